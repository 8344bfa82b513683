//! The file that keeps levels of means, and reading boxes of them. Anybody may have changed it: a file that is not whole
//! counts as none, and so does each chunk, whose sum is in the header.

use std::fs::File;
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use isinglass_core::volume::PyramidLevel;

use super::flat::read_exact_at;
use super::index_file::{IndexBytes, fnv};
use super::levels::PageLevel;
use super::means::{CHUNK_SIDE, MeanLevels, MeanPlan, boxes};
use crate::decode::VoxelSink;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, shown};
use crate::hyperslab::Steps;
use crate::output::{Readers, file_beside};
use crate::padding::{GapNumbers, Missing};
use crate::plan::{Axis, BoxReader, Chosen, Plan, Role};
use crate::source::open_file;

/// Writes the levels of the volume that `key` names, whole or not at all.
///
/// # Errors
/// If the system refuses.
pub(super) fn write_means(path: &Path, key: &str, means: &MeanLevels) -> Result<(), FormatError> {
    let io = io_error(path);
    let Some(mut file) = file_beside(path, Readers::Owner).map_err(&io)? else {
        return Err(io(std::io::ErrorKind::AlreadyExists.into()));
    };
    let num_chunks =
        means.levels.iter().flatten().map(|channel| boxes(channel.dims, CHUNK_SIDE).count()).sum();
    // The header has its length before the sums are known.
    let mut sums = vec![0; num_chunks];
    let length = header(key, means, &sums).len();
    let mut body = |file: &mut File| {
        file.seek(SeekFrom::Start(length as u64))?;
        let mut out = BufWriter::new(file);
        let mut next = sums.iter_mut();
        for channel in means.levels.iter().flatten() {
            for (at, dims) in boxes(channel.dims, CHUNK_SIDE) {
                let numbers = channel.read(at, dims)?;
                out.write_all(&numbers.bytes)?;
                next.by_ref().take(1).for_each(|sum| *sum = fnv(&numbers.bytes));
            }
        }
        out.flush()
    };
    body(file.as_file_mut()).map_err(&io)?;
    let whole = header(key, means, &sums);
    let finish = |file: &mut File| {
        file.seek(SeekFrom::Start(0))?;
        file.write_all(&whole)?;
        file.sync_all()
    };
    finish(file.as_file_mut()).map_err(&io)?;
    file.persist(path).map(drop).map_err(|e| io(e.error))
}

/// All before the numbers: what they are of, and the sum of each chunk.
fn header(key: &str, means: &MeanLevels, sums: &[u64]) -> Vec<u8> {
    let mut out = Vec::new();
    let number = |out: &mut Vec<u8>, n: u32| out.extend(n.to_le_bytes());
    number(&mut out, key.len() as u32);
    out.extend(key.as_bytes());
    out.push(u8::from(means.are_labels));
    number(&mut out, means.gaps.numbers.len() as u32);
    means.gaps.numbers.iter().for_each(|x| out.extend(x.to_le_bytes()));
    out.push(u8::from(means.gaps.valid.is_some()));
    let (lo, hi) = means.gaps.valid.unwrap_or_default();
    [lo, hi].iter().for_each(|x| out.extend(x.to_le_bytes()));
    number(&mut out, means.plan.dtype.num_bytes() as u32);
    number(&mut out, means.levels[0].len() as u32);
    number(&mut out, means.plan.kept.len() as u32);
    for (shape, _) in &means.plan.kept {
        shape.dims.iter().chain(&shape.factor).for_each(|n| number(&mut out, *n));
    }
    sums.iter().for_each(|sum| out.extend(sum.to_le_bytes()));
    let mut all = MAGIC.to_vec();
    number(&mut all, (MAGIC.len() + 4 + out.len() + 8) as u32);
    all.extend(out);
    let sum = fnv(&all);
    all.extend(sum.to_le_bytes());
    all
}

/// What the header of a file says.
#[derive(Clone, Debug, PartialEq)]
struct MeansHeader {
    are_labels: bool,
    gaps: GapNumbers,
    sums: Vec<u64>,
}

