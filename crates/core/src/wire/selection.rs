//! What a file holds beside the shown volume, and how a viewer requests another part of it.
//!
//! All viewers of a server see one part. Any of them may request another. The server reads it while it shows the
//! present one, and reports its progress to everyone. When it is there, everyone gets its description.

use serde::{Deserialize, Serialize};

use super::control::ControlError;
use super::control::check_text;
use crate::ids::LoadId;
use crate::look::MAX_NAME_BYTES;
use crate::text::printable;

/// A part of a file. A field without a value stands for the default. It is all channels that can be shown together, or else
/// the first; the first time; the finest level that fits into memory; the largest series; all voxels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// Channel, component or array, from 0.
    pub channel: Option<u32>,
    /// Point in time, from 0.
    pub time: Option<u32>,
    /// Level of a pyramid, 0 the finest.
    pub level: Option<u32>,
    /// Series of a folder, from 0.
    pub series: Option<u32>,
    /// First voxel and the one after the last, along each axis of the volume as it is shown.
    pub region: Option<[[u32; 2]; 3]>,
    /// The axes of the volume along which it is mirrored, against what the file says.
    pub flip: [bool; 3],
}

/// The choices in a file, and the shown part.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Choices {
    /// The shown part. Time, level and series have values. Without a channel, several are shown together.
    pub shown: Part,
    /// Voxels along x, y, z of the whole, at the shown level and in the shown series.
    pub whole_dims: [u64; 3],
    /// Number of channels.
    pub num_channels: u32,
    /// Whether the channels can be shown together.
    pub joins_channels: bool,
    /// Names of the first channels.
    pub channels: Vec<String>,
    /// Number of points in time.
    pub num_times: u32,
    /// Time from one point in time to the next, seconds, if the file tells it.
    pub time_step: Option<f32>,
    /// Voxels of each pyramid level, the finest first; empty if there is only one.
    pub levels: Vec<[u64; 3]>,
    /// Number of series.
    pub num_series: u32,
    /// Descriptions of the first series.
    pub series: Vec<String>,
    /// Memory of the shown part, bytes.
    pub bytes_in_memory: u64,
}

/// The progress of reading a part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LoadStatus {
    /// Counts the loads of a server, from 1.
    pub load: LoadId,
    /// Whether this viewer requested it.
    pub is_own: bool,
    /// What is asked for.
    pub part: Part,
    /// Memory that it will take, bytes; 0 if not known yet.
    pub bytes_needed: u64,
    /// How far it is.
    pub state: LoadState,
}

/// The progress of a load.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum LoadState {
    /// The reading continues.
    Reading {
        /// Fraction that is read, thousandths, 0 to 1000.
        permille: u16,
    },
    /// The part is there, and its description follows.
    Done,
    /// Somebody cancelled it or requested another part. The shown part stays.
    Cancelled,
    /// Why it cannot be shown. The shown part stays.
    Failed(String),
}

impl Part {
    pub(super) fn validate(&self) -> Result<(), ControlError> {
        let is_empty = |region: &[[u32; 2]; 3]| region.iter().any(|[from, to]| from >= to);
        if self.region.as_ref().is_some_and(is_empty) {
            return Err(ControlError::Value("region"));
        }
        Ok(())
    }
}

impl Choices {
    /// Whether there is anything to choose.
    pub fn has_choice(&self) -> bool {
        self.num_channels > 1 || self.num_times > 1 || self.levels.len() > 1 || self.num_series > 1
    }

    /// Shortens names and lists so that a message can hold them.
    pub fn bounded(mut self) -> Self {
        let cut = |names: &mut Vec<String>, max_bytes: usize| {
            names.truncate(MAX_LISTED);
            for name in names {
                // Four bytes hold any character.
                *name = printable(name, max_bytes / 4);
            }
        };
        cut(&mut self.channels, MAX_CHANNEL_BYTES);
        cut(&mut self.series, MAX_NAME_BYTES);
        self.levels.truncate(MAX_LEVELS);
        self
    }

    pub(super) fn validate(&self) -> Result<(), ControlError> {
        self.shown.validate()?;
        let counts = [self.num_channels, self.num_times, self.num_series];
        if counts.contains(&0) || self.whole_dims.contains(&0) {
            return Err(ControlError::Value("number of parts"));
        }
        if self.time_step.is_some_and(|seconds| !(seconds.is_finite() && seconds > 0.0)) {
            return Err(ControlError::Value("time step"));
        }
        let is_long = |names: &[String], number: u32| names.len() > MAX_LISTED.min(number as usize);
        if is_long(&self.channels, self.num_channels)
            || is_long(&self.series, self.num_series)
            || self.levels.len() > MAX_LEVELS
            || self.levels.iter().flatten().any(|&n| n == 0)
        {
            return Err(ControlError::Value("list of parts"));
        }
        self.channels.iter().try_for_each(|name| check_text("channel", name, MAX_CHANNEL_BYTES))?;
        self.series.iter().try_for_each(|name| check_text("series", name, MAX_NAME_BYTES))
    }
}

