use glam::Vec3;

use super::assembly::Assembly;
use super::planes::{DecodedChunk, decode_chunk};
use super::*;
use crate::camera::{Camera, Intrinsics, Pose};
use crate::ids::{FrameId, LookVersion, PoseId};
use crate::image_error;
use crate::kernels::layering::generate;
use crate::kernels::march::{MarchSettings, Scene};
use crate::layer::{Over, Segment, TAU_MAX};
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
pub(super) fn soft() -> TransferFunction {
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

pub(super) fn soft_scene(builtin: Builtin) -> Scene {
    Scene::new(builtin.volume(48).into(), &soft(), MarchSettings::default())
}

fn marched_frame(builtin: Builtin, size: u32) -> LayeredFrame {
    generate(&soft_scene(builtin), header(size, size, 8))
}

fn bytes(encoded: &EncodedFrame) -> Vec<&[u8]> {
    encoded.chunks.iter().map(|c| &c.bytes[..]).collect()
}

fn round_trip(frame: &LayeredFrame, settings: &Settings) -> LayeredFrame {
    let decoded = decode(&bytes(&encode(frame, settings).unwrap())).unwrap();
    decoded.validate().unwrap();
    decoded
}

const ALL_BITS: [Settings; 2] =
    [Settings { color_bits: 8, num_groups: 2 }, Settings { color_bits: 10, num_groups: 1 }];

#[test]
fn depths_are_kept_and_values_stay_within_the_stated_bounds() {
    let frame = random_frame(70, 150, 8, 1);
    for settings in ALL_BITS {
        let scale = scale::of(settings.color_bits).unwrap();
        let decoded = round_trip(&frame, &settings);
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
}

#[test]
fn encoding_a_decoded_frame_gives_the_same_bytes() {
    for (k, seed) in [(8, 2), (16, 3), (1, 4), (32, 5)] {
        for settings in ALL_BITS {
            let encoded = encode(&random_frame(50, 140, k, seed), &settings).unwrap();
            let decoded = decode(&bytes(&encoded)).unwrap();
            assert_eq!(encode(&decoded, &settings).unwrap(), encoded);
        }
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
        for settings in ALL_BITS {
            // The limit of the payload as a whole is 0.001; it is met here over the object's rectangle.
            let found = dssim(&round_trip(&frame, &settings));
            assert!(found <= 0.001, "{} {found}", builtin.name());
        }
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
    let settings = ALL_BITS[0];
    let scale = scale::of(settings.color_bits).unwrap();
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
    let closed = error(&round_trip(&frame, &settings).flatten().pixels);
    // What is left is the last segment's: half a step of τ near 0.1 (0.0033) times its transmittance (0.2), and half
    // a step of colour near 0.14 (0.0016) times the same, up to the limit on corrections.
    assert!(closed < 2e-3, "{closed}");
    assert!(error(&open_loop) > 2.0 * closed, "{} {closed}", error(&open_loop));
}

#[test]
fn order_does_not_matter_and_the_base_is_enough() {
    let encoded = encode(&random_frame(40, 300, 8, 6), &Settings::default()).unwrap();
    assert!(encoded.chunks.len() > 4 && encoded.chunks.iter().any(|c| !c.is_base));
    assert!(encoded.chunks.is_sorted_by_key(|c| !c.is_base));
    let all = decode(&bytes(&encoded)).unwrap();
    let mut random = Random(7);
    for _ in 0..20 {
        let mut order: Vec<_> = encoded.chunks.iter().collect();
        for i in (1..order.len()).rev() {
            order.swap(i, random.below(i + 1));
        }
        let mut assembly = Assembly::new(&peek(&order[0].bytes).unwrap());
        let num_base = order.iter().filter(|c| c.is_base).count();
        let mut seen_base = 0;
        for (n, chunk) in order.iter().enumerate() {
            assembly.insert(decode_chunk(&chunk.bytes).unwrap()).unwrap();
            seen_base += usize::from(chunk.is_base);
            assert_eq!(assembly.base_complete(), seen_base == num_base);
            assert_eq!((assembly.num_inserted(), assembly.complete()), (n + 1, n + 1 == order.len()));
            let frame = assembly.to_frame(None);
            frame.validate().unwrap();
            assert!(frame == all || n + 1 < order.len());
        }
        assert_eq!(assembly.to_frame(None), all);
    }
}

#[test]
fn the_base_holds_what_is_seen() {
    let frame = marched_frame(Builtin::Cloud, 64);
    let encoded = encode(&frame, &Settings::default()).unwrap();
    let only = |base: bool| {
        let mut assembly = Assembly::new(&peek(&encoded.chunks[0].bytes).unwrap());
        for chunk in encoded.chunks.iter().filter(|c| c.is_base == base) {
            assembly.insert(decode_chunk(&chunk.bytes).unwrap()).unwrap();
        }
        let light: f32 = assembly.to_frame(None).flatten().pixels.iter().map(|p| p[3]).sum();
        light
    };
    assert!(only(true) > 1.5 * only(false), "{} {}", only(true), only(false));
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
                let encoded = encode(&frame, &Settings::default()).unwrap();
                assert!(encoded.chunks.len() <= MAX_CHUNKS);
                let decoded = round_trip(&frame, &Settings::default());
                assert_eq!((decoded.offsets, decoded.depth), (frame.offsets, frame.depth));
            }
        }
    }
    let empty = encode(&LayeredFrame::empty(header(512, 512, 8)), &Settings::default()).unwrap();
    // Eight bands of a header and a bit for each of 4 × 32 tiles.
    assert_eq!(empty.num_bytes(), 8 * (HEADER_BYTES + 16));
}

