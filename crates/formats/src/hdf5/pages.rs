//! Boxes of arrays for pages. Neighbouring pages share the chunks that were decoded.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::contents::with_contents;
use super::storage::Storage;
use super::{Hdf5File, ShownImage, grid_of, part_storage};
use crate::channels::{ChannelSinks, StreamShape};
use crate::chunk_cache::{ChunkCache, ChunkKey};
use crate::decode::VoxelSink;
use crate::error::{FormatError, io_error, malformed, shown};
use crate::hyperslab::Steps;
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{BoxLevel, BoxReader, Plan, Role};
use crate::source::open_file;

/// What the levels of a file share.
struct SharedParts {
    path: PathBuf,
    format: String,
    most_bytes: u64,
    image: ShownImage,
    /// The plans of its levels.
    plans: Vec<Plan>,
    num_channels: usize,
    num_times: usize,
    /// The arrays that were met, by their numbers; `None` for those that are not there.
    storage: Mutex<HashMap<usize, Option<Arc<Storage>>>>,
    chunks: ChunkCache<Arc<Vec<u8>>>,
}

/// A level of a file.
struct PartBoxes {
    shared: Arc<SharedParts>,
    level: usize,
    plan: Plan,
    cost: Option<String>,
    /// Chunks that are not stored, as far as they were met.
    absent: Mutex<HashSet<ChunkKey>>,
}

/// The levels of `file`, finest first.
///
/// # Errors
/// A chunk takes more memory than is kept.
pub(super) fn levels(file: &Hdf5File, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
    let plans = match &file.image {
        ShownImage::Array(_) => vec![file.plan.clone()],
        ShownImage::Image { image, .. } => (0..image.num_levels()).map(|level| image.plan(level)).collect(),
    };
    let shared = Arc::new(SharedParts {
        path: file.path.clone(),
        format: file.plan.format.clone(),
        most_bytes: (file.most_bytes / SHARE_OF_CHUNKS).clamp(LEAST_CACHED, MOST_CACHED),
        image: file.image.clone(),
        plans: plans.clone(),
        num_channels: file.plan.channels() as usize,
        num_times: file.plan.times() as usize,
        storage: Mutex::default(),
        chunks: ChunkCache::new((file.most_bytes / SHARE_OF_CHUNKS).clamp(LEAST_CACHED, MOST_CACHED)),
    });
    let mut found = Vec::new();
    for (level, plan) in plans.into_iter().enumerate() {
        let Some((_, storage)) = shared.storage(level, 0, 0)? else { continue };
        if let (ShownImage::Array(_), Some(offset)) = (&file.image, storage.offset()) {
            let flat = FlatFile { path: file.path.clone(), offset };
            return flat_level(&plan, vec![flat], path);
        }
        let chunk = storage.bytes_of_chunk();
        if chunk > shared.most_bytes {
            let found =
                format!("level {level} in chunks of {chunk} bytes, of which {} are kept,", shared.most_bytes);
            return Err(FormatError::NotPaged { path: shown(path), found });
        }
        let met = storage.sides.iter().zip(&storage.shape).map(|(side, n)| PAGE_SIDE.min(*n).div_ceil(*side));
        let needed = met.fold(chunk, u64::saturating_mul);
        let cost = (needed > shared.most_bytes).then(|| {
            format!(
                "a page takes chunks of {} MiB, more than are kept; `isinglass convert` makes small ones",
                needed >> 20
            )
        });
        let reader = PartBoxes {
            shared: Arc::clone(&shared),
            level,
            plan: plan.clone(),
            cost,
            absent: Mutex::default(),
        };
        found.push(BoxLevel { plan, reader: Box::new(reader) });
    }
    Ok(found)
}

impl SharedParts {
    /// An array and its number; `None` if it is a part of an image that is not there.
    fn storage(
        &self,
        level: usize,
        time: usize,
        channel: usize,
    ) -> Result<Option<(usize, Arc<Storage>)>, FormatError> {
        let (number, name, image) = match &self.image {
            ShownImage::Array(path) => (0, path.clone(), None),
            ShownImage::Image { image, .. } => {
                let number = (level * self.num_times + time) * self.num_channels + channel;
                (number, image.names().path(level, time, channel), Some(&**image))
            }
        };
        let mut known = self.storage.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = known.get(&number) {
            return Ok(found.clone().map(|found| (number, found)));
        }
        let read = with_contents(open_file(&self.path)?, &self.path, |contents| {
            let found = part_storage(contents, &name, (&self.plans[level], image), self.most_bytes);
            found.map_err(malformed(&self.path, &self.format))
        })?;
        let found = read.map(Arc::new);
        if known.len() < MAX_KNOWN {
            known.insert(number, found.clone());
        }
        Ok(found.map(|found| (number, found)))
    }
}

impl BoxReader for PartBoxes {
    fn read(&self, selected: &[Steps]) -> Result<VoxelSink, FormatError> {
        let (shared, plan) = (&self.shared, &self.plan);
        let first = |steps: &Steps| steps.range.start as usize;
        let (channel, time) = match selected {
            [.., channel, time] => (first(channel), first(time)),
            _ => (0, 0),
        };
        let storage = shared.storage(self.level, time, channel)?;
        let no_memory = || io_error(&shared.path)(std::io::ErrorKind::OutOfMemory.into());
        let num_voxels = selected.iter().map(Steps::len).product::<u64>() as usize;
        let channel_axis = plan.axes.iter().position(|axis| axis.role == Role::Channel);
        let (dtype, endian) = (plan.dtype, plan.endian);
        let shape = StreamShape { dtype, endian, selected, channel_axis, num_channels: 1, num_voxels };
        let zero = vec![0; dtype.num_bytes()];
        let fill = storage.as_ref().map_or(&zero, |(_, storage)| &storage.fill);
        let mut sinks = ChannelSinks::new(&shape, Some(fill)).map_err(|_| no_memory())?;
        if let Some((number, storage)) = &storage {
            let in_array = channel_axis.filter(|_| matches!(shared.image, ShownImage::Array(_)));
            let grid = grid_of(storage, selected, in_array, 0);
            for start in storage.starts(&grid.ranges()) {
                if grid.num_within(&start) == 0 {
                    continue;
                }
                let key = (*number, start);
                let Some(chunk) = storage.chunk(&key.1) else {
                    self.note_absent(key);
                    continue;
                };
                let bytes = shared.chunks.get(key, grid.bytes_of_chunk(), || {
                    let damaged = |problem| super::damaged(&shared.path, problem);
                    storage.bytes(&chunk).map(Arc::new).map_err(damaged)
                })?;
                sinks.place(grid.pieces(&chunk.start, &bytes, &shared.path)?, 0);
            }
        }
        sinks.into_first().ok_or_else(no_memory)
    }

    fn num_absent(&self) -> u64 {
        self.absent.lock().unwrap_or_else(PoisonError::into_inner).len() as u64
    }

    fn cost(&self) -> Option<String> {
        self.cost.clone()
    }
}

impl PartBoxes {
    fn note_absent(&self, key: ChunkKey) {
        let mut absent = self.absent.lock().unwrap_or_else(PoisonError::into_inner);
        if absent.len() < MAX_ABSENT {
            absent.insert(key);
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
/// Most arrays of which the places of chunks are kept.
const MAX_KNOWN: usize = 256;
/// Voxels along the side of a page and of what is read around it.
const PAGE_SIDE: u64 = 68;
