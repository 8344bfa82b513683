//! XML images of VTK (`.vti`) with point or cell data. These are text, base64 or raw, inline or appended, and plain,
//! zlib or LZ4. Each component of each array is a channel.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use base64::prelude::{BASE64_STANDARD, Engine};
use flate2::bufread::ZlibDecoder;
use glam::DVec3;

use crate::axes::Geometry;
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, quoted, shown};
use crate::plan::{Axis, Plan, Role, VolumeFile};
use crate::source::{OpenOptions, open_file};
use crate::stream::{MAX_DEFLATE_RATIO, Stream, read_past};
use crate::xml::{Tags, XmlTag};

/// A file whose header was read.
pub(crate) struct VtiFile {
    plan: Plan,
    path: PathBuf,
    array: DataArray,
    header: FileAttributes,
    /// Offset of appended data, and whether they are in base64.
    appended: Option<(u64, bool)>,
}

/// The attributes of the outermost element.
#[derive(Clone, Debug)]
struct FileAttributes {
    endian: Endian,
    size_bytes: usize,
    compressor: Compressor,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Compressor {
    None,
    Zlib,
    Lz4,
}

/// A `DataArray` element.
#[derive(Clone, Debug)]
struct DataArray {
    name: String,
    dtype: Dtype,
    components: u64,
    is_cells: bool,
    place: DataLocation,
}

/// The location of its numbers.
#[derive(Clone, Copy, Debug)]
enum DataLocation {
    /// At this offset in the appended data.
    Appended(u64),
    /// As base64, after the tag that ends at this offset.
    Base64(u64),
    /// As text, after the tag that ends at this offset.
    Text(u64),
}

impl VtiFile {
    /// `file` is the file at `path`. The options choose an array.
    pub(crate) fn open(file: File, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, "VTK header");
        let mut document = Document::default();
        let mut tags = Tags::new(BufReader::new(file));
        loop {
            options.check_cancelled(path)?;
            let tag = tags.next().map_err(|e| match e.kind() {
                io::ErrorKind::InvalidData => bad(e.to_string()),
                _ => io_error(path)(e),
            })?;
            let Some(tag) = tag else { break };
            if !document.take(tag).map_err(bad)? {
                break;
            }
        }
        if let Some((_, is_base64)) = document.appended {
            // An underscore precedes the first byte.
            let start = tags.offset_after(b'_').map_err(io_error(path))?;
            document.appended = start.map(|at| (at, is_base64));
        }
        let channel = options.selection.channel.map(u64::from);
        let (plan, array) = document.plan(channel).map_err(bad)?;
        if matches!(array.place, DataLocation::Appended(_)) && document.appended.is_none() {
            return Err(bad(format!("array {} is appended, but no data are", quoted(&array.name))));
        }
        let header = document.header.ok_or_else(|| bad("there is no VTKFile element".into()))?;
        Ok(Self { plan, path: path.to_owned(), array, header, appended: document.appended })
    }
}

