//! `info`: what is in a volume or in a stored layered frame.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use anyhow::Result;
use clap::Args;
use isinglass_bench::progress::Progress;
use isinglass_core::volume::Histogram;
use isinglass_formats::{OpenOptions, VolumeFacts, iglf, open};
use serde_json::json;

use crate::args::VolumeArgs;
use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct InfoArgs {
    #[command(flatten)]
    volume: VolumeArgs,
    /// As JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &InfoArgs) -> Result<()> {
    let path = Path::new(&args.volume.volume);
    if args.volume.raw.shape().is_none() && is_stored_frame(path) {
        return frame(path, args.json);
    }
    let progress = Progress::new("reading", 1);
    let options = OpenOptions { raw: args.volume.raw.shape(), ..Default::default() };
    let volume = open(&args.volume.volume, &options);
    progress.finish();
    let volume = volume?;
    let facts = VolumeFacts::of(&volume, &Histogram::of(&volume));
    if args.json { print_json(&facts) } else { print(&facts.to_string()) }
}

fn is_stored_frame(path: &Path) -> bool {
    let mut start = [0; 4];
    path.is_file() && File::open(path).and_then(|mut f| f.read_exact(&mut start)).is_ok() && start == *b"IGLF"
}

fn frame(path: &Path, is_json: bool) -> Result<()> {
    let frame = iglf::read(path)?;
    let header = frame.header;
    let camera = header.camera;
    let size = [camera.intrinsics.width, camera.intrinsics.height];
    let fov_deg = camera.intrinsics.fov_y.to_degrees();
    let num_lists = camera.intrinsics.num_pixels();
    let num_filled = frame.offsets.windows(2).filter(|w| w[1] > w[0]).count();
    let (segments, eye) = (frame.num_segments(), camera.pose.eye.to_array());
    if is_json {
        return print_json(&json!({
            "size": size,
            "fov_deg": fov_deg,
            "eye": eye,
            "near": camera.near,
            "far": camera.far,
            "k": header.k,
            "lists": num_lists,
            "lists_filled": num_filled,
            "segments": segments,
            "segments_mean": segments as f64 / num_filled.max(1) as f64,
        }));
    }
    print(&format!(
        "{}\n  size         {} × {}, field of view {fov_deg:.1}°\n  eye          {} {} {}\n  depth        {} to {}\n  \
         segments     {segments} in {num_filled} of {num_lists} lists, at most {} a list\n",
        path.display(),
        size[0],
        size[1],
        eye[0],
        eye[1],
        eye[2],
        camera.near,
        camera.far,
        header.k
    ))
}
