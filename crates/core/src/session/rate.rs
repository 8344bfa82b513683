//! How each frame of a connection is coded: what is shown earliest and best over the link as it is.
//!
//! While the camera moves, frames in blocks get the quality whose bytes the link carries in the time that a frame may
//! take, at most the one asked for. When it rests, the same frame goes out again finer, and then exactly.

use super::round_trip::{LeastRtt, is_longer};
use crate::codec::blocks::{self, RateControl};
use crate::codec::{Coding, Settings};

/// Which codings a connection uses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mode {
    /// Exact frames only.
    Exact,
    /// Frames in blocks only.
    Blocks,
    /// Blocks while the camera moves and exact frames where it rests, or where they are shown hardly later.
    #[default]
    Auto,
}

impl Mode {
    /// As it is asked for.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Exact => "exact",
            Self::Blocks => "blocks",
            Self::Auto => "auto",
        }
    }
}

/// What was asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    /// The codings.
    pub mode: Mode,
    /// Best quality of frames in blocks while the camera moves, 0 to [`blocks::MAX_QUALITY`].
    pub quality: u8,
    /// Most bytes a second; none: what the link carries.
    pub bytes_per_second: Option<f64>,
}

impl Default for Plan {
    fn default() -> Self {
        Self { mode: Mode::default(), quality: DEFAULT_QUALITY, bytes_per_second: None }
    }
}

impl Plan {
    /// Nothing but exact frames.
    pub const EXACT: Self = Self { mode: Mode::Exact, quality: DEFAULT_QUALITY, bytes_per_second: None };
}

/// What the transport knows of the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LinkState {
    /// Bytes that may be on their way at the same time.
    pub window_bytes: u64,
    /// Round-trip time now, smoothed, µs.
    pub rtt_micros: u64,
    /// The least there ever was, µs.
    pub least_rtt_micros: u64,
}

impl LinkState {
    /// What passes in a second with this window.
    fn bytes_per_second(&self) -> f64 {
        self.window_bytes as f64 * 1e6 / self.rtt_micros.max(MIN_RTT_MICROS) as f64
    }

    /// How long packets wait somewhere on the way, s.
    fn queue_seconds(&self) -> f64 {
        self.rtt_micros.saturating_sub(self.least_rtt_micros) as f64 / 1e6
    }

    /// Whether packets wait somewhere on the way, so that the window is all that the link carries.
    fn is_queueing(&self) -> bool {
        is_longer(self.rtt_micros, self.least_rtt_micros)
    }
}

/// Decides how the frames of one connection are coded.
///
/// For each frame: `handle_generated`, `handle_turned`, `handle_link`, then `next` (or `finer` for one that is sent again because the
/// camera rests), and `handle_encoded` when that is done.
#[derive(Clone, Debug)]
pub struct Pilot {
    plan: Plan,
    control: RateControl,
    /// What the link carries, bytes a second, as far as it has shown; none: no queue was seen.
    ceiling: Option<f64>,
    link: Option<LinkState>,
    least_rtt: LeastRtt,
    /// When the link was looked at last, µs.
    looked_at_micros: u64,
    generate_micros: f64,
    /// From frame to frame of a moving camera, µs.
    interval_micros: Mean,
    /// How far frames of a moving camera are turned when they are seen, degrees; none: it is not known.
    turned_deg: Option<f32>,
    /// Whether the next one is seen so.
    is_turned: bool,
    /// Time to encode a list, µs, exactly and in blocks, and bytes of a list of an exact frame.
    exact_micros: Mean,
    blocks_micros: Mean,
    exact_bytes: Mean,
    /// The best quality that is encoded in time.
    timely_quality: f64,
}

impl Pilot {
    /// Knows nothing of the link yet.
    pub fn new(plan: Plan) -> Self {
        Self {
            plan,
            control: RateControl::new(usize::MAX),
            ceiling: None,
            link: None,
            least_rtt: LeastRtt::default(),
            looked_at_micros: 0,
            generate_micros: 0.0,
            interval_micros: Mean::default(),
            turned_deg: None,
            is_turned: false,
            exact_micros: Mean::default(),
            blocks_micros: Mean::default(),
            exact_bytes: Mean::default(),
            timely_quality: blocks::MAX_QUALITY.into(),
        }
    }

