//! Is a layered frame of every volume, made and cast on every backend, the rendering from its own pose?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::codec;
use isinglass_core::image_error::{ImageError, compare};
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::FrameHeader;
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Histogram, Volume};
use isinglass_formats::{OpenOptions, default_preset, load_transfer, open};
use isinglass_render::{Backend, BackendChoice};
use isinglass_tests::data_dir;

const SIZE: Intrinsics = Intrinsics::perspective(72, 64, 0.6);

/// The backends of this machine. Without any adapter the GPU is left out, or in strict mode the test fails.
fn backends() -> Vec<Backend> {
    let mut backends = vec![Backend::Cpu];
    match Backend::open(BackendChoice::Gpu) {
        Ok(gpu) => backends.push(gpu),
        Err(e) => {
            let is_strict = std::env::var_os("ISINGLASS_STRICT").is_some_and(|v| v == "1");
            assert!(!is_strict, "{e}");
            eprintln!("skipped on the GPU: {e}");
        }
    }
    backends
}

fn error(a: &Picture, b: &Picture) -> ImageError {
    let (width, height) = (a.width as usize, a.height as usize);
    compare(&a.to_srgb8([0.0; 3]), &b.to_srgb8([0.0; 3]), width, height, [0; 3]).unwrap()
}

/// The scene of a volume by its own preset.
fn scene_of(source: &str) -> (Scene, TransferFunction) {
    let volume: Volume = open(source, &OpenOptions::default()).unwrap();
    let transfer = load_transfer(default_preset(source, &volume, &Histogram::of(&volume))).unwrap();
    (Scene::new(Arc::new(volume), &transfer, MarchSettings::default()), transfer)
}

/// A scene in every mode but the first, surfaces in two ways: opaque, and a translucent one around it.
fn in_other_modes(scene: &Scene, transfer: &TransferFunction) -> Vec<(String, Scene)> {
    // Air is the least on nearly every ray: what shows it is another function.
    let point = |x, color, opacity| ControlPoint { x, color, opacity };
    let of_the_least = TransferFunction {
        name: "of the least".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![
            point(0.0, [0.9, 0.8, 0.5], 0.8),
            point(0.2, [0.2, 0.4, 0.9], 0.3),
            point(1.0, [1.0; 3], 0.0),
        ],
    };
    let inner = scene.histogram.parting_value();
    let outer = 0.5 * (scene.volume.value_range().0 + inner);
    let translucent =
        Isos::new(&[Iso { value: outer, opacity: 0.3 }, Iso { value: inner, opacity: 1.0 }]).unwrap();
    let with = |mode: Mode, isos, transfer: &TransferFunction| {
        scene.with_look(transfer, MarchSettings { mode, isos, ..MarchSettings::default() })
    };
    vec![
        ("mip".into(), with(Mode::Mip, Isos::default(), transfer)),
        ("minip".into(), with(Mode::MinIp, Isos::default(), &of_the_least)),
        ("average".into(), with(Mode::Average, Isos::default(), transfer)),
        ("iso".into(), with(Mode::Iso, Isos::default(), transfer)),
        ("iso, two".into(), with(Mode::Iso, translucent, transfer)),
    ]
}

fn check(source: &str, backends: &[Backend]) {
    let (scene, _) = scene_of(source);
    check_scene(source, &scene, backends);
}

fn check_scene(source: &str, scene: &Scene, backends: &[Backend]) {
    let bounds = scene.volume.bounds();
    let camera_at = |azimuth: f32| {
        let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.35, bounds.radius() * SIZE.fit_distance());
        Camera::new(pose, SIZE, &bounds)
    };
    let camera = camera_at(0.5);
    // A mean is dark, and changes little as the camera turns.
    let is_projection = scene.settings.mode.is_projection();
    let (seen, aside) = if is_projection { (0.05, 1.3) } else { (0.3, 0.62) };
    for backend in backends {
        let mut renderer = backend.renderer(scene.clone()).unwrap();
        let truth = renderer.render(&camera).unwrap();
        assert!(truth.pixels.iter().any(|p| p[3] > seen), "{source} shows nothing");
        let at = format!("{source}, {}", backend.description());
        let header = FrameHeader::alone(camera, 8);
        let frame = renderer.generate(header).unwrap();
        assert_eq!(frame.header.mode, scene.settings.mode, "{at}");
        let own = error(&backend.raycast(&frame, &bounds, &camera).unwrap(), &truth);
        // Half floats carry C and τ to 2^−11: less than half a step of 1/255.
        assert!(own.max_abs_255 <= 1, "{at}: {own:?}");

        let encoded = codec::encode(&frame).unwrap();
        let chunks: Vec<_> = encoded.chunks.iter().map(|c| c.bytes.as_slice()).collect();
        let decoded = codec::decode(&chunks).unwrap();
        let wired = error(&backend.raycast(&decoded, &bounds, &camera).unwrap(), &truth);
        // The bound that the wire is held to.
        assert!(wired.dssim <= 1e-3, "{at}, through the wire: {wired:?}");

        // Negative control: seven degrees to the side is another picture. (Three are not for a ball at one depth.)
        let beside = backend.raycast(&frame, &bounds, &camera_at(aside)).unwrap();
        assert!(error(&beside, &truth).dssim > 2e-3, "{at}: a turned camera shows the same");
    }
}

