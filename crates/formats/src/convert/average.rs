//! Makes one voxel of several: their mean, or the label that most of them have.

use std::ops::Range;

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
pub(crate) struct NumberBox {
    /// Little-endian.
    pub(crate) bytes: Vec<u8>,
    /// Numbers along x, y and z.
    pub(crate) dims: [usize; 3],
}

impl NumberBox {
    /// The box in which so many numbers along x, y and z became one; at an odd end, fewer.
    pub(crate) fn reduced(&self, dtype: Dtype, factors: [usize; 3], rule: &Rule) -> Self {
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
        let Rule::Mean(gaps) = rule else { return self.most_frequent::<T, N>(factors) };
        let gaps = T::comparable(gaps);
        match (&gaps.numbers[..], gaps.valid) {
            ([], None) => self.means::<T, N>(factors, |x: T| x.is_finite()),
            ([gap], None) => self.means::<T, N>(factors, |x: T| x.is_finite() && x.compared() != *gap),
            _ => self.means::<T, N>(factors, |x: T| x.is_finite() && !gaps.contains(x.compared())),
        }
    }

    /// The means of the numbers that count, or else the first numbers.
    fn means<T: Number<N>, const N: usize>(&self, factors: [usize; 3], counts: impl Fn(T) -> bool) -> Self {
        let dims = self.dims_by(factors);
        let numbers = self.bytes.as_chunks::<N>().0;
        let mut bytes = Vec::with_capacity(dims.iter().product::<usize>() * N);
        let (mut sums, mut nums) = (vec![T::ZERO; dims[0]], vec![0u32; dims[0]]);
        for (z, y) in (0..dims[2]).flat_map(|z| (0..dims[1]).map(move |y| (z, y))) {
            sums.fill(T::ZERO);
            nums.fill(0);
            for row in self.rows(factors, y, z) {
                add_row::<T, N>(&mut sums, &mut nums, &numbers[row], factors[0], &counts);
            }
            for (x, (sum, num)) in sums.iter().zip(&nums).enumerate() {
                let one = match num {
                    0 => self.few::<T, N>(factors, [x, y, z]).next(),
                    _ => T::mean(*sum, *num).or_else(|| {
                        let share = |x: T| T::share(x, *num);
                        self.few::<T, N>(factors, [x, y, z]).filter(|x| counts(*x)).map(share).reduce(T::plus)
                    }),
                };
                // There is a number at every place.
                bytes.extend(one.map_or([0; N], T::to_bytes));
            }
        }
        Self { bytes, dims }
    }

    fn most_frequent<T: Number<N>, const N: usize>(&self, factors: [usize; 3]) -> Self {
        let dims = self.dims_by(factors);
        let mut bytes = Vec::with_capacity(dims.iter().product::<usize>() * N);
        let mut few = Vec::with_capacity(factors.iter().product());
        for (z, y) in (0..dims[2]).flat_map(|z| (0..dims[1]).map(move |y| (z, y))) {
            for x in 0..dims[0] {
                few.clear();
                few.extend(self.few::<T, N>(factors, [x, y, z]));
                bytes.extend(majority(&few).to_bytes());
            }
        }
        Self { bytes, dims }
    }

    fn dims_by(&self, factors: [usize; 3]) -> [usize; 3] {
        [0, 1, 2].map(|k| self.dims[k].div_ceil(factors[k]))
    }

    /// The rows of numbers that become a row.
    fn rows(&self, factors: [usize; 3], y: usize, z: usize) -> impl Iterator<Item = Range<usize>> {
        let [nx, ny, nz] = self.dims;
        let span = |i: usize, factor: usize, n: usize| i * factor..((i + 1) * factor).min(n);
        let ys = span(y, factors[1], ny);
        span(z, factors[2], nz)
            .flat_map(move |z| ys.clone().map(move |y| (z * ny + y) * nx..(z * ny + y + 1) * nx))
    }

    /// The numbers that become one.
    fn few<T: Number<N>, const N: usize>(
        &self,
        factors: [usize; 3],
        [x, y, z]: [usize; 3],
    ) -> impl Iterator<Item = T> {
        let (numbers, nx) = (self.bytes.as_chunks::<N>().0, self.dims[0]);
        let xs = x * factors[0]..((x + 1) * factors[0]).min(nx);
        let part = move |row: Range<usize>| &numbers[row.start + xs.start..row.start + xs.end];
        self.rows(factors, y, z).flat_map(part).map(|bytes| T::of_bytes(*bytes))
    }
}

/// Adds the numbers of a row that count to sums of `factor` of them.
fn add_row<T: Number<N>, const N: usize>(
    sums: &mut [T::Sum],
    nums: &mut [u32],
    row: &[[u8; N]],
    factor: usize,
    counts: &impl Fn(T) -> bool,
) {
    let add = |sum: &mut T::Sum, num: &mut u32, bytes: &[u8; N]| {
        let x = T::of_bytes(*bytes);
        let does_count = counts(x);
        *sum = if does_count { T::add(*sum, x) } else { *sum };
        *num += u32::from(does_count);
    };
    let all = sums.iter_mut().zip(nums);
    if factor == 2 {
        let (pairs, last) = row.as_chunks::<2>();
        let mut all = all;
        for ([a, b], (sum, num)) in pairs.iter().zip(&mut all) {
            add(sum, num, a);
            add(sum, num, b);
        }
        if let ([bytes], Some((sum, num))) = (last, all.next()) {
            add(sum, num, bytes);
        }
        return;
    }
    for (few, (sum, num)) in row.chunks(factor).zip(all) {
        few.iter().for_each(|bytes| add(sum, num, bytes));
    }
}