    /// A frame was generated in so many µs.
    pub fn handle_generated(&mut self, micros: u64) {
        self.generate_micros = micros as f64;
    }

    /// While the camera moves, frames are begun so many µs after each other.
    pub fn handle_interval(&mut self, micros: u64) {
        self.interval_micros.add(micros as f64);
    }

    /// The viewer shows frames turned by so many degrees; none: the next frame is not one of a moving camera, or that is not
    /// known.
    pub fn handle_turned(&mut self, degrees: Option<u8>) {
        self.is_turned = degrees.is_some();
        if let Some(now) = degrees {
            // A view that was jumped to says no more than one that is far off.
            let now = f32::from(now).min(f32::from(blocks::MAX_TURN_DEG) / MEANT);
            self.turned_deg = Some(now + TURN_KEPT * (self.turned_deg.unwrap_or(now) - now));
        }
    }

    /// The link is like this now, on a clock that does not run backwards.
    pub fn handle_link(&mut self, now_micros: u64, link: LinkState) {
        let least_rtt_micros = self.least_rtt.handle(now_micros, link.rtt_micros, link.least_rtt_micros);
        let link = LinkState { least_rtt_micros, ..link };
        let since = (now_micros.saturating_sub(self.looked_at_micros) as f64).min(MAX_GROWTH_MICROS);
        (self.link, self.looked_at_micros) = (Some(link), now_micros);
        // A full queue shows what the link carries. Later, the window may stand for the queue too, so it is believed only
        // step by step.
        self.ceiling = if link.is_queueing() {
            Some(link.bytes_per_second())
        } else {
            self.ceiling.map(|c| c * (since / DOUBLED_IN_MICROS).exp2())
        };
    }

    /// What the link is taken to carry, bytes a second: infinite as long as it is not known.
    pub fn bytes_per_second(&self) -> f64 {
        let link = self.link.map_or(f64::INFINITY, |link| {
            // A window without a queue is not all that the link carries: it grows when it is filled.
            let open = if self.least_rtt.is_draining() {
                FILLING / 3.0
            } else if link.is_queueing() {
                (FILLING - link.queue_seconds() / DRAINED_IN_SECONDS).max(FILLING / 3.0)
            } else {
                OPENING
            };
            (link.bytes_per_second() * open).min(self.ceiling.map_or(f64::INFINITY, |c| c * FILLING))
        });
        link.min(self.plan.bytes_per_second.unwrap_or(f64::INFINITY))
    }

    /// The coding of the next frame, of `num_lists` lists; `is_predicted` if there is a frame to predict it from.
    pub fn next(&mut self, num_lists: usize, is_predicted: bool) -> Coding {
        let rate = self.bytes_per_second();
        let lists = num_lists as f64;
        // Generating a frame and encoding the one before go on at the same time.
        let making = self.generate_micros.max(self.blocks_micros.get() * lists);
        let age = making + self.link.map_or(0.0, |link| link.least_rtt_micros as f64);
        // Where frames are made fast, a newer one is worth more than the bytes of one that takes its time.
        let interval = self.interval_micros.get_or(FRAME_MICROS).clamp(LEAST_FRAME_MICROS, FRAME_MICROS);
        let share = SHARE_OF_AGE * (making / FRAME_MICROS).min(1.0);
        let budget = rate * (interval.max(age * share) / 1e6);
        self.control.set_target((budget * counted(num_lists)) as usize);
        let best = self.plan.quality.min(self.timely_quality as u8).max(LEAST_QUALITY);
        let quality = self.control.quality(is_predicted).clamp(LEAST_QUALITY, best);
        let turned_deg = self.turned_deg.filter(|_| self.is_turned);
        let turn_deg =
            turned_deg.map(|t| ((MEANT * t).round() as u8).clamp(LEAST_TURN_DEG, blocks::MAX_TURN_DEG));
        let in_blocks = Coding::Blocks(blocks::Settings { turn_deg, ..blocks::Settings::of(quality) });
        match self.plan.mode {
            Mode::Exact => Coding::default(),
            Mode::Blocks => in_blocks,
            Mode::Auto => {
                let bytes = self.control.expected_bytes(is_predicted, quality);
                let (Some(bytes), true) = (bytes, self.exact_bytes.is_known()) else { return in_blocks };
                let bytes = f64::from(bytes) / counted(num_lists);
                let exact = self.exact_bytes.get() * lists;
                // Bytes are what a link feels: that blocks took longer to encode, as the first ones do, makes up for none.
                let longer = (self.exact_micros.get() - self.blocks_micros.get()).max(0.0);
                let later = longer * lists + (exact - bytes) * 1e6 / rate;
                let may_be_later = (EXACT_SHARE_OF_INTERVAL * interval).max(making * EXACT_SHARE_OF_MAKING);
                if later < may_be_later { Coding::default() } else { in_blocks }
            }
        }
    }

