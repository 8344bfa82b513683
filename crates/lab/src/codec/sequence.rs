//! What a moving camera costs: frames of an orbit with a stop in it, coded one after another.
//!
//! Codecs without prediction across time code every frame alone. The product's blocks are also predicted from the frame
//! before. AV1 is given the planes as one video each, every picture of which may refer to those before it and waits for
//! none behind it.

#[cfg(feature = "rivals")]
mod video;

use isinglass_core::camera::Camera;
use isinglass_core::codec::blocks::References;
use isinglass_core::codec::{self, Coding};
use isinglass_core::ids::FrameId;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_render::Renderer;
use rayon::ThreadPool;
use serde::Serialize;
use std::collections::BTreeMap;

use super::bd::{RatePoint, bd_rate};
use super::clock::timed;
use super::contenders::{Contender, Way, ladder};
use super::layout::Part;
use super::measure::{Distortion, Judge, Truth, distortion_of};
use super::{CodecOptions, FRAME_RATE_HZ};
use crate::error::LabError;
use crate::quality::black_srgb8;
use isinglass_bench::progress::Progress;
use isinglass_bench::scenes::SceneSource;

/// A camera that orbits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SequenceOptions {
    /// Its speed.
    pub degrees_per_second: f32,
    /// Frames, 30 a second.
    pub frames: u32,
    /// Whether it rests in the middle, for a fifth of the frames.
    pub stops: bool,
    /// Most frames that are compared with the truth; resting ones and the first do not count.
    pub compared: u32,
}

impl SequenceOptions {
    /// The turn of frame `i`, degrees.
    fn turn(&self, i: u32) -> f32 {
        let moves = if self.stops {
            let (from, to) = self.rest();
            i.min(from) + i.saturating_sub(to)
        } else {
            i
        };
        moves as f32 * self.degrees_per_second / FRAME_RATE_HZ as f32
    }

    /// Whether frame `i` has the camera of the previous one.
    fn is_resting(&self, i: u32) -> bool {
        let (from, to) = self.rest();
        self.stops && from < i && i <= to
    }

    /// The last frame before the rest, and the last that rests.
    fn rest(&self) -> (u32, u32) {
        (self.frames * 2 / 5, self.frames * 3 / 5)
    }

    /// Whether frame `i` has another camera than the previous one. The first does not count: a predicting codec codes
    /// it alone.
    fn is_moving(&self, i: u32) -> bool {
        i > 0 && !self.is_resting(i)
    }

    /// At the ends of equal parts of the sequence, so that the last frame is one.
    fn is_compared(&self, i: u32) -> bool {
        let parts = u64::from(self.compared.clamp(1, self.frames));
        let part_at = |i: u32| u64::from(i) * parts / u64::from(self.frames);
        part_at(i + 1) > part_at(i)
    }
}

/// The cost of a moving camera with one codec at one setting.
#[derive(Clone, Debug, Serialize)]
pub struct SequenceRow {
    pub(crate) scene: String,
    pub(crate) k: u8,
    pub(crate) codec: &'static str,
    pub(crate) settings: String,
    /// Whether frames are predicted from earlier ones.
    pub(crate) is_predicted: bool,
    pub(crate) degrees_per_second: f32,
    pub(crate) frames: u32,
    /// Mean bytes of a frame while the camera moves, without the first.
    pub(crate) bytes_moving: f64,
    /// Mean bytes while it rests; `None` if it never does.
    pub(crate) bytes_resting: Option<f64>,
    /// Mean bytes of the same frames, each coded alone with the same setting.
    pub(crate) bytes_intra: f64,
    /// Megabits per second, including the rest.
    pub(crate) mbit_s_at_30_hz: f64,
    /// Saving of a moving frame against one that is coded alone, percent.
    pub(crate) saving_percent: f64,
    /// Means over compared moving frames, each turned from its own pose; without the first.
    pub(crate) distortion: Vec<Distortion>,
    /// The one at 0°, if requested.
    pub(crate) dssim: Option<f64>,
    pub(crate) psnr_db: Option<f64>,
    /// Mean time to encode a frame that moves, on one thread; of blocks alone.
    pub(crate) encode_ms: Option<f64>,
    /// Mean time to decode one of those that are compared.
    pub(crate) decode_ms: Option<f64>,
    pub(crate) bytes: Vec<usize>,
}

