//! NIfTI-1 and NIfTI-2 (nifti.nimh.nih.gov): one file, plain or gzip, or a header beside an image.
//!
//! The world space of the format is RAS+. The sform comes before the qform. A file with neither has no known position
//! in a body.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::axes::{Geometry, World};
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, shown};
use crate::foreign::HomeFolder;
use crate::header_bytes::HeaderBytes;
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{Axis, BoxLevel, ChannelLook, Plan, Role, VolumeFile};
use crate::source::{OpenOptions, open_file};
use crate::stream::{Packing, Unpacked};
use crate::units::time_step;
use crate::warning::WarningKind;

/// A file whose header was read.
pub(crate) struct NiftiFile {
    plan: Plan,
    /// The file with the voxels.
    data: PathBuf,
    packing: Packing,
    /// Bytes before the first voxel, unpacked.
    skip: u64,
}

/// Whether `start` begins a header. It must be unpacked.
pub(crate) fn is_header(start: &[u8]) -> bool {
    version(start).is_some()
}

/// The version, the byte order, and whether the voxels are in another file.
fn version(start: &[u8]) -> Option<(u8, Endian, bool)> {
    let is_at = |at: usize, magic: &[u8]| start.get(at..).is_some_and(|rest| rest.starts_with(magic));
    for endian in [Endian::Little, Endian::Big] {
        match (HeaderBytes { bytes: start, endian }).i32(0) {
            348 if is_at(344, b"n+1\0") => return Some((1, endian, false)),
            348 if is_at(344, b"ni1\0") => return Some((1, endian, true)),
            540 if is_at(4, b"n+2\0") => return Some((2, endian, false)),
            540 if is_at(4, b"ni2\0") => return Some((2, endian, true)),
            _ => {}
        }
    }
    None
}

impl NiftiFile {
    /// `file` is the file at `path`, which is a gzip file if `is_packed`.
    pub(crate) fn open(
        file: File,
        path: &Path,
        is_packed: bool,
        options: &OpenOptions,
    ) -> Result<Self, FormatError> {
        let packing = if is_packed { Packing::Gzip } else { Packing::Plain };
        let mut bytes = Vec::new();
        let start = Unpacked::open(file, path, 0, None, packing)?;
        start.take_start(HEADER_2_BYTES).read_to_end(&mut bytes).map_err(io_error(path))?;
        let bad = malformed(path, "NIfTI header");
        let Some((version, endian, is_pair)) = version(&bytes) else {
            return Err(bad("its mark is missing".into()));
        };
        let words = HeaderBytes { bytes: &bytes, endian };
        let header_bytes = if version == 1 { HEADER_1_BYTES } else { HEADER_2_BYTES };
        if (bytes.len() as u64) < header_bytes {
            return Err(bad(format!("{} bytes, expected {header_bytes}", bytes.len())));
        }
        let header =
            if version == 1 { NiftiHeader::of_version_1(words) } else { NiftiHeader::of_version_2(words) };
        let name = format!("NIfTI-{version}{}", if is_packed { ", gzip" } else { "" });
        let plan = header.plan(&name, endian).map_err(bad)?;
        let least = if is_pair { 0 } else { header_bytes + 4 };
        let skip = header.vox_offset;
        if !(skip.is_finite() && (0.0..=MAX_SKIP).contains(&skip)) {
            return Err(bad(format!("vox_offset is {skip}, expected a place in the file")));
        }
        let (data, packing) = if is_pair {
            let image = image_of(path).ok_or_else(|| bad("there is no .img file beside it".into()))?;
            HomeFolder::of_header(path, options).check(&image.0)?;
            image
        } else {
            (path.to_owned(), packing)
        };
        Ok(Self { plan, data, packing, skip: (skip as u64).max(least) })
    }
}

impl VolumeFile for NiftiFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let data = Unpacked::open(open_file(&self.data)?, &self.data, 0, None, self.packing)?;
        let num_bytes = collector.num_bytes();
        data.take(collector, &self.data, self.skip, num_bytes)
    }

    fn data_files(&self) -> Vec<PathBuf> {
        vec![self.data.clone()]
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        if self.packing != Packing::Plain {
            return Err(FormatError::NotPaged { path: shown(path), found: "gzip".into() });
        }
        flat_level(&self.plan, vec![FlatFile { path: self.data.clone(), offset: self.skip }], path)
    }
}

/// The image beside a header. It has the same name with `.img`, plain or gzip.
fn image_of(header: &Path) -> Option<(PathBuf, Packing)> {
    let is_packed = header.extension().is_some_and(|e| e.eq_ignore_ascii_case("gz"));
    let stem = if is_packed { header.with_extension("") } else { header.to_owned() };
    let found = |end: &str| Some(stem.with_extension(end)).filter(|p| p.is_file());
    let plain = found("img").or_else(|| found("IMG")).map(|p| (p, Packing::Plain));
    plain.or_else(|| found("img.gz").map(|p| (p, Packing::Gzip)))
}

