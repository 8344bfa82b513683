//! Threads that hold the parts of a volume make what one of them orders, give it up together, and share their light.

#![expect(clippy::unwrap_used, reason = "what a test cannot do without")]

mod common;

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use common::{camera, lit, look, served};
use isinglass_cluster::orders;
use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::cancel::ALWAYS;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::FrameHeader;
use isinglass_core::look::Look;
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Detail, GHOSTS, Lighting, Split, Volume};

fn greatest_difference(a: &Picture, b: &Picture) -> u8 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(x, y)| x.abs_diff(*y)).max().unwrap()
}

#[test]
fn what_is_ordered_is_what_one_process_shows_with_all_light() {
    let volume = Builtin::Cubus.volume(40);
    let bounds = volume.bounds();
    let iso = Isos::new(&[Iso { value: 90.0, opacity: 1.0 }]).unwrap();
    let thin = Isos::new(&[Iso { value: 60.0, opacity: 0.4 }, Iso { value: 140.0, opacity: 1.0 }]).unwrap();
    let first = look(0.9, Lighting::default());
    let looks = [
        first.clone(),
        look(0.9, lit()),
        Look { mode: Mode::Iso, isos: iso, ..look(0.5, lit()) },
        Look { mode: Mode::Iso, isos: thin, ..look(0.5, lit()) },
        Look { mode: Mode::Mip, ..look(0.5, lit()) },
        // One that was shown before.
        look(0.9, lit()),
    ];
    for layers in [[2, 1, 1], [1, 3, 2]] {
        let split = Split::grid(volume.dims(), layers).unwrap();
        let found = served(&volume, &split, &first, |orders, base, _| {
            let each = looks.iter().map(|look| {
                let scene = base.under(look, Detail::Final, None);
                assert!(scene.is_final());
                let camera = camera(&volume, 0.0);
                let frame = orders.generate(&scene, FrameHeader::alone(camera, 8), ALWAYS).unwrap();
                let frame = frame.gather().unwrap();
                let view = View::from(&camera);
                let rows = [0..31, 31..80].map(|rows| orders.render_rows(&scene, &view, rows).unwrap());
                let pixels = rows.into_iter().flat_map(|rows| rows.pixels).collect();
                (frame, Picture { pixels, ..Picture::new(96, 80) })
            });
            let found: Vec<_> = each.collect();
            orders.end();
            found
        });
        for (look, (frame, picture)) in looks.iter().zip(&found) {
            let scene = Scene::of_look(Arc::new(volume.clone()), look);
            let truth = render(&scene, &camera(&volume, 0.0));
            let off = greatest_difference(picture, &truth);
            assert!(off <= 1, "{layers:?} {:?}: a picture is {off}/255 off", look.mode);
            let off = greatest_difference(&raycast(frame, &bounds, &camera(&volume, 0.0)), &truth);
            assert!(off <= 1, "{layers:?} {:?}: a frame is {off}/255 off", look.mode);
        }
        // The controls: light is seen, and without that of other parts it would be another.
        assert!(greatest_difference(&found[0].1, &found[1].1) > 8);
        let half = volume.part(&split.held(0, GHOSTS)).unwrap();
        let alone = Volume::new(
            half.dims(),
            half.spacing(),
            half.voxels().clone(),
            half.value_map(),
            half.info.clone(),
        );
        let shares = |volume: Volume| {
            let scene = Scene::of_look(Arc::new(volume), &looks[1]);
            scene.illumination.lit().unwrap().shares.clone()
        };
        let (dims, alone, whole) = (half.dims(), shares(alone.unwrap()), shares(volume.clone()));
        let [ex, ey, ez] = split.boxes()[0].end.map(|n| n as usize);
        let [nx, ny] = [dims[0], dims[1]].map(|n| n as usize);
        let places = (0..ez).flat_map(|z| (0..ey).flat_map(move |y| (0..ex).map(move |x| (x, y, z))));
        let mut pairs = places.map(|(x, y, z)| (alone[(z * ny + y) * nx + x], whole[(z * 40 + y) * 40 + x]));
        assert!(pairs.any(|(alone, whole)| alone.abs_diff(whole) > 4), "a part alone has another light");
    }
}

#[test]
fn a_frame_is_given_up_by_all_and_the_next_one_is_made() {
    let volume = Builtin::Cloud.volume(48);
    let split = Split::evenly(volume.dims(), 3).unwrap();
    let first = look(0.5, Lighting::default());
    let (given_up, made, draft) = served(&volume, &split, &first, |orders, base, _| {
        let asked = AtomicU32::new(0);
        // It is wanted while it is ordered, and no longer soon after.
        let wanted = || asked.fetch_add(1, Ordering::Relaxed) < 1;
        let large =
            Camera::new(camera(&volume, 0.0).pose, Intrinsics::perspective(900, 700, 0.8), &volume.bounds());
        let given_up = orders.generate(base, FrameHeader::alone(large, 8), &wanted);
        let header = FrameHeader::alone(camera(&volume, 10.0), 8);
        let made = orders.generate(base, header, ALWAYS).and_then(|made| made.gather());
        // A light that is a draft says so, until its final one is asked for.
        let draft = base.under(&look(0.5, lit()), Detail::Draft, None);
        let shaded = orders.generate(&draft, header, ALWAYS).and_then(|made| made.gather());
        (given_up, made, (draft.is_final(), shaded))
    });
    assert!(given_up.is_none());
    let made = made.unwrap();
    made.validate().unwrap();
    let (is_final, shaded) = draft;
    assert!(!is_final && shaded.is_some_and(|shaded| shaded != made));
    // Nobody is left who can make anything.
    let (orders, queue) = orders();
    drop(queue);
    let scene = Scene::of_look(Arc::new(volume.clone()), &first);
    assert!(orders.generate(&scene, FrameHeader::alone(camera(&volume, 0.0), 8), ALWAYS).is_none());
}
