//! `isinglass-lab`: tables that compare the product with what the papers did.

mod args;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Result, bail};
use clap::{Args, Parser, Subcommand};
use isinglass_bench::demo::{DemoOptions, Host};
use isinglass_bench::progress::note;
use isinglass_bench::scenes::distinct;
use isinglass_client::{ViewerOptions, WindowOptions};
use isinglass_core::camera::Intrinsics;
use isinglass_core::codec::blocks::MAX_TURN_DEG;
use isinglass_core::kernels::raycast::Reconstruction;
use isinglass_core::layer::FrameHeader;
use isinglass_core::look::DEFAULT_K;
use isinglass_formats::png::Rgb8;
use isinglass_formats::{check_writable, write_whole};
use isinglass_lab::choices::{MethodChoice, parse_reconstruction};
use isinglass_lab::latency::LatencyMethod;
use isinglass_lab::rules::Rule;
use isinglass_lab::{codec as codecs, quality};
use isinglass_net::LinkModel;
use isinglass_render::{Backend, BackendChoice};
use isinglass_server::Timing;

use args::{CommonArgs, Switch, parse_angle, parse_k, parse_list_scale, parse_ms, parse_size, parse_speed};

/// Compares layered frames with what the papers did.
#[derive(Parser)]
#[command(name = "isinglass-lab", version, arg_required_else_help = true, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// How near novel views come to full renderings
    Quality(QualityArgs),
    /// What codecs make of layered frames: bytes, times, and what is left of the picture
    Codec(CodecArgs),
    /// What is shown under latency, by each method
    Latency(LatencyArgs),
    /// One picture of a frame by a rule and a method, seen from aside
    Picture(PictureArgs),
    /// The viewer, showing a frame by a rule and a method
    View(ViewArgs),
}

#[derive(Args)]
struct QualityArgs {
    /// Rules, between commas
    #[arg(long, value_name = "RULE", value_delimiter = ',', default_value = DEFAULT_RULES)]
    layering: Vec<Rule>,
    /// How frames become pictures: layers, point-warp, slabs-planar, slabs-mesh or last-image, between commas. With
    /// @RULE on frames of that rule only, as point-warp@single-depth and slabs-mesh@slabs
    #[arg(long, value_name = "METHOD[@RULE]", value_delimiter = ',', default_values_t = [MethodChoice::default()])]
    method: Vec<MethodChoice>,
    /// How the ray cast reads lists, between commas: mixed takes the two lists that a ray runs between, nearest (as the
    /// papers have it) one
    #[arg(long, value_name = "LISTS", value_parser = parse_reconstruction, value_delimiter = ',', default_value = "mixed")]
    reconstruction: Vec<Reconstruction>,
    /// Most segments a pixel, or for ours their mean, between commas
    #[arg(long, value_name = "K", value_parser = parse_k, value_delimiter = ',', default_values_t = [DEFAULT_K])]
    k: Vec<u8>,
    /// Turns of azimuth to either side, degrees, between commas; 0 is the generating camera
    #[arg(long, value_name = "DEG", value_parser = parse_angle, value_delimiter = ',', default_value = "0,5,10,30", allow_hyphen_values = true)]
    angles: Vec<f32>,
    /// Columns and rows of lists [default: those of the pictures]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    frame_size: Option<[u32; 2]>,
    /// Whether frames are also measured as they are after encoding and decoding
    #[arg(long, value_enum, default_value_t = Switch::On)]
    wire: Switch,
    /// Where our kernels run: auto, gpu or cpu
    #[arg(long, value_name = "BACKEND", default_value_t = BackendChoice::default())]
    backend: BackendChoice,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Args)]
