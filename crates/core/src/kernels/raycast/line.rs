//! A ray in the pixel space of the frame, and its walk from column to column of lists.

use super::{LANES, Raycaster};
use crate::camera::PixelLine;
use crate::kernels::empty_space::TILE;
use crate::layer::DEPTH_UNITS;

/// A ray clipped to the frame's frustum: a straight line in pixel space, and the three constants.
pub(in crate::kernels) struct PixelSpan {
    /// Pixel position at t = 0.
    pub(in crate::kernels) p0: [f32; 2],
    /// Pixel position at t = 1 minus that at t = 0.
    pub(in crate::kernels) d: [f32; 2],
    /// World distance from the ray's origin to t = 0.
    pub(super) s0: f32,
    pub(in crate::kernels) s_w0: f32,
    pub(in crate::kernels) w1: f32,
    pub(in crate::kernels) w0_minus_w1: f32,
    /// View depth is this times the reciprocal of the weight, plus the next number times t.
    pub(super) depth_over_w: f32,
    pub(super) depth_slope: f32,
    /// Parameters before and after which the line meets nothing.
    pub(super) reach: [f32; 2],
}

impl PixelSpan {
    /// Cuts the line to two world distances from the ray's origin. Returns whether anything is left.
    #[inline(always)]
    pub(super) fn narrow(&mut self, distances: [f32; 2]) -> bool {
        let [first, last] = distances.map(|s| s - self.s0);
        // The whole length, S·w0/w0.
        let length = self.s_w0 / (self.w1 + self.w0_minus_w1);
        let t = |s: f32| s * self.w1 / (self.s_w0 - s * self.w0_minus_w1);
        self.reach = [if first > 0.0 { t(first) } else { 0.0 }, if last < length { t(last) } else { 1.0 }];
        first < length && last > 0.0
    }
}

/// The near plane and the borders of a frustum along a ray. Each pair (a, b) is inside where a + b·s ≥ 0. The borders
/// are those of a picture of `size`, moved `inset` pixels inwards.
#[inline(always)]
pub(in crate::kernels) fn frustum_planes(
    &PixelLine { o, d, depth }: &PixelLine,
    [width, height]: [f32; 2],
    near: f32,
    inset: f32,
) -> [(f32, f32); 5] {
    let (right, bottom) = (width - inset, height - inset);
    [
        (depth[0] - near, depth[1]),
        (o.x - inset * o.z, d.x - inset * d.z),
        (right * o.z - o.x, right * d.z - d.x),
        (o.y - inset * o.z, d.y - inset * d.z),
        (bottom * o.z - o.y, bottom * d.z - d.y),
    ]
}

/// The part of `within` inside all planes; empty unless its end is after its start.
#[inline(always)]
pub(in crate::kernels) fn clip_by_planes(
    planes: [(f32, f32); 5],
    (mut s0, mut s1): (f32, f32),
) -> (f32, f32) {
    for (a, b) in planes {
        if b > 0.0 {
            s0 = s0.max(-a / b);
        } else if b < 0.0 {
            s1 = s1.min(-a / b);
        } else if a < 0.0 {
            return (s1, s1);
        }
    }
    (s0, s1)
}

/// The parts of a ray in successive columns of lists, or between all list borders for the nearest list.
pub(super) struct ColumnSpans<const N: usize> {
    /// The number of parts.
    pub(super) num: usize,
    /// Least depth, in units.
    pub(super) lo: [f32; N],
    /// The same, rounded down.
    pub(super) lo_units: [i32; N],
    /// Greatest depth, in units.
    pub(super) hi: [f32; N],
    /// The same, rounded down.
    pub(super) hi_units: [i32; N],
    /// World length of the ray per unit of depth.
    pub(super) length_per_unit: [f32; N],
    /// The first of the two lists that it runs between, across the line; or the nearest list.
    pub(super) row: [i32; N],
    /// Nearness to the second.
    pub(super) fraction: [f32; N],
}

