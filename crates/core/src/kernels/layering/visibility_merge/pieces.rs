//! Joining the pieces of a ray to groups, and settling the borders between these.

use glam::{Vec3, Vec4};

use super::gather::Rows;
use super::{ALPHA_LEAST, COLOR_DARK, COLOR_WEIGHT, OpenSegment, SETTLED_SHARE, SegmentList};
use crate::kernels::raycast::{greater, lesser, opacity};
use crate::layer::{MAX_K, Over};

/// What one ray gathered, front to back.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pieces {
    pub(super) len: usize,
    h: f32,
    /// Weight of collected colour against collected opacity.
    color_weight: f32,
    pieces: [Part; MAX_K],
    /// Weight of what a group that begins here gets wrong.
    visibility: [f32; MAX_K],
    /// Error of each piece joined with the one behind it; infinite for the last.
    pair_error: [f32; MAX_K],
}

/// A piece, or what of it is in a group.
#[derive(Clone, Copy, Debug, Default)]
struct Part {
    /// Colour and opacity.
    collects: Vec4,
    s0: f32,
    s1: f32,
    tau: f32,
}

/// Groups of neighbouring pieces, with borders that may lie inside of pieces: group g has what is between `first[g]`
/// and `first[g + 1]`, counted in pieces (3.25 is a quarter into the fourth).
pub(super) struct Groups {
    len: usize,
    first: [f32; MAX_K + 1],
    /// Error of each group.
    error: [f32; MAX_K],
}

impl Pieces {
    #[inline(always)]
    pub(super) fn new(rows: &Rows, len: usize, h: f32) -> Self {
        let mut pieces = [Part::default(); MAX_K];
        let mut over = Over::default();
        for (i, part) in pieces.iter_mut().enumerate().take(len) {
            let piece = rows.piece(i);
            *part =
                Part { s0: piece.s0, s1: piece.s1, collects: piece.c.extend(piece.alpha), tau: piece.tau };
            over.c += piece.c * over.transmittance;
            over.transmittance *= 1.0 - piece.alpha;
        }
        // The slope of sRGB. Errors of colour show in proportion to it, those of opacity less.
        let slope = 0.5 / over.c.max_element().max(COLOR_DARK).sqrt();
        let root = slope.sqrt();
        let mut visibility = [0.0; MAX_K];
        for (weight, in_front) in visibility.iter_mut().zip(&rows.visibility) {
            *weight = in_front * root;
        }
        let color_weight = COLOR_WEIGHT * slope;
        // Eight at a time, and no more than there are.
        let mut pair_error = match len {
            0..=8 => pair_errors::<8>(rows, &visibility, color_weight, h),
            9..=16 => pair_errors::<16>(rows, &visibility, color_weight, h),
            _ => pair_errors::<MAX_K>(rows, &visibility, color_weight, h),
        };
        for error in &mut pair_error[len.saturating_sub(1)..] {
            *error = f32::INFINITY;
        }
        Self { len, h, color_weight, pieces, visibility, pair_error }
    }

    /// How far the colour and opacity that a ray collects on its way from border `from` to border `to` are from what it
    /// collects in the homogeneous composite of that way: the mean distance over the way, times the 11/8-th power of its
    /// length in steps. Seen at an angle, matter that sits wrongly along the ray sits wrongly in the picture by a share of
    /// that length; a power above one holds apart what is far apart. Found by trial at K = 4: with the power 1 thin shells
    /// were a tenth worse, with 3/2 dark and diffuse matter was.
    #[inline(always)]
    fn group_error(&self, from: f32, to: f32) -> f32 {
        let (first, last) = pieces_between(from, to);
        if first == last {
            return 0.0;
        }
        self.error_of(first, last, &self.part(first, from, to), &self.part(last, from, to))
    }

