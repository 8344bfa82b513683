//! NRRD volumes (versions 1 to 5): attached or detached, raw, gzip or text.

mod axes;
mod header;

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use isinglass_core::volume::{Volume, VolumeInfo};

use self::axes::Grid;
use self::header::{ByteSkip, DataFiles, Encoding, Header, HeaderReadError};
use crate::decode::{GzipMembers, MAX_DEFLATE_RATIO, VoxelSink, next_number, pump_bytes};
use crate::error::{FormatError, HeaderError, io_error, quoted, shown};
use crate::source::{OpenOptions, file_name, open_file};

/// Reads the volume whose header `file`, the file at `path`, starts with.
pub(crate) fn read(file: File, path: &Path, options: &OpenOptions) -> Result<Volume, FormatError> {
    let header_error = |cause| FormatError::Header { path: shown(path), cause };
    let mut reader = BufReader::new(file);
    let header = Header::read(&mut reader).map_err(|e| match e {
        HeaderReadError::Header(cause) => header_error(cause),
        HeaderReadError::Io(cause) => FormatError::Io { path: shown(path), cause },
    })?;
    let grid = Grid::of(&header).map_err(header_error)?;
    // At most 2048³ voxels of 8 bytes: no product below can overflow.
    let num_voxels = grid.file_dims.iter().map(|&d| u64::from(d)).product::<u64>();
    let copies = if grid.is_permuted() { 2 } else { 1 };
    options.check_memory(path, num_voxels * header.dtype.num_bytes_in_memory() as u64 * copies)?;
    let num_files = match &header.data {
        DataFiles::Attached => 1,
        DataFiles::Detached(names) => names.len() as u64,
    };
    if num_voxels % num_files != 0 {
        let what = format!("{num_files} data files cannot share {num_voxels} voxels, expected equal parts");
        return Err(header_error(HeaderError::Contradiction(what)));
    }
    let mut decoder =
        Decoder { header: &header, grid: &grid, options, num_files, sink: None, warnings: Vec::new() };
    match &header.data {
        DataFiles::Attached => decoder.take(reader, path)?,
        DataFiles::Detached(names) => {
            for name in names {
                let data_path = path.parent().map_or_else(|| PathBuf::from(name), |folder| folder.join(name));
                decoder.take(BufReader::new(open_file(&data_path)?), &data_path)?;
            }
        }
    }
    let mut warnings = [header.warnings.clone(), grid.warnings.clone(), decoder.warnings].concat();
    let decoded =
        decoder.sink.map(VoxelSink::finish).ok_or_else(|| header_error(HeaderError::Missing("data file")))?;
    warnings.extend(decoded.warnings);
    let info = VolumeInfo {
        name: file_name(path),
        dtype: header.dtype.name().to_owned(),
        unit: grid.unit.clone(),
        orientation: grid.orientation.clone(),
        warnings,
    };
    Volume::new(grid.dims(), grid.spacing, grid.reorder(decoded.voxels), decoded.value_map, info)
        .map_err(|cause| FormatError::Volume { path: shown(path), cause })
}

/// Takes the voxels out of one or several data files, each of which holds an equal part.
struct Decoder<'a> {
    header: &'a Header,
    grid: &'a Grid,
    options: &'a OpenOptions<'a>,
    num_files: u64,
    /// There once the first file was found long enough, so that no lie about a size allocates much.
    sink: Option<VoxelSink>,
    warnings: Vec<String>,
}

