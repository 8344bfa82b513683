//! The state machine of the congestion control, without sockets and clocks.
//!
//! It knows two numbers of a path: the least round trip, and the rate at which the bottleneck delivers. As many bytes
//! may be in flight as the path holds at that rate, and a short queue. So the queue is bounded by construction, and a
//! lost packet says nothing.
//!
//! - The rate comes from *busy* times: packets that reach the bottleneck before their predecessors have left it are
//!   delivered at its rate, however little the application sends. Without busy times, what was delivered is a lower
//!   bound, and the window grows until there are some.
//! - The least round trip is that of the last ten seconds. A queue that never empties is drained once in that time.
//! - A queue that stays although this side has made room is another flow's. Then the window follows losses, as that
//!   flow's does, or it would get all of the link.
//! - A delay that comes at once, and does not fall with what is in flight, is a longer path's. It is measured anew.
//!
//! Ideas are from BBR (Cardwell et al. 2016), Copa (Arun and Balakrishnan 2018) and Pudica (Wang et al. 2024).

use std::ops::ControlFlow;

/// What is acknowledged at the same time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Batch {
    /// Sum over its packets.
    pub(super) bytes: f64,
    /// When its first and its last packet were sent, µs.
    pub(super) sent: (f64, f64),
}

/// Decides how many bytes may be in flight. Times are µs on any clock.
#[derive(Clone, Debug)]
pub(super) struct DelayControl {
    mtu: f64,
    least: LeastRoundTrip,
    smooth_rtt: f64,
    busy: Busy,
    floor: Floor,
    /// Rate of the bottleneck, bytes per µs; `None` before the first busy time.
    rate: Option<f64>,
    /// The window before the rate is known.
    start_window: f64,
    /// The share of the window that queues and losses leave.
    caution: f64,
    /// The factor by which the window grows while it is used and nothing queues.
    growth: f64,
    /// Number of round trips in a row in which the window was used and nothing queued.
    num_free: u32,
    round: Round,
    /// Since when the queue is longer than this side makes it, µs.
    queued_since: Option<f64>,
    /// The queue of the round trip before, µs.
    last_queue: f64,
    /// The fullest round trip of a delay that came at once.
    delayed: Option<Round>,
    competing: Option<Competing>,
    /// The end of a drain, µs.
    drained_at: Option<f64>,
    /// Losses over a short and a long time.
    losses: [Losses; 2],
    last: Option<(f64, f64)>,
}

/// Bytes that arrived and that were lost of late.
#[derive(Clone, Copy, Debug, Default)]
struct Losses {
    arrived: f64,
    lost: f64,
}

impl Losses {
    fn add_arrived(&mut self, bytes: f64, most: f64) {
        self.arrived += bytes;
        if self.arrived > most {
            (self.arrived, self.lost) = (self.arrived / 2.0, self.lost / 2.0);
        }
    }

    fn share(&self, mtu: f64) -> f64 {
        self.lost / (self.arrived + self.lost).max(50.0 * mtu)
    }
}

/// One round trip.
#[derive(Clone, Copy, Debug)]
struct Round {
    begun_at: f64,
    least_rtt: f64,
    num_batches: u32,
    acked: f64,
    lost: f64,
    is_used: bool,
    is_marked: bool,
}

/// Another flow fills the queue.
#[derive(Clone, Copy, Debug)]
struct Competing {
    window: f64,
    /// Since when the queue is short, µs.
    short_since: Option<f64>,
    has_lost: bool,
}

impl DelayControl {
    /// Starts with a window for the first round trip, bytes.
    pub(super) fn new(now: f64, mtu: u16, first_window: f64) -> Self {
        let mtu = f64::from(mtu);
        Self {
            mtu,
            least: LeastRoundTrip::default(),
            smooth_rtt: 0.0,
            busy: Busy::default(),
            floor: Floor::default(),
            rate: None,
            start_window: first_window.clamp(FEWEST_PACKETS * mtu, MAX_WINDOW),
            caution: 1.0,
            growth: 1.0,
            num_free: 0,
            round: Round::begin(now),
            queued_since: None,
            last_queue: 0.0,
            delayed: None,
            competing: None,
            drained_at: None,
            losses: [Losses::default(); 2],
            last: None,
        }
    }

