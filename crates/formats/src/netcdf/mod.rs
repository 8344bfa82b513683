//! Classic netCDF files: CDF-1, CDF-2 and CDF-5. A variable of them is a volume. Its numbers lie one after the other, or
//! in records, each of which has a part of several variables. NetCDF-4 files are HDF5 files.

mod header;

use std::fs::File;
use std::io::{BufReader, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use self::header::{ClassicHeader, ClassicVariable};
use crate::cf::{self, Standing, Variable, Variables, VolumeCandidate};
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian, numbers_from_bytes};
use crate::error::{FormatError, io_error, malformed, not_there, one_line, shown};
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{BoxLevel, Plan, VolumeFile};
use crate::source::{OpenOptions, open_file};

/// A file whose header was read.
pub(crate) struct NetcdfFile {
    plan: Plan,
    path: PathBuf,
    parts: RecordParts,
}

/// Where the numbers of a variable are: in parts of equal length.
#[derive(Clone, Copy)]
struct RecordParts {
    /// Byte of the first part.
    begin: u64,
    count: u64,
    /// Numbers of a part.
    share: u64,
    /// Bytes from one part to the next.
    apart: u64,
}

/// Whether `start` begins a classic file.
pub(crate) fn is_header(start: &[u8]) -> bool {
    matches!(start, [b'C', b'D', b'F', 1 | 2 | 5, ..])
}

impl NetcdfFile {
    /// `file` is the file at `path`. The options choose a variable.
    pub(crate) fn open(file: File, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, FORMAT);
        let length = file.metadata().map_err(io_error(path))?.len();
        let header = ClassicHeader::read(BufReader::new(&file), length).map_err(bad)?;
        let variables = Variables::new(header.variables.iter().map(|v| header.named(v)).collect(), true);
        let choice = |i: usize| {
            let (shape, dtype) = (header.shape(&header.variables[i]), header.variables[i].dtype?);
            let sizes = cf::num_in_space(&shape, &variables.axes_of(i, None, None))?;
            let standing = Standing::of(variables.is_auxiliary(i));
            (!shape.contains(&0)).then_some((VolumeCandidate { sizes, standing }, (i, dtype)))
        };
        let (choices, found): (Vec<VolumeCandidate>, Vec<(usize, Dtype)>) =
            (0..header.variables.len()).filter_map(choice).unzip();
        let shown = VolumeCandidate::shown(&choices);
        if shown.is_empty() {
            return Err(bad(header.nothing_to_show()));
        }
        let usual = VolumeCandidate::usual(&choices, &shown);
        let names: Vec<String> = shown.iter().map(|n| header.description(found[*n].0)).collect();
        let selected = options.selection.series.map_or(usual, |i| i as usize);
        let Some(&(index, dtype)) = shown.get(selected).map(|n| &found[*n]) else {
            return Err(not_there(path, "series", selected as u64, names.len()));
        };
        let numbers = |i: usize| header.parts(i)?.numbers(&file, length, header.variables[i].dtype?);
        let axes = variables.axes_of(index, Some(&numbers), Some(&header.attributes));
        let chosen = &header.variables[index];
        let format = format!("{FORMAT}, CDF-{}, {}", header.version, one_line(&chosen.name));
        let shape = header.shape(chosen);
        let plan = cf::plan(format, (dtype, Endian::Big), &shape, &axes, &chosen.attributes);
        let (Some(mut plan), Some(parts)) = (plan, header.parts(index)) else {
            return Err(bad(header.nothing_to_show()));
        };
        plan.set_series(names, usual, options.selection.series);
        Ok(Self { plan, path: path.to_owned(), parts })
    }
}

impl ClassicHeader {
    fn shape(&self, variable: &ClassicVariable) -> Vec<u64> {
        variable.dims.iter().map(|i| self.dims[*i].length).collect()
    }

