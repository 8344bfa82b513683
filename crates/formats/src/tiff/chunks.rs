//! The strips or tiles of pages, read in any order.

use std::collections::VecDeque;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ::tiff::decoder::ChunkType;
use ::tiff::tags::{ByteOrder, Tag};

use super::PageLocation;
use super::packing::{PagePacking, Predictor};
use super::page::{PageDecoder, PageError, PageShape, decoder, page_shape, tiff_error};
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, shown};
use crate::paged::flat::read_exact_at;
use crate::planes::{PlaneChunks, PlaneSides};
use crate::source::open_file;

/// Where the strips or tiles of a page lie, and how they are packed.
pub(super) struct PageChunks {
    file: u32,
    pub(super) endian: Endian,
    packing: PagePacking,
    predictor: Predictor,
    /// Pixels of a chunk along x and y.
    sides: [u32; 2],
    /// Numbers of a pixel of a chunk.
    samples: u16,
    /// Whether a chunk at the edge is as large as the others.
    is_tiled: bool,
    /// Offset and length of each.
    places: Vec<(u64, u64)>,
}

impl PageChunks {
    /// The chunks of the current page of the decoder of this file.
    pub(super) fn here(decoder: &mut PageDecoder, file: u32, shape: &PageShape) -> Result<Self, PageError> {
        let number = |decoder: &mut PageDecoder, tag| {
            decoder.find_tag_unsigned::<u32>(tag).map(|n| n.unwrap_or(1)).map_err(PageError::Tiff)
        };
        let packing = PagePacking::of(number(decoder, Tag::Compression)?).map_err(PageError::Kind)?;
        let are_floats = matches!(shape.dtype, Dtype::Half | Dtype::Float | Dtype::Double);
        let predictor =
            Predictor::of(number(decoder, Tag::Predictor)?, are_floats).map_err(PageError::Kind)?;
        let samples = number(decoder, Tag::SamplesPerPixel)?;
        let is_tiled = decoder.get_chunk_type() == ChunkType::Tile;
        let (offsets, lengths) = match is_tiled {
            true => (Tag::TileOffsets, Tag::TileByteCounts),
            false => (Tag::StripOffsets, Tag::StripByteCounts),
        };
        let list = |decoder: &mut PageDecoder, tag| decoder.get_tag_u64_vec(tag).map_err(PageError::Tiff);
        let places = list(decoder, offsets)?.into_iter().zip(list(decoder, lengths)?).collect();
        let (width, rows) = decoder.chunk_dimensions();
        let sides = if is_tiled { [width, rows] } else { [shape.width, rows.min(shape.height)] };
        let chunks = Self {
            file,
            endian: byte_order(decoder),
            packing,
            predictor,
            sides,
            samples: if shape.is_planar { 1 } else { samples as u16 },
            is_tiled,
            places,
        };
        let planes = if shape.is_planar { samples } else { 1 };
        let expected =
            [shape.width, shape.height].into_iter().zip(sides).map(|(n, side)| n.div_ceil(side.max(1)));
        if expected.fold(u64::from(planes), |n, m| n.saturating_mul(u64::from(m)))
            != chunks.places.len() as u64
        {
            return Err(PageError::Kind(format!(
                "{} strips or tiles, expected as many as the page has",
                chunks.places.len()
            )));
        }
        if is_tiled && chunks.num_bytes(0, shape) > MAX_CHUNK_BYTES {
            let problem = format!("tiles of {width}×{rows} pixels, expected at most {MAX_CHUNK_BYTES} bytes");
            return Err(PageError::Kind(problem));
        }
        Ok(chunks)
    }

    /// Offset of the numbers of the page, if they lie in its file as they are and without gaps between them.
    pub(super) fn plain_block(&self, shape: &PageShape) -> Option<u64> {
        let is_plain = self.packing == PagePacking::Plain && self.predictor == Predictor::None;
        let has_all = shape.is_planar || self.samples == shape.samples;
        let are_rows =
            self.sides[0] == shape.width && (!self.is_tiled || shape.height.is_multiple_of(self.sides[1]));
        // The length of a single strip does not matter, and is wrong above 4 GB.
        let is_next = |(i, pair): (usize, &[(u64, u64)])| {
            pair[0].0.checked_add(self.num_bytes(i, shape)) == Some(pair[1].0)
        };
        let is_one = is_plain && has_all && are_rows && self.places.windows(2).enumerate().all(is_next);
        self.places.first().filter(|place| is_one && place.1 > 0).map(|place| place.0)
    }

