//! Counts the numbers of boxes of the finest level: their ranges by page, and how often each occurs.

use std::ops::Range;

use isinglass_core::volume::{PAGE_CELLS, PAGE_POINTS, PyramidLevel, VoxelKind, Voxels};

use super::index::{PageIndexBuilder, float_bin, num_bins};

/// Voxels along an axis, and the pages that have all of them.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct AxisPart {
    voxels: Range<u32>,
    pages: Range<u32>,
}

/// The parts of the voxels `span` along an axis of the finest level, which has so many pages. Pages begin and end
/// between them.
pub(super) fn axis_parts(
    level: &PyramidLevel,
    num_pages: u32,
    axis: usize,
    span: Range<u32>,
) -> Vec<AxisPart> {
    let first = |page: u32| level.first_point([page; 3])[axis];
    let near = (span.start / PAGE_CELLS).saturating_sub(1)..(span.end / PAGE_CELLS + 2).min(num_pages);
    let mut cuts = vec![span.start, span.end];
    for page in near.clone() {
        cuts.extend([first(page), first(page) + PAGE_POINTS].into_iter().filter(|cut| span.contains(cut)));
    }
    cuts.sort_unstable();
    cuts.dedup();
    let part = |ends: &[u32]| {
        let has = |page: &u32| first(*page) <= ends[0] && ends[0] < first(*page) + PAGE_POINTS;
        let mut pages = near.clone().filter(has);
        let from = pages.next().unwrap_or(near.end);
        AxisPart { voxels: ends[0]..ends[1], pages: from..pages.next_back().unwrap_or(from) + 1 }
    };
    cuts.windows(2).map(part).collect()
}

/// A box of the finest level by the parts of its axes.
#[derive(Clone, Debug)]
pub(super) struct BoxParts(pub(super) [Vec<AxisPart>; 3]);

impl BoxParts {
    /// The least and the greatest number of each part, x fastest; the first is above the second where there are only
    /// gaps. Each number is counted in its bin.
    pub(super) fn count(
        &self,
        voxels: &Voxels,
        gaps: Option<&[u8]>,
        bins: &mut NumberBins,
    ) -> Vec<(f32, f32)> {
        match voxels {
            Voxels::U8(v) => self.count_in::<u8, 4>(v, gaps, bins),
            Voxels::U16(v) => self.count_in::<u16, 2>(v, gaps, bins),
            Voxels::F32(v) => self.count_in::<f32, 2>(v, gaps, bins),
        }
    }

    fn count_in<T: StoredNumber, const TABLES: usize>(
        &self,
        all: &[T],
        gaps: Option<&[u8]>,
        bins: &mut NumberBins,
    ) -> Vec<(f32, f32)> {
        let [x, y, z] = &self.0;
        let length = |parts: &[AxisPart]| parts.last().map_or(0, |p| p.voxels.end) - parts[0].voxels.start;
        let (nx, x_first) = (length(x) as usize, x[0].voxels.start);
        let mut ranges = vec![(T::GREATEST, T::LEAST); x.len() * y.len() * z.len()];
        let mut row = 0;
        for (k, z) in z.iter().enumerate() {
            for _ in z.voxels.clone() {
                for (j, part) in y.iter().enumerate() {
                    let ranges = &mut ranges[(k * y.len() + j) * x.len()..][..x.len()];
                    for _ in part.voxels.clone() {
                        let numbers = &all[row..row + nx];
                        let gaps =
                            gaps.map(|gaps| &gaps[row..row + nx]).filter(|g| g.iter().any(|g| *g != 0));
                        for (range, x) in ranges.iter_mut().zip(x) {
                            let at = (x.voxels.start - x_first) as usize..(x.voxels.end - x_first) as usize;
                            *range = widened(*range, &numbers[at.clone()], gaps.map(|gaps| &gaps[at]));
                        }
                        match gaps {
                            None => bins.add::<T, TABLES>(numbers),
                            Some(gaps) => {
                                let some = numbers.iter().zip(gaps).filter(|(_, gap)| **gap == 0);
                                some.for_each(|(x, _)| bins.counts[x.bin()] += 1);
                            }
                        }
                        row += nx;
                    }
                }
            }
        }
        let single = |(lo, hi): (T, T)| match lo <= hi {
            true => (lo.single(), hi.single()),
            false => (f32::INFINITY, f32::NEG_INFINITY),
        };
        ranges.into_iter().map(single).collect()
    }

