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

use glam::{Vec3, Vec4};
use rayon::prelude::*;

use super::empty_space::{EmptySpace, TILE, cell_bits, cell_of_depth};
use super::march::TRANSMITTANCE_MIN;
use crate::camera::{Basis, Camera};
use crate::layer::{DEPTH_UNITS, LayeredFrame, Over, pack_halves};
use crate::picture::Picture;
use crate::space::{Aabb, Ray};

/// How a ray reads the lists that it runs between.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Reconstruction {
    /// The list whose area the ray crosses, as in the sources.
    Nearest,
    /// The two lists whose centres the ray runs between, mixed by nearness.
    #[default]
    Mixed,
}

/// How to cast.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CastOptions {
    /// How the lists are read.
    pub reconstruction: Reconstruction,
    /// Whether empty cells are jumped; the picture is the same without.
    pub skips_empty_space: bool,
    /// Samples a ray ([`super::subsample`]), or 0 for the full cast.
    pub num_samples: u32,
}

impl Default for CastOptions {
    fn default() -> Self {
        Self { reconstruction: Reconstruction::default(), skips_empty_space: true, num_samples: 0 }
    }
}

/// A frame made ready for any number of rays: its segments unpacked to what a crossing needs.
pub struct Raycaster {
    offsets: Vec<u32>,
    media: Vec<Medium>,
    /// Backs of each list, filled up to `row_length`.
    backs: Vec<u16>,
    row_length: usize,
    /// Bit i of a list says that cell i of its depth holds a segment.
    occupied: Vec<u64>,
    empty_space: EmptySpace,
    pub(super) size: [i32; 2],
    eye: Vec3,
    /// Homogeneous pixel coordinates (x·w, y·w, w) of a world-space vector are its products with these.
    pixel_rows: [Vec3; 3],
    bounds: Aabb,
    near: f32,
    units_per_depth: f32,
}

/// A segment as a homogeneous medium, in 16 bytes: casting waits for memory as much as it computes.
#[derive(Clone, Copy, Default)]
#[repr(C, align(16))]
pub(super) struct Medium {
    /// Front and back as in a frame's depth plane.
    depth: u32,
    /// Extinction along the list's centre, 1/world unit.
    pub(super) sigma: f32,
    /// Source colour E = C/α, and 1, as half floats.
    e: [u16; 4],
}

impl Medium {
    pub(super) fn front(&self) -> f32 {
        (self.depth & 0xffff) as i32 as f32
    }

    pub(super) fn back(&self) -> f32 {
        (self.depth >> 16) as i32 as f32
    }

    /// E and 1.
    pub(super) fn e(&self) -> Vec4 {
        Vec4::from_array(self.e.map(|h| f32::from_bits(u32::from(h) << 13))) * HALF_SCALE
    }
}

/// A ray clipped to the old frustum: a straight line in pixel space, and the three constants.
pub(super) struct Line {
    /// Pixel position at t = 0.
    pub(super) p0: [f32; 2],
    /// Pixel position at t = 1 minus that at t = 0.
    pub(super) d: [f32; 2],
    pub(super) s_w0: f32,
    pub(super) w1: f32,
    pub(super) w0_minus_w1: f32,
    w0_w1: f32,
}

/// The parts of a ray inside successive columns of lists, or, for the nearest list, between all borders of lists.
struct Stretch<const N: usize> {
    /// How many there are.
    num: usize,
    /// Least depth, in units.
    lo: [f32; N],
    /// The same, rounded down.
    lo_units: [u16; N],
    /// Greatest depth, in units.
    hi: [f32; N],
    /// The same, rounded down.
    hi_units: [u16; N],
    /// World length of the ray for each unit of depth.
    length_per_unit: [f32; N],
    /// The first of the two lists that it runs between, across the way; for the nearest list, that one.
    row: [i32; N],
    /// Nearness to the second.
    fraction: [f32; N],
}

/// Crossed parts of segments, in the order of the ray: what is worked on at a time.
struct Pieces {
    num: usize,
    /// Optical depth.
    tau: [f32; MAX_PIECES],
    rest: [Piece; MAX_PIECES],
}