impl VolumeFile for VtiFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let path = &self.path;
        let io = io_error(path);
        let mut file = open_file(path)?;
        let length = file.metadata().map_err(&io)?.len();
        let (start, is_base64) = match (self.array.place, self.appended) {
            (DataLocation::Text(at), _) => return self.read_text(file, at, length, collector),
            (DataLocation::Base64(at), _) => (at, true),
            (DataLocation::Appended(offset), Some((at, is_base64))) => (at.saturating_add(offset), is_base64),
            (DataLocation::Appended(_), None) => return Ok(()),
        };
        let left = length.saturating_sub(start);
        file.seek(SeekFrom::Start(start.min(length))).map_err(&io)?;
        let mut reader: Box<dyn Stream> = match is_base64 {
            true => Box::new(Base64::new(BufReader::new(file))),
            false => Box::new(BufReader::new(file)),
        };
        let cut = |e: io::Error| FormatError::Data {
            path: shown(path),
            problem: format!("sizes of the array: {e}"),
        };
        let num_bytes = collector.num_bytes();
        if self.header.compressor == Compressor::None {
            let told = self.size(&mut reader).map_err(cut)?;
            collector.check_length(path, num_bytes, told.min(left))?;
            return collector.pump(&mut reader, path, num_bytes);
        }
        let [num_blocks, block_bytes, last_bytes] =
            [self.size(&mut reader), self.size(&mut reader), self.size(&mut reader)];
        let (num_blocks, block_bytes, last_bytes) =
            (num_blocks.map_err(cut)?, block_bytes.map_err(cut)?, last_bytes.map_err(cut)?);
        if num_blocks > left / self.header.size_bytes as u64
            || block_bytes > MAX_BLOCK_BYTES
            || last_bytes > block_bytes
        {
            let problem = format!(
                "{num_blocks} blocks of {block_bytes} bytes, the last of {last_bytes}, in {left} bytes"
            );
            return Err(collector.data_error(path, problem));
        }
        let full = num_blocks - u64::from(last_bytes > 0 && num_blocks > 0);
        collector.check_length(path, num_bytes, full * block_bytes + last_bytes)?;
        let ratio =
            if self.header.compressor == Compressor::Zlib { MAX_DEFLATE_RATIO } else { MAX_LZ4_RATIO };
        collector.check_length(path, num_bytes, left.saturating_mul(ratio))?;
        let mut sizes = Vec::new();
        for _ in 0..num_blocks {
            sizes.push(self.size(&mut reader).map_err(cut)?);
        }
        let sizes = sizes.into_iter();
        let mut blocks = Blocks {
            reader,
            compressor: self.header.compressor,
            sizes,
            block_bytes: block_bytes as usize,
            most: left,
            block: Vec::new(),
            at: 0,
        };
        collector.pump(&mut blocks, path, num_bytes)
    }
}

impl VtiFile {
    fn size(&self, reader: &mut dyn Read) -> io::Result<u64> {
        let mut bytes = [0; 8];
        let bytes = &mut bytes[..self.header.size_bytes];
        reader.read_exact(bytes)?;
        let fold = |n: u64, b: &u8| n << 8 | u64::from(*b);
        Ok(if self.header.endian == Endian::Big {
            bytes.iter().fold(0, fold)
        } else {
            bytes.iter().rev().fold(0, fold)
        })
    }

    fn read_text(
        &self,
        mut file: File,
        at: u64,
        length: u64,
        collector: &mut Collector,
    ) -> Result<(), FormatError> {
        file.seek(SeekFrom::Start(at)).map_err(io_error(&self.path))?;
        let count = collector.num_elements();
        collector.push_text(&mut BufReader::new(file), &self.path, count, length.saturating_sub(at))
    }
}

#[derive(Default)]
struct Document {
    header: Option<FileAttributes>,
    extent: Option<[i64; 6]>,
    origin: [f64; 3],
    spacing: Option<[f64; 3]>,
    direction: Option<[f64; 9]>,
    num_pieces: usize,
    piece: Option<[i64; 6]>,
    /// Names of the active arrays of points and of cells.
    active: [Option<String>; 2],
    /// Whether the current element has cells; `None` outside of such elements.
    is_cells: Option<bool>,
    arrays: Vec<DataArray>,
    refused: Option<String>,
    appended: Option<(u64, bool)>,
}

