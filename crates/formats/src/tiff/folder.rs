//! The TIFF files of a folder: slices in the order of the numbers in their names, or a grid of slices, channels and
//! times by those names.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::names::{FileFacts, FileNames, NameGrid};
use super::page::{Group, Scan, decoder, page_shape};
use super::stack::{PlaneAxis, Stack, plan};
use super::{PageLocation, TiffFile, imagej, ome, set};
use crate::alike::alike;
use crate::error::{FormatError, malformed, not_there, quoted};
use crate::source::{OpenOptions, file_name};
use crate::warning::WarningKind;

/// Opens the files of the folder at `path`.
pub(super) fn open(files: Vec<PathBuf>, path: &Path, options: &OpenOptions) -> Result<TiffFile, FormatError> {
    let names: Vec<String> = files.iter().map(|file| file_name(file)).collect();
    let first = files.iter().take(MAX_TRIED).find_map(|file| Scan::of(file, options).ok());
    let found = first.as_ref().map(|first| {
        let group = &first.groups[0];
        let is_array =
            first.stack(group, true).is_ok_and(|(stack, _)| stack.num_planes().is_ok_and(|n| n > 1));
        let has_pages = group.pages.len() > 1 || is_array;
        FileNames::of(&names, FileFacts { has_pages, has_colors: group.shape.samples > 1 })
    });
    let note = match found {
        Some(Ok(found)) => match by_names(&found, &files, path, options)? {
            Some(file) => return Ok(file),
            None => {
                Some("the names do not fit the pages of the files, which are slices in their order".into())
            }
        },
        Some(Err(note)) => note,
        None => None,
    };
    let mut file = in_order(files, path, options)?;
    if let Some(text) = note {
        file.plan.warn(WarningKind::Guess, text);
    }
    Ok(file)
}

/// The files with the pages that most have, and what is said of the others.
fn alike_files(
    files: Vec<PathBuf>,
    path: &Path,
    options: &OpenOptions,
) -> Result<(Vec<PathBuf>, Option<String>), FormatError> {
    alike(files, |file| {
        options.check_cancelled(path)?;
        page_shape(&mut decoder(file)?).map_err(|e| e.at(file, 0))
    })
}

/// All pages of all files as slices.
fn in_order(files: Vec<PathBuf>, path: &Path, options: &OpenOptions) -> Result<TiffFile, FormatError> {
    let bad = malformed(path, "TIFF");
    let (files, left_out) = alike_files(files, path, options)?;
    if let Some(asked) = options.selection.series.filter(|asked| *asked > 0) {
        return Err(not_there(path, "series", asked.into(), 1));
    }
    let mut first = Scan::of(&files[0], options)?;
    let num_left: usize = first.groups[1..].iter().map(|g| g.pages.len()).sum();
    first.num_other += num_left;
    let group = first.groups.swap_remove(0);
    let mut stack = of_slices(&first, &group).map_err(bad)?;
    let mut planes = Vec::new();
    for (i, file) in files.iter().enumerate() {
        options.check_cancelled(path)?;
        let pages = pages_of(file, i, &group, options)?;
        planes.extend(pages.into_iter().map(|page| Some(PageLocation { file: i as u32, page })));
    }
    stack.axes = vec![(PlaneAxis::Z, planes.len() as u64)];
    stack.num_planes().map_err(bad)?;
    if stack.name == "TIFF" && files.len() > 1 {
        stack.in_files = ", a file for each slice";
    }
    let mut plan = plan(&group, &mut stack, first.endian).map_err(bad)?;
    if let Some(text) = left_out {
        plan.warn(WarningKind::Data, text);
    }
    if first.num_other > 0 {
        let text = format!("{} pages of another size or type were left out", first.num_other);
        plan.warn(WarningKind::Data, text);
    }
    let (shape, max_bytes) = (group.shape, options.max_bytes);
    Ok(TiffFile { plan, files, planes, shape, contiguous: None, max_bytes })
}

/// What the description of the first file says about each: distances, values and looks. All pages are slices.
fn of_slices(first: &Scan, group: &Group) -> Result<Stack, String> {
    let plain = Stack::plain(group);
    match first.description.as_deref() {
        Some(text) if ome::is_ome(text) => set::slices(text, group),
        Some(text) if imagej::is_imagej(text) => {
            let told = imagej::stack(text, group, first.imagej.as_ref());
            let channel_looks = if told.channel_looks.len() == 1 { told.channel_looks } else { Vec::new() };
            Ok(Stack {
                spacing: told.spacing,
                unit: told.unit,
                value_map: told.value_map,
                value_unit: told.value_unit,
                time_step: told.time_step,
                channel_looks,
                has_channels: true,
                ..plain
            })
        }
        _ => Ok(plain),
    }
}

/// The pages of file `i` that have the shape of `group`, which is that of the first file, or else those of its first
/// group. If the first file has one page, the others are expected to have one, too.
fn pages_of(file: &Path, i: usize, group: &Group, options: &OpenOptions) -> Result<Vec<u32>, FormatError> {
    if i == 0 || group.pages.len() == 1 {
        return Ok(group.pages.clone());
    }
    let scan = Scan::of(file, options)?;
    let alike = scan.groups.iter().find(|g| g.shape == group.shape).or(scan.groups.first());
    Ok(alike.map_or(Vec::new(), |g| g.pages.clone()))
}