/// The gain by prediction in moving frames, at the same quality.
#[derive(Clone, Debug, Serialize)]
pub struct SequenceBd {
    pub(crate) scene: String,
    pub(crate) k: u8,
    /// The codec, with prediction against itself without.
    pub(crate) codec: &'static str,
    /// Turn from the frames' own poses, degrees.
    pub(crate) angle_deg: f32,
    /// Mean difference of bytes at the same DSSIM, percent.
    pub(crate) bd_rate_percent: Option<f64>,
    /// Why there is none.
    pub(crate) refused: Option<String>,
}

pub(super) struct Scene<'a> {
    pub(super) source: &'a SceneSource,
    pub(super) judge: &'a Judge<'a>,
    pub(super) options: &'a CodecOptions,
    pub(super) sequence: &'a SequenceOptions,
    pub(super) k: u8,
}

/// Codes frames one after another.
trait Coder {
    /// Codes the next frame, number `i`. If it `is_kept`, the decoded frame is wanted, now or later.
    fn push(&mut self, i: u32, frame: &LayeredFrame, is_kept: bool)
    -> Result<Option<LayeredFrame>, LabError>;

    /// Whether decoded frames only come at the end.
    fn lags(&self) -> bool {
        false
    }

    fn finish(self: Box<Self>) -> Result<CodedSequence, LabError>;
}

/// A setting of a codec, and its coder.
struct Candidate<'a> {
    settings: String,
    is_predicted: bool,
    coder: Box<dyn Coder + 'a>,
    seen: Seen,
}

/// Means over the compared frames so far.
#[derive(Default)]
struct Seen {
    num: f64,
    distortion: Vec<Distortion>,
}

impl Seen {
    fn add(&mut self, of_frame: Vec<Distortion>) {
        self.num += 1.0;
        if self.distortion.is_empty() {
            self.distortion = of_frame;
            return;
        }
        for (mean, one) in self.distortion.iter_mut().zip(of_frame) {
            mean.dssim += (one.dssim - mean.dssim) / self.num;
            mean.dssim_object += (one.dssim_object - mean.dssim_object) / self.num;
            mean.psnr_db += (one.psnr_db - mean.psnr_db) / self.num;
            mean.novel_view_ms += (one.novel_view_ms - mean.novel_view_ms) / self.num;
        }
    }
}

/// Truths of compared frames by number, see [`Judge::truths`].
type Truths = BTreeMap<u32, Vec<Truth>>;

#[derive(Default)]
struct CodedSequence {
    bytes: Vec<usize>,
    /// Frames that a lagging coder has decoded.
    kept: BTreeMap<u32, LayeredFrame>,
    /// Times of every frame if they are taken, and of decoding those kept.
    encode_ms: Vec<f64>,
    decode_ms: Vec<f64>,
}

