//! Legacy VTK files (`.vtk`) of an image: STRUCTURED_POINTS, as text or binary.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::axes::Geometry;
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, quoted};
use crate::plan::{Axis, Plan, Role, VolumeFile};
use crate::source::open_file;
use crate::stream::{Packing, Unpacked};

/// A file whose header was read.
pub(crate) struct VtkFile {
    plan: Plan,
    path: PathBuf,
    is_text: bool,
    /// Offset of the first number.
    start: u64,
}

pub(crate) const MAGIC: &[u8] = b"# vtk DataFile";

/// What a header says, up to the numbers of its first array.
#[derive(Default)]
struct Header {
    is_text: bool,
    dims: Option<[u64; 3]>,
    origin: [f64; 3],
    spacing: Option<[f64; 3]>,
    is_of_cells: bool,
    array: Option<(String, Dtype, u64)>,
}

impl VtkFile {
    /// `file` is the file at `path`.
    pub(crate) fn open(file: File, path: &Path) -> Result<Self, FormatError> {
        let bad = malformed(path, "VTK header");
        let mut reader = BufReader::new(file);
        let mut header = Header::default();
        let mut number = 0;
        let mut left = MAX_HEADER_BYTES;
        while header.array.is_none() {
            let mut line = Vec::new();
            let n = reader.by_ref().take(left).read_until(b'\n', &mut line).map_err(io_error(path))?;
            left -= n as u64;
            if n == 0 {
                return Err(bad(format!("no array begins within {} bytes", MAX_HEADER_BYTES - left)));
            }
            header.line(number, String::from_utf8_lossy(&line).trim()).map_err(bad)?;
            number += 1;
        }
        // A colour table may be named before the numbers.
        let at = reader.stream_position().map_err(io_error(path))?;
        let mut line = Vec::new();
        let n = reader.by_ref().take(256).read_until(b'\n', &mut line).map_err(io_error(path))?;
        let start = if line.starts_with(b"LOOKUP_TABLE") { at + n as u64 } else { at };
        let Header { is_text, dims, origin, spacing, is_of_cells, array } = header;
        let dims = dims.ok_or_else(|| bad("DIMENSIONS is missing".into()))?;
        let dims = if is_of_cells { dims.map(|n| n.saturating_sub(1).max(1)) } else { dims };
        let (name, dtype, num_components) = array.ok_or_else(|| bad("there is no array".into()))?;
        let steps = spacing.unwrap_or([1.0; 3]);
        let half = if is_of_cells { 0.5 } else { 0.0 };
        let geometry = Geometry {
            origin: Some(DVec3::from_array(std::array::from_fn(|i| origin[i] + half * steps[i]))),
            ..Geometry::along_axes(steps, None)
        };
        let role = if num_components > 1 { Role::Channel } else { Role::Single };
        let mut axes = vec![Axis { size: num_components, role }];
        axes.extend(Axis::in_space(dims));
        let kind = if is_text { "text" } else { "binary" };
        let mut plan = Plan::new(format!("VTK image, {kind}"), dtype, Endian::Big, axes, geometry);
        plan.channel_names = (0..num_components).map(|i| format!("{name} {i}")).collect();
        if num_components == 1 {
            plan.channel_names = vec![name];
        }
        if spacing.is_none() {
            plan.spacing_guess = Some("the file has no spacing; it was taken as 1".into());
        }
        Ok(Self { plan, path: path.to_owned(), is_text, start })
    }
}

