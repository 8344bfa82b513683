//! `reproject`: a novel view of a stored layered frame.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use isinglass_bench::progress::note;
use isinglass_core::camera::Camera;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::mode::Mode;
use isinglass_core::orbit::{Orbit, bounds_from_header, orbit_of_frame, sphere_box_from_header};
use isinglass_formats::iglf::{self, Origin, StoredFrame};
use serde_json::json;

use crate::args::{
    BackendArgs, not_an_input, orthographic, parse_background, parse_fov, parse_picture, parse_size,
};
use crate::clip_args::ClipArgs;
use crate::lens_args::LensArgs;
use crate::report::print_json;

#[derive(Args)]
pub(crate) struct ReprojectArgs {
    /// A layered frame that `layers` stored
    #[arg(value_name = "FRAME")]
    frame: PathBuf,
    /// Azimuth and elevation in degrees, see `render`; distance in radii of the volume's bounding sphere [default:
    /// the frame's own camera; without DIST its distance]
    #[arg(long, value_name = "AZ,EL[,DIST]", allow_hyphen_values = true)]
    orbit: Option<Orbit>,
    /// PNG file to write
    #[arg(short, long, value_name = "FILE", value_parser = parse_picture)]
    output: PathBuf,
    /// Columns and rows of the picture [default: the frame's]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[u32; 2]>,
    /// Vertical field of view, degrees [default: the frame's]
    #[arg(long, value_name = "DEG", value_parser = parse_fov)]
    fov: Option<f32>,
    /// Parallel rays, whatever those of the frame: see `render`
    #[arg(long, conflicts_with = "fov")]
    orthographic: bool,
    /// Colour behind the volume
    #[arg(long, value_name = "#RRGGBB", value_parser = parse_background, default_value = "#000000")]
    background: [u8; 3],
    #[command(flatten)]
    backend: BackendArgs,
    /// Print a summary as JSON
    #[arg(long)]
    json: bool,
    // These come last because clap would list later arguments under their headings.
    #[command(flatten)]
    lens: LensArgs,
    #[command(flatten)]
    clip: ClipArgs,
}

pub(crate) fn run(args: &ReprojectArgs) -> Result<()> {
    not_an_input(&args.output, [args.frame.to_str()])?;
    let StoredFrame { frame, origin: Origin { orientation, bounds } } = iglf::read(&args.frame)?;
    let header = frame.header;
    let mut intrinsics = header.camera.intrinsics;
    if let Some([width, height]) = args.size {
        (intrinsics.width, intrinsics.height) = (width, height);
    }
    if let Some(fov) = args.fov {
        intrinsics = intrinsics.with_fov_y(fov.to_radians());
    }
    let camera = match &args.orbit {
        Some(orbit) => orbit_of_frame(&orbit.upright(orientation.as_deref()), intrinsics, &header),
        None => Camera { intrinsics, ..header.camera },
    };
    let camera =
        if args.orthographic { orthographic(&camera, &sphere_box_from_header(&header)) } else { camera };
    let plan = args.lens.plan(&camera, &sphere_box_from_header(&header), orientation.as_deref(), 0.0)?;
    let clip = args.clip.clip();
    let backend = args.backend.open()?;
    let options = CastOptions { clip, ..CastOptions::default() };
    let start = Instant::now();
    if bounds.is_none() && header.mode == Mode::Average {
        note(
            "note: the file does not know the box that its means are over; from elsewhere they are taken over a larger one",
        );
    }
    let bounds = bounds.unwrap_or_else(|| bounds_from_header(&header));
    let mut reprojector = backend.reprojector(Arc::new(frame), &bounds)?;
    let pictures = plan.draw(|views| reprojector.raycast_mean_with(views, &options))?;
    let novel_view_ms = start.elapsed().as_secs_f64() * 1e3;
    let picture = plan.compose(&pictures, args.background);
    picture.write(&args.output)?;
    if args.json {
        print_json(&json!({
            "output": args.output.display().to_string(),
            "size": [picture.width, picture.height],
            "mode": header.mode.name(),
            "lens": plan.json,
            "backend": backend.description(),
            "novel_view_ms": novel_view_ms,
        }))?;
    }
    Ok(())
}
