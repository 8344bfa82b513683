//! Makes the index of a file by reading all of its numbers once, in large boxes and on all cores.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;

use isinglass_core::volume::{PAGE_CELLS, PageSource, Volume, VolumeInfo, Voxels};

use super::blocks::{BoxParts, NumberBins, axis_parts};
use super::index::{PageIndex, PageIndexBuilder};
use super::index_file::IndexPlace;
use super::levels::PageLevel;
use super::means::{MeanLevels, MeanPlan};
use super::pages::FilePages;
use super::scan_rules::ScanRules;
use crate::convert::average::NumberBox;
use crate::convert::gaps::Tally;
use crate::decode::VoxelSink;
use crate::dtype::Endian;
use crate::error::{FormatError, io_error, shown};
use crate::labels::{judged_part, mark_labels, told_labels};
use crate::output::make_private_folder;
use crate::read_volume::MOST_READ_FOR_NUMBERS;
use crate::reading::Meaning;
use crate::source::OpenOptions;
use crate::web::is_address;

/// What reading all of a file tells: the index of its pages, and the levels of means of a file without levels.
#[derive(Debug)]
pub struct BuiltIndex {
    /// The index.
    pub index: PageIndex,
    pub(super) means: Option<MeanLevels>,
    /// Why there are no levels.
    pub(super) problem: Option<FormatError>,
}

/// A file whose index is made.
#[derive(Clone, Copy)]
pub(super) struct IndexRequest<'a> {
    pub(super) pages: &'a FilePages,
    pub(super) path: &'a Path,
    /// Where the index will be kept.
    pub(super) place: Option<&'a IndexPlace>,
    /// What the person says of the voxels.
    pub(super) meaning: Option<Meaning>,
    pub(super) max_bytes: u64,
    pub(super) cancel: Option<&'a AtomicBool>,
}

impl IndexRequest<'_> {
    /// Reads all numbers, and once more if what marks voxels without a value turns out to be something else than the
    /// coarsest level says. `progress` is called with the fraction that the first pass has read, 0 to 1.
    ///
    /// # Errors
    /// A part cannot be read, there are too many pages, or reading was cancelled.
    pub(super) fn build(&self, progress: Option<&dyn Fn(f32)>) -> Result<BuiltIndex, FormatError> {
        let are_labels = self.are_labels()?;
        let mut rules = ScanRules::of_base(self.pages, are_labels);
        let (mut found, tallies) = Pass::new(self, &rules).run(progress)?;
        let (gaps, by_all) = ScanRules::of_tallies(self.pages, &tallies, are_labels);
        if by_all != rules {
            rules = by_all;
            found = Pass::new(self, &rules).run(None)?.0;
        }
        if let Some(means) = &mut found.means {
            (means.are_labels, means.gaps) = (are_labels, gaps);
            if let Err(e) = means.reduce(&rules.means) {
                (found.means, found.problem) = (None, Some(io_error(self.path)(e)));
            }
        }
        Ok(found)
    }

    /// Whether the voxels are labels, as `convert` finds it.
    fn are_labels(&self) -> Result<bool, FormatError> {
        let level = self.level();
        let num_channels = level.chosen.channels.len() as u64;
        if let Some(known) = told_labels(&level.plan, self.meaning, num_channels) {
            return Ok(known);
        }
        let part = judged_part(level.shape.dims.map(u64::from), level.plan.dtype, self.max_bytes);
        let max = [0, 1, 2].map(|k| u64::from(part.max[k].unwrap_or(level.shape.dims[k])));
        let grid = level.chosen.grid.part(part.min.map(u64::from), max);
        let sink = level.reader.read(&level.steps(&grid, level.chosen.channels.start))?;
        let map = self.pages.pyramid().value_maps.first().copied().unwrap_or((1.0, 0.0));
        let voxels = grid.reorder(sink.into_voxels());
        let middle = Volume::new(grid.dims(), grid.spacing, voxels, map, VolumeInfo::default());
        Ok(middle.is_ok_and(|mut middle| {
            mark_labels(&mut middle, &level.plan, None, self.path).is_ok() && middle.info.are_labels
        }))
    }

    fn level(&self) -> &PageLevel {
        self.pages.level(0)
    }

    fn damaged(&self, problem: impl Into<String>) -> FormatError {
        FormatError::Data { path: shown(self.path), problem: problem.into() }
    }
}

