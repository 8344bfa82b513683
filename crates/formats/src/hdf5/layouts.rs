//! Layouts of arrays that `hdf5-pure` does not know: those of HDF5 before 1.6.3 and from 2.0 on, and chunks in a tree
//! of version 2. From the HDF5 file format specification, version 4.0.

use super::heaps::Records;
use super::objects::{Cursor, EARLY, LAYOUT, Message, ObjectReader};
use super::storage::StoredChunk;

/// Tells the reader of metadata the layout of the array at byte `at` in a version that it knows. `num_bytes` are those
/// of all numbers. The array must be opened again.
pub(super) fn tell_layout(objects: &ObjectReader, at: u64, num_bytes: u64) -> Result<(), String> {
    let message = layout_message(objects, at)?;
    let version = message.body.first().copied().unwrap_or(0);
    let told = match version {
        1 | 2 => from_old(objects, &message.body, num_bytes),
        // Only the version differs.
        5 => Some([&[4], &message.body[1..]].concat()),
        _ => None,
    };
    let told = told.filter(|told| told.len() <= message.body.len());
    let told = told.ok_or_else(|| format!("it is stored as layout {version}, expected 1 to 5"))?;
    objects.source.patch(message.at, told);
    if let Some((start, size)) = message.block {
        let sum = lookup3(&objects.source.bytes(start, size)?);
        objects.source.patch(start + size as u64, sum.to_le_bytes().to_vec());
    }
    Ok(())
}

/// The layout message of the array at byte `at`.
fn layout_message(objects: &ObjectReader, at: u64) -> Result<Message, String> {
    let messages = objects.messages(at)?;
    messages.into_iter().find(|message| message.kind == LAYOUT).ok_or_else(|| "it has no layout".into())
}

/// A message of version 1 or 2 in version 3.
fn from_old(objects: &ObjectReader, body: &[u8], num_bytes: u64) -> Option<Vec<u8>> {
    let mut cursor = Cursor(body);
    cursor.take(1)?;
    let (num_sides, class) = (cursor.number(1)?, cursor.number(1)?);
    cursor.take(5)?;
    let address = if class == 0 { &[] } else { cursor.take(objects.offset_size)? };
    let sides = cursor.take(4 * num_sides as usize)?;
    match class {
        0 => {
            let size = cursor.number(4)?;
            let bytes = cursor.take(usize::try_from(size).ok()?)?;
            Some([&[3, 0], &u16::try_from(size).ok()?.to_le_bytes(), bytes].concat())
        }
        1 => {
            let size = num_bytes.to_le_bytes();
            Some([&[3, 1], address, size.get(..objects.length_size)?].concat())
        }
        2 => Some([&[3, 2, num_sides as u8], address, sides].concat()),
        _ => None,
    }
}

/// The chunks of the array at byte `at` with the sides `sides`, which are in a tree of version 2. An unpacked chunk has
/// `chunk_bytes`.
pub(super) fn chunks_in_tree(
    objects: &ObjectReader,
    at: u64,
    sides: &[u64],
    chunk_bytes: u64,
) -> Result<Vec<StoredChunk>, String> {
    let body = layout_message(objects, at)?.body;
    let mut cursor = Cursor(&body);
    cursor.take(3).ok_or(EARLY)?;
    let (num_sides, width) = (cursor.number(1).ok_or(EARLY)?, cursor.number(1).ok_or(EARLY)?);
    // The kind of the index, and the sizes of its nodes.
    cursor.take((num_sides * width) as usize + 7).ok_or(EARLY)?;
    let Some(tree) = objects.address(&mut cursor) else { return Ok(Vec::new()) };
    let records = Records::read(objects, tree)?;
    let bare = objects.offset_size + 8 * sides.len();
    let size_bytes = records.size.checked_sub(bare + 4).filter(|n| (1..=8).contains(n));
    if records.size != bare && size_bytes.is_none() {
        return Err("its chunks are in a tree of an unknown kind".into());
    }
    let chunk = |record: &[u8]| {
        let mut cursor = Cursor(record);
        let address = objects.address(&mut cursor)?;
        let (size, mask) = match size_bytes {
            Some(bytes) => (cursor.number(bytes)?, cursor.number(4)? as u32),
            None => (chunk_bytes, 0),
        };
        let start = sides.iter().map(|side| cursor.number(8)?.checked_mul(*side));
        Some(StoredChunk { start: start.collect::<Option<_>>()?, address, size, mask })
    };
    records.iter().map(|record| chunk(record).ok_or_else(|| EARLY.to_owned())).collect()
}

