use glam::Vec3;

use super::super::{CodecError, MAX_CHUNK_SEGMENTS, MAX_CHUNKS, decode, decode_with, encode, peek};
use super::scale::scale;
use super::*;
use crate::camera::{Camera, Intrinsics, Pose};
use crate::codec::HEADER_BYTES;
use crate::codec::blocks::{self, References};
use crate::ids::{ChunkIndex, FrameId, LookVersion, PoseId};
use crate::image_error;
use crate::kernels::layering::generate;
use crate::kernels::march::{MarchSettings, Scene};
use crate::layer::{Fineness, FrameHeader, Over, Segment, TAU_MAX};
use crate::space::Aabb;
use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use crate::volume::procedural::Builtin;

mod hostile;

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
        (self.next() % n as u64) as usize
    }

    fn unit(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u64 << 24) as f32
    }
}

fn header(width: u32, height: u32, k: u8) -> FrameHeader {
    let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
    let intrinsics = Intrinsics::perspective(width, height, 0.6);
    let pose = Pose::orbit(Vec3::ZERO, 0.5, 0.3, bounds.radius() * intrinsics.fit_distance());
    let camera = Camera::new(pose, intrinsics, &bounds);
    FrameHeader {
        frame: FrameId(7),
        pose: PoseId(8),
        look: LookVersion(9),
        camera,
        k,
        mode: Default::default(),
        fineness: Default::default(),
    }
}

/// Lists of every length, contiguous and with gaps, thin and thick, τ from 1e-4 to 1000 and colours up to one. A
/// quarter of the tiles stays empty.
fn random_frame(width: u32, height: u32, k: u8, seed: u64) -> LayeredFrame {
    let mut random = Random(seed);
    // The longest lists fit the 16 bits of a depth.
    let reach = 2000 * 16 / usize::from(k).max(16);
    let mut frame = LayeredFrame::empty(header(width, height, k));
    for list in 0..(width * height) as usize {
        let tile = list / width as usize / TILE + list % width as usize / TILE;
        let len = if tile % 4 == 3 { 0 } else { random.below(usize::from(k) + 1) };
        let mut depth = random.below(2000);
        for _ in 0..len {
            let front = depth + [0, random.below(reach * 3 / 4)][random.below(2)];
            let back = front + 1 + [0, random.below(reach)][random.below(2)];
            let tau = 10f32.powf(random.unit() * 7.0 - 4.0);
            let alpha = 1.0 - (-tau).exp();
            let c = Vec3::new(random.unit(), random.unit(), random.unit()) * alpha;
            frame.push(&Segment { front: front as u16, back: back as u16, c, tau });
            depth = back;
        }
        frame.offsets[list + 1] = frame.num_segments() as u32;
    }
    frame.validate().unwrap();
    frame
}

fn full_frame(width: u32, height: u32, k: u8) -> LayeredFrame {
    let mut frame = LayeredFrame::empty(header(width, height, k));
    for list in 0..(width * height) as usize {
        for i in 0..u16::from(k) {
            frame.push(&Segment { front: i, back: i + 1, c: Vec3::ONE, tau: TAU_MAX });
        }
        frame.offsets[list + 1] = frame.num_segments() as u32;
    }
    frame
}

/// The frame without what it has in its first rows of lists.
fn without_top(mut frame: LayeredFrame, num_rows: usize) -> LayeredFrame {
    let above = frame.offsets[num_rows * frame.header.camera.intrinsics.width as usize];
    for offset in &mut frame.offsets {
        *offset = offset.saturating_sub(above);
    }
    for plane in [&mut frame.depth, &mut frame.c_rg, &mut frame.c_b_tau] {
        plane.drain(..above as usize);
    }
    frame
}

