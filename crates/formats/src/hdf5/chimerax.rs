//! ChimeraX and Chimera maps (`.cmap`): each image has an array, and others with fewer voxels of it.

use glam::DVec3;

use super::contents::{ArrayFile, Listed};
use super::image::{ArrayImage, PartLevel, PartNames};
use super::storage::StorageForm;
use crate::axes::Geometry;
use crate::error::one_line;
use crate::plan::{Axis, Plan};

/// The images of a file, with a name of each; none if Chimera did not write it.
pub(super) fn images(contents: &ArrayFile) -> Vec<(String, ArrayImage)> {
    let names = contents.names("/Chimera");
    names.into_iter().take(MAX_IMAGES).filter_map(|name| image(contents, &name)).collect()
}

fn image(contents: &ArrayFile, group: &str) -> Option<(String, ArrayImage)> {
    let folder = format!("/Chimera/{group}");
    let told = contents.attributes(&folder)?;
    let names = contents.names(&folder);
    let arrays = names.iter().filter_map(|name| contents.array(&format!("{folder}/{name}")).ok());
    let steps = |array: &Listed| <[f64; 3]>::try_from(array.attributes.numbers("subsample_spacing"));
    let mut levels: Vec<([f64; 3], Listed)> = arrays
        .filter(|array| array.shape.len() == 3)
        .take(MAX_LEVELS)
        .map(|array| (steps(&array).unwrap_or([1.0; 3]), array))
        .filter(|(step, _)| step.iter().all(|step| *step >= 1.0 && step.is_finite()))
        .collect();
    levels.sort_by(|(a, _), (b, _)| a.iter().product::<f64>().total_cmp(&b.iter().product()));
    let (step, first) = levels.first().filter(|(step, _)| *step == [1.0; 3])?;
    StorageForm::of(contents, first).ok()?;
    let (dtype, endian) = first.kind.clone().ok()?;
    let dims = |array: &Listed| [array.shape[2], array.shape[1], array.shape[0]];
    let parts = levels.iter().filter(|(_, array)| array.kind == first.kind);
    let (parts, paths): (Vec<PartLevel>, Vec<String>) =
        parts.map(|(step, array)| (PartLevel { dims: dims(array), step: *step }, array.path.clone())).unzip();
    let three = |name: &str| <[f64; 3]>::try_from(told.numbers(name)).ok();
    let spacing = three("step").filter(|step| step.iter().all(|step| *step > 0.0 && step.is_finite()));
    let mut geometry = Geometry::along_axes(spacing.unwrap_or(*step), spacing.map(|_| "Å".to_owned()));
    geometry.origin = three("origin").map(DVec3::from).filter(|_| spacing.is_some());
    let format = format!("Chimera map, {}", one_line(&first.path));
    let mut plan = Plan::new(format, dtype, endian, Axis::in_space(dims(first)), geometry);
    if spacing.is_none() {
        plan.spacing_guess = Some("the image has no step; its spacing was taken as 1".into());
    }
    let name = told.text("name").unwrap_or_else(|| group.to_owned());
    let names = PartNames::Paths { paths, num_times: 1, num_channels: 1 };
    Some((one_line(&name), ArrayImage::new(plan, (1, 1), parts, names)))
}

const MAX_IMAGES: usize = 256;
const MAX_LEVELS: usize = 64;