/// One way through a file.
struct Pass<'a> {
    request: &'a IndexRequest<'a>,
    rules: &'a ScanRules,
    plan: Option<MeanPlan>,
    boxes: Vec<[Range<u32>; 3]>,
    num_threads: usize,
}

/// What is found in a box.
struct BoxNumbers {
    number: usize,
    parts: BoxParts,
    ranges: Vec<(f32, f32)>,
    tally: Tally,
    /// The numbers of the first kept level.
    means: Option<NumberBox>,
}

impl<'a> Pass<'a> {
    fn new(request: &'a IndexRequest<'a>, rules: &'a ScanRules) -> Self {
        let level = request.level();
        // A file with levels has its own.
        let plan = request.place.and_then(|_| request.pages.mean_plan());
        let cores = std::thread::available_parallelism().map_or(2, usize::from);
        let boxes = boxes(level, request.max_bytes / (8 * cores as u64));
        let num_threads = cores.min(boxes.len());
        Self { request, rules, plan, boxes, num_threads }
    }

    fn run(&self, progress: Option<&dyn Fn(f32)>) -> Result<(BuiltIndex, Vec<Tally>), FormatError> {
        let pyramid = self.request.pages.pyramid();
        let too_many = "more pages than an index holds, expected at most 16 777 216";
        let mut builder = PageIndexBuilder::new(pyramid).ok_or_else(|| self.request.damaged(too_many))?;
        let num_channels = pyramid.value_maps.len();
        let (mut means, mut problem) = (None, None);
        if let (Some(plan), Some(place)) = (&self.plan, self.request.place) {
            match make_private_folder(place.folder())
                .and_then(|()| MeanLevels::new(plan, num_channels, place.folder()))
            {
                Ok(made) => means = Some(made),
                Err(e) => problem = Some(io_error(place.folder())(e)),
            }
        }
        let mut tallies = Vec::new();
        for channel in 0..num_channels {
            let share = |done: f32| {
                if let Some(progress) = progress {
                    progress((channel as f32 + done) / num_channels as f32);
                }
            };
            let (tally, failed) = self.read_channel(channel, &mut builder, means.as_ref(), &share)?;
            tallies.push(tally);
            if let Some(e) = failed {
                (means, problem) = (None, Some(io_error(self.request.path)(e)));
            }
        }
        let nothing = || self.request.damaged("a channel has no voxel with a value, expected one");
        let index = builder.finish_all().ok_or_else(nothing)?;
        Ok((BuiltIndex { index, means, problem }, tallies))
    }

    /// Reads a channel. Returns what keeps its means from being kept, too.
    fn read_channel(
        &self,
        channel: usize,
        builder: &mut PageIndexBuilder,
        means: Option<&MeanLevels>,
        progress: &dyn Fn(f32),
    ) -> Result<(Tally, Option<std::io::Error>), FormatError> {
        let next = AtomicUsize::new(0);
        let (mut tally, mut failed, mut num_done) = (Tally::NONE, None, 0);
        std::thread::scope(|scope| {
            let (send, found) = mpsc::sync_channel(self.num_threads);
            let threads: Vec<_> = (0..self.num_threads)
                .map(|_| {
                    let (send, next) = (send.clone(), &next);
                    scope.spawn(move || self.count_boxes(channel, next, &send))
                })
                .collect();
            drop(send);
            let mut merge = |found: BoxNumbers| {
                found.parts.widen(builder, channel, &found.ranges);
                tally = tally.and(found.tally);
                if let (Some(means), Some(numbers), None) = (means, found.means, &failed) {
                    let at = self.boxes[found.number].each_ref().map(|span| span.start);
                    failed = means.add(channel, at, &numbers).err();
                }
                num_done += 1;
                progress(num_done as f32 / self.boxes.len() as f32);
            };
            // The receiver goes with the first error, and then the threads end.
            let outcome =
                found.into_iter().try_for_each(|found: Result<BoxNumbers, _>| found.map(&mut merge));
            for bins in threads.into_iter().filter_map(|thread| thread.join().ok()) {
                bins.tables().for_each(|table| builder.add_bins(channel, table));
            }
            outcome
        })?;
        if num_done < self.boxes.len() {
            return Err(self.request.damaged("reading a part of it failed"));
        }
        Ok((tally, failed))
    }

