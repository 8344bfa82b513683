//! `render`: the reference picture of a volume, or pictures and movies of a camera that moves.

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use clap::Args;
use clap::error::ErrorKind;
use isinglass_bench::progress::Progress;
use isinglass_client::CameraPath;
use isinglass_core::camera::{Camera, Pose};
use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::orbit::Orbit;
use isinglass_core::space::Aabb;
use isinglass_formats::movie::{INTERVAL, MovieForm, MovieWriter, PICTURES_PER_SECOND, interval_of_times};
use serde_json::json;

use crate::args::{
    BackendArgs, ListArgs, LookArgs, PathArgs, ViewArgs, VolumeArgs, not_an_input, parse_background,
    parse_picture,
};
use crate::distributed::{DistributedArgs, Drawer, Together, open_for};
use crate::given::Given;
use crate::lens_args::LensArgs;
use crate::light_args::LightArgs;
use crate::memory::MemoryArgs;
use crate::report::print_json;
use crate::state_args::{Seen, StateArgs};

#[derive(Args)]
pub(crate) struct RenderArgs {
    #[command(flatten)]
    state: StateArgs,
    /// Azimuth and elevation in degrees, and distance in radii of the volume's bounding sphere; 0,0 looks from the
    /// front, which is a body's anterior side where the file knows it and +z otherwise
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// PNG file to write. With --turntable, --path or --times a folder, which is made, or a name with a # for each digit
    /// of a number. A movie is of all times of the file, or of a turn: .gif plays everywhere, .apng has all colours
    #[arg(short, long, visible_alias = "movie", value_name = "FILE", value_parser = parse_pictures)]
    output: PathBuf,
    /// Render N pictures once around the volume, starting at --orbit
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=MAX_PICTURES))]
    turntable: Option<u32>,
    /// Render points in time, all under the look of the first: from A, without B, every STEP; : is all of them
    #[arg(long, value_name = "A:B[:STEP]")]
    times: Option<TimeRange>,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    view: ViewArgs,
    /// Colour behind the volume
    #[arg(long, value_name = "#RRGGBB", value_parser = parse_background, default_value = "#000000")]
    background: [u8; 3],
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    memory: MemoryArgs,
    #[command(flatten)]
    distributed: DistributedArgs,
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
    match args.distributed.join()? {
        Some(together) => together.conclude(make(args, given, Some(&together))),
        None => make(args, given, None),
    }
}