#[test]
fn headers_say_what_they_were_given() {
    let frame = random_frame(48, 200, 5, 9);
    let encoded = encode(&frame, &ALL_BITS[0]).unwrap();
    let mut rows: Vec<_> = vec![];
    for (i, chunk) in encoded.chunks.iter().enumerate() {
        let header = peek(&chunk.bytes[..HEADER_BYTES]).unwrap();
        assert_eq!((header.frame, header.color_bits), (frame.header, 8));
        assert_eq!((header.index, header.is_base()), (ChunkIndex(i as u16), chunk.is_base));
        assert_eq!((chunk.index, header.chunk_bytes()), (header.index, chunk.bytes.len()));
        if chunk.is_base {
            rows.extend(decode_chunk(&chunk.bytes).unwrap().rows());
        }
        assert_eq!(header.to_bytes(), chunk.bytes[..HEADER_BYTES]);
    }
    rows.sort_unstable();
    assert_eq!(rows, (0..200).collect::<Vec<_>>());
}

#[test]
fn bands_share_the_segments_wherever_they_are() {
    // Of 40 rows of tiles, 13 with matter.
    let frame = without_top(random_frame(48, 640, 5, 21), 432);
    for settings in ALL_BITS {
        let bands = encode(&frame, &settings).unwrap().chunks;
        let bands = bands.iter().filter(|c| c.is_base).map(|c| decode_chunk(&c.bytes).unwrap());
        let rows: Vec<_> = bands.map(|band| (band.rows(), band.header.rows(None))).collect();
        assert_eq!(rows.len(), MAX_BANDS);
        let num_segments = |rows: &Range<u32>| {
            let [start, end] = [rows.start, rows.end].map(|row| frame.offsets[row as usize * 48]);
            (end - start) as usize
        };
        // An eighth and a row. Of those of equal height some have five rows.
        let row = (0..40).map(|row| num_segments(&(row * 16..row * 16 + 16))).max().unwrap();
        let most = frame.num_segments() / MAX_BANDS + row;
        assert!(rows.iter().all(|(rows, _)| num_segments(rows) <= most), "{rows:?}");
        assert!(rows.iter().any(|(_, equal)| num_segments(equal) > most), "{rows:?}");
        assert_eq!(round_trip(&frame, &settings).depth, frame.depth);
    }
}

