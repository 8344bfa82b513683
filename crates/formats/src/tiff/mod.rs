//! TIFF and BigTIFF. Slices are the pages of one file, or the files of a folder. Descriptions by ImageJ and OME have
//! channels, times and the size of a voxel.

mod check;
mod flat;
mod imagej;
mod ome;

mod page;
mod set;
mod shaped;

use std::path::{Path, PathBuf};

use ::tiff::TiffError;

use self::flat::flat_planes;
use self::page::{Group, PageDecoder, PageShape, Scan, decoder, page_shape, tiff_error};
use self::shaped::Shaped;
use crate::alike::alike;
use crate::axes::Geometry;
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, not_there};
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{Axis, BoxLevel, ChannelLook, Plan, Role, VolumeFile};
use crate::source::{OpenOptions, file_name, open_file};
use crate::stream::{Packing, Unpacked};
use crate::warning::WarningKind;

/// Files whose pages were scanned.
pub(crate) struct TiffFile {
    plan: Plan,
    files: Vec<PathBuf>,
    /// The page of each plane, in the order of the plan's axes. A plane without a page is empty.
    planes: Vec<Option<PageLocation>>,
    shape: PageShape,
    /// Offset of planes that follow each other without pages.
    contiguous: Option<u64>,
    reader: Option<(u32, PageDecoder)>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct PageLocation {
    pub(super) file: u32,
    pub(super) page: u32,
}

/// The meaning of the planes.
pub(super) struct Stack {
    /// Axes of the planes and their sizes, the fastest first.
    pub(super) axes: Vec<(PlaneAxis, u64)>,
    /// Distances along x, y and z, as far as they are known.
    pub(super) spacing: [Option<f64>; 3],
    pub(super) unit: Option<String>,
    pub(super) channel_names: Vec<String>,
    pub(super) channel_looks: Vec<ChannelLook>,
    /// Whether the description calls its channels so. Otherwise, an axis is taken for one.
    pub(super) has_channels: bool,
    /// The page of each plane, unless they are in order.
    pub(super) planes: Option<Vec<Option<PageLocation>>>,
    /// Descriptions of the series of the file; empty if there is only one.
    pub(super) series: Vec<String>,
    /// Slope and intercept that turn numbers into values.
    pub(super) value_map: (f64, f64),
    pub(super) value_unit: Option<String>,
    /// Seconds from one point in time to the next.
    pub(super) time_step: Option<f64>,
    /// A warning about assumed axes.
    pub(super) guess: Option<String>,
    pub(super) name: &'static str,
}

/// An axis of the planes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PlaneAxis {
    Z,
    Channel,
    Time,
}

impl PlaneAxis {
    fn name(self) -> &'static str {
        match self {
            Self::Z => "z",
            Self::Channel => "channels",
            Self::Time => "times",
        }
    }
}

impl Stack {
    /// Pages without a description are slices, from the first to the last.
    fn plain(group: &Group) -> Self {
        let spacing = |i: usize| group.unit_mm.zip(group.resolution[i]).map(|(mm, pixels)| mm / pixels);
        Self {
            axes: vec![(PlaneAxis::Z, group.pages.len() as u64)],
            spacing: [spacing(0), spacing(1), None],
            unit: group.unit_mm.map(|_| "mm".to_owned()),
            channel_names: Vec::new(),
            channel_looks: Vec::new(),
            has_channels: false,
            planes: None,
            series: Vec::new(),
            value_map: (1.0, 0.0),
            value_unit: None,
            time_step: None,
            guess: None,
            name: "TIFF",
        }
    }

    /// Makes each of the `found` pages a slice, because the description has another number. Returns a warning.
    fn read_as_slices(&mut self, num_planes: u64, found: usize) -> String {
        self.axes = vec![(PlaneAxis::Z, found as u64)];
        self.channel_names.clear();
        self.channel_looks.clear();
        format!("the description has {num_planes} planes, the file {found}; they are read as slices")
    }

    /// Number of planes along all axes.
    fn num_planes(&self) -> Result<u64, String> {
        let num_planes = self.axes.iter().try_fold(1u64, |n, a| n.checked_mul(a.1));
        num_planes
            .filter(|n| (1..=MAX_PLANES).contains(n))
            .ok_or_else(|| format!("its description has {:?} planes, expected 1 to {MAX_PLANES}", self.axes))
    }
}

