//! The list of what is in a ZIP archive (APPNOTE 6.3.10), with the 64-bit fields.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use crate::dtype::Endian;
use crate::error::{FormatError, io_error, shown};
use crate::words::Words;

/// What the central directory says.
pub(crate) struct Archive {
    pub(crate) entries: Vec<Entry>,
}

/// A file in an archive.
pub(crate) struct Entry {
    pub(crate) name: String,
    /// 0: as it is, 8: deflate.
    pub(crate) method: u16,
    pub(crate) packed_bytes: u64,
    /// Where its own header begins.
    offset: u64,
}

impl Archive {
    /// Reads the directory of `file`, the file at `path`.
    pub(crate) fn read(file: &mut File, path: &Path) -> Result<Self, FormatError> {
        let bad = |problem: String| FormatError::Malformed {
            path: shown(path),
            format: "ZIP archive".into(),
            problem,
        };
        let io = io_error(path);
        let length = file.metadata().map_err(&io)?.len();
        let tail_start = length.saturating_sub(END_BYTES + MAX_COMMENT_BYTES);
        let tail = read_at(file, path, tail_start, length - tail_start)?;
        let end = tail
            .windows(4)
            .rposition(|w| w == b"PK\x05\x06")
            .ok_or_else(|| bad("no end of its directory was found".into()))?;
        fn words(bytes: &[u8]) -> Words<'_> {
            Words { bytes, endian: Endian::Little }
        }
        let w = words(&tail[end..]);
        let (mut size, mut offset) = (u64::from(w.u32(12)), u64::from(w.u32(16)));
        if (size == u64::from(u32::MAX) || offset == u64::from(u32::MAX))
            && let Some(locator) = end.checked_sub(20).filter(|&at| tail[at..].starts_with(b"PK\x06\x07"))
        {
            let at = words(&tail[locator..]).u64(8);
            let record = read_at(file, path, at, 56)?;
            if !record.starts_with(b"PK\x06\x06") {
                return Err(bad("its 64-bit end record is not where it should be".into()));
            }
            (size, offset) = (words(&record).u64(40), words(&record).u64(48));
        }
        if size > MAX_DIRECTORY_BYTES || offset.checked_add(size).is_none_or(|end| end > length) {
            return Err(bad(format!(
                "its directory of {size} bytes at {offset} is not within {length} bytes"
            )));
        }
        let directory = read_at(file, path, offset, size)?;
        let mut entries = Vec::new();
        let mut rest = &directory[..];
        while rest.starts_with(b"PK\x01\x02") && rest.len() >= 46 {
            let w = words(rest);
            let lengths = [28, 30, 32].map(|at| usize::from(w.u16(at)));
            let total = 46 + lengths.iter().sum::<usize>();
            let Some(record) = rest.get(..total) else { break };
            let (name, extra) =
                (&record[46..46 + lengths[0]], &record[46 + lengths[0]..46 + lengths[0] + lengths[1]]);
            if w.u16(8) & 1 != 0 {
                return Err(bad("it is encrypted".into()));
            }
            let [mut packed, unpacked, mut offset] = [20, 24, 42].map(|at| u64::from(w.u32(at)));
            // The extra field has those that do not fit, in this order.
            let mut large = wide_fields(extra);
            if unpacked == u64::from(u32::MAX) {
                large.next();
            }
            for value in [&mut packed, &mut offset] {
                if *value == u64::from(u32::MAX) {
                    *value = large.next().ok_or_else(|| bad("a 64-bit field is missing".into()))?;
                }
            }
            let name = String::from_utf8_lossy(name).into_owned();
            entries.push(Entry { name, method: w.u16(10), packed_bytes: packed, offset });
            rest = &rest[total..];
        }
        Ok(Self { entries })
    }
}

impl Entry {
    /// Where its bytes begin.
    pub(crate) fn data_offset(&self, file: &mut File, path: &Path) -> Result<u64, FormatError> {
        let local = read_at(file, path, self.offset, LOCAL_BYTES)?;
        let w = Words { bytes: &local, endian: Endian::Little };
        if !local.starts_with(b"PK\x03\x04") || local.len() as u64 != LOCAL_BYTES {
            let problem = "a file is not where its directory says".into();
            return Err(FormatError::Malformed { path: shown(path), format: "ZIP archive".into(), problem });
        }
        let after = u64::from(w.u16(26)) + u64::from(w.u16(28));
        Ok(self.offset.saturating_add(LOCAL_BYTES + after))
    }
}

/// The numbers of the extra field with 64-bit sizes.
fn wide_fields(mut extra: &[u8]) -> impl Iterator<Item = u64> {
    let mut found: &[u8] = &[];
    while let Some((head, rest)) = extra.split_first_chunk::<4>() {
        let (id, size) = (u16::from_le_bytes([head[0], head[1]]), u16::from_le_bytes([head[2], head[3]]));
        let (field, after) = rest.split_at(usize::from(size).min(rest.len()));
        if id == 1 {
            found = field;
        }
        extra = after;
    }
    found.as_chunks::<8>().0.iter().map(|b| u64::from_le_bytes(*b))
}

/// At most `length` bytes from `offset`.
fn read_at(file: &mut File, path: &Path, offset: u64, length: u64) -> Result<Vec<u8>, FormatError> {
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(offset.min(i64::MAX as u64))).map_err(io_error(path))?;
    file.take(length).read_to_end(&mut bytes).map_err(io_error(path))?;
    Ok(bytes)
}

const END_BYTES: u64 = 22;
const MAX_COMMENT_BYTES: u64 = 65_535 + 20;
const LOCAL_BYTES: u64 = 30;
/// A hundred thousand entries with long names.
const MAX_DIRECTORY_BYTES: u64 = 16 << 20;
