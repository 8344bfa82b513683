//! What opaque surfaces are filled up with: their bodies, whichever side those lie on, and nothing beside.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::FrameHeader;
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Lighting, Volume, Voxels};

const SIDE: u32 = 48;

/// A sphere in the middle whose values are greater than 0, or lesser.
fn sphere(is_greater: bool) -> Arc<Volume> {
    let at = |i: u32| i as f32 + 0.5 - 0.5 * SIDE as f32;
    let value = |i: u32| 12.0 - Vec3::new(at(i % SIDE), at(i / SIDE % SIDE), at(i / SIDE / SIDE)).length();
    let voxels = (0..SIDE.pow(3)).map(|i| if is_greater { value(i) } else { -value(i) });
    let voxels = Voxels::F32(voxels.collect());
    Arc::new(Volume::new([SIDE; 3], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap())
}

/// The greater sphere, stored as numbers that fall where its values rise.
fn falling() -> Arc<Volume> {
    let sphere = sphere(true);
    let voxels = (0..sphere.voxels().len()).map(|i| -sphere.voxels().get(i)).collect();
    Arc::new(Volume::new([SIDE; 3], Vec3::ONE, Voxels::F32(voxels), (-1.0, 0.0), Default::default()).unwrap())
}

fn white() -> TransferFunction {
    let p = |x, opacity| ControlPoint { x, color: [1.0; 3], opacity };
    TransferFunction {
        name: "white".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![p(0.0, 0.5), p(1.0, 0.5)],
    }
}

fn scene(is_greater: bool, clip: Clip) -> Scene {
    scene_of(sphere(is_greater), clip)
}

fn scene_of(volume: Arc<Volume>, clip: Clip) -> Scene {
    let isos = Isos::new(&[Iso { value: 0.0, opacity: 1.0 }]).unwrap();
    let of = MarchSettings::of(true, Lighting::default());
    Scene::new(volume, &white(), MarchSettings { mode: Mode::Iso, isos, clip, ..of })
}

/// The share of the picture that a frame made from the front has otherwise than the renderer, seen from the side.
fn share_off(scene: &Scene, degrees: f32) -> f32 {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(120, 100, 0.6);
    let camera = |azimuth: f32| {
        let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.1, bounds.radius() * intrinsics.fit_distance());
        Camera::new(pose, intrinsics, &bounds)
    };
    let frame = generate(scene, FrameHeader::alone(camera(0.0), 8));
    let (to, srgb) = (camera(degrees.to_radians()), |p: &Picture| p.to_srgb8([0.0; 3]));
    let (seen, truth) = (srgb(&raycast(&frame, &bounds, &to)), srgb(&render(scene, &to)));
    // Half of white: a pixel that matter covers or not, not one whose shade differs.
    let is_off = |(a, b): (&[u8], &[u8])| a[0].abs_diff(b[0]) > 60;
    let num_off = seen.chunks_exact(3).zip(truth.chunks_exact(3)).filter(|&pair| is_off(pair)).count();
    num_off as f32 / (120.0 * 100.0)
}

#[test]
fn bodies_of_lesser_values_are_filled_as_those_of_greater_ones_and_leave_open_what_is_open() {
    let (greater, lesser) = (scene(true, Clip::default()), scene(false, Clip::default()));
    assert!(!greater.has_lesser_bodies && lesser.has_lesser_bodies);
    let filled_beside = Scene { has_lesser_bodies: false, ..lesser.clone() };
    let found = [&greater, &lesser, &filled_beside].map(|scene| share_off(scene, 20.0));
    // From its own side nothing tells them apart.
    let own = [&greater, &lesser, &filled_beside].map(|scene| share_off(scene, 0.0));
    assert_eq!(own, [0.0; 3]);
    assert!(found[0] < 0.005 && found[1] < 0.005, "{found:?}");
    // The control: what fills the open space behind the sphere is a shadow of matter beside it.
    assert!(found[2] > 0.02, "{found:?}");
}

#[test]
fn stored_numbers_that_fall_where_values_rise_change_nothing() {
    let (rising, falling) = (scene(true, Clip::default()), scene_of(falling(), Clip::default()));
    assert_eq!(falling.volume.value_range(), rising.volume.value_range());
    assert!(!falling.has_lesser_bodies);
    assert_eq!(share_off(&falling, 20.0), share_off(&rising, 20.0));
}

