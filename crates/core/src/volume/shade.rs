//! The light that reaches each cell of an extinction grid: the mean of transmittances along straight lines.
//!
//! Each direction takes one sweep through the grid, whatever the distance. Parallel lines run through one slice of
//! cells after the other, and each sums the optical depth from the volume's face. Within a slice all lines are offset
//! from the cells by the same shift. So a sum mixes four cells, and a cell's value mixes four lines, once each.
//! Shadows do not blur along the way, as they would if each slice were mixed from the previous one. The optical depth
//! of an interval is the difference of two sums.

use std::f32::consts::{LOG2_E, PI};

use glam::Vec3;
use rayon::prelude::*;

use super::extinction::{Detail, Extinction};
use super::lighting::Lighting;

/// The interval of a line that shades its starting point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ShadingInterval {
    /// Nearer matter does not count, in cells: a surface would shade itself.
    pub(crate) near_in_cells: f32,
    /// Farther matter does not count either, world units, at least two cells more; infinity for no limit.
    pub(crate) far: f32,
}

impl ShadingInterval {
    /// Both ends in a direction, world units: cells need not be cubes.
    fn in_direction(self, extinction: &Extinction, towards: Vec3) -> [f32; 2] {
        let cell = (towards / extinction.cell).length().recip();
        let near = self.near_in_cells * cell;
        [near, self.far.max(near + 2.0 * cell)]
    }
}

/// A light fraction, 0 to 1, for every cell, x fastest.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Shade {
    /// Cells along x, y, z.
    pub(crate) dims: [usize; 3],
    /// Voxels of a cell along x, y, z.
    pub(crate) voxels: [usize; 3],
    /// The shares.
    pub(crate) shares: Vec<f32>,
}

impl Shade {
    /// Ambient occlusion: twice the mean transmittance over all directions within `radius` world units, at most 1. So
    /// a flat opaque surface, which sees half of the sky, keeps its light. A right angle has half of it, and a corner
    /// a quarter.
    pub(crate) fn occlusion(extinction: &Extinction, radius: f32, detail: Detail) -> Self {
        let num = match detail {
            Detail::Draft => 24,
            Detail::Final => 64,
        };
        let directions: Vec<Vec3> = (0..num).map(|i| on_sphere(i, num)).collect();
        let mut shade = Self::mean(
            extinction,
            &directions,
            ShadingInterval { near_in_cells: NEAR_IN_CELLS, far: radius },
        );
        for share in &mut shade.shares {
            *share = (2.0 * *share).min(1.0);
        }
        let clear = clear(extinction);
        shade.smoothed(&clear).in_front(&clear)
    }

    /// The fraction of light from a disc of the sky that reaches each cell.
    pub(crate) fn shadow(extinction: &Extinction, lighting: &Lighting, detail: Detail) -> Self {
        let num = match (lighting.softness_degrees > 0.0, detail) {
            (false, _) => 1,
            (true, Detail::Draft) => 7,
            (true, Detail::Final) => 28,
        };
        let radius = lighting.softness_degrees.to_radians();
        let directions: Vec<Vec3> = (0..num).map(|i| on_disc(lighting.direction(), radius, i, num)).collect();
        let stretch = ShadingInterval { near_in_cells: NEAR_IN_CELLS, far: f32::INFINITY };
        Self::mean(extinction, &directions, stretch).in_front(&clear(extinction))
    }

    /// Replaces each clear cell by a binomial mean of its clear neighbours. Otherwise a surface askew to the cells
    /// would show bands.
    fn smoothed(self, clear: &[f32]) -> Self {
        let lit: Vec<f32> = clear.iter().zip(&self.shares).map(|(clear, share)| clear * share).collect();
        let [lit, weight] = [lit, clear.to_vec()].map(|numbers| smoothed(numbers, self.dims));
        let mut shares = self.shares;
        for ((share, lit), weight) in shares.iter_mut().zip(&lit).zip(&weight) {
            if *weight > WEIGHT_LEAST {
                *share = lit / weight;
            }
        }
        Self { shares, ..self }
    }

