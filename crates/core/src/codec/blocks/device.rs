//! Frames in words, as a GPU decodes them (`shaders/blocks/frame.wgsl`), and what it needs to decode one.

use super::super::chunk::all_of_frame;
use super::super::error::CodecError;
use super::super::header::HEADER_BYTES;
use super::entropy::Tables;
use super::head::{Head, read_streams};
use super::model::lists_of;
use super::motion::ReferenceMotion;
use super::reference::{Reference, num_blocks};
use super::scales::scales;
use super::syntax::Contexts;
use super::tile::{NO_CELLS, Planes};
use super::transform::{WAVES, ZIGZAG};
use crate::camera::Camera;
use crate::ids::FrameId;
use crate::layer::FrameHeader;

/// A decoded frame in words.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FrameWords {
    /// Two for each block, row by row: one more than the number of its layers, with [`HAS_CELLS`], and the index of the
    /// first. 0 and 0 for a block of which nothing was sent.
    pub blocks: Vec<u32>,
    /// [`WORDS_OF_LAYER`] for each layer, block by block: front and back (depth, growth rightwards and downwards); then
    /// the mask of the lists with a cell, the least front and the greatest back of the cells, and the index of the
    /// first. The cells of a block may be with any of its layers, front to back.
    pub layers: Vec<u32>,
    /// [`WORDS_OF_CELL`] for each cell, list by list: front and back, code of u and Y, Co and Cg, two in a word.
    pub cells: Vec<u32>,
}

impl FrameWords {
    /// The same, with layers and cells in the order of the blocks, and cells with the first layers of a block. A device
    /// has them in any order.
    pub fn sorted(&self) -> Self {
        let mut sorted = Self::default();
        for &[word, first] in self.blocks.as_chunks().0 {
            let num_layers = (word & !HAS_CELLS).saturating_sub(1) as usize;
            let words = first as usize * WORDS_OF_LAYER..(first as usize + num_layers) * WORDS_OF_LAYER;
            let own = self.layers[words].as_chunks::<WORDS_OF_LAYER>().0;
            sorted.add_block(word, num_layers, own.iter().map(|layer| &layer[..6]));
            let filled = own.iter().filter(|layer| layer[6] | layer[7] != 0);
            for (n, [.., low, high, bounds, first]) in filled.enumerate() {
                let num_cells = (low.count_ones() + high.count_ones()) as usize;
                let first = *first as usize * WORDS_OF_CELL;
                sorted.add_cells(
                    num_layers - n,
                    [*low, *high, *bounds],
                    &self.cells[first..][..num_cells * WORDS_OF_CELL],
                );
            }
        }
        sorted
    }

    /// Appends a block with the planes of its layers.
    fn add_block<'a>(&mut self, word: u32, num_layers: usize, planes: impl Iterator<Item = &'a [u32]>) {
        let first = if num_layers == 0 { 0 } else { self.layers.len() / WORDS_OF_LAYER };
        self.blocks.extend([word, first as u32]);
        for planes in planes {
            self.layers.extend_from_slice(planes);
            self.layers.extend([0; WORDS_OF_LAYER - 6]);
        }
    }

    /// Appends cells of the layer that is so many before the end, with their mask and bounds.
    fn add_cells(&mut self, before_end: usize, [low, high, bounds]: [u32; 3], cells: &[u32]) {
        let first = (self.cells.len() / WORDS_OF_CELL) as u32;
        let layer = self.layers.len() - before_end * WORDS_OF_LAYER;
        self.layers[layer + 6..layer + WORDS_OF_LAYER].copy_from_slice(&[low, high, bounds, first]);
        self.cells.extend_from_slice(cells);
    }
}

