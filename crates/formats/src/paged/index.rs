//! What is known of the numbers of a volume that is read by pages.

use std::sync::Arc;

use isinglass_core::volume::{
    Histogram, PAGE_POINTS, PageId, PageRanges, PageVoxels, Pyramid, PyramidLevel, VoxelKind, Voxels,
};

use crate::levels::KnownNumbers;

/// The least and the greatest stored number of each page of the finest level, and those of all voxels with their
/// histogram, for each channel. Gaps count for nothing.
#[derive(Clone, Debug, PartialEq)]
pub struct PageIndex {
    pub(super) pages: [u32; 3],
    pub(super) channels: Vec<ChannelIndex>,
}

/// The index of a channel.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ChannelIndex {
    /// By page, x fastest; the first is above the second where there are only gaps.
    pub(super) ranges: Vec<(f32, f32)>,
    pub(super) known: KnownNumbers,
}

impl PageIndex {
    /// Pages along x, y, z.
    pub fn pages(&self) -> [u32; 3] {
        self.pages
    }

    /// Number of channels.
    pub fn num_channels(&self) -> usize {
        self.channels.len()
    }

    /// Least and greatest stored number of a page, over all of its points; `None` if it has only gaps.
    ///
    /// # Panics
    /// If there is no such channel or page.
    pub fn range(&self, channel: usize, at: [u32; 3]) -> Option<(f32, f32)> {
        let (lo, hi) = self.channels[channel].ranges[place(self.pages, at)];
        (lo <= hi).then_some((lo, hi))
    }

    /// Least and greatest stored number of a channel.
    pub fn stored_range(&self, channel: usize) -> (f32, f32) {
        self.channels[channel].known.stored_range
    }

    /// The histogram of a channel.
    pub fn histogram(&self, channel: usize) -> &Arc<Histogram> {
        &self.channels[channel].known.histogram
    }

    pub(crate) fn known(&self) -> Vec<KnownNumbers> {
        self.channels.iter().map(|channel| channel.known.clone()).collect()
    }
}

impl PageRanges for PageIndex {
    fn range(&self, channel: usize, at: [u32; 3]) -> Option<(f32, f32)> {
        let is_known = channel < self.channels.len() && (0..3).all(|i| at[i] < self.pages[i]);
        if is_known { self.range(channel, at) } else { None }
    }
}

/// Makes a [`PageIndex`] of pages as they are read, in any order.
#[derive(Clone, Debug)]
pub struct PageIndexBuilder {
    level: PyramidLevel,
    pages: [u32; 3],
    value_maps: Vec<(f32, f32)>,
    channels: Vec<ChannelCounts>,
    num_missing: u64,
}

#[derive(Clone, Debug)]
struct ChannelCounts {
    /// Not a number where no page has come.
    ranges: Vec<(f32, f32)>,
    /// Voxels of each number, or of each bin of floats, in tables that are made when they are needed.
    tables: Vec<Vec<u64>>,
}

impl PageIndexBuilder {
    /// For the finest level of a pyramid; `None` if it has more pages than an index holds.
    pub fn new(pyramid: &Pyramid) -> Option<Self> {
        let (pages, num_channels) = (pyramid.pages(0), pyramid.value_maps.len());
        let num_pages: u64 = pages.iter().map(|&n| u64::from(n)).product();
        let num_missing = num_pages.checked_mul(num_channels as u64).filter(|n| *n <= MAX_PAGES)?;
        let counts = || ChannelCounts {
            ranges: vec![(f32::NAN, f32::NAN); num_pages as usize],
            tables: vec![Vec::new(); num_tables(pyramid.kind)],
        };
        Some(Self {
            level: *pyramid.levels.first()?,
            pages,
            value_maps: pyramid.value_maps.clone(),
            channels: (0..num_channels).map(|_| counts()).collect(),
            num_missing,
        })
    }

    /// Memory that the builder for a pyramid takes at most, bytes.
    pub(crate) fn most_bytes(pyramid: &Pyramid) -> u64 {
        let num_pages = pyramid.pages(0).iter().fold(1u64, |all, &n| all.saturating_mul(n.into()));
        let tables = (num_tables(pyramid.kind) * BINS_OF_TABLE * size_of::<u64>()) as u64;
        let of_channel = num_pages.saturating_mul(size_of::<(f32, f32)>() as u64).saturating_add(tables);
        of_channel.saturating_mul(pyramid.value_maps.len() as u64)
    }

