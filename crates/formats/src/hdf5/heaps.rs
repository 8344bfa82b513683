//! Trees of version 2 and the heaps in which new groups with many links keep them. From the HDF5 file format
//! specification, version 4.0.

use super::objects::{Cursor, EARLY, MAX_DEPTH, ObjectReader};

/// The links of a group that are not in its header.
pub(super) struct DenseLinks;

impl DenseLinks {
    /// The bodies of the links that `info`, the message about the links of a group, leads to.
    pub(super) fn bodies(objects: &ObjectReader, info: &[u8]) -> Result<Vec<Vec<u8>>, String> {
        let mut cursor = Cursor(info);
        let (_, flags) = (cursor.number(1).ok_or(EARLY)?, cursor.number(1).ok_or(EARLY)?);
        if flags & 1 != 0 {
            cursor.take(8).ok_or(EARLY)?;
        }
        let (heap, tree) = (objects.address(&mut cursor), objects.address(&mut cursor));
        let (Some(heap), Some(tree)) = (heap, tree) else { return Ok(Vec::new()) };
        let heap = FractalHeap::read(objects, heap)?;
        let records = Records::read(objects, tree)?;
        // A record has a hash of the name, and the place of the link in the heap.
        records.iter().map(|record| heap.object(objects, record.get(4..).ok_or(EARLY)?)).collect()
    }
}

/// The text at an offset of a heap of names.
pub(super) fn local_text(names: &[u8], at: u64) -> Option<String> {
    let rest = names.get(usize::try_from(at).ok()?..)?;
    Some(super::objects::text_from(rest))
}

/// The records of a tree of version 2.
pub(super) struct Records {
    bytes: Vec<u8>,
    pub(super) size: usize,
}

impl Records {
    /// Reads the tree whose header is at byte `at`.
    pub(super) fn read(objects: &ObjectReader, at: u64) -> Result<Self, String> {
        let bytes = objects.source.bytes(at, 22 + objects.offset_size + objects.length_size)?;
        let mut cursor = Cursor(bytes.strip_prefix(b"BTHD").ok_or(DAMAGED)?);
        cursor.take(2).ok_or(EARLY)?;
        let node_size = cursor.number(4).ok_or(EARLY)?;
        let size = cursor.number(2).ok_or(EARLY)? as usize;
        let depth = cursor.number(2).ok_or(EARLY)? as usize;
        cursor.take(2).ok_or(EARLY)?;
        let root = objects.address(&mut cursor);
        let num_root = cursor.number(2).ok_or(EARLY)? as usize;
        if size == 0 || depth > MAX_DEPTH || node_size < 16 {
            return Err(DAMAGED.into());
        }
        let mut found = Self { bytes: Vec::new(), size };
        let pointers = pointer_sizes(node_size, size as u64, depth, objects.offset_size as u64);
        let mut nodes = Vec::from_iter(root.map(|root| (root, num_root, depth)));
        while let Some((at, count, depth)) = nodes.pop() {
            let pointer = pointers.get(depth).ok_or(DAMAGED)?;
            let width = if depth > 0 { objects.offset_size + pointer.0 + pointer.1 } else { 0 };
            let num_bytes = count * size + if depth > 0 { (count + 1) * width } else { 0 };
            let bytes = objects.source.bytes(at, 6 + num_bytes)?;
            if !bytes.starts_with(if depth > 0 { b"BTIN" } else { b"BTLF" }) {
                return Err(DAMAGED.into());
            }
            let (records, children) = bytes[6..].split_at(count * size);
            found.bytes.extend_from_slice(records);
            for child in children.chunks_exact(width.max(1)) {
                let mut cursor = Cursor(child);
                let at = objects.address(&mut cursor).ok_or(EARLY)?;
                nodes.push((at, cursor.number(pointer.0).ok_or(EARLY)? as usize, depth - 1));
            }
        }
        Ok(found)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &[u8]> {
        self.bytes.chunks_exact(self.size)
    }
}

/// Bytes of the two counts beside the address of a child, for nodes of each height.
fn pointer_sizes(node_size: u64, record: u64, depth: usize, offset_size: u64) -> Vec<(usize, usize)> {
    let bytes_of = |most: u64| (most.max(1).ilog2() / 8 + 1) as usize;
    let most_in_leaf = (node_size - 10) / record;
    let count = bytes_of(most_in_leaf);
    let mut found = vec![(0, 0)];
    let mut most_below = most_in_leaf;
    for height in 1..=depth {
        let all = if height > 1 { bytes_of(most_below).min(8) } else { 0 };
        found.push((count, all));
        let pointer = offset_size + (count + all) as u64;
        let most = node_size.saturating_sub(10 + pointer) / (record + pointer);
        most_below = most.saturating_add(1).saturating_mul(most_below).saturating_add(most);
    }
    found
}

/// A heap of objects of any size.
struct FractalHeap {
    /// Bytes of the place and of the length in the name of an object.
    offset_bytes: usize,
    length_bytes: usize,
    /// Blocks in a row.
    width: u64,
    /// Size of the blocks of the first two rows; each further row has twice that of the one before.
    first_block: u64,
    /// Size of the largest block that has objects.
    largest_block: u64,
    root: Option<u64>,
    /// Rows of the root; none if it is a block of objects.
    num_rows: u64,
}

impl FractalHeap {
    fn read(objects: &ObjectReader, at: u64) -> Result<Self, String> {
        let (length, offset) = (objects.length_size, objects.offset_size);
        let bytes = objects.source.bytes(at, 22 + 12 * length + 3 * offset)?;
        let mut cursor = Cursor(bytes.strip_prefix(b"FRHP").ok_or(DAMAGED)?);
        let mut number = |size: usize| cursor.number(size).ok_or(EARLY);
        number(1)?;
        number(2)?;
        let has_filters = number(2)? > 0;
        number(1)?;
        let largest_object = number(4)?;
        // Of large objects, of free space, and counts.
        for size in [length, offset, length, offset] {
            number(size)?;
        }
        for _ in 0..8 {
            number(length)?;
        }
        let width = number(2)?;
        let (first_block, largest_block) = (number(length)?, number(length)?);
        let offset_bits = number(2)?;
        number(2)?;
        let root = objects.address(&mut cursor);
        let num_rows = cursor.number(2).ok_or(EARLY)?;
        let is_good = |size: u64| size.is_power_of_two() && size <= MAX_BLOCK_BYTES;
        if has_filters || !is_good(first_block) || !is_good(largest_block) || first_block > largest_block {
            return Err("the links of a group are packed, or in blocks of an unknown size".into());
        }
        let offset_bytes = offset_bits.div_ceil(8) as usize;
        let of_block = (largest_block.ilog2() as usize).div_ceil(8);
        let length_bytes = of_block.min(largest_object.max(1).ilog2() as usize / 8 + 1).max(1);
        if !width.is_power_of_two() || offset_bytes > 8 {
            return Err(DAMAGED.into());
        }
        Ok(Self { offset_bytes, length_bytes, width, first_block, largest_block, root, num_rows })
    }

