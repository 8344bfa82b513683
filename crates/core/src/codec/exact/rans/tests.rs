use super::*;

/// Counts of `n` tokens, each a third rarer than the one before, beginning with token `first`.
fn falling(first: usize, n: usize) -> TokenCounts {
    let mut counts = [0; TOKENS];
    for i in 0..n {
        counts[(first + i) % TOKENS] = (1e6 * 0.67f64.powi(i as i32)) as u32 + 1;
    }
    counts
}

#[test]
fn numbers_are_their_token_and_bits() {
    let mut last = 0;
    for number in (0..70_000).chain([131_071]) {
        let (token, bits, rest) = token(number);
        assert!((last..TOKENS as u8).contains(&token) && rest < 1 << bits && bits < 16);
        last = token;
        let least = NUMBERS[usize::from(token)];
        assert_eq!((least >> 24, (least & 0xff_ffff) + rest), (bits, number));
    }
}

#[test]
fn every_slot_is_in_one_place_for_both_sides() {
    for counts in [falling(0, 64), falling(3, 1), falling(60, 7), falling(0, 30), [1; TOKENS], [0; TOKENS]] {
        let frequencies = frequencies(&counts);
        assert_eq!(frequencies.iter().map(|&f| u32::from(f)).sum::<u32>(), SLOTS);
        assert!(counts.iter().zip(frequencies).all(|(&c, f)| c == 0 || f > 0));
        let mut tables = EncodeTables::default();
        tables.add(&frequencies, 1);
        let mut slots = tables.slots.clone();
        slots.sort_unstable();
        assert!(slots.into_iter().eq(0..SLOTS as u16));
        let decode = DecodeTable::new(&frequencies);
        for (token, &EncodeToken { first, .. }) in tables.tokens.iter().enumerate() {
            let frequency = frequencies[token];
            for number in 0..frequency {
                let slot = u32::from(tables.slots[usize::from(number) + first as usize]);
                let state = (1 << 16 | slot).to_le_bytes();
                let mut stream = TokenStream::new(&state, &[]);
                assert_eq!(stream.next(&decode), NUMBERS[token] & 0xff_ffff);
                // The state is what the definition says: frequency·⌊state/2¹²⌋ + number of the slot.
                let expected = u32::from(frequency) * 16 + u32::from(number);
                assert_eq!(stream.state, if expected < LEAST_STATE { expected << 16 } else { expected });
            }
        }
        let mut writer = BitWriter::default();
        writer.frequencies(&frequencies);
        let mut bytes = vec![];
        writer.finish(&mut bytes);
        assert_eq!(bytes.len(), frequency_bits(&frequencies).div_ceil(8) as usize);
        let mut reader = BitReader::new(&bytes);
        assert_eq!(reader.frequencies(), Ok(frequencies));
        assert!(reader.ended());
    }
}

#[test]
fn states_are_divided_without_division() {
    for frequency in 1..=SLOTS {
        let inverse = (1 << 44) / u64::from(frequency) + 1;
        let divided = |state: u32| (u64::from(state).wrapping_mul(inverse) >> 44) as u32;
        // The greatest state of each quotient, and the least of the next, are where an error shows first.
        let last = (u64::from(frequency) << (32 - SLOT_BITS)) - 1;
        for quotient in [1, 2, 3, 4097, 65_537, (1 << 20) - 2, (1 << 20) - 1u64] {
            let least = (quotient * u64::from(frequency)).min(last) as u32;
            for state in [least - 1, least, least.saturating_add(frequency - 1).min(last as u32), last as u32]
            {
                assert_eq!(divided(state), state / frequency, "{state} / {frequency}");
            }
        }
    }
    // One less is too little where a state is a multiple.
    assert_ne!((u64::from(3 * 4095u32) * ((1 << 44) / 4095)) >> 44, 3);
}

#[test]
fn streams_are_read_as_written_and_are_as_short_as_their_entropy() {
    let tables = [falling(0, 40), falling(20, 12), falling(7, 1)];
    let frequencies = tables.map(|counts| frequencies(&counts));
    let mut seed = 1u64;
    let mut random = |below: u32| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as u32 % below
    };
    let symbols: Vec<(usize, u8)> = (0..40_000)
        .map(|_| {
            let table = random(3) as usize;
            let mut slot = random(SLOTS);
            let token = frequencies[table].iter().position(|&f| {
                let found = slot < f.into();
                slot = slot.wrapping_sub(f.into());
                found
            });
            (table, token.unwrap() as u8)
        })
        .collect();
    let mut encode = EncodeTables::default();
    frequencies.iter().for_each(|of_table| encode.add(of_table, 1));
    let decode = frequencies.each_ref().map(DecodeTable::new);
    let mut writer = TokenWriter::default();
    let coded: Vec<u16> =
        symbols.iter().map(|&(table, token)| (table * TOKENS) as u16 + u16::from(token)).collect();
    encode.push([&mut writer], [(&coded, 0)]);
    let mut raw = BitWriter::default();
    let mut entropy = 0.0;
    for &(table, token) in &symbols {
        raw.push(1, NUMBERS[usize::from(token)] >> 24);
        entropy -= (f64::from(frequencies[table][usize::from(token)]) / f64::from(SLOTS)).log2();
    }
    let (mut tokens, mut bits) = (vec![], vec![]);
    writer.finish(&mut tokens);
    raw.finish(&mut bits);
    // States of 32 bits against slots of 12: rounding costs less than a thousandth, and the last state 4 bytes.
    assert!(tokens.len() as f64 <= 4.0 + entropy / 8.0 * 1.001, "{} {}", tokens.len(), entropy / 8.0);
    let mut stream = TokenStream::new(&tokens, &bits);
    for &(table, token) in &symbols {
        let least = NUMBERS[usize::from(token)];
        let bit = u32::from(least >> 24 > 0);
        assert_eq!(stream.next(&decode[table]), (least & 0xff_ffff) + bit);
    }
    assert!(stream.ended());
    stream.next(&decode[0]);
    assert!(!stream.ended());
    let mut short = TokenStream::new(&tokens[..tokens.len() - 2], &bits);
    for &(table, _) in &symbols {
        short.next(&decode[table]);
    }
    assert!(!short.ended(), "a stream that lost its end must be noticed");
}

#[test]
fn bad_tables_are_refused_and_any_table_decodes() {
    // Two frequencies of 4095 each.
    assert!(BitReader::new(&[0b0000_0011, 0b1111_1111, 0xff, 0xff, 0xff, 0xff, 0xff]).frequencies().is_err());
    let mut seed = 7u64;
    let mut accepted = 0;
    for _ in 0..20_000 {
        let bytes: [u8; 64] = std::array::from_fn(|_| {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            // Mostly small frequencies, as many large ones are always refused.
            (seed >> 56) as u8 & 0x33
        });
        if let Ok(frequencies) = BitReader::new(&bytes).frequencies() {
            accepted += 1;
            let table = DecodeTable::new(&frequencies);
            let mut stream = TokenStream::new(&bytes, &bytes);
            for _ in 0..200 {
                assert!(stream.next(&table) < 1 << 17);
            }
        }
    }
    assert!(accepted > 1000, "{accepted}");
}
