//! Converts the bytes of a file to voxels in chunks, so that a file is never in memory twice.
//!
//! Signed integers of 8 and 16 bits are shifted to unsigned ones, and the value map undoes that. Wider integers and
//! doubles become `f32`. Integers that lose digits are counted.

use std::collections::TryReserveError;
use std::io::{self, BufRead};

use half::f16;
use isinglass_core::volume::Voxels;

use crate::dtype::{Dtype, Endian};
use crate::units::may_be_hounsfield;
use crate::warning::{Warning, WarningKind};

/// Collects voxels in the order of the file.
pub(crate) struct VoxelSink {
    dtype: Dtype,
    endian: Endian,
    voxels: Voxels,
    num_rounded: u64,
}

/// The voxels that a [`VoxelSink`] collected.
pub(crate) struct Decoded {
    pub(crate) voxels: Voxels,
    /// Scale and offset from stored numbers to values.
    pub(crate) value_map: (f32, f32),
    /// For each voxel whether it has no value, if there is any such.
    pub(crate) gaps: Option<Vec<u8>>,
    /// The number that marks voxels without a value.
    pub(crate) mark: Option<f32>,
    pub(crate) warnings: Vec<Warning>,
}

impl Decoded {
    /// Makes all voxels zero, because none has a value.
    pub(crate) fn empty(&mut self) {
        if let Voxels::F32(v) = &mut self.voxels {
            v.fill(0.0);
        }
        self.gaps = None;
        let text = "no voxel has a value; the channel is empty and hidden";
        self.warnings = vec![Warning::new(WarningKind::Values, text)];
    }
}

impl VoxelSink {
    /// A sink with room for `num_voxels`. The caller has checked that number against the file and the memory limit.
    pub(crate) fn new(dtype: Dtype, endian: Endian, num_voxels: usize) -> Result<Self, TryReserveError> {
        fn room<T>(n: usize) -> Result<Vec<T>, TryReserveError> {
            let mut v = Vec::new();
            v.try_reserve_exact(n)?;
            Ok(v)
        }
        let voxels = match dtype.num_bytes_in_memory() {
            1 => Voxels::U8(room(num_voxels)?),
            2 => Voxels::U16(room(num_voxels)?),
            _ => Voxels::F32(room(num_voxels)?),
        };
        Ok(Self { dtype, endian, voxels, num_rounded: 0 })
    }

    /// A sink that is full: each of the `num_voxels` is the number whose bytes are `number`.
    pub(crate) fn filled(
        dtype: Dtype,
        endian: Endian,
        num_voxels: usize,
        number: &[u8],
    ) -> Result<Self, TryReserveError> {
        // This only asks for room. Memory of zeros is taken when it is written to.
        let room = Self::new(dtype, endian, num_voxels)?;
        let mut one = Self::new(dtype, endian, 1)?;
        one.push_bytes(number);
        drop(room);
        let voxels = match one.voxels {
            // A number of several bytes is there as its bytes.
            Voxels::U8(v) if v.len() > 1 && v.iter().any(|byte| *byte != v[0]) => {
                Voxels::U8(v.iter().copied().cycle().take(num_voxels).collect())
            }
            Voxels::U8(v) => Voxels::U8(vec![v.first().copied().unwrap_or(0); num_voxels]),
            Voxels::U16(v) => Voxels::U16(vec![v.first().copied().unwrap_or(0); num_voxels]),
            Voxels::F32(v) => Voxels::F32(vec![v.first().copied().unwrap_or(0.0); num_voxels]),
        };
        Ok(Self { dtype, endian, voxels, num_rounded: 0 })
    }

    /// The voxels so far.
    pub(crate) fn voxels(&self) -> &Voxels {
        &self.voxels
    }

    /// How many of them were rounded.
    pub(crate) fn num_rounded(&self) -> u64 {
        self.num_rounded
    }

    /// Both, to change them.
    pub(crate) fn parts_mut(&mut self) -> (&mut Voxels, &mut u64) {
        (&mut self.voxels, &mut self.num_rounded)
    }

