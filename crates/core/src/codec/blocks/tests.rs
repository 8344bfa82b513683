use glam::Vec3;

use std::sync::Arc;

use super::tables::Counts;
use super::tile::FrameTile;
use super::*;
use crate::camera::{Camera, Intrinsics, Pose};
use crate::codec::exact::tests::soft_scene as scene;
use crate::codec::{CodecError, Coding, EncodedFrame, HEADER_BYTES, decode, decode_with};
use crate::ids::{FrameId, LookVersion, PoseId};
use crate::image_error;
use crate::kernels::layering::generate;
use crate::kernels::march::Scene;
use crate::kernels::raycast::{CastOptions, Raycaster};
use crate::layer::{FrameHeader, LayeredFrame};
use crate::simd::tests::with_each;
use crate::space::Aabb;
use crate::volume::procedural::Builtin;

mod hostile;

/// Frame `frame` of `width`×`height` lists, `degrees` along an orbit.
pub(in crate::codec) fn made(
    scene: &Scene,
    frame: u32,
    width: u32,
    height: u32,
    degrees: f32,
) -> LayeredFrame {
    let intrinsics = Intrinsics::perspective(width, height, 0.6);
    let header = FrameHeader {
        frame: FrameId(frame),
        pose: PoseId(8),
        look: LookVersion(9),
        camera: camera(intrinsics, degrees),
        k: 12,
        mode: Default::default(),
        fineness: Default::default(),
    };
    generate(scene, header)
}

fn camera(intrinsics: Intrinsics, degrees: f32) -> Camera {
    let distance = bounds().radius() * intrinsics.fit_distance();
    Camera::new(Pose::orbit(Vec3::ZERO, 0.5 + degrees.to_radians(), 0.3, distance), intrinsics, &bounds())
}

fn bounds() -> Aabb {
    Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) }
}

fn bytes(encoded: &EncodedFrame) -> Vec<&[u8]> {
    encoded.chunks.iter().map(|c| &c.bytes[..]).collect()
}

fn whole(quality: u8) -> Settings {
    Settings::of(quality)
}

/// DSSIM and PSNR against `reference`, cast `degrees` away from the frames' pose.
fn error(frame: &LayeredFrame, reference: &LayeredFrame, degrees: f32) -> (f64, f64) {
    let intrinsics = frame.header.camera.intrinsics;
    let view = camera(intrinsics, degrees);
    let picture = |f| Raycaster::new(f, &bounds()).picture(&view, &CastOptions::default()).to_srgb8([0.0; 3]);
    let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
    let e = image_error::compare(&picture(frame), &picture(reference), width, height, [0; 3]).unwrap();
    (e.dssim, e.psnr_db)
}

#[test]
fn machines_with_and_without_wider_instructions_decode_alike() {
    let decoded = |coded: &EncodedFrame, references: &References| {
        let (frame, reference) = decode_with(&bytes(coded), references, None).unwrap();
        (frame, reference.unwrap())
    };
    for builtin in ALL {
        let scene = scene(builtin);
        let mut references = References::default();
        for id in 1..4 {
            // The picture moves by parts of a list, and the size is no multiple of a block.
            let frame = made(&scene, id, 140, 93, id as f32);
            let encoded =
                |quality| encode(&frame, &whole(quality), references.newest().map(|r| &**r)).unwrap().0;
            let (ours, other) = (encoded(70), encoded(71));
            let [narrow, wide, wider] = with_each(|| decoded(&ours, &references));
            assert!(wide == narrow && wider == narrow, "{builtin:?} {id}");
            assert!(narrow != decoded(&other, &references));
            references.insert(wider.1);
        }
    }
}

const ALL: [Builtin; 3] = [Builtin::Cubus, Builtin::Cloud, Builtin::Shells];