impl MeansHeader {
    /// The header in `bytes`, without the magic and its length; `None` unless it is of this volume and these levels.
    fn of(bytes: &[u8], key: &str, plan: &MeanPlan, num_channels: usize) -> Option<Self> {
        let mut rest = IndexBytes(bytes);
        let length = rest.number()? as usize;
        if rest.take(length)? != key.as_bytes() {
            return None;
        }
        let are_labels = rest.take(1)? == [1];
        let num_gaps = rest.number()? as usize;
        let numbers: Vec<f64> = rest.words(num_gaps)?.into_iter().map(f64::from_le_bytes).collect();
        let has_valid = rest.take(1)? == [1];
        let ends: Vec<f64> = rest.words(2)?.into_iter().map(f64::from_le_bytes).collect();
        let valid = has_valid.then_some((ends[0], ends[1]));
        if numbers.len() > MOST_GAPS || numbers.iter().chain(&ends).any(|x| !x.is_finite()) {
            return None;
        }
        let found = [rest.number()?, rest.number()?, rest.number()?].map(|n| n as usize);
        if found != [plan.dtype.num_bytes(), num_channels, plan.kept.len()] {
            return None;
        }
        for (shape, _) in &plan.kept {
            for expected in shape.dims.iter().chain(&shape.factor) {
                if rest.number()? != *expected {
                    return None;
                }
            }
        }
        let num_chunks = rest.0.len() / 8;
        let sums: Vec<u64> = rest.words(num_chunks)?.into_iter().map(u64::from_le_bytes).collect();
        let chunks = |shape: &PyramidLevel| boxes(shape.dims.map(u64::from), CHUNK_SIDE).count();
        let expected: usize = plan.kept.iter().map(|(shape, _)| chunks(shape) * num_channels).sum();
        (rest.0.is_empty() && sums.len() == expected).then_some(Self {
            are_labels,
            gaps: GapNumbers { numbers, valid },
            sums,
        })
    }
}

/// An opened file of levels.
pub(super) struct MeansFile {
    file: File,
    path: PathBuf,
    header: MeansHeader,
    /// Whether each chunk was found to be whole.
    are_whole: Vec<AtomicBool>,
    size: u64,
    num_channels: usize,
    /// Byte of the first number.
    start: u64,
}

impl MeansFile {
    /// Opens the file at `path`; `None` if there is none that is whole and of this volume and these levels.
    pub(super) fn open(path: &Path, key: &str, plan: &MeanPlan, num_channels: usize) -> Option<Arc<Self>> {
        Self::open_and_check(path, key, plan, num_channels, MOST_CHECKED)
    }

    /// The same, with all chunks checked at once if they have at most so many bytes.
    fn open_and_check(
        path: &Path,
        key: &str,
        plan: &MeanPlan,
        num_channels: usize,
        most_checked: u64,
    ) -> Option<Arc<Self>> {
        let mut file = open_file(path).ok()?;
        let mut start = [0; MAGIC.len() + 4];
        file.read_exact(&mut start).ok()?;
        let length = start.strip_prefix(MAGIC)?.first_chunk().map(|n| u32::from_le_bytes(*n))?;
        let num_bytes = file.metadata().ok()?.len();
        if u64::from(length) > num_bytes.min(MOST_HEADER) {
            return None;
        }
        let mut bytes = start.to_vec();
        bytes.resize((length as usize).max(start.len()), 0);
        file.read_exact(&mut bytes[start.len()..]).ok()?;
        let (bytes, sum) = bytes.split_last_chunk::<8>()?;
        if u64::from_le_bytes(*sum) != fnv(bytes) {
            return None;
        }
        let header = MeansHeader::of(bytes.get(start.len()..)?, key, plan, num_channels)?;
        let size = plan.dtype.num_bytes() as u64;
        let voxels = |shape: &PyramidLevel| shape.dims.iter().map(|&n| u64::from(n)).product::<u64>();
        let body: u64 = plan.kept.iter().map(|(shape, _)| voxels(shape) * size * num_channels as u64).sum();
        if num_bytes != u64::from(length) + body {
            return None;
        }
        let are_whole = header.sums.iter().map(|_| AtomicBool::new(false)).collect();
        let (path, start) = (path.to_owned(), length.into());
        let opened = Arc::new(Self { file, path, header, are_whole, size, num_channels, start });
        if body <= most_checked {
            let levels = MeanBoxes::of_levels(&opened, plan, 0);
            levels.iter().try_for_each(|level| level.check().ok())?;
        }
        Some(opened)
    }

    /// Whether the voxels are labels.
    pub(super) fn are_labels(&self) -> bool {
        self.header.are_labels
    }