/// Measures every contender that can be given a sequence: blocks with settings from end to end, others with that in the
/// middle.
pub(super) fn measure(
    scene: &Scene<'_>,
    renderer: &mut Renderer,
    contenders: &[Contender],
    progress: &mut Progress,
) -> Result<Vec<SequenceRow>, LabError> {
    let mut coders: Vec<(&Contender, Candidate<'_>)> = Vec::new();
    for contender in contenders {
        coders.extend(coders_of(contender, scene.judge).into_iter().map(|coder| (contender, coder)));
    }
    let sequence = scene.sequence;
    let camera_at = |i: u32, angle: f32| -> Camera {
        let orbit = scene.judge.orbit.turned(sequence.turn(i) + angle);
        orbit.camera(scene.options.subject.intrinsics, &scene.judge.bounds)
    };
    let lags = coders.iter().any(|(_, candidate)| candidate.coder.lags());
    let mut truths: Truths = BTreeMap::new();
    for i in 0..sequence.frames {
        progress
            .advance(1, &format!("{}: K = {}, frame {i} of {}", scene.source.name, scene.k, sequence.frames));
        let camera = camera_at(i, 0.0);
        let is_kept = sequence.is_compared(i) && sequence.is_moving(i);
        if is_kept {
            for &angle in &scene.options.subject.angles_degrees {
                let camera = camera_at(i, angle);
                let truth = black_srgb8(&renderer.render(&camera)?);
                truths.entry(i).or_default().push((angle, camera, truth));
            }
        }
        let mut frames: Vec<(_, LayeredFrame)> = Vec::new();
        for (contender, Candidate { coder, seen, .. }) in &mut coders {
            let layering = contender.layering();
            if frames.iter().all(|(of, _)| *of != layering) {
                // A frame is referred to by its number.
                let header = FrameHeader { frame: FrameId(i + 1), ..FrameHeader::alone(camera, scene.k) };
                frames.push((layering, layering.generate(renderer, header)?));
            }
            if let Some((_, frame)) = frames.iter().find(|(of, _)| *of == layering) {
                let decoded = coder.push(i, frame, is_kept)?;
                if let (Some(decoded), Some(truths)) = (decoded, truths.get(&i)) {
                    seen.add(distortion_of(scene.judge.backend, &scene.judge.bounds, truths, decoded)?);
                }
            }
        }
        if !lags {
            // Pictures of all frames would be gigabytes.
            truths.clear();
        }
    }
    let mut rows: Vec<SequenceRow> = Vec::with_capacity(coders.len());
    for (contender, candidate) in coders {
        let row = row(scene, contender, candidate, rows.last(), &truths)?;
        rows.push(row);
    }
    Ok(rows)
}

/// A row, given the one before: see [`coders_of`].
fn row(
    scene: &Scene<'_>,
    contender: &Contender,
    Candidate { settings, is_predicted, coder, mut seen }: Candidate<'_>,
    before: Option<&SequenceRow>,
    truths: &Truths,
) -> Result<SequenceRow, LabError> {
    let sequence = scene.sequence;
    let coded = coder.finish()?;
    for (i, frame) in coded.kept {
        let Some(truths) = truths.get(&i) else { continue };
        seen.add(distortion_of(scene.judge.backend, &scene.judge.bounds, truths, frame)?);
    }
    let distortion = seen.distortion;
    let mean = |all: &[f64]| all.iter().sum::<f64>() / all.len().max(1) as f64;
    let mean_if_any = |all: &[f64]| (!all.is_empty()).then(|| mean(all));
    let of = |all: &[f64], is_wanted: &dyn Fn(u32) -> bool| -> Vec<f64> {
        all.iter().zip(0..).filter(|(_, i)| is_wanted(*i)).map(|(x, _)| *x).collect()
    };
    let floats = |bytes: &[usize]| -> Vec<f64> { bytes.iter().map(|b| *b as f64).collect() };
    let alone = before.filter(|_| is_predicted).map_or(&coded.bytes, |row| &row.bytes);
    let (all, alone) = (floats(&coded.bytes), floats(alone));
    let (is_moving, is_resting) = (|i| sequence.is_moving(i), |i| sequence.is_resting(i));
    let (bytes_moving, bytes_intra) = (mean(&of(&all, &is_moving)), mean(&of(&alone, &is_moving)));
    let at_own_pose = distortion.iter().find(|d| d.angle_deg == 0.0);
    Ok(SequenceRow {
        scene: scene.source.name.clone(),
        k: scene.k,
        codec: contender.name,
        settings,
        is_predicted,
        degrees_per_second: sequence.degrees_per_second,
        frames: sequence.frames,
        bytes_moving,
        bytes_resting: mean_if_any(&of(&all, &is_resting)),
        bytes_intra,
        mbit_s_at_30_hz: mean(&all) * 8.0 * FRAME_RATE_HZ * 1e-6,
        saving_percent: 100.0 * (1.0 - bytes_moving / bytes_intra),
        dssim: at_own_pose.map(|d| d.dssim),
        psnr_db: at_own_pose.map(|d| d.psnr_db),
        distortion,
        encode_ms: mean_if_any(&of(&coded.encode_ms, &is_moving)),
        decode_ms: mean_if_any(&coded.decode_ms),
        bytes: coded.bytes,
    })
}

/// What prediction gains, for every scene, K, codec and turn that rows were measured of, by the best of all settings on
/// either side.
pub(super) fn gains(rows: &[SequenceRow]) -> Vec<SequenceBd> {
    let mut gains: Vec<SequenceBd> = Vec::new();
    for row in rows.iter().filter(|row| row.is_predicted) {
        for angle_deg in row.distortion.iter().map(|d| d.angle_deg) {
            let is_there = |g: &SequenceBd| {
                (&*g.scene, g.k, g.codec, g.angle_deg) == (&*row.scene, row.k, row.codec, angle_deg)
            };
            if gains.iter().any(is_there) {
                continue;
            }
            let curve = |is_predicted: bool| {
                let of_curve = rows.iter().filter(|r| {
                    (&*r.scene, r.k, r.codec, r.is_predicted) == (&*row.scene, row.k, row.codec, is_predicted)
                });
                let points = of_curve.filter_map(|r| {
                    let seen = r.distortion.iter().find(|d| d.angle_deg == angle_deg)?;
                    Some(RatePoint { bytes: r.bytes_moving, dssim: seen.dssim })
                });
                points.collect::<Vec<_>>()
            };
            let gain = bd_rate(&curve(false), &curve(true));
            gains.push(SequenceBd {
                scene: row.scene.clone(),
                k: row.k,
                codec: row.codec,
                angle_deg,
                bd_rate_percent: gain.as_ref().ok().map(|bd| bd.percent),
                refused: gain.err().map(|e| e.to_string()),
            });
        }
    }
    gains
}

/// The codecs of a contender, each with one setting, frame by frame alone; blocks and AV1 also with prediction, each
/// behind what codes alone with the same setting.
fn coders_of<'a>(contender: &'a Contender, judge: &'a Judge<'_>) -> Vec<Candidate<'a>> {
    let alone = |settings: String, at: [usize; 3]| Candidate {
        settings,
        is_predicted: false,
        coder: Box::new(Alone { contender, judge, at, coded: CodedSequence::default() }),
        seen: Seen::default(),
    };
    match &contender.way {
        Way::Product(settings) => {
            let is_taken = |coding: &Coding| match coding {
                Coding::Blocks(of_blocks) => of_blocks.quality.is_multiple_of(SEQUENCE_STEP),
                Coding::Exact => false,
            };
            let mut all = Vec::new();
            for (name, coding) in settings.iter().filter(|(_, coding)| is_taken(coding)) {
                for (is_predicted, settings) in [(false, name.clone()), (true, format!("{name}, inter"))] {
                    let coder = Box::new(InBlocks::new(*coding, is_predicted, judge.pool));
                    all.push(Candidate { settings, is_predicted, coder, seen: Seen::default() });
                }
            }
            if all.is_empty() {
                let middle = settings.len() / 2;
                all.push(alone(settings.get(middle).map_or_else(String::new, |s| s.0.clone()), [middle; 3]));
            }
            all
        }
        Way::Raw(compressor) => vec![alone(compressor.setting().to_owned(), [0; 3])],
        Way::Planes(layout, codec) => {
            let num = codec.levels().len();
            let middle = Part::ALL.map(|part| (ladder(*layout, part, num, false).len() - 1).div_ceil(2));
            let of_planes = alone("middle".to_owned(), middle);
            #[cfg(feature = "rivals")]
            if contender.name == super::contenders::AVIF {
                let coder = Box::new(video::Video::new(middle));
                let settings = "middle, inter".to_owned();
                let video = Candidate { settings, is_predicted: true, coder, seen: Seen::default() };
                return vec![of_planes, video];
            }
            vec![of_planes]
        }
    }
}

