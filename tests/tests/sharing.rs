//! Do viewers share the rendering thread's time and the memory of frames, whatever one of them asks for?

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::FrameId;
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::load_transfer;
use isinglass_net::{Client, ClientOptions};
use isinglass_render::Backend;
use isinglass_server::{RunningServer, ServeOptions, Timing, start};
use tokio::runtime::Runtime;

/// Voxels along a side of the volume, and the radius of its bounding sphere, world units.
const SIDE: u32 = 96;
const RADIUS: f32 = 1.733;

/// The tests compare how fast viewers are, so one of them runs at a time.
static MACHINE: Mutex<()> = Mutex::new(());

struct Host {
    runtime: Runtime,
    server: RunningServer,
}

impl Host {
    fn new(plan: CodingPlan, frame_memory: u64) -> Self {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let options = ServeOptions {
            volume: Arc::new(Builtin::Shells.volume(SIDE)),
            look: look(8),
            devices: Backend::Cpu.into(),
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            plan,
            max_viewers: 4,
            frame_memory,
            library: None,
            timing: Timing::default(),
        };
        let server = runtime.block_on(async { start(options).unwrap() });
        Self { runtime, server }
    }

    fn viewer(&self) -> Client {
        let link = self.runtime.block_on(self.server.mint_link(None)).unwrap();
        let client = Client::connect(&link, ClientOptions::default()).unwrap();
        client.wait_connected(Duration::from_secs(60)).unwrap();
        client
    }
}

fn look(k: u8) -> Look {
    Look { k, ..Look::new(load_transfer("shells").unwrap()) }
}

/// The whole volume fills the height of the picture.
fn pose(turn: f32, size: &Intrinsics) -> Pose {
    Pose::orbit(Vec3::ZERO, turn, 0.3, RADIUS * size.fit_distance())
}

/// A viewer whose camera turns, and the frames it has seen.
struct Hand {
    client: Client,
    size: Intrinsics,
    newest: Option<FrameId>,
    num_frames: u32,
}

impl Hand {
    fn new(client: Client, width: u32, height: u32) -> Self {
        Self { client, size: Intrinsics::perspective(width, height, 0.6), newest: None, num_frames: 0 }
    }

    fn turn(&mut self, turn: f32) {
        self.client.set_pose(pose(turn, &self.size), self.size);
        let newest = self.client.latest_frame().map(|f| f.frame.header.frame);
        if newest != self.newest {
            (self.newest, self.num_frames) = (newest, self.num_frames + 1);
        }
    }
}

/// Turns all cameras for a while, and returns the frames a second of each.
fn play(hands: &mut [&mut Hand], seconds: f32) -> Vec<f32> {
    hands.iter_mut().for_each(|hand| hand.num_frames = 0);
    let begin = Instant::now();
    while begin.elapsed().as_secs_f32() < seconds {
        let turn = begin.elapsed().as_secs_f32() * 0.5;
        hands.iter_mut().for_each(|hand| hand.turn(turn));
        std::thread::sleep(Duration::from_millis(4));
    }
    hands.iter().map(|hand| hand.num_frames as f32 / begin.elapsed().as_secs_f32()).collect()
}

#[test]
fn a_large_viewer_leaves_a_small_one_nearly_half_of_its_frames() {
    let _machine = MACHINE.lock().unwrap_or_else(PoisonError::into_inner);
    let host = Host::new(CodingPlan::default(), 1 << 30);
    let mut small = Hand::new(host.viewer(), 256, 256);
    play(&mut [&mut small], 2.0);
    let alone = play(&mut [&mut small], 4.0)[0];
    let mut large = Hand::new(host.viewer(), 1920, 1080);
    for k in [8, 32] {
        large.client.set_look(look(k)).unwrap();
        play(&mut [&mut small, &mut large], 2.0);
        let both = play(&mut [&mut small, &mut large], 6.0);
        println!("alone {alone:.1}/s; beside 1920×1080 at K = {k}: {both:.1?}/s");
        // Both get as much rendering; on two cores, coding the large frames takes from both.
        assert!(both[0] >= 0.4 * alone, "{alone} alone, {both:?} beside a large one at K = {k}");
        // The control: the large one is not kept out instead.
        assert!(both[1] > 0.3, "{both:?}");
    }
    // A large camera that rests gets its whole picture, beside a small one that does not.
    let id = large.client.set_pose(pose(1.0, &large.size), large.size);
    let patience = Instant::now() + Duration::from_secs(120);
    loop {
        play(&mut [&mut small], 0.2);
        let whole = large
            .client
            .latest_frame()
            .filter(|f| f.frame.header.pose == id && f.frame.header.camera.intrinsics == large.size);
        if whole.is_some() {
            break;
        }
        assert!(Instant::now() < patience, "no whole frame at rest");
    }
}

#[test]
fn frames_keep_to_their_memory_and_are_made_smaller_before() {
    let _machine = MACHINE.lock().unwrap_or_else(PoisonError::into_inner);
    let segments_with = |frame_memory: u64| {
        let host = Host::new(CodingPlan::EXACT, frame_memory);
        let mut hands: Vec<Hand> = (0..2).map(|_| Hand::new(host.viewer(), 1280, 800)).collect();
        for hand in &hands {
            hand.client.set_look(look(32)).unwrap();
        }
        let mut most = 0;
        for step in 0..3 {
            for hand in &mut hands {
                let id = hand.client.set_pose(pose(step as f32, &hand.size), hand.size);
                let patience = Instant::now() + Duration::from_secs(120);
                let frame = loop {
                    let newest = hand.client.latest_frame();
                    if let Some(frame) = newest.filter(|f| f.frame.header.pose == id) {
                        break frame;
                    }
                    assert!(Instant::now() < patience, "no frame");
                    std::thread::sleep(Duration::from_millis(10));
                };
                frame.frame.validate().unwrap();
                most = most.max(frame.frame.num_segments());
            }
        }
        most
    };
    // Making a frame takes 24 bytes a segment, and nobody gets more than half of the memory.
    let limit: u64 = 48 << 20;
    let most = limit as usize / 2 / 24;
    let (within, control) = (segments_with(limit), segments_with(2 << 30));
    assert!(within <= most && within > most / 8, "{within} segments in {limit} bytes");
    assert!(control > most, "the limit matters: {control}");
}
