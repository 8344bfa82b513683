//! The pages of a file, grouped by shape.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use ::tiff::decoder::{Decoder, Limits};
use ::tiff::tags::{PlanarConfiguration, SampleFormat, Tag, Type};
use ::tiff::{ColorType, TiffError};

use super::check;
use super::chunks::{PageChunks, byte_order};
use super::imagej;
use super::palette::Palette;
use super::shaped::Shaped;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, shown};
use crate::source::{OpenOptions, open_file};

pub(super) type PageDecoder = Decoder<BufReader<File>>;

/// The common properties of all pages of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct PageShape {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) samples: u16,
    pub(super) is_planar: bool,
    pub(super) dtype: Dtype,
    /// Whether the least number is white (MinIsWhite).
    pub(super) is_white: bool,
}

impl PageShape {
    pub(super) fn num_bytes(&self) -> u64 {
        let num_pixels = u64::from(self.width) * u64::from(self.height);
        num_pixels.saturating_mul(u64::from(self.samples) * self.dtype.num_bytes() as u64)
    }

    /// A description, such as `6×5×3 uint8`.
    pub(super) fn name(&self) -> String {
        let samples = if self.samples > 1 { format!("×{}", self.samples) } else { String::new() };
        format!("{}×{}{samples} {}", self.width, self.height, self.dtype.name())
    }
}

/// Pages of one shape that form a series.
#[derive(Clone, Debug)]
pub(super) struct Group {
    pub(super) shape: PageShape,
    pub(super) pages: Vec<u32>,
    /// The description by tifffile.
    pub(super) shaped: Option<Shaped>,
    /// Pixels per unit along x and y.
    pub(super) resolution: [Option<f64>; 2],
    pub(super) unit_mm: Option<f64>,
    /// Offset of the numbers of the first page, if they are plain and without gaps.
    pub(super) block: Option<u64>,
    /// The colours of its numbers.
    pub(super) palette: Option<Palette>,
}

pub(super) struct Scan {
    /// The supported pages in groups. The first group begins with the first page.
    pub(super) groups: Vec<Group>,
    pub(super) description: Option<String>,
    pub(super) endian: Endian,
    pub(super) num_other: usize,
    /// What ImageJ says about the channels.
    pub(super) imagej: Option<imagej::ImageJMetadata>,
}

impl Scan {
    /// Scans all pages of a file.
    pub(super) fn of(path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let mut decoder = decoder(path)?;
        let description = description(&mut decoder);
        if description.as_deref().is_some_and(|d| d.starts_with("Aperio")) {
            return Err(FormatError::Unsupported {
                path: shown(path),
                found: "a slide of a microscope (Aperio SVS)",
                expected: "a volume; `bfconvert -series N` makes a plain TIFF of one of its pictures",
            });
        }
        let endian = byte_order(&decoder);
        let imagej = imagej_metadata(&mut decoder, endian);
        let mut groups = vec![Group::here(&mut decoder, 0).map_err(|e| e.at(path, 0))?];
        let (mut page, mut num_other) = (0, 0);
        while decoder.more_images() && page < MAX_PAGES {
            page += 1;
            options.check_cancelled(path)?;
            match decoder.next_image() {
                Ok(()) => {}
                // The decoder has moved to the next page nevertheless.
                Err(TiffError::UnsupportedError(_)) => {
                    num_other += 1;
                    continue;
                }
                Err(e) => {
                    // A file that ends too early has lost most of its pages.
                    let problem = format!("page {page} and all behind it cannot be read: {}", one_line(&e));
                    return Err(FormatError::Data { path: shown(path), problem });
                }
            }
            let is_reduced = decoder.get_tag_u32(Tag::NewSubfileType).unwrap_or(0) & 1 == 1;
            let Some(shape) = page_shape(&mut decoder).ok().filter(|_| !is_reduced) else {
                num_other += 1;
                continue;
            };
            // tifffile describes the first page of each series.
            let shaped = description_of(&mut decoder, MAX_SHAPED_BYTES).and_then(|d| Shaped::of(&d));
            let is_first = shaped.is_some_and(|s| s.num_planes(&shape).is_some_and(|n| n > 1));
            let at = groups.iter().rposition(|g| g.shape == shape && !is_first);
            match at {
                Some(at) => groups[at].pages.push(page),
                None if groups.len() < MAX_GROUPS => match Group::here(&mut decoder, page) {
                    Ok(group) => groups.push(group),
                    Err(_) => num_other += 1,
                },
                None => num_other += 1,
            }
        }
        Ok(Self { groups, description, endian, num_other, imagej })
    }
}

impl Group {
    /// A description, such as `6×5 uint8, 4 pages`.
    pub(super) fn name(&self) -> String {
        let shaped = self.shaped.as_ref().and_then(|s| s.num_planes(&self.shape));
        let num_pages = shaped.unwrap_or(0).max(self.pages.len() as u64);
        format!("{}, {num_pages} page{}", self.shape.name(), if num_pages == 1 { "" } else { "s" })
    }

