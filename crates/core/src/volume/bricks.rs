//! Min/max of the stored numbers over bricks of the grid, and which bricks a transfer function leaves visible.

use std::sync::Arc;

use rayon::prelude::*;

use super::grid::{Volume, Voxels};
use crate::transfer::TransferTable;

/// Voxels along the side of a brick.
pub const BRICK: u32 = 8;

/// Least and greatest stored number of each brick.
///
/// Brick `b` covers `[8b, 8b + 8)` of voxel space. Its range counts every voxel that a trilinear sample within it, or
/// up to half a voxel outside, can read: `8b − 1 ..= 8b + 8`. So a sample that rounding puts just outside is still
/// bounded, and the ranges of touching bricks always intersect.
#[derive(Clone, Debug)]
pub struct Bricks {
    dims: [u32; 3],
    ranges: Vec<(f32, f32)>,
}

impl Bricks {
    /// Reads the whole volume once, in parallel.
    pub fn of(volume: &Volume) -> Self {
        let first = Self::first(volume);
        let dims =
            [0, 1, 2].map(|axis| (volume.first()[axis] + volume.dims()[axis]).div_ceil(BRICK) - first[axis]);
        let [bx, by, bz] = dims;
        let ranges = (0..bx as usize * by as usize * bz as usize)
            .into_par_iter()
            .map(|i| {
                let (x, rest) = (i % bx as usize, i / bx as usize);
                let at = [x, rest % by as usize, rest / by as usize];
                brick_range(volume, [0, 1, 2].map(|axis| first[axis] + at[axis] as u32))
            })
            .collect();
        Self { dims, ranges }
    }

    /// The first brick along x, y, z. Bricks of a part are those of the whole that have any of its voxels.
    pub fn first(volume: &Volume) -> [u32; 3] {
        volume.first().map(|voxel| voxel / BRICK)
    }

    /// Bricks along x, y, z.
    pub fn dims(&self) -> [u32; 3] {
        self.dims
    }

    /// The bricks that `table` leaves visible.
    pub fn occupancy(&self, table: &TransferTable) -> Occupancy {
        self.occupancy_by(|lo, hi| table.is_visible(lo, hi), |_, _| None)
    }

    /// The bricks that one of several channels with the same grid leaves visible.
    pub fn occupancy_of_channels(channels: &[(&Self, &TransferTable)]) -> Occupancy {
        let dims = channels.first().map_or([0; 3], |(first, _)| first.dims);
        let num = dims.iter().map(|&n| n as usize).product::<usize>();
        let is_visible = |(bricks, table): &(&Self, &TransferTable), i: usize| {
            let (lo, hi) = bricks.ranges[i];
            table.is_visible(lo, hi)
        };
        Occupancy::of(dims, (0..num).map(|i| channels.iter().any(|channel| is_visible(channel, i))))
    }

    /// The bricks for which `is_visible` holds, given their least and greatest stored number. Where a rendering looks
    /// for the greatest of something in 0 to 1, `peak` bounds it for each brick.
    pub fn occupancy_by(
        &self,
        is_visible: impl Fn(f32, f32) -> bool,
        peak: impl Fn(f32, f32) -> Option<f32>,
    ) -> Occupancy {
        let visible = self.ranges.iter().map(|&(lo, hi)| is_visible(lo, hi));
        let peaks = self.ranges.iter().map_while(|&(lo, hi)| peak(lo, hi)).map(peak_code);
        Occupancy { peaks: in_words(peaks).into(), ..Occupancy::of(self.dims, visible) }
    }
}

/// The distance in bricks to the nearest visible brick, for each brick; x fastest.
///
/// Distances are those of a chess king, across corners too. All bricks less than a distance d away are invisible: a
/// cube of 2d − 1 bricks that can be skipped at once.
#[derive(Clone, Debug, PartialEq)]
pub struct Occupancy {
    /// Bricks along x, y, z.
    pub dims: [u32; 3],
    /// The distances, 0 for a visible brick and at most `DISTANCE_MAX`, four per word, lowest byte first. Clones share
    /// them.
    pub words: Arc<[u32]>,
    /// Upper bounds of the keys in each brick, in units of 1/[`PEAK_MAX`], four per word, lowest byte first. Empty
    /// unless a mode looks for the greatest key. A march with a greater key skips the brick.
    pub peaks: Arc<[u32]>,
}

