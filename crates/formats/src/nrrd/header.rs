//! Reads the header of an NRRD file (definition of 2005–2022, teem.sourceforge.net/nrrd). The reader is as lenient as
//! others: names may have any case and lack the inner space. The space after a colon is optional, and lines end with
//! LF or CR LF.

use std::io::{BufRead, Read};

use super::segments::Segments;
use crate::dtype::{Dtype, Endian};
use crate::error::{HeaderError, quoted};
use crate::file_list::{MAX_DATA_FILES, numbered_names};

/// The relevant fields. Lists about axes have one entry for each axis, the fastest first.
#[derive(Debug, PartialEq)]
pub(super) struct NrrdHeader {
    pub(super) dtype: Dtype,
    pub(super) endian: Endian,
    pub(super) encoding: Encoding,
    pub(super) sizes: Vec<u64>,
    pub(super) spacings: Option<Vec<f64>>,
    /// Step of one voxel along each axis, in `space`; `None` for axes without direction.
    pub(super) directions: Option<Vec<Option<[f64; 3]>>>,
    pub(super) space: Space,
    /// Centre of the first voxel in `space`.
    pub(super) origin: Option<[f64; 3]>,
    pub(super) kinds: Option<Vec<String>>,
    /// Units along the axes, for volumes without directions.
    pub(super) units: Option<Vec<String>>,
    /// Units of `space`.
    pub(super) space_units: Option<Vec<String>>,
    /// Unit of the values, as the file writes it.
    pub(super) sample_units: Option<String>,
    pub(super) line_skip: u64,
    pub(super) byte_skip: ByteSkip,
    pub(super) data: DataFiles,
    pub(super) segments: Segments,
    pub(super) warnings: Vec<String>,
}

/// Encoding of the voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Raw,
    Gzip,
    Ascii,
}

/// Bytes before the voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ByteSkip {
    /// The number of bytes to skip.
    Forward(u64),
    /// The voxels are the last bytes of the file.
    ToEnd,
}

/// The meaning of the components of `space directions`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Space {
    /// Whether each component points towards (+) or away from (−) right, front and top of a body.
    Anatomical([f64; 3]),
    /// A frame without a body; −1 marks a left-handed one.
    Cartesian(f64),
}

/// Where the voxels are.
#[derive(Debug, PartialEq)]
pub(super) enum DataFiles {
    /// After the header.
    Attached,
    /// In these files, in order. Paths are relative to the folder of the header.
    Detached(Vec<String>),
}

impl NrrdHeader {
    /// Reads up to and including the blank line. A detached header may end with the file.
    pub(super) fn read(reader: &mut dyn BufRead) -> Result<Self, HeaderReadError> {
        let mut lines = Lines { reader, bytes_left: MAX_HEADER_BYTES, number: 0 };
        let magic = lines.next()?.unwrap_or_default();
        if !matches!(magic.strip_prefix("NRRD000").map(str::as_bytes), Some([b'1'..=b'5'])) {
            return Err(HeaderError::Magic(quoted(&magic)).into());
        }
        let mut fields = Fields::default();
        loop {
            match lines.next()? {
                Some(line) if line.is_empty() => break,
                Some(line) if line.starts_with('#') => {}
                Some(line) => {
                    fields.take(&line, lines.number)?;
                    let list = fields.text[Field::DataFile as usize].as_deref();
                    if list.is_some_and(|v| v.split_ascii_whitespace().next() == Some("LIST")) {
                        while let Some(name) = lines.next()? {
                            fields.list.extend((!name.trim().is_empty()).then(|| name.trim().to_owned()));
                        }
                        break;
                    }
                }
                None if fields.text[Field::DataFile as usize].is_some() => break,
                None => return Err(HeaderError::End(MAX_HEADER_BYTES - lines.bytes_left).into()),
            }
        }
        Ok(fields.into_header()?)
    }
}