impl<const N: usize> ColumnSpans<N> {
    /// The columns of a tile from `column` on, between two parameters of the line.
    #[inline(always)]
    pub(super) fn new(
        caster: &Raycaster,
        line: &PixelSpan,
        columns: &Columns,
        column: i32,
        (t_in, t_out): (f32, f32),
        across: usize,
    ) -> Self {
        let (p_across, d_across) = (line.p0[across], line.d[across]);
        let mut t = [t_in; N];
        let mut t_end = [t_out; N];
        if N == LANES {
            for (i, t_end) in t_end.iter_mut().enumerate() {
                *t_end = lesser(columns.t(column, i as i32), t_out);
            }
            t[1..].copy_from_slice(&t_end[..N - 1]);
        } else {
            // The line runs faster along than across, so it changes its row at most once per column.
            let mut t_column = t_in;
            for i in 0..N / 2 {
                let end = lesser(columns.t(column, i as i32), t_out);
                let (row, row_end) =
                    (row_of(p_across + d_across * t_column), row_of(p_across + d_across * end));
                let border =
                    if row == row_end { end } else { (row.max(row_end) as f32 - p_across) / d_across };
                t[2 * i] = t_column;
                t_end[2 * i] = border.clamp(t_column, end);
                t[2 * i + 1] = t_end[2 * i];
                t_end[2 * i + 1] = end;
                t_column = end;
            }
        }
        let mut s = Self {
            num: 0,
            lo: [0.0; N],
            lo_units: [0; N],
            hi: [0.0; N],
            hi_units: [0; N],
            length_per_unit: [0.0; N],
            row: [0; N],
            fraction: [0.0; N],
        };
        // Each loop compiles to a few vector instructions.
        let (mut depth, mut distance) = ([0.0; N], [0.0; N]);
        for i in 0..N {
            (depth[i], distance[i]) = caster.at(line, t[i]);
        }
        let (mut depth_end, mut distance_end) = ([0.0; N], [0.0; N]);
        for i in 0..N {
            (depth_end[i], distance_end[i]) = caster.at(line, t_end[i]);
        }
        for i in 0..N {
            s.lo[i] = lesser(depth[i], depth_end[i]);
            // A ray parallel to the old image plane stays at one depth; the guard makes its share of the crossing 1.
            s.hi[i] = greater(greater(depth[i], depth_end[i]), s.lo[i] + MIN_CROSSING);
        }
        for i in 0..N {
            s.length_per_unit[i] = (distance_end[i] - distance[i]) / (s.hi[i] - s.lo[i]);
        }
        for i in 0..N {
            s.lo_units[i] = floor_and_fraction(greater(lesser(s.lo[i], LAST_UNIT), 0.0)).0;
        }
        for i in 0..N {
            s.hi_units[i] = floor_and_fraction(greater(lesser(s.hi[i], DEPTH_UNITS), 0.0)).0;
        }
        for t in t {
            s.num += usize::from(t < t_out);
        }
        for i in 0..N {
            let at_across = p_across + d_across * (0.5 * (t[i] + t_end[i]));
            (s.row[i], s.fraction[i]) =
                if N == LANES { floor_and_fraction(at_across - 0.5) } else { (row_of(at_across), 0.0) };
        }
        s
    }

    /// Shifts weight to the nearer list of each column, the more, the less of it is visible. So the other list may
    /// need no look-up. The shift is continuous in the transmittance.
    #[inline(always)]
    pub(super) fn prefer_nearer(&mut self, transmittance: f32) {
        let bias = lesser(NEARER_SHARE / (transmittance * transmittance), MOST_NEARER);
        let scale = 1.0 / (1.0 - 2.0 * bias);
        for fraction in &mut self.fraction {
            *fraction = lesser(greater((*fraction - bias) * scale, 0.0), 1.0);
        }
    }
}

/// The row of lists at a position.
#[inline(always)]
fn row_of(position: f32) -> i32 {
    // Rounding may give slightly negative positions; rows are clamped later.
    (position + 1.0) as i32 - 1
}

/// Compiles to one instruction, which ignores NaN.
#[inline(always)]
pub(in crate::kernels) fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
pub(in crate::kernels) fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The columns of lists along a line: a DDA along one axis.
pub(in crate::kernels) struct Columns {
    /// Step of the index.
    pub(in crate::kernels) step: i32,
    /// The line crosses the border at pixel position x at the parameter x·slope + offset; 0 and infinite for a line
    /// that crosses none.
    pub(super) slope: f32,
    offset: f32,
    /// 1 if the line leaves a column at its upper border.
    leaves_by: i32,
}

impl Columns {
    pub(in crate::kernels) fn new(p: f32, d: f32) -> Self {
        if d.abs() < MIN_SLOPE {
            return Self { step: 1, slope: 0.0, offset: f32::INFINITY, leaves_by: 1 };
        }
        let forward = d > 0.0;
        let slope = 1.0 / d;
        Self { step: if forward { 1 } else { -1 }, slope, offset: -p * slope, leaves_by: forward.into() }
    }

