//! `bench`: tables of quality, speed, codecs and latency.

use std::future::{Future, poll_fn};
use std::path::PathBuf;
use std::pin::pin;
use std::task::Poll;
use std::time::Duration;

use anyhow::{Result, bail};
use clap::{Args, Subcommand};
use isinglass_bench::choices::{MethodChoice, Rule, parse_reconstruction};
use isinglass_bench::demo::DemoOptions;
use isinglass_bench::latency::LatencyMethod;
use isinglass_bench::output::{check_writable, exit_between_writes, write_whole};
use isinglass_bench::progress::note;
use isinglass_bench::scenes::distinct;
use isinglass_bench::subject::Subject;
use isinglass_bench::view::Orbit;
use isinglass_bench::{codec as codecs, latency, quality, scenes, speed};
use isinglass_core::camera::Intrinsics;
use isinglass_core::codec;
use isinglass_core::codec::blocks::MAX_TURN_DEG;
use isinglass_core::kernels::layering::Layering;
use isinglass_core::kernels::raycast::Reconstruction;
use isinglass_core::look::DEFAULT_K;
use isinglass_formats::VolumeSource;
use isinglass_gpu::{Backend, BackendChoice};
use serde::Serialize;

use super::demo::parse_speed;
use super::pipeline::{self, PipelineArgs};
use crate::args::{
    BackendArgs, ForesightArgs, LayeringArgs, LinkArgs, LookArgs, PartArgs, PathArgs, PlanArgs, RawArgs,
    Switch, not_an_input, parse_duration, parse_fov, parse_k, parse_output, parse_size,
};
use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    table: Table,
}

#[derive(Subcommand)]
enum Table {
    /// How near novel views come to full renderings
    Quality(QualityArgs),
    /// How long rendering, layers, coding and novel views take
    Speed(SpeedArgs),
    /// What is shown under latency: the headless demo over a table of round-trip times
    Latency(LatencyArgs),
    /// What codecs make of layered frames: bytes, times, and what is left of the picture
    Codec(CodecArgs),
    /// Where the time of a frame goes from the wish to the screen: server and viewer over a slowed-down link
    Pipeline(Box<PipelineArgs>),
}

/// What all tables have in common.
#[derive(Args)]
struct CommonArgs {
    /// Scenes: cloud, cubus, shells, bonsai, engine, avm, t1_head, heptane, mouse_brain, a file or folder, or a built-in
    /// volume [default: all]. Scanned volumes come from the folder that ISINGLASS_DATA names, or from shared/data
    #[arg(value_name = "SCENE", help_heading = None::<&'static str>)]
    scenes: Vec<String>,
    /// Columns and rows of pictures, and of frames if nothing else is said
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "256x256")]
    size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = isinglass_client::DEFAULT_FOV_Y_DEGREES)]
    fov: f32,
    /// Generating camera: azimuth and elevation in degrees, distance in radii, as for render
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// As JSON
    #[arg(long)]
    json: bool,
    /// Also write the JSON to a file, whole or not at all
    #[arg(short, long, value_name = "FILE", value_parser = parse_output)]
    output: Option<PathBuf>,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    part: PartArgs,
    #[command(flatten)]
    raw: RawArgs,
}

impl CommonArgs {
    fn intrinsics(&self) -> Intrinsics {
        let [width, height] = self.size;
        Intrinsics::perspective(width, height, self.fov.to_radians())
    }

    fn select(&self) -> Result<Vec<scenes::SceneSource>> {
        let selection = scenes::select(&self.scenes, scenes::data_folder().as_deref())?;
        for skipped in &selection.skipped {
            note(&format!("skipped {skipped}"));
        }
        let mut scenes = selection.scenes;
        for scene in &mut scenes {
            let (raw, selection, spacing) = (self.raw.shape(), self.part.selection(), self.part.spacing);
            scene.volume = VolumeSource { raw, selection, spacing, ..scene.volume.clone() };
            // What cannot be opened is refused before hours of measuring.
            scene.check()?;
        }
        Ok(scenes)
    }

