//! What comparisons of a kernel on the GPU with its twin share: the device, scenes, and the tolerance.
//!
//! Tolerance of all pictures, on 8-bit sRGB: at most 2/255 at any channel and below 0.1/255 in the mean. Both sides
//! compute in single precision with other roundings (contracted products, the device's exp and division), which moves a
//! linear value by about 1e-5 of full brightness; near black sRGB magnifies that by 12.92, and the rounding to 8 bits
//! turns the least difference into 1/255.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::{Arc, OnceLock};

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::kernels::march::{MarchSettings, Scene, Shading};
use isinglass_core::layer::FrameHeader;
use isinglass_core::picture::Picture;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Volume, Voxels};
use isinglass_gpu::{Gpu, GpuError};

/// The device, opened once. Without one the caller returns after the line that says so; strict mode fails instead.
pub fn gpu() -> Option<&'static Gpu> {
    static GPU: OnceLock<Result<Gpu, GpuError>> = OnceLock::new();
    match GPU.get_or_init(Gpu::open) {
        Ok(gpu) => Some(gpu),
        Err(e) => {
            let is_strict = std::env::var_os("ISINGLASS_STRICT").is_some_and(|v| v == "1");
            assert!(!is_strict, "{e}");
            eprintln!("skipped: {e}");
            None
        }
    }
}

/// Greatest and mean difference of two pictures over a background that shows errors of opacity too, in 1/255.
#[derive(Clone, Copy, Debug)]
pub struct Difference {
    /// The greatest.
    pub max: u8,
    /// The mean.
    pub mean: f64,
    /// Share of the pixels with a channel beyond 2/255.
    pub share_beyond_2: f64,
}

impl Difference {
    /// Of two pictures of one size.
    pub fn of(a: &Picture, b: &Picture) -> Self {
        assert_eq!((a.width, a.height), (b.width, b.height));
        assert!(a.pixels.iter().flatten().all(|x| x.is_finite()));
        Self::of_srgb8(&a.to_srgb8(BACKGROUND), &b.to_srgb8(BACKGROUND))
    }

    /// Of two pictures as 8-bit sRGB.
    pub fn of_srgb8(a: &[u8], b: &[u8]) -> Self {
        assert_eq!(a.len(), b.len());
        let each = a.iter().zip(b).map(|(a, b)| a.abs_diff(*b));
        let mean = each.clone().map(f64::from).sum::<f64>() / a.len() as f64;
        let num_beyond_2 =
            a.chunks(3).zip(b.chunks(3)).filter(|(a, b)| (0..3).any(|i| a[i].abs_diff(b[i]) > 2)).count();
        Self { max: each.max().unwrap(), mean, share_beyond_2: num_beyond_2 as f64 / (a.len() / 3) as f64 }
    }

    /// Within the tolerance of all pictures.
    pub fn is_tolerable(self) -> bool {
        self.max <= 2 && self.mean < 0.1
    }

    /// Stored in 8 bits before it is enlarged, and mixed by weights of 8 bits: half a step each, and a step in the result;
    /// to that comes the tolerance of what is enlarged.
    pub fn is_tolerable_enlarged(self) -> bool {
        self.max <= 4 && self.mean < 0.5
    }

    /// A few pixels differ: of two choices that cost the same another was made.
    pub fn is_another_choice(self) -> bool {
        self.share_beyond_2 <= 0.005 && self.mean < 0.1
    }

    /// Panics unless within the tolerance of all pictures.
    #[track_caller]
    pub fn assert_tolerable(self, what: &str) {
        assert!(self.is_tolerable(), "{what}: {self:?}");
    }

    /// Panics unless within the tolerance, or few pixels differ: where the nearest voxel counts, as for labels and gaps,
    /// another rounding takes another one.
    #[track_caller]
    pub fn assert_alike_but_for_choices(self, what: &str) {
        assert!(self.is_tolerable() || self.is_another_choice(), "{what}: {self:?}");
    }

    /// Panics if within the tolerance: a negative control.
    #[track_caller]
    pub fn assert_noticed(self, what: &str) {
        assert!(!self.is_tolerable(), "{what} was not noticed: {self:?}");
    }
}

/// Linear colour that pictures are compared over.
pub const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

