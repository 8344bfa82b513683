//! The tasks of one scene on one backend, and their least times.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::cancel::ALWAYS;
use isinglass_core::codec;
use isinglass_core::image_error::{ImageError, compare};
use isinglass_core::kernels::empty_space::EmptySpace;
use isinglass_core::kernels::march::Scene;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::volume::{Bricks, Histogram, PageSet, Pyramid};
use isinglass_render::{Backend, Renderer, Reprojector};

use super::{Preparation, SpeedOptions, SpeedRow};
use crate::error::BenchError;
use crate::scenes::SceneSource;
use isinglass_core::orbit::Orbit;

/// Everything that takes turns.
pub(super) struct Tasks<'a> {
    backend: &'a Backend,
    options: &'a SpeedOptions,
    bounds: Aabb,
    dims: [u32; 3],
    orbit: Orbit,
    renderer: Renderer,
    /// The same scene by pages of the finest level, unless that takes too much memory.
    paged: Option<Renderer>,
    turned: Vec<Camera>,
    frames: Vec<MadeFrame>,
    tasks: Vec<Task>,
    least: BTreeMap<Task, Time>,
}

/// A frame of one K and size, prepared for casting.
struct MadeFrame {
    header: FrameHeader,
    encoded: codec::EncodedFrame,
    frame: Arc<LayeredFrame>,
    caster: Reprojector,
}

/// A task, with indices into the lists of [`Tasks`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Task {
    /// Full rendering from a turned camera.
    Render(usize),
    /// The same by pages.
    RenderPages(usize),
    /// Full rendering from a frame's camera in the frame's size that does not stop at opaque matter.
    Through([u32; 2]),
    Generate(usize),
    /// The same by pages.
    GeneratePages(usize),
    Encode(usize),
    Decode(usize),
    Prepare(usize),
    /// Frame, turn, and whether the grid is used.
    View(usize, usize, bool),
}

/// Milliseconds with readback, and by the device's own clock.
#[derive(Clone, Copy, Debug)]
struct Time {
    wall: f64,
    gpu: Option<f64>,
}

impl Time {
    fn least(self, other: Self) -> Self {
        let gpu = self.gpu.zip(other.gpu).map(|(a, b)| a.min(b)).or(self.gpu).or(other.gpu);
        Self { wall: self.wall.min(other.wall), gpu }
    }

    /// The device's time, where it exists.
    fn best(self) -> f64 {
        self.gpu.unwrap_or(self.wall)
    }
}

fn in_seconds<T>(body: impl FnOnce() -> Result<T, BenchError>) -> Result<(T, f64), BenchError> {
    let started = Instant::now();
    let made = body()?;
    Ok((made, started.elapsed().as_secs_f64()))
}

impl<'a> Tasks<'a> {
    pub(super) fn open(
        backend: &'a Backend,
        options: &'a SpeedOptions,
        source: &SceneSource,
    ) -> Result<(Self, Preparation), BenchError> {
        let subject = &options.subject;
        let (volume, volume_seconds) = in_seconds(|| subject.open_volume(source))?;
        let (_, histogram_seconds) = in_seconds(|| Ok(Histogram::of(&volume)))?;
        let (_, bricks_seconds) = in_seconds(|| Ok(Bricks::of(&volume)))?;
        // A scene makes two histograms, one for its transfer function, and bricks.
        let (opened, scene_seconds) = in_seconds(|| subject.open_scene(source, volume))?;
        let look_seconds = (scene_seconds - 2.0 * histogram_seconds - bricks_seconds).max(0.0);
        let orbit = subject.orbit(&opened.scene.volume);
        let (bounds, dims) = (opened.scene.volume.bounds(), opened.scene.volume.dims());
        let pages = by_pages(&opened.scene);
        let paged = pages.map(|scene| backend.renderer(scene)).transpose()?;
        let (mut renderer, upload_seconds) = in_seconds(|| Ok(backend.renderer(opened.scene)?))?;
        let preparation = Preparation {
            scene: source.name.clone(),
            dims,
            backend: backend.description(),
            volume_seconds,
            histogram_seconds,
            bricks_seconds,
            look_seconds,
            upload_seconds,
        };
        let turned = |&angle: &f32| orbit.turned(angle).camera(subject.intrinsics, &bounds);
        let turned: Vec<Camera> = subject.angles_degrees.iter().map(turned).collect();
        let mut frames = Vec::new();
        for &[width, height] in &options.frame_sizes {
            let camera = orbit.camera(Intrinsics { width, height, ..subject.intrinsics }, &bounds);
            for &k in &subject.ks {
                let header = FrameHeader::alone(camera, k);
                let encoded = codec::encode(&renderer.generate(header)?)?;
                let frame = Arc::new(decode(&encoded)?);
                let caster = backend.reprojector(frame.clone(), &bounds)?;
                frames.push(MadeFrame { header, encoded, frame, caster });
            }
        }
        let mut opened = Self {
            backend,
            options,
            bounds,
            dims,
            orbit,
            renderer,
            paged,
            turned,
            frames,
            tasks: Vec::new(),
            least: BTreeMap::new(),
        };
        opened.tasks = opened.all();
        Ok((opened, preparation))
    }