    /// A group of one page of the file at `path`.
    pub(super) fn of(path: &Path, page: u32) -> Result<Self, FormatError> {
        let mut decoder = decoder(path)?;
        decoder.seek_to_image(page as usize).map_err(|e| tiff_error(path, page, e))?;
        Self::here(&mut decoder, page).map_err(|e| e.at(path, page))
    }

    /// A group of the current page of the decoder.
    fn here(decoder: &mut PageDecoder, page: u32) -> Result<Self, PageError> {
        let shape = page_shape(decoder)?;
        let chunks = PageChunks::here(decoder, 0, &shape)?;
        let resolution =
            [Tag::XResolution, Tag::YResolution].map(|tag| decoder.get_tag(tag).ok().and_then(ratio));
        let unit_mm = match decoder.get_tag_u32(Tag::ResolutionUnit) {
            // Inches are for pictures on paper. Many writers put them there without knowing a size.
            Ok(3) => Some(10.0),
            _ => None,
        };
        Ok(Self {
            shape,
            pages: vec![page],
            shaped: description_of(decoder, MAX_SHAPED_BYTES).and_then(|d| Shaped::of(&d)),
            resolution,
            unit_mm,
            block: chunks.plain_block(&shape),
            palette: Palette::here(decoder),
        })
    }
}

fn imagej_metadata(decoder: &mut PageDecoder, endian: Endian) -> Option<imagej::ImageJMetadata> {
    let lengths = bytes_of(decoder, IMAGEJ_LENGTHS, MAX_IMAGEJ_BYTES)?;
    let number = |b: &[u8; 4]| match endian {
        Endian::Little => u32::from_le_bytes(*b),
        Endian::Big => u32::from_be_bytes(*b),
    };
    let lengths: Vec<u32> = lengths.as_chunks().0.iter().map(number).collect();
    imagej::ImageJMetadata::of(&bytes_of(decoder, IMAGEJ_METADATA, MAX_IMAGEJ_BYTES)?, &lengths)
}

/// Opens a decoder at the first page of the file at `path`.
pub(super) fn decoder(path: &Path) -> Result<PageDecoder, FormatError> {
    let mut file = open_file(path)?;
    let length = file.metadata().map_err(io_error(path))?.len();
    if !check::first_directory_fits(&mut file, length).map_err(io_error(path))? {
        let problem = format!("its first directory is not within {length} bytes, or has values that are not");
        return Err(malformed(path, "TIFF")(problem));
    }
    let mut limits = Limits::default();
    // A list is not longer than its file. In memory, a number of two bytes takes 32, as in a table of colours.
    limits.ifd_value_size = length.saturating_mul(16).min(MAX_LIST_BYTES) as usize;
    limits.decoding_buffer_size = limits.ifd_value_size;
    let decoder = Decoder::new(BufReader::new(file)).map_err(|e| tiff_error(path, 0, e))?;
    Ok(decoder.with_limits(limits))
}

/// The description of the current page, in any encoding.
pub(super) fn description(decoder: &mut PageDecoder) -> Option<String> {
    description_of(decoder, MAX_LIST_BYTES)
}

/// The same, unless it is longer than `most` bytes.
fn description_of(decoder: &mut PageDecoder, most: u64) -> Option<String> {
    let bytes = bytes_of(decoder, Tag::ImageDescription, most)?;
    let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    Some(String::from_utf8_lossy(&bytes[..end]).into_owned())
}

/// The bytes of a tag of the current page, as they are in the file, unless there are more than `most`.
fn bytes_of(decoder: &mut PageDecoder, tag: Tag, most: u64) -> Option<Vec<u8>> {
    let mut tags = decoder.image_ifd();
    let entry = tags.find_entry(tag)?;
    let length = entry.count().checked_mul(if entry.field_type() == Type::LONG { 4 } else { 1 })?;
    if length > most {
        return None;
    }
    let mut bytes = Vec::new();
    // The buffer grows with the data, because the length may be wrong.
    while (bytes.len() as u64) < length {
        let start = bytes.len();
        bytes.resize(length.min(2 * start as u64 + 4096) as usize, 0);
        let n = tags.find_tag_bytes(tag, &mut bytes[start..], start as u64).ok()??;
        if n < bytes.len() - start {
            return None;
        }
    }
    Some(bytes)
}

/// Why a page cannot be read.
pub(super) enum PageError {
    Tiff(TiffError),
    Kind(String),
}

impl PageError {
    pub(super) fn at(self, path: &Path, page: u32) -> FormatError {
        match self {
            Self::Tiff(e) => tiff_error(path, page, e),
            Self::Kind(problem) => malformed(path, &format!("TIFF page {page}"))(problem),
        }
    }
}

