//! Does a viewer that follows another get that one's frames, at the cost of one rendering?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::PoseId;
use isinglass_core::kernels::layering::{self, budget::Budget};
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::load_transfer;
use isinglass_net::{Client, ClientOptions, ReceivedFrame};
use isinglass_render::Backend;
use isinglass_server::{RunningServer, ServeOptions, Timing, start};
use tokio::runtime::Runtime;

const SIZE: Intrinsics = Intrinsics::perspective(96, 80, 0.6);
const OTHER_SIZE: Intrinsics = Intrinsics::perspective(64, 64, 0.6);

struct Host {
    runtime: Runtime,
    server: RunningServer,
    /// Number of frames that the renderer has made.
    num_made: Arc<AtomicUsize>,
}

impl Host {
    fn new() -> Self {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let num_made = Arc::<AtomicUsize>::default();
        let counter = num_made.clone();
        let backend = Backend::Rule(Arc::new(move |scene, header, wanted| {
            let frame = layering::generate_while(scene, header, &mut Budget::default(), wanted)?;
            counter.fetch_add(1, Ordering::SeqCst);
            Some(frame)
        }));
        let options = ServeOptions {
            volume: Arc::new(Builtin::Cloud.volume(32)),
            look: look(8),
            devices: backend.into(),
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            plan: CodingPlan::EXACT,
            max_viewers: 4,
            frame_memory: 1 << 30,
            library: None,
            timing: Timing::default(),
        };
        let server = runtime.block_on(async { start(options).unwrap() });
        Self { runtime, server, num_made }
    }

    fn viewer(&self, name: &str) -> Client {
        let link = self.runtime.block_on(self.server.mint_link(None)).unwrap();
        let client =
            Client::connect(&link, ClientOptions { name: name.into(), ..ClientOptions::default() }).unwrap();
        client.wait_connected(Duration::from_secs(60)).unwrap();
        client
    }
}

fn look(k: u8) -> Look {
    Look { k, ..Look::new(load_transfer("cloud").unwrap()) }
}

fn pose(n: u16) -> Pose {
    let radius = Builtin::Cloud.volume(8).bounds().radius();
    Pose::orbit(Vec3::ZERO, f32::from(n) * 0.1, 0.3, radius * SIZE.fit_distance())
}

fn until<T>(what: &str, mut probe: impl FnMut() -> Option<T>) -> T {
    let patience = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(found) = probe() {
            return found;
        }
        assert!(Instant::now() < patience, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn frame_from(client: &Client, pose: Pose) -> Arc<ReceivedFrame> {
    until("a frame", || client.latest_frame().filter(|f| f.frame.header.camera.pose == pose && f.is_exact))
}

/// The number of the viewer with this name, as another one sees it.
fn number_of(client: &Client, name: &str) -> u32 {
    until("a name", || client.talk().viewers.list().iter().find(|v| v.name == name).map(|v| v.number))
}

fn follow(client: &Client, leader: Option<&str>) {
    let number = leader.map(|name| number_of(client, name));
    client.talk().viewers.follow(number);
}

#[test]
fn who_follows_gets_the_frames_of_the_leader_rendered_once() {
    let host = Host::new();
    let (leader, follower) = (host.viewer("leader"), host.viewer("follower"));
    leader.set_pose(pose(0), SIZE);
    frame_from(&leader, pose(0));
    follower.set_pose(pose(40), OTHER_SIZE);
    frame_from(&follower, pose(40));
    // It has what the leader sees at rest, from the leader's camera, at once.
    follow(&follower, Some("leader"));
    let led = frame_from(&follower, pose(0));
    assert_eq!(led.frame.header.pose, PoseId(0), "it answers none of its own poses");
    assert_eq!(led.frame.header.camera.intrinsics, SIZE);
    until("the news", || leader.talk().viewers.list().iter().any(|v| v.follows.is_some()).then_some(()));
    // While the leader moves, it gets the same frames, whatever its own camera does.
    let before = host.num_made.load(Ordering::SeqCst);
    for n in 1..=12 {
        leader.set_pose(pose(n), SIZE);
        follower.set_pose(pose(40 + n), OTHER_SIZE);
        let of_leader = frame_from(&leader, pose(n));
        let led = frame_from(&follower, pose(n));
        assert_eq!(led.frame.offsets, of_leader.frame.offsets);
        assert_eq!(led.frame.c_rg, of_leader.frame.c_rg);
    }
    assert_eq!(host.num_made.load(Ordering::SeqCst) - before, 12, "one rendering for both");
    // It sees under the leader's look.
    leader.set_look(look(3)).unwrap();
    until("the leader's look", || {
        let talk = follower.talk();
        talk.look.in_force().is_some_and(|(_, look)| look.k == 3).then_some(())
    });
    // The control: on its own again, it gets its own frames.
    follow(&follower, None);
    let own = frame_from(&follower, pose(52));
    assert_eq!(own.frame.header.camera.intrinsics, OTHER_SIZE);
}

#[test]
fn who_leaves_is_followed_no_longer_and_nobody_follows_in_a_circle() {
    let host = Host::new();
    let (leader, follower) = (host.viewer("leader"), host.viewer("follower"));
    for client in [&leader, &follower] {
        client.set_pose(pose(1), SIZE);
        frame_from(client, pose(1));
    }
    follow(&follower, Some("leader"));
    let follows = |client: &Client| client.talk().viewers.list().iter().any(|v| v.follows.is_some());
    until("the news", || follows(&leader).then_some(()));
    // Two that follow each other would both stand still.
    follow(&leader, Some("follower"));
    until("a refusal", || leader.talk().link.take_notice().map(drop));
    until("the server's word", || leader.talk().viewers.following().is_none().then_some(()));
    drop(leader);
    until("the end", || follower.talk().viewers.list().len().eq(&1).then_some(()));
    follower.set_pose(pose(7), SIZE);
    frame_from(&follower, pose(7));
}