/// Codes every frame alone.
struct Alone<'a> {
    contender: &'a Contender,
    judge: &'a Judge<'a>,
    at: [usize; 3],
    coded: CodedSequence,
}

impl Coder for Alone<'_> {
    fn push(
        &mut self,
        _: u32,
        frame: &LayeredFrame,
        is_kept: bool,
    ) -> Result<Option<LayeredFrame>, LabError> {
        let (bytes, decoded) = self.judge.code(self.contender, frame, self.at)?;
        self.coded.bytes.push(bytes);
        Ok(is_kept.then_some(decoded))
    }

    fn finish(self: Box<Self>) -> Result<CodedSequence, LabError> {
        Ok(self.coded)
    }
}

/// Codes blocks, each frame alone or predicted from the previous one.
struct InBlocks<'a> {
    coding: Coding,
    is_predicted: bool,
    pool: &'a ThreadPool,
    references: References,
    coded: CodedSequence,
}

impl<'a> InBlocks<'a> {
    fn new(coding: Coding, is_predicted: bool, pool: &'a ThreadPool) -> Self {
        let (references, coded) = (References::default(), CodedSequence::default());
        Self { coding, is_predicted, pool, references, coded }
    }
}

impl Coder for InBlocks<'_> {
    fn push(
        &mut self,
        _: u32,
        frame: &LayeredFrame,
        is_kept: bool,
    ) -> Result<Option<LayeredFrame>, LabError> {
        let before = self.references.newest().filter(|_| self.is_predicted).cloned();
        let encode = || timed(|| Ok(self.coding.encode(frame, before.as_deref())?));
        let ((encoded, reference), ms) = self.pool.install(encode)?;
        self.coded.bytes.push(encoded.num_bytes());
        self.coded.encode_ms.push(ms);
        let mut kept = None;
        if is_kept {
            let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
            let decode = || timed(|| Ok(codec::decode_with(&chunks, &self.references, None)?.0));
            let (decoded, ms) = self.pool.install(decode)?;
            kept = Some(decoded);
            self.coded.decode_ms.push(ms);
        }
        if let Some(reference) = reference {
            self.references.insert(reference);
        }
        Ok(kept)
    }

    fn finish(self: Box<Self>) -> Result<CodedSequence, LabError> {
        Ok(self.coded)
    }
}