/// Soft and coloured, or nearly opaque above a threshold.
pub fn transfer(soft: bool) -> TransferFunction {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    let (low, high) = if soft { (0.02, 0.25) } else { (0.0, 0.98) };
    TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![
            p(0.1, [0.2, 0.4, 1.0], 0.0),
            p(0.3, [0.3, 0.9, 0.5], low),
            p(0.6, [1.0, 0.7, 0.3], high),
            p(1.0, [1.0, 1.0, 0.9], high),
        ],
    }
}

/// The built-in volume cut to a box and stored in another type, with its own spacing.
fn volume(
    builtin: Builtin,
    side: u32,
    dims: [u32; 3],
    spacing: Vec3,
    voxels: impl Fn(Vec<f32>) -> Voxels,
) -> Volume {
    let whole = builtin.volume(side);
    let n = dims.iter().product::<u32>();
    let at = |i: u32| {
        whole.stored_at((i % dims[0]) as i32, (i / dims[0] % dims[1]) as i32, (i / dims[0] / dims[1]) as i32)
    };
    Volume::new(dims, spacing, voxels((0..n).map(at).collect()), (1.0, 0.0), Default::default()).unwrap()
}

fn as_u16(stored: Vec<f32>) -> Voxels {
    Voxels::U16(stored.iter().enumerate().map(|(i, x)| (x * 256.0) as u16 + (i % 191) as u16).collect())
}

fn as_f32(stored: Vec<f32>) -> Voxels {
    Voxels::F32(stored.iter().map(|x| x * 0.013 - 1.7).collect())
}

/// With this look.
pub fn scene(volume: Volume, soft: bool, shading: Option<Shading>) -> Scene {
    Scene::new(Arc::new(volume), &transfer(soft), MarchSettings { shading, ..Default::default() })
}

/// The built-in volumes and every voxel type, cubic and anisotropic, shaded and not.
pub fn scenes() -> Vec<(&'static str, Scene)> {
    let shaded = Some(Shading::default());
    let long = Vec3::new(0.02, 0.031, 0.047);
    vec![
        ("cloud u8", scene(Builtin::Cloud.volume(40), true, None)),
        ("cubus u8 shaded", scene(Builtin::Cubus.volume(48), false, shaded)),
        ("shells u8 shaded", scene(Builtin::Shells.volume(56), true, shaded)),
        ("cloud u16 shaded", scene(volume(Builtin::Cloud, 40, [40, 32, 27], long, as_u16), true, shaded)),
        ("shells f32 shaded", scene(volume(Builtin::Shells, 48, [33, 48, 48], long, as_f32), false, shaded)),
    ]
}

/// A camera that sees the whole volume.
pub fn camera(scene: &Scene, azimuth_deg: f32, (width, height): (u32, u32)) -> Camera {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(width, height, 0.6);
    let distance = bounds.radius() * intrinsics.fit_distance();
    Camera::new(Pose::orbit(bounds.center(), azimuth_deg.to_radians(), 0.35, distance), intrinsics, &bounds)
}

/// Of a frame of this camera.
pub fn header(camera: Camera, k: u8) -> FrameHeader {
    FrameHeader {
        frame: FrameId(7),
        pose: PoseId(3),
        look: LookVersion(1),
        camera,
        k,
        mode: Default::default(),
        fineness: Default::default(),
    }
}

/// Cameras that see a frame from everywhere: its own pose, beside, behind, inside, looking back.
pub fn views(scene: &Scene) -> Vec<(&'static str, Camera)> {
    let bounds = scene.volume.bounds();
    let size = (72, 60);
    let beside = |degrees: f32| camera(scene, 25.0 + degrees, size);
    let eye = beside(0.0).pose.eye;
    let at = |eye: Vec3, target: Vec3| {
        let intrinsics = Intrinsics::perspective(size.0, size.1, 1.2);
        Camera::new(Pose::look_at(eye, target, Vec3::Y), intrinsics, &bounds)
    };
    vec![
        ("own pose", beside(0.0)),
        ("10 degrees", beside(10.0)),
        ("90 degrees", beside(90.0)),
        ("180 degrees", beside(180.0)),
        ("inside", at(Vec3::new(0.1, 0.05, -0.1), Vec3::new(0.4, 0.1, -0.6))),
        ("inside, looking back", at(Vec3::new(0.05, 0.0, 0.0), eye)),
        ("behind the eye", at(eye * 1.5, Vec3::ZERO)),
    ]
}