impl Decoder<'_> {
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
        let num_voxels = self.num_voxels() / self.num_files;
        let num_bytes = num_voxels * header.dtype.num_bytes() as u64;
        let skip = match header.byte_skip {
            ByteSkip::Forward(n) => n,
            ByteSkip::ToEnd => num_left.saturating_sub(num_bytes),
        };
        match header.encoding {
            Encoding::Raw => {
                let found = num_left.saturating_sub(skip);
                if found < num_bytes {
                    return Err(self.short(path, num_bytes, found, "bytes"));
                }
                if found > num_bytes {
                    self.warn_of_more(path);
                }
                reader.seek(SeekFrom::Start(start + skip)).map_err(&io)?;
                self.bytes(&mut reader, path, num_bytes)
            }
            Encoding::Gzip => self.gzip(reader, path, (skip, num_bytes), num_left),
            Encoding::Ascii => {
                // A number has at least one digit, and a gap before the next.
                let found = num_left.saturating_sub(skip).div_ceil(2);
                if found < num_voxels {
                    return Err(self.short(path, num_voxels, found, "numbers"));
                }
                reader.seek(SeekFrom::Start(start + skip)).map_err(&io)?;
                self.numbers(&mut reader, path, num_voxels)
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
        if found < expected {
            return Err(self.short(path, expected, found, "bytes"));
        }
        let mut inflated = GzipMembers::new(reader);
        let damaged = |done, e| {
            let problem = format!("gzip data is damaged or cut after {done} of {expected} bytes: {e}");
            FormatError::Data { path: shown(path), problem }
        };
        let skipped = std::io::copy(&mut (&mut inflated).take(skip), &mut std::io::sink());
        let skipped = skipped.map_err(|e| damaged(0, e))?;
        if skipped < skip {
            return Err(self.short(path, expected, skipped, "bytes"));
        }
        self.bytes(&mut inflated, path, num_bytes)?;
        // One byte further: the checksum is verified at the end, and more data is noticed.
        let rest = inflated.read(&mut [0]).map_err(|e| damaged(expected, e))?;
        if rest > 0 {
            self.warn_of_more(path);
        }
        Ok(())
    }

    fn bytes(&mut self, reader: &mut dyn Read, path: &Path, num_bytes: u64) -> Result<(), FormatError> {
        let total = (self.num_voxels() * self.header.dtype.num_bytes() as u64) as f32;
        let before = self.sink(path)?.len() as u64 * self.header.dtype.num_bytes() as u64;
        let progress = self.options.progress;
        let mut tick = |done: u64| {
            if let Some(progress) = progress {
                progress((before + done) as f32 / total);
            }
        };
        let (done, result) = pump_bytes(reader, self.sink(path)?, num_bytes, &mut tick);
        result.map_err(|e| FormatError::Data {
            path: shown(path),
            problem: format!("damaged or cut after {done} of {num_bytes} bytes: {e}"),
        })?;
        if done < num_bytes { Err(self.short(path, num_bytes, done, "bytes")) } else { Ok(()) }
    }

    fn numbers(&mut self, reader: &mut dyn BufRead, path: &Path, num_voxels: u64) -> Result<(), FormatError> {
        let name = self.header.dtype.name();
        for i in 0..num_voxels {
            let Some(number) = next_number(reader).map_err(io_error(path))? else {
                return Err(self.short(path, num_voxels, i, "numbers"));
            };
            let is_taken =
                number.as_ref().is_ok_and(|&x| self.sink(path).is_ok_and(|sink| sink.push_number(x)));
            if !is_taken {
                let found = number.map_or_else(|text| quoted(&text), |x| x.to_string());
                let problem = format!("number {i} is {found}, expected one of type {name}");
                return Err(FormatError::Data { path: shown(path), problem });
            }
        }
        if next_number(reader).map_err(io_error(path))?.is_some() {
            self.warn_of_more(path);
        }
        Ok(())
    }

    /// The sink for all files, made when the first of them is known to be long enough.
    fn sink(&mut self, path: &Path) -> Result<&mut VoxelSink, FormatError> {
        if self.sink.is_none() {
            let (dtype, num_voxels) = (self.header.dtype, self.num_voxels());
            let sink = VoxelSink::new(dtype, self.header.endian, num_voxels as usize);
            let out_of_memory = || io_error(path)(std::io::ErrorKind::OutOfMemory.into());
            self.sink = Some(sink.map_err(|_| out_of_memory())?);
        }
        Ok(self.sink.as_mut().expect("it was made above"))
    }

    fn num_voxels(&self) -> u64 {
        self.grid.file_dims.iter().map(|&d| u64::from(d)).product()
    }

    fn short(&self, path: &Path, expected: u64, found: u64, unit: &'static str) -> FormatError {
        let [x, y, z] = self.grid.file_dims;
        let shape = format!("{x}×{y}×{z} {}", self.header.dtype.name());
        FormatError::Short { path: shown(path), shape, expected, found, unit }
    }

    fn warn_of_more(&mut self, path: &Path) {
        if self.warnings.is_empty() {
            self.warnings
                .push(format!("{} has more data than its shape needs; the rest is ignored", file_name(path)));
        }
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