    /// Bytes that may be in flight.
    pub(super) fn window(&self) -> f64 {
        let steady = match (self.rate, self.competing) {
            _ if self.drained_at.is_some() => self.rate.unwrap_or(0.0) * self.least.get() * DRAINING,
            (_, Some(other)) => other.window,
            (Some(rate), None) => self.caution * self.growth * rate * (self.least.get() + QUEUE_MICROS),
            (None, None) => self.caution * self.start_window,
        };
        steady.clamp(FEWEST_PACKETS * self.mtu, MAX_WINDOW)
    }

    /// Bytes per second that this side may send and that arrive; `None` before anything is known.
    pub(super) fn bytes_per_second(&self) -> Option<f64> {
        let rtt = self.smooth_rtt.max(1000.0);
        let known = match (self.competing, self.rate) {
            // A window that the application never fills does not grow.
            (Some(other), _) => OFFERED * other.window / rtt,
            (None, Some(rate)) => rate * self.caution,
            (None, None) => self.start_window * self.caution / rtt,
        };
        self.last.map(|_| known * 1e6)
    }

    /// Whether the rate is measured, and not only a lower bound.
    pub(super) fn knows_rate(&self) -> bool {
        self.rate.is_some()
    }

    /// The share of packets that were lost of late: the larger of two, because a short time shows a change and a long
    /// one is not led astray by chance.
    pub(super) fn loss(&self) -> f64 {
        self.losses.iter().map(|losses| losses.share(self.mtu)).fold(0.0, f64::max)
    }

    /// The least round trip of the path, µs.
    pub(super) fn least_rtt(&self) -> f64 {
        self.least.get()
    }

    pub(super) fn set_mtu(&mut self, mtu: u16) {
        self.mtu = f64::from(mtu);
    }

    /// Packets are acknowledged; `is_used` if the window, and not the application, was the limit.
    pub(super) fn handle_acked(&mut self, now: f64, batch: Batch, is_used: bool) {
        let rtt = (now - batch.sent.1).max(1.0);
        self.least.add(now, rtt);
        self.smooth_rtt = if self.smooth_rtt > 0.0 { self.smooth_rtt * 0.875 + rtt * 0.125 } else { rtt };
        self.round.add(&batch, rtt, is_used);
        for (losses, packets) in self.losses.iter_mut().zip(RECENT_PACKETS) {
            losses.add_arrived(batch.bytes, packets * self.mtu);
        }
        let least = self.least.get();
        if let Some(last) = self.last {
            let horizon = (2.0 * least).clamp(100e3, 400e3);
            self.busy.add(now, &batch, last, least, horizon);
        }
        self.last = Some((now, batch.sent.1));
        let floor = self.floor.add(now, &batch);
        let queue = rtt - least;
        match self.busy.rate(self.round.least_rtt - least > QUEUE_MICROS / 3.0) {
            Some(rate) => (self.rate, self.growth) = (Some(rate), 1.0),
            None if self.rate.is_some() => {
                let rate = self.rate.map(|rate| floor.map_or(rate, |floor| floor.max(rate)));
                self.rate = rate;
            }
            // Until something queues, each round trip doubles the window.
            None if is_used && queue < QUEUE_MICROS => self.start_window += batch.bytes,
            None => {}
        }
        if batch.sent.0 >= self.round.begun_at && self.round.num_batches >= FEWEST_BATCHES {
            self.end_round(now);
        }
        self.drained_at.take_if(|end| *end <= now);
    }