    /// How a frame that was last sent as `sent` is sent once more, because the camera rests; `None` if it cannot be
    /// better.
    pub fn finer(&self, num_lists: usize, sent: &Coding) -> Option<Coding> {
        let exact = Coding::Exact(Settings { num_groups: 1, ..Settings::default() });
        let at = |quality| Coding::Blocks(blocks::Settings::of(quality));
        let Coding::Blocks(last) = sent else { return None };
        match self.plan.mode {
            Mode::Exact => None,
            Mode::Blocks => {
                let is_for_turn = last.turn_deg.is_some();
                let best = self.plan.quality.max(last.quality);
                (is_for_turn || last.quality < best).then(|| at(best))
            }
            Mode::Auto => {
                let bytes = self.exact_bytes.get_or(EXACT_BYTES_PER_LIST) * num_lists as f64;
                let takes_long = bytes / self.bytes_per_second() > LONG_SECONDS;
                Some(if takes_long && last.quality < FINE_QUALITY { at(FINE_QUALITY) } else { exact })
            }
        }
    }

    /// A frame was encoded.
    pub fn handle_encoded(
        &mut self,
        coding: &Coding,
        is_predicted: bool,
        num_lists: usize,
        bytes: usize,
        micros: u64,
    ) {
        let lists = num_lists.max(1) as f64;
        match coding {
            Coding::Exact(_) => {
                self.exact_micros.add(micros as f64 / lists);
                self.exact_bytes.add(bytes as f64 / lists);
            }
            Coding::Blocks(settings) => {
                self.blocks_micros.add(micros as f64 / lists);
                // Where frames are generated fast, a newer one is worth more than a finer one that waits for its coding.
                let in_time = CODING_MICROS.max(self.generate_micros);
                let timely = f64::from(settings.quality)
                    - QUALITY_PER_OCTAVE * (micros.max(1) as f64 / in_time).log2();
                let mut now = self.timely_quality + TIMELY_TAKEN * (timely - self.timely_quality);
                if (micros as f64) < in_time {
                    // It says nothing against the best.
                    now = now.max(self.timely_quality);
                }
                self.timely_quality = now.clamp(LEAST_TIMELY_QUALITY, blocks::MAX_QUALITY.into());
                let bytes = (bytes as f64 * counted(num_lists)) as usize;
                self.control.observe(is_predicted, settings.quality, bytes);
            }
        }
    }
}

/// Bytes that the control counts for one of a frame: as those of a frame of [`COUNTED_LISTS`], since frames change their
/// size with their margin and while the camera moves.
fn counted(num_lists: usize) -> f64 {
    COUNTED_LISTS / num_lists.max(1) as f64
}

/// A mean that forgets.
#[derive(Clone, Copy, Debug, Default)]
struct Mean(Option<f64>);

impl Mean {
    fn add(&mut self, value: f64) {
        self.0 = Some(self.0.map_or(value, |mean| mean + 0.3 * (value - mean)));
    }

    fn get(&self) -> f64 {
        self.get_or(0.0)
    }

    fn get_or(&self, unknown: f64) -> f64 {
        self.0.unwrap_or(unknown)
    }

    fn is_known(&self) -> bool {
        self.0.is_some()
    }
}

