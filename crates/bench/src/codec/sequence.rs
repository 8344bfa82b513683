//! What a moving camera costs: frames of an orbit with a stop in it, coded one after another.
//!
//! Codecs without prediction across time code every frame alone. The product's blocks are also predicted from the frame
//! before. AV1 is given the planes as one video each, every picture of which may refer to those before it and waits for
//! none behind it.

use std::collections::BTreeMap;
use std::sync::Arc;

use isinglass_core::camera::Camera;
use isinglass_core::codec::blocks::References;
use isinglass_core::codec::{self, Coding};
use isinglass_core::ids::FrameId;
use isinglass_core::image_error::compare;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_gpu::Renderer;
use serde::Serialize;

use super::contenders::{Contender, Way, ladder};
use super::layout::Part;
use super::measure::Judge;
use super::{CodecOptions, FRAME_RATE_HZ};
use crate::error::BenchError;
use crate::progress::Progress;
use crate::quality::black_srgb8;
use crate::scenes::SceneSource;

/// A camera that orbits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SequenceOptions {
    /// Its speed.
    pub degrees_per_second: f32,
    /// Frames, 30 a second.
    pub frames: u32,
    /// Whether it rests in the middle, for a fifth of the frames.
    pub stops: bool,
    /// Frames that are compared with the truth, at most.
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

    /// Whether frame `i` is seen from where the one before was.
    fn is_resting(&self, i: u32) -> bool {
        let (from, to) = self.rest();
        self.stops && from < i && i <= to
    }

    /// The last frame before the rest, and the last that rests.
    fn rest(&self) -> (u32, u32) {
        (self.frames * 2 / 5, self.frames * 3 / 5)
    }

    fn is_compared(&self, i: u32) -> bool {
        i.is_multiple_of(self.frames.div_ceil(self.compared.max(1)).max(1))
    }
}

/// What a moving camera costs with one codec at one setting.
#[derive(Clone, Debug, Serialize)]
pub struct SequenceRow {
    /// Name of the scene.
    pub scene: String,
    /// K of the rule.
    pub k: u8,
    /// The codec.
    pub codec: &'static str,
    /// Its settings.
    pub settings: String,
    /// Degrees a second.
    pub degrees_per_second: f32,
    /// Frames of the sequence.
    pub frames: u32,
    /// Mean bytes of a frame while the camera moves, the first frame among them.
    pub bytes_moving: f64,
    /// Mean bytes while it rests; none if it never does.
    pub bytes_resting: Option<f64>,
    /// Mean bytes of a frame that is coded alone, with the same setting.
    pub bytes_intra: f64,
    /// Megabits a second, rest included.
    pub mbit_s_at_30_hz: f64,
    /// Bytes of a moving frame less than those of one that is coded alone, percent.
    pub saving_percent: f64,
    /// Mean over compared frames, each at its own pose.
    pub dssim: f64,
    /// The same.
    pub psnr_db: f64,
    /// Bytes of every frame.
    pub bytes: Vec<usize>,
}

/// What a sequence is made of.
pub(super) struct Scene<'a> {
    pub(super) source: &'a SceneSource,
    pub(super) judge: &'a Judge<'a>,
    pub(super) options: &'a CodecOptions,
    pub(super) sequence: &'a SequenceOptions,
    pub(super) k: u8,
}

/// Codes frames one after another.
trait Coder {
    /// The next frame, number `i`. If it `is_kept`, what is decoded and what it costs alone are wanted.
    fn push(&mut self, i: u32, frame: &LayeredFrame, is_kept: bool) -> Result<(), BenchError>;

    /// All of it.
    fn finish(self: Box<Self>) -> Result<CodedSequence, BenchError>;
}

/// A setting by name, and what codes with it.
type NamedCoder<'a> = (String, Box<dyn Coder + 'a>);

