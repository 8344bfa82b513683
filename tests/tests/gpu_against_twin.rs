//! Does every kernel on the GPU do what its Rust twin does? On any adapter, lavapipe too.
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
use isinglass_core::kernels::combine;
use isinglass_core::kernels::layering::{self, Layering, Representative};
use isinglass_core::kernels::march::{self, MarchSettings, Scene, Shading};
use isinglass_core::kernels::raycast::{self, CastOptions, Raycaster, Reconstruction};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Volume, Voxels};
use isinglass_gpu::{Gpu, GpuError, GpuRenderer, GpuReprojector, ViewPass, wgpu};

/// The device, opened once. Without one the caller returns after the line that says so; strict mode fails instead.
fn gpu() -> Option<&'static Gpu> {
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
struct Difference {
    max: u8,
    mean: f64,
    /// Share of the pixels with a channel beyond 2/255.
    share_beyond_2: f64,
}

impl Difference {
    fn of(a: &Picture, b: &Picture) -> Self {
        assert_eq!((a.width, a.height), (b.width, b.height));
        assert!(a.pixels.iter().flatten().all(|x| x.is_finite()));
        Self::of_srgb8(&a.to_srgb8(BACKGROUND), &b.to_srgb8(BACKGROUND))
    }

    fn of_srgb8(a: &[u8], b: &[u8]) -> Self {
        assert_eq!(a.len(), b.len());
        let each = a.iter().zip(b).map(|(a, b)| a.abs_diff(*b));
        let mean = each.clone().map(f64::from).sum::<f64>() / a.len() as f64;
        let num_beyond_2 =
            a.chunks(3).zip(b.chunks(3)).filter(|(a, b)| (0..3).any(|i| a[i].abs_diff(b[i]) > 2)).count();
        Self { max: each.max().unwrap(), mean, share_beyond_2: num_beyond_2 as f64 / (a.len() / 3) as f64 }
    }

    fn is_tolerable(self) -> bool {
        self.max <= 2 && self.mean < 0.1
    }

    /// Stored in 8 bits before it is enlarged, and mixed by weights of 8 bits: half a step each, and a step in the result;
    /// to that comes the tolerance of what is enlarged.
    fn is_tolerable_enlarged(self) -> bool {
        self.max <= 4 && self.mean < 0.5
    }

    fn is_another_choice(self) -> bool {
        self.share_beyond_2 <= 0.005 && self.mean < 0.1
    }

    #[track_caller]
    fn assert_tolerable(self, what: &str) {
        assert!(self.is_tolerable(), "{what}: {self:?}");
    }

    #[track_caller]
    fn assert_noticed(self, what: &str) {
        assert!(!self.is_tolerable(), "{what} was not noticed: {self:?}");
    }
}

const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

