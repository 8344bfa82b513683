//! Reference frames, from which later ones are predicted.

use std::collections::VecDeque;
use std::sync::Arc;

use super::corrections::{self, TilePicture};
use super::entropy::Tables;
use super::entropy::Tally;
use super::model::{BLOCK, blocks_along, middle_of};
use super::motion::ReferenceMotion;
use super::steps::StepSizes;
use super::tables::Counts;
use super::tile::FrameTile;
use crate::ids::FrameId;
use crate::layer::FrameHeader;

/// A decoded frame as predictions need it. A comparison of two ignores the encoder's notes.
#[derive(Clone, Debug)]
pub struct Reference {
    pub(super) header: FrameHeader,
    /// The steps of its coding.
    pub(super) steps: Option<StepSizes>,
    /// The blocks of its streams.
    pub(super) tiles: Vec<Arc<FrameTile>>,
    /// For each block of the frame, row by row, index of its tile and its index there; `None` where nothing was sent.
    blocks: Vec<Option<(u32, u32)>>,
    /// What its contexts had, and the frames before.
    pub(super) counts: Counts,
    /// The probabilities that follow, of a frame that is predicted from it.
    pub(super) tables: Tables,
    /// λ of its layers; `None` for a decoded frame.
    pub(super) lambda: Option<f32>,
    /// Notes for each tile; empty for a decoded frame.
    pub(super) notes: Vec<Notes>,
}

/// A tile before the picture of its frame is corrected.
#[derive(Clone, Debug, Default)]
pub(in crate::codec) struct CodedTile {
    pub(super) tile: FrameTile,
    pub(super) picture: TilePicture,
}

impl CodedTile {
    /// Number of its blocks.
    pub(in crate::codec) fn num_blocks(&self) -> usize {
        self.tile.blocks.len()
    }
}

/// For each block of a tile, the error of its planes after the last search, in units of the cost of a layer. It is
/// less if the planes fit better since. 0 where nothing is known.
pub(in crate::codec) type Notes = Vec<f32>;

impl PartialEq for Reference {
    fn eq(&self, other: &Self) -> bool {
        (&self.header, &self.steps, &self.tiles, &self.counts)
            == (&other.header, &other.steps, &other.tiles, &other.counts)
    }
}

impl Reference {
    pub(super) fn new(
        header: FrameHeader,
        steps: Option<StepSizes>,
        tiles: Vec<Arc<FrameTile>>,
        counts: Counts,
    ) -> Self {
        let tables = counts.tables();
        let [across, down] = num_blocks(&header);
        let mut blocks = vec![None; across * down];
        for (index, tile) in tiles.iter().enumerate() {
            for block in 0..tile.blocks.len() {
                let [x, y] = tile.place.in_frame(block % tile.place.across, block / tile.place.across);
                if let Some(place) = blocks.get_mut(y * across + x) {
                    *place = Some((index as u32, block as u32));
                }
            }
        }
        Self { header, steps, tiles, blocks, counts, tables, lambda: None, notes: Vec::new() }
    }

    /// Corrects the picture of all tiles of a frame, whose bits are counted. `before` is what it was predicted from.
    pub(super) fn of_tiles(
        header: FrameHeader,
        steps: StepSizes,
        coded: Vec<CodedTile>,
        tally: &Tally,
        before: Option<&Self>,
    ) -> Self {
        let counts = before.map(|reference| reference.counts.faded()).unwrap_or_default().with(tally);
        let (mut tiles, mut pictures): (Vec<FrameTile>, Vec<TilePicture>) =
            coded.into_iter().map(|CodedTile { tile, picture }| (tile, picture)).unzip();
        corrections::correct(&mut tiles, &mut pictures, num_blocks(&header), steps.of_picture());
        Self::new(header, Some(steps), tiles.into_iter().map(Arc::new).collect(), counts)
    }

    /// Adds the notes of its encoding.
    pub(super) fn with_notes(self, lambda: f32, notes: Vec<Notes>) -> Self {
        Self { lambda: Some(lambda), notes, ..self }
    }

    /// The frame.
    pub fn frame(&self) -> FrameId {
        self.header.frame
    }

    /// Its size in bytes, by the count that sender and receiver share.
    fn num_bytes(&self) -> usize {
        self.tiles.iter().map(|tile| tile.num_bytes()).sum()
    }

    /// Mean number of cells in its tiles.
    pub(super) fn cells_per_tile(&self) -> usize {
        self.tiles.iter().map(|tile| tile.num_cells()).sum::<usize>() / self.tiles.len().max(1)
    }

    /// Index of the tile with the block at column `x` and row `y` of blocks, and of the block in it. None outside of the
    /// frame, and in a tile that was not sent.
    fn place(&self, x: i32, y: i32) -> Option<(usize, usize)> {
        let (x, y) = (usize::try_from(x).ok()?, usize::try_from(y).ok()?);
        let [across, _] = num_blocks(&self.header);
        let (tile, block) = (*self.blocks.get(y * across + x).filter(|_| x < across)?)?;
        Some((tile as usize, block as usize))
    }