    /// Number of columns from `column` to the border of the tile or frame.
    #[inline(always)]
    pub(in crate::kernels) fn num_in_tile(&self, column: i32, size: i32) -> i32 {
        let in_tile = column & (TILE as i32 - 1);
        if self.step > 0 { (TILE as i32 - in_tile).min(size - column) } else { in_tile + 1 }
    }

    /// The first column of the tile that holds position `p`, not before `column`, and where the line enters it.
    #[inline(always)]
    pub(super) fn tile_at(&self, p: f32, column: i32, size: i32) -> Option<(i32, f32)> {
        let of_tile = TILE as i32 - 1;
        // Rounding may have skipped one column.
        let at = (p as i32 - self.step).clamp(0, size - 1);
        let first = if self.step > 0 { at & !of_tile } else { (at | of_tile).min(size - 1) };
        let is_ahead = (first - column) * self.step > 0 && self.slope != 0.0;
        is_ahead.then(|| (first, self.t(first - self.step, 0)))
    }

    /// The parameter at which the line leaves the column `i` steps after `column`.
    #[inline(always)]
    pub(in crate::kernels) fn t(&self, column: i32, i: i32) -> f32 {
        (column + self.leaves_by + self.step * i) as f32 * self.slope + self.offset
    }
}

/// The largest integer not above a small number, and the rest. At an integer, the one below with a rest of 1 is right
/// too.
#[inline(always)]
fn floor_and_fraction(x: f32) -> (i32, f32) {
    // Adding 1.5·2²³ rounds to the nearest integer and leaves it in the low bits.
    let shifted = (x - 0.5) + ROUNDER;
    (shifted.to_bits() as i32 - ROUNDER.to_bits() as i32, x - (shifted - ROUNDER))
}

/// The back of the last segment and the filling both end here, behind everything.
const LAST_UNIT: f32 = DEPTH_UNITS - 1.0;
/// Shortest depth interval that is divided by, depth units: far below the rounding of a segment's ends.
const MIN_CROSSING: f32 = 1e-2;
/// Nearness below which a list is ignored at full visibility. It is divided by the transmittance squared. With this
/// value, DSSIM grows by at most .3 % at 5 and 10° (the cloud's by 1 %), and casts at 30° take 3 to 10 % less time.
const NEARER_SHARE: f32 = 0.005;
const MOST_NEARER: f32 = 0.48;
/// Pixels that a line must move in all to cross a border.
const MIN_SLOPE: f32 = 1e-6;
/// 1.5·2²³.
pub(super) const ROUNDER: f32 = 12_582_912.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearer_list_takes_over_where_little_is_seen_and_nowhere_at_a_stroke() {
        let nearness = |fraction: f32, transmittance: f32| {
            let mut stretch = ColumnSpans::<1> {
                num: 1,
                lo: [0.0],
                hi: [1.0],
                lo_units: [0],
                hi_units: [1],
                length_per_unit: [1.0],
                row: [0],
                fraction: [fraction],
            };
            stretch.prefer_nearer(transmittance);
            stretch.fraction[0]
        };
        // In front of all matter it hardly shows, behind much of it one list of most pairs has all of the weight.
        assert!((0..=100).all(|i| (nearness(i as f32 / 100.0, 1.0) - i as f32 / 100.0).abs() < 0.0051));
        let is_mixed = |i: &i32| (1e-6..1.0 - 1e-6).contains(&nearness(*i as f32 / 1e3, 0.1));
        assert!((30..=41).contains(&(0..=1000).filter(is_mixed).count()));
        for transmittance in [1.0, 0.5, 0.2, 0.1, 1e-4] {
            // A ray of the frame's own pose runs through centres, and between two centres neither is preferred.
            for fixed in [0.0, 0.5, 1.0] {
                assert!((nearness(fixed, transmittance) - fixed).abs() < 1e-5);
            }
            let mut before = 0.0;
            for i in 0..=10_000 {
                let [f, less_seen] = [1.0, 0.99].map(|t| nearness(i as f32 / 1e4, transmittance * t));
                assert!(
                    f >= before && f - before < 3e-3 && (f - less_seen).abs() < 0.02,
                    "{transmittance} {i}"
                );
                before = f;
            }
        }
    }
}
