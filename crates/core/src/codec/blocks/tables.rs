//! The probabilities of all contexts in a frame.
//!
//! They follow from what the frames before had in each context ([`Counts`]), which both sides know, and from a prior.
//! A frame without a reference has the prior, with changes that its chunks state.

use std::sync::LazyLock;

use super::super::error::CodecError;
use super::entropy::{BitRecorder, Coder, Context, Decoder, ONE, PROBABILITY_BITS, Tables, Tally, encoded};
use super::prior::PRIOR;

impl Tables {
    /// Those of a frame of which nothing is known.
    pub(super) fn prior() -> &'static Self {
        static TABLES: LazyLock<Tables> =
            LazyLock::new(|| Tables { ones: PRIOR.iter().map(|level| level_from_letter(*level)).collect() });
        &TABLES
    }

    /// Reads the changes of the prior at the start of a chunk, and takes them off.
    pub(super) fn read(bytes: &mut &[u8]) -> Result<Self, CodecError> {
        let damaged = |problem: String| CodecError::Payload { plane: "tables", problem };
        let Some(([a, b, c, d], rest)) = bytes.split_first_chunk::<4>() else {
            return Err(damaged(format!("{} bytes, expected at least 4", bytes.len())));
        };
        let (num_changes, length) = (u16::from_le_bytes([*a, *b]), u16::from_le_bytes([*c, *d]));
        let Some((coded, rest)) = rest.split_at_checked(usize::from(length)) else {
            return Err(damaged(format!("{} bytes of changes, expected {length}", rest.len())));
        };
        *bytes = rest;
        let mut tables = Self::prior().clone();
        if num_changes == 0 && length == 0 {
            return Ok(tables);
        }
        let share = ShareOfChanges::of(num_changes.into());
        let mut decoder = Decoder::new(coded, &share.0, Tally::default());
        for one in &mut tables.ones {
            if decoder.bit(ShareOfChanges::CONTEXT, false) {
                *one = LEVELS[decoder.raw(LEVEL_BITS, 0) as usize];
            }
        }
        if !decoder.is_at_end() {
            return Err(damaged("the changes end too early or too late".into()));
        }
        Ok(tables)
    }

    /// The prior, changed where that saves bits of a frame; and the bytes that say so.
    pub(super) fn changed(tally: &Tally) -> (Self, Vec<u8>) {
        let mut tables = Self::prior().clone();
        let changes: Vec<Option<usize>> =
            tables.ones.iter().zip(&tally.of_places).map(|(one, counts)| change(*one, *counts)).collect();
        let num_changes = changes.iter().flatten().count();
        let mut recorder = BitRecorder::default();
        for (one, level) in tables.ones.iter_mut().zip(changes) {
            recorder.bit(ShareOfChanges::CONTEXT, level.is_some());
            if let Some(level) = level {
                recorder.raw(LEVEL_BITS, level as u32);
                *one = LEVELS[level];
            }
        }
        let mut bytes = (num_changes as u16).to_le_bytes().to_vec();
        if num_changes == 0 {
            bytes.extend([0; 2]);
            return (tables, bytes);
        }
        let coded = encoded(&recorder.bits, &ShareOfChanges::of(num_changes).0);
        bytes.extend((coded.len() as u16).to_le_bytes());
        bytes.extend(coded);
        (tables, bytes)
    }
}

/// The level that saves bits in place of a probability of ones, if one does.
fn change(one: u16, counts: [u32; 2]) -> Option<usize> {
    let [zeros, ones] = counts.map(|count| count as f32);
    let share = (ones + 0.4) / (zeros + ones + 0.8);
    let level = LEVELS.partition_point(|level| f32::from(*level) < share * ONE as f32);
    let bits = |one: u16| {
        let one = f32::from(one) / ONE as f32;
        -(ones * one.log2() + zeros * (1.0 - one).log2())
    };
    let best = [level.saturating_sub(1), level.min(LEVELS.len() - 1)]
        .into_iter()
        .min_by(|a, b| bits(LEVELS[*a]).total_cmp(&bits(LEVELS[*b])))?;
    (bits(one) - bits(LEVELS[best]) > BITS_OF_CHANGE).then_some(best)
}

/// Tables of one context: how many of all contexts are changed.
struct ShareOfChanges(Tables);

impl ShareOfChanges {
    const CONTEXT: Context = Context(0);

    fn of(num_changes: usize) -> Self {
        let one = (num_changes.min(PRIOR.len()) << PROBABILITY_BITS) / PRIOR.len();
        Self(Tables { ones: vec![(one as u32).clamp(LEAST, ONE - LEAST) as u16] })
    }
}

/// How often each context had a zero and a one in the last frames, in sixteenths. Later frames count more.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Counts {
    pub(super) of_places: Vec<[u32; 2]>,
}

impl Default for Counts {
    fn default() -> Self {
        Self { of_places: vec![[0; 2]; PRIOR.len()] }
    }
}