/// Large, as the control counts in whole bytes.
const COUNTED_LISTS: f64 = (1 << 20) as f64;
/// The best quality if none is asked for: where the link carries it, a picture's fault is worth more than its bytes.
pub const DEFAULT_QUALITY: u8 = blocks::MAX_QUALITY;
/// Frames get no worse than this, however narrow the link: below, bytes hardly fall any more.
pub const LEAST_QUALITY: u8 = 5;
/// Quality between that of a moving camera and an exact frame.
const FINE_QUALITY: u8 = 90;
/// Time that a frame of a moving camera may take on the link: until the next one follows, at most a thirtieth of a second. Or, where
/// frames take longer in the making, a part of the age that they are shown with anyway, by that and the way to and fro: the age grows
/// by as much, and the picture has the more bytes (docs/BENCHMARKS.md).
const FRAME_MICROS: f64 = 1e6 / 30.0;
const LEAST_FRAME_MICROS: f64 = 1e6 / 240.0;
const SHARE_OF_AGE: f64 = 0.25;
/// Time that a frame of a moving camera may take to be encoded, unless it takes longer to be generated: some 30 frames a
/// second.
const CODING_MICROS: f64 = 30_000.0;
/// So much less quality takes half the time to encode.
const QUALITY_PER_OCTAVE: f64 = 40.0;
/// Part of what a frame says of the quality that is encoded in time: first frames take longer.
const TIMELY_TAKEN: f64 = 0.3;
/// No frame is made worse than this to be encoded in time: below, time hardly falls any more.
const LEAST_TIMELY_QUALITY: f64 = 40.0;
/// An exact frame is worth so much delay: half the time to the next frame, or a part of the time in the making.
const EXACT_SHARE_OF_INTERVAL: f64 = 0.48;
const EXACT_SHARE_OF_MAKING: f64 = 0.15;
/// A wait for the exact frame so long is worth a finer one on the way.
const LONG_SECONDS: f64 = 0.25;
/// What a list of an exact frame takes as long as none was seen.
const EXACT_BYTES_PER_LIST: f64 = 8.0;
/// Frames are made to be seen at least so far turned: the camera moves, so none is seen from its own pose alone.
const LEAST_TURN_DEG: u8 = 1;
/// Part of the turn that frames are made for: seen nearer than they are meant for they lose more than seen further, and a
/// camera that stops sees them from near.
const MEANT: f32 = 0.5;
/// Part of the turn before that stays, frame by frame.
const TURN_KEPT: f32 = 0.75;
/// Part of what the link carries that frames may fill.
const FILLING: f64 = 0.9;
/// A queue on the way shall be gone after so long.
const DRAINED_IN_SECONDS: f64 = 0.5;
/// Times the window that frames may fill when nothing queues: in one round trip more would not be noticed.
const OPENING: f64 = 2.0;
/// Without a queue the link is taken to carry twice as much after so long, however many frames that were; and no more than
/// twice as much from one frame to the next.
const DOUBLED_IN_MICROS: f64 = 1e6;
const MAX_GROWTH_MICROS: f64 = DOUBLED_IN_MICROS;
/// Clocks and threads do not tell shorter round trips.
const MIN_RTT_MICROS: u64 = 500;

#[cfg(test)]
mod tests {
    use super::*;

    const LISTS: usize = 1 << 16;

    fn quality(coding: Coding) -> Option<u8> {
        match coding {
            Coding::Blocks(settings) => Some(settings.quality),
            Coding::Exact(_) => None,
        }
    }

    /// A link of so many bytes a second that carries one frame after the other: a round trip, and whatever queues.
    struct FakeLink {
        bytes_per_second: f64,
        rtt_micros: f64,
        window: f64,
        queued: f64,
    }

    impl FakeLink {
        fn new(megabytes: f64) -> Self {
            Self { bytes_per_second: megabytes * 1e6, rtt_micros: 1e5, window: 76_800.0, queued: 0.0 }
        }

        /// 33 ms in which `bytes` are handed over, and what the transport sees then.
        fn send(&mut self, bytes: f64) -> LinkState {
            let in_flight = self.bytes_per_second * self.rtt_micros / 1e6;
            self.queued = (self.queued + bytes - self.bytes_per_second / 30.0).max(0.0);
            // Never more than the window is on its way; it grows as long as it is filled and nothing is lost.
            if bytes * 30.0 * self.rtt_micros / 1e6 + self.queued > self.window {
                self.window = (self.window * 1.3).min(in_flight * 3.0);
            }
            self.queued = self.queued.min(self.window - in_flight.min(self.window));
            LinkState {
                window_bytes: self.window as u64,
                rtt_micros: (self.rtt_micros + self.queued / self.bytes_per_second * 1e6) as u64,
                least_rtt_micros: 100_000,
            }
        }
    }

