//! How close novel views come to full renderings, for each scene, layering rule, list length and turn.
//!
//! The truth is the full rendering from the turned camera. A row is the mean over a turn to either side. The ray cast
//! makes pictures of a layered frame, and so do the rival methods on request. For comparison, `last-image` is the
//! picture of the unturned camera, shown unchanged, as a viewer of pictures would.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;

use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::codec;
use isinglass_core::image_error::{ImageError, compare};
use isinglass_core::kernels::raycast::{CastOptions, Reconstruction};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_render::{Backend, BackendChoice};
use serde::Serialize;

use crate::choices::{MethodChoice, methods_by_rule, reconstruction_name};
use crate::error::LabError;
use crate::rivals::Method;
use crate::rules::Rule;
use isinglass_bench::progress::Progress;
use isinglass_bench::scenes::SceneSource;
use isinglass_bench::subject::{Subject, SubjectConditions, each_scene};

/// What to measure.
#[derive(Clone, Debug)]
pub struct QualityOptions {
    /// The subject; turns are to either side.
    pub subject: Subject,
    /// How frames are made.
    pub rules: Vec<Rule>,
    /// How frames become pictures. [`Method::LastImage`] is always measured, once per scene.
    pub methods: Vec<MethodChoice>,
    /// How the ray cast reads lists.
    pub reconstructions: Vec<Reconstruction>,
    /// Where the kernels run.
    pub backend: BackendChoice,
    /// Frame size: columns and rows of lists. The field of view is that of the pictures.
    pub frame_intrinsics: Intrinsics,
    /// Whether frames are also measured after encoding and decoding.
    pub measures_wire: bool,
}

impl QualityOptions {
    /// The rules that make frames of the subject's mode, with their methods.
    fn of_rules(&self) -> Vec<(Rule, Vec<Method>)> {
        methods_by_rule(&self.rules, &self.methods, self.subject.mode)
    }
}

/// The whole result.
#[derive(Clone, Debug, Serialize)]
pub struct QualityReport {
    /// The conditions of all rows.
    pub conditions: QualityConditions,
    /// One row for each scene, method, K, way of reading lists and turn.
    pub(crate) rows: Vec<QualityRow>,
}

/// The conditions of all rows in a report.
#[derive(Clone, Debug, Serialize)]
pub struct QualityConditions {
    /// The conditions of any table of pictures.
    #[serde(flatten)]
    pub subject: SubjectConditions,
    pub(crate) backend: String,
    pub(crate) frame_size: [u32; 2],
    /// Background of the pictures compared.
    pub(crate) background: &'static str,
}

/// Means over a turn to either side.
#[derive(Clone, Debug, Serialize)]
pub struct QualityRow {
    pub(crate) scene: String,
    /// Rule of the frame that was ray-cast, or the name of another [`Method`].
    pub(crate) method: String,
    /// Rule of the frame; none for `last-image`.
    pub(crate) layering: Option<&'static str>,
    /// Where the novel view was made: rivals run on the CPU; `None` for `last-image`.
    pub(crate) view_backend: Option<String>,
    /// How lists were read; none for what does not ray-cast.
    pub(crate) reconstruction: Option<&'static str>,
    /// K of the rule; 0 for `last-image`, 255 for unbounded lists.
    pub(crate) k: u8,
    pub(crate) angle_deg: f32,
    pub(crate) dssim: f64,
    pub(crate) dssim_object: f64,
    pub(crate) ssim: f64,
    pub(crate) psnr_db: f64,
    pub(crate) max_abs_255: u8,
    /// DSSIM of the frame after encoding and decoding; `None` for `last-image` and if it was not measured.
    pub(crate) dssim_wire: Option<f64>,
    pub(crate) generate_ms: Option<f64>,
    /// Time to prepare the frame for views, once.
    pub(crate) prepare_ms: Option<f64>,
    /// Time to cast it, or to draw it by another method.
    pub(crate) novel_view_ms: Option<f64>,
    pub(crate) bytes: Option<usize>,
    pub(crate) segments_mean: Option<f64>,
    pub(crate) segments_total: Option<usize>,
}