#[test]
fn what_decodes_is_what_the_encoder_worked_with() {
    for builtin in ALL {
        let scene = scene(builtin);
        for quality in [0, 55, 100] {
            let mut references = References::default();
            // The size is no multiple of a block.
            for id in 1..4 {
                let frame = made(&scene, id, 140, 93, id as f32);
                let reference = references.newest().cloned();
                let (encoded, reference) = encode(&frame, &whole(quality), reference.as_deref()).unwrap();
                // In the memory of whatever frame.
                let (found, decoded) =
                    decode_with(&bytes(&encoded), &references, Some(frame.clone())).unwrap();
                found.validate().unwrap();
                assert_eq!(decode_with(&bytes(&encoded), &references, None).unwrap().0, found);
                assert_eq!(*decoded.unwrap(), reference);
                assert_eq!(found, reference.to_frame());
                assert_eq!(found.header, encoded.header);
                let alone = decode(&bytes(&encoded));
                match id {
                    1 => assert_eq!(alone.unwrap(), found),
                    _ => assert!(matches!(alone, Err(CodecError::Reference { .. }))),
                }
                references.insert(Arc::new(reference));
            }
        }
    }
}

#[test]
fn bands_end_where_their_work_does_and_all_chunks_agree_on_it() {
    let four = made(&scene(Builtin::Shells), 1, 48, 720, 0.0);
    let (encoded, reference) = encode(&four, &Settings { max_bands: 4, ..whole(60) }, None).unwrap();
    assert_eq!(encoded.chunks.len(), 4);
    let at = HEADER_BYTES + head::HEAD_BYTES;
    let end =
        |n: usize| usize::from(u16::from_le_bytes([0, 1].map(|i| encoded.chunks[0].bytes[at + 2 * n + i])));
    let rows = [end(0), end(1) - end(0), end(2) - end(1), 12 - end(2)];
    // The object is in the middle, so bands there are lower than those beside.
    assert!(rows[1] < rows[0] && rows[2] < rows[3], "{rows:?}");
    let mut chunks = bytes(&encoded);
    chunks.reverse();
    assert_eq!(decode(&chunks).unwrap(), reference.to_frame());

    // Moved by a row in one chunk only, the borders contradict those of the others, even if the chunk still decodes.
    let forged = |n: usize, at: usize, value: u16| {
        let mut chunks: Vec<Vec<u8>> = encoded.chunks.iter().map(|c| c.bytes.clone()).collect();
        chunks[n][at..at + 2].copy_from_slice(&value.to_le_bytes());
        decode(&chunks).unwrap_err()
    };
    let found = forged(3, at, rows[0] as u16 + 1);
    assert!(matches!(found, CodecError::Contradiction { .. } | CodecError::Payload { .. }), "{found}");
    for (n, value) in [(0, 0u16), (1, 0), (2, 12), (2, u16::MAX)] {
        let found = forged(0, at + 2 * n, value);
        assert!(matches!(found, CodecError::Payload { plane: "borders", .. }), "{found}");
    }
}

#[test]
fn the_picture_survives_at_its_pose_and_beside_it() {
    // Measured .0012 and .0055 of DSSIM for 6.6 kB, .0008 and .0031 for 2.2 kB, .0016 and .0141 for 4.9 kB: a quarter more
    // is allowed. Thin shells in so small a picture lose most beside the pose.
    for (builtin, most_bytes, bounds) in [
        (Builtin::Cubus, 8_300, [0.0015, 0.007]),
        (Builtin::Cloud, 2_800, [0.0011, 0.004]),
        (Builtin::Shells, 6_200, [0.002, 0.018]),
    ] {
        let scene = scene(builtin);
        let frame = made(&scene, 1, 160, 160, 0.0);
        let (fine, _) = encode(&frame, &whole(60), None).unwrap();
        let (coarse, _) = encode(&frame, &whole(0), None).unwrap();
        let shown = |e: &EncodedFrame| decode(&bytes(e)).unwrap();
        for (degrees, bound) in [0.0, 5.0].into_iter().zip(bounds) {
            let (dssim, psnr) = error(&shown(&fine), &frame, degrees);
            let (worse, _) = error(&shown(&coarse), &frame, degrees);
            assert!(dssim < bound && psnr > 36.0, "{builtin:?} {degrees}: {dssim} {psnr}");
            assert!(worse > dssim);
        }
        assert!(fine.num_bytes() < most_bytes && coarse.num_bytes() < fine.num_bytes());
    }
}

