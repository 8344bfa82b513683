//! The coarser levels, each made from the chunks of the one above.

use rayon::prelude::*;

use super::average::{NumberBox, Rule};
use super::{Conversion, check_cancelled};
use crate::error::FormatError;
use crate::zarr::ArrayWriter;

impl Conversion<'_> {
    /// Writes what is not yet written of the coarser levels. There is a rule for each time and channel.
    pub(super) fn write_coarser(&mut self, rules: &[Rule]) -> Result<(), FormatError> {
        let mut first = self.num_finest_steps();
        for level in 1..self.levels.len() {
            let num = self.num_coarser_steps(level);
            while self.journal.num_done < first + num {
                let step = self.journal.num_done - first;
                self.write_layer(level, step, rules)?;
                self.done_with_step()?;
            }
            first += num;
        }
        Ok(())
    }

    /// How many layers of chunks across z a level has, of all times and channels.
    pub(super) fn num_coarser_steps(&self, level: usize) -> u64 {
        let [_, _, layers] = self.arrays[level].num_chunks();
        layers * self.num_channels() * self.layout.num_times()
    }

    fn write_layer(&self, level: usize, step: u64, rules: &[Rule]) -> Result<(), FormatError> {
        let (above, array) = (&self.arrays[level - 1], &self.arrays[level]);
        let [nx, ny, nz] = array.num_chunks();
        let (volume, z) = (step / nz, step % nz);
        let of = [volume / self.num_channels(), volume % self.num_channels()];
        let rule = &rules[volume as usize];
        let factors = self.levels[level].factors;
        let (cancel, path, dtype) = (self.options.cancel, &self.path, self.plan.dtype);
        let write = |i: u64| {
            check_cancelled(cancel, path)?;
            let at = [i % nx, i / nx, z];
            let dims = array.found_in(at);
            let from: [u64; 3] = std::array::from_fn(|k| at[k] * array.chunk()[k] * factors[k]);
            let most = std::array::from_fn(|k| dims[k] * factors[k]);
            let whole = read_box(above, of, from, most, dtype.num_bytes())?;
            let made = whole.reduced(dtype, factors.map(|f| f as usize), rule);
            array.write(of, at, &made.bytes, dims)
        };
        self.threads.install(|| (0..nx * ny).into_par_iter().try_for_each(write))
    }
}

/// The numbers in a box of an array, as far as the array goes.
fn read_box(
    array: &ArrayWriter,
    of: [u64; 2],
    from: [u64; 3],
    most: [u64; 3],
    size: usize,
) -> Result<NumberBox, FormatError> {
    let (side, whole) = (array.chunk(), array.dims());
    let dims: [u64; 3] = std::array::from_fn(|k| most[k].min(whole[k] - from[k]));
    let [nx, ny, nz] = dims.map(|n| n as usize);
    let mut bytes = vec![0; nx * ny * nz * size];
    let chunks = |k: usize| from[k] / side[k]..(from[k] + dims[k]).div_ceil(side[k]);
    for cz in chunks(2) {
        for cy in chunks(1) {
            for cx in chunks(0) {
                let at = [cx, cy, cz];
                let numbers = array.read(of, at)?;
                // The part of the box that the chunk has, in voxels of the array.
                let start: [u64; 3] = std::array::from_fn(|k| (at[k] * side[k]).max(from[k]));
                let end: [u64; 3] = std::array::from_fn(|k| ((at[k] + 1) * side[k]).min(from[k] + dims[k]));
                let run = (end[0] - start[0]) as usize * size;
                for z in start[2]..end[2] {
                    for y in start[1]..end[1] {
                        let in_chunk = ((z - cz * side[2]) * side[1] + y - cy * side[1]) * side[0] + start[0]
                            - cx * side[0];
                        let in_box = ((z - from[2]) * dims[1] + y - from[1]) * dims[0] + start[0] - from[0];
                        let (a, b) = (in_chunk as usize * size, in_box as usize * size);
                        bytes[b..b + run].copy_from_slice(&numbers[a..a + run]);
                    }
                }
            }
        }
    }
    Ok(NumberBox { bytes, dims: [nx, ny, nz] })
}