struct CodecArgs {
    /// Codecs, between commas: blocks, exact, raw-zstd, png-published, blocks-planes, and in a build with --features
    /// rivals raw-lz4, jpeg2000-published, jpeg2000-planes, htj2k-published, htj2k-planes, avif-planes,
    /// webp-published; there also jpegxl-planes, jpegxl-modular-planes and avif-aom-planes, where cjxl and djxl, or
    /// avifenc and avifdec are installed [default: all]
    #[arg(long, value_name = "CODEC", value_delimiter = ',')]
    codec: Vec<String>,
    /// The codec that others are compared with by BD-rate [default: jpeg2000-published in a build
    /// with --features rivals, or else blocks-planes]
    #[arg(long, value_name = "CODEC")]
    anchor: Option<String>,
    /// Most segments a pixel, or for ours their mean, between commas
    #[arg(long, value_name = "K", value_parser = parse_k, value_delimiter = ',', default_values_t = [DEFAULT_K])]
    k: Vec<u8>,
    /// Turns of azimuth, degrees, between commas; 0 is the generating camera
    #[arg(long, value_name = "DEG", value_parser = parse_angle, value_delimiter = ',', default_value = "0,5,10", allow_hyphen_values = true)]
    angles: Vec<f32>,
    /// Sides of frames in units of the pictures', between commas: every codec but those as published has the choice,
    /// and those want 1 among them
    #[arg(long, value_name = "SHARE", value_parser = parse_list_scale, value_delimiter = ',', default_value = "1")]
    list_scale: Vec<f32>,
    /// Turns that frames in blocks are made to be seen at, 0 to 10 degrees, or "all", between commas: blocks have the
    /// choice
    #[arg(long, value_name = "DEG", value_parser = parse_seen_at, value_delimiter = ',', default_value = "all")]
    seen_at: Vec<SeenAt>,
    /// Also draw the curves as SVG, whole or not at all
    #[arg(long, value_name = "FILE")]
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
    /// Where our kernels run: auto, gpu or cpu
    #[arg(long, value_name = "BACKEND", default_value_t = BackendChoice::default())]
    backend: BackendChoice,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Args)]
struct LatencyArgs {
    /// How frames become pictures, between commas: as in `quality`, and with :no-prediction at the end without
    /// prediction, as point-warp@single-depth:no-prediction
    #[arg(long, value_name = "METHOD", value_delimiter = ',', default_values_t = [LatencyMethod::default()])]
    method: Vec<LatencyMethod>,
    /// Round-trip times, ms, between commas
    #[arg(long, value_name = "TIME", value_parser = parse_ms, value_delimiter = ',', default_value = "0,100,300")]
    rtt: Vec<f32>,
    /// Speeds of the camera, degrees a second, between commas
    #[arg(long, value_name = "DEG", default_value = "30", value_parser = parse_speed, value_delimiter = ',')]
    speed: Vec<f32>,
    /// Pictures of each run that are compared with the truth, at most
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    compared: u32,
    /// Segments a pixel
    #[arg(long, value_name = "K", value_parser = parse_k, default_value_t = DEFAULT_K)]
    k: u8,
    /// Rate of the link each way, Mbit/s [default: unlimited]
    #[arg(long, value_name = "MBIT")]
    bandwidth: Option<f64>,
    /// Share of packets lost, each way
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    loss: f64,
    /// Keep the pictures and reports of each run in a folder of its own in DIR
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Where our kernels run: auto, gpu or cpu
    #[arg(long, value_name = "BACKEND", default_value_t = BackendChoice::default())]
    backend: BackendChoice,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Args)]
struct PictureArgs {
    /// How the frame becomes a picture, and the rule of the frame: METHOD or METHOD@RULE
    #[arg(long, value_name = "METHOD[@RULE]", default_value_t = MethodChoice::default())]
    method: MethodChoice,
    /// Segments a pixel
    #[arg(long, value_name = "K", value_parser = parse_k, default_value_t = DEFAULT_K)]
    k: u8,
    /// Turn of azimuth from the frame's camera, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_angle, default_value_t = 10.0, allow_hyphen_values = true)]
    angle: f32,
    /// The PNG file
    #[arg(long, value_name = "FILE", default_value = "picture.png")]
    png: PathBuf,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Args)]
struct ViewArgs {
    /// How frames become pictures, and the rule of the server's frames: METHOD or METHOD@RULE
    #[arg(long, value_name = "METHOD[@RULE]", default_value_t = MethodChoice::default())]
    method: MethodChoice,
    /// Segments a pixel
    #[arg(long, value_name = "K", value_parser = parse_k, default_value_t = DEFAULT_K)]
    k: u8,
    /// Round-trip time of the link, ms
    #[arg(long, value_name = "TIME", value_parser = parse_ms, default_value = "200")]
    rtt: f32,
    #[command(flatten)]
    common: CommonArgs,
}

fn main() -> ExitCode {
    match run(Cli::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            note(&format!("isinglass-lab: {e:#}"));
            ExitCode::FAILURE
        }
    }
}

fn run(command: Command) -> Result<()> {
    match command {
        Command::Quality(args) => run_quality(args),
        Command::Codec(args) => run_codec(args),
        Command::Latency(args) => run_latency(args),
        Command::Picture(args) => run_picture(args),
        Command::View(args) => run_view(args),
    }
}