#[test]
fn prediction_from_the_frame_before_saves_bytes_and_costs_no_quality() {
    for builtin in ALL {
        let scene = scene(builtin);
        let frames: Vec<_> = (1..=5).map(|id| made(&scene, id, 160, 160, id as f32)).collect();
        let mut last: Option<Reference> = None;
        let (mut intra, mut inter) = (0, 0);
        for frame in &frames {
            let (alone, alone_decoded) = encode(frame, &whole(60), None).unwrap();
            let (encoded, decoded) = encode(frame, &whole(60), last.as_ref()).unwrap();
            if last.is_some() {
                intra += alone.num_bytes();
                inter += encoded.num_bytes();
            }
            let angle = frame.header.frame.0 as f32;
            let (with, without) = (
                error(&decoded.to_frame(), frame, angle).0,
                error(&alone_decoded.to_frame(), frame, angle).0,
            );
            // Quantisation falls differently, and frames alone are smoother (.00159 and .00110 on the cubus); it does
            // not add up over the frames.
            assert!(with < 1.3 * without + 2e-4, "{builtin:?}: {with} {without}");
            last = Some(decoded);
        }
        assert!(inter * 10 < intra * 7, "{builtin:?}: {inter} of {intra} bytes");
        // At rest nearly nothing is left to say.
        let still = LayeredFrame {
            header: FrameHeader { frame: FrameId(6), ..frames[4].header },
            ..frames[4].clone()
        };
        let (at_rest, _) = encode(&still, &whole(60), last.as_ref()).unwrap();
        println!("{builtin:?}: {inter} of {intra}, at rest: {} of {}", at_rest.num_bytes(), intra / 4);
        assert!(at_rest.num_bytes() * 5 < intra / 4, "{builtin:?}: {} bytes at rest", at_rest.num_bytes());
    }
}

#[test]
fn planes_are_kept_as_long_as_they_suit_so_that_errors_do_not_add_up() {
    let scene = scene(Builtin::Shells);
    let frames: Vec<_> = (0..10).map(|i| made(&scene, i + 1, 160, 160, 2.0 * i as f32)).collect();
    // Frames predicted one from the other, each note changed before it is used.
    let chain = |noted: fn(f32) -> f32| {
        let mut before: Option<Reference> = None;
        let mut num_bytes = 0;
        for frame in &frames {
            let (encoded, mut reference) = encode(frame, &whole(60), before.as_ref()).unwrap();
            num_bytes += encoded.num_bytes();
            reference.notes.iter_mut().flatten().for_each(|note| *note = noted(*note));
            before = Some(reference);
        }
        let last = before.unwrap();
        (error(&last.to_frame(), &frames[frames.len() - 1], 5.0).0, num_bytes)
    };
    let (as_noted, num_bytes) = chain(|note| note);
    let (anything, _) = chain(|_| 1e9);
    let (encoded, alone) = encode(&frames[frames.len() - 1], &whole(60), None).unwrap();
    let (best, _) = error(&alone.to_frame(), &frames[frames.len() - 1], 5.0);
    // Measured .0259 before planes were fitted, where a frame alone has .0251 and one whose planes are kept whatever they are .0454; 31 of 49 kB.
    assert!(as_noted < 1.2 * best && as_noted < 0.8 * anything, "{best} {as_noted} {anything}");
    assert!(num_bytes < encoded.num_bytes() * frames.len() * 4 / 5, "{num_bytes}");
}