    /// Bytes of a frame of a quality: what the codec does, with a slope of its own.
    fn bytes_at(quality: u8, hardness: f64) -> f64 {
        hardness * 4_000.0 * (f64::from(quality) * 0.033).exp2()
    }

    #[test]
    fn frames_are_made_for_the_turn_they_are_seen_at() {
        let mut pilot = Pilot::new(Plan { mode: Mode::Blocks, ..Plan::default() });
        let mut next = |turned| {
            pilot.handle_turned(turned);
            let Coding::Blocks(settings) = pilot.next(LISTS, true) else { panic!("not in blocks") };
            settings.turn_deg
        };
        assert_eq!(next(None), None);
        assert_eq!([next(Some(4)), next(Some(12)), next(Some(12))], [Some(2), Some(3), Some(4)]);
        // One at rest is made for all, and says nothing of the next movement.
        assert_eq!([next(None), next(Some(12)), next(Some(0))], [None, Some(4), Some(3)]);
        // A jump to another view is forgotten like any turn: twice the half of 20 degrees is the most.
        assert_eq!([next(Some(180)), next(Some(180)), next(Some(180))], [Some(5), Some(6), Some(7)]);
        for _ in 0..8 {
            next(Some(0));
        }
        assert_eq!(next(Some(0)), Some(1));
        // Where it rests, it is made once more for any turn, though it be at the best quality, and never worse.
        let sent =
            |turn_deg| Coding::Blocks(blocks::Settings { turn_deg, ..blocks::Settings::of(DEFAULT_QUALITY) });
        assert_eq!(pilot.finer(LISTS, &sent(Some(5))), Some(sent(None)));
        assert_eq!(pilot.finer(LISTS, &sent(None)), None);
        let plan = Plan { mode: Mode::Blocks, quality: 0, ..Plan::default() };
        let moving = blocks::Settings { turn_deg: Some(5), ..blocks::Settings::of(LEAST_QUALITY) };
        let finer = Pilot::new(plan).finer(LISTS, &Coding::Blocks(moving));
        assert_eq!(finer.and_then(quality), Some(LEAST_QUALITY));
    }

    #[test]
    fn frames_fit_the_link_and_come_back_after_a_harder_scene() {
        for megabytes in [0.6, 1.25, 6.0] {
            let mut link = FakeLink::new(megabytes);
            let mut pilot = Pilot::new(Plan { mode: Mode::Blocks, quality: 90, bytes_per_second: None });
            let mut waits = vec![];
            for n in 0..300 {
                // A harder scene from the 150th frame on.
                let hardness = if n < 150 { 1.0 } else { 1.6 };
                let coding = pilot.next(LISTS, n > 0);
                let bytes = bytes_at(quality(coding).unwrap(), hardness);
                pilot.handle_encoded(&coding, n > 0, LISTS, bytes as usize, 10_000);
                pilot.handle_link(n * 33_000, link.send(bytes));
                waits.push(link.queued / link.bytes_per_second);
            }
            // Half a second to settle, each time; then what queues is a few frames' worth.
            let calm = waits[15..150].iter().chain(&waits[165..]).fold(0f64, |a, &b| a.max(b));
            assert!(calm < 0.1, "{megabytes}: {calm} s of queue");
            let best = pilot.bytes_per_second();
            assert!(best > megabytes * 0.5e6, "{megabytes}: {best} of the link is used");
            // The control: a fixed quality fills the narrow link's queue.
            let mut link = FakeLink::new(megabytes);
            for _ in 0..300 {
                link.send(bytes_at(90, 1.0));
            }
            assert_eq!(link.queued > 0.1 * link.bytes_per_second, megabytes < 0.7, "{megabytes}");
        }
    }

