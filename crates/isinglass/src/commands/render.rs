//! `render`: the reference picture of a volume, or pictures and movies of a camera that moves.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use clap::Args;
use clap::error::ErrorKind;
use isinglass_bench::progress::Progress;
use isinglass_core::camera::{Camera, Pose};
use isinglass_core::orbit::Orbit;
use isinglass_core::space::Aabb;
use isinglass_formats::movie::{MovieForm, MovieWriter, PICTURES_PER_SECOND};
use serde_json::json;

use crate::args::{
    BackendArgs, ListArgs, LookArgs, PathArgs, ViewArgs, VolumeArgs, not_an_input, parse_background,
    parse_picture,
};
use crate::given::Given;
use crate::lens_args::LensArgs;
use crate::light_args::LightArgs;
use crate::report::print_json;
use crate::state_args::StateArgs;

#[derive(Args)]
pub(crate) struct RenderArgs {
    #[command(flatten)]
    state: StateArgs,
    /// Azimuth and elevation in degrees, and distance in radii of the volume's bounding sphere; 0,0 looks from the
    /// front, which is a body's anterior side where the file knows it and +z otherwise
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// PNG file to write. With --turntable or --path a folder, which is made, a name with a # for each digit of a
    /// number, or a movie: .gif plays everywhere, .apng has all colours
    #[arg(short, long, value_name = "FILE", value_parser = parse_pictures)]
    output: PathBuf,
    /// Render N pictures once around the volume, starting at --orbit
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=MAX_PICTURES))]
    turntable: Option<u32>,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    view: ViewArgs,
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
    look: LookArgs,
    #[command(flatten)]
    light: LightArgs,
    #[command(flatten)]
    lens: LensArgs,
    #[command(flatten)]
    volume: VolumeArgs,
}

