//! A volume with the look that it is seen with, ready to be marched.

use std::sync::Arc;

use isinglass_core::channels::Channels;
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::{Histogram, Volume};

use crate::channel_looks::default_channels;
use crate::error::FormatError;
use crate::first_look::default_transfer;
use crate::source::{OpenOptions, open};
use crate::transfer::load_transfer;

/// A volume made ready, and the transfer function it is seen with.
#[derive(Clone, Debug)]
pub struct OpenedScene {
    /// Volume, table and settings.
    pub scene: Scene,
    /// The transfer function of the first channel.
    pub transfer: TransferFunction,
    /// The looks of the channels.
    pub channels: Channels,
}

/// Opens a volume with the transfer function that is asked for (a preset's name or a file), or else the one that
/// suits it.
///
/// # Errors
/// If one of both cannot be had.
pub fn open_scene(
    source: &str,
    transfer: Option<&str>,
    settings: MarchSettings,
    options: &OpenOptions,
) -> Result<OpenedScene, FormatError> {
    // First, because it fails fast.
    let transfer = transfer.map(load_transfer).transpose()?;
    let volume = Arc::new(open(source, options)?);
    Ok(ready(volume, source, transfer, settings))
}

/// The same of a volume that was opened already, from `source`.
///
/// # Errors
/// If there is no such transfer function.
pub fn scene_of(
    volume: Arc<Volume>,
    source: &str,
    transfer: Option<&str>,
    settings: MarchSettings,
) -> Result<OpenedScene, FormatError> {
    let transfer = transfer.map(load_transfer).transpose()?;
    Ok(ready(volume, source, transfer, settings))
}

fn ready(
    volume: Arc<Volume>,
    source: &str,
    transfer: Option<TransferFunction>,
    settings: MarchSettings,
) -> OpenedScene {
    let transfer = match transfer {
        Some(transfer) => transfer,
        None => default_transfer(source, &volume, &Histogram::of(&volume)),
    };
    let channels = default_channels(&volume);
    let scene = Scene::with_channels(volume, &transfer, channels.clone(), settings);
    OpenedScene { scene, transfer, channels }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_opens_with_its_own_preset_unless_another_is_named() {
        let open = |transfer| {
            open_scene("builtin:shells@16", transfer, MarchSettings::default(), &OpenOptions::default())
        };
        assert_eq!(open(None).unwrap().transfer, load_transfer("shells").unwrap());
        assert_eq!(open(Some("ct")).unwrap().transfer, load_transfer("ct").unwrap());
        assert!(open(Some("no such preset")).is_err());
    }
}