    /// Packets are lost.
    pub(super) fn handle_lost(&mut self, bytes: f64) {
        self.round.lost += bytes;
        self.losses.iter_mut().for_each(|losses| losses.lost += bytes);
    }

    /// A router marks packets because it queues them.
    pub(super) fn handle_marked(&mut self) {
        self.round.is_marked = true;
    }

    /// The path was dead for so long that nothing is known of it any more.
    pub(super) fn handle_outage(&mut self, now: f64) {
        self.round = Round::begin(now);
        (self.queued_since, self.competing, self.drained_at) = (None, None, None);
        self.caution = self.caution.max(0.5);
    }

    fn end_round(&mut self, now: f64) {
        let round = std::mem::replace(&mut self.round, Round::begin(now));
        let least = self.least.get();
        let queue = round.least_rtt - least;
        let loss = round.lost / (round.acked + round.lost).max(1.0);
        let is_lossy = loss > MAX_LOSS && round.lost > 3.0 * self.mtu;
        if self.rate.is_none() && (queue > QUEUE_MICROS || is_lossy) {
            // It queues before any busy time could be measured.
            self.rate = Some((round.acked / (now - round.begun_at).max(1.0)).max(self.mtu / 1e6));
        }
        if self.is_longer_path(&round, queue) {
            self.measure_anew(now, &round);
            return;
        }
        match self.note_queue(now, queue) {
            ControlFlow::Break(()) => return,
            ControlFlow::Continue(()) => {}
        }
        if let Some(other) = &mut self.competing {
            if round.lost > 0.0 || round.is_marked {
                other.window *= AFTER_LOSS;
                other.has_lost = true;
            } else if round.is_used && other.has_lost {
                other.window += PACKETS_A_ROUND * self.mtu;
            } else if round.is_used {
                other.window *= BEFORE_LOSS;
            }
            other.window = other.window.clamp(FEWEST_PACKETS * self.mtu, MAX_WINDOW);
        } else if queue > 1.5 * QUEUE_MICROS || round.is_marked {
            self.caution *= ((least + QUEUE_MICROS) / (least + queue)).clamp(0.7, 0.95);
        } else if is_lossy {
            self.caution *= 0.85;
        } else {
            let is_free = self.caution >= 1.0 && round.is_used && queue < QUEUE_MICROS / 3.0;
            // After a drain the queue is empty for a while, too.
            self.num_free = if is_free { self.num_free + 1 } else { 0 };
            match self.num_free {
                0 => self.growth = 1.0,
                1..=FEW_FREE => {}
                _ => self.growth = (self.growth * 1.25).min(2.0),
            }
            self.caution = (self.caution + 0.05).min(1.0);
        }
        self.caution = self.caution.max(LEAST_CAUTION);
        if self.least.is_old(now) && self.drained_at.is_none() {
            self.drained_at = Some(now + self.smooth_rtt + QUEUE_MICROS);
        }
    }

    /// Whether the delay came at once and stays while less is in flight. A queue of this side would shrink as much.
    fn is_longer_path(&mut self, round: &Round, queue: f64) -> bool {
        let before = std::mem::replace(&mut self.last_queue, queue);
        if self.competing.is_some() || queue < SUDDEN_MICROS {
            self.delayed = None;
            return false;
        }
        if before < QUEUE_MICROS || self.delayed.is_some_and(|fullest| round.acked > fullest.acked) {
            self.delayed = Some(*round);
        }
        self.delayed.is_some_and(|fullest| {
            round.acked < 0.75 * fullest.acked && round.least_rtt > 0.9 * fullest.least_rtt
        })
    }

    /// Forgets what was known of the path before this round trip.
    fn measure_anew(&mut self, now: f64, round: &Round) {
        self.least = LeastRoundTrip::default();
        self.least.add(now, round.least_rtt);
        self.busy = Busy::default();
        let held = self.rate.take().unwrap_or(0.0) * round.least_rtt;
        self.start_window = held.min(NEW_PATH_BYTES).max(round.acked);
        (self.caution, self.growth, self.num_free) = (1.0, 1.0, 0);
        (self.queued_since, self.delayed, self.last_queue) = (None, None, 0.0);
    }

