//! Which of the arrays and images of a file is shown.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use super::bdv_xml::BdvXml;
use super::contents::{ArrayFile, FORMAT, Listed};
use super::coordinates::Scales;
use super::image::ArrayImage;
use super::links::Inventory;
use super::outside::{self, OutsideArray};
use super::storage::StorageForm;
use super::{array_plan, bdv, chimerax, dialects, imaris, openpmd};
use crate::cf::{Standing, VolumeCandidate};
use crate::error::{FormatError, malformed, not_there, quoted};
use crate::foreign::HomeFolder;
use crate::plan::Plan;
use crate::warning::{Warning, WarningKind};

/// What is shown of a file.
pub(super) enum ArrayChoice {
    /// The plan of an array, and its path.
    Array(Box<Plan>, String),
    Image(Box<ArrayImage>),
    /// An array in another file.
    Outside {
        file: PathBuf,
        inside: String,
        series: Vec<String>,
        usual: u32,
        warnings: Vec<Warning>,
    },
}

/// What decides beside the file.
pub(super) struct Choice<'a> {
    /// The series that is wanted.
    pub(super) series: Option<u32>,
    /// The folder that other files must be in.
    pub(super) home: HomeFolder,
    /// The description of BigDataViewer.
    pub(super) xml: Option<&'a BdvXml>,
    pub(super) cancel: Option<&'a AtomicBool>,
}

/// An array, and the other file that has it.
type ArrayOfFile<'a> = (&'a Listed, Option<&'a OutsideArray>);

/// Chooses what is shown at `inside` or below it: the series that is wanted, or the usual one.
pub(super) fn choose(
    contents: &ArrayFile,
    path: &Path,
    inside: &str,
    choice: &Choice,
) -> Result<ArrayChoice, FormatError> {
    if inside == "/" {
        if let Some(image) = imaris::image(contents) {
            let image = image.map_err(malformed(path, "Imaris"))?;
            return Ok(ArrayChoice::Image(Box::new(image)));
        }
        let mut images = bdv::images(contents, choice.xml);
        if images.is_empty() {
            images = chimerax::images(contents);
        }
        if images.is_empty() {
            images = openpmd::images(contents);
        }
        if !images.is_empty() {
            return choose_image(images, path, choice.series);
        }
    }
    choose_array(contents, path, inside, choice)
}

/// Chooses one of several images: the one that is selected, or the largest.
fn choose_image(
    mut images: Vec<(String, ArrayImage)>,
    path: &Path,
    series: Option<u32>,
) -> Result<ArrayChoice, FormatError> {
    let largest = (0..images.len()).rev().max_by_key(|&i| images[i].1.num_voxels()).unwrap_or(0);
    let index = series.map_or(largest, |i| i as usize);
    let names: Vec<String> = images.iter().map(|(name, _)| name.clone()).collect();
    if index >= images.len() {
        return Err(not_there(path, "series", index as u64, images.len()));
    }
    let image = images.swap_remove(index).1;
    if names.len() == 1 {
        return Ok(ArrayChoice::Image(Box::new(image)));
    }
    let warning = series.is_none().then(|| {
        format!("the file has {} images, of which the largest is shown: {}", names.len(), names[index])
    });
    Ok(ArrayChoice::Image(Box::new(image.with_series(names, largest, warning))))
}

