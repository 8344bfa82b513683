//! Both halves by themselves: chunks in any order, at any time.

use super::super::ledger::MAX_LIVES;
use super::*;

fn place(frame: u32, index: u16) -> ChunkPlace {
    ChunkPlace {
        frame: FrameId(frame),
        pose: PoseId(frame * 10),
        index: ChunkIndex(index),
        num_chunks: 3,
        prediction: None,
    }
}

fn arrive(s: &mut ChunksClient, now: u64, frame: u32, index: u16) -> Result<(), ChunkError> {
    s.handle_chunk(now, now, place(frame, index), vec![index as u8; 3])
}

/// All chunks of an exact frame arrive at 0.
fn whole(s: &mut ChunksClient, frame: u32) {
    (0..3).for_each(|index| arrive(s, 0, frame, index).unwrap());
}

#[test]
fn a_frame_is_decoded_once_all_its_chunks_are_there() {
    let mut s = ChunksClient::default();
    s.handle_connected();
    s.handle_pose(5, PoseId(10));
    for (now, index) in [(10, 2), (11, 1)] {
        arrive(&mut s, now, 1, index).unwrap();
        assert!(s.poll_decode(now).is_none());
    }
    assert_eq!(s.newest_complete(), None);
    arrive(&mut s, 12, 1, 0).unwrap();
    assert_eq!(s.newest_complete(), Some(FrameId(1)));
    let job = s.poll_decode(13).unwrap();
    assert_eq!((job.frame, job.chunks.len()), (FrameId(1), 3));
    assert!(s.poll_decode(13).is_none());
    let life = s.handle_decoded(15, job.connection, job.frame).unwrap();
    let stages =
        [Stage::Asked, Stage::FirstByteReceived, Stage::Received, Stage::DecodingBegun, Stage::Decoded];
    assert_eq!(stages.map(|s| life.at(s)), [5, 10, 12, 13, 15].map(Some));
    assert_eq!(life.bytes, 9);
    s.handle_shown(30, FrameId(1));
    s.handle_shown(40, FrameId(1));
    assert_eq!(s.ledger().get(FrameId(1)).unwrap().at(Stage::Shown), Some(30));
    assert_eq!((s.frames_per_second(30), s.frames_per_second(2_000_000)), (1, 0));
}

#[test]
fn chunks_that_contradict_are_errors_and_late_ones_are_dropped() {
    let mut s = ChunksClient::default();
    let bad = [
        ChunkPlace { num_chunks: MAX_CHUNKS as u16 + 1, ..place(1, 0) },
        ChunkPlace { num_chunks: 0, ..place(1, 0) },
        place(1, 3),
    ];
    for p in bad {
        assert_eq!(s.handle_chunk(0, 0, p, vec![]), Err(ChunkError::Place(p)));
    }
    arrive(&mut s, 0, 2, 0).unwrap();
    assert_eq!(arrive(&mut s, 0, 2, 0), Err(ChunkError::Twice(FrameId(2), ChunkIndex(0))));
    let other = ChunkPlace { num_chunks: 2, ..place(2, 1) };
    assert_eq!(s.handle_chunk(0, 0, other, vec![]), Err(ChunkError::Disagree(FrameId(2))));
    arrive(&mut s, 0, 1, 0).unwrap();
    assert_eq!(s.assembling.len(), 2, "the control: frame 2 is not complete yet");
    arrive(&mut s, 0, 2, 1).unwrap();
    arrive(&mut s, 0, 2, 2).unwrap();
    arrive(&mut s, 0, 1, 1).unwrap();
    assert_eq!(s.assembling.len(), 1, "frame 1 is older than a complete frame");
    assert!(!s.wants(FrameId(1), false) && s.wants(FrameId(2), false));
}