impl Header {
    /// Reads line `number`, from 0. The error says what is wrong.
    fn line(&mut self, number: usize, line: &str) -> Result<(), String> {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        // The first two lines are the mark and a title.
        if number < 2 {
            return Ok(());
        }
        if number == 2 {
            self.is_text = match line {
                "ASCII" => true,
                "BINARY" => false,
                _ => return Err(format!("line 3 is {}, expected ASCII or BINARY", quoted(line))),
            };
            return Ok(());
        }
        let wrong = |expected: &str| format!("{} in {}, expected {expected}", words.len(), quoted(line));
        let numbers = || -> Option<[f64; 3]> {
            let list: Vec<f64> = words.get(1..4)?.iter().filter_map(|w| w.parse().ok()).collect();
            list.try_into().ok().filter(|l: &[f64; 3]| l.iter().all(|x| x.is_finite()))
        };
        match words.as_slice() {
            ["DATASET", "STRUCTURED_POINTS"] => {}
            ["DATASET", other, ..] => {
                return Err(format!(
                    "the dataset is {}, expected STRUCTURED_POINTS, which is an image",
                    quoted(other)
                ));
            }
            ["DIMENSIONS", sizes @ ..] => {
                let sizes: Vec<u64> = sizes.iter().filter_map(|w| w.parse().ok()).collect();
                self.dims = Some(sizes.try_into().map_err(|_| wrong("three sizes"))?);
            }
            ["ORIGIN", ..] => self.origin = numbers().ok_or_else(|| wrong("three numbers"))?,
            ["SPACING" | "ASPECT_RATIO", ..] => {
                self.spacing = Some(numbers().ok_or_else(|| wrong("three numbers"))?);
            }
            ["CELL_DATA", _] => self.is_of_cells = true,
            ["SCALARS", name, kind] => self.set_array(name, kind, "1")?,
            ["SCALARS", name, kind, count] => self.set_array(name, kind, count)?,
            ["VECTORS" | "NORMALS", name, kind] => self.set_array(name, kind, "3")?,
            ["TENSORS", name, kind] => self.set_array(name, kind, "9")?,
            ["FIELD" | "POINT_DATA" | "METADATA", ..] | [] => {}
            // An array of a field: its name, components, tuples and type.
            [name, count, _, kind] if self.dims.is_some() => self.set_array(name, kind, count)?,
            _ => {}
        }
        Ok(())
    }

    fn set_array(&mut self, name: &str, kind: &str, count: &str) -> Result<(), String> {
        let dtype = match kind {
            "unsigned_char" => Dtype::Uint8,
            "char" | "signed_char" => Dtype::Int8,
            "unsigned_short" => Dtype::Uint16,
            "short" => Dtype::Int16,
            "unsigned_int" => Dtype::Uint32,
            "int" => Dtype::Int32,
            "unsigned_long" | "vtktypeuint64" => Dtype::Uint64,
            "long" | "vtktypeint64" | "vtkIdType" => Dtype::Int64,
            "float" => Dtype::Float,
            "double" => Dtype::Double,
            _ => {
                return Err(format!(
                    "array {} has the type {}, expected a number",
                    quoted(name),
                    quoted(kind)
                ));
            }
        };
        let count = count.parse().ok().filter(|n| (1..=MAX_COMPONENTS).contains(n));
        let count = count.ok_or_else(|| format!("array {} has too many components", quoted(name)))?;
        self.array = Some((quoted(name).trim_matches('"').to_owned(), dtype, count));
        Ok(())
    }
}

impl VolumeFile for VtkFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let (path, num_bytes) = (&self.path, collector.num_bytes());
        let mut file = open_file(path)?;
        if self.is_text {
            let length = file.metadata().map_err(io_error(path))?.len();
            file.seek(SeekFrom::Start(self.start)).map_err(io_error(path))?;
            let num_numbers = collector.num_elements();
            let left = length.saturating_sub(self.start);
            return collector.push_text(&mut BufReader::new(file), path, num_numbers, left);
        }
        // Other arrays may follow.
        let data = Unpacked::open(file, path, 0, None, Packing::Plain)?;
        data.take_some(collector, path, self.start, num_bytes).map(drop)
    }
}

const MAX_HEADER_BYTES: u64 = 1 << 16;
const MAX_COMPONENTS: u64 = 256;
