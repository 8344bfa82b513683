//! What holds up light where only surfaces are shown.
//!
//! An opaque surface is that of a body: what lies on its other side as seen from around the volume is as opaque as it is
//! large. So a surface's own side has its light, and a body's thickness does not matter. That is the side of the greater
//! values, or of the lesser ones where most of the faces of what is shown lie among the greater ones. A translucent surface is
//! a sheet: a line that crosses it straight has its optical depth to pass, one that crosses it askew as much more as through
//! a layer of matter.

use rayon::prelude::*;

use super::Extinction;
use crate::space::Aabb;
use crate::volume::grid::{Volume, Voxels};

/// A surface as light meets it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sheet {
    /// The stored number that it passes through.
    pub stored: f32,
    /// Optical depth of a crossing.
    pub tau: f32,
    /// Whether it hides what is behind it, so that this may be full.
    pub is_opaque: bool,
}

/// Whether the bodies of opaque sheets lie among the lesser values. `bounds` are those of what is shown.
pub fn has_lesser_bodies(sheets: &[Sheet], volume: &Volume, bounds: &Aabb) -> bool {
    Body::of(sheets, volume, bounds).is_some_and(|body| !body.is_greater)
}

/// A stored number, and on which side of it bodies lie.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Body {
    stored: f32,
    is_greater: bool,
}

impl Body {
    /// The bodies of opaque sheets, of which the outermost hides the others. `bounds` are those of what is shown.
    fn of(sheets: &[Sheet], volume: &Volume, bounds: &Aabb) -> Option<Self> {
        let opaque = || sheets.iter().filter(|s| s.is_opaque).map(|s| s.stored);
        let lowest = opaque().min_by(f32::total_cmp)?;
        let is_greater = share_above(volume, bounds, lowest) <= 0.5;
        let highest = opaque().max_by(f32::total_cmp)?;
        Some(Self { stored: if is_greater { lowest } else { highest }, is_greater })
    }

    /// The share of a voxel that is full: the mean over the ways half to its neighbours, along which numbers are linear.
    #[inline(always)]
    fn share(self, here: f32, around: [f32; 6]) -> f32 {
        let is_full = |v: f32| (v >= self.stored) == self.is_greater;
        let num_full = around.iter().filter(|v| is_full(**v)).count();
        if (num_full == 6 && is_full(here)) || (num_full == 0 && !is_full(here)) {
            return f32::from(u8::from(num_full == 6));
        }
        let above = around.map(|v| {
            let half = 0.5 * (here + v);
            let (lo, hi) = if half < here { (half, here) } else { (here, half) };
            if lo >= self.stored {
                1.0
            } else if hi < self.stored {
                0.0
            } else {
                // Not clamped: `lo` and `hi` are on both sides.
                (hi - self.stored) / (hi - lo)
            }
        });
        let above = above.iter().sum::<f32>() * (1.0 / 6.0);
        if self.is_greater { above } else { 1.0 - above }
    }
}

/// The share of the faces of a box where stored numbers are at or above one, by at most [`FACE_SAMPLES`] voxels a side of a face:
/// no more than a draft can wait for.
fn share_above(volume: &Volume, bounds: &Aabb, stored: f32) -> f32 {
    let dims = volume.dims().map(|d| d as i32);
    let (spacing, first) = (volume.spacing(), volume.bounds().min);
    let voxel = |axis: usize, world: f32| {
        (((world - first[axis]) / spacing[axis]).floor() as i32).clamp(0, dims[axis] - 1)
    };
    let range = [0, 1, 2].map(|axis| {
        let lo = voxel(axis, bounds.min[axis]);
        // A face between voxels is that of the voxel inside.
        (lo, voxel(axis, bounds.max[axis] - 0.5 * spacing[axis]).max(lo))
    });
    let (mut above, mut all) = (0.0, 0.0);
    for axis in 0..3 {
        let [a, b] = [(axis + 1) % 3, (axis + 2) % 3];
        let area =
            f64::from(spacing[a] / spacing.max_element()) * f64::from(spacing[b] / spacing.max_element());
        for face in [range[axis].0, range[axis].1] {
            let (mut num_above, mut num) = (0u32, 0u32);
            for i in sampled(range[a]) {
                for j in sampled(range[b]) {
                    let mut at = [0; 3];
                    (at[axis], at[a], at[b]) = (face, i, j);
                    num_above += u32::from(volume.stored_at(at[0], at[1], at[2]) >= stored);
                    num += 1;
                }
            }
            let [na, nb] = [a, b].map(|axis| f64::from(range[axis].1 - range[axis].0 + 1));
            let of_face = area * na * nb;
            above += of_face * f64::from(num_above) / f64::from(num);
            all += of_face;
        }
    }
    (above / all) as f32
}

/// Voxels between two, both taken in, at equal distances and from their middle.
fn sampled((lo, hi): (i32, i32)) -> impl Iterator<Item = i32> {
    let apart = (hi - lo) / FACE_SAMPLES + 1;
    (lo + (apart - 1) / 2..=hi).step_by(apart as usize)
}

