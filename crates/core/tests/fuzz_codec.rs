//! Can any bytes make the decoder do more than fail?
//!
//! A seeded fuzzer that knows the format: it takes valid chunks and flips bits, puts fields at their limits, splices parts of
//! different chunks, cuts and repeats, mostly with a header that agrees with the new length, so that the damage is met
//! deep in the payload. Frames that are predicted from others meet the ones they name, others of the same name, or none.
//! A damaged chunk is decoded among the other chunks of its frame, or as if it were all of a frame. Panics, memory beyond what the
//! limits allow and inputs that take long are findings.

#[path = "common/fuzzing.rs"]
mod fuzzing;

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use fuzzing::{ALLOCATED, MOST, Random};
use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::blocks::{self, Reference, References, reference_named};
use isinglass_core::codec::{
    Coding, EncodedFrame, HEADER_BYTES, MAX_CHUNK_SEGMENTS, MAX_FRAME_LISTS, decode_with, encode, peek,
};
use isinglass_core::ids::FrameId;
use isinglass_core::layer::{FrameHeader, LayeredFrame, Segment};
use isinglass_core::space::Aabb;

/// A valid frame, and what it is predicted from.
struct Seed {
    encoded: EncodedFrame,
    references: References,
}

/// Frames of many shapes: sizes around those of a tile, empty, full, short and long lists, smooth and noisy; in blocks each
/// three times, turned a little, predicted from each other, the last one at rest. And all references there are: those of
/// one shape have the names of those of another.
fn seeds() -> (Vec<Seed>, Vec<Arc<Reference>>) {
    let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
    let mut random = Random(1);
    let (mut seeds, mut all) = (vec![], vec![]);
    for (width, height, k, noise) in [
        (17, 33, 8, 0),
        (20, 70, 4, 300),
        (5, 3, 32, 40),
        (64, 130, 1, 5),
        (1, 1, 2, 0),
        (33, 31, 3, 9000),
        (24, 260, 6, 100),
    ] {
        let intrinsics = Intrinsics::perspective(width, height, 0.6);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.5, 0.3, 5.0), intrinsics, &bounds);
        let header = FrameHeader::alone(camera, k);
        let mut frame = LayeredFrame::empty(header);
        for list in 0..intrinsics.num_pixels() {
            let (x, y) = (list % width as usize, list / width as usize);
            let mut last = x * 20 + y * 30 + random.below(noise + 1);
            for i in 0..(x + y + random.below(2)) % (usize::from(k) + 1) {
                let front = last + [0, 0, 1 + random.below(noise / 2 + 2)][i % 3];
                let back = front + 300 + random.below(noise + 1);
                let tau = 0.1 * (1 + random.below(9)) as f32;
                let c = Vec3::new(0.9, 0.5, 0.1 * random.below(9) as f32) * (1.0 - (-tau).exp());
                if back < 65_535 {
                    frame.push(&Segment { front: front as u16, back: back as u16, c, tau });
                    last = back;
                }
            }
            frame.offsets[list + 1] = frame.num_segments() as u32;
        }
        frame.validate().expect("it is valid");
        let alone = |encoded| Seed { encoded, references: References::default() };
        seeds.push(alone(encode(&frame).expect("it can be encoded")));
        let empty = LayeredFrame::empty(header);
        seeds.push(alone(encode(&empty).expect("valid bytes")));
        let blocks = Coding::Blocks(blocks::Settings::of(60));
        let mut references = References::default();
        let mut last = None;
        for (number, azimuth) in [(1, 0.5), (2, 0.52), (3, 0.54), (4, 0.54)] {
            frame.header.frame = FrameId(number);
            frame.header.camera =
                Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.3, 5.0), intrinsics, &bounds);
            let (encoded, reference) = blocks.encode(&frame, last.as_deref()).expect("valid bytes");
            seeds.push(Seed { encoded, references: references.clone() });
            last = reference;
            references.insert(last.clone().expect("blocks are a reference"));
            all.extend(last.clone());
        }
    }
    (seeds, all)
}

