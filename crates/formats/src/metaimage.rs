//! MetaImage (ITK's MetaIO): a text header, and voxels after it or in other files. The voxels are raw, zlib or text.
//!
//! The frame is LPS, as in DICOM, if the header has directions or an anatomical orientation. Otherwise there is no
//! body.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::axes::{Geometry, World, ras_from_lps};
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, quoted, shown};
use crate::file_list::{MAX_DATA_FILES, numbered_names};
use crate::foreign::{HomeFolder, note_on_data_files};
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{Axis, BoxLevel, Plan, Role, VolumeFile};
use crate::source::{OpenOptions, open_file};
use crate::stream::{Packing, Unpacked};
use crate::warning::WarningKind;

/// A file whose header was read.
pub(crate) struct MetaImageFile {
    plan: Plan,
    path: PathBuf,
    data: Data,
    is_text: bool,
    is_packed: bool,
    /// Bytes before the voxels of each file; −1 if the voxels are the last bytes.
    header_size: i64,
}

/// Where the voxels are.
enum Data {
    /// In the file of the header, from this byte on.
    Local(u64),
    /// In these files, with an equal part in each.
    Files(Vec<PathBuf>),
}

/// Whether `start` begins a header. Its first line must be one of [`FIRST_FIELDS`].
pub(crate) fn is_header(start: &[u8]) -> bool {
    let line = start.split(|&b| b == b'\n').next().unwrap_or_default();
    let Some((name, _)) = std::str::from_utf8(line).ok().and_then(|l| l.split_once('=')) else {
        return false;
    };
    FIRST_FIELDS.contains(&name.trim())
}

impl MetaImageFile {
    /// `file` is the file at `path`.
    pub(crate) fn open(file: File, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, "MetaImage header");
        let mut reader = BufReader::new(file);
        let fields = MetaFields::read(&mut reader).map_err(|e| match e {
            ReadError::Io(cause) => FormatError::Io { path: shown(path), cause },
            ReadError::Bad(problem) => bad(problem),
        })?;
        let start = reader.stream_position().map_err(io_error(path))?;
        let (plan, num_slices) = fields.plan().map_err(bad)?;
        let names = fields.data_files(num_slices).map_err(bad)?;
        let data = match &names {
            None => Data::Local(start),
            Some(names) => {
                let home = HomeFolder::of_header(path, options);
                Data::Files(names.iter().map(|name| home.data_file(name)).collect::<Result<_, _>>()?)
            }
        };
        let is_text = fields.flag(&["BinaryData"]).map_err(bad)? == Some(false);
        let is_packed = fields.flag(&["CompressedData"]).map_err(bad)? == Some(true);
        let header_size = match fields.get(&["HeaderSize"]) {
            None => 0,
            Some(text) => text
                .parse()
                .ok()
                .filter(|n| *n >= -1)
                .ok_or_else(|| bad(format!("HeaderSize is {}, expected -1 or more", quoted(text))))?,
        };
        let mut file = Self { plan, path: path.to_owned(), data, is_text, is_packed, header_size };
        let packing = if is_packed {
            "zlib"
        } else if is_text {
            "text"
        } else {
            "raw"
        };
        let place = if matches!(file.data, Data::Local(_)) { "" } else { ", detached" };
        file.plan.format = format!("MetaImage, {packing}{place}");
        if let Some(note) = names.and_then(|names| note_on_data_files(path, &names)) {
            file.plan.warn(WarningKind::Data, note);
        }
        Ok(file)
    }
}

impl VolumeFile for MetaImageFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let (num_elements, num_bytes) = (collector.num_elements(), collector.num_bytes());
        match &self.data {
            Data::Local(start) => self.take(collector, &self.path, *start, (num_elements, num_bytes)),
            Data::Files(files) => {
                let num_files = files.len() as u64;
                if !num_elements.is_multiple_of(num_files) {
                    let problem = format!(
                        "{num_files} data files cannot share {num_elements} voxels, expected equal parts"
                    );
                    return Err(collector.data_error(&self.path, problem));
                }
                files.iter().try_for_each(|path| {
                    let part = (num_elements / num_files, num_bytes / num_files);
                    if collector.is_done() { Ok(()) } else { self.take(collector, path, 0, part) }
                })
            }
        }
    }

    fn data_files(&self) -> Vec<PathBuf> {
        match &self.data {
            Data::Local(_) => Vec::new(),
            Data::Files(files) => files.clone(),
        }
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        if self.is_packed || self.is_text {
            let found = if self.is_text { "numbers as text" } else { "zlib" };
            return Err(FormatError::NotPaged { path: shown(path), found: found.into() });
        }
        let (start, paths) = match &self.data {
            Data::Local(start) => (*start, std::slice::from_ref(&self.path)),
            Data::Files(files) => (0, &files[..]),
        };
        let sizes = self.plan.axes.iter().map(|axis| axis.size);
        let num_bytes = sizes.fold(self.plan.dtype.num_bytes() as u64, u64::saturating_mul);
        let share = num_bytes / paths.len().max(1) as u64;
        let mut files = Vec::new();
        for path in paths {
            let length = open_file(path)?.metadata().map_err(io_error(path))?.len();
            files.push(FlatFile { path: path.clone(), offset: self.first_byte(start, length, share) });
        }
        flat_level(&self.plan, files, path)
    }
}

