//! The channels of a volume in one picture: which are shown, in which colours, and how their matter counts together.

use serde::{Deserialize, Serialize};

use crate::text::is_control;
use crate::transfer::{LABEL_NODES, TransferError, TransferFunction};

/// How matter of several channels at one place counts together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Blend {
    /// Light adds up: red beside green of the same strength is yellow. The densest channel sets the extinction.
    #[default]
    Additive,
    /// Media mix: extinctions add up, and each channel hides what is behind it.
    Over,
}

impl Blend {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Additive, Self::Over];

    /// The name in texts, such as `additive`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Additive => "additive",
            Self::Over => "over",
        }
    }
}

/// What of a channel is shown.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Visibility {
    /// Whether nothing is.
    #[serde(default)]
    pub is_hidden: bool,
    /// Labels that are not shown, ascending, if the values are labels.
    #[serde(default)]
    pub hidden_labels: Vec<u16>,
}

impl Visibility {
    /// Shows or hides a label.
    pub fn set_label(&mut self, label: u16, is_shown: bool) {
        match (self.hidden_labels.binary_search(&label), is_shown) {
            (Ok(at), true) => {
                self.hidden_labels.remove(at);
            }
            (Err(at), false) => self.hidden_labels.insert(at, label),
            _ => {}
        }
    }
}

/// The look of one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelLook {
    /// Maps values to colour and extinction. Of labels, only its greatest opacity counts.
    pub transfer: TransferFunction,
    /// What is shown.
    #[serde(default)]
    pub visibility: Visibility,
}

/// The looks of a volume's channels, beside the transfer function of the first.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Channels {
    /// How they count together.
    #[serde(default)]
    pub blend: Blend,
    /// What of the first channel is shown.
    #[serde(default)]
    pub first: Visibility,
    /// The looks of all but the first. A channel without a look is hidden.
    #[serde(default)]
    pub others: Vec<ChannelLook>,
    /// The channel that projections and surfaces show, from 0.
    #[serde(default)]
    pub chosen: u8,
}

/// Why looks of channels cannot be used.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum ChannelsError {
    /// There are too many.
    #[error("{0} channels, expected at most {MAX_CHANNELS}")]
    Count(usize),
    /// The chosen channel cannot exist.
    #[error("channel {0} is chosen, expected one below {MAX_CHANNELS}")]
    Chosen(u8),
    /// A transfer function is not valid.
    #[error("transfer function of channel {0}: {1}")]
    Transfer(usize, TransferError),
    /// A name is too long or cannot be printed.
    #[error("the name of channel {0}'s transfer function is too long or cannot be printed")]
    Name(usize),
    /// Hidden labels are not ascending, or too large.
    #[error("hidden labels of channel {0}, expected ascending ones below {LABEL_NODES}")]
    Labels(usize),
}

impl Channels {
    /// Checks what the types cannot express. Names of transfer functions take at most `max_name_bytes`.
    ///
    /// # Errors
    /// The first rule that it breaks.
    pub fn validate(&self, max_name_bytes: usize) -> Result<(), ChannelsError> {
        if self.others.len() >= MAX_CHANNELS {
            return Err(ChannelsError::Count(self.others.len() + 1));
        }
        if usize::from(self.chosen) >= MAX_CHANNELS {
            return Err(ChannelsError::Chosen(self.chosen));
        }
        let visibilities = std::iter::once(&self.first).chain(self.others.iter().map(|o| &o.visibility));
        for (channel, Visibility { hidden_labels, .. }) in visibilities.enumerate() {
            let is_ascending = hidden_labels.is_sorted_by(|a, b| a < b);
            if !is_ascending || hidden_labels.last().is_some_and(|last| usize::from(*last) >= LABEL_NODES) {
                return Err(ChannelsError::Labels(channel));
            }
        }
        for (i, ChannelLook { transfer, .. }) in self.others.iter().enumerate() {
            if transfer.name.len() > max_name_bytes || transfer.name.chars().any(is_control) {
                return Err(ChannelsError::Name(i + 1));
            }
            transfer.validate().map_err(|e| ChannelsError::Transfer(i + 1, e))?;
        }
        Ok(())
    }

