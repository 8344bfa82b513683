//! The coarsest level, which is held whole.

use std::path::Path;
use std::sync::Arc;

use glam::Vec3;
use isinglass_core::volume::{Finest, Placement, PyramidLevel, Volume, VoxelKind};

use super::index::PageIndex;
use super::levels::PageLevel;
use crate::decode::VoxelSink;
use crate::error::{FormatError, io_error};
use crate::gap_rule::GapRule;
use crate::hyperslab::Steps;
use crate::labels::{TAKEN_FOR_LABELS, told_labels};
use crate::plan::{Chosen, Plan};
use crate::read_volume::{UNKNOWN_NUMBERS, channel_volumes, joint};
use crate::source::OpenOptions;

/// The base, and what it tells of the pages.
pub(super) struct Base {
    /// The channels.
    pub(super) volumes: Vec<Volume>,
    /// Which voxels have no value, for each channel.
    pub(super) rules: Vec<GapRule>,
    /// Distances of the voxels of the finest level.
    pub(super) spacing: Vec3,
    pub(super) kind: VoxelKind,
    finest: Finest,
    placement: Option<Placement>,
    plan: Arc<Plan>,
    /// Warnings about the file.
    words: Vec<String>,
}

impl Base {
    /// Reads the coarsest level. If that is large, a thinned one is added to the levels, and read.
    pub(super) fn read(
        levels: &mut Vec<PageLevel>,
        path: &Path,
        options: &OpenOptions,
    ) -> Result<Self, FormatError> {
        add_thinned(levels);
        let (finest, level) = (&levels[0], &levels[levels.len() - 1]);
        let channels = level.chosen.channels.clone();
        options.check_memory(path, level.bytes_of_base())?;
        let num_slabs = channels.len() * SLABS;
        let mut decoded = Vec::new();
        for (i, channel) in channels.enumerate() {
            let steps = level.steps(&level.chosen.grid, channel);
            let tick = |slab: usize| {
                if let Some(progress) = options.progress {
                    progress((i * SLABS + slab) as f32 / num_slabs as f32);
                }
                options.check_cancelled(path)
            };
            decoded.push(read_slabs(level, &steps, path, &tick)?.finish(level.plan.has_gaps));
        }
        let (volumes, rules) = channel_volumes(&level.plan, &level.chosen, decoded, path)?;
        let kind = match level.plan.dtype.num_bytes_in_memory() {
            1 => VoxelKind::U8,
            2 => VoxelKind::U16,
            _ => VoxelKind::F32,
        };
        let words = finest.chosen.warnings.iter().map(|w| w.text.clone());
        let words = words.chain(levels.iter().find_map(|level| level.reader.cost()));
        let mut words: Vec<String> = words.chain(finest.reader.absence()).collect();
        // The index knows that they look like labels, and the file does not.
        if level.is_kept
            && level.plan.are_labels
            && told_labels(&finest.plan, options.reading.voxels, 1).is_none()
        {
            words.push(TAKEN_FOR_LABELS.to_owned());
        }
        let (spacing, first) = (finest.chosen.grid.spacing, Vec3::from_array(level.shape.first));
        Ok(Self {
            volumes,
            rules,
            spacing,
            kind,
            finest: Finest { dims: finest.shape.dims, spacing, first, stored_range: None, histogram: None },
            placement: finest.chosen.grid.placement,
            plan: Arc::clone(&level.plan),
            words,
        })
    }

    /// The channels as one volume that looks as the finest level does, as far as that is known.
    pub(super) fn into_volume(
        mut self,
        index: Option<&PageIndex>,
        path: &Path,
        options: &OpenOptions,
    ) -> Result<Volume, FormatError> {
        let of_channel = |i: usize| Finest {
            stored_range: index.map(|index| index.stored_range(i)),
            histogram: index.map(|index| Arc::clone(index.histogram(i))),
            ..self.finest.clone()
        };
        let volumes = self.volumes.into_iter().enumerate();
        let volumes = volumes.map(|(i, volume)| volume.with_finest(of_channel(i))).collect();
        if index.is_none() {
            self.words.push(UNKNOWN_NUMBERS.to_owned());
        }
        let mut volume = joint(volumes, &self.plan, self.words, path, options)?;
        // The box is that of the finest level, and so is its place.
        volume.info.placement = self.placement;
        Ok(volume)
    }
}

/// Bytes that it takes to read the base of these levels, and to keep some of the file meanwhile.
pub(super) fn bytes_to_open(levels: &mut Vec<PageLevel>, max_bytes: u64) -> u64 {
    add_thinned(levels);
    // Each voxel has its brightness, too.
    let base = levels.last().map_or(0, |level| level.bytes_of_base().saturating_add(level.num_voxels()));
    base.saturating_add(max_bytes / 8)
}

/// Adds a level of one voxel in some of the coarsest level, unless that is small.
fn add_thinned(levels: &mut Vec<PageLevel>) {
    let Some(last) = levels.last() else { return };
    let mut steps = [1u32; 3];
    let dims = |steps: [u32; 3]| [0, 1, 2].map(|k| last.shape.dims[k].div_ceil(steps[k]));
    loop {
        let now = dims(steps);
        let longest = (0..3).max_by_key(|&k| now[k]).unwrap_or(0);
        let num_voxels: u64 = now.iter().map(|&n| u64::from(n)).product();
        if num_voxels <= MOST_VOXELS && now[longest] <= Volume::MAX_SIDE {
            break;
        }
        steps[longest] *= 2;
    }
    let is_only = levels.len() == 1;
    if is_only && steps == [1; 3] {
        // A base of the finest level's own voxels would be no coarser level.
        steps = last.shape.dims.map(|n| if n > 1 { 2 } else { 1 });
    }
    if steps == [1; 3] {
        return;
    }
    let grid = last.chosen.grid.thinned(steps);
    let shape = PyramidLevel {
        dims: grid.dims(),
        factor: [0, 1, 2].map(|k| last.shape.factor[k] * steps[k]),
        first: last.shape.first,
    };
    let num_voxels = shape.dims.iter().map(|&n| u64::from(n)).product();
    let chosen = Arc::new(Chosen { grid, num_voxels, ..(*last.chosen).clone() });
    let thinned = PageLevel { chosen, shape, ..last.clone() };
    levels.push(thinned);
}

/// Reads a channel of a level by slabs across the slowest axis, so that it can be stopped.
fn read_slabs(
    level: &PageLevel,
    steps: &[Steps],
    path: &Path,
    tick: &dyn Fn(usize) -> Result<(), FormatError>,
) -> Result<VoxelSink, FormatError> {
    let count: u64 = steps.iter().map(Steps::len).product();
    let sink = VoxelSink::new(level.plan.dtype, level.plan.endian, count as usize);
    let mut all = sink.map_err(|_| io_error(path)(std::io::ErrorKind::OutOfMemory.into()))?;
    let slow = steps.iter().rposition(|s| s.len() > 1).unwrap_or(0);
    let num_planes = steps[slow].len();
    let in_slab = num_planes.div_ceil(SLABS as u64).max(1);
    for (i, first) in (0..num_planes).step_by(in_slab as usize).enumerate() {
        tick(i)?;
        let last = (first + in_slab).min(num_planes) - 1;
        let mut part = steps.to_vec();
        part[slow].range = steps[slow].at(first)..steps[slow].at(last) + 1;
        all.append(level.reader.read(&part)?);
    }
    tick(SLABS)?;
    Ok(all)
}

/// Most voxels of the base: 256³.
const MOST_VOXELS: u64 = 1 << 24;
/// Parts of a channel between which reading can be stopped.
const SLABS: usize = 16;
