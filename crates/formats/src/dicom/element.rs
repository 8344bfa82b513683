//! Reads the elements of a DICOM file (PS3.5 and PS3.10) up to its pixel data. It keeps those that matter for a
//! volume, also for each frame of an enhanced file.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

use super::tags::{self, Tag};
use crate::dtype::Endian;

#[derive(Debug, Default)]
pub(super) struct DataSet {
    pub(super) syntax: String,
    /// Values of the whole file, or shared by all of its frames.
    pub(super) fields: Elements,
    /// Values of each frame of an enhanced file.
    pub(super) frames: Vec<Elements>,
    /// Values of each segment of a segmentation.
    pub(super) segments: Vec<Elements>,
    /// Values of each slice of a mosaic.
    pub(super) tiles: Vec<Elements>,
    pub(super) pixels: Option<PixelElement>,
}

/// The element with the pixel data.
#[derive(Clone, Copy, Debug)]
pub(super) struct PixelElement {
    /// Offset of its first byte.
    pub(super) offset: u64,
    /// Bytes; `None` if they are in fragments.
    pub(super) length: Option<u32>,
    /// Whether the bytes are parts of words of 16 bits (OW).
    pub(super) is_words: bool,
    /// Whether the numbers are floats, of the allocated bits.
    pub(super) is_float: bool,
}

/// Values by tag, with the byte order of the file.
#[derive(Clone, Debug, Default)]
pub(super) struct Elements {
    values: HashMap<Tag, Vec<u8>>,
    endian: Endian,
}

impl Elements {
    /// The first text of a value, without padding.
    pub(super) fn text(&self, tag: Tag) -> Option<String> {
        let bytes = self.values.get(&tag)?;
        let text = String::from_utf8_lossy(bytes);
        let text = text.trim_end_matches('\0').trim();
        (!text.is_empty()).then(|| text.to_owned())
    }

    /// All numbers of a decimal or integer string.
    pub(super) fn decimals(&self, tag: Tag) -> Option<Vec<f64>> {
        let text = self.text(tag)?;
        text.split('\\').map(|w| w.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect()
    }

    /// The first number of a decimal or integer string.
    pub(super) fn decimal(&self, tag: Tag) -> Option<f64> {
        let text = self.text(tag)?;
        text.split('\\').next()?.trim().parse().ok().filter(|x: &f64| x.is_finite())
    }

    /// `N` numbers of a decimal string.
    pub(super) fn decimal_array<const N: usize>(&self, tag: Tag) -> Option<[f64; N]> {
        self.decimals(tag)?.try_into().ok()
    }

    /// A binary number of 16 bits.
    pub(super) fn short(&self, tag: Tag) -> Option<u16> {
        let bytes = *self.values.get(&tag)?.first_chunk()?;
        Some(if self.endian == Endian::Big { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) })
    }

    /// All binary numbers of 16 bits.
    pub(super) fn shorts(&self, tag: Tag) -> Vec<u16> {
        let is_big = self.endian == Endian::Big;
        let words = self.values.get(&tag).map_or(&[][..], |bytes| bytes.as_chunks().0);
        words.iter().map(|b| if is_big { u16::from_be_bytes(*b) } else { u16::from_le_bytes(*b) }).collect()
    }

    /// The bytes of a value as they are; empty if there are none.
    pub(super) fn bytes(&self, tag: Tag) -> &[u8] {
        self.values.get(&tag).map_or(&[], Vec::as_slice)
    }

    /// A float of 64 bits.
    pub(super) fn double(&self, tag: Tag) -> Option<f64> {
        let bytes = *self.values.get(&tag)?.first_chunk()?;
        let is_big = self.endian == Endian::Big;
        Some(if is_big { f64::from_be_bytes(bytes) } else { f64::from_le_bytes(bytes) })
            .filter(|x| x.is_finite())
    }

    /// A float of 32 bits.
    pub(super) fn float(&self, tag: Tag) -> Option<f32> {
        let bits = self.longs(tag).next()?;
        Some(f32::from_bits(bits)).filter(|x| x.is_finite())
    }

    /// All binary numbers of 32 bits.
    pub(super) fn longs(&self, tag: Tag) -> impl Iterator<Item = u32> {
        let is_big = self.endian == Endian::Big;
        let words = self.values.get(&tag).map_or(&[][..], |bytes| bytes.as_chunks().0);
        words.iter().map(move |b| if is_big { u32::from_be_bytes(*b) } else { u32::from_le_bytes(*b) })
    }
}

/// Most bytes of a value that is kept.
fn longest(tag: Tag) -> u32 {
    match tag {
        tags::GRID_FRAME_OFFSETS => MAX_OFFSETS_BYTES,
        tags::LUT_DATA | tags::SIEMENS_HEADER => MAX_TABLE_BYTES,
        tags::ROTATION_VECTOR | tags::TIME_SLOT_VECTOR | tags::SLICE_VECTOR => MAX_TABLE_BYTES,
        _ => MAX_VALUE_BYTES,
    }
}

