//! NumPy arrays: `.npy` and `.npz`. The arrays of an archive are channels, and the largest is shown first.
//!
//! An array names neither its axes nor their distances. The fastest axis in memory is x, then come y and z. If there
//! are more, a fastest axis with three or four entries contains colours. The slower axes are channels and time.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use crate::axes::Geometry;
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, not_there, quoted, shown};
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{Axis, BoxLevel, Plan, Role, VolumeFile};
use crate::source::{OpenOptions, open_file};
use crate::stream::{Packing, Unpacked};
use crate::warning::WarningKind;
use crate::zip;

/// The first bytes of an array.
pub(crate) const MAGIC: &[u8] = b"\x93NUMPY";

/// An array whose header was read.
pub(crate) struct NpyFile {
    plan: Plan,
    path: PathBuf,
    place: ArrayLocation,
    /// Bytes before the first number.
    skip: u64,
}

#[derive(Clone, Copy)]
struct ArrayLocation {
    offset: u64,
    length: Option<u64>,
    packing: Packing,
}

impl NpyFile {
    /// `file` is the array at `path`.
    pub(crate) fn open(file: File, path: &Path) -> Result<Self, FormatError> {
        let place = ArrayLocation { offset: 0, length: None, packing: Packing::Plain };
        let mut stream = Unpacked::open(file, path, 0, None, Packing::Plain)?;
        let (plan, skip) = header(&mut stream, path, "NumPy array")?;
        Ok(Self { plan, path: path.to_owned(), place, skip })
    }

    /// `file` is the archive at `path`. The options choose an array.
    pub(crate) fn open_archive(file: File, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, "NumPy archive");
        let mut arrays = Vec::new();
        let mut first_problem = None;
        for entry in zip::entries(file, path, ".npy", MAX_ARRAYS)? {
            options.check_cancelled(path)?;
            let packing = match entry.method {
                0 => Packing::Plain,
                8 => Packing::Deflate,
                other => {
                    let problem =
                        format!("{} is packed by method {other}, expected 0 or 8", quoted(&entry.name));
                    first_problem.get_or_insert(bad(problem));
                    continue;
                }
            };
            let place = ArrayLocation { offset: entry.offset, length: Some(entry.packed_bytes), packing };
            let mut stream = Unpacked::open(open_file(path)?, path, place.offset, place.length, packing)?;
            match header(&mut stream, path, "NumPy archive") {
                Ok((plan, skip)) => {
                    let name = entry.name.trim_end_matches(".npy");
                    arrays.push((quoted(name).trim_matches('"').to_owned(), plan, place, skip));
                }
                Err(e) => {
                    first_problem.get_or_insert(e);
                }
            }
        }
        let names: Vec<String> = arrays.iter().map(|a| a.0.clone()).collect();
        // An archive often has masks and tables beside an image, so the largest array in space is the default.
        let in_space = |plan: &Plan| {
            let sizes =
                [0, 1, 2].map(|i| plan.axes.iter().find(|a| a.role == Role::Space(i)).map_or(1, |a| a.size));
            (sizes.iter().all(|n| *n > 1), sizes.into_iter().fold(1u64, u64::saturating_mul))
        };
        let usual = (0..arrays.len()).rev().max_by_key(|&i| in_space(&arrays[i].1)).unwrap_or(0);
        let has_channels = |plan: &Plan| plan.axes.iter().any(|a| a.role == Role::Channel && a.size > 1);
        let is_one = arrays.get(usual).is_some_and(|a| has_channels(&a.1));
        let index = if is_one { usual } else { options.selection.channel.map_or(usual, |n| n as usize) };
        let Some((_, mut plan, place, skip)) = arrays.into_iter().nth(index) else {
            return Err(match (names.len(), first_problem) {
                (0, Some(problem)) => problem,
                (0, None) => bad("it has no arrays".into()),
                (found, _) => not_there(path, "channel", index as u64, found),
            });
        };
        if names.len() > 1 && !is_one && has_channels(&plan) {
            return Err(bad("an array with channels beside other arrays, expected one or the other".into()));
        }
        if is_one && names.len() > 1 {
            let others = names.iter().enumerate().filter(|(i, _)| *i != usual).map(|(_, n)| n.as_str());
            let others = others.take(MAX_NAMED).collect::<Vec<_>>().join(", ");
            let text = format!("{} is the largest array; others are not shown: {others}", names[usual]);
            plan.warn(WarningKind::Choice, text);
        } else if !is_one {
            plan.num_channels = names.len() as u64;
            plan.channel = usual as u64;
            plan.channel_names = names;
        }
        Ok(Self { plan, path: path.to_owned(), place, skip })
    }
}

impl VolumeFile for NpyFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let ArrayLocation { offset, length, packing } = self.place;
        let data = Unpacked::open(open_file(&self.path)?, &self.path, offset, length, packing)?;
        let num_bytes = collector.num_bytes();
        data.take(collector, &self.path, self.skip, num_bytes)
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        if self.place.packing != Packing::Plain {
            return Err(FormatError::NotPaged { path: shown(path), found: "a packed NumPy archive".into() });
        }
        let offset = self.place.offset.saturating_add(self.skip);
        flat_level(&self.plan, vec![FlatFile { path: self.path.clone(), offset }], path)
    }
}

