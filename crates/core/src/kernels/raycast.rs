//! Novel views: ray casts a layered frame from any camera (Gupta 2022, section 3; Lochmann 2016, section 3.3). Twin
//! of `shaders/raycast.wgsl`.
//!
//! A new ray P(s) = O + s·D is linear in the homogeneous pixel coordinates (x·w, y·w, w) of the generating camera,
//! w being the view depth there. The six planes of its frustum are linear in s too, so the ray is clipped before any
//! division, also when it runs towards the old eye or starts behind it (design, trap 7). Between the clipped ends
//! with depths w0, w1 and world distance S, the projection is a straight line; with t its parameter,
//!
//!   depth(t) = w0·w1/(w1 + t(w0 − w1)),    distance(t) = S·t·w0/(w1 + t(w0 − w1)),
//!
//! so one division a list gives both, by three constants a ray (S·w0, w1, w0 − w1). In each list the segments that
//! the ray's depth interval overlaps are composited in the ray's order, front to back or, if the ray runs towards
//! the old eye, back to front. A segment crossed over a length l of its own length z gives opacity 1 − (1 − α)^(l/z).
//!
//! A DDA (Amanatides & Woo 1987) walks along the axis on which the line runs faster, from one column (or row) of
//! lists to the next. Across it the line lies between the centres of two lists: both are composited over the same
//! interval and mixed by nearness. Along the line lists have their exact shares of it; across it this removes the
//! stair-steps of the nearest list. A ray of the frame's own pose runs through a centre, where the nearest list has
//! all of the weight, so the own pose stays exact (ours; the sources take the nearest list).

use glam::Vec3;
use rayon::prelude::*;

use super::march::{TRANSMITTANCE_MIN, opacity};
use crate::camera::{Basis, Camera};
use crate::layer::{DEPTH_UNITS, LayeredFrame, Over, Segment};
use crate::picture::Picture;
use crate::space::{Aabb, Ray};

/// A frame with what is constant over all new rays.
pub struct Raycaster<'a> {
    frame: &'a LayeredFrame,
    basis: Basis,
    bounds: Aabb,
    near: f32,
    units_per_depth: f32,
}

/// A ray clipped to the old frustum: a straight line in pixel space, and the three constants.
struct Line {
    /// Pixel position at t = 0.
    p0: [f32; 2],
    /// Pixel position at t = 1 minus that at t = 0.
    d: [f32; 2],
    s_w0: f32,
    w1: f32,
    w0_minus_w1: f32,
    w0_w1: f32,
}

/// The part of a ray inside a column of lists.
struct Crossing {
    /// Least depth, in units.
    lo: f32,
    /// Greatest depth, in units.
    hi: f32,
    /// World length of the ray for each unit of depth.
    length_per_unit: f32,
    /// Whether the ray runs away from the old eye.
    is_forward: bool,
}

impl Crossing {
    /// Between two points of the line, each a depth in units and a distance.
    fn new(line: &Line, enter: (f32, f32), leave: (f32, f32)) -> Self {
        let lo = enter.0.min(leave.0);
        // A ray along the old image plane stays at one depth; the guard makes the share of the crossing 1.
        let hi = enter.0.max(leave.0).max(lo + MIN_CROSSING);
        let is_forward = line.w0_minus_w1 <= 0.0;
        Self { lo, hi, length_per_unit: (leave.1 - enter.1) / (hi - lo), is_forward }
    }
}

impl<'a> Raycaster<'a> {
    /// `bounds` is the box of the volume that the frame was made of.
    pub fn new(frame: &'a LayeredFrame, bounds: &Aabb) -> Self {
        let camera = &frame.header.camera;
        let depth_per_unit = (camera.far - camera.near) / DEPTH_UNITS;
        // Rounding puts a segment's end up to half a unit outside of the box.
        let margin = Vec3::splat(2.0 * depth_per_unit);
        Self {
            frame,
            basis: camera.basis(),
            bounds: Aabb { min: bounds.min - margin, max: bounds.max + margin },
            near: camera.near,
            units_per_depth: depth_per_unit.recip(),
        }
    }

    /// Premultiplied colour and opacity seen along a ray of world space.
    pub fn cast(&self, ray: &Ray) -> Over {
        let mut acc = Over::default();
        if let Some(line) = self.clip(ray) {
            self.walk(&line, &mut acc);
        }
        acc
    }

