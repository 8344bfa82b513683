//! The bytes of chunks: the codecs of Zarr and the filters of HDF5. Decoding gives no more bytes than it may. Only blosc
//! is also written.

mod bitshuffle;
pub(crate) mod blosc;
mod lzf;
mod shuffle;

use std::io::{self, Read};

use flate2::bufread::{MultiGzDecoder, ZlibDecoder};

use crate::error::quoted;

/// A codec for bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Codec {
    Gzip,
    Zlib,
    Zstd,
    Blosc,
    /// A block of LZ4 after its length.
    Lz4,
    /// Blocks of LZ4, each after its length, as the filter of HDF5 writes them.
    Lz4Blocks,
    Lzf,
    /// All first bytes of numbers of so many bytes, then all second ones.
    Shuffle(usize),
    /// The filter 32008 of HDF5: all first bits of numbers of `size` bytes, then all second ones, in blocks of so many
    /// numbers, each of which may be packed. Zero is the usual block.
    BitShuffle {
        size: u32,
        block: u32,
        packing: BitPacking,
    },
    /// A checksum of four bytes at the end, which is verified.
    Crc32c,
    /// Another such checksum, of HDF5.
    Fletcher32,
}

/// How the blocks of a bit shuffle are packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BitPacking {
    None,
    Lz4,
    Zstd,
}

impl Codec {
    /// Decodes to at most `most` bytes.
    pub(crate) fn decode(self, bytes: &[u8], most: usize) -> Result<Vec<u8>, String> {
        let error = |e: &dyn std::fmt::Display| quoted(&e.to_string());
        let mut out = Vec::new();
        let mut all = |reader: &mut dyn Read| -> io::Result<()> {
            reader.take(most as u64).read_to_end(&mut out).map(drop)
        };
        match self {
            Self::Gzip => all(&mut MultiGzDecoder::new(bytes)).map_err(|e| error(&e))?,
            Self::Zlib => all(&mut ZlibDecoder::new(bytes)).map_err(|e| error(&e))?,
            Self::Zstd => unpack_zstd(bytes, most, &mut out).map_err(|e| error(&e))?,
            Self::Blosc => out = blosc::decode(bytes, most)?,
            Self::Lz4 => {
                let (length, rest) = bytes.split_first_chunk().ok_or(EARLY)?;
                unpack_lz4(rest, (u32::from_le_bytes(*length) as usize).min(most), &mut out)?;
            }
            Self::Lz4Blocks => unpack_lz4_blocks(bytes, most, &mut out)?,
            Self::Lzf => lzf::decode(bytes, most, &mut out)?,
            Self::Shuffle(size) => out = shuffle::unshuffled(bytes, size.max(1)),
            Self::BitShuffle { size, block, packing } => {
                bitshuffle::decode(bytes, most, (size as usize, block as usize), packing, &mut out)?;
            }
            Self::Crc32c => {
                let (data, sum) = bytes.split_last_chunk().ok_or(EARLY)?;
                out = checked(data, crc32c(data) == u32::from_le_bytes(*sum))?;
            }
            Self::Fletcher32 => {
                let (data, sum) = bytes.split_last_chunk().ok_or(EARLY)?;
                let (found, [a, b, c, d]) = (fletcher32(data).to_le_bytes(), *sum);
                // Old versions of HDF5 swap bytes.
                out = checked(data, found == *sum || found == [b, a, d, c])?;
            }
        }
        Ok(out)
    }
}

fn checked(data: &[u8], is_good: bool) -> Result<Vec<u8>, String> {
    if is_good { Ok(data.to_vec()) } else { Err("its checksum does not match".into()) }
}

/// Decodes the frames in `packed` and appends at most `most` bytes to `out`. The window of a frame may have this
/// size, or the 8 MiB that every decoder should support (RFC 8878, section 3.1.1.1.2).
fn unpack_zstd(packed: &[u8], most: usize, out: &mut Vec<u8>) -> io::Result<()> {
    let mut decoder = zstd::Decoder::with_buffer(packed)?;
    decoder.window_log_max(most.clamp(LEAST_WINDOW_BYTES, MOST_WINDOW_BYTES).next_power_of_two().ilog2())?;
    decoder.take(most as u64).read_to_end(out).map(drop)
}

/// Decodes a block of LZ4 and appends at most `most` bytes to `out`.
fn unpack_lz4(packed: &[u8], most: usize, out: &mut Vec<u8>) -> Result<(), String> {
    let start = out.len();
    // LZ4 packs at most 255 bytes into one.
    out.resize(start + most.min(packed.len().saturating_mul(256)), 0);
    let n =
        lz4_flex::block::decompress_into(packed, &mut out[start..]).map_err(|e| quoted(&e.to_string()))?;
    out.truncate(start + n);
    Ok(())
}

