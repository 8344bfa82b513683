//! The coding of each frame of a connection: what appears earliest and best over the current link.
//!
//! While the camera moves, frames in blocks get the quality that the link can carry in a frame's time, up to a limit.
//! At rest, the same frame goes out again finer, and then exactly.

use crate::codec::Coding;
use crate::codec::blocks::{self, RateControl};

/// Which codings a connection uses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CodingMode {
    /// Exact frames only.
    Exact,
    /// Frames in blocks only.
    Blocks,
    /// Blocks while the camera moves. Exact frames at rest, or where they are shown hardly later.
    #[default]
    Auto,
}

impl CodingMode {
    /// Its name on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Exact => "exact",
            Self::Blocks => "blocks",
            Self::Auto => "auto",
        }
    }
}

/// The requested coding.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CodingPlan {
    /// The codings.
    pub mode: CodingMode,
    /// Best quality of frames in blocks while the camera moves, 0 to [`blocks::MAX_QUALITY`].
    pub quality: u8,
    /// Most bytes per second; `None` for what the link carries.
    pub bytes_per_second: Option<f64>,
}

impl Default for CodingPlan {
    fn default() -> Self {
        Self { mode: CodingMode::default(), quality: DEFAULT_QUALITY, bytes_per_second: None }
    }
}

impl CodingPlan {
    /// Uses exact frames only.
    pub const EXACT: Self =
        Self { mode: CodingMode::Exact, quality: DEFAULT_QUALITY, bytes_per_second: None };
}

/// What the transport knows of the link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkState {
    /// Rate that the link delivers, bytes per second.
    pub bytes_per_second: f64,
    /// Whether that rate is measured. Otherwise it is only what was sent so far.
    pub is_measured: bool,
    /// Least round-trip time of the path, µs.
    pub least_rtt_micros: u64,
}

/// Decides how the frames of one connection are coded.
///
/// For each frame call `handle_generated`, `handle_turned` and `handle_link`, then `next`, and `handle_encoded` at
/// the end. For a frame that is sent again at rest, call `finer` in place of `next`.
#[derive(Clone, Debug)]
pub struct CodingControl {
    plan: CodingPlan,
    control: RateControl,
    link: Option<LinkState>,
    generate_micros: f64,
    /// Time between frames of a moving camera, µs.
    interval_micros: Mean,
    /// Angle by which frames of a moving camera are turned when shown, degrees; `None` if unknown.
    turned_deg: Option<f32>,
    /// Whether the next one is seen so.
    is_turned: bool,
    /// Time to encode a list exactly and in blocks, µs, and bytes per list of an exact frame.
    exact_micros: Mean,
    blocks_micros: Mean,
    exact_bytes: Mean,
    /// The best quality that is encoded in time.
    timely_quality: f64,
}

impl CodingControl {
    /// Starts without knowledge of the link.
    pub fn new(plan: CodingPlan) -> Self {
        Self {
            plan,
            control: RateControl::new(usize::MAX),
            link: None,
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

    /// Notes the time between frames of a moving camera, µs.
    pub fn handle_interval(&mut self, micros: u64) {
        self.interval_micros.add(micros as f64);
    }

    /// Notes the angle by which the viewer shows frames turned, degrees. `None` if the next frame is not one of a
    /// moving camera, or if the angle is unknown.
    pub fn handle_turned(&mut self, degrees: Option<u8>) {
        self.is_turned = degrees.is_some();
        if let Some(now) = degrees {
            // A jump to a distant view counts like the largest turn.
            let now = f32::from(now).min(f32::from(blocks::MAX_TURN_DEG) / MEANT);
            self.turned_deg = Some(now + TURN_KEPT * (self.turned_deg.unwrap_or(now) - now));
        }
    }

    /// Notes the state of the link.
    pub fn handle_link(&mut self, link: LinkState) {
        self.link = Some(link);
    }

    /// The assumed rate of the link, bytes per second: infinite until it is known.
    pub fn bytes_per_second(&self) -> f64 {
        let link = self.link.map_or(f64::INFINITY, |link| {
            // Only frames that fill the link show what it carries.
            link.bytes_per_second * if link.is_measured { FILLING } else { OPENING }
        });
        link.min(self.plan.bytes_per_second.unwrap_or(f64::INFINITY))
    }

    /// Whether the link takes long for an exact frame of `num_lists` lists.
    pub fn takes_long(&self, num_lists: usize) -> bool {
        let bytes = self.exact_bytes.get_or(EXACT_BYTES_PER_LIST) * num_lists as f64;
        bytes / self.bytes_per_second() > LONG_EXACT_SECONDS
    }

    /// The coding of the next frame, of `num_lists` lists; `is_predicted` if it can be predicted from another.
    pub fn next(&mut self, num_lists: usize, is_predicted: bool) -> Coding {
        let rate = self.bytes_per_second();
        let lists = num_lists as f64;
        // Generation of a frame and encoding of the previous one overlap.
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
                // Only bytes count for the link, so slower encoding of blocks, as in the first frames, is no bonus.
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
                // Where generation is fast, a newer frame is worth more than a finer one that waits for its coding.
                let in_time = CODING_MICROS.max(self.generate_micros);
                let timely = f64::from(settings.quality)
                    - QUALITY_PER_OCTAVE * (micros.max(1) as f64 / in_time).log2();
                let mut now = self.timely_quality + TIMELY_TAKEN * (timely - self.timely_quality);
                if (micros as f64) < in_time {
                    // The best quality stays possible.
                    now = now.max(self.timely_quality);
                }
                self.timely_quality = now.clamp(LEAST_TIMELY_QUALITY, blocks::MAX_QUALITY.into());
                let bytes = (bytes as f64 * counted(num_lists)) as usize;
                self.control.observe(is_predicted, settings.quality, bytes);
            }
        }
    }
}

