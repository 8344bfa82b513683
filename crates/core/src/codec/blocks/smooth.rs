//! The deblocking filter. It makes jumps at borders between blocks smaller if they are within the step size of the
//! coding. It moves two samples on either side by a bounded amount (docs/PROTOCOL.md, "Smoothing"; docs/MATH.md,
//! "Borders"). At the frame's own pose it saves 3 % of the bytes for the same DSSIM (bonsai, engine, t1_head,
//! shells).

use super::model::{BLOCK, BLOCK_LISTS};
use super::scales::roots_from_ycc;
use super::transform::BlockNumbers;

/// Samples of the lines at a place across a border.
type Line8 = [i32; BLOCK];

/// Samples of all lines across a border: the last three of the first block and the first three of the second.
type Across = [Line8; NEAR];

/// The position of two blocks at a border.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Border {
    /// A block and its right neighbour.
    Beside,
    /// A block and its lower neighbour.
    Below,
}

impl Border {
    /// The lines across the border whose samples all lie in the masks of the blocks. Each line has one bit, from the
    /// lowest.
    pub(super) fn lines(self, first: u64, second: u64) -> u8 {
        let last = BLOCK - 1;
        match self {
            Self::Beside => {
                let first = first >> last & first >> (last - 1) & first >> (last - 2);
                let rows = first & second & second >> 1 & second >> 2;
                (0..BLOCK).fold(0, |lines, y| lines | ((rows >> (y * BLOCK) & 1) as u8) << y)
            }
            Self::Below => {
                let row = |mask: u64, y: usize| (mask >> (y * BLOCK)) as u8;
                let first = row(first, last) & row(first, last - 1) & row(first, last - 2);
                first & row(second, 0) & row(second, 1) & row(second, 2)
            }
        }
    }

    /// The three samples on either side.
    #[inline(always)]
    fn across(self, first: &BlockNumbers, second: &BlockNumbers) -> Across {
        std::array::from_fn(|at| match at.checked_sub(NEAR / 2) {
            Some(away) => self.line(second, away),
            None => self.line(first, BLOCK - NEAR / 2 + at),
        })
    }

    /// Adds the moves to the two samples on either side.
    #[inline(always)]
    fn add(self, first: &mut BlockNumbers, second: &mut BlockNumbers, across: &Across, moves: &[Line8; 4]) {
        let moved = |n: usize| -> Line8 { std::array::from_fn(|i| across[n + 1][i] + moves[n][i]) };
        self.set_line(first, BLOCK - 2, &moved(0));
        self.set_line(first, BLOCK - 1, &moved(1));
        self.set_line(second, 0, &moved(2));
        self.set_line(second, 1, &moved(3));
    }

    /// The samples of a plane at index `away` across the border.
    #[inline(always)]
    fn line(self, plane: &BlockNumbers, away: usize) -> Line8 {
        match self {
            Self::Beside => std::array::from_fn(|y| plane[y * BLOCK + away]),
            Self::Below => plane.as_chunks().0[away],
        }
    }

    #[inline(always)]
    fn set_line(self, plane: &mut BlockNumbers, away: usize, line: &Line8) {
        match self {
            Self::Beside => line.iter().enumerate().for_each(|(y, value)| plane[y * BLOCK + away] = *value),
            Self::Below => plane.as_chunks_mut().0[away] = *line,
        }
    }
}

wide! {
    /// Smooths `lines` of a border in several planes. `steps` are those of their coding.
    pub(super) fn smooth(border: Border, first: &mut [BlockNumbers], second: &mut [BlockNumbers], lines: u8, steps: &[i32])
        = smooth_any;
}

wide! {
    /// The same in planes of roots of red, green and blue. `steps` are those of Y, Co and Cg.
    pub(super) fn smooth_roots(
        border: Border,
        first: &mut [BlockNumbers; 3],
        second: &mut [BlockNumbers; 3],
        lines: u8,
        steps: &[i32; 3],
    ) = smooth_roots_any;
}

#[inline(always)]
fn smooth_any(
    border: Border,
    first: &mut [BlockNumbers],
    second: &mut [BlockNumbers],
    lines: u8,
    steps: &[i32],
) {
    for ((first, second), &step) in first.iter_mut().zip(second).zip(steps) {
        let across = border.across(first, second);
        let moves = moves(&across, lines, step);
        border.add(first, second, &across, &moves);
    }
}