/// A built-in volume of 48³ voxels through a smooth transfer function.
pub(in crate::codec) fn soft() -> TransferFunction {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    TransferFunction {
        name: "soft".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Radius(1.0),
        points: vec![
            p(0.1, [0.2, 0.3, 0.8], 0.0),
            p(0.5, [0.9, 0.6, 0.3], 0.9),
            p(1.0, [1.0, 0.9, 0.7], 0.999),
        ],
    }
}

pub(in crate::codec) fn soft_scene(builtin: Builtin) -> Scene {
    Scene::new(builtin.volume(48).into(), &soft(), MarchSettings::default())
}

fn marched_frame(builtin: Builtin, size: u32) -> LayeredFrame {
    generate(&soft_scene(builtin), header(size, size, 8))
}

fn bytes(encoded: &EncodedFrame) -> Vec<&[u8]> {
    encoded.chunks.iter().map(|c| &c.bytes[..]).collect()
}

fn round_trip(frame: &LayeredFrame) -> LayeredFrame {
    let decoded = decode(&bytes(&encode(frame).unwrap())).unwrap();
    decoded.validate().unwrap();
    decoded
}

#[test]
fn depths_are_kept_and_values_stay_within_the_stated_bounds() {
    let frame = random_frame(70, 150, 8, 1);
    let (scale, decoded) = (scale(), round_trip(&frame));
    assert_eq!(
        (&decoded.header, &decoded.offsets, &decoded.depth),
        (&frame.header, &frame.offsets, &frame.depth)
    );
    let mut changed = 0;
    for i in 0..frame.num_segments() {
        let (a, b) = (frame.segment(i), decoded.segment(i));
        // Exact: the bound is the stated greatest correction, then the nearest code, which is monotone.
        let give = quantize::GIVE;
        let tau_give = a.tau * give + scale.tau[1];
        let codes = scale.tau_code((a.tau - tau_give).max(0.0))..=scale.tau_code(a.tau + tau_give);
        assert!(codes.contains(&scale.tau_code(b.tau)), "{a:?} {b:?}");
        assert!(b.tau > 0.0, "an extinction vanished: {a:?}");
        for (c, d) in a.c.to_array().into_iter().zip(b.c.to_array()) {
            let codes = scale.color_code(c * (1.0 - give))..=scale.color_code(c * (1.0 + give));
            assert!(codes.contains(&scale.color_code(d)), "{a:?} {b:?}");
        }
        changed += usize::from(a != b);
    }
    assert!(changed * 2 > frame.num_segments(), "quantisation that changes nothing bounds nothing");
}

#[test]
fn a_frame_says_whether_it_stays_coarse_in_both_codings() {
    let frame = marched_frame(Builtin::Shells, 48);
    for fineness in Fineness::ALL {
        let mut frame = frame.clone();
        frame.header.fineness = fineness;
        let found =
            |chunks: &[Vec<u8>]| peek(&chunks[0]).map(|header| (header.frame.fineness, header.is_exact));
        let exact: Vec<_> = encode(&frame).unwrap().chunks.into_iter().map(|chunk| chunk.bytes).collect();
        assert_eq!(found(&exact), Ok((fineness, true)));
        let (blocks, _) = blocks::encode(&frame, &blocks::Settings::of(60), None).unwrap();
        let blocks: Vec<_> = blocks.chunks.into_iter().map(|chunk| chunk.bytes).collect();
        assert_eq!(found(&blocks), Ok((fineness, false)));
    }
}

#[test]
fn encoding_a_decoded_frame_gives_the_same_bytes() {
    for (k, seed) in [(8, 2), (16, 3), (1, 4), (32, 5)] {
        let encoded = encode(&random_frame(50, 140, k, seed)).unwrap();
        let decoded = decode(&bytes(&encoded)).unwrap();
        assert_eq!(encode(&decoded).unwrap(), encoded);
    }
}

