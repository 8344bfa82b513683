//! Casting a projection: nothing hides anything, so the order of segments does not matter. Twin of the branches for it in
//! `shaders/raycast.wgsl`.
//!
//! The two lists that a ray runs between are each reduced to one pair over a column, colour and key, and these mixed by
//! nearness; of the columns the greatest key wins, or their colours add. A [`Medium`](super::media::Medium) holds
//! - of the greatest: the colour in place of E and the key in place of σ;
//! - of the mean: in place of E the segment's part of the integral over its list's way through the box ([`Way`]), in place of σ the
//!   inverse of its length. A new ray takes of it the share that it crosses, and divides by its own way in the end. Both
//!   ways are found alike, so at the frame's own pose they cancel out.

use glam::Vec4;

use super::line::{ColumnSpans, Columns, PixelSpan, greater, lesser};
use super::{CastOptions, LANES, MIN_NEARNESS, Raycaster, Reconstruction};
use crate::layer::{Over, Projected};
use crate::mode::Compositing;
use crate::space::{Aabb, Ray};

/// Path lengths of rays through the volume's box. They cover the whole box, because a frame does not say how the
/// volume was clipped.
pub(super) struct Way {
    bounds: Aabb,
    /// Parts per unit of length; the box's diagonal has [`PARTS`].
    parts_per_length: f32,
    least: f32,
}

impl Way {
    pub(super) fn new(bounds: &Aabb) -> Self {
        let diagonal = (bounds.max - bounds.min).length();
        Self { bounds: *bounds, parts_per_length: PARTS / diagonal, least: diagonal * LEAST_WAY }
    }

    /// The length of a ray in the box, in parts.
    pub(super) fn parts(&self, ray: &Ray) -> f32 {
        let length = self.bounds.clip(ray).map_or(0.0, |(s0, s1)| s1 - s0);
        greater(length, self.least) * self.parts_per_length
    }
}

impl Raycaster {
    /// What a line collects.
    pub(super) fn project_line(&self, line: &PixelSpan, options: &CastOptions) -> Projected {
        match options.reconstruction {
            Reconstruction::Mixed => self.project::<LANES>(line, options),
            Reconstruction::Nearest => self.project::<{ 2 * LANES }>(line, options),
        }
    }

    /// What a ray collects between two world distances from its origin.
    pub(in crate::kernels) fn project_between(
        &self,
        ray: &Ray,
        within: (f32, f32),
        options: &CastOptions,
    ) -> Projected {
        self.clip(ray, within, &self.region(&options.clip))
            .map_or_else(Projected::default, |line| self.project_line(&line, options))
    }

    /// The colour that a ray shows for what it collected.
    pub(in crate::kernels) fn shown(&self, collected: &Projected, ray: &Ray) -> Over {
        let way = if self.compositing == Compositing::Mean { self.way.parts(ray) } else { 1.0 };
        let c = collected.c / way;
        Over { c, transmittance: 1.0 - c.max_element().min(1.0) }
    }

    /// Walks the columns of lists along the line, as the cast of other frames does.
    fn project<const N: usize>(&self, line: &PixelSpan, options: &CastOptions) -> Projected {
        let along = usize::from(line.d[0].abs() + super::AXIS_BIAS < line.d[1].abs());
        let across = 1 - along;
        let (size_along, size_across) = (self.size[along], self.size[across]);
        let columns = Columns::new(line.p0[along], line.d[along]);
        let num_sides = 2 * LANES / N;
        let mut collected = Projected::default();
        let mut column = (line.p0[along].floor() as i32).clamp(0, size_along - 1);
        let mut t_in = 0.0;
        let start = line.p0[along] + line.d[along] * line.reach[0];
        if let Some(ahead) = columns.tile_at(start, column, size_along) {
            (column, t_in) = ahead;
        }
        let mut enter = self.at(line, t_in);
        loop {
            let num = columns.num_in_tile(column, size_along);
            let t_out = lesser(columns.t(column, num - 1), 1.0);
            let leave = self.at(line, t_out);
            let rows = [t_in, t_out].map(|t| line.p0[across] + line.d[across] * t - 0.5);
            if !options.skips_empty_space
                || self.is_occupied(column, rows, [enter.0, leave.0], along, size_across)
            {
                let stretch = ColumnSpans::<N>::new(self, line, &columns, column, (t_in, t_out), across);
                for i in 0..stretch.num {
                    let column = column + columns.step * (i * LANES / N) as i32;
                    let nearness = [1.0 - stretch.fraction[i], stretch.fraction[i]];
                    let crossing = [stretch.lo[i], stretch.hi[i], stretch.length_per_unit[i]];
                    let mut mixture = Vec4::ZERO;
                    for (side, &nearness) in nearness.iter().enumerate().take(num_sides) {
                        if nearness >= MIN_NEARNESS {
                            let row = stretch.row[i] + side as i32;
                            mixture += self.project_list(column, row, along, crossing) * nearness;
                        }
                    }
                    collected.add(self.compositing, mixture.truncate(), mixture.w);
                }
                if collected.key >= KEY_FULL {
                    break;
                }
            }
            column += columns.step * num;
            if t_out >= line.reach[1] || column < 0 || column >= size_along {
                break;
            }
            (t_in, enter) = (t_out, leave);
        }
        collected
    }

    /// Colour and key of a list between two depths; `length_per_unit` is the world length per unit of depth.
    fn project_list(&self, column: i32, row: i32, along: usize, crossing: [f32; 3]) -> Vec4 {
        let [lo, hi, length_per_unit] = crossing;
        let media = self.list(column, row, along);
        let first = media.partition_point(|medium| medium.back() <= lo);
        let mut collected = Projected::default();
        for medium in media[first..].iter().take_while(|medium| medium.front() < hi) {
            let overlap = lesser(hi, medium.back()) - greater(lo, medium.front());
            if overlap > 0.0 {
                let share = match self.compositing {
                    Compositing::Mean => overlap * length_per_unit * medium.sigma,
                    _ => 1.0,
                };
                collected.add(self.compositing, medium.e().truncate() * share, medium.sigma);
            }
        }
        collected.c.extend(collected.key)
    }
}

/// Parts of the longest path: enough that the shortest is no subnormal half float.
const PARTS: f32 = 1024.0;
/// Shortest path that is divided by, in diagonals: near the edges of the box, a list's path may be many times that of
/// a ray beside it.
const LEAST_WAY: f32 = 0.0078125;
/// No key is greater, apart from rounding to a half float.
const KEY_FULL: f32 = 0.9995;