impl MetaImageFile {
    /// The byte of the first voxel of a file of `length` bytes, whose header ends at `start`.
    fn first_byte(&self, start: u64, length: u64, num_bytes: u64) -> u64 {
        match u64::try_from(self.header_size) {
            Ok(skip) => start.saturating_add(skip),
            Err(_) if self.is_packed || self.is_text => start,
            Err(_) => length.saturating_sub(num_bytes).max(start),
        }
    }

    /// Reads the voxels of one file from byte `start`.
    fn take(
        &self,
        collector: &mut Collector,
        path: &Path,
        start: u64,
        (num_elements, num_bytes): (u64, u64),
    ) -> Result<(), FormatError> {
        let io = io_error(path);
        let mut file = open_file(path)?;
        let length = file.metadata().map_err(io)?.len();
        let start = self.first_byte(start, length, num_bytes);
        if self.is_text {
            let start = start.min(length);
            file.seek(SeekFrom::Start(start)).map_err(io)?;
            return collector.push_text(&mut BufReader::new(file), path, num_elements, length - start);
        }
        let packing = if self.is_packed {
            // MetaIO accepts gzip, too.
            let mut mark = [0; 2];
            file.seek(SeekFrom::Start(start.min(length))).map_err(io)?;
            let n = file.read(&mut mark).map_err(io)?;
            if n == 2 && mark == [0x1f, 0x8b] { Packing::Gzip } else { Packing::Zlib }
        } else {
            Packing::Plain
        };
        Unpacked::open(file, path, start, None, packing)?.take(collector, path, 0, num_bytes)
    }
}

/// The names and values of a header, in order.
struct MetaFields {
    list: Vec<(String, String)>,
    /// The file names after `ElementDataFile = LIST`.
    files: Vec<String>,
}

enum ReadError {
    Io(std::io::Error),
    Bad(String),
}

impl MetaFields {
    /// Reads up to and including `ElementDataFile`, which is the last field.
    fn read(reader: &mut BufReader<File>) -> Result<Self, ReadError> {
        let mut fields = Self { list: Vec::new(), files: Vec::new() };
        let mut bytes_left = MAX_HEADER_BYTES;
        let mut next = |reader: &mut BufReader<File>| -> Result<Option<String>, ReadError> {
            let mut line = Vec::new();
            let n = reader.take(bytes_left).read_until(b'\n', &mut line).map_err(ReadError::Io)?;
            bytes_left -= n as u64;
            if bytes_left == 0 {
                let problem = format!("no field \"ElementDataFile\" ends it within {MAX_HEADER_BYTES} bytes");
                return Err(ReadError::Bad(problem));
            }
            Ok((n > 0).then(|| String::from_utf8_lossy(&line).trim().to_owned()))
        };
        loop {
            let Some(line) = next(reader)? else {
                return Err(ReadError::Bad("field \"ElementDataFile\" is missing".into()));
            };
            if line.is_empty() {
                continue;
            }
            let Some((name, value)) = line.split_once('=') else {
                let number = fields.list.len() + 1;
                return Err(ReadError::Bad(format!(
                    "line {number} is {}, expected \"name = value\"",
                    quoted(&line)
                )));
            };
            let (name, value) = (name.trim().to_owned(), value.trim().to_owned());
            let is_last = name == "ElementDataFile";
            let is_list = is_last && value.split_ascii_whitespace().next() == Some("LIST");
            fields.list.push((name, value));
            if is_list {
                while let Some(line) = next(reader)? {
                    fields.files.extend((!line.is_empty()).then_some(line));
                }
            }
            if is_last {
                return Ok(fields);
            }
        }
    }