    /// Gives opaque cells the light of the clear ones beside them: a surface lies between two cells, and its light is
    /// that in front of it.
    fn in_front(self, clear: &[f32]) -> Self {
        let [nx, ny, nz] = self.dims;
        let mut shares = vec![0.0; clear.len()];
        shares.par_chunks_mut(nx * ny).enumerate().for_each(|(z, slice)| {
            for (i, out) in slice.iter_mut().enumerate() {
                let (x, y) = (i % nx, i / nx);
                let here = z * nx * ny + i;
                *out = self.shares[here];
                if clear[here] > CLEAR {
                    continue;
                }
                let (mut sum, mut weight) = (0.0, 0.0);
                let mut add = |is_inside: bool, at: usize| {
                    if is_inside {
                        sum += clear[at] * self.shares[at];
                        weight += clear[at];
                    }
                };
                add(x > 0, here.wrapping_sub(1));
                add(x + 1 < nx, here + 1);
                add(y > 0, here.wrapping_sub(nx));
                add(y + 1 < ny, here + nx);
                add(z > 0, here.wrapping_sub(nx * ny));
                add(z + 1 < nz, here + nx * ny);
                // Deep inside matter there are no clear cells, and nobody sees it.
                let part = (1.0 - clear[here]) * (weight / WEIGHT_FULL).min(1.0);
                *out += (sum / weight.max(f32::MIN_POSITIVE) - *out) * part;
            }
        });
        Self { shares, ..self }
    }

    /// The mean transmittance from every cell along `directions`.
    pub(crate) fn mean(extinction: &Extinction, directions: &[Vec3], stretch: ShadingInterval) -> Self {
        let Extinction { dims, voxels, .. } = *extinction;
        let num_cells = extinction.sigma.len();
        // Integer sums do not depend on the order of addition.
        let unit = (f32::from(u16::MAX) / directions.len() as f32).floor();
        let share = directions.len().div_ceil(rayon::current_num_threads().min(MAX_SUMS)).max(1);
        let sums = directions
            .par_chunks(share)
            .map(|directions| {
                let mut sums = vec![0u16; num_cells];
                for &direction in directions {
                    Sweep::new(extinction, direction).run(extinction, stretch, unit, &mut sums);
                }
                sums
            })
            .reduce_with(|mut a, b| {
                a.iter_mut().zip(&b).for_each(|(a, b)| *a += b);
                a
            })
            .unwrap_or_else(|| vec![0; num_cells]);
        let scale = (unit * directions.len() as f32).recip();
        Self { dims, voxels, shares: sums.iter().map(|&sum| f32::from(sum) * scale).collect() }
    }
}

/// Transmittance of each cell.
fn clear(extinction: &Extinction) -> Vec<f32> {
    let length = extinction.cell.to_array().iter().product::<f32>().cbrt();
    extinction.sigma.par_iter().map(|sigma| exp_of_minus(sigma * length)).collect()
}

/// Replaces each number by a binomial mean over 27 cells; at the faces the outermost repeat.
fn smoothed(mut numbers: Vec<f32>, [nx, ny, nz]: [usize; 3]) -> Vec<f32> {
    let mut out = vec![0.0; numbers.len()];
    for (stride, num) in [(1, nx), (nx, ny), (nx * ny, nz)] {
        out.par_chunks_mut(nx * ny).enumerate().for_each(|(z, slice)| {
            for (i, out) in slice.iter_mut().enumerate() {
                let i = z * nx * ny + i;
                let at = i / stride % num;
                let before = numbers[if at > 0 { i - stride } else { i }];
                let after = numbers[if at + 1 < num { i + stride } else { i }];
                *out = 0.5 * numbers[i] + 0.25 * (before + after);
            }
        });
        std::mem::swap(&mut numbers, &mut out);
    }
    numbers
}

/// Point `i` of `num` evenly spread over the sphere (spherical Fibonacci lattice).
fn on_sphere(i: usize, num: usize) -> Vec3 {
    let z = 1.0 - (2 * i + 1) as f32 / num as f32;
    let (sin, cos) = (i as f32 * GOLDEN_ANGLE).sin_cos();
    let flat = (1.0 - z * z).sqrt();
    Vec3::new(flat * cos, flat * sin, z)
}