    #[test]
    fn a_way_that_has_become_longer_is_no_queue() {
        let mut pilot = Pilot::new(Plan { mode: Mode::Blocks, quality: 90, bytes_per_second: None });
        let mut link = FakeLink::new(2.5);
        let mut rates = vec![];
        for n in 0..900 {
            if n == 150 {
                link.rtt_micros = 2e5;
            }
            // Losses for a while.
            if (200..350).contains(&n) && n % 10 == 0 {
                link.window = (link.window * 0.5).max(5_000.0);
            }
            let coding = pilot.next(LISTS, n > 0);
            let bytes = bytes_at(quality(coding).unwrap(), 1.0);
            pilot.handle_encoded(&coding, n > 0, LISTS, bytes as usize, 10_000);
            pilot.handle_link(n * 33_000, link.send(bytes));
            rates.push(pilot.bytes_per_second());
        }
        let mean =
            |range: std::ops::Range<usize>| rates[range.clone()].iter().sum::<f64>() / range.len() as f64;
        // Ten seconds after the last loss.
        assert!(
            mean(650..900) > 0.9 * mean(100..150),
            "{} {} {}",
            mean(100..150),
            mean(340..350),
            mean(650..900)
        );
        // Negative control: losses do tell.
        assert!(mean(340..350) < 0.5 * mean(100..150));
    }

    #[test]
    fn a_quality_that_takes_too_long_to_encode_is_left_out() {
        let wide = LinkState { window_bytes: 100_000_000, rtt_micros: 1000, least_rtt_micros: 1000 };
        let settled = |generate_micros: u64, micros_at_best: f64| {
            let mut pilot = Pilot::new(Plan { mode: Mode::Blocks, ..Plan::default() });
            let (mut last, mut micros) = (0, 0.0);
            for n in 0..60 {
                pilot.handle_generated(generate_micros);
                pilot.handle_link(n * 33_000, wide);
                let coding = pilot.next(LISTS, n > 0);
                last = quality(coding).unwrap();
                // Half the time with every 30 less.
                micros = micros_at_best * ((f64::from(last) - 100.0) / 30.0).exp2();
                pilot.handle_encoded(&coding, n > 0, LISTS, 1000, micros as u64);
            }
            (last, micros)
        };
        let (quality, micros) = settled(2_000, 90_000.0);
        assert!(quality < 75 && (micros / CODING_MICROS - 1.0).abs() < 0.1, "{quality}: {micros} µs");
        // Where generating takes as long, nothing waits for the coder; and a fast coder makes the best.
        assert_eq!([settled(100_000, 90_000.0).0, settled(2_000, 30_000.0).0], [100, 100]);
        // However slow the coder, the picture stays one.
        assert_eq!(settled(2_000, 1e6).0, LEAST_TIMELY_QUALITY as u8);
    }

    #[test]
    fn a_rate_is_kept_whatever_the_link_carries() {
        let plan = Plan { mode: Mode::Blocks, quality: 100, bytes_per_second: Some(1e6) };
        let mut pilot = Pilot::new(plan);
        let wide = LinkState { window_bytes: 10_000_000, rtt_micros: 1000, least_rtt_micros: 1000 };
        let mut last = 0.0;
        for n in 0..20 {
            pilot.handle_link(n * 33_000, wide);
            let coding = pilot.next(LISTS, n > 0);
            last = bytes_at(quality(coding).unwrap(), 1.0);
            pilot.handle_encoded(&coding, n > 0, LISTS, last as usize, 1000);
        }
        assert!((20_000.0..=33_400.0).contains(&last), "{last} bytes a frame");
        pilot.plan.bytes_per_second = None;
        assert!(bytes_at(quality(pilot.next(LISTS, true)).unwrap(), 1.0) > 36_000.0);
    }

    #[test]
    fn frames_over_a_long_way_may_take_a_part_of_it() {
        let bytes_over = |rtt_micros, generate_micros| {
            let plan = Plan { mode: Mode::Blocks, quality: 100, bytes_per_second: Some(3e5) };
            let mut pilot = Pilot::new(plan);
            let mut last = 0.0;
            for _ in 0..20 {
                pilot.handle_generated(generate_micros);
                let link = LinkState { window_bytes: 10_000_000, rtt_micros, least_rtt_micros: rtt_micros };
                pilot.handle_link(0, link);
                let coding = pilot.next(LISTS, true);
                last = bytes_at(quality(coding).unwrap(), 1.0);
                pilot.handle_encoded(&coding, true, LISTS, last as usize, 1000);
            }
            last / 3e5
        };
        let [near, far, slow] =
            [(20_000, 20_000), (350_000, 50_000), (20_000, 380_000)].map(|(r, g)| bytes_over(r, g));
        // Seconds of the link: one thirtieth, and a quarter of 400 ms.
        assert!((0.025..0.034).contains(&near), "{near}");
        assert!((0.075..0.101).contains(&far) && (0.075..0.101).contains(&slow), "{far} {slow}");
    }

