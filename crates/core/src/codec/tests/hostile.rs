//! Damaged and contradicting bytes are refused by name.

use super::*;

#[test]
fn bad_borders_are_named() {
    let frame = random_frame(48, 200, 5, 22);
    let good = encode(&frame, &Settings::default()).unwrap().chunks[0].bytes.clone();
    let header = peek(&good).unwrap();
    assert!(header.has_borders && header.num_base == 3);
    let with = |ends: [u16; 2]| {
        let mut bytes = good.clone();
        bytes[HEADER_BYTES..HEADER_BYTES + 4].copy_from_slice(ends.map(u16::to_le_bytes).as_flattened());
        decode_chunk(&bytes)
    };
    // There are 13 rows of tiles.
    for ends in [[0, 5], [5, 5], [6, 5], [5, 13], [5, u16::MAX]] {
        let error = with(ends).unwrap_err();
        assert!(matches!(error, CodecError::Payload { plane: "borders", .. }), "{ends:?} {error}");
    }
    let short = ChunkHeader { payload_bytes: 3, ..header };
    let cut = [&short.to_bytes()[..], &[1, 0, 2]].concat();
    assert!(matches!(decode_chunk(&cut), Err(CodecError::Payload { plane: "borders", .. })));
    // One band ends nowhere, and blocks say it elsewhere.
    let one = ChunkHeader { num_base: 1, band: 0, num_chunks: 1, index: ChunkIndex(0), ..header };
    let one = [&one.to_bytes()[..], &good[HEADER_BYTES..]].concat();
    assert!(matches!(decode_chunk(&one), Err(CodecError::Payload { plane: "borders", .. })));
    let blocks = ChunkHeader { color_bits: 0, ..header };
    let error = peek(&blocks.to_bytes()).unwrap_err();
    assert!(matches!(error, CodecError::Header { what: "borders in front of blocks", .. }), "{error}");
}

#[test]
fn bad_settings_and_bad_headers_are_named() {
    let frame = random_frame(16, 16, 4, 10);
    for settings in [
        Settings { color_bits: 9, num_groups: 2 },
        Settings { color_bits: 8, num_groups: 0 },
        Settings { color_bits: 8, num_groups: 3 },
    ] {
        assert!(matches!(encode(&frame, &settings), Err(CodecError::Header { .. })));
    }
    let good = encode(&frame, &Settings::default()).unwrap().chunks[0].bytes.clone();
    let with = |at: usize, byte: u8| {
        let mut bytes = good.clone();
        bytes[at] = byte;
        decode_chunk(&bytes).unwrap_err()
    };
    assert!(matches!(with(0, b'X'), CodecError::Magic(_)));
    assert_eq!(with(4, 1), CodecError::Version(1));
    for (at, byte, name) in
        [(5, 0, "k"), (5, 33, "k"), (6, 9, "bits of colour"), (7, 1, "band"), (8, 9, "chunk index")]
    {
        assert!(
            matches!(with(at, byte), CodecError::Header { what, .. } if what == name),
            "{at} {:?}",
            with(at, byte)
        );
    }
    assert!(matches!(with(27, 0xff), CodecError::Header { what: "camera", .. }));
    assert_eq!(
        decode_chunk(&good[..good.len() - 1]),
        Err(CodecError::Length { found: good.len() - 1, expected: good.len() })
    );
    assert!(matches!(peek(&good[..10]), Err(CodecError::Length { found: 10, expected: HEADER_BYTES })));
    assert!(matches!(decode::<Vec<u8>>(&[]), Err(CodecError::Incomplete { found: 0, .. })));
    assert_eq!(with(4, 1).to_string(), "chunk format version 1, expected 2");
}

