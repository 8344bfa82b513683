//! Damaged and contradicting bytes are refused by name.

use super::*;

/// Decodes a chunk as if it were all of its frame.
fn decode_one(bytes: &[u8]) -> Result<LayeredFrame, CodecError> {
    decode(&[bytes])
}

#[test]
fn bad_borders_are_named() {
    let frame = random_frame(48, 200, 5, 22);
    let good = encode(&frame).unwrap();
    let with = |ends: [u16; 2]| {
        let mut chunks: Vec<Vec<u8>> = good.chunks.iter().map(|chunk| chunk.bytes.clone()).collect();
        for bytes in &mut chunks {
            bytes[HEADER_BYTES..HEADER_BYTES + 4].copy_from_slice(ends.map(u16::to_le_bytes).as_flattened());
        }
        decode(&chunks)
    };
    // There are 13 rows of tiles.
    for ends in [[0, 5], [5, 5], [6, 5], [5, 13], [5, u16::MAX]] {
        let error = with(ends).unwrap_err();
        assert!(matches!(error, CodecError::Payload { plane: "borders", .. }), "{ends:?} {error}");
    }
    let header = ChunkHeader { payload_bytes: 3, ..peek(&good.chunks[0].bytes).unwrap() };
    let cut = [&header.to_bytes()[..], &[1, 0, 2]].concat();
    let found = Opened::new(&header, &cut).err();
    assert!(matches!(found, Some(CodecError::Payload { plane: "borders", .. })));
}

#[test]
fn bad_headers_are_named() {
    let good = encode(&random_frame(16, 16, 4, 10)).unwrap().chunks[0].bytes.clone();
    assert!(decode_one(&good).is_ok());
    let with = |at: usize, byte: u8| {
        let mut bytes = good.clone();
        bytes[at] = byte;
        decode_one(&bytes).unwrap_err()
    };
    assert!(matches!(with(0, b'X'), CodecError::Magic(_)));
    assert_eq!(with(4, 2), CodecError::Version { found: 2, expected: 4 });
    for (at, byte, name) in [
        (5, 0, "k"),
        (5, 33, "k"),
        (6, 6, "coding and fineness"),
        (7, 5, "mode"),
        (8, 1, "chunk index"),
        (10, 0, "number of chunks"),
        (10, 2, "number of chunks"),
    ] {
        let found = with(at, byte);
        assert!(matches!(found, CodecError::Header { what, .. } if what == name), "{at} {found:?}");
    }
    assert!(matches!(with(27, 0xff), CodecError::Header { what: "camera", .. }));
    let found = good.len() - 1;
    assert_eq!(decode_one(&good[..found]), Err(CodecError::Length { found, expected: good.len() }));
    assert!(matches!(peek(&good[..10]), Err(CodecError::Length { found: 10, expected: HEADER_BYTES })));
    assert!(matches!(decode::<Vec<u8>>(&[]), Err(CodecError::Incomplete { found: 0, .. })));
    assert_eq!(with(4, 1).to_string(), "chunk format version 1, expected 4");
}

#[test]
fn contradicting_chunks_are_refused() {
    let frame = random_frame(40, 400, 8, 21);
    let encoded = encode(&frame).unwrap();
    let chunks = bytes(&encoded);
    let with = |other: &[u8]| {
        let mut chunks = chunks.clone();
        chunks[1] = other;
        decode(&chunks).err()
    };
    assert_eq!(with(chunks[1]), None);
    assert_eq!(with(chunks[0]), Some(CodecError::Duplicate(ChunkIndex(0))));
    let mut later = frame.clone();
    later.header.frame = FrameId(8);
    let mut moved = frame.clone();
    moved.header.camera.far *= 1.5;
    for other in [later, moved] {
        let found = with(&encode(&other).unwrap().chunks[1].bytes);
        assert!(matches!(found, Some(CodecError::Contradiction { .. })), "{found:?}");
    }
    // A chunk of a frame under this frame's name whose bands end elsewhere.
    let lower = encode(&without_top(frame.clone(), 112)).unwrap();
    let found = with(&lower.chunks[1].bytes);
    let what = "other borders of bands";
    assert!(
        matches!(found, Some(CodecError::Contradiction { what: found, .. }) if found == what),
        "{found:?}"
    );
    assert!(matches!(with(&chunks[1][..chunks[1].len() - 1]), Some(CodecError::Length { .. })));
    let more = [&chunks[..], &chunks[..1]].concat();
    assert!(matches!(decode(&more), Err(CodecError::TooLarge { what: "chunks", .. })));
}

