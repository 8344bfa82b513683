//! Selects numbers along each axis of a file from the stream of its numbers.

use std::ops::Range;

/// The selected numbers along an axis: each `step`th of a range, from its first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Steps {
    /// Not empty.
    pub(crate) range: Range<u64>,
    /// At least 1.
    pub(crate) step: u64,
}

impl Steps {
    /// All numbers of a range.
    pub(crate) fn all(range: Range<u64>) -> Self {
        Self { range, step: 1 }
    }

    /// How many they are.
    pub(crate) fn len(&self) -> u64 {
        (self.range.end - self.range.start).div_ceil(self.step)
    }

    /// Those of them that lie in `part` of the axis, counted from the first selected one.
    pub(crate) fn within(&self, part: Range<u64>) -> Range<u64> {
        let index = |at: u64| at.clamp(self.range.start, self.range.end) - self.range.start;
        index(part.start).div_ceil(self.step)..index(part.end).div_ceil(self.step)
    }

    /// The place on the axis of the selected number `i`.
    pub(crate) fn at(&self, i: u64) -> u64 {
        self.range.start + i * self.step
    }
}

/// The selected numbers as runs in a stream of all numbers.
pub(crate) struct Hyperslab {
    /// The axes that are slower than a run.
    outer: Vec<Outer>,
    /// The rest of the current run of selected numbers; `None` after the last run.
    run: Option<Range<u64>>,
    run_start: u64,
    run_length: u64,
    /// Distance of the selected numbers in a run.
    run_step: u64,
    /// Position in the stream, in numbers.
    position: u64,
}

struct Outer {
    stride: u64,
    steps: Steps,
    at: u64,
}

impl Hyperslab {
    /// The selection of these numbers. Each axis has its length and its selection, the fastest first.
    pub(crate) fn new(axes: &[(u64, Steps)]) -> Self {
        let (mut stride, mut start, mut run_length, mut run_step) = (1, 0, None, 1);
        let mut outer = Vec::new();
        for (size, steps) in axes {
            let range = &steps.range;
            start += stride * range.start;
            let is_outer = run_length.is_some() || (steps.step > 1 && stride > 1);
            if is_outer {
                run_length.get_or_insert(stride);
                outer.push(Outer { stride, steps: steps.clone(), at: range.start });
            } else if *range != (0..*size) || steps.step > 1 {
                run_length = Some(stride * (range.end - range.start));
                run_step = steps.step;
            }
            stride *= size;
        }
        let run_length = run_length.unwrap_or(stride);
        Self {
            outer,
            run: Some(start..start + run_length),
            run_start: start,
            run_length,
            run_step,
            position: 0,
        }
    }

    /// Numbers before the next selected one; 0 after the last.
    pub(crate) fn gap(&self) -> u64 {
        self.run.as_ref().map_or(0, |run| run.start - self.position)
    }

    /// Whether all selected numbers have passed.
    pub(crate) fn is_done(&self) -> bool {
        self.run.is_none()
    }

    /// Numbers that have passed.
    pub(crate) fn position(&self) -> u64 {
        self.position
    }

    /// Takes the first `count` selected numbers off the selection, which has steps of 1.
    pub(crate) fn leave_out(&mut self, mut count: u64) {
        while let Some(run) = &mut self.run {
            let length = run.end - run.start;
            if count < length {
                run.start += count;
                return;
            }
            count -= length;
            self.run = self.next_run();
        }
    }

    /// Skips `count` numbers, at most [`Hyperslab::gap`].
    pub(crate) fn pass(&mut self, count: u64) {
        debug_assert!(self.is_done() || count <= self.gap());
        self.position += count;
    }