/// Measures. Takes minutes for the default scenes on the CPU.
pub fn run(options: &QualityOptions) -> Result<QualityReport, LabError> {
    options.methods.iter().try_for_each(|choice| choice.method.check_mode(options.subject.mode))?;
    let backend = Backend::open(options.backend)?;
    let of_rules = options.of_rules();
    let frames: usize = of_rules.iter().map(|(rule, _)| rule.ks(&options.subject.ks).len()).sum();
    let mut progress = Progress::new("quality", (options.subject.scenes.len() * (1 + frames)) as u64);
    let mut rows = Vec::new();
    let failures = each_scene(&options.subject.scenes, |source| {
        measure_scene(&backend, options, source, &mut rows, &mut progress)
    });
    progress.finish();
    let failed = failures.lines(rows.is_empty())?;
    Ok(QualityReport { conditions: conditions(options, &backend, failed), rows })
}

/// A table for people, in the order of measuring.
pub fn table(report: &QualityReport) -> String {
    let number = |x: Option<f64>, digits| x.map_or_else(|| "-".to_owned(), |x| format!("{x:.digits$}"));
    let mut text = format!(
        "{:<12} {:<21} {:<21} {:<7} {:>3} {:>6} {:>7} {:>7} {:>6} {:>4} {:>7} {:>8} {:>8} {:>8} {:>9} {:>6} {:>9}\n",
        "scene",
        "method",
        "of frame",
        "lists",
        "k",
        "turn",
        "dssim",
        "object",
        "psnr",
        "max",
        "wire",
        "gen ms",
        "prep ms",
        "view ms",
        "bytes",
        "seg",
        "seg all"
    );
    let count = |n: Option<usize>| n.map_or_else(|| "-".to_owned(), |n| n.to_string());
    for r in &report.rows {
        text += &format!(
            "{:<12} {:<21} {:<21} {:<7} {:>3} {:>5.0}° {:>7.4} {:>7.4} {:>6.1} {:>4} {:>7} {:>8} {:>8} {:>8} {:>9} {:>6} {:>9}\n",
            r.scene,
            r.method,
            r.layering.unwrap_or("-"),
            r.reconstruction.unwrap_or("-"),
            r.k,
            r.angle_deg,
            r.dssim,
            r.dssim_object,
            r.psnr_db,
            r.max_abs_255,
            number(r.dssim_wire, 4),
            number(r.generate_ms, 1),
            number(r.prepare_ms, 1),
            number(r.novel_view_ms, 1),
            count(r.bytes),
            number(r.segments_mean, 2),
            count(r.segments_total),
        );
    }
    text
}

/// Runs `body` and returns its result and milliseconds. A short first run is repeated and the lesser time counts,
/// because it may compile shaders or fill caches.
pub fn timed<T>(mut body: impl FnMut() -> Result<T, LabError>) -> Result<(T, f64), LabError> {
    let start = Instant::now();
    let mut result = body()?;
    let mut ms = start.elapsed().as_secs_f64() * 1e3;
    if ms < SHORT_MS {
        let start = Instant::now();
        result = body()?;
        ms = ms.min(start.elapsed().as_secs_f64() * 1e3);
    }
    Ok((result, ms))
}

fn conditions(options: &QualityOptions, backend: &Backend, failed: Vec<String>) -> QualityConditions {
    QualityConditions {
        subject: options.subject.conditions(rayon::current_num_threads(), failed),
        backend: backend.description(),
        frame_size: [options.frame_intrinsics.width, options.frame_intrinsics.height],
        background: "#000000",
    }
}

