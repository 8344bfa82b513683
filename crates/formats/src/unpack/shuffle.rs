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
    out[..n * type_size].fill(0);
    for (row, plane) in
        block.chunks_exact((n / 8).max(1)).take(if n > 0 { type_size * 8 } else { 0 }).enumerate()
    {
        let (byte, bit) = (row / 8, row % 8);
        for i in 0..n {
            let value = plane[i / 8] >> (i % 8) & 1;
            out[i * type_size + byte] |= value << bit;
        }
    }
    out
}