#[test]
fn the_picture_survives() {
    for builtin in Builtin::ALL {
        let frame = marched_frame(builtin, 96);
        let picture = |f: &LayeredFrame| f.flatten().to_srgb8([0.0; 3]);
        let dssim = |f: &LayeredFrame| {
            image_error::compare(&picture(&frame), &picture(f), 96, 96, [0; 3]).unwrap().dssim_object
        };
        // The limit of the payload as a whole is 0.001; it is met here over the object's rectangle.
        let found = dssim(&round_trip(&frame));
        assert!(found <= 0.001, "{} {found}", builtin.name());
        let mut dimmed = frame.clone();
        for word in &mut dimmed.c_rg {
            *word = word.saturating_sub(0x0080_0080) & 0x7fff_7fff;
        }
        assert!(dssim(&dimmed) > 0.001, "an eighth of an octave of red and green must show");
    }
}

#[test]
fn the_closed_loop_keeps_the_composite() {
    let mut random = Random(5);
    let mut frame = LayeredFrame::empty(header(64, 64, 16));
    for list in 0..64 * 64 {
        for i in 0..16 {
            let tau = 0.05 + 0.1 * random.unit();
            let c = Vec3::new(0.9, 0.5, random.unit()) * (1.0 - (-tau).exp());
            frame.push(&Segment { front: i * 10, back: i * 10 + 10, c, tau });
        }
        frame.offsets[list + 1] = frame.num_segments() as u32;
    }
    let scale = scale();
    let exact = frame.flatten();
    let error = |pixels: &[[f32; 4]]| {
        let channels =
            exact.pixels.iter().zip(pixels).flat_map(|(a, b)| (0..4).map(move |i| (a[i] - b[i]).abs()));
        channels.fold(0.0, f32::max)
    };
    let open_loop: Vec<[f32; 4]> = (0..64 * 64)
        .map(|list| {
            let mut over = Over::default();
            for i in frame.list(list) {
                let s = frame.segment(i);
                let c = s.c.to_array().map(|c| scale.color[usize::from(scale.color_code(c))]);
                over.add(Vec3::from(c), scale.tau[usize::from(scale.tau_code(s.tau))]);
            }
            over.rgba()
        })
        .collect();
    let closed = error(&round_trip(&frame).flatten().pixels);
    // What is left is the last segment's: half a step of τ near 0.1 (0.0033) times its transmittance (0.2), and half
    // a step of colour near 0.14 (0.0004) times the same, up to the limit on corrections.
    assert!(closed < 2e-3, "{closed}");
    assert!(error(&open_loop) > 2.0 * closed, "{} {closed}", error(&open_loop));
}

#[test]
fn chunks_may_come_in_any_order_and_a_frame_in_any_memory() {
    for (width, height, k, seed) in [(40, 400, 8, 21), (17, 16, 24, 22), (33, 130, 3, 23)] {
        let frame = random_frame(width, height, k, seed);
        for frame in [frame.clone(), without_top(frame.clone(), height as usize / 2)] {
            let encoded = encode(&frame).unwrap();
            let all = decode(&bytes(&encoded)).unwrap();
            let mut chunks = bytes(&encoded);
            let other = random_frame(width, height, k, seed + 9);
            for spare in [None, Some(other), Some(LayeredFrame::empty(frame.header))] {
                chunks.rotate_left(1);
                let (found, reference) = decode_with(&chunks, &References::default(), spare).unwrap();
                assert!(found == all && reference.is_none());
            }
            assert!(matches!(decode(&chunks[1..]), Err(CodecError::Incomplete { .. })));
        }
    }
}

#[test]
fn small_and_odd_frames() {
    for (width, height) in [(1, 1), (1, 100), (100, 1), (16, 16), (17, 65), (33, 129)] {
        for k in [1, 2, 7, 16, 17, 31, 32] {
            for frame in [
                LayeredFrame::empty(header(width, height, k)),
                random_frame(width, height, k, 8),
                full_frame(width, height, k),
            ] {
                assert!(encode(&frame).unwrap().chunks.len() <= MAX_CHUNKS);
                let decoded = round_trip(&frame);
                assert_eq!((decoded.offsets, decoded.depth), (frame.offsets, frame.depth));
            }
        }
    }
    let empty = encode(&LayeredFrame::empty(header(512, 512, 8))).unwrap();
    // Eight bands of a header and where all but the last end, and a bit for each of 32 × 32 tiles.
    assert_eq!(empty.num_bytes(), 8 * (HEADER_BYTES + 14) + 128);
}

