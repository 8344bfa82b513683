//! Does a server with several GPUs use them, with the frames of a single one, and go on when it loses them?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::picture::Picture;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::volume::Volume;
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::load_transfer;
use isinglass_gpu::Gpu;
use isinglass_net::{Client, ClientOptions, ReceivedFrame};
use isinglass_render::{Backend, Devices};
use isinglass_server::{DeviceUse, RunningServer, ServeOptions, Timing, start};
use tokio::runtime::Runtime;

const SIZE: Intrinsics = Intrinsics::perspective(96, 80, 0.6);

struct Host {
    runtime: Runtime,
    server: RunningServer,
    gpus: Vec<Gpu>,
}

impl Host {
    /// A server on so many devices, which may be one software device, opened several times. `None` without any.
    fn new(num_devices: usize) -> Option<Self> {
        let gpus = match Gpu::open_alike(Some(num_devices)) {
            Ok(gpus) => gpus,
            Err(e) => {
                let is_strict = std::env::var_os("ISINGLASS_STRICT").is_some_and(|v| v == "1");
                assert!(!is_strict, "{e}");
                eprintln!("skipped: {e}");
                return None;
            }
        };
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let options = ServeOptions {
            volume: volume(),
            look: look(),
            devices: Devices::of_gpus(gpus.clone()),
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            plan: CodingPlan::EXACT,
            max_viewers: 4,
            frame_memory: 1 << 30,
            library: None,
            timing: Timing::default(),
        };
        let server = runtime.block_on(async { start(options).unwrap() });
        Some(Self { runtime, server, gpus })
    }

    fn viewer(&self) -> Client {
        let link = self.runtime.block_on(self.server.mint_link(None)).unwrap();
        let client = Client::connect(&link, ClientOptions::default()).unwrap();
        client.wait_connected(Duration::from_secs(60)).unwrap();
        client
    }

    fn num_viewers(&self) -> Vec<usize> {
        self.server.devices().iter().map(|device| device.viewers).collect()
    }

    /// Turns all cameras to further poses until `is_enough`.
    fn turn(&self, viewers: &[&Client], is_enough: impl Fn(&[DeviceUse]) -> bool) {
        let patience = Instant::now() + Duration::from_secs(60);
        for step in 0.. {
            viewers.iter().for_each(|viewer| drop(frame_from(viewer, pose(step as f32 * 0.01))));
            let devices = self.server.devices();
            if is_enough(&devices) {
                break;
            }
            assert!(Instant::now() < patience, "{devices:?}");
        }
    }
}

fn volume() -> Arc<Volume> {
    Arc::new(Builtin::Shells.volume(40))
}

fn look() -> Look {
    Look::new(load_transfer("shells").unwrap())
}

fn pose(turn: f32) -> Pose {
    Pose::orbit(Vec3::ZERO, turn, 0.3, volume().bounds().radius() * SIZE.fit_distance())
}

/// The frame that answers a pose.
fn frame_from(client: &Client, pose: Pose) -> Arc<ReceivedFrame> {
    client.set_pose(pose, SIZE);
    let patience = Instant::now() + Duration::from_secs(60);
    loop {
        let newest = client.latest_frame();
        if let Some(frame) = newest.filter(|f| f.frame.header.camera.pose == pose && f.is_exact) {
            return frame;
        }
        assert!(Instant::now() < patience, "no frame");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn max_difference(a: &Picture, b: &Picture) -> u8 {
    let [a, b] = [a, b].map(|picture| picture.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn two_devices_serve_two_viewers_with_the_frames_of_one() {
    let Some(host) = Host::new(2) else { return };
    let (first, second) = (host.viewer(), host.viewer());
    frame_from(&first, pose(0.0));
    assert!(!host.server.devices()[1].is_ready, "one viewer needs one device");
    host.turn(&[&first, &second], |devices| {
        devices.iter().all(|d| d.is_ready && d.viewers == 1 && d.rendering > Duration::ZERO)
    });
    let before: Vec<Duration> = host.server.devices().iter().map(|d| d.rendering).collect();
    let single = Backend::Gpu(Gpu::open().unwrap());
    let scene = Scene::of_look(volume(), &look());
    let bounds = scene.volume.bounds();
    let mut truth = single.renderer(scene).unwrap();
    for turn in [0.4, 2.0] {
        let frames =
            [(&first, turn), (&second, turn + 1.0)].map(|(viewer, turn)| frame_from(viewer, pose(turn)));
        let [mine, other] = frames.each_ref().map(|frame| truth.render(&frame.frame.header.camera).unwrap());
        let shown = frames.each_ref().map(|received| {
            let camera = received.frame.header.camera;
            single.raycast(&received.frame, &bounds, &camera).unwrap()
        });
        assert!(max_difference(&shown[0], &mine) <= 1 && max_difference(&shown[1], &other) <= 1, "{turn}");
        // The control: the pictures of the two viewers differ.
        assert!(max_difference(&shown[0], &other) > 8 && max_difference(&shown[1], &mine) > 8);
        // The single device makes the same lists.
        for received in &frames {
            let own = truth.generate(received.frame.header).unwrap();
            let cast = single.raycast(&own, &bounds, &own.header.camera).unwrap();
            let received = single.raycast(&received.frame, &bounds, &own.header.camera).unwrap();
            assert!(max_difference(&cast, &received) <= 1);
        }
    }
    let after = host.server.devices();
    assert!(after.iter().zip(&before).all(|(after, before)| after.rendering > *before), "{after:?}");
}

#[test]
fn the_viewers_of_a_lost_device_go_on_at_the_others_and_at_last_on_the_cpu() {
    let Some(host) = Host::new(2) else { return };
    let viewers = [host.viewer(), host.viewer()];
    let both: Vec<&Client> = viewers.iter().collect();
    host.turn(&both, |devices| devices.iter().all(|d| d.is_ready && d.viewers == 1));
    host.gpus[0].device().destroy();
    viewers.iter().for_each(|viewer| drop(frame_from(viewer, pose(1.0))));
    assert_eq!(host.num_viewers(), [0, 2]);
    assert!(!host.server.devices()[0].is_ready);
    let on_other = host.server.devices()[1].rendering;
    viewers.iter().for_each(|viewer| drop(frame_from(viewer, pose(2.0))));
    assert!(host.server.devices()[1].rendering > on_other, "the control: it is the other one that works");
    host.gpus[1].device().destroy();
    // The CPU makes the same frames.
    let scene = Scene::of_look(volume(), &look());
    let bounds = scene.volume.bounds();
    let mut truth = Backend::Cpu.renderer(scene).unwrap();
    for (viewer, turn) in viewers.iter().zip([3.0, 4.0]) {
        let received = frame_from(viewer, pose(turn));
        let camera = received.frame.header.camera;
        let shown = Backend::Cpu.raycast(&received.frame, &bounds, &camera).unwrap();
        assert!(max_difference(&shown, &truth.render(&camera).unwrap()) <= 1);
    }
}

#[test]
fn one_device_serves_all_viewers_if_it_is_the_only_one() {
    let Some(host) = Host::new(1) else { return };
    let viewers = [host.viewer(), host.viewer()];
    viewers.iter().for_each(|viewer| drop(frame_from(viewer, pose(0.5))));
    assert_eq!(host.num_viewers(), [2]);
    assert!(host.server.devices()[0].description.starts_with("gpu: "));
}