#[test]
fn any_order_of_arrival_keeps_the_bounds_and_never_goes_back() {
    // A small multiplicative generator is random enough for orders of arrival.
    let mut seed = 12345u64;
    let mut random = move |n: u64| {
        seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (seed >> 33) % n
    };
    let mut s = ChunksClient::default();
    s.handle_connected();
    let (mut shown, mut jobs) = (FrameId(0), 0);
    let mut in_flight: Vec<(u32, u16)> = vec![];
    for now in 0..20_000u64 {
        if now % 3 == 0 {
            in_flight.extend((0..3).map(|i| (now as u32 / 3 + 1, i)));
        }
        let newest = in_flight.len().saturating_sub(24);
        in_flight.drain(..newest.min(random(2) as usize * newest));
        let (frame, index) = in_flight.swap_remove(random(in_flight.len() as u64) as usize);
        arrive(&mut s, now, frame, index).unwrap();
        assert!(s.assembling.len() <= MAX_ASSEMBLING);
        assert!(s.ledger.iter().count() <= MAX_LIVES);
        while let Some(job) = s.poll_decode(now) {
            assert!(job.frame > shown && job.chunks.len() == 3);
            shown = job.frame;
            jobs += 1;
            assert!(s.handle_decoded(now, job.connection, job.frame).is_some());
        }
    }
    assert!(jobs > 500, "{jobs}");
}

#[test]
fn predicted_frames_wait_for_what_they_name() {
    let mut s = ChunksClient::default();
    s.handle_connected();
    let arrive = |s: &mut ChunksClient, frame: u32, reference: u32| {
        let prediction = Some(Prediction { reference: (reference > 0).then_some(FrameId(reference)) });
        let place = ChunkPlace { num_chunks: 1, prediction, ..place(frame, 0) };
        s.handle_chunk(0, 0, place, vec![]).unwrap();
    };
    let decode = |s: &mut ChunksClient| {
        let job = s.poll_decode(0)?;
        s.handle_decoded(0, job.connection, job.frame);
        Some(job.frame.0)
    };
    // Frame 3 names 2, which is on its way: none but 1 can be shown.
    arrive(&mut s, 1, 0);
    arrive(&mut s, 3, 2);
    assert_eq!((s.newest_complete(), decode(&mut s), decode(&mut s)), (None, Some(1), None));
    assert_eq!(s.newest_complete(), Some(FrameId(1)));
    arrive(&mut s, 2, 1);
    assert_eq!((decode(&mut s), decode(&mut s), decode(&mut s)), (Some(2), Some(3), None));
    // Frame 4 is lost: 5 and 6 name it or each other, 7 does not.
    arrive(&mut s, 5, 4);
    arrive(&mut s, 6, 5);
    assert_eq!((decode(&mut s), s.newest_complete()), (None, Some(FrameId(3))));
    arrive(&mut s, 7, 3);
    assert_eq!((decode(&mut s), s.assembling.len()), (Some(7), 0));
    // A frame that names none ends all before it, also those that wait.
    arrive(&mut s, 9, 8);
    arrive(&mut s, 10, 0);
    assert_eq!((decode(&mut s), decode(&mut s)), (Some(10), None));
    // A frame that could not be decoded is no reference.
    arrive(&mut s, 11, 10);
    let job = s.poll_decode(0).unwrap();
    arrive(&mut s, 12, 11);
    s.handle_broken(job.connection, job.frame);
    assert_eq!((decode(&mut s), s.newest_complete()), (None, Some(FrameId(10))));
    arrive(&mut s, 13, 10);
    assert_eq!(decode(&mut s), Some(13));
    s.handle_connected();
    arrive(&mut s, 1, 13);
    assert_eq!((decode(&mut s), s.newest_complete()), (None, None));
}

