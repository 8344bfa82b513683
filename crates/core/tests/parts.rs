//! A volume in parts shows what the whole one shows: at the frame's own pose to 1/255, and in novel views with the same
//! error.

#![expect(clippy::unwrap_used, reason = "what a test cannot do without")]

#[path = "common/frames.rs"]
mod frames;
#[path = "common/parts.rs"]
mod parts;

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::kernels::layering::parts::{frame_from_words, frame_of_rows, unite, words_from_rows};
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::kernels::{PartsError, rows_of};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Finest, GHOSTS, Lighting, Split, Volume};

use self::frames::{frame_of, max_difference};
use self::parts::Parts;

fn transfer() -> TransferFunction {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    TransferFunction {
        name: "test".into(),
        domain: Domain::Percentiles(1.0, 99.9),
        unit_length: UnitLength::Radius(0.02),
        points: vec![
            p(0.0, [0.1, 0.2, 0.9], 0.0),
            p(0.2, [0.2, 0.8, 0.5], 0.05),
            p(0.8, [0.9, 0.6, 0.2], 0.5),
            p(1.0, [1.0, 1.0, 0.9], 0.9),
        ],
    }
}

/// One way to look at a volume.
struct View {
    name: &'static str,
    volume: Volume,
    settings: MarchSettings,
    distance: f32,
    is_orthographic: bool,
}

impl View {
    fn scene(&self) -> Scene {
        Scene::new(Arc::new(self.volume.clone()), &transfer(), self.settings)
    }

    /// The camera, turned by some degrees around the volume.
    fn camera(&self, degrees: f32) -> Camera {
        let bounds = self.volume.bounds();
        let pose = Pose::orbit(Vec3::ZERO, 0.5 + degrees.to_radians(), 0.35, self.distance * bounds.radius());
        let camera = Camera::new(pose, Intrinsics::perspective(44, 36, 0.8), &bounds);
        if self.is_orthographic {
            camera.to_orthographic(self.distance * bounds.radius(), &bounds)
        } else {
            camera
        }
    }
}

fn stretched(builtin: Builtin, spacing: Vec3) -> Volume {
    let cube = builtin.volume(48);
    Volume::new([48; 3], spacing, cube.voxels().clone(), cube.value_map(), cube.info.clone()).unwrap()
}

fn views() -> Vec<View> {
    let unit = Vec3::splat(2.0 / 48.0);
    let shaded = MarchSettings::of(true, Lighting::default());
    let glossy = MarchSettings::of(true, Lighting { specular: 0.8, ..Lighting::default() });
    let flat = MarchSettings::of(false, Lighting::default());
    let inner = Aabb { min: Vec3::new(-0.6, -0.5, -0.7), max: Vec3::new(0.45, 0.62, 0.3) };
    let clip = Clip { bounds: Some(inner), plane: Plane::new(Vec3::new(0.4, 1.0, -0.7), 0.1) };
    let view = |name, builtin, spacing, settings, distance, is_orthographic| View {
        name,
        volume: stretched(builtin, spacing),
        settings,
        distance,
        is_orthographic,
    };
    let iso = |value, opacity| Isos::new(&[Iso { value, opacity }]).unwrap();
    let two = Isos::new(&[Iso { value: 60.0, opacity: 0.4 }, Iso { value: 140.0, opacity: 1.0 }]).unwrap();
    let long = unit * Vec3::new(1.0, 0.7, 1.9);
    let finest = Finest {
        dims: [95, 48, 190],
        spacing: unit / Vec3::new(2.0, 1.0, 4.0),
        first: Vec3::new(0.5, 0.0, 1.5),
        stored_range: None,
        histogram: None,
    };
    let level = stretched(Builtin::Cloud, unit).with_finest(finest);
    vec![
        view("shaded", Builtin::Cloud, unit, shaded, 2.6, false),
        view("glossy", Builtin::Cubus, unit, glossy, 2.6, false),
        view("flat and stretched", Builtin::Shells, long, flat, 2.4, false),
        View { volume: level, ..view("a level of a pyramid", Builtin::Cloud, unit, shaded, 2.6, false) },
        view("orthographic", Builtin::Shells, unit, shaded, 2.6, true),
        view("from inside", Builtin::Cloud, unit, shaded, 0.3, false),
        view("clipped", Builtin::Cubus, unit, MarchSettings { clip, ..shaded }, 2.6, false),
        view("greatest", Builtin::Cloud, long, MarchSettings { mode: Mode::Mip, ..shaded }, 2.6, false),
        view("least", Builtin::Cubus, unit, MarchSettings { mode: Mode::MinIp, clip, ..shaded }, 2.6, false),
        view("mean", Builtin::Cloud, unit, MarchSettings { mode: Mode::Average, ..shaded }, 2.6, true),
        view(
            "surface",
            Builtin::Cloud,
            unit,
            MarchSettings { mode: Mode::Iso, isos: iso(90.0, 1.0), ..shaded },
            2.6,
            false,
        ),
        view(
            "surfaces",
            Builtin::Shells,
            long,
            MarchSettings { mode: Mode::Iso, isos: two, clip, ..glossy },
            2.6,
            false,
        ),
        view(
            "surface from inside",
            Builtin::Cloud,
            unit,
            MarchSettings { mode: Mode::Iso, isos: iso(60.0, 0.5), ..shaded },
            0.3,
            false,
        ),
    ]
}

