//! Voxels with nothing in them: outside of a scanner's circle, of a mask or of a mesh.
//!
//! Samples are interpolated between eight voxels. So a gap beside matter gets the mean of the matter around it, and no
//! value of its own makes a false surface. A march drops a step if the voxel around one of its ends is a gap.

use rayon::prelude::*;

use super::grid::Voxels;

/// Which voxels are gaps.
#[derive(Debug, PartialEq, Eq)]
pub struct VoxelGaps {
    /// 0 for a voxel with a value, one byte each, x fastest.
    pub bytes: Vec<u8>,
    /// Voxels without a value.
    pub num_gaps: u64,
}

/// A number that can be averaged.
pub(super) trait Number: Copy + Send + Sync + Into<f32> {
    fn from_mean(mean: f32) -> Self;
}

impl Number for u8 {
    fn from_mean(mean: f32) -> Self {
        mean.round() as Self
    }
}

impl Number for u16 {
    fn from_mean(mean: f32) -> Self {
        mean.round() as Self
    }
}

impl Number for f32 {
    fn from_mean(mean: f32) -> Self {
        mean
    }
}

/// Fills the gaps: beside other voxels with the mean of these, elsewhere with the least number. Returns the least and
/// the greatest number of the others, of which there must be one.
pub(super) fn fill<T: Number>(voxels: &mut [T], gaps: &[u8], dims: [u32; 3]) -> (f32, f32) {
    let both = |a: (f32, f32), b: (f32, f32)| (a.0.min(b.0), a.1.max(b.1));
    let none = (f32::INFINITY, f32::NEG_INFINITY);
    let known = voxels.par_iter().zip(gaps).filter(|(_, gap)| **gap == 0);
    let range = known.map(|(v, _)| ((*v).into(), (*v).into())).reduce(|| none, both);
    fill_with(voxels, gaps, dims, range.0);
    range
}

/// Fills the gaps: beside other voxels with the mean of these, elsewhere with a number.
fn fill_with<T: Number>(voxels: &mut [T], gaps: &[u8], dims: [u32; 3], elsewhere: f32) {
    let [nx, ny, nz] = dims.map(|d| d as usize);
    let around = |i: usize, n: usize| i.saturating_sub(1)..=(i + 1).min(n - 1);
    let mean = |old: &[T], i: usize| {
        let (x, y, z) = (i % nx, i / nx % ny, i / nx / ny);
        let (mut sum, mut count) = (0.0, 0.0);
        for (z, y) in around(z, nz).flat_map(|z| around(y, ny).map(move |y| (z, y))) {
            for at in around(x, nx).map(|x| (z * ny + y) * nx + x).filter(|at| gaps[*at] == 0) {
                sum += old[at].into();
                count += 1.0;
            }
        }
        T::from_mean(if count > 0.0 { sum / count } else { elsewhere })
    };
    // Only voxels that stay are read, so one slice after the other can be replaced.
    for first in (0..voxels.len()).step_by(nx * ny) {
        let each = (first..first + nx * ny).into_par_iter();
        let old = &*voxels;
        let slice: Vec<T> = each.map(|i| if gaps[i] == 0 { old[i] } else { mean(old, i) }).collect();
        voxels[first..][..nx * ny].copy_from_slice(&slice);
    }
}

impl Voxels {
    /// Fills the gaps of a part of a volume, which has one byte for each of its `dims` voxels, not 0 for a gap. Beside
    /// other voxels they get the mean of these, as in a whole volume, and the number `elsewhere` where there are none.
    ///
    /// # Panics
    /// If there are not as many voxels and bytes as `dims` say.
    pub fn fill_gaps(&mut self, gaps: &[u8], dims: [u32; 3], elsewhere: f32) {
        let expected = dims.iter().map(|&d| d as usize).product::<usize>();
        assert!(self.len() == expected && gaps.len() == expected, "{dims:?} voxels");
        match self {
            Self::U8(v) => fill_with(v, gaps, dims, elsewhere),
            Self::U16(v) => fill_with(v, gaps, dims, elsewhere),
            Self::F32(v) => fill_with(v, gaps, dims, elsewhere),
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::super::{Histogram, Volume, Voxels};

    #[test]
    fn gaps_are_not_counted_and_take_the_values_beside_them() {
        let volume =
            |voxels| Volume::new([5, 1, 1], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap();
        let words = volume(Voxels::U16(vec![9000, 9000, 20, 30, 9000]));
        let with_gaps = words.clone().with_gaps(vec![1, 1, 0, 0, 1]);
        assert_eq!(with_gaps.voxels(), &Voxels::U16(vec![20, 20, 20, 30, 30]));
        assert_eq!((with_gaps.value_range(), with_gaps.gaps().unwrap().num_gaps), ((20.0, 30.0), 3));
        assert_eq!(Histogram::of(&with_gaps).counts.iter().sum::<u64>(), 2);
        // The controls: without any, with nothing else, and of another length.
        assert_eq!(Histogram::of(&words).counts.iter().sum::<u64>(), 5);
        for bytes in [vec![0; 5], vec![1; 5], vec![1; 4]] {
            assert!(words.clone().with_gaps(bytes).gaps().is_none());
        }
    }
}