/// Point `i` of `num` evenly spread over a disc of the sky around `center` (Vogel 1979), `radius` in radians.
fn on_disc(center: Vec3, radius: f32, i: usize, num: usize) -> Vec3 {
    let (right, up) = center.any_orthonormal_pair();
    let away = radius.sin() * ((i as f32 + 0.5) / num as f32).sqrt();
    let away = if num == 1 { 0.0 } else { away };
    let (sin, cos) = (i as f32 * GOLDEN_ANGLE).sin_cos();
    center * (1.0 - away * away).sqrt() + (right * cos + up * sin) * away
}

/// The lines of one direction. They advance along the axis on which they cross cells fastest; a and b are the other
/// two.
struct Sweep {
    /// The axes a, b and that of the slices.
    axes: [usize; 3],
    /// Whether the light comes from the high end of the slice axis.
    from_high: bool,
    /// Cells along a and b that a line moves per slice.
    drift: [f32; 2],
    /// Length of a line between two slices, world units.
    length: f32,
    towards: Vec3,
}

impl Sweep {
    /// `towards`: unit vector towards the light.
    fn new(extinction: &Extinction, towards: Vec3) -> Self {
        let in_cells = towards / extinction.cell;
        let slices = in_cells.abs().max_position();
        let axes = match slices {
            0 => [1, 2, 0],
            1 => [0, 2, 1],
            _ => [0, 1, 2],
        };
        let fastest = in_cells[slices].abs();
        let drift = [axes[0], axes[1]].map(|axis| -in_cells[axis] / fastest);
        Self { axes, from_high: towards[slices] > 0.0, length: fastest.recip(), drift, towards }
    }

    /// Adds the transmittance to every cell, in units of 1/`unit`.
    fn run(&self, extinction: &Extinction, stretch: ShadingInterval, unit: f32, sums: &mut [u16]) {
        let dims = extinction.dims;
        let strides = [1, dims[0], dims[0] * dims[1]];
        let [a, b, slices] = self.axes;
        let (num_a, num_b, num_slices) = (dims[a], dims[b], dims[slices]);
        let mut cells = PaddedSlice::new(num_a, num_b);
        let ends = stretch.in_direction(extinction, self.towards);
        let mut depths = Depths::new([num_a + 1, num_b + 1], num_slices, ends, self.length);
        let mut through = vec![0.0f32; num_a + 1];
        let mut mixed = [vec![0.0f32; num_a], vec![0.0f32; num_a]];
        for t in 0..num_slices {
            let slice = if self.from_high { num_slices - 1 - t } else { t };
            cells.read(&extinction.sigma, slice * strides[slices], [strides[a], strides[b]]);
            let [place_a, place_b] = [0, 1].map(|i| CellShift::at(self.drift[i] * t as f32));
            // The first line at or beside a cell of this slice; number 0 is the first of the first slice.
            let first = [-place_a.whole, -place_b.whole];
            depths.advance(&cells, first, [place_a.part, place_b.part], self.length);
            depths.transmittances(0, &mut through);
            mix_neighbours(&through, place_a.part, &mut mixed[0]);
            for row in 0..num_b {
                depths.transmittances(row + 1, &mut through);
                mix_neighbours(&through, place_a.part, &mut mixed[1]);
                let from = slice * strides[slices] + row * strides[b];
                let [before, after] = &mixed;
                let (part, scale) = (place_b.part, unit);
                let share = |x: f32, y: f32| (((y + (x - y) * part) * scale) + 0.5) as u16;
                if strides[a] == 1 {
                    let sums = &mut sums[from..from + num_a];
                    for ((sum, x), y) in sums.iter_mut().zip(before).zip(after) {
                        *sum += share(*x, *y);
                    }
                } else {
                    let sums = sums[from..].iter_mut().step_by(strides[a]);
                    for ((sum, x), y) in sums.zip(before).zip(after) {
                        *sum += share(*x, *y);
                    }
                }
                mixed.swap(0, 1);
            }
        }
    }
}

