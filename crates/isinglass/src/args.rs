//! Arguments that several commands share.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};
use clap::{Args, ValueEnum};
use glam::Vec3;
use isinglass_bench::paths;
use isinglass_bench::progress::Progress;
use isinglass_bench::rivals::Method;
use isinglass_bench::scenes::{OpenedScene, open_scene};
use isinglass_client::{CameraPath, DEFAULT_FOV_Y_DEGREES, Foresight};
use isinglass_core::camera::{Camera, Intrinsics, MAX_SIDE};
use isinglass_core::kernels::layering::Layering;
use isinglass_core::kernels::march::MarchSettings;
use isinglass_core::layer::MAX_K;
use isinglass_core::look::{DEFAULT_K, Look};
use isinglass_core::mode::{Isos, Mode as RenderMode};
use isinglass_core::session::rate::{DEFAULT_QUALITY, Mode, Plan};
use isinglass_core::space::Aabb;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::{Lighting, Volume};
use isinglass_formats::{
    Dtype, Endian, LoadRequest, OpenOptions, Outline, RawShape, Region, Selection, open, outline,
};
use isinglass_gpu::{Backend, BackendChoice};
use isinglass_net::LinkModel;

use crate::clip_args::ClipArgs;
use crate::library::{FileLoader, OpenedFile};
use crate::memory::MemoryArgs;

/// A volume, and the shape of a raw one.
#[derive(Args, Clone, Debug)]
pub(crate) struct VolumeArgs {
    /// A file or folder (DICOM, NIfTI, NRRD, MetaImage, TIFF, OME-TIFF, OME-Zarr, VTI, MRC, NumPy), a raw file with --dims
    /// and --dtype, or builtin:cloud, builtin:cubus, builtin:shells (with @N for N voxels a side)
    #[arg(value_name = "VOLUME", required = true)]
    pub(crate) volume: Option<String>,
    #[command(flatten)]
    pub(crate) raw: RawArgs,
    #[command(flatten)]
    pub(crate) part: PartArgs,
}

impl VolumeArgs {
    /// What to open.
    pub(crate) fn source(&self) -> Result<&str> {
        self.volume.as_deref().context("expected VOLUME")
    }

    /// The volume that a saved state names; flags that take another part of it hold.
    pub(crate) fn in_state(&self, source: String, saved: &Selection) -> Self {
        let of_flags = self.part.selection();
        let part = PartArgs {
            channel: of_flags.channel.or(saved.channel),
            time: of_flags.time.or(saved.time),
            level: of_flags.level.or(saved.level),
            series: of_flags.series.or(saved.series),
            region: of_flags.region.or(saved.region),
            ..self.part.clone()
        };
        Self { volume: Some(source), raw: self.raw.clone(), part }
    }

    /// Opens the volume, after what is known before; large files show their progress.
    pub(crate) fn open(&self) -> Result<(Volume, Outline)> {
        let source = self.source()?;
        let before = outline(source, &self.options())?;
        let volume = show_progress(&before, |progress| {
            open(source, &OpenOptions { progress: Some(progress), ..self.options() })
        })?;
        Ok((volume, before))
    }

    /// How to open it.
    fn options(&self) -> OpenOptions<'static> {
        let PartArgs { spacing, .. } = self.part;
        OpenOptions {
            raw: self.raw.shape(),
            selection: self.part.selection(),
            spacing,
            ..OpenOptions::default()
        }
    }
}

/// Runs `read` with something to tell its progress to, under the size of what is read.
fn show_progress<T>(outline: &Outline, read: impl FnOnce(&dyn Fn(f32)) -> T) -> T {
    let [x, y, z] = outline.dims;
    let megabytes = outline.bytes_in_memory as f64 / 1e6;
    let text = format!("reading {x}×{y}×{z} {}, {megabytes:.1} MB", outline.dtype);
    let progress = std::cell::RefCell::new(Progress::new(&text, 100));
    let done = std::cell::Cell::new(0);
    let report = |fraction: f32| {
        let percent = (fraction * 100.0) as u64;
        progress.borrow_mut().advance(percent.saturating_sub(done.get()), "%");
        done.set(percent.max(done.get()));
    };
    let result = read(&report);
    progress.into_inner().finish();
    result
}

