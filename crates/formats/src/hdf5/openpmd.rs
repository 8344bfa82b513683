//! openPMD 1.0 to 2.0: meshes of simulations, whose components are channels and whose iterations are points in time.

use super::array_plan;
use super::contents::{ArrayFile, Attributes, Listed};
use super::coordinates::Scales;
use super::image::{ArrayImage, PartLevel, PartNames};
use super::storage::StorageForm;
use crate::cf::{Coordinates, Unit, kind_of_name};
use crate::error::one_line;
use crate::plan::Role;
use crate::units::time_step;

/// The meshes of a file, with a name of each; none if openPMD did not write it.
pub(super) fn images(contents: &ArrayFile) -> Vec<(String, ArrayImage)> {
    let Some(root) = contents.attributes("/").filter(|root| root.has("openPMD")) else { return Vec::new() };
    let meshes = root.text("meshesPath").unwrap_or_else(|| "meshes/".into());
    let mut iterations: Vec<u64> =
        contents.names("/data").iter().filter_map(|name| name.parse().ok()).collect();
    iterations.sort_unstable();
    let folders: Vec<String> = iterations.iter().map(|i| format!("/data/{i}")).collect();
    let Some(first) = folders.first() else { return Vec::new() };
    let step =
        folders.get(1).and_then(|second| time_step(seconds(contents, second)? - seconds(contents, first)?));
    let meshes = meshes.trim_matches('/');
    let names = contents.names(&format!("{first}/{meshes}"));
    let image = |name: String| {
        let paths: Vec<String> = folders.iter().map(|folder| format!("{folder}/{meshes}/{name}")).collect();
        let image = image(contents, &name, &paths, step)?;
        Some((name, image))
    };
    names.into_iter().take(MAX_MESHES).filter_map(image).collect()
}

/// The time of an iteration in seconds.
fn seconds(contents: &ArrayFile, folder: &str) -> Option<f64> {
    let found = contents.attributes(folder)?;
    Some(found.number("time")? * found.number("timeUnitSI").unwrap_or(1.0))
}

/// The mesh at `paths`, one for each iteration; `None` if it is no volume.
fn image(contents: &ArrayFile, name: &str, paths: &[String], step: Option<f64>) -> Option<ArrayImage> {
    let first = paths.first()?;
    let mesh = contents.attributes(first)?;
    // A mesh with one component may be an array itself.
    let components: Vec<String> = match contents.array(first) {
        Ok(_) => vec![String::new()],
        Err(_) => contents.names(first),
    };
    let mut arrays: Vec<(String, Listed)> = Vec::new();
    for component in components.into_iter().take(MAX_COMPONENTS) {
        let path = if component.is_empty() { first.clone() } else { format!("{first}/{component}") };
        let Ok(array) = contents.array(&path) else { continue };
        if arrays.first().is_none_or(|(_, like)| (&like.shape, &like.kind) == (&array.shape, &array.kind)) {
            arrays.push((component, array));
        }
    }
    let array = &mut arrays.first_mut()?.1;
    StorageForm::of(contents, array).ok()?;
    array.told = Some(axes(&mesh, array)?);
    let mut plan = array_plan::plan(contents, array, &Scales::of(&[])).ok()?;
    if plan.channels() > 1 || plan.times() > 1 {
        return None;
    }
    plan.format = format!("openPMD, {}", one_line(name));
    plan.time_step = step;
    if arrays.len() > 1 {
        plan.channel_names = arrays.iter().map(|(component, _)| one_line(component)).collect();
    }
    let dims = [0, 1, 2].map(|i| plan.size(Role::Space(i)));
    let path = |folder: &String, component: &String| match component.as_str() {
        "" => folder.clone(),
        component => format!("{folder}/{component}"),
    };
    let all =
        paths.iter().flat_map(|folder| arrays.iter().map(move |(component, _)| path(folder, component)));
    let (num_times, num_channels) = (paths.len(), arrays.len());
    let names = PartNames::Paths { paths: all.collect(), num_times, num_channels };
    let level = PartLevel { dims, step: [1.0; 3] };
    Some(ArrayImage::new(plan, (num_channels, num_times), vec![level], names))
}

/// The axes of a component. Lists of the mesh have the slowest axis first, or last if its `dataOrder` is that of
/// Fortran.
fn axes(mesh: &Attributes, array: &Listed) -> Option<Vec<Coordinates>> {
    let rank = array.shape.len();
    let is_reversed = mesh.text("dataOrder").is_some_and(|order| order.trim() == "F");
    let ordered = |mut numbers: Vec<f64>| {
        if is_reversed {
            numbers.reverse();
        }
        (numbers.len() == rank).then_some(numbers)
    };
    let mut labels = mesh.texts("axisLabels").to_vec();
    if labels.is_empty() {
        labels.extend(mesh.text("axisLabels"));
    }
    if is_reversed {
        labels.reverse();
    }
    let steps = ordered(mesh.numbers("gridSpacing"));
    let starts = ordered(mesh.numbers("gridGlobalOffset")).unwrap_or_else(|| vec![0.0; rank]);
    // Where a number lies in its cell, 0 to 1.
    let within = ordered(array.attributes.numbers("position")).unwrap_or_else(|| vec![0.0; rank]);
    // Since version 2.0 each axis may have its own.
    let units = mesh.numbers("gridUnitSI");
    let units = ordered(units.clone()).unwrap_or_else(|| vec![units.first().copied().unwrap_or(1.0); rank]);
    let axis = |i: usize| {
        let step = steps.as_ref().map(|steps| steps[i]);
        let line = step.map(|step| ((starts[i] + within[i] * step) * units[i], step * units[i]));
        let kind =
            labels.get(i).filter(|_| labels.len() == rank).and_then(|label| kind_of_name(label.trim()));
        Coordinates::told(kind, line, Unit::Length(1.0, "m")).in_space()
    };
    (rank > 1).then(|| (0..rank).map(axis).collect())
}

const MAX_MESHES: usize = 256;
const MAX_COMPONENTS: usize = 64;