#[derive(Clone, Copy, Default)]
struct Piece {
    /// Nearness of the list.
    weight: f32,
    segment: u32,
    /// 1 for the first piece of a column, else 0.
    starts_column: f32,
    /// 1 for a piece behind another one of the same list, else 0.
    continues_list: f32,
}

impl Pieces {
    fn new() -> Self {
        Self { num: 0, tau: [0.0; MAX_PIECES], rest: [Piece::default(); MAX_PIECES] }
    }
}

/// What is seen along a ray, up to some piece of a column.
struct Sum {
    color: Vec4,
    /// In front of the column.
    before: f32,
    /// Opacity of the column, lists mixed.
    mixed: f32,
    /// Transmittance of the list.
    of_list: f32,
}

impl Default for Sum {
    fn default() -> Self {
        Self { color: Vec4::ZERO, before: 1.0, mixed: 0.0, of_list: 1.0 }
    }
}

impl Sum {
    /// Puts the pieces behind what is there, and forgets them. Factors of 0 and 1 instead of branches, which a
    /// processor would guess wrong.
    #[inline]
    fn add(&mut self, media: &[Medium], pieces: &mut Pieces) {
        let num = std::mem::take(&mut pieces.num);
        let padded = num.next_multiple_of(4).min(MAX_PIECES);
        for tau in &mut pieces.tau[..padded] {
            *tau = opacity(*tau);
        }
        for (piece, &alpha) in pieces.rest[..num].iter().zip(&pieces.tau) {
            self.before *= 1.0 - self.mixed * piece.starts_column;
            self.mixed *= 1.0 - piece.starts_column;
            self.of_list = (1.0 - piece.continues_list) + piece.continues_list * self.of_list;
            let share = self.of_list * alpha * piece.weight;
            self.of_list *= 1.0 - alpha;
            self.mixed += share;
            self.color += media[piece.segment as usize].e() * (share * self.before);
        }
    }

    fn transmittance(&self) -> f32 {
        self.before * (1.0 - self.mixed)
    }
}

impl Raycaster {
    /// `bounds` is the box of the volume that the frame was made of.
    pub fn new(frame: &LayeredFrame, bounds: &Aabb) -> Self {
        let camera = &frame.header.camera;
        let depth_per_unit = (camera.far - camera.near) / DEPTH_UNITS;
        // Rounding puts a segment's end up to half a unit outside of the box.
        let margin = Vec3::splat(2.0 * depth_per_unit);
        let basis = camera.basis();
        let x = basis.right / basis.right.length_squared();
        let y = basis.up / basis.up.length_squared();
        let longest = frame.offsets.windows(2).map(|o| o[1] - o[0]).max().unwrap_or(0) as usize;
        let row_length = [ROW_8, ROW_16, ROW_32].into_iter().find(|n| longest <= *n).unwrap_or(0);
        let (backs, occupied, media) = unpack(frame, &basis, depth_per_unit, row_length);
        Self {
            offsets: frame.offsets.clone(),
            media,
            backs,
            row_length,
            occupied,
            empty_space: EmptySpace::new(frame),
            size: [camera.intrinsics.width as i32, camera.intrinsics.height as i32],
            eye: basis.eye,
            pixel_rows: [
                (basis.forward + x) * (0.5 * basis.width),
                (basis.forward - y) * (0.5 * basis.height),
                basis.forward,
            ],
            bounds: Aabb { min: bounds.min - margin, max: bounds.max + margin },
            near: camera.near,
            units_per_depth: depth_per_unit.recip(),
        }
    }

    /// Where the frame holds nothing.
    pub fn empty_space(&self) -> &EmptySpace {
        &self.empty_space
    }

    /// Jumps over other cells from now on.
    pub fn set_empty_space(&mut self, empty_space: EmptySpace) {
        self.empty_space = empty_space;
    }

    /// Premultiplied colour and opacity seen along a ray of world space.
    pub fn cast(&self, ray: &Ray, options: &CastOptions) -> Over {
        self.cast_with(ray, options, &mut Pieces::new())
    }