/// Which part of a file becomes the volume.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Parts of a file")]
pub(crate) struct PartArgs {
    /// Channel, component or array of the file, from 0
    #[arg(long, value_name = "N")]
    channel: Option<u32>,
    /// Point in time, from 0
    #[arg(long, value_name = "N")]
    time: Option<u32>,
    /// Level of a pyramid, 0 the finest [default: the finest that fits into memory]
    #[arg(long, value_name = "N")]
    level: Option<u32>,
    /// Series of a folder, from 0 [default: the largest]
    #[arg(long, value_name = "N")]
    series: Option<u32>,
    /// Voxels to take along the axes that `info` shows, the end not included, such as 0:100,50:,:
    #[arg(long, value_name = "X,Y,Z")]
    region: Option<Region>,
    /// Distances between voxels, in place of those of the file
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_spacing, allow_hyphen_values = true)]
    pub(crate) spacing: Option<Vec3>,
}

impl PartArgs {
    /// The part.
    pub(crate) fn selection(&self) -> Selection {
        let &Self { channel, time, level, series, region, .. } = self;
        Selection { channel, time, level, series, region }
    }
}

/// What a raw file does not say of itself.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Raw volumes")]
pub(crate) struct RawArgs {
    /// Voxels along x, y and z of a raw file
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_dims, requires = "dtype")]
    dims: Option<[u32; 3]>,
    /// Type of its voxels: uint8, int16, float, …
    #[arg(long, value_name = "TYPE", requires = "dims")]
    dtype: Option<Dtype>,
    /// Order of its bytes: little or big
    #[arg(long, value_name = "ORDER", requires = "dims")]
    endian: Option<Endian>,
    /// Bytes before its first voxel
    #[arg(long, value_name = "BYTES", requires = "dims")]
    offset: Option<u64>,
}

impl RawArgs {
    /// The shape, if there is one.
    pub(crate) fn shape(&self) -> Option<RawShape> {
        Some(RawShape {
            dims: self.dims?,
            dtype: self.dtype?,
            spacing: Vec3::ONE,
            endian: self.endian.unwrap_or_default(),
            offset: self.offset.unwrap_or(0),
        })
    }
}

/// Size and field of view of a picture.
#[derive(Args, Clone, Debug)]
pub(crate) struct ViewArgs {
    /// Columns and rows of the picture
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "512x512")]
    pub(crate) size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = DEFAULT_FOV_Y_DEGREES)]
    pub(crate) fov: f32,
    /// Parallel rays: what is far away is as large as what is near. The picture shows as much of the volume's middle as it
    /// would with --fov
    #[arg(long)]
    pub(crate) orthographic: bool,
}

impl ViewArgs {
    /// The intrinsics of a perspective picture.
    pub(crate) fn intrinsics(&self) -> Intrinsics {
        let [width, height] = self.size;
        Intrinsics::perspective(width, height, self.fov.to_radians())
    }
}

/// The camera of parallel rays that shows as much of the middle of `bounds` as `camera` does.
pub(crate) fn orthographic(camera: &Camera, bounds: &Aabb) -> Camera {
    if camera.intrinsics.projection.is_orthographic() {
        return *camera;
    }
    let depth = (bounds.center() - camera.pose.eye).dot(camera.pose.forward());
    // An eye in the very middle would see nothing of it.
    camera.to_orthographic(depth.max(1e-3 * bounds.radius()), bounds)
}

/// How matter looks.
#[derive(Args, Clone, Debug)]
pub(crate) struct LookArgs {
    /// Transfer function: a preset or a TOML file [default: the preset that suits the volume]
    #[arg(long, value_name = "FILE|PRESET")]
    pub(crate) tf: Option<String>,
    /// Whether gradients shade the colours
    #[arg(long, value_enum, default_value_t = Switch::On)]
    pub(crate) shading: Switch,
    /// What a pixel tells of its ray: composite, mip, minip, average or iso [default: composite, with --iso iso]
    #[arg(long, value_name = "MODE")]
    mode: Option<RenderMode>,
    /// Values of the surfaces of --mode iso, each with an opacity if it is not opaque [default: the value that parts the
    /// histogram best]
    #[arg(long, value_name = "V[:OPACITY],…", allow_hyphen_values = true)]
    iso: Option<Isos>,
    #[command(flatten)]
    pub(crate) clip: ClipArgs,
}

