//! DICOM: the series of a folder, or the frames of one file. Slices are sorted along their normal. Differences at one
//! position divide them into series and points in time. The frame is LPS in millimetres.

mod divide;
mod element;
mod frame;
mod gaps;
mod keys;
mod pixels;
mod series;
mod tags;

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use self::frame::{FileStack, Frame, Shape};
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, not_there, shown};
use crate::plan::{Axis, Plan, Role, VolumeFile, color_names};
use crate::source::{OpenOptions, file_name, open_file};
use crate::warning::WarningKind;

/// A series whose headers were read.
pub(crate) struct DicomFiles {
    plan: Plan,
    files: Vec<PathBuf>,
    shape: Shape,
    /// Slices in the order of the plan: along the normal, then in time.
    frames: Vec<Frame>,
    /// Whether each slice has its own slope and intercept.
    is_rescaled: bool,
    open: Option<(usize, File)>,
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

impl DicomFiles {
    /// Opens the file or folder at `path` with these `files`.
    pub(crate) fn open(files: Vec<PathBuf>, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, "DICOM");
        let is_folder = path.is_dir();
        let (mut found, mut num_other, mut first_problem) = (Vec::new(), 0, None);
        let mut first_other = None;
        for (i, file) in files.iter().enumerate() {
            options.check_cancelled(path)?;
            match FileStack::read(open_file(file)?, i) {
                Ok(stacks) => found.extend(stacks),
                Err(e) => {
                    num_other += 1;
                    let problem = match e.kind() {
                        io::ErrorKind::InvalidData => e.to_string(),
                        io::ErrorKind::UnexpectedEof => "it ends within an element".to_owned(),
                        _ => return Err(io_error(file)(e)),
                    };
                    first_other.get_or_insert_with(|| (file_name(file), problem.clone()));
                    first_problem.get_or_insert(malformed(file, "DICOM")(problem));
                }
            }
        }
        let series = series::group(found);
        let Some(largest) = (0..series.len()).max_by_key(|&i| (series[i].num_voxels(), std::cmp::Reverse(i)))
        else {
            return Err(first_problem.unwrap_or_else(|| bad("no slice was found".into())));
        };
        let names: Vec<String> = series.iter().map(series::Series::name).collect();
        let num_series = names.len();
        let index = options.selection.series.map_or(largest, |i| i as usize);
        let chosen = series
            .into_iter()
            .nth(index)
            .ok_or_else(|| not_there(path, "series", index as u64, num_series))?;
        let shape = chosen.shape;
        let stacked = chosen.stack();
        let slope = (stacked.frames[0].slope, stacked.frames[0].intercept);
        let is_rescaled = stacked.frames.iter().any(|f| (f.slope, f.intercept) != slope);
        let dtype = match (shape.bits_allocated, shape.is_signed) {
            _ if is_rescaled => Dtype::Float,
            (8, false) => Dtype::Uint8,
            (8, true) => Dtype::Int8,
            (16, false) => Dtype::Uint16,
            (16, true) => Dtype::Int16,
            (_, false) => Dtype::Uint32,
            (_, true) => Dtype::Int32,
        };
        let mut axes = vec![
            Axis { size: shape.columns.into(), role: Role::Space(0) },
            Axis { size: shape.rows.into(), role: Role::Space(1) },
        ];
        let samples = Axis {
            size: shape.samples.into(),
            role: if shape.samples > 1 { Role::Channel } else { Role::Single },
        };
        axes.insert(if shape.is_planar { 2 } else { 0 }, samples);
        axes.push(Axis { size: stacked.num_slices as u64, role: Role::Space(2) });
        axes.push(Axis { size: stacked.num_times as u64, role: Role::Time });
        let format = format!("DICOM, {}", shape.coding.name());
        let mut plan = Plan::new(format, dtype, Endian::Little, axes, stacked.geometry);
        plan.spacing_guess = stacked.spacing_guess;
        plan.modality = stacked.modality;
        plan.value_unit = stacked.value_unit.filter(|_| !shape.is_inverted);
        if shape.samples == 3 {
            plan.channel_names = color_names(3);
        }
        for (kind, text) in stacked.warnings {
            plan.warn(kind, text);
        }
        if !is_rescaled {
            plan.value_map = value_map(&shape, slope);
        }
        if shape.is_inverted {
            plan.warn(WarningKind::Values, "the least value is white (MONOCHROME1); values were inverted");
        }
        if is_rescaled {
            plan.warn(WarningKind::Values, "slices have different rescale slopes; values are kept as floats");
        }
        if num_series > 1 {
            if options.selection.series.is_none() {
                let whole = if is_folder { "folder" } else { "file" };
                let text = format!(
                    "the {whole} has {} series, of which the largest is shown: {}",
                    num_series, names[index]
                );
                plan.warn(WarningKind::Choice, text);
            }
            plan.series = names;
            plan.usual_series = largest as u32;
        }
        if num_other > 0 && is_folder {
            // The warning has only the name of the file, because remote viewers see it.
            let first = first_other
                .map_or(String::new(), |(name, problem)| format!(", the first: {name}: {problem}"));
            plan.warn(WarningKind::Data, format!("{num_other} files are no slices and were left out{first}"));
        }
        if !is_folder && stacked.frames.len() == 1 && num_series == 1 {
            plan.warn(WarningKind::Data, "the file is one slice; its folder is a series");
        }
        Ok(Self { plan, files, shape, frames: stacked.frames, is_rescaled, open: None })
    }

