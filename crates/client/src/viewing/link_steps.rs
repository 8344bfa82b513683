//! Fewer lists where the link is narrow.
//!
//! The server gives a moving camera's frames the quality whose bytes the link carries. Below some quality a frame of fewer
//! lists looks better for its bytes after a turn of a few degrees, and is made sooner. Pure: time comes in as an argument.

use std::time::Duration;

use isinglass_core::ids::FrameId;
use isinglass_net::ReceivedFrame;

use super::MOVING_SCALES;

/// Chooses one of [`MOVING_SCALES`] by the quality that frames come in.
#[derive(Clone, Debug, Default)]
pub(super) struct LinkSteps {
    step: usize,
    /// Frames of poses that were set before say nothing of this step.
    since: Duration,
    /// Frames in a row that were of too bad a quality, or negative of one good enough for more lists.
    streak: i8,
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
        if std::mem::replace(&mut self.seen, id) == id {
            return;
        }
        // What a resting camera is sent says nothing, nor does a frame of the size before.
        let asked_since = self.since.max(moving_since);
        if newest.times.pose_set.is_none_or(|set| Duration::from_micros(set) < asked_since) {
            return;
        }
        self.streak = match newest.quality {
            Some(quality) if quality < BAD_QUALITY => self.streak.max(0) + 1,
            Some(quality) if quality < GOOD_QUALITY => 0,
            _ => self.streak.min(0) - 1,
        };
        if self.streak.abs() < STREAK {
            return;
        }
        let finer = self.streak < 0;
        let step =
            if finer { self.step.saturating_sub(1) } else { (self.step + 1).min(MOVING_SCALES.len() - 1) };
        self.streak = 0;
        if step != self.step {
            (self.step, self.since) = (step, now);
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