    /// Rows of a chunk that are stored.
    fn rows(&self, chunk: usize, shape: &PageShape) -> u32 {
        let [across, down] = [(shape.width, 0), (shape.height, 1)].map(|(n, k)| n.div_ceil(self.sides[k]));
        let first = (chunk / across as usize % down as usize) as u32 * self.sides[1];
        if self.is_tiled { self.sides[1] } else { self.sides[1].min(shape.height - first) }
    }

    fn row_bytes(&self, shape: &PageShape) -> u64 {
        u64::from(self.sides[0]) * u64::from(self.samples) * shape.dtype.num_bytes() as u64
    }

    /// Bytes of a chunk when unpacked.
    fn num_bytes(&self, chunk: usize, shape: &PageShape) -> u64 {
        self.row_bytes(shape).saturating_mul(u64::from(self.rows(chunk, shape)))
    }

    /// Numbers of a chunk along each axis of a plane.
    fn plane_sides(&self, shape: &PageShape) -> PlaneSides {
        let [x, y] = self.sides.map(u64::from);
        if shape.is_planar { [x, y, 1] } else { [self.samples.into(), x, y] }
    }

    /// The numbers of a chunk in the order `endian`; `None` if it is not there.
    fn read(
        &self,
        (path, (handle, num_bytes)): (&Path, OpenFile),
        chunk: usize,
        shape: &PageShape,
        endian: Endian,
    ) -> Result<Option<Vec<u8>>, FormatError> {
        let data = |problem: String| FormatError::Data { path: shown(path), problem };
        let &(offset, length) =
            self.places.get(chunk).ok_or_else(|| data("a page has too few parts".into()))?;
        // Sparse files have neither place nor length for what is zero.
        if (offset, length) == (0, 0) {
            return Ok(None);
        }
        let expected = self.num_bytes(chunk, shape);
        let wanted = if self.packing == PagePacking::Plain { expected } else { length };
        let found = wanted.min(num_bytes.saturating_sub(offset));
        let mut packed = vec![0; found as usize];
        read_exact_at(&handle, &mut packed, offset).map_err(io_error(path))?;
        let bytes = self.packing.unpack(packed, expected as usize);
        let mut bytes = bytes.map_err(|e| data(format!("the strip or tile at byte {offset}: {e}")))?;
        if (bytes.len() as u64) < expected {
            let found = bytes.len();
            return Err(data(format!(
                "the strip or tile at byte {offset} has {found} bytes, expected {expected}"
            )));
        }
        let size = shape.dtype.num_bytes();
        let row_bytes = self.row_bytes(shape) as usize;
        self.predictor.undo(&mut bytes, row_bytes, (self.samples.into(), size), (self.endian, endian));
        Ok(Some(bytes))
    }
}

/// The byte order of a file.
pub(super) fn byte_order(decoder: &PageDecoder) -> Endian {
    match decoder.byte_order() {
        ByteOrder::LittleEndian => Endian::Little,
        ByteOrder::BigEndian => Endian::Big,
    }
}

/// A file that is open, and its length in bytes.
type OpenFile = (Arc<File>, u64);

/// Where a plane is.
pub(super) enum PlanePlace {
    /// In no file: it has zeros.
    Nowhere,
    /// In a file that is missing.
    Missing(u32),
    At(PageChunks),
}

/// Planes whose chunks were located.
pub(super) struct TiffPlanes {
    files: Vec<PathBuf>,
    /// The files that were read last, by their number.
    open: Mutex<VecDeque<(u32, OpenFile)>>,
    places: Vec<PlanePlace>,
    shape: PageShape,
    /// The byte order of the numbers that are read.
    endian: Endian,
}

impl TiffPlanes {
    pub(super) fn new(files: &[PathBuf], places: Vec<PlanePlace>, shape: PageShape, endian: Endian) -> Self {
        Self { files: files.to_vec(), open: Mutex::default(), places, shape, endian }
    }