    /// Adds a page of the finest level. Other pages, and one that was there before, change nothing.
    pub fn add(&mut self, channel: usize, page: PageId, voxels: &PageVoxels) {
        let is_inside = page.level == 0 && (0..3).all(|k| page.at[k] < self.pages[k]);
        let Some(found) = self.channels.get_mut(channel).filter(|_| is_inside) else { return };
        let index = place(self.pages, page.at);
        if !found.ranges[index].0.is_nan() {
            return;
        }
        let gaps = voxels.gaps.as_deref();
        let mut range = (f32::INFINITY, f32::NEG_INFINITY);
        for i in (0..voxels.voxels.len()).filter(|&i| gaps.is_none_or(|gaps| gaps[i] == 0)) {
            let x = voxels.voxels.get(i);
            range = (range.0.min(x), range.1.max(x));
        }
        found.ranges[index] = range;
        self.num_missing -= 1;
        // Each voxel counts once: those before the next page's first one, and all of the last page.
        let first = self.level.first_point(page.at);
        let next = self.level.first_point(page.at.map(|n| n + 1));
        let [nx, ny, nz] = std::array::from_fn(|k| {
            let end = if page.at[k] + 1 < self.pages[k] { next[k] } else { self.level.dims[k] };
            (end - first[k]).min(PAGE_POINTS)
        });
        for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
            let row = ((z * PAGE_POINTS + y) * PAGE_POINTS) as usize;
            for i in (row..row + nx as usize).filter(|&i| gaps.is_none_or(|gaps| gaps[i] == 0)) {
                let bin = match &voxels.voxels {
                    Voxels::U8(v) => usize::from(v[i]),
                    Voxels::U16(v) => usize::from(v[i]),
                    Voxels::F32(v) => float_bin(v[i]),
                };
                found.count(bin);
            }
        }
    }

    /// Widens the range of a page by numbers that it has.
    pub(super) fn widen(&mut self, channel: usize, at: [u32; 3], (lo, hi): (f32, f32)) {
        let range = &mut self.channels[channel].ranges[place(self.pages, at)];
        // What is not a number gives way.
        *range = (range.0.min(lo), range.1.max(hi));
    }

    /// Counts numbers of a channel: how many are in each bin, from the first on.
    pub(super) fn add_bins(&mut self, channel: usize, bins: &[u64]) {
        for (table, more) in self.channels[channel].tables.iter_mut().zip(bins.chunks(BINS_OF_TABLE)) {
            if more.iter().any(|n| *n > 0) {
                table.resize(BINS_OF_TABLE, 0);
                table.iter_mut().zip(more).for_each(|(n, more)| *n += more);
            }
        }
    }

    /// The index, when all numbers were added by [`Self::widen`] and [`Self::add_bins`]; `None` if a channel has only
    /// gaps.
    pub(super) fn finish_all(mut self) -> Option<PageIndex> {
        let ranges = self.channels.iter_mut().flat_map(|channel| &mut channel.ranges);
        ranges.filter(|range| range.0.is_nan()).for_each(|range| *range = (f32::INFINITY, f32::NEG_INFINITY));
        self.num_missing = 0;
        self.finish()
    }

    /// Pages of all channels that have not come.
    pub fn num_missing(&self) -> u64 {
        self.num_missing
    }

    /// Least and greatest stored number of a page that has come; `None` if it has not, or has only gaps.
    pub fn range(&self, channel: usize, at: [u32; 3]) -> Option<(f32, f32)> {
        let (lo, hi) = *self.channels.get(channel)?.ranges.get(place(self.pages, at))?;
        (lo <= hi).then_some((lo, hi))
    }

    /// The index; `None` if pages are missing, or a channel has only gaps.
    pub fn finish(self) -> Option<PageIndex> {
        if self.num_missing > 0 {
            return None;
        }
        let channels = self.channels.into_iter().zip(self.value_maps);
        let channels = channels.map(|(channel, map)| channel.finish(map)).collect::<Option<_>>()?;
        Some(PageIndex { pages: self.pages, channels })
    }
}