/// Soft and coloured, or nearly opaque above a threshold.
fn transfer(soft: bool) -> TransferFunction {
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

fn scene(volume: Volume, soft: bool, shading: Option<Shading>) -> Scene {
    Scene::new(Arc::new(volume), &transfer(soft), MarchSettings { shading, ..Default::default() })
}

/// The built-in volumes and every voxel type, cubic and anisotropic, shaded and not.
fn scenes() -> Vec<(&'static str, Scene)> {
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

fn camera(scene: &Scene, azimuth_deg: f32, (width, height): (u32, u32)) -> Camera {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics { width, height, fov_y: 0.6 };
    let distance = bounds.radius() * intrinsics.fit_distance();
    Camera::new(Pose::orbit(bounds.center(), azimuth_deg.to_radians(), 0.35, distance), intrinsics, &bounds)
}

fn header(camera: Camera, k: u8) -> FrameHeader {
    FrameHeader { frame: FrameId(7), pose: PoseId(3), look: LookVersion(1), camera, k }
}

#[test]
fn render_is_that_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes() {
        let camera = camera(&scene, 25.0, (96, 72));
        let twin = march::render(&scene, &camera);
        let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
        let found = renderer.render(&camera).unwrap();
        Difference::of(&found, &twin).assert_tolerable(name);
        assert!(found.pixels.iter().any(|p| p[3] > 0.5), "{name}: nothing to be seen");

        let mut turned = camera;
        turned.pose = Pose::orbit(Vec3::ZERO, 26f32.to_radians(), 0.35, camera.pose.eye.length());
        let turned = renderer.render(&turned).unwrap();
        Difference::of(&turned, &twin).assert_noticed("a camera turned by one degree");
    }
}

/// 36 MiB of voxels: more than one slab of the upload, the last one not full.
#[test]
fn volumes_are_uploaded_to_the_last_slice() {
    let Some(gpu) = gpu() else { return };
    let scene = scene(Builtin::Cubus.volume(336), false, None);
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    // Azimuth 0 sees the last slices in front, 180 the first.
    for azimuth in [0.0, 180.0] {
        let camera = camera(&scene, azimuth, (48, 48));
        let found = renderer.render(&camera).unwrap();
        Difference::of(&found, &march::render(&scene, &camera)).assert_tolerable("several slabs");
    }
}

#[test]
fn the_look_can_change_without_another_upload() {
    let Some(gpu) = gpu() else { return };
    let light = Vec3::new(0.9, -0.3, 0.2).normalize();
    let (_, scene) = scenes().swap_remove(1);
    let camera = camera(&scene, 25.0, (64, 64));
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    let before = renderer.render(&camera).unwrap();
    let settings =
        MarchSettings { shading: Some(Shading { light, ..Default::default() }), ..Default::default() };
    let relit = scene.with_look(&transfer(false), settings);
    renderer.set_scene(relit.clone()).unwrap();
    let after = renderer.render(&camera).unwrap();
    Difference::of(&after, &march::render(&relit, &camera)).assert_tolerable("another light");
    Difference::of(&after, &before).assert_noticed("another light");
    let softer = scene.with_look(&transfer(true), settings);
    renderer.set_scene(softer.clone()).unwrap();
    let found = renderer.render(&camera).unwrap();
    Difference::of(&found, &march::render(&softer, &camera)).assert_tolerable("another transfer function");
    // And another volume, of another size and type.
    let (_, other) = scenes().swap_remove(4);
    renderer.set_scene(other.clone()).unwrap();
    let found = renderer.render(&camera).unwrap();
    Difference::of(&found, &march::render(&other, &camera)).assert_tolerable("another volume");
}

/// Lists cannot be equal word by word: a rounding decides to which depth unit an end goes, and which of two merges that
/// cost the same (there are many: equal cubes, equal shells, everything hidden) comes first. Composited along their own
/// rays they must agree within the tolerance of all pictures. From aside, merges decided otherwise show: they are as
/// good, but elsewhere, so visibility-merge is allowed 0.5 % of the pixels beyond 2/255 (costs
/// that differ in the last bit moved 0.27 % of them), and its error against the true picture must be the same to 2 % of
/// itself.
#[test]
fn layered_frames_are_those_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes() {
        let bounds = scene.volume.bounds();
        let camera_0 = camera(&scene, 25.0, (80, 64));
        let camera_1 = camera(&scene, 37.0, (80, 64));
        let view = |frame: &LayeredFrame| raycast::raycast(frame, &bounds, &camera_1);
        let truth = march::render(&scene, &camera_1);
        let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
        for layering in Layering::ALL {
            // Each list length is a kernel of its own; one scene tries the ends of the range.
            let ks: &[u8] = match layering {
                // These differ in a number alone.
                Layering::SingleDepth(r) if r != Representative::Mean && !name.ends_with("u8 shaded") => &[],
                Layering::SingleDepth(_) | Layering::Slabs => &[8],
                _ if name.starts_with("cubus") => &[8, 1, 32],
                _ => &[8],
            };
            for &k in ks {
                let what = format!("{name}, {layering}, k = {k}");
                let twin = layering::generate(&scene, header(camera_0, k), layering);
                let found = renderer.generate(header(camera_0, k), layering).unwrap();
                found.validate().unwrap_or_else(|e| panic!("{what}: {e}"));
                assert_eq!(found.header, twin.header);
                Difference::of(&found.flatten(), &twin.flatten()).assert_tolerable(&what);
                let (view_found, view_twin) = (view(&found), view(&twin));
                let turned = Difference::of(&view_found, &view_twin);
                let chooses =
                    matches!(layering, Layering::VisibilityMerge | Layering::VisibilityMergeFixed) && k > 1;
                assert!(
                    turned.is_tolerable() || chooses && turned.is_another_choice(),
                    "{what}, turned: {turned:?}"
                );
                let error = |view| Difference::of(view, &truth).mean;
                let (a, b) = (error(&view_found), error(&view_twin));
                assert!((a - b).abs() <= 0.02 * b, "{what}: error {a} of the view, the twin's is {b}");
                // A grazing ray may touch an invisible amount of matter on one side only; where pieces merge below a
                // tolerance, rounding may let one more or less through.
                let (a, b) = (found.num_segments() as f64, twin.num_segments() as f64);
                assert!(
                    (a - b).abs() <= if chooses { 0.04 } else { 0.01 } * b,
                    "{what}: {a} segments, the twin has {b}"
                );
                let tau = |f: &LayeredFrame| {
                    (0..f.num_segments()).map(|i| f64::from(f.segment(i).tau)).sum::<f64>()
                };
                assert!(
                    (tau(&found) - tau(&twin)).abs() <= 1e-3 * tau(&twin),
                    "{what}: optical depth in all"
                );
                let again = renderer.generate(header(camera_0, k), layering).unwrap();
                assert!(again == found, "{what}: another result of the same input");
            }
        }
        let twin = layering::generate(&scene, header(camera_0, 8), Layering::VisibilityMerge);
        for (layering, k) in [(Layering::VisibilityMerge, 4), (Layering::EqualTransmittance, 8)] {
            let other = view(&renderer.generate(header(camera_0, k), layering).unwrap());
            let turned = Difference::of(&other, &view(&twin));
            assert!(
                !turned.is_tolerable() && !turned.is_another_choice(),
                "{name}: {layering}, k = {k}: {turned:?}"
            );
        }
    }
}

