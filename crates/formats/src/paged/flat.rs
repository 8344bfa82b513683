//! Boxes of numbers that lie in files one after the other, read by offset.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::channels::pick;
use crate::decode::VoxelSink;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, shown};
use crate::hyperslab::Steps;
use crate::plan::{BoxLevel, BoxReader, Plan};
use crate::source::open_file;

/// A file with an equal share of the numbers, in their order.
pub(crate) struct FlatFile {
    pub(crate) path: PathBuf,
    /// Byte of the first number.
    pub(crate) offset: u64,
}

/// Numbers in one file or several.
struct FlatBoxes {
    files: Vec<(FlatFile, Option<Arc<File>>)>,
    /// Numbers in each file.
    share: u64,
    /// Numbers along each axis, the fastest first.
    sizes: Vec<u64>,
    dtype: Dtype,
    endian: Endian,
}

/// The one level of a plan whose numbers lie in `files`, with an equal share in each.
///
/// # Errors
/// A file is missing or too short, or a share is a part of a plane.
pub(crate) fn flat_level(
    plan: &Plan,
    files: Vec<FlatFile>,
    path: &Path,
) -> Result<Vec<BoxLevel>, FormatError> {
    let sizes: Vec<u64> = plan.axes.iter().map(|axis| axis.size).collect();
    let size = plan.dtype.num_bytes() as u64;
    let count =
        sizes.iter().try_fold(1u64, |n, m| n.checked_mul(*m)).filter(|n| n.checked_mul(size).is_some());
    let not_paged = |found: &str| FormatError::NotPaged { path: shown(path), found: found.to_owned() };
    let count = count.filter(|n| *n > 0).ok_or_else(|| not_paged("a file of no or too many numbers"))?;
    let share = count / files.len().max(1) as u64;
    let in_plane: u64 = sizes.iter().take(2).product();
    if files.is_empty() || share * files.len() as u64 != count || !share.is_multiple_of(in_plane) {
        return Err(not_paged("a volume in parts of planes"));
    }
    let are_kept = files.windows(2).filter(|pair| pair[0].path != pair[1].path).count() < MAX_KEPT;
    let mut kept: Vec<(FlatFile, Option<Arc<File>>)> = Vec::new();
    let mut last: Option<(PathBuf, Arc<File>)> = None;
    for file in files {
        let opened = match &last {
            Some((path, opened)) if *path == file.path => Arc::clone(opened),
            _ => Arc::new(open_file(&file.path)?),
        };
        last = Some((file.path.clone(), Arc::clone(&opened)));
        let length = opened.metadata().map_err(io_error(&file.path))?.len();
        let (expected, found) = (share * size, length.saturating_sub(file.offset));
        if found < expected {
            let words: Vec<String> = sizes.iter().map(u64::to_string).collect();
            let shape = format!("{} {}", words.join("×"), plan.dtype.name());
            return Err(FormatError::Short {
                path: shown(&file.path),
                shape,
                expected,
                found,
                unit: "bytes",
            });
        }
        kept.push((file, are_kept.then_some(opened)));
    }
    let boxes = FlatBoxes { files: kept, share, sizes, dtype: plan.dtype, endian: plan.endian };
    Ok(vec![BoxLevel { plan: plan.clone(), reader: Box::new(boxes) }])
}

impl BoxReader for FlatBoxes {
    fn read(&self, selected: &[Steps]) -> Result<VoxelSink, FormatError> {
        let count: u64 = selected.iter().map(Steps::len).product();
        let path = &self.files[0].0.path;
        let sink = usize::try_from(count).ok().map(|n| VoxelSink::new(self.dtype, self.endian, n));
        let mut sink =
            sink.and_then(Result::ok).ok_or_else(|| io_error(path)(io::ErrorKind::OutOfMemory.into()))?;
        self.read_rows(selected, &mut |row| sink.push_bytes(row))?;
        Ok(sink)
    }

