//! OME-XML in the description of an OME-TIFF (ome-model, 2016-06). It has sizes, order and location of the planes,
//! and physical sizes.

use std::collections::HashMap;

use super::PageLocation;
use super::stack::{MAX_PLANES, PlaneAxis, Stack};
use crate::error::quoted;
use crate::plan::ChannelLook;
use crate::units::{length_unit, time_step, time_unit};
use crate::xml::{Tags, XmlTag};

/// Whether a description is OME-XML.
pub(super) fn is_ome(text: &str) -> bool {
    text.get(..text.len().min(4096)).or_else(|| text.get(..1000)).unwrap_or(text).contains("<OME")
}

pub(super) struct Ome {
    images: Vec<Image>,
    /// Another file that contains the description.
    pub(super) metadata_file: Option<String>,
}

#[derive(Default)]
struct Image {
    name: String,
    pixels: Option<XmlTag>,
    channels: Vec<String>,
    looks: Vec<ChannelLook>,
    data: Vec<TiffData>,
}

impl Image {
    fn get(&self, name: &str) -> Option<&str> {
        self.pixels.as_ref()?.get(name)
    }

    /// Its sizes along x, y and z, and its numbers of channels and times above one.
    fn sizes(&self) -> String {
        let size = |n: &str| quoted(self.get(n).unwrap_or("?")).replace('"', "");
        let mut text = ["SizeX", "SizeY", "SizeZ"].map(size).join("×");
        for (name, what) in [("SizeC", "channels"), ("SizeT", "times")] {
            if self.get(name).is_some_and(|n| n != "1") {
                text.push_str(&format!(", {} {what}", size(name)));
            }
        }
        text
    }
}

pub(super) struct Files {
    /// Numbers of the files by name. 0 is the file that was opened.
    numbers: HashMap<String, u32>,
    /// Names of the other files, from number 1.
    pub(super) others: Vec<String>,
}

/// Location of some planes.
struct TiffData {
    fields: XmlTag,
    file: Option<String>,
}

impl TiffData {
    fn says_something(&self) -> bool {
        self.fields.has_attributes() || self.file.is_some()
    }
}

impl Ome {
    /// Parses `text`.
    pub(super) fn read(text: &str) -> Result<Self, String> {
        parse(text)
    }

    pub(super) fn num_images(&self) -> usize {
        self.images.len()
    }

    /// Whether an image is one slice.
    pub(super) fn is_slice(&self, index: usize) -> bool {
        let is_one = |name: &str| self.images.get(index).and_then(|i| i.get(name)).is_none_or(|n| n == "1");
        is_one("SizeZ") && is_one("SizeT")
    }

    /// The files of an image, as the file `own_name` lists them. `is_there` tells whether a file exists beside it.
    pub(super) fn files(
        &self,
        index: usize,
        own_name: &str,
        is_there: &dyn Fn(&str) -> bool,
    ) -> Result<Files, String> {
        let data = self.images.get(index).map_or(&[][..], |i| &i.data);
        let mut names: Vec<&str> = data.iter().filter_map(|d| d.file.as_deref()).collect();
        names.sort_unstable();
        names.dedup();
        if names.len() > MAX_FILES {
            return Err(format!("planes are in {} files, expected at most {MAX_FILES}", names.len()));
        }
        let mut files = Files { numbers: HashMap::from([(own_name.to_owned(), 0)]), others: Vec::new() };
        // A renamed file still lists its old name. It is used if no other file has that name.
        if let [only] = names[..]
            && !is_there(only)
        {
            files.numbers.insert(only.to_owned(), 0);
        }
        for name in names {
            if name.is_empty() || name.contains(['/', '\\', '\0']) {
                return Err(format!("a plane is in file {}, expected a name without folders", quoted(name)));
            }
            if !files.numbers.contains_key(name) {
                files.others.push(name.to_owned());
                files.numbers.insert(name.to_owned(), files.others.len() as u32);
            }
        }
        Ok(files)
    }

    /// The pages of an image, in the order of the description. There are none if the image follows its file.
    pub(super) fn places<'a>(
        &'a self,
        index: usize,
        files: &'a Files,
    ) -> impl Iterator<Item = PageLocation> + 'a {
        let data = self.images.get(index).map_or(&[][..], |i| &i.data);
        data.iter().filter(|d| d.says_something()).filter_map(|d| {
            let page = d.fields.get("IFD").map_or(Some(0), |n| n.parse().ok())?;
            Some(PageLocation { file: files.number(d), page })
        })
    }
}

