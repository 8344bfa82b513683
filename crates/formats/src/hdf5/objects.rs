//! The messages in the headers of objects, and the links of groups. `hdf5-pure` knows names and arrays, but no links to
//! other paths or files, and no places of objects. From the HDF5 file format specification, version 4.0.

use super::heaps::{DenseLinks, local_text};
use super::source::MetadataSource;

/// Reads objects by the byte at which they begin.
pub(super) struct ObjectReader {
    pub(super) source: MetadataSource,
    /// What stored addresses count from.
    pub(super) base: u64,
    /// Bytes of an address and of a length.
    pub(super) offset_size: usize,
    pub(super) length_size: usize,
}

/// A message in the header of an object.
pub(super) struct Message {
    pub(super) kind: u16,
    /// The byte of the file where its body begins.
    pub(super) at: u64,
    pub(super) body: Vec<u8>,
    /// First byte and length of the block that ends with a checksum, if its header has checksums.
    pub(super) block: Option<(u64, usize)>,
}

/// A name in a group.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Link {
    pub(super) name: String,
    pub(super) target: LinkTarget,
}

/// What a link leads to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum LinkTarget {
    /// The object at this byte of the file.
    Object(u64),
    /// A path in this file, from the root or from the group of the link.
    Path(String),
    /// A path in another file.
    File { file: String, path: String },
}

/// What an object is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ObjectKind {
    Group,
    Array,
    Other,
}

/// Takes numbers off the front of bytes. `None` if they end early.
pub(super) struct Cursor<'a>(pub(super) &'a [u8]);

impl<'a> Cursor<'a> {
    pub(super) fn take(&mut self, size: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(size)?;
        self.0 = rest;
        Some(taken)
    }

    /// A little-endian number of 1 to 8 bytes.
    pub(super) fn number(&mut self, size: usize) -> Option<u64> {
        let mut bytes = [0; 8];
        bytes.get_mut(..size)?.copy_from_slice(self.take(size)?);
        Some(u64::from_le_bytes(bytes))
    }
}

impl ObjectReader {
    /// The byte of the file that a stored address means; `None` if it means nowhere.
    pub(super) fn place(&self, stored: u64) -> Option<u64> {
        let nowhere = u64::MAX >> (64 - 8 * self.offset_size.clamp(1, 8));
        self.base.checked_add(stored).filter(|_| stored != nowhere)
    }

    /// The next address of `cursor`, as a byte of the file.
    pub(super) fn address(&self, cursor: &mut Cursor) -> Option<u64> {
        self.place(cursor.number(self.offset_size)?)
    }

    /// The messages of the object that begins at byte `at`.
    pub(super) fn messages(&self, at: u64) -> Result<Vec<Message>, String> {
        let start = self.source.bytes(at, 16)?;
        let mut found = Vec::new();
        let mut blocks = Vec::new();
        let flags = if start.starts_with(b"OHDR") {
            let flags = start[5];
            let more = if flags & 0x20 != 0 { 16 } else { 0 } + if flags & 0x10 != 0 { 4 } else { 0 };
            let size_bytes = 1 << (flags & 3);
            let head = 6 + more + size_bytes;
            let bytes = self.source.bytes(at + (head - size_bytes) as u64, size_bytes)?;
            let size = Cursor(&bytes).number(size_bytes).ok_or(EARLY)?;
            blocks.push((at, head, size.saturating_add(head as u64)));
            Some(flags)
        } else if start[0] == 1 {
            let size = Cursor(&start[8..]).number(4).ok_or(EARLY)?;
            blocks.push((at + 16, 0, size));
            None
        } else {
            return Err(format!("no object begins at byte {at}"));
        };
        let mut num_blocks = 0;
        while let Some((at, head, size)) = blocks.pop() {
            num_blocks += 1;
            let size = usize::try_from(size).map_err(|_| EARLY)?;
            if num_blocks > MAX_BLOCKS {
                return Err(format!("an object has more than {MAX_BLOCKS} parts"));
            }
            let bytes = self.source.bytes(at, size)?;
            let body = bytes.get(head..).ok_or(EARLY)?;
            self.add_messages(body, at + head as u64, (flags, at, size), &mut found, &mut blocks)?;
        }
        Ok(found)
    }

