//! TIFF: pages of one file (BigTIFF too) or the files of a folder are slices; ImageJ's and OME's descriptions say which of them
//! are channels and times, and how large a voxel is.

mod check;
mod imagej;
mod ome;

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use ::tiff::decoder::{Decoder, Limits};
use ::tiff::tags::{PlanarConfiguration, SampleFormat, Tag};
use ::tiff::{ColorType, TiffError};

use crate::axes::Geometry;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, shown};
use crate::plan::{Axis, Plan, Role, VolumeFile};
use crate::source::{OpenOptions, file_name, open_file};
use crate::stream::{Packing, Unpacked};
use crate::taker::Taker;
use crate::warning::WarningKind;

/// Files whose pages were looked at.
pub(crate) struct TiffFile {
    plan: Plan,
    files: Vec<PathBuf>,
    /// The page of each plane, in the order of the plan's axes; a plane without a page is empty.
    planes: Vec<Option<Place>>,
    shape: PageShape,
    /// Where planes lie one after the other without pages of their own.
    contiguous: Option<u64>,
    reader: Option<(u32, Decoder<BufReader<File>>)>,
}

/// A page: which file, and which of its pages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) file: u32,
    pub(super) page: u32,
}

/// What all pages of a volume have in common.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct PageShape {
    width: u32,
    height: u32,
    samples: u16,
    is_planar: bool,
    dtype: Dtype,
}

impl PageShape {
    fn num_bytes(&self) -> u64 {
        let num_pixels = u64::from(self.width) * u64::from(self.height);
        num_pixels.saturating_mul(u64::from(self.samples) * self.dtype.num_bytes() as u64)
    }
}

/// What the planes mean.
pub(super) struct Stack {
    /// Axes of the planes and how many there are along each, fastest first.
    pub(super) axes: Vec<(PlaneAxis, u64)>,
    /// Distances along x, y and z, as far as they are known.
    pub(super) spacing: [Option<f64>; 3],
    pub(super) unit: Option<String>,
    pub(super) channel_names: Vec<String>,
    /// The page of each plane, if they are not simply in order.
    pub(super) planes: Option<Vec<Option<Place>>>,
    /// Files that planes are in beside the first.
    pub(super) other_files: Vec<String>,
    pub(super) series: Vec<String>,
    /// What numbers mean: times the first, plus the second.
    pub(super) value_map: (f64, f64),
    /// Unit of the values.
    pub(super) value_unit: Option<String>,
    pub(super) name: &'static str,
}

/// What planes are counted along.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PlaneAxis {
    Z,
    Channel,
    Time,
}

/// What one file says.
struct Scan {
    shape: PageShape,
    /// Pages of that shape.
    pages: Vec<u32>,
    description: Option<String>,
    /// Pixels per unit along x and y, and the millimetres of the unit if it is one of length.
    resolution: [Option<f64>; 2],
    unit_mm: Option<f64>,
    first_offset: Option<u64>,
    is_plain: bool,
    endian: Endian,
    num_other: usize,
}

