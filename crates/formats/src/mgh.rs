//! FreeSurfer's volumes (`.mgh`, and `.mgz` in gzip). The frame is RAS in millimetres.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::axes::{Geometry, World};
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed};
use crate::header_bytes::HeaderBytes;
use crate::plan::{Axis, Plan, Role, VolumeFile};
use crate::source::open_file;
use crate::stream::{Packing, Unpacked};

/// A file whose header was read.
pub(crate) struct MghFile {
    plan: Plan,
    path: PathBuf,
}

/// Whether `start` begins a header. All files begin with the version 1, so the suffix must tell.
pub(crate) fn is_header(start: &[u8], path: &Path) -> bool {
    let is_named = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mgh"));
    is_named && start.starts_with(&[0, 0, 0, 1])
}

impl MghFile {
    /// `file` is the file at `path`.
    pub(crate) fn open(file: File, path: &Path) -> Result<Self, FormatError> {
        let bad = malformed(path, "MGH header");
        let mut bytes = Vec::new();
        file.take(HEADER_BYTES).read_to_end(&mut bytes).map_err(io_error(path))?;
        if bytes.len() < LEAST_HEADER_BYTES {
            return Err(bad(format!("{} bytes, expected {HEADER_BYTES}", bytes.len())));
        }
        let w = HeaderBytes { bytes: &bytes, endian: Endian::Big };
        let sizes = [4, 8, 12, 16].map(|at| u64::try_from(w.i32(at)).unwrap_or(0));
        let dtype = match w.i32(20) {
            0 => Dtype::Uint8,
            1 => Dtype::Int32,
            3 => Dtype::Float,
            4 => Dtype::Int16,
            10 => Dtype::Uint16,
            other => return Err(bad(format!("its type is {other}, expected 0, 1, 3, 4 or 10"))),
        };
        let mut axes = Axis::in_space([sizes[0], sizes[1], sizes[2]]);
        axes.push(Axis { size: sizes[3], role: Role::Time });
        let vector = |at: usize| DVec3::from_array([0, 4, 8].map(|i| f64::from(w.f32(at + i))));
        let is_placed = w.i16(28) != 0;
        // Without a place, the slices are coronal, and the cube lies around the origin.
        let (spacing, directions, center) = if is_placed {
            (vector(30).to_array(), [42, 54, 66].map(vector), vector(78))
        } else {
            ([1.0; 3], [-DVec3::X, -DVec3::Z, DVec3::Y], DVec3::ZERO)
        };
        let steps: [DVec3; 3] = std::array::from_fn(|i| directions[i] * spacing[i]);
        let corner = (0..3).fold(center, |p, i| p - steps[i] * (sizes[i] as f64 / 2.0));
        let geometry = Geometry {
            steps,
            origin: Some(corner),
            world: World::Body,
            unit: is_placed.then(|| "mm".to_owned()),
        };
        let mut plan = Plan::new("MGH", dtype, Endian::Big, axes, geometry);
        if !is_placed {
            plan.spacing_guess =
                Some("the header has no place; its slices were taken as coronal, with a spacing of 1".into());
        }
        Ok(Self { plan, path: path.to_owned() })
    }
}

impl VolumeFile for MghFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let data = Unpacked::open(open_file(&self.path)?, &self.path, 0, None, Packing::Plain)?;
        let num_bytes = collector.num_bytes();
        // Notes of FreeSurfer follow the voxels.
        data.take_some(collector, &self.path, HEADER_BYTES, num_bytes).map(drop)
    }
}

/// Bytes before the voxels, and those that have numbers.
const HEADER_BYTES: u64 = 284;
const LEAST_HEADER_BYTES: usize = 90;
