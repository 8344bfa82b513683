//! Novel views: ray casts a layered frame from any camera (Gupta 2022, section 3; Lochmann 2016, section 3.3). Twin
//! of `shaders/raycast.wgsl`.
//!
//! A new ray P(s) = O + s·D is linear in the homogeneous pixel coordinates (x·w, y·w, w) of the generating camera,
//! with w the view depth there. The six planes of its frustum are linear in s too. So the ray is clipped before any
//! division, even if it runs towards the old eye or starts behind it. Between the clipped ends with depths w0, w1 and
//! world distance S, the projection is a straight line. With t its parameter,
//!
//!   depth(t) = w0·w1/(w1 + t(w0 − w1)),    distance(t) = S·t·w0/(w1 + t(w0 − w1)).
//!
//! One division per list gives both, from three constants per ray (S·w0, w1, w0 − w1). For parallel rays, w is 1
//! everywhere and the depth is linear in t. The sum of both forms, each times 0 or 1, holds for either camera.
//!
//! In each list, the segments in the ray's depth interval are composited in the ray's order: front to back, or back
//! to front if the ray runs towards the old eye. A segment of length z that is crossed over a length l has the
//! opacity 1 − (1 − α)^(l/z).
//!
//! A DDA (Amanatides & Woo 1987) walks along the axis on which the line runs faster, from one column (or row) of
//! lists to the next. Across that axis the line lies between the centres of two lists. Both are composited over the
//! same interval and mixed by nearness, which removes the stair-steps of the nearest list. A ray of the frame's own
//! pose runs through a centre, where the nearest list has all of the weight. So the own pose stays exact (ours; the
//! papers take the nearest list).
//!
//! Beyond the shader, the twin first finds what a picture's rays can reach (`reach`). It looks the lists of a tile's
//! columns up together and composites them afterwards (`line`, `media` and `pieces`).

mod line;
mod media;
mod pieces;
mod projected;
mod reach;

use glam::Vec3;
use rayon::prelude::*;

use self::line::ColumnSpans;
pub(super) use self::line::{Columns, PixelSpan, clip_by_planes, frustum_planes, greater, lesser};
pub(super) use self::media::Medium;
use self::media::{list_cells, unpack};
pub use self::pieces::opacity;
pub(crate) use self::pieces::transmittance;
use self::pieces::{Crossing, Pieces, Sum};
use self::projected::Way;
use self::reach::Reach;
use super::empty_space::{EmptySpace, TILE, cell_bits, cell_of_depth};
use super::march::TRANSMITTANCE_MIN;
use crate::camera::{Basis, Camera, PixelLine};
use crate::clip::{Clip, Region};
use crate::layer::{DEPTH_UNITS, LayeredFrame, Over};
use crate::mode::Compositing;
use crate::picture::Picture;
use crate::simd::has_avx2;
use crate::space::{Aabb, Ray};

/// How a ray reads the lists that it runs between.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Reconstruction {
    /// The list whose area the ray crosses, as in the papers.
    Nearest,
    /// The two lists whose centres the ray runs between, mixed by nearness.
    #[default]
    Mixed,
}

/// Options of a cast.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CastOptions {
    /// How the lists are read.
    pub reconstruction: Reconstruction,
    /// Whether empty cells are skipped; the picture is the same without.
    pub skips_empty_space: bool,
    /// The visible part of the volume, whatever the frame holds: segments are cut at its borders.
    pub clip: Clip,
}

impl Default for CastOptions {
    fn default() -> Self {
        Self { reconstruction: Reconstruction::default(), skips_empty_space: true, clip: Clip::default() }
    }
}

