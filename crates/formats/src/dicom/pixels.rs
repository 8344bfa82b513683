//! Decodes the pixel data of a frame: plain, run lengths (RLE), JPEG, JPEG-LS and JPEG 2000.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};

use openreadout_codecs::{
    CodecError, JpegColor, Raster, jpeg_decode_tiff_limited, jpeg_markers, jpeg2000_decode_limited,
    jpegls_decode_limited,
};

use super::frame::Frame;
use super::shape::{Colors, Shape};

/// The coding of pixel data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Coding {
    Plain { is_big: bool },
    Rle,
    Jpeg,
    JpegLs,
    Jpeg2000,
}

impl Coding {
    /// The coding of a transfer syntax. The error names an unsupported one.
    pub(super) fn of(syntax: &str) -> Result<Self, String> {
        let rest = syntax.strip_prefix("1.2.840.10008.1.2");
        Ok(match rest {
            // A file without preamble has no transfer syntax.
            None if syntax.is_empty() => Self::Plain { is_big: false },
            Some("" | ".1") => Self::Plain { is_big: false },
            Some(".2") => Self::Plain { is_big: true },
            Some(".5") => Self::Rle,
            Some(".4.50" | ".4.51" | ".4.57" | ".4.70") => Self::Jpeg,
            Some(".4.80" | ".4.81") => Self::JpegLs,
            Some(".4.90" | ".4.91" | ".4.201" | ".4.202" | ".4.203") => Self::Jpeg2000,
            _ => {
                let name = match rest {
                    Some(".1.99") => "deflated",
                    Some(".4.92" | ".4.93") => "JPEG 2000 of several components",
                    Some(".4.110" | ".4.111" | ".4.112") => "JPEG XL",
                    Some(other) if other.starts_with(".4.10") => "video",
                    _ => "unknown",
                };
                return Err(format!(
                    "pixels are coded as {name} (transfer syntax {}), expected plain, RLE, JPEG, JPEG-LS or JPEG 2000",
                    crate::error::quoted(syntax)
                ));
            }
        })
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Plain { .. } => "plain",
            Self::Rle => "RLE",
            Self::Jpeg => "JPEG",
            Self::JpegLs => "JPEG-LS",
            Self::Jpeg2000 => "JPEG 2000",
        }
    }

    /// Whether the decoder returns red, green and blue.
    pub(super) fn has_own_colors(self) -> bool {
        matches!(self, Self::Jpeg | Self::Jpeg2000)
    }
}

/// The numbers of a picture as little-endian words of 8, 16, 32 or 64 bits. The error says what is wrong.
pub(super) fn decode(file: &mut File, frame: &Frame, shape: &Shape) -> Result<Vec<u8>, String> {
    let packed = read(file, frame, shape)?;
    let num_bytes = shape.num_bytes() as usize;
    let mut bytes = match shape.coding {
        Coding::Plain { is_big } => {
            let mut bytes = packed;
            if is_big {
                let size = usize::from(shape.bits_allocated / 8);
                bytes.chunks_exact_mut(size).for_each(<[u8]>::reverse);
            }
            bytes
        }
        Coding::Rle => run_lengths(&packed, shape)?,
        Coding::Jpeg | Coding::JpegLs | Coding::Jpeg2000 => packed_picture(&packed, shape)?,
    };
    if bytes.len() < num_bytes {
        return Err(format!("a frame has {} bytes, expected {num_bytes}", bytes.len()));
    }
    bytes.truncate(num_bytes);
    keep_stored_bits(&mut bytes, shape);
    if shape.colors == Colors::Ybr && !shape.coding.has_own_colors() {
        to_rgb(&mut bytes, shape.is_planar);
    }
    Ok(bytes)
}

/// One slice of a picture.
pub(super) fn tile(picture: &[u8], frame: &Frame, shape: &Shape) -> Vec<u8> {
    let tiles = usize::from(shape.tiles);
    let row_bytes = usize::from(shape.columns) * shape.bytes_per_pixel();
    let (across, down) = (frame.tile % tiles, frame.tile / tiles);
    let rows = picture.chunks_exact(row_bytes * tiles).skip(down * usize::from(shape.rows));
    let rows = rows.take(shape.rows.into());
    rows.flat_map(|row| &row[across * row_bytes..(across + 1) * row_bytes]).copied().collect()
}

/// The bytes of a frame as they are in the file.
fn read(file: &mut File, frame: &Frame, shape: &Shape) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    for &(start, length) in &frame.parts {
        // Words begin at even offsets.
        let (offset, end) = if shape.is_swapped {
            (start & !1, (start + length).next_multiple_of(2))
        } else {
            (start, start + length)
        };
        let length = end - offset;
        file.seek(SeekFrom::Start(offset)).map_err(|e| e.to_string())?;
        let n = Read::by_ref(file).take(length).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
        if (n as u64) < length {
            return Err(format!("pixel data end after {n} of {length} bytes"));
        }
        if shape.is_swapped {
            bytes.as_chunks_mut::<2>().0.iter_mut().for_each(|pair| pair.reverse());
            bytes.drain(..(start - offset) as usize);
        }
    }
    Ok(bytes)
}