fn measure_scene(
    backend: &Backend,
    options: &QualityOptions,
    source: &SceneSource,
    rows: &mut Vec<QualityRow>,
    progress: &mut Progress,
) -> Result<(), LabError> {
    progress.begin(&format!("{}: opening", source.name));
    let opened = options.subject.open(source)?;
    let bounds = opened.scene.volume.bounds();
    let orbit = options.subject.orbit(&opened.scene.volume);
    let mut renderer = backend.renderer(opened.scene)?;
    let camera_at = |degrees: f32| orbit.turned(degrees).camera(options.subject.intrinsics, &bounds);

    // The truth, by the bits of the angle.
    let mut truth = BTreeMap::new();
    let angles: BTreeSet<u32> = options
        .subject
        .angles_degrees
        .iter()
        .flat_map(|&a| sides(a))
        .chain([0.0])
        .map(f32::to_bits)
        .collect();
    for angle in angles {
        truth.insert(angle, black_srgb8(&renderer.render(&camera_at(f32::from_bits(angle)))?));
    }
    progress.advance(1, &format!("{}: truth rendered", source.name));
    for &angle in options.subject.angles_degrees.iter().filter(|a| **a != 0.0) {
        let mut mean = Mean::default();
        for side in sides(angle) {
            mean.add(&errors(&truth[&0f32.to_bits()], &truth[&side.to_bits()], &options.subject.intrinsics)?);
        }
        rows.push(mean.row(source, Method::LastImage.name(), 0, angle));
    }

    let truth = TruthPictures { camera_at: &camera_at, pictures: &truth, bounds: &bounds };
    for (rule, methods) in options.of_rules() {
        for k in rule.ks(&options.subject.ks) {
            let camera = orbit.camera(options.frame_intrinsics, &bounds);
            let (frame, generate_ms) = timed(|| rule.generate(&mut renderer, FrameHeader::alone(camera, k)))?;
            let made = Made::new(rule, k, frame, generate_ms)?;
            for &method in methods.iter().filter(|m| **m != Method::LastImage) {
                measure_method(backend, options, source, &made, method, &truth, rows)?;
            }
            progress.advance(1, &format!("{}: {rule} K = {k}", source.name));
        }
    }
    Ok(())
}

struct Made {
    rule: Rule,
    k: u8,
    frame: Arc<LayeredFrame>,
    /// The frame after encoding and decoding, and its bytes; `None` if no codec takes it.
    wire: Option<(Arc<LayeredFrame>, usize)>,
    generate_ms: f64,
}

impl Made {
    fn new(rule: Rule, k: u8, frame: LayeredFrame, generate_ms: f64) -> Result<Self, LabError> {
        let wire = if rule == Rule::AllSamples {
            None
        } else {
            let encoded = codec::encode(&frame)?;
            let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
            Some((Arc::new(codec::decode(&chunks)?), encoded.num_bytes()))
        };
        Ok(Self { rule, k, frame: Arc::new(frame), wire, generate_ms })
    }
}

struct TruthPictures<'a> {
    camera_at: &'a dyn Fn(f32) -> Camera,
    /// By the bits of the angle.
    pictures: &'a BTreeMap<u32, Vec<u8>>,
    bounds: &'a Aabb,
}