    /// The value of the first of `names` that is given.
    fn get(&self, names: &[&str]) -> Option<&str> {
        let find = |name: &&str| self.list.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str());
        names.iter().find_map(find)
    }

    fn flag(&self, names: &[&str]) -> Result<Option<bool>, String> {
        let Some(text) = self.get(names) else { return Ok(None) };
        match text.to_ascii_lowercase().as_str() {
            "true" | "1" | "t" => Ok(Some(true)),
            "false" | "0" | "f" => Ok(Some(false)),
            _ => Err(format!("{} is {}, expected True or False", names[0], quoted(text))),
        }
    }

    /// At least `count` finite numbers.
    fn numbers(&self, names: &[&str], count: usize) -> Result<Option<Vec<f64>>, String> {
        let Some(text) = self.get(names) else { return Ok(None) };
        let numbers: Option<Vec<f64>> =
            text.split_ascii_whitespace().map(|w| w.parse().ok().filter(|x: &f64| x.is_finite())).collect();
        let numbers = numbers.filter(|n| n.len() >= count);
        numbers.map(Some).ok_or_else(|| format!("{} is {}, expected {count} numbers", names[0], quoted(text)))
    }

    /// The plan, and the number of slices.
    fn plan(&self) -> Result<(Plan, u64), String> {
        if let Some(kind) = self.get(&["ObjectType"]).filter(|k| !k.eq_ignore_ascii_case("Image")) {
            return Err(format!("ObjectType is {}, expected Image", quoted(kind)));
        }
        let text = self.get(&["DimSize"]).ok_or("field \"DimSize\" is missing")?;
        let sizes: Option<Vec<u64>> =
            text.split_ascii_whitespace().map(|w| w.parse().ok().filter(|n| *n > 0)).collect();
        let sizes = sizes
            .filter(|s| (2..=4).contains(&s.len()))
            .ok_or_else(|| format!("DimSize is {}, expected two to four numbers of voxels", quoted(text)))?;
        let num_axes = sizes.len();
        if let Some(n) = self.get(&["NDims"]).filter(|n| n.parse() != Ok(num_axes)) {
            return Err(format!("NDims is {}, but DimSize has {num_axes} numbers", quoted(n)));
        }
        let text = self.get(&["ElementType"]).ok_or("field \"ElementType\" is missing")?;
        let dtype = match text {
            "MET_CHAR" => Dtype::Int8,
            "MET_UCHAR" => Dtype::Uint8,
            "MET_SHORT" => Dtype::Int16,
            "MET_USHORT" => Dtype::Uint16,
            // A long has four bytes in MetaIO.
            "MET_INT" | "MET_LONG" => Dtype::Int32,
            "MET_UINT" | "MET_ULONG" => Dtype::Uint32,
            "MET_LONG_LONG" => Dtype::Int64,
            "MET_ULONG_LONG" => Dtype::Uint64,
            "MET_FLOAT" => Dtype::Float,
            "MET_DOUBLE" => Dtype::Double,
            _ => return Err(format!("ElementType is {}, expected MET_UCHAR to MET_DOUBLE", quoted(text))),
        };
        let is_big = self.flag(&["BinaryDataByteOrderMSB", "ElementByteOrderMSB"])?;
        let endian = if is_big == Some(true) { Endian::Big } else { Endian::Little };
        let at = |i: usize| sizes.get(i).copied().unwrap_or(1);
        let mut axes = Axis::in_space([at(0), at(1), at(2)]);
        axes.push(Axis { size: at(3), role: Role::Time });
        if let Some(text) = self.get(&["ElementNumberOfChannels"]) {
            let size = text.parse().ok().filter(|n| (1..=MAX_CHANNELS).contains(n));
            let size = size.ok_or_else(|| {
                format!("ElementNumberOfChannels is {}, expected 1 to {MAX_CHANNELS}", quoted(text))
            })?;
            axes.insert(0, Axis { size, role: Role::Channel });
        }
        let mut plan = Plan::new("MetaImage", dtype, endian, axes, Geometry::along_axes([1.0; 3], None));
        plan.geometry = self.geometry(num_axes, &mut plan)?;
        plan.modality = self
            .get(&["Modality"])
            .and_then(|m| m.strip_prefix("MET_MOD_"))
            .map(|m| m.chars().filter(char::is_ascii_alphanumeric).take(MAX_MODALITY_CHARS).collect());
        plan.modality = plan.modality.filter(|m: &String| !m.is_empty() && m != "UNKNOWN" && m != "OTHER");
        plan.value_unit = (plan.modality.as_deref() == Some("CT")).then(|| "HU".into());
        Ok((plan, at(2)))
    }

    fn geometry(&self, num_axes: usize, plan: &mut Plan) -> Result<Geometry, String> {
        let in_space = num_axes.min(3);
        let spacing = match self.numbers(&["ElementSpacing", "ElementSize"], in_space)? {
            Some(numbers) => {
                std::array::from_fn(|i| if i < in_space { numbers[i] } else { numbers[0].abs() })
            }
            None => {
                plan.spacing_guess = Some("the header has no ElementSpacing; it was taken as 1".into());
                [1.0; 3]
            }
        };
        let matrix = self.numbers(&["TransformMatrix", "Rotation", "Orientation"], num_axes * num_axes)?;
        let orientation = self.get(&["AnatomicalOrientation"]).filter(|o| !o.contains('?'));
        let is_body = matrix.is_some() || orientation.is_some();
        // As in ITK, each row of the matrix is the direction of an axis.
        let direction = |axis: usize| match &matrix {
            Some(m) if axis < in_space => {
                DVec3::from_array([0, 1, 2].map(|c| if c < in_space { m[axis * num_axes + c] } else { 0.0 }))
            }
            _ => DVec3::AXES[axis],
        };
        let in_world = |v: DVec3| if is_body { ras_from_lps(v) } else { v };
        if matrix.is_none()
            && let Some(text) = orientation.filter(|o| !o.eq_ignore_ascii_case("RAI"))
        {
            let text = format!(
                "AnatomicalOrientation {} without a TransformMatrix was read as LPS, as ITK does",
                quoted(text)
            );
            plan.warn(WarningKind::Guess, text);
        }
        let origin = self.numbers(&["Offset", "Position", "Origin"], in_space)?;
        let origin = origin
            .map(|o| in_world(DVec3::from_array([0, 1, 2].map(|i| if i < in_space { o[i] } else { 0.0 }))));
        let mut steps: [DVec3; 3] =
            std::array::from_fn(|i| in_world(direction(i)).normalize_or_zero() * spacing[i]);
        if num_axes == 2 {
            let normal = steps[0].cross(steps[1]).normalize_or(DVec3::Z);
            steps[2] = normal * steps[0].length();
        }
        // ITK uses millimetres for bodies. Without a body, the unit is unknown.
        let world = if is_body { World::Body } else { World::Space };
        Ok(Geometry { steps, origin, world, unit: is_body.then(|| "mm".to_owned()) })
    }

    /// The names of the files with the voxels; `None` if the voxels follow the header.
    fn data_files(&self, num_slices: u64) -> Result<Option<Vec<String>>, String> {
        let text = self.get(&["ElementDataFile"]).unwrap_or_default();
        let bad = || {
            format!(
                "ElementDataFile is {}, expected LOCAL, a file, LIST, or a pattern like s%03d.raw 1 90 1",
                quoted(text)
            )
        };
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        let names = match words[..] {
            ["LOCAL" | "Local" | "local"] => return Ok(None),
            ["LIST", ref dimension @ ..] if dimension.len() < 2 => self.files.clone(),
            [pattern, first, last, step] if pattern.contains('%') => {
                let number = |w: &str| w.parse::<i64>().map_err(|_| bad());
                numbered_names(pattern, number(first)?, number(last)?, number(step)?).ok_or_else(bad)?
            }
            [pattern] if pattern.contains('%') => {
                let last = i64::try_from(num_slices).map_err(|_| bad())?;
                numbered_names(pattern, 1, last, 1).ok_or_else(bad)?
            }
            _ => vec![text.to_owned()],
        };
        if names.is_empty() || names.iter().any(String::is_empty) || names.len() > MAX_DATA_FILES {
            return Err(bad());
        }
        Ok(Some(names))
    }
}

/// The fields that come first in a header.
const FIRST_FIELDS: [&str; 4] = ["ObjectType", "NDims", "Comment", "ObjectSubType"];
/// Longest header in bytes.
const MAX_HEADER_BYTES: u64 = 1 << 20;
/// Most channels of a voxel.
const MAX_CHANNELS: u64 = 4096;
/// Longest name of a modality.
const MAX_MODALITY_CHARS: usize = 8;
