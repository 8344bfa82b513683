//! Does a server answer what a viewer asks beside frames: shade that is worked out at rest, values at points, pictures to keep, slices?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::cancel::ALWAYS;
use isinglass_core::ids::{LookVersion, ScreenshotId};
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::session::screenshot::ReceivedScreenshot;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Lighting, SlabMode, Slice, SlicePlane, SliceSpec, Volume};
use isinglass_formats::{load_transfer, png};
use isinglass_net::{Client, ClientOptions};
use isinglass_render::Backend;
use isinglass_server::{RunningServer, ServeOptions, Timing, start};
use tokio::runtime::Runtime;

const SIZE: Intrinsics = Intrinsics::perspective(64, 48, 0.6);

fn runtime() -> Runtime {
    tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap()
}

fn look() -> Look {
    Look::new(load_transfer("shells").unwrap())
}

fn serve(runtime: &Runtime, volume: &Arc<Volume>) -> RunningServer {
    let options = ServeOptions {
        volume: volume.clone(),
        look: look(),
        devices: Backend::Cpu.into(),
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
        plan: CodingPlan::EXACT,
        library: None,
        max_viewers: 4,
        frame_memory: 1 << 30,
        timing: Timing::default(),
    };
    runtime.block_on(async { start(options).unwrap() })
}

fn connect(runtime: &Runtime, server: &RunningServer) -> Client {
    let link = runtime.block_on(server.mint_link(None)).unwrap();
    Client::connect(&link, ClientOptions::default()).unwrap()
}

/// Asks again and again, for a minute at most.
fn wait_for<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let patience = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(found) = ask() {
            return found;
        }
        assert!(Instant::now() < patience, "{what} never came");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn pose(azimuth: f32) -> Pose {
    let bounds = Builtin::Shells.volume(48).bounds();
    Pose::orbit(Vec3::ZERO, azimuth, 0.3, bounds.radius() * SIZE.fit_distance())
}

const SHADED: Lighting = Lighting {
    ambient_occlusion: 0.8,
    occlusion_radius: 0.2,
    shadows: 0.7,
    softness_degrees: 6.0,
    azimuth_degrees: 30.0,
    elevation_degrees: 50.0,
    specular: 0.4,
    shininess: 30.0,
};

/// What `render` writes for the same camera, look and background.
fn file(volume: &Arc<Volume>, look: &Look, camera: &Camera, background: [u8; 3]) -> Vec<u8> {
    let scene = Scene::new(volume.clone(), &look.transfer, look.march_settings());
    let linear = background.map(|c| isinglass_core::picture::linear_from_srgb(f32::from(c) / 255.0));
    let srgb = render(&scene, camera).to_srgb8(linear);
    png::encode(camera.intrinsics.width, camera.intrinsics.height, &srgb).unwrap()
}

#[test]
fn a_draft_of_the_shade_is_called_one_and_the_rest_has_all_of_it() {
    let runtime = runtime();
    let volume = Arc::new(Builtin::Shells.volume(72));
    let server = serve(&runtime, &volume);
    let client = connect(&runtime, &server);
    client.set_pose(pose(0.4), SIZE);
    wait_for("the first frame", || client.latest_frame());
    assert!(!client.talk().look.is_draft());
    let shaded = Look { lighting: SHADED, ..look() };
    client.set_look(shaded.clone()).unwrap();
    let first = wait_for("the new look", || client.talk().look.in_force().filter(|(_, l)| **l == shaded)).0;
    // Once the final is there, frames have its number.
    let last = wait_for("all of the shade", || {
        let talk = client.talk();
        talk.look.in_force().filter(|_| !talk.look.is_draft())
    })
    .0;
    assert!(last > first, "{last} after {first}: the draft has a number of its own");
    let with_version =
        |version: LookVersion| client.latest_frame().filter(|f| f.frame.header.look == version);
    let shown = wait_for("the frame with all of the shade", || with_version(last));
    let header = shown.frame.header;
    let made = |lighting: Lighting| {
        let look = Look { lighting, ..shaded.clone() };
        let scene = Scene::new(volume.clone(), &look.transfer, look.march_settings());
        isinglass_core::kernels::layering::generate(&scene, header).flatten().to_srgb8([0.0; 3])
    };
    let ours = shown.frame.flatten().to_srgb8([0.0; 3]);
    let off = |other: Vec<u8>| ours.iter().zip(&other).map(|(a, b)| u32::from(a.abs_diff(*b))).sum::<u32>();
    // What the exact coding rounds is far below what the shade changes.
    let (same, bare) =
        (off(made(SHADED)), off(made(Lighting { ambient_occlusion: 0.0, shadows: 0.0, ..SHADED })));
    assert!(same * 20 < bare, "{same} against {bare} without shade");
    // A look whose shade is there already is never a draft, nor is one without any.
    for known in [look(), shaded.clone()] {
        client.set_look(known.clone()).unwrap();
        let version =
            wait_for("a look from before", || client.talk().look.in_force().filter(|(_, l)| **l == known)).0;
        assert!(!client.talk().look.is_draft());
        wait_for("its frame", || with_version(version));
        assert!(!client.talk().look.is_draft());
    }
    runtime.block_on(server.close());
}