    /// The same between two world distances from the ray's origin.
    pub fn cast_between(&self, ray: &Ray, within: (f32, f32), options: &CastOptions) -> Over {
        self.cast_line(self.clip(ray, within), options, &mut Pieces::new())
    }

    fn cast_with(&self, ray: &Ray, options: &CastOptions, pieces: &mut Pieces) -> Over {
        self.cast_line(self.clip(ray, (0.0, f32::INFINITY)), options, pieces)
    }

    fn cast_line(&self, line: Option<Line>, options: &CastOptions, pieces: &mut Pieces) -> Over {
        match line {
            None => Over::default(),
            Some(line) if options.num_samples > 0 => {
                self.sample(&line, options.reconstruction, options.num_samples)
            }
            Some(line) => match self.row_length {
                ROW_8 => self.walk_by::<ROW_8>(&line, options, pieces),
                ROW_16 => self.walk_by::<ROW_16>(&line, options, pieces),
                ROW_32 => self.walk_by::<ROW_32>(&line, options, pieces),
                _ => self.walk_by::<0>(&line, options, pieces),
            },
        }
    }

    /// The picture from a camera. Premultiplied linear.
    pub fn picture(&self, camera: &Camera, options: &CastOptions) -> Picture {
        let mut picture = Picture::new(camera.intrinsics.width, camera.intrinsics.height);
        let basis = camera.basis();
        let width = picture.width as usize;
        // In blocks of pixels: their rays share lists in the cache, whichever way they run.
        picture.pixels.par_chunks_mut(width * BLOCK_SIDE).enumerate().for_each(|(j, rows)| {
            let mut pieces = Pieces::new();
            for first_x in (0..width).step_by(BLOCK_SIDE) {
                for (i, row) in rows.chunks_mut(width).enumerate() {
                    let y = (j * BLOCK_SIDE + i) as f32 + 0.5;
                    for (x, pixel) in row.iter_mut().enumerate().skip(first_x).take(BLOCK_SIDE) {
                        let (ray, _) = basis.ray(x as f32 + 0.5, y);
                        *pixel = self.cast_with(&ray, options, &mut pieces).rgba();
                    }
                }
            }
        });
        picture
    }

    fn walk_by<const K: usize>(&self, line: &Line, options: &CastOptions, pieces: &mut Pieces) -> Over {
        match options.reconstruction {
            Reconstruction::Mixed => self.walk::<K, LANES>(line, options, pieces),
            Reconstruction::Nearest => self.walk::<K, { 2 * LANES }>(line, options, pieces),
        }
    }

