//! The bytes of an HDF5 file for the reader of its metadata, which may read only so many.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use hdf5_pure::Source;

/// A file that several threads read.
pub(super) struct SharedFile {
    file: Mutex<File>,
    pub(super) length: u64,
}

impl SharedFile {
    pub(super) fn new(file: File) -> io::Result<Self> {
        let length = file.metadata()?.len();
        Ok(Self { file: Mutex::new(file), length })
    }

    /// Fills `bytes` from the offset `at`.
    fn fill(&self, at: u64, bytes: &mut [u8]) -> io::Result<()> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(bytes)
    }

    /// Reads `size` bytes at the offset `at`. The error says that they are not in the file.
    pub(super) fn read(&self, at: u64, size: u64) -> Result<Vec<u8>, String> {
        if at.checked_add(size).is_none_or(|end| end > self.length) {
            return Err(format!("it ends at {at} + {size} of {} bytes", self.length));
        }
        let mut bytes = vec![0; size as usize];
        self.fill(at, &mut bytes).map_err(|e| e.to_string())?;
        Ok(bytes)
    }
}

/// The metadata of a file. Their trees may have circles, and their sizes may be anything, so the reader gets an end of
/// bytes: a few times the file, in blocks of a bounded size.
pub(super) struct MetadataSource {
    file: Arc<SharedFile>,
    /// Bytes that may still be read.
    left: AtomicU64,
}

impl MetadataSource {
    pub(super) fn new(file: Arc<SharedFile>) -> Self {
        let most = file.length.saturating_mul(READS_OF_ALL).saturating_add(LEAST_BYTES).min(MOST_BYTES);
        Self { file, left: AtomicU64::new(most) }
    }

    /// Counts the bytes of a block. A block costs something even if it is short.
    fn count(&self, at: u64, size: usize) -> Result<(), hdf5_pure::FormatError> {
        let size = size as u64;
        if at.checked_add(size).is_none_or(|end| end > self.file.length) {
            return Err(problem(format!("a part ends at {at} + {size} of {} bytes", self.file.length)));
        }
        if size > MAX_BLOCK_BYTES {
            return Err(problem(format!(
                "{size} bytes of metadata in one, expected at most {MAX_BLOCK_BYTES}"
            )));
        }
        let cost = size.max(LEAST_COST);
        let take = |left: u64| left.checked_sub(cost);
        match self.left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take) {
            Ok(_) => Ok(()),
            Err(_) => Err(problem("its metadata have circles, or are too large".into())),
        }
    }
}

impl Source for MetadataSource {
    fn len(&self) -> u64 {
        self.file.length
    }

    fn read_at(&self, at: u64, bytes: &mut [u8]) -> Result<(), hdf5_pure::FormatError> {
        self.count(at, bytes.len())?;
        self.file.fill(at, bytes).map_err(|e| problem(e.to_string()))
    }

    fn read_exact_at(&self, at: u64, size: usize) -> Result<Vec<u8>, hdf5_pure::FormatError> {
        self.count(at, size)?;
        self.file.read(at, size as u64).map_err(problem)
    }
}

fn problem(text: String) -> hdf5_pure::FormatError {
    hdf5_pure::FormatError::Source(text)
}

/// How often all of a file may be read for its metadata.
const READS_OF_ALL: u64 = 8;
const LEAST_BYTES: u64 = 1 << 20;
const MOST_BYTES: u64 = 256 << 20;
/// What a block costs at least.
const LEAST_COST: u64 = 64;
/// Largest block of metadata. The depth of what the reader finds in a block, and so its stack, grows with its size.
const MAX_BLOCK_BYTES: u64 = 256 << 10;

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn the_reader_of_metadata_comes_to_an_end() {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(&[7; 1000]).unwrap();
        let metadata = MetadataSource::new(Arc::new(SharedFile::new(file).unwrap()));
        assert_eq!(metadata.read_exact_at(998, 2).unwrap(), [7, 7]);
        assert!(metadata.read_exact_at(998, 3).is_err() && metadata.read_at(u64::MAX, &mut [0]).is_err());
        assert!(metadata.count(0, 1 << 20).unwrap_err().to_string().contains("of 1000 bytes"));
        let reads = (0..).take_while(|_| metadata.read_at(0, &mut [0; 8]).is_ok()).count() as u64;
        assert!((10_000..(LEAST_BYTES + 8000) / LEAST_COST).contains(&reads), "{reads}");
        assert!(metadata.read_at(0, &mut [0]).unwrap_err().to_string().contains("circles"));
    }
}
