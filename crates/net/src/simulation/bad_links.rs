//! What frames do where packets are lost in runs, or overtake each other.

use quinn::congestion::CubicConfig;

use super::*;

const SECOND: Duration = Duration::from_secs(1);

/// Median and 99th percentile of ages in ms, and frames a second, from the fifth second of the movement on.
fn played(model: LinkModel, congestion: Option<Arc<dyn ControllerFactory + Send + Sync>>) -> [f64; 3] {
    let (shown, _) = one_viewer(model, congestion, 14 * SECOND, SECOND / 2);
    let (from, to) = (4e3, 14e3);
    [shown.age(0.5, from, to), shown.age(0.99, from, to), shown.frames_per_second(from, to)]
}

fn cubic() -> Option<Arc<dyn ControllerFactory + Send + Sync>> {
    Some(Arc::new(CubicConfig::default()))
}

/// Parity restores what chance takes out of a frame. A run may take more, and then comes again a round trip later.
#[test]
fn losses_in_runs_cost_at_most_a_round_trip() {
    for (rtt_ms, loss, burst) in [(40, 0.01, 4.0), (40, 0.02, 8.0), (150, 0.02, 4.0)] {
        let model = LinkModel { burst, ..link_model(50.0, rtt_ms, loss) };
        let [p50, p99, fps] = played(model.clone(), None);
        println!("{rtt_ms} ms, {loss} in runs of {burst}: {p50:.0}/{p99:.0} ms, {fps:.0} frames/s");
        let bound = 2.0 * rtt_ms as f64 + 2.5e3 / 60.0 + 25.0;
        assert!(p50 <= rtt_ms as f64 + 45.0 && p99 <= bound && fps >= 50.0, "{p50} {p99} {fps}");
        let [p50, p99, fps] = played(model, cubic());
        println!("CUBIC: {p50:.0}/{p99:.0} ms, {fps:.0} frames/s");
        assert!(p99 > 1.2 * bound && fps < 40.0, "CUBIC: {p99} {fps}");
    }
}

#[test]
fn packets_that_overtake_each_other_are_no_lost_ones() {
    for jitter_ms in [2, 10] {
        let jitter = Duration::from_millis(jitter_ms);
        let reordered = LinkModel { jitter, reorder: true, ..link_model(20.0, 40, 0.0) };
        let [p50, p99, fps] = played(reordered.clone(), None);
        println!("{jitter_ms} ms: {p50:.0}/{p99:.0} ms, {fps:.0} frames/s");
        let bound = 40.0 + 2.0 * jitter_ms as f64 + 2.5e3 / 60.0 + 25.0;
        assert!(p99 <= bound && fps >= 50.0, "{p50} {p99} {fps}");
    }
    // The control: CUBIC halves its window whenever three packets overtake one.
    let jitter = Duration::from_millis(10);
    let [_, p99, fps] = played(LinkModel { jitter, reorder: true, ..link_model(20.0, 40, 0.0) }, cubic());
    println!("CUBIC: {p99:.0} ms, {fps:.0} frames/s");
    assert!(p99 > 200.0 || fps < 40.0, "CUBIC: {p99} {fps}");
}