impl DataSet {
    /// Reads the elements of a file. An error of kind `InvalidData` says what is wrong.
    pub(super) fn read(reader: &mut BufReader<File>) -> io::Result<Self> {
        let length = reader.get_ref().metadata()?.len();
        let mut start = [0; 132];
        let n = read_up_to(reader, &mut start)?;
        if n == 0 {
            return Err(invalid("it is empty (0 bytes)"));
        }
        let is_marked = n == start.len() && start[128..] == *b"DICM";
        let at = if is_marked { 132 } else { 0 };
        reader.seek(SeekFrom::Start(at))?;
        let mut parser = ElementParser {
            reader,
            at,
            length,
            endian: Endian::Little,
            is_implicit: false,
            left: MAX_ELEMENTS,
        };
        let mut set = Self::default();
        if is_marked {
            parser.meta(&mut set)?;
            set.syntax = set.fields.text(tags::TRANSFER_SYNTAX).unwrap_or_default();
        } else {
            // A file without preamble has implicit types, unless the letters of a type are there.
            parser.is_implicit = !(start[4].is_ascii_uppercase() && start[5].is_ascii_uppercase());
        }
        match set.syntax.as_str() {
            "1.2.840.10008.1.2" => parser.is_implicit = true,
            "1.2.840.10008.1.2.2" => parser.endian = Endian::Big,
            "1.2.840.10008.1.2.1.99" => {
                return Err(invalid("its elements are deflated, expected them as they are"));
            }
            _ => {}
        }
        set.fields.endian = parser.endian;
        parser.body(&mut set)?;
        Ok(set)
    }
}

struct Head {
    tag: Tag,
    vr: [u8; 2],
    /// `None` if the length is unknown.
    length: Option<u32>,
}

struct ElementParser<'a> {
    reader: &'a mut BufReader<File>,
    at: u64,
    length: u64,
    endian: Endian,
    is_implicit: bool,
    /// Elements that may still follow.
    left: u32,
}

/// A sequence or item around the current element.
struct SequenceLevel {
    tag: Tag,
    is_item: bool,
    /// Offset of its end, if known.
    end: Option<u64>,
    /// Whether elements outside of it have implicit types.
    was_implicit: bool,
}