impl Counts {
    /// What is left of them at the next frame: five eighths.
    pub(super) fn faded(&self) -> Self {
        let fade = |count: u32| (count >> 1) + (count >> 3);
        Self { of_places: self.of_places.iter().map(|counts| counts.map(fade)).collect() }
    }

    /// Adds the bits of a frame.
    pub(super) fn with(mut self, tally: &Tally) -> Self {
        let counts = self.of_places.as_flattened_mut().iter_mut();
        for (count, more) in counts.zip(tally.of_places.as_flattened()) {
            *count = count.saturating_add(more.saturating_mul(PER_BIT));
        }
        self
    }

    /// The probabilities that they make of the prior, which counts as six bits.
    pub(super) fn tables(&self) -> Tables {
        let one = |(prior, [zeros, ones]): (&u16, &[u32; 2])| {
            // So the numerator has 32 bits.
            let shift = (32 - (zeros | ones).leading_zeros()).saturating_sub(16);
            let (zeros, ones) = (zeros >> shift, ones >> shift);
            let more = PRIOR_WEIGHT * u32::from(*prior);
            let one = ((ones << PROBABILITY_BITS) + more) / (zeros + ones + PRIOR_WEIGHT);
            one.clamp(LEAST, ONE - LEAST) as u16
        };
        Tables { ones: Tables::prior().ones.iter().zip(&self.of_places).map(one).collect() }
    }
}

/// A probability of [`PRIOR`].
fn level_from_letter(letter: u8) -> u16 {
    LEVELS[usize::from(letter.saturating_sub(FIRST_LETTER)) % LEVELS.len()]
}

/// The probabilities that a prior or a change may have. Their log-odds are 0.45 apart.
const LEVELS: [u16; 1 << LEVEL_BITS] = [
    38, 60, 94, 147, 230, 360, 561, 872, 1346, 2064, 3124, 4648, 6746, 9472, 12759, 16384, 20009, 23296,
    26022, 28120, 29644, 30704, 31422, 31896, 32207, 32408, 32538, 32621, 32674, 32708, 32730, 32744,
];
const LEVEL_BITS: u32 = 5;
/// The first letter of [`PRIOR`].
const FIRST_LETTER: u8 = b'0';
/// What a bit of a frame counts.
const PER_BIT: u32 = 16;
/// What the prior counts: six bits of a frame.
const PRIOR_WEIGHT: u32 = 96;
/// About the bits that state a change.
const BITS_OF_CHANGE: f32 = 10.0;
/// Least probability of either bit, in units of 2⁻¹⁵. The likely one then takes 0.001 bits.
const LEAST: u32 = 24;

#[cfg(test)]
mod tests {
    use super::super::syntax::NUM_CONTEXTS;
    use super::*;

    /// A frame that has ones in some contexts and zeros in others.
    fn tally() -> Tally {
        let mut recorder = BitRecorder::default();
        for i in 0..60_000u32 {
            let place = i.wrapping_mul(2_654_435_761) >> 20;
            recorder.bit(Context(place as u16), !place.is_multiple_of(3) || i % 7 == 0);
        }
        recorder.tally()
    }

    #[test]
    fn changes_of_the_prior_come_back_and_save_bits() {
        let (tables, bytes) = Tables::changed(&tally());
        assert_ne!(&tables, Tables::prior());
        let mut rest = &[&bytes[..], &[7, 7]].concat()[..];
        assert_eq!((Tables::read(&mut rest), rest), (Ok(tables), &[7, 7][..]));
        // Nothing counted, nothing changed.
        let (same, none) = Tables::changed(&Tally::default());
        assert_eq!((&same, none.len()), (Tables::prior(), 4));
        assert_eq!(Tables::read(&mut &none[..]).as_ref(), Ok(Tables::prior()));
        for cut in [0, 3, 4, bytes.len() - 1] {
            assert!(Tables::read(&mut &bytes[..cut]).is_err(), "{cut}");
        }
        let mut other = bytes.clone();
        other[0] ^= 1;
        assert!(Tables::read(&mut &other[..]).is_err());
    }

    #[test]
    fn counts_move_the_prior_and_fade() {
        let counts = Counts::default().with(&tally());
        let tables = counts.tables();
        let one = |tables: &Tables, place: usize| u32::from(tables.ones[place]);
        assert!(
            (0..4000)
                .all(|place| place % 3 == 0
                    || one(&tables, place) > one(Tables::prior(), place).min(ONE - 2000))
        );
        assert_eq!(one(&tables, NUM_CONTEXTS - 1), one(Tables::prior(), NUM_CONTEXTS - 1));
        let mut faded = counts.clone();
        (0..40).for_each(|_| faded = faded.faded());
        assert_eq!(&faded.tables(), Tables::prior());
        // Even counts that have no room are counted.
        let full = Counts { of_places: vec![[u32::MAX, 3]; NUM_CONTEXTS] };
        assert!(full.tables().ones.iter().all(|one| u32::from(*one) < 100));
    }
}
