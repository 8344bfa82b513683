//! Is an edit of the look on the screen before the next one, and exact in the end?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::cell::OnceCell;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::time::{Duration, Instant};

use isinglass_client::{Foresight, FrameSize, Standing, Viewing};
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::transfer::Domain;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Histogram, Volume};
use isinglass_formats::{OpenOptions, default_transfer, open};
use isinglass_net::{Client, ClientOptions};
use isinglass_render::Backend;
use isinglass_server::{ServeOptions, Timing, start};

/// A frame of a new look.
struct Seen {
    num_lists: usize,
    is_exact: bool,
    /// Time since the edit.
    after: Duration,
}

/// Shows a volume until it is exact, and then makes edits, `pause` apart. Returns what was seen after each.
fn play(
    (volume, look): (Volume, Look),
    picture: Intrinsics,
    edits: &[impl Fn(&mut Look)],
    pause: Option<Duration>,
) -> Vec<Vec<Seen>> {
    let mut threads = tokio::runtime::Builder::new_multi_thread();
    let runtime = threads.worker_threads(2).enable_all().build().unwrap();
    let bounds = volume.bounds();
    let options = ServeOptions {
        volume: Arc::new(volume),
        look: look.clone(),
        devices: Backend::Cpu.into(),
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
        plan: CodingPlan::default(),
        max_viewers: 4,
        frame_memory: 1 << 30,
        library: None,
        timing: Timing::default(),
    };
    let server = runtime.block_on(async { start(options) }).unwrap();
    let link = runtime.block_on(server.mint_link(None)).unwrap();
    let client = Client::connect(&link, ClientOptions::default()).unwrap();
    client.wait_connected(Duration::from_secs(60)).unwrap();
    let budget = Some(Duration::from_millis(300));
    let frame_size = FrameSize { moving_budget: budget, ..FrameSize::default() };
    let mut viewing = Viewing::new(client, frame_size, Foresight::default());
    let pose = Pose::orbit(bounds.center(), 0.4, 0.3, bounds.radius() * picture.fit_distance());
    let begun = Instant::now();
    let refresh = |viewing: &mut Viewing<Client>| {
        std::thread::sleep(Duration::from_millis(8));
        assert!(begun.elapsed() < Duration::from_secs(300), "no rest");
        viewing.refresh(begun.elapsed(), pose, picture, &bounds)
    };
    while refresh(&mut viewing).standing != Standing::Exact {}
    let mut seen = Vec::new();
    let mut wanted = look;
    for edit in edits {
        edit(&mut wanted);
        viewing.set_look(begun.elapsed(), wanted.clone());
        let edited = Instant::now();
        let mut of_edit: Vec<Seen> = Vec::new();
        loop {
            let refresh = refresh(&mut viewing);
            let is_new = refresh.changed && refresh.older_look_since.is_none();
            if let Some(frame) = refresh.frame.filter(|_| is_new) {
                let num_lists = frame.frame.header.camera.intrinsics.num_pixels();
                of_edit.push(Seen { num_lists, is_exact: frame.is_exact, after: edited.elapsed() });
            }
            let is_over = pause.is_some_and(|pause| edited.elapsed() >= pause);
            if is_over || (refresh.standing == Standing::Exact && !of_edit.is_empty()) {
                break;
            }
        }
        seen.push(of_edit);
    }
    seen
}

fn shells() -> (Volume, Look) {
    let volume = Builtin::Shells.volume(40);
    let look = Look::new(default_transfer("builtin:shells", &volume, &Histogram::of(&volume)));
    (volume, look)
}

const EDITS: [fn(&mut Look); 5] = [
    |look| look.transfer.points.iter_mut().for_each(|p| p.color = [p.color[2], p.color[0], p.color[1]]),
    |look| look.transfer.points.iter_mut().for_each(|p| p.opacity *= 0.7),
    |look| look.transfer.domain = Domain::Percentiles(2.0, 99.5),
    |look| look.lighting.ambient_occlusion = 0.5,
    |look| look.transfer.points.iter_mut().for_each(|p| p.opacity *= 0.8),
];