    /// Gives each of `num_channels` channels a look: one that has none gets that of `transfer`, hidden. Chooses one
    /// that is there.
    pub fn complete(&mut self, num_channels: usize, transfer: &TransferFunction) {
        let num_others = num_channels.clamp(1, MAX_CHANNELS) - 1;
        let visibility = Visibility { is_hidden: true, ..Visibility::default() };
        let hidden = || ChannelLook { transfer: transfer.clone(), visibility: visibility.clone() };
        if self.others.len() < num_others {
            self.others.resize_with(num_others, hidden);
        }
        self.chosen = self.chosen.min(num_others as u8);
    }

    /// The same to change it.
    pub fn visibility_mut(&mut self, channel: usize) -> Option<&mut Visibility> {
        match channel.checked_sub(1) {
            None => Some(&mut self.first),
            Some(other) => self.others.get_mut(other).map(|look| &mut look.visibility),
        }
    }

    /// The visibility of a channel, from 0; a channel without a look is hidden.
    pub fn visibility(&self, channel: usize) -> Option<&Visibility> {
        match channel.checked_sub(1) {
            None => Some(&self.first),
            Some(other) => self.others.get(other).map(|look| &look.visibility),
        }
    }
}

/// Most channels that are shown together.
pub const MAX_CHANNELS: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transfer::{ControlPoint, Domain, UnitLength};

    fn look(name: &str) -> ChannelLook {
        let transfer = TransferFunction {
            name: name.into(),
            domain: Domain::Full,
            unit_length: UnitLength::Voxel,
            points: vec![ControlPoint { x: 0.0, color: [1.0; 3], opacity: 0.5 }],
        };
        ChannelLook { transfer, visibility: Visibility::default() }
    }

    #[test]
    fn what_cannot_be_shown_is_named() {
        let good = Channels { others: vec![look("a"); 7], chosen: 7, ..Channels::default() };
        assert_eq!(good.validate(20), Ok(()));
        let many = Channels { others: vec![look("a"); 8], ..Channels::default() };
        assert_eq!(many.validate(20), Err(ChannelsError::Count(9)));
        assert_eq!(Channels { chosen: 8, ..good.clone() }.validate(20), Err(ChannelsError::Chosen(8)));
        let mut bad = good.clone();
        bad.others[2].transfer.points.clear();
        assert_eq!(bad.validate(20), Err(ChannelsError::Transfer(3, TransferError::Count(0))));
        bad = Channels { others: vec![look("\u{7}")], ..Channels::default() };
        assert_eq!(bad.validate(20), Err(ChannelsError::Name(1)));
        for labels in [vec![2, 1], vec![1, 1], vec![1024]] {
            let first = Visibility { hidden_labels: labels, ..Visibility::default() };
            assert_eq!(Channels { first, ..good.clone() }.validate(20), Err(ChannelsError::Labels(0)));
        }
    }

    #[test]
    fn channels_without_a_look_are_hidden_and_can_be_shown() {
        let mut looks = Channels { others: vec![look("a")], chosen: 6, ..Channels::default() };
        looks.complete(4, &look("b").transfer);
        let names: Vec<_> =
            looks.others.iter().map(|l| (&*l.transfer.name, l.visibility.is_hidden)).collect();
        assert_eq!((names, looks.chosen), (vec![("a", false), ("b", true), ("b", true)], 3));
        let before = looks.clone();
        looks.complete(4, &look("c").transfer);
        assert_eq!(looks, before);
    }

    #[test]
    fn labels_are_switched_off_and_on() {
        let mut shown = Visibility::default();
        for label in [7, 3, 7] {
            shown.set_label(label, false);
        }
        assert_eq!(shown.hidden_labels, [3, 7]);
        shown.set_label(3, true);
        shown.set_label(4, true);
        assert_eq!(shown.hidden_labels, [7]);
    }
}
