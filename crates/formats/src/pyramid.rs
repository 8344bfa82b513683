//! The level of a pyramid that is shown, and how it lies in the finest one.

use std::path::Path;

use isinglass_core::volume::Volume;

use crate::dtype::Dtype;
use crate::error::{FormatError, not_there};
use crate::levels::LevelGrid;
use crate::plan::{Memory, Plan, Role};
use crate::source::OpenOptions;
use crate::warning::WarningKind;

/// The level that the options select, or the finest that fits into memory and a texture with its channels. `levels`
/// are the voxels of each along x, y and z, the finest first.
pub(crate) fn level_to_show(
    path: &Path,
    levels: &[[u64; 3]],
    num_channels: u64,
    dtype: Dtype,
    options: &OpenOptions,
) -> Result<usize, FormatError> {
    let fits = |dims: &[u64; 3]| {
        let num_voxels = dims.iter().try_fold(1u64, |n, d| n.checked_mul(*d));
        let memory = |num_voxels| Memory { num_voxels, dtype, is_permuted: false };
        dims.iter().all(|d| *d <= u64::from(Volume::MAX_SIDE))
            && num_voxels.is_some_and(|n| memory(n).needed(num_channels) <= options.max_bytes)
    };
    match options.selection.level {
        Some(level) if level as usize >= levels.len() => {
            Err(not_there(path, "level", level.into(), levels.len()))
        }
        Some(level) => Ok(level as usize),
        None if options.selection.region.is_some() => Ok(0),
        None => Ok(levels.iter().position(fits).unwrap_or(levels.len() - 1)),
    }
}

/// Puts the level of `plan`, which is not the finest, into the finest one. One that lies elsewhere gets a warning.
pub(crate) fn put_in_finest(plan: &mut Plan, in_finest: LevelGrid) {
    let dims = [0, 1, 2].map(|i| plan.size(Role::Space(i)));
    plan.in_finest = in_finest.is_alike(dims).then_some(in_finest);
    if plan.in_finest.is_none() {
        let text = format!("level {} lies elsewhere than level 0, so it looks different", plan.level);
        plan.warn(WarningKind::Data, text);
    }
}

/// Says which level of `plan` is shown, if the user did not choose it and it is not the finest.
pub(crate) fn warn_of_level(plan: &mut Plan, options: &OpenOptions) {
    if plan.level > 0 && options.selection.level.is_none() {
        let (level, num) = (plan.level, plan.levels.len());
        let text = format!("level {level} of {num} is shown, the finest that fits into memory and a texture");
        plan.warn(WarningKind::Choice, text);
    }
}
