//! Processes that have some rows each code a frame as one that has all of them does, to the byte.

use super::*;
use crate::cancel::ALWAYS;
use crate::codec::blocks::tests::made;
use crate::codec::exact::tests::soft_scene;
use crate::codec::{Coding, References, decode_with};
use crate::kernels::layering::parts::{frame_from_words, words_from_rows};
use crate::kernels::rows_of;
use crate::layer::LayeredFrame;
use crate::volume::procedural::Builtin;

/// A frame with these rows of another.
fn with_rows(frame: &LayeredFrame, rows: Vec<u32>) -> LayeredFrame {
    let words = words_from_rows(frame, &rows);
    frame_from_words(frame.header, &[rows], &[words]).unwrap()
}

/// What each of `num` processes has of a coded frame, where each has the references `before`. Without notes, the
/// references are as a viewer has them.
fn coded(
    frame: &LayeredFrame,
    coding: &Coding,
    before: &[Option<Arc<Reference>>],
    has_notes: bool,
) -> Vec<(EncodedFrame, Option<Arc<Reference>>)> {
    let (num, height) = (before.len(), frame.header.camera.intrinsics.height);
    let shares: Vec<_> = (0..num).map(|rank| with_rows(frame, rows_of(rank, num, height))).collect();
    let works: Vec<_> = shares.iter().map(|share| coding.work_of_rows(share)).collect();
    let work: Vec<usize> = (0..works[0].len()).map(|row| works.iter().map(|work| work[row]).sum()).collect();
    let plans: Vec<_> =
        before.iter().map(|before| coding.bands(frame.header, before.as_deref(), &work).unwrap()).collect();
    let coder = |band: usize| band % num;
    let bands: Vec<CodedBand> = (0..plans[0].num())
        .map(|band| {
            let plan = &plans[coder(band)];
            // The coder gets these rows, and no others.
            let rows = plan.rows(band).map(|row| row as u32).collect();
            plan.encode(&with_rows(frame, rows), band, ALWAYS).unwrap()
        })
        .collect();
    let of_rank = |rank: usize| {
        let bands = bands.iter().enumerate().map(|(i, band)| {
            let notes = if has_notes { band.notes.clone() } else { Vec::new() };
            match coder(i) == rank {
                true => CodedBand { notes, ..band.clone() },
                false => CodedBand::of_other(band.payload.clone(), notes),
            }
        });
        plans[rank].join(bands.collect()).unwrap()
    };
    (0..num).map(of_rank).collect()
}

#[test]
fn frames_coded_by_several_processes_are_those_of_one_to_the_byte() {
    let blocks = |quality, max_bands| Coding::Blocks(Settings { max_bands, ..Settings::of(quality) });
    let scene = soft_scene(Builtin::Cubus);
    for (num, coding) in [(2, Coding::Exact), (3, Coding::Exact), (3, blocks(80, 8)), (4, blocks(60, 3))] {
        let (mut of_one, mut of_all, mut references) = (None, vec![None; num], References::default());
        for id in 1..=3 {
            // Odd sizes, and a picture that moves by parts of a list.
            let frame = made(&scene, id, 150, 157, id as f32);
            let (expected, reference) = coding.encode(&frame, of_one.as_deref()).unwrap();
            let found = coded(&frame, &coding, &of_all, true);
            assert!(expected.chunks.len() > 1);
            for (encoded, other) in &found {
                assert_eq!(encoded, &expected, "{num} {coding:?} {id}");
                assert_eq!(other, &reference);
            }
            // The control: the next frame depends on what coders have noted, too.
            if id == 2 && reference.is_some() {
                let next = made(&scene, 3, 150, 157, 3.0);
                let without = coded(&frame, &coding, &of_all, false);
                let without: Vec<_> = without.into_iter().map(|(_, reference)| reference).collect();
                let (truth, _) = coding.encode(&next, reference.as_deref()).unwrap();
                assert!(coded(&next, &coding, &without, true)[0].0 != truth, "{num} {coding:?}");
            }
            let chunks: Vec<_> = found[0].0.chunks.iter().map(|chunk| &chunk.bytes).collect();
            let (_, received) = decode_with(&chunks, &references, None).unwrap();
            received.into_iter().for_each(|received| references.insert(received));
            of_one = reference;
            of_all = found.into_iter().map(|(_, reference)| reference).collect();
        }
    }
}

#[test]
fn bands_that_are_missing_or_damaged_are_errors() {
    let frame = made(&soft_scene(Builtin::Cubus), 1, 100, 157, 1.0);
    let coding = Coding::Blocks(Settings { max_bands: 3, ..Settings::of(60) });
    let work = coding.work_of_rows(&frame);
    let plan = coding.bands(frame.header, None, &work).unwrap();
    let band = |i| plan.encode(&frame, i, ALWAYS).unwrap();
    let bands: Vec<_> = (0..plan.num()).map(band).collect();
    assert!(plan.join(bands.clone()).is_ok());
    let fewer = plan.join(bands[1..].to_vec());
    assert!(matches!(fewer, Err(CodecError::Incomplete { .. })));
    let mut cut = bands.clone();
    let half = cut[1].payload[..cut[1].payload.len() / 2].to_vec();
    cut[1] = CodedBand::of_other(half, Vec::new());
    assert!(plan.join(cut).is_err());
    assert_eq!(plan.encode(&frame, 0, &|| false).err(), Some(CodecError::Abandoned));
}