/// An exact frame among predicted ones neither overtakes those that later frames may name, nor waits for what can
/// never be decoded.
#[test]
fn an_exact_frame_comes_after_the_references_before_it() {
    let decode = |s: &mut ChunksClient| {
        let job = s.poll_decode(0)?;
        s.handle_decoded(0, job.connection, job.frame);
        Some(job.frame.0)
    };
    let arrive = |s: &mut ChunksClient, frame: u32, index: u16, prediction: Option<Option<u32>>| {
        let prediction = prediction.map(|r| Prediction { reference: r.map(FrameId) });
        let place = ChunkPlace { num_chunks: 2, prediction, ..place(frame, index) };
        s.handle_chunk(0, 0, place, vec![]).unwrap();
    };
    let whole = |s: &mut ChunksClient, frame: u32, prediction| {
        arrive(s, frame, 0, prediction);
        arrive(s, frame, 1, prediction);
    };
    let begun = || {
        let mut s = ChunksClient::default();
        s.handle_connected();
        whole(&mut s, 1, Some(None));
        assert_eq!(decode(&mut s), Some(1));
        s
    };
    // Half of 2 is there when all of 3 is, which is exact.
    let mut s = begun();
    arrive(&mut s, 2, 0, Some(Some(1)));
    whole(&mut s, 3, None);
    assert_eq!(decode(&mut s), None);
    arrive(&mut s, 2, 1, Some(Some(1)));
    assert_eq!((decode(&mut s), decode(&mut s)), (Some(2), Some(3)));
    assert_eq!(s.newest_complete(), Some(FrameId(3)));
    whole(&mut s, 4, Some(Some(2)));
    assert_eq!((decode(&mut s), s.newest_complete()), (Some(4), Some(FrameId(4))));
    // Frame 5 is lost: 6 and 7 cannot be decoded, and 8 waits for neither.
    whole(&mut s, 6, Some(Some(5)));
    whole(&mut s, 7, Some(Some(6)));
    assert_eq!(decode(&mut s), None);
    whole(&mut s, 8, None);
    assert_eq!((decode(&mut s), s.assembling.len()), (Some(8), 0));
    // Nor does it overtake one that is being decoded.
    let mut s = begun();
    whole(&mut s, 2, Some(Some(1)));
    let job = s.poll_decode(0).unwrap();
    whole(&mut s, 3, None);
    assert!(s.poll_decode(0).is_none());
    s.handle_decoded(0, job.connection, job.frame);
    assert_eq!((decode(&mut s), decode(&mut s)), (Some(3), None));
    whole(&mut s, 4, Some(Some(2)));
    assert_eq!(decode(&mut s), Some(4));
    // A broken one is not waited for either.
    let mut s = begun();
    whole(&mut s, 2, Some(Some(1)));
    let job = s.poll_decode(0).unwrap();
    arrive(&mut s, 3, 0, Some(Some(2)));
    whole(&mut s, 4, None);
    s.handle_broken(job.connection, job.frame);
    assert_eq!(decode(&mut s), Some(4));
}

/// All of frame 2 is lost, and 3, which is exact, comes before it is sent again: those after may be predicted from it.
#[test]
fn what_an_exact_frame_has_overtaken_is_decoded_for_those_that_name_it() {
    let mut s = ChunksClient::default();
    s.handle_connected();
    let whole = |s: &mut ChunksClient, frame: u32, prediction: Option<Option<u32>>| {
        let prediction = prediction.map(|r| Prediction { reference: r.map(FrameId) });
        let place = ChunkPlace { num_chunks: 1, prediction, ..place(frame, 0) };
        s.handle_chunk(0, 0, place, vec![]).unwrap();
    };
    let decode = |s: &mut ChunksClient| {
        let job = s.poll_decode(0)?;
        let is_shown = s.handle_decoded(0, job.connection, job.frame).is_some();
        Some((job.frame.0, is_shown))
    };
    whole(&mut s, 1, Some(None));
    whole(&mut s, 3, None);
    assert_eq!([decode(&mut s), decode(&mut s)], [Some((1, true)), Some((3, true))]);
    whole(&mut s, 5, Some(Some(2)));
    assert_eq!(decode(&mut s), None);
    whole(&mut s, 2, Some(Some(1)));
    assert_eq!([decode(&mut s), decode(&mut s), decode(&mut s)], [Some((2, false)), Some((5, true)), None]);
    assert_eq!(s.newest_complete(), Some(FrameId(5)));
    // Once others go on from a newer one, or it was decoded, or nothing is predicted from it, it is of no use.
    assert!(!s.wants(FrameId(4), true));
    whole(&mut s, 7, None);
    assert_eq!(decode(&mut s), Some((7, true)));
    assert!(s.wants(FrameId(6), true) && !s.wants(FrameId(6), false) && !s.wants(FrameId(5), true));
    // One that is broken stands in nobody's way.
    whole(&mut s, 6, Some(Some(5)));
    let job = s.poll_decode(0).unwrap();
    s.handle_broken(job.connection, job.frame);
    assert_eq!((decode(&mut s), s.newest_complete()), (None, Some(FrameId(7))));
    whole(&mut s, 8, Some(Some(5)));
    assert_eq!(decode(&mut s), Some((8, true)));
}