/// Bytes that the control counts per byte of a frame: as if it had [`COUNTED_LISTS`] lists. The size of frames varies
/// with the margin and with the camera's movement.
fn counted(num_lists: usize) -> f64 {
    COUNTED_LISTS / num_lists.max(1) as f64
}

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

/// It is large because the control counts whole bytes.
const COUNTED_LISTS: f64 = (1 << 20) as f64;
/// The default for the best quality: where the link carries it, a picture's fault is worth more than its bytes.
pub const DEFAULT_QUALITY: u8 = blocks::MAX_QUALITY;
/// The worst quality on any link: below it, bytes hardly fall.
pub const LEAST_QUALITY: u8 = 5;
/// Quality between that of a moving camera and an exact frame.
const FINE_QUALITY: u8 = 90;
/// Time on the link for a frame of a moving camera: until the next one, at most a thirtieth of a second. Where frames
/// are slow to make, it is a part of the age that making and travelling cause anyway. That age grows by as much, and
/// the picture gets more bytes.
const FRAME_MICROS: f64 = 1e6 / 30.0;
const LEAST_FRAME_MICROS: f64 = 1e6 / 240.0;
const SHARE_OF_AGE: f64 = 0.25;
/// Encoding time for a frame of a moving camera, unless generation takes longer: some 30 frames a second.
const CODING_MICROS: f64 = 30_000.0;
/// Loss of quality that halves the encoding time.
const QUALITY_PER_OCTAVE: f64 = 40.0;
/// Weight of a frame in the estimate of timely quality: first frames take longer.
const TIMELY_TAKEN: f64 = 0.3;
/// The worst quality for the sake of encoding time: below it, time hardly falls.
const LEAST_TIMELY_QUALITY: f64 = 40.0;
/// Delay that an exact frame is worth: half the time to the next frame, or a part of the generation time.
const EXACT_SHARE_OF_INTERVAL: f64 = 0.48;
const EXACT_SHARE_OF_MAKING: f64 = 0.15;
/// A time on the link from which on an exact frame of a moving camera is thinned, s.
const LONG_EXACT_SECONDS: f64 = 0.1;
/// A wait for the exact frame that justifies a finer one in between, s.
const LONG_SECONDS: f64 = 0.25;
/// Bytes per list of an exact frame before any measurement.
const EXACT_BYTES_PER_LIST: f64 = 8.0;
/// The least turn that frames are made for: the camera moves, so none is seen only from its own pose.
const LEAST_TURN_DEG: u8 = 1;
/// Fraction of the measured turn that frames are made for. Frames lose more when seen from nearer than intended, and
/// a camera that stops sees them from near.
const MEANT: f32 = 0.5;
/// Fraction of the previous turn that each frame keeps.
const TURN_KEPT: f32 = 0.75;
/// Fraction of the link's rate that frames may fill.
const FILLING: f64 = 0.9;
/// Multiple of the sent rate that frames may fill while the link carries all of it.
const OPENING: f64 = 2.0;

#[cfg(test)]
mod tests;