    /// The same for the pieces `first` to `last`, with what of these two is in the group.
    #[inline(always)]
    fn error_of(&self, first: usize, last: usize, front: &Part, back: &Part) -> f32 {
        let (mut composite, mut tau) = (front.collects, front.tau);
        for part in &self.pieces[first + 1..last] {
            composite += part.collects * (1.0 - composite.w);
            tau += part.tau;
        }
        composite += back.collects * (1.0 - composite.w);
        tau += back.tau;
        let (s_front, s_back) = (front.s0, back.s1);
        let length = s_back - s_front;
        let tau_per_length = tau / length;
        let per_opacity = composite / composite.w.max(ALPHA_LEAST);
        let distance = |s: f32, collected: Vec4| {
            let share = opacity(tau_per_length * (s - s_front));
            self.distance(collected - per_opacity * share)
        };
        // Twice the error. Both ways agree at the two ends of the group.
        let (mut error, mut distance_before) = (0.0, 0.0);
        let (mut part, mut collected) = (front, front.collects);
        for i in first + 1..=last {
            let next = if i < last { &self.pieces[i] } else { back };
            let distance_end = distance(part.s1, collected);
            error += (distance_before + distance_end) * (part.s1 - part.s0);
            distance_before = distance_end;
            if next.s0 > part.s1 {
                distance_before = distance(next.s0, collected);
                error += (distance_end + distance_before) * (next.s0 - part.s1);
            }
            collected += next.collects * (1.0 - collected.w);
            part = next;
        }
        error += distance_before * (s_back - part.s0);
        0.5 * error * weight_of_length(length, self.h) * self.visibility[first]
    }

    #[inline(always)]
    fn distance(&self, difference: Vec4) -> f32 {
        let d = difference.abs();
        greater(d.w, self.color_weight * greater(greater(d.x, d.y), d.z))
    }

    /// What of piece `i` is between the borders `from` and `to`: matter is spread evenly in a piece.
    #[inline(always)]
    fn part(&self, i: usize, from: f32, to: f32) -> Part {
        let piece = self.pieces[i];
        let (begin, end) = (greater(from - i as f32, 0.0), lesser(to - i as f32, 1.0));
        if end - begin == 1.0 {
            return piece;
        }
        let length = piece.s1 - piece.s0;
        let tau = piece.tau * (end - begin);
        let alpha = opacity(tau);
        Part {
            s0: piece.s0 + begin * length,
            s1: if end < 1.0 { piece.s0 + end * length } else { piece.s1 },
            collects: (piece.collects * (alpha / piece.collects.w.max(ALPHA_LEAST))).truncate().extend(alpha),
            tau,
        }
    }

    /// What is between two borders as one segment.
    #[inline(always)]
    fn composite(&self, from: f32, to: f32) -> OpenSegment {
        let (first, last) = pieces_between(from, to);
        let mut all = self.part(first, from, to);
        for i in first + 1..=last {
            let part = self.part(i, from, to);
            all.collects += part.collects * (1.0 - all.collects.w);
            all.tau += part.tau;
            all.s1 = part.s1;
        }
        OpenSegment {
            s0: all.s0,
            s1: all.s1,
            c: all.collects.truncate(),
            tau: all.tau,
            alpha: all.collects.w,
        }
    }

    /// Joins groups, cheapest first, until there are at most `most` and the next join costs more than `threshold`.
    /// `note` is told the number of groups and the greatest cost so far before each join.
    #[inline(always)]
    pub(super) fn join(&self, most: usize, threshold: f32, mut note: impl FnMut(usize, f32)) -> Groups {
        // By the first piece of a group: the group behind it, the one in front of it, its error, that of it joined with
        // the one behind it, and what joining adds; infinite where there is no such group, or none behind it.
        let mut behind: [usize; MAX_K] = std::array::from_fn(|i| i + 1);
        let mut before: [usize; MAX_K] = std::array::from_fn(|i| i.saturating_sub(1));
        let mut error = [0.0; MAX_K];
        let (mut joined, mut growth) = (self.pair_error, self.pair_error);
        let mut len = self.len;
        let mut greatest: f32 = 0.0;
        while len > 1 {
            let Some(least) = first_least(&growth) else { break };
            greatest = greatest.max(growth[least]);
            if len <= most && greatest > threshold {
                break;
            }
            note(len, greatest);
            let (taken, next) = (behind[least], behind[behind[least]]);
            error[least] = joined[least];
            growth[taken] = f32::INFINITY;
            growth[least] = f32::INFINITY;
            behind[least] = next;
            len -= 1;
            if next < self.len {
                before[next] = least;
                joined[least] = self.joined_error(least, behind[next]);
                growth[least] = joined[least] - error[least] - error[next];
            }
            if least > 0 {
                let front = before[least];
                joined[front] = self.joined_error(front, next);
                growth[front] = joined[front] - error[front] - error[least];
            }
        }
        let mut groups = Groups { len, first: [self.len as f32; MAX_K + 1], error: [0.0; MAX_K] };
        let mut first = 0;
        for g in 0..len {
            groups.first[g] = first as f32;
            groups.error[g] = error[first];
            first = behind[first];
        }
        groups
    }