    /// What is looked at.
    fn subject(&self, ks: Vec<u8>, angles_degrees: Vec<f32>) -> Result<Subject> {
        let (mode, isos) = self.look.mode()?;
        Ok(Subject {
            scenes: self.select()?,
            transfer: self.look.tf.clone(),
            ks: distinct(ks),
            angles_degrees: distinct(angles_degrees),
            orbit: self.orbit,
            intrinsics: self.intrinsics(),
            shaded: self.look.is_shaded(),
            mode,
            isos,
            clip: self.look.clip.clip(),
        })
    }

    /// Refuses a file that cannot be written to.
    fn check_output(&self) -> Result<()> {
        if let Some(output) = &self.output {
            let transfer = std::iter::once(self.look.transfer_file());
            not_an_input(output, self.scenes.iter().map(|scene| Some(scene.as_str())).chain(transfer))?;
        }
        self.output.iter().try_for_each(|path| Ok(check_writable(path)?))
    }

    /// Prints, then writes: what was measured is not lost with a file, nor with a scene that failed, which is told last.
    fn publish(&self, report: &impl Serialize, table: &str, failed: &[String]) -> Result<()> {
        let printed = if self.json { print_json(report) } else { print(table) };
        if let Some(path) = &self.output {
            write_whole(path, (serde_json::to_string_pretty(report)? + "\n").as_bytes())?;
        }
        printed?;
        if failed.is_empty() { Ok(()) } else { bail!("not measured to the end: {}", failed.join("; ")) }
    }
}

/// How a layered frame is looked at.
#[derive(Args)]
struct CastArgs {
    /// How frames become pictures: layers, point-warp, slabs-planar, slabs-mesh or last-image, between commas. With @RULE
    /// on frames of that rule only, as point-warp@single-depth and slabs-mesh@slabs
    #[arg(long, value_name = "METHOD[@RULE]", value_delimiter = ',', default_values_t = [MethodChoice::default()])]
    method: Vec<MethodChoice>,
    /// How the ray cast reads lists, between commas: mixed takes the two lists that a ray runs between, nearest (as the
    /// papers have it) one
    #[arg(long, value_name = "LISTS", value_parser = parse_reconstruction, value_delimiter = ',', default_value = "mixed")]
    reconstruction: Vec<Reconstruction>,
    /// Most segments a pixel, or for rules with a budget their mean, between commas
    #[arg(long, value_name = "K", value_parser = parse_k, value_delimiter = ',', default_values_t = [DEFAULT_K])]
    k: Vec<u8>,
}

#[derive(Args)]
struct QualityArgs {
    /// Rules, between commas: those of `layers`, and all-samples, the floor with every sample kept
    #[arg(long, value_name = "RULE", value_delimiter = ',', default_value = DEFAULT_RULES)]
    layering: Vec<Rule>,
    #[command(flatten)]
    cast: CastArgs,
    /// Turns of azimuth to either side, degrees, between commas; 0 is the generating camera
    #[arg(long, value_name = "DEG", value_parser = parse_angle, value_delimiter = ',', default_value = "0,5,10,30")]
    angles: Vec<f32>,
    /// Columns and rows of lists [default: those of the pictures]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    frame_size: Option<[u32; 2]>,
    /// Whether frames are also measured as they are after encoding and decoding
    #[arg(long, value_enum, default_value_t = Switch::On)]
    wire: Switch,
    #[command(flatten)]
    backend: BackendArgs,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Args)]
struct SpeedArgs {
    /// Rules, between commas
    #[arg(long, value_name = "RULE", value_delimiter = ',', default_values_t = [Layering::default()])]
    layering: Vec<Layering>,
    #[command(flatten)]
    cast: CastArgs,
    /// Turns of the novel view, degrees, between commas
    #[arg(long, alias = "angle", value_name = "DEG", value_parser = parse_angle, value_delimiter = ',', default_value = "5,30")]
    angles: Vec<f32>,
    /// Columns and rows of lists, between commas [default: those of the pictures]
    #[arg(long, value_name = "WxH", value_parser = parse_size, value_delimiter = ',')]
    frame_size: Vec<[u32; 2]>,
    /// Frame rates to be held by a coarser cast, between commas: what is left of the picture
    #[arg(long, value_name = "FPS", value_parser = parse_target, value_delimiter = ',')]
    target_fps: Vec<f32>,
    /// Rounds of which the least time counts
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,
    /// Backends, between commas [default: cpu, and gpu if there is one]
    #[arg(long, value_name = "BACKEND", value_delimiter = ',')]
    backend: Vec<BackendChoice>,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Args)]
