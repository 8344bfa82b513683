//! Arguments for the look of matter, and for its segments.

use anyhow::Result;
use clap::{Args, ValueEnum};
use isinglass_core::channels::Channels;
use isinglass_core::kernels::march::MarchSettings;
use isinglass_core::look::{DEFAULT_K, Look};
use isinglass_core::mode::{Isos, Mode as RenderMode};
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::Lighting;
use isinglass_formats::preset;

use super::{parse_k, usage_error};
use crate::clip_args::ClipArgs;

/// The look of matter.
#[derive(Args, Clone, Debug)]
pub(crate) struct LookArgs {
    /// Transfer function: a preset or a TOML file [default: the preset that suits the volume]
    #[arg(long, value_name = "FILE|PRESET")]
    pub(crate) tf: Option<String>,
    /// Whether gradients shade the colours
    #[arg(long, value_enum, default_value_t = Switch::On)]
    pub(crate) shading: Switch,
    /// What a pixel shows of its ray: composite, mip, minip, average or iso [default: composite, or iso with --iso]
    #[arg(long, value_name = "MODE")]
    mode: Option<RenderMode>,
    /// Values of the surfaces of --mode iso, each with an opacity unless it is opaque [default: the value that splits
    /// the histogram best]
    #[arg(long, value_name = "V[:OPACITY],…", allow_hyphen_values = true)]
    iso: Option<Isos>,
    #[command(flatten)]
    pub(crate) clip: ClipArgs,
}

/// On or off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Switch {
    /// Yes.
    On,
    /// No.
    #[default]
    Off,
}

impl LookArgs {
    /// Whether gradients shade.
    pub(crate) fn is_shaded(&self) -> bool {
        self.shading == Switch::On
    }

    /// The transfer function, unless it is a preset.
    pub(crate) fn transfer_file(&self) -> Option<&str> {
        self.tf.as_deref().filter(|name| preset(name).is_none())
    }

    pub(crate) fn mode(&self) -> Result<(RenderMode, Isos)> {
        let isos = self.iso.unwrap_or_default();
        match (self.mode, self.iso) {
            (None, Some(_)) => Ok((RenderMode::Iso, isos)),
            (Some(mode), Some(_)) if mode != RenderMode::Iso => {
                Err(usage_error(format!("--iso: found --mode {mode}, expected --mode iso")))
            }
            (mode, _) => Ok((mode.unwrap_or_default(), isos)),
        }
    }

    pub(crate) fn march_settings(&self, lighting: Lighting) -> Result<MarchSettings> {
        let (mode, isos) = self.mode()?;
        Ok(MarchSettings {
            clip: self.clip.clip(),
            mode,
            isos,
            ..MarchSettings::of(self.is_shaded(), lighting)
        })
    }

    /// The requested look of a volume with this transfer function and these channels.
    pub(crate) fn look(
        &self,
        transfer: TransferFunction,
        channels: Channels,
        lists: &ListArgs,
    ) -> Result<Look> {
        let &ListArgs { k } = lists;
        let (mode, isos) = self.mode()?;
        let clip = self.clip.clip();
        let shaded = self.is_shaded();
        Ok(Look { shaded, k, clip, mode, isos, channels, ..Look::new(transfer) })
    }
}

/// The number of segments in a layered frame.
#[derive(Args, Clone, Debug)]
pub(crate) struct ListArgs {
    /// Mean number of segments per pixel, over pixels that see anything
    #[arg(long, value_name = "K", value_parser = parse_k, default_value_t = DEFAULT_K)]
    pub(crate) k: u8,
}

impl Default for ListArgs {
    fn default() -> Self {
        Self { k: DEFAULT_K }
    }
}