impl Document {
    /// Handles a tag. Returns `false` if later tags do not matter.
    fn take(&mut self, tag: XmlTag) -> Result<bool, String> {
        match (tag.name.as_str(), tag.is_end) {
            ("VTKFile", false) => self.header = Some(FileAttributes::of(&tag)?),
            ("ImageData", false) => {
                self.extent = numbers(&tag, "WholeExtent")?;
                self.spacing = numbers(&tag, "Spacing")?;
                self.origin = numbers(&tag, "Origin")?.unwrap_or_default();
                self.direction = numbers(&tag, "Direction")?;
            }
            ("Piece", false) => {
                self.num_pieces += 1;
                self.piece = numbers(&tag, "Extent")?;
            }
            ("PointData" | "CellData", is_end) => {
                let is_cells = tag.name == "CellData";
                self.is_cells = (!is_end).then_some(is_cells);
                if !is_end {
                    self.active[usize::from(is_cells)] = tag.get("Scalars").map(str::to_owned);
                }
            }
            ("DataArray", false) if self.arrays.len() < MAX_ARRAYS => {
                if let Some(is_cells) = self.is_cells {
                    match array(&tag, is_cells) {
                        Ok(array) => self.arrays.push(array),
                        Err(problem) => {
                            self.refused.get_or_insert(problem);
                        }
                    }
                }
            }
            ("AppendedData", false) => {
                let is_base64 = match tag.get("encoding").unwrap_or("base64") {
                    "base64" => true,
                    "raw" => false,
                    other => {
                        return Err(format!("appended data are {}, expected raw or base64", quoted(other)));
                    }
                };
                self.appended = Some((tag.end, is_base64));
                return Ok(false);
            }
            _ => {}
        }
        Ok(true)
    }

    fn plan(&mut self, channel: Option<u64>) -> Result<(Plan, DataArray), String> {
        let header = self.header.as_ref().ok_or("there is no VTKFile element")?;
        if self.num_pieces > 1 {
            return Err(format!("the image has {} pieces, expected one", self.num_pieces));
        }
        let extent = self.piece.or(self.extent).ok_or("there is no extent")?;
        let mut dims = [0; 3];
        for (i, dim) in dims.iter_mut().enumerate() {
            let n = extent[2 * i + 1].checked_sub(extent[2 * i]).and_then(|n| n.checked_add(1));
            *dim = n
                .and_then(|n| u64::try_from(n).ok())
                .filter(|&n| n > 0 && n < 1 << 32)
                .ok_or_else(|| format!("the extent is {extent:?}, expected ranges of points"))?;
        }
        let mut choices: Vec<(usize, u64)> = Vec::new();
        let mut names = Vec::new();
        for (i, array) in self.arrays.iter().enumerate() {
            for component in 0..array.components {
                choices.push((i, component));
                let index = if array.components > 1 { format!("[{component}]") } else { String::new() };
                let cells = if array.is_cells { " (cells)" } else { "" };
                names.push(format!("{}{index}{cells}", quoted(&array.name).trim_matches('"')));
            }
        }
        let is_active = |&(i, _): &(usize, u64)| {
            let array = &self.arrays[i];
            self.active[usize::from(array.is_cells)].as_deref() == Some(&array.name)
        };
        let preferred = choices.iter().position(is_active).unwrap_or(0);
        let index = channel.map_or(preferred, |c| c as usize);
        let Some(&(chosen, component)) = choices.get(index).or(choices.first()) else {
            return Err(self.refused.take().unwrap_or_else(|| "there is no array of points or cells".into()));
        };
        let array = self.arrays[chosen].clone();
        let cells = u64::from(array.is_cells);
        // A slice of one point has one cell.
        let sizes = dims.map(|n| if n > 1 { n - cells } else { n });
        let mut axes = vec![Axis { size: array.components, role: Role::Picked(component) }];
        axes.extend(Axis::in_space(sizes));
        let spacing = self.spacing.unwrap_or([1.0; 3]);
        let mut geometry = Geometry::along_axes(spacing, None);
        if let Some(d) = self.direction {
            // The matrix is in rows, and its columns are the directions of the axes.
            let direction = |c: usize| DVec3::new(d[c], d[3 + c], d[6 + c]);
            geometry.steps = std::array::from_fn(|i| direction(i) * spacing[i]);
        }
        let first = std::array::from_fn::<f64, 3, _>(|i| extent[2 * i] as f64 + 0.5 * cells as f64);
        let origin = (0..3).fold(DVec3::from_array(self.origin), |p, i| p + geometry.steps[i] * first[i]);
        geometry.origin = Some(origin);
        let packing = match header.compressor {
            Compressor::None => "plain",
            Compressor::Zlib => "zlib",
            Compressor::Lz4 => "LZ4",
        };
        let place = match array.place {
            DataLocation::Appended(_) if self.appended.is_some_and(|a| !a.1) => "appended raw",
            DataLocation::Appended(_) => "appended base64",
            DataLocation::Base64(_) => "inline base64",
            DataLocation::Text(_) => "text",
        };
        let packing =
            if matches!(array.place, DataLocation::Text(_)) { String::new() } else { format!(", {packing}") };
        let mut plan =
            Plan::new(format!("VTK image, {place}{packing}"), array.dtype, header.endian, axes, geometry);
        plan.num_channels = choices.len() as u64;
        plan.channel_names = names;
        plan.channel = preferred as u64;
        if self.spacing.is_none() {
            plan.spacing_guess = Some("the header has no spacing; it was taken as 1".into());
        }
        Ok((plan, array))
    }
}

