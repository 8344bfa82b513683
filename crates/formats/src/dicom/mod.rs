//! DICOM: the series of a folder, or the frames of one file. Slices are sorted along their normal. Differences at one
//! position divide them into series and points in time. Uneven, missing and tilted slices are resampled. The frame is
//! LPS in millimetres.

mod divide;
mod element;
mod frame;
mod gaps;
mod keys;
mod mosaic;
mod pixels;
mod resample;
mod segmentation;
mod series;
mod shape;
mod slices;
mod tags;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use self::frame::{Contents, Scale, read_file};
use self::resample::Resampling;
use self::segmentation::Segmentation;
use self::series::{Series, Stacked};
use self::shape::Shape;
use self::slices::DicomSlices;
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, not_there, shown};
use crate::plan::{Axis, BoxLevel, ChannelLook, Plan, Role, VolumeFile};
use crate::planes::plane_level;
use crate::source::{OpenOptions, file_name, open_file};
use crate::warning::WarningKind;

/// A series whose headers were read.
struct DicomFiles {
    plan: Plan,
    slices: Arc<DicomSlices>,
    /// Most bytes of memory.
    max_bytes: u64,
}

/// Whether `start` begins a DICOM file. It needs the mark, or an element of group 8 or 2 at its start.
pub(crate) fn is_header(start: &[u8]) -> bool {
    let is_marked = start.get(128..132) == Some(b"DICM");
    let bare = |group: u8| {
        start.len() > 132 && start[..2] == [group, 0] && start[3] == 0 && start[6..8].contains(&0)
    };
    is_marked
        || (bare(8)
            && start[2] <= 0x18
            && (start[4..6].iter().all(u8::is_ascii_uppercase) || start[6..8] == [0, 0]))
}

/// Opens the file or folder at `path` with these `files`. Pictures come before segmentations.
pub(crate) fn open(
    files: Vec<PathBuf>,
    path: &Path,
    options: &OpenOptions,
) -> Result<Box<dyn VolumeFile>, FormatError> {
    let is_folder = path.is_dir();
    let (mut stacks, mut segmentations, mut left_out) = (Vec::new(), Vec::new(), LeftOut::default());
    for (i, file) in files.iter().enumerate() {
        options.check_cancelled(path)?;
        match read_file(open_file(file)?, i) {
            Ok(Contents::Stacks(found)) => stacks.extend(found),
            Ok(Contents::Segmentation(found)) => segmentations.push(*found),
            Ok(Contents::List) => left_out.has_list = true,
            Err(e) => {
                let problem = match e.kind() {
                    io::ErrorKind::InvalidData => e.to_string(),
                    io::ErrorKind::UnexpectedEof => "it ends within an element".to_owned(),
                    _ => return Err(io_error(file)(e)),
                };
                left_out.num += 1;
                left_out.first.get_or_insert_with(|| (file.clone(), problem));
            }
        }
    }
    let series = series::group(stacks);
    let names = series.iter().map(Series::name).chain(segmentations.iter().map(Segmentation::name));
    let names: Vec<String> = names.collect();
    let Some(usual) = (0..series.len())
        .max_by_key(|&i| (series[i].num_voxels(), std::cmp::Reverse(i)))
        .or((!segmentations.is_empty()).then_some(0))
    else {
        return Err(left_out.into_error(path));
    };
    let index = options.selection.series.map_or(usual, |i| i as usize);
    let is_lone_slice = !is_folder && names.len() == 1;
    let num_pictures = series.len();
    let mut file: Box<dyn DicomVolume> = if let Some(chosen) = series.into_iter().nth(index) {
        Box::new(DicomFiles::new(chosen, files, is_lone_slice, options))
    } else if let Some(chosen) = segmentations.into_iter().nth(index.saturating_sub(num_pictures)) {
        let path = files[chosen.file].clone();
        Box::new(chosen.into_file(path))
    } else {
        return Err(not_there(path, "series", index as u64, names.len()));
    };
    let plan = file.plan_mut();
    if names.len() > 1 {
        if options.selection.series.is_none() {
            let whole = if is_folder { "folder" } else { "file" };
            let text = format!(
                "the {whole} has {} series, of which the largest is shown: {}",
                names.len(),
                names[index]
            );
            plan.warn(WarningKind::Choice, text);
        }
        plan.series = names;
        plan.usual_series = usual as u32;
    }
    if let Some(text) = left_out.warning().filter(|_| is_folder) {
        plan.warn(WarningKind::Data, text);
    }
    Ok(file.into_volume_file())
}

/// The files that are neither slices nor segmentations.
#[derive(Default)]
struct LeftOut {
    num: usize,
    /// The first of them, and what is wrong with it.
    first: Option<(PathBuf, String)>,
    /// Whether a list of files (DICOMDIR) is there. It is not counted.
    has_list: bool,
}

impl LeftOut {
    /// The warning has only the name of the file, because remote viewers see it.
    fn warning(self) -> Option<String> {
        let (file, problem) = self.first?;
        let name = file_name(&file);
        Some(format!("{} files are no slices and were left out, the first: {name}: {problem}", self.num))
    }

    /// The error if nothing else is there.
    fn into_error(self, path: &Path) -> FormatError {
        match self.first {
            Some((file, problem)) => malformed(&file, "DICOM")(problem),
            None if self.has_list => FormatError::Unsupported {
                path: shown(path),
                found: "a list of files (DICOMDIR)",
                expected: "the folder that it lists",
            },
            None => malformed(path, "DICOM")("no slice was found".into()),
        }
    }
}