impl ChannelCounts {
    fn count(&mut self, bin: usize) {
        if let Some(table) = self.tables.get_mut(bin / BINS_OF_TABLE) {
            if table.is_empty() {
                table.resize(BINS_OF_TABLE, 0);
            }
            table[bin % BINS_OF_TABLE] += 1;
        }
    }

    fn finish(self, value_map: (f32, f32)) -> Option<ChannelIndex> {
        let both = |a: (f32, f32), b: &(f32, f32)| (a.0.min(b.0), a.1.max(b.1));
        let range = self.ranges.iter().fold((f32::INFINITY, f32::NEG_INFINITY), both);
        if range.0 > range.1 {
            return None;
        }
        let is_float = self.tables.len() * BINS_OF_TABLE == 1 << FLOAT_BITS;
        let tables = self.tables.iter().enumerate();
        let counted = tables
            .flat_map(|(i, table)| table.iter().enumerate().map(move |(k, n)| (i * BINS_OF_TABLE + k, n)))
            .filter(|(_, n)| **n > 0);
        let bin = |(i, &n): (usize, &u64)| match is_float {
            true => (float_of_bin(i).max(range.0), float_of_bin(i + 1).min(range.1), n),
            false => (i as f32, i as f32, n),
        };
        let histogram = Histogram::of_counts(&counted.map(bin).collect::<Vec<_>>(), range, value_map);
        let known = KnownNumbers { stored_range: range, histogram: Arc::new(histogram) };
        Some(ChannelIndex { ranges: self.ranges, known })
    }
}

/// Bins for the numbers of a channel.
pub(super) fn num_bins(kind: VoxelKind) -> usize {
    match kind {
        VoxelKind::U8 => 1 << 8,
        VoxelKind::U16 => 1 << 16,
        VoxelKind::F32 => 1 << FLOAT_BITS,
    }
}

/// Tables of these bins.
fn num_tables(kind: VoxelKind) -> usize {
    num_bins(kind).div_ceil(BINS_OF_TABLE)
}

/// The index of a page, x fastest.
fn place(pages: [u32; 3], at: [u32; 3]) -> usize {
    let [nx, ny, _] = pages.map(|n| n as usize);
    let [x, y, z] = at.map(|n| n as usize);
    (z * ny + y) * nx + x
}

/// Bins of floats ascend with them and are 1/2048 of their magnitude wide.
pub(super) fn float_bin(x: f32) -> usize {
    let bits = x.to_bits();
    let key = if bits >> 31 == 1 { !bits } else { bits | 1 << 31 };
    (key >> (32 - FLOAT_BITS)) as usize
}

/// The least float of a bin.
fn float_of_bin(bin: usize) -> f32 {
    let key = (bin as u64) << (32 - FLOAT_BITS);
    let key = u32::try_from(key).unwrap_or(u32::MAX);
    let x = f32::from_bits(if key >> 31 == 1 { key & !(1 << 31) } else { !key });
    if x.is_nan() { f32::MAX.copysign(x) } else { x }
}

/// Most pages of an index: a volume of 4 T voxels.
const MAX_PAGES: u64 = 1 << 24;
/// Bins of a table.
const BINS_OF_TABLE: usize = 1 << 11;
/// The highest bits of a float by which it is counted.
const FLOAT_BITS: u32 = 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_of_floats_ascend_and_hold_their_numbers() {
        let numbers = [-1e37f32, -3.5, -1.0, -1e-30, -0.0, 0.0, 1e-40, 1.0, 1.000_1, 2.0, 1e10, 1e37];
        let bins = numbers.map(float_bin);
        assert!(bins.is_sorted());
        for (x, bin) in numbers.iter().zip(bins) {
            let (lo, hi) = (float_of_bin(bin), float_of_bin(bin + 1));
            assert!(lo <= *x && *x <= hi && (hi - lo) <= x.abs() / 1000.0 + 1e-38, "{x}: {lo} to {hi}");
        }
        // The control: numbers further apart than a bin have others.
        assert_ne!(float_bin(1.0), float_bin(1.001));
    }
}
