//! Converts a volume to a pyramid in OME-Zarr: all channels and times, in bounded memory, whole or not at all. A run that
//! was stopped goes on where it was.
//!
//! The numbers of a file pass once, from the front to the end. A layer of chunks across the slowest axis is collected in
//! memory, or in a file where it is too large, and written. Files of chunks are read part by part. Each coarser level is
//! made from the chunks of the one above.

pub(crate) mod average;
mod finest;
pub(crate) mod gaps;
mod layout;
mod levels;
mod part;

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::{ThreadPool, ThreadPoolBuilder};

use self::gaps::{Tally, level_rules};
use self::layout::Layout;
use self::part::{Journal, PartFolder, files_of};
use crate::dtype::Dtype;
use crate::error::{FormatError, io_error, shown};
use crate::labels::{judged_part, told_labels};
use crate::outline::Level;
use crate::padding::GapNumbers;
use crate::paged::open_paged;
use crate::plan::{Chosen, Plan, Role, VolumeFile};
use crate::reading::{Meaning, Reading};
use crate::selection::Selection;
use crate::source::{OpenOptions, file_name, open, open_any};
use crate::web::is_address;
use crate::zarr::{ArrayWriter, ImageFacts, PyramidLevel, pyramid_levels, write_document};

/// A conversion that has read the header of its source, and begun or found its unfinished result.
pub struct Conversion<'a> {
    source: &'a str,
    target: PathBuf,
    options: OpenOptions<'a>,
    /// The path of the source.
    path: PathBuf,
    plan: Plan,
    chosen: Chosen,
    layout: Layout,
    /// How often the source is read, each time with this channel selected. Channels that an axis has pass at once.
    passes: Vec<Option<u32>>,
    levels: Vec<PyramidLevel>,
    arrays: Vec<ArrayWriter>,
    is_chunked: bool,
    /// The parts that are read at once of a file of chunks, or that follow each other in another file.
    groups: Vec<Vec<Range<u64>>>,
    part: PartFolder,
    journal: Journal,
    notes: Vec<String>,
    threads: ThreadPool,
}

/// What a conversion made.
#[derive(Clone, Debug, PartialEq)]
pub struct Converted {
    /// Whether the voxels are labels, so that the levels have those that are most frequent.
    pub are_labels: bool,
    /// What the reader says about the voxels.
    pub notes: Vec<String>,
}

impl<'a> Conversion<'a> {
    /// Reads the header of `source`, a source of [`crate::open`], and begins to convert it to the folder `target`. It
    /// finds what an earlier run has done. The options select channel, time, series and region, and limit the memory.
    ///
    /// # Errors
    /// The source cannot be read, the target exists or cannot be made, or too little memory is allowed.
    pub fn begin(source: &'a str, target: &Path, options: &OpenOptions<'a>) -> Result<Self, FormatError> {
        let selection = options.selection;
        let level = Some(selection.level.unwrap_or(0));
        let options = OpenOptions { selection: Selection { level, ..selection }, ..*options };
        let (path, file) = open_any(source, &options)?;
        let plan = file.plan().clone();
        let passes = passes(source, &plan, &options)?;
        let first = OpenOptions { selection: of_pass(&options, passes[0]), ..options };
        let chosen = plan.choose_all(&path, &first)?;
        let layout = Layout::new(&plan, &chosen, SIDE);
        let is_chunked = file.is_chunked();
        let most = options.max_bytes / 3;
        let groups = if is_chunked { layout.blocks(most) } else { layout.groups() };
        let strip = |group: &Vec<Range<u64>>| layout.strips(group).iter().map(|s| layout.num_bytes(s)).max();
        let needed = if is_chunked {
            groups.iter().map(|block| layout.num_bytes(block)).max()
        } else {
            groups.iter().filter_map(strip).max()
        };
        let needed = needed.unwrap_or(0).max(WORKING_CHUNKS * SIDE.pow(3) * plan.dtype.num_bytes() as u64);
        options.check_memory(&path, needed.saturating_mul(3))?;
        let spacing = plan.spacing_of(&options).map_err(crate::error::malformed(&path, &plan.format))?;
        let spacing = chosen.grid.order.map(|(axis, _)| spacing[axis]);
        let levels = pyramid_levels(layout.dims, spacing);
        let fingerprint = fingerprint(source, &path, &options, &plan, groups.len());
        let (part, mut journal) = PartFolder::open(target, fingerprint)?;
        let mut notes: Vec<String> = chosen.warnings.iter().map(|w| w.text.clone()).collect();
        notes.extend(plan.spacing_guess.clone().filter(|_| options.spacing.is_none()));
        let num_channels = layout.num_channels() * passes.len() as u64;
        let (t, c) = (several(layout.num_times()), several(num_channels));
        let array = |(i, level): (usize, &PyramidLevel)| {
            ArrayWriter::new(part.image().join(i.to_string()), level.dims, SIDE, t, c, plan.dtype)
        };
        let arrays: Vec<_> = levels.iter().enumerate().map(array).collect();
        journal.tallies.resize((layout.num_times() * num_channels) as usize, Tally::NONE);
        let target = target.to_owned();
        let threads = threads(&path, options.max_bytes, arrays[0].bytes_of_chunk())?;
        Ok(Self {
            source,
            target,
            options,
            path,
            plan,
            chosen,
            layout,
            passes,
            levels,
            arrays,
            is_chunked,
            groups,
            part,
            journal,
            notes,
            threads,
        })
    }