impl Occupancy {
    /// The distances to the bricks for which `visible` yields true; x fastest.
    fn of(dims: [u32; 3], visible: impl Iterator<Item = bool>) -> Self {
        let mut distances: Vec<u8> = visible.map(|v| if v { 0 } else { DISTANCE_MAX }).collect();
        let [nx, ny, nz] = dims.map(|d| d as usize);
        // Two passes over the grid suffice for a king's moves, each from the neighbours that have been visited.
        for is_back in [false, true] {
            let turn = |i: usize, n: usize| if is_back { n - 1 - i } else { i };
            for (z, y, x) in (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| (z, y, x))))
            {
                let at = |x, y, z| (turn(z, nz) * ny + turn(y, ny)) * nx + turn(x, nx);
                let here = at(x, y, z);
                let mut least = distances[here];
                if least == 0 {
                    continue;
                }
                let mut visit = |dx: Option<usize>, dy: Option<usize>, dz: Option<usize>| {
                    if let (Some(x), Some(y), Some(z)) = (dx, dy, dz)
                        && x < nx
                        && y < ny
                    {
                        least = least.min(distances[at(x, y, z)].saturating_add(1));
                    }
                };
                let around = |i: usize| [i.checked_sub(1), Some(i), Some(i + 1)];
                for x in around(x) {
                    for y in around(y) {
                        visit(x, y, z.checked_sub(1));
                    }
                    visit(x, y.checked_sub(1), Some(z));
                }
                visit(x.checked_sub(1), Some(y), Some(z));
                distances[here] = least;
            }
        }
        Self { dims, words: in_words(distances.into_iter()).into(), peaks: Arc::default() }
    }

    /// All bricks visible: the negative control of empty-space skipping.
    pub fn full(dims: [u32; 3]) -> Self {
        let n = dims.iter().map(|&d| d as usize).product::<usize>();
        Self { dims, words: vec![0; n.div_ceil(4)].into(), peaks: Arc::default() }
    }

    /// Distance from brick (x, y, z), which must exist, to the nearest visible one: 0 if it is visible itself, at
    /// most `DISTANCE_MAX`.
    #[inline]
    pub fn distance(&self, x: u32, y: u32, z: u32) -> u32 {
        let i = (z * self.dims[1] + y) * self.dims[0] + x;
        self.words[i as usize / 4] >> (8 * (i % 4)) & 0xff
    }

    /// Whether no key of brick (x, y, z) exceeds `key`, if peaks are known.
    #[inline]
    pub fn is_beaten(&self, x: u32, y: u32, z: u32, key: f32) -> bool {
        let i = (z * self.dims[1] + y) * self.dims[0] + x;
        let code = self.peaks.get(i as usize / 4).map(|word| word >> (8 * (i % 4)) & 0xff);
        code.is_some_and(|code| code as f32 * (1.0 / PEAK_MAX) <= key)
    }

    /// Fraction of bricks that are visible.
    pub fn fraction(&self) -> f32 {
        let [nx, ny, nz] = self.dims;
        let bricks = (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])));
        let set = bricks.filter(|&[x, y, z]| self.distance(x, y, z) == 0).count();
        set as f32 / (nx as f32 * ny as f32 * nz as f32)
    }
}

/// Code of an upper bound of a key, rounded up; the last code bounds all keys.
fn peak_code(key: f32) -> u8 {
    let key = if key < 1.0 { key.max(0.0) } else { 1.0 };
    (key * PEAK_MAX + 1.0) as u8
}

/// Packs bytes, four per word, lowest byte first.
fn in_words(bytes: impl Iterator<Item = u8>) -> Vec<u32> {
    let bytes: Vec<u8> = bytes.collect();
    let word = |four: &[u8]| four.iter().rev().fold(0, |word, &byte| word << 8 | u32::from(byte));
    bytes.chunks(4).map(word).collect()
}

fn brick_range(volume: &Volume, b: [u32; 3]) -> (f32, f32) {
    let (dims, first) = (volume.dims(), volume.first());
    let span = |axis: usize| {
        let start = (b[axis] * BRICK).saturating_sub(1).max(first[axis]);
        let end = ((b[axis] + 1) * BRICK + 1).min(first[axis] + dims[axis]);
        (start - first[axis]) as usize..(end - first[axis]) as usize
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

/// Code of the greatest key.
pub const PEAK_MAX: f32 = 255.0;
/// Greatest stored distance.
const DISTANCE_MAX: u8 = 32;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_of_a_search() {
        let dims = [9u32, 5, 40];
        let bricks: Vec<[u32; 3]> = (0..dims[2])
            .flat_map(|z| (0..dims[1]).flat_map(move |y| (0..dims[0]).map(move |x| [x, y, z])))
            .collect();
        let is_visible = |b: [u32; 3]| [[7, 1, 2], [0, 4, 2], [3, 3, 36]].contains(&b);
        let occupancy = Occupancy::of(dims, bricks.iter().map(|&b| is_visible(b)));
        let away = |a: &[u32; 3], b: &[u32; 3]| (0..3).map(|i| a[i].abs_diff(b[i])).max().unwrap();
        for b in &bricks {
            let nearest = bricks.iter().filter(|&&v| is_visible(v)).map(|v| away(b, v)).min().unwrap();
            assert_eq!(occupancy.distance(b[0], b[1], b[2]), nearest, "{b:?}");
        }
        assert!((occupancy.fraction() - 3.0 / 1800.0).abs() < 1e-6);
        // Nothing visible, and everything.
        let nothing = Occupancy::of([3, 1, 1], [false; 3].into_iter());
        assert_eq!(nothing.distance(1, 0, 0), u32::from(DISTANCE_MAX));
        assert_eq!(Occupancy::of([3, 1, 1], [true; 3].into_iter()), Occupancy::full([3, 1, 1]));
    }
}