#[test]
fn a_probe_tells_the_voxel_and_the_newest_question_wins() {
    let runtime = runtime();
    let volume = Arc::new(Builtin::Cloud.volume(24));
    let server = serve(&runtime, &volume);
    let (one, other) = (connect(&runtime, &server), connect(&runtime, &server));
    let center = |[x, y, z]: [u32; 3]| {
        volume.bounds().min + (Vec3::new(x as f32, y as f32, z as f32) + 0.5) * volume.spacing()
    };
    let answer = |client: &Client, point: Vec3| {
        let id = client.talk().probe.ask(point.to_array());
        wait_for("the answer", || client.talk().probe.answer().copied().filter(|p| p.id == id))
    };
    let mut values = std::collections::BTreeSet::new();
    for index in [[12, 12, 12], [0, 23, 5], [7, 11, 16]] {
        let voxel = answer(&one, center(index)).voxel.unwrap();
        let [x, y, z] = index.map(|i| i as i32);
        assert_eq!((voxel.index, voxel.value), (index, volume.value_from_stored(volume.stored_at(x, y, z))));
        values.insert(voxel.value.to_bits());
    }
    assert!(values.len() > 1, "negative control: not one value everywhere");
    assert_eq!(answer(&one, Vec3::splat(1e6)).voxel, None);
    assert_eq!(other.talk().probe.answer().copied(), None, "the other viewer is told nothing");
    // A flood is no violation: only the newest is sent and answered.
    for i in 0..5000 {
        one.talk().probe.ask([i as f32, 0.0, 0.0]);
    }
    assert_eq!(answer(&one, center([1, 2, 3])).voxel.unwrap().index, [1, 2, 3]);
    let mut talk = one.talk();
    let newest = talk.probe.ask([0.0; 3]);
    assert_eq!(talk.probe.ask([f32::NAN; 3]), newest, "no question at all");
    drop(talk);
    runtime.block_on(server.close());
}

#[test]
fn a_picture_to_keep_is_that_of_render_to_the_bit() {
    let runtime = runtime();
    let volume = Arc::new(Builtin::Shells.volume(48));
    let server = serve(&runtime, &volume);
    let (one, other) = (connect(&runtime, &server), connect(&runtime, &server));
    let shot = |client: &Client, id: ScreenshotId| {
        let shot = wait_for("the picture", || client.talk().screenshot.take_outcome());
        let ReceivedScreenshot { id: found, png } = Arc::unwrap_or_clone(shot);
        assert_eq!(found, id);
        png.unwrap()
    };
    // Wider than is made in one piece on a CPU, of another shape than the frames, and on a background.
    let large = Intrinsics::perspective(400, 300, 0.7);
    for (look, background) in [(look(), [0; 3]), (Look { lighting: SHADED, ..look() }, [200, 210, 220])] {
        one.set_look(look.clone()).unwrap();
        let ids = [(&one, 0.2f32), (&other, 1.1)].map(|(c, azimuth)| {
            (c, azimuth, c.talk().screenshot.request(pose(azimuth), large, background, None))
        });
        let mut files = Vec::new();
        for (client, azimuth, id) in ids {
            let found = shot(client, id);
            // The look of the one is not that of the other.
            let look = if std::ptr::eq(client, &one) { look.clone() } else { self::look() };
            let camera = Camera::new(pose(azimuth), large, &volume.bounds());
            assert!(found == file(&volume, &look, &camera, background), "{azimuth}: another picture");
            files.push(found);
        }
        assert!(files[0] != files[1], "negative control");
    }
    runtime.block_on(server.close());
}

