//! Rate and distortion of codecs on the same layered frames.
//!
//! Distortion is what the viewer sees: the coded frame is ray-cast from turned cameras and compared with the full volume
//! rendering from there, so the loss of the layers counts as well as that of their coding. Each codec is given frames of
//! the rule it needs, its own transforms and a search of its settings ([`search`](self), [`layout`](self)); points that
//! others of the same codec beat do not count. Curves are compared by [`bd`].
//!
//! Coding runs on one thread, and times are those that it computed. The codecs of others are there in builds with the
//! feature `rivals` only: the product carries none of them.

#[cfg(feature = "rivals")]
mod av1;
pub mod bd;
mod clock;
mod contenders;
#[cfg(feature = "rivals")]
mod htj2k;
#[cfg(feature = "rivals")]
mod jpeg2000;
mod layout;
mod measure;
mod ours;
mod plot;
#[cfg(feature = "rivals")]
mod programs;
mod raster;
mod raw;
mod search;
mod sequence;
mod table;
#[cfg(test)]
mod tests;
mod times;
#[cfg(feature = "rivals")]
mod webp;

use std::collections::BTreeMap;
use std::time::Instant;

use crate::rules::Rule;
use isinglass_core::camera::Intrinsics;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_render::{Backend, BackendChoice};
use rayon::ThreadPool;
use serde::{Serialize, Serializer};

use self::bd::{RatePoint, bd_rate, front};
use self::contenders::{AS_PUBLISHED, Contender, PUBLISHED};
use self::measure::{Judge, Measured};
use crate::error::LabError;
use crate::quality::black_srgb8;
use isinglass_bench::progress::{Progress, note};
use isinglass_bench::scenes::SceneSource;
use isinglass_bench::subject::{Subject, SubjectConditions, each_scene};

pub use self::measure::Distortion;
pub use self::plot::svg;
pub use self::sequence::{SequenceBd, SequenceOptions, SequenceRow};
pub use self::table::table;
pub use self::times::{TimeOptions, TimeRow, Times};

/// What to measure.
#[derive(Clone, Debug)]
pub struct CodecOptions {
    /// What is looked at.
    pub subject: Subject,
    /// Names out of [`codec_names`]; none: all.
    pub codecs: Vec<String>,
    /// The codec that others are compared with, which is measured in any case; none: JPEG 2000 as published where that is
    /// measured, or else `blocks-planes`.
    pub anchor: Option<String>,
    /// Where frames are made and looked at.
    pub backend: BackendChoice,
    /// Sides of the frames in units of the pictures', over 0 and at most 1: every codec has the choice, but for those that
    /// are as published, and for a moving camera, where frames are as large as pictures.
    pub list_scales: Vec<f32>,
    /// Turns that frames in blocks are made to be seen at, degrees, none for all of them: blocks have the choice.
    pub turns_deg: Vec<Option<u8>>,
    /// Also code a moving camera; none: only stills.
    pub sequence: Option<SequenceOptions>,
    /// Also take times on several threads; none: only those of one thread.
    pub times: Option<TimeOptions>,
}

impl CodecOptions {
    /// Columns, rows and field of view of the frames.
    fn frame_intrinsics(&self) -> impl Iterator<Item = Intrinsics> {
        let picture = self.subject.intrinsics;
        self.list_scales.iter().map(move |scale| {
            let scaled = |side: u32| ((side as f32 * scale).round() as u32).max(1);
            Intrinsics { width: scaled(picture.width), height: scaled(picture.height), ..picture }
        })
    }

    /// Whether frames of so many lists are for a codec: what is as published has as many as the picture has pixels.
    fn takes(&self, contender: &Contender, lists: Intrinsics) -> bool {
        lists == self.subject.intrinsics || !contender.name.ends_with(AS_PUBLISHED)
    }
}

