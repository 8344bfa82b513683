use std::collections::VecDeque;

use super::*;

const MTU: u16 = 1200;

/// A link that carries so many bytes a µs with this round trip; the sender always fills its window.
struct Bottleneck {
    rate: f64,
    least: f64,
    free_at: f64,
    /// When each pair was sent and arrives.
    in_flight: VecDeque<(f64, f64)>,
}

impl Bottleneck {
    /// Sends pairs of packets for `micros`, as the window allows; returns the longest wait in the queue, µs.
    fn run(&mut self, control: &mut DelayControl, from: f64, micros: f64) -> f64 {
        let (mut now, mut longest) = (from, 0f64);
        let packet = f64::from(MTU);
        while now < from + micros {
            while (self.in_flight.len() as f64 + 1.0) * 2.0 * packet <= control.window() {
                self.free_at = self.free_at.max(now) + 2.0 * packet / self.rate;
                longest = longest.max(self.free_at - now);
                self.in_flight.push_back((now, self.free_at + self.least));
            }
            let Some((sent, at)) = self.in_flight.pop_front() else { break };
            now = now.max(at);
            control.handle_acked(now, Batch { bytes: 2.0 * packet, sent: (sent, sent) }, true);
        }
        longest
    }
}

#[test]
fn a_full_link_has_a_short_queue_and_its_rate_is_known() {
    for mbit in [2.0, 20.0, 200.0] {
        for least_ms in [5.0, 40.0, 300.0] {
            let mut link = Bottleneck {
                rate: mbit / 8.0,
                least: least_ms * 1e3,
                free_at: 0.0,
                in_flight: VecDeque::new(),
            };
            let mut control = DelayControl::new(0.0, MTU, 32.0 * f64::from(MTU));
            link.run(&mut control, 0.0, 12e6);
            let longest = link.run(&mut control, 12e6, 6e6);
            let found = control.bytes_per_second().unwrap_or(0.0) * 8e-6;
            assert!((0.9..1.1).contains(&(found / mbit)), "{mbit} Mbit/s, {least_ms} ms: {found}");
            // The shortest queue, and a few packets.
            assert!(
                longest < 3.0 * QUEUE_MICROS + 16.0 * f64::from(MTU) / link.rate,
                "{mbit} Mbit/s, {least_ms} ms: {longest} µs of queue"
            );
        }
    }
}

#[test]
fn single_losses_change_nothing_and_a_broken_link_does() {
    let mut link = Bottleneck { rate: 2.5, least: 40e3, free_at: 0.0, in_flight: VecDeque::new() };
    let mut control = DelayControl::new(0.0, MTU, 38_400.0);
    let mut now = 0.0;
    let mut rate_with = |loss: f64| {
        for _ in 0..100 {
            link.run(&mut control, now, 50e3);
            now += 50e3;
            control.handle_lost(loss * 125e3);
        }
        control.bytes_per_second().unwrap_or(0.0)
    };
    let (clean, lossy, broken) = (rate_with(0.0), rate_with(0.02), rate_with(0.3));
    assert!(lossy > 0.95 * clean, "{lossy} of {clean}");
    assert!(broken < 0.7 * clean, "{broken} of {clean}");
}

#[test]
fn anything_that_happens_leaves_a_bounded_window() {
    let mut random = 88_172_645_463_325_252u64;
    let mut next = |below: u64| {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random % below
    };
    for _ in 0..200 {
        let (mut now, mut control) = (0.0, DelayControl::new(0.0, MTU, next(1 << 40) as f64));
        for _ in 0..2000 {
            now += [0.0, 1.0, 1e3, 1e5, 1e9][next(5) as usize] * next(100) as f64;
            let sent = now - [0.0, 10.0, 1e4, 1e6, 1e10][next(5) as usize] * next(10) as f64;
            match next(20) {
                0 => control.handle_lost(next(1 << 40) as f64),
                1 => control.handle_marked(),
                2 => control.handle_outage(now),
                3 => control.set_mtu(1200 + next(60_000) as u16),
                _ => {
                    let earlier = sent - next(100_000) as f64;
                    let batch = Batch { bytes: next(1 << 30) as f64, sent: (earlier, sent) };
                    control.handle_acked(now, batch, next(2) == 0);
                }
            }
            let (window, rate) = (control.window(), control.bytes_per_second().unwrap_or(0.0));
            assert!((FEWEST_PACKETS * f64::from(MTU)..=MAX_WINDOW).contains(&window), "{window}");
            assert!(rate.is_finite() && rate >= 0.0 && (0.0..=1.0).contains(&control.loss()), "{rate}");
        }
    }
}