    /// Decodes the numbers of a frame.
    fn decode(&mut self, index: usize) -> Result<Vec<u8>, FormatError> {
        let frame = &self.frames[index];
        let path = &self.files[frame.file];
        if self.open.as_ref().is_none_or(|(file, _)| *file != frame.file) {
            self.open = Some((frame.file, open_file(path)?));
        }
        let Some((_, file)) = &mut self.open else { return Ok(Vec::new()) };
        let bytes = pixels::decode(file, frame, &self.shape)
            .map_err(|problem| FormatError::Data { path: shown(path), problem })?;
        Ok(if self.is_rescaled { rescaled(&bytes, &self.shape, frame) } else { bytes })
    }
}

impl VolumeFile for DicomFiles {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        if self.shape.num_bytes() > MAX_FRAME_BYTES {
            let path = &self.files[0];
            return Err(collector.data_error(
                path,
                format!("a frame of {} bytes, expected at most {MAX_FRAME_BYTES}", self.shape.num_bytes()),
            ));
        }
        let in_frame = self.shape.num_pixels() * u64::from(self.shape.samples);
        for i in 0..self.frames.len() {
            if collector.is_done() {
                break;
            }
            if collector.gap() >= in_frame {
                collector.pass(in_frame);
            } else {
                collector.push(&self.decode(i)?)?;
            }
        }
        Ok(())
    }
}

/// Slope and intercept that turn numbers into values. The least value becomes the greatest if it is white.
fn value_map(shape: &Shape, (slope, intercept): (f64, f64)) -> (f64, f64) {
    if !shape.is_inverted {
        return (slope, intercept);
    }
    let sum = if shape.is_signed { -1.0 } else { 2f64.powi(shape.bits_stored.into()) - 1.0 };
    (-slope, slope * sum + intercept)
}

/// The values of a frame as floats.
fn rescaled(bytes: &[u8], shape: &Shape, frame: &Frame) -> Vec<u8> {
    let (slope, intercept) = value_map(shape, (frame.slope, frame.intercept));
    let value = |stored: f64| ((stored * slope + intercept) as f32).to_le_bytes();
    match (shape.bits_allocated, shape.is_signed) {
        (8, false) => bytes.iter().flat_map(|&b| value(b.into())).collect(),
        (8, true) => bytes.iter().flat_map(|&b| value((b as i8).into())).collect(),
        (16, false) => {
            bytes.as_chunks().0.iter().flat_map(|b| value(u16::from_le_bytes(*b).into())).collect()
        }
        (16, true) => bytes.as_chunks().0.iter().flat_map(|b| value(i16::from_le_bytes(*b).into())).collect(),
        (_, false) => bytes.as_chunks().0.iter().flat_map(|b| value(u32::from_le_bytes(*b).into())).collect(),
        (_, true) => bytes.as_chunks().0.iter().flat_map(|b| value(i32::from_le_bytes(*b).into())).collect(),
    }
}

/// Largest frame, decompressed.
const MAX_FRAME_BYTES: u64 = 1 << 30;