    /// Adds the voxels of another sink for the same numbers.
    pub(crate) fn append(&mut self, other: Self) {
        self.num_rounded += other.num_rounded;
        match (&mut self.voxels, other.voxels) {
            (Voxels::U8(v), Voxels::U8(mut more)) => v.append(&mut more),
            (Voxels::U16(v), Voxels::U16(mut more)) => v.append(&mut more),
            (Voxels::F32(v), Voxels::F32(mut more)) => v.append(&mut more),
            _ => {}
        }
    }

    /// The voxels as they are stored, with whatever stands for no value.
    pub(crate) fn into_voxels(self) -> Voxels {
        self.voxels
    }

    /// The numbers in the type of the file, little-endian. Wide ones are as exact as single precision is.
    pub(crate) fn into_numbers(self) -> Vec<u8> {
        let dtype = self.dtype;
        match self.voxels {
            Voxels::U8(mut v) => {
                if dtype == Dtype::Int8 {
                    v.iter_mut().for_each(|x| *x ^= 0x80);
                }
                v
            }
            Voxels::U16(v) => {
                let flip = if dtype == Dtype::Int16 { 0x8000 } else { 0 };
                v.into_iter().flat_map(|x| (x ^ flip).to_le_bytes()).collect()
            }
            Voxels::F32(v) => match dtype {
                Dtype::Half => v.into_iter().flat_map(|x| f16::from_f32(x).to_le_bytes()).collect(),
                Dtype::Int32 => v.into_iter().flat_map(|x| (x as i32).to_le_bytes()).collect(),
                Dtype::Uint32 => v.into_iter().flat_map(|x| (x as u32).to_le_bytes()).collect(),
                Dtype::Int64 => v.into_iter().flat_map(|x| (x as i64).to_le_bytes()).collect(),
                Dtype::Uint64 => v.into_iter().flat_map(|x| (x as u64).to_le_bytes()).collect(),
                Dtype::Double => v.into_iter().flat_map(|x| f64::from(x).to_le_bytes()).collect(),
                _ => v.into_iter().flat_map(f32::to_le_bytes).collect(),
            },
        }
    }

    /// Voxels taken so far.
    pub(crate) fn len(&self) -> usize {
        self.voxels.len()
    }

    /// Adds the voxels in `bytes`. An incomplete voxel at the end is ignored.
    pub(crate) fn push_bytes(&mut self, bytes: &[u8]) {
        let endian = self.endian;
        match (&mut self.voxels, self.dtype) {
            (Voxels::U8(v), Dtype::Int8) => v.extend(bytes.iter().map(|b| b ^ 0x80)),
            (Voxels::U8(v), _) => v.extend_from_slice(bytes),
            (Voxels::U16(v), Dtype::Int16) => {
                v.extend(words(bytes, endian).map(|w| u16::from_le_bytes(w) ^ 0x8000));
            }
            (Voxels::U16(v), _) => v.extend(words(bytes, endian).map(u16::from_le_bytes)),
            (Voxels::F32(v), Dtype::Half) => {
                v.extend(words(bytes, endian).map(|w| f16::from_le_bytes(w).to_f32()));
            }
            (Voxels::F32(v), Dtype::Float) => v.extend(words(bytes, endian).map(f32::from_le_bytes)),
            (Voxels::F32(v), Dtype::Double) => {
                v.extend(words(bytes, endian).map(|w| single(f64::from_le_bytes(w))));
            }
            (Voxels::F32(v), dtype) => {
                let mut rounded = |exact: i128| {
                    let x = exact as f32;
                    self.num_rounded += u64::from(x as i128 != exact);
                    x
                };
                match dtype {
                    Dtype::Int32 => {
                        v.extend(words(bytes, endian).map(|w| rounded(i32::from_le_bytes(w).into())));
                    }
                    Dtype::Uint32 => {
                        v.extend(words(bytes, endian).map(|w| rounded(u32::from_le_bytes(w).into())));
                    }
                    Dtype::Int64 => {
                        v.extend(words(bytes, endian).map(|w| rounded(i64::from_le_bytes(w).into())));
                    }
                    _ => v.extend(words(bytes, endian).map(|w| rounded(u64::from_le_bytes(w).into()))),
                }
            }
        }
    }

