//! What a segment is expected to be, from those of the same chunk that came before it: the earlier ones of its list,
//! and the lists to the left and above. Encoder and decoder both run this, so it uses exact arithmetic only (sums,
//! products, quotients and casts of IEEE floats, and tables made of those).
//!
//! Colour depends on how much matter of its kind a segment holds: C is E·α, and on the square-root scale its code goes
//! with √α. So the optical depth is predicted from the thickness, then colour from the optical depth, then green and
//! blue from how red (and green) turned out.

use std::ops::Range;

use super::quantize::Code;
use super::scale::Scale;

/// Goes from list to list in row order and knows where the lists to the left and above are.
pub(super) struct Walk {
    column: usize,
    end: usize,
    left: Range<usize>,
    above: Vec<Range<usize>>,
}

impl Walk {
    /// At the first list of a chunk with so many lists to a row.
    pub(super) fn new(width: usize) -> Self {
        Self { column: 0, end: 0, left: 0..0, above: vec![0..0; width] }
    }

    /// The predictor of the next list, which has `count` segments.
    pub(super) fn next(&mut self, count: usize) -> Predictor {
        if self.column == self.above.len() {
            self.column = 0;
            self.left = 0..0;
        }
        let own = self.end..self.end + count;
        let above = std::mem::replace(&mut self.above[self.column], own.clone());
        let left = std::mem::replace(&mut self.left, own.clone());
        self.column += 1;
        self.end = own.end;
        Predictor { seek: [left.start, above.start], own, left, above }
    }
}

/// Predicts the segments of one list. Lists are ranges of the codes of the chunk.
pub(super) struct Predictor {
    /// The list itself.
    pub(super) own: Range<usize>,
    left: Range<usize>,
    above: Range<usize>,
    /// Where the search for a segment of the same depth goes on, left and above.
    seek: [usize; 2],
}

impl Predictor {
    /// Front of segment `at`: the back of the one before it, or the first fronts of the neighbours.
    pub(super) fn front(&self, codes: &[Code], at: usize) -> u16 {
        if at > self.own.start {
            return codes[at - 1].back;
        }
        let first = |list: &Range<usize>| (!list.is_empty()).then(|| codes[list.start]);
        Near([first(&self.left), first(&self.above)]).mean(|n| n.front)
    }

    /// Back of segment `at`: that of the segment of the same number to the left or above, if it is behind `front`.
    pub(super) fn back(&self, codes: &[Code], at: usize, front: u16) -> u16 {
        let number = at - self.own.start;
        let same = |list: &Range<usize>| {
            (number < list.len()).then(|| codes[list.start + number].back).filter(|&back| back > front)
        };
        same(&self.left).or_else(|| same(&self.above)).unwrap_or(front)
    }

    /// The segments to the left and above whose middle is nearest to that of `front..back`. Asked in the order of the
    /// list, so one pass over the neighbours serves the whole list.
    pub(super) fn near(&mut self, codes: &[Code], front: u16, back: u16) -> Near {
        let twice_middle = |front: u16, back: u16| u32::from(front) + u32::from(back);
        let wanted = twice_middle(front, back);
        let distance = |at: usize| twice_middle(codes[at].front, codes[at].back).abs_diff(wanted);
        let mut near = [None; 2];
        for (side, end) in [self.left.end, self.above.end].into_iter().enumerate() {
            let seek = &mut self.seek[side];
            while *seek + 1 < end && distance(*seek + 1) <= distance(*seek) {
                *seek += 1;
            }
            near[side] = (*seek < end).then(|| codes[*seek]);
        }
        Near(near)
    }
}

/// The segments that another is predicted from, where there are any.
pub(super) struct Near([Option<Code>; 2]);

impl Near {
    /// Code of the optical depth of a segment of such a thickness, if the extinction is the same.
    pub(super) fn tau(&self, scale: &Scale, thickness: u16) -> u8 {
        self.mean(|n| {
            let times = f32::from(thickness) / f32::from(n.back.saturating_sub(n.front).max(1));
            scale.tau_code(scale.tau[usize::from(n.tau)] * times).into()
        }) as u8
    }

    /// Codes of the colour of a segment of such an optical depth, if the source colour is the same.
    pub(super) fn color(&self, scale: &Scale, tau: u8) -> [u16; 3] {
        let of_tau = scale.sqrt_alpha[usize::from(tau)];
        let scaled = |n: &Code| {
            let times = of_tau * scale.inverse_sqrt_alpha[usize::from(n.tau)];
            n.c.map(|q| scale.clamp_code((f32::from(q) * times + 0.5) as u32))
        };
        match &self.0 {
            [Some(a), Some(b)] => {
                let (a, b) = (scaled(a), scaled(b));
                std::array::from_fn(|ch| (a[ch] + b[ch]) / 2)
            }
            [Some(a), None] | [None, Some(a)] => scaled(a),
            [None, None] => [0; 3],
        }
    }

    fn mean(&self, of: impl Fn(&Code) -> u16) -> u16 {
        match &self.0 {
            [Some(a), Some(b)] => ((u32::from(of(a)) + u32::from(of(b))) / 2) as u16,
            [Some(a), None] | [None, Some(a)] => of(a),
            [None, None] => 0,
        }
    }
}

/// The prediction of channel `ch` made better by the channels before it: scaled as their sum turned out to be, unless
/// that is too dark to tell.
pub(super) fn corrected(scale: &Scale, ch: usize, predicted: &[u16; 3], c: &[u16; 3]) -> u16 {
    let sum = |codes: &[u16; 3]| codes[..ch].iter().map(|&q| u32::from(q)).sum::<u32>();
    let (was, is) = (sum(predicted), sum(c));
    if was < u32::from(scale.max_code() / 8) || ch == 0 {
        return predicted[ch];
    }
    scale.clamp_code((u32::from(predicted[ch]) * is + was / 2) / was)
}
