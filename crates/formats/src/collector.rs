//! Collects the selected voxels from the data of a file, and reports progress.

use std::io::{self, BufRead};
use std::path::Path;
use std::sync::atomic::AtomicBool;

use isinglass_core::volume::Voxels;

use crate::channels::{ChannelSinks, Piece, StreamShape};
use crate::decode::{Decoded, next_number};
use crate::dtype::Dtype;
use crate::error::{FormatError, io_error, quoted, shown};
use crate::hyperslab::{Hyperslab, Steps};
use crate::plan::{Chosen, Plan, Role};
use crate::source::OpenOptions;
use crate::stream::Stream;
use crate::warning::{Warning, WarningKind};

/// Takes the bytes of the selected numbers in the order of the file.
pub(crate) trait NumberSink {
    /// The bytes of the next numbers, all of them whole.
    fn push(&mut self, bytes: &[u8]) -> Result<(), FormatError>;

    /// The fraction that is done, 0 to 1.
    fn progress(&self) -> f32;
}

/// Collects the selected voxels. Memory is allocated with the first voxel, so readers can check lengths before.
pub(crate) struct Collector<'a> {
    /// Shape of the file for messages, such as `256×256×128 uint8`.
    shape: String,
    dtype: Dtype,
    endian: crate::dtype::Endian,
    path: &'a Path,
    options: &'a OpenOptions<'a>,
    chosen: &'a Chosen,
    hyperslab: Hyperslab,
    channel_axis: Option<usize>,
    sinks: Option<ChannelSinks>,
    /// Takes the numbers as they come, in place of the sinks.
    stream: Option<&'a mut (dyn NumberSink + 'a)>,
    /// Whether the sinks take the bytes of numbers as they are.
    is_raw: bool,
    has_gaps: bool,
    warnings: Vec<Warning>,
}

impl<'a> Collector<'a> {
    pub(crate) fn new(plan: &Plan, chosen: &'a Chosen, path: &'a Path, options: &'a OpenOptions<'a>) -> Self {
        let sizes: Vec<String> = plan.axes.iter().map(|a| a.size.to_string()).collect();
        let axes: Vec<(u64, Steps)> =
            plan.axes.iter().map(|a| a.size).zip(chosen.selected.iter().cloned()).collect();
        Self {
            shape: format!("{} {}", sizes.join("×"), plan.dtype.name()),
            dtype: plan.dtype,
            endian: plan.endian,
            path,
            options,
            chosen,
            hyperslab: Hyperslab::new(&axes),
            channel_axis: plan.axes.iter().position(|a| a.role == Role::Channel),
            sinks: None,
            stream: None,
            is_raw: false,
            has_gaps: plan.has_gaps,
            warnings: Vec::new(),
        }
    }

    /// Collects the bytes of each number as they are in the file, for [`Collector::finish_raw`]. The file places boxes.
    pub(crate) fn raw(plan: &Plan, chosen: &'a Chosen, path: &'a Path, options: &'a OpenOptions<'a>) -> Self {
        Self { is_raw: true, ..Self::new(plan, chosen, path, options) }
    }

