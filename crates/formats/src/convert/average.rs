//! Makes one voxel of several: their mean, or the label that most of them have.

use half::f16;

use crate::decode::single;
use crate::dtype::Dtype;
use crate::padding::GapNumbers;

/// How voxels become one.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Rule {
    /// The mean of those that have a value, or else the first. Some numbers may mark voxels without a value.
    Mean(GapNumbers),
    /// The number that is most frequent, and the first of equally frequent ones.
    Majority,
}

/// A box of numbers, x fastest.
pub(super) struct NumberBox {
    /// Little-endian.
    pub(super) bytes: Vec<u8>,
    /// Numbers along x, y and z.
    pub(super) dims: [usize; 3],
}

impl NumberBox {
    /// The box in which so many numbers along x, y and z became one; at an odd end, fewer.
    pub(super) fn reduced(&self, dtype: Dtype, factors: [usize; 3], rule: &Rule) -> Self {
        match dtype {
            Dtype::Int8 => self.reduce::<i8, 1>(factors, rule),
            Dtype::Uint8 => self.reduce::<u8, 1>(factors, rule),
            Dtype::Int16 => self.reduce::<i16, 2>(factors, rule),
            Dtype::Uint16 => self.reduce::<u16, 2>(factors, rule),
            Dtype::Int32 => self.reduce::<i32, 4>(factors, rule),
            Dtype::Uint32 => self.reduce::<u32, 4>(factors, rule),
            Dtype::Int64 => self.reduce::<i64, 8>(factors, rule),
            Dtype::Uint64 => self.reduce::<u64, 8>(factors, rule),
            Dtype::Half => self.reduce::<f16, 2>(factors, rule),
            Dtype::Float => self.reduce::<f32, 4>(factors, rule),
            Dtype::Double => self.reduce::<f64, 8>(factors, rule),
        }
    }

    fn reduce<T: Number<N>, const N: usize>(&self, factors: [usize; 3], rule: &Rule) -> Self {
        let numbers = self.bytes.as_chunks::<N>().0;
        let gaps = match rule {
            Rule::Mean(gaps) => Some(T::comparable(gaps)),
            Rule::Majority => None,
        };
        let [nx, ny, nz] = self.dims;
        let dims = [0, 1, 2].map(|k| self.dims[k].div_ceil(factors[k]));
        let mut bytes = Vec::with_capacity(dims.iter().product::<usize>() * N);
        let span = |i: usize, factor: usize, n: usize| i * factor..((i + 1) * factor).min(n);
        let mut few = Vec::with_capacity(factors.iter().product());
        for z in 0..dims[2] {
            for y in 0..dims[1] {
                for x in 0..dims[0] {
                    few.clear();
                    for z in span(z, factors[2], nz) {
                        for y in span(y, factors[1], ny) {
                            let row = (z * ny + y) * nx;
                            let x = span(x, factors[0], nx);
                            few.extend(numbers[row + x.start..row + x.end].iter().map(|b| T::of_bytes(*b)));
                        }
                    }
                    let one = match &gaps {
                        Some(gaps) => T::mean(&few, gaps),
                        None => majority(&few),
                    };
                    bytes.extend(one.to_bytes());
                }
            }
        }
        Self { bytes, dims }
    }
}

/// The most frequent number of a few, the first of equally frequent ones.
fn majority<T: Copy + PartialEq>(few: &[T]) -> T {
    let count = |x: T| few.iter().filter(|y| **y == x).count();
    let mut best = (few[0], count(few[0]));
    for &x in &few[1..] {
        if x != best.0 && count(x) > best.1 {
            best = (x, count(x));
        }
    }
    best.0
}

/// A number of a file, of `N` bytes.
trait Number<const N: usize>: Copy + PartialEq {
    fn of_bytes(bytes: [u8; N]) -> Self;
    fn to_bytes(self) -> [u8; N];
    /// The gaps as numbers of this type are compared with them.
    fn comparable(gaps: &GapNumbers) -> GapNumbers;
    /// The mean of those that are finite and no gap, or else the first.
    fn mean(few: &[Self], gaps: &GapNumbers) -> Self;
}

/// Integers: the mean is rounded to the nearest, and to the even one of two.
macro_rules! integers {
    ($($t:ty, $n:literal, $sum:ty;)*) => {$(
        impl Number<$n> for $t {
            fn of_bytes(bytes: [u8; $n]) -> Self {
                Self::from_le_bytes(bytes)
            }

            fn to_bytes(self) -> [u8; $n] {
                self.to_le_bytes()
            }

            fn comparable(gaps: &GapNumbers) -> GapNumbers {
                gaps.clone()
            }

            fn mean(few: &[Self], gaps: &GapNumbers) -> Self {
                let (mut sum, mut count) = (0, 0);
                for x in few.iter().filter(|x| !gaps.contains(**x as f64)) {
                    sum += <$sum>::from(*x);
                    count += 1;
                }
                if count == 0 {
                    return few[0];
                }
                let (mean, rest) = (sum.div_euclid(count), sum.rem_euclid(count));
                let is_up = 2 * rest > count || (2 * rest == count && mean % 2 != 0);
                // The mean lies between the least and the greatest.
                (mean + <$sum>::from(is_up)) as Self
            }
        }
    )*};
}