/// Of what was dropped for a newer frame, the rest comes late: it can never be whole, so nothing waits for it.
#[test]
fn the_rest_of_a_frame_that_was_dropped_stands_in_nobodys_way() {
    let mut s = ChunksClient::default();
    s.handle_connected();
    let chunk = |s: &mut ChunksClient, frame: u32, index: u16, num: u16, prediction: Option<Option<u32>>| {
        let prediction = prediction.map(|r| Prediction { reference: r.map(FrameId) });
        let place = ChunkPlace { num_chunks: num, prediction, ..place(frame, index) };
        s.handle_chunk(0, 0, place, vec![]).unwrap();
    };
    let decode = |s: &mut ChunksClient| {
        let job = s.poll_decode(0)?;
        let is_shown = s.handle_decoded(0, job.connection, job.frame).is_some();
        Some((job.frame.0, is_shown))
    };
    chunk(&mut s, 1, 0, 1, Some(None));
    assert_eq!(decode(&mut s), Some((1, true)));
    // 2 is lost, and half of 3, which names it. 4 is exact.
    chunk(&mut s, 3, 0, 2, Some(Some(2)));
    chunk(&mut s, 4, 0, 1, None);
    assert_eq!(decode(&mut s), Some((4, true)));
    chunk(&mut s, 2, 0, 1, Some(Some(1)));
    assert_eq!(decode(&mut s), Some((2, false)));
    chunk(&mut s, 3, 1, 2, Some(Some(2)));
    // The camera rests: the exact frame is shown, and does not wait for 3.
    chunk(&mut s, 5, 0, 1, None);
    assert_eq!(decode(&mut s), Some((5, true)));
}

/// While a lost packet is sent again, as many frames come as may be predicted from each other. None of them is lost.
#[test]
fn what_was_held_up_is_waited_for_as_long_as_others_may_be_predicted_from_it() {
    let mut s = ChunksClient::default();
    s.handle_connected();
    let arrive = |s: &mut ChunksClient, frame: u32, num_bytes: usize| {
        let prediction = Some(Prediction { reference: (frame > 1).then(|| FrameId(frame - 1)) });
        let place = ChunkPlace { num_chunks: 1, prediction, ..place(frame, 0) };
        s.handle_chunk(0, 0, place, vec![0; num_bytes]).unwrap();
    };
    let last = MAX_ASSEMBLING as u32;
    (2..=last).for_each(|frame| arrive(&mut s, frame, 1));
    assert!(s.poll_decode(0).is_none() && s.wants(FrameId(1), true));
    arrive(&mut s, 1, 1);
    for frame in 1..=last {
        let job = s.poll_decode(0).unwrap();
        assert_eq!(job.frame, FrameId(frame));
        s.handle_decoded(0, job.connection, job.frame);
    }
    // Bytes are bounded whatever their number.
    (last + 2..last + 6).for_each(|frame| arrive(&mut s, frame, MAX_ASSEMBLING_BYTES / 3));
    assert_eq!(s.assembling.len(), 3);
    assert!(!s.assembling.contains_key(&FrameId(last + 2)));
}

