//! Joining the pieces of a ray to groups, and settling the borders between these.

use glam::{Vec3, Vec4, Vec4Swizzles};

use super::gather::{LENGTH_LEAST, Rows};
use super::{ALPHA_LEAST, COLOR_DARK, COLOR_WEIGHT, OpenSegment, SETTLED_SHARE, SegmentList};
use crate::kernels::layering::append;
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
    /// Error of each piece joined with the two behind it, without meaning for the last two.
    triple_error: [f32; MAX_K],
}

/// Points on the way through a group: the ends of its parts and of the gaps between them, but for its own ends.
#[derive(Clone, Copy, Debug)]
pub(super) struct Way {
    /// World distance from the front of the group.
    s: [f32; MAX_POINTS],
    /// World distance from the point before.
    length: [f32; MAX_POINTS],
    /// What a ray has collected there.
    collected: [Vec4; MAX_POINTS],
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

impl Default for Pieces {
    fn default() -> Self {
        let numbers = [0.0; MAX_K];
        Self {
            len: 0,
            h: 1.0,
            color_weight: 0.0,
            pieces: [Part::default(); MAX_K],
            visibility: numbers,
            pair_error: numbers,
            triple_error: numbers,
        }
    }
}

impl Default for Way {
    fn default() -> Self {
        let numbers = [0.0; MAX_POINTS];
        Self { s: numbers, length: numbers, collected: [Vec4::ZERO; MAX_POINTS] }
    }
}

impl Pieces {
    /// Takes the first `len` pieces of `rows`.
    #[inline(always)]
    pub(super) fn take(&mut self, rows: &Rows, len: usize, h: f32) {
        let mut over = Over::default();
        for (i, part) in self.pieces.iter_mut().enumerate().take(len) {
            let piece = rows.piece(i);
            *part =
                Part { s0: piece.s0, s1: piece.s1, collects: piece.c.extend(piece.alpha), tau: piece.tau };
            over.c += piece.c * over.transmittance;
            over.transmittance *= 1.0 - piece.alpha;
        }
        // The slope of sRGB. Errors of colour show in proportion to it, those of opacity less.
        let slope = 0.5 / over.c.max_element().max(COLOR_DARK).sqrt();
        let root = slope.sqrt();
        for (weight, in_front) in self.visibility.iter_mut().zip(&rows.visibility) {
            *weight = in_front * root;
        }
        (self.len, self.h, self.color_weight) = (len, h, COLOR_WEIGHT * slope);
        // Eight at a time, and no more than there are.
        self.pair_error = match len {
            0..=8 => pair_errors::<8>(rows, &self.visibility, self.color_weight, h),
            9..=16 => pair_errors::<16>(rows, &self.visibility, self.color_weight, h),
            17..=24 => pair_errors::<24>(rows, &self.visibility, self.color_weight, h),
            _ => pair_errors::<MAX_K>(rows, &self.visibility, self.color_weight, h),
        };
        self.triple_error = match len {
            0..=8 => triple_errors::<8>(rows, &self.visibility, self.color_weight, h),
            9..=16 => triple_errors::<16>(rows, &self.visibility, self.color_weight, h),
            17..=24 => triple_errors::<24>(rows, &self.visibility, self.color_weight, h),
            _ => triple_errors::<MAX_K>(rows, &self.visibility, self.color_weight, h),
        };
        for error in &mut self.pair_error[len.saturating_sub(1)..] {
            *error = f32::INFINITY;
        }
    }

    /// How far the colour and opacity that a ray collects on its way from border `from` to border `to` are from what it
    /// collects in the homogeneous composite of that way: the mean distance over the way, times the 11/8-th power of its
    /// length in steps. Seen at an angle, matter that sits wrongly along the ray sits wrongly in the picture by a share of
    /// that length; a power above one holds apart what is far apart. Found by trial at K = 4: with the power 1 thin shells
    /// were a tenth worse, with 3/2 dark and diffuse matter was.
    #[inline(always)]
    fn group_error(&self, way: &mut Way, from: f32, to: f32) -> f32 {
        let (first, last) = pieces_between(from, to);
        if first == last {
            return 0.0;
        }
        self.error_of(way, first, last, &self.part(first, from, to), &self.part(last, from, to))
    }

