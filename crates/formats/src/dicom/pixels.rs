//! Decodes the pixel data of a frame: plain, run lengths (RLE), and lossy or lossless JPEG.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};

use jpeg_decoder::{Decoder, PixelFormat};

use super::frame::{Frame, Shape};

/// The coding of pixel data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Coding {
    Plain { is_big: bool },
    Rle,
    Jpeg,
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
            _ => {
                let name = match rest {
                    Some(".1.99") => "deflated",
                    Some(".4.80" | ".4.81") => "JPEG-LS",
                    Some(".4.90" | ".4.91" | ".4.92" | ".4.93") => "JPEG 2000",
                    Some(".4.201" | ".4.202" | ".4.203") => "HTJ2K",
                    Some(other) if other.starts_with(".4.10") => "video",
                    _ => "unknown",
                };
                return Err(format!(
                    "pixels are coded as {name} (transfer syntax {}), expected plain, RLE or JPEG",
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
        }
    }
}

/// The numbers of a frame as little-endian words of 8, 16 or 32 bits. The error says what is wrong.
pub(super) fn decode(file: &mut File, frame: &Frame, shape: &Shape) -> Result<Vec<u8>, String> {
    let packed = read(file, frame)?;
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
        Coding::Jpeg => jpeg(&packed, shape)?,
    };
    if bytes.len() < num_bytes {
        return Err(format!("a frame has {} bytes, expected {num_bytes}", bytes.len()));
    }
    bytes.truncate(num_bytes);
    keep_stored_bits(&mut bytes, shape);
    Ok(bytes)
}

/// The bytes of a frame as they are in the file.
fn read(file: &mut File, frame: &Frame) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    for &(offset, length) in &frame.parts {
        file.seek(SeekFrom::Start(offset)).map_err(|e| e.to_string())?;
        let n = Read::by_ref(file).take(length).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
        if (n as u64) < length {
            return Err(format!("pixel data end after {n} of {length} bytes"));
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
    let num_pixels = shape.num_pixels() as usize;
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

/// Decodes JPEG with one sample of 8 to 16 bits.
fn jpeg(packed: &[u8], shape: &Shape) -> Result<Vec<u8>, String> {
    let clean = |e: jpeg_decoder::Error| crate::error::quoted(&e.to_string());
    let mut decoder = Decoder::new(packed);
    decoder.set_max_decoding_buffer_size(shape.num_bytes() as usize + 16);
    decoder.read_info().map_err(|e| format!("JPEG: {}", clean(e)))?;
    let info = decoder.info().ok_or("JPEG without a header")?;
    let expected = if shape.bits_allocated == 8 { PixelFormat::L8 } else { PixelFormat::L16 };
    let is_narrow = info.pixel_format == PixelFormat::L8 && shape.bits_allocated == 16;
    if (info.width, info.height) != (shape.columns, shape.rows)
        || (info.pixel_format != expected && !is_narrow)
    {
        return Err(format!(
            "JPEG of {}×{} {:?}, expected {}×{} {expected:?}",
            info.width, info.height, info.pixel_format, shape.columns, shape.rows
        ));
    }
    let bytes = decoder.decode().map_err(|e| format!("JPEG: {}", clean(e)))?;
    Ok(match info.pixel_format {
        PixelFormat::L16 => {
            let native = bytes.as_chunks().0.iter();
            native.flat_map(|b| u16::from_ne_bytes(*b).to_le_bytes()).collect()
        }
        _ if is_narrow => bytes.into_iter().flat_map(|b| [b, 0]).collect(),
        _ => bytes,
    })
}

/// Moves the stored bits to the bottom of each word, and extends the sign.
fn keep_stored_bits(bytes: &mut [u8], shape: &Shape) {
    let (allocated, stored) = (u32::from(shape.bits_allocated), u32::from(shape.bits_stored));
    // The JPEG decoder returns the bits at the bottom.
    let low = if shape.coding == Coding::Jpeg { 0 } else { u32::from(shape.high_bit + 1) - stored };
    if stored == allocated {
        return;
    }
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
