//! Does a volume reach the viewer's picture: renderer, codec, QUIC, client, novel view?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::ids::PoseId;
use isinglass_core::image_error::{ImageError, compare};
use isinglass_core::kernels::layering::{self, budget::Budget};
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::look::Look;
use isinglass_core::picture::Picture;
use isinglass_core::session::ledger::Stage;
use isinglass_core::session::rate::{CodingMode, CodingPlan};
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::load_transfer;
use isinglass_net::{Client, ClientOptions, LinkModel, ReceivedFrame};
use isinglass_render::Backend;
use isinglass_server::{Attendance, RunningServer, ServeOptions, Timing, start};

const SIZE: Intrinsics = Intrinsics::perspective(96, 80, 0.6);

fn look(builtin: Builtin) -> Look {
    let transfer = load_transfer(builtin.name()).unwrap();
    Look::new(transfer)
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap()
}

async fn serve(builtin: Builtin) -> RunningServer {
    serve_as(builtin, CodingPlan::EXACT).await
}

async fn serve_as(builtin: Builtin, plan: CodingPlan) -> RunningServer {
    serve_with(builtin, plan, Backend::Cpu).await
}

async fn serve_with(builtin: Builtin, plan: CodingPlan, backend: Backend) -> RunningServer {
    start(ServeOptions {
        volume: Arc::new(builtin.volume(48)),
        look: look(builtin),
        devices: backend.into(),
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
        plan,
        max_viewers: 4,
        frame_memory: 1 << 30,
        library: None,
        timing: Timing::default(),
    })
    .unwrap()
}

/// Waits until the frame for a pose is there.
fn frame_for(client: &Client, pose: PoseId) -> Arc<ReceivedFrame> {
    let patience = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(frame) = client.latest_frame()
            && frame.frame.header.pose == pose
        {
            return frame;
        }
        assert!(Instant::now() < patience, "no frame for pose {pose}: {:?}", client.state());
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn error(a: &Picture, b: &Picture) -> ImageError {
    let size = (a.width as usize, a.height as usize);
    compare(&a.to_srgb8([0.0; 3]), &b.to_srgb8([0.0; 3]), size.0, size.1, [0; 3]).unwrap()
}

#[test]
fn what_the_viewer_sees_is_what_the_volume_looks_like() {
    let runtime = runtime();
    for builtin in Builtin::ALL {
        let server = runtime.block_on(serve(builtin));
        let link = runtime.block_on(server.mint_link(None)).unwrap();
        let client = Client::connect(&link, ClientOptions::default()).unwrap();
        let look = look(builtin);
        let scene = Scene::new(Arc::new(builtin.volume(48)), &look.transfer, look.march_settings());
        let bounds = scene.volume.bounds();
        for azimuth in [0.0f32, 0.6] {
            let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.3, bounds.radius() * SIZE.fit_distance());
            let received = frame_for(&client, client.set_pose(pose, SIZE));
            let camera = Camera::new(pose, SIZE, &bounds);
            assert_eq!(received.frame.header.camera, camera);

            // At rest the display shows the decoded frame itself.
            let shown = raycast(&received.frame, &bounds, &camera);
            assert!(error(&shown, &received.frame.flatten()).max_abs_255 <= 1);
            let truth = render(&scene, &camera);
            // The bound that the wire is held to.
            let exact = error(&shown, &truth);
            assert!(exact.dssim <= 1e-3, "{} {azimuth}: {exact:?}", builtin.name());

            // While the hand moves, the novel view is nearer to the truth than the last picture.
            let turned = Pose::orbit(Vec3::ZERO, azimuth + 0.17, 0.3, bounds.radius() * SIZE.fit_distance());
            let turned = Camera::new(turned, SIZE, &bounds);
            let truth = render(&scene, &turned);
            let novel = error(&raycast(&received.frame, &bounds, &turned), &truth).dssim;
            let unchanged = error(&received.frame.flatten(), &truth).dssim;
            assert!(novel < unchanged / 2.0, "{} {azimuth}: {novel} against {unchanged}", builtin.name());
        }
        runtime.block_on(server.close());
    }
}