impl Files {
    /// The number of the file that planes are in.
    fn number(&self, data: &TiffData) -> u32 {
        data.file.as_ref().and_then(|name| self.numbers.get(name)).copied().unwrap_or(0)
    }
}

/// The stack of an image. A pixel has `samples` numbers.
pub(super) fn stack(ome: &Ome, index: usize, files: &Files, samples: u64) -> Result<Stack, String> {
    let images = &ome.images;
    let image = images.get(index).ok_or("OME-XML has no such image")?;
    let size = |name: &str| match image.get(name) {
        None => Ok(1),
        Some(text) => {
            let size = text.parse::<u64>().ok().filter(|n| *n > 0);
            size.ok_or_else(|| format!("{name} is {}, expected a number of planes", quoted(text)))
        }
    };
    let (z, t) = (size("SizeZ")?, size("SizeT")?);
    let channels = size("SizeC")?;
    // Samples of a pixel are channels of the model, and share a plane.
    let planes_of_channels = if channels.is_multiple_of(samples) { channels / samples } else { channels };
    let order = image.get("DimensionOrder").unwrap_or("XYZCT");
    let axes: Vec<(PlaneAxis, u64)> = order
        .chars()
        .filter_map(|c| match c {
            'Z' => Some((PlaneAxis::Z, z)),
            'C' => Some((PlaneAxis::Channel, planes_of_channels)),
            'T' => Some((PlaneAxis::Time, t)),
            _ => None,
        })
        .collect();
    let has_each =
        [PlaneAxis::Z, PlaneAxis::Channel, PlaneAxis::Time].iter().all(|a| axes.iter().any(|x| x.0 == *a));
    if axes.len() != 3 || !has_each {
        return Err(format!("DimensionOrder is {}, expected an order such as XYZCT", quoted(order)));
    }
    let num_planes = axes.iter().try_fold(1u64, |n, a| n.checked_mul(a.1)).unwrap_or(u64::MAX);
    if num_planes > MAX_PLANES {
        return Err(format!("{num_planes} planes, expected at most {}", MAX_PLANES));
    }
    let planes = planes(image, &axes, num_planes as usize, files)?;
    let (spacing, unit) = spacing(image);
    let names = images.iter().map(|i| format!("{} {}", quoted(&i.name), i.sizes()));
    Ok(Stack {
        axes,
        spacing,
        unit,
        channel_names: image.channels.iter().map(|c| quoted(c).trim_matches('"').to_owned()).collect(),
        channel_looks: image.looks.clone(),
        has_channels: true,
        planes,
        series: if images.len() > 1 { names.collect() } else { Vec::new() },
        value_map: (1.0, 0.0),
        value_unit: None,
        time_step: interval(image),
        guess: None,
        name: "OME-TIFF",
        in_files: "",
    })
}

/// The page of each plane, if there are `TiffData` elements with content.
fn planes(
    image: &Image,
    axes: &[(PlaneAxis, u64)],
    num_planes: usize,
    files: &Files,
) -> Result<Option<Vec<Option<PageLocation>>>, String> {
    if !image.data.iter().any(TiffData::says_something) {
        return Ok(None);
    }
    let mut num_told = 0;
    let mut planes = vec![None; num_planes];
    for data in &image.data {
        let number = |name: &str| match data.fields.get(name) {
            None => Ok(None),
            Some(text) => {
                let n =
                    text.parse::<u32>().map_err(|_| format!("{name} is {}, expected a number", quoted(text)));
                n.map(Some)
            }
        };
        let (page, count) = (number("IFD")?, number("PlaneCount")?);
        let mut start = 0;
        let mut stride = 1;
        for (axis, size) in axes {
            let name = match axis {
                PlaneAxis::Z => "FirstZ",
                PlaneAxis::Channel => "FirstC",
                PlaneAxis::Time => "FirstT",
            };
            let first = u64::from(number(name)?.unwrap_or(0));
            start += stride * first.min(*size) as usize;
            stride *= *size as usize;
        }
        let count = count.unwrap_or(if page.is_some() || data.file.is_some() { 1 } else { u32::MAX });
        let file = files.number(data);
        let end = start.saturating_add(count as usize).min(num_planes);
        let told = planes.get_mut(start..end).unwrap_or_default();
        num_told += told.len();
        if num_told > 4 * num_planes {
            return Err("the same planes are listed many times".into());
        }
        for (i, plane) in told.iter_mut().enumerate() {
            let page = page.unwrap_or(0).checked_add(i as u32).ok_or("IFD is too large")?;
            *plane = Some(PageLocation { file, page });
        }
    }
    Ok(Some(planes))
}

