//! The slices of a series as its plan has them: decoded, rescaled, cut out of mosaics, and resampled.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::frame::Frame;
use super::resample::Resampling;
use super::shape::Shape;
use super::{inverted_sum, pixels};
use crate::chunk_cache::ChunkCache;
use crate::dtype::Dtype;
use crate::error::{FormatError, shown};
use crate::planes::{PlaneChunks, PlaneSides};
use crate::source::open_file;

/// The slices of a series, each a function of its number alone, so that they can be read in any order.
pub(super) struct DicomSlices {
    files: Vec<PathBuf>,
    shape: Shape,
    /// Slices in the files, along the normal, then in time.
    frames: Vec<Frame>,
    /// How many of them are at one time.
    num_stored: usize,
    resampling: Option<Resampling>,
    /// The type of the plan.
    dtype: Dtype,
    /// Whether voxels are floats, because each slice has its own scale.
    is_rescaled: bool,
    /// Pictures that several slices take.
    pictures: ChunkCache<Arc<Vec<u8>>>,
}

impl DicomSlices {
    /// The slices of these frames. Floats of integers are rescaled ones.
    pub(super) fn new(
        files: Vec<PathBuf>,
        shape: Shape,
        frames: Vec<Frame>,
        num_stored: usize,
        resampling: Option<Resampling>,
        (dtype, is_rescaled): (Dtype, bool),
    ) -> Self {
        let kept = MOST_KEPT.max(shape.num_bytes().saturating_mul(LEAST_KEPT));
        let pictures = ChunkCache::new(kept);
        Self { files, shape, frames, num_stored, resampling, dtype, is_rescaled, pictures }
    }

    /// The files of the series and those beside them.
    pub(super) fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// How many slices there are, at all times.
    pub(super) fn len(&self) -> usize {
        self.num_shown() * (self.frames.len() / self.num_stored)
    }

    /// How many slices are at one time.
    fn num_shown(&self) -> usize {
        self.resampling.as_ref().map_or(self.num_stored, Resampling::num_slices)
    }

    /// Refuses pictures that are too large.
    pub(super) fn check_size(&self) -> Result<(), FormatError> {
        let num_bytes = self.shape.num_bytes();
        if num_bytes > MAX_FRAME_BYTES {
            let problem = format!("a frame of {num_bytes} bytes, expected at most {MAX_FRAME_BYTES}");
            return Err(FormatError::Data { path: shown(&self.files[0]), problem });
        }
        Ok(())
    }

    /// The numbers of a slice in the type of the plan, little-endian.
    pub(super) fn slice(&self, i: usize) -> Result<Vec<u8>, FormatError> {
        let Some(resampling) = &self.resampling else { return self.voxels(i) };
        let (time, slice) = (i / self.num_shown(), i % self.num_shown());
        let stored = |k: usize| time * self.num_stored + k;
        let mut numbers = resampling.slice(slice, |k| self.numbers(stored(k)))?;
        if numbers.iter().any(|x| x.is_nan()) {
            let outside = self.outside(stored(resampling.beside(slice)))?;
            numbers.iter_mut().filter(|x| x.is_nan()).for_each(|x| *x = outside);
        }
        Ok(self.bytes(&numbers))
    }

    /// The numbers of a stored slice as they are in its file.
    fn decode(&self, index: usize) -> Result<Arc<Vec<u8>>, FormatError> {
        let (frame, is_mosaic) = (&self.frames[index], self.shape.tiles > 1);
        let picture = || {
            let path = &self.files[frame.file];
            let mut file = open_file(path)?;
            let bytes = pixels::decode(&mut file, frame, &self.shape);
            bytes.map(Arc::new).map_err(|problem| FormatError::Data { path: shown(path), problem })
        };
        if !is_mosaic && self.resampling.is_none() {
            return picture();
        }
        // A file with a mosaic has no other picture.
        let key = if is_mosaic { frame.file } else { index };
        let picture = self.pictures.get((key, Vec::new()), self.shape.num_bytes(), picture)?;
        Ok(if is_mosaic { Arc::new(pixels::tile(&picture, frame, &self.shape)) } else { picture })
    }

    /// The numbers of a stored slice in the type of the plan.
    fn voxels(&self, index: usize) -> Result<Vec<u8>, FormatError> {
        let bytes = self.decode(index)?;
        if !self.is_rescaled {
            return Ok(Arc::unwrap_or_clone(bytes));
        }
        let value = |number| self.in_plan(index, number).to_le_bytes();
        Ok(numbers(&bytes, self.shape.dtype()).flat_map(value).collect())
    }