#[derive(Default)]
struct CodedSequence {
    bytes: Vec<usize>,
    /// Of frames coded alone.
    intra: Vec<usize>,
    kept: BTreeMap<u32, LayeredFrame>,
}

/// Measures every contender that can be given a sequence, each at the middle of its settings.
pub(super) fn measure(
    scene: &Scene<'_>,
    renderer: &mut Renderer,
    contenders: &[Contender],
    progress: &mut Progress,
) -> Result<Vec<SequenceRow>, BenchError> {
    let mut coders: Vec<(&Contender, NamedCoder<'_>)> = Vec::new();
    for contender in contenders {
        coders.extend(coders_of(contender, scene.judge).into_iter().map(|coder| (contender, coder)));
    }
    let sequence = scene.sequence;
    let camera_at = |i: u32| -> Camera {
        let orbit = scene.options.subject.orbit.turned(sequence.turn(i));
        orbit.camera(scene.options.subject.intrinsics, &scene.judge.bounds)
    };
    let mut truths = BTreeMap::new();
    for i in 0..sequence.frames {
        progress
            .advance(0, &format!("{}: K = {}, frame {i} of {}", scene.source.name, scene.k, sequence.frames));
        let camera = camera_at(i);
        let is_kept = sequence.is_compared(i);
        if is_kept {
            truths.insert(i, black_srgb8(&renderer.render(&camera)?));
        }
        let mut frames: Vec<(_, LayeredFrame)> = Vec::new();
        for (contender, (_, coder)) in &mut coders {
            let layering = contender.layering();
            if frames.iter().all(|(of, _)| *of != layering) {
                // A frame is referred to by its number.
                let header = FrameHeader { frame: FrameId(i + 1), ..FrameHeader::alone(camera, scene.k) };
                frames.push((layering, renderer.generate(header, layering)?));
            }
            if let Some((_, frame)) = frames.iter().find(|(of, _)| *of == layering) {
                coder.push(i, frame, is_kept)?;
            }
        }
    }
    let mut rows = Vec::with_capacity(coders.len());
    for (contender, (settings, coder)) in coders {
        let coded = coder.finish()?;
        rows.push(row(scene, contender, settings, coded, &truths)?);
    }
    Ok(rows)
}

fn row(
    scene: &Scene<'_>,
    contender: &Contender,
    settings: String,
    coded: CodedSequence,
    truths: &BTreeMap<u32, Vec<u8>>,
) -> Result<SequenceRow, BenchError> {
    let size = scene.options.subject.intrinsics;
    let (mut dssim, mut psnr_db) = (Vec::new(), Vec::new());
    for (i, frame) in coded.kept {
        let Some(truth) = truths.get(&i) else { continue };
        let camera = frame.header.camera;
        let mut caster = scene.judge.backend.reprojector(Arc::new(frame), &scene.judge.bounds)?;
        let view = black_srgb8(&caster.raycast_with(&camera, &CastOptions::default())?);
        let error = compare(&view, truth, size.width as usize, size.height as usize, [0; 3])?;
        dssim.push(error.dssim);
        psnr_db.push(error.psnr_db);
    }
    let mean = |all: &[f64]| all.iter().sum::<f64>() / all.len().max(1) as f64;
    let of = |resting: bool| -> Vec<f64> {
        let all = coded.bytes.iter().zip(0..);
        all.filter(|(_, i)| scene.sequence.is_resting(*i) == resting).map(|(b, _)| *b as f64).collect()
    };
    let (moving, resting) = (of(false), of(true));
    let intra: Vec<f64> = coded.intra.iter().map(|b| *b as f64).collect();
    let all: Vec<f64> = coded.bytes.iter().map(|b| *b as f64).collect();
    Ok(SequenceRow {
        scene: scene.source.name.clone(),
        k: scene.k,
        codec: contender.name,
        settings,
        degrees_per_second: scene.sequence.degrees_per_second,
        frames: scene.sequence.frames,
        bytes_moving: mean(&moving),
        bytes_resting: (!resting.is_empty()).then(|| mean(&resting)),
        bytes_intra: mean(&intra),
        mbit_s_at_30_hz: mean(&all) * 8.0 * FRAME_RATE_HZ * 1e-6,
        saving_percent: 100.0 * (1.0 - mean(&moving) / mean(&intra)),
        dssim: mean(&dssim),
        psnr_db: mean(&psnr_db),
        bytes: coded.bytes,
    })
}

/// A contender with one setting, frame by frame alone; AV1 also with prediction.
fn coders_of<'a>(contender: &'a Contender, judge: &'a Judge<'_>) -> Vec<NamedCoder<'a>> {
    let (name, at) = match &contender.way {
        Way::Product(settings) => {
            let middle = settings.len() / 2;
            (settings.get(middle).map_or_else(String::new, |s| s.0.clone()), [middle; 3])
        }
        Way::Raw(compressor) => (compressor.setting().to_owned(), [0; 3]),
        Way::Planes(layout, codec) => {
            let num = codec.levels().len();
            let middle = Part::ALL.map(|part| (ladder(*layout, part, num).len() - 1).div_ceil(2));
            ("middle".to_owned(), middle)
        }
    };
    let alone = Alone { contender, judge, at, coded: CodedSequence::default() };
    let mut all: Vec<NamedCoder<'a>> = vec![(name.clone(), Box::new(alone))];
    if let Way::Product(settings) = &contender.way
        && let Some((_, coding @ Coding::Blocks(_))) = settings.get(at[0])
    {
        all.push((format!("{name}, inter"), Box::new(Predicted::new(*coding))));
    }
    #[cfg(feature = "rivals")]
    if contender.name == super::contenders::AVIF {
        all.push(("middle, inter".to_owned(), Box::new(video::Video::new(judge, at))));
    }
    all
}

