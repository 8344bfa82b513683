//! Writes an HDF5 file as versions before 1.6.3 do: superblock 0, a group with a tree and a heap, and an array whose
//! layout message has version 1 or 2. From the HDF5 file format specification, version 4.0.

/// How the numbers are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum OldLayout {
    Compact,
    Contiguous,
    /// In two chunks of 2×4×5, the second of which reaches beyond the array.
    Chunked,
}

const NOWHERE: u64 = u64::MAX;
/// Where the parts of the file begin.
const ROOT: u64 = 96;
const GROUP_TREE: u64 = 0x200;
const HEAP: u64 = 0x500;
const NAMES: u64 = 0x540;
const NODE: u64 = 0x600;
const ARRAY: u64 = 0x800;
const CHUNK_TREE: u64 = 0xa00;
const NUMBERS: u64 = 0xc00;

/// Puts bytes into a file that grows.
#[derive(Default)]
struct Bytes(Vec<u8>);

impl Bytes {
    fn at(&mut self, at: u64, parts: &[&[u8]]) {
        let bytes = parts.concat();
        let end = at as usize + bytes.len();
        self.0.resize(self.0.len().max(end), 0);
        self.0[at as usize..end].copy_from_slice(&bytes);
    }
}

/// The volume of `make.py` as numbers of 16 bits, in an array `a`.
pub(crate) fn old_file(version: u8, layout: OldLayout) -> Vec<u8> {
    let word = |n: u64| n.to_le_bytes();
    let short = |n: u16| n.to_le_bytes();
    let mut file = Bytes::default();
    file.at(0, &[b"\x89HDF\r\n\x1a\n", &[0, 0, 0, 0, 0, 8, 8, 0], &short(4), &short(16), &[0; 4]]);
    file.at(24, &[&word(0), &word(NOWHERE), &word(0x2000), &word(NOWHERE)]);
    // The root, whose tree and heap are kept here too.
    file.at(56, &[&word(0), &word(ROOT), &[1, 0, 0, 0, 0, 0, 0, 0], &word(GROUP_TREE), &word(HEAP)]);
    file.at(ROOT, &[&[1, 0], &short(1), &[1, 0, 0, 0], &[24, 0, 0, 0], &[0; 4]]);
    file.at(ROOT + 16, &[&short(17), &short(16), &[0; 4], &word(GROUP_TREE), &word(HEAP)]);
    file.at(GROUP_TREE, &[b"TREE", &[0, 0], &short(1), &word(NOWHERE), &word(NOWHERE)]);
    file.at(GROUP_TREE + 24, &[&word(0), &word(NODE), &word(8)]);
    file.at(HEAP, &[b"HEAP", &[0; 4], &word(88), &word(16), &word(NAMES)]);
    file.at(NAMES + 8, &[b"a\0\0\0\0\0\0\0", &word(1), &word(72)]);
    file.at(NODE, &[b"SNOD", &[1, 0], &short(1), &word(8), &word(ARRAY), &[0; 24]]);
    let numbers: Vec<u8> =
        (0..60u16).flat_map(|i| (i % 5 + i / 5 % 4 * 10 + i / 20 * 100).to_le_bytes()).collect();
    let message = layout_message(version, layout, &numbers);
    let space = [&[1, 3, 0, 0, 0, 0, 0, 0][..], &word(3), &word(4), &word(5)].concat();
    let kind = [&[0x10, 0, 0, 0, 2, 0, 0, 0][..], &short(0), &short(16), &[0; 4]].concat();
    let messages = [(1, space), (3, kind), (8, message)];
    let size: usize = messages.iter().map(|(_, body)| 8 + body.len()).sum();
    file.at(ARRAY, &[&[1, 0], &short(3), &[1, 0, 0, 0], &(size as u32).to_le_bytes(), &[0; 4]]);
    let mut at = ARRAY + 16;
    for (kind, body) in messages {
        file.at(at, &[&short(kind), &short(body.len() as u16), &[0; 4], &body]);
        at += 8 + body.len() as u64;
    }
    file.at(NUMBERS, &[&numbers, &[0; 64]]);
    if layout == OldLayout::Chunked {
        file.at(CHUNK_TREE, &[b"TREE", &[1, 0], &short(2), &word(NOWHERE), &word(NOWHERE)]);
        let key = |z: u64| [&[80, 0, 0, 0, 0, 0, 0, 0][..], &word(z), &word(0), &word(0), &word(0)].concat();
        let (first, second) = (word(NUMBERS), word(NUMBERS + 80));
        file.at(CHUNK_TREE + 24, &[&key(0), &first, &key(2), &second, &key(4)]);
    }
    file.at(0x2000, &[]);
    file.0
}

fn layout_message(version: u8, layout: OldLayout, numbers: &[u8]) -> Vec<u8> {
    let sides = |sides: &[u32]| sides.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<u8>>();
    let head = |num_sides: u8, class: u8| [version, num_sides, class, 0, 0, 0, 0, 0];
    let mut body = match layout {
        OldLayout::Compact => {
            let size = (numbers.len() as u32).to_le_bytes();
            [&head(3, 0)[..], &sides(&[3, 4, 5]), &size, numbers].concat()
        }
        OldLayout::Contiguous => [&head(3, 1)[..], &NUMBERS.to_le_bytes(), &sides(&[3, 4, 5])].concat(),
        OldLayout::Chunked => [&head(4, 2)[..], &CHUNK_TREE.to_le_bytes(), &sides(&[2, 4, 5, 2])].concat(),
    };
    body.resize(body.len().next_multiple_of(8), 0);
    body
}