#[test]
fn a_server_says_who_is_there() {
    let runtime = runtime();
    let server = runtime.block_on(serve(Builtin::Cubus));
    let link = runtime.block_on(server.mint_link(None)).unwrap();
    let mut attendance = server.attendance();
    let mut until = |connected, used_links| {
        let expected = Attendance { connected, used_links };
        let waited = attendance.wait_for(|found| *found == expected);
        runtime
            .block_on(async { tokio::time::timeout(Duration::from_secs(60), waited).await })
            .unwrap()
            .unwrap();
    };
    until(0, 0);
    let client = Client::connect(&link, ClientOptions::default()).unwrap();
    until(1, 1);
    drop(client);
    until(0, 1);
    runtime.block_on(server.close());
}

#[test]
fn frames_in_blocks_reach_the_viewer_for_a_fraction_of_the_bytes() {
    let runtime = runtime();
    let blocks = CodingPlan { mode: CodingMode::Blocks, ..CodingPlan::default() };
    let server = runtime.block_on(serve_as(Builtin::Cubus, blocks));
    let exact = runtime.block_on(serve(Builtin::Cubus));
    let connect = |server: &RunningServer| {
        let link = runtime.block_on(server.mint_link(None)).unwrap();
        Client::connect(&link, ClientOptions::default()).unwrap()
    };
    let (client, other) = (connect(&server), connect(&exact));
    let bounds = Builtin::Cubus.volume(48).bounds();
    let mut bytes = [0; 2];
    for step in 0..6u8 {
        let azimuth = 0.02 * f32::from(step);
        let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.3, bounds.radius() * SIZE.fit_distance());
        let [received, wanted] = [&client, &other].map(|c| frame_for(c, c.set_pose(pose, SIZE)));
        received.frame.validate().unwrap();
        let e = error(&received.frame.flatten(), &wanted.frame.flatten());
        // Measured .003 on so small a picture; a frame for another pose is off by ten times that.
        assert!(e.dssim < 6e-3, "{step}: {e:?}");
        bytes[0] += received.times.bytes;
        bytes[1] += wanted.times.bytes;
    }
    assert!(bytes[0] * 8 < bytes[1], "{bytes:?}");
    runtime.block_on(server.close());
    runtime.block_on(exact.close());
}

#[test]
fn a_new_look_reaches_the_picture_and_only_its_own_viewer() {
    let runtime = runtime();
    let server = runtime.block_on(serve(Builtin::Cubus));
    let connect = || {
        let link = runtime.block_on(server.mint_link(None)).unwrap();
        Client::connect(&link, ClientOptions::default()).unwrap()
    };
    let (changing, staying) = (connect(), connect());
    let pose = Pose::orbit(Vec3::ZERO, 0.4, 0.3, 6.0);
    let before = frame_for(&changing, changing.set_pose(pose, SIZE));
    let same = frame_for(&staying, staying.set_pose(pose, SIZE));
    // Its budget follows from the frame before, so its segments may be others.
    assert!(error(&before.frame.flatten(), &same.frame.flatten()).max_abs_255 <= 1);

    changing.set_look(look(Builtin::Shells)).unwrap();
    let patience = Instant::now() + Duration::from_secs(60);
    let after = loop {
        let frame = changing.latest_frame().unwrap();
        if frame.frame.header.look > before.frame.header.look {
            break frame;
        }
        assert!(Instant::now() < patience, "the look never changed");
        std::thread::sleep(Duration::from_millis(5));
    };
    assert_eq!(after.frame.header.camera, before.frame.header.camera);
    assert!(error(&after.frame.flatten(), &before.frame.flatten()).max_abs_255 > 8);
    let (_, look) = changing.talk().look.in_force().unwrap();
    assert_eq!(look.transfer.name, "shells");
    assert_eq!(staying.latest_frame().unwrap().frame.header.look, same.frame.header.look);
    runtime.block_on(server.close());
}