/// Physical sizes, all in the unit of x.
fn spacing(image: &Image) -> ([Option<f64>; 3], Option<String>) {
    let get = |name: &str| image.get(name);
    let sizes = ["PhysicalSizeX", "PhysicalSizeY", "PhysicalSizeZ"]
        .map(|n| get(n).and_then(|v| v.parse::<f64>().ok()));
    // The default unit of the model is the micrometre.
    let units = ["PhysicalSizeXUnit", "PhysicalSizeYUnit", "PhysicalSizeZUnit"]
        .map(|n| length_unit(get(n).unwrap_or("µm")));
    let Some((meters, name)) = units[0] else { return (sizes, None) };
    let in_first = |i: usize| sizes[i].map(|s| s * units[i].map_or(1.0, |(own, _)| own / meters));
    ([in_first(0), in_first(1), in_first(2)], Some(name.to_owned()))
}

/// Seconds between the points in time. The default unit of the model is the second.
fn interval(image: &Image) -> Option<f64> {
    let unit = time_unit(image.get("TimeIncrementUnit").unwrap_or("s"))?;
    time_step(image.get("TimeIncrement")?.parse::<f64>().ok()? * unit)
}

fn parse(text: &str) -> Result<Ome, String> {
    let mut tags = Tags::new(text.as_bytes());
    let mut images: Vec<Image> = Vec::new();
    let mut metadata_file = None;
    let mut num_elements = 0;
    while let Some(tag) = tags.next().map_err(|e| format!("OME-XML: {e}"))? {
        num_elements += 1;
        if num_elements > MAX_ELEMENTS {
            return Err(format!("OME-XML has more than {MAX_ELEMENTS} elements"));
        }
        if tag.is_end {
            continue;
        }
        if tag.name == "Image" {
            images.push(Image { name: tag.get("Name").unwrap_or_default().to_owned(), ..Image::default() });
            continue;
        }
        if tag.name == "BinaryOnly" {
            metadata_file = tag.get("MetadataFile").map(str::to_owned);
        }
        let Some(image) = images.last_mut() else { continue };
        match tag.name.as_str() {
            "Pixels" => image.pixels = Some(tag),
            "Channel" => {
                let name = tag.get("Name").or_else(|| tag.get("ID")).unwrap_or_default();
                image.channels.push(name.to_owned());
                image
                    .looks
                    .push(ChannelLook { color: tag.get("Color").and_then(color), ..ChannelLook::default() });
            }
            "TiffData" => image.data.push(TiffData { fields: tag, file: None }),
            "UUID" => {
                if let (Some(data), Some(file)) = (image.data.last_mut(), tag.get("FileName")) {
                    data.file = Some(file.to_owned());
                }
            }
            _ => {}
        }
    }
    images.retain(|i| i.pixels.is_some());
    if images.is_empty() && metadata_file.is_none() {
        return Err("OME-XML has no Pixels".into());
    }
    Ok(Ome { images, metadata_file })
}

/// A colour, which the model writes as a signed number of red, green, blue and opacity.
fn color(text: &str) -> Option<[u8; 3]> {
    let number: i64 = text.trim().parse().ok()?;
    // Some writers leave out the sign.
    let bits = u32::try_from(number).ok().or_else(|| i32::try_from(number).ok().map(|n| n as u32))?;
    let [red, green, blue, _] = bits.to_be_bytes();
    Some([red, green, blue])
}

/// Most elements of a description. Each plane has a few.
const MAX_ELEMENTS: usize = 1 << 20;
/// Most files of an image.
const MAX_FILES: usize = 16_384;