    /// The same for the pieces `first` to `last`, with what of these two is in the group.
    #[inline(always)]
    fn error_of(&self, way: &mut Way, first: usize, last: usize, front: &Part, back: &Part) -> f32 {
        let (mut composite, mut tau) = (front.collects, front.tau);
        let mut num = 0;
        let mut point = |s: f32, length: f32, collected: Vec4| {
            way.s[num] = s - front.s0;
            way.length[num] = length;
            way.collected[num] = collected;
            num += 1;
        };
        let mut part = front;
        for i in first + 1..=last {
            let next = if i < last { &self.pieces[i] } else { back };
            point(part.s1, part.s1 - part.s0, composite);
            if next.s0 > part.s1 {
                point(next.s0, next.s0 - part.s1, composite);
            }
            composite += next.collects * (1.0 - composite.w);
            tau += next.tau;
            part = next;
        }
        let length = greater(back.s1 - front.s0, LENGTH_LEAST);
        let tau_per_length = tau / length;
        let per_opacity = composite / composite.w.max(ALPHA_LEAST);
        let weights = Vec3::splat(self.color_weight).extend(1.0);
        // Twice the error. Both ways agree at the two ends of the group.
        let (mut error, mut distance_before) = (0.0, 0.0);
        for begin in (0..num).step_by(8) {
            let mut share = [0.0; 8];
            for (share, s) in share.iter_mut().zip(&way.s[begin..begin + 8]) {
                *share = opacity(tau_per_length * s);
            }
            for (m, share) in share.into_iter().enumerate().take(num - begin) {
                let difference = (way.collected[begin + m] - per_opacity * share).abs() * weights;
                let distance = greatest(difference);
                error += (distance_before + distance) * way.length[begin + m];
                distance_before = distance;
            }
        }
        error += distance_before * (back.s1 - back.s0);
        0.5 * error * weight_of_length(length, self.h) * self.visibility[first]
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
    pub(super) fn join(
        &self,
        way: &mut Way,
        most: usize,
        threshold: f32,
        mut note: impl FnMut(usize, f32),
    ) -> Groups {
        // By the first piece of a group: the group behind it, the one in front of it, its error, that of it joined with
        // the one behind it, and what joining adds; infinite where there is no such group, or none behind it.
        let mut behind: [u8; MAX_K] = std::array::from_fn(|i| i as u8 + 1);
        let mut before: [u8; MAX_K] = std::array::from_fn(|i| (i as u8).saturating_sub(1));
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
            let taken = usize::from(behind[least]) % MAX_K;
            let next = usize::from(behind[taken]);
            error[least] = joined[least];
            growth[taken] = f32::INFINITY;
            growth[least] = f32::INFINITY;
            behind[least] = next as u8;
            len -= 1;
            if next < self.len {
                before[next] = least as u8;
                joined[least] = self.joined_error(way, least, usize::from(behind[next]));
                growth[least] = joined[least] - error[least] - error[next];
            }
            if least > 0 {
                let front = usize::from(before[least]) % MAX_K;
                joined[front] = self.joined_error(way, front, next);
                growth[front] = joined[front] - error[front] - error[least];
            }
        }
        let mut groups = Groups { len, first: [self.len as f32; MAX_K + 1], error: [0.0; MAX_K] };
        let mut first = 0;
        for g in 0..len {
            groups.first[g] = first as f32;
            groups.error[g] = error[first];
            first = usize::from(behind[first]);
        }
        groups
    }

    /// Error of the pieces from `first` to before `end` as one group.
    #[inline(always)]
    fn joined_error(&self, way: &mut Way, first: usize, end: usize) -> f32 {
        // The most of them, and found already.
        if end - first == 3 {
            return self.triple_error[first];
        }
        self.error_of(way, first, end - 1, &self.pieces[first], &self.pieces[end - 1])
    }