/// A frame prepared for any number of rays: its segments are unpacked to what a crossing needs.
pub struct Raycaster {
    offsets: Vec<u32>,
    media: Vec<Medium>,
    /// Backs of each list, filled up to `row_length`.
    backs: Vec<u16>,
    row_length: usize,
    /// Bit i of a list's word is set if cell i of its depth holds a segment.
    occupied: Vec<u64>,
    empty_space: EmptySpace,
    pub(super) size: [i32; 2],
    basis: Basis,
    /// The dot products of a world-space vector with these are its homogeneous pixel coordinates (x·w, y·w, w).
    pixel_rows: [Vec3; 3],
    /// The offset to add for a point.
    pixel_offset: Vec3,
    bounds: Aabb,
    /// How far segments may reach beyond the marched volume, world units.
    margin: f32,
    near: f32,
    units_per_depth: f32,
    pub(super) compositing: Compositing,
    way: Way,
    has_avx2: bool,
}

/// A list that may hold a segment on the ray.
#[derive(Clone, Copy, Default)]
struct Met {
    part: u32,
    list: u32,
    nearness: f32,
}

/// What a part of a stretch meets first in a list.
#[derive(Clone, Copy, Default)]
struct Found {
    /// The first segment whose back is behind the part's least depth, and the end of the list.
    segment: u32,
    end: u32,
    medium: Medium,
}

impl Raycaster {
    /// Prepares a frame. `bounds` is the box of its volume.
    pub fn new(frame: &LayeredFrame, bounds: &Aabb) -> Self {
        let camera = &frame.header.camera;
        let depth_per_unit = (camera.far - camera.near) / DEPTH_UNITS;
        let basis = camera.basis();
        let x = basis.right / basis.right.length_squared();
        let y = basis.up / basis.up.length_squared();
        let weight = basis.forward * basis.perspective;
        let longest = frame.offsets.windows(2).map(|o| o[1] - o[0]).max().unwrap_or(0) as usize;
        let row_length = [ROW_8, ROW_16, ROW_32].into_iter().find(|n| longest <= *n).unwrap_or(0);
        let way = Way::new(bounds);
        let (backs, occupied, media) = unpack(frame, &basis, depth_per_unit, row_length, &way);
        Self {
            offsets: frame.offsets.clone(),
            media,
            backs,
            row_length,
            occupied,
            empty_space: EmptySpace::new(frame),
            size: [camera.intrinsics.width as i32, camera.intrinsics.height as i32],
            basis,
            pixel_rows: [(weight + x) * (0.5 * basis.width), (weight - y) * (0.5 * basis.height), weight],
            pixel_offset: Vec3::new(0.5 * basis.width, 0.5 * basis.height, 1.0) * (1.0 - basis.perspective),
            bounds: *bounds,
            margin: MARGIN_UNITS * depth_per_unit,
            near: camera.near,
            units_per_depth: depth_per_unit.recip(),
            compositing: frame.header.mode.compositing(),
            way,
            has_avx2: has_avx2(),
        }
    }

    /// The empty cells of the frame.
    pub fn empty_space(&self) -> &EmptySpace {
        &self.empty_space
    }

    /// Replaces the empty cells.
    pub fn set_empty_space(&mut self, empty_space: EmptySpace) {
        self.empty_space = empty_space;
    }

    /// Premultiplied colour and opacity along a ray in world space.
    pub fn cast(&self, ray: &Ray, options: &CastOptions) -> Over {
        self.cast_between(ray, (0.0, f32::INFINITY), options)
    }

    /// The same between two world distances from the ray's origin.
    pub fn cast_between(&self, ray: &Ray, within: (f32, f32), options: &CastOptions) -> Over {
        match self.clip(ray, within, &self.region(&options.clip)) {
            None => Over::default(),
            Some(line) => self.cast_line(&line, ray, options, &mut Pieces::new()),
        }
    }

    /// The visible part of the volume, with a margin for the rounding of segments.
    pub(super) fn region(&self, clip: &Clip) -> Region {
        clip.region(&self.bounds).grown(self.margin)
    }

