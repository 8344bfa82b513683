//! NRRD volumes of versions 1 to 5, attached or detached, as raw data, gzip or text.

mod axes;
mod header;
mod segments;

use std::fs::File;
use std::io::{BufRead, BufReader, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use self::axes::Axes;
use self::header::{ByteSkip, DataFiles, Encoding, HeaderReadError, NrrdHeader};
use crate::collector::Collector;
use crate::decode::next_number;
use crate::error::{FormatError, HeaderError, io_error, shown};
use crate::foreign::{HomeFolder, note_on_data_files};
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{BoxLevel, Plan, VolumeFile};
use crate::source::{OpenOptions, open_file};
use crate::stream::{Packing, Unpacked, warn_of_more};
use crate::units::value_unit;
use crate::warning::{Warning, WarningKind};

/// A file whose header was read.
pub(crate) struct NrrdFile {
    header: NrrdHeader,
    plan: Plan,
    path: PathBuf,
    /// The files with detached voxels.
    files: Vec<PathBuf>,
    /// Where an attached header ends.
    header_end: u64,
    /// The file at the start of attached voxels.
    reader: Option<BufReader<File>>,
}

impl NrrdFile {
    /// `file` is the file at `path`.
    pub(crate) fn open(file: File, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let header_error = |cause| FormatError::Header { path: shown(path), cause };
        let mut reader = BufReader::new(file);
        let header = NrrdHeader::read(&mut reader).map_err(|e| match e {
            HeaderReadError::Header(cause) => header_error(cause),
            HeaderReadError::Io(cause) => FormatError::Io { path: shown(path), cause },
        })?;
        let axes = Axes::of(&header).map_err(header_error)?;
        let encoding = match header.encoding {
            Encoding::Raw => "raw",
            Encoding::Gzip => "gzip",
            Encoding::Ascii => "ascii",
        };
        let place = if header.data == DataFiles::Attached { "" } else { ", detached" };
        let format = format!("NRRD, {encoding}{place}");
        let mut plan = Plan::new(format, header.dtype, header.endian, axes.axes, axes.geometry);
        if axes.are_colors {
            plan.set_colors();
        }
        plan.are_labels = !header.segments.is_empty();
        plan.labels = header.segments.labels(options.selection.channel.unwrap_or(0));
        plan.value_unit = header.sample_units.as_deref().and_then(value_unit);
        plan.warnings = header.warnings.iter().map(|w| Warning::new(WarningKind::Data, w.clone())).collect();
        plan.warnings.extend(axes.warnings);
        let files = match &header.data {
            DataFiles::Attached => Vec::new(),
            DataFiles::Detached(names) => {
                if let Some(note) = note_on_data_files(path, names) {
                    plan.warn(WarningKind::Data, note);
                }
                let home = HomeFolder::of_header(path, options);
                names.iter().map(|name| home.data_file(name)).collect::<Result<_, _>>()?
            }
        };
        let header_end = reader.stream_position().map_err(io_error(path))?;
        Ok(Self { header, plan, path: path.to_owned(), files, header_end, reader: Some(reader) })
    }
}

impl VolumeFile for NrrdFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let num_voxels = collector.num_elements();
        let num_files = match &self.header.data {
            DataFiles::Attached => 1,
            DataFiles::Detached(names) => names.len() as u64,
        };
        if !num_voxels.is_multiple_of(num_files) {
            let what =
                format!("{num_files} data files cannot share {num_voxels} voxels, expected equal parts");
            let cause = HeaderError::Contradiction(what);
            return Err(FormatError::Header { path: shown(&self.path), cause });
        }
        let num_voxels = num_voxels / num_files;
        match (&self.header.data, self.reader.take()) {
            (DataFiles::Attached, Some(reader)) => self.take(collector, reader, &self.path, num_voxels),
            (DataFiles::Attached, None) => Ok(()),
            (DataFiles::Detached(_), _) => self.files.iter().try_for_each(|path| {
                if collector.is_done() {
                    return Ok(());
                }
                self.take(collector, BufReader::new(open_file(path)?), path, num_voxels)
            }),
        }
    }

    fn data_files(&self) -> Vec<PathBuf> {
        self.files.clone()
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        let found = match self.header.encoding {
            Encoding::Raw => None,
            Encoding::Gzip => Some("gzip"),
            Encoding::Ascii => Some("numbers as text"),
        };
        if let Some(found) = found {
            return Err(FormatError::NotPaged { path: shown(path), found: found.into() });
        }
        let sizes = self.plan.axes.iter().map(|axis| axis.size);
        let num_bytes = sizes.fold(self.plan.dtype.num_bytes() as u64, u64::saturating_mul);
        let share = num_bytes / self.files.len().max(1) as u64;
        let (start, paths) = match self.header.data {
            DataFiles::Attached => (self.header_end, std::slice::from_ref(&self.path)),
            DataFiles::Detached(_) => (0, &self.files[..]),
        };
        let mut files = Vec::new();
        for path in paths {
            let mut reader = BufReader::new(open_file(path)?);
            reader.seek(SeekFrom::Start(start)).map_err(io_error(path))?;
            let (start, num_left) = self.skip_lines(&mut reader, path)?;
            let offset = start.saturating_add(self.bytes_to_skip(num_left, share));
            files.push(FlatFile { path: path.clone(), offset });
        }
        flat_level(&self.plan, files, path)
    }
}