    /// Notes how long the queue was for a whole round trip, µs. Enters and leaves the competition.
    fn note_queue(&mut self, now: f64, queue: f64) -> ControlFlow<()> {
        if queue < 2.0 * QUEUE_MICROS {
            self.queued_since = None;
        }
        match &mut self.competing {
            None if queue >= 2.0 * QUEUE_MICROS => {
                let since = *self.queued_since.get_or_insert(now);
                if now - since > PATIENCE_MICROS.max(4.0 * self.smooth_rtt) {
                    let window = self.rate.unwrap_or(0.0) * self.smooth_rtt;
                    self.competing = Some(Competing { window, short_since: None, has_lost: false });
                    self.caution = 1.0;
                    return ControlFlow::Break(());
                }
            }
            Some(other) if queue < QUEUE_MICROS => {
                let since = *other.short_since.get_or_insert(now);
                if now - since > PATIENCE_MICROS.max(4.0 * self.smooth_rtt) {
                    self.competing = None;
                    return ControlFlow::Break(());
                }
            }
            Some(other) => other.short_since = None,
            None => {}
        }
        ControlFlow::Continue(())
    }
}

impl Round {
    fn begin(now: f64) -> Self {
        let least_rtt = f64::INFINITY;
        Self {
            begun_at: now,
            least_rtt,
            num_batches: 0,
            acked: 0.0,
            lost: 0.0,
            is_used: false,
            is_marked: false,
        }
    }

    fn add(&mut self, batch: &Batch, rtt: f64, is_used: bool) {
        self.num_batches += 1;
        self.least_rtt = self.least_rtt.min(rtt);
        self.acked += batch.bytes;
        self.is_used |= is_used;
    }
}

/// Measures the bottleneck's rate while it is busy.
#[derive(Clone, Copy, Debug, Default)]
struct Busy {
    /// Sums that fade: bytes, time in which they arrived and in which they were sent, µs.
    bytes: f64,
    arriving: f64,
    sending: f64,
    /// The newest batch counts when the next one is of the same busy time: the last acknowledgement of a busy time
    /// may come late.
    pending: Option<(f64, f64, f64)>,
}

impl Busy {
    fn add(&mut self, now: f64, batch: &Batch, last: (f64, f64), least: f64, horizon: f64) {
        let (last_now, last_sent) = last;
        let elapsed = now - last_now;
        let kept = (-elapsed / horizon).exp();
        (self.bytes, self.arriving, self.sending) =
            (self.bytes * kept, self.arriving * kept, self.sending * kept);
        // It was at the bottleneck before the packet before it had left.
        let is_busy = batch.sent.0 + least <= last_now && elapsed < LONGEST_BUSY_MICROS;
        let pending = is_busy.then(|| (batch.bytes, elapsed, (batch.sent.1 - last_sent).max(0.0)));
        if let Some((bytes, arriving, sending)) = std::mem::replace(&mut self.pending, pending)
            && is_busy
        {
            self.bytes += bytes;
            self.arriving += arriving;
            self.sending += sending;
        }
    }

    /// Bytes per µs, if enough was seen; `is_queued` if even the shortest round trip has waited.
    fn rate(&self, is_queued: bool) -> Option<f64> {
        // Packets that arrive as they were sent only show the sender's rate, unless there is a queue.
        let is_slower = self.arriving > 1.05 * self.sending || is_queued;
        (self.arriving > FEWEST_BUSY_MICROS && is_slower).then(|| self.bytes / self.arriving)
    }
}

/// What was delivered for some time is a lower bound of the rate.
#[derive(Clone, Copy, Debug, Default)]
struct Floor {
    begun: Option<(f64, f64)>,
    bytes: f64,
}