    /// Clips in homogeneous coordinates.
    fn clip(&self, ray: &Ray, within: (f32, f32)) -> Option<Line> {
        let (s0, s1) = self.bounds.clip(ray)?;
        let (mut s0, mut s1) = (s0.max(within.0), s1.min(within.1));
        let pixel_from_world = |v: Vec3| {
            let [x, y, w] = self.pixel_rows;
            Vec3::new(v.dot(x), v.dot(y), v.dot(w))
        };
        let o = pixel_from_world(ray.origin - self.eye);
        let d = pixel_from_world(ray.dir);
        let [width, height] = self.size.map(|n| n as f32);
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

    /// Walks the columns of lists along the line, as many at a time as a tile is wide. `K` is the length of a row of
    /// `backs`.
    fn walk<const K: usize, const N: usize>(
        &self,
        line: &Line,
        options: &CastOptions,
        pieces: &mut Pieces,
    ) -> Over {
        let along = usize::from(line.d[0].abs() + AXIS_BIAS < line.d[1].abs());
        let across = 1 - along;
        let (size_along, size_across) = (self.size[along], self.size[across]);
        let strides = [1, self.size[0]];
        let (stride_along, stride_across) = (strides[along], strides[across]);
        let columns = Columns::new(line.p0[along], line.d[along]);
        let is_forward = line.w0_minus_w1 <= 0.0;
        // Two lists in each column, or one in each part of it.
        let sides = 2 * LANES / N;
        let mut sum = Sum::default();
        let mut column = (line.p0[along].floor() as i32).clamp(0, size_along - 1);
        let (mut t_in, mut enter) = (0.0, self.at(line, 0.0));
        loop {
            // To the border of the tile, of the frame or to the end of the line.
            let num = columns.num_in_tile(column, size_along);
            let t_out = lesser(columns.t(column, num - 1), 1.0);
            let leave = self.at(line, t_out);
            let rows = [t_in, t_out].map(|t| line.p0[across] + line.d[across] * t - 0.5);
            if !options.skips_empty_space
                || self.is_occupied(column, rows, [enter.0, leave.0], along, size_across)
            {
                let stretch = Stretch::<N>::new(self, line, &columns, column, (t_in, t_out), across);
                // The lists that may have a segment there, two bits a column.
                let mut met = 0u32;
                let mut lists = [0; 2 * LANES];
                for i in 0..stretch.num {
                    let cells = list_cells(stretch.lo_units[i], stretch.hi_units[i]);
                    let column = column + columns.step * (i * LANES / N) as i32;
                    for side in 0..sides {
                        let row = (stretch.row[i] + side as i32).clamp(0, size_across - 1);
                        let list = (column * stride_along + row * stride_across) as usize;
                        let at = i * sides + side;
                        lists[at] = list as u32;
                        met |= u32::from(self.occupied[list] & cells != 0) << at;
                    }
                }
                let mut last_part = N;
                while met != 0 {
                    let at = met.trailing_zeros() as usize % (2 * LANES);
                    met &= met - 1;
                    let i = at / sides;
                    let is_first_side = at.is_multiple_of(sides);
                    let nearness =
                        if is_first_side { 1.0 - stretch.fraction[i] } else { stretch.fraction[i] };
                    if nearness < MIN_NEARNESS {
                        continue;
                    }
                    let list = lists[at] as usize;
                    let (lo, hi, length_per_unit) =
                        (stretch.lo[i], stretch.hi[i], stretch.length_per_unit[i]);
                    let end = self.offsets[list + 1] as usize;
                    let first = self.first_behind::<K>(list, stretch.lo_units[i]);
                    let mut piece = Piece { weight: nearness, ..Piece::default() };
                    let mut push = |segment: usize| {
                        let medium = &self.media[segment];
                        let back = medium.back();
                        let overlap = lesser(hi, back) - greater(lo, medium.front());
                        let is_crossed = overlap > 0.0 && segment < end;
                        piece.segment = segment as u32;
                        piece.starts_column = if i == last_part { 0.0 } else { 1.0 };
                        if pieces.num == MAX_PIECES {
                            sum.add(&self.media, pieces);
                        }
                        pieces.tau[pieces.num % MAX_PIECES] = medium.sigma * (overlap * length_per_unit);
                        pieces.rest[pieces.num % MAX_PIECES] = piece;
                        pieces.num += usize::from(is_crossed);
                        if is_crossed {
                            last_part = i;
                            piece.continues_list = 1.0;
                        }
                        back
                    };
                    if is_forward {
                        let mut segment = first;
                        while push(segment) < hi && segment + 1 < end {
                            segment += 1;
                        }
                    } else {
                        let is_in_front = |segment: &usize| self.media[*segment].front() < hi;
                        let num = (first..end).take_while(is_in_front).count();
                        (first..first + num).rev().for_each(|segment| {
                            push(segment);
                        });
                    }
                }
                sum.add(&self.media, pieces);
                if sum.transmittance() < TRANSMITTANCE_MIN {
                    break;
                }
            }
            column += columns.step * num;
            if t_out >= 1.0 || column < 0 || column >= size_along {
                break;
            }
            (t_in, enter) = (t_out, leave);
        }
        Over { c: sum.color.truncate(), transmittance: sum.transmittance() }
    }

    /// Whether a stretch of the line, inside of one column of tiles, may meet a segment: `rows` are its ends across,
    /// as the rows of the first of the two lists it runs between, `depths` those in depth.
    #[inline]
    fn is_occupied(
        &self,
        column: i32,
        rows: [f32; 2],
        depths: [f32; 2],
        along: usize,
        size_across: i32,
    ) -> bool {
        let [first, last] = self.tiles_across(rows, size_across);
        let (start, stride) = self.tiles_along(column, along);
        let mut occupied = 0;
        for tile in first..=last {
            occupied |= self.empty_space.occupied[(start + tile * stride) as usize];
        }
        let first_cell = cell_of_depth(lesser(depths[0], depths[1]));
        occupied & cell_bits(first_cell, cell_of_depth(greater(depths[0], depths[1]))) != 0
    }

    /// The first and the last tile, across the way, of the lists that a stretch of a line runs between.
    #[inline]
    pub(super) fn tiles_across(&self, rows: [f32; 2], size_across: i32) -> [i32; 2] {
        let tile_of = |row: f32, side: i32| (row.max(0.0) as i32 + side).min(size_across - 1) / TILE as i32;
        [tile_of(lesser(rows[0], rows[1]), 0), tile_of(greater(rows[0], rows[1]), 1)]
    }

    /// The index of the first tile of a column of tiles, and the step from one to the next.
    #[inline]
    pub(super) fn tiles_along(&self, column: i32, along: usize) -> (i32, i32) {
        let tiles_x = self.empty_space.tiles[0] as i32;
        let tile_column = column / TILE as i32;
        if along == 0 { (tile_column, tiles_x) } else { (tile_column * tiles_x, 1) }
    }

    /// The segments of a list; a row outside of the frame is the one at its border.
    pub(super) fn list(&self, column: i32, row: i32, along: usize) -> &[Medium] {
        let row = row.clamp(0, self.size[1 - along] - 1);
        let (x, y) = if along == 0 { (column, row) } else { (row, column) };
        let list = (y * self.size[0] + x) as usize;
        &self.media[self.offsets[list] as usize..self.offsets[list + 1] as usize]
    }

    /// Depth in units and world distance from the start of the line.
    #[inline]
    pub(super) fn at(&self, line: &Line, t: f32) -> (f32, f32) {
        let r = 1.0 / (line.w1 + t * line.w0_minus_w1);
        ((line.w0_w1 * r - self.near) * self.units_per_depth, line.s_w0 * t * r)
    }

    /// The first segment of a list that ends behind a depth: how many do not is counted for all of a row at once,
    /// which is faster than to look for it from where the list before was left (Gupta 2022, algorithm 1).
    #[inline]
    fn first_behind<const K: usize>(&self, list: usize, depth: u16) -> usize {
        let start = self.offsets[list] as usize;
        if K == 0 {
            let media = &self.media[start..self.offsets[list + 1] as usize];
            return start + media.partition_point(|medium| (medium.depth >> 16) as u16 <= depth);
        }
        let mut num = 0;
        for back in self.backs.as_chunks::<K>().0[list] {
            num += u16::from(back <= depth);
        }
        start + num as usize
    }
}

impl<const N: usize> Stretch<N> {
    /// The columns of a tile from `column` on, between two parameters of the line.
    #[inline]
    fn new(
        caster: &Raycaster,
        line: &Line,
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
            // The line runs faster along than across, so it changes its row once in a column at most.
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
        for i in 0..N {
            s.num += usize::from(t[i] < t_out);
            let (depth, distance) = caster.at(line, t[i]);
            let (depth_end, distance_end) = caster.at(line, t_end[i]);
            s.lo[i] = lesser(depth, depth_end);
            // A ray along the old image plane stays at one depth; the guard makes the share of the crossing 1.
            s.hi[i] = greater(greater(depth, depth_end), s.lo[i] + MIN_CROSSING);
            s.lo_units[i] = floor_and_fraction(greater(s.lo[i], 0.0)).0 as u16;
            s.hi_units[i] = floor_and_fraction(greater(lesser(s.hi[i], DEPTH_UNITS), 0.0)).0 as u16;
            s.length_per_unit[i] = (distance_end - distance) / (s.hi[i] - s.lo[i]);
            let at_across = p_across + d_across * (0.5 * (t[i] + t_end[i]));
            if N == LANES {
                (s.row[i], s.fraction[i]) = floor_and_fraction(at_across - 0.5);
            } else {
                s.row[i] = row_of(at_across);
            }
        }
        s
    }
}

/// The row of lists at a position.
fn row_of(position: f32) -> i32 {
    // Positions are not negative but for a rounding, which is clamped with the rows.
    (position + 1.0) as i32 - 1
}

/// The cells of a list between two depths, one bit each.
#[inline]
fn list_cells(lo: u16, hi: u16) -> u64 {
    (u64::MAX << (lo >> 10)) & (u64::MAX >> (63 - (hi >> 10)))
}

/// As the machine has it: without a thought for NaN.
#[inline]
pub(super) fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline]
pub(super) fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The columns of lists along a line: a DDA along one axis.
pub(super) struct Columns {
    /// Step of the index.
    pub(super) step: i32,
    /// The parameter of the border at pixel position x is x·slope + offset.
    slope: f32,
    offset: f32,
    /// 1 if the line leaves a column by its upper border.
    leaves_by: i32,
}