#[test]
fn headers_say_what_they_were_given() {
    let frame = random_frame(48, 200, 5, 9);
    let encoded = encode(&frame).unwrap();
    assert_eq!(encoded.chunks.len(), 3);
    for (i, chunk) in encoded.chunks.iter().enumerate() {
        let header = peek(&chunk.bytes[..HEADER_BYTES]).unwrap();
        assert_eq!((header.frame, header.is_exact, header.num_chunks), (frame.header, true, 3));
        assert_eq!((header.index, chunk.index), (ChunkIndex(i as u16), ChunkIndex(i as u16)));
        assert_eq!(header.chunk_bytes(), chunk.bytes.len());
        assert_eq!(header.to_bytes(), chunk.bytes[..HEADER_BYTES]);
    }
}

#[test]
fn bands_share_the_segments_wherever_they_are() {
    // Of 40 rows of tiles, 13 with matter.
    let frame = without_top(random_frame(48, 640, 5, 21), 432);
    let encoded = encode(&frame).unwrap();
    assert_eq!(encoded.chunks.len(), MAX_CHUNKS);
    let num_segments: Vec<_> = encoded
        .chunks
        .iter()
        .map(|chunk| Opened::new(&peek(&chunk.bytes).unwrap(), &chunk.bytes).unwrap().num_segments)
        .collect();
    assert_eq!(num_segments.iter().sum::<usize>(), frame.num_segments());
    // An eighth and a row. Some of eight bands of equal height have five rows.
    let of_rows = |row: usize, num: usize| {
        (frame.offsets[(row + num) * 16 * 48] - frame.offsets[row * 16 * 48]) as usize
    };
    let row = (0..40).map(|row| of_rows(row, 1)).max().unwrap();
    let most = frame.num_segments() / MAX_CHUNKS + row;
    assert!(num_segments.iter().all(|&num| num <= most), "{num_segments:?}");
    assert!((0..8).any(|band| of_rows(5 * band, 5) > most));
}

#[test]
fn contexts_beat_zstd_on_the_same_planes() {
    for builtin in Builtin::ALL {
        let frame = marched_frame(builtin, 256);
        let encoded = encode(&frame).unwrap();
        let scale = scale();
        let decoded = decode(&bytes(&encoded)).unwrap();
        let mut planes: [Vec<u8>; 10] = Default::default();
        planes[9] = decoded.offsets.windows(2).map(|ends| (ends[1] - ends[0]) as u8).collect();
        for i in 0..decoded.num_segments() {
            let s = decoded.segment(i);
            let c = s.c.to_array().map(|c| scale.color_code(c));
            let c_hi = c.iter().rev().fold(0, |hi, q| hi << 2 | (q >> 8) as u8);
            let depths = [s.front.to_le_bytes(), s.back.to_le_bytes()].concat();
            let rest = [c[0] as u8, c[1] as u8, c[2] as u8, c_hi, scale.tau_code(s.tau)];
            for (plane, byte) in planes.iter_mut().zip(depths.into_iter().chain(rest)) {
                plane.push(byte);
            }
        }
        let zstd: usize = planes.iter().map(|p| zstd::bulk::compress(p, 3).unwrap().len()).sum();
        // The exact mode is held to 0.6 at 512×512 lists. At 256×256 its tables weigh four times as much.
        let ratio = encoded.num_bytes() as f64 / zstd as f64;
        assert!(ratio <= 0.61, "{} {ratio}", builtin.name());
    }
}