#[inline(always)]
fn smooth_roots_any(
    border: Border,
    first: &mut [BlockNumbers; 3],
    second: &mut [BlockNumbers; 3],
    lines: u8,
    steps: &[i32; 3],
) {
    let roots: [Across; 3] = std::array::from_fn(|c| border.across(&first[c], &second[c]));
    let mut ycc = roots;
    for at in 0..NEAR {
        for i in 0..BLOCK {
            let [r, g, b] = [roots[0][at][i], roots[1][at][i], roots[2][at][i]];
            [ycc[0][at][i], ycc[1][at][i], ycc[2][at][i]] =
                [(r + 2 * g + b) >> 2, (r - b) >> 1, (2 * g - r - b) >> 2];
        }
    }
    let of_ycc: [[Line8; 4]; 3] = std::array::from_fn(|c| moves(&ycc[c], lines, steps[c]));
    let mut of_roots = of_ycc;
    for at in 0..4 {
        for i in 0..BLOCK {
            let channels = roots_from_ycc([of_ycc[0][at][i], of_ycc[1][at][i], of_ycc[2][at][i]]);
            [of_roots[0][at][i], of_roots[1][at][i], of_roots[2][at][i]] = channels;
        }
    }
    for c in 0..3 {
        border.add(&mut first[c], &mut second[c], &roots[c], &of_roots[c]);
    }
}

/// Moves of the four samples next to the border in each line; 0 where the line is not smoothed.
#[inline(always)]
fn moves([p2, p1, p0, q0, q1, q2]: &Across, lines: u8, step: i32) -> [Line8; 4] {
    let [most, bend, far] = [MOST, BEND, FAR].map(|part| (part * step) >> 8);
    let mut moves = [[0; BLOCK]; 4];
    for i in 0..BLOCK {
        let bent = (p2[i] - 2 * p1[i] + p0[i]).abs() + (q2[i] - 2 * q1[i] + q0[i]).abs();
        let apart = (9 * (q0[i] - p0[i]) - 3 * (q1[i] - p1[i])) >> 4;
        let is_smoothed = (lines >> i & 1 == 1) & (bent <= bend) & (apart.abs() <= far);
        let by = within(apart, most);
        let of_p1 = within((((p2[i] + p0[i]) >> 1) - p1[i] + by) >> 1, most >> 1);
        let of_q1 = within((((q2[i] + q0[i]) >> 1) - q1[i] - by) >> 1, most >> 1);
        for (moves, by) in moves.iter_mut().zip([of_p1, by, -by, of_q1]) {
            moves[i] = if is_smoothed { by } else { 0 };
        }
    }
    moves
}

#[inline(always)]
fn within(x: i32, most: i32) -> i32 {
    x.min(most).max(-most)
}