    /// The levels as those of the file whose finest one is given.
    pub(super) fn levels(self: &Arc<Self>, plan: &MeanPlan, finest: &PageLevel) -> Vec<PageLevel> {
        let first = finest.chosen.channels.start;
        let readers = MeanBoxes::of_levels(self, plan, first);
        let of_level = |((shape, _), reader): (&(PyramidLevel, _), MeanBoxes)| {
            let mut axes = Axis::in_space(shape.dims.map(u64::from));
            axes.push(Axis { size: finest.chosen.channels.end.into(), role: Role::Channel });
            let own = Plan {
                axes,
                endian: Endian::Little,
                missing: self.missing(&finest.plan),
                are_labels: self.header.are_labels,
                ..(*finest.plan).clone()
            };
            let grid = finest.chosen.grid.coarser(shape.dims, shape.factor);
            let num_voxels = shape.dims.iter().map(|&n| u64::from(n)).product();
            let chosen = Arc::new(Chosen { grid, num_voxels, ..(*finest.chosen).clone() });
            PageLevel { plan: Arc::new(own), chosen, reader: Arc::new(reader), shape: *shape, is_kept: true }
        };
        plan.kept.iter().zip(readers).map(of_level).collect()
    }

    /// The values of voxels without one: those that the file tells, or those that were found among all of its numbers.
    fn missing(&self, plan: &Plan) -> Missing {
        let gaps = &self.header.gaps;
        if plan.missing != Missing::default() || self.header.are_labels {
            return plan.missing.clone();
        }
        let (slope, intercept) = plan.value_map;
        let values = gaps.numbers.iter().map(|x| slope * x + intercept).collect();
        Missing { values, ..Missing::default() }
    }
}

/// Boxes of a level of means.
struct MeanBoxes {
    file: Arc<MeansFile>,
    dims: [u64; 3],
    dtype: Dtype,
    /// Byte of the first number, and the number of the first chunk.
    start: u64,
    first_chunk: usize,
    /// The number of the first channel.
    first_channel: u64,
}

impl MeanBoxes {
    /// Those of all levels, whose channels begin with this number.
    fn of_levels(file: &Arc<MeansFile>, plan: &MeanPlan, first_channel: u32) -> Vec<Self> {
        let (mut start, mut first_chunk) = (file.start, 0);
        let level = |(shape, _): &(PyramidLevel, _)| {
            let dims = shape.dims.map(u64::from);
            let file = Arc::clone(file);
            let own = Self {
                file,
                dims,
                dtype: plan.dtype,
                start,
                first_chunk,
                first_channel: first_channel.into(),
            };
            first_chunk += own.num_chunks() * own.file.num_channels;
            start += dims.iter().product::<u64>() * own.file.size * own.file.num_channels as u64;
            own
        };
        plan.kept.iter().map(level).collect()
    }

    fn num_chunks(&self) -> usize {
        self.dims.iter().map(|n| n.div_ceil(CHUNK_SIDE) as usize).product()
    }

    /// Reads all chunks of all channels once.
    fn check(&self) -> Result<(), FormatError> {
        let of_channel =
            |channel| boxes(self.dims, CHUNK_SIDE).try_for_each(|(at, _)| self.chunk(channel, at).map(drop));
        (0..self.file.num_channels as u64).try_for_each(of_channel)
    }

    /// The numbers of the chunk of a channel that begins at a voxel.
    fn chunk(&self, channel: u64, at: [u64; 3]) -> Result<Vec<u8>, FormatError> {
        let (file, [nx, ny, _]) = (&*self.file, self.dims);
        let [x, y, z] = [0, 1, 2].map(|k| CHUNK_SIDE.min(self.dims[k] - at[k]));
        // Chunks before it fill whole layers, whole rows of this layer, and a part of this row.
        let before = at[2] * ny * nx + z * (at[1] * nx + y * at[0]);
        let all = self.dims.iter().product::<u64>();
        let mut bytes = vec![0; (x * y * z * file.size) as usize];
        let place = self.start + (channel * all + before) * file.size;
        read_exact_at(&file.file, &mut bytes, place).map_err(io_error(&file.path))?;
        let [cx, cy, cz] = at.map(|n| (n / CHUNK_SIDE) as usize);
        let [mx, my, _] = self.dims.map(|n| n.div_ceil(CHUNK_SIDE) as usize);
        let number = self.first_chunk + channel as usize * self.num_chunks() + (cz * my + cy) * mx + cx;
        if !file.are_whole[number].load(Ordering::Relaxed) {
            if fnv(&bytes) != file.header.sums[number] {
                // The next session does without it.
                let _ = std::fs::remove_file(&file.path);
                let problem = "the index is damaged; `isinglass index` makes it anew".to_owned();
                return Err(FormatError::Data { path: shown(&file.path), problem });
            }
            file.are_whole[number].store(true, Ordering::Relaxed);
        }
        Ok(bytes)
    }
}