fn psnr(a: &Picture, b: &Picture) -> f64 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    let sum: f64 = a.iter().zip(&b).map(|(x, y)| f64::from(x.abs_diff(*y)).powi(2)).sum();
    10.0 * (255.0f64.powi(2) / (sum / a.len() as f64).max(1e-3)).log10()
}

/// The error of a frame's novel view, in decibels.
fn novel(view: &View, scene: &Scene, frame: &LayeredFrame, degrees: f32) -> f64 {
    let camera = view.camera(degrees);
    psnr(&raycast(frame, &view.volume.bounds(), &camera), &render(scene, &camera))
}

#[test]
fn every_split_shows_the_picture_of_the_whole() {
    for view in views() {
        let (scene, camera) = (view.scene(), view.camera(0.0));
        let bounds = view.volume.bounds();
        let truth = render(&scene, &camera);
        let single = frame_of(&scene, camera, 8);
        let errors = [10.0, 30.0].map(|degrees| novel(&view, &scene, &single, degrees));
        // Small pictures: on scans at usual sizes the margins are .1 and .3 dB. From inside, half of a turned picture
        // lies beyond the frame, and errors go either way.
        let margins = if view.distance < 1.0 { [1.5, 1.5] } else { [0.25, 0.5] };
        for layers in (0..27).map(|i| [i % 3 + 1, i / 3 % 3 + 1, i / 9 + 1]) {
            let split = Split::grid([48; 3], layers).unwrap();
            let parts = Parts::of(&view.volume, split, &transfer(), view.settings, GHOSTS);
            let frame = parts.frame(FrameHeader::alone(camera, 8));
            let off = max_difference(&raycast(&frame, &bounds, &camera), &truth);
            assert!(off <= 1, "{} {layers:?}: {off}/255 off at its own pose", view.name);
            let spent = frame.num_segments() as f32 / single.num_segments() as f32;
            assert!((0.8..1.25).contains(&spent), "{} {layers:?}: {spent} times the segments", view.name);
            for ((degrees, margin), of_single) in [10.0, 30.0].into_iter().zip(margins).zip(errors) {
                let found = novel(&view, &scene, &frame, degrees);
                let text =
                    format!("{} {layers:?}: {found:.2} dB at {degrees}, {of_single:.2} of one", view.name);
                assert!(found > of_single - margin, "{text}");
            }
        }
    }
}

#[test]
fn a_picture_of_parts_lacks_what_one_does_not_send() {
    let view = &views()[0];
    let split = Split::grid([48; 3], [2, 1, 1]).unwrap();
    let parts = Parts::of(&view.volume, split, &transfer(), view.settings, GHOSTS);
    let camera = view.camera(0.0);
    let frame = parts.asked(FrameHeader::alone(camera, 8));
    let rows = rows_of(0, 1, 36);
    let lists = parts.pieces(&frame, &rows);
    let all = |lists: &[Vec<u32>]| unite(&parts.scenes[0], &parts.split, &frame, &rows, lists);
    let segments = |rows: Vec<LayeredFrame>| rows.iter().map(LayeredFrame::num_segments).sum::<usize>();
    let whole = segments(all(&lists).unwrap());
    // Empty rows are one word each.
    let without = [lists[0].clone(), vec![0; 36]];
    assert!(segments(all(&without).unwrap()) < whole);
    // What is wrong is an error and not another picture.
    assert_eq!(all(&lists[..1]).unwrap_err(), PartsError::Processes { found: 1, expected: 2 });
    let short = [lists[0].clone(), lists[1][..lists[1].len() - 1].to_vec()];
    assert!(matches!(all(&short), Err(PartsError::Words { rank: 1, .. })));
    let swapped = [lists[1].clone(), lists[0].clone()];
    assert!(matches!(all(&swapped), Err(PartsError::Stray { .. })), "each ray meets other parts");
    // Rows of lists, too.
    let made = frame_of_rows(&frame, &rows, all(&lists).unwrap());
    let words = words_from_rows(&made, &rows);
    let read = |words: &[u32]| frame_from_words(made.header, std::slice::from_ref(&rows), &[words.to_vec()]);
    assert_eq!(read(&words).unwrap(), made);
    assert!(matches!(read(&words[..7]), Err(PartsError::Words { rank: 0, .. })));
    assert!(matches!(read(&[&words[..], &[0]].concat()), Err(PartsError::Words { rank: 0, .. })));
    let mut wrong = words.clone();
    wrong[0] = u32::MAX;
    assert_eq!(read(&wrong).unwrap_err(), PartsError::Lists { rank: 0, row: 0 });
}
