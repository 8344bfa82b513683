//! The filter bitshuffle of HDF5 (32008): blocks of numbers whose bits were put together, and which may be packed.

use super::{BitPacking, EARLY, shuffle, unpack_lz4, unpack_zstd};
use crate::error::quoted;

/// Decodes to at most `most` bytes. A number has `size` bytes, and a block `block` numbers, or as usual if that is zero.
/// Packed data begin with the bytes of all numbers and those of a block. The last numbers are no eight, and stay.
pub(super) fn decode(
    bytes: &[u8],
    most: usize,
    (size, block): (usize, usize),
    packing: BitPacking,
    out: &mut Vec<u8>,
) -> Result<(), String> {
    let size = size.max(1);
    let usual = (USUAL_BYTES / size / 8 * 8).max(LEAST_NUMBERS);
    let (total, block_bytes, mut rest) = match packing {
        BitPacking::None => {
            let numbers = if block > 0 { block } else { usual };
            (bytes.len(), numbers.saturating_mul(size), bytes)
        }
        _ => {
            let (total, rest) = bytes.split_first_chunk().ok_or(EARLY)?;
            let (block, rest) = rest.split_first_chunk().ok_or(EARLY)?;
            let block = u32::from_be_bytes(*block) as usize;
            let block = if block > 0 { block } else { usual * size };
            (usize::try_from(u64::from_be_bytes(*total)).unwrap_or(usize::MAX), block, rest)
        }
    };
    if total > most || block_bytes == 0 || !block_bytes.is_multiple_of(8 * size) {
        return Err(format!("{total} bytes in blocks of {block_bytes}, expected at most {most}, in eights"));
    }
    let in_eights = total / (8 * size) * (8 * size);
    while out.len() < in_eights {
        let length = block_bytes.min(in_eights - out.len());
        let (shuffled, after) = match packing {
            BitPacking::None => {
                let (block, after) = rest.split_at_checked(length).ok_or(EARLY)?;
                (block.to_vec(), after)
            }
            _ => unpacked(rest, length, packing)?,
        };
        out.extend(shuffle::bit_unshuffled(&shuffled, size));
        rest = after;
    }
    out.extend_from_slice(rest.get(..total - in_eights).ok_or(EARLY)?);
    Ok(())
}

/// The next block, of `length` bytes, and what follows it.
fn unpacked(rest: &[u8], length: usize, packing: BitPacking) -> Result<(Vec<u8>, &[u8]), String> {
    let (packed, rest) = rest.split_first_chunk().ok_or(EARLY)?;
    let (packed, rest) = rest.split_at_checked(u32::from_be_bytes(*packed) as usize).ok_or(EARLY)?;
    let mut block = Vec::new();
    match packing {
        BitPacking::Zstd => unpack_zstd(packed, length, &mut block).map_err(|e| quoted(&e.to_string()))?,
        _ => unpack_lz4(packed, length, &mut block)?,
    }
    match block.len() == length {
        true => Ok((block, rest)),
        false => Err(format!("a block has {} bytes, expected {length}", block.len())),
    }
}

/// Bytes of a usual block, which has at least so many numbers.
const USUAL_BYTES: usize = 8192;
const LEAST_NUMBERS: usize = 128;

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers of two bytes with their bits put together, by the definition.
    fn shuffled(numbers: &[u8]) -> Vec<u8> {
        let n = numbers.len() / 2;
        let mut out = vec![0; numbers.len()];
        for (i, number) in numbers.chunks_exact(2).enumerate() {
            for bit in 0..16 {
                out[bit * n / 8 + i / 8] |= (number[bit / 8] >> (bit % 8) & 1) << (i % 8);
            }
        }
        out
    }

    /// 37 numbers: two blocks of 16, and five that stay.
    fn numbers() -> Vec<u8> {
        (0..74u32).map(|i| ((i * i * 37) >> 3) as u8).collect()
    }

    fn packed(pack: impl Fn(&[u8]) -> Vec<u8>) -> Vec<u8> {
        let all = numbers();
        let mut out = [74u64.to_be_bytes().to_vec(), 32u32.to_be_bytes().to_vec()].concat();
        for block in all[..64].chunks(32) {
            let block = pack(&shuffled(block));
            out.extend([(block.len() as u32).to_be_bytes().to_vec(), block].concat());
        }
        out.extend_from_slice(&all[64..]);
        out
    }

    #[test]
    fn bits_come_back_from_blocks_of_every_packing() {
        let plain =
            [shuffled(&numbers()[..32]), shuffled(&numbers()[32..64]), numbers()[64..].to_vec()].concat();
        let zstd = packed(|block| zstd::bulk::compress(block, 3).unwrap_or_default());
        let lz4 = packed(lz4_flex::block::compress);
        for (packing, bytes) in [(BitPacking::None, plain), (BitPacking::Lz4, lz4), (BitPacking::Zstd, zstd)]
        {
            let decoded = |bytes: &[u8], most: usize| {
                let mut out = Vec::new();
                decode(bytes, most, (2, 16), packing, &mut out).map(|()| out)
            };
            assert_eq!(decoded(&bytes, 74), Ok(numbers()), "{packing:?}");
            assert!(decoded(&bytes, 73).is_err(), "{packing:?}");
            let is_whole = |cut: usize| decoded(&bytes[..cut], 74).is_ok_and(|out| out.len() == 74);
            assert!((0..bytes.len()).all(|cut| !is_whole(cut)), "{packing:?}");
        }
    }
}