/// A core in a body in something else, of three values each: what a segmentation has.
#[test]
fn a_surface_of_a_value_holds_the_voxels_of_that_value() {
    let at = |i: u32| i as f32 + 0.5 - 12.0;
    let radius = |i: u32| Vec3::new(at(i % 24), at(i / 24 % 24), at(i / 576)).length();
    for [lo, body, core] in
        [[-1000, 40, 1200], [-1024, 300, 2000], [10, 50, 200], [1, 2, 3], [100, 1000, 4000]]
    {
        let stored = |i: u32| match radius(i) {
            r if r < 3.0 => core,
            r if r < 8.0 => body,
            _ => lo,
        };
        let voxels = (0..24 * 24 * 24).map(|i| (stored(i) + 32768) as u16).collect();
        let volume =
            Volume::new([24; 3], Vec3::ONE, Voxels::U16(voxels), (1.0, -32768.0), Default::default());
        let volume = Arc::new(volume.unwrap());
        let mean = |value: f32| {
            let isos = Isos::new(&[Iso { value, opacity: 1.0 }]).unwrap();
            let settings =
                MarchSettings { mode: Mode::Iso, isos, ..MarchSettings::of(true, Lighting::default()) };
            let scene = Scene::new(volume.clone(), &white(), settings);
            let bounds = volume.bounds();
            let intrinsics = Intrinsics::perspective(40, 40, 0.6);
            let pose = Pose::orbit(Vec3::ZERO, 0.4, 0.3, bounds.radius() * intrinsics.fit_distance());
            let rgb = render(&scene, &Camera::new(pose, intrinsics, &bounds)).to_srgb8([0.0; 3]);
            rgb.iter().map(|&v| f32::from(v)).sum::<f32>() / rgb.len() as f32
        };
        let [below, on, above] = [-0.05, 0.0, 0.05].map(|by| mean(body as f32 + by));
        assert!((on - below).abs() < 0.05 * on, "{lo} {body} {core}: {below} {on} {above}");
        // Negative control: the core is much smaller.
        assert!(above < 0.5 * on, "{lo} {body} {core}: {below} {on} {above}");
    }
}

#[test]
fn bodies_are_those_of_what_is_left_of_a_volume() {
    // Inside of the sphere all around is greater.
    let bounds = Some(Aabb { min: Vec3::splat(-5.0), max: Vec3::splat(5.0) });
    let inside = Clip { bounds, ..Clip::default() };
    assert!(scene(true, inside).has_lesser_bodies && !scene(false, inside).has_lesser_bodies);
    let whole = scene(true, Clip::default());
    let clipped = whole.with_look(&white(), MarchSettings { clip: inside, ..whole.settings });
    assert!(clipped.has_lesser_bodies, "another clip is another look");
}

#[test]
fn a_plane_and_a_box_that_leave_the_same_leave_the_same_bodies() {
    // Greater from voxel 28 of 48 on: less than half of the faces of the whole, more of those from voxel 20 on.
    let voxels = (0..SIDE.pow(3)).map(|i| (i % SIDE) as f32 - 27.5);
    let voxels = Voxels::F32(voxels.collect());
    let volume = Arc::new(Volume::new([SIDE; 3], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap());
    let is_lesser = |clip: Clip| scene_of(volume.clone(), clip).has_lesser_bodies;
    let whole = volume.bounds();
    let (mut right, mut left) = (whole, whole);
    (right.min.x, left.max.x) = (-4.0, 16.0);
    let boxed = |bounds| is_lesser(Clip { bounds: Some(bounds), plane: None });
    let cut = |to: Vec3, d: f32| is_lesser(Clip { plane: Plane::new(to, d), bounds: None });
    assert_eq!([is_lesser(Clip::default()), boxed(right), boxed(left)], [false, true, false]);
    assert_eq!([cut(Vec3::X, -4.0), cut(Vec3::NEG_X, -16.0)], [true, false]);
    // Askew: the cut shows greater values nearly alone, or next to none.
    let askew = Vec3::new(1.0, 0.2, -0.1);
    assert_eq!([cut(askew, 5.0), cut(-askew, -5.0), cut(askew, -20.0)], [true, false, false]);
}
