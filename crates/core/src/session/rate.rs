//! How each frame of a connection is coded: what is shown earliest and best over the link as it is.
//!
//! While the camera moves, frames in blocks get the quality whose bytes the link carries in the time that a frame may
//! take, at most the one asked for. When it rests, the same frame goes out again finer, and then exactly.

use super::round_trip::{LeastRtt, is_longer};
use crate::codec::Coding;
use crate::codec::blocks::{self, RateControl};

/// Which codings a connection uses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CodingMode {
    /// Exact frames only.
    Exact,
    /// Frames in blocks only.
    Blocks,
    /// Blocks while the camera moves and exact frames where it rests, or where they are shown hardly later.
    #[default]
    Auto,
}

impl CodingMode {
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
pub struct CodingPlan {
    /// The codings.
    pub mode: CodingMode,
    /// Best quality of frames in blocks while the camera moves, 0 to [`blocks::MAX_QUALITY`].
    pub quality: u8,
    /// Most bytes a second; none: what the link carries.
    pub bytes_per_second: Option<f64>,
}

impl Default for CodingPlan {
    fn default() -> Self {
        Self { mode: CodingMode::default(), quality: DEFAULT_QUALITY, bytes_per_second: None }
    }
}

impl CodingPlan {
    /// Nothing but exact frames.
    pub const EXACT: Self =
        Self { mode: CodingMode::Exact, quality: DEFAULT_QUALITY, bytes_per_second: None };
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
pub struct CodingControl {
    plan: CodingPlan,
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

impl CodingControl {
    /// Knows nothing of the link yet.
    pub fn new(plan: CodingPlan) -> Self {
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
            CodingMode::Exact => Coding::Exact,
            CodingMode::Blocks => in_blocks,
            CodingMode::Auto => {
                let bytes = self.control.expected_bytes(is_predicted, quality);
                let (Some(bytes), true) = (bytes, self.exact_bytes.is_known()) else { return in_blocks };
                let bytes = f64::from(bytes) / counted(num_lists);
                let exact = self.exact_bytes.get() * lists;
                // Bytes are what a link feels: that blocks took longer to encode, as the first ones do, makes up for none.
                let longer = (self.exact_micros.get() - self.blocks_micros.get()).max(0.0);
                let later = longer * lists + (exact - bytes) * 1e6 / rate;
                let may_be_later = (EXACT_SHARE_OF_INTERVAL * interval).max(making * EXACT_SHARE_OF_MAKING);
                if later < may_be_later { Coding::Exact } else { in_blocks }
            }
        }
    }

    /// How a frame that was last sent as `sent` is sent once more, because the camera rests; `None` if it cannot be
    /// better.
    pub fn finer(&self, num_lists: usize, sent: &Coding) -> Option<Coding> {
        let at = |quality| Coding::Blocks(blocks::Settings::of(quality));
        let Coding::Blocks(last) = sent else { return None };
        match self.plan.mode {
            CodingMode::Exact => None,
            CodingMode::Blocks => {
                let is_for_turn = last.turn_deg.is_some();
                let best = self.plan.quality.max(last.quality);
                (is_for_turn || last.quality < best).then(|| at(best))
            }
            CodingMode::Auto => {
                let bytes = self.exact_bytes.get_or(EXACT_BYTES_PER_LIST) * num_lists as f64;
                let takes_long = bytes / self.bytes_per_second() > LONG_SECONDS;
                Some(if takes_long && last.quality < FINE_QUALITY { at(FINE_QUALITY) } else { Coding::Exact })
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
            Coding::Exact => {
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
mod tests;