    /// Counts boxes until none is left.
    fn count_boxes(
        &self,
        channel: usize,
        next: &AtomicUsize,
        send: &mpsc::SyncSender<Result<BoxNumbers, FormatError>>,
    ) -> NumberBins {
        let mut bins = NumberBins::new(self.request.pages.pyramid().kind);
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= self.boxes.len() {
                return bins;
            }
            let found = self.count_box(channel, number, &mut bins);
            let is_over = found.is_err();
            if send.send(found).is_err() || is_over {
                return bins;
            }
        }
    }

    fn count_box(
        &self,
        channel: usize,
        number: usize,
        bins: &mut NumberBins,
    ) -> Result<BoxNumbers, FormatError> {
        let request = self.request;
        if request.cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed)) {
            return Err(FormatError::Cancelled { path: shown(request.path) });
        }
        let (level, span) = (request.level(), &self.boxes[number]);
        let dtype = level.plan.dtype;
        let ends = |end: fn(&Range<u32>) -> u32| span.each_ref().map(|s| u64::from(end(s)));
        let grid = level.chosen.grid.part(ends(|s| s.start), ends(|s| s.end));
        let steps = level.steps(&grid, level.chosen.channels.start + channel as u32);
        let bytes = grid.reorder_numbers(level.reader.read_numbers(&steps)?, dtype.num_bytes());
        let sink = VoxelSink::new(dtype, Endian::Little, bytes.len() / dtype.num_bytes());
        let mut sink = sink.map_err(|_| io_error(request.path)(std::io::ErrorKind::OutOfMemory.into()))?;
        sink.push_bytes(&bytes);
        let mut voxels = sink.into_voxels();
        let mut gaps = self.rules.gaps[channel].gaps(&voxels).map_err(|problem| request.damaged(problem))?;
        // A channel without any value has zeros.
        if self.rules.gaps[channel].is_empty && gaps.as_ref().is_some_and(|gaps| gaps.iter().all(|g| *g != 0))
        {
            (voxels, gaps) = (Voxels::F32(vec![0.0; voxels.len()]), None);
        }
        let pyramid = request.pages.pyramid();
        let parts = |k: usize| axis_parts(&level.shape, pyramid.pages(0)[k], k, span[k].clone());
        let parts = BoxParts([0, 1, 2].map(parts));
        let ranges = parts.count(&voxels, gaps.as_deref(), bins);
        drop(voxels);
        let tally = Tally::of(&bytes, dtype, level.plan.value_map);
        let dims = span.each_ref().map(|s| (s.end - s.start) as usize);
        let numbers = NumberBox { bytes, dims };
        let means = self.plan.as_ref().map(|plan| plan.first_of(numbers, &self.rules.means[channel]));
        Ok(BoxNumbers { number, parts, ranges, tally, means })
    }
}