/// On or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Switch {
    /// Yes.
    On,
    /// No.
    Off,
}

impl LookArgs {
    /// Whether gradients shade.
    pub(crate) fn is_shaded(&self) -> bool {
        self.shading == Switch::On
    }

    /// The mode, and its surfaces.
    pub(crate) fn mode(&self) -> Result<(RenderMode, Isos)> {
        let isos = self.iso.unwrap_or_default();
        match (self.mode, self.iso) {
            (None, Some(_)) => Ok((RenderMode::Iso, isos)),
            (Some(mode), Some(_)) if mode != RenderMode::Iso => {
                bail!("--iso: found --mode {mode}, expected --mode iso")
            }
            (mode, _) => Ok((mode.unwrap_or_default(), isos)),
        }
    }

    /// How the volume is marched.
    pub(crate) fn march_settings(&self, lighting: Lighting) -> Result<MarchSettings> {
        let (mode, isos) = self.mode()?;
        Ok(MarchSettings {
            clip: self.clip.clip(),
            mode,
            isos,
            ..MarchSettings::of(self.is_shaded(), lighting)
        })
    }

    /// What is asked for, of a volume whose transfer function is `transfer`.
    pub(crate) fn look(&self, transfer: TransferFunction, layering: &LayeringArgs) -> Result<Look> {
        let LayeringArgs { layering, k } = *layering;
        let (mode, isos) = self.mode()?;
        let clip = self.clip.clip();
        Ok(Look { shaded: self.is_shaded(), layering, k, clip, mode, isos, ..Look::new(transfer) })
    }
}

/// What a viewer does against the delay of its frames.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Foresight")]
pub(crate) struct ForesightArgs {
    /// Ask for frames from where the camera will be when they are shown
    #[arg(long, value_enum, default_value_t = Switch::On)]
    predict: Switch,
    /// Ask for frames with a margin where the volume goes on beyond the picture
    #[arg(long, value_enum, default_value_t = Switch::On)]
    guard_band: Switch,
    /// Take what the newest frame does not see from older ones
    #[arg(long, value_enum, default_value_t = Switch::On)]
    kept_frames: Switch,
}

impl ForesightArgs {
    /// In the viewer's terms.
    pub(crate) fn foresight(&self) -> Foresight {
        let is_on = |switch| switch == Switch::On;
        Foresight {
            predicts: is_on(self.predict),
            guards: is_on(self.guard_band),
            keeps: is_on(self.kept_frames),
        }
    }
}

/// A camera path from a file.
#[derive(Args, Clone, Debug)]
pub(crate) struct PathArgs {
    /// Play the camera path in FILE, as `view --record` writes it, in place of the orbit; or builtin:stops,
    /// builtin:flicks, builtin:zoom-pan
    #[arg(long, value_name = "FILE")]
    path: Option<PathBuf>,
}

impl PathArgs {
    /// Reads it.
    pub(crate) fn read(&self) -> Result<Option<CameraPath>> {
        let Some(path) = &self.path else { return Ok(None) };
        let name = path.display();
        if let Some(builtin) = path.to_str().and_then(|p| p.strip_prefix("builtin:")) {
            let known = || paths::names().collect::<Vec<_>>().join(", ");
            let found = paths::builtin(builtin);
            let found = found.with_context(|| format!("{name}: expected one of {}", known()))?;
            return Ok(Some(found.with_context(|| name.to_string())?));
        }
        let size = std::fs::metadata(path).with_context(|| name.to_string())?.len();
        if size > MAX_PATH_BYTES {
            bail!("{name}: found {size} bytes, expected a camera path of at most {MAX_PATH_BYTES}");
        }
        let text = std::fs::read_to_string(path).with_context(|| name.to_string())?;
        Ok(Some(CameraPath::parse(&text).with_context(|| name.to_string())?))
    }
}

/// Which segments a layered frame holds.
#[derive(Args, Clone, Debug)]
pub(crate) struct LayeringArgs {
    /// Rule: visibility-merge, equal-transmittance, equal-length, homogeneity, slabs, single-depth or single-depth:D, D
    /// being mean, entry, exit, midpoint, peak, gradient or threshold
    #[arg(long, value_name = "RULE", default_value_t = Layering::default())]
    pub(crate) layering: Layering,
    /// Most segments a pixel
    #[arg(long, value_name = "K", value_parser = parse_k, default_value_t = DEFAULT_K)]
    pub(crate) k: u8,
}