struct LatencyArgs {
    #[command(flatten)]
    layering: LayeringArgs,
    /// How frames become pictures, between commas: as in `bench quality`, and with :no-prediction at the end without
    /// prediction, as point-warp@single-depth:no-prediction
    #[arg(long, value_name = "METHOD", value_delimiter = ',', default_values_t = [LatencyMethod::default()])]
    method: Vec<LatencyMethod>,
    /// Round-trip times, between commas
    #[arg(long, alias = "rtts", value_name = "TIME", value_parser = parse_duration, value_delimiter = ',', default_value = "0ms,100ms,300ms")]
    rtt: Vec<Duration>,
    /// Speeds of the camera, degrees a second, between commas
    #[arg(long, value_name = "DEG", default_value = "30", value_parser = parse_speed, value_delimiter = ',')]
    speed: Vec<f32>,
    /// Pictures of each run that are compared with the truth, at most
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    compared: u32,
    /// Keep the pictures and reports of each run in a folder of its own in DIR
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    path: PathArgs,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    plan: PlanArgs,
    #[command(flatten)]
    link: LinkArgs,
    #[command(flatten)]
    foresight: ForesightArgs,
}

#[derive(Args)]
struct CodecArgs {
    /// Codecs, between commas: blocks, exact, raw-zstd, png-published, blocks-planes, and in a build with --features
    /// rivals raw-lz4, jpeg2000-published, jpeg2000-planes, htj2k-published, htj2k-planes, avif-planes,
    /// webp-published; there also jpegxl-planes, jpegxl-modular-planes and avif-aom-planes, where cjxl and djxl, or avifenc
    /// and avifdec are installed [default: all]
    #[arg(long, value_name = "CODEC", value_delimiter = ',')]
    codec: Vec<String>,
    /// The codec that others are compared with by BD-rate [default: jpeg2000-published in a build
    /// with --features rivals, or else blocks-planes]
    #[arg(long, value_name = "CODEC")]
    anchor: Option<String>,
    /// Most segments a pixel, or for rules with a budget their mean, between commas
    #[arg(long, value_name = "K", value_parser = parse_k, value_delimiter = ',', default_values_t = [DEFAULT_K])]
    k: Vec<u8>,
    /// Turns of azimuth, degrees, between commas; 0 is the generating camera
    #[arg(long, value_name = "DEG", value_parser = parse_angle, value_delimiter = ',', default_value = "0,5,10", allow_hyphen_values = true)]
    angles: Vec<f32>,
    /// Sides of frames in units of the pictures', between commas: every codec but those as published has the choice, and
    /// those want 1 among them
    #[arg(long, value_name = "SHARE", value_parser = parse_list_scale, value_delimiter = ',', default_value = "1")]
    list_scale: Vec<f32>,
    /// Turns that frames in blocks are made to be seen at, 0 to 10 degrees, or "all", between commas: blocks have the choice
    #[arg(long, value_name = "DEG", value_parser = parse_seen_at, value_delimiter = ',', default_value = "all")]
    seen_at: Vec<SeenAt>,
    /// Also draw the curves as SVG, whole or not at all
    #[arg(long, value_name = "FILE", value_parser = parse_output)]
    plot: Option<PathBuf>,
    /// Also code a camera that orbits at so many degrees a second, 30 frames a second
    #[arg(long, value_name = "DEG", value_parser = parse_speed)]
    turn: Option<f32>,
    /// Frames of the orbit; the first counts for nothing but the bytes a second
    #[arg(long, value_name = "N", default_value_t = 120, value_parser = clap::value_parser!(u32).range(3..=100_000), requires = "turn")]
    frames: u32,
    /// The orbit rests in its middle, for a fifth of the frames
    #[arg(long, requires = "turn")]
    stop: bool,
    /// Frames of the orbit that are compared with the truth, at most
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=100_000), requires = "turn")]
    compared: u32,
    /// Also take the times of blocks and exact frames from start to end on so many threads, between commas
    #[arg(long, value_name = "N", value_parser = parse_threads, value_delimiter = ',')]
    threads: Vec<usize>,
    /// Rounds of which the least time counts
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000), requires = "threads")]
    repeats: u32,
    #[command(flatten)]
    backend: BackendArgs,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    common: CommonArgs,
}