    /// Adds one number that was written as text. Returns `false` and adds nothing if the type cannot hold it.
    pub(crate) fn push_number(&mut self, number: f64) -> bool {
        if let Some((lo, hi)) = self.dtype.integer_range()
            && !(number.fract() == 0.0 && number >= lo && number <= hi)
        {
            return false;
        }
        match &mut self.voxels {
            Voxels::U8(v) if self.dtype == Dtype::Int8 => v.push((number + 128.0) as u8),
            Voxels::U8(v) => v.push(number as u8),
            Voxels::U16(v) if self.dtype == Dtype::Int16 => v.push((number + 32_768.0) as u16),
            Voxels::U16(v) => v.push(number as u16),
            Voxels::F32(v) => {
                let x = single(number);
                self.num_rounded += u64::from(self.dtype.integer_range().is_some() && f64::from(x) != number);
                v.push(x);
            }
        }
        true
    }

    /// The voxels, and the map from their numbers to values. If the file `has_gaps`, voxels without a value are marked,
    /// and get a finite number for now. Such voxels are not a number, infinite, or a marker such as −9999. Masks,
    /// statistical maps and simulations have them outside of the measured part.
    pub(crate) fn finish(mut self, has_gaps: bool) -> Decoded {
        let (mut warnings, mut gaps, mut mark) = (Vec::new(), None, None);
        if let Voxels::F32(v) = &mut self.voxels
            && has_gaps
        {
            let (mut least, mut greatest) = (f32::INFINITY, f32::NEG_INFINITY);
            let (mut num_nan, mut num_infinite) = (0u64, 0u64);
            for x in v.iter() {
                num_nan += u64::from(x.is_nan());
                num_infinite += u64::from(x.is_infinite());
                if x.is_finite() {
                    (least, greatest) = (least.min(*x), greatest.max(*x));
                }
            }
            let gap = near_zero(least, greatest);
            // Without a finite number, [`isinglass_core::volume::Volume::new`] refuses the volume.
            if num_nan + num_infinite > 0 && least.is_finite() {
                gaps = Some(v.iter().map(|x| u8::from(!x.is_finite())).collect());
                v.iter_mut().filter(|x| !x.is_finite()).for_each(|x| *x = gap);
            }
            for (count, what) in [(num_nan, "not a number"), (num_infinite, "infinite")] {
                if count > 0 && least.is_finite() {
                    let text = format!("{count} voxels are {what}; nothing is shown there");
                    warnings.push(Warning::new(WarningKind::Values, text));
                }
            }
            if matches!(self.dtype, Dtype::Half | Dtype::Float | Dtype::Double)
                && let Some((found, warning)) = fill_gaps(v, &mut gaps)
            {
                mark = Some(found);
                warnings.push(warning);
            }
        }
        if self.num_rounded > 0 {
            let (n, name) = (self.num_rounded, self.dtype.name());
            let text = format!("{n} {name} voxels are beyond 2^24 and were rounded to single precision");
            warnings.push(Warning::new(WarningKind::Values, text));
        }
        let offset = offset_in_memory(self.dtype);
        Decoded { voxels: self.voxels, value_map: (1.0, offset), gaps, mark, warnings }
    }
}

/// What the numbers of a type are more than those in memory, which have no sign.
pub(crate) fn offset_in_memory(dtype: Dtype) -> f32 {
    match dtype {
        Dtype::Int8 => -128.0,
        Dtype::Int16 => -32_768.0,
        _ => 0.0,
    }
}

/// The number in single precision. One that is too large becomes the largest float, because it may be a marker.
pub(crate) fn single(number: f64) -> f32 {
    let single = number as f32;
    if single.is_infinite() && number.is_finite() { f32::MAX.copysign(single) } else { single }
}