    /// Passes the next `count` numbers. Calls `take` with each range of them and the step of the selected ones in it,
    /// which begin with the first.
    pub(crate) fn take(&mut self, count: u64, mut take: impl FnMut(Range<usize>, usize)) {
        let end = self.position + count;
        while let Some(run) = &mut self.run {
            if run.start >= end {
                break;
            }
            let stop = run.end.min(end);
            take(
                (run.start - self.position) as usize..(stop - self.position) as usize,
                self.run_step as usize,
            );
            run.start += (stop - run.start).next_multiple_of(self.run_step);
            if run.start < run.end {
                break;
            }
            self.run = self.next_run();
        }
        self.position = end;
    }

    fn next_run(&mut self) -> Option<Range<u64>> {
        for axis in &mut self.outer {
            axis.at += axis.steps.step;
            if axis.at < axis.steps.range.end {
                self.run_start += axis.stride * axis.steps.step;
                return Some(self.run_start..self.run_start + self.run_length);
            }
            self.run_start -= axis.stride * (axis.at - axis.steps.step - axis.steps.range.start);
            axis.at = axis.steps.range.start;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The selection equals that of nested loops over the ranges, for any division of the stream.
    #[test]
    fn every_cut_of_the_stream_gives_the_same_numbers() {
        let sizes = [3u64, 4, 2, 5];
        let all: u64 = sizes.iter().product();
        let mut random = 7u64;
        for round in 0..200 {
            let mut next = |n: u64| {
                random =
                    random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (random >> 33) % n
            };
            let axes: Vec<(u64, Steps)> = sizes
                .iter()
                .map(|&n| {
                    let lo = if round % 3 == 0 { 0 } else { next(n) };
                    let hi = if round % 3 == 0 && next(2) == 0 { n } else { lo + 1 + next(n - lo) };
                    (n, Steps { range: lo..hi, step: if round % 2 == 0 { 1 } else { 1 + next(3) } })
                })
                .collect();
            let is_wanted = |i: u64| {
                let mut rest = i;
                axes.iter().all(|(n, Steps { range, step })| {
                    let at = rest % n;
                    rest /= n;
                    range.contains(&at) && (at - range.start).is_multiple_of(*step)
                })
            };
            let expected: Vec<u64> = (0..all).filter(|&i| is_wanted(i)).collect();
            let mut hyperslab = Hyperslab::new(&axes);
            let mut found = Vec::new();
            while !hyperslab.is_done() {
                let gap = hyperslab.gap();
                if next(2) == 0 {
                    hyperslab.pass(next(gap + 1));
                }
                let start = hyperslab.position();
                let count = (1 + next(9)).min(all - start);
                hyperslab
                    .take(count, |range, step| found.extend(range.step_by(step).map(|i| start + i as u64)));
            }
            assert_eq!(found, expected, "{axes:?}");
            assert_eq!(expected.len() as u64, axes.iter().map(|a| a.1.len()).product::<u64>());
        }
    }

    #[test]
    fn what_is_left_out_is_the_start_of_the_selection() {
        let axes = [(3, Steps::all(0..3)), (4, Steps::all(1..3)), (2, Steps::all(0..2))];
        let taken = |count| {
            let mut hyperslab = Hyperslab::new(&axes);
            hyperslab.leave_out(count);
            let mut found = Vec::new();
            hyperslab.take(24, |range, _| found.extend(range));
            found
        };
        let all = taken(0);
        assert_eq!(all.len(), 12);
        for count in 0..=12 {
            assert_eq!(taken(count), all[count as usize..]);
        }
    }

    #[test]
    fn a_part_of_an_axis_has_its_share_of_the_steps() {
        let steps = Steps { range: 3..17, step: 4 };
        // 3, 7, 11 and 15.
        assert_eq!(steps.len(), 4);
        for (part, expected) in [(0..3, 0..0), (0..4, 0..1), (4..12, 1..3), (8..100, 2..4), (16..17, 4..4)] {
            assert_eq!(steps.within(part.clone()), expected, "{part:?}");
            assert!(expected.map(|i| steps.at(i)).all(|at| part.contains(&at)));
        }
    }
}