    fn opened(&self, file: u32) -> Result<OpenFile, FormatError> {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, found)) = open.iter().find(|(number, _)| *number == file) {
            return Ok(found.clone());
        }
        let path = &self.files[file as usize];
        let handle = open_file(path)?;
        let length = handle.metadata().map_err(io_error(path))?.len();
        let opened = (Arc::new(handle), length);
        open.truncate(MOST_KEPT_OPEN - 1);
        open.push_front((file, opened.clone()));
        Ok(opened)
    }

    /// Has this plane only, as number 0.
    pub(super) fn set_only(&mut self, place: PlanePlace) {
        self.places = vec![place];
    }
}

impl PlaneChunks for TiffPlanes {
    fn sides(&self, plane: usize) -> Option<PlaneSides> {
        match self.places.get(plane)? {
            PlanePlace::Nowhere => None,
            // Whoever asks for it is told that the file is missing.
            PlanePlace::Missing(_) => {
                let PageShape { width, height, samples, is_planar, .. } = self.shape;
                let [x, y, s] = [width.into(), height.into(), samples.into()];
                Some(if is_planar { [x, y, s] } else { [s, x, y] })
            }
            PlanePlace::At(chunks) => Some(chunks.plane_sides(&self.shape)),
        }
    }

    fn chunk(&self, plane: usize, chunk: usize) -> Result<Option<Vec<u8>>, FormatError> {
        match &self.places[plane] {
            PlanePlace::Nowhere => Ok(None),
            PlanePlace::Missing(file) => {
                let path = shown(&self.files[*file as usize]);
                let problem = "the file is missing, which has some of the planes".to_owned();
                Err(FormatError::Data { path, problem })
            }
            PlanePlace::At(chunks) => {
                let file = (&*self.files[chunks.file as usize], self.opened(chunks.file)?);
                chunks.read(file, chunk, &self.shape, self.endian)
            }
        }
    }

    fn path(&self, plane: usize) -> &Path {
        let file = match self.places.get(plane) {
            Some(PlanePlace::At(chunks)) => chunks.file,
            Some(PlanePlace::Missing(file)) => *file,
            _ => 0,
        };
        &self.files[file as usize]
    }
}

/// Finds the chunks of pages. The files that were used last stay open.
pub(super) struct PageFinder<'a> {
    files: &'a [PathBuf],
    shape: PageShape,
    open: VecDeque<(u32, PageDecoder)>,
}

impl<'a> PageFinder<'a> {
    pub(super) fn new(files: &'a [PathBuf], shape: PageShape) -> Self {
        Self { files, shape, open: VecDeque::new() }
    }

    /// The place of a plane; `None` is a plane of zeros.
    pub(super) fn place(&mut self, location: Option<PageLocation>) -> Result<PlanePlace, FormatError> {
        let Some(PageLocation { file, page }) = location else { return Ok(PlanePlace::Nowhere) };
        let path = &self.files[file as usize];
        if let Some(at) = self.open.iter().position(|(number, _)| *number == file) {
            self.open.swap(0, at);
        } else {
            if file > 0 && !path.exists() {
                return Ok(PlanePlace::Missing(file));
            }
            self.open.truncate(MOST_DECODERS - 1);
            self.open.push_front((file, decoder(path)?));
        }
        let Some((_, decoder)) = self.open.front_mut() else { return Ok(PlanePlace::Nowhere) };
        decoder.seek_to_image(page as usize).map_err(|e| tiff_error(path, page, e))?;
        let found = page_shape(decoder).map_err(|e| e.at(path, page))?;
        if found != self.shape {
            let problem = format!("page {page} is {}, expected {}", found.name(), self.shape.name());
            return Err(FormatError::Data { path: shown(path), problem });
        }
        let chunks = PageChunks::here(decoder, file, &found).map_err(|e| e.at(path, page))?;
        Ok(PlanePlace::At(chunks))
    }
}

/// Largest tile, unpacked.
const MAX_CHUNK_BYTES: u64 = 1 << 30;
/// Most files that stay open for reading.
const MOST_KEPT_OPEN: usize = 64;
/// Most files whose directories are walked at the same time.
const MOST_DECODERS: usize = 16;