/// The most frequent number of a few, the first of equally frequent ones.
fn majority<T: Copy + PartialEq>(few: &[T]) -> T {
    let count = |x: T| few.iter().filter(|y| **y == x).count();
    let mut best = (few[0], count(few[0]));
    if best.1 == few.len() {
        return best.0;
    }
    for &x in &few[1..] {
        if x != best.0 && count(x) > best.1 {
            best = (x, count(x));
        }
    }
    best.0
}

/// A number of a file, of `N` bytes.
trait Number<const N: usize>: Copy + PartialEq {
    /// The sum of some.
    type Sum: Copy;
    const ZERO: Self::Sum;
    fn of_bytes(bytes: [u8; N]) -> Self;
    fn to_bytes(self) -> [u8; N];
    fn is_finite(self) -> bool;
    /// The gaps as numbers of this type are compared with them.
    fn comparable(gaps: &GapNumbers) -> GapNumbers;
    /// The number as it is compared with gaps.
    fn compared(self) -> f64;
    fn add(sum: Self::Sum, x: Self) -> Self::Sum;
    /// The mean of so many numbers; `None` if their sum is too large.
    fn mean(sum: Self::Sum, num: u32) -> Option<Self>;
    /// A part of a number, of which so many are its mean with others whose sum is too large.
    fn share(self, num: u32) -> Self;
    fn plus(self, other: Self) -> Self;
}

/// Integers: the mean is rounded to the nearest, and to the even one of two.
macro_rules! integers {
    ($($t:ty, $n:literal, $sum:ty;)*) => {$(
        impl Number<$n> for $t {
            type Sum = $sum;
            const ZERO: $sum = 0;

            fn of_bytes(bytes: [u8; $n]) -> Self {
                Self::from_le_bytes(bytes)
            }

            fn to_bytes(self) -> [u8; $n] {
                self.to_le_bytes()
            }

            fn is_finite(self) -> bool {
                true
            }

            fn comparable(gaps: &GapNumbers) -> GapNumbers {
                gaps.clone()
            }

            fn compared(self) -> f64 {
                self as f64
            }

            fn add(sum: $sum, x: Self) -> $sum {
                sum + <$sum>::from(x)
            }

            fn mean(sum: $sum, num: u32) -> Option<Self> {
                let count = <$sum>::try_from(num).ok()?;
                let (mean, rest) = match num.is_power_of_two() {
                    true => (sum >> num.trailing_zeros(), sum & (count - 1)),
                    false => (sum.div_euclid(count), sum.rem_euclid(count)),
                };
                let is_up = 2 * rest > count || (2 * rest == count && mean % 2 != 0);
                // The mean lies between the least and the greatest.
                Some((mean + <$sum>::from(is_up)) as Self)
            }

            fn share(self, num: u32) -> Self {
                (<$sum>::from(self) / <$sum>::try_from(num).unwrap_or(1)) as Self
            }

            fn plus(self, other: Self) -> Self {
                self.saturating_add(other)
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
            type Sum = f64;
            const ZERO: f64 = -0.0;

            fn of_bytes(bytes: [u8; $n]) -> Self {
                Self::from_le_bytes(bytes)
            }

            fn to_bytes(self) -> [u8; $n] {
                self.to_le_bytes()
            }

            fn is_finite(self) -> bool {
                <$t>::is_finite(self)
            }

            fn comparable(gaps: &GapNumbers) -> GapNumbers {
                gaps.in_single()
            }

            // Readers compare markers in single precision.
            fn compared(self) -> f64 {
                single($to(self)).into()
            }

            fn add(sum: f64, x: Self) -> f64 {
                sum + $to(x)
            }

            fn mean(sum: f64, num: u32) -> Option<Self> {
                sum.is_finite().then(|| $from(sum / f64::from(num)))
            }

            fn share(self, num: u32) -> Self {
                $from($to(self) / f64::from(num))
            }

            fn plus(self, other: Self) -> Self {
                self + other
            }
        }
    )*};
}

floats! {
    f16, 2, f64::from, f16::from_f64;
    f32, 4, f64::from, |x| x as f32;
    f64, 8, |x| x, |x| x;
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of<T: Number<N>, const N: usize>(numbers: &[T], rule: Rule) -> T {
        let bytes = numbers.iter().flat_map(|x| x.to_bytes()).collect();
        let row = NumberBox { bytes, dims: [numbers.len(), 1, 1] };
        let one = row.reduce::<T, N>(row.dims, &rule).bytes;
        T::of_bytes(*one.first_chunk().unwrap())
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
