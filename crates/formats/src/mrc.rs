//! MRC2014 (ccpem.ac.uk/mrc_format) and older files of electron microscopy: density maps and tomograms.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::axes::{Geometry, World};
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed};
use crate::header_bytes::HeaderBytes;
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{Axis, BoxLevel, Plan, Role, VolumeFile};
use crate::source::open_file;
use crate::stream::{Packing, Unpacked};
use crate::warning::WarningKind;

/// A map whose header was read.
pub(crate) struct MrcFile {
    plan: Plan,
    path: PathBuf,
    /// Bytes before the first voxel.
    skip: u64,
}

/// Whether `start` begins a header. Old files lack the mark `MAP ` at byte 208. Their numbers must be plausible, and
/// the suffix must be one of this format.
pub(crate) fn is_header(start: &[u8], path: &Path) -> bool {
    let is_marked = start.get(208..212).is_some_and(|mark| mark == b"MAP " || mark == b"MAP\0");
    let end = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    let is_named = ["mrc", "map", "rec", "st", "ali", "mrcs", "ccp4"].contains(&end.as_str());
    start.len() as u64 >= HEADER_BYTES && (is_marked || is_named) && endian(start).is_some()
}

/// The byte order of the machine stamp if the numbers are plausible in it, or else the other one.
fn endian(start: &[u8]) -> Option<Endian> {
    let is_sane = |endian| {
        let w = HeaderBytes { bytes: start, endian };
        let axes = [64, 68, 72].map(|at| w.i32(at));
        (0..3).all(|i| w.i32(4 * i) > 0)
            && (0..=200).contains(&w.i32(12))
            && (axes == [0; 3] || axes.iter().all(|a| (1..=3).contains(a)))
    };
    let stamped = if start.get(212) == Some(&0x11) { Endian::Big } else { Endian::Little };
    let other = if stamped == Endian::Big { Endian::Little } else { Endian::Big };
    [stamped, other].into_iter().find(|&e| is_sane(e))
}

impl MrcFile {
    /// `file` is the file at `path`.
    pub(crate) fn open(file: File, path: &Path) -> Result<Self, FormatError> {
        let bad = malformed(path, "MRC header");
        let mut start = Vec::new();
        file.take(HEADER_BYTES).read_to_end(&mut start).map_err(io_error(path))?;
        let endian = endian(&start).filter(|_| start.len() as u64 == HEADER_BYTES);
        let endian = endian
            .ok_or_else(|| bad("its sizes, mode and axes make no sense in either byte order".into()))?;
        let w = HeaderBytes { bytes: &start, endian };
        let extended = w.i32(92);
        let extended = u64::try_from(extended)
            .map_err(|_| bad(format!("its extended header has {extended} bytes, expected 0 or more")))?;
        Ok(Self { plan: plan(w, endian).map_err(bad)?, path: path.to_owned(), skip: HEADER_BYTES + extended })
    }
}

impl VolumeFile for MrcFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let data = Unpacked::open(open_file(&self.path)?, &self.path, 0, None, Packing::Plain)?;
        let num_bytes = collector.num_bytes();
        data.take(collector, &self.path, self.skip, num_bytes)
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        flat_level(&self.plan, vec![FlatFile { path: self.path.clone(), offset: self.skip }], path)
    }
}

fn plan(w: HeaderBytes, endian: Endian) -> Result<Plan, String> {
    let mode = w.i32(12);
    // IMOD writes unsigned bytes unless the lowest bit of its flags is set.
    let is_imod = w.i32(152) == IMOD_STAMP;
    let dtype = match mode {
        0 if is_imod && w.i32(156) & 1 == 0 => Dtype::Uint8,
        0 => Dtype::Int8,
        1 => Dtype::Int16,
        2 => Dtype::Float,
        6 => Dtype::Uint16,
        12 => Dtype::Half,
        _ => {
            let name = match mode {
                3 | 4 => " (complex numbers)",
                16 => " (colours)",
                101 => " (four bits)",
                _ => "",
            };
            return Err(format!("mode is {mode}{name}, expected 0, 1, 2, 6 or 12"));
        }
    };
    // `endian` has checked that all are above zero.
    let sizes = [0, 4, 8].map(|at| w.i32(at).unsigned_abs().into());
    let mut axes = Axis::in_space(sizes);
    let (group, depth) = (w.i32(88), u64::try_from(w.i32(36)).unwrap_or(0));
    if group >= FIRST_STACK_GROUP && depth > 0 && sizes[2] % depth == 0 && sizes[2] > depth {
        axes[2].size = depth;
        axes.push(Axis { size: sizes[2] / depth, role: Role::Time });
    }
    let mut plan = Plan::new("MRC", dtype, endian, axes, Geometry::along_axes([1.0; 3], None));
    let order = [64, 68, 72].map(|at| w.i32(at));
    let order: [usize; 3] = match order {
        [0, 0, 0] => [0, 1, 2],
        order => {
            let mut sorted = order;
            sorted.sort_unstable();
            if sorted != [1, 2, 3] {
                return Err(format!("mapc, mapr and maps are {order:?}, expected 1, 2 and 3 in some order"));
            }
            order.map(|a| a as usize - 1)
        }
    };
    let cell = [40, 44, 48].map(|at| f64::from(w.f32(at)));
    let samples = [28, 32, 36].map(|at| f64::from(w.i32(at)));
    let spacing: [f64; 3] = std::array::from_fn(|i| cell[i] / samples[i]);
    let is_good = spacing.iter().all(|s| s.is_finite() && *s > 0.0);
    if !is_good {
        plan.spacing_guess = Some("the header has no size of its cell; the spacing was taken as 1".into());
    }
    let spacing = if is_good { spacing } else { [1.0; 3] };
    let angles = [52, 56, 60].map(|at| w.f32(at));
    if is_good && angles.iter().any(|a| *a != 0.0 && (a - 90.0).abs() > 0.5) {
        let [a, b, c] = angles;
        plan.warn(
            WarningKind::Geometry,
            format!("the cell has angles of {a}, {b} and {c}°, which are not shown"),
        );
    }
    let origin = [196, 200, 204].map(|at| f64::from(w.f32(at)));
    let start = [16, 20, 24].map(|at| f64::from(w.i32(at)));
    // The older field has the position of the first voxel in the order of the file.
    let from_start =
        |axis: usize| order.iter().position(|&o| o == axis).map_or(0.0, |i| start[i]) * spacing[axis];
    let is_set = origin.iter().all(|o| o.is_finite()) && origin != [0.0; 3];
    let origin = if is_set { origin } else { [0, 1, 2].map(from_start) };
    plan.geometry = Geometry {
        steps: order.map(|axis| DVec3::AXES[axis] * spacing[axis]),
        origin: is_good.then(|| DVec3::from_array(origin)),
        world: World::Space,
        unit: is_good.then(|| "Å".to_owned()),
    };
    Ok(plan)
}

const HEADER_BYTES: u64 = 1024;
/// The word "IMOD" in the header of its files.
const IMOD_STAMP: i32 = 1_146_047_817;
/// Space groups from this number on are stacks of volumes.
const FIRST_STACK_GROUP: i32 = 401;