/// The value that stands for no matter: zero in a map with signs, air in CT, else the one next to zero.
pub(crate) fn near_zero(least: f32, greatest: f32) -> f32 {
    if least <= greatest && !may_be_hounsfield(least, greatest) {
        0.0_f32.clamp(least, greatest)
    } else {
        least
    }
}

/// Replaces the marker for a missing value by [`near_zero`] of the others. Returns the marker and a warning if there is
/// one.
fn fill_gaps(v: &mut [f32], gaps: &mut Option<Vec<u8>>) -> Option<(f32, Warning)> {
    let (mark, gap) = v.iter().fold(Extremes::NONE, |extremes, x| extremes.with(*x)).mark()?;
    let mut num = 0u64;
    let gaps = gaps.get_or_insert_with(|| vec![0; v.len()]);
    for (x, byte) in v.iter_mut().zip(gaps).filter(|(x, _)| **x == mark) {
        (*x, *byte) = (gap, 1);
        num += 1;
    }
    let text = format!("{num} voxels are {mark:?}, as if nothing was known there; nothing is shown");
    Some((mark, Warning::new(WarningKind::Values, text)))
}

/// The two least and the two greatest different numbers of many, in ascending order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Extremes(pub(crate) [f32; 4]);

impl Extremes {
    /// Of no numbers.
    pub(crate) const NONE: Self = Self([f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY]);

    /// With one number more.
    pub(crate) fn with(self, x: f32) -> Self {
        let [a, b, c, d] = self.0;
        let (b, c) = (if x > a { b.min(x) } else { b }, if x < d { c.max(x) } else { c });
        Self([a.min(x), if x < a { a.min(b) } else { b }, if x > d { c.max(d) } else { c }, d.max(x)])
    }

    /// Of the finite numbers of both.
    pub(crate) fn and(self, other: Self) -> Self {
        other.0.into_iter().filter(|x| x.is_finite()).fold(self, Self::with)
    }

    /// The least and the greatest.
    pub(crate) fn range(self) -> (f32, f32) {
        (self.0[0], self.0[3])
    }

    /// The marker for a missing value, and the number that stands for it: [`near_zero`] of the others.
    pub(crate) fn mark(self) -> Option<(f32, f32)> {
        let [least, second, last, greatest] = self.0;
        let is_far = |mark: f32, lo: f32, hi: f32| {
            let [mark, lo, hi] = [mark, lo, hi].map(f64::from);
            hi > lo && (lo - mark).max(mark - hi) > FAR * (hi - lo)
        };
        let is_mark = |x: f32| x.is_finite() && (x.abs() >= MARK_LEAST || MARKS.contains(&x));
        if is_mark(least) && is_far(least, second, greatest) {
            Some((least, near_zero(second, greatest)))
        } else if is_mark(greatest) && is_far(greatest, least, last) {
            Some((greatest, near_zero(least, last)))
        } else {
            None
        }
    }
}

/// A float of at least this magnitude may be a marker. NetCDF uses 9.97e36, climate models 1e20, others the largest
/// float.
const MARK_LEAST: f32 = 1e18;
/// Other common markers.
const MARKS: [f32; 6] = [-999.0, -999.25, -9999.0, -99_999.0, -32_767.0, -32_768.0];
/// A marker is at least this many times the range of all other values away from them.
const FAR: f64 = 10.0;

/// The next number that is written as text, between white space or commas; `None` at the end. The function never
/// reads more than [`MAX_NUMBER_BYTES`].
pub(crate) fn next_number(reader: &mut dyn BufRead) -> io::Result<Option<Result<f64, String>>> {
    let mut token = Vec::new();
    loop {
        let buffer = match reader.fill_buf() {
            Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
            other => other?,
        };
        let Some(&byte) = buffer.first() else { break };
        reader.consume(1);
        let is_gap = byte.is_ascii_whitespace() || byte == b',';
        match (is_gap, token.is_empty()) {
            (true, true) => {}
            (true, false) => break,
            (false, _) => token.push(byte),
        }
        if token.len() > MAX_NUMBER_BYTES {
            break;
        }
    }
    if token.is_empty() {
        return Ok(None);
    }
    let text = String::from_utf8_lossy(&token);
    Ok(Some(text.parse().map_err(|_| text.into_owned())))
}

