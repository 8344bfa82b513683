//! Imaris 5.5 (`.ims`): an HDF5 file with levels of a pyramid, points in time and channels, each an array of its own.

use glam::DVec3;

use super::contents::{ArrayFile, Attributes};
use super::image::{ArrayImage, PartLevel, PartNames};
use super::storage::StorageForm;
use crate::axes::Geometry;
use crate::error::one_line;
use crate::plan::{Axis, ChannelLook, Plan};
use crate::units::{length_unit, time_step};

/// The image of a file of Imaris; `None` if it is none.
pub(super) fn image(contents: &ArrayFile) -> Option<Result<ArrayImage, String>> {
    let root = contents.attributes("/");
    let folder = |name: &str, usual: &str| {
        let told = root.as_ref().and_then(|root| root.text(name)).filter(|told| !told.trim().is_empty());
        told.map_or(usual.to_owned(), |told| told.trim().to_owned())
    };
    let data = folder("DataSetDirectoryName", "DataSet");
    let levels = contents.numbers_after(&format!("/{data}"), "ResolutionLevel ");
    let at_level = format!("/{data}/ResolutionLevel {}", levels.first()?);
    let times = contents.numbers_after(&at_level, "TimePoint ");
    let channels = contents.numbers_after(&format!("{at_level}/TimePoint {}", times.first()?), "Channel ");
    let names = PartNames::Imaris { root: data, levels, times, channels };
    let first = contents.array(&names.path(0, 0, 0)).ok()?;
    if first.shape.len() != 3 {
        return None;
    }
    let info = format!("/{}", folder("DataSetInfoDirectoryName", "DataSetInfo"));
    Some(read(contents, names, &info))
}

/// Reads what the file says of its image. `info` is the group that describes it.
fn read(contents: &ArrayFile, names: PartNames, info: &str) -> Result<ArrayImage, String> {
    let PartNames::Imaris { levels, times, channels, .. } = &names else { return Err("no image".into()) };
    let first = contents.array(&names.path(0, 0, 0))?;
    StorageForm::of(contents, &first)?;
    let (dtype, endian) = first.kind?;
    let num_levels = levels.len().min(MAX_LEVELS);
    let dims: Vec<[u64; 3]> =
        (0..num_levels).map(|level| dims(contents, &names, level)).collect::<Result<_, _>>()?;
    let (num_times, num_channels) = (times.len(), channels.len());
    let looks = channels.iter().map(|number| {
        let info = contents.attributes(&format!("{info}/Channel {number}"));
        let name = info.as_ref().and_then(|info| info.text("Name")).unwrap_or_default();
        (one_line(name.trim()), info.map(|info| look(&info)).unwrap_or_default())
    });
    let (channel_names, looks): (Vec<String>, Vec<ChannelLook>) = looks.unzip();
    let image = contents.attributes(&format!("{info}/Image"));
    let extent = image.as_ref().and_then(|image| extent(image));
    let unit = image.and_then(|image| length_unit(image.text("Unit")?.trim())).map(|(_, name)| name);
    let voxels = |dims: [u64; 3]| DVec3::from(dims.map(|n| n as f64));
    let (least, most) = extent.unwrap_or((DVec3::ZERO, voxels(dims[0])));
    let spacing = (most - least) / voxels(dims[0]);
    let unit = extent.map(|_| unit.unwrap_or("µm").to_owned());
    let mut geometry = Geometry::of_image(spacing.to_array(), unit);
    geometry.origin = extent.map(|_| least + spacing / 2.0);
    let mut plan = Plan::new("Imaris", dtype, endian, Axis::in_space(dims[0]), geometry);
    if extent.is_none() {
        plan.spacing_guess = Some("the image has no extent; its spacing was taken as 1".into());
    }
    if num_channels > 1 {
        plan.channel_names = channel_names;
    }
    plan.channel_looks = looks;
    plan.time_step = contents.attributes(&format!("{info}/TimeInfo")).and_then(|info| seconds_between(&info));
    let finest = voxels(dims[0]);
    let parts = dims.iter().map(|dims| PartLevel { dims: *dims, step: (finest / voxels(*dims)).to_array() });
    let parts: Vec<PartLevel> = parts.collect();
    Ok(ArrayImage::new(plan, (num_channels, num_times), parts, names).with_joint_channels())
}

/// The voxels of a level along x, y and z.
fn dims(contents: &ArrayFile, names: &PartNames, level: usize) -> Result<[u64; 3], String> {
    let array = contents.array(&names.path(level, 0, 0))?;
    let [z, y, x] = array.shape[..] else {
        return Err(format!("{} has {} axes, expected three", array.description(), array.shape.len()));
    };
    let group = contents.attributes(array.folder());
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
    // Where the corners are exchanged, the axis runs down.
    (most - least).cmpne(DVec3::ZERO).all().then_some((least, most))
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