    /// The picture from a camera. Premultiplied linear.
    pub fn picture(&self, camera: &Camera, options: &CastOptions) -> Picture {
        let mut picture = Picture::new(camera.intrinsics.width, camera.intrinsics.height);
        let basis = camera.basis();
        let width = picture.width as usize;
        let region = self.region(&options.clip);
        let reach = options.skips_empty_space.then(|| Reach::new(self, &basis));
        // Rays within a block of pixels share lists in the cache, in any direction.
        picture.pixels.par_chunks_mut(width * BLOCK_SIDE).enumerate().for_each(|(j, rows)| {
            let mut pieces = Pieces::new();
            for first_x in (0..width).step_by(BLOCK_SIDE) {
                for (i, row) in rows.chunks_mut(width).enumerate() {
                    let y = j * BLOCK_SIDE + i;
                    for (x, pixel) in row.iter_mut().enumerate().skip(first_x).take(BLOCK_SIDE) {
                        let depths = reach.as_ref().map_or([0.0, f32::INFINITY], |reach| reach.at(x, y));
                        if depths[0] > depths[1] {
                            continue;
                        }
                        let (ray, s_per_depth) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
                        if let Some(mut line) = self.clip(&ray, (0.0, f32::INFINITY), &region)
                            && line.narrow(depths.map(|depth| depth * s_per_depth))
                        {
                            *pixel = self.cast_line(&line, &ray, options, &mut pieces).rgba();
                        }
                    }
                }
            }
        });
        picture
    }

    fn cast_line(&self, line: &PixelSpan, ray: &Ray, options: &CastOptions, pieces: &mut Pieces) -> Over {
        if self.compositing != Compositing::Over {
            return self.shown(&self.project_line(line, options), ray);
        }
        #[cfg(target_arch = "x86_64")]
        if self.has_avx2 {
            #[expect(unsafe_code, reason = "the one way to instructions that not every processor has")]
            // SAFETY: the processor supports these instructions.
            return unsafe { self.walk_avx2(line, options, pieces) };
        }
        self.walk_any(line, options, pieces)
    }

