//! PNG pictures as slices: one file, or the files of a folder in the order of the numbers in their names.

use std::io::BufReader;
use std::path::{Path, PathBuf};

use ::png::{BitDepth, ColorType, Decoder, Limits, Reader, Transformations};

use crate::alike::alike;
use crate::axes::Geometry;
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, malformed, one_line};
use crate::plan::{Axis, Plan, Role, VolumeFile};
use crate::source::{OpenOptions, open_file};
use crate::warning::WarningKind;

/// Files whose headers were read.
pub(crate) struct PngStack {
    plan: Plan,
    files: Vec<PathBuf>,
    shape: PictureShape,
}

/// The common properties of all pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct PictureShape {
    width: u32,
    height: u32,
    samples: u8,
    is_wide: bool,
}

impl PngStack {
    /// Opens the file or folder at `path` with these `files`, in order.
    pub(crate) fn open(files: Vec<PathBuf>, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let (files, left_out) = alike(files, |file| {
            options.check_cancelled(path)?;
            Ok(reader(file)?.1)
        })?;
        let shape = reader(&files[0])?.1;
        let channels = Axis {
            size: shape.samples.into(),
            role: if shape.samples > 1 { Role::Channel } else { Role::Single },
        };
        let mut axes = vec![channels];
        axes.extend(Axis::in_space([shape.width.into(), shape.height.into(), files.len() as u64]));
        let dtype = if shape.is_wide { Dtype::Uint16 } else { Dtype::Uint8 };
        let place = if files.len() > 1 { ", a file for each slice" } else { "" };
        let geometry = Geometry::of_image([1.0; 3], None);
        let mut plan = Plan::new(format!("PNG{place}"), dtype, Endian::Big, axes, geometry);
        match shape.samples {
            1 => {}
            2 => plan.channel_names = ["gray", "alpha"].map(str::to_owned).into(),
            _ => plan.set_colors(),
        }
        plan.spacing_guess = Some("PNG pictures have no spacing; it was taken as 1".into());
        if let Some(text) = left_out {
            plan.warn(WarningKind::Data, text);
        }
        if files.len() == 1 && !path.is_dir() {
            plan.warn(WarningKind::Data, "the file is one slice; its folder is a stack");
        }
        Ok(Self { plan, files, shape })
    }
}

impl VolumeFile for PngStack {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let PictureShape { width, height, samples, .. } = self.shape;
        let in_slice = u64::from(width) * u64::from(height) * u64::from(samples);
        for path in &self.files {
            if collector.is_done() {
                break;
            }
            if collector.gap() >= in_slice {
                collector.pass(in_slice);
                continue;
            }
            let (mut reader, found) = reader(path)?;
            let size = in_slice * collector.bytes_per_number();
            if found != self.shape
                || reader.output_buffer_size() != Some(size as usize)
                || size > MAX_BYTES as u64
            {
                return Err(collector.data_error(path, "the picture has changed, or is too large"));
            }
            let mut bytes = vec![0; size as usize];
            let problem = |e: ::png::DecodingError| collector.data_error(path, one_line(&e.to_string()));
            reader.next_frame(&mut bytes).map_err(problem)?;
            collector.push(&bytes)?;
        }
        Ok(())
    }
}

/// A reader at the first row of a picture. Palettes and less than 8 bits become plain numbers.
fn reader(path: &Path) -> Result<(Reader<BufReader<std::fs::File>>, PictureShape), FormatError> {
    let file = BufReader::new(open_file(path)?);
    let mut decoder = Decoder::new_with_limits(file, Limits { bytes: MAX_BYTES });
    decoder.set_transformations(Transformations::EXPAND);
    let bad = malformed(path, "PNG");
    let reader = decoder.read_info().map_err(|e| bad(one_line(&e.to_string())))?;
    let (color, depth) = reader.output_color_type();
    let samples = match color {
        ColorType::Grayscale | ColorType::Indexed => 1,
        ColorType::GrayscaleAlpha => 2,
        ColorType::Rgb => 3,
        ColorType::Rgba => 4,
    };
    let info = reader.info();
    let shape =
        PictureShape { width: info.width, height: info.height, samples, is_wide: depth == BitDepth::Sixteen };
    Ok((reader, shape))
}

/// Most bytes of a picture, and of what its decoder keeps.
const MAX_BYTES: usize = 1 << 30;
