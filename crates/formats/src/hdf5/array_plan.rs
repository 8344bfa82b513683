//! The plan of one array.

use super::contents::{ArrayFile, FORMAT, Listed};
use super::coordinates::{self, Scales};

use crate::cf;
use crate::error::one_line;
use crate::plan::Plan;

/// Voxels of `array` along its axes in space. The error says why it is no volume.
pub(super) fn sizes(array: &Listed, scales: &Scales) -> Result<Vec<u64>, String> {
    array.kind.as_ref().map_err(|found| format!("{} has {found}, expected numbers", array.description()))?;
    let found = coordinates::of_array(None, array, scales);
    cf::num_in_space(&array.shape, &found).ok_or_else(|| other_axes(array))
}

fn other_axes(array: &Listed) -> String {
    format!("{} has other axes, expected two or three in space, and channels and times", array.description())
}

/// The plan of `array`.
pub(super) fn plan(contents: &ArrayFile, array: &Listed, scales: &Scales) -> Result<Plan, String> {
    let format = if scales.are_of_netcdf() { "NetCDF-4" } else { FORMAT };
    let format = format!("{format}, {}", one_line(&array.path));
    let found = coordinates::of_array(Some(contents), array, scales);
    let plan = cf::plan(format, array.kind.clone()?, &array.shape, &found, &array.attributes);
    plan.ok_or_else(|| other_axes(array))
}