    /// Moves each border by a piece, then half of one, then a quarter where that lessens the error of the two groups.
    /// Borders between whole pieces only would jump from a ray to its neighbours, which shows as noise in smooth media.
    #[inline(always)]
    fn settle(&self, way: &mut Way, groups: &mut Groups, threshold: f32) {
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
                    // The group that grows may be too much alone.
                    let (grown, shrunk) = if moved < border {
                        ((moved, to), (from, moved))
                    } else {
                        ((from, moved), (moved, to))
                    };
                    let error_grown = self.group_error(way, grown.0, grown.1);
                    if error_grown >= least {
                        continue;
                    }
                    let error_shrunk = self.group_error(way, shrunk.0, shrunk.1);
                    if error_grown + error_shrunk < least {
                        least = error_grown + error_shrunk;
                        groups.first[g] = moved;
                        (groups.error[g - 1], groups.error[g]) = if moved < border {
                            (error_shrunk, error_grown)
                        } else {
                            (error_grown, error_shrunk)
                        };
                        // The other way it was worse.
                        break;
                    }
                }
            }
        }
    }

    /// The list of at most `most` segments, and of no more than joins below `threshold` leave.
    #[inline(always)]
    pub(super) fn reduce(&self, way: &mut Way, most: usize, threshold: f32, list: &mut SegmentList) {
        list.len = 0;
        let mut groups = self.join(way, most, threshold, |_, _| ());
        // Groups of three pieces or fewer have the borders that joining gave them.
        if self.len > 3 * groups.len {
            self.settle(way, &mut groups, threshold);
        }
        for g in 0..groups.len {
            list.push(self.composite(groups.first[g], groups.first[g + 1]));
        }
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
        let length = greater(b.s1 - a.s0, LENGTH_LEAST);
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

/// [`Pieces::group_error`] of each of the first `N` pieces and the two behind it.
#[inline(always)]
fn triple_errors<const N: usize>(
    rows: &Rows,
    visibility: &[f32; MAX_K],
    color_weight: f32,
    h: f32,
) -> [f32; MAX_K] {
    let mut errors = [0.0; MAX_K];
    for i in 0..N {
        let (a, b, c) = (rows.piece(i), rows.piece(i + 1), rows.piece(i + 2));
        let mut two = a;
        append(&mut two, &b);
        let mut all = two;
        append(&mut all, &c);
        let length = greater(c.s1 - a.s0, LENGTH_LEAST);
        let tau_per_length = all.tau / length;
        let opacity_least = greater(all.alpha, ALPHA_LEAST);
        let color_per_opacity = all.c / opacity_least;
        let alpha_per_opacity = all.alpha / opacity_least;
        let distance = |s: f32, collected: &OpenSegment| {
            let share = opacity(tau_per_length * (s - a.s0));
            let color: Vec3 = (collected.c - color_per_opacity * share).abs();
            greater(
                (collected.alpha - alpha_per_opacity * share).abs(),
                color_weight * greater(greater(color.x, color.y), color.z),
            )
        };
        let (end_a, begin_b) = (distance(a.s1, &a), distance(b.s0, &a));
        let (end_b, begin_c) = (distance(b.s1, &two), distance(c.s0, &two));
        let error = end_a * (a.s1 - a.s0)
            + (end_a + begin_b) * greater(b.s0 - a.s1, 0.0)
            + (begin_b + end_b) * (b.s1 - b.s0)
            + (end_b + begin_c) * greater(c.s0 - b.s1, 0.0)
            + begin_c * (c.s1 - c.s0);
        errors[i] = 0.5 * error * weight_of_length(length, h) * visibility[i];
    }
    errors
}

/// The greatest of four numbers.
#[inline(always)]
fn greatest(v: Vec4) -> f32 {
    let pairs = v.max(v.zwxy());
    greater(pairs.x, pairs.y)
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

/// Points on the longest way: two for each piece but the last.
const MAX_POINTS: usize = 2 * MAX_K;

#[cfg(test)]
mod tests {
    use super::super::Gather;
    use super::super::gather::tests::steps;
    use super::*;
    use crate::kernels::march::Sink;
    use crate::width::tests::with_each;

    fn gathered(seed: u32, num: u32, tolerance: f32) -> Gather {
        let mut gather = Gather::default();
        gather_into(&mut gather, seed, num, tolerance);
        gather
    }

    fn gather_into(gather: &mut Gather, seed: u32, num: u32, tolerance: f32) {
        gather.begin(1.0, tolerance);
        for step in steps(seed, num) {
            let _ = gather.step(step);
        }
    }

    fn bits(list: &SegmentList) -> Vec<[u32; 7]> {
        let bits = |s: &OpenSegment| [s.s0, s.s1, s.tau, s.alpha, s.c.x, s.c.y, s.c.z].map(f32::to_bits);
        list.segments[..list.len].iter().map(bits).collect()
    }

    #[test]
    fn pairs_and_triples_worked_on_together_have_the_errors_of_each_by_itself() {
        let (mut num_compared, mut num_triples) = (0, 0);
        for (seed, num) in [(1, 5), (2, 14), (3, 30), (4, 200), (5, 700)] {
            let mut gather = gathered(seed, num, 0.0);
            gather.finish();
            let Gather { pieces, way, .. } = &mut gather;
            assert!(pieces.len > 2 && pieces.len <= MAX_K);
            for i in 0..pieces.len - 1 {
                let alone = pieces.group_error(way, i as f32, (i + 2) as f32);
                // A few roundings of single precision in differences of numbers up to 1, over up to 50 steps.
                let tolerance = 1e-4 * alone + 1e-4 * pieces.visibility[i];
                assert!(
                    (pieces.pair_error[i] - alone).abs() <= tolerance,
                    "{i} {alone} {}",
                    pieces.pair_error[i]
                );
                if i + 2 < pieces.len {
                    let alone = pieces.group_error(way, i as f32, (i + 3) as f32);
                    let tolerance = 1e-4 * alone + 1e-4 * pieces.visibility[i];
                    let together = pieces.triple_error[i];
                    assert!((together - alone).abs() <= tolerance, "{i} {alone} {together}");
                    // Negative control: it is not that of the pair.
                    num_triples += usize::from((pieces.pair_error[i] - alone).abs() > 10.0 * tolerance);
                }
                // Negative control: another pair's is another one.
                let next = pieces.pair_error[i + 1];
                num_compared += usize::from(next.is_finite() && (next - alone).abs() > 10.0 * tolerance);
            }
            assert_eq!(pieces.pair_error[pieces.len - 1], f32::INFINITY);
        }
        assert!(num_compared > 20 && num_triples > 20, "{num_compared} {num_triples}");
    }

    #[test]
    fn wider_instructions_keep_all_bits() {
        for (seed, threshold) in [(1, 0.0), (2, 0.1), (3, 1.0), (4, 5.0)] {
            let reduced = |num: u32| {
                let mut list = SegmentList::default();
                gathered(seed, num, 0.01 * threshold).reduce(12, threshold, &mut list);
                bits(&list)
            };
            let joined = || {
                let mut gather = gathered(seed, 300, 0.0);
                let mut costs = vec![gather.finish() as u32];
                gather.join_all(&mut |_, cost| costs.push(cost.to_bits()));
                costs
            };
            let [portable, avx2, avx512] = with_each(|| (reduced(300), joined()));
            assert!(portable == avx2 && portable == avx512);
            // Negative control: one step more shows.
            assert_ne!(portable.0, reduced(301));
        }
    }

    #[test]
    fn what_the_ray_before_left_behind_changes_no_bit_of_a_list() {
        // As a row of a frame has them: one to gather in and one list for all of its rays.
        let (mut used, mut list) = (Gather::default(), SegmentList::default());
        let mut before = Vec::new();
        for (seed, num) in [(1, 9), (2, 700), (1, 9), (3, 1), (2, 700), (4, 65), (5, 300), (6, 2)] {
            for most in [4, 12, MAX_K] {
                gather_into(&mut used, seed, num, 0.002);
                used.reduce(most, 0.01, &mut list);
                let mut fresh = SegmentList::default();
                gathered(seed, num, 0.002).reduce(most, 0.01, &mut fresh);
                assert_eq!(bits(&list), bits(&fresh), "{num} steps to {most}");
                assert!((1..=most).contains(&list.len));
            }
            // Negative control: it is not the list of the ray before.
            assert_ne!(std::mem::replace(&mut before, bits(&list)), bits(&list));
        }
    }
}