impl TiffFile {
    /// A file, or the files of a folder, each a slice or some. `path` is the file or the folder.
    pub(crate) fn open(
        mut files: Vec<PathBuf>,
        path: &Path,
        options: &OpenOptions,
    ) -> Result<Self, FormatError> {
        let bad =
            |problem: String| FormatError::Malformed { path: shown(path), format: "TIFF".into(), problem };
        let first = scan(&files[0], options)?;
        let shape = first.shape;
        let mut stack = match first.description.as_deref() {
            Some(text) if ome::is_ome(text) => {
                ome::stack(text, &file_name(&files[0]), u64::from(shape.samples), options.selection.series)
                    .map_err(bad)?
            }
            Some(text) if files.len() == 1 && imagej::is_imagej(text) => {
                imagej::stack(text, &first.resolution)
            }
            _ => plain_stack(&first),
        };
        let mut pages: Vec<Place> = first.pages.iter().map(|&page| Place { file: 0, page }).collect();
        if stack.name == "OME-TIFF" {
            files.truncate(1);
            let folder = files[0].parent().unwrap_or(Path::new("")).to_owned();
            files.extend(stack.other_files.iter().map(|name| folder.join(name)));
        } else {
            for (i, file) in files.iter().enumerate().skip(1) {
                options.check_cancelled(path)?;
                // Where the first file is one page, the others are expected to be.
                let count = if first.pages.len() == 1 { vec![0] } else { scan(file, options)?.pages };
                pages.extend(count.into_iter().map(|page| Place { file: i as u32, page }));
            }
        }
        let num_planes = stack.axes.iter().try_fold(1u64, |n, a| n.checked_mul(a.1));
        let mut num_planes = num_planes.filter(|n| (1..=MAX_PLANES).contains(n)).ok_or_else(|| {
            bad(format!("its description has {:?} planes, expected 1 to {MAX_PLANES}", stack.axes))
        })?;
        let is_contiguous =
            stack.name == "ImageJ TIFF" && pages.len() == 1 && num_planes > 1 && first.is_plain;
        let mut warnings = Vec::new();
        if !is_contiguous && stack.planes.is_none() && num_planes != pages.len() as u64 {
            if stack.name != "TIFF" {
                let found = pages.len();
                warnings.push(format!(
                    "the description has {num_planes} planes, the file {found}; they are read as slices"
                ));
            }
            num_planes = pages.len() as u64;
            stack.axes = vec![(PlaneAxis::Z, num_planes)];
            stack.channel_names.clear();
        }
        let mut plan = plan(&first, &mut stack, is_contiguous, files.len()).map_err(bad)?;
        if plan.axes.iter().filter(|a| a.role == Role::Channel && a.size > 1).count() > 1 {
            return Err(bad(format!(
                "{} samples a pixel in several channels, expected one or the other",
                shape.samples
            )));
        }
        for text in warnings {
            plan.warn(WarningKind::Data, text);
        }
        if first.num_other > 0 {
            let text = format!("{} pages of another size or type were left out", first.num_other);
            plan.warn(WarningKind::Data, text);
        }
        let planes = match stack.planes {
            Some(planes) => planes,
            None if is_contiguous => Vec::new(),
            None => pages.into_iter().take(num_planes as usize).map(Some).collect(),
        };
        let num_missing = planes.iter().filter(|p| p.is_none()).count();
        if num_missing > 0 {
            plan.warn(
                WarningKind::Data,
                format!("{num_missing} planes are not in the file and are shown empty"),
            );
        }
        let contiguous = first.first_offset.filter(|_| is_contiguous);
        Ok(Self { plan, files, planes, shape, contiguous, reader: None })
    }

    /// Decodes a page into `bytes`.
    fn decode(&mut self, place: Place, bytes: &mut [u8], taker: &Taker) -> Result<(), FormatError> {
        let path = &self.files[place.file as usize];
        if self.reader.as_ref().is_none_or(|(file, _)| *file != place.file) {
            self.reader = Some((place.file, decoder(path)?));
        }
        let Some((_, decoder)) = &mut self.reader else { return Ok(()) };
        let page = place.page;
        let error = |e: TiffError| tiff_error(path, page, e);
        decoder.seek_to_image(page as usize).map_err(error)?;
        let found = page_shape(decoder).map_err(|e| e.at(path, page))?;
        if found != self.shape {
            let name = |s: PageShape| format!("{}×{}×{} {}", s.width, s.height, s.samples, s.dtype.name());
            let problem = format!("page {page} is {}, expected {}", name(found), name(self.shape));
            return Err(taker.data_error(path, problem));
        }
        decoder.read_image_bytes(bytes).map_err(error)
    }
}