    /// Clips in homogeneous coordinates.
    fn clip(&self, ray: &Ray) -> Option<Line> {
        let (mut s0, mut s1) = self.bounds.clip(ray)?;
        let o = self.basis.pixel_from_world(ray.origin - self.basis.eye);
        let d = self.basis.pixel_from_world(ray.dir);
        let (width, height) = (self.basis.width, self.basis.height);
        let planes = [
            (o.z - self.near, d.z),
            (o.x, d.x),
            (width * o.z - o.x, width * d.z - d.x),
            (o.y, d.y),
            (height * o.z - o.y, height * d.z - d.y),
        ];
        for (a, b) in planes {
            // Inside where a + b·s ≥ 0.
            if b > 0.0 {
                s0 = s0.max(-a / b);
            } else if b < 0.0 {
                s1 = s1.min(-a / b);
            } else if a < 0.0 {
                return None;
            }
        }
        if s1 <= s0 {
            return None;
        }
        let (h0, h1) = (o + d * s0, o + d * s1);
        let (w0, w1) = (h0.z.max(self.near), h1.z.max(self.near));
        let p0 = [h0.x / w0, h0.y / w0];
        let p1 = [h1.x / w1, h1.y / w1];
        Some(Line {
            p0,
            d: [p1[0] - p0[0], p1[1] - p0[1]],
            s_w0: (s1 - s0) * w0,
            w1,
            w0_minus_w1: w0 - w1,
            w0_w1: w0 * w1,
        })
    }

    /// Walks the columns of lists along the line.
    fn walk(&self, line: &Line, acc: &mut Over) {
        let size = [self.basis.width as i32, self.basis.height as i32];
        let along = usize::from(line.d[0].abs() + AXIS_BIAS < line.d[1].abs());
        let across = 1 - along;
        let mut column = (line.p0[along].floor() as i32).clamp(0, size[along] - 1);
        let (step, mut t_next, dt) = axis(line.p0[along], line.d[along], column);
        let mut hints = [0; 2];
        let mut t_in = 0.0;
        let mut enter = self.at(line, t_in);
        loop {
            let t_out = t_next.min(1.0);
            let leave = self.at(line, t_out);
            if leave.1 > enter.1 {
                let crossing = Crossing::new(line, enter, leave);
                let at_across = line.p0[across] + line.d[across] * (0.5 * (t_in + t_out)) - 0.5;
                let first = at_across.floor();
                let nearness = [1.0 - (at_across - first), at_across - first];
                let mut mixed = (Vec3::ZERO, 0.0);
                for side in 0..2 {
                    if nearness[side] < MIN_NEARNESS {
                        continue;
                    }
                    let row = (first as i32 + side as i32).clamp(0, size[across] - 1);
                    let (x, y) = if along == 0 { (column, row) } else { (row, column) };
                    let mut list = Over::default();
                    self.cross_list(x, y, &crossing, &mut hints[side], &mut list);
                    mixed.0 += list.c * nearness[side];
                    mixed.1 += (1.0 - list.transmittance) * nearness[side];
                }
                acc.c += mixed.0 * acc.transmittance;
                acc.transmittance *= 1.0 - mixed.1;
                if acc.transmittance < TRANSMITTANCE_MIN {
                    return;
                }
            }
            if t_out >= 1.0 {
                return;
            }
            (t_in, enter) = (t_out, leave);
            column += step;
            t_next += dt;
            if column < 0 || column >= size[along] {
                return;
            }
        }
    }

    /// Depth in units and world distance from the start of the line.
    fn at(&self, line: &Line, t: f32) -> (f32, f32) {
        let r = 1.0 / (line.w1 + t * line.w0_minus_w1);
        ((line.w0_w1 * r - self.near) * self.units_per_depth, line.s_w0 * t * r)
    }