/// The header of an array and its length in bytes.
fn header(stream: &mut dyn Read, path: &Path, format: &str) -> Result<(Plan, u64), FormatError> {
    let bad = malformed(path, format);
    let io = io_error(path);
    let mut start = Vec::new();
    stream.take(8).read_to_end(&mut start).map_err(&io)?;
    let &[0x93, b'N', b'U', b'M', b'P', b'Y', version, _] = &start[..] else {
        return Err(bad("found no header of an array".into()));
    };
    let length_bytes = match version {
        1 => 2,
        2 | 3 => 4,
        _ => return Err(bad(format!("version is {version}, expected 1 to 3"))),
    };
    let mut length = [0; 4];
    stream.read_exact(&mut length[..length_bytes]).map_err(&io)?;
    let length = u32::from_le_bytes(length);
    if length > MAX_HEADER_BYTES {
        return Err(bad(format!("its header has {length} bytes, expected at most {MAX_HEADER_BYTES}")));
    }
    let mut text = Vec::new();
    stream.take(length.into()).read_to_end(&mut text).map_err(&io)?;
    let text = String::from_utf8_lossy(&text);
    let plan = plan(&text, format).map_err(bad)?;
    Ok((plan, 8 + length_bytes as u64 + u64::from(length)))
}

/// The plan of the dictionary in `text`.
fn plan(text: &str, format: &str) -> Result<Plan, String> {
    // Returns the text after a key, which begins with its value.
    let value = |key: &str| {
        let quoted_key = [format!("'{key}'"), format!("\"{key}\"")];
        let after = quoted_key.iter().find_map(|k| text.split_once(k.as_str()));
        let after = after.and_then(|(_, rest)| rest.trim_start().strip_prefix(':'));
        after.map(str::trim_start).ok_or_else(|| format!("{key:?} is missing from {}", quoted(text.trim())))
    };
    let descr = value("descr")?;
    let descr = descr
        .strip_prefix(['\'', '"'])
        .and_then(|d| d.split(['\'', '"']).next())
        .ok_or_else(|| format!("the type is {}, expected one number a voxel", quoted(descr)))?;
    let (endian, kind) = match descr.split_at_checked(1) {
        Some(("<" | "|" | "=", kind)) => (Endian::Little, kind),
        Some((">", kind)) => (Endian::Big, kind),
        _ => (Endian::Little, descr),
    };
    let dtype = Dtype::from_numpy(kind).ok_or_else(|| {
        format!("the type is {}, expected b1, i1 to i8, u1 to u8, or f2 to f8", quoted(descr))
    })?;
    let is_fortran = value("fortran_order")?.starts_with("True");
    let shape = value("shape")?;
    let bad = || format!("the shape is {}, expected two to five numbers of voxels", quoted(shape));
    let inner = shape.strip_prefix('(').and_then(|s| s.split_once(')')).ok_or_else(bad)?.0;
    let words = inner.split(',').map(|w| w.trim().trim_end_matches('L')).filter(|w| !w.is_empty());
    let sizes: Option<Vec<u64>> = words.map(|w| w.parse().ok().filter(|n| *n > 0)).collect();
    let mut sizes = sizes.filter(|s| s.len() <= 8).ok_or_else(bad)?;
    if !is_fortran {
        sizes.reverse();
    }
    // Slow or fast axes with one entry have no meaning if there are more than three axes.
    while sizes.len() > 3 && sizes.last() == Some(&1) {
        sizes.pop();
    }
    while sizes.len() > 3 && sizes[0] == 1 {
        sizes.remove(0);
    }
    if !(2..=5).contains(&sizes.len()) {
        return Err(bad());
    }
    if sizes.len() == 2 {
        sizes.push(1);
    }
    let is_color = sizes.len() > 3 && matches!(sizes[0], 3 | 4) && sizes[1..].iter().all(|&n| n > 4);
    let mut axes = Vec::new();
    let mut rest = sizes.into_iter();
    if is_color {
        axes.extend(rest.next().map(|size| Axis { size, role: Role::Channel }));
    }
    axes.extend(rest.by_ref().take(3).enumerate().map(|(i, size)| Axis { size, role: Role::Space(i) }));
    let roles = if is_color { [Role::Time, Role::Time] } else { [Role::Channel, Role::Time] };
    axes.extend(rest.zip(roles).map(|(size, role)| Axis { size, role }));
    let mut plan = Plan::new(format, dtype, endian, axes, Geometry::of_image([1.0; 3], None));
    plan.spacing_guess = Some("an array has no spacing; it was taken as 1".into());
    plan.warn(WarningKind::Guess, "an array does not name its axes; the fastest was taken as x");
    Ok(plan)
}

/// Longest header in bytes. Only unsupported arrays of structures have longer ones.
const MAX_HEADER_BYTES: u32 = 1 << 16;
/// Most arrays in a warning.
const MAX_NAMED: usize = 8;
/// Most arrays of an archive.
const MAX_ARRAYS: usize = 256;