impl Columns {
    pub(super) fn new(p: f32, d: f32) -> Self {
        if d.abs() < MIN_SLOPE {
            return Self { step: 1, slope: 0.0, offset: f32::INFINITY, leaves_by: 1 };
        }
        let forward = d > 0.0;
        let slope = 1.0 / d;
        Self { step: if forward { 1 } else { -1 }, slope, offset: -p * slope, leaves_by: forward.into() }
    }

    /// From `column` on, how many columns there are to the border of the tile or of the frame.
    #[inline]
    pub(super) fn num_in_tile(&self, column: i32, size: i32) -> i32 {
        let in_tile = column & (TILE as i32 - 1);
        if self.step > 0 { (TILE as i32 - in_tile).min(size - column) } else { in_tile + 1 }
    }

    /// Where the line leaves the column `i` steps behind `column`.
    #[inline]
    pub(super) fn t(&self, column: i32, i: i32) -> f32 {
        (column + self.leaves_by + self.step * i) as f32 * self.slope + self.offset
    }
}

/// Largest integer not above a small number, and the rest. At an integer both that one and the one below with a rest of 1
/// are right.
#[inline]
fn floor_and_fraction(x: f32) -> (i32, f32) {
    // Adding 1.5·2²³ rounds to the nearest integer and leaves it in the low bits.
    let shifted = (x - 0.5) + ROUNDER;
    (shifted.to_bits() as i32 - ROUNDER.to_bits() as i32, x - (shifted - ROUNDER))
}

