//! Boxes of an array for pages. Neighbouring pages share the chunks that were decoded.

use std::collections::HashSet;
use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use super::ArrayPyramid;
use super::array::Array;
use super::chunks::{Chunks, ReadChunk, absent_text};
use super::store::Store;
use crate::chunk_cache::{ChunkCache, ChunkKey};
use crate::chunk_grid::next_index;
use crate::decode::VoxelSink;
use crate::error::{FormatError, shown};
use crate::hyperslab::Steps;
use crate::plan::{BoxLevel, BoxReader, Plan, Role};

/// What the levels of an image share.
pub(super) struct SharedChunks {
    pub(super) chunks: ChunkCache<ReadChunk>,
    pub(super) tables: ChunkCache<Option<(Arc<Vec<u8>>, u64)>>,
    absent: Mutex<HashSet<ChunkKey>>,
}

/// A level of an image.
struct ArrayBoxes {
    pyramid: Arc<ArrayPyramid>,
    level: usize,
    channel_axis: Option<usize>,
    shared: Arc<SharedChunks>,
    cost: Option<String>,
}

impl SharedChunks {
    fn new(most_bytes: u64) -> Self {
        Self {
            chunks: ChunkCache::new(most_bytes),
            tables: ChunkCache::new(most_bytes / 8),
            absent: Mutex::new(HashSet::new()),
        }
    }

    /// Notes a chunk that is not there.
    pub(super) fn note_absent(&self, key: ChunkKey) {
        let mut absent = self.absent.lock().unwrap_or_else(PoisonError::into_inner);
        if absent.len() < MAX_ABSENT {
            absent.insert(key);
        }
    }
}

/// The levels of an image, whose chunks may take a share of `max_bytes`. `plans` are those of its levels.
///
/// # Errors
/// A chunk takes more.
pub(super) fn levels(
    pyramid: &Arc<ArrayPyramid>,
    plans: Vec<Plan>,
    max_bytes: u64,
    path: &Path,
) -> Result<Vec<BoxLevel>, FormatError> {
    let most_bytes = (max_bytes / SHARE_OF_CHUNKS).clamp(LEAST_CACHED, MOST_CACHED);
    let shared = Arc::new(SharedChunks::new(most_bytes));
    let mut levels = Vec::new();
    for (level, plan) in plans.into_iter().enumerate() {
        let array = &pyramid.arrays[level];
        let chunk = array.chunk_bytes();
        if chunk > most_bytes {
            let found = format!("level {level} in chunks of {chunk} bytes, of which {most_bytes} are kept,");
            return Err(FormatError::NotPaged { path: shown(path), found });
        }
        let met = array.sides().iter().zip(&array.shape).map(|(side, n)| PAGE_SIDE.min(*n).div_ceil(*side));
        let needed = met.fold(chunk, u64::saturating_mul);
        let cost = (needed > most_bytes).then(|| {
            format!(
                "a page takes chunks of {} MiB, more than are kept; `isinglass convert` makes small ones",
                needed >> 20
            )
        });
        let channel_axis = plan.axes.iter().position(|axis| axis.role == Role::Channel);
        let (pyramid, shared) = (Arc::clone(pyramid), Arc::clone(&shared));
        levels.push(BoxLevel {
            plan,
            reader: Box::new(ArrayBoxes { pyramid, level, channel_axis, shared, cost }),
        });
    }
    Ok(levels)
}

impl BoxReader for ArrayBoxes {
    fn read(&self, selected: &[Steps]) -> Result<VoxelSink, FormatError> {
        let (array, store) = (&self.pyramid.arrays[self.level], &self.pyramid.store);
        let chunks = Chunks::of_box(array, store, selected, self.channel_axis, (self.level, &self.shared));
        chunks.read_box(selected, self.channel_axis)
    }

    fn num_absent(&self) -> u64 {
        let absent = self.shared.absent.lock().unwrap_or_else(PoisonError::into_inner);
        absent.iter().filter(|(level, _)| *level == self.level).count() as u64
    }

    fn absence(&self) -> Option<String> {
        let array = &self.pyramid.arrays[self.level];
        let (present, num_files) = present_files(array, &self.pyramid.store)?;
        (present < num_files).then(|| absent_text(num_files - present, num_files))
    }

    fn cost(&self) -> Option<String> {
        self.cost.clone()
    }
}

/// How many files of chunks or shards an array has, and how many it could have; `None` if they are many, or at an
/// address.
fn present_files(array: &Array, store: &Store) -> Option<(u64, u64)> {
    let counts: Vec<u64> = array.shape.iter().zip(&array.chunk).map(|(n, side)| n.div_ceil(*side)).collect();
    let num_files = counts.iter().try_fold(1u64, |n, count| n.checked_mul(*count))?;
    if num_files > MAX_ABSENT as u64 || matches!(store, Store::Web(..)) {
        return None;
    }
    let (folder, is_nested) = array.chunk_folder();
    if !is_nested {
        let names = store.names_in(&folder, 2 * MAX_ABSENT)?;
        let is_one =
            |index: Vec<u64>| index.len() == counts.len() && index.iter().zip(&counts).all(|(i, n)| i < n);
        let present = names.iter().filter(|name| array.index_of(name).is_some_and(is_one)).count();
        return Some((present as u64, num_files));
    }
    let (last, outer) = counts.split_last()?;
    let outer: Vec<Range<u64>> = outer.iter().map(|n| 0..*n).collect();
    let mut index = vec![0; outer.len()];
    let mut present = 0;
    loop {
        let inner = index.iter().fold(folder.clone(), |path, i| path.join(i.to_string()));
        // A folder that is not there has no chunks.
        let names = store.names_in(&inner, 2 * MAX_ABSENT).unwrap_or_default();
        let is_one = |name: &&String| name.parse::<u64>().is_ok_and(|i| i < *last);
        present += names.iter().filter(is_one).count() as u64;
        if index.is_empty() || !next_index(&mut index, &outer) {
            return Some((present, num_files));
        }
    }
}

/// The chunks in memory take at most this part of the memory.
const SHARE_OF_CHUNKS: u64 = 8;
/// Bytes of chunks in memory, at least and at most.
const LEAST_CACHED: u64 = 32 << 20;
const MOST_CACHED: u64 = 512 << 20;
/// Most chunks that are noted as absent.
const MAX_ABSENT: usize = 1 << 16;
/// Voxels along the side of a page and of what is read around it.
const PAGE_SIDE: u64 = 68;