#[test]
fn contradicting_chunks_are_refused_and_change_nothing() {
    let frame = random_frame(40, 130, 8, 11);
    let chunks = |frame: &LayeredFrame, settings: Settings| -> Vec<DecodedChunk> {
        encode(frame, &settings).unwrap().chunks.iter().map(|c| decode_chunk(&c.bytes).unwrap()).collect()
    };
    let ours = chunks(&frame, Settings::default());
    let mut assembly = Assembly::new(&ours[0].header);
    assembly.insert(ours[0].clone()).unwrap();
    let before = assembly.to_frame(None);
    let mut later = frame.clone();
    later.header.frame = FrameId(8);
    let mut moved = frame.clone();
    moved.header.camera.far *= 1.5;
    for other in [
        chunks(&later, Settings::default()),
        chunks(&moved, Settings::default()),
        chunks(&frame, ALL_BITS[0]),
    ] {
        assert!(matches!(assembly.insert(other[1].clone()), Err(CodecError::Contradiction { .. })));
    }
    assert_eq!(assembly.insert(ours[0].clone()), Err(CodecError::Duplicate(ChunkIndex(0))));
    let mut same_band = ours[1].clone();
    same_band.header.band = ours[0].header.band;
    assert!(matches!(assembly.insert(same_band), Err(CodecError::Contradiction { .. })));
    // The refinement of another frame under this frame's name: its segments collide with the base.
    let mut other = random_frame(40, 130, 8, 12);
    other.header = frame.header;
    let band = ours[0].header.band;
    let other = chunks(&other, Settings::default());
    let foreign = other.into_iter().find(|c| !c.header.is_base() && c.header.band == band).unwrap();
    let refused = |assembly: &mut Assembly, chunk| match assembly.insert(chunk) {
        Err(CodecError::Contradiction { what, .. }) => what,
        other => panic!("{other:?}"),
    };
    assert_eq!(refused(&mut assembly, foreign), "its segments overlap those of the other group");
    // The other band of a frame under this frame's name that ends its bands elsewhere.
    let lower = without_top(frame.clone(), 112);
    let mut lower = chunks(&lower, Settings::default()).into_iter().find(|c| c.header.band != band).unwrap();
    lower.header.index = ours[1].header.index;
    assert_eq!(refused(&mut assembly, lower), "other borders of bands");
    assert_eq!((assembly.num_inserted(), assembly.to_frame(None)), (1, before));
    for chunk in ours.into_iter().skip(1) {
        assembly.insert(chunk).unwrap();
    }
    assert!(assembly.complete());
}

#[test]
fn damaged_bytes_never_do_more_than_fail() {
    let mut random = Random(13);
    let (mut refused, mut accepted) = (0, 0);
    for (k, bits) in [(8, 10), (3, 8)] {
        let settings = Settings { color_bits: bits, num_groups: 2 };
        let encoded = encode(&random_frame(20, 70, k, 14), &settings).unwrap();
        for chunk in &encoded.chunks {
            for _ in 0..1500 {
                let mut bytes = chunk.bytes.clone();
                for _ in 0..1 + random.below(3) {
                    // Half of the damage hits the header, the lengths and the first tables, a small part of the bytes.
                    let reach = [bytes.len(), HEADER_BYTES + 90][random.below(2)].min(bytes.len());
                    let at = random.below(reach);
                    bytes[at] ^= 1 << random.below(8);
                }
                if random.below(4) == 0 {
                    bytes.truncate(random.below(bytes.len() + 1));
                }
                let Ok(decoded) = decode_chunk(&bytes) else {
                    refused += 1;
                    continue;
                };
                accepted += 1;
                let mut assembly = Assembly::new(&peek(&encoded.chunks[0].bytes).unwrap());
                // In the place of the chunk it was, among its fellows.
                let _ = assembly.insert(decoded);
                for other in &encoded.chunks {
                    let _ = assembly.insert(decode_chunk(&other.bytes).unwrap());
                }
                assembly.to_frame(None).validate().unwrap();
            }
            for len in 0..chunk.bytes.len() {
                assert!(decode_chunk(&chunk.bytes[..len]).is_err());
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
        color_bits: 10,
        index: ChunkIndex(0),
        num_chunks: 1,
        num_base: 1,
        band: 0,
        has_borders: false,
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
        decode_chunk(&bytes)
    };
    assert!(matches!(forged(8), Err(CodecError::TooLarge { limit: MAX_CHUNK_SEGMENTS, .. })));
    assert!(matches!(forged(33), Err(CodecError::Payload { plane: "lengths", .. })));
    assert_eq!(forged(0).unwrap().num_segments(), 0);
    let wide = ChunkHeader { frame: header(8192, 8192, 16), ..chunk };
    assert!(matches!(peek(&wide.to_bytes()), Err(CodecError::TooLarge { limit: MAX_FRAME_LISTS, .. })));
}