    /// Error of the pieces from `first` to before `end` as one group.
    #[inline(always)]
    fn joined_error(&self, first: usize, end: usize) -> f32 {
        self.error_of(first, end - 1, &self.pieces[first], &self.pieces[end - 1])
    }

    /// Moves each border by a piece, then half of one, then a quarter where that lessens the error of the two groups.
    /// Borders between whole pieces only would jump from a ray to its neighbours, which shows as noise in smooth media.
    #[inline(always)]
    fn settle(&self, groups: &mut Groups, threshold: f32) {
        for g in 1..groups.len {
            let (from, to) = (groups.first[g - 1], groups.first[g + 1]);
            let mut least = groups.error[g - 1] + groups.error[g];
            if least < SETTLED_SHARE * threshold {
                continue;
            }
            for step in [1.0, 0.5, 0.25] {
                let border = groups.first[g];
                for moved in [border - step, border + step] {
                    // A group never begins in a piece with a number below its own: so the shader can put it there.
                    if moved <= from || moved >= to || moved < g as f32 {
                        continue;
                    }
                    let errors = (self.group_error(from, moved), self.group_error(moved, to));
                    if errors.0 + errors.1 < least {
                        least = errors.0 + errors.1;
                        groups.first[g] = moved;
                        (groups.error[g - 1], groups.error[g]) = errors;
                        // The other way it was worse.
                        break;
                    }
                }
            }
        }
    }

    /// The list of at most `most` segments, and of no more than joins below `threshold` leave.
    #[inline(always)]
    pub(super) fn reduce(&self, most: usize, threshold: f32) -> SegmentList {
        let mut list = SegmentList::default();
        let mut groups = self.join(most, threshold, |_, _| ());
        // Groups of three pieces or fewer have the borders that joining gave them.
        if self.len > 3 * groups.len {
            self.settle(&mut groups, threshold);
        }
        for g in 0..groups.len {
            list.push(self.composite(groups.first[g], groups.first[g + 1]));
        }
        list
    }
}

/// [`Pieces::group_error`] of each of the first `N` pieces and the one behind it.
#[inline(always)]
fn pair_errors<const N: usize>(
    rows: &Rows,
    visibility: &[f32; MAX_K],
    color_weight: f32,
    h: f32,
) -> [f32; MAX_K] {
    let mut errors = [0.0; MAX_K];
    for i in 0..N {
        let (a, b) = (rows.piece(i), rows.piece(i + 1));
        let alpha = a.alpha + b.alpha * (1.0 - a.alpha);
        let c = a.c + b.c * (1.0 - a.alpha);
        let length = b.s1 - a.s0;
        let tau_per_length = (a.tau + b.tau) / length;
        let per_opacity = 1.0 / greater(alpha, ALPHA_LEAST);
        let distance = |s: f32| {
            let share = opacity(tau_per_length * (s - a.s0)) * per_opacity;
            let color: Vec3 = (a.c - c * share).abs();
            greater(
                (a.alpha - alpha * share).abs(),
                color_weight * greater(greater(color.x, color.y), color.z),
            )
        };
        let (end, begin) = (distance(a.s1), distance(b.s0));
        let error = end * (a.s1 - a.s0) + (end + begin) * greater(b.s0 - a.s1, 0.0) + begin * (b.s1 - b.s0);
        errors[i] = 0.5 * error * weight_of_length(length, h) * visibility[i];
    }
    errors
}

/// The mean over a length, in steps, times the 11/8-th power of it.
#[inline(always)]
fn weight_of_length(length: f32, h: f32) -> f32 {
    let fourth_root = (length / h).sqrt().sqrt();
    fourth_root * fourth_root.sqrt() / h
}

