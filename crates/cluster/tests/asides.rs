//! Threads that hold the parts of a volume code a frame as one that has all of it does. They cut slices and find values
//! as one does, also while they make a frame.

#![expect(clippy::unwrap_used, reason = "what a test cannot do without")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use std::sync::atomic::{AtomicBool, Ordering};

use common::{camera, look, served};
use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::cancel::ALWAYS;
use isinglass_core::codec::blocks::Settings;
use isinglass_core::codec::{CodecError, Coding};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::look::Look;
use isinglass_core::mode::Mode;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{
    AskedPoints, Detail, Lighting, SlabMode, Slice, SlicePlane, SliceSpec, Split, ValuesAt, Volume,
};

/// A camera with a picture of several bands.
fn tall(volume: &Volume, degrees: f32) -> Camera {
    Camera::new(camera(volume, degrees).pose, Intrinsics::perspective(160, 270, 0.8), &volume.bounds())
}

#[test]
fn frames_are_coded_where_their_rows_are_as_one_process_codes_them() {
    let volume = Builtin::Cubus.volume(48);
    let first = look(0.7, Lighting::default());
    let blocks =
        |quality, turn_deg| Coding::Blocks(Settings { max_bands: 8, turn_deg, ..Settings::of(quality) });
    for layers in [[2, 1, 1], [1, 3, 1], [3, 2, 2]] {
        let split = Split::grid(volume.dims(), layers).unwrap();
        served(&volume, &split, &first, |orders, base, come| {
            let mut last = None;
            // The camera moves, and rests at the end.
            for (n, degrees) in [0.0, 2.0, 4.0, 4.0].into_iter().enumerate() {
                let made = orders.generate(base, FrameHeader::alone(tall(&volume, degrees), 8), ALWAYS);
                let made = made.unwrap();
                let before = come.load(Ordering::Relaxed);
                let whole = made.gather().unwrap();
                let of_gathering = come.load(Ordering::Relaxed) - before;
                assert_eq!(made.num_segments(), whole.num_segments());
                let (frame, pose) = (FrameId(n as u32 + 5), PoseId(n as u32 + 70));
                let header = FrameHeader { frame, pose, look: LookVersion(3), ..*made.header() };
                let whole = LayeredFrame { header, ..whole };
                for coding in [Coding::Exact, blocks(70, None), blocks(85, Some(3))] {
                    let before = come.load(Ordering::Relaxed);
                    let (found, reference) = made.encode(&header, coding, false, last.as_ref()).unwrap();
                    let of_coding = come.load(Ordering::Relaxed) - before;
                    let before = last.as_deref().filter(|_| coding != Coding::Exact);
                    let (expected, expected_reference) = coding.encode(&whole, before).unwrap();
                    assert_eq!(found, expected, "{layers:?} {coding:?} {n}");
                    assert_eq!(reference, expected_reference);
                    assert!(found.chunks.len() >= 4);
                    // Process 0 gets the rows that it codes itself, and bytes.
                    assert!(of_coding < of_gathering, "{layers:?} {coding:?}: {of_coding} of {of_gathering}");
                    if reference.is_some() {
                        last = reference;
                    }
                }
            }
            // A reference that they have not coded is refused, and nobody fails.
            let made = orders.generate(base, FrameHeader::alone(tall(&volume, 0.0), 8), ALWAYS).unwrap();
            let other = blocks(70, None).encode(&made.gather().unwrap(), None).unwrap().1;
            let refused = made.encode(made.header(), blocks(70, None), false, other.as_ref());
            assert!(matches!(refused, Err(CodecError::Reference { .. })));
            orders.end();
        });
    }
}

#[test]
fn frames_of_greatest_values_are_coded_thinned_too() {
    let volume = Builtin::Cubus.volume(48);
    let greatest = Look { mode: Mode::Mip, ..look(0.7, Lighting::default()) };
    let split = Split::grid(volume.dims(), [1, 1, 3]).unwrap();
    served(&volume, &split, &greatest, |orders, base, _| {
        let scene = base.under(&greatest, Detail::Final, None);
        let made = orders.generate(&scene, FrameHeader::alone(tall(&volume, 1.0), 8), ALWAYS).unwrap();
        let whole = made.gather().unwrap();
        let coded = |is_thinned| made.encode(made.header(), Coding::Exact, is_thinned, None).unwrap().0;
        let expected = |frame: &LayeredFrame| Coding::Exact.encode(frame, None).unwrap().0;
        assert_eq!(coded(true), expected(&whole.thinned()));
        assert_eq!(coded(false), expected(&whole));
        assert!(coded(true) != coded(false), "control: a thinned frame is another");
        let refused = made.encode(made.header(), Coding::Blocks(Settings::of(50)), false, None);
        assert_eq!(refused.unwrap_err(), CodecError::Projection(Mode::Mip));
        orders.end();
    });
}

#[test]
fn slices_and_values_are_those_of_the_whole_also_while_a_frame_is_made() {
    let volume = Builtin::Shells.volume(40);
    let first = look(0.7, Lighting::default());
    let split = Split::evenly(volume.dims(), 3).unwrap();
    let step = volume.spacing().min_element();
    let oblique = SlicePlane::Oblique {
        origin: [-12.0 * step; 3],
        column: [step * 0.8, step * 0.6, 0.0],
        row: [0.0, 0.0, step],
        size: [30, 24],
    };
    let planes = [0, 1, 2].map(|axis| SlicePlane::Axis { axis, index: 19 });
    let of_plane = |plane| SliceSpec { plane, thickness: 3.0 * step, mode: SlabMode::Mean };
    let specs: Vec<SliceSpec> = planes.into_iter().chain([oblique]).map(of_plane).collect();
    let line = |values: &mut dyn ValuesAt| -> Vec<_> {
        let ends = [volume.bounds().min, volume.bounds().max].map(|end| end * 1.01);
        let point = |i: u32| ends[0].lerp(ends[1], i as f32 / 30.0) + Vec3::X * 0.3 * step;
        (0..31).map(|i| (values.voxel(point(i)), values.between(point(i)))).collect()
    };
    served(&volume, &split, &first, |orders, base, _| {
        let ask = || {
            for spec in &specs {
                let found = orders.slice(*spec).unwrap();
                assert_eq!(Some(&found), Slice::of(&volume, spec, ALWAYS).as_ref());
                // The control: the part of process 0 has less.
                assert!(Some(found) != Slice::of(base.whole(), spec, ALWAYS));
            }
            let mut asked = AskedPoints::default();
            line(&mut asked);
            let found = line(&mut orders.values(asked).unwrap());
            assert_eq!(found, line(&mut &volume));
            assert!(found != line(&mut &**base.whole()), "control: process 0 has a part");
        };
        ask();
        // A large frame is made until they have answered, so they answer before it is there.
        let is_answered = AtomicBool::new(false);
        let large = Intrinsics::perspective(2000, 1500, 0.8);
        let header = FrameHeader::alone(Camera::new(camera(&volume, 0.0).pose, large, &volume.bounds()), 8);
        let wanted = || !is_answered.load(Ordering::Relaxed);
        std::thread::scope(|scope| {
            let making = scope.spawn(|| orders.generate(base, header, &wanted));
            ask();
            is_answered.store(true, Ordering::Relaxed);
            assert!(making.join().unwrap().is_none(), "the frame was there before the answers");
        });
        orders.end();
    });
}
