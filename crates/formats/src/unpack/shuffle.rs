//! Numbers whose bytes or bits were put together, so that they pack better.

/// The byte shuffle: all first bytes before all second ones.
pub(super) fn shuffled(bytes: &[u8], type_size: usize) -> Vec<u8> {
    let n = bytes.len() / type_size;
    let mut out = bytes.to_vec();
    for (byte, plane) in out.chunks_exact_mut(n.max(1)).take(type_size).enumerate() {
        for (to, number) in plane.iter_mut().zip(bytes.chunks_exact(type_size)) {
            *to = number[byte];
        }
    }
    out
}

/// Undoes the byte shuffle, which puts all first bytes before all second ones. Bytes that are left over stay.
pub(super) fn unshuffled(block: &[u8], type_size: usize) -> Vec<u8> {
    let n = block.len() / type_size;
    let mut out = block.to_vec();
    for (byte, plane) in block.chunks_exact(n.max(1)).take(type_size).enumerate() {
        for (i, b) in plane.iter().enumerate().take(n) {
            out[i * type_size + byte] = *b;
        }
    }
    out
}

/// Undoes the bit shuffle, which does the same with bits of eight numbers. Numbers beyond a multiple of eight stay.
pub(super) fn bit_unshuffled(block: &[u8], type_size: usize) -> Vec<u8> {
    let n = block.len() / type_size / 8 * 8;
    let mut out = block.to_vec();
    // Each byte of a plane has a bit of eight numbers.
    let (planes, stride) = (&block[..n * type_size], n / 8);
    for byte in 0..type_size {
        for group in 0..stride {
            let rows = std::array::from_fn(|bit| planes[(byte * 8 + bit) * stride + group]);
            let numbers = transposed(u64::from_le_bytes(rows)).to_le_bytes();
            for (i, value) in numbers.into_iter().enumerate() {
                out[(group * 8 + i) * type_size + byte] = value;
            }
        }
    }
    out
}

/// Exchanges rows and columns of 8 × 8 bits, whose rows are bytes (Hacker's Delight, 7-3).
fn transposed(mut x: u64) -> u64 {
    for (shift, mask) in
        [(7, 0x00aa_00aa_00aa_00aa), (14, 0x0000_cccc_0000_cccc), (28, 0x0000_0000_f0f0_f0f0)]
    {
        let moved = (x ^ x >> shift) & mask;
        x ^= moved ^ moved << shift;
    }
    x
}
