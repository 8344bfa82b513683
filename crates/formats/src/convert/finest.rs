//! The finest level: the numbers of the source, in chunks.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::ops::Range;

use rayon::prelude::*;

use super::gaps::Tally;
use super::layout::{Block, count};
use super::{Conversion, check_cancelled};
use crate::collector::{Collector, NumberSink};
use crate::error::{FormatError, io_error, shown};
use crate::hyperslab::Steps;
use crate::plan::{Chosen, Role};
use crate::source::OpenOptions;
use crate::warning::Warning;

impl Conversion<'_> {
    /// Writes what is not yet written of the finest level. Returns what the reader says.
    pub(super) fn write_finest(&mut self) -> Result<Vec<String>, FormatError> {
        let num_groups = self.groups.len();
        let mut notes: Vec<String> = Vec::new();
        for pass in 0..self.passes.len() {
            let done = (self.journal.num_done as usize).saturating_sub(pass * num_groups);
            if done >= num_groups {
                continue;
            }
            let found =
                if self.is_chunked { self.read_blocks(pass, done)? } else { self.read_stream(pass, done)? };
            for warning in found {
                if notes.len() < MOST_NOTES && !notes.contains(&warning.text) {
                    notes.push(warning.text);
                }
            }
        }
        Ok(notes)
    }

    /// Reads a file of chunks part by part.
    fn read_blocks(&mut self, pass: usize, done: usize) -> Result<Vec<Warning>, FormatError> {
        let (options, mut file) = self.reopened(pass)?;
        let options = OpenOptions { progress: None, ..options };
        let mut warnings = Vec::new();
        for number in done..self.groups.len() {
            let group = self.groups[number].clone();
            let chosen = self.chosen_part(&group);
            let path = self.path.clone();
            let mut collector = Collector::raw(file.plan(), &chosen, &path, &options);
            file.read(&mut collector)?;
            let (channels, said) = collector.finish_raw()?;
            warnings.extend(said);
            let axis = self.layout.axes.iter().position(|axis| axis.1 == Role::Channel);
            for (i, bytes) in channels.iter().enumerate() {
                let mut ranges = group.clone();
                if let Some(axis) = axis {
                    let channel = group[axis].start + i as u64;
                    ranges[axis] = channel..channel + 1;
                }
                self.put(&Block { ranges, bytes }, pass)?;
            }
            self.done_with_step()?;
        }
        Ok(warnings)
    }

    /// The selection of a part of what is chosen.
    fn chosen_part(&self, ranges: &[Range<u64>]) -> Chosen {
        let mut chosen = self.chosen.clone();
        for (steps, range) in chosen.selected.iter_mut().zip(ranges) {
            let first = steps.range.start;
            *steps = Steps::all(first + range.start..first + range.end);
        }
        let axis = self.layout.axes.iter().position(|axis| axis.1 == Role::Channel);
        let num_channels = axis.map_or(1, |axis| ranges[axis].end - ranges[axis].start);
        chosen.channels = 0..num_channels as u32;
        chosen.num_voxels = count(ranges) / num_channels;
        chosen
    }

    /// Reads a file from the front to the end, after the groups that are done.
    fn read_stream(&mut self, pass: usize, done: usize) -> Result<Vec<Warning>, FormatError> {
        let (options, mut file) = self.reopened(pass)?;
        let (plan, chosen, path) = (file.plan().clone(), self.chosen.clone(), self.path.clone());
        let num_done = self.groups[..done].iter().map(|group| count(group)).sum();
        let mut sink = GroupSink::new(self, pass, done)?;
        let mut collector = Collector::streaming(&plan, &chosen, &path, &options, num_done, &mut sink);
        file.read(&mut collector)?;
        collector.finish_stream()
    }

    /// Writes the chunks of a block.
    fn put(&mut self, block: &Block, pass: usize) -> Result<(), FormatError> {
        let (layout, array, plan) = (&self.layout, &self.arrays[0], &self.plan);
        let (cancel, path) = (self.options.cancel, &self.path);
        let chunks = layout.chunks_in(block);
        let write = |(of, at): &([u64; 2], [u64; 3])| {
            check_cancelled(cancel, path)?;
            let chunk = layout.chunk(block, *of, *at);
            let [time, channel] = chunk.of;
            let channel = channel + pass as u64 * layout.num_channels();
            array.write([time, channel], chunk.at, &chunk.bytes, chunk.dims)?;
            Ok(([time, channel], Tally::of(&chunk.bytes, plan.dtype, plan.value_map)))
        };
        let write_all = || chunks.par_iter().map(write).collect::<Result<Vec<_>, FormatError>>();
        let found = self.threads.install(write_all)?;
        let num_channels = self.num_channels();
        for ([time, channel], tally) in found {
            let own = &mut self.journal.tallies[(time * num_channels + channel) as usize];
            *own = own.and(tally);
            if !self.plan.has_gaps && own.num_not_finite() > 0 {
                let num = own.num_not_finite();
                let problem = format!("{num} numbers or more are NaN or infinite, expected finite ones");
                return Err(FormatError::Data { path: shown(&self.path), problem });
            }
        }
        Ok(())
    }
}

