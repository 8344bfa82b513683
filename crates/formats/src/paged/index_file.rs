//! The bytes of an index, and the file that keeps them. Anybody may have changed it, so nothing in it is trusted: a file
//! that is not whole counts as none.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::UNIX_EPOCH;

use isinglass_core::volume::Histogram;

use super::index::{ChannelIndex, PageIndex};
use super::means::{MeanLevels, MeanPlan};
use super::means_file::{MeansFile, write_means};
use crate::error::FormatError;
use crate::levels::KnownNumbers;
use crate::output::{folder_of, write_private};
use crate::plan::VolumeFile;
use crate::selection::{Region, Selection};
use crate::source::{OpenOptions, read_file};

/// Where the index of a volume is kept, and the volume that it is of.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct IndexPlace {
    path: PathBuf,
    /// The file, its age and the part of it.
    key: String,
}

impl IndexPlace {
    /// The place for a region of the finest level of `file`, the file at `path`; `None` if nothing is kept.
    pub(crate) fn of(
        file: &dyn VolumeFile,
        path: &Path,
        region: Option<Region>,
        options: &OpenOptions,
    ) -> Option<Self> {
        let folder = options.index_folder?;
        let mut key = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned()).display().to_string();
        let data = file.data_files();
        for name in std::iter::once(path).chain(data.iter().map(PathBuf::as_path)) {
            let Ok(found) = fs::metadata(name) else { continue };
            let changed = found.modified().ok().and_then(|at| at.duration_since(UNIX_EPOCH).ok());
            let changed = changed.unwrap_or_default().as_nanos();
            key += &format!("|{}|{changed}", if found.is_dir() { 0 } else { found.len() });
        }
        let selection = Selection { level: None, region, ..options.selection };
        let plan = file.plan();
        key += &format!("|{selection:?}|{:?}|{}|{:?}", options.raw, plan.format, plan.dtype);
        let path = folder.join(format!("{:016x}.pages", fnv(key.as_bytes())));
        Some(Self { path, key })
    }

    /// The index that is kept there, if it is whole and of this volume.
    pub(crate) fn read(&self) -> Option<PageIndex> {
        let bytes = read_file(&self.path, MAX_BYTES).ok()??;
        index_from_bytes(&bytes, &self.key)
    }

    /// Keeps an index. Returns its file.
    ///
    /// # Errors
    /// If the system refuses.
    pub(crate) fn write(&self, index: &PageIndex) -> Result<PathBuf, FormatError> {
        write_private(&self.path, &bytes_of_index(index, &self.key))?;
        Ok(self.path.clone())
    }

    /// The file.
    pub(super) fn file(&self) -> PathBuf {
        self.path.clone()
    }

    /// The folder of the file.
    pub(super) fn folder(&self) -> &Path {
        folder_of(&self.path)
    }

    /// The levels of means that are kept beside it, if they are whole and of this volume.
    pub(super) fn read_means(&self, plan: &MeanPlan, num_channels: usize) -> Option<Arc<MeansFile>> {
        MeansFile::open(&self.path_of_means(), &self.key, plan, num_channels)
    }

    /// Keeps levels of means beside the index.
    ///
    /// # Errors
    /// If the system refuses.
    pub(super) fn write_means(&self, means: &MeanLevels) -> Result<(), FormatError> {
        write_means(&self.path_of_means(), &self.key, means)
    }

    fn path_of_means(&self) -> PathBuf {
        self.path.with_extension("means")
    }
}

fn bytes_of_index(index: &PageIndex, key: &str) -> Vec<u8> {
    let mut out = MAGIC.to_vec();
    let number = |out: &mut Vec<u8>, n: u32| out.extend(n.to_le_bytes());
    number(&mut out, key.len() as u32);
    out.extend(key.as_bytes());
    index.pages.iter().for_each(|n| number(&mut out, *n));
    number(&mut out, index.channels.len() as u32);
    for channel in &index.channels {
        let KnownNumbers { stored_range, histogram } = &channel.known;
        let ends = [histogram.percentile(0.0), histogram.percentile(100.0)];
        let floats = [stored_range.0, stored_range.1, histogram.lo, histogram.hi, ends[0], ends[1]];
        floats.iter().for_each(|x| out.extend(x.to_le_bytes()));
        number(&mut out, histogram.counts.len() as u32);
        histogram.counts.iter().for_each(|n| out.extend(n.to_le_bytes()));
        for (lo, hi) in &channel.ranges {
            out.extend(lo.to_le_bytes());
            out.extend(hi.to_le_bytes());
        }
    }
    let sum = fnv(&out);
    out.extend(sum.to_le_bytes());
    out
}