    /// Composites the segments of list (`x`, `y`) that the crossing meets. `hint` is the index at which the list before
    /// was left.
    fn cross_list(&self, x: i32, y: i32, crossing: &Crossing, hint: &mut usize, acc: &mut Over) {
        let list =
            self.frame.list(y as usize * self.frame.header.camera.intrinsics.width as usize + x as usize);
        if list.is_empty() {
            return;
        }
        let &Crossing { lo, hi, length_per_unit, is_forward } = crossing;
        // World length of one depth unit along the centre of this list.
        let nx = (2.0 * x as f32 + 1.0) / self.basis.width - 1.0;
        let ny = 1.0 - (2.0 * y as f32 + 1.0) / self.basis.height;
        let center = self.basis.forward + self.basis.right * nx + self.basis.up * ny;
        let ratio = length_per_unit * self.units_per_depth / center.length();
        let ends = |i: usize| {
            let word = self.frame.depth[i];
            ((word & 0xffff) as f32, (word >> 16) as f32)
        };
        // Previous-index search (Gupta 2022, algorithm 1): neighbouring lists are alike, so start where the last
        // list was left and walk to the first segment that the ray meets.
        let mut i = list.start + (*hint).min(list.len() - 1);
        if is_forward {
            while i > list.start && ends(i - 1).1 > lo {
                i -= 1;
            }
            while i < list.end && ends(i).1 <= lo {
                i += 1;
            }
            while i < list.end && ends(i).0 < hi {
                self.cross_segment(i, ends(i), (lo, hi), ratio, acc);
                i += 1;
            }
            *hint = i.max(list.start + 1) - list.start - 1;
        } else {
            while i + 1 < list.end && ends(i + 1).0 < hi {
                i += 1;
            }
            let mut after = i + 1;
            while after > list.start && ends(after - 1).0 >= hi {
                after -= 1;
            }
            while after > list.start && ends(after - 1).1 > lo {
                self.cross_segment(after - 1, ends(after - 1), (lo, hi), ratio, acc);
                after -= 1;
            }
            *hint = after - list.start;
        }
    }

    /// Composites the part of segment `i` between the depths `lo` and `hi`; `ratio` is the ray's length over the
    /// list's own length, for the same depth.
    fn cross_segment(
        &self,
        i: usize,
        (front, back): (f32, f32),
        (lo, hi): (f32, f32),
        ratio: f32,
        acc: &mut Over,
    ) {
        let overlap = hi.min(back) - lo.max(front);
        if overlap <= 0.0 {
            return;
        }
        let Segment { c, tau, .. } = self.frame.segment(i);
        let tau_crossed = tau * (overlap / (back - front)) * ratio;
        let alpha = opacity(tau);
        if alpha <= 0.0 {
            return;
        }
        let alpha_crossed = opacity(tau_crossed);
        acc.c += c * (acc.transmittance * alpha_crossed / alpha);
        acc.transmittance *= 1.0 - alpha_crossed;
    }
}

/// DDA along one axis: step of the index, parameter of the first crossing, parameter between crossings.
fn axis(p: f32, d: f32, index: i32) -> (i32, f32, f32) {
    if d.abs() < MIN_SLOPE {
        return (0, f32::INFINITY, f32::INFINITY);
    }
    let edge = if d > 0.0 { index as f32 + 1.0 } else { index as f32 };
    (if d > 0.0 { 1 } else { -1 }, (edge - p) / d, 1.0 / d.abs())
}

/// The picture of a layered frame from a camera. Premultiplied linear. `bounds` is the box of the volume.
pub fn raycast(frame: &LayeredFrame, bounds: &Aabb, camera: &Camera) -> Picture {
    let mut picture = Picture::new(camera.intrinsics.width, camera.intrinsics.height);
    let caster = Raycaster::new(frame, bounds);
    let basis = camera.basis();
    let width = picture.width as usize;
    picture.pixels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let (ray, _) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
            *pixel = caster.cast(&ray).rgba();
        }
    });
    picture
}

/// Shortest depth interval that is divided by, in depth units: far below the rounding of a segment's ends.
const MIN_CROSSING: f32 = 1e-2;
/// A list with less weight than this is left out: a quarter of one step of 1/255.
const MIN_NEARNESS: f32 = 1e-3;
/// A row must win by so many pixels: where the eye has not moved and no line moves, rounding must not choose.
const AXIS_BIAS: f32 = 1e-2;
/// A line that moves less than this many pixels in all crosses no border worth a division.
const MIN_SLOPE: f32 = 1e-6;