    fn read_numbers(&self, selected: &[Steps]) -> Result<Vec<u8>, FormatError> {
        let size = self.dtype.num_bytes();
        let count: u64 = selected.iter().map(Steps::len).product();
        let mut numbers = Vec::new();
        let room = usize::try_from(count).ok().and_then(|n| numbers.try_reserve_exact(n * size).ok());
        room.ok_or_else(|| io_error(&self.files[0].0.path)(io::ErrorKind::OutOfMemory.into()))?;
        self.read_rows(selected, &mut |row| numbers.extend_from_slice(row))?;
        if self.endian == Endian::Big && size > 1 {
            numbers.chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
        Ok(numbers)
    }
}

impl FlatBoxes {
    /// Passes the bytes of each row of the selected numbers to `take`, in the order of the file.
    fn read_rows(&self, selected: &[Steps], take: &mut dyn FnMut(&[u8])) -> Result<(), FormatError> {
        let size = self.dtype.num_bytes();
        let mut strides = vec![1; self.sizes.len()];
        for axis in 1..strides.len() {
            strides[axis] = strides[axis - 1] * self.sizes[axis - 1];
        }
        let [fast, next] = [&selected[0], &selected[1]];
        let row = fast.range.end - fast.range.start;
        // Rows are read together where little lies between them.
        let apart = strides[1] * next.step;
        let is_near = (apart - row.min(apart)) * size as u64 <= MOST_BETWEEN;
        let most = (MOST_AT_ONCE / (apart * size as u64).max(1)).max(1);
        let rows_at_once = if is_near { most.min(next.len()) } else { 1 };
        let outer: Vec<&Steps> = selected.iter().skip(2).collect();
        let planes: u64 = outer.iter().map(|steps| steps.len()).product();
        let (mut bytes, mut picked) = (Vec::new(), Vec::new());
        for plane in 0..planes {
            let (mut rest, mut start) = (plane, fast.range.start);
            for (steps, stride) in outer.iter().zip(&strides[2..]) {
                start += steps.at(rest % steps.len()) * stride;
                rest /= steps.len();
            }
            for first in (0..next.len()).step_by(rows_at_once as usize) {
                let rows = rows_at_once.min(next.len() - first);
                let at = start + next.at(first) * strides[1];
                bytes.resize((((rows - 1) * apart + row) as usize) * size, 0);
                self.read_at(at, &mut bytes)?;
                for i in 0..rows {
                    let from = (i * apart) as usize * size;
                    let row = &bytes[from..from + row as usize * size];
                    if fast.step == 1 {
                        take(row);
                    } else {
                        pick(row, size, 0, fast.step as usize, &mut picked);
                        take(&picked);
                    }
                }
            }
        }
        Ok(())
    }

    /// Fills `bytes` with the numbers from number `at` on, all in one file.
    fn read_at(&self, at: u64, bytes: &mut [u8]) -> Result<(), FormatError> {
        let (file, kept) = &self.files[(at / self.share) as usize];
        let offset = file.offset + at % self.share * self.dtype.num_bytes() as u64;
        let opened = match kept {
            Some(_) => None,
            None => Some(Arc::new(open_file(&file.path)?)),
        };
        let Some(handle) = kept.as_ref().or(opened.as_ref()) else { return Ok(()) };
        read_exact_at(handle, bytes, offset).map_err(|e| match e.kind() {
            io::ErrorKind::UnexpectedEof => FormatError::Data {
                path: shown(&file.path),
                problem: format!("it ends before byte {}", offset + bytes.len() as u64),
            },
            _ => io_error(&file.path)(e),
        })
    }
}

/// Fills `bytes` from byte `offset` of a file on, whatever its position is. Several threads may do so at once.
#[cfg(unix)]
pub(crate) fn read_exact_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset)
}

/// Fills `bytes` from byte `offset` of a file on.
#[cfg(not(unix))]
pub(crate) fn read_exact_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    use std::io::{Read, Seek, SeekFrom};
    // Threads share the position of a file, so each read has a handle of its own.
    let mut own = file.try_clone()?;
    let _turn = TURNS.lock();
    own.seek(SeekFrom::Start(offset))?;
    own.read_exact(bytes)
}

/// Where a file has one position, reads take turns.
#[cfg(not(unix))]
static TURNS: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// Most files that are kept open.
const MAX_KEPT: usize = 64;
/// Rows with at most this many bytes between them are read together.
const MOST_BETWEEN: u64 = 16 << 10;
/// Most bytes that are read together, unless a row has more.
const MOST_AT_ONCE: u64 = 1 << 20;
