//! What frames do on each link.

use std::sync::Arc;
use std::time::Duration;

use quinn::congestion::CubicConfig;

use super::*;

const SECOND: Duration = Duration::from_secs(1);

/// Prints one row of the table for each link: `cargo test -p isinglass-net --release networks_table -- --ignored
/// --nocapture`.
#[test]
#[ignore = "prints a table"]
fn networks_table() {
    println!(
        "| link | control | age p50/p99 ms | bound | frames/s | sent Mbit/s | queue p95 ms | lost+dropped |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    for mbit in [5.0, 20.0, 50.0, 100.0] {
        for rtt_ms in [20, 40, 150, 300] {
            for loss in [0.0, 0.01, 0.02] {
                row(mbit, rtt_ms, loss);
            }
        }
    }
}

/// What one viewer had on a link, from the fifth second of its movement on.
#[derive(Debug)]
struct Run {
    /// Median and 99th percentile.
    age_ms: [f64; 2],
    /// What the 99th percentile should not exceed.
    bound_ms: f64,
    frames_per_second: f64,
    sent_mbit: f64,
    queue_ms: f64,
    num_lost: u64,
    num_dropped: u64,
}

impl Run {
    fn of(model: LinkModel, congestion: Option<Arc<dyn ControllerFactory + Send + Sync>>) -> Self {
        let (rtt_ms, mbit) = (model.rtt.as_secs_f64() * 1e3, model.bandwidth_mbit.unwrap_or(f64::INFINITY));
        let (shown, mut traffic) = one_viewer(model, congestion, 14 * SECOND, SECOND / 2);
        let (from, to) = (4e3, 14e3);
        traffic.queue_micros.sort_unstable();
        let frames_per_second = shown.frames_per_second(from, to);
        let wire_ms = shown.bytes as f64 / shown.frames.len().max(1) as f64 * 8.0 / mbit / 1e3;
        Self {
            age_ms: [shown.age(0.5, from, to), shown.age(0.99, from, to)],
            bound_ms: rtt_ms + 1.5e3 / frames_per_second.max(1.0) + wire_ms + 25.0,
            frames_per_second,
            sent_mbit: traffic.bytes as f64 * 8.0 / 14.5e6,
            queue_ms: traffic.queue_micros[traffic.queue_micros.len() * 95 / 100] as f64 / 1e3,
            num_lost: traffic.lost,
            num_dropped: traffic.dropped,
        }
    }
}

fn row(mbit: f64, rtt_ms: u64, loss: f64) {
    let congestions: [(&str, Option<Arc<dyn ControllerFactory + Send + Sync>>); 2] =
        [("delay", None), ("CUBIC", Some(Arc::new(CubicConfig::default())))];
    for (name, congestion) in congestions {
        let Run {
            age_ms: [p50, p99],
            bound_ms,
            frames_per_second,
            sent_mbit,
            queue_ms,
            num_lost,
            num_dropped,
        } = Run::of(link_model(mbit, rtt_ms, loss), congestion);
        let percent = loss * 100.0;
        println!(
            "| {mbit} Mbit/s, {rtt_ms} ms, {percent} % | {name} | {p50:.0}/{p99:.0} | {bound_ms:.0} | \
             {frames_per_second:.0} | {sent_mbit:.1} | {queue_ms:.0} | {num_lost}+{num_dropped} |"
        );
    }
}

/// The links on which the bound must hold, as an ordinary test.
#[test]
fn frames_are_as_old_as_the_link_makes_them() {
    for (mbit, rtt_ms, loss) in
        [(5.0, 20, 0.0), (20.0, 40, 0.0), (20.0, 40, 0.01), (50.0, 150, 0.02), (100.0, 300, 0.0)]
    {
        let run = Run::of(link_model(mbit, rtt_ms, loss), None);
        assert!(run.age_ms[1] <= run.bound_ms, "{mbit} Mbit/s, {rtt_ms} ms, {loss}: {run:?}");
        assert!(run.frames_per_second >= 55.0, "{run:?}");
        assert!(run.queue_ms <= 30.0 && run.sent_mbit <= 1.1 * mbit, "{run:?}");
    }
    // The control: CUBIC fills the queue, and takes each loss for one.
    for (mbit, rtt_ms, loss) in [(20.0, 40, 0.0), (50.0, 150, 0.02)] {
        let run = Run::of(link_model(mbit, rtt_ms, loss), Some(Arc::new(CubicConfig::default())));
        assert!(run.age_ms[1] > 1.5 * run.bound_ms && run.frames_per_second < 40.0, "{run:?}");
    }
}

#[test]
fn the_same_seed_is_the_same_run() {
    let model = |seed| LinkModel { seed, ..link_model(20.0, 40, 0.01) };
    let run = |seed| one_viewer(model(seed), None, 3 * SECOND, SECOND);
    let [a, b, c] = [7, 7, 8].map(run);
    assert_eq!((a.1.digest, &a.0.ages), (b.1.digest, &b.0.ages));
    assert_ne!(a.1.digest, c.1.digest);
}

#[test]
fn a_rest_becomes_exact_on_a_lossy_link() {
    let (shown, _) = one_viewer(link_model(50.0, 150, 0.02), None, 4 * SECOND, 2 * SECOND);
    let exact = shown.exact.iter().find(|at| **at > 4e3);
    assert!(exact.is_some_and(|at| *at < 6e3), "{:?}", shown.exact);
}
