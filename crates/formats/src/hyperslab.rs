//! Selects a range along each axis of a file from the stream of its numbers.

use std::ops::Range;

/// The numbers within a range along each axis, as runs in a stream of all numbers.
pub(crate) struct Hyperslab {
    /// The axes that are slower than a run.
    outer: Vec<Outer>,
    /// The rest of the current run of selected numbers; `None` after the last run.
    run: Option<Range<u64>>,
    run_start: u64,
    run_length: u64,
    /// Position in the stream, in numbers.
    position: u64,
}

struct Outer {
    stride: u64,
    range: Range<u64>,
    at: u64,
}

impl Hyperslab {
    /// The selection of these ranges. Each axis has its length and its range, the fastest first. No range may be
    /// empty.
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

    /// Skips `count` numbers, at most [`Hyperslab::gap`].
    pub(crate) fn pass(&mut self, count: u64) {
        debug_assert!(self.is_done() || count <= self.gap());
        self.position += count;
    }

    /// Passes the next `count` numbers. Calls `take` with each range of selected ones, counted from the first of
    /// them.
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
            let mut hyperslab = Hyperslab::new(&axes);
            let mut found = Vec::new();
            while !hyperslab.is_done() {
                let gap = hyperslab.gap();
                if next(2) == 0 {
                    hyperslab.pass(next(gap + 1));
                }
                let start = hyperslab.position();
                let count = (1 + next(9)).min(all - start);
                hyperslab.take(count, |range| found.extend(range.map(|i| start + i as u64)));
            }
            assert_eq!(found, expected, "{axes:?}");
        }
    }
}