pub(crate) fn run(args: BenchArgs) -> Result<()> {
    exit_on_interrupt()?;
    match args.table {
        Table::Quality(args) => run_quality(args),
        Table::Speed(args) => run_speed(args),
        Table::Latency(args) => run_latency(args),
        Table::Codec(args) => run_codec(args),
        Table::Pipeline(args) => pipeline::run(*args),
    }
}

/// From now on Ctrl-C ends the process at once, and leaves no half of a file.
fn exit_on_interrupt() -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let (listening, listens) = std::sync::mpsc::sync_channel(1);
    let wait = move || {
        let interrupted = runtime.block_on(async {
            let mut interrupt = pin!(tokio::signal::ctrl_c());
            // Its first poll is what listens.
            let first = poll_fn(|context| Poll::Ready(interrupt.as_mut().poll(context))).await;
            // Fails only if the process is about to end.
            let _ = listening.send(());
            match first {
                Poll::Ready(result) => result,
                Poll::Pending => interrupt.await,
            }
        });
        if interrupted.is_ok() {
            note("isinglass: interrupted");
            exit_between_writes(INTERRUPTED);
        }
    };
    std::thread::Builder::new().name("interrupt".into()).spawn(wait)?;
    Ok(listens.recv()?)
}

fn run_quality(args: QualityArgs) -> Result<()> {
    let common = args.common;
    common.check_output()?;
    let [width, height] = args.frame_size.unwrap_or(common.size);
    let report = quality::run(&quality::QualityOptions {
        subject: common.subject(args.cast.k, args.angles)?,
        rules: args.layering,
        methods: args.cast.method,
        reconstructions: distinct(args.cast.reconstruction),
        backend: args.backend.backend,
        frame_intrinsics: Intrinsics { width, height, ..common.intrinsics() },
        codec: codec::Settings::default(),
        measures_wire: args.wire == Switch::On,
    })?;
    common.publish(&report, &quality::table(&report), &report.conditions.subject.failed)
}

fn run_speed(args: SpeedArgs) -> Result<()> {
    let common = args.common;
    if let Some(choice) = args.cast.method.iter().find(|choice| choice.rule == Some(Rule::AllSamples)) {
        bail!("--method {choice}: no codec takes such frames, expected a rule that `layers` knows");
    }
    // First: what is refused opens no device.
    common.check_output()?;
    let subject = common.subject(args.cast.k, args.angles)?;
    args.cast.method.iter().try_for_each(|choice| choice.method.check_mode(subject.mode))?;
    let mut backends = distinct(args.backend);
    if backends.is_empty() {
        backends.push(BackendChoice::Cpu);
        if let Ok(Backend::Gpu(_)) = Backend::open(BackendChoice::Gpu) {
            backends.push(BackendChoice::Gpu);
        }
    }
    let frame_sizes = if args.frame_size.is_empty() { vec![common.size] } else { args.frame_size };
    let report = speed::run(&speed::SpeedOptions {
        subject,
        backends,
        layerings: args.layering,
        methods: args.cast.method,
        reconstructions: distinct(args.cast.reconstruction),
        frame_sizes: distinct(frame_sizes),
        repeats: args.repeats,
        target_fps: distinct(args.target_fps),
    })?;
    common.publish(&report, &speed::table(&report), &report.conditions.subject.failed)
}

