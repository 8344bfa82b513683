//! Layered frames as files with the suffix `.iglf`. They contain the chunks of the wire payload (`docs/PROTOCOL.md`,
//! "Layered-frame payload").
//!
//! All numbers are little-endian. A file has these parts, and nothing follows:
//!
//! 1. `IGLF`, the version (`u16`) and the number of chunks (`u16`)
//! 2. from version 2: three letters for the directions of the volume's axes, or zeros
//! 3. from version 3: the bounds of the volume (6 × `f32`, the lower corner first), or zeros
//! 4. for each chunk: its length (`u32`) and its bytes

use std::io::{self, BufReader, Read};
use std::path::Path;

use glam::Vec3;
use isinglass_core::codec::{CodecError, EncodedFrame, HEADER_BYTES, MAX_CHUNK_BYTES, MAX_CHUNKS, decode};
use isinglass_core::layer::LayeredFrame;
use isinglass_core::space::Aabb;

use crate::error::FormatError;
use crate::output::write_whole;
use crate::source::open_file;

/// Why a layered frame could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IglfError {
    /// The system refused to read or write the file.
    #[error("{path}: {cause}")]
    Io {
        /// The file.
        path: String,
        /// What the system said.
        cause: io::Error,
    },
    /// The bytes are not those of a stored frame.
    #[error("{path}: {what} is {found}, expected {expected}")]
    Malformed {
        /// The file.
        path: String,
        /// The part of the file.
        what: String,
        /// What is there.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The chunks are damaged or do not belong together.
    #[error("{path}: {cause}")]
    Codec {
        /// The file.
        path: String,
        /// What is wrong.
        cause: CodecError,
    },
}

/// A frame that was read.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredFrame {
    /// The frame.
    pub frame: LayeredFrame,
    /// What the frame shows.
    pub origin: Origin,
}

/// What is known about the volume that a frame shows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Origin {
    /// The directions of the volume's axes, such as `RAS`.
    pub orientation: Option<String>,
    /// The bounds of the volume, or of the part inside a clip box.
    pub bounds: Option<Aabb>,
}

/// Writes a frame with [`write_whole`].
///
/// # Errors
/// The system refuses to write the file.
pub fn write(path: &Path, encoded: &EncodedFrame, origin: &Origin) -> Result<(), FormatError> {
    write_whole(path, &to_bytes(encoded, origin))
}

/// Reads a frame with all its chunks. Memory is bounded by the size of the file and the limits of the codec.
///
/// # Errors
/// The file cannot be read, or its bytes are not those of a frame.
pub fn read(path: &Path) -> Result<StoredFrame, IglfError> {
    let (chunks, origin) = read_parts(path)?;
    let frame =
        decode(&chunks).map_err(|cause| IglfError::Codec { path: path.display().to_string(), cause })?;
    Ok(StoredFrame { frame, origin })
}

/// Reads the chunks of a frame without decoding them.
///
/// # Errors
/// As [`read`], except for errors within the chunks.
pub fn read_chunks(path: &Path) -> Result<Vec<Vec<u8>>, IglfError> {
    Ok(read_parts(path)?.0)
}

fn read_parts(path: &Path) -> Result<Parts, IglfError> {
    let name = || path.display().to_string();
    let file = open_file(path).map_err(|e| match e {
        FormatError::Io { cause, .. } => IglfError::Io { path: name(), cause },
        FormatError::Unsupported { found, expected, .. } => IglfError::Malformed {
            path: name(),
            what: "it".into(),
            found: found.into(),
            expected: expected.into(),
        },
        e => IglfError::Io { path: name(), cause: io::Error::other(e) },
    })?;
    parts_from_reader(&mut BufReader::new(file)).map_err(|problem| match problem {
        ReadProblem::Io(cause) => IglfError::Io { path: name(), cause },
        ReadProblem::Malformed(what, found, expected) => {
            IglfError::Malformed { path: name(), what, found, expected }
        }
    })
}

fn to_bytes(encoded: &EncodedFrame, origin: &Origin) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(encoded.num_bytes() + 4 * encoded.chunks.len() + 35);
    bytes.extend_from_slice(&MAGIC);
    bytes.extend_from_slice(&VERSION.to_le_bytes());
    bytes.extend_from_slice(&(encoded.chunks.len() as u16).to_le_bytes());
    // Invalid letters are written as unknown, because the reader refuses them.
    let letters =
        origin.orientation.as_ref().and_then(|letters| <[u8; 3]>::try_from(letters.as_bytes()).ok());
    let letters = letters.filter(|letters| letters.iter().all(u8::is_ascii_uppercase));
    bytes.extend_from_slice(&letters.unwrap_or([0; 3]));
    let bounds = origin.bounds.filter(is_box).unwrap_or(NO_BOX);
    for corner in [bounds.min, bounds.max] {
        corner.to_array().iter().for_each(|x| bytes.extend_from_slice(&x.to_le_bytes()));
    }
    for chunk in &encoded.chunks {
        bytes.extend_from_slice(&(chunk.bytes.len() as u32).to_le_bytes());
        bytes.extend_from_slice(&chunk.bytes);
    }
    bytes
}