pub(crate) fn run(args: &RenderArgs, given: Given) -> Result<()> {
    let path = args.path.read()?;
    if args.turntable.is_some() && path.is_some() {
        let text = "found --turntable and --path, expected one of them";
        return Err(clap::Error::raw(ErrorKind::ArgumentConflict, text).into());
    }
    let is_series = args.turntable.is_some() || path.is_some();
    let movie = MovieForm::of(&args.output).filter(|_| is_series);
    if !is_series && !args.output.is_dir() {
        let parsed = parse_picture(&args.output.to_string_lossy());
        parsed.map_err(|text| clap::Error::raw(ErrorKind::ValueValidation, text))?;
    }
    if !is_series && args.output.is_dir() {
        let text = format!("{}: found a folder, expected the name of a file", args.output.display());
        return Err(clap::Error::raw(ErrorKind::ValueValidation, text).into());
    }
    let seen = args.state.read(given)?;
    if !is_series || movie.is_some() {
        not_an_input(&args.output, seen.inputs(&args.volume, &args.state, &args.look))?;
    }
    seen.note_what_is_not_drawn(args.lens.has_two_eyes());
    let lighting = args.light.lighting();
    let (opened, _) = seen.open(&args.volume, &args.look, lighting, &ListArgs::default())?;
    let bounds = opened.scene.volume.bounds();
    let mode = opened.scene.settings.mode;
    let letters = opened.scene.volume.info.orientation.clone();
    let orbit = args.orbit.upright(letters.as_deref());
    let num_pictures = match &path {
        Some(path) => (path.duration().as_secs_f32() * PICTURES_PER_SECOND as f32) as u32 + 1,
        None => args.turntable.unwrap_or(1),
    };
    if num_pictures > MAX_PICTURES as u32 {
        let most = MAX_PICTURES as u32 / PICTURES_PER_SECOND;
        anyhow::bail!("the path has {num_pictures} pictures, expected one of at most {most} s");
    }
    let names = Names::of(&args.output, is_series);
    if let (None, Names::Folder(folder)) = (movie, &names) {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }
    let (mut renderer, backend) = args.backend.renderer(opened.scene)?;
    let mut progress = is_series.then(|| Progress::new("pictures", num_pictures.into()));
    let mut writer = None;
    let start = Instant::now();
    let mut told = None;
    for number in 0..num_pictures {
        let degrees = if path.is_some() { 0.0 } else { 360.0 * number as f32 / num_pictures as f32 };
        let mut camera = seen.camera(&orbit, degrees, &args.view, &bounds);
        let at = Duration::from_secs_f32(number as f32 / PICTURES_PER_SECOND as f32);
        if let Some(pose) = path.as_ref().and_then(|path| path.pose_at(at, &camera.intrinsics, &bounds)) {
            camera = moved(&camera, pose, &bounds);
        }
        let plan = args.lens.plan(&camera, &bounds, letters.as_deref(), degrees)?;
        let pictures = plan.draw(|views| renderer.render_mean(views))?;
        let render_ms = start.elapsed().as_secs_f64() * 1e3;
        let picture = plan.compose(&pictures, seen.background(args.background));
        match movie {
            Some(form) => {
                let size = [picture.width, picture.height];
                let begun = match writer.take() {
                    Some(begun) => Ok(begun),
                    None => MovieWriter::create(&args.output, form, size, num_pictures),
                };
                let mut begun = begun?;
                begun.add(&picture)?;
                writer = Some(begun);
            }
            None => picture.write(&names.file(number))?,
        }
        if let Some(progress) = &mut progress {
            progress.advance(1, "");
        }
        told = Some(([picture.width, picture.height], plan.json, render_ms));
    }
    if let Some(writer) = writer {
        writer.finish(true)?;
    }
    if let Some(progress) = progress {
        progress.finish();
    }
    if let (true, Some((size, lens, render_ms))) = (args.json, told) {
        print_json(&json!({
            "output": args.output.display().to_string(),
            "size": size,
            "pictures": num_pictures,
            "lens": lens,
            "backend": backend.description(),
            "tf": opened.transfer.name,
            "mode": mode.name(),
            "render_ms": render_ms,
        }))?;
    }
    Ok(())
}

/// Names of the pictures.
enum Names {
    One(PathBuf),
    /// Numbered files in a folder.
    Folder(PathBuf),
    /// A number with so many digits between two parts of the name.
    Pattern(PathBuf, String, usize, String),
}

impl Names {
    fn of(output: &Path, is_series: bool) -> Self {
        if !is_series {
            return Self::One(output.to_owned());
        }
        let name = output.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let Some(first) = name.find('#') else { return Self::Folder(output.to_owned()) };
        let (before, rest) = name.split_at(first);
        let after = rest.trim_start_matches('#');
        let folder = output.parent().map(PathBuf::from).unwrap_or_default();
        Self::Pattern(folder, before.to_owned(), rest.len() - after.len(), after.to_owned())
    }

    fn file(&self, number: u32) -> PathBuf {
        match self {
            Self::One(file) => file.clone(),
            Self::Folder(folder) => folder.join(format!("{number:04}.png")),
            Self::Pattern(folder, before, figures, after) => {
                folder.join(format!("{before}{number:0figures$}{after}"))
            }
        }
    }
}

/// The same camera elsewhere.
fn moved(camera: &Camera, pose: Pose, bounds: &Aabb) -> Camera {
    // Parallel rays begin at the eye, so the whole volume must be in front of it.
    let is_parallel = camera.intrinsics.projection.is_orthographic();
    let pose = if is_parallel { pose.before(bounds) } else { pose };
    Camera::new(pose, camera.intrinsics, bounds)
}

/// A file to write, or an existing folder.
fn parse_pictures(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    if path.is_dir() || MovieForm::of(&path).is_some() { Ok(path) } else { parse_picture(text) }
}

/// A minute at 60 pictures a second.
const MAX_PICTURES: i64 = 3600;