    /// Adds the messages of a block, whose first begins at byte `at`, and the places of further blocks.
    fn add_messages(
        &self,
        body: &[u8],
        at: u64,
        (flags, block_at, block_size): (Option<u8>, u64, usize),
        found: &mut Vec<Message>,
        blocks: &mut Vec<(u64, usize, u64)>,
    ) -> Result<(), String> {
        let mut cursor = Cursor(body);
        while let Some((kind, size, own)) = next_message(&mut cursor, flags) {
            // What is left over at the end of a block is a gap.
            let from = body.len() - cursor.0.len();
            let Some(bytes) = cursor.take(size) else { break };
            if kind == CONTINUED {
                let mut cursor = Cursor(bytes);
                let next = self.address(&mut cursor).ok_or(EARLY)?;
                let size = cursor.number(self.length_size).ok_or(EARLY)?;
                // A later block has its signature first and its checksum last.
                blocks.push(match flags {
                    Some(_) => (next, 4, size.saturating_sub(4)),
                    None => (next, 0, size),
                });
            } else if own & SHARED == 0 {
                let block = flags.map(|_| (block_at, block_size));
                found.push(Message { kind, at: at + from as u64, body: bytes.to_vec(), block });
            }
        }
        Ok(())
    }

    /// What the object at byte `at` is.
    pub(super) fn kind(&self, at: u64) -> Result<ObjectKind, String> {
        let messages = self.messages(at)?;
        let has = |kind: u16| messages.iter().any(|message| message.kind == kind);
        Ok(match () {
            () if has(LAYOUT) => ObjectKind::Array,
            () if has(SYMBOL_TABLE) || has(LINK_INFO) || has(LINK) => ObjectKind::Group,
            () => ObjectKind::Other,
        })
    }

    /// The links of the group at byte `at`, in the order of their names. A link of an unknown kind is left out.
    pub(super) fn links(&self, at: u64) -> Result<Vec<Link>, String> {
        let mut found = Vec::new();
        for message in self.messages(at)? {
            match message.kind {
                SYMBOL_TABLE => self.add_old_links(&message.body, &mut found)?,
                LINK => found.extend(self.link(&message.body)),
                LINK_INFO => {
                    for body in DenseLinks::bodies(self, &message.body)? {
                        found.extend(self.link(&body));
                    }
                }
                _ => {}
            }
        }
        found.sort_by(|a: &Link, b| a.name.cmp(&b.name));
        Ok(found)
    }

    /// The link that a message of a new group is.
    fn link(&self, body: &[u8]) -> Option<Link> {
        let mut cursor = Cursor(body);
        let (1, flags) = (cursor.number(1)?, cursor.number(1)?) else { return None };
        let kind = if flags & 8 != 0 { cursor.number(1)? } else { 0 };
        if flags & 4 != 0 {
            cursor.take(8)?;
        }
        if flags & 16 != 0 {
            cursor.take(1)?;
        }
        let size = cursor.number(1 << (flags & 3))?;
        let name = String::from_utf8_lossy(cursor.take(usize::try_from(size).ok()?)?).into_owned();
        let target = match kind {
            0 => LinkTarget::Object(self.address(&mut cursor)?),
            1 | 64 => {
                let size = cursor.number(2)?;
                let bytes = cursor.take(size as usize)?;
                if kind == 1 { LinkTarget::Path(text_from(bytes)) } else { file_target(bytes)? }
            }
            _ => return None,
        };
        Some(Link { name, target })
    }

