//! The levels of means that an index keeps of a volume without levels: those that `convert` makes, from a thirty-second of
//! the voxels on, and larger ones that take little room.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

use isinglass_core::volume::PyramidLevel;

use super::flat::read_exact_at;
use super::levels::PageLevel;
use crate::convert::average::{NumberBox, Rule};
use crate::dtype::Dtype;
use crate::padding::GapNumbers;
use crate::zarr::pyramid_levels;

/// The levels of a volume: which are kept, and how each is made of the one above.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct MeanPlan {
    /// Voxels of the level above that become one, for the levels from the first below the finest to the first that is
    /// kept.
    pub(super) before: Vec<[usize; 3]>,
    /// The levels that are kept, and the same for those after the first.
    pub(super) kept: Vec<(PyramidLevel, [usize; 3])>,
    pub(super) dtype: Dtype,
}

impl MeanPlan {
    /// The levels of a volume whose finest one is given; `None` if none is kept.
    pub(super) fn of(finest: &PageLevel) -> Option<Self> {
        let dims = finest.shape.dims.map(u64::from);
        let num_voxels: u64 = dims.iter().product();
        let spacing = finest.chosen.grid.spacing.to_array().map(f64::from);
        let (mut before, mut kept, mut factor) = (Vec::new(), Vec::new(), [1u32; 3]);
        for level in pyramid_levels(dims, spacing).into_iter().skip(1) {
            let step = level.factors.map(|n| n as usize);
            factor = [0, 1, 2].map(|k| factor[k] * step[k] as u32);
            let first = factor.map(|n| (n as f32 - 1.0) / 2.0);
            let shape = PyramidLevel { dims: level.dims.map(|n| n as u32), factor, first };
            if kept.is_empty() {
                before.push(step);
            }
            if is_kept(level.num_voxels(), num_voxels, finest.plan.dtype) {
                kept.push((shape, step));
            }
        }
        let is_possible =
            kept.first().is_some_and(|(first, _)| first.factor.iter().all(|n| *n <= MOST_AT_ONCE));
        is_possible.then_some(Self { before, kept, dtype: finest.plan.dtype })
    }

    /// The first kept level of a box of the finest one, which begins at a multiple of 64 voxels.
    pub(super) fn first_of(&self, mut numbers: NumberBox, rule: &Rule) -> NumberBox {
        for step in &self.before {
            numbers = numbers.reduced(self.dtype, *step, rule);
        }
        numbers
    }
}

/// Whether a level of so many voxels is kept, of a volume with so many in the finest one.
fn is_kept(num_voxels: u64, num_finest: u64, dtype: Dtype) -> bool {
    num_voxels * LEAST_SHARE <= num_finest || num_voxels * dtype.num_bytes() as u64 <= LITTLE_ROOM
}

/// The numbers of the levels, while an index is made.
#[derive(Debug)]
pub(super) struct MeanLevels {
    pub(super) plan: MeanPlan,
    /// For each level its channels.
    pub(super) levels: Vec<Vec<NumberFile>>,
    /// Whether the voxels are labels, so that levels have the most frequent ones.
    pub(super) are_labels: bool,
    /// The numbers of voxels without a value that all channels share.
    pub(super) gaps: GapNumbers,
}

impl MeanLevels {
    /// Room for the levels, in files without a name in `folder`.
    ///
    /// # Errors
    /// If the system refuses.
    pub(super) fn new(plan: &MeanPlan, num_channels: usize, folder: &Path) -> io::Result<Self> {
        let channels = |shape: &PyramidLevel| {
            (0..num_channels).map(|_| NumberFile::new(shape.dims, plan.dtype, folder)).collect()
        };
        let levels = plan.kept.iter().map(|(shape, _)| channels(shape)).collect::<io::Result<_>>()?;
        Ok(Self { plan: plan.clone(), levels, are_labels: false, gaps: GapNumbers::default() })
    }

    /// Adds a box of the first level, made of one that begins at this voxel of the finest level.
    pub(super) fn add(&self, channel: usize, at: [u32; 3], numbers: &NumberBox) -> io::Result<()> {
        let factor = self.plan.kept[0].0.factor;
        self.levels[0][channel].write([0, 1, 2].map(|k| u64::from(at[k] / factor[k])), numbers)
    }

