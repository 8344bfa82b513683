//! `layers`: stores a layered frame of a volume.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Result, bail};
use clap::Args;
use isinglass_core::codec::{Coding, EncodedFrame, blocks};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::Mode;
use isinglass_core::orbit::Orbit;
use isinglass_formats::iglf::{self, Origin};
use serde_json::json;

use crate::args::{
    BackendArgs, CodecArgs, CodecChoice, ListArgs, LookArgs, ViewArgs, VolumeArgs, not_an_input,
    parse_output, usage_error,
};
use crate::distributed::{DistributedArgs, Drawer, Together, open_for};
use crate::given::Given;
use crate::light_args::LightArgs;
use crate::memory::MemoryArgs;
use crate::report::print_json;
use crate::state_args::StateArgs;

#[derive(Args)]
pub(crate) struct LayersArgs {
    #[command(flatten)]
    state: StateArgs,
    /// Azimuth and elevation in degrees, and distance in radii of the volume's bounding sphere; 0,0 looks from the
    /// front, which is a body's anterior side where the file knows it and +z otherwise
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// File to write, such as a.iglf
    #[arg(short, long, value_name = "FILE", value_parser = parse_output)]
    output: PathBuf,
    #[command(flatten)]
    view: ViewArgs,
    #[command(flatten)]
    lists: ListArgs,
    #[command(flatten)]
    codec: CodecArgs,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    memory: MemoryArgs,
    #[command(flatten)]
    distributed: DistributedArgs,
    /// Print a summary as JSON
    #[arg(long)]
    json: bool,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    light: LightArgs,
    #[command(flatten)]
    volume: VolumeArgs,
}

pub(crate) fn run(args: &LayersArgs, given: Given) -> Result<()> {
    match args.distributed.join()? {
        Some(together) => together.conclude(make(args, given, Some(&together))),
        None => make(args, given, None),
    }
}

fn make(args: &LayersArgs, given: Given, together: Option<&Together>) -> Result<()> {
    if args.output.exists() && !args.output.is_file() {
        bail!("{}: found a device or pipe, expected a regular file", args.output.display());
    }
    args.codec.check()?;
    let seen = args.state.read(given)?;
    not_an_input(&args.output, seen.inputs(&args.volume, &args.state, &args.look))?;
    let lighting = args.light.lighting();
    let (opened, look) =
        open_for(together, &seen, (&args.volume, &args.memory), &args.look, lighting, &args.lists)?;
    let orientation = opened.scene.volume.info.orientation.clone();
    let orbit = args.orbit.upright(orientation.as_deref());
    let camera = seen.camera(&orbit, 0.0, &args.view, &opened.scene.volume.bounds());
    if args.codec.codec == CodecChoice::Blocks && look.mode.is_projection() {
        let found = format!("--codec blocks: found --mode {}, expected --codec exact with it", look.mode);
        return Err(usage_error(found));
    }
    // A mean behind an oblique plane needs a path length that no box gives.
    let is_askew = look.mode == Mode::Average && look.clip.plane.is_some();
    let left = (!is_askew).then(|| opened.scene.region().bounds);
    let transfer = opened.transfer.clone();
    let mut drawer = Drawer::new(opened, together, &args.backend)?;
    let fineness = drawer.show(&camera)?;
    let start = Instant::now();
    let header = FrameHeader { fineness, ..FrameHeader::alone(camera, look.k) };
    let Some((frame, ranks)) = drawer.generate(header)? else { return Ok(()) };
    let generate_ms = start.elapsed().as_secs_f64() * 1e3;
    let start = Instant::now();
    let (encoded, coding) = encode(&args.codec, &frame)?;
    let encode_ms = start.elapsed().as_secs_f64() * 1e3;
    iglf::write(&args.output, &encoded, &Origin { orientation, bounds: left })?;
    if args.json {
        let mut told = json!({
            "output": args.output.display().to_string(),
            "size": [camera.intrinsics.width, camera.intrinsics.height],
            "backend": drawer.description(),
            "tf": transfer,
            "mode": frame.header.mode.name(),
            "k": look.k,
            "segments": frame.num_segments(),
            "bytes": encoded.num_bytes(),
            "codec": match coding {
                Coding::Exact => "exact",
                Coding::Blocks(_) => "blocks",
            },
            "quality": match coding {
                Coding::Exact => None,
                Coding::Blocks(settings) => Some(settings.quality),
            },
            "generate_ms": generate_ms,
            "encode_ms": encode_ms,
        });
        if !ranks.is_empty() {
            told["ranks"] = json!(ranks);
        }
        print_json(&told)?;
    }
    Ok(())
}

/// The encoded frame, and the coding that was chosen.
fn encode(args: &CodecArgs, frame: &LayeredFrame) -> Result<(EncodedFrame, Coding)> {
    let turn_deg = args.turn.map(|t| t.round() as u8);
    let in_blocks = |quality| blocks::Settings { turn_deg, ..blocks::Settings::of(quality) };
    let coding = match (args.codec, args.bytes) {
        (CodecChoice::Exact, _) => Coding::Exact,
        (CodecChoice::Blocks, None) => Coding::Blocks(in_blocks(args.quality.unwrap_or(QUALITY))),
        (CodecChoice::Blocks, Some(bytes)) => {
            let (encoded, _, quality) = blocks::encode_within(frame, bytes, &in_blocks(0), None)?;
            return Ok((encoded, Coding::Blocks(in_blocks(quality))));
        }
    };
    Ok((coding.encode(frame, None)?.0, coding))
}

/// The default quality of frames in blocks.
const QUALITY: u8 = 60;