impl VolumeFile for TiffFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, taker: &mut Taker) -> Result<(), FormatError> {
        let path = self.files[0].clone();
        if let Some(offset) = self.contiguous {
            let num_bytes = taker.num_bytes();
            let data = Unpacked::open(open_file(&path)?, &path, offset, Some(num_bytes), Packing::Plain)?;
            return data.take(taker, &path, 0, num_bytes);
        }
        let plane_bytes = self.shape.num_bytes();
        let found = file_length(&path)?;
        if plane_bytes > MAX_PLANE_BYTES || plane_bytes > found.saturating_mul(MAX_LZW_RATIO) {
            return Err(taker.short(&path, plane_bytes, found, "bytes a page"));
        }
        let mut bytes = vec![0; plane_bytes as usize];
        let in_plane = plane_bytes / taker.bytes_per_number();
        for i in 0..self.planes.len() {
            if taker.is_done() {
                break;
            }
            if taker.gap() >= in_plane {
                taker.pass(in_plane);
                continue;
            }
            match self.planes[i] {
                Some(place) => self.decode(place, &mut bytes, taker)?,
                None => bytes.fill(0),
            }
            taker.push(&bytes)?;
        }
        Ok(())
    }
}

/// The plan of planes with this meaning.
fn plan(first: &Scan, stack: &mut Stack, is_contiguous: bool, num_files: usize) -> Result<Plan, String> {
    let PageShape { width, height, samples, is_planar, dtype } = first.shape;
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
        // A single channel beside samples is none.
        let role = if size == 1 && role == Role::Channel { Role::Single } else { role };
        axes.push(Axis { size, role });
    }
    if !axes.iter().any(|a| a.role == Role::Space(2)) {
        axes.push(Axis { size: 1, role: Role::Space(2) });
    }
    let endian = if is_contiguous { first.endian } else { NATIVE };
    let spacing = stack.spacing.map(|s| s.filter(|s| s.is_finite() && *s > 0.0));
    let in_plane = spacing[0].or(spacing[1]);
    let known = [in_plane, spacing[1].or(in_plane), spacing[2].or(in_plane)].map(|s| s.unwrap_or(1.0));
    let unit = stack.unit.take().filter(|_| in_plane.is_some());
    let place = if num_files > 1 && stack.name == "TIFF" { ", a file for each slice" } else { "" };
    let mut plan =
        Plan::new(format!("{}{place}", stack.name), dtype, endian, axes, Geometry::along_axes(known, unit));
    plan.channel_names = std::mem::take(&mut stack.channel_names);
    if plan.channel_names.is_empty() && matches!(samples.size, 3 | 4) {
        plan.channel_names =
            ["red", "green", "blue", "alpha"][..samples.size as usize].iter().map(|&s| s.into()).collect();
    }
    plan.series = std::mem::take(&mut stack.series);
    plan.value_map = stack.value_map;
    plan.value_unit = stack.value_unit.take();
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

/// Pages without a description: slices from the first to the last.
fn plain_stack(scan: &Scan) -> Stack {
    let spacing = |i: usize| scan.unit_mm.zip(scan.resolution[i]).map(|(mm, pixels)| mm / pixels);
    Stack {
        axes: vec![(PlaneAxis::Z, scan.pages.len() as u64)],
        spacing: [spacing(0), spacing(1), None],
        unit: scan.unit_mm.map(|_| "mm".to_owned()),
        channel_names: Vec::new(),
        planes: None,
        other_files: Vec::new(),
        series: Vec::new(),
        value_map: (1.0, 0.0),
        value_unit: None,
        name: "TIFF",
    }
}

fn file_length(path: &Path) -> Result<u64, FormatError> {
    Ok(std::fs::metadata(path).map_err(io_error(path))?.len())
}

fn decoder(path: &Path) -> Result<Decoder<BufReader<File>>, FormatError> {
    let mut file = open_file(path)?;
    let length = file.metadata().map_err(io_error(path))?.len();
    if !check::first_directory_fits(&mut file, length).map_err(io_error(path))? {
        let problem = format!("its first directory is not within {length} bytes, or has values that are not");
        return Err(FormatError::Malformed { path: shown(path), format: "TIFF".into(), problem });
    }
    let mut limits = Limits::default();
    // A list of strips is no longer than the file it is in.
    limits.ifd_value_size = length.min(MAX_LIST_BYTES) as usize;
    limits.decoding_buffer_size = limits.ifd_value_size;
    let decoder = Decoder::new(BufReader::new(file)).map_err(|e| tiff_error(path, 0, e))?;
    Ok(decoder.with_limits(limits))
}