fn make(args: &RenderArgs, given: Given, together: Option<&Together>) -> Result<()> {
    let seen = args.state.read(given)?;
    let series = args.series(&seen)?;
    if together.is_some() && matches!(series, Series::Times(..)) {
        let text = "found several times with --distributed, expected one, chosen by --time";
        return Err(clap::Error::raw(ErrorKind::ArgumentConflict, text).into());
    }
    let is_writer = together.is_none_or(Together::is_root);
    let is_series = !matches!(series, Series::One);
    let movie = MovieForm::of(&args.output).filter(|_| is_series);
    if !is_series && !args.output.is_dir() {
        let parsed = parse_picture(&args.output.to_string_lossy());
        parsed.map_err(|text| clap::Error::raw(ErrorKind::ValueValidation, text))?;
    }
    if !is_series && args.output.is_dir() {
        let text = format!("{}: found a folder, expected the name of a file", args.output.display());
        return Err(clap::Error::raw(ErrorKind::ValueValidation, text).into());
    }
    if !is_series || movie.is_some() {
        not_an_input(&args.output, seen.inputs(&args.volume, &args.state, &args.look))?;
    }
    seen.note_what_is_not_drawn(args.lens.has_two_eyes());
    let lighting = args.light.lighting();
    let volume = match &series {
        Series::Times(times, _) => seen.volume(&args.volume)?.at_time(times[0]),
        _ => args.volume.clone(),
    };
    let (opened, look) =
        open_for(together, &seen, (&volume, &args.memory), &args.look, lighting, &ListArgs::default())?;
    let bounds = opened.scene.volume.bounds();
    let mode = opened.scene.settings.mode;
    let letters = opened.scene.volume.info.orientation.clone();
    let orbit = args.orbit.upright(letters.as_deref());
    let num_pictures = series.num_pictures();
    if num_pictures > MAX_PICTURES as u32 {
        anyhow::bail!("these would be {num_pictures} pictures, expected at most {MAX_PICTURES}");
    }
    let names = Names::of(&args.output, is_series);
    if let (None, Names::Folder(folder), true) = (movie, &names, is_writer) {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }
    let at_values = look.at_values(&opened.scene);
    let transfer = opened.transfer.clone();
    let mut drawer = Drawer::new(opened, together, &args.backend)?;
    let mut progress = (is_series && is_writer).then(|| Progress::new("pictures", num_pictures.into()));
    let mut writer = None;
    let start = Instant::now();
    let mut told = None;
    for number in 0..num_pictures {
        let mut label = number;
        let mut camera = seen.camera(&orbit, series.degrees(number), &args.view, &bounds);
        match &series {
            Series::Path(path) => {
                let at = Duration::from_secs_f32(number as f32 / PICTURES_PER_SECOND as f32);
                if let Some(pose) = path.pose_at(at, &camera.intrinsics, &bounds) {
                    camera = moved(&camera, pose, &bounds);
                }
            }
            Series::Times(times, _) => {
                label = times[number as usize];
                if number > 0 {
                    let open = || scene_under(&at_values, &volume.at_time(label), &args.memory);
                    drawer = drawer.with_volume(open)?;
                }
            }
            Series::One | Series::Turn(_) => {}
        }
        drawer.show(&camera)?;
        let plan = args.lens.plan(&camera, &bounds, letters.as_deref(), series.degrees(number))?;
        let pictures = plan.draw(|views| drawer.render_mean(views))?;
        if !is_writer {
            continue;
        }
        let render_ms = start.elapsed().as_secs_f64() * 1e3;
        let picture = plan.compose(&pictures, seen.background(args.background));
        match movie {
            Some(form) => {
                let size = [picture.width, picture.height];
                let begun = match writer.take() {
                    Some(begun) => Ok(begun),
                    None => MovieWriter::create(&args.output, form, size, num_pictures, series.interval()),
                };
                let mut begun = begun?;
                begun.add(&picture)?;
                writer = Some(begun);
            }
            None => picture.write(&names.file(label))?,
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
        let mut told = json!({
            "output": args.output.display().to_string(),
            "size": size,
            "pictures": num_pictures,
            "lens": lens,
            "backend": drawer.description(),
            "tf": transfer,
            "mode": mode.name(),
            "render_ms": render_ms,
        });
        if let Series::Times(times, _) = &series {
            told["times"] = json!(times);
        }
        print_json(&told)?;
    }
    Ok(())
}

/// What there are pictures of.
enum Series {
    One,
    /// So many around the volume.
    Turn(u32),
    Path(CameraPath),
    /// Points in time of the file, and the time between two of them in a movie.
    Times(Vec<u32>, Duration),
}

impl RenderArgs {
    /// The series that is asked for. A movie without one is of all times, or else of a turn.
    fn series(&self, seen: &Seen) -> Result<Series> {
        let path = self.path.read()?;
        let given = [
            ("--turntable", self.turntable.is_some()),
            ("--path", path.is_some()),
            ("--times", self.times.is_some()),
        ];
        let mut given = given.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name);
        if let (Some(first), Some(second)) = (given.next(), given.next()) {
            let text = format!("found {first} and {second}, expected one of them");
            return Err(clap::Error::raw(ErrorKind::ArgumentConflict, text).into());
        }
        let is_movie = MovieForm::of(&self.output).is_some();
        let of_times = |range: TimeRange| -> Result<Series> {
            let outline = seen.volume(&self.volume)?.outline()?;
            let number = u32::try_from(outline.num_times).unwrap_or(u32::MAX);
            if number == 1 && self.times.is_none() {
                return Ok(Series::Turn(TURN_PICTURES));
            }
            let times = range.times(number).map_err(|text| anyhow::anyhow!("--times: {text}"))?;
            let step = outline.time_step.map(|seconds| seconds * f64::from(range.step));
            Ok(Series::Times(times, interval_of_times(step)))
        };
        match (path, self.turntable, self.times) {
            (Some(path), ..) => Ok(Series::Path(path)),
            (_, Some(number), _) => Ok(Series::Turn(number)),
            (_, _, Some(range)) => of_times(range),
            _ if is_movie => of_times(TimeRange::ALL),
            _ => Ok(Series::One),
        }
    }
}