    /// The levels, the finest first.
    pub fn levels(&self) -> Vec<Level> {
        self.levels.iter().map(|level| Level { dims: level.dims, spacing: level.spacing }).collect()
    }

    /// The type of the voxels.
    pub fn dtype(&self) -> Dtype {
        self.plan.dtype
    }

    /// Channels and points in time.
    pub fn num_channels_and_times(&self) -> [u64; 2] {
        [self.num_channels(), self.layout.num_times()]
    }

    /// Bytes of all numbers. Packed, they are hardly ever more.
    pub fn most_bytes(&self) -> u64 {
        let num_volumes = self.num_channels() * self.layout.num_times();
        let num_voxels = self.levels.iter().fold(0u64, |n, level| n.saturating_add(level.num_voxels()));
        num_voxels.saturating_mul(num_volumes).saturating_mul(self.plan.dtype.num_bytes() as u64)
    }

    /// The fraction that an earlier run has done, 0 to 1.
    pub fn done(&self) -> f32 {
        self.fraction(self.journal.num_done)
    }

    /// Where the unfinished result is.
    pub fn part_folder(&self) -> &Path {
        self.part.path()
    }

    /// What the header says that may matter.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Converts. The target appears at the end.
    ///
    /// # Errors
    /// The source is damaged, the system refuses, or the options cancel. What is done stays for another run, unless the
    /// source is damaged.
    pub fn run(mut self) -> Result<Converted, FormatError> {
        match self.make() {
            Ok(mut found) => {
                self.part.finish(&self.target)?;
                found.notes.extend(leave_index(&self.target, &self.options, found.are_labels));
                Ok(found)
            }
            // A full disk, a slow server and a person who stops are no reason to begin anew. A damaged file is.
            Err(e)
                if is_address(self.source)
                    || matches!(e, FormatError::Io { .. } | FormatError::Cancelled { .. }) =>
            {
                Err(e)
            }
            Err(e) => {
                self.part.remove();
                Err(e)
            }
        }
    }

    /// Writes everything into the unfinished result.
    fn make(&mut self) -> Result<Converted, FormatError> {
        self.describe(false, &GapNumbers::default())?;
        self.part.note(&self.journal)?;
        let notes = self.write_finest()?;
        let are_labels = match self.journal.are_labels {
            Some(known) => known,
            None => self.are_labels(),
        };
        self.journal.are_labels = Some(are_labels);
        let (all, rules) = level_rules(&self.plan, &self.journal.tallies, are_labels);
        self.describe(are_labels, &all)?;
        self.part.note(&self.journal)?;
        self.write_coarser(&rules)?;
        Ok(Converted { are_labels, notes })
    }

    /// Writes the metadata.
    fn describe(&self, are_labels: bool, gaps: &GapNumbers) -> Result<(), FormatError> {
        let folder = self.part.image();
        let [x, y, z] = self.layout.dims;
        let levels = &self.levels;
        let first = self.chosen.grid.placement.map(|place| {
            let half = [x, y, z].map(|n| (n as f64 - 1.0) / 2.0);
            std::array::from_fn(|k| place.center[k] - half[k] * levels[0].spacing[k])
        });
        let from = self.passes[0].map_or(u64::from(self.chosen.channels.start), u64::from);
        let facts = ImageFacts {
            name: file_name(&self.path),
            plan: &self.plan,
            levels,
            first,
            world: self.plan.geometry.world,
            num_times: several(self.layout.num_times()),
            num_channels: several(self.num_channels()),
            channels: from..from + self.num_channels(),
            are_labels,
            gaps,
        };
        for array in &self.arrays {
            array.describe(&facts.of_array())?;
        }
        write_document(&folder.join(".zgroup"), &serde_json::json!({"zarr_format": 2}))?;
        write_document(&folder.join(".zattrs"), &facts.of_group())
    }

