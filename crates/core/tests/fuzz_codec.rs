//! Can any bytes make the decoder do more than fail?
//!
//! A seeded fuzzer that knows the format: it takes valid chunks and flips bits, puts fields at their limits, splices parts of
//! different chunks, cuts and repeats, mostly with a header that agrees with the new length, so that the damage is met
//! deep in the payload. Whatever still decodes is assembled with the other chunks of its frame. Panics, memory beyond what the
//! limits allow and inputs that take long are findings.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::blocks::{self, References};
use isinglass_core::codec::{
    Assembly, Coding, EncodedFrame, HEADER_BYTES, MAX_CHUNK_SEGMENTS, MAX_FRAME_LISTS, Settings,
    bytes_by_plane, decode_chunk, encode, peek,
};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::layer::{FrameHeader, LayeredFrame, Segment};
use isinglass_core::space::Aabb;

/// Counts what is allocated.
struct Counting;

static ALLOCATED: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

#[expect(unsafe_code, reason = "an allocator cannot be written otherwise")]
// SAFETY: the system's allocator does all of it; this counts.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = ALLOCATED.fetch_add(layout.size(), Relaxed) + layout.size();
        MOST.fetch_max(now, Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        ALLOCATED.fetch_sub(layout.size(), Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n.max(1) as u64) as usize
    }

    fn of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len())]
    }
}

/// Frames of many shapes: sizes around those of a tile, empty, full, short and long lists, smooth and noisy.
fn seeds() -> Vec<EncodedFrame> {
    let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
    let mut random = Random(1);
    let mut seeds = vec![];
    for (width, height, k, noise) in
        [(17, 33, 8, 0), (20, 70, 4, 300), (5, 3, 32, 40), (64, 130, 1, 5), (1, 1, 2, 0), (33, 31, 3, 9000)]
    {
        let intrinsics = Intrinsics { width, height, fov_y: 0.6 };
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.5, 0.3, 5.0), intrinsics, &bounds);
        let header = FrameHeader { frame: FrameId(1), pose: PoseId(2), look: LookVersion(3), camera, k };
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
        for (color_bits, num_groups) in [(10, 2), (8, 1)] {
            seeds.push(encode(&frame, &Settings { color_bits, num_groups }).expect("it can be encoded"));
        }
        seeds.push(encode(&LayeredFrame::empty(header), &Settings::default()).expect("valid bytes"));
        for is_split in [false, true] {
            let blocks = Coding::Blocks(blocks::Settings { quality: 60, is_split });
            seeds.push(blocks.encode(&frame, None).expect("valid bytes").0);
        }
    }
    seeds
}

/// A chunk made from one of `seeds`, and which frame it came from.
fn mutated(seeds: &[EncodedFrame], random: &mut Random) -> (usize, Vec<u8>) {
    let frame = random.below(seeds.len());
    let chunk = |random: &mut Random, frame: usize| {
        let chunks = &seeds[frame].chunks;
        chunks[random.below(chunks.len())].bytes.clone()
    };
    let mut bytes = chunk(random, frame);
    for _ in 0..1 + random.below(4) {
        let len = bytes.len();
        // Half of the damage hits the header, the lengths and the first tables, a small part of the bytes.
        let reach = random.of(&[len, len, HEADER_BYTES + 100, HEADER_BYTES]).min(len);
        let at = random.below(reach);
        match random.below(10) {
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

/// Runs for so long or so many inputs from one seed: inputs, and those of them that decoded.
fn fuzz(duration: Duration, most: u64, seed: u64) -> (u64, u64) {
    let seeds = seeds();
    let none = References::default();
    let mut random = Random(seed);
    let start = Instant::now();
    let (mut inputs, mut decoded, mut slowest, mut largest) = (0, 0, Duration::ZERO, 0);
    while inputs < most && start.elapsed() < duration {
        let state = random.0;
        let (frame, bytes) = mutated(&seeds, &mut random);
        let before = ALLOCATED.load(Relaxed);
        MOST.store(before, Relaxed);
        let begin = Instant::now();
        let chunk = decode_chunk(&bytes, &none);
        let took = begin.elapsed();
        let used = MOST.load(Relaxed) - before;
        let _ = bytes_by_plane(&bytes);
        inputs += 1;
        let is_rate = peek(&bytes).is_ok_and(|header| header.is_rate());
        let bound = if is_rate { MAX_BLOCKS_BYTES } else { MAX_BYTES };
        assert!(used <= bound, "{used} bytes allocated, state {state:#x}");
        // A chunk of the most segments takes about a second; a machine under load may take many times as long.
        assert!(took < Duration::from_secs(60), "{took:?}, state {state:#x}");
        slowest = slowest.max(took);
        largest = largest.max(used);
        let Ok(chunk) = chunk else { continue };
        decoded += 1;
        // In the place of the chunk it was, among its fellows, and alone.
        let mut alone = Assembly::new(chunk.header());
        let mut assembly = Assembly::new(&peek(&seeds[frame].chunks[0].bytes).expect("valid bytes"));
        let _ = assembly.insert(chunk.clone());
        for other in &seeds[frame].chunks {
            let _ = assembly.insert(decode_chunk(&other.bytes, &none).expect("valid bytes"));
        }
        alone.insert(chunk).expect("valid bytes");
        for assembly in [alone, assembly] {
            assembly.to_frame().validate().unwrap_or_else(|e| panic!("{e}, state {state:#x}"));
        }
    }
    eprintln!("{inputs} inputs, {decoded} decoded, slowest {slowest:?}, largest {largest} bytes");
    (inputs, decoded)
}

#[test]
fn some_mutations_find_nothing() {
    let (inputs, decoded) = fuzz(Duration::MAX, 5_000, 2);
    // Damage that is never met, or nothing but damage, would test nothing.
    assert!(decoded > 0 && decoded < inputs, "{decoded} of {inputs}");
}

/// `ISINGLASS_FUZZ_SECONDS`, 900 if it is not set, and `ISINGLASS_FUZZ_SEED`.
#[test]
#[ignore = "runs for a quarter of an hour"]
fn a_quarter_of_an_hour_of_mutations_finds_nothing() {
    let number = |name: &str, otherwise| std::env::var(name).map_or(otherwise, |v| v.parse().unwrap());
    let duration = Duration::from_secs(number("ISINGLASS_FUZZ_SECONDS", 900));
    fuzz(duration, u64::MAX, number("ISINGLASS_FUZZ_SEED", 3));
}

/// Most that decoding one chunk allocates at once: lengths of the lists, 12 bytes a segment, and a megabyte for
/// tables and two rows of the widest frame with the longest lists.
const MAX_BYTES: usize = MAX_FRAME_LISTS + 12 * MAX_CHUNK_SEGMENTS + 2 * 8192 * 32 * 16 + (1 << 20);
/// The same of a chunk in blocks: cells and layers as they are in memory, growing by doubling.
const MAX_BLOCKS_BYTES: usize = 1 << 30;