impl Default for LayeringArgs {
    fn default() -> Self {
        Self { layering: Layering::default(), k: DEFAULT_K }
    }
}

/// How the frames of a server become bytes.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Coding")]
pub(crate) struct PlanArgs {
    /// Codec: exact, which keeps every list and depth; blocks, which takes far fewer bytes; or auto: blocks while the camera
    /// moves and exact frames where it rests
    #[arg(long, value_enum, default_value_t = ModeChoice::Auto)]
    codec: ModeChoice,
    /// Best quality of frames in blocks, from 0 to 100; less where the link is too narrow for it
    #[arg(long, value_name = "Q", default_value_t = DEFAULT_QUALITY, value_parser = clap::value_parser!(u8).range(0..=100))]
    quality: u8,
}

/// The codings of a server.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ModeChoice {
    /// Both.
    Auto,
    /// All lists and depths as they are.
    Exact,
    /// Lists in blocks.
    Blocks,
}

impl PlanArgs {
    /// In the server's terms, with at most `rate_mbit` megabits a second.
    pub(crate) fn plan(&self, rate_mbit: Option<f64>) -> Plan {
        let mode = match self.codec {
            ModeChoice::Auto => Mode::Auto,
            ModeChoice::Exact => Mode::Exact,
            ModeChoice::Blocks => Mode::Blocks,
        };
        let bytes_per_second = rate_mbit.map(|mbit| mbit * 1e6 / 8.0);
        Plan { mode, quality: self.quality, bytes_per_second }
    }
}

/// How one frame becomes bytes.
#[derive(Args, Clone, Debug)]
pub(crate) struct CodecArgs {
    /// Codec: exact, which keeps every list and depth, or blocks, which takes far fewer bytes
    #[arg(long, value_enum, default_value_t = CodecChoice::Exact)]
    pub(crate) codec: CodecChoice,
    /// Quality of --codec blocks, from 0 to 100
    #[arg(long, value_name = "Q", default_value_t = 60, value_parser = clap::value_parser!(u8).range(0..=100))]
    pub(crate) quality: u8,
    /// The best quality of --codec blocks that makes the frame no larger than so many bytes
    #[arg(long, value_name = "N", conflicts_with = "quality")]
    pub(crate) bytes: Option<usize>,
    /// The fewest bytes of any codec with which no channel of the picture at the frame's own pose is off by more than so many
    /// 255ths, and no list's middle by more than --shift
    #[arg(long, value_name = "E", conflicts_with_all = ["quality", "bytes", "codec"])]
    pub(crate) bound: Option<u8>,
    /// Greatest shift of a list's middle for --bound, in pixels at a turn of --turn
    #[arg(long, value_name = "PIXELS", default_value_t = 1.0, value_parser = parse_pixels, requires = "bound")]
    pub(crate) shift: f32,
    /// Turn for --shift, degrees
    #[arg(long, value_name = "DEG", default_value_t = 10.0, value_parser = parse_turn, requires = "bound")]
    pub(crate) turn: f32,
}

/// A codec.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum CodecChoice {
    /// All lists and depths as they are.
    Exact,
    /// Lists in blocks.
    Blocks,
}

/// How a frame becomes a picture.
#[derive(Args, Clone, Debug)]
pub(crate) struct MethodArgs {
    /// How frames become pictures: layers, point-warp, slabs-planar, slabs-mesh or last-image
    #[arg(long, value_name = "METHOD", default_value_t = Method::default())]
    pub(crate) method: Method,
}

/// Where kernels run.
#[derive(Args, Clone, Debug)]
pub(crate) struct BackendArgs {
    /// Where kernels run: auto, gpu or cpu
    #[arg(long, value_name = "BACKEND", default_value_t = BackendChoice::default())]
    pub(crate) backend: BackendChoice,
}

impl BackendArgs {
    /// Opens it.
    pub(crate) fn open(&self) -> Result<Backend> {
        Ok(Backend::open(self.backend)?)
    }
}