#[test]
fn what_is_noted_of_planes_goes_with_them() {
    let scene = scene(Builtin::Cubus);
    let (_, one) = encode(&made(&scene, 1, 160, 160, 0.0), &whole(60), None).unwrap();
    let (still, two) = encode(&made(&scene, 2, 160, 160, 0.0), &whole(60), Some(&one)).unwrap();
    let (_, turned) = encode(&made(&scene, 3, 160, 160, 1.0), &whole(60), Some(&two)).unwrap();
    let noted = |reference: &Reference| -> Vec<f32> {
        (0..20 * 20).map(|i| reference.note([i % 20, i / 20])).collect()
    };
    let has_planes = |reference: &Reference, i: i32| {
        reference.block(i % 20, i / 20).is_some_and(|(tile, block)| !tile.layers(block).is_empty())
    };
    for reference in [&one, &turned] {
        for (note, i) in noted(reference).into_iter().zip(0..) {
            assert!(note.is_finite() && (note > 0.0) == has_planes(reference, i), "{i}: {note}");
        }
    }
    // All but a few blocks are copies.
    let same = noted(&one).iter().zip(noted(&two)).filter(|(a, b)| **a == *b).count();
    assert!(same > 390, "{same}");
    // Who decodes knows nothing of it, and has the same frame.
    let mut references = References::default();
    references.insert(Arc::new(one));
    let decoded = decode_with(&bytes(&still), &references, None).unwrap().1.unwrap();
    assert!(*decoded == two && noted(&decoded).iter().all(|note| *note == 0.0));
    for outside in [[-1, 0], [0, -1], [20, 0], [0, 20]] {
        assert_eq!(two.note(outside), 0.0);
    }
}

#[test]
fn a_lost_frame_breaks_those_that_name_it_and_no_other() {
    let scene = scene(Builtin::Cloud);
    let frames: Vec<_> = (1..=4).map(|id| made(&scene, id, 64, 64, id as f32)).collect();
    let (first, one) = encode(&frames[0], &whole(50), None).unwrap();
    let (_, two) = encode(&frames[1], &whole(50), Some(&one)).unwrap();
    let (third, _) = encode(&frames[2], &whole(50), Some(&two)).unwrap();
    let (fourth, four) = encode(&frames[3], &whole(50), Some(&one)).unwrap();
    let mut references = References::default();
    references.insert(decode_with(&bytes(&first), &references, None).unwrap().1.unwrap());
    // Frame 2 is lost: frame 3 names it, frame 4 does not.
    let missing = CodecError::Reference { frame: FrameId(3), reference: FrameId(2) };
    assert_eq!(decode_with(&bytes(&third), &references, None).unwrap_err(), missing);
    let (_, found) = decode_with(&bytes(&fourth), &references, None).unwrap();
    assert_eq!(*found.unwrap(), four);
    for id in 10..10 + MAX_REFERENCES as u32 {
        let header = FrameHeader { frame: FrameId(id), ..frames[0].header };
        references.insert(Arc::new(Reference::new(header, None, vec![], Counts::default())));
    }
    assert!(references.get(FrameId(1)).is_none() && references.get(FrameId(10)).is_some());
    // A frame without blocks is no use, but no harm either.
    let (encoded, decoded) = encode(&frames[3], &whole(50), references.newest().map(|r| &**r)).unwrap();
    assert_eq!(decode_with(&bytes(&encoded), &references, None).unwrap().0, decoded.to_frame());
}

