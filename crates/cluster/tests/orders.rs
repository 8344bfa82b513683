//! Threads that hold the parts of a volume make what one of them orders, give it up together, and share their light.

#![expect(clippy::unwrap_used, reason = "what a test cannot do without")]

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use glam::Vec3;
use isinglass_cluster::{Cluster, Exchange, InProcess, OrderQueue, Orders, in_whole, orders};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::cancel::ALWAYS;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::FrameHeader;
use isinglass_core::look::Look;
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Detail, GHOSTS, Lighting, Split, Volume};

fn look(opacity: f32, lighting: Lighting) -> Look {
    let point = |x, color, opacity| ControlPoint { x, color, opacity };
    let transfer = TransferFunction {
        name: "step".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Radius(0.1),
        points: vec![
            point(0.0, [0.2, 0.4, 1.0], 0.0),
            point(0.3, [1.0, 0.8, 0.3], 0.0),
            point(1.0, [1.0; 3], opacity),
        ],
    };
    Look { lighting, ..Look::new(transfer) }
}

fn lit() -> Lighting {
    Lighting { ambient_occlusion: 0.9, shadows: 0.8, ..Lighting::default() }
}

fn camera(volume: &Volume, degrees: f32) -> Camera {
    let bounds = volume.bounds();
    let pose = Pose::orbit(Vec3::ZERO, 0.5 + degrees.to_radians(), 0.35, 2.6 * bounds.radius());
    Camera::new(pose, Intrinsics::perspective(96, 80, 0.8), &bounds)
}

fn greatest_difference(a: &Picture, b: &Picture) -> u8 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(x, y)| x.abs_diff(*y)).max().unwrap()
}

/// Process 0 works on the orders that `serve` gives with the scene of its part. Each process has a thread.
fn served<R: Send>(
    volume: &Volume,
    split: &Split,
    look: &Look,
    serve: impl FnOnce(Orders, &Scene) -> R + Send,
) -> R {
    let part = |exchange: &InProcess| {
        let rank = exchange.rank();
        let (own, held) = (split.boxes()[rank], split.held(rank, GHOSTS));
        let part = volume.part(&held).unwrap();
        let part = in_whole(exchange, part, &own, &held, volume.dims(), None).unwrap();
        Scene::of_look(Arc::new(part), look)
    };
    let mut all = InProcess::all(split.boxes().len()).into_iter();
    let first = all.next().unwrap();
    let (orders, queue): (Orders, OrderQueue) = orders();
    std::thread::scope(|scope| {
        for exchange in all {
            let part = &part;
            scope.spawn(move || {
                let base = part(&exchange);
                Cluster::new(&exchange, split.clone()).help(&base).unwrap();
            });
        }
        let base = part(&first);
        let own = base.clone();
        let serving = scope.spawn(move || serve(orders, &own));
        Cluster::new(&first, split.clone()).work_on(queue).unwrap();
        serving.join().unwrap()
    })
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
        let found = served(&volume, &split, &first, |orders, base| {
            let each = looks.iter().map(|look| {
                let scene = base.under(look, Detail::Final, None);
                assert!(scene.is_final());
                let camera = camera(&volume, 0.0);
                let frame = orders.generate(&scene, FrameHeader::alone(camera, 8), ALWAYS).unwrap();
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
    let (given_up, made, draft) = served(&volume, &split, &first, |orders, base| {
        let asked = AtomicU32::new(0);
        // It is wanted while it is ordered, and no longer soon after.
        let wanted = || asked.fetch_add(1, Ordering::Relaxed) < 1;
        let large =
            Camera::new(camera(&volume, 0.0).pose, Intrinsics::perspective(900, 700, 0.8), &volume.bounds());
        let given_up = orders.generate(base, FrameHeader::alone(large, 8), &wanted);
        let header = FrameHeader::alone(camera(&volume, 10.0), 8);
        let made = orders.generate(base, header, ALWAYS);
        // A light that is a draft says so, until its final one is asked for.
        let draft = base.under(&look(0.5, lit()), Detail::Draft, None);
        let shaded = orders.generate(&draft, header, ALWAYS);
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