/// The first of the least.
#[inline(always)]
fn first_least(values: &[f32; MAX_K]) -> Option<usize> {
    let mut lanes = [f32::INFINITY; 8];
    for chunk in values.as_chunks::<8>().0 {
        for m in 0..8 {
            lanes[m] = lesser(chunk[m], lanes[m]);
        }
    }
    let least = lanes.into_iter().fold(f32::INFINITY, lesser);
    let mut bits = 0u32;
    for (i, &value) in values.iter().enumerate() {
        bits |= u32::from(value == least) << i;
    }
    (least < f32::INFINITY).then(|| bits.trailing_zeros() as usize % MAX_K)
}

/// The first and the last of the pieces that have a part between two borders.
#[inline(always)]
fn pieces_between(from: f32, to: f32) -> (usize, usize) {
    let behind = to as usize;
    (from as usize, if behind as f32 == to { behind - 1 } else { behind })
}

#[cfg(test)]
mod tests {
    use super::super::Gather;
    use super::*;
    use crate::kernels::march::{Sink, Step};

    /// Steps of length 1, some of them missing, with colours and depths that change slowly and now and then jump.
    fn gathered(seed: u32, num: u32, tolerance: f32) -> Gather {
        let mut gather = Gather::default();
        gather.begin(1.0, tolerance);
        let mut random = seed;
        let mut step = Step { tau: 0.05, c: Vec3::splat(0.5), ..Step::default() };
        for i in 0..num {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let share = (random >> 8) as f32 / (1 << 24) as f32;
            if random >> 28 == 0 {
                step.tau = share * 0.3;
                step.c = Vec3::new(share, 1.0 - share, 0.3);
            }
            step.tau = step.tau * (0.98 + 0.04 * share) + 1e-4;
            if random >> 28 != 1 {
                let alpha = opacity(step.tau);
                let _ =
                    gather.step(Step { s0: i as f32, s1: (i + 1) as f32, alpha, c: step.c * alpha, ..step });
            }
        }
        gather
    }

    #[test]
    fn pairs_worked_on_together_have_the_errors_of_each_by_itself() {
        let mut num_compared = 0;
        for (seed, num) in [(1, 5), (2, 14), (3, 30), (4, 200), (5, 700)] {
            let pieces = gathered(seed, num, 0.0).finish();
            assert!(pieces.len > 2 && pieces.len <= MAX_K);
            for i in 0..pieces.len - 1 {
                let alone = pieces.group_error(i as f32, (i + 2) as f32);
                // A few roundings of single precision in differences of numbers up to 1, over up to 50 steps.
                let tolerance = 1e-4 * alone + 1e-4 * pieces.visibility[i];
                assert!(
                    (pieces.pair_error[i] - alone).abs() <= tolerance,
                    "{i} {alone} {}",
                    pieces.pair_error[i]
                );
                // Negative control: another pair's is another one.
                let next = pieces.pair_error[i + 1];
                num_compared += usize::from(next.is_finite() && (next - alone).abs() > 10.0 * tolerance);
            }
            assert_eq!(pieces.pair_error[pieces.len - 1], f32::INFINITY);
        }
        assert!(num_compared > 20, "{num_compared}");
    }

    #[test]
    fn wider_instructions_keep_all_bits() {
        let bits = |list: SegmentList| -> Vec<[u32; 7]> {
            let bits = |s: &OpenSegment| [s.s0, s.s1, s.tau, s.alpha, s.c.x, s.c.y, s.c.z].map(f32::to_bits);
            list.segments[..list.len].iter().map(bits).collect()
        };
        for (seed, threshold) in [(1, 0.0), (2, 0.1), (3, 1.0), (4, 5.0)] {
            let mut gather = gathered(seed, 300, 0.01 * threshold);
            // What the processor has, against plain instructions.
            let wide = bits(gather.clone().reduce(12, threshold));
            assert_eq!(wide, bits(gather.finish().reduce(12, threshold)));
            // Negative control: one step more shows.
            assert_ne!(wide, bits(gathered(seed, 301, 0.01 * threshold).reduce(12, threshold)));
        }
    }
}