/// The bytes of a number of the array at byte `at` that is not stored, which has `size` bytes; zero if it is not told.
pub(super) fn fill_value(objects: &ObjectReader, at: u64, size: usize) -> Vec<u8> {
    let messages = objects.messages(at).unwrap_or_default();
    let told = |message: &Message| {
        let mut cursor = Cursor(&message.body);
        match message.kind {
            FILL => {
                let version = cursor.number(1)?;
                // The times at which it is written.
                let is_told = match version {
                    1 | 2 => cursor.take(2).and_then(|_| cursor.number(1))? == 1,
                    _ => cursor.number(1)? & 0x20 != 0,
                };
                is_told.then_some(())?;
            }
            OLD_FILL => {}
            _ => return None,
        }
        let told = cursor.number(4)?;
        cursor.take(size).filter(|_| told == size as u64).map(<[u8]>::to_vec)
    };
    messages.iter().rev().find_map(told).unwrap_or_else(|| vec![0; size])
}

/// Whether chunks that reach beyond the array at byte `at` are not packed.
pub(super) fn has_plain_edges(objects: &ObjectReader, at: u64) -> bool {
    layout_message(objects, at)
        .is_ok_and(|message| matches!(message.body[..], [4 | 5, 2, flags, ..] if flags & 1 == 1))
}

/// Whether the numbers of the array at byte `at` are in plain files beside this one.
pub(super) fn has_external_files(objects: &ObjectReader, at: u64) -> bool {
    objects.messages(at).is_ok_and(|messages| messages.iter().any(|message| message.kind == EXTERNAL_FILES))
}

/// The message that names files with the numbers.
const EXTERNAL_FILES: u16 = 7;
/// The messages that tell the fill value.
const OLD_FILL: u16 = 4;
const FILL: u16 = 5;

/// The checksum of metadata: lookup3 of Bob Jenkins, which is in the public domain.
fn lookup3(bytes: &[u8]) -> u32 {
    let start = 0xdead_beef_u32.wrapping_add(bytes.len() as u32);
    let (mut a, mut b, mut c) = (start, start, start);
    let mut rest = bytes;
    loop {
        let (part, after) = rest.split_at(rest.len().min(12));
        let word = |i: usize| {
            let byte = |j: usize| u32::from(part.get(4 * i + j).copied().unwrap_or(0)) << (8 * j);
            (0..4).map(byte).sum::<u32>()
        };
        if part.is_empty() {
            return c;
        }
        (a, b, c) = (a.wrapping_add(word(0)), b.wrapping_add(word(1)), c.wrapping_add(word(2)));
        if after.is_empty() {
            let step = |x: u32, y: u32, turn: u32| (x ^ y).wrapping_sub(y.rotate_left(turn));
            c = step(c, b, 14);
            a = step(a, c, 11);
            b = step(b, a, 25);
            c = step(c, b, 16);
            a = step(a, c, 4);
            b = step(b, a, 14);
            return step(c, b, 24);
        }
        rest = after;
        for turns in [[4, 6, 8], [16, 19, 4]] {
            a = a.wrapping_sub(c) ^ c.rotate_left(turns[0]);
            c = c.wrapping_add(b);
            b = b.wrapping_sub(a) ^ a.rotate_left(turns[1]);
            a = a.wrapping_add(c);
            c = c.wrapping_sub(b) ^ b.rotate_left(turns[2]);
            b = b.wrapping_add(a);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_that_of_its_author() {
        // From the self-test of lookup3.c, and of the empty text.
        assert_eq!(lookup3(b""), 0xdead_beef);
        assert_eq!(lookup3(b"Four score and seven years ago"), 0x1777_0551);
    }
}