/// A shift as whole cells and a fraction.
struct CellShift {
    whole: isize,
    part: f32,
}

impl CellShift {
    fn at(shift: f32) -> Self {
        let whole = shift.floor();
        Self { whole: whole as isize, part: shift - whole }
    }
}

/// Sets out[i] between the numbers i and i + 1 of `lines`, at `part` from the second to the first.
fn mix_neighbours(lines: &[f32], part: f32, out: &mut [f32]) {
    for (out, (x, y)) in out.iter_mut().zip(lines.iter().zip(&lines[1..])) {
        *out = y + (x - y) * part;
    }
}

/// The extinctions of a slice, with a border of empty cells.
struct PaddedSlice {
    num: [usize; 2],
    sigma: Vec<f32>,
}

impl PaddedSlice {
    fn new(num_a: usize, num_b: usize) -> Self {
        Self { num: [num_a, num_b], sigma: vec![0.0; (num_a + 2) * (num_b + 2)] }
    }

    fn read(&mut self, all: &[f32], first: usize, strides: [usize; 2]) {
        let [num_a, num_b] = self.num;
        for j in 0..num_b {
            let from = first + j * strides[1];
            let row = &mut self.sigma[(j + 1) * (num_a + 2) + 1..][..num_a];
            if strides[0] == 1 {
                row.copy_from_slice(&all[from..from + num_a]);
            } else {
                row.iter_mut().zip(all[from..].iter().step_by(strides[0])).for_each(|(to, from)| *to = *from);
            }
        }
    }

    /// Row `j` of those, with the border.
    fn row(&self, j: usize) -> &[f32] {
        let width = self.num[0] + 2;
        &self.sigma[j * width..][..width]
    }
}

/// Optical depths along the lines through the newest slice, from where they enter the grid.
///
/// Lines are numbered over the whole sweep; a slice has those from its own first on. A line that had not entered by
/// an earlier slice has no depth there.
struct Depths {
    /// Number of lines in a slice along a and b.
    num: [usize; 2],
    /// Depths at the end of the newest slice.
    whole: LineValues,
    spare: LineValues,
    /// Depths at the middles of slices in a ring: the newest is at `newest`, older ones follow.
    middles: Vec<LineValues>,
    newest: usize,
    /// The ends of the interval, in slices before the newest; no far end means everything.
    near: (usize, f32),
    far: Option<(usize, f32)>,
    rows: [Vec<f32>; 4],
}

/// One number for each line of a slice.
#[derive(Clone)]
struct LineValues {
    first: [isize; 2],
    numbers: Vec<f32>,
}

impl LineValues {
    /// Reads the numbers of the lines from `first` on, `row` rows further; 0 for lines that are absent.
    fn read(&self, num: [usize; 2], first: [isize; 2], row: usize, out: &mut [f32]) {
        let row = row as isize + first[1] - self.first[1];
        let shift = first[0] - self.first[0];
        out.fill(0.0);
        if row < 0 || row >= num[1] as isize || shift.unsigned_abs() >= num[0] {
            return;
        }
        let here = &self.numbers[row as usize * num[0]..][..num[0]];
        let by = shift.unsigned_abs();
        if shift >= 0 {
            out[..num[0] - by].copy_from_slice(&here[by..]);
        } else {
            out[by..].copy_from_slice(&here[..num[0] - by]);
        }
    }
}

impl Depths {
    /// Starts lines that are `length` long between two of `num_slices`.
    fn new(num: [usize; 2], num_slices: usize, stretch: [f32; 2], length: f32) -> Self {
        let split = |distance: f32| {
            let slices = distance / length;
            (slices as usize, slices.fract())
        };
        let far = Some(stretch[1]).filter(|far| far / length < num_slices as f32).map(split);
        let near = split(stretch[0]);
        let num_kept = far.map_or(near.0, |far| far.0.max(near.0)) + 2;
        let empty = LineValues { first: [0; 2], numbers: vec![0.0; num[0] * num[1]] };
        let rows = std::array::from_fn(|_| vec![0.0; num[0]]);
        Self {
            num,
            middles: vec![empty.clone(); num_kept],
            spare: empty.clone(),
            whole: empty,
            newest: 0,
            near,
            far,
            rows,
        }
    }