/// Decodes run lengths (PS3.5, annex G). Each byte of a number and each sample has its own segment, the highest byte
/// first.
fn run_lengths(packed: &[u8], shape: &Shape) -> Result<Vec<u8>, String> {
    let word =
        |at: usize| packed.get(at..).and_then(|rest| rest.first_chunk()).map(|b| u32::from_le_bytes(*b));
    let size = usize::from(shape.bits_allocated / 8);
    let num_pixels = shape.picture().iter().product::<usize>();
    let num_segments = size * usize::from(shape.samples);
    if word(0) != Some(num_segments as u32) || num_segments > 15 {
        return Err(format!("{:?} segments of run lengths, expected {num_segments}", word(0).unwrap_or(0)));
    }
    if (packed.len() as u64).saturating_mul(MAX_RUN_RATIO) < shape.num_bytes() {
        return Err("run lengths are too short for the frame".into());
    }
    let mut bytes = vec![0; num_pixels * num_segments];
    for segment in 0..num_segments {
        let start = word(4 + 4 * segment).unwrap_or(0) as usize;
        let mut rest = packed.get(start.max(64)..).ok_or("a segment of run lengths begins after the end")?;
        let (sample, byte) = (segment / size, size - 1 - segment % size);
        // The samples are consecutive planes.
        let mut at = sample * num_pixels * size + byte;
        let end = (sample + 1) * num_pixels * size;
        while at < end {
            let (&control, after) = rest.split_first().ok_or("run lengths end early")?;
            let count = match control {
                0..=127 => usize::from(control) + 1,
                128 => 0,
                _ => 257 - usize::from(control),
            };
            let run = if control <= 127 { after.get(..count) } else { after.get(..1) };
            let run = run.ok_or("run lengths end early")?;
            for i in 0..count {
                if at >= end {
                    break;
                }
                bytes[at] = run[i % run.len()];
                at += size;
            }
            rest = &after[if control == 128 { 0 } else { run.len() }..];
        }
    }
    Ok(bytes)
}

/// Decodes JPEG, JPEG-LS and JPEG 2000.
fn packed_picture(packed: &[u8], shape: &Shape) -> Result<Vec<u8>, String> {
    let name = shape.coding.name();
    let clean = |e: CodecError| format!("{name}: {}", crate::error::one_line(&e.to_string()));
    let [columns, rows] = shape.picture();
    // Two bytes a number, as the decoders count.
    let most = 2 * columns * rows * usize::from(shape.samples);
    let raster = match shape.coding {
        Coding::JpegLs => jpegls_decode_limited(packed, most),
        Coding::Jpeg2000 => jpeg2000_decode_limited(packed, most),
        _ => {
            // Files often say RGB of colours that the JPEG itself marks as others.
            let marks = jpeg_markers(packed, None).map_err(clean)?;
            let is_marked = marks.jfif || marks.adobe_transform.is_some();
            let told = if shape.colors == Colors::Ybr { JpegColor::ToRgb } else { JpegColor::AsCoded };
            let color = marks.coded_color().filter(|_| is_marked).unwrap_or(told);
            jpeg_decode_tiff_limited(packed, None, color, most)
        }
    };
    let Raster { width, height, channels, bits_per_sample, data, .. } = raster.map_err(clean)?;
    let found = [width as usize, height as usize, channels as usize];
    let is_narrow = bits_per_sample == 8 && shape.bits_allocated == 16;
    let is_known = bits_per_sample == u32::from(shape.bits_allocated) || is_narrow;
    if found != [columns, rows, shape.samples.into()] || !is_known {
        let [width, height, samples] = found;
        return Err(format!(
            "{name} of {width}×{height} pixels with {samples} samples of {bits_per_sample} bits, expected {columns}×{rows} with {} of {}",
            shape.samples, shape.bits_allocated
        ));
    }
    Ok(if is_narrow { data.into_iter().flat_map(|b| [b, 0]).collect() } else { data })
}

/// Turns brightness, blue and red of 8 bits into red, green and blue (PS3.3, C.7.6.3.1.2).
fn to_rgb(bytes: &mut [u8], is_planar: bool) {
    let num_pixels = bytes.len() / 3;
    let (step, sample) = if is_planar { (1, num_pixels) } else { (3, 1) };
    for at in (0..num_pixels).map(|i| i * step) {
        let [y, blue, red] = [0, 1, 2].map(|k| f32::from(bytes[at + k * sample]));
        let (blue, red) = (blue - 128.0, red - 128.0);
        let rgb = [y + 1.402 * red, y - 0.344_136 * blue - 0.714_136 * red, y + 1.772 * blue];
        for (k, value) in rgb.into_iter().enumerate() {
            bytes[at + k * sample] = value.round() as u8;
        }
    }
}

/// Moves the stored bits to the bottom of each word, and extends the sign.
fn keep_stored_bits(bytes: &mut [u8], shape: &Shape) {
    let (allocated, stored) = (u32::from(shape.bits_allocated), u32::from(shape.bits_stored));
    // Decoders return the bits at the bottom.
    let is_raw = matches!(shape.coding, Coding::Plain { .. } | Coding::Rle);
    if stored == allocated {
        return;
    }
    let low = if is_raw { u32::from(shape.high_bit + 1) - stored } else { 0 };
    let keep = |word: u32| {
        let top = 32 - stored;
        let word = word >> low << top;
        if shape.is_signed { (word as i32 >> top) as u32 } else { word >> top }
    };
    match allocated {
        8 => bytes.iter_mut().for_each(|b| *b = keep((*b).into()) as u8),
        16 => bytes
            .as_chunks_mut()
            .0
            .iter_mut()
            .for_each(|b| *b = (keep(u16::from_le_bytes(*b).into()) as u16).to_le_bytes()),
        _ => bytes.as_chunks_mut().0.iter_mut().for_each(|b| *b = keep(u32::from_le_bytes(*b)).to_le_bytes()),
    }
}

/// Greatest ratio of run lengths: two bytes become 128.
const MAX_RUN_RATIO: u64 = 64;