/// The numbers in `bytes` as little-endian words.
fn words<const N: usize>(bytes: &[u8], endian: Endian) -> impl Iterator<Item = [u8; N]> {
    bytes.as_chunks::<N>().0.iter().map(move |word| {
        let mut word = *word;
        if endian == Endian::Big {
            word.reverse();
        }
        word
    })
}

/// Longest number in text. A double with all its digits is shorter.
const MAX_NUMBER_BYTES: usize = 400;

#[cfg(test)]
mod tests {
    use super::*;

    fn sink(dtype: Dtype, endian: Endian) -> VoxelSink {
        VoxelSink::new(dtype, endian, 8).expect("eight voxels fit")
    }

    /// The values that a user of the volume gets.
    fn values(sink: VoxelSink) -> Vec<f32> {
        let decoded = sink.finish(true);
        let (scale, offset) = decoded.value_map;
        (0..decoded.voxels.len()).map(|i| decoded.voxels.get(i) * scale + offset).collect()
    }

    #[test]
    fn both_endians_of_every_type_give_the_numbers_back() {
        macro_rules! check {
            ($($dtype:ident $t:ty),*) => {$(
                let numbers: [$t; 4] = [<$t>::MIN.max(-1e9 as $t), 0 as $t, 77 as $t, <$t>::MAX.min(1e9 as $t)];
                let expected: Vec<f32> = numbers.iter().map(|&x| x as f32).collect();
                for endian in [Endian::Little, Endian::Big] {
                    let mut s = sink(Dtype::$dtype, endian);
                    for x in numbers {
                        s.push_bytes(&if endian == Endian::Big { x.to_be_bytes() } else { x.to_le_bytes() });
                    }
                    assert_eq!(values(s), expected, "{} {endian:?}", Dtype::$dtype.name());
                    let mut text = sink(Dtype::$dtype, endian);
                    assert!(numbers.iter().all(|&x| text.push_number(x as f64)));
                    assert_eq!(values(text), expected);
                }
            )*};
        }
        check!(Int8 i8, Uint8 u8, Int16 i16, Uint16 u16, Int32 i32, Uint32 u32, Int64 i64, Uint64 u64);
        check!(Float f32, Double f64);
    }

    #[test]
    fn what_is_not_a_number_becomes_a_value_without_matter() {
        let mut s = sink(Dtype::Float, Endian::Little);
        [3.0, f32::NAN, -2.0].iter().for_each(|x: &f32| s.push_bytes(&x.to_le_bytes()));
        let decoded = s.finish(true);
        assert_eq!(decoded.voxels, Voxels::F32(vec![3.0, 0.0, -2.0]));
        assert_eq!(decoded.warnings[0].text, "1 voxels are not a number; nothing is shown there");
        for (numbers, gap) in [
            ([3.0, f32::NAN, 2.0], 2.0),
            ([-3.0, f32::NAN, -2.0], -2.0),
            ([-1024.0, f32::NAN, 900.0], -1024.0),
        ] {
            let mut s = sink(Dtype::Float, Endian::Little);
            numbers.iter().for_each(|x: &f32| s.push_bytes(&x.to_le_bytes()));
            assert_eq!(s.finish(true).voxels, Voxels::F32(vec![numbers[0], gap, numbers[2]]));
        }
        let mut s = sink(Dtype::Float, Endian::Little);
        [f32::INFINITY, 3.0, f32::NEG_INFINITY, -2.0]
            .iter()
            .for_each(|x: &f32| s.push_bytes(&x.to_le_bytes()));
        let decoded = s.finish(true);
        assert_eq!(decoded.voxels, Voxels::F32(vec![0.0, 3.0, 0.0, -2.0]));
        assert_eq!(decoded.warnings[0].text, "2 voxels are infinite; nothing is shown there");
        let mut s = sink(Dtype::Float, Endian::Little);
        s.push_bytes(&f32::INFINITY.to_le_bytes());
        assert_eq!(
            s.finish(false).voxels,
            Voxels::F32(vec![f32::INFINITY]),
            "a raw file tells of a wrong guess"
        );
        let mut s = sink(Dtype::Float, Endian::Little);
        s.push_bytes(&f32::NAN.to_le_bytes());
        assert!(s.finish(true).voxels.get(0).is_nan(), "without any number there is no volume");
    }