    /// Advances by a slice in which line `first` runs `part` behind cell −1.
    fn advance(&mut self, cells: &PaddedSlice, first: [isize; 2], part: [f32; 2], length: f32) {
        self.newest = (self.newest + self.middles.len() - 1) % self.middles.len();
        std::mem::swap(&mut self.whole, &mut self.spare);
        let (num, middle) = (self.num, &mut self.middles[self.newest]);
        (self.whole.first, middle.first) = (first, first);
        let rows = self.whole.numbers.chunks_mut(num[0]).zip(middle.numbers.chunks_mut(num[0]));
        for (j, (whole, middle)) in rows.enumerate() {
            self.spare.read(num, first, j, whole);
            let (near, far) = (cells.row(j), cells.row(j + 1));
            for (i, (whole, middle)) in whole.iter_mut().zip(middle).enumerate() {
                let x = near[i] + (near[i + 1] - near[i]) * part[0];
                let y = far[i] + (far[i + 1] - far[i]) * part[0];
                let tau = ((x + (y - x) * part[1]) * length).min(TAU_MAX);
                *middle = *whole + 0.5 * tau;
                *whole += tau;
            }
        }
    }

    /// Transmittances of the intervals that end in the newest slice, along the lines of its row `row`.
    fn transmittances(&mut self, row: usize, out: &mut [f32]) {
        let first = self.whole.first;
        let ring = self.middles.len();
        let [near_0, near_1, far_0, far_1] = &mut self.rows;
        let slot = |before: usize, to: &mut [f32]| {
            self.middles[(self.newest + before) % ring].read(self.num, first, row, to);
        };
        slot(self.near.0, near_0);
        slot(self.near.0 + 1, near_1);
        let near_part = self.near.1;
        let Some((before, far_part)) = self.far else {
            for (out, (a, b)) in out.iter_mut().zip(near_0.iter().zip(near_1)) {
                *out = exp_of_minus(a + (*b - a) * near_part);
            }
            return;
        };
        slot(before, far_0);
        slot(before + 1, far_1);
        for (i, out) in out.iter_mut().enumerate() {
            let near = near_0[i] + (near_1[i] - near_0[i]) * near_part;
            let far = far_0[i] + (far_1[i] - far_0[i]) * far_part;
            *out = exp_of_minus(near - far);
        }
    }
}

/// e^−x for x ≥ 0, to a relative 10⁻⁵; it calls nothing, so loops compile to vector instructions.
#[inline(always)]
fn exp_of_minus(x: f32) -> f32 {
    let x = (x * LOG2_E).clamp(0.0, 40.0);
    let whole = x as i32;
    let part = x - whole as f32;
    // 2^−part, by a polynomial that is exact at both ends.
    let power = 1.0 - part * (0.693084 - part * (0.239528 - part * (0.053286 - part * 0.006842)));
    f32::from_bits(((127 - whole) as u32) << 23) * power
}

/// Matter nearer than this does not shade, in cells: a surface's light is that in front of it, and its cell has
/// matter on both sides of its centre.
const NEAR_IN_CELLS: f32 = 1.25;
/// A cell with more transmittance than this keeps its own light.
const CLEAR: f32 = 0.98;
/// A cell keeps its own light among fewer clear cells than this.
const WEIGHT_LEAST: f32 = 1e-3;
/// Weight of clear neighbours from which their light counts fully: one of six.
const WEIGHT_FULL: f32 = 0.5;
/// Most threads with sums of their own, two bytes per cell.
const MAX_SUMS: usize = 16;
/// Greatest optical depth of a slice, so that sums keep their precision.
const TAU_MAX: f32 = 32.0;
const GOLDEN_ANGLE: f32 = PI * (3.0 - 2.236_068);

#[cfg(test)]
mod tests;
