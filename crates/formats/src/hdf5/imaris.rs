//! Imaris 5.5 (`.ims`): an HDF5 file with levels of a pyramid, points in time and channels, each an array of its own.

use std::path::Path;

use glam::DVec3;
use isinglass_core::volume::MAX_CHANNELS;

use super::contents::{ArrayFile, Attributes};
use super::storage;
use crate::axes::Geometry;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, one_line};
use crate::levels::LevelGrid;
use crate::outline::Level;
use crate::plan::{Axis, ChannelLook, Plan, Role};
use crate::pyramid;
use crate::source::OpenOptions;
use crate::units::{length_unit, time_step};

/// The image of an Imaris file.
#[derive(Clone)]
pub(super) struct Imaris {
    /// Voxels of each level along x, y and z, without those that fill the last chunks.
    dims: Vec<[u64; 3]>,
    num_times: usize,
    dtype: Dtype,
    endian: Endian,
    /// The corners, and the unit of their coordinates.
    extent: Option<(DVec3, DVec3)>,
    unit: Option<&'static str>,
    /// Name and look of each channel.
    channels: Vec<(String, ChannelLook)>,
    /// Seconds from one point in time to the next.
    time_step: Option<f64>,
}

/// Whether the file is of Imaris.
pub(super) fn is_imaris(contents: &ArrayFile) -> bool {
    contents.array(&array_path(0, 0, 0)).is_ok_and(|array| array.shape.len() == 3)
}

/// The array of a level, a point in time and a channel.
pub(super) fn array_path(level: usize, time: usize, channel: usize) -> String {
    format!("/DataSet/ResolutionLevel {level}/TimePoint {time}/Channel {channel}/Data")
}

impl Imaris {
    /// Reads what the file says of its image.
    pub(super) fn read(contents: &ArrayFile) -> Result<Self, String> {
        let first = contents.array(&array_path(0, 0, 0))?;
        storage::check(&first)?;
        let (dtype, endian) = first.kind?;
        let num_levels = contents.num_numbered("/DataSet", "ResolutionLevel ").clamp(1, MAX_LEVELS);
        let num_times = contents.num_numbered("/DataSet/ResolutionLevel 0", "TimePoint ");
        let num_channels = contents.num_numbered("/DataSet/ResolutionLevel 0/TimePoint 0", "Channel ");
        let dims = (0..num_levels).map(|level| dims(contents, level)).collect::<Result<_, _>>()?;
        let channel = |i: usize| {
            let info = contents.attributes(&format!("/DataSetInfo/Channel {i}"));
            let name = info.as_ref().and_then(|info| info.text("Name")).unwrap_or_default();
            (one_line(name.trim()), info.as_ref().map(look).unwrap_or_default())
        };
        let info = contents.attributes("/DataSetInfo/Image");
        let times = contents.attributes("/DataSetInfo/TimeInfo");
        Ok(Self {
            dims,
            num_times,
            dtype,
            endian,
            extent: info.as_ref().and_then(extent),
            unit: info.and_then(|info| length_unit(info.text("Unit")?.trim())).map(|(_, name)| name),
            channels: (0..num_channels).map(channel).collect(),
            time_step: times.and_then(|info| seconds_between(&info)),
        })
    }

    /// The level that the options select, or that fits.
    pub(super) fn level(&self, path: &Path, options: &OpenOptions) -> Result<usize, FormatError> {
        let num_channels = match options.selection.channel {
            Some(_) => 1,
            None => self.channels.len().min(MAX_CHANNELS),
        };
        pyramid::level_to_show(path, &self.dims, num_channels as u64, self.dtype, options)
    }