impl LoadStatus {
    pub(super) fn validate(&self) -> Result<(), ControlError> {
        self.part.validate()?;
        match &self.state {
            LoadState::Reading { permille: 1001.. } => Err(ControlError::Value("progress")),
            LoadState::Failed(problem) => check_text("problem", problem, super::control::MAX_NOTICE_BYTES),
            LoadState::Reading { .. } | LoadState::Done | LoadState::Cancelled => Ok(()),
        }
    }
}

/// Most channels or series that are listed by name.
const MAX_LISTED: usize = 128;
/// Longest name of a channel, bytes.
const MAX_CHANNEL_BYTES: usize = 160;
/// Most levels of a pyramid: each halves the previous one.
const MAX_LEVELS: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::control::{decode, encode, one_line};
    use crate::wire::{ClientMessage, MAX_CONTROL_BYTES, ServerMessage};

    fn parts() -> Choices {
        Choices {
            shown: Part {
                channel: Some(1),
                time: Some(0),
                level: Some(0),
                series: Some(0),
                ..Part::default()
            },
            whole_dims: [5, 4, 3],
            num_channels: 3,
            joins_channels: true,
            channels: vec!["DAPI".into(), "GFP".into(), "2".into()],
            num_times: 7,
            time_step: Some(2.5),
            levels: vec![[5, 4, 3], [3, 2, 2]],
            num_series: 1,
            series: vec![],
            bytes_in_memory: 180,
        }
    }

    fn status(state: LoadState) -> LoadStatus {
        LoadStatus { load: LoadId(4), is_own: true, part: Part::default(), bytes_needed: 9, state }
    }

    #[test]
    fn the_longest_lists_fit_a_message_once_they_are_bounded() {
        let long = |n: usize| vec!["\u{10ffff}".repeat(500); n];
        let huge = Choices {
            num_channels: u32::MAX,
            channels: long(1000),
            num_series: 5000,
            series: long(900),
            levels: vec![[u64::MAX; 3]; 99],
            ..parts()
        };
        assert!(encode(&ServerMessage::Choices(Box::new(huge.clone()))).is_err());
        let bytes = encode(&ServerMessage::Choices(Box::new(huge.bounded()))).unwrap();
        assert!(bytes.len() < MAX_CONTROL_BYTES);
        let again: ServerMessage = decode(&bytes[4..]).unwrap();
        assert_eq!(encode(&again).unwrap(), bytes);
    }

    #[test]
    fn what_makes_no_sense_is_refused_on_both_ways() {
        assert!(encode(&ServerMessage::Choices(Box::new(parts()))).is_ok());
        for bad in [
            Choices { num_times: 0, ..parts() },
            Choices { time_step: Some(0.0), ..parts() },
            Choices { time_step: Some(f32::NAN), ..parts() },
            Choices { time_step: Some(f32::INFINITY), ..parts() },
            Choices { num_channels: 2, ..parts() },
            Choices { whole_dims: [1, 0, 1], ..parts() },
            Choices { levels: vec![[0; 3]], ..parts() },
            Choices { channels: vec!["\u{1b}[2J".into()], ..parts() },
            Choices { series: vec!["two".into(), "of one".into()], ..parts() },
        ] {
            assert!(encode(&ServerMessage::Choices(Box::new(bad.clone()))).is_err(), "{bad:?}");
        }
        for (state, is_good) in [
            (LoadState::Reading { permille: 1000 }, true),
            (LoadState::Reading { permille: 1001 }, false),
            (LoadState::Failed("two\nlines".into()), false),
            (LoadState::Failed(one_line("two\nlines")), true),
            (LoadState::Done, true),
        ] {
            let message = ServerMessage::Load(status(state));
            assert_eq!(encode(&message).is_ok(), is_good, "{message:?}");
        }
        for (region, is_good) in [([[0, 1]; 3], true), ([[0, 1], [4, 4], [0, 1]], false)] {
            let part = Part { region: Some(region), ..Part::default() };
            assert_eq!(encode(&ClientMessage::Select(part)).is_ok(), is_good);
        }
    }

    #[test]
    fn flipped_and_cut_messages_never_panic_and_decode_only_to_valid_ones() {
        let messages = [
            encode(&ServerMessage::Choices(Box::new(parts()))).unwrap(),
            encode(&ServerMessage::Load(status(LoadState::Failed("no such file".into())))).unwrap(),
            encode(&ServerMessage::Load(status(LoadState::Reading { permille: 500 }))).unwrap(),
        ];
        for good in messages {
            for bit in 0..8 * (good.len() - 4) {
                let mut bytes = good[4..].to_vec();
                bytes[bit / 8] ^= 1 << (bit % 8);
                if let Ok(message) = decode::<ServerMessage>(&bytes) {
                    assert!(encode(&message).is_ok());
                }
                let _ = decode::<ClientMessage>(&bytes);
            }
            for length in 0..good.len() - 4 {
                assert!(decode::<ServerMessage>(&good[4..4 + length]).is_err());
            }
        }
    }
}
