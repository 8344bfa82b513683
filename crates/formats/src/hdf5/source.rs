//! The bytes of an HDF5 file for the readers of its metadata, which may read only so many.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, RwLock};

use hdf5_pure::Source;

use crate::error::one_line;

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

/// The metadata of a file. Their trees may have circles, and their sizes may be anything, so all readers together get
/// an end of bytes: a few times the file, in blocks of a bounded size.
#[derive(Clone)]
pub(super) struct MetadataSource(Arc<Metadata>);

struct Metadata {
    file: Arc<SharedFile>,
    /// Bytes that may still be read.
    left: AtomicU64,
    /// What readers find in place of the bytes at an offset.
    patches: RwLock<Vec<(u64, Vec<u8>)>>,
}

impl MetadataSource {
    pub(super) fn new(file: Arc<SharedFile>) -> Self {
        let most = file.length.saturating_mul(READS_OF_ALL).saturating_add(LEAST_BYTES).min(MOST_BYTES);
        Self(Arc::new(Metadata { file, left: AtomicU64::new(most), patches: RwLock::default() }))
    }

    /// Gives readers `bytes` in place of those at the offset `at`.
    pub(super) fn patch(&self, at: u64, bytes: Vec<u8>) {
        self.0.patches.write().unwrap_or_else(PoisonError::into_inner).push((at, bytes));
    }

    /// The bytes at an offset. The error says why they cannot be read.
    pub(super) fn bytes(&self, at: u64, size: usize) -> Result<Vec<u8>, String> {
        self.read_exact_at(at, size).map_err(|e| one_line(&e.to_string()))
    }

    /// Puts the patches over `bytes`, which were read at the offset `at`.
    fn set_patches(&self, at: u64, bytes: &mut [u8]) {
        for (from, patch) in self.0.patches.read().unwrap_or_else(PoisonError::into_inner).iter() {
            for (i, byte) in (*from..).zip(patch) {
                let place = i.checked_sub(at).and_then(|i| bytes.get_mut(usize::try_from(i).ok()?));
                if let Some(place) = place {
                    *place = *byte;
                }
            }
        }
    }

    /// Counts the bytes of a block. A block costs something even if it is short.
    fn count(&self, at: u64, size: usize) -> Result<(), hdf5_pure::FormatError> {
        let size = size as u64;
        if at.checked_add(size).is_none_or(|end| end > self.0.file.length) {
            return Err(problem(format!("a part ends at {at} + {size} of {} bytes", self.0.file.length)));
        }
        if size > MAX_BLOCK_BYTES {
            return Err(problem(format!(
                "{size} bytes of metadata in one, expected at most {MAX_BLOCK_BYTES}"
            )));
        }
        let cost = size.max(LEAST_COST);
        let take = |left: u64| left.checked_sub(cost);
        match self.0.left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take) {
            Ok(_) => Ok(()),
            Err(_) => Err(problem("its metadata have circles, or are too large".into())),
        }
    }
}

impl Source for MetadataSource {
    fn len(&self) -> u64 {
        self.0.file.length
    }

    fn read_at(&self, at: u64, bytes: &mut [u8]) -> Result<(), hdf5_pure::FormatError> {
        self.count(at, bytes.len())?;
        self.0.file.fill(at, bytes).map_err(|e| problem(e.to_string()))?;
        self.set_patches(at, bytes);
        Ok(())
    }

    fn read_exact_at(&self, at: u64, size: usize) -> Result<Vec<u8>, hdf5_pure::FormatError> {
        self.count(at, size)?;
        let mut bytes = self.0.file.read(at, size as u64).map_err(problem)?;
        self.set_patches(at, &mut bytes);
        Ok(bytes)
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
        metadata.patch(10, vec![1, 2, 3]);
        assert_eq!(metadata.bytes(9, 3).unwrap(), [7, 1, 2]);
        assert_eq!(metadata.bytes(12, 2).unwrap(), [3, 7]);
        assert!(metadata.read_exact_at(998, 3).is_err() && metadata.read_at(u64::MAX, &mut [0]).is_err());
        assert!(metadata.count(0, 1 << 20).unwrap_err().to_string().contains("of 1000 bytes"));
        let reads = (0..).take_while(|_| metadata.read_at(0, &mut [0; 8]).is_ok()).count() as u64;
        assert!((10_000..(LEAST_BYTES + 8000) / LEAST_COST).contains(&reads), "{reads}");
        assert!(metadata.read_at(0, &mut [0]).unwrap_err().to_string().contains("circles"));
    }
}