#[test]
fn pictures_of_several_dispatches_have_no_seams() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(0);
    // More pixels than a software device takes in a dispatch, and no multiple of any workgroup or block.
    let camera = camera(&scene, 200.0, (333, 211));
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    let found = renderer.render(&camera).unwrap();
    Difference::of(&found, &march::render(&scene, &camera)).assert_tolerable("render");
    let frame = renderer.generate(header(camera, 3), Layering::VisibilityMerge).unwrap();
    frame.validate().unwrap();
    let twin = layering::generate(&scene, header(camera, 3), Layering::VisibilityMerge);
    Difference::of(&frame.flatten(), &twin.flatten()).assert_tolerable("generate");
    let moved =
        Picture { pixels: found.pixels.iter().cycle().skip(333).take(333 * 211).copied().collect(), ..found };
    Difference::of(&moved, &march::render(&scene, &camera)).assert_noticed("a row too many");
}

/// Cameras that see a frame from everywhere: its own pose, beside, behind, inside, looking back.
fn views(scene: &Scene) -> Vec<(&'static str, Camera)> {
    let bounds = scene.volume.bounds();
    let size = (72, 60);
    let beside = |degrees: f32| camera(scene, 25.0 + degrees, size);
    let eye = beside(0.0).pose.eye;
    let at = |eye: Vec3, target: Vec3| {
        let intrinsics = Intrinsics { width: size.0, height: size.1, fov_y: 1.2 };
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

#[test]
fn novel_views_are_those_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes() {
        let bounds = scene.volume.bounds();
        let frame =
            layering::generate(&scene, header(camera(&scene, 25.0, (90, 77)), 8), Layering::VisibilityMerge);
        let mut reprojector = GpuReprojector::new(gpu, &frame, &bounds).unwrap();
        let caster = Raycaster::new(&frame, &bounds);
        for (view, camera) in views(&scene) {
            let twin = raycast::raycast(&frame, &bounds, &camera);
            let found = reprojector.raycast(&camera).unwrap();
            Difference::of(&found, &twin).assert_tolerable(&format!("{name}, {view}"));
            // Jumping over empty cells leaves out nothing.
            let skips_none = CastOptions { skips_empty_space: false, ..Default::default() };
            let all = reprojector.raycast_with(&camera, &skips_none).unwrap();
            assert_eq!(all.pixels, found.pixels, "{name}, {view}");
            let nearest = CastOptions { reconstruction: Reconstruction::Nearest, ..Default::default() };
            let found = reprojector.raycast_with(&camera, &nearest).unwrap();
            let twin_nearest = caster.picture(&camera, &nearest);
            Difference::of(&found, &twin_nearest).assert_tolerable(&format!("{name}, {view}, nearest"));
            for reconstruction in [Reconstruction::Nearest, Reconstruction::Mixed] {
                let sampled = CastOptions { reconstruction, num_samples: 40, ..Default::default() };
                let found = reprojector.raycast_with(&camera, &sampled).unwrap();
                let sampled = Difference::of(&found, &caster.picture(&camera, &sampled));
                // A sample at a segment's end may fall to either side.
                assert!(sampled.is_another_choice(), "{name}, {view}, sampled: {sampled:?}");
            }
            let mut shifted = camera;
            shifted.pose.eye += camera.pose.world_from_view * Vec3::X * (0.02 * bounds.radius());
            let shifted = reprojector.raycast(&shifted).unwrap();
            Difference::of(&shifted, &twin).assert_noticed(&format!("{name}, {view}: a camera shifted"));
        }
    }
}

/// The newest frame sees a part of the volume only, older ones other parts of it, and the pictures look beside, between and
/// beyond them.
#[test]
fn several_frames_are_combined_as_by_the_twin() {
    let Some(gpu) = gpu() else { return };
    // A soft one and an opaque one.
    for (name, scene) in scenes().into_iter().take(2) {
        let bounds = scene.volume.bounds();
        let near = |degrees: f32, aside: f32, (width, height): (u32, u32)| {
            let intrinsics = Intrinsics { width, height, fov_y: 0.7 };
            let pose = Pose::orbit(bounds.center(), degrees.to_radians(), 0.2, 0.8 * bounds.radius());
            let eye = pose.eye + pose.world_from_view * (Vec3::X * (aside * bounds.radius()));
            Camera::new(Pose { eye, ..pose }, intrinsics, &bounds)
        };
        let frame = |degrees, aside, size| {
            layering::generate(&scene, header(near(degrees, aside, size), 6), Layering::VisibilityMerge)
        };
        // Of several sizes: each has its own buffers.
        let frames = [
            frame(0.0, 0.0, (72, 56)),
            frame(35.0, 0.0, (80, 56)),
            frame(-40.0, 0.2, (64, 64)),
            frame(180.0, 0.0, (40, 40)),
        ];
        let frames = frames.each_ref();
        let pictures = [(0.0, 0.0), (12.0, 0.0), (-25.0, 0.15), (60.0, -0.1)];
        let mut reprojector = GpuReprojector::new(gpu, frames[0], &bounds).unwrap();
        for num_frames in [4, 2] {
            reprojector.set_frames(&frames[..num_frames], &bounds).unwrap();
            for (degrees, aside) in pictures {
                let what = format!("{name}, {num_frames} frames, {degrees} degrees");
                let camera = near(degrees, aside, (72, 56));
                let found = reprojector.raycast(&camera).unwrap();
                let twin = combine::combine(&frames[..num_frames], &bounds, &camera);
                Difference::of(&found, &twin).assert_tolerable(&what);
                let newest = raycast::raycast(frames[0], &bounds, &camera);
                if degrees == 0.0 {
                    Difference::of(&found, &newest).assert_tolerable("the own pose");
                } else {
                    Difference::of(&found, &newest).assert_noticed(&format!("{what}: kept frames left out"));
                }
            }
        }
        // One frame is cast as ever, to the bit, and so are several from the newest one's own pose.
        let own = near(0.0, 0.0, (72, 56));
        let together = reprojector.raycast(&own).unwrap();
        reprojector.set_frame(frames[0], &bounds).unwrap();
        let alone = reprojector.raycast(&own).unwrap();
        assert_eq!(together, alone, "{name}");
        let turned = near(12.0, 0.0, (72, 56));
        let mut never_several = GpuReprojector::new(gpu, frames[0], &bounds).unwrap();
        let alone = reprojector.raycast(&turned).unwrap();
        assert_eq!(never_several.raycast(&turned).unwrap(), alone, "{name}");
    }
}

#[test]
fn a_reprojector_takes_frames_of_any_size_and_refuses_bad_ones() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(1);
    let bounds = scene.volume.bounds();
    let frame = |size, k| {
        layering::generate(&scene, header(camera(&scene, 25.0, size), k), Layering::EqualTransmittance)
    };
    let view = camera(&scene, 31.0, (64, 48));
    let mut reprojector = GpuReprojector::new(gpu, &frame((20, 16), 2), &bounds).unwrap();
    for frame in
        [frame((120, 90), 8), frame((30, 40), 3), LayeredFrame::empty(header(camera(&scene, 0.0, (9, 9)), 4))]
    {
        reprojector.set_frame(&frame, &bounds).unwrap();
        let twin = raycast::raycast(&frame, &bounds, &view);
        Difference::of(&reprojector.raycast(&view).unwrap(), &twin)
            .assert_tolerable("a frame of another size");
    }
    let good = frame((30, 40), 3);
    reprojector.set_frame(&good, &bounds).unwrap();
    let before = reprojector.raycast(&view).unwrap();
    let broken: [fn(&mut LayeredFrame); 5] = [
        |f| f.offsets[5] = u32::MAX,
        |f| f.offsets.truncate(10),
        |f| f.depth.truncate(1),
        |f| f.c_rg.clear(),
        |f| f.header.camera.near = -1.0,
    ];
    for damage in broken {
        let mut bad = good.clone();
        damage(&mut bad);
        assert!(matches!(reprojector.set_frame(&bad, &bounds), Err(GpuError::Frame(_) | GpuError::Camera)));
    }
    assert_eq!(reprojector.raycast(&view).unwrap(), before);
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(0);
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    let huge = camera(&scene, 0.0, (8192, 8192));
    let error = renderer.generate(header(huge, 16), Layering::VisibilityMerge).unwrap_err();
    assert!(matches!(error, GpuError::TooLarge { .. }), "{error}");
    // The longest lists of the sources at full size: a quarter of a gigabyte a plane, which not every device can bind.
    match renderer.generate(header(camera(&scene, 0.0, (1920, 1080)), 30), Layering::VisibilityMergeFixed) {
        Ok(frame) => frame.validate().unwrap(),
        Err(e) => {
            assert!(matches!(e, GpuError::TooLarge { needed: 248_832_000, .. }), "{e}");
            assert!(!e.to_string().contains('\n'));
        }
    }
    let mut bad = camera(&scene, 0.0, (64, 64));
    bad.intrinsics.width = 0;
    assert_eq!(renderer.render(&bad), Err(GpuError::Camera));
    assert_eq!(renderer.generate(header(bad, 4), Layering::VisibilityMerge), Err(GpuError::Camera));
    // And the renderer still works.
    let good = camera(&scene, 0.0, (40, 40));
    let found = renderer.render(&good).unwrap();
    Difference::of(&found, &march::render(&scene, &good)).assert_tolerable("after errors");
}