    /// The same with wider instructions. No multiplication is fused with an addition, so the bits are the same.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn walk_avx2(&self, line: &PixelSpan, options: &CastOptions, pieces: &mut Pieces) -> Over {
        self.walk_any(line, options, pieces)
    }

    #[inline(always)]
    fn walk_any(&self, line: &PixelSpan, options: &CastOptions, pieces: &mut Pieces) -> Over {
        match self.row_length {
            ROW_8 => self.walk_by::<ROW_8>(line, options, pieces),
            ROW_16 => self.walk_by::<ROW_16>(line, options, pieces),
            ROW_32 => self.walk_by::<ROW_32>(line, options, pieces),
            _ => self.walk_by::<0>(line, options, pieces),
        }
    }

    #[inline(always)]
    fn walk_by<const K: usize>(&self, line: &PixelSpan, options: &CastOptions, pieces: &mut Pieces) -> Over {
        match options.reconstruction {
            Reconstruction::Mixed => self.walk::<K, LANES>(line, options, pieces),
            Reconstruction::Nearest => self.walk::<K, { 2 * LANES }>(line, options, pieces),
        }
    }

    /// Clips the ray in homogeneous coordinates, and to the visible part of the volume.
    #[inline]
    fn clip(&self, ray: &Ray, within: (f32, f32), region: &Region) -> Option<PixelSpan> {
        let (s0, s1) = region.clip(ray)?;
        let pixel_from_world = |v: Vec3| {
            let [x, y, w] = self.pixel_rows;
            Vec3::new(v.dot(x), v.dot(y), v.dot(w))
        };
        let from_eye = ray.origin - self.basis.eye;
        let forward = self.basis.forward;
        let line = PixelLine {
            o: pixel_from_world(from_eye) + self.pixel_offset,
            d: pixel_from_world(ray.dir),
            depth: [from_eye.dot(forward), ray.dir.dot(forward)],
        };
        let planes = frustum_planes(&line, self.size.map(|n| n as f32), self.near, 0.0);
        let (s0, s1) = clip_by_planes(planes, (s0.max(within.0), s1.min(within.1)));
        if s1 <= s0 {
            return None;
        }
        let (h0, h1) = (line.at(s0), line.at(s1));
        let perspective = self.basis.perspective;
        let (w0, w1) = (h0.z.max(self.near * perspective), h1.z.max(self.near * perspective));
        let p0 = [h0.x / w0, h0.y / w0];
        let p1 = [h1.x / w1, h1.y / w1];
        Some(PixelSpan {
            p0,
            d: [p1[0] - p0[0], p1[1] - p0[1]],
            s_w0: (s1 - s0) * w0,
            w1,
            w0_minus_w1: w0 - w1,
            depth_over_w: w0 * w1 * perspective + line.depth_at(s0) * (1.0 - perspective),
            depth_slope: line.depth[1] * (s1 - s0) * (1.0 - perspective),
            s0,
            reach: [0.0, 1.0],
        })
    }

    /// Walks the columns of lists along the line, a tile's width at a time. `K` is the length of a row of `backs`.
    #[inline(always)]
    fn walk<const K: usize, const N: usize>(
        &self,
        line: &PixelSpan,
        options: &CastOptions,
        pieces: &mut Pieces,
    ) -> Over {
        let along = usize::from(line.d[0].abs() + AXIS_BIAS < line.d[1].abs());
        let across = 1 - along;
        let (size_along, size_across) = (self.size[along], self.size[across]);
        let strides = [1, self.size[0]];
        let (stride_along, stride_across) = (strides[along], strides[across]);
        let columns = Columns::new(line.p0[along], line.d[along]);
        let is_forward = line.w0_minus_w1 - line.depth_slope <= 0.0;
        // A column has two lists, or one in each of its parts.
        let sides = 2 * LANES / N;
        let mut sum = Sum::default();
        let mut column = (line.p0[along].floor() as i32).clamp(0, size_along - 1);
        let mut t_in = 0.0;
        let start = line.p0[along] + line.d[along] * line.reach[0];
        if let Some(ahead) = columns.tile_at(start, column, size_along) {
            (column, t_in) = ahead;
        }
        let mut enter = self.at(line, t_in);
        loop {
            // The batch ends at the border of the tile or frame, or at the end of the line.
            let num = columns.num_in_tile(column, size_along);
            let t_out = lesser(columns.t(column, num - 1), 1.0);
            let leave = self.at(line, t_out);
            let rows = [t_in, t_out].map(|t| line.p0[across] + line.d[across] * t - 0.5);
            if !options.skips_empty_space
                || self.is_occupied(column, rows, [enter.0, leave.0], along, size_across)
            {
                let mut stretch = ColumnSpans::<N>::new(self, line, &columns, column, (t_in, t_out), across);
                stretch.prefer_nearer(sum.transmittance());
                // The lists that may hold a segment on the line.
                let mut num_met = 0;
                let mut met = [Met::default(); 2 * LANES];
                for i in 0..stretch.num {
                    let cells = list_cells(stretch.lo_units[i] as u16, stretch.hi_units[i] as u16);
                    let column = column + columns.step * (i * LANES / N) as i32;
                    let nearness = [1.0 - stretch.fraction[i], stretch.fraction[i]];
                    for (side, &nearness) in nearness.iter().enumerate().take(sides) {
                        let row = (stretch.row[i] + side as i32).clamp(0, size_across - 1);
                        let list = (column * stride_along + row * stride_across) as u32;
                        let is_met = (self.occupied[list as usize] & cells != 0) & (nearness >= MIN_NEARNESS);
                        met[num_met % (2 * LANES)] = Met { part: i as u32, list, nearness };
                        num_met += usize::from(is_met);
                    }
                }
                // Without branches in between, the look-ups wait for memory together.
                let mut found = [Found::default(); 2 * LANES];
                for (met, found) in met[..num_met].iter().zip(&mut found) {
                    let list = met.list as usize;
                    let lo = stretch.lo_units[met.part as usize % N] as u16;
                    let segment = self.first_behind::<K>(list, lo) as u32;
                    let medium = self.media[segment as usize];
                    *found = Found { segment, end: self.offsets[list + 1], medium };
                }
                let mut last_part = N as u32;
                for (met, found) in met[..num_met].iter().zip(&found) {
                    let i = met.part as usize % N;
                    let mut crossing = Crossing {
                        lo: stretch.lo[i],
                        hi: stretch.hi[i],
                        length_per_unit: stretch.length_per_unit[i],
                        weight: met.nearness,
                        starts_column: if met.part == last_part { 0.0 } else { 1.0 },
                        continues_list: 0.0,
                    };
                    if is_forward {
                        let (mut segment, mut medium) = (found.segment, found.medium);
                        let is_crossed = segment < found.end;
                        pieces.push(&mut sum, &mut crossing, &medium, is_crossed);
                        while medium.back() < crossing.hi && segment + 1 < found.end {
                            segment += 1;
                            medium = self.media[segment as usize];
                            pieces.push(&mut sum, &mut crossing, &medium, true);
                        }
                    } else {
                        let mut num = 0;
                        while found.segment + num < found.end
                            && self.media[(found.segment + num) as usize].front() < crossing.hi
                        {
                            num += 1;
                        }
                        for segment in (found.segment..found.segment + num).rev() {
                            pieces.push(&mut sum, &mut crossing, &self.media[segment as usize], true);
                        }
                    }
                    last_part = if crossing.continues_list > 0.0 { met.part } else { last_part };
                }
                sum.add(pieces);
                if sum.transmittance() < TRANSMITTANCE_MIN {
                    break;
                }
            }
            column += columns.step * num;
            if t_out >= line.reach[1] || column < 0 || column >= size_along {
                break;
            }
            (t_in, enter) = (t_out, leave);
        }
        Over { c: sum.color.truncate(), transmittance: sum.transmittance() }
    }

    /// Whether a stretch of the line within one column of tiles may meet a segment. `rows` are its ends across, as
    /// rows of the first list, and `depths` its ends in depth.
    #[inline(always)]
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

    /// The first and the last tile, across the line, of the lists that a stretch runs between.
    #[inline(always)]
    pub(super) fn tiles_across(&self, rows: [f32; 2], size_across: i32) -> [i32; 2] {
        let tile_of = |row: f32, side: i32| (row.max(0.0) as i32 + side).min(size_across - 1) / TILE as i32;
        [tile_of(lesser(rows[0], rows[1]), 0), tile_of(greater(rows[0], rows[1]), 1)]
    }

    /// The index of the first tile in a column of tiles, and the stride to the next.
    #[inline(always)]
    pub(super) fn tiles_along(&self, column: i32, along: usize) -> (i32, i32) {
        let tiles_x = self.empty_space.tiles[0] as i32;
        let tile_column = column / TILE as i32;
        if along == 0 { (tile_column, tiles_x) } else { (tile_column * tiles_x, 1) }
    }

    /// The segments of a list; rows outside the frame are clamped to its border.
    pub(super) fn list(&self, column: i32, row: i32, along: usize) -> &[Medium] {
        let row = row.clamp(0, self.size[1 - along] - 1);
        let (x, y) = if along == 0 { (column, row) } else { (row, column) };
        let list = (y * self.size[0] + x) as usize;
        &self.media[self.offsets[list] as usize..self.offsets[list + 1] as usize]
    }

    /// Depth in units and world distance, relative to the start of the line.
    #[inline(always)]
    pub(super) fn at(&self, line: &PixelSpan, t: f32) -> (f32, f32) {
        let r = 1.0 / (line.w1 + t * line.w0_minus_w1);
        (
            ((line.depth_over_w * r + line.depth_slope * t) - self.near) * self.units_per_depth,
            line.s_w0 * t * r,
        )
    }

    /// The first segment of a list whose back is behind a depth. A search over all backs is faster than one from the
    /// previous list's position (Gupta 2022, algorithm 1).
    #[inline(always)]
    fn first_behind<const K: usize>(&self, list: usize, depth: u16) -> usize {
        let start = self.offsets[list] as usize;
        if K == 0 {
            let media = &self.media[start..self.offsets[list + 1] as usize];
            return start + media.partition_point(|medium| (medium.depth >> 16) as u16 <= depth);
        }
        // This search has no branches: K is a power of two, and a row lies in one cache line.
        let backs = &self.backs.as_chunks::<K>().0[list];
        let mut num = 0;
        let mut half = K / 2;
        while half > 0 {
            num += half * usize::from(backs[(num + half - 1) % K] <= depth);
            half /= 2;
        }
        start + num + usize::from(backs[num % K] <= depth)
    }
}