/// Opacity 1 − e^−τ to single precision, relative for small τ too, without a branch or a call: 2^−y with
/// y = n − f, |f| ≤ ½, is 2^−n·(1 + p(f)).
#[inline]
pub(super) fn opacity(tau: f32) -> f32 {
    let y = lesser(tau * std::f32::consts::LOG2_E, 126.0);
    let shifted = y + ROUNDER;
    let f = (shifted - ROUNDER) - y;
    // Taylor's series of 2^f − 1, whose next term is below 2^−25 for |f| ≤ ½.
    let p = f
        * (LN_2_POWERS[0]
            + f * (LN_2_POWERS[1]
                + f * (LN_2_POWERS[2] + f * (LN_2_POWERS[3] + f * (LN_2_POWERS[4] + f * LN_2_POWERS[5])))));
    let scale = f32::from_bits(ONE_BITS.wrapping_sub(shifted.to_bits() << 23));
    (1.0 - scale) - scale * p
}

/// The backs of all lists and their segments, row by row in parallel.
fn unpack(
    frame: &LayeredFrame,
    basis: &Basis,
    depth_per_unit: f32,
    row_length: usize,
) -> (Vec<u16>, Vec<u64>, Vec<Medium>) {
    let width = frame.header.camera.intrinsics.width as usize;
    let num_lists = frame.offsets.len() - 1;
    let mut backs = vec![u16::MAX; num_lists * row_length];
    let mut occupied = vec![0; num_lists];
    // One more: the index behind the last is read.
    let mut media = vec![Medium::default(); frame.num_segments() + 1];
    let mut rest_of_media = &mut media[..];
    let mut rest_of_backs = &mut backs[..];
    let mut rows = Vec::with_capacity(num_lists / width);
    for (y, occupied) in occupied.chunks_mut(width).enumerate() {
        let num = frame.offsets[(y + 1) * width] - frame.offsets[y * width];
        let (media, others) = rest_of_media.split_at_mut(num as usize);
        rest_of_media = others;
        let (backs, others) = rest_of_backs.split_at_mut(width * row_length);
        rest_of_backs = others;
        rows.push((y, backs, occupied, media));
    }
    rows.into_par_iter().for_each(|(y, backs, occupied, media)| {
        let start_of_row = frame.offsets[y * width] as usize;
        for (x, occupied) in occupied.iter_mut().enumerate() {
            // World length of one depth unit along the centre of this list.
            let nx = (2.0 * x as f32 + 1.0) / basis.width - 1.0;
            let ny = 1.0 - (2.0 * y as f32 + 1.0) / basis.height;
            let center = basis.forward + basis.right * nx + basis.up * ny;
            let length_per_unit = depth_per_unit * center.length();
            for (i, index) in frame.list(y * width + x).enumerate() {
                let segment = frame.segment(index);
                if row_length > 0 {
                    backs[x * row_length + i] = segment.back;
                }
                *occupied |= list_cells(segment.front, segment.back.saturating_sub(1));
                let alpha = opacity(segment.tau);
                let e = if alpha > 0.0 { segment.c / alpha } else { Vec3::ZERO };
                let length = f32::from(segment.back.saturating_sub(segment.front)) * length_per_unit;
                let (rg, b1) = (pack_halves(e.x, e.y), pack_halves(e.z, 1.0));
                media[index - start_of_row] = Medium {
                    depth: frame.depth[index],
                    sigma: segment.tau / length,
                    e: [rg as u16, (rg >> 16) as u16, b1 as u16, (b1 >> 16) as u16],
                };
            }
        }
    });
    (backs, occupied, media)
}