/// Twice as large each way, linear between the centres of pixels.
fn enlarged(picture: &Picture) -> Picture {
    let mut large = Picture::new(2 * picture.width, 2 * picture.height);
    // Left or upper neighbour, the other one, and the share of the other.
    let between = |x: u32, side: u32| {
        let at = (x as f32 * 0.5 - 0.25).clamp(0.0, side as f32 - 1.0);
        (at as u32, (at as u32 + 1).min(side - 1), at.fract())
    };
    for (i, pixel) in large.pixels.iter_mut().enumerate() {
        let (x0, x1, right) = between(i as u32 % large.width, picture.width);
        let (y0, y1, below) = between(i as u32 / large.width, picture.height);
        let at = |x: u32, y: u32| glam::Vec4::from(picture.pixels[(y * picture.width + x) as usize]);
        let row = |y| at(x0, y).lerp(at(x1, y), right);
        *pixel = row(y0).lerp(row(y1), below).into();
    }
    large
}

/// The same of what the screen holds. Pixels are mixed as the device reads them: light from an sRGB format, stored values
/// from the other.
fn enlarged_srgb8(mut picture: Picture, format: wgpu::TextureFormat) -> Vec<u8> {
    if format.is_srgb() {
        return enlarged(&picture).to_srgb8(BACKGROUND);
    }
    let bytes = picture.to_srgb8(BACKGROUND);
    for (pixel, rgb) in picture.pixels.iter_mut().zip(bytes.chunks(3)) {
        *pixel = [rgb[0], rgb[1], rgb[2], 255].map(|byte| f32::from(byte) / 255.0);
    }
    let byte = |x: f32| (x * 255.0).round() as u8;
    enlarged(&picture).pixels.iter().flat_map(|p| [p[0], p[1], p[2]].map(byte)).collect()
}