impl NrrdFile {
    /// Skips the lines before the voxels. Returns the position behind them, and the number of bytes from there on.
    fn skip_lines(&self, reader: &mut BufReader<File>, path: &Path) -> Result<(u64, u64), FormatError> {
        let io = io_error(path);
        for _ in 0..self.header.line_skip {
            if skip_line(reader).map_err(io)? == 0 {
                let problem = format!("the file ends within the {} lines to skip", self.header.line_skip);
                return Err(FormatError::Data { path: shown(path), problem });
            }
        }
        let start = reader.stream_position().map_err(io)?;
        let length = reader.get_ref().metadata().map_err(io)?.len();
        Ok((start, length.saturating_sub(start)))
    }

    /// Bytes to skip then, of `num_left`.
    fn bytes_to_skip(&self, num_left: u64, num_bytes: u64) -> u64 {
        match self.header.byte_skip {
            ByteSkip::Forward(n) => n,
            ByteSkip::ToEnd => num_left.saturating_sub(num_bytes),
        }
    }

    /// Reads the voxels of one data file. `reader` is at its start, or at the end of an attached header.
    fn take(
        &self,
        collector: &mut Collector,
        mut reader: BufReader<File>,
        path: &Path,
        num_voxels: u64,
    ) -> Result<(), FormatError> {
        let header = &self.header;
        let io = io_error(path);
        let (start, num_left) = self.skip_lines(&mut reader, path)?;
        let num_bytes = num_voxels * header.dtype.num_bytes() as u64;
        let skip = self.bytes_to_skip(num_left, num_bytes);
        let packing = match header.encoding {
            Encoding::Raw => Packing::Plain,
            Encoding::Gzip => Packing::Gzip,
            Encoding::Ascii => {
                let skip = skip.min(num_left);
                reader.seek(SeekFrom::Start(start + skip)).map_err(io)?;
                collector.push_text(&mut reader, path, num_voxels, num_left - skip)?;
                if next_number(&mut reader).map_err(io)?.is_some() {
                    warn_of_more(collector, path);
                }
                return Ok(());
            }
        };
        let data = Unpacked::open(reader.into_inner(), path, start, None, packing)?;
        data.take(collector, path, skip, num_bytes)
    }
}

/// Skips a line without keeping it. Returns the number of bytes.
fn skip_line(reader: &mut BufReader<File>) -> std::io::Result<u64> {
    let mut passed = 0;
    loop {
        let buffer = reader.fill_buf()?;
        let (n, is_end) = match buffer.iter().position(|&b| b == b'\n') {
            Some(i) => (i + 1, true),
            None => (buffer.len(), buffer.is_empty()),
        };
        reader.consume(n);
        passed += n as u64;
        if is_end {
            return Ok(passed);
        }
    }
}