    /// Whether a stored number is padding.
    fn is_padding(&self, index: usize, number: f64) -> bool {
        let padding = self.frames[index].padding.filter(|_| self.shape.samples == 1);
        padding.is_some_and(|(least, greatest)| (least..=greatest).contains(&number))
    }

    /// The number of the plan for a stored one. Padding is none in floats that were rescaled.
    fn in_plan(&self, index: usize, number: f64) -> f32 {
        if !self.is_rescaled {
            return number as f32;
        }
        if self.is_padding(index, number) {
            return f32::NAN;
        }
        let upright = if self.shape.is_inverted { inverted_sum(&self.shape) - number } else { number };
        self.frames[index].scale.value(upright) as f32
    }

    /// The numbers of a stored slice as the plan has them, but none where there is padding.
    fn numbers(&self, index: usize) -> Result<Vec<f32>, FormatError> {
        let bytes = self.decode(index)?;
        let number = |number| {
            if self.is_padding(index, number) { f32::NAN } else { self.in_plan(index, number) }
        };
        Ok(numbers(&bytes, self.shape.dtype()).map(number).collect())
    }

    /// The number that stands where a slice has none: padding, or else the darkest one of a stored slice.
    fn outside(&self, index: usize) -> Result<f32, FormatError> {
        if let Some((least, _)) = self.frames[index].padding {
            return Ok(self.in_plan(index, least));
        }
        let is_highest = self.shape.is_inverted && !self.is_rescaled;
        let darkest = self.numbers(index)?.into_iter().reduce(if is_highest { f32::max } else { f32::min });
        Ok(darkest.filter(|x| !x.is_nan()).unwrap_or(0.0))
    }

    /// The bytes of numbers in the type of the plan.
    fn bytes(&self, numbers: &[f32]) -> Vec<u8> {
        let numbers = numbers.iter().copied();
        match self.dtype {
            Dtype::Uint8 => numbers.map(|x| x.round() as u8).collect(),
            Dtype::Int8 => numbers.map(|x| x.round() as i8 as u8).collect(),
            Dtype::Uint16 => numbers.flat_map(|x| (x.round() as u16).to_le_bytes()).collect(),
            Dtype::Int16 => numbers.flat_map(|x| (x.round() as i16).to_le_bytes()).collect(),
            Dtype::Uint32 => numbers.flat_map(|x| (x.round() as u32).to_le_bytes()).collect(),
            Dtype::Int32 => numbers.flat_map(|x| (x.round() as i32).to_le_bytes()).collect(),
            Dtype::Double => numbers.flat_map(|x| f64::from(x).to_le_bytes()).collect(),
            _ => numbers.flat_map(f32::to_le_bytes).collect(),
        }
    }
}

/// Each slice is one chunk.
impl PlaneChunks for Arc<DicomSlices> {
    fn sides(&self, _: usize) -> Option<PlaneSides> {
        let Shape { columns, rows, samples, is_planar, .. } = self.shape;
        let stored = [columns, rows].map(u64::from);
        let [x, y] = self.resampling.as_ref().map_or(stored, |r| r.shown.map(|n| n as u64));
        Some(if is_planar { [x, y, samples.into()] } else { [samples.into(), x, y] })
    }

    fn chunk(&self, plane: usize, _: usize) -> Result<Option<Vec<u8>>, FormatError> {
        self.slice(plane).map(Some)
    }

    fn path(&self, plane: usize) -> &Path {
        let index = if self.resampling.is_some() { 0 } else { plane.min(self.frames.len() - 1) };
        &self.files[self.frames[index].file]
    }
}

/// The numbers in little-endian words of this type.
fn numbers(bytes: &[u8], dtype: Dtype) -> Box<dyn Iterator<Item = f64> + '_> {
    macro_rules! of {
        ($t:ty) => {
            Box::new(bytes.as_chunks().0.iter().map(|b| <$t>::from_le_bytes(*b) as f64))
        };
    }
    match dtype {
        Dtype::Uint8 => of!(u8),
        Dtype::Int8 => of!(i8),
        Dtype::Uint16 => of!(u16),
        Dtype::Int16 => of!(i16),
        Dtype::Uint32 => of!(u32),
        Dtype::Int32 => of!(i32),
        Dtype::Double => of!(f64),
        _ => of!(f32),
    }
}

/// Largest frame, decompressed.
const MAX_FRAME_BYTES: u64 = 1 << 30;
/// Bytes of pictures that are kept for the next slices, and how many pictures at least.
const MOST_KEPT: u64 = 32 << 20;
const LEAST_KEPT: u64 = 3;