/// What the link between server and viewer is like, beside its round-trip time.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Link")]
pub(crate) struct LinkArgs {
    /// Greatest additional delay of a packet, each way
    #[arg(long, value_name = "TIME", value_parser = parse_duration, default_value = "0ms")]
    jitter: Duration,
    /// Share of packets that are lost, each way: 0.01 is one in a hundred
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    loss: f64,
    /// Rate each way, megabits a second [default: unlimited]
    #[arg(long, value_name = "MBIT")]
    bandwidth: Option<f64>,
    /// Seed of the link's chances
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
}

impl LinkArgs {
    /// The link.
    pub(crate) fn model(&self, rtt: Duration) -> Result<LinkModel> {
        let &Self { jitter, loss, bandwidth: bandwidth_mbit, seed } = self;
        let model = LinkModel { rtt, jitter, loss, bandwidth_mbit, seed, ..LinkModel::default() };
        model.validate()?;
        Ok(model)
    }
}

/// Opens a volume with its look; large files show their progress.
pub(crate) fn open_volume(volume: &VolumeArgs, look: &LookArgs, lighting: Lighting) -> Result<OpenedScene> {
    let settings = look.march_settings(lighting)?;
    let source = volume.source()?;
    let before = outline(source, &volume.options())?;
    let opened = show_progress(&before, |progress| {
        let options = OpenOptions { progress: Some(progress), ..volume.options() };
        open_scene(source, look.tf.as_deref(), settings, &options)
    });
    Ok(opened?)
}

/// Opens a volume to serve within a limit of memory, with the rest of its file; large files show their progress.
pub(crate) fn open_to_serve(volume: &VolumeArgs, look: &LookArgs, memory: &MemoryArgs) -> Result<OpenedFile> {
    let options = OpenOptions { max_bytes: memory.bytes(), ..volume.options() };
    let OpenOptions { raw, selection, spacing, max_bytes, .. } = options;
    let request = LoadRequest { source: volume.source()?.to_owned(), raw, selection, spacing, max_bytes };
    let loader = FileLoader::new(&request, look.tf.as_deref())?;
    let before = loader.outline(selection, 0).map_err(|e| anyhow!(e))?;
    let opened = show_progress(&before, |progress| {
        open(&request.source, &OpenOptions { progress: Some(progress), ..options })
    });
    loader.opened(Arc::new(opened?), &before)
}

/// The path of a file to write, checked before any work is done: its folder must exist.
pub(crate) fn parse_output(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match path.file_name() {
        None => Err("expected the name of a file".into()),
        Some(_) if !folder.is_dir() => Err(format!("there is no folder {}", folder.display())),
        Some(_) if path.is_dir() => Err("found a folder, expected the name of a file".into()),
        Some(_) => Ok(path),
    }
}

/// `#rrggbb`.
pub(crate) fn parse_background(text: &str) -> Result<[u8; 3], String> {
    let hex = text.strip_prefix('#').unwrap_or(text);
    let number = (hex.len() == 6 && hex.bytes().all(|b| b.is_ascii_hexdigit()))
        .then(|| u32::from_str_radix(hex, 16).ok())
        .flatten();
    let [_, rgb @ ..] = number.ok_or("expected a colour like #20242c")?.to_be_bytes();
    Ok(rgb)
}

/// `200ms`, `0.2s`, `0`, or a number of milliseconds.
pub(crate) fn parse_duration(text: &str) -> Result<Duration, String> {
    let (number, seconds_per_unit) = match text.strip_suffix("ms") {
        Some(number) => (number, 1e-3),
        None => text.strip_suffix('s').map_or((text, 1e-3), |number| (number, 1.0)),
    };
    let seconds = number.trim().parse::<f64>().ok().map(|n| n * seconds_per_unit);
    match seconds.filter(|s| (0.0..=MAX_SECONDS).contains(s)) {
        Some(seconds) => Ok(Duration::from_secs_f64(seconds)),
        None => Err(format!("expected a time of at most {MAX_SECONDS} s, such as 200ms or 0.2s")),
    }
}

fn parse_pixels(text: &str) -> Result<f32, String> {
    let pixels = text.parse::<f32>().ok().filter(|p| (0.0..=10_000.0).contains(p));
    pixels.ok_or_else(|| "expected 0 to 10000 pixels".into())
}