    /// The object that a name in the heap means.
    fn object(&self, objects: &ObjectReader, name: &[u8]) -> Result<Vec<u8>, String> {
        let kind = name.first().ok_or(EARLY)? >> 4 & 3;
        if kind == 2 {
            // A short object is in its name.
            let size = usize::from(name[0] & 15) + 1;
            return name.get(1..1 + size).map(<[u8]>::to_vec).ok_or(EARLY.into());
        }
        let mut cursor = Cursor(&name[1..]);
        let offset = cursor.number(self.offset_bytes).ok_or(EARLY)?;
        let size = cursor.number(self.length_bytes).ok_or(EARLY)?;
        if kind != 0 {
            return Err("the name of a link is longer than a block".into());
        }
        let (block, start) = self.block(objects, offset)?;
        objects.source.bytes(block.saturating_add(offset - start), size as usize)
    }

    /// The block of objects that holds an offset of the heap: its byte in the file, and its own offset.
    fn block(&self, objects: &ObjectReader, offset: u64) -> Result<(u64, u64), String> {
        let mut at = self.root.ok_or(EARLY)?;
        let (mut num_rows, mut start) = (self.num_rows, 0);
        for _ in 0..MAX_DEPTH {
            if num_rows == 0 {
                return Ok((at, start));
            }
            let (row, size, row_start) = self.row(offset - start);
            if row >= num_rows {
                return Err(DAMAGED.into());
            }
            let column = (offset - start - row_start) / size;
            let place = 5 + objects.offset_size + self.offset_bytes;
            let index = row * self.width + column;
            let place = at + place as u64 + index * objects.offset_size as u64;
            let bytes = objects.source.bytes(place, objects.offset_size)?;
            at = objects.address(&mut Cursor(&bytes)).ok_or(DAMAGED)?;
            start += row_start + column * size;
            // Large blocks are tables of smaller ones.
            let rows = (size / self.first_block).max(1).ilog2().saturating_sub(self.width.ilog2()) + 1;
            num_rows = if size > self.largest_block { u64::from(rows) } else { 0 };
        }
        Err(DAMAGED.into())
    }

    /// The row of a table that holds an offset of it, the size of the row's blocks, and where the row begins.
    fn row(&self, offset: u64) -> (u64, u64, u64) {
        let (mut row, mut size, mut start) = (0, self.first_block, 0u64);
        loop {
            let next = start.saturating_add(self.width.saturating_mul(size));
            if offset < next || row > 64 {
                return (row, size, start);
            }
            (row, start) = (row + 1, next);
            if row > 1 {
                size = size.saturating_mul(2);
            }
        }
    }
}

const DAMAGED: &str = "its trees are damaged";
/// Largest block of a heap.
const MAX_BLOCK_BYTES: u64 = 1 << 32;
