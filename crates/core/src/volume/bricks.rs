//! Min/max of the stored numbers over bricks of the grid, and which bricks a transfer function leaves visible.

use rayon::prelude::*;

use super::grid::{Volume, Voxels};
use crate::transfer::TransferTable;

/// Voxels along the side of a brick.
pub const BRICK: u32 = 8;

/// Least and greatest stored number of each brick.
///
/// Brick `b` covers `[8b, 8b + 8)` of voxel space. Its range counts every voxel that a trilinear sample in there, or
/// up to half a voxel outside, can read: `8b − 1 ..= 8b + 8`. So a sample that rounding puts just outside is still
/// bounded, and the ranges of bricks that touch always intersect.
#[derive(Clone, Debug)]
pub struct Bricks {
    dims: [u32; 3],
    ranges: Vec<(f32, f32)>,
}

impl Bricks {
    /// Reads the whole volume once, in parallel.
    pub fn of(volume: &Volume) -> Self {
        let dims = volume.dims().map(|d| d.div_ceil(BRICK));
        let [bx, by, bz] = dims;
        let ranges = (0..bx * by * bz)
            .into_par_iter()
            .map(|i| brick_range(volume, [i % bx, i / bx % by, i / bx / by]))
            .collect();
        Self { dims, ranges }
    }

    /// Bricks along x, y, z.
    pub fn dims(&self) -> [u32; 3] {
        self.dims
    }

    /// The bricks that `table` leaves visible.
    pub fn occupancy(&self, table: &TransferTable) -> Occupancy {
        let mut words = vec![0u32; self.ranges.len().div_ceil(32)];
        for (i, &(lo, hi)) in self.ranges.iter().enumerate() {
            if table.is_visible(lo, hi) {
                words[i / 32] |= 1 << (i % 32);
            }
        }
        Occupancy { dims: self.dims, words }
    }
}

/// One bit a brick, set where something is visible; x fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct Occupancy {
    /// Bricks along x, y, z.
    pub dims: [u32; 3],
    /// The bits, 32 a word, lowest first.
    pub words: Vec<u32>,
}

impl Occupancy {
    /// Every brick visible: the negative control of empty-space skipping.
    pub fn full(dims: [u32; 3]) -> Self {
        let n = dims.iter().map(|&d| d as usize).product::<usize>();
        Self { dims, words: vec![u32::MAX; n.div_ceil(32)] }
    }

    /// The bit of brick (x, y, z), which must be inside.
    pub fn get(&self, x: u32, y: u32, z: u32) -> bool {
        let i = (z * self.dims[1] + y) * self.dims[0] + x;
        self.words[i as usize / 32] >> (i % 32) & 1 != 0
    }

    /// Share of the bricks that are visible.
    pub fn fraction(&self) -> f32 {
        let n = self.dims.iter().map(|&d| u64::from(d)).product::<u64>();
        let set = (0..n).filter(|&i| self.words[i as usize / 32] >> (i % 32) & 1 != 0).count();
        set as f32 / n as f32
    }
}

fn brick_range(volume: &Volume, b: [u32; 3]) -> (f32, f32) {
    let dims = volume.dims();
    let span = |axis: usize| {
        let start = (b[axis] * BRICK).saturating_sub(1) as usize;
        start..((b[axis] + 1) * BRICK + 1).min(dims[axis]) as usize
    };
    let (nx, ny) = (dims[0] as usize, dims[1] as usize);
    let (mut lo, mut hi) = (f32::INFINITY, f32::NEG_INFINITY);
    for z in span(2) {
        for y in span(1) {
            let row = (z * ny + y) * nx;
            let xs = span(0);
            let (a, b) = match volume.voxels() {
                Voxels::U8(v) => range_of(&v[row + xs.start..row + xs.end]),
                Voxels::U16(v) => range_of(&v[row + xs.start..row + xs.end]),
                Voxels::F32(v) => {
                    let xs = &v[row + xs.start..row + xs.end];
                    xs.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &x| (a.min(x), b.max(x)))
                }
            };
            lo = lo.min(a);
            hi = hi.max(b);
        }
    }
    (lo, hi)
}

fn range_of<T: Copy + Ord + Into<f32>>(row: &[T]) -> (f32, f32) {
    let first = row[0];
    let (lo, hi) = row.iter().fold((first, first), |(a, b), &x| (a.min(x), b.max(x)));
    (lo.into(), hi.into())
}