/// Looks at all pages of a file.
fn scan(path: &Path, options: &OpenOptions) -> Result<Scan, FormatError> {
    let mut decoder = decoder(path)?;
    let shape = page_shape(&mut decoder).map_err(|e| e.at(path, 0))?;
    let description = description(&mut decoder);
    let resolution =
        [Tag::XResolution, Tag::YResolution].map(|tag| decoder.get_tag(tag).ok().and_then(ratio));
    let unit_mm = match decoder.get_tag_u32(Tag::ResolutionUnit) {
        // An inch stands for pictures on paper, and is what most writers put there who know nothing.
        Ok(3) => Some(10.0),
        _ => None,
    };
    let is_plain = decoder.get_tag_u32(Tag::Compression).unwrap_or(1) == 1;
    let first_offset = decoder.get_tag_u64_vec(Tag::StripOffsets).ok().and_then(|o| o.first().copied());
    let endian = match decoder.byte_order() {
        ::tiff::tags::ByteOrder::LittleEndian => Endian::Little,
        ::tiff::tags::ByteOrder::BigEndian => Endian::Big,
    };
    let (mut pages, mut num_other) = (vec![0], 0);
    let mut page = 0;
    while decoder.more_images() && page < MAX_PAGES {
        page += 1;
        options.check_cancelled(path)?;
        match decoder.next_image() {
            Ok(()) => {}
            // The decoder is at the page behind it all the same.
            Err(TiffError::UnsupportedError(_)) => {
                num_other += 1;
                continue;
            }
            Err(e) => {
                // A file that ends too early has lost most of what it says it has.
                let problem = format!("page {page} and all behind it cannot be read: {}", one_line(&e));
                return Err(FormatError::Data { path: shown(path), problem });
            }
        }
        let is_reduced = decoder.get_tag_u32(Tag::NewSubfileType).unwrap_or(0) & 1 == 1;
        match page_shape(&mut decoder) {
            Ok(found) if found == shape && !is_reduced => pages.push(page),
            _ => num_other += 1,
        }
    }
    Ok(Scan { shape, pages, description, resolution, unit_mm, first_offset, is_plain, endian, num_other })
}

/// The description of the page that the decoder is at, in whatever encoding.
fn description(decoder: &mut Decoder<BufReader<File>>) -> Option<String> {
    let mut tags = decoder.image_ifd();
    let length = tags.find_entry(Tag::ImageDescription)?.count();
    if length > MAX_LIST_BYTES {
        return None;
    }
    let mut bytes = Vec::new();
    // In parts, as the length may be a lie.
    while (bytes.len() as u64) < length {
        let start = bytes.len();
        bytes.resize(length.min(2 * start as u64 + 4096) as usize, 0);
        let n = tags.find_tag_bytes(Tag::ImageDescription, &mut bytes[start..], start as u64).ok()??;
        if n < bytes.len() - start {
            return None;
        }
    }
    let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    Some(String::from_utf8_lossy(&bytes[..end]).into_owned())
}

/// What is wrong with a page.
enum PageError {
    Tiff(TiffError),
    Kind(String),
}

impl PageError {
    fn at(self, path: &Path, page: u32) -> FormatError {
        match self {
            Self::Tiff(e) => tiff_error(path, page, e),
            Self::Kind(problem) => {
                FormatError::Malformed { path: shown(path), format: format!("TIFF page {page}"), problem }
            }
        }
    }
}