    /// A variable with the names of its dimensions.
    fn named<'a>(&'a self, variable: &'a ClassicVariable) -> Variable<'a> {
        Variable {
            path: variable.name.clone(),
            dims: variable.dims.iter().map(|i| Some(self.dims[*i].name.clone())).collect(),
            shape: self.shape(variable),
            attributes: &variable.attributes,
        }
    }

    fn description(&self, index: usize) -> String {
        let variable = &self.variables[index];
        let sides: Vec<String> = self.shape(variable).iter().map(u64::to_string).collect();
        let kind = variable.dtype.map_or("text", Dtype::name);
        format!("{} ({} {kind})", one_line(&variable.name), sides.join("×"))
    }

    fn nothing_to_show(&self) -> String {
        let listed: Vec<String> =
            (0..self.variables.len().min(MAX_NAMED)).map(|i| self.description(i)).collect();
        let listed = if listed.is_empty() { "none".to_owned() } else { listed.join(", ") };
        format!(
            "it has no variable of numbers with two or three axes in space, expected one; it has {listed}"
        )
    }

    /// Where the numbers of a variable are; `None` if they are too many.
    fn parts(&self, index: usize) -> Option<RecordParts> {
        let variable = &self.variables[index];
        let mut sides = self.shape(variable);
        let is_record = variable.dims.first().is_some_and(|i| self.dims[*i].is_record);
        let count = if is_record { sides.remove(0) } else { 1 };
        let share = sides.iter().try_fold(1u64, |n, side| n.checked_mul(*side))?;
        share.checked_mul(8)?.checked_mul(count)?;
        Some(RecordParts { begin: variable.begin, count, share, apart: self.record_bytes })
    }
}

impl RecordParts {
    /// Byte of a part.
    fn at(&self, part: u64) -> u64 {
        self.begin.saturating_add(self.apart.saturating_mul(part))
    }

    /// Bytes that the file must have for numbers of so many bytes.
    fn end(&self, size: u64) -> u64 {
        self.at(self.count.saturating_sub(1)).saturating_add(self.share.saturating_mul(size))
    }

    /// All numbers of a short variable.
    fn numbers(&self, mut file: &File, file_bytes: u64, dtype: Dtype) -> Option<Vec<f64>> {
        let size = dtype.num_bytes();
        if self.share.checked_mul(self.count)? > MAX_NUMBERS || self.end(size as u64) > file_bytes {
            return None;
        }
        let mut bytes = vec![0; (self.share * self.count) as usize * size];
        for (part, bytes) in bytes.chunks_exact_mut((self.share as usize * size).max(1)).enumerate() {
            file.seek(SeekFrom::Start(self.at(part as u64))).ok()?;
            std::io::Read::read_exact(&mut file, bytes).ok()?;
        }
        Some(numbers_from_bytes(&bytes, dtype, Endian::Big))
    }
}

impl VolumeFile for NetcdfFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let (path, parts) = (&self.path, self.parts);
        let size = self.plan.dtype.num_bytes() as u64;
        let file = open_file(path)?;
        collector.check_length(path, parts.end(size), file.metadata().map_err(io_error(path))?.len())?;
        let mut stream = BufReader::new(file);
        for part in 0..parts.count {
            if collector.is_done() {
                break;
            }
            if collector.gap() >= parts.share {
                collector.pass(parts.share);
                continue;
            }
            stream.seek(SeekFrom::Start(parts.at(part))).map_err(io_error(path))?;
            collector.pump(&mut stream, path, parts.share * size)?;
        }
        Ok(())
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        if self.parts.count > MAX_PARTS {
            return Err(FormatError::NotPaged { path: shown(path), found: "a file of many records".into() });
        }
        let part = |i: u64| FlatFile { path: self.path.clone(), offset: self.parts.at(i) };
        flat_level(&self.plan, (0..self.parts.count).map(part).collect(), path)
    }
}

const FORMAT: &str = "NetCDF";
/// Most variables in a message.
const MAX_NAMED: usize = 8;
/// Most numbers of coordinates.
const MAX_NUMBERS: u64 = 1 << 22;
/// Most parts of a variable that is read by pages.
const MAX_PARTS: u64 = 1 << 16;
