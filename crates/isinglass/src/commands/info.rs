//! `info`: the contents of a volume or a stored layered frame.

use std::io::Read;
use std::path::Path;

use anyhow::Result;
use clap::Args;
use isinglass_core::volume::Histogram;
use isinglass_formats::iglf::{self, Origin, StoredFrame};
use isinglass_formats::{VolumeFacts, open_file};
use serde_json::json;

use crate::args::VolumeArgs;
use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct InfoArgs {
    /// As JSON
    #[arg(long)]
    json: bool,
    /// Read all voxels for the values, however long that takes [default: those of the index, of the coarsest level, or
    /// of a sample of a large file]
    #[arg(long)]
    values: bool,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    volume: VolumeArgs,
}

pub(crate) fn run(args: &InfoArgs) -> Result<()> {
    let source = args.volume.source()?;
    let path = Path::new(source);
    if args.volume.raw.shape().is_none() && is_stored_frame(path) {
        return frame(path, args.json);
    }
    let at_once = if args.values { None } else { args.volume.facts_at_once()? };
    let mut facts = match at_once {
        Some(facts) => facts,
        None => {
            let (volume, outline) = args.volume.open()?;
            let mut facts = VolumeFacts::of(&volume, &Histogram::of(&volume));
            facts.file = (!source.starts_with("builtin:")).then_some(outline);
            facts
        }
    };
    if let Some(outline) = &mut facts.file {
        outline.pages = args.volume.page_count()?;
    }
    if args.json { print_json(&facts) } else { print(&facts.to_string()) }
}

fn is_stored_frame(path: &Path) -> bool {
    let mut start = [0; 4];
    open_file(path).is_ok_and(|mut f| f.read_exact(&mut start).is_ok()) && start == *b"IGLF"
}

fn frame(path: &Path, is_json: bool) -> Result<()> {
    let StoredFrame { frame, origin: Origin { orientation, .. } } = iglf::read(path)?;
    let chunks: Vec<usize> = iglf::read_chunks(path)?.iter().map(Vec::len).collect();
    let bytes: usize = chunks.iter().sum();
    let header = frame.header;
    let camera = header.camera;
    let size = [camera.intrinsics.width, camera.intrinsics.height];
    let fov_deg = camera.intrinsics.fov_y().to_degrees();
    let num_lists = camera.intrinsics.num_pixels();
    let num_filled = frame.num_filled();
    let (segments, eye) = (frame.num_segments(), camera.pose.eye.to_array());
    if is_json {
        return print_json(&json!({
            "size": size,
            "fov_deg": fov_deg,
            "orientation": orientation,
            "eye": eye,
            "near": camera.near,
            "far": camera.far,
            "k": header.k,
            "mode": header.mode.name(),
            "lists": num_lists,
            "lists_filled": num_filled,
            "segments": segments,
            "segments_mean": frame.segments_mean(),
            "bytes": bytes,
            "bytes_per_segment": per(bytes, segments),
            "bytes_of_chunks": chunks,
        }));
    }
    print(&format!(
        "{}\n  size         {} × {}, field of view {fov_deg:.1}°\n  eye          {} {} {}\n  depth        {} to {}\n  \
         mode         {}\n  \
         segments     {segments} in {num_filled} of {num_lists} lists, at most {} a list\n  bytes        {bytes} in {} chunks, {:.3} a segment\n",
        path.display(),
        size[0],
        size[1],
        eye[0],
        eye[1],
        eye[2],
        camera.near,
        camera.far,
        header.mode,
        header.k,
        chunks.len(),
        per(bytes, segments),
    ))
}

fn per(bytes: usize, segments: usize) -> f64 {
    bytes as f64 / segments.max(1) as f64
}