    /// Whether the voxels are labels, as the file, the person or the look of the finest level says.
    fn are_labels(&self) -> bool {
        if let Some(known) = told_labels(&self.plan, self.options.reading.voxels, self.num_channels()) {
            return known;
        }
        let region = judged_part(self.layout.dims, self.plan.dtype, self.options.max_bytes);
        let selection =
            Selection { level: Some(0), time: Some(0), region: Some(region), ..Selection::default() };
        let options = OpenOptions {
            selection,
            max_bytes: self.options.max_bytes,
            cancel: self.options.cancel,
            ..OpenOptions::default()
        };
        let image = self.part.image();
        open(&image.to_string_lossy(), &options).is_ok_and(|volume| volume.info.are_labels)
    }

    fn num_channels(&self) -> u64 {
        self.layout.num_channels() * self.passes.len() as u64
    }

    /// Notes a step that is done.
    fn done_with_step(&mut self) -> Result<(), FormatError> {
        self.journal.num_done += 1;
        self.part.note(&self.journal)?;
        self.report(0.0);
        self.options.check_cancelled(&self.path)
    }

    /// Reports what is done, and a part of the next step.
    fn report(&self, part: f32) {
        if let Some(progress) = self.options.progress {
            progress(self.fraction_with(part));
        }
    }

    /// The fraction that is done, with a part of the next step.
    fn fraction_with(&self, part: f32) -> f32 {
        let from = self.fraction(self.journal.num_done);
        from + part * (self.fraction(self.journal.num_done + 1) - from)
    }

    /// The fraction of the work that is done after so many steps.
    fn fraction(&self, num_done: u64) -> f32 {
        let num_finest = self.num_finest_steps();
        let voxels = |level: &PyramidLevel| level.num_voxels() as f64;
        // To make a level, the one above is read; to make the finest, the source is read and all is packed.
        let weights: Vec<f64> = self
            .levels
            .iter()
            .enumerate()
            .map(|(i, level)| if i == 0 { voxels(level) } else { voxels(&self.levels[i - 1]) / 2.0 })
            .collect();
        let all: f64 = weights.iter().sum();
        let (mut rest, mut done) = (num_done as f64, 0.0);
        for (i, weight) in weights.iter().enumerate() {
            let num = if i == 0 { num_finest } else { self.num_coarser_steps(i) };
            let here = rest.min(num as f64);
            done += weight * here / (num as f64).max(1.0);
            rest -= here;
        }
        let share = if self.options.index_folder.is_some() { SHARE_BEFORE_INDEX } else { 1.0 };
        (done / all) as f32 * share
    }

    fn num_finest_steps(&self) -> u64 {
        (self.groups.len() * self.passes.len()) as u64
    }

    /// Opens the source once more, with the channel of a pass.
    fn reopened(&self, pass: usize) -> Result<(OpenOptions<'a>, Box<dyn VolumeFile>), FormatError> {
        let selection = of_pass(&self.options, self.passes[pass]);
        // A chunk is in memory packed, as bytes, and as a part of a block.
        let max_bytes = if self.is_chunked { self.options.max_bytes / 4 } else { self.options.max_bytes };
        let options = OpenOptions { selection, max_bytes, ..self.options };
        Ok((options, open_any(self.source, &options)?.1))
    }
}

/// Keeps the index of an image that was made, in the folder of the options. Returns a word if that fails: the image is
/// whole all the same.
fn leave_index(image: &Path, options: &OpenOptions, are_labels: bool) -> Option<String> {
    let folder = options.index_folder?;
    let report = |done: f32| {
        if let Some(progress) = options.progress {
            progress(SHARE_BEFORE_INDEX + (1.0 - SHARE_BEFORE_INDEX) * done);
        }
    };
    let OpenOptions { max_bytes, cancel, .. } = *options;
    // To judge again would read a part of the volume again.
    let voxels = Some(if are_labels { Meaning::Labels } else { Meaning::Values });
    let reading = Reading { voxels, ..Reading::default() };
    let own = OpenOptions {
        index_folder: Some(folder),
        max_bytes,
        cancel,
        reading: &reading,
        ..OpenOptions::default()
    };
    let keep = || -> Result<(), FormatError> {
        let paged = open_paged(&image.to_string_lossy(), &own)?;
        if !paged.is_indexed() {
            paged.keep_index(&paged.build_index(Some(&report), cancel)?)?;
        }
        Ok(())
    };
    match keep() {
        Ok(()) => None,
        Err(FormatError::Cancelled { .. }) => {
            Some("it is whole and has no index: it was stopped there".into())
        }
        Err(e) => Some(format!("it is whole and has no index: {e}")),
    }
}