#[test]
fn a_bad_link_delays_but_does_not_harm() {
    let runtime = runtime();
    let server = runtime.block_on(serve(Builtin::Cloud));
    let link = runtime.block_on(server.mint_link(None)).unwrap();
    let model = LinkModel {
        rtt: Duration::from_millis(120),
        jitter: Duration::from_millis(5),
        loss: 0.02,
        seed: 7,
        ..LinkModel::default()
    };
    let options = ClientOptions { conditioner: Some(model), ..ClientOptions::default() };
    let client = Client::connect(&link, options).unwrap();
    let mut newest = 0;
    for i in 0..12 {
        let pose = Pose::orbit(Vec3::ZERO, 0.05 * i as f32, 0.3, 6.0);
        let id = client.set_pose(pose, SIZE);
        let frame = frame_for(&client, id);
        assert!(frame.frame.header.frame.0 > newest, "frames never go back");
        newest = frame.frame.header.frame.0;
        let (set, arrived) =
            (frame.times.at(Stage::Asked).unwrap(), frame.times.at(Stage::FirstByteReceived).unwrap());
        assert!(arrived - set >= 120_000, "faster than the link: {:?}", frame.times);
    }
    runtime.block_on(server.close());
}

/// What a viewer sees over a narrow link whose camera turns for two seconds: by how many of its poses the frame shown is
/// late, in the median of the second half, and the frames that came.
fn turned_over(
    runtime: &tokio::runtime::Runtime,
    plan: CodingPlan,
    link: &LinkModel,
) -> (u32, usize, Client) {
    let server = runtime.block_on(serve_as(Builtin::Shells, plan));
    let address = runtime.block_on(server.mint_link(None)).unwrap();
    let options = ClientOptions { conditioner: Some(link.clone()), ..Default::default() };
    let client = Client::connect(&address, options).unwrap();
    let bounds = Builtin::Shells.volume(48).bounds();
    let pose = |n: u32| Pose::orbit(Vec3::ZERO, 0.01 * n as f32, 0.3, bounds.radius() * SIZE.fit_distance());
    // Until all of the frame at rest is there: what of it is on its way could not be called back.
    let rest = || {
        let patience = Instant::now() + Duration::from_secs(60);
        while plan.mode != CodingMode::Blocks && !client.latest_frame().is_some_and(|f| f.is_exact) {
            assert!(Instant::now() < patience, "the rest is never exact");
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    frame_for(&client, client.set_pose(pose(0), SIZE));
    rest();
    let mut late = vec![];
    let mut last = PoseId(0);
    for n in 1..=60 {
        last = client.set_pose(pose(n), SIZE);
        std::thread::sleep(Duration::from_millis(33));
        if n > 30 {
            let shown = client.latest_frame().unwrap().frame.header.pose;
            late.push(last.0 - shown.0);
        }
    }
    let frames = client.ledger().iter().filter(|t| t.at(Stage::Received).is_some()).count();
    let at_rest = frame_for(&client, last);
    assert_eq!(at_rest.frame.header.camera.pose, pose(60));
    // The server goes with its connections; the test waits for what it needs of them first.
    rest();
    runtime.block_on(server.close());
    late.sort_unstable();
    (late[late.len() / 2], frames, client)
}

/// At 1 Mbit/s an exact frame of this size takes two fifths of a second, far longer than a busy machine takes to make one; one in
/// blocks takes as long as there is time for it. The queue is so long that it loses nothing: how late a lost packet makes frames
/// would depend on when it is lost.
#[test]
fn frames_keep_up_on_a_narrow_link_and_are_exact_at_rest() {
    let runtime = runtime();
    let (rtt, queue) = (Duration::from_millis(40), Duration::from_millis(600));
    let link = LinkModel { rtt, queue, bandwidth_mbit: Some(1.0), ..LinkModel::default() };
    let (late, frames, client) = turned_over(&runtime, CodingPlan::default(), &link);
    let (late_exact, frames_exact, other) = turned_over(&runtime, CodingPlan::EXACT, &link);
    assert!(late * 2 < late_exact, "{late} against {late_exact} poses late");
    assert!(frames > 2 * frames_exact, "{frames} against {frames_exact} frames");
    // The rest ends with the picture as if all frames had been exact.
    let [ours, theirs] = [client, other].map(|c| c.latest_frame().unwrap().frame.clone());
    let as_theirs = isinglass_core::layer::FrameHeader { frame: theirs.header.frame, ..ours.header };
    assert_eq!(as_theirs, theirs.header);
    assert!(error(&ours.flatten(), &theirs.flatten()).max_abs_255 <= 1);
    // A rate makes any link as narrow: 0.25 MB/s leave no room for more than 33 kB in a second of frames.
    let plan = CodingPlan { mode: CodingMode::Blocks, quality: 100, bytes_per_second: Some(0.25e6) };
    let (late, frames, client) = turned_over(&runtime, plan, &LinkModel::default());
    assert!(late * 2 < late_exact && frames > 2 * frames_exact, "{late} poses late, {frames} frames");
    let ledger = client.ledger();
    let (first, last) = (ledger.first().unwrap(), ledger.last().unwrap());
    let seconds = (last.at(Stage::Received).unwrap() - first.at(Stage::Received).unwrap()) as f64 / 1e6;
    let bytes: u64 = ledger.iter().skip(1).map(|t| t.bytes).sum();
    // A tenth for the burst that a pause leaves room for.
    assert!(bytes as f64 <= 0.25e6 * 1.1 * seconds + 8e3, "{bytes} bytes in {seconds} s");
}

/// The exact frame of a moving camera's size says nothing of the full one: that comes in blocks first, which is soon.
#[test]
fn a_larger_frame_comes_in_blocks_before_it_is_exact() {
    let runtime = runtime();
    // An exact frame takes half a second and more.
    let plan = CodingPlan { bytes_per_second: Some(5e4), ..CodingPlan::default() };
    let server = runtime.block_on(serve_as(Builtin::Cloud, plan));
    let address = runtime.block_on(server.mint_link(None)).unwrap();
    let client = Client::connect(&address, ClientOptions::default()).unwrap();
    let bounds = Builtin::Cloud.volume(48).bounds();
    let pose = Pose::orbit(Vec3::ZERO, 0.3, 0.3, bounds.radius() * SIZE.fit_distance());
    let half = Intrinsics { width: SIZE.width / 2, height: SIZE.height / 2, ..SIZE };
    // Whether the first frame of a size is exact; returns when there is one that is.
    let is_exact_at_first = |size| {
        let id = client.set_pose(pose, size);
        let first = frame_for(&client, id).is_exact;
        let patience = Instant::now() + Duration::from_secs(60);
        while !client.latest_frame().is_some_and(|f| f.is_exact && f.frame.header.pose == id) {
            assert!(Instant::now() < patience, "a frame at rest is never exact");
            std::thread::sleep(Duration::from_millis(5));
        }
        first
    };
    assert!(!is_exact_at_first(half));
    assert!(!is_exact_at_first(SIZE), "the full frame waited until it was exact");
    // The control: nothing of this picture is new but its margin.
    assert!(is_exact_at_first(SIZE.with_margin(3)));
    runtime.block_on(server.close());
}

/// A renderer that takes as long for wide frames as it is let, and how many it has begun and made.
#[derive(Default)]
struct Slow {
    begun: AtomicUsize,
    made: AtomicUsize,
    /// Whether wide frames get done.
    is_open: AtomicBool,
}

impl Slow {
    fn backend(self: Arc<Self>) -> Backend {
        Backend::Rule(Arc::new(move |scene, header, wanted| {
            if header.camera.intrinsics.width < WIDE.width {
                return layering::generate_while(scene, header, &mut Budget::default(), wanted);
            }
            self.begun.fetch_add(1, Ordering::SeqCst);
            while !self.is_open.load(Ordering::SeqCst) {
                if !wanted() {
                    return None;
                }
                std::thread::sleep(Duration::from_millis(1));
            }
            self.made.fetch_add(1, Ordering::SeqCst);
            Some(LayeredFrame::empty(header))
        }))
    }
}

const WIDE: Intrinsics = Intrinsics { width: 320, height: 240, ..SIZE };

impl Slow {
    /// Waits until a wide frame is begun.
    fn wait_for_begin(&self) {
        wait_for(&self.begun, "no wide frame is begun");
    }

    /// Waits until a wide frame is made. A busy server answers a pose with a smaller frame first.
    fn wait_for_made(&self) {
        wait_for(&self.made, "no wide frame is made");
    }
}

fn wait_for(count: &AtomicUsize, or_else: &str) {
    let patience = Instant::now() + Duration::from_secs(60);
    while count.load(Ordering::SeqCst) == 0 {
        assert!(Instant::now() < patience, "{or_else}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// The frame of a camera at rest is not done when the camera moves.
#[test]
fn a_frame_for_a_rest_that_is_over_is_given_up() {
    let runtime = runtime();
    let slow = Arc::new(Slow::default());
    let server = runtime.block_on(serve_with(Builtin::Cloud, CodingPlan::EXACT, slow.clone().backend()));
    let link = runtime.block_on(server.mint_link(None)).unwrap();
    let client = Client::connect(&link, ClientOptions::default()).unwrap();
    let bounds = Builtin::Cloud.volume(8).bounds();
    let pose = |azimuth| Pose::orbit(Vec3::ZERO, azimuth, 0.3, bounds.radius() * SIZE.fit_distance());
    frame_for(&client, client.set_pose(pose(0.0), SIZE));
    client.set_pose(pose(0.1), WIDE);
    slow.wait_for_begin();
    // Longer than the camera must have rested.
    std::thread::sleep(Duration::from_millis(350));
    frame_for(&client, client.set_pose(pose(0.2), SIZE));
    assert_eq!(slow.made.load(Ordering::SeqCst), 0, "the frame at rest was made to its end");
    // The control: where the camera stays, it is.
    slow.is_open.store(true, Ordering::SeqCst);
    client.set_pose(pose(0.1), WIDE);
    slow.wait_for_made();
    runtime.block_on(server.close());
}

/// Viewers that leave at once have asked for frames that take for ever: nobody else waits for them, and none is made.
#[test]
fn what_viewers_that_have_left_asked_for_is_not_made() {
    let runtime = runtime();
    let slow = Arc::new(Slow::default());
    let server = runtime.block_on(serve_with(Builtin::Cloud, CodingPlan::EXACT, slow.clone().backend()));
    let connect = || {
        let link = runtime.block_on(server.mint_link(None)).unwrap();
        Client::connect(&link, ClientOptions::default()).unwrap()
    };
    let bounds = Builtin::Cloud.volume(8).bounds();
    let pose = Pose::orbit(Vec3::ZERO, 0.0, 0.3, bounds.radius() * SIZE.fit_distance());
    let leaving = [(); 3].map(|()| {
        let viewer = connect();
        frame_for(&viewer, viewer.set_pose(pose, SIZE));
        viewer
    });
    for viewer in &leaving {
        viewer.set_pose(pose, WIDE);
    }
    slow.wait_for_begin();
    drop(leaving);
    let staying = connect();
    frame_for(&staying, staying.set_pose(pose, SIZE));
    // What the others have asked for is out of the way: from now on a wide frame would be made.
    slow.is_open.store(true, Ordering::SeqCst);
    frame_for(&staying, staying.set_pose(Pose { eye: pose.eye * 1.01, ..pose }, SIZE));
    assert_eq!(slow.made.load(Ordering::SeqCst), 0);
    // Negative control: a viewer that stays gets its wide frame.
    staying.set_pose(pose, WIDE);
    slow.wait_for_made();
    runtime.block_on(server.close());
}