enum ReadProblem {
    Io(io::Error),
    /// What is wrong, what was found and what was expected.
    Malformed(String, String, String),
}

/// Whether a box is finite and not empty.
fn is_box(bounds: &Aabb) -> bool {
    bounds.min.is_finite() && bounds.max.is_finite() && bounds.min.cmplt(bounds.max).all()
}

/// The chunks of a file, and what they show.
type Parts = (Vec<Vec<u8>>, Origin);

fn parts_from_reader(reader: &mut impl Read) -> Result<Parts, ReadProblem> {
    let magic: [u8; 4] = take(reader, "start of the file")?;
    if magic != MAGIC {
        let found = if &magic == b"\x89PNG" { "a PNG picture" } else { "something else" };
        return Err(malformed("it", found, "a layered frame (.iglf) as `layers` writes it"));
    }
    let version = u16::from_le_bytes(take(reader, "version")?);
    if !(1..=VERSION).contains(&version) {
        return Err(malformed("version", version, format!("1 to {VERSION}")));
    }
    let count = usize::from(u16::from_le_bytes(take(reader, "number of chunks")?));
    if !(1..=MAX_CHUNKS).contains(&count) {
        return Err(malformed("number of chunks", count, format!("1 to {MAX_CHUNKS}")));
    }
    let letters = if version == 1 { [0; 3] } else { take(reader, "letters of the axes")? };
    let orientation = match letters {
        [0, 0, 0] => None,
        letters if letters.iter().all(u8::is_ascii_uppercase) => {
            Some(letters.map(char::from).iter().collect())
        }
        letters => {
            return Err(malformed("letters of the axes", format!("{letters:02x?}"), "capitals or zeros"));
        }
    };
    let bounds = if version < 3 { NO_BOX } else { take_box(reader)? };
    if bounds != NO_BOX && !is_box(&bounds) {
        let found = format!("{} to {}", bounds.min, bounds.max);
        return Err(malformed(
            "box of the volume",
            found,
            "finite corners, the first below the second, or zeros",
        ));
    }
    let mut chunks = Vec::with_capacity(count);
    for number in 0..count {
        let what = format!("length of chunk {number}");
        let length = u32::from_le_bytes(take(reader, &what)?) as usize;
        if !(HEADER_BYTES..=MAX_CHUNK_BYTES).contains(&length) {
            return Err(malformed(what, length, format!("{HEADER_BYTES} to {MAX_CHUNK_BYTES}")));
        }
        // The vector grows with the data, because the length may be wrong.
        let mut bytes = Vec::new();
        reader.by_ref().take(length as u64).read_to_end(&mut bytes).map_err(ReadProblem::Io)?;
        if bytes.len() != length {
            let found = format!("cut off after {} bytes", bytes.len());
            return Err(malformed(format!("chunk {number}"), found, format!("{length} bytes")));
        }
        chunks.push(bytes);
    }
    match reader.read(&mut [0]).map_err(ReadProblem::Io)? {
        0 => Ok((chunks, Origin { orientation, bounds: Some(bounds).filter(is_box) })),
        _ => Err(malformed("what follows the last chunk", "more bytes", "the end of the file")),
    }
}

fn take_box(reader: &mut impl Read) -> Result<Aabb, ReadProblem> {
    let mut corner = || {
        let mut corner = Vec3::ZERO;
        for i in 0..3 {
            corner[i] = f32::from_le_bytes(take(reader, "box of the volume")?);
        }
        Ok(corner)
    };
    Ok(Aabb { min: corner()?, max: corner()? })
}

fn take<const N: usize>(reader: &mut impl Read, what: &str) -> Result<[u8; N], ReadProblem> {
    let mut bytes = [0; N];
    reader.read_exact(&mut bytes).map_err(|e| match e.kind() {
        io::ErrorKind::UnexpectedEof => malformed(what, "cut off", format!("{N} bytes")),
        _ => ReadProblem::Io(e),
    })?;
    Ok(bytes)
}

fn malformed(what: impl Into<String>, found: impl ToString, expected: impl ToString) -> ReadProblem {
    ReadProblem::Malformed(what.into(), found.to_string(), expected.to_string())
}

const MAGIC: [u8; 4] = *b"IGLF";
const VERSION: u16 = 3;
const NO_BOX: Aabb = Aabb { min: Vec3::ZERO, max: Vec3::ZERO };

#[cfg(test)]
mod tests {
    use std::fs;