/// Frames of a moving camera, each predicted from the one before: none is more than a twentieth above the target once the
/// first few are seen, and most of it is used. What a frame takes beyond the last one's is the only thing not known; 8 % are
/// kept free for it.
#[test]
fn a_wanted_number_of_bytes_is_kept_along_a_chain_and_found_again_behind_a_cut() {
    let scenes = [scene(Builtin::Shells), scene(Builtin::Cubus)];
    let target = 2500;
    let mut rate = RateControl::new(target);
    let mut reference = None;
    let mut taken = vec![];
    for id in 1..=24 {
        // A cut to another volume behind the 12th.
        let frame = made(&scenes[usize::from(id > 12)], id, 128, 128, id as f32);
        let quality = rate.quality(reference.is_some());
        let settings = Settings::of(quality);
        let (encoded, decoded) = encode(&frame, &settings, reference.as_ref()).unwrap();
        rate.observe(reference.is_some(), quality, encoded.num_bytes());
        reference = Some(decoded);
        taken.push((encoded.num_bytes(), quality));
    }
    let settled = |from: usize, to: usize| taken[from..to].iter().map(|t| t.0);
    for (from, to) in [(3, 12), (16, 24)] {
        assert!(settled(from, to).all(|bytes| bytes <= target * 21 / 20), "{taken:?}");
        assert!(settled(from, to).sum::<usize>() > (to - from) * target * 7 / 10, "{taken:?}");
    }
    // The control: with the quality as it was before the cut, the frames behind it would be of another size.
    assert!(taken[11].1.abs_diff(taken[20].1) >= 5, "{taken:?}");
}

#[test]
fn a_frame_is_made_as_good_as_a_number_of_bytes_allows() {
    let frame = made(&scene(Builtin::Shells), 1, 128, 128, 0.0);
    for max_bytes in [2000, 4000, 9000] {
        let (encoded, decoded, quality) = encode_within(&frame, max_bytes, &whole(0), None).unwrap();
        let bytes = encoded.num_bytes();
        assert!(bytes <= max_bytes && bytes > max_bytes * 9 / 10, "{bytes} of {max_bytes}");
        let again = encode(&frame, &whole(quality), None).unwrap();
        assert_eq!((again.0, again.1.to_frame()), (encoded, decoded.to_frame()));
    }
    let (encoded, _, quality) = encode_within(&frame, 1 << 24, &whole(0), None).unwrap();
    assert_eq!((quality, encoded), (MAX_QUALITY, encode(&frame, &whole(MAX_QUALITY), None).unwrap().0));
    assert!(matches!(
        encode_within(&frame, 600, &whole(0), None),
        Err(CodecError::TooLarge { limit: 600, .. })
    ));
}

/// Counts how often an encoder asks, and says no from some time on.
#[test]
fn a_frame_that_is_given_up_is_left_at_the_next_tile() {
    use std::sync::atomic::{AtomicUsize, Ordering};
    let frame = made(&scene(Builtin::Shells), 1, 128, 128, 0.0);
    let blocks = Coding::Blocks(whole(60));
    for (coding, at_least) in [(blocks, 4), (Coding::Exact, 2)] {
        let asked = AtomicUsize::new(0);
        let encode = |times: usize| {
            asked.store(0, Ordering::Relaxed);
            coding.encode_while(&frame, None, &|| asked.fetch_add(1, Ordering::Relaxed) < times)
        };
        assert_eq!(encode(usize::MAX).unwrap().0, coding.encode(&frame, None).unwrap().0);
        let whole = asked.load(Ordering::Relaxed);
        assert!(whole >= at_least, "{coding:?} asks {whole} times");
        assert_eq!(encode(3).unwrap_err(), CodecError::Abandoned);
    }
}

#[test]
fn an_empty_frame_is_nothing_but_headers() {
    let frame = made(&scene(Builtin::Cubus), 1, 64, 64, 0.0);
    let (encoded, _) = encode(&LayeredFrame::empty(frame.header), &whole(50), None).unwrap();
    assert!(encoded.num_bytes() < encoded.chunks.len() * 110, "{}", encoded.num_bytes());
    assert_eq!(decode(&bytes(&encoded)).unwrap().num_segments(), 0);
}