    fn all(&self) -> Vec<Task> {
        let mut tasks: Vec<Task> = (0..self.turned.len()).map(Task::Render).collect();
        tasks.extend(self.options.frame_sizes.iter().map(|&size| Task::Through(size)));
        if self.paged.is_some() {
            tasks.extend((0..self.turned.len()).map(Task::RenderPages));
            tasks.extend((0..self.frames.len()).map(Task::GeneratePages));
        }
        for i in 0..self.frames.len() {
            tasks.extend([Task::Generate(i), Task::Encode(i), Task::Decode(i), Task::Prepare(i)]);
            for angle in 0..self.turned.len() {
                tasks.extend([Task::View(i, angle, true), Task::View(i, angle, false)]);
            }
        }
        tasks
    }

    /// Runs every task once.
    pub(super) fn run_round(&mut self, counts: bool) -> Result<(), BenchError> {
        for task in self.tasks.clone() {
            let mut time = self.run(task)?;
            // Another K needs new buffers on the GPU, which a server does not make per frame. Competing tasks get as
            // many tries.
            if counts
                && matches!(
                    (task, self.backend),
                    (Task::Generate(_) | Task::GeneratePages(_) | Task::Through(_), Backend::Gpu(_))
                )
                && time.wall < SHORT_MS
            {
                time = time.least(self.run(task)?);
            }
            if counts {
                self.least.entry(task).and_modify(|least| *least = least.least(time)).or_insert(time);
            }
        }
        Ok(())
    }

    fn run(&mut self, task: Task) -> Result<Time, BenchError> {
        let backend = self.backend;
        let Self { renderer, paged, orbit, turned, frames, options, bounds, .. } = self;
        let paged = paged.as_mut().unwrap_or(renderer);
        match task {
            Task::Render(angle) => timed(backend, || Ok(renderer.render(&turned[angle])?)),
            Task::RenderPages(angle) => timed(backend, || Ok(paged.render(&turned[angle])?)),
            Task::GeneratePages(i) => timed(backend, || Ok(paged.generate_while(frames[i].header, ALWAYS)?)),
            Task::Through([width, height]) => {
                let intrinsics = Intrinsics { width, height, ..options.subject.intrinsics };
                let camera = orbit.camera(intrinsics, bounds);
                timed(backend, || Ok(renderer.render_through(&camera)?))
            }
            Task::Generate(i) => timed(backend, || Ok(renderer.generate_while(frames[i].header, ALWAYS)?)),
            Task::Encode(i) => timed(backend, || Ok(codec::encode(&frames[i].frame)?)),
            Task::Decode(i) => timed(backend, || decode(&frames[i].encoded)),
            Task::Prepare(i) => timed(backend, || Ok(backend.reprojector(frames[i].frame.clone(), bounds)?)),
            Task::View(i, angle, skips_empty_space) => {
                let cast = CastOptions { skips_empty_space, ..CastOptions::default() };
                timed(backend, || Ok(frames[i].caster.raycast_with(&turned[angle], &cast)?))
            }
        }
    }

    pub(super) fn rows(&mut self, source: &SceneSource, rows: &mut Vec<SpeedRow>) -> Result<(), BenchError> {
        let truths: Vec<Picture> =
            self.turned.iter().map(|camera| self.renderer.render(camera)).collect::<Result<_, _>>()?;
        for i in 0..self.frames.len() {
            for (angle, truth) in truths.iter().enumerate() {
                rows.push(self.row(source, i, angle, truth)?);
            }
        }
        Ok(())
    }