impl Reference {
    /// The frame in words.
    pub fn words(&self) -> FrameWords {
        let [across, down] = num_blocks(&self.header);
        let mut words = FrameWords::default();
        for block in 0..across * down {
            let [x, y] = [block % across, block / across];
            let Some((tile, index)) = self.block(x as i32, y as i32) else {
                words.blocks.extend([0; 2]);
                continue;
            };
            let planes = &tile.planes[tile.layers(index)];
            let has_cells = if tile.has_matter(index) { HAS_CELLS } else { 0 };
            let of_planes: Vec<[u32; 6]> = planes.iter().map(plane_words).collect();
            let word = (planes.len() as u32 + 1) | has_cells;
            words.add_block(word, planes.len(), of_planes.iter().map(|words| &words[..]));
            let (mut spread, mut n) = (NO_CELLS, planes.len());
            let mut walk = tile.cells_of(index).walk(&mut spread);
            while let Some((layer, cells)) = walk.next() {
                let bounds = u32::from(layer.front) | u32::from(layer.back) << 16;
                let of_cells: Vec<u32> = lists_of(layer.mask)
                    .flat_map(|list| {
                        let own = cells.map(|plane| u32::from(plane[list]));
                        [own[0] | own[1] << 16, own[2] | own[3] << 16, own[4] | own[5] << 16]
                    })
                    .collect();
                words.add_cells(n, [layer.mask as u32, (layer.mask >> 32) as u32, bounds], &of_cells);
                n -= 1;
            }
        }
        words
    }

    /// Twice as many words as contexts: how often each had a zero and a one, in this frame and before.
    pub fn count_words(&self) -> &[u32] {
        self.counts.of_places.as_flattened()
    }

    /// The probabilities of a frame that is predicted from this one, two in a word.
    pub fn probability_words(&self) -> Vec<u32> {
        pairs(&self.tables.ones)
    }
}

fn plane_words((front, back): &Planes) -> [u32; 6] {
    [front.z, front.dx, front.dy, back.z, back.dx, back.dy].map(|v| v as u32)
}

/// The chunks of a frame, for a GPU that decodes them.
#[derive(Clone, Debug, PartialEq)]
pub struct DevicePayload {
    /// The header of the frame.
    pub header: FrameHeader,
    /// The frame that it is predicted from.
    pub reference: Option<FrameId>,
    /// Steps of depth, opacity, colour, the picture's correction, and of colour over brightness.
    pub steps: [u16; 5],
    /// The probabilities of all contexts, two in a word, once for each chunk; empty for a predicted frame, which has
    /// those of its reference.
    pub probabilities: Vec<u32>,
    /// Number of streams.
    pub num_streams: usize,
    /// Five words for each stream: the first of its words of 16 bits, their number, the first word of its
    /// probabilities; column and row of its first block, and columns and rows of blocks, two in a word. Then the
    /// streams.
    pub words: Vec<u32>,
}

impl DevicePayload {
    /// Reads all chunks of a frame in blocks, in any order, but not the bits of their tiles.
    ///
    /// # Errors
    /// If chunks are damaged, missing or of different frames.
    pub fn read<B: AsRef<[u8]>>(chunks: &[B]) -> Result<Self, CodecError> {
        let chunks = all_of_frame(chunks)?;
        let (mut heads, mut probabilities, mut streams) = (vec![], vec![], vec![]);
        for (header, bytes) in &chunks {
            let mut coded = bytes.get(HEADER_BYTES..).unwrap_or_default();
            let head = Head::read(&mut coded, header)?;
            let tables = probabilities.len() as u32;
            if head.reference.is_none() {
                probabilities.extend(pairs(&Tables::read(&mut coded)?.ones));
            }
            let places = head.tiles(&header.frame, header.index.0.into());
            streams.extend(read_streams(coded, &places)?.into_iter().map(|stream| (stream, tables)));
            heads.push((header, head));
        }
        let Some(&(first, head)) = heads.first() else {
            return Err(CodecError::Incomplete { found: 0, expected: 1 });
        };
        if let Some((header, _)) = heads.iter().find(|(_, other)| *other != head) {
            return Err(header.contradicts("other steps, predictions or bands"));
        }
        let mut words = Vec::new();
        let mut at = 2 * WORDS_OF_STREAM * streams.len();
        for ((place, stream), tables) in &streams {
            let num_words = stream.len() / 2;
            let two = |[a, b]: [usize; 2]| a as u32 | (b as u32) << 16;
            let blocks = [two(place.first), two([place.across, place.num_rows])];
            words.extend([at as u32, num_words as u32, *tables, blocks[0], blocks[1]]);
            at += num_words;
        }
        let halves: Vec<u16> = streams
            .iter()
            .flat_map(|((_, stream), _)| stream.as_chunks().0)
            .map(|bytes| u16::from_le_bytes(*bytes))
            .collect();
        words.extend(pairs(&halves));
        let steps = head.steps;
        Ok(Self {
            header: first.frame,
            reference: head.reference,
            steps: [steps.depth, steps.opacity, steps.color, steps.picture, steps.chroma],
            probabilities,
            num_streams: streams.len(),
            words,
        })
    }
}