    pub(super) fn plan(self, level: usize) -> Plan {
        let mut axes = Axis::in_space(self.dims[level]);
        axes.push(Axis { size: self.channels.len() as u64, role: Role::Channel });
        axes.push(Axis { size: self.num_times as u64, role: Role::Time });
        let voxels = |dims: [u64; 3]| DVec3::from(dims.map(|n| n as f64));
        let (least, most) = self.extent.unwrap_or((DVec3::ZERO, voxels(self.dims[0])));
        let spacing = |dims: [u64; 3]| ((most - least) / voxels(dims)).to_array();
        let own = spacing(self.dims[level]);
        let unit = self.extent.map(|_| self.unit.unwrap_or("µm").to_owned());
        let mut geometry = Geometry::of_image(own, unit);
        geometry.origin = self.extent.map(|(least, _)| least + DVec3::from(own) / 2.0);
        let mut plan = Plan::new("Imaris", self.dtype, self.endian, axes, geometry);
        if self.extent.is_none() {
            plan.spacing_guess = Some("the image has no extent; its spacing was taken as 1".into());
        }
        if self.channels.len() > 1 {
            plan.channel_names = self.channels.iter().map(|(name, _)| name.clone()).collect();
        }
        plan.channel_looks = self.channels.into_iter().map(|(_, look)| look).collect();
        plan.join_channels();
        plan.time_step = self.time_step;
        plan.level = level;
        if level > 0 {
            let step = (voxels(self.dims[0]) / voxels(self.dims[level])).to_array();
            // All levels have the corners of the image.
            let first = step.map(|step| (step - 1.0) / 2.0);
            pyramid::put_in_finest(&mut plan, LevelGrid { finest_dims: self.dims[0], step, first });
        }
        if self.dims.len() > 1 {
            let level = |dims: &[u64; 3]| Level { dims: *dims, spacing: spacing(*dims) };
            plan.levels = self.dims.iter().map(level).collect();
        }
        plan
    }
}

/// The voxels of a level along x, y and z.
fn dims(contents: &ArrayFile, level: usize) -> Result<[u64; 3], String> {
    let array = contents.array(&array_path(level, 0, 0))?;
    let [z, y, x] = array.shape[..] else {
        return Err(format!("{} has {} axes, expected three", array.description(), array.shape.len()));
    };
    let group = contents.attributes(array.path.trim_end_matches("/Data"));
    let told = |name: &str, stored: u64| {
        let number = group.as_ref().and_then(|group| group.text(name)?.trim().parse().ok());
        number.filter(|n| (1..=stored).contains(n)).unwrap_or(stored)
    };
    Ok([told("ImageSizeX", x), told("ImageSizeY", y), told("ImageSizeZ", z)])
}

/// The corners of the image; `None` if they are none.
fn extent(info: &Attributes) -> Option<(DVec3, DVec3)> {
    let numbers = |start: &str| -> Option<DVec3> {
        let number = |i: usize| {
            info.text(&format!("{start}{i}"))?.trim().parse::<f64>().ok().filter(|x| x.is_finite())
        };
        Some(DVec3::new(number(0)?, number(1)?, number(2)?))
    };
    let (least, most) = (numbers("ExtMin")?, numbers("ExtMax")?);
    least.cmplt(most).all().then_some((least, most))
}

/// The colour and the window of a channel.
fn look(info: &Attributes) -> ChannelLook {
    let numbers = |name: &str| -> Vec<f64> {
        let text = info.text(name).unwrap_or_default();
        text.split_whitespace().filter_map(|word| word.parse().ok()).filter(|x: &f64| x.is_finite()).collect()
    };
    let window = match numbers("ColorRange")[..] {
        [least, most] => Some((least, most)),
        _ => None,
    };
    let color = match numbers("Color")[..] {
        [r, g, b] => Some([r, g, b].map(|part| (part.clamp(0.0, 1.0) * 255.0).round() as u8)),
        _ => None,
    };
    ChannelLook { window, color, is_hidden: false }
}

/// Seconds between the first two points in time, which are dates and times such as `2012-04-13 18:27:51.734`.
fn seconds_between(info: &Attributes) -> Option<f64> {
    let of_day = |number: usize| {
        let text = info.text(&format!("TimePoint{number}"))?;
        let (day, time) = text.trim().split_once(' ')?;
        let parts: Vec<f64> = time.split(':').map(str::parse).collect::<Result<_, _>>().ok()?;
        match parts[..] {
            [hours, minutes, seconds] => Some((day.to_owned(), hours * 3600.0 + minutes * 60.0 + seconds)),
            _ => None,
        }
    };
    let ((day, first), (next_day, second)) = (of_day(1)?, of_day(2)?);
    let midnight = if day == next_day { 0.0 } else { 86_400.0 };
    // Times of one day, or of two that follow each other.
    time_step(second + midnight - first).filter(|step| *step < 86_400.0)
}

const MAX_LEVELS: usize = 64;
