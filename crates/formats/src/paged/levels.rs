//! The levels of a file that pages can be read from.

use std::path::Path;
use std::sync::Arc;

use isinglass_core::volume::PyramidLevel;

use super::MAX_SIDE;
use crate::error::{FormatError, shown};
use crate::hyperslab::Steps;
use crate::levels::LevelGrid;
use crate::plan::{BoxLevel, BoxReader, Chosen, Plan};
use crate::selection::{Region, Selection};
use crate::source::OpenOptions;

/// A level of a file.
#[derive(Clone)]
pub(super) struct PageLevel {
    pub(super) plan: Arc<Plan>,
    /// The selected part, which is all that pages know of.
    pub(super) chosen: Arc<Chosen>,
    pub(super) reader: Arc<dyn BoxReader>,
    pub(super) shape: PyramidLevel,
    /// Whether it is no level of the file, but one that its index keeps.
    pub(super) is_kept: bool,
}

impl PageLevel {
    /// The numbers of a box of a channel along each axis of the file, from voxel `min` to the one before `max`.
    pub(super) fn steps(&self, grid: &crate::axes::Grid, channel: u32) -> Vec<Steps> {
        let channel = u64::from(channel);
        self.plan.steps(grid, channel..channel + 1, self.chosen.time.into())
    }

    pub(super) fn num_voxels(&self) -> u64 {
        self.shape.dims.iter().map(|&n| u64::from(n)).product()
    }

    /// Bytes of all channels while the level is read whole: one of them is there twice.
    pub(super) fn bytes_of_base(&self) -> u64 {
        let of_voxel = self.plan.dtype.num_bytes_in_memory() as u64 * (self.chosen.channels.len() as u64 + 1);
        self.num_voxels().saturating_mul(of_voxel)
    }
}

/// The levels that lie in the finest one as pages need it, finest first.
///
/// # Errors
/// The selection is not in the file, or a side is too long.
pub(super) fn page_levels(
    levels: Vec<BoxLevel>,
    path: &Path,
    options: &OpenOptions,
) -> Result<Vec<PageLevel>, FormatError> {
    let mut found: Vec<PageLevel> = Vec::new();
    let mut levels = levels.into_iter();
    let Some(BoxLevel { mut plan, reader }) = levels.next() else {
        return Err(FormatError::NotPaged { path: shown(path), found: "an image without levels".into() });
    };
    let whole = [0, 1, 2].map(|i| plan.size(crate::plan::Role::Space(i)));
    plan.in_finest = Some(LevelGrid::finest(whole));
    let chosen = choose(&plan, path, options, options.selection.region)?;
    let dims = chosen.grid.dims();
    if chosen.grid.thin != [1; 3] {
        let found = format!("a side of more than {MAX_SIDE} voxels");
        return Err(FormatError::NotPaged { path: shown(path), found });
    }
    let finest = Arc::new(chosen);
    let shape = PyramidLevel { dims, factor: [1; 3], first: [0.0; 3] };
    found.push(PageLevel {
        plan: Arc::new(plan),
        chosen: finest,
        reader: reader.into(),
        shape,
        is_kept: false,
    });
    for BoxLevel { plan, reader } in levels {
        if let Some(level) = coarser(plan, reader, &found[0], path, options)?
            && found.last().is_none_or(|last| level.num_voxels() < last.num_voxels())
        {
            found.push(level);
        }
    }
    Ok(found)
}

/// What is selected of a level, whatever memory it takes.
fn choose(
    plan: &Plan,
    path: &Path,
    options: &OpenOptions,
    region: Option<Region>,
) -> Result<Chosen, FormatError> {
    let selection = Selection { region, level: None, ..options.selection };
    let options = OpenOptions { selection, max_bytes: u64::MAX, ..*options };
    plan.choose_within(path, &options, MAX_SIDE)
}

/// A coarser level in the selected part of the finest one; `None` if it does not lie there as pages need it: powers of
/// two apart, of the same numbers.
fn coarser(
    plan: Plan,
    reader: Box<dyn BoxReader>,
    finest: &PageLevel,
    path: &Path,
    options: &OpenOptions,
) -> Result<Option<PageLevel>, FormatError> {
    let Some(in_finest) = plan.in_finest.clone() else { return Ok(None) };
    if plan.dtype != finest.plan.dtype || plan.value_map != finest.plan.value_map {
        return Ok(None);
    }
    let chosen = choose(&plan, path, options, None)?;
    if chosen.grid.thin != [1; 3] || chosen.channels != finest.chosen.channels {
        return Ok(None);
    }
    let (mut factor, mut first, mut region) = ([1; 3], [0.0; 3], Region { min: [0; 3], max: [None; 3] });
    for (k, (axis, _)) in chosen.grid.order.into_iter().enumerate() {
        let step = in_finest.step[axis].round();
        let is_exact = (in_finest.step[axis] - step).abs() <= MOST_UNEVEN * step;
        if !is_exact || !(1.0..=MOST_FACTOR).contains(&step) || !(step as u32).is_power_of_two() {
            return Ok(None);
        }
        factor[k] = step as u32;
        let Some(found) = chosen.in_finest.as_ref() else { return Ok(None) };
        // The finest level's index of the level's first voxel, from the first one that is selected.
        let (start, length) = (part_start(options, k), f64::from(finest.shape.dims[k]));
        let at = f64::from(found.finest.first[k]) - start;
        let from = if start > 0.0 { (-at / step).ceil().max(0.0) } else { 0.0 };
        let dims = f64::from(chosen.grid.dims()[k]);
        let is_part = options.selection.region.is_some_and(|r| r.max[k].is_some());
        let to = if is_part { (((length - 1.0 - at) / step).floor() + 1.0).min(dims) } else { dims };
        if to <= from {
            return Ok(None);
        }
        first[k] = (at + step * from) as f32;
        region.min[k] = from as u32;
        region.max[k] = (to < dims).then_some(to as u32);
    }
    let chosen = choose(&plan, path, options, Some(region))?;
    let shape = PyramidLevel { dims: chosen.grid.dims(), factor, first };
    Ok(Some(PageLevel {
        plan: Arc::new(plan),
        chosen: Arc::new(chosen),
        reader: reader.into(),
        shape,
        is_kept: false,
    }))
}

/// The first selected voxel of the finest level along an axis of the volume.
fn part_start(options: &OpenOptions, axis: usize) -> f64 {
    options.selection.region.map_or(0.0, |region| f64::from(region.min[axis]))
}

/// A step may be this part of it away from a whole number, as scales are rounded in files.
const MOST_UNEVEN: f64 = 1e-3;
/// Greatest step from one voxel of a level to the next.
const MOST_FACTOR: f64 = 1024.0;
