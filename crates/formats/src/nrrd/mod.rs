//! NRRD volumes (versions 1 to 5): attached or detached, raw, gzip or text.

mod axes;
mod header;

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use self::axes::Axes;
use self::header::{ByteSkip, DataFiles, Encoding, Header, HeaderReadError};
use crate::decode::next_number;
use crate::error::{FormatError, HeaderError, io_error, shown};
use crate::plan::{Plan, VolumeFile, unit_of_values};
use crate::source::{file_name, open_file};
use crate::stream::{GzipMembers, MAX_DEFLATE_RATIO, read_past};
use crate::taker::Taker;
use crate::warning::{Warning, WarningKind};

/// A file whose header was read.
pub(crate) struct NrrdFile {
    header: Header,
    plan: Plan,
    path: PathBuf,
    /// Where attached voxels begin.
    reader: Option<BufReader<File>>,
}

impl NrrdFile {
    /// `file` is the file at `path`.
    pub(crate) fn open(file: File, path: &Path) -> Result<Self, FormatError> {
        let header_error = |cause| FormatError::Header { path: shown(path), cause };
        let mut reader = BufReader::new(file);
        let header = Header::read(&mut reader).map_err(|e| match e {
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
        plan.channel_names = axes.channel_names;
        plan.value_unit = header.sample_units.as_deref().and_then(unit_of_values);
        plan.warnings = header.warnings.iter().map(|w| Warning::new(WarningKind::Data, w.clone())).collect();
        plan.warnings.extend(axes.warnings);
        Ok(Self { header, plan, path: path.to_owned(), reader: Some(reader) })
    }
}

impl VolumeFile for NrrdFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, taker: &mut Taker) -> Result<(), FormatError> {
        let num_voxels = taker.num_elements();
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
        let mut part = Part { header: &self.header, num_voxels: num_voxels / num_files, taker };
        match (&self.header.data, self.reader.take()) {
            (DataFiles::Attached, Some(reader)) => part.take(reader, &self.path),
            (DataFiles::Attached, None) => Ok(()),
            (DataFiles::Detached(names), _) => names.iter().try_for_each(|name| {
                if part.taker.is_done() {
                    return Ok(());
                }
                let path = self.path.parent().map_or_else(|| PathBuf::from(name), |folder| folder.join(name));
                part.take(BufReader::new(open_file(&path)?), &path)
            }),
        }
    }
}

/// Takes the voxels out of one of several data files, each of which holds an equal part.
struct Part<'a, 'b, 'c> {
    header: &'a Header,
    num_voxels: u64,
    taker: &'b mut Taker<'c>,
}

impl Part<'_, '_, '_> {
    /// The next data file, `reader` being at its start or at the end of an attached header.
    fn take(&mut self, mut reader: BufReader<File>, path: &Path) -> Result<(), FormatError> {
        let header = self.header;
        let io = io_error(path);
        for _ in 0..header.line_skip {
            let n = skip_line(&mut reader).map_err(&io)?;
            if n == 0 {
                let problem = format!("the file ends within the {} lines to skip", header.line_skip);
                return Err(FormatError::Data { path: shown(path), problem });
            }
        }
        let start = reader.stream_position().map_err(&io)?;
        let num_left = reader.get_ref().metadata().map_err(&io)?.len().saturating_sub(start);
        let num_bytes = self.num_voxels * header.dtype.num_bytes() as u64;
        let skip = match header.byte_skip {
            ByteSkip::Forward(n) => n,
            ByteSkip::ToEnd => num_left.saturating_sub(num_bytes),
        };
        match header.encoding {
            Encoding::Raw => {
                let found = num_left.saturating_sub(skip);
                self.taker.check_length(path, num_bytes, found)?;
                if found > num_bytes {
                    self.warn_of_more(path);
                }
                reader.seek(SeekFrom::Start(start + skip)).map_err(&io)?;
                self.taker.pump(&mut reader, path, num_bytes)
            }
            Encoding::Gzip => self.gzip(reader, path, (skip, num_bytes), num_left),
            Encoding::Ascii => {
                // A number has at least one digit, and a gap before the next.
                let found = num_left.saturating_sub(skip).div_ceil(2);
                if found < self.num_voxels {
                    return Err(self.taker.short(path, self.num_voxels, found, "numbers"));
                }
                reader.seek(SeekFrom::Start(start + skip)).map_err(&io)?;
                self.numbers(&mut reader, path)
            }
        }
    }

    /// Gzip data: `skip` inflated bytes, then the voxels. Never inflates more than one byte beyond those.
    fn gzip(
        &mut self,
        reader: BufReader<File>,
        path: &Path,
        (skip, num_bytes): (u64, u64),
        num_compressed: u64,
    ) -> Result<(), FormatError> {
        let (expected, found) =
            (num_bytes.saturating_add(skip), num_compressed.saturating_mul(MAX_DEFLATE_RATIO));
        self.taker.check_length(path, expected, found)?;
        let mut inflated = GzipMembers::new(reader);
        let damaged = |done, e| {
            let problem = format!("gzip data is damaged or cut after {done} of {expected} bytes: {e}");
            FormatError::Data { path: shown(path), problem }
        };
        read_past(&mut inflated, skip).map_err(|e| damaged(0, e))?;
        self.taker.pump(&mut inflated, path, num_bytes)?;
        if self.taker.position() < self.taker.num_elements() {
            return Ok(());
        }
        // One byte further: the checksum is verified at the end, and more data is noticed.
        let rest = inflated.read(&mut [0]).map_err(|e| damaged(expected, e))?;
        if rest > 0 {
            self.warn_of_more(path);
        }
        Ok(())
    }

    fn numbers(&mut self, reader: &mut dyn BufRead, path: &Path) -> Result<(), FormatError> {
        for i in 0..self.num_voxels {
            let Some(number) = next_number(reader).map_err(io_error(path))? else {
                return Err(self.taker.short(path, self.num_voxels, i, "numbers"));
            };
            self.taker.push_number(path, number)?;
        }
        if next_number(reader).map_err(io_error(path))?.is_some() {
            self.warn_of_more(path);
        }
        Ok(())
    }

    fn warn_of_more(&mut self, path: &Path) {
        let text = format!("{} has more data than its shape needs; the rest is ignored", file_name(path));
        self.taker.warn(WarningKind::Data, text);
    }
}

/// Moves past the next line feed without keeping the line; returns the bytes passed.
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