pub(super) fn page_shape(decoder: &mut PageDecoder) -> Result<PageShape, PageError> {
    let (width, height) = decoder.dimensions().map_err(PageError::Tiff)?;
    let photometric =
        decoder.find_tag_unsigned::<u32>(Tag::PhotometricInterpretation).map_err(PageError::Tiff)?;
    let is_white = photometric == Some(0);
    let (samples, bits) = if photometric == Some(PALETTE) {
        palette_sizes(decoder)?
    } else {
        let color = decoder.colortype().map_err(PageError::Tiff)?;
        match color {
            ColorType::YCbCr(_) | ColorType::CMYK(_) | ColorType::CMYKA(_) | ColorType::Lab(_) => {
                return Err(PageError::Kind(format!(
                    "colours are {color:?}, expected grey, RGB or channels"
                )));
            }
            color => (color.num_samples(), color.bit_depth()),
        }
    };
    let formats = decoder.find_tag_unsigned_vec::<u16>(Tag::SampleFormat).map_err(PageError::Tiff)?;
    let format = formats.and_then(|f| f.first().copied()).unwrap_or(1);
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
    let depth = decoder.find_tag_unsigned::<u32>(IMAGE_DEPTH).map_err(PageError::Tiff)?.unwrap_or(1);
    if depth > 1 {
        let problem = format!("ImageDepth is {depth}, expected 1: a slice in each page");
        return Err(PageError::Kind(problem));
    }
    let is_turnable = matches!(
        dtype,
        Dtype::Uint8 | Dtype::Uint16 | Dtype::Uint32 | Dtype::Uint64 | Dtype::Float | Dtype::Double
    );
    if is_white && !(is_turnable && samples == 1) {
        let name = dtype.name();
        let problem = format!(
            "the least number is white (MinIsWhite) of {samples} samples of type {name}, expected one without sign"
        );
        return Err(PageError::Kind(problem));
    }
    let planar = decoder.find_tag_unsigned::<u16>(Tag::PlanarConfiguration).map_err(PageError::Tiff)?;
    let is_planar =
        samples > 1 && planar.and_then(PlanarConfiguration::from_u16) == Some(PlanarConfiguration::Planar);
    if width == 0 || height == 0 || samples == 0 {
        return Err(PageError::Kind(format!(
            "{width}×{height} pixels of {samples} samples, expected at least one of each"
        )));
    }
    Ok(PageShape { width, height, samples, is_planar, dtype, is_white })
}

/// Numbers of a pixel and their bits, of a page with a table of colours.
fn palette_sizes(decoder: &mut PageDecoder) -> Result<(u16, u8), PageError> {
    let samples =
        decoder.find_tag_unsigned::<u16>(Tag::SamplesPerPixel).map_err(PageError::Tiff)?.unwrap_or(1);
    let bits = decoder.find_tag_unsigned_vec::<u8>(Tag::BitsPerSample).map_err(PageError::Tiff)?;
    if samples != 1 {
        return Err(PageError::Kind(format!("{samples} samples of a palette, expected one")));
    }
    Ok((samples, bits.and_then(|bits| bits.first().copied()).unwrap_or(1)))
}

/// A positive fraction as a number.
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

pub(super) fn tiff_error(path: &Path, page: u32, e: TiffError) -> FormatError {
    match e {
        TiffError::IoError(cause) if cause.kind() != std::io::ErrorKind::UnexpectedEof => {
            FormatError::Io { path: shown(path), cause }
        }
        e => FormatError::Data { path: shown(path), problem: format!("page {page}: {}", one_line(&e)) },
    }
}

/// A message of the decoder, on one short line.
fn one_line(e: &TiffError) -> String {
    isinglass_core::text::one_line(&e.to_string(), MAX_MESSAGE_CHARS)
}

/// ImageJ's tags for the lengths of blocks, and for the blocks.
const IMAGEJ_LENGTHS: Tag = Tag::Unknown(50838);
const IMAGEJ_METADATA: Tag = Tag::Unknown(50839);
/// Most bytes of what ImageJ says. It may have the labels of many slices.
const MAX_IMAGEJ_BYTES: u64 = 4 << 20;
/// The interpretation of numbers as places in a table of colours.
const PALETTE: u32 = 3;
/// SGI's tag for pages that are volumes.
const IMAGE_DEPTH: Tag = Tag::Unknown(32997);
/// Most pages of a file.
const MAX_PAGES: u32 = 1 << 17;
/// Most series of a file.
const MAX_GROUPS: usize = 64;
/// Longest list of strips or tiles, in bytes.
const MAX_LIST_BYTES: u64 = 8 << 20;
/// Longest description by tifffile. Each page may have one, with some text of the user.
const MAX_SHAPED_BYTES: u64 = 1 << 14;
/// Longest message of the decoder that is shown.
const MAX_MESSAGE_CHARS: usize = 200;
