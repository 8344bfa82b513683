//! Damaged and contradicting bytes are refused, and memory is bounded.

use super::*;

/// Large frames leave room for fewer, and both sides agree on which; who has lost one is not sent what it cannot use.
#[test]
fn references_are_bounded_in_bytes() {
    let header = made(&scene(Builtin::Cloud), 1, 64, 64, 0.0).header;
    let band = Arc::new(band::Band::counted_as(MAX_REFERENCE_BYTES / 3));
    let of = |id| {
        let header = FrameHeader { frame: FrameId(id), ..header };
        Arc::new(Reference::new(header, None, vec![band.clone()]))
    };
    let (mut sender, mut receiver) = (References::default(), References::default());
    for id in 1..=40 {
        sender.insert(of(id));
        // It has lost some.
        if id % 4 != 0 {
            receiver.insert(of(id));
        }
        let kept = |references: &References| {
            (1..=id).filter(|&i| references.get(FrameId(i)).is_some()).collect::<Vec<_>>()
        };
        assert_eq!(kept(&sender).len(), id.min(3) as usize);
        assert!(kept(&sender).iter().all(|i| i % 4 == 0 || kept(&receiver).contains(i)));
    }
    assert_eq!(sender.next(FrameId(16)).map(|r| r.frame()), Some(FrameId(40)));
    assert!(sender.next(FrameId(15)).is_none(), "25 are ahead of what it has, which is not kept");
    sender.clear();
    assert!(sender.next(FrameId(40)).is_none());
    // One alone is kept whatever it takes.
    let large = |id| {
        let header = FrameHeader { frame: FrameId(id), ..header };
        Arc::new(Reference::new(header, None, vec![band.clone(); 4]))
    };
    for id in 1..=3 {
        sender.insert(large(id));
        assert_eq!(sender.newest().map(|r| r.frame()), Some(FrameId(id)));
        assert!(sender.get(FrameId(id - 1)).is_none());
    }
}

#[test]
fn damaged_bytes_never_do_more_than_fail() {
    let scene = scene(Builtin::Shells);
    let (_, reference) = encode(&made(&scene, 1, 72, 70, 0.0), &whole(60), None).unwrap();
    let settings = Settings { is_split: true, ..Settings::of(60) };
    let next = made(&scene, 2, 72, 70, 1.0);
    let [predicted, alone] =
        [Some(&reference), None].map(|reference| encode(&next, &settings, reference).unwrap().0);
    let chunks = [predicted.chunks, alone.chunks].concat();
    let mut references = References::default();
    references.insert(Arc::new(reference));
    let mut seed = 11u64;
    let mut random = move |n: usize| {
        seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (seed >> 33) as usize % n
    };
    let (mut good, mut bad) = (0, 0);
    for round in 0..2400 {
        let chunk = &chunks[round / 4 % chunks.len()];
        let mut damaged = chunk.bytes.clone();
        match round % 4 {
            0 => damaged[HEADER_BYTES..].iter_mut().for_each(|b| *b = random(256) as u8),
            1 => {
                let length = HEADER_BYTES + random(damaged.len() - HEADER_BYTES);
                damaged.truncate(length);
                let payload = (length - HEADER_BYTES) as u32;
                damaged[HEADER_BYTES - 4..HEADER_BYTES].copy_from_slice(&payload.to_le_bytes());
            }
            _ => {
                for _ in 0..1 + random(3) {
                    let at = random(damaged.len());
                    damaged[at] ^= 1 << random(8);
                }
            }
        }
        if round % 4 == 0 {
            // Past the head, so that the bits themselves are tried.
            damaged[HEADER_BYTES..HEADER_BYTES + chunk::HEAD_BYTES]
                .copy_from_slice(&chunk.bytes[HEADER_BYTES..HEADER_BYTES + chunk::HEAD_BYTES]);
        }
        match decode_chunk(&damaged, &references) {
            Ok(decoded) => {
                good += 1;
                let mut assembly = Assembly::new(decoded.header());
                if assembly.insert(decoded).is_ok() {
                    assembly.to_frame().validate().unwrap();
                }
            }
            Err(_) => bad += 1,
        }
    }
    // A flipped bit of a range coder goes unnoticed when as many bytes are read as before.
    assert!(bad > 1400, "{good} {bad}");
}

#[test]
fn chunks_that_contradict_each_other_are_refused() {
    let scene = scene(Builtin::Cubus);
    let frame = made(&scene, 1, 70, 140, 0.0);
    let split = |quality| {
        let (encoded, _) =
            encode(&frame, &Settings { is_split: true, ..Settings::of(quality) }, None).unwrap();
        let none = References::default();
        encoded.chunks.iter().map(|c| decode_chunk(&c.bytes, &none).unwrap()).collect::<Vec<_>>()
    };
    let (ours, theirs) = (split(50), split(90));
    let mut assembly = Assembly::new(ours[0].header());
    assembly.insert(ours[0].clone()).unwrap();
    assert_eq!(assembly.insert(ours[0].clone()), Err(CodecError::Duplicate(ChunkIndex(0))));
    assert!(matches!(assembly.insert(theirs[1].clone()), Err(CodecError::Contradiction { .. })));
    let exact = crate::codec::encode(&frame, &crate::codec::Settings::default()).unwrap();
    let exact = decode_chunk(&exact.chunks[1].bytes, &References::default()).unwrap();
    assert!(matches!(exact, DecodedChunk::Exact(_)));
    assert!(matches!(assembly.insert(exact), Err(CodecError::Contradiction { .. })));
    ours.into_iter().skip(1).for_each(|c| assembly.insert(c).unwrap());
    assert!(assembly.complete());
}

#[test]
fn heads_with_unknown_bits_or_with_edges_in_a_predicted_frame_are_refused() {
    let scene = scene(Builtin::Shells);
    let (alone, reference) = encode(&made(&scene, 1, 40, 40, 0.0), &whole(60), None).unwrap();
    let (predicted, _) = encode(&made(&scene, 2, 40, 40, 1.0), &whole(60), Some(&reference)).unwrap();
    let mut references = References::default();
    references.insert(Arc::new(reference));
    let with = |encoded: &EncodedFrame, bits: u8| {
        let mut bytes = encoded.chunks[0].bytes.clone();
        bytes[HEADER_BYTES] ^= bits;
        decode_chunk(&bytes, &references)
    };
    const EDGES: u8 = 8;
    const SMOOTH: u8 = 16;
    assert!(with(&alone, 0).is_ok() && with(&predicted, 0).is_ok());
    assert_eq!([&alone, &predicted].map(|e| e.chunks[0].bytes[HEADER_BYTES] & EDGES), [EDGES, 0]);
    assert!([&alone, &predicted].iter().all(|e| e.chunks[0].bytes[HEADER_BYTES] & SMOOTH != 0));
    for encoded in [&alone, &predicted] {
        for bits in [32, 64, 128] {
            assert!(matches!(with(encoded, bits), Err(CodecError::Payload { plane: "head", .. })), "{bits}");
        }
    }
    assert!(matches!(with(&predicted, EDGES), Err(CodecError::Payload { plane: "head", .. })));
}
