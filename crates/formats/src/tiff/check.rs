//! Checks the first directory before the decoder reads it. The decoder trusts the lengths in it, whatever limits are
//! set later.

use std::io::{self, Read, Seek, SeekFrom};

use crate::dtype::Endian;
use crate::header_bytes::HeaderBytes;

/// Whether every value of the first directory fits into a file of `length` bytes. `file` is at its start before and
/// after.
pub(super) fn first_directory_fits(file: &mut (impl Read + Seek), length: u64) -> io::Result<bool> {
    let fits = directory_fits(file, length)?;
    file.seek(SeekFrom::Start(0))?;
    Ok(fits)
}

fn directory_fits(file: &mut (impl Read + Seek), length: u64) -> io::Result<bool> {
    let mut start = [0; 16];
    let read = |file: &mut dyn Read, bytes: &mut [u8]| match file.read_exact(bytes) {
        Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
        other => other.map(|()| true),
    };
    if !read(file, &mut start[..8])? {
        return Ok(false);
    }
    let endian = if start[0] == b'M' { Endian::Big } else { Endian::Little };
    let is_big = (HeaderBytes { bytes: &start, endian }).u16(2) == 43;
    if is_big && !read(file, &mut start[8..])? {
        return Ok(false);
    }
    let w = HeaderBytes { bytes: &start, endian };
    let offset = if is_big { w.u64(8) } else { w.u32(4).into() };
    if offset >= length {
        return Ok(false);
    }
    file.seek(SeekFrom::Start(offset))?;
    let mut count = [0; 8];
    let count_bytes = if is_big { 8 } else { 2 };
    if !read(file, &mut count[..count_bytes])? {
        return Ok(false);
    }
    let w = HeaderBytes { bytes: &count, endian };
    let count = if is_big { w.u64(0) } else { w.u16(0).into() };
    let entry_bytes = if is_big { 20 } else { 12 };
    if count > u64::from(u16::MAX) || count * entry_bytes > length {
        return Ok(false);
    }
    let mut entries = vec![0; (count * entry_bytes) as usize];
    if !read(file, &mut entries)? {
        return Ok(false);
    }
    Ok(entries.chunks_exact(entry_bytes as usize).all(|entry| {
        let w = HeaderBytes { bytes: entry, endian };
        // Sizes of the types of TIFF 6.0 and BigTIFF.
        let size = match w.u16(2) {
            1 | 2 | 6 | 7 => 1,
            3 | 8 => 2,
            4 | 9 | 11 | 13 => 4,
            _ => 8,
        };
        let count = if is_big { w.u64(4) } else { w.u32(4).into() };
        count.saturating_mul(size) <= length
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fits(bytes: &[u8]) -> bool {
        first_directory_fits(&mut io::Cursor::new(bytes), bytes.len() as u64).unwrap()
    }

    /// A damaged file had a description of half a gigabyte in a kilobyte.
    #[test]
    fn values_longer_than_the_file_are_found() {
        let file = |offset: u32, entries: u16, count: u32| {
            let entry =
                [&270u16.to_le_bytes()[..], &2u16.to_le_bytes(), &count.to_le_bytes(), &8u32.to_le_bytes()]
                    .concat();
            [b"II*\0".as_slice(), &offset.to_le_bytes(), &entries.to_le_bytes(), &entry, &[0; 64]].concat()
        };
        assert!(fits(&file(8, 1, 60)));
        assert!(!fits(&file(8, 1, 482_364_765)) && !fits(&file(8, 900, 60)) && !fits(&file(9999, 1, 60)));
        let big = |count: u64| {
            let entry =
                [&270u16.to_le_bytes()[..], &2u16.to_le_bytes(), &count.to_le_bytes(), &16u64.to_le_bytes()]
                    .concat();
            let start =
                [&b"II+\0"[..], &8u16.to_le_bytes(), &[0; 2], &16u64.to_le_bytes(), &1u64.to_le_bytes()]
                    .concat();
            [&start[..], &entry, &[0; 64]].concat()
        };
        assert!(fits(&big(60)) && !fits(&big(u64::MAX)));
        assert!(!fits(b"II*\0") && !fits(b"II+\0\x08\0\0\0"));
    }
}