#[test]
fn the_newest_picture_wins_and_one_that_is_cancelled_does_not_come() {
    let runtime = runtime();
    let volume = Arc::new(Builtin::Shells.volume(48));
    let server = serve(&runtime, &volume);
    let client = connect(&runtime, &server);
    client.set_pose(pose(0.1), SIZE);
    wait_for("a frame", || client.latest_frame());
    // A turntable that is given up: the pictures are large, so that none is there at once.
    let large = Intrinsics::perspective(3000, 2000, 0.6);
    for i in 0..5 {
        client.talk().screenshot.request(pose(0.3 * i as f32), large, [0; 3], None);
    }
    client.talk().screenshot.cancel();
    let small = client.talk().screenshot.request(pose(0.5), SIZE, [9; 3], None);
    let found = wait_for("the small picture", || client.talk().screenshot.take_outcome());
    assert_eq!(found.id, small);
    assert!(found.png.is_ok());
    client.talk().screenshot.request(pose(0.2), large, [0; 3], None);
    client.talk().screenshot.cancel();
    // Frames are made meanwhile and after.
    let id = client.set_pose(pose(0.7), SIZE);
    wait_for("a frame after it", || client.latest_frame().filter(|f| f.frame.header.pose == id));
    assert!(client.talk().screenshot.take_outcome().is_none());
    // One larger than any that is made is not asked for.
    let huge =
        client.talk().screenshot.request(pose(0.2), Intrinsics::perspective(8192, 8192, 0.6), [0; 3], None);
    let found = wait_for("the refusal", || client.talk().screenshot.take_outcome());
    assert!(found.id == huge && found.png.is_err());
    runtime.block_on(server.close());
}

#[test]
fn slices_are_the_server_s_voxels_and_those_that_nobody_waits_for_any_more_do_not_come() {
    let runtime = runtime();
    let volume = Arc::new(Builtin::Cloud.volume(40));
    let server = serve(&runtime, &volume);
    let (one, other) = (connect(&runtime, &server), connect(&runtime, &server));
    let across = |axis: u8, index: u32| SliceSpec {
        plane: SlicePlane::Axis { axis, index },
        thickness: 0.0,
        mode: SlabMode::Mean,
    };
    let step = volume.spacing().min_element();
    let oblique = SliceSpec {
        plane: SlicePlane::Oblique {
            origin: [-10.0 * step; 3],
            column: [step * 0.8, step * 0.6, 0.0],
            row: [0.0, 0.0, step],
            size: [30, 20],
        },
        thickness: 3.0 * step,
        mode: SlabMode::Max,
    };
    let specs = [across(0, 7), across(1, 20), across(2, 39), oblique];
    one.talk().slices.want(&specs.map(|spec| (spec, false)));
    let found = specs.map(|spec| wait_for("a slice", || one.talk().slices.get(&spec)));
    for (slice, spec) in found.iter().zip(&specs) {
        assert_eq!(Some((**slice).clone()), Slice::of(&volume, spec, ALWAYS));
    }
    assert!(*found[0] != *found[1], "negative control: slices differ");
    assert!(other.talk().slices.get(&specs[0]).is_none(), "the other viewer gets nothing");
    // Somebody pages past all of them, and stays.
    for index in 0..40 {
        other.talk().slices.want(&[(across(2, index), false)]);
    }
    wait_for("the last one", || other.talk().slices.get(&across(2, 39)));
    let num_there = (0..40).filter(|i| other.talk().slices.get(&across(2, *i)).is_some()).count();
    assert!(num_there < 10, "{num_there} of 40 came");
    // Frames are made all the same.
    let id = other.set_pose(pose(0.7), SIZE);
    wait_for("a frame", || other.latest_frame().filter(|f| f.frame.header.pose == id));
    runtime.block_on(server.close());
}