/// Decodes blocks of LZ4 after their length in all and that of each when unpacked, all of them big-endian.
fn unpack_lz4_blocks(packed: &[u8], most: usize, out: &mut Vec<u8>) -> Result<(), String> {
    let (total, rest) = packed.split_first_chunk().ok_or(EARLY)?;
    let (block, mut rest) = rest.split_first_chunk().ok_or(EARLY)?;
    let total = usize::try_from(u64::from_be_bytes(*total)).unwrap_or(usize::MAX).min(most);
    let block = u32::from_be_bytes(*block) as usize;
    while out.len() < total {
        let (length, after) = rest.split_first_chunk().ok_or(EARLY)?;
        let length = u32::from_be_bytes(*length) as usize;
        let (packed, after) = after.split_at_checked(length).ok_or(EARLY)?;
        let size = block.min(total - out.len());
        let before = out.len();
        // A block that does not shrink is kept as it is.
        if length == size {
            out.extend_from_slice(packed);
        } else {
            unpack_lz4(packed, size, out)?;
        }
        if out.len() == before {
            return Err("a block is empty".into());
        }
        rest = after;
    }
    Ok(())
}

/// CRC-32C (Castagnoli), a byte at a time.
pub(crate) fn crc32c(bytes: &[u8]) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut i = 0;
        while i < 256 {
            let (mut crc, mut bit) = (i as u32, 0);
            while bit < 8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
                bit += 1;
            }
            table[i] = crc;
            i += 1;
        }
        table
    };
    !bytes.iter().fold(u32::MAX, |crc, b| TABLE[usize::from(crc as u8 ^ b)] ^ crc >> 8)
}

/// Fletcher's checksum of big-endian words of 16 bits. A last byte alone is the first of a word.
fn fletcher32(bytes: &[u8]) -> u32 {
    let (mut sum, mut sums) = (0u32, 0u32);
    // So many words cannot overflow.
    for part in bytes.chunks(2 * 360) {
        for word in part.chunks(2) {
            sum += u32::from(word[0]) << 8 | word.get(1).map_or(0, |b| u32::from(*b));
            sums += sum;
        }
        (sum, sums) = (folded(sum), folded(sums));
    }
    folded(sums) << 16 | folded(sum)
}

fn folded(sum: u32) -> u32 {
    (sum & 0xffff) + (sum >> 16)
}

const EARLY: &str = "it ends early";
const LEAST_WINDOW_BYTES: usize = 8 << 20;
/// The largest window that the reference decoder accepts by default.
const MOST_WINDOW_BYTES: usize = 128 << 20;

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn zstd_gives_no_more_bytes_and_takes_no_more_memory_than_allowed() {
        let unpacked = |packed: &[u8], most: usize| {
            let mut out = Vec::new();
            unpack_zstd(packed, most, &mut out).map(|()| out.len())
        };
        let packed = zstd::bulk::compress(&[7; 5000], 1).unwrap();
        assert_eq!(unpacked(&packed, 5000).unwrap(), 5000);
        assert_eq!(unpacked(&packed, 1000).unwrap(), 1000);
        let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
        encoder.window_log(24).unwrap();
        encoder.write_all(&[7; 5000]).unwrap();
        let packed = encoder.finish().unwrap();
        assert!(unpacked(&packed, 5000).is_err(), "the window has 16 MiB");
        assert_eq!(unpacked(&packed, 16 << 20).unwrap(), 5000);
    }

    #[test]
    fn the_checksums_are_those_of_the_standards() {
        // RFC 3720, B.4: 32 bytes of zeros, of ones, and ascending.
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(&[0xff; 32]), 0x62a8_ab43);
        assert_eq!(crc32c(&(0..32).collect::<Vec<u8>>()), 0x46dd_794e);
        // By hand: the words 0x6162, 0x6364 and 0x6500 add up to 0x129c6, and their sums to 0x24fee.
        assert_eq!(fletcher32(b"abcde"), 0x4ff0_29c7);
        assert_eq!(fletcher32(b""), 0);
    }

    #[test]
    fn blocks_of_lz4_are_joined_and_bounded() {
        let numbers: Vec<u8> = (0..100).map(|i| i / 40).collect();
        let mut packed = [100u64.to_be_bytes().to_vec(), 64u32.to_be_bytes().to_vec()].concat();
        let first = lz4_flex::block::compress(&numbers[..64]);
        packed.extend([(first.len() as u32).to_be_bytes().to_vec(), first].concat());
        packed.extend([36u32.to_be_bytes().to_vec(), numbers[64..].to_vec()].concat());
        assert_eq!(Codec::Lz4Blocks.decode(&packed, 100), Ok(numbers.clone()));
        assert_eq!(Codec::Lz4Blocks.decode(&packed, 64), Ok(numbers[..64].to_vec()));
        for cut in 0..packed.len() {
            assert!(Codec::Lz4Blocks.decode(&packed[..cut], 100).is_err(), "{cut}");
        }
    }
}