/// Chooses an array at `inside` or below it.
fn choose_array(
    contents: &ArrayFile,
    path: &Path,
    inside: &str,
    choice: &Choice,
) -> Result<ArrayChoice, FormatError> {
    let bad = malformed(path, FORMAT);
    let mut own = contents.inventory(inside, path, choice.cancel)?;
    dialects::tell(contents, &mut own.arrays);
    // Coordinates may be outside of the group.
    let whole = match inside {
        "/" => Inventory::default(),
        _ => contents.inventory("/", path, choice.cancel)?,
    };
    // An array that a link leads to has its path there too.
    let is_in_whole = |array: &Listed| whole.arrays.binary_search_by(|a| a.path.cmp(&array.path)).is_ok();
    let own_only = own.arrays.iter().filter(|array| !is_in_whole(array));
    let scales = Scales::of(&whole.arrays.iter().chain(own_only).collect::<Vec<_>>());
    let (outside, notes) = outside::arrays(&own.outside, path, choice)?;
    let (candidates, arrays) = candidates(&own.arrays, &outside, &scales);
    let volumes = VolumeCandidate::shown(&candidates);
    if volumes.is_empty() {
        return Err(bad(nothing_to_show(inside, &own.arrays, &scales, &notes)));
    }
    let usual = VolumeCandidate::usual(&candidates, &volumes);
    let names: Vec<String> = volumes.iter().map(|n| arrays[*n].0.description()).collect();
    let index = choice.series.map_or(usual, |i| i as usize);
    let Some(&number) = volumes.get(index) else {
        return Err(not_there(path, "series", index as u64, volumes.len()));
    };
    let (listed, outside) = arrays[number];
    let mut warnings: Vec<Warning> =
        notes.into_iter().take(MAX_NOTES).map(|text| Warning::new(WarningKind::Data, text)).collect();
    if names.len() > 1 && choice.series.is_none() {
        let is_first = candidates[number].standing == Standing::First;
        let what = if is_first { "the file's own choice" } else { "the largest" };
        let text = format!("the file has {} arrays, of which {what} is shown: {}", names.len(), names[index]);
        warnings.push(Warning::new(WarningKind::Choice, text));
    }
    let series = if names.len() > 1 { names } else { Vec::new() };
    let usual = usual as u32;
    if let Some(array) = outside {
        let (file, inside) = (array.file.clone(), array.inside.clone());
        return Ok(ArrayChoice::Outside { file, inside, series, usual, warnings });
    }
    let mut plan = array_plan::plan(contents, listed, &scales).map_err(bad)?;
    StorageForm::of(contents, listed).map_err(bad)?;
    plan.warnings.extend(warnings);
    (plan.series, plan.usual_series) = (series, usual);
    Ok(ArrayChoice::Array(Box::new(plan), listed.path.clone()))
}

/// The arrays that may be volumes, by their paths.
fn candidates<'a>(
    own: &'a [Listed],
    outside: &'a [OutsideArray],
    scales: &Scales,
) -> (Vec<VolumeCandidate>, Vec<ArrayOfFile<'a>>) {
    let own = own.iter().map(|listed| (listed, None));
    let outside = outside.iter().map(|array| (&array.listed, Some(array)));
    let mut all: Vec<ArrayOfFile> = own.chain(outside).collect();
    all.sort_by(|(a, _), (b, _)| a.path.cmp(&b.path));
    let sized = all.into_iter().filter_map(|(listed, outside)| {
        let sizes = array_plan::sizes(listed, scales).ok()?;
        let is_auxiliary = outside.is_none() && scales.is_auxiliary(listed);
        let standing = match listed.standing {
            Standing::Usual => Standing::of(is_auxiliary),
            told => told,
        };
        Some((VolumeCandidate { sizes, standing }, (listed, outside)))
    });
    sized.unzip()
}

/// Why nothing in a file is a volume. `notes` are those about links to other files.
fn nothing_to_show(inside: &str, own: &[Listed], scales: &Scales, notes: &[String]) -> String {
    if let Some(note) = notes.first() {
        return format!("it has no volume of its own: {note}");
    }
    if let [array] = own {
        return match array_plan::sizes(array, scales) {
            Err(problem) => problem,
            Ok(_) => format!("{} is not even a plane", array.description()),
        };
    }
    let listed = own.iter().take(MAX_NAMED).map(|array| array.description()).collect::<Vec<_>>().join(", ");
    match own.is_empty() {
        true if inside == "/" => "it has no arrays, expected a volume".into(),
        true => format!("it has no arrays at {}", quoted(inside)),
        false => format!(
            "it has no volume, expected an array of numbers with two or three axes in space; it has {listed}"
        ),
    }
}

/// Most arrays in a message.
const MAX_NAMED: usize = 8;
/// Most notes on links to other files.
const MAX_NOTES: usize = 4;