/// A volume of DICOM files, whose plan may get further notes.
trait DicomVolume: VolumeFile {
    fn plan_mut(&mut self) -> &mut Plan;
    fn into_volume_file(self: Box<Self>) -> Box<dyn VolumeFile>;
}

impl DicomVolume for DicomFiles {
    fn plan_mut(&mut self) -> &mut Plan {
        &mut self.plan
    }

    fn into_volume_file(self: Box<Self>) -> Box<dyn VolumeFile> {
        self
    }
}

impl DicomFiles {
    fn new(series: Series, files: Vec<PathBuf>, is_lone_slice: bool, options: &OpenOptions) -> Self {
        let shape = series.shape;
        let stacked = series.stack(options.reading.stored_slices);
        let Stacked { frames, num_slices, num_times, resampling, .. } = stacked;
        let scale = frames[0].scale.clone();
        let linear = match scale {
            Scale::Linear(slope, intercept) if frames.iter().all(|f| f.scale == scale) => {
                Some((slope, intercept))
            }
            _ => None,
        };
        let is_rescaled = linear.is_none();
        let dtype = if is_rescaled { Dtype::Float } else { shape.dtype() };
        let [columns, rows] = resampling
            .as_ref()
            .map_or([shape.columns, shape.rows].map(u64::from), |r| r.shown.map(|n| n as u64));
        let num_shown = resampling.as_ref().map_or(num_slices, Resampling::num_slices);
        let mut axes =
            vec![Axis { size: columns, role: Role::Space(0) }, Axis { size: rows, role: Role::Space(1) }];
        let samples = Axis {
            size: shape.samples.into(),
            role: if shape.samples > 1 { Role::Channel } else { Role::Single },
        };
        axes.insert(if shape.is_planar { 2 } else { 0 }, samples);
        axes.push(Axis { size: num_shown as u64, role: Role::Space(2) });
        axes.push(Axis { size: num_times as u64, role: Role::Time });
        let how = if resampling.is_some() { ", resampled" } else { "" };
        let format = format!("DICOM, {}{how}", shape.coding.name());
        let mut plan = Plan::new(format, dtype, Endian::Little, axes, stacked.geometry);
        plan.spacing_guess = stacked.spacing_guess;
        plan.modality = stacked.modality;
        plan.value_unit = stacked.value_unit.filter(|_| !shape.is_inverted);
        // Slices may have windows of their own. That in the middle of the stack stands for all.
        let window = frames.get(num_slices / 2).and_then(|frame| frame.window);
        if shape.samples == 1 {
            let window = window.filter(|_| !shape.is_inverted);
            plan.channel_looks = vec![ChannelLook { window, ..ChannelLook::default() }];
        }
        if shape.samples == 3 {
            plan.set_colors();
        }
        for (kind, text) in stacked.warnings {
            plan.warn(kind, text);
        }
        if let Some((slope, intercept)) = linear {
            let sum = if shape.is_inverted { inverted_sum(&shape) } else { 0.0 };
            let sign = if shape.is_inverted { -1.0 } else { 1.0 };
            plan.value_map = (sign * slope, slope * sum + intercept);
        }
        // Floats have no number where there is padding.
        if let Some((least, greatest)) = frames[0].padding.filter(|_| shape.samples == 1 && !is_rescaled) {
            let (scale, offset) = plan.value_map;
            let (a, b) = (scale * least + offset, scale * greatest + offset);
            if least == greatest {
                plan.missing.values.push(a);
            } else {
                plan.missing.ranges.push((a.min(b), a.max(b)));
            }
        }
        if shape.is_inverted {
            plan.warn(WarningKind::Values, "the least value is white (MONOCHROME1); values were inverted");
        }
        if is_rescaled {
            let text = if frames.iter().any(|f| matches!(f.scale, Scale::Table(..))) {
                "values come from a table (Modality LUT) and are kept as floats"
            } else {
                "slices have different rescale slopes; values are kept as floats"
            };
            plan.warn(WarningKind::Values, text);
        }
        if is_lone_slice && frames.len() == 1 {
            plan.warn(WarningKind::Data, "the file is one slice; its folder is a series");
        }
        let slices =
            DicomSlices::new(files, shape, frames, num_slices, resampling, (plan.dtype, is_rescaled));
        Self { plan, slices: Arc::new(slices), max_bytes: options.max_bytes }
    }
}

impl VolumeFile for DicomFiles {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        self.slices.check_size()?;
        let in_slice = self.plan.axes.iter().take(3).map(|axis| axis.size).product();
        for i in 0..self.slices.len() {
            if collector.is_done() {
                break;
            }
            if collector.gap() >= in_slice {
                collector.pass(in_slice);
                continue;
            }
            collector.push(&self.slices.slice(i)?)?;
        }
        Ok(())
    }

    fn data_files(&self) -> Vec<PathBuf> {
        self.slices.files().to_vec()
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        self.slices.check_size()?;
        plane_level(&self.plan, Arc::clone(&self.slices), self.max_bytes, path)
    }
}

/// Minus this, numbers are inverted: the least becomes the greatest.
fn inverted_sum(shape: &Shape) -> f64 {
    if shape.is_signed { -1.0 } else { 2f64.powi(shape.bits_stored.into()) - 1.0 }
}