impl BoxReader for MeanBoxes {
    fn read(&self, selected: &[Steps]) -> Result<VoxelSink, FormatError> {
        let count: u64 = selected.iter().map(Steps::len).product();
        let sink = VoxelSink::new(self.dtype, Endian::Little, count as usize);
        let mut sink = sink.map_err(|_| io_error(&self.file.path)(std::io::ErrorKind::OutOfMemory.into()))?;
        sink.push_bytes(&self.read_numbers(selected)?);
        Ok(sink)
    }

    fn read_numbers(&self, selected: &[Steps]) -> Result<Vec<u8>, FormatError> {
        let [x, y, z, channel] = selected else { return Ok(Vec::new()) };
        let channel = channel.range.start - self.first_channel;
        let size = self.file.size as usize;
        let [nx, ny, nz] = [x, y, z].map(|steps| steps.len() as usize);
        let mut numbers = vec![0; nx * ny * nz * size];
        let met = [x, y, z].map(|s| s.range.start / CHUNK_SIDE..s.range.end.div_ceil(CHUNK_SIDE));
        for (cz, cy) in met[2].clone().flat_map(|cz| met[1].clone().map(move |cy| (cz, cy))) {
            for cx in met[0].clone() {
                let from = [cx, cy, cz].map(|n| n * CHUNK_SIDE);
                let side = [0, 1, 2].map(|k| CHUNK_SIDE.min(self.dims[k] - from[k]));
                let [xs, ys, zs] =
                    [(x, 0), (y, 1), (z, 2)].map(|(s, k)| s.within(from[k]..from[k] + side[k]));
                if [&xs, &ys, &zs].iter().any(|range| range.is_empty()) {
                    continue;
                }
                let bytes = self.chunk(channel, from)?;
                for (k, j) in zs.flat_map(|k| ys.clone().map(move |j| (k, j))) {
                    let row = ((z.at(k) - from[2]) * side[1] + y.at(j) - from[1]) * side[0];
                    let to = (k as usize * ny + j as usize) * nx;
                    for i in xs.clone() {
                        let at = (row + x.at(i) - from[0]) as usize * size;
                        let to = (to + i as usize) * size;
                        if x.step == 1 {
                            let length = (xs.end - i) as usize * size;
                            numbers[to..to + length].copy_from_slice(&bytes[at..at + length]);
                            break;
                        }
                        numbers[to..to + size].copy_from_slice(&bytes[at..at + size]);
                    }
                }
            }
        }
        Ok(numbers)
    }
}

