//! How matter looks, and which segments it becomes.

use anyhow::Result;
use clap::{Args, ValueEnum};
use isinglass_core::kernels::march::MarchSettings;
use isinglass_core::look::{DEFAULT_K, Look};
use isinglass_core::mode::{Isos, Mode as RenderMode};
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::Lighting;
use isinglass_formats::preset;

use super::{parse_k, usage_error};
use crate::clip_args::ClipArgs;

/// How matter looks.
#[derive(Args, Clone, Debug)]
pub(crate) struct LookArgs {
    /// Transfer function: a preset or a TOML file [default: the preset that suits the volume]
    #[arg(long, value_name = "FILE|PRESET")]
    pub(crate) tf: Option<String>,
    /// Whether gradients shade the colours
    #[arg(long, value_enum, default_value_t = Switch::On)]
    pub(crate) shading: Switch,
    /// What a pixel tells of its ray: composite, mip, minip, average or iso [default: composite, with --iso iso]
    #[arg(long, value_name = "MODE")]
    mode: Option<RenderMode>,
    /// Values of the surfaces of --mode iso, each with an opacity if it is not opaque [default: the value that parts the
    /// histogram best]
    #[arg(long, value_name = "V[:OPACITY],…", allow_hyphen_values = true)]
    iso: Option<Isos>,
    #[command(flatten)]
    pub(crate) clip: ClipArgs,
}

/// On or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Switch {
    /// Yes.
    On,
    /// No.
    Off,
}

impl LookArgs {
    /// Whether gradients shade.
    pub(crate) fn is_shaded(&self) -> bool {
        self.shading == Switch::On
    }

    /// The transfer function, if no preset is meant.
    pub(crate) fn transfer_file(&self) -> Option<&str> {
        self.tf.as_deref().filter(|name| preset(name).is_none())
    }

    /// The mode, and its surfaces.
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

    /// How the volume is marched.
    pub(crate) fn march_settings(&self, lighting: Lighting) -> Result<MarchSettings> {
        let (mode, isos) = self.mode()?;
        Ok(MarchSettings {
            clip: self.clip.clip(),
            mode,
            isos,
            ..MarchSettings::of(self.is_shaded(), lighting)
        })
    }

    /// What is asked for, of a volume whose transfer function is `transfer`.
    pub(crate) fn look(&self, transfer: TransferFunction, lists: &ListArgs) -> Result<Look> {
        let &ListArgs { k } = lists;
        let (mode, isos) = self.mode()?;
        let clip = self.clip.clip();
        Ok(Look { shaded: self.is_shaded(), k, clip, mode, isos, ..Look::new(transfer) })
    }
}

/// How many segments a layered frame holds.
#[derive(Args, Clone, Debug)]
pub(crate) struct ListArgs {
    /// Segments a pixel, on average over those that see anything
    #[arg(long, value_name = "K", value_parser = parse_k, default_value_t = DEFAULT_K)]
    pub(crate) k: u8,
}

impl Default for ListArgs {
    fn default() -> Self {
        Self { k: DEFAULT_K }
    }
}