#[test]
fn damaged_bytes_never_do_more_than_fail() {
    let mut random = Random(13);
    let (mut refused, mut accepted) = (0, 0);
    for k in [8, 3] {
        let encoded = encode(&random_frame(20, 130, k, 14)).unwrap();
        let chunks = bytes(&encoded);
        assert_eq!(chunks.len(), 2);
        for (n, chunk) in chunks.iter().enumerate() {
            for _ in 0..1500 {
                let mut bytes = chunk.to_vec();
                for _ in 0..1 + random.below(3) {
                    // Half of the damage hits the header, the lengths and the first tables, a small part of the bytes.
                    let reach = [bytes.len(), HEADER_BYTES + 90][random.below(2)].min(bytes.len());
                    let at = random.below(reach);
                    bytes[at] ^= 1 << random.below(8);
                }
                if random.below(4) == 0 {
                    bytes.truncate(random.below(bytes.len() + 1));
                }
                // In the place of the chunk it was, among its fellows.
                let mut damaged = chunks.clone();
                damaged[n] = &bytes;
                match decode(&damaged) {
                    Ok(frame) => {
                        accepted += 1;
                        frame.validate().unwrap();
                    }
                    Err(_) => refused += 1,
                }
            }
            for len in 0..chunk.len() {
                let mut damaged = chunks.clone();
                damaged[n] = &chunk[..len];
                assert!(decode(&damaged).is_err());
            }
        }
    }
    assert!(refused > 1000 && accepted > 100, "{refused} refused, {accepted} accepted");
}

#[test]
fn a_small_chunk_cannot_ask_for_much() {
    let (width, height) = (8192u32, 4080u32);
    let chunk = ChunkHeader {
        frame: header(width, height, 32),
        is_exact: true,
        index: ChunkIndex(0),
        num_chunks: 1,
        payload_bytes: 0,
    };
    // Tables with one number each take no bits of the streams: every list has as many segments as its table says.
    let forged = |length: u8| {
        let mut tables = rans::BitWriter::default();
        let only = |token: usize| std::array::from_fn(|i| if i == token { 4096 } else { 0 });
        for (plane, contexts) in contexts::CONTEXTS.into_iter().enumerate() {
            // A front one unit behind what is expected, and a back one behind that.
            let token = [usize::from(length), 0, 2, 0, 0, 0, 0][plane];
            tables.frequencies(&only(token));
            (1..contexts).for_each(|_| tables.push(1, 1));
        }
        let mut table_bytes = vec![];
        tables.finish(&mut table_bytes);
        let mut payload = vec![0xff; (width as usize / TILE * (height as usize / TILE)).div_ceil(8)];
        payload.extend((table_bytes.len() as u32).to_le_bytes());
        (0..contexts::NUM_PLANES).for_each(|_| payload.extend([4, 0, 0, 0, 0, 0, 0, 0]));
        payload.extend(table_bytes);
        (0..contexts::NUM_PLANES).for_each(|_| payload.extend([0, 0, 1, 0]));
        let mut bytes = ChunkHeader { payload_bytes: payload.len() as u32, ..chunk }.to_bytes().to_vec();
        bytes.extend(payload);
        assert!(bytes.len() < 20_000);
        decode_one(&bytes)
    };
    assert!(matches!(forged(8), Err(CodecError::TooLarge { limit: MAX_CHUNK_SEGMENTS, .. })));
    assert!(matches!(forged(33), Err(CodecError::Payload { plane: "lengths", .. })));
    assert_eq!(forged(0).unwrap().num_segments(), 0);
    let wide = ChunkHeader { frame: header(8192, 8192, 16), ..chunk };
    assert!(matches!(peek(&wide.to_bytes()), Err(CodecError::TooLarge { limit: MAX_FRAME_LISTS, .. })));
}