    /// The tile of the block at column `x` and row `y` of blocks, and its index there.
    pub(super) fn block(&self, x: i32, y: i32) -> Option<(&FrameTile, usize)> {
        let (tile, block) = self.place(x, y)?;
        Some((&self.tiles[tile], block))
    }

    /// The note on the block at column `x` and row `y` of blocks; 0 for none.
    pub(super) fn note(&self, [x, y]: [i32; 2]) -> f32 {
        let Some((tile, block)) = self.place(x, y) else { return 0.0 };
        self.notes.get(tile).and_then(|notes| notes.get(block)).copied().unwrap_or(0.0)
    }

    /// Column and row of the reference's block that the middle of the block at (`x`, `y`) of a frame moves to. They
    /// may lie outside.
    pub(super) fn moved_to(&self, motion: &ReferenceMotion, at: [usize; 2]) -> Option<[i32; 2]> {
        let [x, y] = at.map(|v| v as i32);
        // The depth of the move is the reference's, here or in a neighbour.
        let (front, _) = [(0, 0), (0, -1), (-1, 0), (1, 0), (0, 1)].into_iter().find_map(|(dx, dy)| {
            let (tile, block) = self.block(x + dx, y + dy)?;
            tile.planes[tile.layers(block)].first()
        })?;
        let middle = middle_of([x, y]);
        let shift = motion.at(middle, front.z)?;
        let to = [64 * middle[0] + shift.x, 64 * middle[1] + shift.y];
        Some(to.map(|v| v.div_euclid(64 * BLOCK as i32)))
    }
}

/// Columns and rows of blocks.
pub(super) fn num_blocks(header: &FrameHeader) -> [usize; 2] {
    let intrinsics = header.camera.intrinsics;
    [intrinsics.width, intrinsics.height].map(blocks_along)
}

/// The last frames that a receiver decoded or a sender sent, from which later frames may be predicted.
#[derive(Clone, Debug, Default)]
pub struct References {
    newest_last: VecDeque<Arc<Reference>>,
    num_bytes: usize,
    /// Ids of the last added frames, including those that gave way to newer ones.
    frames: VecDeque<FrameId>,
}

impl References {
    /// Adds a frame. The oldest give way beyond [`MAX_REFERENCES`] frames or [`MAX_REFERENCE_BYTES`]; the newest
    /// stays. A receiver adds no more frames than its sender, so it keeps every frame that the sender keeps.
    pub fn insert(&mut self, reference: Arc<Reference>) {
        if self.frames.len() == MAX_REFERENCES {
            self.frames.pop_front();
        }
        self.frames.push_back(reference.frame());
        self.num_bytes += reference.num_bytes();
        self.newest_last.push_back(reference);
        let is_over =
            |kept: &Self| kept.newest_last.len() > MAX_REFERENCES || kept.num_bytes > MAX_REFERENCE_BYTES;
        while is_over(self) && self.newest_last.len() > 1 {
            let oldest = self.newest_last.pop_front();
            self.num_bytes -= oldest.map_or(0, |reference| reference.num_bytes());
        }
    }

    /// The size of all in bytes, by the count that sender and receiver share.
    pub fn num_bytes(&self) -> usize {
        self.num_bytes
    }

    /// Keeps only the newest frame. A sender may keep fewer than its receiver.
    pub fn keep_newest(&mut self) {
        if let Some(newest) = self.newest_last.pop_back() {
            self.num_bytes = newest.num_bytes();
            self.newest_last = VecDeque::from([newest]);
        }
    }

    /// Forgets all frames.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// The frame with this id, if it is kept.
    pub fn get(&self, frame: FrameId) -> Option<&Arc<Reference>> {
        self.newest_last.iter().rev().find(|r| r.frame() == frame)
    }

    /// The reference for the next frame, if `decoded` is the last frame that the receiver has reported. It is the
    /// newest frame, which will arrive. If too many are on their way, or one may be lost, it is the reported one, if
    /// that is kept.
    pub fn next(&self, decoded: FrameId) -> Option<&Arc<Reference>> {
        let ahead = self.frames.iter().rev().take_while(|&&frame| frame > decoded).count();
        if ahead <= MAX_AHEAD { self.newest() } else { self.get(decoded) }
    }

    /// The newest frame.
    pub fn newest(&self) -> Option<&Arc<Reference>> {
        self.newest_last.back()
    }
}

/// Most frames that are kept. A frame names no older one.
pub const MAX_REFERENCES: usize = 32;
/// Most bytes of kept frames, as counted. A cell counts 12 bytes. So 1280×720 lists of 4 cells on average count 44
/// MB, and eleven such frames fit. 1920×1080 lists of 8 cells count 200 MB, and two fit. Real memory is a tenth more,
/// and up to seven times as much for layers with few cells. If only one fits, a lost frame costs a frame without a
/// reference.
pub const MAX_REFERENCE_BYTES: usize = 512 << 20;
/// Most frames that may be named before the receiver reports one of them: those of a round trip of 400 ms at 60
/// frames a second. This is also the longest time for which a lost frame is missed.
const MAX_AHEAD: usize = 24;