/// The numbers of a motion between two cameras; see `shaders/blocks/motion.wgsl`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MotionWords {
    /// Factors of a depth, and what is added: x, y, weight and depth, each as factors of x and y and a constant.
    pub along: [[i32; 3]; 4],
    /// See `along`.
    pub here: [[i32; 3]; 4],
    /// Bits after the point of a factor of x or y.
    pub shift: u32,
    /// Whether the cameras are the same.
    pub is_still: bool,
}

/// The motion from a frame's camera to that of its reference.
pub fn motion_words(camera: &Camera, reference: &Camera) -> MotionWords {
    let motion = ReferenceMotion::new(camera, reference);
    MotionWords { along: motion.along, here: motion.here, shift: motion.shift, is_still: motion.is_still }
}

/// The tables of opacity, colour and depth, in the order of `shaders/blocks/scales.wgsl`.
pub fn scale_words() -> Vec<u32> {
    let scales = scales();
    let signed = |values: &[i16]| pairs(&values.iter().map(|v| *v as u16).collect::<Vec<_>>());
    let mut words = scales.by_code.to_vec();
    words.extend(pairs(&scales.code_of_log[..]));
    words.extend(signed(&scales.log_of_mantissa[..]));
    words.extend(signed(&scales.log_of_sum[..]));
    words.extend(pairs(&scales.per_root[..]));
    words.extend(WAVES.as_flattened().iter().map(|v| *v as u32));
    words.extend(ZIGZAG.map(u32::from));
    words.extend(scales.alpha.iter().map(|v| v.to_bits()));
    words.extend(pairs(&scales.tau_half));
    words
}

/// The first contexts of each kind, by their names in `shaders/blocks/syntax.wgsl`.
pub fn context_places() -> [(&'static str, u16); 19] {
    let c = Contexts::all();
    [
        ("HAS_PLANES", c.has_planes[0][0]),
        ("IS_COPIED", c.is_copied[0]),
        ("IS_KEPT", c.is_kept[0]),
        ("IS_MERGED", c.is_merged[0]),
        ("IS_ABOVE", c.is_above[0]),
        ("NUM_LAYERS", c.num_layers[0][0][0]),
        ("TOUCHES", c.touches[0]),
        ("DEPTH", c.depth[0][0].is_not_zero),
        ("SLOPE", c.slope[0][0].is_not_zero),
        ("HAS_MATTER", c.has_matter[0][0]),
        ("IS_FULL", c.is_full[0][0]),
        ("IS_SAME", c.is_same[0][0]),
        ("OCCUPANCY", c.occupancy[0][0]),
        ("HAS_CORRECTION", c.has_correction[0]),
        ("IS_ZERO", c.is_zero[0][0][0]),
        ("CLASS", c.class[0][0][0][0]),
        ("REST", c.rest[0][0]),
        ("SIZE", c.size[0][0][0][0]),
        ("ESCAPE", c.escape.length[0]),
    ]
    .map(|(name, context)| (name, context.0))
}

/// The probabilities of a frame of which nothing is known, two in a word.
pub fn prior_words() -> Vec<u32> {
    pairs(&Tables::prior().ones)
}

/// Two numbers in a word, the first in its lower half.
fn pairs(values: &[u16]) -> Vec<u32> {
    values
        .chunks(2)
        .map(|two| u32::from(two[0]) | u32::from(two.get(1).copied().unwrap_or(0)) << 16)
        .collect()
}

/// In the first word of a block: whether a list has a cell.
pub const HAS_CELLS: u32 = 1 << 31;
/// Words of a layer.
pub const WORDS_OF_LAYER: usize = 10;
/// Words of a cell.
pub const WORDS_OF_CELL: usize = 3;
/// Words that say where a stream is, and whose blocks it has.
pub const WORDS_OF_STREAM: usize = 5;
