//! Damaged and contradicting bytes are refused, and memory is bounded.

use super::*;

/// Large frames leave room for fewer, and both sides agree on which; who has lost one is not sent what it cannot use.
#[test]
fn references_are_bounded_in_bytes() {
    let header = made(&scene(Builtin::Cloud), 1, 64, 64, 0.0).header;
    let tile = Arc::new(FrameTile::counted_as(MAX_REFERENCE_BYTES / 3));
    let of = |id| {
        let header = FrameHeader { frame: FrameId(id), ..header };
        Arc::new(Reference::new(header, None, vec![tile.clone()], Counts::default()))
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
        Arc::new(Reference::new(header, None, vec![tile.clone(); 4], Counts::default()))
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
    let next = made(&scene, 2, 72, 70, 1.0);
    let [predicted, alone] =
        [Some(&reference), None].map(|reference| encode(&next, &whole(60), reference).unwrap().0);
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
            damaged[HEADER_BYTES..HEADER_BYTES + head::HEAD_BYTES]
                .copy_from_slice(&chunk.bytes[HEADER_BYTES..HEADER_BYTES + head::HEAD_BYTES]);
        }
        match decode_with(&[damaged], &references, None) {
            Ok((frame, _)) => {
                good += 1;
                frame.validate().unwrap();
            }
            Err(_) => bad += 1,
        }
    }
    // A stream must end in the state in which an encoder begins.
    assert!(bad > 2300, "{good} {bad}");
}

#[test]
fn chunks_that_contradict_each_other_are_refused() {
    let frame = made(&scene(Builtin::Cubus), 1, 70, 140, 0.0);
    let [ours, theirs] = [50, 90].map(|quality| {
        let settings = Settings { max_bands: 2, ..whole(quality) };
        encode(&frame, &settings, None).unwrap().0
    });
    let exact = crate::codec::encode(&frame).unwrap();
    let ours = bytes(&ours);
    assert!(decode(&ours).is_ok() && ours.len() == 2);
    assert!(matches!(decode(&[ours[0], ours[0]]), Err(CodecError::Duplicate(_))));
    for other in [&theirs, &exact] {
        assert!(matches!(decode(&[ours[0], &other.chunks[1].bytes]), Err(CodecError::Contradiction { .. })));
    }
}

#[test]
fn heads_with_unknown_flags_are_refused() {
    let scene = scene(Builtin::Shells);
    let (alone, reference) = encode(&made(&scene, 1, 40, 40, 0.0), &whole(60), None).unwrap();
    let (predicted, _) = encode(&made(&scene, 2, 40, 40, 1.0), &whole(60), Some(&reference)).unwrap();
    let mut references = References::default();
    references.insert(Arc::new(reference));
    for encoded in [&alone, &predicted] {
        for flags in 0..=255 {
            let mut bytes = encoded.chunks[0].bytes.clone();
            let is_own = bytes[HEADER_BYTES] == flags;
            bytes[HEADER_BYTES] = flags;
            let found = decode_with(&[bytes], &references, None);
            let is_refused = matches!(
                found,
                Err(CodecError::Payload {
                    plane: "head" | "tables" | "tiles" | "blocks" | "corrections",
                    ..
                } | CodecError::Reference { .. })
            );
            assert!(if is_own { found.is_ok() } else { is_refused }, "{flags}");
        }
    }
}