/// The first bytes, with the version.
const MAGIC: &[u8] = b"isinglass means 1\n";
/// Longest header: the sums of the chunks of the largest volume with an index.
const MOST_HEADER: u64 = 64 << 20;
/// Levels of at most so many bytes are checked when they are opened, and others when they are read.
const MOST_CHECKED: u64 = 32 << 20;
/// Most numbers of voxels without a value.
const MOST_GAPS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::convert::average::{NumberBox, Rule};

    fn plan() -> MeanPlan {
        let level = |factor: u32, dims| PyramidLevel { dims, factor: [factor; 3], first: [1.5; 3] };
        let kept = vec![(level(4, [70, 66, 3]), [2; 3]), (level(8, [35, 33, 2]), [2; 3])];
        MeanPlan { before: vec![[2; 3], [2; 3]], kept, dtype: Dtype::Int16 }
    }

    /// Two channels of running numbers.
    fn written(folder: &Path) -> (PathBuf, MeanLevels) {
        let plan = plan();
        let mut means = MeanLevels::new(&plan, 2, folder).unwrap();
        (means.are_labels, means.gaps) = (true, GapNumbers { numbers: vec![-7.0], valid: Some((0.0, 9.0)) });
        for channel in 0..2u16 {
            let numbers = (0..70 * 66 * 3u16).map(|i| i.wrapping_mul(3 + channel));
            let bytes = numbers.flat_map(u16::to_le_bytes).collect();
            means.add(channel.into(), [0; 3], &NumberBox { bytes, dims: [70, 66, 3] }).unwrap();
        }
        means.reduce(&[Rule::Majority, Rule::Majority]).unwrap();
        let path = folder.join("a.means");
        write_means(&path, "key", &means).unwrap();
        (path, means)
    }

    #[test]
    fn levels_are_read_as_they_were_written_and_damage_is_met_when_it_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let (path, means) = written(folder.path());
        let all = |x: std::ops::Range<u64>, step: u64, channel: u64| {
            let along = |range: std::ops::Range<u64>| Steps { range, step: 1 };
            [Steps { range: x, step }, along(1..65), along(0..2), along(channel + 3..channel + 4)]
        };
        for most_checked in [0, u64::MAX] {
            let file = MeansFile::open_and_check(&path, "key", &plan(), 2, most_checked).unwrap();
            assert!(file.are_labels() && file.header.gaps == means.gaps);
            let boxes = MeanBoxes::of_levels(&file, &plan(), 3);
            for (channel, numbers) in means.levels[0].iter().enumerate() {
                let found = boxes[0].read_numbers(&all(5..70, 1, channel as u64)).unwrap();
                assert_eq!(found, numbers.read([5, 1, 0], [65, 64, 2]).unwrap().bytes);
                let some = boxes[0].read_numbers(&all(5..70, 3, channel as u64)).unwrap();
                let third =
                    |row: &[u8]| -> Vec<u8> { row.chunks(6).flat_map(|few| few[..2].to_vec()).collect() };
                assert_eq!(some, found.chunks(65 * 2).flat_map(third).collect::<Vec<u8>>());
                let last = [(0..35), (0..33), (0..2)].map(Steps::all);
                let last = [&last[..], &[Steps::all(channel as u64 + 3..channel as u64 + 4)]].concat();
                let coarse = means.levels[1][channel].read([0; 3], [35, 33, 2]).unwrap();
                assert_eq!(boxes[1].read_numbers(&last).unwrap(), coarse.bytes);
            }
        }
        // A number of the second chunk is another one.
        let mut bytes = std::fs::read(&path).unwrap();
        let at = bytes.len() - (2 * 70 * 66 * 3 + 2 * 35 * 33 * 2) * 2 + 64 * 64 * 3 * 2 + 5;
        bytes[at] ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        assert!(MeansFile::open_and_check(&path, "key", &plan(), 2, u64::MAX).is_none() && !path.exists());
        std::fs::write(&path, &bytes).unwrap();
        let file = MeansFile::open_and_check(&path, "key", &plan(), 2, 0).unwrap();
        let boxes = MeanBoxes::of_levels(&file, &plan(), 3);
        assert!(boxes[0].read_numbers(&all(0..64, 1, 0)).is_ok() && path.exists(), "the control");
        let problem = boxes[0].read_numbers(&all(0..70, 1, 0)).unwrap_err().to_string();
        assert!(problem.contains("the index is damaged") && problem.lines().count() == 1, "{problem}");
        assert!(!path.exists(), "the next session does without it");
    }

    /// Headers that make no sense, under a sum that is right.
    #[test]
    fn headers_that_cannot_be_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let (path, _) = written(folder.path());
        let bytes = std::fs::read(&path).unwrap();
        let opens = |bytes: &[u8], key: &str, num_channels: usize, plan: &MeanPlan| {
            std::fs::write(&path, bytes).unwrap();
            MeansFile::open_and_check(&path, key, plan, num_channels, 0).is_some()
        };
        assert!(opens(&bytes, "key", 2, &plan()), "the control");
        assert!(!opens(&bytes, "kez", 2, &plan()) && !opens(&bytes, "key", 1, &plan()));
        let mut other = plan();
        other.kept[1].0.factor = [8, 8, 4];
        assert!(!opens(&bytes, "key", 2, &other));
        assert!(!opens(&bytes, "key", 2, &MeanPlan { dtype: Dtype::Float, ..plan() }));
        let length = u32::from_le_bytes(*bytes[MAGIC.len()..].first_chunk().unwrap()) as usize;
        let mut random = 7u32;
        let mut num_opened = 0;
        for _ in 0..2000 {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let mut odd = bytes.clone();
            odd[MAGIC.len() + (random >> 8) as usize % (length - MAGIC.len() - 8)] = (random >> 24) as u8;
            let sum = fnv(&odd[..length - 8]);
            odd[length - 8..length].copy_from_slice(&sum.to_le_bytes());
            num_opened += u32::from(opens(&odd, "key", 2, &plan()));
        }
        // Sums of chunks may be any numbers until the chunks are read.
        assert!((1..1900).contains(&num_opened), "{num_opened}");
    }
}