/// The whole result.
#[derive(Clone, Debug, Serialize)]
pub struct CodecReport {
    /// What holds for all points.
    pub conditions: CodecConditions,
    /// Frames that no codec has touched.
    pub uncoded: Vec<Uncoded>,
    /// Every setting that was measured: in JSON a row for each turn.
    #[serde(rename = "rows", serialize_with = "rows_of")]
    pub points: Vec<Point>,
    /// Codecs against the anchor, scene by scene.
    pub bd_rates: Vec<BdRow>,
    /// Means of [`CodecReport::bd_rates`] over scenes.
    pub bd_means: Vec<BdMean>,
    /// What a moving camera costs.
    pub sequences: Vec<SequenceRow>,
    /// What prediction gains there.
    pub sequence_gains: Vec<SequenceBd>,
    /// The product's times on several threads.
    pub times: Vec<TimeRow>,
}

/// What holds for all points of a report.
#[derive(Clone, Debug, Serialize)]
pub struct CodecConditions {
    /// What holds for any table of pictures; the threads are those that code.
    #[serde(flatten)]
    pub subject: SubjectConditions,
    /// Where frames were made and looked at.
    pub backend: String,
    /// Clock of the processor by which cycles are counted, megahertz; none where the system does not tell.
    pub clock_mhz: Option<f64>,
    /// The codec that others are compared with.
    pub anchor: Option<String>,
}

/// A frame that no codec has touched.
#[derive(Clone, Debug, Serialize)]
pub struct Uncoded {
    /// Name of the scene.
    pub scene: String,
    /// K of the rule.
    pub k: u8,
    /// The rule.
    pub layering: &'static str,
    /// Columns and rows of lists.
    pub lists: [u32; 2],
    /// Segments of the frame.
    pub segments: usize,
    /// Segments in a list, over lists that have any.
    pub segments_mean: f64,
    /// Time to make the frame.
    pub generate_ms: f64,
    /// From every turn.
    pub distortion: Vec<Distortion>,
}

/// A frame coded with one setting.
#[derive(Clone, Debug, Serialize)]
pub struct Point {
    /// Name of the scene.
    pub scene: String,
    /// K of the rule.
    pub k: u8,
    /// The codec.
    #[serde(rename = "method")]
    pub codec: &'static str,
    /// The rule of its frame.
    pub layering: &'static str,
    /// Columns and rows of lists.
    pub lists: [u32; 2],
    /// Segments in a list of the frame before it was coded, over lists that have any.
    pub segments_mean: f64,
    /// Time to make that frame.
    pub generate_ms: f64,
    /// Its settings.
    pub settings: String,
    /// Bytes of the coded frame.
    pub bytes: usize,
    /// Bytes of colour, opacity and depth, where they are coded apart.
    pub bytes_color_opacity_depth: Option<[usize; 3]>,
    /// Bits for each pixel of the picture.
    pub bits_per_pixel: f64,
    /// With 30 such frames a second, megabits.
    pub mbit_s_at_30_hz: f64,
    /// Time to encode, on one thread.
    pub encode_ms: f64,
    /// Time to decode; none where the encoder tells what a decoder gets.
    pub decode_ms: Option<f64>,
    /// The same for each pixel, nanoseconds.
    pub encode_ns_per_pixel: f64,
    /// Time to decode a pixel.
    pub decode_ns_per_pixel: Option<f64>,
    /// Cycles to encode a pixel at the clock of the conditions.
    pub encode_cycles_per_pixel: Option<f64>,
    /// Cycles to decode a pixel.
    pub decode_cycles_per_pixel: Option<f64>,
    /// From every turn.
    #[serde(skip)]
    pub distortion: Vec<Distortion>,
    /// Turns at which no other setting of the codec beats this one in bytes and DSSIM both, degrees.
    #[serde(skip)]
    pub on_front_deg: Vec<f32>,
}