impl Floor {
    /// Returns bytes per µs when enough time has passed.
    fn add(&mut self, now: f64, batch: &Batch) -> Option<f64> {
        let Some((begun, sent)) = self.begun else {
            (self.begun, self.bytes) = (Some((now, batch.sent.1)), 0.0);
            return None;
        };
        self.bytes += batch.bytes;
        // Packets that were delayed and come together were not sent together.
        let micros = (now - begun).max(batch.sent.1 - sent);
        if micros < FLOOR_MICROS {
            return None;
        }
        let rate = self.bytes / micros;
        (self.begun, self.bytes) = (Some((now, batch.sent.1)), 0.0);
        Some(rate)
    }
}

/// The least round trip of the last [`LEAST_FOR_MICROS`], µs.
#[derive(Clone, Copy, Debug)]
struct LeastRoundTrip {
    /// The least of the present half of that time, and of the one before.
    halves: [f64; 2],
    begun_at: f64,
    /// When a round trip was last as short.
    met_at: f64,
}

impl Default for LeastRoundTrip {
    fn default() -> Self {
        Self { halves: [f64::INFINITY; 2], begun_at: f64::NEG_INFINITY, met_at: 0.0 }
    }
}

impl LeastRoundTrip {
    fn add(&mut self, now: f64, rtt: f64) {
        let half = LEAST_FOR_MICROS / 2.0;
        if now - self.begun_at > half {
            let is_long_ago = now - self.begun_at > 2.0 * half;
            self.halves = [f64::INFINITY, if is_long_ago { f64::INFINITY } else { self.halves[0] }];
            self.begun_at = now;
        }
        self.halves[0] = self.halves[0].min(rtt);
        if rtt <= self.get() + NEAR_LEAST_MICROS {
            self.met_at = now;
        }
    }

    /// 0 before the first.
    fn get(&self) -> f64 {
        let least = self.halves[0].min(self.halves[1]);
        if least.is_finite() { least } else { 0.0 }
    }

    /// Whether no round trip was as short for long.
    fn is_old(&self, now: f64) -> bool {
        now - self.met_at > LEAST_FOR_MICROS * 0.8
    }
}

/// The queue that this side makes at most, µs. Acknowledgements alone may be 5 ms late.
const QUEUE_MICROS: f64 = 15e3;
/// Loss that no queue explains is borne up to this share.
const MAX_LOSS: f64 = 0.1;
const LEAST_CAUTION: f64 = 0.3;
/// A delay that comes within one round trip and may be a longer path's.
const SUDDEN_MICROS: f64 = 4.0 * QUEUE_MICROS;
/// How long a queue must stay, or be gone, until another flow is held responsible.
const PATIENCE_MICROS: f64 = 400e3;
/// The competition is that of a loss-based flow, somewhat bolder than NewReno.
const AFTER_LOSS: f64 = 0.8;
const PACKETS_A_ROUND: f64 = 12.0;
const BEFORE_LOSS: f64 = 1.2;
const OFFERED: f64 = 1.12;
/// Share of the path's content that stays while it is drained.
const DRAINING: f64 = 0.6;
const LEAST_FOR_MICROS: f64 = 10e6;
const NEAR_LEAST_MICROS: f64 = 8e3;
const FEWEST_BUSY_MICROS: f64 = 6e3;
/// So long without a packet is a pause, and not a packet's time on the wire.
const LONGEST_BUSY_MICROS: f64 = 60e3;
const FLOOR_MICROS: f64 = 20e3;
/// What a path of unknown rate takes at first.
const NEW_PATH_BYTES: f64 = 64e3;
const FEWEST_BATCHES: u32 = 3;
const FEW_FREE: u32 = 2;
const FEWEST_PACKETS: f64 = 4.0;
/// Losses are those of about so many packets.
const RECENT_PACKETS: [f64; 2] = [800.0, 8000.0];
const MAX_WINDOW: f64 = (1u64 << 28) as f64;

#[cfg(test)]
mod tests;