impl FileAttributes {
    fn of(tag: &XmlTag) -> Result<Self, String> {
        let kind = tag.get("type").unwrap_or_default();
        if kind != "ImageData" {
            return Err(format!("the file is of type {}, expected ImageData", quoted(kind)));
        }
        let endian = match tag.get("byte_order") {
            None | Some("LittleEndian") => Endian::Little,
            Some("BigEndian") => Endian::Big,
            Some(other) => {
                return Err(format!("byte_order is {}, expected LittleEndian or BigEndian", quoted(other)));
            }
        };
        let size_bytes = match tag.get("header_type") {
            None | Some("UInt32") => 4,
            Some("UInt64") => 8,
            Some(other) => {
                return Err(format!("header_type is {}, expected UInt32 or UInt64", quoted(other)));
            }
        };
        let compressor = match tag.get("compressor") {
            None | Some("") => Compressor::None,
            Some("vtkZLibDataCompressor") => Compressor::Zlib,
            Some("vtkLZ4DataCompressor") => Compressor::Lz4,
            Some(other) => {
                return Err(format!(
                    "compressor is {}, expected none, vtkZLibDataCompressor or vtkLZ4DataCompressor",
                    quoted(other)
                ));
            }
        };
        Ok(Self { endian, size_bytes, compressor })
    }
}

fn array(tag: &XmlTag, is_cells: bool) -> Result<DataArray, String> {
    let kind = tag.get("type").unwrap_or_default();
    let dtype = match kind {
        "Int8" => Dtype::Int8,
        "UInt8" => Dtype::Uint8,
        "Int16" => Dtype::Int16,
        "UInt16" => Dtype::Uint16,
        "Int32" => Dtype::Int32,
        "UInt32" => Dtype::Uint32,
        "Int64" => Dtype::Int64,
        "UInt64" => Dtype::Uint64,
        "Float32" => Dtype::Float,
        "Float64" => Dtype::Double,
        _ => return Err(format!("an array is of type {}, expected Int8 to Float64", quoted(kind))),
    };
    let components = tag.get("NumberOfComponents").unwrap_or("1");
    let count = components.parse().ok().filter(|n| (1..=MAX_COMPONENTS).contains(n));
    let count = count.ok_or_else(|| {
        format!("an array has {} components, expected 1 to {MAX_COMPONENTS}", quoted(components))
    })?;
    let place = match tag.get("format").unwrap_or("ascii") {
        "appended" => {
            let offset = tag.get("offset").unwrap_or("0");
            DataLocation::Appended(
                offset.parse().map_err(|_| format!("an offset is {}, expected a number", quoted(offset)))?,
            )
        }
        "binary" => DataLocation::Base64(tag.end),
        "ascii" => DataLocation::Text(tag.end),
        other => return Err(format!("an array is {}, expected appended, binary or ascii", quoted(other))),
    };
    Ok(DataArray {
        name: tag.get("Name").unwrap_or_default().to_owned(),
        dtype,
        components: count,
        is_cells,
        place,
    })
}

/// The `N` numbers of an attribute, if there is one.
fn numbers<T: FromStr, const N: usize>(tag: &XmlTag, name: &str) -> Result<Option<[T; N]>, String> {
    let Some(text) = tag.get(name) else { return Ok(None) };
    let numbers: Option<Vec<T>> = text.split_ascii_whitespace().map(|word| word.parse().ok()).collect();
    let numbers = numbers.and_then(|n| n.try_into().ok());
    numbers.map(Some).ok_or_else(|| format!("{name} is {}, expected {N} numbers", quoted(text)))
}