#[test]
fn every_edit_is_on_the_screen_and_exact_in_the_end() {
    let picture = Intrinsics::perspective(96, 64, 0.6);
    let seen = play(shells(), picture, &EDITS, None);
    for of_edit in &seen {
        let last = of_edit.last().unwrap();
        assert!(last.is_exact && last.num_lists >= picture.num_pixels());
    }
    // Edits that follow each other too fast for whole frames are seen all the same.
    let edits: Vec<fn(&mut Look)> = (0..40).map(|i| EDITS[i % 2]).collect();
    let seen = play(shells(), picture, &edits, Some(Duration::from_millis(120)));
    assert!(seen.iter().filter(|of_edit| !of_edit.is_empty()).count() > 10, "the editor starves");
}

/// Work that has all shared threads of the process until it is dropped. The shade of a large volume has them for
/// seconds.
struct LongWork(Arc<AtomicBool>);

impl LongWork {
    fn begin() -> Self {
        let is_over = Arc::new(AtomicBool::new(false));
        let num_threads = rayon::current_num_threads();
        let (sender, begun) = sync_channel(num_threads);
        let work = is_over.clone();
        rayon::spawn_broadcast(move |_| {
            sender.send(()).unwrap();
            while !work.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(1));
            }
        });
        (0..num_threads).for_each(|_| begun.recv().unwrap());
        Self(is_over)
    }
}

impl Drop for LongWork {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn an_edit_does_not_wait_for_long_work_of_a_server_in_the_same_process() {
    let picture = Intrinsics::perspective(96, 64, 0.6);
    let work = OnceCell::new();
    let edit = |look: &mut Look| {
        work.get_or_init(LongWork::begin);
        EDITS[0](look);
    };
    let seen = play(shells(), picture, &[edit], None);
    assert!(seen[0].last().unwrap().is_exact);
    // The control: the shared threads do nothing else until then.
    let (sender, answer) = sync_channel(1);
    rayon::spawn(move || sender.send(()).unwrap());
    assert!(answer.recv_timeout(Duration::from_millis(100)).is_err());
    drop(work);
    answer.recv().unwrap();
}

/// How soon an edit is seen without a GPU, in numbers.
#[test]
#[ignore = "measures times"]
fn edits_table() {
    let folder = isinglass_tests::data_dir().expect("ISINGLASS_DATA names the folder of volumes");
    let picture = Intrinsics::perspective(944, 738, 0.7);
    let edits: Vec<fn(&mut Look)> = (0..8).map(|i| EDITS[i % 2]).collect();
    for name in ["bonsai.nrrd", "t1_head.nrrd", "mouse_brain.nrrd"] {
        for ambient_occlusion in [0.0, 0.5] {
            let volume = open(folder.join(name).to_str().unwrap(), &OpenOptions::default()).unwrap();
            let mut look = Look::new(default_transfer(name, &volume, &Histogram::of(&volume)));
            look.lighting.ambient_occlusion = ambient_occlusion;
            let seen = play((volume, look), picture, &edits, None);
            let mut first: Vec<_> = seen.iter().map(|of_edit| of_edit[0].after).collect();
            let mut exact: Vec<_> = seen.iter().map(|of_edit| of_edit.last().unwrap().after).collect();
            first.sort();
            exact.sort();
            let side = (seen[0][0].num_lists as f64).sqrt();
            println!(
                "{name}, ambient occlusion {ambient_occlusion}: first changed picture {:.0?} to {:.0?}, about {side:.0} lists \
                 a side; exact after {:.1?} to {:.1?}",
                first[0],
                first[first.len() - 1],
                exact[0],
                exact[exact.len() - 1]
            );
        }
    }
}