/// A chunk made from one of `seeds`, and which frame it came from.
fn mutated(seeds: &[Seed], random: &mut Random) -> (usize, Vec<u8>) {
    let frame = random.below(seeds.len());
    let chunk = |random: &mut Random, frame: usize| {
        let chunks = &seeds[frame].encoded.chunks;
        chunks[random.below(chunks.len())].bytes.clone()
    };
    let mut bytes = chunk(random, frame);
    for _ in 0..1 + random.below(4) {
        let len = bytes.len();
        // Half of the damage hits the header, the lengths and the first tables, a small part of the bytes.
        let reach = random.of(&[len, len, HEADER_BYTES + 100, HEADER_BYTES]).min(len);
        let at = random.below(reach);
        match random.below(12) {
            0..=2 if len > 0 => bytes[at] ^= 1 << random.below(8),
            3 if len > 0 => bytes[at] = random.of(&[0, 1, 0x7f, 0x80, 0xff]),
            4 if at + 4 <= len => {
                let value = random.of(&[
                    0,
                    1,
                    3,
                    4,
                    len as u32,
                    len.saturating_sub(HEADER_BYTES) as u32,
                    1 << 23,
                    1 << 31,
                    u32::MAX,
                ]);
                bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
            }
            // Sizes, k, numbers of chunks at their limits.
            5 if len >= HEADER_BYTES => {
                let field = random.of(&[5, 6, 7, 8, 10, 24, 26]);
                let value = random.of(&[0u16, 1, 2, 8, 10, 16, 17, 32, 33, 4080, 8192, 8193, u16::MAX]);
                let width = if field >= 24 { 2 } else { 1 };
                bytes[field..field + width].copy_from_slice(&value.to_le_bytes()[..width]);
            }
            6 => bytes.truncate(random.below(len + 1)),
            7 => {
                let other = random.below(seeds.len());
                let other = chunk(random, other);
                let anywhere = random.below(other.len());
                let from = random.of(&[at, anywhere]).min(other.len());
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..]);
            }
            8 => {
                let to = at + random.below(64).min(len - at);
                let run = bytes[at..to].to_vec();
                bytes.splice(at..at, run);
            }
            // Another reference, or one where none was.
            9 if len >= HEADER_BYTES + 5 => {
                bytes[HEADER_BYTES] = random.of(&[0, 1, 1, 2, 255]);
                bytes[HEADER_BYTES + 1..][..4].copy_from_slice(&(random.below(6) as u32).to_le_bytes());
            }
            // Cameras from which everything is far away, or nothing.
            10 if len >= HEADER_BYTES => {
                let field = 28 + 4 * random.below(10);
                let value = random.of(&[0.0f32, -0.0, 1e-30, 1e-3, 1.0, -3.0, 1e6, 1e30, f32::MAX, f32::NAN]);
                bytes[field..field + 4].copy_from_slice(&value.to_le_bytes());
            }
            // Bitmaps of more tiles.
            _ if len >= HEADER_BYTES => {
                let (byte, count) = (random.of(&[0, 0xff]), random.of(&[1, 8, 60, 16_320]));
                let run = vec![byte; count];
                bytes.splice(HEADER_BYTES..HEADER_BYTES, run);
            }
            _ => {}
        }
    }
    if bytes.len() >= HEADER_BYTES && random.below(8) > 0 {
        let payload = (bytes.len() - HEADER_BYTES) as u32;
        bytes[68..72].copy_from_slice(&payload.to_le_bytes());
    }
    // All of a frame.
    if bytes.len() >= HEADER_BYTES && random.below(3) == 0 {
        bytes[8..12].copy_from_slice(&[0, 0, 1, 0]);
    }
    (frame, bytes)
}

/// What a receiver may have: nothing, what the frame needs, or one to three of any.
fn references(seed: &Seed, all: &[Arc<Reference>], random: &mut Random) -> References {
    let mut some = References::default();
    match random.below(4) {
        0 => {}
        1 => (0..1 + random.below(3)).for_each(|_| some.insert(all[random.below(all.len())].clone())),
        _ => return seed.references.clone(),
    }
    some
}

