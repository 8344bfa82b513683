//! OME-XML in the description of an OME-TIFF (ome-model, 2016-06): sizes, order and place of the planes, physical sizes.

use std::collections::HashMap;

use super::{Place, PlaneAxis, Stack};
use crate::error::quoted;
use crate::xml::{Tag, Tags};

/// Whether a description is OME-XML.
pub(super) fn is_ome(text: &str) -> bool {
    text.get(..text.len().min(4096)).or_else(|| text.get(..1000)).unwrap_or(text).contains("<OME")
}

/// One image of the file.
#[derive(Default)]
struct Image {
    name: String,
    pixels: Option<Tag>,
    channels: Vec<String>,
    data: Vec<TiffData>,
}

impl Image {
    /// A field of its pixels.
    fn get(&self, name: &str) -> Option<&str> {
        self.pixels.as_ref()?.get(name)
    }
}

/// Where some planes are.
struct TiffData {
    fields: Tag,
    file: Option<String>,
}

/// What `text`, in the file called `own_name`, says of an image, the first if no `series` is asked for. A pixel has `samples`
/// numbers.
pub(super) fn stack(text: &str, own_name: &str, samples: u64, series: Option<u32>) -> Result<Stack, String> {
    let images = parse(text)?;
    let index = series.unwrap_or(0) as usize;
    let image = images.get(index).ok_or_else(|| {
        format!("series {index} was asked for, expected 0 to {}", images.len().saturating_sub(1))
    })?;
    let size = |name: &str| match image.get(name) {
        None => Ok(1),
        Some(text) => {
            let size = text.parse::<u64>().ok().filter(|n| *n > 0);
            size.ok_or_else(|| format!("{name} is {}, expected a number of planes", quoted(text)))
        }
    };
    let (z, t) = (size("SizeZ")?, size("SizeT")?);
    let channels = size("SizeC")?;
    // Samples of a pixel are channels of the model; they share a plane.
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
    if num_planes > super::MAX_PLANES {
        return Err(format!("{num_planes} planes, expected at most {}", super::MAX_PLANES));
    }
    let mut other_files = Vec::new();
    let planes = planes(image, &axes, num_planes as usize, own_name, &mut other_files)?;
    let (spacing, unit) = spacing(image);
    let names = images.iter().map(|i| {
        let sizes = ["SizeX", "SizeY", "SizeZ"].map(|n| i.get(n).unwrap_or("?"));
        format!("{} {}", quoted(&i.name), sizes.map(|s| quoted(s).replace('"', "")).join("×"))
    });
    Ok(Stack {
        axes,
        spacing,
        unit,
        channel_names: image.channels.iter().map(|c| quoted(c).trim_matches('"').to_owned()).collect(),
        planes,
        other_files,
        series: if images.len() > 1 { names.collect() } else { Vec::new() },
        value_map: (1.0, 0.0),
        value_unit: None,
        name: "OME-TIFF",
    })
}

/// The page of each plane, if the elements say so.
fn planes(
    image: &Image,
    axes: &[(PlaneAxis, u64)],
    num_planes: usize,
    own_name: &str,
    other_files: &mut Vec<String>,
) -> Result<Option<Vec<Option<Place>>>, String> {
    let says_something = |d: &TiffData| d.fields.has_attributes() || d.file.is_some();
    if !image.data.iter().any(says_something) {
        return Ok(None);
    }
    // Files are known by their names; the one that was opened comes first, and is meant by any name if there is but one.
    let mut files: HashMap<&str, u32> = HashMap::from([(own_name, 0)]);
    let mut names: Vec<&str> = image.data.iter().filter_map(|d| d.file.as_deref()).collect();
    names.sort_unstable();
    names.dedup();
    if names.len() > MAX_FILES {
        return Err(format!("planes are in {} files, expected at most {MAX_FILES}", names.len()));
    }
    if let [only] = names[..] {
        files.insert(only, 0);
    }
    for name in names {
        if name.is_empty() || name.contains(['/', '\\', '\0']) {
            return Err(format!("a plane is in file {}, expected a name without folders", quoted(name)));
        }
        files.entry(name).or_insert_with(|| {
            other_files.push(name.to_owned());
            other_files.len() as u32
        });
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
        let file = data.file.as_deref().and_then(|name| files.get(name)).copied().unwrap_or(0);
        let end = start.saturating_add(count as usize).min(num_planes);
        let told = planes.get_mut(start..end).unwrap_or_default();
        num_told += told.len();
        if num_told > 4 * num_planes {
            return Err("the same planes are told many times over".into());
        }
        for (i, plane) in told.iter_mut().enumerate() {
            let page = page.unwrap_or(0).checked_add(i as u32).ok_or("IFD is too large")?;
            *plane = Some(Place { file, page });
        }
    }
    Ok(Some(planes))
}

/// Physical sizes in the unit of x.
fn spacing(image: &Image) -> ([Option<f64>; 3], Option<String>) {
    let get = |name: &str| image.get(name);
    let sizes = ["PhysicalSizeX", "PhysicalSizeY", "PhysicalSizeZ"]
        .map(|n| get(n).and_then(|v| v.parse::<f64>().ok()));
    // The model's unit is the micrometre where none is named.
    let units =
        ["PhysicalSizeXUnit", "PhysicalSizeYUnit", "PhysicalSizeZUnit"].map(|n| get(n).unwrap_or("µm"));
    let meters = units.map(meters);
    let Some(first) = meters[0] else { return (sizes, None) };
    let in_first = |i: usize| sizes[i].map(|s| s * meters[i].unwrap_or(first) / first);
    let unit = if units[0] == "μm" || units[0] == "um" { "µm" } else { units[0] };
    ([in_first(0), in_first(1), in_first(2)], Some(unit.to_owned()))
}

/// A unit of length in metres.
fn meters(unit: &str) -> Option<f64> {
    Some(match unit {
        "m" => 1.0,
        "cm" => 1e-2,
        "mm" => 1e-3,
        "µm" | "μm" | "um" => 1e-6,
        "nm" => 1e-9,
        "\u{c5}" | "\u{212b}" => 1e-10,
        "pm" => 1e-12,
        "in" => 0.0254,
        _ => return None,
    })
}

fn parse(text: &str) -> Result<Vec<Image>, String> {
    let mut tags = Tags::new(text.as_bytes());
    let mut images: Vec<Image> = Vec::new();
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
        let Some(image) = images.last_mut() else { continue };
        match tag.name.as_str() {
            "Pixels" => image.pixels = Some(tag),
            "Channel" => {
                let name = tag.get("Name").or_else(|| tag.get("ID")).unwrap_or_default();
                image.channels.push(name.to_owned());
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
    if images.is_empty() { Err("OME-XML has no Pixels".into()) } else { Ok(images) }
}

/// Elements of the description of one file: a few for each of its planes.
const MAX_ELEMENTS: usize = 1 << 20;
/// Files that one image is in.
const MAX_FILES: usize = 16_384;
