//! Is the picture of a layered frame from its own pose the full rendering from that pose? One table of volumes, looks and
//! cameras is checked on every backend, before and after the wire.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::codec::{Coding, decode};
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::FrameHeader;
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Histogram, Lighting, Volume, Voxels};
use isinglass_formats::{OpenOptions, default_preset, load_transfer, open};
use isinglass_render::{Backend, BackendChoice};
use isinglass_tests::{data_dir, twins};

const SIZE: Intrinsics = Intrinsics::perspective(72, 64, 0.6);

/// A row of the table.
struct Case {
    what: String,
    scene: Scene,
    camera: Camera,
    /// Segments per list.
    ks: &'static [u8],
    /// On the CPU alone, as each look is another kernel that a GPU's driver compiles.
    only_on_cpu: bool,
}

/// What of a volume is seen, and how.
type Look = (&'static str, TransferFunction, MarchSettings);

/// The looks of a volume: its own, and every other mode. Surfaces come alone, within a translucent one, and four deep.
fn looks(scene: &Scene, own: &TransferFunction) -> Vec<Look> {
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
    let (least, greatest) = scene.volume.value_range();
    let parting = scene.histogram.parting_value();
    let at = |part: f32, opacity| Iso { value: least + part * (parting - least), opacity };
    let beyond = Iso { value: parting + 0.2 * (greatest - parting), opacity: 0.5 };
    let two = Isos::new(&[at(0.5, 0.3), at(1.0, 1.0)]).unwrap();
    let four = Isos::new(&[at(0.5, 0.2), at(0.8, 0.4), at(1.0, 1.0), beyond]).unwrap();
    let with = |mode, isos| MarchSettings { mode, isos, ..scene.settings };
    let gloss = Lighting { specular: 0.8, shininess: 30.0, ..Lighting::default() };
    let shining = |mode, isos| MarchSettings { mode, isos, ..MarchSettings::of(true, gloss) };
    vec![
        ("composite", own.clone(), scene.settings),
        ("mip", own.clone(), with(Mode::Mip, Isos::default())),
        ("minip", of_the_least, with(Mode::MinIp, Isos::default())),
        ("average", own.clone(), with(Mode::Average, Isos::default())),
        ("iso", own.clone(), with(Mode::Iso, Isos::default())),
        ("two surfaces", own.clone(), with(Mode::Iso, two)),
        ("four surfaces", own.clone(), with(Mode::Iso, four)),
        ("highlights", own.clone(), shining(Mode::Composite, Isos::default())),
        ("shining surfaces", own.clone(), shining(Mode::Iso, two)),
    ]
}

/// Where a volume is seen from, with or without a clip.
fn views(bounds: &Aabb) -> Vec<(&'static str, Camera, Clip)> {
    let far = bounds.radius() * SIZE.fit_distance();
    let at = |azimuth: f32, distance: f32| {
        Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.35, distance), SIZE, bounds)
    };
    let inner = Aabb { min: bounds.min * 0.55, max: bounds.max * 0.3 };
    let plane = Plane::new(Vec3::new(0.3, 1.0, 0.6), 0.05 * bounds.radius());
    let mut views = vec![
        ("whole", at(0.5, far), Clip::default()),
        ("from the other side", at(2.4, far), Clip::default()),
        ("near", at(2.0, 1.3 * bounds.radius()), Clip::default()),
        ("inside", at(4.0, 0.25 * bounds.radius()), Clip::default()),
        ("parallel", at(0.3, far).to_orthographic(far, bounds), Clip::default()),
        ("parallel, from inside", at(4.0, 0.25 * far).to_orthographic(0.25 * far, bounds), Clip::default()),
    ];
    let box_and_plane = Clip { bounds: Some(inner), plane };
    let a_box = Clip { plane: None, ..box_and_plane };
    let a_plane = Clip { bounds: None, ..box_and_plane };
    for (of_perspective, of_parallel, clip) in [
        ("in a box", "in a box, parallel", a_box),
        ("cut by a plane", "cut by a plane, parallel", a_plane),
        ("in a box, cut by a plane", "in a box, cut by a plane, parallel", box_and_plane),
    ] {
        views.push((of_perspective, at(0.5, far), clip));
        views.push((of_parallel, at(0.5, far).to_orthographic(far, bounds), clip));
    }
    views
}

/// Bubbles over a ramp. Matter reaches all faces of the volume, and rays leave some of it just before they leave the box.
fn bubbles() -> Scene {
    const SIDE: u32 = 48;
    let voxels = (0..SIDE.pow(3)).map(|i| {
        let [x, y, z] = [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE].map(|n| n as f32);
        let wave = (x * 0.61).sin() * (y * 0.47).cos() + (z * 0.53).sin() * (x * 0.29).cos();
        ((wave + 2.0) * 50.0 + (x + y + z) * 0.3) as u8
    });
    let voxels = Voxels::U8(voxels.collect());
    let volume = Volume::new([SIDE; 3], Vec3::new(0.05, 0.06, 0.045), voxels, (1.0, 0.0), Default::default());
    twins::scene(volume.unwrap(), true, None)
}