    /// Adds the links of an old group, whose message has the places of a tree and of a heap with the names.
    fn add_old_links(&self, body: &[u8], found: &mut Vec<Link>) -> Result<(), String> {
        let mut cursor = Cursor(body);
        let tree = self.address(&mut cursor).ok_or(EARLY)?;
        let heap = self.address(&mut cursor).ok_or(EARLY)?;
        let names = self.local_heap(heap)?;
        let mut nodes = vec![(tree, 0)];
        while let Some((at, depth)) = nodes.pop() {
            let head = 8 + 2 * self.offset_size;
            let start = self.source.bytes(at, head)?;
            if start.starts_with(b"SNOD") {
                let count = usize::from(u16::from_le_bytes([start[6], start[7]]));
                let size = 2 * self.offset_size + 24;
                let entries = self.source.bytes(at + 8, count * size)?;
                found.extend(entries.chunks_exact(size).filter_map(|entry| self.old_link(entry, &names)));
                continue;
            }
            if !start.starts_with(b"TREE") || start[4] != 0 || depth > MAX_DEPTH {
                return Err("the tree of a group is damaged".into());
            }
            let count = usize::from(u16::from_le_bytes([start[6], start[7]]));
            let bytes = self.source.bytes(at + head as u64, count * (self.length_size + self.offset_size))?;
            let mut cursor = Cursor(&bytes);
            for _ in 0..count {
                cursor.take(self.length_size).ok_or(EARLY)?;
                nodes.push((self.address(&mut cursor).ok_or(EARLY)?, depth + 1));
            }
        }
        Ok(())
    }

    fn old_link(&self, entry: &[u8], names: &[u8]) -> Option<Link> {
        let mut cursor = Cursor(entry);
        let name = local_text(names, cursor.number(self.offset_size)?)?;
        let object = cursor.number(self.offset_size)?;
        let kind = cursor.number(4)?;
        cursor.take(4)?;
        let target = match kind {
            SOFT => LinkTarget::Path(local_text(names, cursor.number(4)?)?),
            _ => LinkTarget::Object(self.place(object)?),
        };
        Some(Link { name, target })
    }

    /// The bytes of the heap at byte `at`, which has the names of an old group.
    fn local_heap(&self, at: u64) -> Result<Vec<u8>, String> {
        let bytes = self.source.bytes(at, 8 + 2 * self.length_size + self.offset_size)?;
        let mut cursor = Cursor(bytes.strip_prefix(b"HEAP").ok_or("the names of a group are damaged")?);
        cursor.take(4).ok_or(EARLY)?;
        let size = cursor.number(self.length_size).ok_or(EARLY)?;
        cursor.take(self.length_size).ok_or(EARLY)?;
        let at = self.address(&mut cursor).ok_or(EARLY)?;
        self.source.bytes(at, usize::try_from(size).map_err(|_| EARLY)?)
    }
}

/// Kind, length and flags of the next message. `flags` are those of a header of version 2.
fn next_message(cursor: &mut Cursor, flags: Option<u8>) -> Option<(u16, usize, u64)> {
    match flags {
        Some(flags) => {
            let kind = cursor.number(1)? as u16;
            let (size, own) = (cursor.number(2)? as usize, cursor.number(1)?);
            if flags & 4 != 0 {
                cursor.take(2)?;
            }
            Some((kind, size, own))
        }
        None => {
            let (kind, size) = (cursor.number(2)? as u16, cursor.number(2)? as usize);
            let own = cursor.number(1)?;
            cursor.take(3)?;
            Some((kind, size, own))
        }
    }
}

/// The file and the path of an external link, each of which ends with a zero.
fn file_target(bytes: &[u8]) -> Option<LinkTarget> {
    let mut parts = bytes.get(1..)?.split(|byte| *byte == 0);
    let (file, path) = (text_from(parts.next()?), text_from(parts.next()?));
    Some(LinkTarget::File { file, path })
}

/// The text before the first zero.
pub(super) fn text_from(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

const LINK_INFO: u16 = 2;
const LINK: u16 = 6;
/// The message that tells how an array is stored.
pub(super) const LAYOUT: u16 = 8;
const CONTINUED: u16 = 16;
const SYMBOL_TABLE: u16 = 17;
/// The flag of a message whose body is elsewhere.
const SHARED: u64 = 2;
/// How an old group marks a link to a path.
const SOFT: u64 = 2;
pub(super) const EARLY: &str = "its metadata end early";
/// Most parts of a header.
const MAX_BLOCKS: usize = 4096;
/// Deepest tree.
pub(super) const MAX_DEPTH: usize = 32;
