//! The entries of a ZIP archive and the location of their bytes.
//!
//! `rawzip` looks at one record after the other. The crate `zip` would keep a record of every entry in memory, and
//! brings decoders that [`crate::stream`] has already.

use std::fs::File;
use std::path::Path;

use rawzip::{ErrorKind, RECOMMENDED_BUFFER_SIZE, ZipArchive};

use crate::error::{FormatError, io_error, malformed};

#[derive(Clone, Debug)]
pub(crate) struct Entry {
    pub(crate) name: String,
    /// 0 for plain bytes, 8 for deflate.
    pub(crate) method: u16,
    /// Offset of its first byte in the archive.
    pub(crate) offset: u64,
    pub(crate) packed_bytes: u64,
}

/// The first `most` entries of the archive at `path` whose names end with `suffix`.
pub(crate) fn entries(file: File, path: &Path, suffix: &str, most: usize) -> Result<Vec<Entry>, FormatError> {
    let bad = malformed(path, "ZIP archive");
    let damaged = |e: rawzip::Error| match e.into_kind() {
        ErrorKind::IO(cause) => io_error(path)(cause),
        kind => bad(kind.to_string()),
    };
    let mut buffer = vec![0; RECOMMENDED_BUFFER_SIZE];
    let archive = ZipArchive::from_file(file, &mut buffer).map_err(damaged)?;
    let mut records = archive.entries(&mut buffer);
    let mut entries = Vec::new();
    for _ in 0..MAX_ENTRIES {
        let Some(record) = records.next_entry().map_err(damaged)? else { break };
        let name = String::from_utf8_lossy(record.file_path().as_ref()).into_owned();
        if record.flags().is_encrypted() {
            return Err(bad("it is encrypted".into()));
        }
        if name.ends_with(suffix) && entries.len() < most {
            let entry = archive.get_entry(record.wayfinder()).map_err(damaged)?;
            let (offset, end) = entry.compressed_data_range();
            let method = record.compression_method().as_u16();
            entries.push(Entry { name, method, offset, packed_bytes: end - offset });
        }
    }
    Ok(entries)
}

/// Most entries of an archive that are read.
const MAX_ENTRIES: usize = 1 << 17;