#[test]
fn a_whole_frame_is_what_is_assembled_of_its_chunks() {
    let one = |color_bits| Settings { color_bits, num_groups: 1 };
    for (width, height, k, seed) in [(40, 400, 8, 21), (17, 16, 24, 22), (33, 130, 3, 23)] {
        let frame = random_frame(width, height, k, seed);
        for frame in [frame.clone(), without_top(frame.clone(), height as usize / 2)] {
            let encoded = encode(&frame, &one(10)).unwrap();
            let mut chunks = bytes(&encoded);
            chunks.reverse();
            let assembled = assemble(&chunks, &References::default()).unwrap().to_frame();
            // Whatever was there before.
            for mut spare in [
                None,
                Some(random_frame(width, height, k, seed + 9)),
                Some(LayeredFrame::empty(frame.header)),
            ] {
                assert_eq!(decode_whole(&chunks, &mut spare).unwrap().as_ref(), Some(&assembled));
                assert!(spare.is_none());
            }
            assert_eq!(decode_whole(&chunks[1..], &mut None), Ok(None), "not all of them, {width}×{height}");
        }
        let two = encode(&frame, &Settings::default()).unwrap();
        assert_eq!(decode_whole(&bytes(&two), &mut None), Ok(None));
    }
    assert_eq!(decode_whole::<Vec<u8>>(&[], &mut None), Ok(None));

    // What an assembly refuses is refused.
    let frame = random_frame(40, 400, 8, 21);
    let encoded = encode(&frame, &one(10)).unwrap();
    let chunks = bytes(&encoded);
    let with = |at: usize, other: &[u8]| {
        let mut chunks = chunks.clone();
        chunks[at] = other;
        let found = decode_whole(&chunks, &mut None);
        let assembled = assemble(&chunks, &References::default()).map(|assembly| Some(assembly.to_frame()));
        assert_eq!(found.is_ok(), assembled.is_ok());
        found.err()
    };
    assert_eq!(with(1, chunks[1]), None);
    assert_eq!(with(1, chunks[0]), Some(CodecError::Duplicate(ChunkIndex(0))));
    let mut later = frame.clone();
    later.header.frame = FrameId(8);
    for other in [encode(&later, &one(10)), encode(&frame, &one(8))] {
        let found = with(1, &other.unwrap().chunks[1].bytes);
        assert!(matches!(found, Some(CodecError::Contradiction { .. })), "{found:?}");
    }
    let lower = encode(&without_top(frame.clone(), 112), &one(10)).unwrap();
    let found = with(1, &lower.chunks[1].bytes);
    assert!(
        matches!(found, Some(CodecError::Contradiction { what: "other borders of bands", .. })),
        "{found:?}"
    );
    assert!(matches!(with(1, &chunks[1][..chunks[1].len() - 1]), Some(CodecError::Length { .. })));

    // Two bands of as many rows: the second says that it is the first.
    let encoded = encode(&full_frame(16, 128, 2), &one(10)).unwrap();
    let [first, second] = &bytes(&encoded)[..] else { panic!("{} chunks", encoded.chunks.len()) };
    let same_band = [&second[..7], &first[7..8], &second[8..]].concat();
    let found = decode_whole(&[first, &same_band[..]], &mut None);
    let what = "its band and group are there under another index";
    assert!(
        matches!(found, Err(CodecError::Contradiction { what: found, .. }) if found == what),
        "{found:?}"
    );
}

#[test]
fn what_bytes_are_for_sums_to_the_chunk_and_names_every_plane() {
    for settings in ALL_BITS {
        let (mut num_tiles, mut num_filled) = (0, 0);
        let frame = random_frame(40, 130, 8, 15);
        for chunk in encode(&frame, &settings).unwrap().chunks {
            let Spent { parts, tile_side, tiles } = spent(&chunk.bytes, &References::default()).unwrap();
            assert_eq!(parts.iter().map(|(_, bytes)| bytes).sum::<usize>(), chunk.bytes.len());
            assert_eq!(parts.len(), 4 + contexts::NUM_PLANES);
            assert!(parts.iter().all(|&(name, bytes)| bytes > 0 && !name.is_empty()));
            let [empty, filled] = tiles[..] else { panic!("{tiles:?}") };
            let before_planes = ["header", "tiles", "part lengths", "tables"];
            let in_planes = parts.iter().filter(|(name, _)| !before_planes.contains(name));
            assert_eq!(filled.bytes, in_planes.map(|(_, bytes)| bytes).sum::<usize>());
            assert_eq!((empty.name, filled.name, tile_side), ("empty", "with segments", TILE));
            num_tiles += empty.num + filled.num;
            num_filled += filled.num;
            assert!(spent(&chunk.bytes[..chunk.bytes.len() - 1], &References::default()).is_err());
        }
        // Of two groups too, each tile counts once.
        let is_filled = |x: usize, y: usize| {
            let lists = (0..TILE * TILE).map(|i| (x * TILE + i % TILE, y * TILE + i / TILE));
            let mut inside = lists.filter(|&(x, y)| x < 40 && y < 130);
            inside.any(|(x, y)| frame.offsets[y * 40 + x] < frame.offsets[y * 40 + x + 1])
        };
        let all = (0..40usize.div_ceil(TILE)).flat_map(|x| (0..130usize.div_ceil(TILE)).map(move |y| (x, y)));
        assert_eq!(num_tiles, all.clone().count());
        assert_eq!(num_filled, all.filter(|&(x, y)| is_filled(x, y)).count());
    }
}

#[test]
fn one_group_is_the_same_frame_in_fewer_bytes() {
    for builtin in Builtin::ALL {
        let frame = marched_frame(builtin, 128);
        let [two, one] = [2, 1].map(|num_groups| {
            let encoded = encode(&frame, &Settings { color_bits: 10, num_groups }).unwrap();
            (encoded.num_bytes(), decode(&bytes(&encoded)).unwrap(), encoded.chunks)
        });
        assert_eq!(one.1, two.1);
        assert!(one.0 < two.0 && one.2.iter().all(|c| c.is_base), "{} {}", one.0, two.0);
    }
}

#[test]
fn contexts_beat_zstd_on_the_same_planes() {
    for builtin in Builtin::ALL {
        let frame = marched_frame(builtin, 256);
        let settings = Settings { color_bits: 10, num_groups: 1 };
        let encoded = encode(&frame, &settings).unwrap();
        let scale = scale::of(settings.color_bits).unwrap();
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