fn run_latency(args: LatencyArgs) -> Result<()> {
    let common = args.common;
    common.check_output()?;
    let path = args.path.read()?;
    let mut speeds = distinct(args.speed);
    if path.is_some() && speeds.len() > 1 {
        note("a path is played as it was recorded, at its own speed");
        speeds.truncate(1);
    }
    let (mode, isos) = common.look.mode()?;
    let report = latency::run(&latency::LatencyOptions {
        scenes: common.select()?,
        methods: distinct(args.method),
        degrees_per_second: speeds,
        rtts: distinct(args.rtt),
        out: args.out,
        demo: DemoOptions {
            transfer: common.look.tf.clone(),
            shaded: common.look.is_shaded(),
            mode,
            isos,
            clip: common.look.clip.clip(),
            layering: args.layering.layering,
            k: args.layering.k,
            orbit: common.orbit,
            path,
            foresight: args.foresight.foresight(),
            intrinsics: common.intrinsics(),
            backend: args.backend.backend,
            link: args.link.model(Duration::ZERO)?,
            plan: args.plan.plan(None),
            max_evaluated: args.compared as usize,
            ..DemoOptions::default()
        },
    })?;
    common.publish(&report, &latency::table(&report), &report.conditions.subject.failed)
}

fn run_codec(args: CodecArgs) -> Result<()> {
    let common = args.common;
    common.check_output()?;
    if let Some(plot) = &args.plot {
        if common.output.as_ref() == Some(plot) {
            bail!("--plot and --output: expected two files, found {} twice", plot.display());
        }
        check_writable(plot)?;
    }
    let report = codecs::run(&codecs::CodecOptions {
        subject: common.subject(args.k, args.angles)?,
        codecs: args.codec,
        anchor: args.anchor,
        backend: args.backend.backend,
        list_scales: distinct(args.list_scale),
        turns_deg: distinct(args.seen_at.into_iter().map(|SeenAt(turn_deg)| turn_deg)),
        sequence: args.turn.map(|degrees_per_second| codecs::SequenceOptions {
            degrees_per_second,
            frames: args.frames,
            stops: args.stop,
            compared: args.compared,
        }),
        times: (!args.threads.is_empty())
            .then_some(codecs::TimeOptions { threads: distinct(args.threads), rounds: args.repeats }),
    })?;
    let published = common.publish(&report, &codecs::table(&report), &report.conditions.subject.failed);
    if let Some(path) = &args.plot {
        write_whole(path, codecs::svg(&report)?.as_bytes())?;
    }
    published
}

/// As many as a large machine has.
fn parse_threads(text: &str) -> Result<usize, String> {
    let threads = text.parse::<usize>().ok().filter(|n| (1..=256).contains(n));
    threads.ok_or_else(|| "expected 1 to 256 threads".into())
}

/// A side of a frame in units of the picture's.
fn parse_list_scale(text: &str) -> Result<f32, String> {
    let scale = text.parse::<f32>().ok().filter(|s| (0.05..=1.0).contains(s));
    scale.ok_or_else(|| "expected 0.05 to 1".into())
}

/// A turn that a frame is made for; none: all.
#[derive(Clone, Copy, Debug)]
struct SeenAt(Option<u8>);

fn parse_seen_at(text: &str) -> Result<SeenAt, String> {
    if text == "all" {
        return Ok(SeenAt(None));
    }
    let turn_deg = text.parse::<u8>().ok().filter(|t| *t <= MAX_TURN_DEG);
    turn_deg.map(|t| SeenAt(Some(t))).ok_or_else(|| format!("expected 0 to {MAX_TURN_DEG} degrees, or all"))
}

/// Degrees, finite.
fn parse_angle(text: &str) -> Result<f32, String> {
    let degrees = text.parse::<f32>().ok().filter(|d| d.abs() <= 360.0);
    degrees.ok_or_else(|| "expected degrees, -360 to 360".into())
}

/// A frame rate.
fn parse_target(text: &str) -> Result<f32, String> {
    let rate = text.parse::<f32>().ok().filter(|r| (1.0..=1000.0).contains(r));
    rate.ok_or_else(|| "expected 1 to 1000 pictures a second".into())
}

/// Ours, and the two that the papers call best.
const DEFAULT_RULES: &str = "visibility-merge,equal-transmittance,homogeneity";
/// As a shell tells of a process that Ctrl-C ended.
const INTERRUPTED: i32 = 130;