/// A coded frame from one turn, as it is told in JSON.
#[derive(Serialize)]
struct Row<'a> {
    #[serde(flatten)]
    point: &'a Point,
    #[serde(flatten)]
    seen: &'a Distortion,
    /// Whether no other setting of the codec beats this one in bytes and DSSIM both.
    is_on_front: bool,
}

fn rows_of<S: Serializer>(points: &[Point], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(points.iter().flat_map(|point| {
        point.distortion.iter().map(move |seen| Row {
            point,
            seen,
            is_on_front: point.on_front_deg.contains(&seen.angle_deg),
        })
    }))
}

/// A codec against the anchor.
#[derive(Clone, Debug, Serialize)]
pub struct BdRow {
    /// Name of the scene.
    pub scene: String,
    /// K of both; none: each at whatever K is best for it at each rate.
    pub k: Option<u8>,
    /// The codec.
    pub codec: &'static str,
    /// Turn, degrees.
    pub angle_deg: f32,
    /// Mean difference of bytes at the same DSSIM, percent.
    pub bd_rate_percent: Option<f64>,
    /// The difference in the middle of the qualities that both reach, percent.
    pub middle_percent: Option<f64>,
    /// Over which qualities, decibels of DSSIM.
    pub range_db: Option<[f64; 2]>,
    /// Why there is no mean difference.
    pub refused: Option<String>,
}

/// Mean over scenes.
#[derive(Clone, Debug, Serialize)]
pub struct BdMean {
    /// See [`BdRow::k`].
    pub k: Option<u8>,
    /// The codec.
    pub codec: &'static str,
    /// Turn, degrees.
    pub angle_deg: f32,
    /// Mean of the scenes that have one, percent.
    pub bd_rate_percent: Option<f64>,
    /// Mean of the differences in the middle of the curves, percent.
    pub middle_percent: Option<f64>,
    /// Scenes with a mean difference.
    pub scenes: usize,
    /// Scenes without: curves that share no quality, or are none.
    pub refused: usize,
}

/// The names of the codecs of this build.
pub fn codec_names() -> Vec<&'static str> {
    contenders::all(&[None]).into_iter().map(|c| c.name).collect()
}

/// Measures. Takes minutes a scene.
pub fn run(options: &CodecOptions) -> Result<CodecReport, LabError> {
    let contenders = contenders_of(options)?;
    let anchor = anchor(options, &contenders);
    let backend = Backend::open(options.backend)?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(THREADS)
        .build()
        .map_err(|e| LabError::Rival { codec: "threads", cause: e.to_string() })?;
    let frames = options.sequence.as_ref().map_or(0, |sequence| sequence.frames as usize);
    let rounds = options.times.as_ref().map_or(0, |times| times.rounds as usize);
    let steps = 1 + options.subject.ks.len() * (1 + contenders.len() + frames + rounds);
    let mut progress = Progress::new("codec", (options.subject.scenes.len() * steps) as u64);
    let mut run = Run {
        options,
        backend: &backend,
        contenders: &contenders,
        pool: &pool,
        clock_mhz: clock::clock_mhz(),
        uncoded: Vec::new(),
        points: Vec::new(),
        sequences: Vec::new(),
        times: Vec::new(),
    };
    let failures = each_scene(&options.subject.scenes, |source| run.measure_scene(source, &mut progress));
    progress.finish();
    let Run { uncoded, mut points, sequences, times, clock_mhz, .. } = run;
    mark_fronts(&mut points, &options.subject.angles_degrees);
    let bd_rates = anchor.map(|anchor| compare(&points, anchor, options)).unwrap_or_default();
    let bd_means = means(&bd_rates);
    let conditions = CodecConditions {
        subject: options.subject.conditions(THREADS, failures.lines(uncoded.is_empty())?),
        backend: backend.description(),
        clock_mhz,
        anchor: anchor.map(str::to_owned),
    };
    let sequence_gains = sequence::gains(&sequences);
    Ok(CodecReport { conditions, uncoded, points, bd_rates, bd_means, sequences, sequence_gains, times })
}

