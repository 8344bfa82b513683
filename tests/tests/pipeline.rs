//! Does a fast machine's speed reach the viewer? A renderer of 2 ms and a codec of 6 and 5 ms, by way of everything that lies between
//! them and the screen: the server's stations, QUIC on loopback, a link of a given delay, the client, and a display of 60 Hz.
//!
//! The work is that of a small frame, which then rests until the time of a larger one on the faster machine has passed. This is the one
//! test that measures time, for that is what it is about; so it has a program for itself, and does one link after the other.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_client::{Foresight, HeadlessViewer};
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::look::Look;
use isinglass_core::session::ledger::{Life, Stage};
use isinglass_core::session::rate::{CodingMode, CodingPlan};
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::load_transfer;
use isinglass_net::{AfterWork, Client, ClientOptions, Clock, Journal, LinkModel, Work};
use isinglass_render::Backend;
use isinglass_server::{ServeOptions, Timing, start};

/// What a machine needs for a frame.
#[derive(Clone, Copy, Debug)]
struct Machine {
    generate: Duration,
    encode: Duration,
    decode: Duration,
}

impl Machine {
    fn after_work(self) -> AfterWork {
        AfterWork::new(move |work, took| {
            let whole = match work {
                Work::Generate => self.generate,
                Work::Encode => self.encode,
                Work::Decode => self.decode,
            };
            std::thread::sleep(whole.saturating_sub(took));
        })
    }
}

/// What came of it while it counted.
struct Outcome {
    new_frames_per_second: f64,
    /// At each refresh, sorted, ms.
    ages: Vec<f64>,
    /// Of the frames that were begun.
    lives: Vec<Life>,
}

impl Outcome {
    fn mean_age(&self) -> f64 {
        self.ages.iter().sum::<f64>() / self.ages.len() as f64
    }

    fn p95_age(&self) -> f64 {
        self.ages[self.ages.len() * 95 / 100]
    }

    /// Frames that were begun and overtaken before they were sent.
    fn in_vain(&self) -> usize {
        let newest = self
            .lives
            .iter()
            .filter(|life| life.at(Stage::LastByteSent).is_some())
            .map(|life| life.frame)
            .max();
        let is_lost =
            |life: &&Life| life.at(Stage::LastByteSent).is_none() && newest.is_some_and(|n| life.frame < n);
        self.lives.iter().filter(is_lost).count()
    }
}

/// Shows an orbiting camera's frames for some seconds.
fn play(machine: Machine, mode: CodingMode, rtt: Duration) -> Outcome {
    let threads = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let clock = Clock::start();
    let options = ServeOptions {
        volume: Arc::new(Builtin::Cubus.volume(16)),
        look: Look::new(load_transfer("cubus").unwrap()),
        devices: Backend::Cpu.into(),
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
        plan: CodingPlan { mode, ..CodingPlan::default() },
        max_viewers: 1,
        frame_memory: 1 << 30,
        library: None,
        timing: Timing { clock: clock.clone(), after_work: machine.after_work() },
    };
    let server = threads.block_on(async { start(options) }).unwrap();
    let link = threads.block_on(server.mint_link(None)).unwrap();
    let client = ClientOptions {
        conditioner: Some(LinkModel { rtt, ..LinkModel::default() }),
        clock: clock.clone(),
        after_work: machine.after_work(),
        ..ClientOptions::default()
    };
    let client = Client::connect(&link, client).unwrap();
    client.wait_connected(Duration::from_secs(60)).unwrap();
    let mut viewer = HeadlessViewer::new(client, SIZE, Foresight { guards: false, ..Foresight::default() });
    let (mut ages, mut lives, mut shown, mut num_new) = (vec![], vec![], None, 0);
    let begin = Instant::now();
    for tick in 0..(WARM_UP + MEASURED) * HZ {
        std::thread::sleep((Duration::from_secs(1) * tick / HZ).saturating_sub(begin.elapsed()));
        let turn = begin.elapsed().as_secs_f32() * 0.5;
        let pose = Pose::orbit(Vec3::ZERO, turn, 0.3, 40.0);
        let now = Duration::from_micros(clock.now_micros());
        viewer.tick(now, pose);
        for record in viewer.take_records() {
            let Some(frame) = record.frame else { continue };
            let is_new = shown.replace(frame.frame.header.frame) != Some(frame.frame.header.frame);
            let asked = frame.times.at(Stage::Asked);
            if tick >= WARM_UP * HZ {
                num_new += u32::from(is_new);
                ages.extend(asked.map(|asked| (record.at.as_micros() as u64 - asked) as f64 / 1e3));
            }
        }
        if tick % HZ == 0 && tick > WARM_UP * HZ || tick + 1 == (WARM_UP + MEASURED) * HZ {
            let journal = server.newest_journal().unwrap();
            collect(&mut lives, viewer.source(), &journal, clock.now_micros());
        }
    }
    drop(viewer);
    threads.block_on(server.close());
    ages.sort_by(f64::total_cmp);
    Outcome { new_frames_per_second: f64::from(num_new) / f64::from(MEASURED), ages, lives }
}

