//! What the tables of the laboratory are asked for.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use isinglass_bench::progress::note;
use isinglass_bench::scenes::{self, distinct};
use isinglass_bench::subject::Subject;
use isinglass_core::camera::Intrinsics;
use isinglass_core::clip::Clip;
use isinglass_core::layer::MAX_K;
use isinglass_core::mode::{Isos, Mode};
use isinglass_core::orbit::Orbit;
use isinglass_formats::{check_writable, write_whole};
use serde::Serialize;

/// What all tables have in common.
#[derive(Args)]
pub(crate) struct CommonArgs {
    /// Scenes: cloud, cubus, shells, bonsai, engine, avm, t1_head, heptane, mouse_brain, a file or folder, or a built-in
    /// volume [default: all]. Scanned volumes come from the folder that ISINGLASS_DATA names, or from shared/data
    #[arg(value_name = "SCENE")]
    pub(crate) scenes: Vec<String>,
    /// Columns and rows of pictures, and of frames if nothing else is said
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "256x256")]
    pub(crate) size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = isinglass_client::DEFAULT_FOV_Y_DEGREES)]
    pub(crate) fov: f32,
    /// Generating camera: azimuth and elevation in degrees, distance in radii
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    pub(crate) orbit: Orbit,
    /// Transfer function: a preset or a TOML file [default: the preset that suits each volume]
    #[arg(long, value_name = "FILE|PRESET")]
    pub(crate) tf: Option<String>,
    /// Whether gradients shade the colours
    #[arg(long, value_enum, default_value_t = Switch::On)]
    pub(crate) shading: Switch,
    /// What a pixel tells of its ray: composite, mip, minip, average or iso
    #[arg(long, value_name = "MODE", default_value_t = Mode::default())]
    pub(crate) mode: Mode,
    /// As JSON
    #[arg(long)]
    pub(crate) json: bool,
    /// Also write the JSON to a file, whole or not at all
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
}

/// On or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Switch {
    /// Yes.
    On,
    /// No.
    Off,
}

impl CommonArgs {
    pub(crate) fn intrinsics(&self) -> Intrinsics {
        let [width, height] = self.size;
        Intrinsics::perspective(width, height, self.fov.to_radians())
    }

    pub(crate) fn select(&self) -> Result<Vec<scenes::SceneSource>> {
        let selection = scenes::select(&self.scenes, scenes::data_folder().as_deref())?;
        for skipped in &selection.skipped {
            note(&format!("skipped {skipped}"));
        }
        // What cannot be opened is refused before hours of measuring.
        selection.scenes.iter().try_for_each(scenes::SceneSource::check)?;
        Ok(selection.scenes)
    }

    /// What is looked at.
    pub(crate) fn subject(&self, ks: Vec<u8>, angles_degrees: Vec<f32>) -> Result<Subject> {
        Ok(Subject {
            scenes: self.select()?,
            transfer: self.tf.clone(),
            ks: distinct(ks),
            angles_degrees: distinct(angles_degrees),
            orbit: self.orbit,
            intrinsics: self.intrinsics(),
            shaded: self.shading == Switch::On,
            mode: self.mode,
            isos: Isos::default(),
            clip: Clip::default(),
        })
    }

    /// Refuses a file that cannot be written to.
    pub(crate) fn check_output(&self) -> Result<()> {
        Ok(self.output.iter().try_for_each(|path| check_writable(path))?)
    }

    /// Prints, then writes: what was measured is not lost with a file, nor with a scene that failed, which is told last.
    pub(crate) fn publish(&self, report: &impl Serialize, table: &str, failed: &[String]) -> Result<()> {
        let text = serde_json::to_string_pretty(report)? + "\n";
        let printed = print(if self.json { &text } else { table });
        if let Some(path) = &self.output {
            write_whole(path, text.as_bytes())?;
        }
        printed?;
        if failed.is_empty() { Ok(()) } else { bail!("not measured to the end: {}", failed.join("; ")) }
    }
}

/// Writes text to standard output. A reader that went away is no failure.
pub(crate) fn print(text: &str) -> Result<()> {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        result => result.context("standard output"),
    }
}

/// `WxH`.
pub(crate) fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    sides
        .filter(|sides| sides.iter().all(|side| (1..=8192).contains(side)))
        .ok_or_else(|| "expected WxH with sides of 1 to 8192, such as 512x512".into())
}

/// A number within bounds, for `value_parser`.
fn number(text: &str, low: f32, high: f32, of: &str) -> Result<f32, String> {
    let number = text.parse::<f32>().ok().filter(|x| (low..=high).contains(x));
    number.ok_or_else(|| format!("expected {low} to {high} {of}"))
}

fn parse_fov(text: &str) -> Result<f32, String> {
    number(text, 1.0, 170.0, "degrees")
}

/// Degrees of a turn.
pub(crate) fn parse_angle(text: &str) -> Result<f32, String> {
    number(text, -360.0, 360.0, "degrees")
}

/// Degrees a second.
pub(crate) fn parse_speed(text: &str) -> Result<f32, String> {
    number(text, 0.1, 3600.0, "degrees a second")
}

/// Milliseconds.
pub(crate) fn parse_ms(text: &str) -> Result<f32, String> {
    number(text.strip_suffix("ms").unwrap_or(text), 0.0, 60_000.0, "milliseconds")
}

/// A side of a frame in units of the picture's.
pub(crate) fn parse_list_scale(text: &str) -> Result<f32, String> {
    number(text, 0.05, 1.0, "of the picture's side")
}

/// A list length.
pub(crate) fn parse_k(text: &str) -> Result<u8, String> {
    let k = text.parse::<u8>().ok().filter(|&k| (1..=MAX_K).contains(&usize::from(k)));
    k.ok_or_else(|| format!("expected 1 to {MAX_K}"))
}
