//! Arguments for the coding of frames.

use clap::error::ErrorKind;
use clap::{Args, ValueEnum};
use isinglass_core::codec::blocks::MAX_TURN_DEG;
use isinglass_core::session::rate::{CodingMode, CodingPlan, DEFAULT_QUALITY};

/// The coding of a server's frames.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Coding")]
pub(crate) struct PlanArgs {
    /// Codec: exact, which keeps every list and depth; blocks, which takes far fewer bytes; or auto: blocks while the camera
    /// moves and exact frames where it rests
    #[arg(long, value_enum, default_value_t = ModeChoice::Auto)]
    codec: ModeChoice,
    /// Best quality of frames in blocks, from 0 to 100; less where the link is too narrow for it
    #[arg(long, value_name = "Q", default_value_t = DEFAULT_QUALITY, value_parser = clap::value_parser!(u8).range(0..=100))]
    quality: u8,
}

/// The codings of a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ModeChoice {
    /// Blocks in movement, exact at rest.
    Auto,
    /// All lists and depths unchanged.
    Exact,
    /// Lists in blocks.
    Blocks,
}

impl PlanArgs {
    /// The plan for a server, with at most `rate_mbit` megabits per second.
    pub(crate) fn plan(&self, rate_mbit: Option<f64>) -> CodingPlan {
        let mode = match self.codec {
            ModeChoice::Auto => CodingMode::Auto,
            ModeChoice::Exact => CodingMode::Exact,
            ModeChoice::Blocks => CodingMode::Blocks,
        };
        let bytes_per_second = rate_mbit.map(|mbit| mbit * 1e6 / 8.0);
        CodingPlan { mode, quality: self.quality, bytes_per_second }
    }
}

/// The coding of one frame.
#[derive(Args, Clone, Debug)]
pub(crate) struct CodecArgs {
    /// Codec: exact, which keeps every list and depth, or blocks, which takes far fewer bytes
    #[arg(long, value_enum, default_value_t = CodecChoice::Exact)]
    pub(crate) codec: CodecChoice,
    /// Quality of --codec blocks, from 0 to 100 [default: 60]
    #[arg(long, value_name = "Q", value_parser = clap::value_parser!(u8).range(0..=100))]
    pub(crate) quality: Option<u8>,
    /// Choose the best quality of --codec blocks that keeps the frame within so many bytes
    #[arg(long, value_name = "N", conflicts_with = "quality")]
    pub(crate) bytes: Option<usize>,
    /// Angle from which the frame will be seen, degrees, at most 10 and rounded: --codec blocks spends its bytes
    /// where they show at that turn [default: suits all]
    #[arg(long, value_name = "DEG", value_parser = parse_turn)]
    pub(crate) turn: Option<f32>,
}

impl CodecArgs {
    /// # Errors
    /// Of usage, where an argument has no meaning for the codec.
    pub(crate) fn check(&self) -> Result<(), clap::Error> {
        let usage = |text| Err(clap::Error::raw(ErrorKind::ArgumentConflict, text));
        if self.codec == CodecChoice::Blocks {
            let most = f32::from(MAX_TURN_DEG);
            return match self.turn {
                Some(turn) if turn > most => {
                    usage(format!("--turn: found {turn}, expected at most {most} with --codec blocks"))
                }
                _ => Ok(()),
            };
        }
        let given = [
            ("--quality", self.quality.is_some()),
            ("--bytes", self.bytes.is_some()),
            ("--turn", self.turn.is_some()),
        ];
        given.iter().find(|(_, is_given)| *is_given).map_or(Ok(()), |(name, _)| {
            usage(format!("{name}: found --codec exact, expected --codec blocks"))
        })
    }
}

/// A codec.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum CodecChoice {
    /// All lists and depths unchanged.
    Exact,
    /// Lists in blocks.
    Blocks,
}

fn parse_turn(text: &str) -> Result<f32, String> {
    let degrees = text.parse::<f32>().ok().filter(|d| (0.0..=90.0).contains(d));
    degrees.ok_or_else(|| "expected 0 to 90 degrees".into())
}
