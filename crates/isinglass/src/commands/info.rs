//! `info`: the contents of a volume or a stored layered frame.

use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::Path;

use anyhow::Result;
use clap::Args;
use isinglass_core::codec::blocks::References;
use isinglass_core::codec::{self, TileClass};
use isinglass_core::volume::Histogram;
use isinglass_formats::VolumeFacts;
use isinglass_formats::iglf::{self, Origin, StoredFrame};
use serde_json::{Map, json};

use crate::args::VolumeArgs;
use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct InfoArgs {
    /// As JSON
    #[arg(long)]
    json: bool,
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
    let (volume, outline) = args.volume.open()?;
    let mut facts = VolumeFacts::of(&volume, &Histogram::of(&volume));
    facts.file = (!source.starts_with("builtin:")).then_some(outline);
    if args.json { print_json(&facts) } else { print(&facts.to_string()) }
}

fn is_stored_frame(path: &Path) -> bool {
    let mut start = [0; 4];
    path.is_file() && File::open(path).and_then(|mut f| f.read_exact(&mut start)).is_ok() && start == *b"IGLF"
}

fn frame(path: &Path, is_json: bool) -> Result<()> {
    let StoredFrame { frame, origin: Origin { orientation, .. } } = iglf::read(path)?;
    let spent = FrameSpent::of(&iglf::read_chunks(path)?)?;
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
            "bytes": spent.bytes(|_| true),
            "bytes_per_segment": per(spent.bytes(|_| true), segments),
            "bytes_by_plane": spent.parts().map(|p| (p.to_owned(), spent.of_part(p, |_| true).into())).collect::<Map<_, _>>(),
            "tiles": spent.tiles().into_iter().map(|t| json!({ "class": t.name, "tiles": t.num, "bytes": t.bytes })).collect::<Vec<_>>(),
            "chunks": spent.0.iter().map(|chunk| json!({
                "group": chunk.group,
                "band": chunk.band,
                "rows": [chunk.rows.start, chunk.rows.end],
                "bytes": chunk.bytes(),
                "segments": chunk.segments,
            })).collect::<Vec<_>>(),
        }));
    }
    print(&format!(
        "{}\n  size         {} × {}, field of view {fov_deg:.1}°\n  eye          {} {} {}\n  depth        {} to {}\n  \
         mode         {}\n  \
         segments     {segments} in {num_filled} of {num_lists} lists, at most {} a list\n{}",
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
        spent.table(segments),
    ))
}

/// How the chunks of a frame spend their bytes.
struct FrameSpent(Vec<ChunkSpent>);

struct ChunkSpent {
    /// 0 for the base, 1 for a refinement.
    group: usize,
    band: u8,
    rows: Range<u32>,
    segments: usize,
    spent: codec::Spent,
}

impl ChunkSpent {
    fn bytes(&self) -> usize {
        self.spent.parts.iter().map(|(_, bytes)| bytes).sum()
    }
}

impl FrameSpent {
    fn of(chunks: &[Vec<u8>]) -> Result<Self> {
        let mut spent = Vec::with_capacity(chunks.len());
        for bytes in chunks {
            let references = References::default();
            let chunk = codec::decode_chunk(bytes, &references)?;
            spent.push(ChunkSpent {
                group: usize::from(!chunk.header().is_base()),
                band: chunk.header().band,
                rows: chunk.rows(),
                segments: chunk.num_segments(),
                spent: codec::spent(bytes, &references)?,
            });
        }
        Ok(Self(spent))
    }

    /// Headers and planes in order; a chunk without segments uses the names of another.
    fn parts(&self) -> impl Iterator<Item = &'static str> {
        let longest = self.0.iter().max_by_key(|chunk| chunk.spent.parts.len());
        longest.into_iter().flat_map(|chunk| chunk.spent.parts.iter().map(|(name, _)| *name))
    }

    /// Tiles of all chunks by class, without absent classes.
    fn tiles(&self) -> Vec<TileClass> {
        let mut all: Vec<TileClass> = Vec::new();
        for class in
            self.0.iter().flat_map(|chunk| &chunk.spent.tiles).filter(|class| class.num + class.bytes > 0)
        {
            match all.iter_mut().find(|c| c.name == class.name) {
                Some(c) => (c.num, c.bytes) = (c.num + class.num, c.bytes + class.bytes),
                None => all.push(*class),
            }
        }
        all
    }

    fn bytes(&self, of: impl Fn(&ChunkSpent) -> bool) -> usize {
        self.0.iter().filter(|chunk| of(chunk)).map(ChunkSpent::bytes).sum()
    }

    fn of_part(&self, part: &str, of: impl Fn(&ChunkSpent) -> bool) -> usize {
        let parts = self.0.iter().filter(|chunk| of(chunk)).flat_map(|chunk| &chunk.spent.parts);
        parts.filter(|(name, _)| *name == part).map(|(_, bytes)| bytes).sum()
    }

    /// Bytes of planes and bands, by group and in total, and per segment; then the tiles.
    fn table(&self, segments: usize) -> String {
        let total = self.bytes(|_| true);
        let mut text = format!("  bytes        {total} in {} chunks\n\n", self.0.len());
        text +=
            &format!("  {:14} {:>10} {:>10} {:>10} {:>8}\n", "", "base", "refinement", "both", "/segment");
        let mut row = |name: &str, groups: [usize; 2], segments: usize| {
            let both = groups[0] + groups[1];
            let [base, refinement] = groups;
            text += &format!("  {name:14} {base:10} {refinement:10} {both:10} {:8.3}\n", per(both, segments));
        };
        for part in self.parts() {
            row(part, [0, 1].map(|g| self.of_part(part, |c| c.group == g)), segments);
        }
        for chunk in (0..=u8::MAX).filter_map(|band| self.0.iter().find(|c| c.band == band)) {
            let in_band = |c: &ChunkSpent| c.band == chunk.band;
            let name = format!("rows {}–{}", chunk.rows.start, chunk.rows.end - 1);
            let own = self.0.iter().filter(|c| in_band(c)).map(|c| c.segments).sum();
            row(&name, [0, 1].map(|g| self.bytes(|c| c.group == g && in_band(c))), own);
        }
        row("all", [0, 1].map(|g| self.bytes(|c| c.group == g)), segments);
        let side = self.0.first().map_or(0, |chunk| chunk.spent.tile_side);
        text += &format!(
            "\n  {:21} {:>8} {:>10} {:>8}\n",
            format!("tiles of {side}×{side} lists"),
            "",
            "bytes",
            "/tile"
        );
        for TileClass { name, num, bytes } in self.tiles() {
            text += &format!("  {name:21} {num:>8} {bytes:>10} {:8.2}\n", per(bytes, num));
        }
        text
    }
}

fn per(bytes: usize, segments: usize) -> f64 {
    bytes as f64 / segments.max(1) as f64
}