fn run_quality(args: QualityArgs) -> Result<()> {
    let common = args.common;
    common.check_output()?;
    let [width, height] = args.frame_size.unwrap_or(common.size);
    let report = quality::run(&quality::QualityOptions {
        subject: common.subject(args.k, args.angles)?,
        rules: args.layering,
        methods: args.method,
        reconstructions: distinct(args.reconstruction),
        backend: args.backend,
        frame_intrinsics: Intrinsics { width, height, ..common.intrinsics() },
        measures_wire: args.wire == Switch::On,
    })?;
    common.publish(&report, &quality::table(&report), &report.conditions.subject.failed)
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
        backend: args.backend,
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

fn run_latency(args: LatencyArgs) -> Result<()> {
    use isinglass_bench::latency;
    let common = args.common;
    common.check_output()?;
    args.method.iter().try_for_each(|m| m.choice.method.check_mode(common.mode))?;
    let link = LinkModel { bandwidth_mbit: args.bandwidth, loss: args.loss, ..LinkModel::default() };
    let report = latency::run(&latency::LatencyOptions {
        scenes: common.select()?,
        contenders: distinct(args.method).into_iter().map(LatencyMethod::contender).collect(),
        degrees_per_second: distinct(args.speed),
        rtts: distinct(args.rtt).into_iter().map(duration).collect(),
        out: args.out,
        demo: DemoOptions {
            backend: args.backend,
            link,
            max_evaluated: args.compared as usize,
            ..demo(&common, args.k)
        },
    })?;
    common.publish(&report, &latency::table(&report), &report.conditions.subject.failed)
}

fn run_picture(args: PictureArgs) -> Result<()> {
    let common = args.common;
    args.method.method.check_mode(common.mode)?;
    check_writable(&args.png)?;
    let subject = common.subject(vec![args.k], vec![args.angle])?;
    let [scene] = &subject.scenes[..] else { bail!("expected one scene, found {}", subject.scenes.len()) };
    let opened = subject.open(scene)?;
    let bounds = opened.scene.volume.bounds();
    let orbit = subject.orbit(&opened.scene.volume);
    let backend = Backend::open(BackendChoice::default())?;
    let mut renderer = backend.renderer(opened.scene)?;
    let header = FrameHeader::alone(orbit.camera(subject.intrinsics, &bounds), args.k);
    let frame = args.method.rule.unwrap_or_default().generate(&mut renderer, header)?;
    let camera = orbit.turned(args.angle).camera(subject.intrinsics, &bounds);
    let picture = args.method.method.draw(&backend, &frame, &bounds, &camera)?;
    Ok(Rgb8::of(&picture, [0; 3]).write(&args.png)?)
}

fn run_view(args: ViewArgs) -> Result<()> {
    let common = args.common;
    args.method.method.check_mode(common.mode)?;
    if args.method.rule == Some(Rule::AllSamples) {
        bail!("no server sends {}, expected a rule for frames", Rule::AllSamples);
    }
    let scenes = common.select()?;
    let [scene] = &scenes[..] else { bail!("expected one scene, found {}", scenes.len()) };
    let (opened, options) =
        DemoOptions { source: scene.volume.source.clone(), ..demo(&common, args.k) }.open()?;
    let backend = match args.method.rule.and_then(Rule::frame_maker) {
        Some(maker) => Backend::Rule(maker),
        None => Backend::open(BackendChoice::default())?,
    };
    let host = Host::start(&options, &opened, &backend, Timing::default())?;
    let method = args.method.method;
    let shown = isinglass_client::run(ViewerOptions {
        link: host.link.clone(),
        conditioner: Some(LinkModel { rtt: duration(args.rtt), ..LinkModel::default() }),
        window: WindowOptions {
            server_name: "this computer".into(),
            fov_y: common.fov.to_radians(),
            novel_views: method.for_viewer().into_iter().collect(),
            novel_view: method.name(),
            ..WindowOptions::default()
        },
    });
    host.close();
    Ok(shown?)
}

fn demo(common: &CommonArgs, k: u8) -> DemoOptions {
    DemoOptions {
        transfer: common.tf.clone(),
        shaded: common.shading == Switch::On,
        mode: common.mode,
        k,
        orbit: common.orbit,
        intrinsics: common.intrinsics(),
        ..DemoOptions::default()
    }
}

fn duration(ms: f32) -> Duration {
    Duration::from_secs_f32(ms * 1e-3)
}

/// As many as a large machine has.
fn parse_threads(text: &str) -> Result<usize, String> {
    let threads = text.parse::<usize>().ok().filter(|n| (1..=256).contains(n));
    threads.ok_or_else(|| "expected 1 to 256 threads".into())
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

/// Ours, and the two that the papers call best.
const DEFAULT_RULES: &str = "visibility-merge,equal-transmittance,homogeneity";
