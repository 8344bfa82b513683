//! `bench viewers`: what viewers of one server cost it.

use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::Result;
use clap::{Args, ValueEnum};
use isinglass_bench::BenchError;
use isinglass_bench::demo::DEFAULT_SOURCE;
use isinglass_bench::scenes::distinct;
use isinglass_bench::viewers::{self, Looks, ServerProcess, ViewersOptions};
use isinglass_core::camera::Intrinsics;
use isinglass_core::orbit::Orbit;

use super::demo::parse_speed;
use crate::args::{BackendArgs, GpusArgs, any_text, parse_fov, parse_size};
use crate::report::{print, print_json};

#[derive(Args)]
pub(super) struct ViewersArgs {
    /// A volume, as for `serve`
    #[arg(value_name = "VOLUME", default_value = DEFAULT_SOURCE, value_parser = any_text())]
    volume: String,
    /// Numbers of viewers, between commas
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [1, 2, 4, 8, 16], value_parser = clap::value_parser!(u32).range(1..=100))]
    viewers: Vec<u32>,
    /// Looks of the viewers, between commas
    #[arg(long, value_enum, value_name = "LOOKS", value_delimiter = ',', default_values_t = [LooksChoice::Same, LooksChoice::Different])]
    looks: Vec<LooksChoice>,
    /// How long cameras move in each row, seconds
    #[arg(long, value_name = "N", default_value_t = 6, value_parser = clap::value_parser!(u32).range(1..=3600))]
    seconds: u32,
    /// How often each row is measured; medians count
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,
    /// Columns and rows of the pictures
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "512x512")]
    size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = isinglass_client::DEFAULT_FOV_Y_DEGREES)]
    fov: f32,
    /// Where the first camera begins, see `render`; the others are spread around the volume
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// Speed of the cameras, degrees per second
    #[arg(long, value_name = "DEG", default_value_t = 30.0, value_parser = parse_speed)]
    speed: f32,
    /// An argument of `serve`, such as --ambient-occlusion or --max-memory=2G; may come several times
    #[arg(long, value_name = "FLAG", allow_hyphen_values = true)]
    serve: Vec<OsString>,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    gpus: GpusArgs,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// The looks of the viewers.
#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
enum LooksChoice {
    /// All have the server's.
    Same,
    /// Each has one of its own.
    Different,
}

pub(super) fn run(args: ViewersArgs) -> Result<()> {
    let [width, height] = args.size;
    let looks = distinct(args.looks).into_iter().map(|looks| match looks {
        LooksChoice::Same => Looks::Same,
        LooksChoice::Different => Looks::Different,
    });
    let options = ViewersOptions {
        counts: distinct(args.viewers),
        looks: looks.collect(),
        duration: Duration::from_secs(args.seconds.into()),
        repeats: args.repeats,
        orbit: args.orbit,
        degrees_per_second: args.speed,
        intrinsics: Intrinsics::perspective(width, height, args.fov.to_radians()),
    };
    let mut flags: Vec<OsString> = vec!["serve".into(), "--listen".into(), "127.0.0.1:0".into()];
    flags.extend(["--backend".into(), args.backend.backend.to_string().into()]);
    flags.extend(["--gpus".into(), args.gpus.gpus.to_string().into()]);
    flags.extend(args.serve);
    let report = viewers::run(&args.volume, &options, |count| serve(&flags, count, &args.volume))?;
    if args.json { print_json(&report) } else { print(&viewers::table(&report)) }
}

/// Starts a server for so many viewers, as this program does with `serve`.
fn serve(flags: &[OsString], count: u32, volume: &str) -> Result<ServerProcess, BenchError> {
    let failed = |e: &dyn std::fmt::Display| BenchError::Demo(format!("the server: {e}"));
    let own = std::env::current_exe().map_err(|e| failed(&e))?;
    let mut command = Command::new(own);
    command.args(flags).args(["--viewers", &count.to_string(), "--", volume]);
    // What it prints on standard error is for the user only if it fails.
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().map_err(|e| failed(&e))?;
    let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
    let links = stdout.map(|stdout| BufReader::new(stdout).lines().take(count as usize));
    let links: Vec<String> = links.into_iter().flatten().collect::<Result<_, _>>().map_err(|e| failed(&e))?;
    if links.len() < count as usize {
        let told = stderr.map(|stderr| BufReader::new(stderr).lines().map_while(Result::ok).last());
        let _ = child.wait();
        return Err(failed(&told.flatten().unwrap_or_else(|| "ended without a link".into())));
    }
    // The server may say more as long as it runs.
    child.stderr = stderr;
    let links = links.iter().map(|link| link.parse()).collect::<Result<_, _>>().map_err(|e| failed(&e))?;
    Ok(ServerProcess::new(child, links))
}