/// How many inputs there were, how many of them decoded, and how many of these with a reference.
struct Tally {
    inputs: u64,
    decoded: u64,
    predicted: u64,
}

/// Runs for so long or so many inputs from one seed.
fn fuzz(duration: Duration, most: u64, seed: u64) -> Tally {
    let (seeds, all) = seeds();
    let mut random = Random(seed);
    let start = Instant::now();
    let mut tally = Tally { inputs: 0, decoded: 0, predicted: 0 };
    let (mut slowest, mut largest) = (Duration::ZERO, 0);
    while tally.inputs < most && start.elapsed() < duration {
        let state = random.0;
        let (frame, bytes) = mutated(&seeds, &mut random);
        let seed = &seeds[frame];
        let references = references(seed, &all, &mut random);
        // Among its fellows, where it says that it has some.
        let header = peek(&bytes);
        let fellows =
            seed.encoded.chunks.iter().filter(|other| {
                header.as_ref().is_ok_and(|own| own.num_chunks > 1 && own.index != other.index)
            });
        let chunks: Vec<&[u8]> = fellows.map(|other| &other.bytes[..]).chain([&bytes[..]]).collect();
        let before = ALLOCATED.load(Relaxed);
        MOST.store(before, Relaxed);
        let begin = Instant::now();
        let decoded = decode_with(&chunks, &references, None);
        let took = begin.elapsed();
        let used = MOST.load(Relaxed) - before;
        tally.inputs += 1;
        let bound = if header.is_ok_and(|header| !header.is_exact) { MAX_BLOCKS_BYTES } else { MAX_BYTES };
        assert!(used <= bound, "{used} bytes allocated, state {state:#x}");
        // A chunk of the most segments takes about a second; a machine under load may take many times as long.
        assert!(took < Duration::from_secs(60), "{took:?}, state {state:#x}");
        slowest = slowest.max(took);
        largest = largest.max(used);
        let Ok((frame, reference)) = decoded else { continue };
        tally.decoded += 1;
        tally.predicted += u64::from(reference.is_some() && reference_named(&bytes).is_some());
        frame.validate().unwrap_or_else(|e| panic!("{e}, state {state:#x}"));
    }
    let Tally { inputs, decoded, predicted } = tally;
    eprintln!(
        "{inputs} inputs, {decoded} decoded, {predicted} of them with a reference, slowest {slowest:?}, largest {largest} bytes"
    );
    tally
}

#[test]
fn some_mutations_find_nothing() {
    let Tally { inputs, decoded, predicted } = fuzz(Duration::MAX, 5_000, 2);
    // Damage that is never met, or nothing but damage, would test nothing.
    assert!(predicted > 0 && predicted < decoded && decoded < inputs, "{predicted}, {decoded}, {inputs}");
}

/// `ISINGLASS_FUZZ_SECONDS`, 900 if it is not set, and `ISINGLASS_FUZZ_SEED`.
#[test]
#[ignore = "runs for a quarter of an hour"]
fn a_quarter_of_an_hour_of_mutations_finds_nothing() {
    let number = |name: &str, otherwise| std::env::var(name).map_or(otherwise, |v| v.parse().unwrap());
    let duration = Duration::from_secs(number("ISINGLASS_FUZZ_SECONDS", 900));
    fuzz(duration, u64::MAX, number("ISINGLASS_FUZZ_SEED", 3));
}

/// Most bytes that decoding a frame with a damaged chunk allocates at once. Lists take 5 bytes each, and segments 12.
/// Two rows of the widest frame hold the longest lists, with 20 bytes for each segment. One row takes 32 more for each
/// segment, and doubles as it grows. Tables and other chunks take a megabyte.
const MAX_BYTES: usize =
    5 * MAX_FRAME_LISTS + 12 * MAX_CHUNK_SEGMENTS + 8192 * (2 * 34 * 20 + 3 * 32 * 32) + (1 << 20);
/// The same of a frame in blocks: cells and layers as they are in memory, growing by doubling, and then a frame.
const MAX_BLOCKS_BYTES: usize = (1 << 30) + 4 * MAX_FRAME_LISTS + 12 * MAX_CHUNK_SEGMENTS;
