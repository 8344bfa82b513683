//! Which of the numbers of a file are wanted: a range along each of its axes. The numbers come in the order of the file.

use std::ops::Range;

/// Takes the wanted numbers out of a stream of all.
pub(crate) struct Picker {
    /// Axes above the run: distance between neighbours, range, and where the run is.
    outer: Vec<Outer>,
    /// What is left of the run of neighbouring numbers that comes next; `None` after the last.
    run: Option<Range<u64>>,
    run_start: u64,
    run_length: u64,
    /// Numbers that have passed.
    position: u64,
}

struct Outer {
    stride: u64,
    range: Range<u64>,
    at: u64,
}

impl Picker {
    /// Of axes of these lengths, fastest first, the numbers in these ranges, none of which may be empty.
    pub(crate) fn new(axes: &[(u64, Range<u64>)]) -> Self {
        let (mut stride, mut start, mut run_length) = (1, 0, None);
        let mut outer = Vec::new();
        for (size, range) in axes {
            start += stride * range.start;
            match run_length {
                None if *range == (0..*size) => {}
                None => run_length = Some(stride * (range.end - range.start)),
                Some(_) => outer.push(Outer { stride, range: range.clone(), at: range.start }),
            }
            stride *= size;
        }
        let run_length = run_length.unwrap_or(stride);
        Self { outer, run: Some(start..start + run_length), run_start: start, run_length, position: 0 }
    }

    /// Numbers that pass before the next wanted one; none if all were taken.
    pub(crate) fn gap(&self) -> u64 {
        self.run.as_ref().map_or(0, |run| run.start - self.position)
    }

    /// Whether all were taken.
    pub(crate) fn is_done(&self) -> bool {
        self.run.is_none()
    }

    /// Numbers that have passed.
    pub(crate) fn position(&self) -> u64 {
        self.position
    }

    /// Lets `count` numbers pass, which must not be more than [`Picker::gap`].
    pub(crate) fn pass(&mut self, count: u64) {
        debug_assert!(self.is_done() || count <= self.gap());
        self.position += count;
    }

    /// Lets the next `count` numbers pass and tells `take` which of them are wanted, counted from the first.
    pub(crate) fn take(&mut self, count: u64, mut take: impl FnMut(Range<usize>)) {
        let end = self.position + count;
        while let Some(run) = &mut self.run {
            if run.start >= end {
                break;
            }
            let stop = run.end.min(end);
            take((run.start - self.position) as usize..(stop - self.position) as usize);
            run.start = stop;
            if run.start < run.end {
                break;
            }
            self.run = self.next_run();
        }
        self.position = end;
    }

    fn next_run(&mut self) -> Option<Range<u64>> {
        for axis in &mut self.outer {
            axis.at += 1;
            if axis.at < axis.range.end {
                self.run_start += axis.stride;
                return Some(self.run_start..self.run_start + self.run_length);
            }
            self.run_start -= axis.stride * (axis.range.end - axis.range.start - 1);
            axis.at = axis.range.start;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The law: what is taken is what nested loops over the ranges would take, however the stream is cut.
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
            let axes: Vec<(u64, Range<u64>)> = sizes
                .iter()
                .map(|&n| {
                    let lo = if round % 3 == 0 { 0 } else { next(n) };
                    let hi = if round % 3 == 0 && next(2) == 0 { n } else { lo + 1 + next(n - lo) };
                    (n, lo..hi)
                })
                .collect();
            let is_wanted = |i: u64| {
                let mut rest = i;
                axes.iter().all(|(n, range)| {
                    let at = rest % n;
                    rest /= n;
                    range.contains(&at)
                })
            };
            let expected: Vec<u64> = (0..all).filter(|&i| is_wanted(i)).collect();
            let mut picker = Picker::new(&axes);
            let mut found = Vec::new();
            while !picker.is_done() {
                let gap = picker.gap();
                if next(2) == 0 {
                    picker.pass(next(gap + 1));
                }
                let start = picker.position();
                let count = (1 + next(9)).min(all - start);
                picker.take(count, |range| found.extend(range.map(|i| start + i as u64)));
            }
            assert_eq!(found, expected, "{axes:?}");
        }
    }
}