    /// Widens the ranges of pages by those of the parts.
    pub(super) fn widen(&self, builder: &mut PageIndexBuilder, channel: usize, ranges: &[(f32, f32)]) {
        let [x, y, z] = &self.0;
        let places = z.iter().flat_map(|z| y.iter().flat_map(move |y| x.iter().map(move |x| [x, y, z])));
        for ([x, y, z], range) in places.zip(ranges).filter(|(_, range)| range.0 <= range.1) {
            for z in z.pages.clone() {
                for y in y.pages.clone() {
                    x.pages.clone().for_each(|x| builder.widen(channel, [x, y, z], *range));
                }
            }
        }
    }
}

/// How many numbers are in each bin. Neighbours are often alike, so they count in tables of their own.
pub(super) struct NumberBins {
    counts: Vec<u64>,
    num_bins: usize,
}

impl NumberBins {
    pub(super) fn new(kind: VoxelKind) -> Self {
        let num_bins = num_bins(kind);
        Self { counts: vec![0; num_bins * if kind == VoxelKind::U8 { 4 } else { 2 }], num_bins }
    }

    fn add<T: StoredNumber, const TABLES: usize>(&mut self, numbers: &[T]) {
        let (some, rest) = numbers.as_chunks::<TABLES>();
        for few in some {
            for (table, x) in few.iter().enumerate() {
                self.counts[table * self.num_bins + x.bin()] += 1;
            }
        }
        rest.iter().for_each(|x| self.counts[x.bin()] += 1);
    }

    /// The counts of the bins from the first on, in pieces.
    pub(super) fn tables(&self) -> impl Iterator<Item = &[u64]> {
        self.counts.chunks(self.num_bins)
    }
}

/// A number in memory.
trait StoredNumber: Copy + PartialOrd {
    const LEAST: Self;
    const GREATEST: Self;
    fn single(self) -> f32;
    fn bin(self) -> usize;
}

impl StoredNumber for u8 {
    const LEAST: Self = Self::MIN;
    const GREATEST: Self = Self::MAX;

    fn single(self) -> f32 {
        self.into()
    }

    fn bin(self) -> usize {
        self.into()
    }
}

impl StoredNumber for u16 {
    const LEAST: Self = Self::MIN;
    const GREATEST: Self = Self::MAX;

    fn single(self) -> f32 {
        self.into()
    }

    fn bin(self) -> usize {
        self.into()
    }
}

impl StoredNumber for f32 {
    const LEAST: Self = Self::NEG_INFINITY;
    const GREATEST: Self = Self::INFINITY;

    fn single(self) -> f32 {
        self
    }

    fn bin(self) -> usize {
        float_bin(self)
    }
}

/// A range with more numbers in it.
fn widened<T: StoredNumber>(range: (T, T), numbers: &[T], gaps: Option<&[u8]>) -> (T, T) {
    let with = |(lo, hi): (T, T), x: T| (if x < lo { x } else { lo }, if x > hi { x } else { hi });
    match gaps {
        None => numbers.iter().fold(range, |range, x| with(range, *x)),
        Some(gaps) => {
            let some = numbers.iter().zip(gaps).filter(|(_, gap)| **gap == 0);
            some.fold(range, |range, (x, _)| with(range, *x))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_an_axis_know_the_pages_that_have_each_voxel() {
        for n in [1u32, 2, 64, 65, 66, 69, 70, 128, 129, 130, 200, 333] {
            let level = PyramidLevel { dims: [n; 3], factor: [1; 3], first: [0.0; 3] };
            let num_pages = (n - 1).div_ceil(PAGE_CELLS).max(1);
            let spans = [0..n.min(128), n.min(128)..n];
            let parts: Vec<AxisPart> = spans
                .into_iter()
                .filter(|span| !span.is_empty())
                .flat_map(|span| axis_parts(&level, num_pages, 0, span))
                .collect();
            let mut next = 0;
            for AxisPart { voxels, pages } in parts {
                assert_eq!(voxels.start, next, "{n}");
                next = voxels.end;
                for page in 0..num_pages {
                    let first = level.first_point([page; 3])[0];
                    let points = first..first + PAGE_POINTS;
                    let has = voxels.clone().filter(|x| points.contains(x)).count() as u32;
                    let expected = if pages.contains(&page) { voxels.end - voxels.start } else { 0 };
                    assert_eq!(has, expected, "{n}: page {page} of {voxels:?}");
                }
            }
            assert_eq!(next, n);
        }
    }
}
