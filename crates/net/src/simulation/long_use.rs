//! Long use of a link that changes: frames never stop for long, and nothing grows.

use std::sync::Mutex;

use allocation_counter::measure;
use isinglass_core::session::repair::{RepairedStream, parity};
use isinglass_core::wire::parity::ParityHead;
use rand::rngs::Xoshiro256PlusPlus;
use rand::{RngExt, SeedableRng};
use tokio::runtime::Runtime;

use super::model::pose;
use super::*;

/// How long a link stays as it is.
const STEP: Duration = Duration::from_secs(10);
const STEPS_A_MINUTE: usize = 6;

/// The longest time without a new frame while the camera moved, and the bytes held at the end of each step.
#[derive(Debug, Default)]
struct Use {
    longest_gap_ms: f64,
    held: Vec<i64>,
    num_frames: u64,
    most_in_flight: usize,
}

impl Use {
    /// Growth over the first `settle` minutes, bytes. The least of a minute is what is held when hardly anything is on
    /// its way; what is on its way depends on the link.
    fn growth(&self, settle: usize) -> i64 {
        let least = |minute: &[i64]| minute.iter().copied().min().unwrap_or(0);
        let minutes: Vec<i64> = self.held.chunks_exact(STEPS_A_MINUTE).map(least).collect();
        let most = |minutes: &[i64]| minutes.iter().copied().max().unwrap_or(0);
        most(&minutes[settle..]) - most(&minutes[..settle])
    }
}

/// A hand that turns the volume for eight of ten seconds. `leak` keeps so many bytes of each frame.
async fn watch(client: ModelClient, gap: Arc<Mutex<Use>>, leak: usize) {
    let start = Instant::now();
    let mut kept: Vec<Vec<u8>> = Vec::new();
    let (mut refresh, mut newest) = (0u32, Duration::ZERO);
    let mut tick = tokio::time::interval(Duration::from_millis(4));
    loop {
        tick.tick().await;
        let elapsed = start.elapsed();
        let is_moving = elapsed.as_millis() % 10_000 < 8000;
        let num = client.decode().len();
        let mut seen = gap.lock().expect("no panic");
        if num > 0 {
            seen.num_frames += num as u64;
            kept.extend((leak > 0).then(|| vec![1; leak]));
            newest = elapsed;
        }
        if !is_moving {
            newest = elapsed;
        }
        let gap_ms = (elapsed - newest).as_secs_f64() * 1e3;
        seen.longest_gap_ms = seen.longest_gap_ms.max(gap_ms);
        drop(seen);
        if is_moving && elapsed.as_micros() * 60 >= u128::from(refresh) * 1_000_000 {
            refresh = (elapsed.as_micros() * 60 / 1_000_000) as u32 + 1;
            client.set_pose(pose(refresh as f32 * 0.5), model::INTRINSICS);
        }
    }
}

/// Another link after each step; the same ones with each run. The first of each minute is the same fast one.
fn links(num: usize) -> impl Iterator<Item = LinkModel> {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(11);
    (0..num).map(move |step| {
        let mut one_of = |values: [f64; 4]| values[rng.random_range(0..4)];
        let (mbit, rtt_ms) = (one_of([5.0, 20.0, 50.0, 100.0]), one_of([20.0, 40.0, 150.0, 300.0]));
        let loss = one_of([0.0, 0.0, 0.01, 0.02]);
        match step % STEPS_A_MINUTE {
            0 => link_model(100.0, 20, 0.0),
            _ => link_model(mbit, rtt_ms as u64, loss),
        }
    })
}

/// Counts what this thread holds: both sides of the session, quinn's buffers and the packets on their way.
fn use_for(steps: usize, leak: usize) -> Use {
    // The tables of the Reed-Solomon code are made once for all sessions of a process.
    let mut stream = RepairedStream::default();
    for datagram in parity(1, &[7; 9000], 0.05, 1200) {
        let (head, symbols) = ParityHead::decode(&datagram).expect("our own");
        stream.handle_parity(0, head, symbols);
    }
    stream.handle_part(0, 0, &[7; 8000]);
    stream.repair();
    let runtime: Runtime = tokio::runtime::Builder::new_current_thread()
        .enable_time()
        .start_paused(true)
        .build()
        .expect("a runtime");
    let seen = Arc::<Mutex<Use>>::default();
    seen.lock().expect("no panic").held.reserve(steps);
    let network = runtime.block_on(async {
        let mut world = World::new(&link_model(50.0, 40, 0.0), None);
        let links = world.serve(1, Renderer::default());
        let client = world.viewer(&links[0]);
        tokio::spawn(watch(client, seen.clone(), leak));
        world.network
    });
    let mut held = 0;
    for link in links(steps) {
        network.set_model(&link);
        let info = measure(|| {
            runtime.block_on(async { tokio::time::sleep(STEP).await });
            // Records of the simulation itself are not counted.
            drop(network.take_traffic());
        });
        held += info.bytes_current;
        let mut seen = seen.lock().expect("no panic");
        seen.held.push(held);
        seen.most_in_flight = seen.most_in_flight.max(network.num_in_flight());
    }
    drop(runtime);
    let used = std::mem::take(&mut *seen.lock().expect("no panic"));
    println!(
        "{} s: {} frames, {:.0} ms without a new frame at most, {:.0} to {:.0} kB held",
        steps as u64 * STEP.as_secs(),
        used.num_frames,
        used.longest_gap_ms,
        used.held.iter().min().copied().unwrap_or(0) as f64 / 1e3,
        used.held.iter().max().copied().unwrap_or(0) as f64 / 1e3,
    );
    used
}

fn assert_steady(used: &Use, settle: usize) {
    assert!(used.longest_gap_ms <= LONGEST_GAP_MS, "{} ms without a new frame", used.longest_gap_ms);
    assert!(used.growth(settle) <= MOST_GROWTH_BYTES, "{} bytes more: {:?}", used.growth(settle), used.held);
}

/// Two minutes, after one.
#[test]
fn nothing_stops_or_grows_while_the_link_changes() {
    assert_steady(&use_for(3 * STEPS_A_MINUTE, 0), 1);
    // The control keeps a little of each frame.
    let leaking = use_for(2 * STEPS_A_MINUTE, 4096);
    assert!(leaking.growth(1) > 4 * MOST_GROWTH_BYTES, "{:?}", leaking.held);
}

#[test]
#[ignore = "plays half an hour, which takes minutes"]
fn nothing_stops_or_grows_in_half_an_hour() {
    assert_steady(&use_for(30 * STEPS_A_MINUTE, 0), 5);
}

/// A twentieth of what a process with one viewer holds: 1 MB, and 9 MB of tables of the code.
const MOST_GROWTH_BYTES: i64 = 500_000;
/// The round trip grows from 20 to 300 ms and the rate falls to a tenth. Some round trips pass until a delay that stays
/// is known to be the path's and not a queue's.
const LONGEST_GAP_MS: f64 = 1600.0;