/// The relevant fields of both versions.
struct NiftiHeader {
    dim: [i64; 8],
    datatype: i16,
    pixdim: [f64; 8],
    vox_offset: f64,
    slope: f64,
    intercept: f64,
    /// The values that are shown black and white.
    window: (f64, f64),
    units: i32,
    intent: i32,
    qform_code: i32,
    sform_code: i32,
    quatern: [f64; 3],
    qoffset: [f64; 3],
    srow: [[f64; 4]; 3],
}

impl NiftiHeader {
    fn of_version_1(w: HeaderBytes) -> Self {
        let f = |at: usize| f64::from(w.f32(at));
        Self {
            dim: std::array::from_fn(|i| w.i16(40 + 2 * i).into()),
            datatype: w.i16(70),
            pixdim: std::array::from_fn(|i| f(76 + 4 * i)),
            vox_offset: f(108),
            slope: f(112),
            intercept: f(116),
            window: (f(128), f(124)),
            units: i32::from(w.array::<1>(123)[0]),
            intent: w.i16(68).into(),
            qform_code: w.i16(252).into(),
            sform_code: w.i16(254).into(),
            quatern: std::array::from_fn(|i| f(256 + 4 * i)),
            qoffset: std::array::from_fn(|i| f(268 + 4 * i)),
            srow: std::array::from_fn(|r| std::array::from_fn(|c| f(280 + 16 * r + 4 * c))),
        }
    }

    fn of_version_2(w: HeaderBytes) -> Self {
        Self {
            dim: std::array::from_fn(|i| w.i64(16 + 8 * i)),
            datatype: w.i16(12),
            pixdim: std::array::from_fn(|i| w.f64(104 + 8 * i)),
            vox_offset: w.i64(168) as f64,
            slope: w.f64(176),
            intercept: w.f64(184),
            window: (w.f64(200), w.f64(192)),
            units: w.i32(500),
            intent: w.i32(504),
            qform_code: w.i32(344),
            sform_code: w.i32(348),
            quatern: std::array::from_fn(|i| w.f64(352 + 8 * i)),
            qoffset: std::array::from_fn(|i| w.f64(376 + 8 * i)),
            srow: std::array::from_fn(|r| std::array::from_fn(|c| w.f64(400 + 32 * r + 8 * c))),
        }
    }

    fn plan(&self, format: &str, endian: Endian) -> Result<Plan, String> {
        let num_axes = self.dim[0];
        if !(1..=7).contains(&num_axes) {
            return Err(format!("dim[0] is {num_axes}, expected 1 to 7"));
        }
        let mut sizes = [1u64; 7];
        for (i, size) in sizes.iter_mut().enumerate().take(num_axes as usize) {
            let found = self.dim[i + 1];
            *size = u64::try_from(found)
                .ok()
                .filter(|&n| n > 0)
                .ok_or_else(|| format!("dim[{}] is {found}, expected a number of voxels", i + 1))?;
        }
        if sizes[5] > 1 || sizes[6] > 1 {
            return Err(format!("dim[6] and dim[7] are {} and {}, expected 1", sizes[5], sizes[6]));
        }
        let (dtype, colors) = self.dtype()?;
        let mut axes = Axis::in_space([sizes[0], sizes[1], sizes[2]]);
        axes.push(Axis { size: sizes[3], role: Role::Time });
        match (colors, sizes[4]) {
            (0, size) => axes.push(Axis { size, role: Role::Channel }),
            (colors, 1) => axes.insert(0, Axis { size: colors, role: Role::Channel }),
            (_, more) => return Err(format!("dim[5] of a colour image is {more}, expected 1")),
        }
        let mut plan = Plan::new(format, dtype, endian, axes, Geometry::along_axes([1.0; 3], None));
        if colors > 0 {
            plan.set_colors();
        } else if self.slope != 0.0 && self.slope.is_finite() && self.intercept.is_finite() {
            plan.value_map = (self.slope, self.intercept);
        } else if !self.slope.is_finite() || !self.intercept.is_finite() {
            plan.warn(
                WarningKind::Values,
                "scl_slope or scl_inter is not a number; values are taken as they are",
            );
        }
        if colors == 0 {
            plan.channel_looks = vec![ChannelLook { window: Some(self.window), ..ChannelLook::default() }];
        }
        plan.are_labels = self.intent == INTENT_LABEL;
        plan.time_step = self.time_step();
        plan.geometry = self.geometry(&mut plan);
        Ok(plan)
    }

    /// Seconds from one volume to the next. The other units are of frequencies.
    fn time_step(&self) -> Option<f64> {
        let seconds = match self.units & 0x38 {
            // Without a unit it is taken as seconds, as other programs do.
            0 | 8 => 1.0,
            16 => 1e-3,
            24 => 1e-6,
            _ => return None,
        };
        time_step(self.pixdim[4] * seconds)
    }