integers! {
    i8, 1, i32; u8, 1, i32; i16, 2, i32; u16, 2, i32; i32, 4, i64; u32, 4, i64; i64, 8, i128; u64, 8, i128;
}

/// Floats: the mean is that of double precision, rounded once.
macro_rules! floats {
    ($($t:ty, $n:literal, $to:expr, $from:expr;)*) => {$(
        impl Number<$n> for $t {
            fn of_bytes(bytes: [u8; $n]) -> Self {
                Self::from_le_bytes(bytes)
            }

            fn to_bytes(self) -> [u8; $n] {
                self.to_le_bytes()
            }

            fn comparable(gaps: &GapNumbers) -> GapNumbers {
                gaps.in_single()
            }

            fn mean(few: &[Self], gaps: &GapNumbers) -> Self {
                mean_of_floats(few.iter().map(|x| $to(*x)), gaps).map_or(few[0], $from)
            }
        }
    )*};
}

floats! {
    f16, 2, f64::from, f16::from_f64;
    f32, 4, f64::from, |x| x as f32;
    f64, 8, |x| x, |x| x;
}

/// The mean of finite numbers that are no gaps; `None` without any.
fn mean_of_floats(few: impl Iterator<Item = f64> + Clone, gaps: &GapNumbers) -> Option<f64> {
    // Readers compare markers in single precision.
    let is_gap = |x: f64| gaps.contains(single(x).into());
    let valid = || few.clone().filter(|x| x.is_finite() && !is_gap(*x));
    let count = valid().count() as f64;
    if count == 0.0 {
        return None;
    }
    let sum: f64 = valid().sum();
    // A sum of the largest numbers is infinite, and that of their shares is not.
    Some(if sum.is_finite() { sum / count } else { valid().map(|x| x / count).sum() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of<T: Number<N>, const N: usize>(numbers: &[T], rule: Rule) -> T {
        match rule {
            Rule::Mean(gaps) => T::mean(numbers, &T::comparable(&gaps)),
            Rule::Majority => majority(numbers),
        }
    }

    fn plain() -> Rule {
        Rule::Mean(GapNumbers::default())
    }

    fn beside(gaps: &[f64]) -> Rule {
        Rule::Mean(GapNumbers { numbers: gaps.to_vec(), valid: None })
    }

    #[test]
    fn means_are_rounded_once_and_never_overflow() {
        assert_eq!([of(&[1u8, 2], plain()), of(&[2u8, 3], plain())], [2, 2]);
        assert_eq!([of(&[-1i8, -2], plain()), of(&[-2i8, -3], plain())], [-2, -2]);
        assert_eq!(of(&[u64::MAX; 8], plain()), u64::MAX);
        assert_eq!(of(&[i64::MIN, i64::MIN, i64::MAX], plain()), -3_074_457_345_618_258_603);
        assert_eq!(of(&[f64::MAX; 8], plain()), f64::MAX);
        assert_eq!(of(&[f16::MAX; 3], plain()), f16::MAX);
        assert_eq!(of(&[1.0f32, 2.0, 4.5], plain()), 2.5);
    }

    #[test]
    fn what_has_no_value_is_not_averaged() {
        assert_eq!(of(&[f32::NAN, 2.0, 4.0, f32::INFINITY], plain()), 3.0);
        assert!(of(&[f32::NAN; 4], plain()).is_nan());
        assert_eq!(of(&[-9999.0f64, 2.0, 4.0], beside(&[-9999.0])), 3.0);
        assert_eq!(of(&[-2000i16, 10, 20], beside(&[-2000.0])), 15);
        assert_eq!(of(&[-2000i16; 8], beside(&[-2000.0])), -2000);
        assert_eq!(of(&[-2000i16, 10, -1, 20], beside(&[-2000.0, -1.0])), 15, "several");
        let valid = Rule::Mean(GapNumbers { numbers: vec![], valid: Some((0.0, 15.0)) });
        assert_eq!((of(&[-1i16, 10, 12, 16], valid.clone()), of(&[0.1f32, 99.0], valid)), (11, 0.1));
        // The control: without a word about it, the number counts.
        assert_eq!(of(&[-2000i16, 10, 20], plain()), -657);
    }

    #[test]
    fn most_voxels_decide_and_no_new_label_appears() {
        assert_eq!(of(&[3u16, 9, 9, 3, 9], Rule::Majority), 9);
        assert_eq!(of(&[3u16, 9, 9, 3], Rule::Majority), 3);
        let few = [1u8, 5, 5, 9];
        assert!(few.contains(&of(&few, Rule::Majority)));
        // The control: the mean of two labels is a third one.
        assert_eq!(of(&[2u8, 6, 6, 2], plain()), 4);
    }

    #[test]
    fn odd_ends_are_means_of_fewer() {
        let bytes: Vec<u8> = (0..5 * 3).map(|i| i * 10).collect();
        let whole = NumberBox { bytes, dims: [5, 3, 1] };
        let found = whole.reduced(Dtype::Uint8, [2, 2, 2], &plain());
        assert_eq!((found.dims, &found.bytes[..]), ([3, 2, 1], &[30, 50, 65, 105, 125, 140][..]));
        let rows = whole.reduced(Dtype::Uint8, [2, 1, 1], &plain());
        assert_eq!((rows.dims, &rows.bytes[..3]), ([3, 3, 1], &[5, 25, 40][..]));
    }
}