const NEAR: usize = 6;
/// Greatest move of a sample at a border: .12 steps, the best of .06 to .3 (docs/BENCHMARKS.md, "Borders"). In 256ths.
const MOST: i32 = 31;
/// Greatest bend of both sides together, and greatest jump: 2 and 1.8 steps. The jump counts by 3/8 if both sides are
/// flat. Beyond these limits, the jump belongs to the picture.
const BEND: i32 = 512;
const FAR: i32 = 461;
const _: () = assert!(BLOCK == 8 && BLOCK_LISTS == 64);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::tests::with_each;

    /// A sample of 1.
    const ONE: f32 = 32_768.0;
    const BORDERS: [Border; 2] = [Border::Beside, Border::Below];

    /// A pair of blocks of a picture, across a border that is at 0.
    fn pair(border: Border, picture: impl Fn(f32, f32) -> f32) -> [BlockNumbers; 2] {
        [-8.0, 0.0].map(|start| {
            std::array::from_fn(|i| {
                let at = [(i % BLOCK) as f32, (i / BLOCK) as f32];
                let [across, along] = if border == Border::Beside { at } else { [at[1], at[0]] };
                (picture(start + across, along) * ONE).round() as i32
            })
        })
    }

    fn smoothed(
        border: Border,
        [first, second]: [BlockNumbers; 2],
        lines: u8,
        step: i32,
    ) -> [BlockNumbers; 2] {
        let (mut first, mut second) = ([first], [second]);
        smooth(border, &mut first, &mut second, lines, &[step]);
        [first[0], second[0]]
    }

    #[test]
    fn small_steps_between_blocks_become_smaller_and_edges_and_slopes_stay() {
        for border in BORDERS {
            let step_of =
                |pair: &[BlockNumbers; 2]| (border.line(&pair[1], 0)[3] - border.line(&pair[0], 7)[3]).abs();
            let small = pair(border, |x, _| if x < 0.0 { 0.5 } else { 0.502 });
            let found = smoothed(border, small, u8::MAX, 655);
            assert!(2 * step_of(&found) < step_of(&small), "{border:?}");
            // An edge that is many steps high, and a slope, which has no step.
            for kept in [
                pair(border, |x, _| if x < 0.0 { 0.2 } else { 0.5 }),
                pair(border, |x, y| 0.25 + x * 0.0625 + y * 0.125),
            ] {
                let found = smoothed(border, kept, u8::MAX, 655);
                assert_eq!(found, kept, "{border:?}");
            }
        }
    }

    /// A step across the border, and a bend of one side, just inside and outside of what is smoothed.
    #[test]
    fn what_bends_or_steps_by_more_than_its_bound_stays() {
        let step = 328;
        let moved = |border, picture: &dyn Fn(f32, f32) -> f32| {
            let given = pair(border, picture);
            smoothed(border, given, u8::MAX, step) != given
        };
        for border in BORDERS {
            for (part, is_smoothed) in [(0.98, true), (1.02, false)] {
                // Flat on both sides: 9/16 − 3/16 of the step count.
                let high = part * (FAR * step) as f32 / 256.0 / ONE * 8.0 / 3.0;
                assert_eq!(
                    moved(border, &|x, _| if x < 0.0 { 0.5 } else { 0.5 + high }),
                    is_smoothed,
                    "{border:?}"
                );
                // The sample next to the border is off by what its side bends by.
                let off = part * (BEND * step) as f32 / 256.0 / ONE;
                assert_eq!(
                    moved(border, &|x, _| if x == 0.0 { 0.5 + off } else { 0.5 }),
                    is_smoothed,
                    "{border:?}"
                );
            }
        }
    }

    #[test]
    fn no_sample_moves_by_more_than_its_share_of_the_step_and_only_near_the_border() {
        let noise = |x: f32, y: f32| 0.5 + 0.01 * ((x * 12.9 + y * 78.2).sin() * 43_758.5).fract();
        for border in BORDERS {
            let given = pair(border, noise);
            let lines = 0b1011_0110;
            let found = smoothed(border, given, lines, 328);
            let mut num_moved = 0;
            for (given, found, near) in [(given[0], found[0], [7, 6]), (given[1], found[1], [0, 1])] {
                for away in 0..BLOCK {
                    let [given, found] = [given, found].map(|plane| border.line(&plane, away));
                    for i in 0..BLOCK {
                        let moved = (found[i] - given[i]).abs();
                        let most = match near.iter().position(|n| *n == away) {
                            Some(n) if lines >> i & 1 == 1 => ((MOST * 328) >> 8) >> n,
                            _ => 0,
                        };
                        assert!(moved <= most, "{border:?} {away} {i}");
                        num_moved += usize::from(moved > 0);
                    }
                }
            }
            assert!(num_moved > 10, "{num_moved}");
        }
    }

    /// Gray has no colour differences, and what is smoothed of its brightness is that of its channels.
    #[test]
    fn gray_roots_are_smoothed_as_their_brightness_is_and_colours_by_their_own_steps() {
        for border in BORDERS {
            let given = pair(border, |x, y| 0.5 + 0.01 * (x * 1.7 + y * y).sin());
            let [mut first, mut second] = given.map(|plane| [plane; 3]);
            smooth_roots(border, &mut first, &mut second, u8::MAX, &[655, 1966, 1966]);
            let expected = smoothed(border, given, u8::MAX, 655);
            for (found, expected) in [first, second].iter().zip(expected) {
                for channel in found {
                    assert_eq!(*channel, expected, "{border:?}");
                }
            }
            // A step of colour alone, by up to its share of the coarser step: red and blue by as much as Co.
            let given = pair(border, |x, _| if x < 0.0 { -0.006 } else { 0.006 });
            let gray = 16_384;
            let [mut first, mut second] =
                given.map(|co| [co.map(|v| gray + v), [gray; BLOCK_LISTS], co.map(|v| gray - v)]);
            smooth_roots(border, &mut first, &mut second, u8::MAX, &[33, 1966, 1966]);
            let after = border.line(&second[0], 0)[3] - border.line(&first[0], 7)[3];
            assert!(after < 197, "{after}");
            assert_eq!(second[1], [gray; BLOCK_LISTS], "{border:?}");
        }
    }

    #[test]
    fn lines_are_those_with_matter_on_both_sides() {
        for border in BORDERS {
            assert_eq!(border.lines(u64::MAX, u64::MAX), u8::MAX);
            // Line 2 of the second block, line 5 of the first, and one that is too far from the border to count.
            let bit = |line: usize, away: usize| match border {
                Border::Beside => 1u64 << (line * BLOCK + away),
                Border::Below => 1 << (away * BLOCK + line),
            };
            for away in 0..3 {
                let lines = border.lines(!bit(5, 7 - away), !bit(2, away));
                assert_eq!(lines, !(1 << 5 | 1 << 2), "{border:?} {away}");
            }
            assert_eq!(border.lines(!bit(5, 4), !bit(2, 3)), u8::MAX);
            assert_eq!(border.lines(0, u64::MAX), 0);
        }
    }

    #[test]
    fn wider_instructions_smooth_alike() {
        for border in BORDERS {
            let given = pair(border, |x, y| 0.5 + 0.01 * (x * 1.7 + y * y).sin());
            let [portable, avx2, avx512] = with_each(|| smoothed(border, given, 0b1110_1111, 655));
            assert_eq!([avx2, avx512], [portable; 2]);
            let of_roots = || {
                let [mut first, mut second] =
                    given.map(|plane| [plane, plane.map(|v| v - (v >> 2)), plane.map(|v| (v * v) >> 15)]);
                smooth_roots(border, &mut first, &mut second, 0b1110_1111, &[655, 1966, 1966]);
                [first, second]
            };
            let [portable, avx2, avx512] = with_each(of_roots);
            assert_eq!([avx2, avx512], [portable; 2]);
        }
    }
}