    fn row(
        &mut self,
        source: &SceneSource,
        i: usize,
        angle: usize,
        truth: &Picture,
    ) -> Result<SpeedRow, BenchError> {
        let shown = self.frames[i].caster.raycast(&self.turned[angle])?;
        let error = error_between(&shown, truth)?;
        let made = &self.frames[i];
        let Intrinsics { width, height, .. } = made.header.camera.intrinsics;
        let frame_size = [width, height];
        // Every task has run; an infinite time would reveal a mistake.
        let time =
            |task: Task| self.least.get(&task).copied().unwrap_or(Time { wall: f64::INFINITY, gpu: None });
        let (render, through) = (time(Task::Render(angle)), time(Task::Through(frame_size)));
        let generate = time(Task::Generate(i));
        let by_pages = |paged, whole| self.paged.as_ref().map(|_| ratio(time(paged), whole));
        let view = time(Task::View(i, angle, true));
        let no_grid = time(Task::View(i, angle, false));
        Ok(SpeedRow {
            scene: source.name.clone(),
            dims: self.dims,
            backend: self.backend.description(),
            k: made.header.k,
            frame_size,
            angle_deg: self.options.subject.angles_degrees[angle],
            render_ms: render.wall,
            render_gpu_ms: render.gpu,
            render_through_ms: through.wall,
            render_through_gpu_ms: through.gpu,
            generate_ms: generate.wall,
            generate_gpu_ms: generate.gpu,
            encode_ms: time(Task::Encode(i)).wall,
            decode_ms: time(Task::Decode(i)).wall,
            prepare_ms: time(Task::Prepare(i)).wall,
            novel_view_ms: view.wall,
            novel_view_gpu_ms: view.gpu,
            novel_view_no_grid_ms: no_grid.wall,
            novel_view_no_grid_gpu_ms: no_grid.gpu,
            fps: 1e3 / view.best(),
            render_fps: 1e3 / render.best(),
            view_over_render: ratio(view, render),
            generate_over_through: ratio(generate, through),
            render_pages_over_whole: by_pages(Task::RenderPages(angle), render),
            generate_pages_over_whole: by_pages(Task::GeneratePages(i), generate),
            grid_gain: 1.0 - ratio(view, no_grid),
            empty_share: EmptySpace::new(&made.frame).empty_share(),
            ssim: error.ssim,
            dssim: error.dssim,
            dssim_object: error.dssim_object,
            psnr_db: error.psnr_db,
            bytes: made.encoded.num_bytes(),
            segments_mean: made.frame.segments_mean(),
            segments_total: made.frame.num_segments(),
        })
    }
}

/// The scene by all pages of its finest level.
fn by_pages(scene: &Scene) -> Option<Scene> {
    let volume = scene.whole();
    if volume.paging().is_some() || volume.bytes_in_memory() > MOST_BYTES_BY_PAGES {
        return None;
    }
    let pyramid = Arc::new(Pyramid::of(volume));
    let pages = pyramid.base_pages(volume).ok()?;
    Some(scene.with_pages(Arc::new(PageSet::new(pyramid, pages, |_| true)), None))
}

/// The ratio of two times: by the device's clock where both have it.
fn ratio(of: Time, to: Time) -> f64 {
    of.gpu.zip(to.gpu).map_or(of.wall / to.wall, |(of, to)| of / to)
}

/// Two pictures of one size on black.
fn error_between(a: &Picture, b: &Picture) -> Result<ImageError, BenchError> {
    let (width, height) = (a.width as usize, a.height as usize);
    Ok(compare(&a.to_srgb8([0.0; 3]), &b.to_srgb8([0.0; 3]), width, height, [0; 3])?)
}

fn decode(encoded: &codec::EncodedFrame) -> Result<LayeredFrame, BenchError> {
    let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
    Ok(codec::decode(&chunks)?)
}

fn timed<T>(backend: &Backend, body: impl FnOnce() -> Result<T, BenchError>) -> Result<Time, BenchError> {
    let run = || -> Result<f64, BenchError> {
        let start = Instant::now();
        // Dropping the result is not timed.
        let _made = body()?;
        Ok(start.elapsed().as_secs_f64() * 1e3)
    };
    let (wall, gpu) = match backend {
        Backend::Gpu(gpu) => gpu.timed(run)?,
        Backend::Cpu | Backend::Rule(_) | Backend::Workers(_) => (run()?, None),
    };
    Ok(Time { wall, gpu: gpu.map(|t| t.as_secs_f64() * 1e3) })
}

/// Memory of a volume that is also shown by pages, which are a copy of it, bytes.
const MOST_BYTES_BY_PAGES: u64 = 2 << 30;
/// Shorter runs are repeated, where that is worthwhile.
const SHORT_MS: f64 = 2000.0;