impl Extinction {
    /// Fills the bodies and adds the sheets; `step` as in [`Extinction::of`]. Where nothing is cut away.
    pub(super) fn fill_surfaces(
        &mut self,
        volume: &Volume,
        step: [usize; 3],
        sheets: &[Sheet],
        bounds: &Aabb,
    ) {
        let body = Body::of(sheets, volume, bounds);
        let sheets: Vec<Sheet> = sheets.iter().filter(|s| !s.is_opaque).copied().collect();
        match volume.voxels() {
            Voxels::U8(v) => self.fill_from(v, volume, step, body, &sheets),
            Voxels::U16(v) => self.fill_from(v, volume, step, body, &sheets),
            Voxels::F32(v) => self.fill_from(v, volume, step, body, &sheets),
        }
    }

    fn fill_from<T: Copy + Into<f32> + Sync>(
        &mut self,
        voxels: &[T],
        volume: &Volume,
        step: [usize; 3],
        body: Option<Body>,
        sheets: &[Sheet],
    ) {
        let [nx, ny, nz] = volume.dims().map(|d| d as usize);
        let [cx, cy, _] = self.dims;
        let side = self.voxels;
        let taken = |axis: usize| side[axis].div_ceil(step[axis]) as f32;
        let share = (taken(0) * taken(1) * taken(2)).recip();
        // A sheet straight across an axis has one crossing in each column of voxels that are looked at: so much of optical
        // depth for each unit of length, taken over the cell.
        let apart = volume.spacing() * glam::Vec3::from_array(step.map(|n| n as f32));
        let per_crossing = apart.recip() * share;
        let length = self.cell.to_array().iter().product::<f32>().cbrt();
        self.sigma.par_chunks_mut(cx * cy).enumerate().for_each(|(k, slice)| {
            let mut full = vec![0.0f32; cx * cy];
            for z in (k * side[2]..((k + 1) * side[2]).min(nz)).step_by(step[2]) {
                for y in (0..ny).filter(|y| (y % side[1]).is_multiple_of(step[1])) {
                    let row = |y: usize, z: usize| &voxels[(z * ny + y) * nx..][..nx];
                    let here = row(y, z);
                    let beside = [row(y.saturating_sub(step[1]), z), row((y + step[1]).min(ny - 1), z)];
                    let across = [row(y, z.saturating_sub(step[2])), row(y, (z + step[2]).min(nz - 1))];
                    let first = y / side[1] * cx;
                    for (i, cell) in (first..first + cx).enumerate() {
                        for x in (i * side[0]..((i + 1) * side[0]).min(nx)).step_by(step[0]) {
                            let v: f32 = here[x].into();
                            let ahead = [here[(x + step[0]).min(nx - 1)], beside[1][x], across[1][x]];
                            let ahead: [f32; 3] = ahead.map(Into::into);
                            let behind = [here[x.saturating_sub(step[0])], beside[0][x], across[0][x]];
                            let [a, b, c]: [f32; 3] = behind.map(Into::into);
                            if let Some(body) = body {
                                full[cell] += body.share(v, [a, b, c, ahead[0], ahead[1], ahead[2]]) * share;
                            }
                            for sheet in sheets {
                                let is_crossed = |to: f32| (v < sheet.stored) != (to < sheet.stored);
                                let crossed = ahead.map(|to| f32::from(u8::from(is_crossed(to))));
                                slice[cell] +=
                                    sheet.tau * (glam::Vec3::from(crossed) * per_crossing).length();
                            }
                        }
                    }
                }
            }
            for (sigma, full) in slice.iter_mut().zip(full) {
                // A cell that is full in part hides so much of what is behind it.
                *sigma += -(1.0 - full).max(FULL_TRANSMITTANCE).ln() / length;
            }
        });
    }
}

/// Which side most of a face lies on is told by so many rows of so many voxels.
const FACE_SAMPLES: i32 = 128;
/// What comes through a full cell.
const FULL_TRANSMITTANCE: f32 = 1e-6;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    #[test]
    fn faces_are_told_apart_by_a_bounded_number_of_voxels() {
        for (lo, hi) in [(0, 0), (0, 1), (3, 130), (0, 127), (0, 128), (5, 2047), (0, 300)] {
            let found: Vec<i32> = sampled((lo, hi)).collect();
            assert!(
                !found.is_empty() && found.len() <= FACE_SAMPLES as usize,
                "{lo}..={hi}: {}",
                found.len()
            );
            assert!(found.iter().all(|i| (lo..=hi).contains(i)));
            let is_all = hi - lo < FACE_SAMPLES;
            assert_eq!(found.len() == (hi - lo + 1) as usize, is_all, "{lo}..={hi}");
        }
        // Long along x. The faces across x have few voxels and count by their size: 5 of 9 rows of the others are above.
        let dims = [600u32, 9, 9];
        let at = |i: u32| i / 600 % 9;
        let voxels = (0..600 * 81).map(|i| if at(i) < 5 { 200 } else { 0 }).collect();
        let of = |voxels| Volume::new(dims, Vec3::ONE, Voxels::U8(voxels), (1.0, 0.0), Default::default());
        let volume = of(voxels).unwrap();
        // Along y: one face is above, one below, and of those along z and across x 5 of 9.
        let expected = (5400.0 + 2.0 * 3000.0 + 2.0 * 45.0) / (4.0 * 5400.0 + 2.0 * 81.0);
        let found = share_above(&volume, &volume.bounds(), 100.0);
        assert!((found - expected).abs() < 1e-4, "{found} {expected}");
    }
}