    /// Makes the other levels of the first one.
    pub(super) fn reduce(&self, rules: &[Rule]) -> io::Result<()> {
        for (i, (_, step)) in self.plan.kept.iter().enumerate().skip(1) {
            for (channel, rule) in rules.iter().enumerate() {
                let (above, level) = (&self.levels[i - 1][channel], &self.levels[i][channel]);
                for (at, dims) in boxes(above.dims, 2 * CHUNK_SIDE) {
                    let made = above.read(at, dims)?.reduced(self.plan.dtype, *step, rule);
                    level.write([0, 1, 2].map(|k| at[k] / step[k] as u64), &made)?;
                }
            }
        }
        Ok(())
    }
}

/// Numbers of a grid in a file without a name, x fastest.
#[derive(Debug)]
pub(super) struct NumberFile {
    file: File,
    pub(super) dims: [u64; 3],
    size: u64,
}

impl NumberFile {
    fn new(dims: [u32; 3], dtype: Dtype, folder: &Path) -> io::Result<Self> {
        let file = tempfile::tempfile_in(folder)?;
        Ok(Self { file, dims: dims.map(u64::from), size: dtype.num_bytes() as u64 })
    }

    /// Calls `run` with the bytes of each piece of a box that lies at one place of the file, and that place.
    fn pieces(
        &self,
        at: [u64; 3],
        dims: [usize; 3],
        mut run: impl FnMut(u64, std::ops::Range<usize>) -> io::Result<()>,
    ) -> io::Result<()> {
        let [nx, ny, nz] = dims;
        // Whole rows lie one after the other.
        let rows = if nx as u64 == self.dims[0] { ny } else { 1 };
        let length = nx * rows * self.size as usize;
        for i in 0..ny / rows.max(1) * nz {
            let (y, z) = ((i % (ny / rows) * rows) as u64, (i / (ny / rows)) as u64);
            let place = ((at[2] + z) * self.dims[1] + at[1] + y) * self.dims[0] + at[0];
            run(place * self.size, i * length..(i + 1) * length)?;
        }
        Ok(())
    }

    fn write(&self, at: [u64; 3], numbers: &NumberBox) -> io::Result<()> {
        let mut file = &self.file;
        self.pieces(at, numbers.dims, |place, part| {
            file.seek(SeekFrom::Start(place))?;
            file.write_all(&numbers.bytes[part])
        })
    }

    /// Reads a box of numbers, which must be written.
    pub(super) fn read(&self, at: [u64; 3], dims: [usize; 3]) -> io::Result<NumberBox> {
        let mut bytes = vec![0; dims.iter().product::<usize>() * self.size as usize];
        self.pieces(at, dims, |place, part| read_exact_at(&self.file, &mut bytes[part], place))?;
        Ok(NumberBox { bytes, dims })
    }
}

/// The boxes of `side` voxels of a grid, x fastest: where each begins, and its voxels.
pub(super) fn boxes(dims: [u64; 3], side: u64) -> impl Iterator<Item = ([u64; 3], [usize; 3])> {
    let [nx, ny, nz] = dims.map(|n| n.div_ceil(side));
    (0..nx * ny * nz).map(move |i| {
        let at = [i % nx * side, i / nx % ny * side, i / nx / ny * side];
        (at, [0, 1, 2].map(|k| side.min(dims[k] - at[k]) as usize))
    })
}

/// A level is kept if it has at most one voxel for so many of the finest level: from 1/64 on where all axes are halved.
const LEAST_SHARE: u64 = 32;
/// A level that takes at most so many bytes is kept in any case: that of every second voxel of up to 2 GB.
const LITTLE_ROOM: u64 = 256_000_000;
/// Most voxels of the finest level along an axis that become one of the first kept level.
const MOST_AT_ONCE: u32 = 64;
/// Voxels along a side of the chunks in which levels are kept.
pub(super) const CHUNK_SIDE: u64 = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_levels_are_kept_from_a_quarter_on_and_small_ones_all() {
        let kept = |side: u64, step: u64| is_kept((side / step).pow(3), side.pow(3), Dtype::Uint16);
        assert!(kept(1000, 2) && kept(1000, 4));
        assert!(!kept(2000, 2) && kept(2000, 4) && kept(100_000, 4));
    }
}