/// The codecs that are asked for and the anchor. Those that cannot code the frames are left out with a note, or refused
/// where they were named.
fn contenders_of(options: &CodecOptions) -> Result<Vec<Contender>, LabError> {
    // An unknown name is refused even if all are measured.
    let anchor: Vec<String> = options.anchor.iter().cloned().collect();
    contenders::select(&anchor, &[None])?;
    let is_all = options.codecs.is_empty();
    let names = if is_all { vec![] } else { [&options.codecs[..], &anchor].concat() };
    let mut contenders = contenders::select(&names, &options.turns_deg)?;
    let mut leave_out = |is_fit: &dyn Fn(&Contender) -> bool, cause: String| {
        let unfit: Vec<&str> = contenders.iter().filter(|c| !is_fit(c)).map(|c| c.name).collect();
        match unfit.first() {
            Some(&codec) if !is_all => return Err(LabError::Rival { codec, cause }),
            Some(_) => note(&format!("left out: {}: {cause}", unfit.join(", "))),
            None => {}
        }
        contenders.retain(is_fit);
        Ok(())
    };
    let mode = options.subject.mode;
    if mode.is_projection() {
        leave_out(&Contender::takes_projections, format!("codes no frames of mode {mode}"))?;
    }
    let takes_any = |c: &Contender| options.frame_intrinsics().any(|lists| options.takes(c, lists));
    leave_out(&takes_any, "wants as many lists as pixels, expected 1 among the list scales".to_owned())?;
    Ok(contenders)
}

/// The name of what others are compared with; none if it is not measured.
fn anchor(options: &CodecOptions, contenders: &[Contender]) -> Option<&'static str> {
    let wanted = match &options.anchor {
        Some(wanted) => vec![&wanted[..]],
        None => vec![PUBLISHED, FALLBACK_ANCHOR],
    };
    wanted.iter().find_map(|wanted| contenders.iter().map(|c| c.name).find(|name| name == wanted))
}

/// What is there so far.
struct Run<'a> {
    options: &'a CodecOptions,
    backend: &'a Backend,
    contenders: &'a [Contender],
    pool: &'a ThreadPool,
    clock_mhz: Option<f64>,
    uncoded: Vec<Uncoded>,
    points: Vec<Point>,
    sequences: Vec<SequenceRow>,
    times: Vec<TimeRow>,
}

/// A frame of the generating camera.
struct Generated {
    layering: Rule,
    frame: LayeredFrame,
    segments_mean: f64,
    generate_ms: f64,
}