/// The rows of a volume: its own look from everywhere, and each other look as a whole and from one more side.
fn rows(name: &str, scene: &Scene, own: &TransferFunction) -> Vec<Case> {
    let views = views(&scene.volume.bounds());
    let mut rows = Vec::new();
    for (i, (look, transfer, settings)) in looks(scene, own).into_iter().enumerate() {
        let is_own = i == 0;
        for (j, (view, camera, clip)) in views.iter().enumerate() {
            if is_own || j == 0 || j == i {
                rows.push(Case {
                    what: format!("{name}, {look}, {view}"),
                    scene: scene.with_look(&transfer, MarchSettings { clip: *clip, ..settings }),
                    camera: *camera,
                    ks: if is_own { &[1, 8, 32] } else { &[1, 4, 16] },
                    only_on_cpu: !name.starts_with("shells") || !is_own && j > 0,
                });
            }
        }
    }
    rows
}

/// Every voxel type, cubic and anisotropic, shaded and not, and a volume that fills its box.
fn table() -> Vec<Case> {
    let mut table = rows("bubbles", &bubbles(), &twins::transfer(true));
    for (name, scene) in twins::scenes() {
        table.extend(rows(name, &scene, &twins::transfer(name.contains("cloud"))));
    }
    table
}

/// Scanned volumes by their own presets. Three of them have all looks.
fn scanned() -> Vec<Case> {
    let Some(folder) = data_dir() else { return Vec::new() };
    let mut table = Vec::new();
    for name in ["engine", "bonsai", "avm", "t1_head", "heptane", "mouse_brain"] {
        let path = folder.join(name).with_extension("nrrd");
        let source = path.to_str().unwrap();
        let volume = open(source, &OpenOptions::default()).unwrap();
        let transfer = load_transfer(default_preset(source, &volume, &Histogram::of(&volume))).unwrap();
        let scene = Scene::new(Arc::new(volume), &transfer, MarchSettings::default());
        let has_all = ["engine", "bonsai", "mouse_brain"].contains(&name);
        let rows = rows(name, &scene, &transfer).into_iter().enumerate();
        let of_whole = rows.filter(|(i, case)| *i == 0 || has_all && case.what.ends_with("whole"));
        table.extend(of_whole.map(|(i, case)| Case { ks: &[8], only_on_cpu: i > 0, ..case }));
    }
    table
}

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

fn max_difference(a: &Picture, b: &Picture) -> u8 {
    let [a, b] = [a, b].map(|picture| picture.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

/// Half floats carry C and τ to 2^−11: less than half a step of 1/255.
const MOST: u8 = 1;

fn check(case: &Case, backend: &Backend) {
    let &Case { ref what, ref scene, camera, ks, .. } = case;
    let bounds = scene.volume.bounds();
    let options = CastOptions { clip: scene.settings.clip, ..CastOptions::default() };
    let mut renderer = backend.renderer(scene.clone()).unwrap();
    let truth = renderer.render(&camera).unwrap();
    if scene.settings.clip != Clip::default() {
        let whole = MarchSettings { clip: Clip::default(), ..scene.settings };
        let mut whole = backend.renderer(Scene { settings: whole, ..scene.clone() }).unwrap();
        let whole = max_difference(&whole.render(&camera).unwrap(), &truth);
        assert!(whole > 4 * MOST, "{what}: nothing is cut away, {whole}");
    }
    // A tenth of the volume's radius to the side.
    let mut beside = camera;
    beside.pose.eye += camera.pose.world_from_view * Vec3::X * 0.1 * bounds.radius();
    for k in ks {
        let at = format!("{what}, k = {k}, {}", backend.description());
        let frame = renderer.generate(FrameHeader::alone(camera, *k)).unwrap();
        frame.validate().unwrap_or_else(|e| panic!("{at}: {e}"));
        assert_eq!(frame.header.mode, scene.settings.mode, "{at}");
        let coding = Coding::default().for_mode(frame.header.mode);
        let (encoded, _) = coding.encode(&frame, None).unwrap();
        let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|chunk| &chunk.bytes[..]).collect();
        let decoded = decode(&chunks).unwrap();
        assert_eq!(decoded.header, frame.header, "{at}");
        assert!(coding.encode(&decoded, None).unwrap().0 == encoded, "{at}: codes are not found again");
        let flat = [&frame, &decoded].map(|frame| max_difference(&frame.flatten(), &truth));
        // As the viewer does, which cuts the frame once more by the clip.
        let cast = |frame, camera: &Camera| {
            let mut reprojector = backend.reprojector(Arc::new(frame), &bounds).unwrap();
            max_difference(&reprojector.raycast_with(camera, &options).unwrap(), &truth)
        };
        let found = [cast(frame.clone(), &camera), cast(decoded, &camera)];
        assert!(flat.into_iter().chain(found).all(|most| most <= MOST), "{at}: {flat:?}, {found:?}");
        // Negative control: another pose is another picture.
        let control = cast(frame, &beside);
        assert!(control > 4 * MOST, "{at}: a camera that moved shows the same, {control}");
    }
    // A frame with a margin around the same picture is as exact.
    let wide = Camera { intrinsics: camera.intrinsics.with_margin(16), ..camera };
    let wide = renderer.generate(FrameHeader::alone(wide, 8)).unwrap();
    let mut reprojector = backend.reprojector(Arc::new(wide), &bounds).unwrap();
    let found = max_difference(&reprojector.raycast_with(&camera, &options).unwrap(), &truth);
    assert!(found <= MOST, "{what}, {}, with a margin: {found}", backend.description());
}

fn check_all(table: &[Case]) {
    for backend in backends() {
        let is_cpu = matches!(backend, Backend::Cpu);
        for case in table.iter().filter(|case| is_cpu || !case.only_on_cpu) {
            check(case, &backend);
        }
    }
}

#[test]
fn of_the_table() {
    check_all(&table());
}

#[test]
fn of_the_scanned_volumes() {
    check_all(&scanned());
}