fn parse_turn(text: &str) -> Result<f32, String> {
    let degrees = text.parse::<f32>().ok().filter(|d| (0.0..=90.0).contains(d));
    degrees.ok_or_else(|| "expected 0 to 90 degrees".into())
}

/// Megabits a second.
pub(crate) fn parse_mbit(text: &str) -> Result<f64, String> {
    let rate = text.parse::<f64>().ok().filter(|r| (0.1..=100_000.0).contains(r));
    rate.ok_or_else(|| "expected 0.1 to 100000 megabits a second".into())
}

/// `WxH`.
pub(crate) fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once(['x', 'X', '×']).and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    sides
        .filter(|sides| sides.iter().all(|side| (1..=MAX_SIDE).contains(side)))
        .ok_or_else(|| format!("expected WxH with sides of 1 to {MAX_SIDE}, such as 512x512"))
}

/// Degrees.
pub(crate) fn parse_fov(text: &str) -> Result<f32, String> {
    let degrees = text.parse::<f32>().ok().filter(|d| (1.0..=170.0).contains(d));
    degrees.ok_or_else(|| "expected 1 to 170 degrees".into())
}

/// A list length.
pub(crate) fn parse_k(text: &str) -> Result<u8, String> {
    let k = text.parse::<u8>().ok().filter(|&k| (1..=MAX_K).contains(&usize::from(k)));
    k.ok_or_else(|| format!("expected 1 to {MAX_K}"))
}

fn parse_dims(text: &str) -> Result<[u32; 3], String> {
    parse_three(text).filter(|dims| dims.iter().all(|d| (1..=Volume::MAX_SIDE).contains(d))).ok_or_else(
        || format!("expected three numbers of voxels, 1 to {}, such as 256,256,128", Volume::MAX_SIDE),
    )
}

fn parse_spacing(text: &str) -> Result<Vec3, String> {
    parse_three::<f32>(text)
        .filter(|spacing| spacing.iter().all(|s| s.is_finite() && *s > 0.0))
        .map(Vec3::from_array)
        .ok_or_else(|| "expected three positive numbers, such as 1,1,2.5".into())
}

/// Three values between commas or crosses.
fn parse_three<T: std::str::FromStr>(text: &str) -> Option<[T; 3]> {
    let parts =
        text.split([',', 'x', 'X', '×']).map(|p| p.trim().parse().ok()).collect::<Option<Vec<T>>>()?;
    parts.try_into().ok()
}

/// Segments a pixel if none are named: the design's figures are for this number.
/// A path of the greatest length, with every number written out.
const MAX_PATH_BYTES: u64 = 4 << 20;
/// Longer times are typing errors.
const MAX_SECONDS: f64 = 60.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_read_and_nonsense_is_refused() {
        assert_eq!(parse_size("640x480"), Ok([640, 480]));
        assert_eq!(parse_duration("200ms"), Ok(Duration::from_millis(200)));
        assert_eq!(parse_duration("0.2s"), parse_duration("200"));
        assert_eq!(parse_background("#0a0B0c"), Ok([10, 11, 12]));
        assert_eq!(parse_dims("1,2,3"), Ok([1, 2, 3]));
        assert_eq!(parse_spacing("1,2,0.5"), Ok(Vec3::new(1.0, 2.0, 0.5)));
        assert_eq!(parse_k("32"), Ok(32));
        for bad in ["", "0x5", "5x", "x", "-1x4", "9999x1", "4", "4x4x4"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
        for bad in ["", "-1ms", "nan", "1h", "inf", "61s"] {
            assert!(parse_duration(bad).is_err(), "{bad}");
        }
        for bad in ["", "#12345", "#1234567", "#gggggg", "red"] {
            assert!(parse_background(bad).is_err(), "{bad}");
        }
        for bad in ["1,2", "0,1,1", "1,2,3,4", "1,2,99999"] {
            assert!(parse_dims(bad).is_err(), "{bad}");
        }
        assert!(parse_spacing("1,0,1").is_err() && parse_spacing("1,nan,1").is_err());
        assert!(parse_k("0").is_err() && parse_k("33").is_err() && parse_fov("180").is_err());
    }
}
