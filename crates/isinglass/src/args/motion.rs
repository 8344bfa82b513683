//! Arguments for camera paths, and for the viewer's prediction.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use isinglass_bench::paths;
use isinglass_client::{CameraPath, Foresight};
use isinglass_formats::{open_file, read_text};

use super::Switch;

/// The viewer's measures against latency.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Foresight")]
pub(crate) struct ForesightArgs {
    /// Request frames for the camera's predicted pose
    #[arg(long, value_enum, default_value_t = Switch::On)]
    predict: Switch,
    /// Request frames with a margin where the volume continues beyond the picture
    #[arg(long, value_enum, default_value_t = Switch::On)]
    guard_band: Switch,
    /// Fill what the newest frame lacks from older ones
    #[arg(long, value_enum, default_value_t = Switch::On)]
    kept_frames: Switch,
}

impl ForesightArgs {
    /// The same as the viewer's type.
    pub(crate) fn foresight(&self) -> Foresight {
        let is_on = |switch| switch == Switch::On;
        Foresight {
            predicts: is_on(self.predict),
            guards: is_on(self.guard_band),
            keeps: is_on(self.kept_frames),
        }
    }
}

/// A camera path in a file.
#[derive(Args, Clone, Debug)]
pub(crate) struct PathArgs {
    /// Play the camera path in FILE, as `view --record` writes it, in place of the orbit; or builtin:stops,
    /// builtin:flicks, builtin:zoom-pan
    #[arg(long, value_name = "FILE")]
    pub(crate) path: Option<PathBuf>,
}

impl PathArgs {
    pub(crate) fn read(&self) -> Result<Option<CameraPath>> {
        let Some(path) = &self.path else { return Ok(None) };
        let name = path.display();
        if let Some(builtin) = path.to_str().and_then(|p| p.strip_prefix("builtin:")) {
            let known = || paths::names().collect::<Vec<_>>().join(", ");
            let found = paths::builtin(builtin);
            let found = found.with_context(|| format!("{name}: expected one of {}", known()))?;
            return Ok(Some(found.with_context(|| name.to_string())?));
        }
        let size = open_file(path)?.metadata().with_context(|| name.to_string())?.len();
        if size > MAX_PATH_BYTES {
            bail!("{name}: found {size} bytes, expected a camera path of at most {MAX_PATH_BYTES}");
        }
        let text = read_text(path, MAX_PATH_BYTES)?;
        Ok(Some(CameraPath::parse(&text).with_context(|| name.to_string())?))
    }
}

/// Longest file of a path.
const MAX_PATH_BYTES: u64 = 4 << 20;