/// Returns an error if the conversion was cancelled. Threads ask this.
fn check_cancelled(cancel: Option<&AtomicBool>, path: &Path) -> Result<(), FormatError> {
    match cancel {
        Some(cancel) if cancel.load(Ordering::Relaxed) => Err(FormatError::Cancelled { path: shown(path) }),
        _ => Ok(()),
    }
}

/// The length of an axis, which an image has only for several entries.
fn several(num: u64) -> Option<u64> {
    (num > 1).then_some(num)
}

/// Threads that pack chunks, as many as the memory allows.
fn threads(path: &Path, max_bytes: u64, bytes_of_chunk: u64) -> Result<ThreadPool, FormatError> {
    let bytes_each = (WORKING_CHUNKS * bytes_of_chunk).max(1);
    let most = (max_bytes / 3 / bytes_each).clamp(1, MOST_THREADS) as usize;
    let found = std::thread::available_parallelism().map_or(2, usize::from).max(2);
    let threads = ThreadPoolBuilder::new().num_threads(found.min(most)).thread_name(|_| "convert".into());
    threads.build().map_err(|e| io_error(path)(std::io::Error::other(e)))
}

/// The channels that are selected one after the other: `None` once, if an axis of the file has them all.
fn passes(source: &str, plan: &Plan, options: &OpenOptions) -> Result<Vec<Option<u32>>, FormatError> {
    let has_axis = plan.axes.iter().any(|axis| axis.role == Role::Channel);
    if has_axis || options.selection.channel.is_some() || plan.channels() == 1 {
        return Ok(vec![options.selection.channel.filter(|_| !has_axis)]);
    }
    let channels: Vec<Option<u32>> = (0..plan.channels() as u32).map(Some).collect();
    let sizes = |plan: &Plan| (plan.dtype.name(), plan.axes.iter().map(|axis| axis.size).collect::<Vec<_>>());
    for channel in &channels {
        let options = OpenOptions { selection: of_pass(options, *channel), ..*options };
        let (path, file) = open_any(source, &options)?;
        let (own, first) = (sizes(file.plan()), sizes(plan));
        if own != first {
            let problem = format!(
                "arrays of different sizes or types, {:?} {} and {:?} {}, expected like ones; --channel selects one",
                first.1, first.0, own.1, own.0
            );
            return Err(FormatError::Data { path: shown(&path), problem });
        }
    }
    Ok(channels)
}

/// The selection with the channel of a pass.
fn of_pass(options: &OpenOptions, channel: Option<u32>) -> Selection {
    Selection { channel: channel.or(options.selection.channel), ..options.selection }
}

/// What must be the same for another run to go on.
fn fingerprint(source: &str, path: &Path, options: &OpenOptions, plan: &Plan, num_groups: usize) -> String {
    let real = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let is_file = !is_address(source) && !source.starts_with("builtin:");
    let files = if is_file { files_of(&real) } else { source.to_owned() };
    let OpenOptions { raw, selection, spacing, foreign_files, reading, .. } = options;
    let options = format!("{raw:?} {selection:?} {spacing:?} {foreign_files} {reading:?}");
    let found = format!("{:?} {:?} {:?} {:?}", plan.dtype, plan.axes, plan.value_map, plan.geometry);
    let version = env!("CARGO_PKG_VERSION");
    format!("{version}; {}; {files}; {options}; {found}; {num_groups}", real.display())
}

/// The part of the work that is done before the index is made.
const SHARE_BEFORE_INDEX: f32 = 0.85;
/// Voxels along a side of a chunk.
const SIDE: u64 = 64;
/// Chunks that a thread has in memory at once: eight of the level above, one that is made, and its packed forms.
const WORKING_CHUNKS: u64 = 12;
const MOST_THREADS: u64 = 32;
