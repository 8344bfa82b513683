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
    println!("| link | control | age p50/p99 ms | bound | frames/s | sent Mbit/s | queue p95 ms | lost+dropped |");
    println!("|---|---|---|---|---|---|---|---|");
    for mbit in [5.0, 20.0, 50.0, 100.0] {
        for rtt_ms in [20, 40, 150, 300] {
            for loss in [0.0, 0.01, 0.02] {
                row(mbit, rtt_ms, loss);
            }
        }
    }
}

fn row(mbit: f64, rtt_ms: u64, loss: f64) {
    let congestions: [(&str, Option<Arc<dyn ControllerFactory + Send + Sync>>); 2] =
        [("delay", None), ("CUBIC", Some(Arc::new(CubicConfig::default())))];
    for (name, congestion) in congestions {
        let (shown, traffic) = one_viewer(link_model(mbit, rtt_ms, loss), congestion, 12 * SECOND, SECOND / 2);
        let (from, to) = (2e3, 12e3);
        let mut queue = traffic.queue_micros.clone();
        queue.sort_unstable();
        let queue_ms = queue[queue.len() * 95 / 100] as f64 / 1e3;
        let fps = shown.frames_per_second(from, to);
        let wire_ms = shown.bytes as f64 / shown.frames.len().max(1) as f64 * 8.0 / mbit / 1e3;
        let bound = rtt_ms as f64 + 1.5e3 / fps.max(1.0) + wire_ms + 25.0;
        println!(
            "| {mbit} Mbit/s, {rtt_ms} ms, {} % | {name} | {:.0}/{:.0} | {bound:.0} | {fps:.0} | {:.1} | {queue_ms:.0} | {}+{} |",
            loss * 100.0,
            shown.age(0.5, from, to),
            shown.age(0.99, from, to),
            traffic.bytes as f64 * 8.0 / 12.5e6,
            traffic.lost,
            traffic.dropped,
        );
    }
}