/// All turns of one method on one frame, for each way to read lists.
fn measure_method(
    backend: &Backend,
    options: &QualityOptions,
    source: &SceneSource,
    made: &Made,
    method: Method,
    truth: &TruthPictures<'_>,
    rows: &mut Vec<QualityRow>,
) -> Result<(), LabError> {
    // Unbounded lists may exceed a GPU's limits.
    let backend = if made.rule == Rule::AllSamples { &Backend::Cpu } else { backend };
    let prepare = |frame: &Arc<LayeredFrame>| method.prepare(backend, frame.clone(), truth.bounds);
    let (mut exact, prepare_ms) = timed(|| prepare(&made.frame))?;
    let decoded = made.wire.as_ref().filter(|_| options.measures_wire);
    let mut decoded = decoded.map(|(frame, _)| prepare(frame)).transpose()?;
    // Only the ray cast reads lists in more than one way.
    let reconstructions: Vec<Option<Reconstruction>> = match method {
        Method::Layers => options.reconstructions.iter().copied().map(Some).collect(),
        _ => vec![None],
    };
    let segments_mean = made.frame.segments_mean();
    for reconstruction in reconstructions {
        let cast =
            CastOptions { reconstruction: reconstruction.unwrap_or_default(), ..CastOptions::default() };
        for &angle in &options.subject.angles_degrees {
            let (mut mean, mut wire) = (Mean::default(), Mean::default());
            let (mut ms_sum, mut num) = (0.0, 0.0);
            for side in sides(angle) {
                let camera = (truth.camera_at)(side);
                let (view, ms) = timed(|| exact.view_with(&camera, &cast))?;
                let truth = &truth.pictures[&side.to_bits()];
                mean.add(&errors(&black_srgb8(&view), truth, &options.subject.intrinsics)?);
                if let Some(decoded) = &mut decoded {
                    let view = decoded.view_with(&camera, &cast)?;
                    wire.add(&errors(&black_srgb8(&view), truth, &options.subject.intrinsics)?);
                }
                (ms_sum, num) = (ms_sum + ms, num + 1.0);
            }
            rows.push(QualityRow {
                layering: Some(made.rule.name()),
                view_backend: Some(method.backend(backend).description()),
                reconstruction: reconstruction.map(reconstruction_name),
                dssim_wire: decoded.is_some().then(|| wire.mean(|e| e.dssim)),
                generate_ms: Some(made.generate_ms),
                prepare_ms: Some(prepare_ms),
                novel_view_ms: Some(ms_sum / num),
                bytes: made.wire.as_ref().map(|(_, bytes)| *bytes),
                segments_mean: Some(segments_mean),
                segments_total: Some(made.frame.num_segments()),
                ..mean.row(source, method.name_on(made.rule), made.k, angle)
            });
        }
    }
    Ok(())
}

/// A turn to either side; no turn is one view.
fn sides(angle: f32) -> Vec<f32> {
    if angle == 0.0 { vec![0.0] } else { vec![angle, -angle] }
}

/// On black, as 8-bit sRGB.
pub fn black_srgb8(picture: &Picture) -> Vec<u8> {
    picture.to_srgb8([0.0; 3])
}

fn errors(a: &[u8], b: &[u8], intrinsics: &Intrinsics) -> Result<ImageError, LabError> {
    Ok(compare(a, b, intrinsics.width as usize, intrinsics.height as usize, [0; 3])?)
}

#[derive(Default)]
struct Mean(Vec<ImageError>);

impl Mean {
    fn add(&mut self, errors: &ImageError) {
        self.0.push(*errors);
    }

    fn mean(&self, of: impl Fn(&ImageError) -> f64) -> f64 {
        self.0.iter().map(of).sum::<f64>() / self.0.len().max(1) as f64
    }

    fn row(&self, source: &SceneSource, method: &str, k: u8, angle_deg: f32) -> QualityRow {
        QualityRow {
            scene: source.name.clone(),
            method: method.to_owned(),
            layering: None,
            view_backend: None,
            reconstruction: None,
            k,
            angle_deg,
            dssim: self.mean(|e| e.dssim),
            dssim_object: self.mean(|e| e.dssim_object),
            ssim: self.mean(|e| e.ssim),
            psnr_db: self.mean(|e| e.psnr_db),
            max_abs_255: self.0.iter().map(|e| e.max_abs_255).max().unwrap_or(0),
            dssim_wire: None,
            generate_ms: None,
            prepare_ms: None,
            novel_view_ms: None,
            bytes: None,
            segments_mean: None,
            segments_total: None,
        }
    }
}

/// Shorter runs are repeated.
const SHORT_MS: f64 = 400.0;