    #[test]
    fn a_frame_of_fewer_lists_has_its_better_quality_at_once() {
        let plan = Plan { mode: Mode::Blocks, quality: 100, bytes_per_second: Some(300_000.0) };
        let mut pilot = Pilot::new(plan);
        let mut at = |num_lists: usize| {
            let coding = pilot.next(num_lists, true);
            let bytes = bytes_at(quality(coding).unwrap(), 1.0) * num_lists as f64 / LISTS as f64;
            pilot.handle_encoded(&coding, true, num_lists, bytes as usize, 1000);
            (f64::from(quality(coding).unwrap()), bytes)
        };
        for _ in 0..10 {
            at(LISTS);
        }
        let (whole, of_whole) = at(LISTS);
        let (small, of_small) = at(LISTS / 4);
        // Two octaves of bytes, by the slope of `bytes_at`.
        assert!((small - whole - 2.0 / 0.033).abs() < 12.0, "{whole} and {small}");
        assert!(of_small < 11_000.0 && of_whole < 11_000.0, "{of_whole} and {of_small} bytes");
        // And a larger one its worse: with the quality of the small one it would take four times the bytes.
        let (again, of_again) = at(LISTS);
        assert!((again - whole).abs() < 12.0 && of_again < 12_000.0, "{again}, {of_again} bytes");
    }

    #[test]
    fn a_rest_ends_exactly_and_by_a_finer_frame_only_where_that_takes_long() {
        let mut pilot = Pilot::new(Plan { quality: 50, ..Plan::default() });
        let first = pilot.next(LISTS, false);
        assert_eq!(quality(first), Some(50), "nothing is known of the link or of exact frames");
        pilot.handle_encoded(&first, false, LISTS, 30_000, 20_000);
        let link = |window_bytes| LinkState { window_bytes, rtt_micros: 100_000, least_rtt_micros: 100_000 };
        let steps = |pilot: &Pilot| {
            let mut steps = vec![];
            let mut last = first;
            while let Some(finer) = pilot.finer(LISTS, &last) {
                steps.push(quality(finer));
                last = finer;
            }
            steps
        };
        pilot.handle_link(0, link(10_000_000));
        assert_eq!(steps(&pilot), [None]);
        pilot.handle_link(0, link(80_000));
        assert_eq!(steps(&pilot), [Some(FINE_QUALITY), None]);
        pilot.plan.mode = Mode::Blocks;
        assert_eq!(steps(&pilot), []);
        pilot.plan.quality = 70;
        assert_eq!(steps(&pilot), [Some(70)]);
        pilot.plan.mode = Mode::Exact;
        assert_eq!(steps(&pilot), []);
    }

    #[test]
    fn moving_frames_are_exact_only_where_the_link_does_not_feel_it() {
        let mut pilot = Pilot::new(Plan::default());
        let blocks = Coding::Blocks(blocks::Settings::of(60));
        pilot.handle_encoded(&blocks, true, LISTS, 20_000, 20_000);
        let mut coding = |exact_micros: u64, window_bytes| {
            pilot.exact_bytes = Mean::default();
            pilot.exact_micros = Mean::default();
            pilot.handle_encoded(&Coding::default(), false, LISTS, 400_000, exact_micros);
            pilot.handle_link(0, LinkState { window_bytes, rtt_micros: 20_000, least_rtt_micros: 20_000 });
            quality(pilot.next(LISTS, true))
        };
        assert_eq!(coding(20_000, 2_000_000), None);
        assert_eq!(coding(20_000, 100_000), Some(100), "too narrow");
        assert_eq!(coding(100, 150_000), Some(100), "too narrow, though blocks take longer to encode");
        assert_eq!(coding(40_000, 2_000_000), Some(100), "exact frames take longer to encode");
    }
}