/// The header is wrong, or the system refused to read it.
#[derive(Debug, thiserror::Error)]
pub(super) enum HeaderReadError {
    #[error(transparent)]
    Header(#[from] HeaderError),
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

macro_rules! fields {
    ($($variant:ident $name:literal),* $(,)?) => {
        #[derive(Clone, Copy)]
        enum Field { $($variant),* }

        /// Names in the spelling of the format, in the order of [`Field`].
        const FIELD_NAMES: &[&str] = &[$($name),*];
    };
}

fields! {
    Type "type", Dimension "dimension", Sizes "sizes", Encoding "encoding", Endian "endian",
    DataFile "data file", LineSkip "line skip", ByteSkip "byte skip", Spacings "spacings", Kinds "kinds",
    Units "units", Space "space", SpaceDimension "space dimension", SpaceUnits "space units",
    SpaceDirections "space directions", SpaceOrigin "space origin", SampleUnits "sample units",
}

/// Fields that affect neither the positions nor the values of voxels.
const IGNORED_FIELDS: [&str; 15] = [
    "block size",
    "content",
    "old min",
    "old max",
    "min",
    "max",
    "number",
    "thicknesses",
    "axis mins",
    "axis maxs",
    "centers",
    "centerings",
    "labels",
    "measurement frame",
    "description",
];

/// The texts of the fields, before they are parsed.
#[derive(Default)]
struct Fields {
    text: [Option<String>; FIELD_NAMES.len()],
    /// File names after `data file: LIST`.
    list: Vec<String>,
    segments: Segments,
    warnings: Vec<String>,
}

impl Fields {
    /// Adds a line that is neither blank nor a comment.
    fn take(&mut self, line: &str, number: usize) -> Result<(), HeaderError> {
        let Some((name, value)) = line.split_once(':') else {
            return Err(HeaderError::Line { line: number, found: quoted(line) });
        };
        if let Some(value) = value.strip_prefix('=') {
            self.segments.take(name, value); // other keys are meant for the program that wrote them
            return Ok(());
        }
        let folded = |s: &str| s.to_ascii_lowercase().replace([' ', '\t'], "");
        let name = folded(name);
        if let Some(i) = FIELD_NAMES.iter().position(|f| folded(f) == name) {
            if self.text[i].is_some() {
                return Err(HeaderError::Twice(FIELD_NAMES[i]));
            }
            self.text[i] = Some(value.trim().to_owned());
        } else if !IGNORED_FIELDS.iter().any(|f| folded(f) == name) && self.warnings.len() < MAX_WARNINGS {
            self.warnings.push(format!("unknown header field {} was ignored", quoted(&name)));
        }
        Ok(())
    }

    fn get(&self, field: Field) -> Option<&str> {
        self.text[field as usize].as_deref()
    }

    fn require(&self, field: Field) -> Result<&str, HeaderError> {
        self.get(field).ok_or(HeaderError::Missing(FIELD_NAMES[field as usize]))
    }

    fn bad(&self, field: Field, expected: &'static str) -> HeaderError {
        let found = quoted(self.get(field).unwrap_or_default());
        HeaderError::Value { field: FIELD_NAMES[field as usize], found, expected }
    }

    /// The `count` numbers of a field.
    fn numbers<T: std::str::FromStr>(
        &self,
        field: Field,
        count: usize,
        expected: &'static str,
    ) -> Result<Option<Vec<T>>, HeaderError> {
        let Some(text) = self.get(field) else { return Ok(None) };
        let numbers: Result<Vec<T>, _> = text.split_ascii_whitespace().map(str::parse).collect();
        let numbers = numbers.map_err(|_| self.bad(field, expected))?;
        self.counted(field, count, numbers).map(Some)
    }

    fn counted<T>(&self, field: Field, expected: usize, list: Vec<T>) -> Result<Vec<T>, HeaderError> {
        let (field, found) = (FIELD_NAMES[field as usize], list.len());
        (found == expected).then_some(list).ok_or(HeaderError::Entries { field, found, expected })
    }

    /// The `count` names of a field, with or without quotes.
    fn names(&self, field: Field, count: usize) -> Result<Option<Vec<String>>, HeaderError> {
        let Some(text) = self.get(field) else { return Ok(None) };
        let mut names = Vec::new();
        let mut rest = text.trim_start();
        while !rest.is_empty() {
            let (name, after) = match rest.strip_prefix('"') {
                Some(inner) => {
                    inner.split_once('"').ok_or_else(|| self.bad(field, "names in closed quotes"))?
                }
                None => rest.split_once([' ', '\t']).unwrap_or((rest, "")),
            };
            names.push(name.to_owned());
            rest = after.trim_start();
        }
        self.counted(field, count, names).map(Some)
    }

    fn into_header(mut self) -> Result<NrrdHeader, HeaderError> {
        let dtype: Dtype =
            self.require(Field::Type)?.parse().map_err(|_| self.bad(Field::Type, Dtype::EXPECTED))?;
        let dimension: usize = self
            .require(Field::Dimension)?
            .parse()
            .ok()
            .filter(|d| (1..=MAX_DIMENSION).contains(d))
            .ok_or_else(|| self.bad(Field::Dimension, "a number from 1 to 16"))?;
        self.require(Field::Sizes)?;
        let sizes: Vec<u64> =
            self.numbers(Field::Sizes, dimension, "positive whole numbers")?.unwrap_or_default();
        if sizes.contains(&0) {
            return Err(self.bad(Field::Sizes, "positive whole numbers"));
        }
        let encoding = match self.require(Field::Encoding)?.to_ascii_lowercase().as_str() {
            "raw" => Encoding::Raw,
            "gzip" | "gz" => Encoding::Gzip,
            "ascii" | "text" | "txt" => Encoding::Ascii,
            _ => return Err(self.bad(Field::Encoding, "raw, gzip or ascii")),
        };
        let endian = match self.get(Field::Endian) {
            Some(text) => text.parse().map_err(|_| self.bad(Field::Endian, "little or big"))?,
            None if dtype.num_bytes() == 1 || encoding == Encoding::Ascii => Endian::Little,
            None => return Err(HeaderError::Missing("endian")),
        };
        let line_skip = match self.get(Field::LineSkip) {
            Some(text) => text.parse().map_err(|_| self.bad(Field::LineSkip, "a whole number, 0 or more"))?,
            None => 0,
        };
        let byte_skip = match self.get(Field::ByteSkip) {
            Some("-1") if encoding == Encoding::Raw => ByteSkip::ToEnd,
            Some(text) => ByteSkip::Forward(
                text.parse().map_err(|_| self.bad(Field::ByteSkip, "0 or more, or -1 with raw encoding"))?,
            ),
            None => ByteSkip::Forward(0),
        };
        let (space, space_dimension) = self.space()?;
        Ok(NrrdHeader {
            dtype,
            endian,
            encoding,
            spacings: self.numbers(Field::Spacings, dimension, "numbers")?,
            directions: self.directions(dimension, space_dimension)?,
            space,
            origin: self.get(Field::SpaceOrigin).and_then(vector),
            kinds: self.names(Field::Kinds, dimension)?,
            units: self.names(Field::Units, dimension)?,
            space_units: match space_dimension {
                Some(n) => self.names(Field::SpaceUnits, n)?,
                None => None,
            },
            sample_units: self.get(Field::SampleUnits).map(|text| text.trim_matches('"').to_owned()),
            sizes,
            line_skip,
            byte_skip,
            data: self.data_files(dimension)?,
            segments: std::mem::take(&mut self.segments),
            warnings: std::mem::take(&mut self.warnings),
        })
    }

    /// The space, and its number of dimensions if the header names a space.
    fn space(&self) -> Result<(Space, Option<usize>), HeaderError> {
        let number = match self.get(Field::SpaceDimension) {
            Some(text) => Some(
                text.parse()
                    .ok()
                    .filter(|n| (1..=MAX_SPACE_DIMENSION).contains(n))
                    .ok_or_else(|| self.bad(Field::SpaceDimension, "a number from 1 to 4"))?,
            ),
            None => None,
        };
        let Some(text) = self.get(Field::Space) else { return Ok((Space::Cartesian(1.0), number)) };
        if number.is_some() {
            let both = "both \"space\" and \"space dimension\" are given, expected one of them";
            return Err(HeaderError::Contradiction(both.into()));
        }
        let name = text.to_ascii_lowercase();
        let (name, dimension) = match name.strip_suffix("-time") {
            Some(name) => (name, 4),
            None if matches!(name.as_str(), "rast" | "last" | "lpst") => (&name[..3], 4),
            None => (name.as_str(), 3),
        };
        let space = match name {
            "right-anterior-superior" | "ras" => Space::Anatomical([1.0, 1.0, 1.0]),
            "left-anterior-superior" | "las" => Space::Anatomical([-1.0, 1.0, 1.0]),
            "left-posterior-superior" | "lps" => Space::Anatomical([-1.0, -1.0, 1.0]),
            "scanner-xyz" | "3d-right-handed" => Space::Cartesian(1.0),
            "3d-left-handed" => Space::Cartesian(-1.0),
            _ => {
                let known = "right-anterior-superior, left-anterior-superior, left-posterior-superior, scanner-xyz, \
                             3D-right-handed or 3D-left-handed";
                return Err(self.bad(Field::Space, known));
            }
        };
        Ok((space, Some(dimension)))
    }

    /// The field `space directions`. It has a vector in parentheses for each axis, or `none`, or `nan`.
    fn directions(
        &self,
        dimension: usize,
        space_dimension: Option<usize>,
    ) -> Result<Option<Vec<Option<[f64; 3]>>>, HeaderError> {
        let field = Field::SpaceDirections;
        let Some(text) = self.get(field) else { return Ok(None) };
        let Some(space_dimension) = space_dimension else {
            let alone = "\"space directions\" are given, but neither \"space\" nor \"space dimension\"";
            return Err(HeaderError::Contradiction(alone.into()));
        };
        let bad = || self.bad(field, "for each axis none or a vector like (0,0,1) of finite numbers");
        let mut directions = Vec::new();
        let mut rest = text;
        while !rest.is_empty() {
            let none = ["none", "nan"]
                .into_iter()
                .find(|none| rest.get(..none.len()).is_some_and(|word| word.eq_ignore_ascii_case(none)));
            if let Some(none) = none {
                directions.push(None);
                rest = rest[none.len()..].trim_start();
                continue;
            }
            let (inner, after) = rest.strip_prefix('(').and_then(|r| r.split_once(')')).ok_or_else(bad)?;
            let numbers: Result<Vec<f64>, _> = inner.split(',').map(|n| n.trim().parse()).collect();
            let numbers = numbers.map_err(|_| bad())?;
            let is_none = numbers.iter().all(|x| x.is_nan());
            if !is_none && !numbers.iter().all(|x| x.is_finite()) {
                return Err(bad());
            }
            if numbers.len() != space_dimension {
                let found = numbers.len();
                let what = format!(
                    "a vector of \"space directions\" has {found} components, expected {space_dimension}"
                );
                return Err(HeaderError::Contradiction(what));
            }
            // A fourth component is time, and a volume shows one point in time.
            let direction = std::array::from_fn(|i| numbers.get(i).copied().unwrap_or(0.0));
            directions.push((!is_none).then_some(direction));
            rest = after.trim_start();
        }
        self.counted(field, dimension, directions).map(Some)
    }

    /// The field `data file`: one name, `LIST` with names below it, or a printf pattern with first, last and step.
    fn data_files(&self, dimension: usize) -> Result<DataFiles, HeaderError> {
        let Some(text) = self.get(Field::DataFile) else { return Ok(DataFiles::Attached) };
        let bad = || self.bad(Field::DataFile, "a file name, LIST, or a pattern like slice%03d.raw 1 90 1");
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        // The last number is the number of dimensions of each file. It is only checked, because the sizes imply it.
        let is_subdimension = |w: &str| w.parse().is_ok_and(|d: usize| (1..=dimension).contains(&d));
        let names = match words[..] {
            ["LIST"] => self.list.clone(),
            ["LIST", sub] if is_subdimension(sub) => self.list.clone(),
            [pattern, first, last, step, ref sub @ ..] if pattern.contains('%') && sub.len() < 2 => {
                let number = |w: &str| w.parse::<i64>().map_err(|_| bad());
                let (first, last, step) = (number(first)?, number(last)?, number(step)?);
                if !sub.iter().all(|w| is_subdimension(w)) {
                    return Err(bad());
                }
                numbered_names(pattern, first, last, step).ok_or_else(bad)?
            }
            _ => vec![text.to_owned()],
        };
        if names.is_empty() || names.iter().any(String::is_empty) || names.len() > MAX_DATA_FILES {
            return Err(bad());
        }
        Ok(DataFiles::Detached(names))
    }
}

/// A vector such as `(0,0,1)`. Missing components are 0.
fn vector(text: &str) -> Option<[f64; 3]> {
    let inner = text.trim().strip_prefix('(')?.strip_suffix(')')?;
    let numbers: Vec<f64> = inner.split(',').map(|n| n.trim().parse().ok()).collect::<Option<_>>()?;
    let is_good = numbers.len() <= MAX_SPACE_DIMENSION && numbers.iter().all(|x| x.is_finite());
    is_good.then(|| std::array::from_fn(|i| numbers.get(i).copied().unwrap_or(0.0)))
}

/// The lines of a header without their ends. They have at most [`MAX_HEADER_BYTES`] in all.
struct Lines<'a> {
    reader: &'a mut dyn BufRead,
    bytes_left: u64,
    number: usize,
}

impl Lines<'_> {
    /// The next line, `None` at the end of the file.
    fn next(&mut self) -> Result<Option<String>, HeaderReadError> {
        let mut line = Vec::new();
        let n = (&mut *self.reader).take(self.bytes_left).read_until(b'\n', &mut line)?;
        self.bytes_left -= n as u64;
        self.number += 1;
        if self.bytes_left == 0 && line.last() != Some(&b'\n') {
            return Err(HeaderError::End(MAX_HEADER_BYTES).into());
        }
        let text = String::from_utf8_lossy(&line);
        Ok((n > 0).then(|| text.trim_end_matches(['\n', '\r']).to_owned()))
    }
}