impl Series {
    fn num_pictures(&self) -> u32 {
        match self {
            Self::One => 1,
            Self::Turn(number) => *number,
            Self::Path(path) => (path.duration().as_secs_f32() * PICTURES_PER_SECOND as f32) as u32 + 1,
            Self::Times(times, _) => times.len() as u32,
        }
    }

    /// How far the camera has turned around the volume, degrees.
    fn degrees(&self, number: u32) -> f32 {
        match self {
            Self::Turn(pictures) => 360.0 * number as f32 / *pictures as f32,
            Self::One | Self::Path(_) | Self::Times(..) => 0.0,
        }
    }

    fn interval(&self) -> Duration {
        match self {
            Self::Times(_, interval) => *interval,
            Self::One | Self::Turn(_) | Self::Path(_) => INTERVAL,
        }
    }
}

/// Points in time of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct TimeRange {
    from: u32,
    /// The time after the last; `None` is the end.
    to: Option<u32>,
    step: u32,
}

impl TimeRange {
    const ALL: Self = Self { from: 0, to: None, step: 1 };

    /// The times, of a file with `number` of them.
    fn times(self, number: u32) -> Result<Vec<u32>, String> {
        let to = self.to.unwrap_or(number);
        if self.from >= to || to > number {
            return Err(format!("found {}:{to}, expected a part of 0:{number}", self.from));
        }
        Ok((self.from..to).step_by(self.step as usize).take(MAX_PICTURES as usize + 1).collect())
    }
}

impl FromStr for TimeRange {
    type Err = String;

    /// Reads `A:B` or `A:B:STEP`. The end is not included. A missing number is the first or the last time.
    fn from_str(text: &str) -> Result<Self, String> {
        let bad = || "expected A:B or A:B:STEP, such as 0:10 or ::2".to_owned();
        let number = |word: &str| match word.trim() {
            "" => Ok(None),
            word => word.parse::<u32>().map(Some).map_err(|_| bad()),
        };
        let words: Vec<_> = text.split(':').map(number).collect::<Result<_, _>>()?;
        let (from, to, step) = match words[..] {
            [from, to] => (from, to, None),
            [from, to, step] => (from, to, step),
            _ => return Err(bad()),
        };
        let (from, step) = (from.unwrap_or(0), step.unwrap_or(1));
        if step == 0 || to.is_some_and(|to| to <= from) {
            return Err(format!("{text} is empty; {}", bad()));
        }
        Ok(Self { from, to, step })
    }
}

/// Opens a volume under a look of values.
fn scene_under(look: &Look, volume: &VolumeArgs, memory: &MemoryArgs) -> Result<Scene> {
    let volume = volume.open_to_draw(memory)?;
    let (channels, settings) = (look.channels.clone(), look.march_settings());
    Ok(Scene::with_channels(Arc::new(volume), &look.transfer, channels, settings))
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
    let says = |ending: &&&str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending));
    if let Some(other) = ["avi", "mkv", "mov", "mp4", "webm"].iter().find(says) {
        return Err(format!(
            "movies are GIF or APNG, expected a name ending in .gif or .apng, found .{other}"
        ));
    }
    if path.is_dir() || MovieForm::of(&path).is_some() { Ok(path) } else { parse_picture(text) }
}

/// A minute at 60 pictures a second.
const MAX_PICTURES: i64 = 3600;
/// Pictures of a turn in a movie that is asked for by its name alone: four seconds.
const TURN_PICTURES: u32 = 4 * PICTURES_PER_SECOND;