impl TiffFile {
    /// Opens a file, or the files of a folder, which contain one or more slices each. `path` is the file or the
    /// folder.
    pub(crate) fn open(files: Vec<PathBuf>, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, "TIFF");
        let mut files = files;
        let is_set = files.len() == 1
            || Scan::of(&files[0], options)
                .is_ok_and(|s| s.description.is_some_and(|text| ome::is_ome(&text)));
        let mut left_out = None;
        if !is_set {
            (files, left_out) = alike(files, |file| {
                options.check_cancelled(path)?;
                page_shape(&mut decoder(file)?).map_err(|e| e.at(file, 0))
            })?;
        }
        let mut first = Scan::of(&files[0], options)?;
        if let Some(text) = first.description.as_deref().filter(|text| ome::is_ome(text)) {
            let image = set::OmeSet::open(text, &files, path, options)?;
            if let Some(image) = image {
                return image.into_file(first, path, options);
            }
        }
        let num_series = if files.len() == 1 { first.groups.len() } else { 1 };
        let index = options.selection.series.unwrap_or(0) as usize;
        if index >= num_series {
            return Err(not_there(path, "series", index as u64, num_series));
        }
        let series: Vec<String> = first.groups[..num_series].iter().map(Group::name).collect();
        let num_left: usize = first.groups[num_series..].iter().map(|g| g.pages.len()).sum();
        first.num_other += num_left;
        let group = first.groups.swap_remove(index);
        let is_array = |s: &&Shaped| files.len() == 1 && s.num_planes(&group.shape).is_some_and(|n| n > 1);
        let shaped = group.shaped.as_ref().filter(is_array).map(|s| s.stack(&group));
        let is_described = shaped.is_some();
        let mut stack = match (first.description.as_deref(), shaped) {
            (_, Some(stack)) => stack.map_err(bad)?.unwrap_or_else(|| Stack::plain(&group)),
            (Some(text), _) if files.len() == 1 && index == 0 && imagej::is_imagej(text) => {
                imagej::stack(text, &group.resolution, first.imagej.as_ref())
            }
            (Some(text), _) if files.len() > 1 && ome::is_ome(text) => {
                set::slices(text, &group).map_err(bad)?
            }
            _ => Stack::plain(&group),
        };
        let mut pages: Vec<PageLocation> =
            group.pages.iter().map(|&page| PageLocation { file: 0, page }).collect();
        for (i, file) in files.iter().enumerate().skip(1) {
            options.check_cancelled(path)?;
            // If the first file has one page, the others are expected to have one, too.
            let others = if group.pages.len() == 1 { vec![0] } else { pages_like(file, &group, options)? };
            pages.extend(others.into_iter().map(|page| PageLocation { file: i as u32, page }));
        }
        let num_planes = stack.num_planes().map_err(bad)?;
        let is_truncated = group.shaped.as_ref().is_some_and(|s| s.is_truncated);
        let is_contiguous =
            (stack.name == "ImageJ TIFF" || is_truncated) && pages.len() == 1 && num_planes > 1;
        if is_contiguous && group.block.is_none() {
            return Err(bad(format!(
                "its description has {num_planes} planes, but there is one page, packed or in parts that lie apart; \
                 expected a page for each, or plain numbers one after the other"
            )));
        }
        let mut warnings = Vec::new();
        if !is_contiguous && num_planes != pages.len() as u64 {
            let text = stack.read_as_slices(num_planes, pages.len());
            if stack.name != "TIFF" || is_described {
                warnings.push((WarningKind::Data, text));
            }
            stack.guess = None;
        }
        if num_series > 1 {
            if options.selection.series.is_none() {
                warnings.push((WarningKind::Choice, several_series(&series)));
            }
            stack.series = series;
        }
        let mut plan =
            plan(&group, &mut stack, is_contiguous.then_some(first.endian), files.len()).map_err(bad)?;
        for (kind, text) in warnings {
            plan.warn(kind, text);
        }
        if let Some(text) = left_out {
            plan.warn(WarningKind::Data, text);
        }
        if first.num_other > 0 {
            let text = format!("{} pages of another size or type were left out", first.num_other);
            plan.warn(WarningKind::Data, text);
        }
        let planes = if is_contiguous { Vec::new() } else { pages.into_iter().map(Some).collect() };
        let contiguous = group.block.filter(|_| is_contiguous);
        Ok(Self { plan, files, planes, shape: group.shape, contiguous, reader: None })
    }

    /// Decodes a page into `bytes`.
    fn decode(
        &mut self,
        place: PageLocation,
        bytes: &mut [u8],
        collector: &Collector,
    ) -> Result<(), FormatError> {
        let path = &self.files[place.file as usize];
        if self.reader.as_ref().is_none_or(|(file, _)| *file != place.file) {
            if place.file > 0 && !path.exists() {
                return Err(collector.data_error(path, "the file is missing, which has some of the planes"));
            }
            self.reader = Some((place.file, decoder(path)?));
        }
        let Some((_, decoder)) = &mut self.reader else { return Ok(()) };
        let page = place.page;
        let error = |e: TiffError| tiff_error(path, page, e);
        decoder.seek_to_image(page as usize).map_err(error)?;
        let found = page_shape(decoder).map_err(|e| e.at(path, page))?;
        if found != self.shape {
            let problem = format!("page {page} is {}, expected {}", found.name(), self.shape.name());
            return Err(collector.data_error(path, problem));
        }
        decoder.read_image_bytes(bytes).map_err(error)
    }
}