/// The lives of frames that were begun while it counts, as both sides know them, which read one clock.
fn collect(lives: &mut Vec<Life>, client: &Client, journal: &Journal, now_micros: u64) {
    let of_client = client.ledger();
    let since = now_micros - u64::from(MEASURED) * 1_000_000;
    for life in journal.lives() {
        let other = of_client.iter().find(|other| other.frame == life.frame);
        let whole = other.map_or(life, |other| life.joined(other));
        match lives.iter_mut().find(|known: &&mut Life| known.frame == whole.frame) {
            Some(known) => *known = whole,
            None => lives.push(whole),
        }
    }
    lives.retain(|life| life.at(Stage::Begun).is_some_and(|begun| begun >= since));
}

fn check(machine: Machine, rtt_ms: u64, mode: CodingMode) -> Result<(), String> {
    let played = play(machine, mode, Duration::from_millis(rtt_ms));
    let (fps, mean, p95) = (played.new_frames_per_second, played.mean_age(), played.p95_age());
    let in_vain = played.in_vain();
    let found = format!(
        "{mode:?}, round trip {rtt_ms} ms: {fps:.1} new frames a second, {mean:.1} ms old in the mean, {p95:.1} at p95; {in_vain} of {} in vain",
        played.lives.len()
    );
    eprintln!("{found}");
    let rtt = rtt_ms as f64;
    let is_met =
        fps >= LEAST_FPS && mean <= rtt + 45.0 && p95 <= rtt + 70.0 && in_vain * 100 <= played.lives.len();
    if is_met { Ok(()) } else { Err(found) }
}

/// New frames a second that the display of 60 Hz must get. A quiet machine gets 54 to 60, the control less than 40.
const LEAST_FPS: f64 = 47.0;

#[test]
fn a_fast_machines_frames_are_on_the_screen_as_old_as_the_link_and_little_older() {
    let ms = Duration::from_millis;
    let fast = Machine { generate: ms(2), encode: ms(6), decode: ms(5) };
    for mode in [CodingMode::Exact, CodingMode::Blocks] {
        for rtt_ms in [20, 100, 200] {
            // Other programs may have the machine for a moment.
            let tries: Vec<_> = (0..3).map_while(|_| check(fast, rtt_ms, mode).err()).collect();
            assert!(
                tries.len() < 3,
                "expected {LEAST_FPS} frames a second, RTT + 45 ms and RTT + 70 ms; found {tries:?}"
            );
        }
    }
    // The control: one whose coder takes 30 ms has less, and makes no more frames than it sends.
    let slow = Machine { encode: ms(30), ..fast };
    let played = play(slow, CodingMode::Exact, ms(20));
    assert!(played.new_frames_per_second < 40.0, "{}", played.new_frames_per_second);
    assert!(played.in_vain() * 20 <= played.lives.len(), "{} in vain", played.in_vain());
}

const SIZE: Intrinsics = Intrinsics::perspective(40, 30, 0.6);
const HZ: u32 = 60;
/// Seconds.
const WARM_UP: u32 = 2;
const MEASURED: u32 = 3;