impl Run<'_> {
    fn measure_scene(&mut self, source: &SceneSource, progress: &mut Progress) -> Result<(), LabError> {
        let options = self.options;
        progress.begin(&format!("{}: opening", source.name));
        let opened = options.subject.open(source)?;
        let bounds = opened.scene.volume.bounds();
        let orbit = options.subject.orbit(&opened.scene.volume);
        let mut renderer = self.backend.renderer(opened.scene)?;
        let mut truths = Vec::with_capacity(options.subject.angles_degrees.len());
        for &angle in &options.subject.angles_degrees {
            let camera = orbit.turned(angle).camera(options.subject.intrinsics, &bounds);
            truths.push((angle, camera, black_srgb8(&renderer.render(&camera)?)));
        }
        let judge = Judge { backend: self.backend, bounds, orbit, truths, pool: self.pool };
        progress.advance(1, &format!("{}: truth rendered", source.name));
        for &k in &options.subject.ks {
            let mut frames: Vec<Generated> = Vec::new();
            for intrinsics in options.frame_intrinsics() {
                let camera = orbit.camera(intrinsics, &bounds);
                for contender in self.contenders.iter().filter(|c| options.takes(c, intrinsics)) {
                    let layering = contender.layering();
                    let is_made = |made: &Generated| {
                        made.layering == layering && made.frame.header.camera.intrinsics == intrinsics
                    };
                    if !frames.iter().any(is_made) {
                        let start = Instant::now();
                        let frame = layering.generate(&mut renderer, FrameHeader::alone(camera, k))?;
                        let generate_ms = start.elapsed().as_secs_f64() * 1e3;
                        let segments_mean = frame.segments_mean();
                        self.uncoded.push(Uncoded {
                            scene: source.name.clone(),
                            k,
                            layering: layering.name(),
                            lists: [intrinsics.width, intrinsics.height],
                            segments: frame.num_segments(),
                            segments_mean,
                            generate_ms,
                            distortion: judge.distortion(frame.clone())?,
                        });
                        frames.push(Generated { layering, frame, segments_mean, generate_ms });
                    }
                }
            }
            progress.advance(1, &format!("{}: frames made", source.name));
            for contender in self.contenders {
                progress.begin(&format!("{}: K = {k}, {}", source.name, contender.name));
                let layering = contender.layering();
                for made in frames.iter().filter(|made| made.layering == layering) {
                    if !options.takes(contender, made.frame.header.camera.intrinsics) {
                        continue;
                    }
                    let measured = judge.measure(contender, &made.frame)?;
                    let points = measured.into_iter().map(|m| self.point(source, k, contender, m, made));
                    let points: Vec<Point> = points.collect();
                    self.points.extend(points);
                }
                progress.advance(1, &format!("{}: K = {k}, {} done", source.name, contender.name));
            }
            if let Some(sequence) = &options.sequence {
                let rows = sequence::measure(
                    &sequence::Scene { source, judge: &judge, options, sequence, k },
                    &mut renderer,
                    self.contenders,
                    progress,
                )?;
                self.sequences.extend(rows);
            }
            if let Some(times) = &options.times {
                let rows = times::measure(times, options, source, &judge, k, &mut renderer, progress)?;
                self.times.extend(rows);
            }
        }
        Ok(())
    }

    fn point(
        &self,
        source: &SceneSource,
        k: u8,
        contender: &Contender,
        measured: Measured,
        made: &Generated,
    ) -> Point {
        let lists = made.frame.header.camera.intrinsics;
        let picture = self.options.subject.intrinsics;
        let pixels = picture.num_pixels() as f64;
        let of_lists = match lists == picture {
            true => String::new(),
            false => format!(", {}×{} lists", lists.width, lists.height),
        };
        let nanoseconds = |ms: f64| ms * 1e6 / pixels;
        // Milliseconds times megahertz are thousands of cycles.
        let cycles = |ms: f64| self.clock_mhz.map(|mhz| ms * mhz * 1e3 / pixels);
        let bits = measured.bytes as f64 * 8.0;
        Point {
            scene: source.name.clone(),
            k,
            codec: contender.name,
            layering: contender.layering().name(),
            lists: [lists.width, lists.height],
            segments_mean: made.segments_mean,
            generate_ms: made.generate_ms,
            settings: measured.settings + &of_lists,
            bytes: measured.bytes,
            bytes_color_opacity_depth: measured.parts,
            bits_per_pixel: bits / pixels,
            mbit_s_at_30_hz: bits * FRAME_RATE_HZ * 1e-6,
            encode_ms: measured.encode_ms,
            decode_ms: measured.decode_ms,
            encode_ns_per_pixel: nanoseconds(measured.encode_ms),
            decode_ns_per_pixel: measured.decode_ms.map(nanoseconds),
            encode_cycles_per_pixel: cycles(measured.encode_ms),
            decode_cycles_per_pixel: measured.decode_ms.and_then(cycles),
            distortion: measured.distortion,
            on_front_deg: Vec::new(),
        }
    }
}

impl Point {
    /// Rate and distortion at the turn number `turn`.
    fn rate_point(&self, turn: usize) -> RatePoint {
        RatePoint { bytes: self.bytes as f64, dssim: self.distortion[turn].dssim }
    }
}

