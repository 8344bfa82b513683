//! Fewer lists where the link is narrow.
//!
//! The server gives a moving camera's frames the quality whose bytes the link carries. Below some quality a frame of fewer
//! lists looks better for its bytes after a turn of a few degrees, and is made sooner. Whether it is the link that holds the
//! quality down, or a limit that somebody has set, shows only when it is tried: a step that brings no better quality is taken
//! back, and one to more lists is tried now and then. Pure: time comes in as an argument.

use std::time::Duration;

use isinglass_core::ids::FrameId;
use isinglass_core::session::rate::LEAST_QUALITY;
use isinglass_net::ReceivedFrame;

use super::MOVING_SCALES;

/// Chooses one of [`MOVING_SCALES`] by the quality that frames come in.
#[derive(Clone, Debug, Default)]
pub(super) struct LinkSteps {
    step: usize,
    /// Frames of poses that were set before say nothing of this step.
    since: Duration,
    /// Frames of this step so far.
    num_frames: u32,
    /// Frames in a row that were of too bad a quality, or negative of one good enough for more lists.
    streak: i8,
    /// The quality before a step to fewer lists, until a better one shows that it helps.
    before: Option<u8>,
    /// A quality at which fewer lists did not help.
    in_vain: Option<u8>,
    /// The connection and the frame that was seen last.
    seen: (u32, FrameId),
}

impl LinkSteps {
    /// Size of frames in units of the full one.
    pub(super) fn scale(&self) -> f32 {
        MOVING_SCALES[self.step]
    }

    /// Learns from the newest frame of a camera that has been moving since then; the same frame may be told again.
    pub(super) fn note(&mut self, now: Duration, newest: &ReceivedFrame, moving_since: Duration) {
        let id = (newest.times.connection, newest.frame.header.frame);
        let last = std::mem::replace(&mut self.seen, id);
        if last == id {
            return;
        }
        if last.0 != id.0 {
            (self.before, self.in_vain) = (None, None);
        }
        // What a resting camera is sent says nothing, nor does a frame of the size before.
        let asked_since = self.since.max(moving_since);
        if newest.times.pose_set.is_none_or(|set| Duration::from_micros(set) < asked_since) {
            return;
        }
        self.num_frames = self.num_frames.saturating_add(1);
        let Some(quality) = newest.quality.filter(|q| *q < GOOD_QUALITY) else {
            self.in_vain = None;
            self.streak = self.streak.min(0) - 1;
            if self.streak <= -STREAK {
                self.go_to(now, self.step.saturating_sub(1), None);
            }
            return;
        };
        let is_better = self.before.is_none_or(|before| quality >= before + GAIN || quality <= LEAST_QUALITY);
        if is_better {
            self.before = None;
        } else if self.num_frames >= TRIAL {
            self.in_vain = self.before;
            return self.go_to(now, self.step.saturating_sub(1), None);
        }
        if quality >= BAD_QUALITY {
            self.streak = 0;
            if self.num_frames >= FAIR {
                self.go_to(now, self.step.saturating_sub(1), None);
            }
            return;
        }
        self.streak = (self.streak.max(0) + 1).min(STREAK);
        let may_help = quality <= LEAST_QUALITY || self.in_vain.is_none_or(|q| quality + GAIN <= q);
        if self.streak >= STREAK && may_help && self.before.is_none() {
            self.go_to(now, (self.step + 1).min(MOVING_SCALES.len() - 1), Some(quality));
        }
    }

    /// `before` is the quality up to now, if the step is to fewer lists.
    fn go_to(&mut self, now: Duration, step: usize, before: Option<u8>) {
        self.streak = 0;
        self.num_frames = 0;
        if step != self.step {
            (self.step, self.since, self.before) = (step, now, before);
        }
    }
}

/// Below this quality a frame of the next scale and of as many bytes is better after turns of 5° and 10°
/// (docs/BENCHMARKS.md).
const BAD_QUALITY: u8 = 30;
/// From this quality on the scale before would still have clearly more than the bad one: a step is worth 20 to 28.
const GOOD_QUALITY: u8 = 68;
/// So many frames in a row: the first of a size are predicted from frames of another, and have more bytes for it.
const STREAK: i8 = 3;
/// A step to fewer lists must bring so much quality within so many frames.
const GAIN: u8 = 6;
const TRIAL: u32 = 10;
/// After so many frames that were neither bad nor good more lists are tried.
const FAIR: u32 = 150;
