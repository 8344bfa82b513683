//! Giving up, and the way of a [`Rule`] that is brought.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::Vec3;

use super::*;
use crate::camera::{Camera, Intrinsics, Pose};
use crate::kernels::march::{MarchSettings, render};
use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use crate::volume::procedural::Builtin;

fn scene_and_header() -> (Scene, FrameHeader) {
    let point = |x, opacity| ControlPoint { x, color: [1.0, 0.7, 0.3], opacity };
    let transfer = TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![point(0.1, 0.0), point(1.0, 0.5)],
    };
    let scene = Scene::new(Arc::new(Builtin::Shells.volume(24)), &transfer, MarchSettings::default());
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(64, 48, 0.6);
    let pose = Pose::orbit(Vec3::ZERO, 0.4, 0.2, bounds.radius() * intrinsics.fit_distance());
    let header = FrameHeader::alone(Camera::new(pose, intrinsics, &bounds), 8);
    (scene, header)
}

/// Counts how often the march asks: once a row, and once when no row is left. When the answer is no, at most the rows that are under way are
/// finished.
#[test]
fn a_frame_that_is_given_up_is_left_at_the_next_row() {
    let (scene, header) = scene_and_header();
    let asked = AtomicUsize::new(0);
    let generate = |times: usize| {
        asked.store(0, Ordering::Relaxed);
        let wanted = || asked.fetch_add(1, Ordering::Relaxed) < times;
        generate_while(&scene, header, &mut Budget::default(), &wanted)
    };
    assert_eq!(generate(usize::MAX), Some(super::generate(&scene, header)));
    let threads = rayon::current_num_threads();
    let num = asked.load(Ordering::Relaxed);
    assert!((48..=48 + threads).contains(&num), "{num}");
    assert_eq!(generate(5), None);
    assert!(asked.load(Ordering::Relaxed) <= 5 + 2 * threads.max(8), "{asked:?} rows were begun");
}

/// Everything of a ray as one segment.
struct One;

impl Rule for One {
    fn list<T: Texels>(&self, ray: &Listing<'_, T>, k: usize, list: &mut SegmentList) {
        assert_eq!(k, 8);
        ray.list(1, f32::INFINITY, list);
    }
}

#[test]
fn a_rule_that_is_brought_makes_the_lists() {
    let (scene, header) = scene_and_header();
    let frame = generate_by(&scene, header, &One, ALWAYS).unwrap();
    frame.validate().unwrap();
    assert_eq!(frame.header, header);
    assert!(frame.num_filled() > 500 && frame.num_segments() == frame.num_filled());
    let difference = |frame: &LayeredFrame| {
        let (a, b) = (frame.flatten(), render(&scene, &header.camera));
        let apart = |(a, b): (&[f32; 4], &[f32; 4])| (0..4).map(|i| (a[i] - b[i]).abs()).fold(0.0, f32::max);
        a.pixels.iter().zip(&b.pixels).map(apart).fold(0.0, f32::max)
    };
    // Half floats carry colour to 2^−11.
    assert!(difference(&frame) < 2e-3, "{}", difference(&frame));
    // Negative control: without a segment a pixel differs.
    let mut dark = frame.clone();
    dark.c_rg.iter_mut().for_each(|c| *c = 0);
    assert!(difference(&dark) > 0.1);
}

#[test]
fn a_frame_in_pieces_is_the_frame_and_stops_at_its_limit() {
    let (scene, header) = scene_and_header();
    let whole = generate(&scene, header);
    let mut frame = UnfinishedFrame::new(&scene, header);
    let (mut budget, mut num_pieces) = (Budget::default(), 1);
    while frame.advance(&scene, &budget, whole.num_segments(), &|| false) == Making::Unfinished {
        num_pieces += 1;
        // Another frame between two pieces changes nothing.
        generate_while(&scene, FrameHeader { k: 3, ..header }, &mut budget, ALWAYS).unwrap();
    }
    assert_eq!(num_pieces, 48, "each piece has one row");
    assert_eq!(frame.expected_segments(), whole.num_segments());
    assert_eq!(frame.finish(&mut budget), whole);
    // A smaller limit ends it long before all rows are there.
    let mut frame = UnfinishedFrame::new(&scene, header);
    let limit = whole.num_segments() / 4;
    assert_eq!(frame.advance(&scene, &Budget::default(), limit, ALWAYS), Making::TooLarge);
    assert!(frame.expected_segments() > limit, "{}", frame.expected_segments());
    assert!(frame.finish(&mut budget).num_segments() < whole.num_segments() * 3 / 4);
}