/// Every frame alone.
struct Alone<'a> {
    contender: &'a Contender,
    judge: &'a Judge<'a>,
    /// Setting of each part.
    at: [usize; 3],
    coded: CodedSequence,
}

impl Coder for Alone<'_> {
    fn push(&mut self, i: u32, frame: &LayeredFrame, is_kept: bool) -> Result<(), BenchError> {
        let (bytes, decoded) = self.judge.code(self.contender, frame, self.at)?;
        self.coded.bytes.push(bytes);
        self.coded.intra.push(bytes);
        if is_kept {
            self.coded.kept.insert(i, decoded);
        }
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<CodedSequence, BenchError> {
        Ok(self.coded)
    }
}

/// The product's codec, every frame predicted from the one before.
struct Predicted {
    coding: Coding,
    /// What the receiver has.
    references: References,
    coded: CodedSequence,
}

impl Predicted {
    fn new(coding: Coding) -> Self {
        Self { coding, references: References::default(), coded: CodedSequence::default() }
    }
}

impl Coder for Predicted {
    fn push(&mut self, i: u32, frame: &LayeredFrame, is_kept: bool) -> Result<(), BenchError> {
        let before = self.references.newest().cloned();
        let (encoded, reference) = self.coding.encode(frame, before.as_deref())?;
        self.coded.bytes.push(encoded.num_bytes());
        if is_kept {
            let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
            self.coded.kept.insert(i, codec::assemble(&chunks, &self.references)?.to_frame());
            self.coded.intra.push(self.coding.encode(frame, None)?.0.num_bytes());
        }
        if let Some(reference) = reference {
            self.references.insert(reference);
        }
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<CodedSequence, BenchError> {
        Ok(self.coded)
    }
}

#[cfg(feature = "rivals")]
mod video {
    use super::super::av1::{Av1, Kind, Picture, QUANTIZERS, Stream};
    use super::super::contenders::{AVIF_SPEED, ladder};
    use super::super::layout::{Layout, Part};
    use super::super::raster::{ImageCodec, Raster};
    use super::*;