/// The boxes in which the numbers of a level are read, in the order of the file: of whole blocks of 64³ voxels, along all
/// of the file's rows if memory allows.
fn boxes(level: &PageLevel, most_bytes: u64) -> Vec<[Range<u32>; 3]> {
    let dims = level.shape.dims;
    let size = level.plan.dtype.num_bytes() as u64;
    // The axes of the volume from the file's fastest to its slowest.
    let order = level.chosen.grid.order;
    let axes = [0, 1, 2].map(|i| (0..3).find(|&k| order[k].0 == i).unwrap_or(i));
    let mut side = dims.map(|n| n.min(PAGE_CELLS));
    for (i, k) in axes.into_iter().enumerate() {
        let most = if i == 0 { MOST_OF_ROWS } else { MOST_AT_ONCE }.min(most_bytes);
        let bytes = side.iter().fold(size, |n, side| n * u64::from(*side));
        let fits = (most / bytes.max(1)).max(1).min(u64::from(dims[k].div_ceil(PAGE_CELLS)));
        side[k] = side[k].max(fits as u32 * PAGE_CELLS).min(dims[k].max(PAGE_CELLS));
        if side[k] < dims[k] {
            break;
        }
    }
    let counts = [0, 1, 2].map(|k| dims[k].div_ceil(side[k]));
    let span = |k: usize, i: u32| {
        // What is reversed in the file is read from its end.
        let i = if order[k].1 { counts[k] - 1 - i } else { i };
        i * side[k]..((i + 1) * side[k]).min(dims[k])
    };
    let [a, b, c] = axes;
    let all =
        (0..counts[c]).flat_map(|z| (0..counts[b]).flat_map(move |y| (0..counts[a]).map(move |x| [x, y, z])));
    all.map(|at| {
        let mut spans = [0..0, 0..0, 0..0];
        axes.into_iter().zip(at).for_each(|(k, i)| spans[k] = span(k, i));
        spans
    })
    .collect()
}

/// The index that is kept, or that of a small volume, which is kept then. Returns whether it was made and kept just now.
///
/// # Errors
/// If reading was cancelled.
pub(super) fn known_index(
    request: &IndexRequest,
    options: &OpenOptions,
) -> Result<(Option<PageIndex>, bool), FormatError> {
    let pyramid = request.pages.pyramid();
    let num_channels = pyramid.value_maps.len();
    let is_alike =
        |index: &PageIndex| (index.pages(), index.num_channels()) == (pyramid.pages(0), num_channels);
    if let Some(index) = request.place.and_then(IndexPlace::read).filter(is_alike) {
        return Ok((Some(index), false));
    }
    let bytes = (pyramid.kind.bytes() * num_channels) as u64;
    let bytes = pyramid.dims().iter().fold(bytes, |n, &m| n.saturating_mul(m.into()));
    if bytes > MOST_READ_FOR_NUMBERS || is_address(&request.path.to_string_lossy()) {
        return Ok((None, false));
    }
    match request.build(options.progress) {
        Ok(built) => {
            // A folder that cannot be written to costs only time.
            let is_kept = request.place.is_some_and(|place| built.keep(place).is_ok());
            Ok((Some(built.index), is_kept))
        }
        Err(e @ FormatError::Cancelled { .. }) => Err(e),
        Err(_) => Ok((None, false)),
    }
}

impl BuiltIndex {
    /// Keeps all of it. Returns the file of the index.
    ///
    /// # Errors
    /// If the system refuses, or refused before.
    pub(super) fn keep(&self, place: &IndexPlace) -> Result<PathBuf, FormatError> {
        let file = place.write(&self.index)?;
        if let Some(means) = &self.means {
            place.write_means(means)?;
        }
        match &self.problem {
            Some(e) => Err(FormatError::Data { path: shown(&file), problem: e.to_string() }),
            None => Ok(file),
        }
    }
}

/// Most bytes of a box of more than one row of blocks.
const MOST_AT_ONCE: u64 = 16 << 20;
/// Most bytes of a row of blocks along the file's rows.
const MOST_OF_ROWS: u64 = 64 << 20;