/// The shape of the page that the decoder is at.
fn page_shape(decoder: &mut Decoder<BufReader<File>>) -> Result<PageShape, PageError> {
    let (width, height) = decoder.dimensions().map_err(PageError::Tiff)?;
    let color = decoder.colortype().map_err(PageError::Tiff)?;
    let samples = match color {
        ColorType::YCbCr(_) | ColorType::CMYK(_) | ColorType::CMYKA(_) | ColorType::Lab(_) => {
            return Err(PageError::Kind(format!("colours are {color:?}, expected grey, RGB or channels")));
        }
        color => color.num_samples(),
    };
    let formats = decoder.find_tag_unsigned_vec::<u16>(Tag::SampleFormat).map_err(PageError::Tiff)?;
    let format = formats.and_then(|f| f.first().copied()).unwrap_or(1);
    let bits = color.bit_depth();
    let dtype = match (SampleFormat::from_u16(format), bits) {
        (Some(SampleFormat::Int), 8) => Dtype::Int8,
        (Some(SampleFormat::Int), 16) => Dtype::Int16,
        (Some(SampleFormat::Int), 32) => Dtype::Int32,
        (Some(SampleFormat::Int), 64) => Dtype::Int64,
        (Some(SampleFormat::IEEEFP), 16) => Dtype::Half,
        (Some(SampleFormat::IEEEFP), 32) => Dtype::Float,
        (Some(SampleFormat::IEEEFP), 64) => Dtype::Double,
        (Some(SampleFormat::Uint | SampleFormat::Void), 8) => Dtype::Uint8,
        (Some(SampleFormat::Uint | SampleFormat::Void), 16) => Dtype::Uint16,
        (Some(SampleFormat::Uint | SampleFormat::Void), 32) => Dtype::Uint32,
        (Some(SampleFormat::Uint | SampleFormat::Void), 64) => Dtype::Uint64,
        _ => {
            let problem =
                format!("{bits} bits of sample format {format}, expected numbers of 8, 16, 32 or 64 bits");
            return Err(PageError::Kind(problem));
        }
    };
    let planar = decoder.find_tag_unsigned::<u16>(Tag::PlanarConfiguration).map_err(PageError::Tiff)?;
    let is_planar =
        samples > 1 && planar.and_then(PlanarConfiguration::from_u16) == Some(PlanarConfiguration::Planar);
    if width == 0 || height == 0 || samples == 0 {
        return Err(PageError::Kind(format!("{width}×{height} pixels of {samples} samples, expected some")));
    }
    Ok(PageShape { width, height, samples, is_planar, dtype })
}

/// A fraction as a number above zero.
fn ratio(value: ::tiff::decoder::ifd::Value) -> Option<f64> {
    use ::tiff::decoder::ifd::Value;
    let number = match value {
        Value::Rational(a, b) => f64::from(a) / f64::from(b),
        Value::List(list) => return list.into_iter().next().and_then(ratio),
        Value::Float(x) => f64::from(x),
        Value::Double(x) => x,
        _ => return None,
    };
    Some(number).filter(|x| x.is_finite() && *x > 0.0)
}

fn tiff_error(path: &Path, page: u32, e: TiffError) -> FormatError {
    match e {
        TiffError::IoError(cause) if cause.kind() != std::io::ErrorKind::UnexpectedEof => {
            FormatError::Io { path: shown(path), cause }
        }
        e => FormatError::Data { path: shown(path), problem: format!("page {page}: {}", one_line(&e)) },
    }
}

/// A message of the decoder on one line, cut to a length that fits.
fn one_line(e: &TiffError) -> String {
    e.to_string().chars().map(|c| if c.is_control() { ' ' } else { c }).take(MAX_MESSAGE_CHARS).collect()
}

/// The files of a folder of slices in the order of the numbers in their names.
pub(crate) fn sort_by_number(files: &mut [PathBuf]) {
    files.sort_by_cached_key(|path| {
        let name = file_name(path);
        // Runs of digits become numbers, which are compared by length first.
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

/// The decoder gives numbers in the order of the machine.
const NATIVE: Endian = if cfg!(target_endian = "big") { Endian::Big } else { Endian::Little };
/// Pages of one file that are looked at.
const MAX_PAGES: u32 = 1 << 17;
/// Planes of one volume with all its channels and times.
const MAX_PLANES: u64 = 1 << 18;
/// The largest page that is decoded.
const MAX_PLANE_BYTES: u64 = 1 << 30;
/// The longest list of strips or tiles.
const MAX_LIST_BYTES: u64 = 8 << 20;
/// The longest string of LZW, 4096 bytes less the codes before it, in a code of twelve bits.
const MAX_LZW_RATIO: u64 = 2731;
/// Longest message of the decoder that is shown.
const MAX_MESSAGE_CHARS: usize = 200;

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