/// Finds the fronts of every codec at each K.
fn mark_fronts(points: &mut [Point], angles: &[f32]) {
    let mut curves: BTreeMap<(String, u8, &str), Vec<usize>> = BTreeMap::new();
    for (i, p) in points.iter().enumerate() {
        curves.entry((p.scene.clone(), p.k, p.codec)).or_default().push(i);
    }
    for indices in curves.values() {
        for (turn, &angle) in angles.iter().enumerate() {
            let rates: Vec<RatePoint> = indices.iter().map(|&i| points[i].rate_point(turn)).collect();
            for on_front in front(&rates) {
                points[indices[on_front]].on_front_deg.push(angle);
            }
        }
    }
}

/// Every codec against the anchor: at each K, and with each at its best K.
fn compare(points: &[Point], anchor: &str, options: &CodecOptions) -> Vec<BdRow> {
    let mut codecs: Vec<&'static str> = Vec::new();
    for p in points {
        if !codecs.contains(&p.codec) && p.codec != anchor {
            codecs.push(p.codec);
        }
    }
    let best_k = (options.subject.ks.len() > 1).then_some(None);
    let mut rows = Vec::new();
    for source in &options.subject.scenes {
        for k in options.subject.ks.iter().copied().map(Some).chain(best_k) {
            let curve = |codec: &str, turn: usize| -> Vec<RatePoint> {
                points
                    .iter()
                    .filter(|p| p.scene == source.name && p.codec == codec && k.is_none_or(|k| p.k == k))
                    .map(|p| p.rate_point(turn))
                    .collect()
            };
            for &codec in &codecs {
                for (turn, &angle_deg) in options.subject.angles_degrees.iter().enumerate() {
                    let result = bd_rate(&curve(anchor, turn), &curve(codec, turn));
                    rows.push(BdRow {
                        scene: source.name.clone(),
                        k,
                        codec,
                        angle_deg,
                        bd_rate_percent: result.as_ref().ok().map(|bd| bd.percent),
                        middle_percent: result.as_ref().ok().map(|bd| bd.middle_percent),
                        range_db: result.as_ref().ok().map(|bd| bd.range_db),
                        refused: result.err().map(|e| e.to_string()),
                    });
                }
            }
        }
    }
    rows
}

fn means(rows: &[BdRow]) -> Vec<BdMean> {
    let mut means: Vec<BdMean> = Vec::new();
    for row in rows {
        let is_same = |m: &&BdMean| (m.k, m.codec, m.angle_deg) == (row.k, row.codec, row.angle_deg);
        if means.iter().any(|m| is_same(&m)) {
            continue;
        }
        let of = BdMean {
            k: row.k,
            codec: row.codec,
            angle_deg: row.angle_deg,
            bd_rate_percent: None,
            middle_percent: None,
            scenes: 0,
            refused: 0,
        };
        let same = rows.iter().filter(|r| (r.k, r.codec, r.angle_deg) == (of.k, of.codec, of.angle_deg));
        let scenes = same.clone().filter(|r| r.bd_rate_percent.is_some()).count();
        let mean = |percent: fn(&BdRow) -> Option<f64>| {
            let sum: f64 = same.clone().filter_map(percent).sum();
            (scenes > 0).then(|| sum / scenes as f64)
        };
        let [bd_rate_percent, middle_percent] = [mean(|r| r.bd_rate_percent), mean(|r| r.middle_percent)];
        let refused = same.clone().count() - scenes;
        means.push(BdMean { bd_rate_percent, middle_percent, scenes, refused, ..of });
    }
    means
}

/// What others are compared with in a build without [`PUBLISHED`].
const FALLBACK_ANCHOR: &str = "blocks-planes";
/// Frames a second that rates are given for.
const FRAME_RATE_HZ: f64 = 30.0;
/// That code: of the codecs of others not all can use more.
const THREADS: usize = 1;
