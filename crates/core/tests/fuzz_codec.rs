//! Can any bytes make the decoder do more than fail?
//!
//! A seeded fuzzer that knows the format: it takes valid chunks and flips bits, puts fields at their limits, splices parts of
//! different chunks, cuts and repeats, mostly with a header that agrees with the new length, so that the damage is met
//! deep in the payload. Frames that are predicted from others meet the ones they name, others of the same name, or none.
//! Whatever still decodes is assembled with the other chunks of its frame. Panics, memory beyond what the
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
    Assembly, Coding, EncodedFrame, HEADER_BYTES, MAX_CHUNK_SEGMENTS, MAX_FRAME_LISTS, Settings, assemble,
    decode_chunk, decode_whole, encode, peek, spent,
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
        for (color_bits, num_groups) in [(10, 2), (8, 1)] {
            let settings = Settings { color_bits, num_groups };
            seeds.push(alone(encode(&frame, &settings).expect("it can be encoded")));
        }
        let empty = LayeredFrame::empty(header);
        seeds.push(alone(encode(&empty, &Settings::default()).expect("valid bytes")));
        for is_split in [false, true] {
            let blocks = Coding::Blocks(blocks::Settings { is_split, ..blocks::Settings::of(60) });
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
                let field = random.of(&[5, 6, 7, 8, 10, 11, 24, 26]);
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
                bytes[HEADER_BYTES] = random.of(&[0, 1, 2, 3, 1, 3, 4, 5, 6, 7]);
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

/// How many inputs there were, how many of them decoded, how many of these with a reference, and how many made a frame with
/// the others of their own that needs no assembly.
struct Tally {
    inputs: u64,
    decoded: u64,
    predicted: u64,
    whole: u64,
}

/// Runs for so long or so many inputs from one seed.
fn fuzz(duration: Duration, most: u64, seed: u64) -> Tally {
    let (seeds, all) = seeds();
    let mut random = Random(seed);
    let start = Instant::now();
    let mut tally = Tally { inputs: 0, decoded: 0, predicted: 0, whole: 0 };
    let (mut slowest, mut largest) = (Duration::ZERO, 0);
    while tally.inputs < most && start.elapsed() < duration {
        let state = random.0;
        let (frame, bytes) = mutated(&seeds, &mut random);
        let seed = &seeds[frame];
        let references = references(seed, &all, &mut random);
        let before = ALLOCATED.load(Relaxed);
        MOST.store(before, Relaxed);
        let begin = Instant::now();
        let chunk = decode_chunk(&bytes, &references);
        let took = begin.elapsed();
        let used = MOST.load(Relaxed) - before;
        let _ = spent(&bytes, &references);
        tally.inputs += 1;
        let is_rate = peek(&bytes).is_ok_and(|header| header.is_rate());
        let bound = if is_rate { MAX_BLOCKS_BYTES } else { MAX_BYTES };
        assert!(used <= bound, "{used} bytes allocated, state {state:#x}");
        // A chunk of the most segments takes about a second; a machine under load may take many times as long.
        assert!(took < Duration::from_secs(60), "{took:?}, state {state:#x}");
        slowest = slowest.max(took);
        largest = largest.max(used);
        // In the place of the chunk it was: a whole frame is what is assembled, and fails where that does.
        let chunks = &seed.encoded.chunks;
        if let (Ok(header), true) = (peek(&bytes), chunks.iter().all(|chunk| chunk.is_base)) {
            let fellows =
                chunks.iter().filter(|other| other.index != header.index).map(|other| &other.bytes[..]);
            let fellows: Vec<_> = fellows.chain([&bytes[..]]).collect();
            let assembled = || assemble(&fellows, &seed.references).map(|assembly| assembly.to_frame());
            match decode_whole(&fellows, &mut None) {
                Ok(None) => {}
                Ok(Some(frame)) => {
                    assert!(assembled().is_ok_and(|assembled| assembled == frame), "state {state:#x}");
                    tally.whole += 1;
                }
                Err(_) => assert!(assembled().is_err(), "state {state:#x}"),
            }
        }
        let Ok(chunk) = chunk else { continue };
        tally.decoded += 1;
        tally.predicted += u64::from(is_rate && reference_named(&bytes).is_some());
        // In the place of the chunk it was, among its fellows, and alone.
        let mut alone = Assembly::new(chunk.header());
        let mut assembly = Assembly::new(&peek(&chunks[0].bytes).expect("valid bytes"));
        let _ = assembly.insert(chunk.clone());
        for other in chunks {
            let _ = assembly.insert(decode_chunk(&other.bytes, &seed.references).expect("valid bytes"));
        }
        alone.insert(chunk).expect("valid bytes");
        for assembly in [alone, assembly] {
            assembly.to_frame().validate().unwrap_or_else(|e| panic!("{e}, state {state:#x}"));
        }
    }
    let Tally { inputs, decoded, predicted, whole } = tally;
    eprintln!(
        "{inputs} inputs, {decoded} decoded, {predicted} of them with a reference, {whole} whole frames, slowest {slowest:?}, largest {largest} bytes"
    );
    tally
}

#[test]
fn some_mutations_find_nothing() {
    let Tally { inputs, decoded, predicted, whole } = fuzz(Duration::MAX, 5_000, 2);
    // Damage that is never met, or nothing but damage, would test nothing.
    assert!(predicted > 0 && predicted < decoded && decoded < inputs, "{predicted}, {decoded}, {inputs}");
    assert!(whole > 0 && whole < decoded, "{whole}, {decoded}");
}

/// `ISINGLASS_FUZZ_SECONDS`, 900 if it is not set, and `ISINGLASS_FUZZ_SEED`.
#[test]
#[ignore = "runs for a quarter of an hour"]
fn a_quarter_of_an_hour_of_mutations_finds_nothing() {
    let number = |name: &str, otherwise| std::env::var(name).map_or(otherwise, |v| v.parse().unwrap());
    let duration = Duration::from_secs(number("ISINGLASS_FUZZ_SECONDS", 900));
    fuzz(duration, u64::MAX, number("ISINGLASS_FUZZ_SEED", 3));
}

/// Most that decoding one chunk allocates at once: lengths of the lists, 12 bytes a segment, two rows of the widest frame
/// with the longest lists, each segment 20 bytes, 32 more for those of one row, growing by doubling, and a megabyte for
/// tables.
const MAX_BYTES: usize =
    MAX_FRAME_LISTS + 12 * MAX_CHUNK_SEGMENTS + 8192 * (2 * 34 * 20 + 3 * 32 * 32) + (1 << 20);
/// The same of a chunk in blocks: cells and layers as they are in memory, growing by doubling.
const MAX_BLOCKS_BYTES: usize = 1 << 30;