/// The picture of a layered frame from a camera, premultiplied linear. `bounds` is the box of the volume. For several
/// views of one frame use a [`Raycaster`].
pub fn raycast(frame: &LayeredFrame, bounds: &Aabb, camera: &Camera) -> Picture {
    Raycaster::new(frame, bounds).picture(camera, &CastOptions::default())
}

/// Lengths of the rows of `backs`. Frames with longer lists, which only measurements make, have none.
const ROW_8: usize = 8;
const ROW_16: usize = 16;
const ROW_32: usize = 32;
/// Columns in one batch.
const LANES: usize = TILE as usize;
/// Side of a block of pixels that one thread casts.
const BLOCK_SIDE: usize = 16;
/// Depth units that a segment may reach beyond the marched volume: half of one by rounding, and the thickness of the
/// thinnest segment where a ray only touches.
pub const MARGIN_UNITS: f32 = 6.0;
/// The least weight of a list that is composited: a quarter of one step of 1/255.
const MIN_NEARNESS: f32 = 1e-3;
/// Pixels by which rows must win over columns, so that rounding does not choose where the eye has not moved.
pub(super) const AXIS_BIAS: f32 = 1e-2;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::camera::{Intrinsics, Pose};

    use crate::kernels::layering::generate;
    use crate::kernels::march::{MarchSettings, Scene};
    use crate::layer::FrameHeader;
    use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
    use crate::volume::procedural::Builtin;

    #[test]
    fn wider_instructions_and_reach_keep_all_bits() {
        let point = |x, opacity| ControlPoint { x, color: [0.2, 0.8, 0.5], opacity };
        let transfer = TransferFunction {
            name: "test".into(),
            domain: Domain::Full,
            unit_length: UnitLength::Radius(0.02),
            points: vec![point(0.0, 0.0), point(0.3, 0.0), point(1.0, 0.5)],
        };
        let scene = Scene::new(Arc::new(Builtin::Cloud.volume(32)), &transfer, MarchSettings::default());
        let bounds = scene.volume.bounds();
        let camera = |azimuth: f32| {
            let intrinsics = Intrinsics::perspective(60, 50, 0.8);
            Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, 4.0), intrinsics, &bounds)
        };
        let header = FrameHeader::alone(camera(0.3), 6);
        let mut caster = Raycaster::new(&generate(&scene, header), &bounds);
        let options = CastOptions::default();
        let (mut num_out_of_reach, mut pictures) = (0, Vec::new());
        for azimuth in [0.3, 0.4, 0.8, 2.0] {
            let camera = camera(azimuth);
            let reach = Reach::new(&caster, &camera.basis());
            let picture = caster.picture(&camera, &options);
            for (i, pixel) in picture.pixels.iter().enumerate() {
                let (x, y) = (i % 60, i / 60);
                let (ray, _) = camera.ray(x as f32 + 0.5, y as f32 + 0.5);
                assert_eq!(*pixel, caster.cast(&ray, &options).rgba(), "{x}, {y} at {azimuth}");
                let [first, last] = reach.at(x, y);
                num_out_of_reach += usize::from(first > last);
            }
            caster.has_avx2 = false;
            assert_eq!(picture.pixels, caster.picture(&camera, &options).pixels);
            caster.has_avx2 = has_avx2();
            pictures.push(picture.pixels);
        }
        // Negative controls: there is something to leave out, and pictures can differ.
        assert!(num_out_of_reach > 100, "{num_out_of_reach}");
        assert_ne!(pictures[0], pictures[1]);
    }
}