/// The warning for a file with several series.
fn several_series(series: &[String]) -> String {
    let names = series.iter().take(MAX_NAMED).cloned().collect::<Vec<_>>().join("; ");
    format!("the file has {} series ({names}), of which 0 is shown", series.len())
}

/// The pages of another file in the folder that have the shape of `group`, or else those of its first group.
fn pages_like(file: &Path, group: &Group, options: &OpenOptions) -> Result<Vec<u32>, FormatError> {
    let scan = Scan::of(file, options)?;
    let alike = scan.groups.iter().find(|g| g.shape == group.shape).or(scan.groups.first());
    Ok(alike.map_or(Vec::new(), |g| g.pages.clone()))
}

impl VolumeFile for TiffFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let path = self.files[0].clone();
        if let Some(offset) = self.contiguous {
            let num_bytes = collector.num_bytes();
            let data = Unpacked::open(open_file(&path)?, &path, offset, Some(num_bytes), Packing::Plain)?;
            return data.take(collector, &path, 0, num_bytes);
        }
        let plane_bytes = self.shape.num_bytes();
        let found = file_length(&path)?;
        if plane_bytes > MAX_PLANE_BYTES || plane_bytes > found.saturating_mul(MAX_LZW_RATIO) {
            return Err(collector.short(&path, plane_bytes, found, "bytes a page"));
        }
        let mut bytes = vec![0; plane_bytes as usize];
        let in_plane = plane_bytes / collector.bytes_per_number();
        for i in 0..self.planes.len() {
            if collector.is_done() {
                break;
            }
            if collector.gap() >= in_plane {
                collector.pass(in_plane);
                continue;
            }
            match self.planes[i] {
                Some(place) => self.decode(place, &mut bytes, collector)?,
                None => bytes.fill(0),
            }
            collector.push(&bytes)?;
        }
        Ok(())
    }

    fn data_files(&self) -> Vec<PathBuf> {
        self.files.clone()
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        if let Some(offset) = self.contiguous {
            return flat_level(&self.plan, vec![FlatFile { path: self.files[0].clone(), offset }], path);
        }
        let (files, endian) = flat_planes(&self.files, &self.planes, self.shape, path)?;
        flat_level(&Plan { endian, ..self.plan.clone() }, files, path)
    }
}