    /// The type of a number, and the number of colours of a voxel, or 0.
    fn dtype(&self) -> Result<(Dtype, u64), String> {
        Ok(match self.datatype {
            2 => (Dtype::Uint8, 0),
            4 => (Dtype::Int16, 0),
            8 => (Dtype::Int32, 0),
            16 => (Dtype::Float, 0),
            64 => (Dtype::Double, 0),
            128 => (Dtype::Uint8, 3),
            256 => (Dtype::Int8, 0),
            512 => (Dtype::Uint16, 0),
            768 => (Dtype::Uint32, 0),
            1024 => (Dtype::Int64, 0),
            1280 => (Dtype::Uint64, 0),
            2304 => (Dtype::Uint8, 4),
            other => {
                let name = match other {
                    1 => " (single bits)",
                    32 | 1792 | 2048 => " (complex numbers)",
                    1536 => " (128-bit floating point)",
                    _ => "",
                };
                return Err(format!(
                    "datatype is {other}{name}, expected integers of 8 to 64 bits, floating point of 32 or 64, RGB24 or RGBA32"
                ));
            }
        })
    }

    fn geometry(&self, plan: &mut Plan) -> Geometry {
        let (mm, is_named) = match self.units & 7 {
            1 => (1e3, true),
            2 => (1.0, true),
            3 => (1e-3, true),
            _ => (1.0, false),
        };
        let spacing: [f64; 3] = std::array::from_fn(|i| self.pixdim[i + 1].abs());
        let is_good = spacing.iter().all(|s| s.is_finite() && *s > 0.0);
        let qform = (self.qform_code > 0 && is_good).then(|| self.qform(spacing)).filter(is_usable);
        let sform = (self.sform_code > 0).then(|| self.sform()).filter(is_usable);
        if self.sform_code > 0 && sform.is_none() {
            plan.warn(WarningKind::Geometry, "the sform is not invertible and was ignored");
        }
        if let (Some(q), Some(s)) = (&qform, &sform) {
            // This is a tenth of a voxel over a hundred voxels.
            let differs = q.0.iter().zip(&s.0).any(|(a, b)| (*a - *b).length() > 1e-3 * b.length());
            if differs {
                plan.warn(WarningKind::Geometry, "qform and sform differ; the sform is used");
            }
        }
        let unit = is_named.then(|| "mm".to_owned());
        match sform.or(qform) {
            Some((steps, origin)) => {
                let steps = steps.map(|s| s * mm);
                Geometry { steps, origin: Some(origin * mm), world: World::Body, unit }
            }
            None => {
                if !is_good {
                    plan.spacing_guess =
                        Some("pixdim has no lengths above zero; the spacing was taken as 1".into());
                }
                let text = "neither qform nor sform says where the axes point; they were taken as +x+y+z";
                plan.warn(WarningKind::Guess, text);
                let spacing = if is_good { spacing } else { [1.0; 3] };
                Geometry::along_axes(spacing.map(|s| s * mm), unit)
            }
        }
    }

    fn sform(&self) -> ([DVec3; 3], DVec3) {
        let column = |c: usize| DVec3::from_array([0, 1, 2].map(|r| self.srow[r][c]));
        ([column(0), column(1), column(2)], column(3))
    }

    /// The rotation by a unit quaternion. The file leaves out its first component (nifti1.h, "METHOD 2").
    fn qform(&self, spacing: [f64; 3]) -> ([DVec3; 3], DVec3) {
        let [mut b, mut c, mut d] = self.quatern;
        let mut square = 1.0 - (b * b + c * c + d * d);
        if square < 1e-7 {
            // For a rotation by 180°, rounding can make the first component imaginary.
            let scale = 1.0 / (b * b + c * c + d * d).sqrt();
            (b, c, d) = (b * scale, c * scale, d * scale);
            square = 0.0;
        }
        let a = square.sqrt();
        let qfac = if self.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
        let steps = [
            DVec3::new(a * a + b * b - c * c - d * d, 2.0 * (b * c + a * d), 2.0 * (b * d - a * c)),
            DVec3::new(2.0 * (b * c - a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d + a * b)),
            DVec3::new(2.0 * (b * d + a * c), 2.0 * (c * d - a * b), a * a + d * d - c * c - b * b) * qfac,
        ];
        (std::array::from_fn(|i| steps[i] * spacing[i]), DVec3::from_array(self.qoffset))
    }
}

/// Whether the steps are independent and all numbers are finite.
fn is_usable((steps, origin): &([DVec3; 3], DVec3)) -> bool {
    let volume = steps[0].dot(steps[1].cross(steps[2])).abs();
    let lengths = steps.iter().map(|s| s.length()).product::<f64>();
    origin.is_finite() && lengths.is_finite() && lengths > 0.0 && volume >= lengths * 0.01
}

/// The code of voxels that are labels (nifti1.h).
const INTENT_LABEL: i32 = 1002;
const HEADER_1_BYTES: u64 = 348;
const HEADER_2_BYTES: u64 = 540;
/// Most bytes before the voxels.
const MAX_SKIP: f64 = 1e12;
