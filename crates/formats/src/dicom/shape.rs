//! What the frames of a volume have in common: their size, their numbers and their coding.

use super::element::DataSet;
use super::mosaic::Mosaic;
use super::pixels::Coding;
use super::tags;
use crate::dtype::Dtype;
use crate::error::quoted;

/// The common properties of all frames of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shape {
    pub(super) columns: u16,
    pub(super) rows: u16,
    /// Slices along each side of a mosaic; 1 if a picture is one slice.
    pub(super) tiles: u16,
    pub(super) samples: u16,
    /// Whether each sample has its own plane.
    pub(super) is_planar: bool,
    pub(super) bits_allocated: u16,
    pub(super) bits_stored: u16,
    pub(super) high_bit: u16,
    pub(super) is_signed: bool,
    pub(super) is_float: bool,
    /// Whether each byte of two has the place of the other, as big-endian words of 8-bit pixels have.
    pub(super) is_swapped: bool,
    /// Whether the least value is white (MONOCHROME1).
    pub(super) is_inverted: bool,
    pub(super) colors: Colors,
    pub(super) coding: Coding,
}

/// The meaning of samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Colors {
    Gray,
    Rgb,
    /// Brightness, blue and red, which become RGB.
    Ybr,
}

impl Shape {
    /// The error says what is wrong.
    pub(super) fn of(set: &DataSet, mosaic: Option<&Mosaic>) -> Result<Self, String> {
        let number = |tag, name: &str| set.fields.short(tag).ok_or_else(|| format!("{name} is missing"));
        let (rows, columns) = (number(tags::ROWS, "Rows")?, number(tags::COLUMNS, "Columns")?);
        let bits_allocated = number(tags::BITS_ALLOCATED, "BitsAllocated")?;
        let is_float = set.pixels.is_some_and(|p| p.is_float);
        let bits_stored = set.fields.short(tags::BITS_STORED).filter(|_| !is_float).unwrap_or(bits_allocated);
        let high_bit = set.fields.short(tags::HIGH_BIT).unwrap_or(bits_stored.wrapping_sub(1));
        let samples = set.fields.short(tags::SAMPLES_PER_PIXEL).unwrap_or(1);
        let photometric = set.fields.text(tags::PHOTOMETRIC).unwrap_or_default();
        let coding = Coding::of(&set.syntax)?;
        let colors = match (samples, photometric.as_str()) {
            (1, name) if !name.starts_with("PALETTE") => Some(Colors::Gray),
            (3, "RGB") => Some(Colors::Rgb),
            (3, "YBR_FULL") if bits_allocated == 8 => Some(Colors::Ybr),
            (3, name) if coding.has_own_colors() && name.starts_with("YBR") => Some(Colors::Ybr),
            _ => None,
        };
        let colors = colors.ok_or_else(|| {
            format!(
                "pixels are {} of {samples} samples of {bits_allocated} bits, {}; expected MONOCHROME1, MONOCHROME2, RGB, \
                 YBR_FULL of 8 bits, or YBR colours in JPEG",
                quoted(&photometric),
                coding.name()
            )
        })?;
        let is_good = if is_float {
            matches!(bits_allocated, 32 | 64) && samples == 1 && coding == Coding::Plain { is_big: false }
        } else {
            matches!(bits_allocated, 8 | 16 | 32)
                && (1..=bits_allocated).contains(&bits_stored)
                && (bits_stored - 1..bits_allocated).contains(&high_bit)
        };
        if !is_good || rows == 0 || columns == 0 {
            let kind = if is_float { "floats" } else { "integers" };
            return Err(format!(
                "{columns}×{rows} {kind} of {bits_stored} bits in {bits_allocated}, the highest {high_bit}; expected at least one pixel, integers in 8, 16 or 32 bits, or little-endian floats of 32 or 64"
            ));
        }
        let tiles = mosaic.map_or(1, |m| m.per_side);
        Ok(Self {
            columns: columns / tiles,
            rows: rows / tiles,
            tiles,
            samples,
            is_planar: samples > 1
                && match coding {
                    Coding::Rle => true,
                    Coding::Plain { .. } => set.fields.short(tags::PLANAR_CONFIGURATION) == Some(1),
                    _ => false,
                },
            bits_allocated,
            bits_stored,
            high_bit,
            is_signed: set.fields.short(tags::PIXEL_REPRESENTATION) == Some(1),
            is_float,
            is_swapped: bits_allocated == 8
                && coding == Coding::Plain { is_big: true }
                && set.pixels.is_some_and(|p| p.is_words),
            is_inverted: photometric == "MONOCHROME1",
            colors,
            coding,
        })
    }

    pub(super) fn dtype(&self) -> Dtype {
        match (self.bits_allocated, self.is_signed) {
            (64, _) => Dtype::Double,
            _ if self.is_float => Dtype::Float,
            (8, false) => Dtype::Uint8,
            (8, true) => Dtype::Int8,
            (16, false) => Dtype::Uint16,
            (16, true) => Dtype::Int16,
            (_, false) => Dtype::Uint32,
            (_, true) => Dtype::Int32,
        }
    }

    /// Columns and rows of a picture in the file.
    pub(super) fn picture(&self) -> [usize; 2] {
        [self.columns, self.rows].map(|n| usize::from(n) * usize::from(self.tiles))
    }

    /// Pixels of a slice.
    pub(super) fn num_pixels(&self) -> u64 {
        u64::from(self.columns) * u64::from(self.rows)
    }

    /// Bytes of a pixel, unpacked.
    pub(super) fn bytes_per_pixel(&self) -> usize {
        usize::from(self.samples) * usize::from(self.bits_allocated / 8)
    }

    /// Bytes of a picture in the file, unpacked.
    pub(super) fn num_bytes(&self) -> u64 {
        self.num_pixels() * u64::from(self.tiles).pow(2) * self.bytes_per_pixel() as u64
    }
}