/// Draws a view pass into the right half of a target twice as wide; the bytes of both halves.
fn paint(gpu: &Gpu, pass: &ViewPass, format: wgpu::TextureFormat, size: (u32, u32)) -> [Vec<u8>; 2] {
    paint_by(gpu, format, size, |render_pass| pass.paint(render_pass))
}

fn paint_by(
    gpu: &Gpu,
    format: wgpu::TextureFormat,
    (width, height): (u32, u32),
    draw: impl FnOnce(&mut wgpu::RenderPass<'_>),
) -> [Vec<u8>; 2] {
    let size = wgpu::Extent3d { width: 2 * width, height, depth_or_array_layers: 1 };
    let target = gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: None,
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let bytes_per_row = (2 * width * 4).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let staging = gpu.device().create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: u64::from(bytes_per_row * height),
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = gpu.device().create_command_encoder(&Default::default());
    {
        let view = target.create_view(&Default::default());
        let mut render_pass = encoder
            .begin_render_pass(&wgpu::RenderPassDescriptor {
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view: &view,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations {
                        load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                        store: wgpu::StoreOp::Store,
                    },
                })],
                ..Default::default()
            })
            .forget_lifetime();
        render_pass.set_viewport(width as f32, 0.0, width as f32, height as f32, 0.0, 1.0);
        draw(&mut render_pass);
    }
    encoder.copy_texture_to_buffer(
        target.as_image_copy(),
        wgpu::TexelCopyBufferInfo {
            buffer: &staging,
            layout: wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(bytes_per_row),
                rows_per_image: None,
            },
        },
        size,
    );
    gpu.queue().submit([encoder.finish()]);
    staging.map_async(wgpu::MapMode::Read, .., |result| result.unwrap());
    gpu.device().poll(wgpu::PollType::wait_indefinitely()).unwrap();
    let bytes = staging.get_mapped_range(..).unwrap();
    let half = |from: u32| {
        let row = |y: u32| &bytes[(y * bytes_per_row + from * 4) as usize..][..width as usize * 4];
        (0..height).flat_map(|y| row(y).chunks(4).flat_map(|p| p[..3].to_vec())).collect()
    };
    [half(0), half(width)]
}

