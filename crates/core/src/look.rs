//! The viewer's choices for the picture: mode, classification, shading and list lengths.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::channels::{Channels, ChannelsError};
use crate::clip::{Clip, ClipError};
use crate::kernels::march::{MarchSettings, Scene};
use crate::layer::MAX_K;
use crate::mode::{Isos, Mode};
use crate::text::is_control;
use crate::transfer::{TransferError, TransferFunction};
use crate::volume::{Detail, Lighting, LightingError, Occlusion, Volume};

/// The choices behind a frame. Each change has a [`LookVersion`](crate::ids::LookVersion).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Look {
    /// Maps scalars to colour and extinction.
    pub transfer: TransferFunction,
    /// Whether gradients shade the colour.
    pub shaded: bool,
    /// Direction of the light, and the shade of matter.
    pub lighting: Lighting,
    /// Mean length of lists that are not empty, 1 to [`MAX_K`].
    pub k: u8,
    /// The visible part of the volume.
    pub clip: Clip,
    /// What a pixel shows of its ray.
    #[serde(default)]
    pub mode: Mode,
    /// The surfaces of [`Mode::Iso`].
    #[serde(default)]
    pub isos: Isos,
    /// What of the channels is shown, and the looks of all but the first.
    #[serde(default)]
    pub channels: Channels,
}

/// Why a look cannot be used.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum LookError {
    /// The transfer function is not valid.
    #[error("transfer function: {0}")]
    Transfer(#[from] TransferError),
    /// The name is too long or cannot be printed.
    #[error(
        "the transfer function's name has {0} bytes or unprintable characters, expected at most {MAX_NAME_BYTES}"
    )]
    Name(usize),
    /// The list length is out of range.
    #[error("k is {0}, expected 1 to {MAX_K}")]
    K(u8),
    /// The clip is not valid.
    #[error(transparent)]
    Clip(#[from] ClipError),
    /// The light is not valid.
    #[error(transparent)]
    Lighting(#[from] LightingError),
    /// The looks of the channels are not valid.
    #[error(transparent)]
    Channels(#[from] ChannelsError),
}

impl Look {
    /// The look that shows each value in any volume as this one does in `scene`.
    pub fn at_values(&self, scene: &Scene) -> Self {
        let all = &scene.channels;
        let chosen = &all[usize::from(self.channels.chosen).min(all.len() - 1)];
        let isos = match self.mode {
            Mode::Iso if self.isos.as_slice().is_empty() => Isos::one(chosen.histogram.parting_value()),
            _ => self.isos,
        };
        let mut channels = self.channels.clone();
        for (other, facts) in channels.others.iter_mut().zip(&all[1..]) {
            other.transfer = other.transfer.at_values(&facts.volume, &facts.histogram);
        }
        let transfer = self.transfer.at_values(&all[0].volume, &all[0].histogram);
        Self { transfer, isos, channels, ..self.clone() }
    }

    /// A look with this transfer function and defaults.
    pub fn new(transfer: TransferFunction) -> Self {
        let (lighting, clip) = (Lighting::default(), Clip::default());
        let (mode, isos) = (Mode::default(), Isos::default());
        let channels = Channels::default();
        Self { transfer, shaded: true, lighting, k: DEFAULT_K, clip, mode, isos, channels }
    }

    /// Checks what the type cannot express.
    ///
    /// # Errors
    /// The first rule that it breaks.
    pub fn validate(&self) -> Result<(), LookError> {
        let name = &self.transfer.name;
        if name.len() > MAX_NAME_BYTES || name.chars().any(is_control) {
            return Err(LookError::Name(name.len()));
        }
        if !(1..=MAX_K).contains(&usize::from(self.k)) {
            return Err(LookError::K(self.k));
        }
        self.clip.validate()?;
        self.lighting.validate()?;
        self.channels.validate(MAX_NAME_BYTES)?;
        Ok(self.transfer.validate()?)
    }

    /// The transfer function of a channel, from 0; that of the first for a channel without a look.
    pub fn transfer_of(&self, channel: u8) -> &TransferFunction {
        let other = usize::from(channel).checked_sub(1).and_then(|other| self.channels.others.get(other));
        other.map_or(&self.transfer, |other| &other.transfer)
    }

    /// The same to change it.
    pub fn transfer_of_mut(&mut self, channel: u8) -> &mut TransferFunction {
        let other = usize::from(channel).checked_sub(1).and_then(|i| self.channels.others.get_mut(i));
        other.map_or(&mut self.transfer, |other| &mut other.transfer)
    }

    /// The transfer function of the chosen channel.
    pub fn chosen_transfer(&self) -> &TransferFunction {
        self.transfer_of(self.channels.chosen)
    }

    /// Whether both march a volume alike, so that they differ at most in the length of lists.
    pub fn marches_like(&self, other: &Self) -> bool {
        Self { k: other.k, ..self.clone() } == *other
    }

    /// How a volume is marched under this look.
    pub fn march_settings(&self) -> MarchSettings {
        let &Self { shaded, lighting, clip, mode, isos, .. } = self;
        MarchSettings { clip, mode, isos, ..MarchSettings::of(shaded, lighting) }
    }
}

impl Scene {
    /// Prepares a volume under a valid look.
    pub fn of_look(volume: Arc<Volume>, look: &Look) -> Self {
        Self::with_channels(volume, &look.transfer, look.channels.clone(), look.march_settings())
    }

    /// The look that the scene is prepared under, with lists of this mean length.
    pub fn look(&self, k: u8) -> Look {
        let MarchSettings { shading, lighting, clip, mode, isos, .. } = self.settings;
        let (transfer, channels) = ((*self.transfer).clone(), self.looks.clone());
        Look { transfer, shaded: shading.is_some(), lighting, k, clip, mode, isos, channels }
    }

    /// The same volume under another look. Its shade has this detail; a draft takes its ambient occlusion from `near`,
    /// or has none.
    pub fn under(&self, look: &Look, detail: Detail, near: Option<&Occlusion>) -> Self {
        let settings = MarchSettings { detail, ..look.march_settings() };
        let (channels, looks) = (self.channels.clone(), look.channels.clone());
        Self::build(channels, &look.transfer, looks, settings, Some((self, near)))
    }
}

/// The default of [`Look::k`].
pub const DEFAULT_K: u8 = 8;
/// Longest name that is accepted.
pub const MAX_NAME_BYTES: usize = 200;