#[test]
fn a_broken_frame_does_not_stand_in_the_way() {
    let mut s = ChunksClient::default();
    s.handle_connected();
    whole(&mut s, 1);
    let job = s.poll_decode(0).unwrap();
    s.handle_decoded(0, job.connection, job.frame);
    whole(&mut s, 1_000_000);
    let job = s.poll_decode(0).unwrap();
    assert_eq!((job.frame, s.newest_complete()), (FrameId(1_000_000), Some(FrameId(1_000_000))));
    s.handle_broken(job.connection, job.frame);
    assert_eq!(s.newest_complete(), Some(FrameId(1)));
    whole(&mut s, 2);
    assert_eq!(s.poll_decode(0).unwrap().frame, FrameId(2));
}

#[test]
fn a_new_connection_starts_its_frames_again() {
    let mut s = ChunksClient::default();
    s.handle_connected();
    whole(&mut s, 50);
    let old = s.poll_decode(0).unwrap();
    s.handle_connected();
    assert!(s.handle_decoded(1, old.connection, old.frame).is_none());
    assert_eq!(s.newest_complete(), None);
    for _ in 0..2 {
        // Frame 1 is new on every connection.
        whole(&mut s, 1);
        let job = s.poll_decode(2).unwrap();
        assert_eq!(job.frame, FrameId(1));
        assert!(s.handle_decoded(3, job.connection, job.frame).is_some());
        assert!(arrive(&mut s, 4, 1, 0).is_err());
        s.handle_connected();
    }
}

#[test]
fn a_frame_outlives_newer_ones_until_one_of_them_is_complete() {
    let mut s = ChunksServer::default();
    for n in 1..100 {
        s.handle_handed(FrameId(n));
        assert!(!s.is_superseded(FrameId(1)), "frame 1 is all that may ever arrive");
    }
    s.handle_delivered(FrameId(40));
    for n in 1..100 {
        assert_eq!(s.is_superseded(FrameId(n)), n < 40);
    }
}

#[test]
fn a_claim_of_frames_never_sent_does_not_stop_the_newest() {
    let mut s = ChunksServer::default();
    s.handle_handed(FrameId(5));
    s.handle_report(FrameId(u32::MAX), true);
    assert_eq!((s.newest_complete(), s.reported()), (FrameId(5), FrameId(5)));
    s.handle_handed(FrameId(6));
    assert!(!s.is_superseded(FrameId(6)));
}

#[test]
fn what_the_newest_pose_reports_may_go_back() {
    let mut s = ChunksServer::default();
    s.handle_handed(FrameId(9));
    for (named, is_newest, reported) in
        [(5, true, 5), (7, true, 7), (4, false, 7), (6, true, 6), (5, true, 5)]
    {
        s.handle_report(FrameId(named), is_newest);
        assert_eq!(s.reported(), FrameId(reported));
    }
    assert_eq!(s.newest_complete(), FrameId(7));
}

#[test]
fn priorities_never_mix_ranks() {
    use Rank::{Finer, Independent, Predicting};
    for n in [1u32, 2, 1_000_000, 0x01ff_fffe] {
        let (old, new) = (FrameId(n), FrameId(n + 1));
        let p = priority;
        assert!(p(new, Independent) > p(old, Independent));
        assert!(p(new, Finer) > p(old, Finer));
        assert!(p(old, Independent) > p(new, Finer));
        assert!(p(FrameId(0), Independent) > p(FrameId(FRAMES), Finer));
        // What others wait for goes before them.
        assert!(p(old, Predicting) > p(new, Predicting));
        assert!(p(FrameId(FRAMES), Predicting) > p(FrameId(FRAMES), Independent));
        assert!(p(FrameId(0), Predicting) < CONTROL_PRIORITY);
        assert!(p(FrameId(0), Predicting) < SLICE_PRIORITY);
        assert!(p(FrameId(0), Finer) > SLICE_AHEAD_PRIORITY);
    }
}