/// The index in `bytes`; `None` if they are damaged, of another version, or of another volume than `key` says.
fn index_from_bytes(bytes: &[u8], key: &str) -> Option<PageIndex> {
    let (bytes, sum) = bytes.split_last_chunk::<8>()?;
    if u64::from_le_bytes(*sum) != fnv(bytes) {
        return None;
    }
    let mut rest = IndexBytes(bytes.strip_prefix(MAGIC)?);
    let length = rest.number()? as usize;
    if rest.take(length)? != key.as_bytes() {
        return None;
    }
    let pages = [rest.number()?, rest.number()?, rest.number()?];
    let num_pages = pages.iter().try_fold(1usize, |n, m| n.checked_mul(*m as usize))?;
    let num_channels = rest.number()? as usize;
    if num_channels == 0 || num_channels > isinglass_core::volume::MAX_CHANNELS {
        return None;
    }
    let mut channels = Vec::new();
    for _ in 0..num_channels {
        let [least, greatest, lo, hi, first, last] = rest.floats()?;
        let num_bins = rest.number()? as usize;
        let counts = rest.take(num_bins.checked_mul(8)?)?.as_chunks::<8>().0;
        let counts = counts.iter().map(|n| u64::from_le_bytes(*n)).collect();
        let histogram = Arc::new(Histogram::from_parts(lo, hi, counts, (first, last))?);
        let pairs = rest.take(num_pages.checked_mul(8)?)?.as_chunks::<4>().0.as_chunks::<2>().0;
        let pair = |[lo, hi]: &[[u8; 4]; 2]| (f32::from_le_bytes(*lo), f32::from_le_bytes(*hi));
        let ranges: Vec<(f32, f32)> = pairs.iter().map(pair).collect();
        let is_good = |&(lo, hi): &(f32, f32)| (least <= lo && lo <= hi && hi <= greatest) || lo > hi;
        if !(least.is_finite() && greatest.is_finite() && least <= greatest && ranges.iter().all(is_good)) {
            return None;
        }
        channels.push(ChannelIndex {
            ranges,
            known: KnownNumbers { stored_range: (least, greatest), histogram },
        });
    }
    rest.0.is_empty().then_some(PageIndex { pages, channels })
}

/// What is left of the bytes.
pub(super) struct IndexBytes<'a>(pub(super) &'a [u8]);

impl<'a> IndexBytes<'a> {
    pub(super) fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    pub(super) fn number(&mut self) -> Option<u32> {
        Some(u32::from_le_bytes(*self.take(4)?.first_chunk()?))
    }

    pub(super) fn words(&mut self, count: usize) -> Option<Vec<[u8; 8]>> {
        Some(self.take(count.checked_mul(8)?)?.as_chunks::<8>().0.to_vec())
    }

    fn floats<const N: usize>(&mut self) -> Option<[f32; N]> {
        let words = self.take(4 * N)?.as_chunks::<4>().0;
        let floats: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
        floats.try_into().ok()
    }
}

/// A sum of bytes that changes with each of them (FNV-1a, 64 bits).
pub(super) fn fnv(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |sum, b| (sum ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3))
}

/// The first bytes, with the version.
const MAGIC: &[u8] = b"isinglass pages 1\n";
/// Longest file: the ranges of the most pages, and histograms.
const MAX_BYTES: u64 = 256 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> PageIndex {
        let channel = |shift: f32| {
            let ranges = (0..6).map(|i| (shift + i as f32, shift + 10.0 + i as f32));
            let mut ranges: Vec<(f32, f32)> = ranges.collect();
            ranges[3] = (f32::INFINITY, f32::NEG_INFINITY);
            let range = (shift, shift + 15.0);
            let histogram = Histogram::of_counts(
                &[(shift, shift + 2.0, 77), (shift + 15.0, shift + 15.0, 3)],
                range,
                (2.0, 1.0),
            );
            ChannelIndex {
                ranges,
                known: KnownNumbers { stored_range: range, histogram: Arc::new(histogram) },
            }
        };
        PageIndex { pages: [3, 2, 1], channels: vec![channel(0.0), channel(-7.5)] }
    }

    #[test]
    fn an_index_is_read_as_it_was_written_and_no_other_bytes_are() {
        let index = sample();
        let bytes = bytes_of_index(&index, "a key");
        assert_eq!(index_from_bytes(&bytes, "a key"), Some(index.clone()));
        assert_eq!(index_from_bytes(&bytes, "another"), None);
        assert_eq!((index.range(0, [0, 1, 0]), index.range(0, [1, 0, 0])), (None, Some((1.0, 11.0))));
        for at in (0..bytes.len()).step_by(bytes.len() / 997) {
            assert_eq!(index_from_bytes(&bytes[..at], "a key"), None, "cut at {at}");
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << (at % 8);
            assert_eq!(index_from_bytes(&flipped, "a key"), None, "changed at {at}");
        }
    }

    /// Numbers that make no sense, under a sum that is right.
    #[test]
    fn numbers_that_cannot_be_are_refused() {
        let summed = |mut bytes: Vec<u8>| {
            bytes.truncate(bytes.len() - 8);
            let sum = fnv(&bytes);
            bytes.extend(sum.to_le_bytes());
            bytes
        };
        let bytes = bytes_of_index(&sample(), "k");
        let start = MAGIC.len() + 4 + 1;
        assert!(index_from_bytes(&summed(bytes.clone()), "k").is_some());
        let mut random = 7u32;
        let mut num_read = 0;
        for round in 0..2000 {
            let mut odd = bytes.clone();
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            // Most changes are in the numbers before the bins.
            let at = start + (random >> 8) as usize % if round % 4 == 0 { odd.len() - start - 8 } else { 44 };
            odd[at] = (random >> 24) as u8;
            if let Some(index) = index_from_bytes(&summed(odd), "k") {
                num_read += 1;
                assert!(index.stored_range(0).0.is_finite() && index.pages().iter().product::<u32>() == 6);
            }
        }
        assert!(num_read > 0 && num_read < 2000, "{num_read}");
    }
}