#[test]
fn the_view_pass_paints_what_the_twin_casts() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(2);
    let bounds = scene.volume.bounds();
    let frame =
        layering::generate(&scene, header(camera(&scene, 25.0, (90, 77)), 8), Layering::VisibilityMerge);
    for format in [wgpu::TextureFormat::Rgba8Unorm, wgpu::TextureFormat::Rgba8UnormSrgb] {
        let mut pass = ViewPass::new(gpu.device(), format).unwrap();
        let view = camera(&scene, 33.0, (100, 76));
        pass.prepare(gpu.queue(), &view, BACKGROUND);
        let [_, empty] = paint(gpu, &pass, format, (100, 76));
        let background = Picture::new(100, 76).to_srgb8(BACKGROUND);
        Difference::of_srgb8(&empty, &background).assert_tolerable("background before the first frame");

        pass.upload(gpu.device(), gpu.queue(), 0, &frame, &bounds).unwrap();
        for (name, mut view) in views(&scene) {
            view.intrinsics = Intrinsics { width: 100, height: 76, ..view.intrinsics };
            pass.prepare(gpu.queue(), &view, BACKGROUND);
            let [beside, found] = paint(gpu, &pass, format, (100, 76));
            assert!(beside.iter().all(|&x| x == 0), "painted outside of the viewport");
            let twin = raycast::raycast(&frame, &bounds, &view).to_srgb8(BACKGROUND);
            Difference::of_srgb8(&found, &twin).assert_tolerable(&format!("{name}, {format:?}"));
            Difference::of_srgb8(&found, &background).assert_noticed("nothing painted");
        }
        // Half as many pixels each way, enlarged: the same as the twin's picture of that size, enlarged by hand.
        let whole = camera(&scene, 33.0, (100, 76));
        let smaller =
            Camera { intrinsics: Intrinsics { width: 50, height: 38, ..whole.intrinsics }, ..whole };
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        pass.prepare_smaller(gpu.device(), gpu.queue(), &mut encoder, &smaller, BACKGROUND);
        gpu.queue().submit([encoder.finish()]);
        let [_, found] = paint_by(gpu, format, (100, 76), |render_pass| pass.paint_enlarged(render_pass));
        let twin = enlarged_srgb8(raycast::raycast(&frame, &bounds, &smaller), format);
        let difference = Difference::of_srgb8(&found, &twin);
        assert!(difference.is_tolerable_enlarged(), "enlarged, {format:?}: {difference:?}");
        let full = raycast::raycast(&frame, &bounds, &whole).to_srgb8(BACKGROUND);
        assert!(
            !Difference::of_srgb8(&found, &full).is_tolerable_enlarged(),
            "half of the pixels were not noticed"
        );
        // Another slot for an older frame, of another size, shown along with the newest.
        let older = header(camera(&scene, 80.0, (61, 50)), 8);
        let older = layering::generate(&scene, older, Layering::VisibilityMerge);
        pass.upload(gpu.device(), gpu.queue(), 5, &older, &bounds).unwrap();
        let aside = |degrees: f32, distance: f32| {
            let pose =
                Pose::orbit(bounds.center(), f32::to_radians(degrees), 0.35, distance * bounds.radius());
            Camera::new(pose, whole.intrinsics, &bounds)
        };
        let newest = header(Camera { intrinsics: frame.header.camera.intrinsics, ..aside(30.0, 0.8) }, 8);
        let newest = layering::generate(&scene, newest, Layering::VisibilityMerge);
        pass.upload(gpu.device(), gpu.queue(), 0, &newest, &bounds).unwrap();
        let whole = aside(45.0, 0.9);
        let draw = |pass: &mut ViewPass, slots: &[usize]| {
            pass.show(gpu.device(), slots).unwrap();
            pass.prepare(gpu.queue(), &whole, BACKGROUND);
            let [_, found] = paint(gpu, pass, format, (100, 76));
            found
        };
        let twin = combine::combine(&[&newest, &older], &bounds, &whole).to_srgb8(BACKGROUND);
        let alone = raycast::raycast(&newest, &bounds, &whole).to_srgb8(BACKGROUND);
        Difference::of_srgb8(&draw(&mut pass, &[0, 5]), &twin).assert_tolerable("two frames");
        Difference::of_srgb8(&draw(&mut pass, &[0, 5]), &alone).assert_noticed("the older frame");
        Difference::of_srgb8(&draw(&mut pass, &[0]), &alone).assert_tolerable("one frame again");
        Difference::of_srgb8(&draw(&mut pass, &[0, 3]), &alone).assert_tolerable("an empty slot");
        // A frame of another size in a slot that is shown.
        pass.show(gpu.device(), &[0, 5]).unwrap();
        let larger = header(camera(&scene, 80.0, (120, 100)), 8);
        let larger = layering::generate(&scene, larger, Layering::VisibilityMerge);
        pass.upload(gpu.device(), gpu.queue(), 5, &larger, &bounds).unwrap();
        let twin = combine::combine(&[&newest, &larger], &bounds, &whole).to_srgb8(BACKGROUND);
        Difference::of_srgb8(&draw(&mut pass, &[0, 5]), &twin).assert_tolerable("a larger frame");
        // Enlarged from a smaller picture.
        let smaller =
            Camera { intrinsics: Intrinsics { width: 50, height: 38, ..whole.intrinsics }, ..whole };
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        pass.prepare_smaller(gpu.device(), gpu.queue(), &mut encoder, &smaller, BACKGROUND);
        gpu.queue().submit([encoder.finish()]);
        let [_, found] = paint_by(gpu, format, (100, 76), |render_pass| pass.paint_enlarged(render_pass));
        let twin = enlarged_srgb8(combine::combine(&[&newest, &larger], &bounds, &smaller), format);
        let difference = Difference::of_srgb8(&found, &twin);
        assert!(difference.is_tolerable_enlarged(), "several frames, enlarged: {difference:?}");
        let mut bad = frame.clone();
        bad.offsets.pop();
        assert!(pass.upload(gpu.device(), gpu.queue(), 0, &bad, &bounds).is_err());
    }
}
