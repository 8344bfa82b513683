//! How long each stage of a frame's life takes, for each scene and backend.

use std::sync::Arc;
use std::time::Instant;

use isinglass_core::camera::Intrinsics;
use isinglass_core::codec;
use isinglass_core::kernels::layering::Layering;
use isinglass_formats::OpenOptions;
use isinglass_gpu::{Backend, BackendChoice};
use serde::Serialize;

use crate::error::BenchError;
use crate::progress::Progress;
use crate::quality::{header, march_settings};
use crate::rivals::Method;
use crate::scenes::{SceneSource, open_scene};
use crate::view::Orbit;

/// What to measure.
#[derive(Clone, Debug)]
pub struct SpeedOptions {
    /// The scenes, see [`crate::scenes::select`].
    pub scenes: Vec<SceneSource>,
    /// Preset or file for all scenes; none: the one that suits each.
    pub transfer: Option<String>,
    /// Backends to compare.
    pub backends: Vec<BackendChoice>,
    /// Layering rule.
    pub layering: Layering,
    /// How frames become pictures.
    pub method: Method,
    /// Longest list.
    pub k: u8,
    /// The generating camera.
    pub orbit: Orbit,
    /// The novel view is turned by so much azimuth.
    pub turn_degrees: f32,
    /// Picture and frame size, field of view.
    pub intrinsics: Intrinsics,
    /// Whether gradients shade.
    pub shaded: bool,
    /// Runs of which the median counts, after one that does not.
    pub repeats: u32,
}

/// The whole result.
#[derive(Clone, Debug, Serialize)]
pub struct SpeedReport {
    /// What holds for all rows.
    pub conditions: SpeedConditions,
    /// One for each scene and backend.
    pub rows: Vec<SpeedRow>,
}

/// What holds for all rows.
#[derive(Clone, Debug, Serialize)]
pub struct SpeedConditions {
    /// Version of this program.
    pub version: &'static str,
    /// Columns and rows.
    pub size: [u32; 2],
    /// Turn of the novel view, degrees.
    pub angle_deg: f32,
    /// Whether gradients shade.
    pub shading: bool,
    /// Runs of which the median counts.
    pub repeats: u32,
    /// Threads of the CPU.
    pub threads: usize,
}

/// Median milliseconds.
#[derive(Clone, Debug, Serialize)]
pub struct SpeedRow {
    /// Name of the scene.
    pub scene: String,
    /// Where the kernels ran.
    pub backend: String,
    /// Layering rule, or the rival method that drew the novel view.
    pub method: String,
    /// Longest list.
    pub k: u8,
    /// Full rendering, with its way back to the CPU.
    pub render_ms: f64,
    /// A layered frame, with its way back to the CPU.
    pub generate_ms: f64,
    /// Encoding it.
    pub encode_ms: f64,
    /// Decoding it.
    pub decode_ms: f64,
    /// Casting it, with the picture's way back to the CPU.
    pub novel_view_ms: f64,
    /// Bytes of the encoded frame.
    pub bytes: usize,
}

/// Measures.
pub fn run(options: &SpeedOptions) -> Result<SpeedReport, BenchError> {
    let mut progress = Progress::new("speed", (options.backends.len() * options.scenes.len()) as u64);
    let mut rows = Vec::new();
    for &choice in &options.backends {
        let backend = Backend::open(choice)?;
        for source in &options.scenes {
            rows.push(measure(&backend, options, source)?);
            progress.advance(1, &format!("{} on {}", source.name, backend.description()));
        }
    }
    progress.finish();
    let conditions = SpeedConditions {
        version: env!("CARGO_PKG_VERSION"),
        size: [options.intrinsics.width, options.intrinsics.height],
        angle_deg: options.turn_degrees,
        shading: options.shaded,
        repeats: options.repeats,
        threads: rayon::current_num_threads(),
    };
    Ok(SpeedReport { conditions, rows })
}

/// A table for people.
pub fn table(report: &SpeedReport) -> String {
    let mut text = format!(
        "{:<12} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}  {}\n",
        "scene", "render", "generate", "encode", "decode", "view", "bytes", "ms, on"
    );
    for r in &report.rows {
        text += &format!(
            "{:<12} {:>9.2} {:>9.2} {:>9.2} {:>9.2} {:>9.2} {:>9}  {}\n",
            r.scene,
            r.render_ms,
            r.generate_ms,
            r.encode_ms,
            r.decode_ms,
            r.novel_view_ms,
            r.bytes,
            r.backend
        );
    }
    text
}

fn measure(backend: &Backend, options: &SpeedOptions, source: &SceneSource) -> Result<SpeedRow, BenchError> {
    let settings = march_settings(options.shaded);
    let opened = open_scene(&source.source, options.transfer.as_deref(), settings, &OpenOptions::default())?;
    let bounds = opened.scene.volume.bounds();
    let mut renderer = backend.renderer(opened.scene)?;
    let camera = options.orbit.camera(options.intrinsics, &bounds);
    let turned = options.orbit.turned(options.turn_degrees).camera(options.intrinsics, &bounds);
    let header = header(camera, options.k);
    let settings = codec::Settings::default();
    let (_, render_ms) = median_ms(options.repeats, || Ok(renderer.render(&camera)?))?;
    let (frame, generate_ms) =
        median_ms(options.repeats, || Ok(renderer.generate(header, options.layering)?))?;
    let (encoded, encode_ms) = median_ms(options.repeats, || Ok(codec::encode(&frame, &settings)?))?;
    let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
    let (decoded, decode_ms) = median_ms(options.repeats, || Ok(codec::decode(&chunks)?))?;
    let mut views = options.method.prepare(backend, Arc::new(decoded), &bounds)?;
    let (_, novel_view_ms) = median_ms(options.repeats, || views.view(&turned))?;
    Ok(SpeedRow {
        scene: source.name.clone(),
        backend: backend.description(),
        method: options.method.name_with(options.layering).to_owned(),
        k: options.k,
        render_ms,
        generate_ms,
        encode_ms,
        decode_ms,
        novel_view_ms,
        bytes: encoded.num_bytes(),
    })
}

/// The result of a first run, and the median time of `repeats` more.
fn median_ms<T>(
    repeats: u32,
    mut body: impl FnMut() -> Result<T, BenchError>,
) -> Result<(T, f64), BenchError> {
    let result = body()?;
    let mut times = Vec::with_capacity(repeats as usize);
    for _ in 0..repeats.max(1) {
        let start = Instant::now();
        body()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_unstable_by(f64::total_cmp);
    Ok((result, times[times.len() / 2]))
}
