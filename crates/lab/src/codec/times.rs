//! Times of the product's codec on several threads, wall clock: a frame coded alone, and one predicted from the
//! previous one while the camera orbits.

use std::time::Instant;

use isinglass_core::codec::blocks::{self, References};
use isinglass_core::codec::{self, CodecError, Coding};
use isinglass_core::ids::FrameId;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_render::Renderer;
use rayon::ThreadPool;
use serde::Serialize;

use super::measure::Judge;
use super::{CodecOptions, FRAME_RATE_HZ};
use crate::error::LabError;
use isinglass_bench::progress::Progress;
use isinglass_bench::scenes::SceneSource;

/// The times to take.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TimeOptions {
    /// Numbers of threads.
    pub threads: Vec<usize>,
    /// Rounds of which the least time counts; everything takes turns.
    pub rounds: u32,
}

/// Times of one coding on this many threads.
#[derive(Clone, Debug, Serialize)]
pub struct TimeRow {
    pub(crate) scene: String,
    pub(crate) k: u8,
    pub(crate) settings: &'static str,
    pub(crate) threads: usize,
    /// A frame that is coded alone.
    pub(crate) intra: Times,
    /// The last of a few frames that are each predicted from the one before; none where the coding does not predict.
    pub(crate) inter: Option<Times>,
}

/// The cost of coding a frame: the least of all rounds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Times {
    /// Time to encode, wall-clock milliseconds.
    pub(crate) encode_ms: f64,
    /// Time to decode into a displayable frame.
    pub(crate) decode_ms: f64,
    pub(crate) bytes: usize,
}

/// Takes the times of every coding for every number of threads.
pub(super) fn measure(
    wanted: &TimeOptions,
    options: &CodecOptions,
    source: &SceneSource,
    judge: &Judge<'_>,
    k: u8,
    renderer: &mut Renderer,
    progress: &mut Progress,
) -> Result<Vec<TimeRow>, LabError> {
    let mut frames = Vec::with_capacity(FRAMES as usize);
    for i in 0..FRAMES {
        let turned = judge.orbit.turned((i as f64 * DEGREES_PER_SECOND / FRAME_RATE_HZ) as f32);
        let camera = turned.camera(options.subject.intrinsics, &judge.bounds);
        // A frame is referred to by its number.
        let header = FrameHeader { frame: FrameId(i + 1), ..FrameHeader::alone(camera, k) };
        frames.push(renderer.generate(header)?);
    }
    let mut pools: Vec<ThreadPool> = Vec::with_capacity(wanted.threads.len());
    for &threads in &wanted.threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pools.push(pool.map_err(|e| LabError::Rival { codec: "threads", cause: e.to_string() })?);
    }
    let mut rows: Vec<TimeRow> = Vec::new();
    for round in 0..wanted.rounds {
        progress.advance(
            1,
            &format!("{}: K = {k}, times, round {} of {}", source.name, round + 1, wanted.rounds),
        );
        let mut at = 0;
        for (settings, coding) in CODINGS {
            for (pool, &threads) in pools.iter().zip(&wanted.threads) {
                let (intra, inter) = pool.install(|| sequence(&coding, &frames))?;
                if round == 0 {
                    rows.push(TimeRow { scene: source.name.clone(), k, settings, threads, intra, inter });
                } else {
                    let row = &mut rows[at];
                    row.intra = row.intra.least(intra);
                    row.inter = row.inter.zip(inter).map(|(a, b)| a.least(b));
                }
                at += 1;
            }
        }
    }
    Ok(rows)
}

/// The first frame alone, and the last predicted, where there is prediction.
fn sequence(coding: &Coding, frames: &[LayeredFrame]) -> Result<(Times, Option<Times>), CodecError> {
    let mut references = References::default();
    let mut all = Vec::with_capacity(frames.len());
    let mut spare = None;
    for frame in frames {
        let before = references.newest().cloned();
        let start = Instant::now();
        let (encoded, reference) = coding.encode(frame, before.as_deref())?;
        let encode_ms = start.elapsed().as_secs_f64() * 1e3;
        let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
        let start = Instant::now();
        let (decoded, _) = codec::decode_with(&chunks, &references, spare)?;
        let decode_ms = start.elapsed().as_secs_f64() * 1e3;
        // A client does the same.
        spare = Some(decoded);
        all.push(Times { encode_ms, decode_ms, bytes: encoded.num_bytes() });
        match reference {
            Some(reference) => references.insert(reference),
            None => break,
        }
    }
    Ok((all[0], all.get(1..).and_then(<[Times]>::last).copied()))
}

impl Times {
    fn least(self, other: Self) -> Self {
        Self {
            encode_ms: self.encode_ms.min(other.encode_ms),
            decode_ms: self.decode_ms.min(other.decode_ms),
            bytes: self.bytes,
        }
    }
}

const DEGREES_PER_SECOND: f64 = 30.0;
/// Frames of the orbit: one alone, and predicted ones until the number of kept planes has settled.
const FRAMES: u32 = 4;
const CODINGS: [(&str, Coding); 3] =
    [("blocks, quality 45", in_blocks(45)), ("blocks, quality 90", in_blocks(90)), ("exact", Coding::Exact)];

const fn in_blocks(quality: u8) -> Coding {
    Coding::Blocks(blocks::Settings::of(quality))
}