/// The picture of a layered frame from a camera. Premultiplied linear. `bounds` is the box of the volume. For several
/// views of one frame take a [`Raycaster`].
pub fn raycast(frame: &LayeredFrame, bounds: &Aabb, camera: &Camera) -> Picture {
    Raycaster::new(frame, bounds).picture(camera, &CastOptions::default())
}

/// Lengths of the rows of `backs`; frames of longer lists, made for measurements, have none.
const ROW_8: usize = 8;
const ROW_16: usize = 16;
const ROW_32: usize = 32;
/// Columns that are worked on at a time.
const LANES: usize = TILE as usize;
/// Pieces that are worked on at a time: more than there usually are in a tile's columns.
const MAX_PIECES: usize = 64;
/// From the bits of a half float, moved to where a float has them, to its value: 2¹¹².
const HALF_SCALE: f32 = f32::from_bits((254 - 15) << 23);
/// Side of the blocks of pixels that are cast one after the other.
const BLOCK_SIDE: usize = 16;
/// 1.5·2²³.
const ROUNDER: f32 = 12_582_912.0;
const ONE_BITS: u32 = 0x3f80_0000;
/// (ln 2)^i/i!.
const LN_2_POWERS: [f32; 6] =
    [std::f32::consts::LN_2, 0.240_226_5, 0.055_504_11, 0.009_618_129, 0.001_333_355_8, 0.000_154_035_3];
/// Shortest depth interval that is divided by, in depth units: far below the rounding of a segment's ends.
const MIN_CROSSING: f32 = 1e-2;
/// A list with less weight than this is left out: a quarter of one step of 1/255.
const MIN_NEARNESS: f32 = 1e-3;
/// A row must win by so many pixels: where the eye has not moved and no line moves, rounding must not choose.
pub(super) const AXIS_BIAS: f32 = 1e-2;
/// A line that moves less than this many pixels in all crosses no border worth a division.
const MIN_SLOPE: f32 = 1e-6;