    /// Planes as videos.
    pub(super) struct Video<'a> {
        judge: &'a Judge<'a>,
        codec: Av1,
        at: [usize; 3],
        /// By part and plane.
        streams: [Vec<Stream>; 3],
        /// Planes of kept frames, by frame.
        planes: BTreeMap<u32, Kept>,
        bytes: Vec<usize>,
        intra: Vec<usize>,
    }

    struct Kept {
        header: FrameHeader,
        parts: [Vec<Option<Raster>>; 3],
    }

    impl<'a> Video<'a> {
        /// Settings of the parts as in a search.
        pub(super) fn new(judge: &'a Judge<'a>, at: [usize; 3]) -> Self {
            Self {
                judge,
                codec: Av1 { speed: AVIF_SPEED },
                at,
                streams: Default::default(),
                planes: BTreeMap::new(),
                bytes: Vec::new(),
                intra: Vec::new(),
            }
        }

        fn take(&mut self, part: usize, plane: usize, pictures: Vec<Picture>) {
            for picture in pictures {
                let i = picture.index as usize;
                if let Some(bytes) = self.bytes.get_mut(i) {
                    *bytes += picture.bytes;
                }
                if let Some(kept) = self.planes.get_mut(&(i as u32)) {
                    kept.parts[part][plane] = picture.decoded;
                }
            }
        }
    }

    impl Coder for Video<'_> {
        fn push(&mut self, i: u32, frame: &LayeredFrame, is_kept: bool) -> Result<(), BenchError> {
            self.bytes.push(0);
            let mut alone = 0;
            for (p, part) in Part::ALL.into_iter().enumerate() {
                let (divisor, level) = ladder(Layout::Weighted, part, QUANTIZERS.len())[self.at[p]];
                let rasters = Layout::Weighted.split(frame, part, self.codec.max_bits(), divisor);
                if self.streams[p].is_empty() {
                    let open = |r| Stream::new(r, AVIF_SPEED, QUANTIZERS[level], Kind::Sequence);
                    self.streams[p] = rasters.iter().map(open).collect::<Result<_, _>>()?;
                }
                if is_kept {
                    let none = || std::array::from_fn(|_| Vec::new());
                    let kept = Kept { header: frame.header, parts: none() };
                    self.planes.entry(i).or_insert(kept).parts[p] = vec![None; rasters.len()];
                    for raster in &rasters {
                        alone += self.judge.pool.install(|| self.codec.code(raster, level))?.bytes;
                    }
                }
                for (plane, raster) in rasters.iter().enumerate() {
                    let pictures = self.streams[p][plane].push(raster)?;
                    self.take(p, plane, pictures);
                }
            }
            if is_kept {
                self.intra.push(alone);
            }
            Ok(())
        }

        fn finish(mut self: Box<Self>) -> Result<CodedSequence, BenchError> {
            for part in 0..3 {
                for plane in 0..self.streams[part].len() {
                    let pictures = self.streams[part][plane].finish()?;
                    self.take(part, plane, pictures);
                }
            }
            let mut kept = BTreeMap::new();
            for (i, frame) in self.planes {
                let parts: Option<Vec<Vec<Raster>>> =
                    frame.parts.into_iter().map(|planes| planes.into_iter().collect()).collect();
                if let Some([color, opacity, depth]) = parts.as_deref() {
                    kept.insert(i, Layout::Weighted.join(frame.header, color, opacity, depth));
                }
            }
            Ok(CodedSequence { bytes: self.bytes, intra: self.intra, kept })
        }
    }
}

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
        assert_eq!((0..100).filter(|&i| sequence.is_compared(i)).count(), 4);
        let moving = SequenceOptions { stops: false, ..sequence };
        assert!((moving.turn(99) - 99.0).abs() < 1e-3 && (0..100).all(|i| !moving.is_resting(i)));
    }
}
