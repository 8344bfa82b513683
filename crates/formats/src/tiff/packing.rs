//! How the bytes of strips and tiles are packed: LZW, deflate, PackBits and zstd, with predictors (TIFF 6.0, sections 9,
//! 13 and 14; Adobe's technical notes 2 and 3 on TIFF; libtiff's zstd).

use weezl::{BitOrder, LzwStatus, decode};

use crate::dtype::Endian;
use crate::error::quoted;
use crate::unpack::Codec;

/// The packing of a page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PagePacking {
    Plain,
    Lzw,
    PackBits,
    /// With a header of zlib.
    Deflate,
    Zstd,
}

impl PagePacking {
    /// The packing with this number. The error names another one.
    pub(super) fn of(number: u32) -> Result<Self, String> {
        let name = match number {
            1 => return Ok(Self::Plain),
            5 => return Ok(Self::Lzw),
            8 | 32_946 => return Ok(Self::Deflate),
            32_773 => return Ok(Self::PackBits),
            50_000 | 34_926 => return Ok(Self::Zstd),
            2..=4 => "fax",
            6 | 7 => "JPEG",
            33_003 | 33_004 | 33_005 | 34_712 => "JPEG 2000",
            34_925 => "LZMA",
            34_887 => "LERC",
            50_001 | 34_927 => "WebP",
            50_002 | 52_546 => "JPEG XL",
            _ => "an unknown code",
        };
        Err(format!(
            "pixels are packed as {name} (compression {number}), expected none, LZW, deflate, PackBits or zstd"
        ))
    }

    /// The `expected` bytes in `packed`. There may be less if it ends early.
    pub(super) fn unpack(self, packed: Vec<u8>, expected: usize) -> Result<Vec<u8>, String> {
        match self {
            Self::Plain => Ok(packed),
            Self::Lzw => lzw(&packed, expected),
            Self::PackBits => pack_bits(&packed, expected),
            Self::Deflate => Codec::Zlib.decode(&packed, expected),
            Self::Zstd => Codec::Zstd.decode(&packed, expected),
        }
    }
}

fn lzw(packed: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    if packed.len().saturating_mul(MAX_LZW_RATIO) < expected {
        return Err(format!("{} bytes of LZW cannot be {expected}", packed.len()));
    }
    let mut decoder = decode::Configuration::with_tiff_size_switch(BitOrder::Msb, 8).build();
    let (mut bytes, mut read, mut written) = (vec![0; expected], 0, 0);
    while written < expected {
        let result = decoder.decode_bytes(&packed[read..], &mut bytes[written..]);
        read += result.consumed_in;
        written += result.consumed_out;
        match result.status {
            Ok(LzwStatus::Ok) if result.consumed_in + result.consumed_out > 0 => {}
            Ok(_) => break,
            Err(e) => return Err(quoted(&e.to_string())),
        }
    }
    bytes.truncate(written);
    Ok(bytes)
}

fn pack_bits(packed: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    let (mut bytes, mut rest) = (Vec::new(), packed);
    while bytes.len() < expected {
        let Some((&head, after)) = rest.split_first() else { break };
        let used = match head {
            0..=127 => {
                let run = after.get(..usize::from(head) + 1).ok_or("PackBits ends within a run")?;
                bytes.extend_from_slice(run);
                run.len()
            }
            128 => 0,
            _ => {
                let byte = after.first().ok_or("PackBits ends within a run")?;
                bytes.extend(std::iter::repeat_n(*byte, 257 - usize::from(head)));
                1
            }
        };
        rest = &after[used..];
    }
    bytes.truncate(expected);
    Ok(bytes)
}

/// What was stored in place of the numbers of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Predictor {
    None,
    /// Differences of neighbours.
    Horizontal,
    /// Differences of the bytes of floats, all first bytes of a row before all second ones.
    Floats,
}

impl Predictor {
    /// The predictor with this number, for floats or others.
    pub(super) fn of(number: u32, are_floats: bool) -> Result<Self, String> {
        match number {
            1 => Ok(Self::None),
            2 => Ok(Self::Horizontal),
            3 if are_floats => Ok(Self::Floats),
            other => Err(format!("predictor {other}, expected 1, 2, or 3 for floats")),
        }
    }

