//! Congestion control for frames: driven by delay and delivery rate, not by single losses.
//!
//! [`control`] decides. Here it is plugged into quinn, which asks for the window, and a [`LinkGauge`] tells the
//! application what it knows of the path.

mod control;

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Instant;

use quinn::congestion::{Controller, ControllerFactory};
use quinn_proto::RttEstimator;

use control::{Batch, DelayControl};

/// What the congestion control of one connection knows. Its numbers are of the newest acknowledgement.
#[derive(Debug, Default)]
pub(crate) struct LinkGauge {
    /// 0 if unknown.
    bytes_per_second: AtomicU64,
    least_rtt_micros: AtomicU64,
    knows_rate: AtomicBool,
    /// Millionths.
    loss: AtomicU64,
    /// Bytes that may be in flight beyond the window, because the peer was heard while nothing is acknowledged.
    extra_bytes: AtomicU64,
}

impl LinkGauge {
    /// What is known of a path, for tests.
    #[cfg(test)]
    pub(crate) fn of(bytes_per_second: f64, least_rtt_micros: u64) -> Self {
        Self {
            bytes_per_second: AtomicU64::new(bytes_per_second as u64),
            least_rtt_micros: AtomicU64::new(least_rtt_micros),
            knows_rate: AtomicBool::new(true),
            ..Self::default()
        }
    }

    /// Rate of the path; `None` if it is unknown.
    pub(crate) fn bytes_per_second(&self) -> Option<f64> {
        let rate = self.bytes_per_second.load(Ordering::Relaxed);
        (rate > 0).then_some(rate as f64)
    }

    /// Whether the rate is measured, and not only what has been sent so far.
    pub(crate) fn knows_rate(&self) -> bool {
        self.knows_rate.load(Ordering::Relaxed)
    }

    /// The share of packets that were lost of late.
    pub(crate) fn loss(&self) -> f64 {
        self.loss.load(Ordering::Relaxed) as f64 / 1e6
    }

    /// The least round trip of the path, µs; 0 if unknown.
    pub(crate) fn least_rtt_micros(&self) -> u64 {
        self.least_rtt_micros.load(Ordering::Relaxed)
    }

    /// The peer is heard after an outage. Everything in flight is lost, but only the next acknowledgement shows it,
    /// and retransmission timers are long by now. So a few more packets may go at once.
    pub(crate) fn handle_heard_again(&self) {
        self.extra_bytes.fetch_add(EXTRA_BYTES, Ordering::Relaxed);
    }
}

/// Makes the congestion control of one connection.
#[derive(Clone, Debug)]
pub(crate) struct DelayConfig {
    pub(crate) gauge: Arc<LinkGauge>,
    /// Window for the first round trip, bytes.
    pub(crate) first_window_bytes: u64,
}

impl Default for DelayConfig {
    fn default() -> Self {
        Self { gauge: Arc::default(), first_window_bytes: FIRST_WINDOW_BYTES }
    }
}

impl ControllerFactory for DelayConfig {
    fn build(self: Arc<Self>, now: Instant, mtu: u16) -> Box<dyn Controller> {
        let controller = DelayController {
            control: DelayControl::new(0.0, mtu, self.first_window_bytes as f64),
            epoch: now,
            batch: None,
            was_idle: true,
            config: (*self).clone(),
        };
        controller.publish();
        Box::new(controller)
    }
}

/// quinn's view of a [`DelayControl`].
#[derive(Clone, Debug)]
struct DelayController {
    control: DelayControl,
    epoch: Instant,
    batch: Option<Batch>,
    was_idle: bool,
    config: DelayConfig,
}

impl DelayController {
    fn micros(&self, at: Instant) -> f64 {
        at.saturating_duration_since(self.epoch).as_nanos() as f64 / 1e3
    }

    fn publish(&self) {
        let gauge = &self.config.gauge;
        let rate = self.control.bytes_per_second().unwrap_or(0.0);
        gauge.bytes_per_second.store(rate as u64, Ordering::Relaxed);
        gauge.knows_rate.store(self.control.knows_rate(), Ordering::Relaxed);
        gauge.loss.store((self.control.loss() * 1e6) as u64, Ordering::Relaxed);
        gauge.least_rtt_micros.store(self.control.least_rtt() as u64, Ordering::Relaxed);
    }
}

impl Controller for DelayController {
    fn on_ack(&mut self, _now: Instant, sent: Instant, bytes: u64, app_limited: bool, _: &RttEstimator) {
        let sent = self.micros(sent);
        self.was_idle = app_limited;
        let batch = self.batch.get_or_insert(Batch { bytes: 0.0, sent: (sent, sent) });
        batch.bytes += bytes as f64;
        batch.sent = (batch.sent.0.min(sent), batch.sent.1.max(sent));
    }

    fn on_end_acks(&mut self, now: Instant, _in_flight: u64, _app_limited: bool, _largest: Option<u64>) {
        if let Some(batch) = self.batch.take() {
            self.control.handle_acked(self.micros(now), batch, !self.was_idle);
            self.config.gauge.extra_bytes.store(0, Ordering::Relaxed);
            self.publish();
        }
    }

    fn on_congestion_event(&mut self, now: Instant, _sent: Instant, is_persistent: bool, lost_bytes: u64) {
        match lost_bytes {
            0 => self.control.handle_marked(),
            bytes => self.control.handle_lost(bytes as f64),
        }
        if is_persistent {
            self.control.handle_outage(self.micros(now));
        }
        self.publish();
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.control.set_mtu(new_mtu);
    }

    fn window(&self) -> u64 {
        self.control.window() as u64 + self.config.gauge.extra_bytes.load(Ordering::Relaxed)
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(self.clone())
    }

    fn initial_window(&self) -> u64 {
        self.config.first_window_bytes
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}

/// The congestion control of a viewer: a constant window. A viewer sends poses at a bounded rate and hardly anything
/// else, and they must go on while nothing is acknowledged, so that the server hears when the link is back.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ViewerWindow;

impl ControllerFactory for ViewerWindow {
    fn build(self: Arc<Self>, _: Instant, _: u16) -> Box<dyn Controller> {
        Box::new(Self)
    }
}

impl Controller for ViewerWindow {
    fn on_congestion_event(&mut self, _: Instant, _: Instant, _: bool, _: u64) {}

    fn on_mtu_update(&mut self, _: u16) {}

    fn window(&self) -> u64 {
        VIEWER_WINDOW_BYTES
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(*self)
    }

    fn initial_window(&self) -> u64 {
        VIEWER_WINDOW_BYTES
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}

/// Poses of two minutes.
const VIEWER_WINDOW_BYTES: u64 = 1 << 20;
/// 32 packets: what a slow link delivers in some tens of milliseconds.
pub(crate) const FIRST_WINDOW_BYTES: u64 = 32 * 1200;
const EXTRA_BYTES: u64 = 16 * 1200;