/// Collects one group of numbers after the other, and writes the chunks of each.
struct GroupSink<'c, 'a> {
    conversion: &'c mut Conversion<'a>,
    pass: usize,
    /// The group that is collected.
    next: usize,
    store: GroupBytes,
    num_bytes: u64,
}

/// The bytes of a group.
enum GroupBytes {
    Memory(Vec<u8>),
    /// A file without a name, for groups that are too large.
    File(File),
}

impl<'c, 'a> GroupSink<'c, 'a> {
    fn new(conversion: &'c mut Conversion<'a>, pass: usize, next: usize) -> Result<Self, FormatError> {
        let largest = conversion.groups.iter().map(|group| conversion.layout.num_bytes(group)).max();
        let largest = largest.unwrap_or(0);
        let folder = conversion.part.path();
        let store = if largest <= conversion.options.max_bytes / 2 {
            let mut bytes = Vec::new();
            let room = bytes.try_reserve_exact(largest as usize);
            room.map_err(|_| io_error(&conversion.path)(io::ErrorKind::OutOfMemory.into()))?;
            GroupBytes::Memory(bytes)
        } else {
            GroupBytes::File(tempfile::tempfile_in(folder).map_err(io_error(folder))?)
        };
        Ok(Self { conversion, pass, next, store, num_bytes: 0 })
    }

    /// Bytes of the group that is collected.
    fn wanted(&self) -> u64 {
        let group = self.conversion.groups.get(self.next);
        group.map_or(0, |group| self.conversion.layout.num_bytes(group))
    }

    /// Writes the chunks of a group that is complete.
    fn write_group(&mut self) -> Result<(), FormatError> {
        let group = self.conversion.groups[self.next].clone();
        match &mut self.store {
            GroupBytes::Memory(bytes) => {
                self.conversion.put(&Block { ranges: group, bytes }, self.pass)?;
                bytes.clear();
            }
            GroupBytes::File(file) => {
                let folder = self.conversion.part.path().to_owned();
                for strip in self.conversion.layout.strips(&group) {
                    let (length, places) = self.conversion.layout.pieces(&group, &strip);
                    let mut bytes = vec![0; length as usize * places.len()];
                    for (piece, at) in bytes.chunks_exact_mut(length as usize).zip(places) {
                        let read = file.seek(SeekFrom::Start(at)).and_then(|_| file.read_exact(piece));
                        read.map_err(io_error(&folder))?;
                    }
                    self.conversion.put(&Block { ranges: strip, bytes: &bytes }, self.pass)?;
                }
                file.seek(SeekFrom::Start(0)).map_err(io_error(&folder))?;
            }
        }
        (self.next, self.num_bytes) = (self.next + 1, 0);
        self.conversion.done_with_step()
    }
}

impl NumberSink for GroupSink<'_, '_> {
    fn push(&mut self, mut bytes: &[u8]) -> Result<(), FormatError> {
        while !bytes.is_empty() {
            let rest = self.wanted().saturating_sub(self.num_bytes);
            let (now, later) = bytes.split_at((rest as usize).min(bytes.len()));
            if now.is_empty() {
                return Ok(());
            }
            match &mut self.store {
                GroupBytes::Memory(held) => held.extend_from_slice(now),
                GroupBytes::File(file) => {
                    file.write_all(now).map_err(io_error(self.conversion.part.path()))?;
                }
            }
            self.num_bytes += now.len() as u64;
            if self.num_bytes == self.wanted() {
                self.write_group()?;
            }
            bytes = later;
        }
        Ok(())
    }

    fn progress(&self) -> f32 {
        let part = self.num_bytes as f32 / self.wanted().max(1) as f32;
        self.conversion.fraction_with(part)
    }
}

/// Most words of the reader that are passed on.
const MOST_NOTES: usize = 16;