/// Text in base64. Padding ends a part, and another part may follow.
struct Base64<R> {
    reader: R,
    decoded: Cursor<Vec<u8>>,
}

impl<R: BufRead> Base64<R> {
    fn new(reader: R) -> Self {
        Self { reader, decoded: Cursor::default() }
    }

    /// Decodes the next letters, up to a padding.
    fn refill(&mut self) -> io::Result<()> {
        let mut letters = Vec::with_capacity(BASE64_LETTERS);
        while letters.len() < BASE64_LETTERS && !(letters.len() % 4 == 0 && letters.ends_with(b"=")) {
            match self.reader.fill_buf()?.first() {
                None | Some(b'<') => break,
                Some(byte) if byte.is_ascii_whitespace() => {}
                Some(byte) => letters.push(*byte),
            }
            self.reader.consume(1);
        }
        letters.truncate(letters.len() / 4 * 4);
        let decoded = BASE64_STANDARD.decode(letters).map_err(|e| invalid(e.to_string()))?;
        self.decoded = Cursor::new(decoded);
        Ok(())
    }
}

impl<R: BufRead> Read for Base64<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if self.decoded.position() == self.decoded.get_ref().len() as u64 {
            self.refill()?;
        }
        self.decoded.read(out)
    }
}

impl<R: BufRead> Stream for Base64<R> {
    fn pass(&mut self, num_bytes: u64) -> io::Result<()> {
        read_past(self, num_bytes)
    }
}

/// A sequence of compressed blocks.
struct Blocks {
    reader: Box<dyn Stream>,
    compressor: Compressor,
    /// Compressed sizes of the next blocks, in bytes.
    sizes: std::vec::IntoIter<u64>,
    block_bytes: usize,
    /// Most bytes of a block in the file.
    most: u64,
    block: Vec<u8>,
    at: usize,
}

impl Blocks {
    fn next_block(&mut self, size: u64) -> io::Result<()> {
        if size > self.most {
            return Err(invalid(format!("a block of {size} bytes is longer than the file")));
        }
        let mut packed = Vec::new();
        let n = (&mut self.reader).take(size).read_to_end(&mut packed)?;
        if (n as u64) < size {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        self.block.clear();
        self.at = 0;
        match self.compressor {
            Compressor::Lz4 => {
                let most = self.block_bytes.min(packed.len().saturating_mul(MAX_LZ4_RATIO as usize));
                self.block.resize(most, 0);
                let n = lz4_flex::block::decompress_into(&packed, &mut self.block)
                    .map_err(|e| invalid(e.to_string()))?;
                self.block.truncate(n);
            }
            _ => {
                ZlibDecoder::new(&packed[..]).take(self.block_bytes as u64).read_to_end(&mut self.block)?;
            }
        }
        Ok(())
    }
}

impl Read for Blocks {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while self.at == self.block.len() {
            let Some(size) = self.sizes.next() else { return Ok(0) };
            self.next_block(size)?;
        }
        let n = out.len().min(self.block.len() - self.at);
        out[..n].copy_from_slice(&self.block[self.at..self.at + n]);
        self.at += n;
        Ok(n)
    }
}

impl Stream for Blocks {
    fn pass(&mut self, num_bytes: u64) -> io::Result<()> {
        read_past(self, num_bytes)
    }
}

fn invalid(problem: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, problem)
}

/// Largest block, decompressed. VTK's own blocks have 32 KiB.
const MAX_BLOCK_BYTES: u64 = 256 << 20;
/// Greatest ratio of LZ4. A byte of length adds at most 255 bytes.
const MAX_LZ4_RATIO: u64 = 256;
/// Letters that are decoded at a time, a multiple of four.
const BASE64_LETTERS: usize = 1 << 14;
const MAX_ARRAYS: usize = 256;
const MAX_COMPONENTS: u64 = 256;