/// The plan of a stack. `endian` is that of numbers that are not decoded.
fn plan(group: &Group, stack: &mut Stack, endian: Option<Endian>, num_files: usize) -> Result<Plan, String> {
    let PageShape { width, height, samples, is_planar, dtype } = group.shape;
    let samples = Axis { size: samples.into(), role: if samples > 1 { Role::Channel } else { Role::Single } };
    let mut axes = vec![
        Axis { size: width.into(), role: Role::Space(0) },
        Axis { size: height.into(), role: Role::Space(1) },
    ];
    axes.insert(if is_planar { 2 } else { 0 }, samples);
    for &(axis, size) in &stack.axes {
        let role = match axis {
            PlaneAxis::Z => Role::Space(2),
            PlaneAxis::Channel => Role::Channel,
            PlaneAxis::Time => Role::Time,
        };
        // A single channel beside samples has no meaning.
        let role = if size == 1 && role == Role::Channel { Role::Single } else { role };
        axes.push(Axis { size, role });
    }
    if !axes.iter().any(|a| a.role == Role::Space(2)) {
        axes.push(Axis { size: 1, role: Role::Space(2) });
    }
    if axes.iter().filter(|a| a.role == Role::Channel && a.size > 1).count() > 1 {
        return Err(format!(
            "{} samples a pixel in several channels, expected one or the other",
            group.shape.samples
        ));
    }
    let spacing = stack.spacing.map(|s| s.filter(|s| s.is_finite() && *s > 0.0));
    let in_plane = spacing[0].or(spacing[1]);
    let known = [in_plane, spacing[1].or(in_plane), spacing[2].or(in_plane)].map(|s| s.unwrap_or(1.0));
    let unit = stack.unit.take().filter(|_| in_plane.is_some());
    let place = if num_files > 1 && stack.name == "TIFF" { ", a file for each slice" } else { "" };
    let mut plan = Plan::new(
        format!("{}{place}", stack.name),
        dtype,
        endian.unwrap_or(NATIVE),
        axes,
        Geometry::of_image(known, unit),
    );
    plan.value_map = stack.value_map;
    plan.channel_names = std::mem::take(&mut stack.channel_names);
    if matches!(samples.size, 3 | 4) && plan.channel_names.len() as u64 != samples.size {
        plan.set_colors();
    } else if stack.has_channels {
        plan.channel_looks = std::mem::take(&mut stack.channel_looks);
        plan.join_channels();
    }
    plan.series = std::mem::take(&mut stack.series);
    if group.is_white {
        // The decoder inverts the numbers that it decodes.
        if endian.is_some() {
            let ((slope, intercept), most) = (plan.value_map, greatest(dtype));
            plan.value_map = (-slope, slope * most + intercept);
        }
        plan.warn(WarningKind::Values, "the least value is white (MinIsWhite); values were inverted");
    }
    if let Some(text) = stack.guess.take() {
        plan.warn(WarningKind::Guess, text);
    }
    plan.value_unit = stack.value_unit.take();
    plan.time_step = stack.time_step;
    let depth = stack.axes.iter().find(|a| a.0 == PlaneAxis::Z).map_or(1, |a| a.1);
    plan.spacing_guess = match (in_plane, spacing[2]) {
        (None, _) => Some("the file has no spacing; it was taken as 1".into()),
        (Some(_), None) if depth > 1 => {
            Some("the distance of the slices is not in the file; it was taken as that of the pixels".into())
        }
        _ => None,
    };
    Ok(plan)
}

/// The number of white after inversion: the greatest of an integer type, 1 of floats.
fn greatest(dtype: Dtype) -> f64 {
    dtype.integer_range().map_or(1.0, |(_, most)| most)
}

fn file_length(path: &Path) -> Result<u64, FormatError> {
    Ok(std::fs::metadata(path).map_err(io_error(path))?.len())
}

/// Sorts the files of a folder by the numbers in their names.
pub(crate) fn sort_by_number(files: &mut [PathBuf]) {
    files.sort_by_cached_key(|path| {
        let name = file_name(path);
        // Runs of digits are compared as numbers, first by length.
        let mut key = Vec::new();
        let mut rest = name.as_str();
        while let Some(first) = rest.chars().next() {
            let is_digit = first.is_ascii_digit();
            let end = rest.find(|c: char| c.is_ascii_digit() != is_digit).unwrap_or(rest.len());
            let word = &rest[..end];
            let number = word.trim_start_matches('0');
            key.push(if is_digit {
                (number.len(), number.to_owned())
            } else {
                (usize::MAX, word.to_owned())
            });
            rest = &rest[end..];
        }
        (key, name)
    });
}

/// The decoder returns numbers in the byte order of the machine.
const NATIVE: Endian = if cfg!(target_endian = "big") { Endian::Big } else { Endian::Little };
/// Most planes of a volume with all its channels and times.
const MAX_PLANES: u64 = 1 << 18;
/// Most series in a warning.
const MAX_NAMED: usize = 8;
/// Largest page in bytes.
const MAX_PLANE_BYTES: u64 = 1 << 30;
/// Greatest ratio of LZW: the longest string, 4096 bytes less the codes before it, in a code of twelve bits.
const MAX_LZW_RATIO: u64 = 2731;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_sorted_by_their_numbers() {
        let mut files: Vec<PathBuf> =
            ["b2.tif", "a10.tif", "a9.tif", "a010.tif", "a1_2.tif", "a1_10.tif"].map(PathBuf::from).into();
        sort_by_number(&mut files);
        let names: Vec<String> = files.iter().map(|p| file_name(p)).collect();
        assert_eq!(names, ["a1_2.tif", "a1_10.tif", "a9.tif", "a010.tif", "a10.tif", "b2.tif"]);
    }
}