/// The picture that a viewer shows where its camera rests: decoded, of a server's frame with its clip, and cut once more by
/// the same clip.
#[test]
fn of_clipped_volumes_and_parallel_rays_through_the_wire() {
    for name in ["builtin:cubus@64", "builtin:shells@64"] {
        let volume: Volume = open(name, &OpenOptions::default()).unwrap();
        let transfer = load_transfer(default_preset(name, &volume, &Histogram::of(&volume))).unwrap();
        let bounds = volume.bounds();
        let inner = Aabb { min: bounds.min * 0.55, max: bounds.max * 0.3 };
        let plane = Plane::new(Vec3::new(0.3, 1.0, 0.6), 0.05 * bounds.radius());
        let clip = Clip { bounds: Some(inner), plane };
        let whole = Scene::new(Arc::new(volume), &transfer, MarchSettings::default());
        let settings = MarchSettings { clip, ..whole.settings };
        let pose = Pose::orbit(Vec3::ZERO, 0.5, 0.35, bounds.radius() * SIZE.fit_distance());
        let camera = Camera::new(pose, SIZE, &bounds);
        for camera in [camera, camera.to_orthographic(bounds.radius() * SIZE.fit_distance(), &bounds)] {
            for backend in backends() {
                let at = format!("{name}, {camera:?}, {}", backend.description());
                let mut renderer = backend.renderer(whole.clone()).unwrap();
                let uncut = renderer.render(&camera).unwrap();
                renderer.set_scene(Scene { settings, ..whole.clone() }).unwrap();
                let truth = renderer.render(&camera).unwrap();
                assert!(error(&truth, &uncut).max_abs_255 > 30, "{at}: nothing is cut away");
                let header = FrameHeader::alone(camera, 8);
                let frame = renderer.generate(header).unwrap();
                let encoded = codec::encode(&frame).unwrap();
                let chunks: Vec<_> = encoded.chunks.iter().map(|c| c.bytes.as_slice()).collect();
                let decoded = codec::decode(&chunks).unwrap();
                assert_eq!(decoded.header.camera, camera, "{at}");
                let options = CastOptions { clip, ..CastOptions::default() };
                let mut reprojector = backend.reprojector(Arc::new(decoded), &bounds).unwrap();
                let shown = error(&reprojector.raycast_with(&camera, &options).unwrap(), &truth);
                assert!(shown.max_abs_255 <= 1, "{at}: {shown:?}");
            }
        }
    }
}

#[test]
fn of_the_built_in_volumes() {
    let backends = backends();
    for name in ["builtin:cloud@64", "builtin:cubus@64", "builtin:shells@64"] {
        check(name, &backends);
    }
}

#[test]
fn of_the_scanned_volumes() {
    let Some(folder) = data_dir() else { return };
    let backends = backends();
    for name in ["engine", "bonsai", "avm", "t1_head", "heptane", "mouse_brain"] {
        check(folder.join(name).with_extension("nrrd").to_str().unwrap(), &backends);
    }
}

/// Every mode but the first, of volumes that fill their boxes and ones that do not. On the GPU of
/// one volume, as each mode is another kernel.
#[test]
fn of_the_other_modes() {
    let backends = backends();
    let mut sources = vec![("builtin:shells@64".to_owned(), &backends[..])];
    if let Some(folder) = data_dir() {
        let path = |name: &str| folder.join(name).with_extension("nrrd").to_str().unwrap().to_owned();
        sources.extend(["bonsai", "engine", "mouse_brain"].map(|name| (path(name), &backends[..1])));
    }
    for (source, backends) in sources {
        let (scene, transfer) = scene_of(&source);
        for (look, scene) in in_other_modes(&scene, &transfer) {
            check_scene(&format!("{source}, {look}"), &scene, backends);
        }
    }
}