    /// Turns `rows` of so many bytes into numbers in the order `to`. A number has `size` bytes, in the order `from`, and
    /// a pixel has `samples` numbers.
    pub(super) fn undo(
        self,
        rows: &mut [u8],
        row_bytes: usize,
        (samples, size): (usize, usize),
        (from, to): (Endian, Endian),
    ) {
        match self {
            Self::None => {}
            Self::Horizontal => {
                let add = match (size, from) {
                    (1, _) => add_bytes,
                    (2, Endian::Little) => add_words::<2, false>,
                    (2, Endian::Big) => add_words::<2, true>,
                    (4, Endian::Little) => add_words::<4, false>,
                    (4, Endian::Big) => add_words::<4, true>,
                    (_, Endian::Little) => add_words::<8, false>,
                    (_, Endian::Big) => add_words::<8, true>,
                };
                rows.chunks_exact_mut(row_bytes).for_each(|row| add(row, samples));
            }
            Self::Floats => {
                let mut numbers = vec![0; row_bytes];
                for row in rows.chunks_exact_mut(row_bytes) {
                    add_bytes(row, samples);
                    let count = row_bytes / size;
                    for (i, number) in numbers.chunks_exact_mut(size).enumerate() {
                        number.iter_mut().enumerate().for_each(|(k, byte)| *byte = row[k * count + i]);
                        if to == Endian::Little {
                            number.reverse();
                        }
                    }
                    row.copy_from_slice(&numbers);
                }
                return;
            }
        }
        if from != to && size > 1 {
            rows.chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
    }
}

/// Adds to each byte of a row the one that lies `step` before it.
fn add_bytes(row: &mut [u8], step: usize) {
    for i in step..row.len() {
        row[i] = row[i].wrapping_add(row[i - step]);
    }
}

/// Adds to each word of a row the one that lies `step` words before it.
fn add_words<const N: usize, const IS_BIG: bool>(row: &mut [u8], step: usize) {
    let words = row.as_chunks_mut::<N>().0;
    let number = |word: [u8; N]| {
        let mut wide = [0; 8];
        wide[..N].copy_from_slice(&word);
        if IS_BIG {
            wide[..N].reverse();
        }
        u64::from_le_bytes(wide)
    };
    for i in step..words.len() {
        let sum = number(words[i]).wrapping_add(number(words[i - step]));
        words[i].copy_from_slice(&sum.to_le_bytes()[..N]);
        if IS_BIG {
            words[i].reverse();
        }
    }
}

/// Greatest ratio of LZW: the longest string, 4096 bytes less the codes before it, in a code of twelve bits.
pub(super) const MAX_LZW_RATIO: usize = 2731;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_bytes_are_unpacked_and_bounded() {
        // The example of TIFF 6.0, section 9.
        let packed =
            [0xfe, 0xaa, 0x02, 0x80, 0x00, 0x2a, 0xfd, 0xaa, 0x03, 0x80, 0x00, 0x2a, 0x22, 0xf7, 0xaa];
        let bytes = [&[0xaa; 3][..], &[0x80, 0x00, 0x2a], &[0xaa; 4], &[0x80, 0x00, 0x2a, 0x22], &[0xaa; 10]]
            .concat();
        let unpacked = |packed: &[u8], most| PagePacking::PackBits.unpack(packed.to_vec(), most);
        assert_eq!(unpacked(&packed, 24), Ok(bytes.clone()));
        assert_eq!(unpacked(&packed, 5), Ok(bytes[..5].to_vec()));
        assert_eq!(unpacked(&packed, 99), Ok(bytes.clone()), "whoever asked for more is told");
        assert!(unpacked(&packed[..1], 24).is_err() && unpacked(&packed[..4], 24).is_err());
        let lzw = weezl::encode::Encoder::with_tiff_size_switch(BitOrder::Msb, 8).encode(&[7; 5000]).unwrap();
        assert_eq!(PagePacking::Lzw.unpack(lzw.clone(), 5000), Ok(vec![7; 5000]));
        assert_eq!(PagePacking::Lzw.unpack(lzw.clone(), 4000), Ok(vec![7; 4000]));
        assert!(PagePacking::Lzw.unpack(lzw.clone(), usize::MAX).is_err());
        assert!(PagePacking::Lzw.unpack(lzw[..40].to_vec(), 5000).unwrap().len() < 5000);
        assert!(PagePacking::of(7).unwrap_err().contains("JPEG (compression 7)"));
    }

    #[test]
    fn predictors_are_undone_in_both_orders() {
        use Endian::{Big, Little};
        let undone = |predictor: Predictor, row: &[u8], samples, size, orders| {
            let mut row = row.to_vec();
            let length = row.len();
            predictor.undo(&mut row, length, (samples, size), orders);
            row
        };
        let bytes = undone(Predictor::Horizontal, &[250, 1, 10, 1], 2, 1, (Little, Little));
        assert_eq!(bytes, [250, 1, 4, 2]);
        let row = [0xff, 0x00, 0x01, 0x00];
        assert_eq!(undone(Predictor::Horizontal, &row, 1, 2, (Little, Little)), [0xff, 0, 0, 1]);
        assert_eq!(undone(Predictor::Horizontal, &row, 1, 2, (Big, Big)), [0xff, 0, 0, 0]);
        assert_eq!(undone(Predictor::Horizontal, &row, 1, 2, (Big, Little)), [0, 0xff, 0, 0]);
        // 1.0 and 2.0 are 3f800000 and 40000000: 3f 40 | 80 00 | 00 00 | 00 00, as differences.
        let row = [0x3f, 0x01, 0x40, 0x80, 0, 0, 0, 0];
        let floats = [1f32.to_le_bytes(), 2f32.to_le_bytes()].concat();
        assert_eq!(undone(Predictor::Floats, &row, 1, 4, (Big, Little)), floats);
        assert!(Predictor::of(3, false).is_err() && Predictor::of(4, true).is_err());
    }
}