/// Longest header in bytes. Most have a few kilobytes, and lists of slices a few hundred.
const MAX_HEADER_BYTES: u64 = 1 << 20;
/// The limit of the reference reader (NRRD_DIM_MAX).
const MAX_DIMENSION: usize = 16;
/// Three directions and time.
const MAX_SPACE_DIMENSION: usize = 4;
/// Most warnings about one header.
const MAX_WARNINGS: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<NrrdHeader, HeaderError> {
        NrrdHeader::read(&mut text.as_bytes()).map_err(|e| match e {
            HeaderReadError::Header(e) => e,
            HeaderReadError::Io(e) => panic!("slices cannot fail: {e}"),
        })
    }

    const PLAIN: &str = "NRRD0004\ntype: uint16\ndimension: 3\nsizes: 4 3 2\nendian: little\nencoding: raw\n";

    #[test]
    fn spelling_does_not_matter() {
        let plain = read(&format!("{PLAIN}byte skip: 5\n\n")).unwrap();
        let odd = "NRRD0001\r\n# a comment: with a colon\r\nTYPE:unsigned short\r\nDimension:   3\r\nSIZES: 4 3 2\r\n\
                   Endian:Little\r\nENCODING: RAW\r\nByteSkip: 5\r\nkey:=value: one\r\ncontent: a:=b\r\n\r\n";
        assert_eq!(read(odd).unwrap(), plain);
        assert_ne!(read(&format!("{PLAIN}byte skip: 6\n\n")).unwrap(), plain);
    }

    #[test]
    fn each_kind_of_data_file() {
        let files = |line: &str| match read(&format!("{PLAIN}{line}\n")).unwrap().data {
            DataFiles::Detached(files) => files,
            DataFiles::Attached => panic!("{line} is detached"),
        };
        assert_eq!(files("data file: ./my volume.raw"), ["./my volume.raw"]);
        assert_eq!(files("datafile:a.raw"), ["a.raw"]);
        assert_eq!(files("data file: LIST\n a.raw\nb.raw\r\n"), ["a.raw", "b.raw"]);
        assert_eq!(files("data file: s%02d.raw 9 11 1 2"), ["s09.raw", "s10.raw", "s11.raw"]);
        assert_eq!(files("data file: s%d.raw 3 1 -2"), ["s3.raw", "s1.raw"]);
        for wrong in ["LIST", "s%d.raw 1 9 0", "s%s.raw 1 9 1", "s%d.raw 1 99999999 1", "s%d%d.raw 1 2 1", ""]
        {
            let e = read(&format!("{PLAIN}data file: {wrong}\n")).unwrap_err();
            assert!(matches!(e, HeaderError::Value { field: "data file", .. }), "{wrong}: {e}");
        }
    }

    #[test]
    fn vectors_with_spaces_and_none() {
        let text = |v: &str| {
            let start = PLAIN.replace("dimension: 3\nsizes: 4 3 2", "dimension: 4\nsizes: 1 4 3 2");
            read(&format!("{start}space: LPS\nspace directions: {v}\n\n"))
        };
        let directions = text("none (1, 0,0.5)(0,-2,0)  (0,0,3e-1)").unwrap().directions.unwrap();
        let expected = [None, Some([1.0, 0.0, 0.5]), Some([0.0, -2.0, 0.0]), Some([0.0, 0.0, 0.3])];
        assert_eq!(directions, expected);
        for wrong in ["none (1,0,0)", "none (1,0) (0,1) (0,0)", "none (1,0,0) (0,1,0) (0,0,nan)", "(1,0,0"] {
            assert!(text(wrong).is_err(), "{wrong}");
        }
    }
}