impl ElementParser<'_> {
    fn array<const N: usize>(&mut self) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.reader.read_exact(&mut bytes)?;
        self.at += N as u64;
        Ok(bytes)
    }

    fn u16(&mut self) -> io::Result<u16> {
        let bytes = self.array()?;
        Ok(if self.endian == Endian::Big { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) })
    }

    fn u32(&mut self) -> io::Result<u32> {
        let bytes = self.array()?;
        Ok(if self.endian == Endian::Big { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
    }

    fn skip(&mut self, num_bytes: u64) -> io::Result<()> {
        self.at = self.at.saturating_add(num_bytes);
        if self.at > self.length {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        self.reader.seek_relative(num_bytes as i64)
    }

    fn value(&mut self, num_bytes: u32) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let n = self.reader.take(num_bytes.into()).read_to_end(&mut bytes)?;
        self.at += n as u64;
        if n < num_bytes as usize { Err(io::ErrorKind::UnexpectedEof.into()) } else { Ok(bytes) }
    }

    fn head(&mut self) -> io::Result<Head> {
        self.left = self.left.checked_sub(1).ok_or_else(|| invalid("it has too many elements"))?;
        let tag = (self.u16()?, self.u16()?);
        let (vr, length) = if tag.0 == 0xfffe || self.is_implicit {
            (*b"  ", self.u32()?)
        } else {
            let vr = self.array()?;
            if !LONG_VRS.contains(&&vr) {
                (vr, self.u16()?.into())
            } else {
                self.u16()?;
                (vr, self.u32()?)
            }
        };
        Ok(Head { tag, vr, length: (length != u32::MAX).then_some(length) })
    }

    /// Reads group 2, which is always explicit and little-endian.
    fn meta(&mut self, set: &mut DataSet) -> io::Result<()> {
        loop {
            let before = self.at;
            let head = match self.head() {
                Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => return Ok(()),
                head => head?,
            };
            if head.tag.0 != 2 {
                self.at = before;
                self.reader.seek(SeekFrom::Start(before))?;
                return Ok(());
            }
            let length = head.length.ok_or_else(|| invalid("an element of group 2 has no length"))?;
            if tags::is_relevant(head.tag) && length <= MAX_VALUE_BYTES {
                let value = self.value(length)?;
                set.fields.values.insert(head.tag, value);
            } else {
                self.skip(length.into())?;
            }
        }
    }

    /// Reads everything up to the pixel data or the end.
    fn body(&mut self, set: &mut DataSet) -> io::Result<()> {
        let mut levels: Vec<SequenceLevel> = Vec::new();
        loop {
            while levels.last().is_some_and(|l| l.end.is_some_and(|end| self.at >= end)) {
                self.leave(&mut levels);
            }
            let head = match self.head() {
                // A file may end after any element. Missing values are noticed later.
                Err(e) if e.kind() == io::ErrorKind::UnexpectedEof && levels.is_empty() => return Ok(()),
                head => head?,
            };
            let end = head.length.map(|n| self.at + u64::from(n));
            match head.tag {
                tags::ITEM => {
                    if let Some(list) = levels.last().filter(|l| !l.is_item).and_then(|l| set.list(l.tag)) {
                        list.push(Elements { endian: self.endian, ..Elements::default() });
                    }
                    self.enter(&mut levels, head.tag, true, end)?;
                }
                tags::ITEM_END | tags::SEQUENCE_END => self.leave(&mut levels),
                tags::PIXEL_DATA | tags::FLOAT_PIXEL_DATA | tags::DOUBLE_PIXEL_DATA if levels.is_empty() => {
                    // Without types, pixels are words.
                    let is_words = self.is_implicit || head.vr == *b"OW";
                    let is_float = head.tag != tags::PIXEL_DATA;
                    set.pixels =
                        Some(PixelElement { offset: self.at, length: head.length, is_words, is_float });
                    return Ok(());
                }
                tag => {
                    let is_unknown_length = head.length.is_none();
                    let is_sequence = head.vr == *b"SQ"
                        || is_unknown_length
                        || (self.is_implicit && tags::is_sequence(tag));
                    if is_sequence && (is_unknown_length || tags::is_sequence(tag)) {
                        self.enter(&mut levels, tag, false, end)?;
                        if head.vr == *b"UN" {
                            self.is_implicit = true;
                        }
                        continue;
                    }
                    let length = head.length.unwrap_or(0);
                    let fields =
                        place(set, &levels).filter(|_| tags::is_relevant(tag) && length <= longest(tag));
                    match fields {
                        Some(fields) => {
                            let value = self.value(length)?;
                            // The first value counts, because a private copy may follow.
                            fields.values.entry(tag).or_insert(value);
                        }
                        None => self.skip(length.into())?,
                    }
                }
            }
        }
    }

    fn enter(
        &self,
        levels: &mut Vec<SequenceLevel>,
        tag: Tag,
        is_item: bool,
        end: Option<u64>,
    ) -> io::Result<()> {
        if levels.len() == MAX_DEPTH {
            return Err(invalid("its sequences are nested too deeply"));
        }
        levels.push(SequenceLevel { tag, is_item, end, was_implicit: self.is_implicit });
        Ok(())
    }

    fn leave(&mut self, levels: &mut Vec<SequenceLevel>) {
        if let Some(level) = levels.pop() {
            self.is_implicit = level.was_implicit;
        }
    }
}

impl DataSet {
    /// The list whose entries are the items of this sequence, if it is such a sequence.
    fn list(&mut self, sequence: Tag) -> Option<&mut Vec<Elements>> {
        match sequence {
            tags::PER_FRAME_GROUPS => Some(&mut self.frames),
            tags::SEGMENTS => Some(&mut self.segments),
            tags::UIH_TILES => Some(&mut self.tiles),
            _ => None,
        }
    }
}

/// The owner of values in these sequences: the file, an entry of a list, or nobody.
fn place<'a>(set: &'a mut DataSet, levels: &[SequenceLevel]) -> Option<&'a mut Elements> {
    if levels.iter().any(|l| !l.is_item && !tags::is_sequence(l.tag)) {
        return None;
    }
    match levels.first().map(|l| l.tag) {
        None | Some(tags::SHARED_GROUPS | tags::MODALITY_LUT | tags::DETECTORS) => Some(&mut set.fields),
        Some(tag) => set.list(tag)?.last_mut(),
    }
}

/// Fills as much of `bytes` as the reader has.
fn read_up_to(reader: &mut impl Read, bytes: &mut [u8]) -> io::Result<usize> {
    let mut n = 0;
    while n < bytes.len() {
        match reader.read(&mut bytes[n..])? {
            0 => break,
            more => n += more,
        }
    }
    Ok(n)
}

fn invalid(problem: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, problem)
}

/// Types with a length of 32 bits.
const LONG_VRS: [&[u8; 2]; 13] =
    [b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"];
/// Longest value. None that matters is longer.
const MAX_VALUE_BYTES: u32 = 4096;
/// Longest list of offsets: 16 bytes and a separator for each frame.
const MAX_OFFSETS_BYTES: u32 = 17 << 16;
/// Longest table: two bytes for each of 65536 numbers, and headers of scanners.
const MAX_TABLE_BYTES: u32 = 1 << 18;
/// Most elements of a file, enough for some ten thousand frames.
const MAX_ELEMENTS: u32 = 4 << 20;
const MAX_DEPTH: usize = 32;