/// Step between qualities of blocks.
const SEQUENCE_STEP: u8 = 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_orbit_moves_stops_and_moves_on() {
        let sequence = SequenceOptions { degrees_per_second: 30.0, frames: 100, stops: true, compared: 4 };
        let resting: Vec<u32> = (0..100).filter(|&i| sequence.is_resting(i)).collect();
        assert_eq!((resting.len(), resting[0], resting[19]), (20, 41, 60));
        for i in 1..100 {
            let step = sequence.turn(i) - sequence.turn(i - 1);
            // Differences of numbers of the order of 100 in single precision.
            assert!((step - if sequence.is_resting(i) { 0.0 } else { 1.0 }).abs() < 1e-4, "{i}: {step}");
        }
        // The first is not predicted by any codec.
        assert!((0..100).all(|i| sequence.is_moving(i) == (i > 0 && !resting.contains(&i))));
        for (frames, compared) in [(100, 4), (101, 2), (120, 8), (5, 2), (3, 1), (7, 7), (4, 9)] {
            let sequence = SequenceOptions { frames, compared, ..sequence };
            let all: Vec<u32> = (0..frames).filter(|&i| sequence.is_compared(i)).collect();
            assert_eq!(all.len() as u32, compared.min(frames), "of {frames}");
            // Something to be seen that moves.
            assert!(
                all.last() == Some(&(frames - 1)) && sequence.is_moving(frames - 1),
                "{all:?} of {frames}"
            );
            assert!(frames < 2 * compared || !sequence.is_compared(0));
        }
        let moving = SequenceOptions { stops: false, ..sequence };
        assert!((moving.turn(99) - 99.0).abs() < 1e-3 && (0..100).all(|i| !moving.is_resting(i)));
    }

    #[test]
    fn half_the_bytes_for_the_same_picture_is_a_gain_of_half_at_every_turn() {
        let row = |is_predicted: bool, bytes_moving: f64, dssim: [f64; 2]| SequenceRow {
            scene: "a".into(),
            k: 8,
            codec: "blocks",
            settings: String::new(),
            is_predicted,
            degrees_per_second: 30.0,
            frames: 3,
            bytes_moving,
            bytes_resting: None,
            // What is compared are curves of rows, not these.
            bytes_intra: 7.0,
            mbit_s_at_30_hz: 7.0,
            saving_percent: 7.0,
            distortion: [0.0, 10.0]
                .into_iter()
                .zip(dssim)
                .map(|(angle_deg, dssim)| Distortion {
                    angle_deg,
                    dssim,
                    dssim_object: dssim,
                    psnr_db: 30.0,
                    novel_view_ms: 1.0,
                })
                .collect(),
            dssim: None,
            psnr_db: None,
            encode_ms: None,
            decode_ms: None,
            bytes: vec![7; 3],
        };
        // At 10° the picture costs four times the bytes, by any curve.
        let curve = |is_predicted: bool, share: f64| {
            [1e3, 2e3, 4e3].map(|bytes| row(is_predicted, share * bytes, [10.0 / bytes, 40.0 / bytes]))
        };
        for (alone, predicted, percent) in [(1.0, 0.5, -50.0), (0.5, 1.0, 100.0), (1.0, 1.0, 0.0)] {
            let mut rows = curve(false, alone).to_vec();
            rows.extend(curve(true, predicted));
            // Rows of others change nothing.
            rows.extend(curve(true, 0.1).map(|row| SequenceRow { codec: "avif-planes", ..row }));
            rows.extend(curve(false, 0.1).map(|row| SequenceRow { k: 4, ..row }));
            let gains = gains(&rows);
            assert_eq!(gains.len(), 4, "two codecs at two turns");
            for gain in &gains[..2] {
                let found = gain.bd_rate_percent.unwrap();
                // Logarithms and powers of doubles.
                assert!((found - percent).abs() < 1e-9, "{found} at {}", gain.angle_deg);
            }
            assert_eq!((gains[0].angle_deg, gains[1].angle_deg), (0.0, 10.0));
            // Nothing without prediction to compare it with.
            assert!(gains[2..].iter().all(|g| g.bd_rate_percent.is_none() && g.refused.is_some()));
        }
        assert!(gains(&curve(false, 1.0)).is_empty());
    }
}