    /// Passes the selected numbers after the first `num_done` to `stream`, for [`Collector::finish_stream`]. The file
    /// does not place boxes.
    pub(crate) fn streaming(
        plan: &Plan,
        chosen: &'a Chosen,
        path: &'a Path,
        options: &'a OpenOptions<'a>,
        num_done: u64,
        stream: &'a mut (dyn NumberSink + 'a),
    ) -> Self {
        let mut collector = Self { stream: Some(stream), ..Self::new(plan, chosen, path, options) };
        collector.hyperslab.leave_out(num_done);
        collector
    }

    /// Whether the boxes that are placed have the bytes of numbers, as a first axis of them.
    pub(crate) fn is_raw(&self) -> bool {
        self.is_raw
    }

    /// Numbers in the whole file.
    pub(crate) fn num_elements(&self) -> u64 {
        self.chosen.in_file
    }

    /// Bytes of all numbers in the file.
    pub(crate) fn num_bytes(&self) -> u64 {
        self.chosen.in_file * self.dtype.num_bytes() as u64
    }

    pub(crate) fn bytes_per_number(&self) -> u64 {
        self.dtype.num_bytes() as u64
    }

    /// The selection along each axis of the plan.
    pub(crate) fn selected(&self) -> &'a [Steps] {
        &self.chosen.selected
    }

    /// The axis of the plan that has the channels, if there is one.
    pub(crate) fn channel_axis(&self) -> Option<usize> {
        self.channel_axis
    }

    /// The flag that ends the reading.
    pub(crate) fn cancel(&self) -> Option<&'a AtomicBool> {
        self.options.cancel
    }

    /// Position in the file, in numbers.
    pub(crate) fn position(&self) -> u64 {
        self.hyperslab.position()
    }

    /// Numbers before the next selected one.
    pub(crate) fn gap(&self) -> u64 {
        self.hyperslab.gap()
    }

    /// Whether all selected voxels have been collected.
    pub(crate) fn is_done(&self) -> bool {
        self.hyperslab.is_done()
    }

    /// Skips `count` numbers that are not selected.
    pub(crate) fn pass(&mut self, count: u64) {
        self.hyperslab.pass(count);
    }

    /// Collects the selected numbers in `bytes`, which contain whole numbers.
    pub(crate) fn push(&mut self, bytes: &[u8]) -> Result<(), FormatError> {
        let size = self.dtype.num_bytes();
        let count = (bytes.len() / size) as u64;
        if let Some(stream) = &mut self.stream {
            let mut pushed = Ok(());
            self.hyperslab.take(count, |range, _| {
                if pushed.is_ok() {
                    pushed = stream.push(&bytes[range.start * size..range.end * size]);
                }
            });
            pushed?;
            return self.tick();
        }
        self.sinks(None)?;
        if let Some(sinks) = &mut self.sinks {
            let take = |range: std::ops::Range<usize>, step| {
                sinks.push(&bytes[range.start * size..range.end * size], step);
            };
            self.hyperslab.take(count, take);
        }
        self.tick()
    }

    /// Makes each voxel the number whose bytes are `fill`. Boxes of others can then be placed in any order.
    pub(crate) fn fill(&mut self, fill: &[u8]) -> Result<(), FormatError> {
        self.sinks(Some(fill)).map(drop)
    }

    /// Puts boxes of voxels in their places, after [`Collector::fill`]. Counts `num_passed` selected numbers.
    pub(crate) fn place(&mut self, pieces: Vec<Piece>, num_passed: u64) -> Result<(), FormatError> {
        let bytes_each = if self.is_raw { self.bytes_per_number() } else { 1 };
        self.sinks(None)?.place(pieces, num_passed * bytes_each);
        self.tick()
    }

    /// Collects a number that was written as text, if it is selected.
    fn push_number(&mut self, path: &Path, number: Result<f64, String>) -> Result<(), FormatError> {
        let (index, name) = (self.hyperslab.position(), self.dtype.name());
        let mut is_good = number.is_ok();
        let encoded = number.as_ref().ok().and_then(|x| self.dtype.bytes_of(*x, self.endian));
        if let Some(stream) = &mut self.stream {
            let mut pushed = Ok(());
            self.hyperslab.take(1, |_, _| match &encoded {
                Some(bytes) => pushed = stream.push(bytes),
                None => is_good = false,
            });
            pushed?;
        } else {
            self.sinks(None)?;
        }
        if let (Some(sinks), Ok(x)) = (&mut self.sinks, &number) {
            self.hyperslab.take(1, |_, _| is_good = sinks.push_number(*x));
        }
        if !is_good {
            let found = number.map_or_else(|text| quoted(&text), |x| x.to_string());
            let problem = format!("number {index} is {found}, expected one of type {name}");
            return Err(FormatError::Data { path: shown(path), problem });
        }
        if index.is_multiple_of(TEXT_TICK) { self.tick() } else { Ok(()) }
    }

    /// Collects the selected ones of `count` numbers that are written as text. At most `num_bytes` bytes are left in
    /// `reader`, the file at `path`.
    pub(crate) fn push_text(
        &mut self,
        reader: &mut dyn BufRead,
        path: &Path,
        count: u64,
        num_bytes: u64,
    ) -> Result<(), FormatError> {
        // A number has at least one digit, and a gap before the next.
        let most = num_bytes.div_ceil(2);
        if most < count {
            return Err(self.short(path, count, most, "numbers"));
        }
        (0..count).try_for_each(|i| match next_number(reader).map_err(io_error(path))? {
            Some(number) => self.push_number(path, number),
            None => Err(self.short(path, count, i, "numbers")),
        })
    }

    /// Collects the selected numbers in `num_bytes` bytes of `stream`, the file at `path`. It stops early when all
    /// selected numbers have passed.
    pub(crate) fn pump(
        &mut self,
        stream: &mut dyn Stream,
        path: &Path,
        num_bytes: u64,
    ) -> Result<(), FormatError> {
        let size = self.dtype.num_bytes() as u64;
        let mut done = 0;
        let mut chunk = Vec::with_capacity(num_bytes.min(CHUNK_BYTES) as usize);
        while done < num_bytes && !self.is_done() {
            self.tick()?;
            let damaged = |done: u64, e: io::Error| {
                let problem = format!("damaged or cut after {done} of {num_bytes} bytes: {e}");
                FormatError::Data { path: shown(path), problem }
            };
            let gap = self.gap().saturating_mul(size).min(num_bytes - done);
            if gap >= WORTH_PASSING {
                // Small steps allow cancelling.
                let step = gap.min(PASS_BYTES) / size * size;
                stream.pass(step).map_err(|e| damaged(done, e))?;
                self.pass(step / size);
                done += step;
                continue;
            }
            let wanted = (num_bytes - done).min(CHUNK_BYTES);
            chunk.clear();
            let result = io::Read::read_to_end(&mut io::Read::take(&mut *stream, wanted), &mut chunk);
            self.push(&chunk)?;
            done += chunk.len() as u64;
            result.map_err(|e| damaged(done, e))?;
            if (chunk.len() as u64) < wanted {
                return Err(self.short(path, num_bytes, done, "bytes"));
            }
        }
        Ok(())
    }

    /// Reports progress and checks for cancelling.
    pub(crate) fn tick(&self) -> Result<(), FormatError> {
        if let Some(progress) = self.options.progress {
            progress(match &self.stream {
                Some(stream) => stream.progress(),
                None => self.sinks.as_ref().map_or(0.0, ChannelSinks::progress),
            });
        }
        self.options.check_cancelled(self.path)
    }

    /// The error for a file that is too short.
    pub(crate) fn short(&self, path: &Path, expected: u64, found: u64, unit: &'static str) -> FormatError {
        FormatError::Short { path: shown(path), shape: self.shape.clone(), expected, found, unit }
    }

    /// Returns an error if `found` bytes are fewer than expected.
    pub(crate) fn check_length(&self, path: &Path, expected: u64, found: u64) -> Result<(), FormatError> {
        if found < expected { Err(self.short(path, expected, found, "bytes")) } else { Ok(()) }
    }

    /// The error for a damaged file.
    pub(crate) fn data_error(&self, path: &Path, problem: impl Into<String>) -> FormatError {
        FormatError::Data { path: shown(path), problem: problem.into() }
    }

    /// Adds a warning, unless it exists.
    pub(crate) fn warn(&mut self, kind: WarningKind, text: String) {
        let warning = Warning::new(kind, text);
        if !self.warnings.contains(&warning) && self.warnings.len() < MAX_WARNINGS {
            self.warnings.push(warning);
        }
    }

    /// The sinks, which are created with the first voxel.
    fn sinks(&mut self, fill: Option<&[u8]>) -> Result<&mut ChannelSinks, FormatError> {
        if self.sinks.is_none() {
            let mut shape = StreamShape {
                dtype: self.dtype,
                endian: self.endian,
                selected: &self.chosen.selected,
                channel_axis: self.channel_axis,
                num_channels: self.chosen.channels.len(),
                num_voxels: self.chosen.num_voxels as usize,
            };
            let of_bytes = [&[Steps::all(0..self.bytes_per_number())], shape.selected].concat();
            if self.is_raw {
                shape.dtype = Dtype::Uint8;
                shape.selected = &of_bytes;
                shape.channel_axis = shape.channel_axis.map(|axis| axis + 1);
                shape.num_voxels *= self.dtype.num_bytes();
            }
            let sinks = ChannelSinks::new(&shape, fill);
            self.sinks = Some(sinks.map_err(|_| io_error(self.path)(io::ErrorKind::OutOfMemory.into()))?);
        }
        Ok(self.sinks.as_mut().expect("they were made above"))
    }

    /// The bytes of the numbers of each channel, after [`Collector::raw`], and the warnings of the reader.
    pub(crate) fn finish_raw(mut self) -> Result<(Vec<Vec<u8>>, Vec<Warning>), FormatError> {
        self.sinks(None)?;
        let decoded = self.sinks.take().map_or(Vec::new(), |sinks| sinks.finish(false));
        let bytes = decoded.into_iter().map(|decoded| match decoded.voxels {
            Voxels::U8(bytes) => bytes,
            Voxels::U16(_) | Voxels::F32(_) => Vec::new(),
        });
        Ok((bytes.collect(), self.warnings))
    }

    /// Checks that all numbers have passed, after [`Collector::streaming`]. Returns the warnings of the reader.
    pub(crate) fn finish_stream(self) -> Result<Vec<Warning>, FormatError> {
        if self.is_done() {
            return Ok(self.warnings);
        }
        Err(self.short(self.path, self.num_elements(), self.position(), "numbers"))
    }

    /// The voxels of each channel, the first with the warnings of the reader.
    pub(crate) fn finish(mut self) -> Result<Vec<Decoded>, FormatError> {
        let taken = self.sinks(None)?.num_taken() as u64;
        if taken != self.chosen.num_voxels {
            return Err(self.short(self.path, self.chosen.num_voxels, taken, "voxels"));
        }
        self.tick()?;
        let mut channels = self.sinks.take().map_or(Vec::new(), |sinks| sinks.finish(self.has_gaps));
        if let Some(first) = channels.first_mut() {
            first.warnings.splice(0..0, self.warnings);
        }
        Ok(channels)
    }
}

/// Bytes to read at a time: a multiple of every voxel size, small beside a volume and large beside a system call.
const CHUNK_BYTES: u64 = 256 * 1024;
/// Shorter gaps are read instead of skipped.
const WORTH_PASSING: u64 = 64 * 1024;
/// Most bytes to skip before the next check for cancelling.
const PASS_BYTES: u64 = 16 << 20;
/// Numbers in text between two reports of progress.
const TEXT_TICK: u64 = 1 << 16;
/// Most warnings about the data of one file.
const MAX_WARNINGS: usize = 16;