/// The picture at the own pose does not show for which turn a frame was made, so what was made for a lesser one is not kept.
#[test]
fn a_rest_does_not_copy_what_was_made_for_a_lesser_turn() {
    let scene = scene(Builtin::Shells);
    let [before, now] = [1, 2].map(|id| made(&scene, id, 128, 128, 0.0));
    // A copied block has the cells of the reference, which no other coding of it gives by chance.
    let num_copied = |turn_deg| {
        let settings = Settings { turn_deg, ..whole(70) };
        let (_, reference) = encode(&before, &settings, None).unwrap();
        let (_, decoded) = encode(&now, &whole(70), Some(&reference)).unwrap();
        let blocks = (0..16 * 16).map(|i| (i % 16, i / 16));
        let is_copied = |&(x, y): &(i32, i32)| {
            let [a, b] = [&decoded, &reference].map(|of: &Reference| {
                let mut one = FrameTile::default();
                if let Some((tile, block)) = of.block(x, y) {
                    one.copy(tile, block);
                }
                one
            });
            a.num_cells() > 0 && a == b
        };
        blocks.filter(is_copied).count()
    };
    let [lesser, all, greater] = [Some(1), None, Some(MAX_TURN_DEG)].map(num_copied);
    assert!(lesser == 0 && all > 50 && greater > 50, "{lesser}, {all}, {greater} blocks");
}

/// Of as many bytes, each frame is the best at the turn that it is made for: in the mean of a few poses, as a search for
/// planes has its luck.
#[test]
fn bytes_are_spent_where_a_turn_shows_them() {
    for builtin in [Builtin::Cloud, Builtin::Shells] {
        let scene = scene(builtin);
        let [mut alone, mut predicted] = [[[0.0; 2]; 3]; 2];
        for at in [0.0, 20.0, 40.0, 100.0] {
            let (before, reference) = encode(&made(&scene, 1, 160, 160, at - 1.0), &whole(50), None).unwrap();
            let mut references = References::default();
            references.insert(Arc::new(reference.clone()));
            let frame = made(&scene, 2, 160, 160, at);
            let usual = before.num_bytes();
            let found = |turn_deg, reference: Option<&Reference>| {
                let bytes_allowed = if reference.is_some() { usual / 2 } else { usual };
                let settings = Settings { turn_deg, ..whole(0) };
                let (encoded, ..) = encode_within(&frame, bytes_allowed, &settings, reference).unwrap();
                assert!(encoded.num_bytes() * 10 > bytes_allowed * 9, "{builtin:?} {turn_deg:?}");
                let decoded = decode_with(&bytes(&encoded), &references, None).unwrap().0;
                [at, at + 10.0].map(|degrees| error(&decoded, &frame, degrees).0)
            };
            for (i, turn) in [Some(0), None, Some(MAX_TURN_DEG)].into_iter().enumerate() {
                for (sums, reference) in [(&mut alone, None), (&mut predicted, Some(&reference))] {
                    let found = found(turn, reference);
                    sums[i].iter_mut().zip(found).for_each(|(sum, found)| *sum += found);
                }
            }
        }
        println!(
            "{builtin:?}: DSSIM at 0° and 10° made for 0°, all, 10°: {alone:?}, predicted {predicted:?}"
        );
        for [near, all, far] in [alone, predicted] {
            assert!(near[0] < all[0] && all[0] < far[0], "{builtin:?} {alone:?} {predicted:?}");
            // Predicted frames of the cloud for 10° and for all are alike there, within 1 %.
            assert!(far[1] < near[1] && far[1] < 1.01 * all[1], "{builtin:?} {alone:?} {predicted:?}");
        }
        assert!(alone[0][0] < 0.8 * alone[1][0], "{builtin:?} {alone:?}");
        assert!(alone[2][1] < 0.95 * alone[1][1], "{builtin:?} {alone:?}");
    }
}