/// The files as their names count them. `None` if that does not fit their pages.
fn by_names(
    names: &FileNames,
    files: &[PathBuf],
    path: &Path,
    options: &OpenOptions,
) -> Result<Option<TiffFile>, FormatError> {
    let bad = malformed(path, "TIFF");
    let series = names.series();
    let usual = (0..series.len()).max_by_key(|&i| (series[i].1, std::cmp::Reverse(i))).unwrap_or(0);
    let index = options.selection.series.map_or(usual, |i| i as usize);
    if index >= series.len() {
        return Err(not_there(path, "series", index as u64, series.len()));
    }
    let Some(grid) = names.grid(index) else { return Ok(None) };
    let own: Vec<PathBuf> = grid.files.iter().flatten().map(|i| files[*i].clone()).collect();
    let (kept, left_out) = alike_files(own, path, options)?;
    let mut first = Scan::of(&kept[0], options)?;
    let group = first.groups.swap_remove(0);
    let Some((mut stack, inner)) = described(&first, &group, &grid).map_err(bad)? else { return Ok(None) };
    let (planes, num_odd) = planes(&grid, files, &kept, (&group, inner), options)?;
    stack.num_planes().map_err(bad)?;
    let mut plan = plan(&group, &mut stack, first.endian).map_err(bad)?;
    let num_missing = planes.iter().filter(|plane| plane.is_none()).count();
    let num_others = names.num_left_out(files.len());
    let texts = [
        left_out,
        (num_others > 0)
            .then(|| format!("{num_others} files of the folder have other names and were left out")),
        (num_missing > 0)
            .then(|| format!("{num_missing} planes are in no file of the folder and are shown empty")),
        (num_odd > 0)
            .then(|| format!("{num_odd} files have more pages than the first one, which were left out")),
    ];
    texts.into_iter().flatten().for_each(|text| plan.warn(WarningKind::Data, text));
    if let Some(note) = &names.note {
        plan.warn(WarningKind::Guess, note.clone());
    }
    if series.len() > 1 {
        plan.series = series.iter().map(|(name, n)| format!("{}, {n} files", quoted(name))).collect();
        plan.usual_series = usual as u32;
        if options.selection.series.is_none() {
            let (count, name) = (series.len(), &plan.series[index]);
            let text = format!("the folder has {count} series, of which the largest is shown: {name}");
            plan.warn(WarningKind::Choice, text);
        }
    }
    let (shape, max_bytes) = (group.shape, options.max_bytes);
    Ok(Some(TiffFile { plan, files: kept, planes, shape, contiguous: None, max_bytes }))
}

/// The stack of a grid of files, and how many planes of each it takes. The description of the first file, or else its
/// pages, have the axes within a file. `None` if both count the same.
fn described(first: &Scan, group: &Group, grid: &NameGrid) -> Result<Option<(Stack, usize)>, String> {
    let [slices, channels, times] = grid.sizes.map(|n| n as u64);
    let outer = [(PlaneAxis::Z, slices), (PlaneAxis::Channel, channels), (PlaneAxis::Time, times)];
    let is_free = |axis: PlaneAxis| outer.iter().all(|(a, size)| *a != axis || *size == 1);
    let (mut stack, is_told) = first.stack(group, true)?;
    let inner = stack.num_planes()?;
    if inner != group.pages.len() as u64 {
        return Ok(None);
    }
    if stack.name == "TIFF" && !is_told {
        let own = of_slices(first, group)?;
        stack = Stack { axes: stack.axes, ..own };
    }
    stack.axes.retain(|(_, size)| *size > 1);
    // Pages of files that are slices themselves are channels or times.
    if let [(axis, _)] = &mut stack.axes[..]
        && !is_told
        && !is_free(*axis)
    {
        let Some(other) = [PlaneAxis::Channel, PlaneAxis::Time].into_iter().find(|axis| is_free(*axis))
        else {
            return Ok(None);
        };
        *axis = other;
        let what = other.name();
        stack.guess =
            Some(format!("the files are slices by their names, and so their pages were taken as {what}"));
    }
    if stack.axes.iter().any(|(axis, _)| !is_free(*axis)) {
        return Ok(None);
    }
    stack.axes.extend(outer.into_iter().filter(|(_, size)| *size > 1));
    if channels > 1 {
        stack.channel_names = grid.channels.clone();
        stack.channel_looks.clear();
        stack.has_channels = true;
    }
    stack.in_files =
        if channels > 1 || times > 1 { ", files of channels and times" } else { ", a file for each slice" };
    Ok(Some((stack, inner as usize)))
}

/// The planes of a grid, and how many files have more pages than `inner`. Files that were not `kept` have none.
fn planes(
    grid: &NameGrid,
    files: &[PathBuf],
    kept: &[PathBuf],
    (group, inner): (&Group, usize),
    options: &OpenOptions,
) -> Result<(Vec<Option<PageLocation>>, usize), FormatError> {
    let numbers: HashMap<&Path, usize> = kept.iter().enumerate().map(|(i, file)| (&**file, i)).collect();
    let (mut planes, mut num_odd) = (Vec::new(), 0);
    for file in &grid.files {
        let number = file.and_then(|i| numbers.get(&*files[i]));
        let pages = match number {
            Some(&i) => {
                options.check_cancelled(&kept[i])?;
                pages_of(&kept[i], i, group, options)?
            }
            None => Vec::new(),
        };
        num_odd += usize::from(pages.len() > inner);
        let location = |k: usize| Some(PageLocation { file: *number? as u32, page: *pages.get(k)? });
        planes.extend((0..inner).map(location));
    }
    Ok((planes, num_odd))
}

/// Most files that are tried for the first with pages.
const MAX_TRIED: usize = 8;
