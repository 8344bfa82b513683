//! What the camera does: paths that are played, and what a viewer expects of it.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use isinglass_bench::paths;
use isinglass_client::{CameraPath, Foresight};

use super::Switch;

/// What a viewer does against the delay of its frames.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Foresight")]
pub(crate) struct ForesightArgs {
    /// Ask for frames from where the camera will be when they are shown
    #[arg(long, value_enum, default_value_t = Switch::On)]
    predict: Switch,
    /// Ask for frames with a margin where the volume goes on beyond the picture
    #[arg(long, value_enum, default_value_t = Switch::On)]
    guard_band: Switch,
    /// Take what the newest frame does not see from older ones
    #[arg(long, value_enum, default_value_t = Switch::On)]
    kept_frames: Switch,
}

impl ForesightArgs {
    /// In the viewer's terms.
    pub(crate) fn foresight(&self) -> Foresight {
        let is_on = |switch| switch == Switch::On;
        Foresight {
            predicts: is_on(self.predict),
            guards: is_on(self.guard_band),
            keeps: is_on(self.kept_frames),
        }
    }
}

/// A camera path from a file.
#[derive(Args, Clone, Debug)]
pub(crate) struct PathArgs {
    /// Play the camera path in FILE, as `view --record` writes it, in place of the orbit; or builtin:stops,
    /// builtin:flicks, builtin:zoom-pan
    #[arg(long, value_name = "FILE")]
    pub(crate) path: Option<PathBuf>,
}

impl PathArgs {
    /// Reads it.
    pub(crate) fn read(&self) -> Result<Option<CameraPath>> {
        let Some(path) = &self.path else { return Ok(None) };
        let name = path.display();
        if let Some(builtin) = path.to_str().and_then(|p| p.strip_prefix("builtin:")) {
            let known = || paths::names().collect::<Vec<_>>().join(", ");
            let found = paths::builtin(builtin);
            let found = found.with_context(|| format!("{name}: expected one of {}", known()))?;
            return Ok(Some(found.with_context(|| name.to_string())?));
        }
        let size = std::fs::metadata(path).with_context(|| name.to_string())?.len();
        if size > MAX_PATH_BYTES {
            bail!("{name}: found {size} bytes, expected a camera path of at most {MAX_PATH_BYTES}");
        }
        let text = std::fs::read_to_string(path).with_context(|| name.to_string())?;
        Ok(Some(CameraPath::parse(&text).with_context(|| name.to_string())?))
    }
}

/// A path of the greatest length, with every number written out.
const MAX_PATH_BYTES: u64 = 4 << 20;