    use isinglass_core::camera::{Camera, Intrinsics, Pose};
    use isinglass_core::codec::encode;

    use isinglass_core::layer::{FrameHeader, Segment};

    use super::*;

    fn frame() -> LayeredFrame {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let intrinsics = Intrinsics::perspective(20, 130, 0.6);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.1, 0.2, 6.0), intrinsics, &bounds);
        let header = FrameHeader::alone(camera, 4);
        let mut frame = LayeredFrame::empty(header);
        for list in 0..20 * 130u16 {
            for i in 0..list % 5 {
                let front = 100 * i + list % 90;
                let c = Vec3::new(0.1, 0.2, 0.3) * f32::from(i);
                frame.push(&Segment { front, back: front + 10, c, tau: 0.5 });
            }
            frame.offsets[usize::from(list) + 1] = frame.num_segments() as u32;
        }
        frame
    }

    fn error(path: &Path, bytes: &[u8]) -> IglfError {
        fs::write(path, bytes).unwrap();
        let error = read(path).unwrap_err();
        let message = error.to_string();
        assert!(message.contains("a.iglf") && !message.contains('\n'), "{message}");
        error
    }

    #[test]
    fn what_is_written_is_read_and_replaces_what_was_there() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.iglf");
        let encoded = encode(&frame()).unwrap();
        write(&path, &encoded, &Origin::default()).unwrap();
        assert_eq!(read(&path).unwrap().origin, Origin::default());
        let bounds = Aabb { min: Vec3::new(-1.0, -2.0, -3.5), max: Vec3::new(1.0, 0.5, 4.0) };
        let known = Origin { orientation: Some("LPS".into()), bounds: Some(bounds) };
        write(&path, &encoded, &known).unwrap();
        let StoredFrame { frame: decoded, origin } = read(&path).unwrap();
        assert_eq!(origin, known);
        // Values that the reader refuses are not written.
        for letters in ["ras", "RA\u{0}", "R S", "é1", "RASL", ""] {
            write(&path, &encoded, &Origin { orientation: Some(letters.into()), bounds: None }).unwrap();
            assert_eq!(read(&path).unwrap().origin, Origin::default(), "{letters:?}");
        }
        for bounds in [Aabb { max: bounds.min, ..bounds }, Aabb { max: Vec3::splat(f32::NAN), ..bounds }] {
            write(&path, &encoded, &Origin { bounds: Some(bounds), orientation: None }).unwrap();
            assert_eq!(read(&path).unwrap().origin, Origin::default(), "{bounds:?}");
        }
        assert_eq!(decoded.depth, frame().depth);
        assert_eq!(encode(&decoded).unwrap(), encoded);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn files_of_versions_before_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.iglf");
        let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        let origin = Origin { orientation: Some("RAS".into()), bounds: Some(bounds) };
        let mut bytes = to_bytes(&encode(&frame()).unwrap(), &origin);
        fs::write(&path, &bytes).unwrap();
        let newest = read(&path).unwrap();
        bytes[4] = 2;
        bytes.drain(11..35);
        fs::write(&path, &bytes).unwrap();
        assert_eq!(read(&path).unwrap().origin, Origin { bounds: None, ..origin });
        bytes[4] = 1;
        bytes.drain(8..11);
        fs::write(&path, &bytes).unwrap();
        assert_eq!(read(&path).unwrap(), StoredFrame { origin: Origin::default(), ..newest });
    }

    #[test]
    fn damaged_files_are_named_in_one_line() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.iglf");
        assert!(matches!(read(&path), Err(IglfError::Io { .. })));
        let good = to_bytes(&encode(&frame()).unwrap(), &Origin::default());
        for len in (0..good.len()).step_by(97).chain(0..39) {
            assert!(matches!(error(&path, &good[..len]), IglfError::Malformed { .. }), "{len}");
        }
        let mut longer = good.clone();
        longer.push(0);
        assert!(matches!(error(&path, &longer), IglfError::Malformed { .. }));
        for (at, byte) in [(0, b'X'), (4, 9), (4, 0), (6, 0), (6, 200), (9, b'P'), (20, b'P'), (38, 0xff)] {
            let mut bytes = good.clone();
            bytes[at] = byte;
            assert!(matches!(error(&path, &bytes), IglfError::Malformed { .. }), "{at}");
        }
        let mut bytes = good.clone();
        bytes[39] = b'X';
        assert!(matches!(error(&path, &bytes), IglfError::Codec { .. }));
        // The last chunk is missing.
        let mut encoded = encode(&frame()).unwrap();
        encoded.chunks.pop();
        assert!(matches!(
            error(&path, &to_bytes(&encoded, &Origin::default())),
            IglfError::Codec { cause: CodecError::Incomplete { .. }, .. }
        ));
    }
}