    #[test]
    fn marks_for_nothing_become_the_least_value_of_the_others() {
        let finished = |dtype, numbers: &[f32]| {
            let mut s = sink(dtype, Endian::Little);
            numbers.iter().for_each(|&x| assert!(s.push_number(x.into())));
            let Decoded { voxels, warnings, .. } = s.finish(true);
            (voxels, warnings.len())
        };
        for mark in [9.969_21e36, 1e20, -1e30, f32::MAX, f32::MIN, -9999.0, -999.25] {
            for numbers in [[mark, 5.0, 6.0, mark, 5.5], [6.0, 5.5, mark, 5.0, mark]] {
                let filled = numbers.map(|x| if x == mark { 5.0 } else { x });
                assert_eq!(finished(Dtype::Double, &numbers), (Voxels::F32(filled.into()), 1), "{mark}");
            }
        }
        let mut s = sink(Dtype::Double, Endian::Little);
        [-f64::MAX, 5.0, 6.0].iter().for_each(|x| s.push_bytes(&x.to_le_bytes()));
        assert_eq!(s.finish(true).voxels, Voxels::F32(vec![5.0, 5.0, 6.0]));
        // None of these have a marker: the number is near, alone or not a common marker, or the type is an integer.
        for numbers in [
            [-9999.0, -4000.0, 3000.0],
            [1e20, 2e20, 3e20],
            [1e20, 0.0, 0.0],
            [-9999.0, -9999.0, -9999.0],
            [0.0, 1.0, 255.0],
        ] {
            assert_eq!(finished(Dtype::Float, &numbers), (Voxels::F32(numbers.into()), 0));
        }
        assert_eq!(finished(Dtype::Int32, &[-9999.0, 1.0, 2.0]).1, 0);
    }

    #[test]
    fn integers_that_do_not_fit_single_precision_are_counted() {
        let mut s = sink(Dtype::Int32, Endian::Little);
        for x in [1 << 24, (1 << 24) + 1, -(1 << 24) - 1, i32::MAX, 1 << 30] {
            s.push_bytes(&i32::to_le_bytes(x));
        }
        assert_eq!(s.num_rounded, 3);
        let warnings = s.finish(true).warnings;
        let warnings: Vec<String> = warnings.iter().map(ToString::to_string).collect();
        assert_eq!(warnings, ["3 int32 voxels are beyond 2^24 and were rounded to single precision"]);
    }

    #[test]
    fn text_outside_of_the_type_is_refused() {
        for (dtype, number) in [
            (Dtype::Uint8, 256.0),
            (Dtype::Uint8, -1.0),
            (Dtype::Int16, 0.5),
            (Dtype::Int32, f64::NAN),
            (Dtype::Uint16, f64::INFINITY),
        ] {
            assert!(!sink(dtype, Endian::Little).push_number(number), "{number} as {}", dtype.name());
        }
    }

    #[test]
    fn numbers_in_text_end_where_they_should() {
        let mut text: &[u8] = b" 1,2\r\n-3.5e2\tx 7";
        let mut next = || next_number(&mut text).expect("slices cannot fail");
        assert_eq!(next(), Some(Ok(1.0)));
        assert_eq!(next(), Some(Ok(2.0)));
        assert_eq!(next(), Some(Ok(-350.0)));
        assert_eq!(next(), Some(Err("x".into())));
        assert_eq!(next(), Some(Ok(7.0)));
        assert_eq!(next(), None);
    }
}
