//! What attenuates light where only surfaces are shown.
//!
//! An opaque surface bounds a body, which is opaque throughout. So the surface is lit from its own side, and a body's
//! thickness does not matter. Bodies have the greater values, or the lesser ones if most of the visible volume's
//! faces lie among the greater ones. A translucent surface is a sheet. A line that crosses it at a right angle passes
//! its optical depth; an oblique one passes more, as through a layer of matter.

use rayon::prelude::*;

use super::{CellBox, CellSums, Extinction};
use crate::clip::Region;
use crate::volume::grid::{Volume, Voxels};
use crate::volume::world::VoxelBox;

/// A surface for lighting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sheet {
    /// Its stored number.
    pub stored: f32,
    /// Optical depth of a crossing.
    pub tau: f32,
    /// Whether it hides what is behind it, so that a body may fill that.
    pub is_opaque: bool,
}

/// Whether bodies of opaque sheets have the lesser stored numbers, in the visible `region`; `None` without such a
/// sheet.
pub fn has_lesser_bodies(sheets: &[Sheet], volume: &Volume, region: &Region) -> Option<bool> {
    Some(!Body::of(sheets, volume, region)?.is_greater)
}

/// Of a part of a volume, two areas of the visible `region`'s faces. The first is that in voxels of `own` which have at
/// least the number of the lowest opaque sheet. The second is that of all faces. `None` without such a sheet.
pub fn area_above(sheets: &[Sheet], volume: &Volume, region: &Region, own: &VoxelBox) -> Option<[f64; 2]> {
    let opaque = sheets.iter().filter(|s| s.is_opaque).map(|s| s.stored);
    Some(areas(volume, region, opaque.min_by(f32::total_cmp)?, |voxel| own.contains(voxel)))
}

/// Whether bodies have the lesser stored numbers, given the areas of [`area_above`].
pub fn are_lesser_bodies([above, all]: [f64; 2]) -> bool {
    share_of([above, all]) > 0.5
}

/// A stored number, and the side of it that bodies have.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Body {
    stored: f32,
    is_greater: bool,
}

impl Body {
    /// The bodies of opaque sheets in `region`, of which the outermost hides the others.
    fn of(sheets: &[Sheet], volume: &Volume, region: &Region) -> Option<Self> {
        let opaque = sheets.iter().filter(|s| s.is_opaque).map(|s| s.stored);
        let is_greater = share_above(volume, region, opaque.min_by(f32::total_cmp)?) <= 0.5;
        Self::on_side(sheets, is_greater)
    }

    /// The same, where the side that bodies have is known.
    fn on_side(sheets: &[Sheet], is_greater: bool) -> Option<Self> {
        let opaque = sheets.iter().filter(|s| s.is_opaque).map(|s| s.stored);
        let stored =
            if is_greater { opaque.min_by(f32::total_cmp)? } else { opaque.max_by(f32::total_cmp)? };
        Some(Self { stored, is_greater })
    }

    /// The filled fraction of a voxel: the mean over half the ways to its neighbours, with linear numbers between.
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
                // No clamp: `lo` and `hi` are on both sides.
                (hi - self.stored) / (hi - lo)
            }
        });
        let above = above.iter().sum::<f32>() * (1.0 / 6.0);
        if self.is_greater { above } else { 1.0 - above }
    }
}

/// The fraction of the visible region's faces where stored numbers are at least `stored`. At most [`FACE_SAMPLES`]
/// voxels per side of a face count, which is fast enough for a draft. A voxel is visible if its centre is.
fn share_above(volume: &Volume, region: &Region, stored: f32) -> f32 {
    share_of(areas(volume, region, stored, |_| true))
}

/// Nothing is visible if everything is cut away.
fn share_of([above, all]: [f64; 2]) -> f32 {
    if all > 0.0 { (above / all) as f32 } else { 0.0 }
}

/// The area of those faces in the voxels that are `own`, and that of all faces.
fn areas(volume: &Volume, region: &Region, stored: f32, is_own: impl Fn([u32; 3]) -> bool) -> [f64; 2] {
    let (last, spacing) = (volume.whole_dims().map(|d| d as i32 - 1), volume.spacing());
    let first = volume.world_from_voxel(glam::Vec3::ZERO);
    // The centre of voxel i is at i.
    let in_voxels = |axis: usize, world: f32| (world - first[axis]) / spacing[axis] - 0.5;
    let range = [0, 1, 2].map(|axis| {
        // A face between voxels belongs to the voxel inside.
        let lo = (in_voxels(axis, region.bounds.min[axis]).ceil() as i32).clamp(0, last[axis]);
        let hi = (in_voxels(axis, region.bounds.max[axis]).floor() as i32).clamp(lo, last[axis]);
        (lo, hi)
    });
    // How far a plane lies below the voxels of a row along `axis`, times the normal's component.
    let distance =
        |axis: usize, n: i32| region.normal[axis] * (first[axis] + (n as f32 + 0.5) * spacing[axis]);
    let facing = (0..3).max_by(|&a, &b| region.normal[a].abs().total_cmp(&region.normal[b].abs()));
    let facing = facing.filter(|&axis| region.normal[axis] != 0.0);
    let (mut above, mut all) = (0.0, 0.0);
    for axis in 0..3 {
        let [a, b] = [(axis + 1) % 3, (axis + 2) % 3];
        let (lo, hi) = range[axis];
        let (mut num_above, mut num) = (0.0, 0.0);
        let mut look_at = |mut at: [i32; 3], n: i32, area: f64| {
            at[axis] = n;
            num += area;
            let at = at.map(|i| i as u32);
            if is_own(at) {
                num_above += area * f64::from(u8::from(volume.stored_in_world(at) >= stored));
            }
        };
        for i in sampled(range[a]) {
            for j in sampled(range[b]) {
                let mut at = [0; 3];
                (at[a], at[b]) = (i, j);
                let beside = distance(a, i) + distance(b, j) - region.offset;
                for face in [lo, hi] {
                    if beside + distance(axis, face) >= 0.0 {
                        look_at(at, face, 1.0);
                    }
                }
                if facing == Some(axis) {
                    // The plane's own face is larger than the area that it covers across.
                    let slope = region.normal[axis];
                    let place = in_voxels(axis, -beside / slope);
                    let (n, is_inside) = match slope > 0.0 {
                        true => (place.ceil() as i32, lo + 1..=hi),
                        false => (place.floor() as i32, lo..=hi - 1),
                    };
                    if is_inside.contains(&n) {
                        look_at(at, n, f64::from(slope.abs().recip()));
                    }
                }
            }
        }
        // The area of each sampled voxel.
        let area = [a, b].map(|axis| {
            let (lo, hi) = range[axis];
            f64::from(spacing[axis] / spacing.max_element()) * f64::from(hi - lo + 1)
                / sampled((lo, hi)).count() as f64
        });
        above += area[0] * area[1] * num_above;
        all += area[0] * area[1] * num;
    }
    [above, all]
}

/// Evenly spaced voxels between two, inclusive, around their middle.
fn sampled((lo, hi): (i32, i32)) -> impl Iterator<Item = i32> {
    let apart = (hi - lo) / FACE_SAMPLES + 1;
    (lo + (apart - 1) / 2..=hi).step_by(apart as usize)
}

impl CellSums {
    /// Adds the bodies and the sheets. Bodies have the lesser numbers if `is_lesser`.
    pub(super) fn fill_surfaces(
        &mut self,
        volume: &Volume,
        cells: &CellBox,
        sheets: &[Sheet],
        is_lesser: Option<bool>,
    ) {
        let body = is_lesser.and_then(|is_lesser| Body::on_side(sheets, !is_lesser));
        let sheets: Vec<Sheet> = sheets.iter().filter(|s| !s.is_opaque).copied().collect();
        self.full = vec![0.0; cells.count()];
        match volume.voxels() {
            Voxels::U8(v) => self.fill_from(v, volume, cells, body, &sheets),
            Voxels::U16(v) => self.fill_from(v, volume, cells, body, &sheets),
            Voxels::F32(v) => self.fill_from(v, volume, cells, body, &sheets),
        }
    }

    fn fill_from<T: Copy + Into<f32> + Sync>(
        &mut self,
        voxels: &[T],
        volume: &Volume,
        cells: &CellBox,
        body: Option<Body>,
        sheets: &[Sheet],
    ) {
        let [nx, ny, nz] = volume.dims().map(|d| d as usize);
        let [fx, fy, fz] = volume.first().map(|d| d as usize);
        let [cx, cy, _] = cells.dims;
        let (step, share) = (cells.step, cells.share());
        // A sheet straight across an axis has one crossing per sampled column of voxels. This is its optical depth
        // per unit of length, spread over the cell.
        let apart = volume.spacing() * glam::Vec3::from_array(step.map(|n| n as f32));
        let per_crossing = apart.recip() * share;
        let slices = self.sigma.par_chunks_mut(cx * cy).zip(self.full.par_chunks_mut(cx * cy));
        slices.enumerate().for_each(|(k, (slice, full))| {
            for z in cells.voxels(2, k).map(|z| z - fz) {
                for (j, y) in (0..cy).flat_map(|j| cells.voxels(1, j).map(move |y| (j, y - fy))) {
                    let row = |y: usize, z: usize| &voxels[(z * ny + y) * nx..][..nx];
                    let here = row(y, z);
                    let beside = [row(y.saturating_sub(step[1]), z), row((y + step[1]).min(ny - 1), z)];
                    let across = [row(y, z.saturating_sub(step[2])), row(y, (z + step[2]).min(nz - 1))];
                    for (i, cell) in (j * cx..(j + 1) * cx).enumerate() {
                        for x in cells.voxels(0, i).map(|x| x - fx) {
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
        });
    }
}

impl Extinction {
    /// Adds bodies, given the share of each cell that they fill: it hides that share of what is behind it.
    pub(super) fn hide_behind_bodies(&mut self, full: &[f32]) {
        let length = self.cell.to_array().iter().product::<f32>().cbrt();
        for (sigma, full) in self.sigma.iter_mut().zip(full) {
            *sigma += -(1.0 - full).max(FULL_TRANSMITTANCE).ln() / length;
        }
    }
}

/// Rows and columns of samples on a face.
const FACE_SAMPLES: i32 = 128;
const FULL_TRANSMITTANCE: f32 = 1e-6;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::super::{Detail, Matter};
    use super::*;
    use crate::clip::{Clip, Plane};

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
        // Long along x. The faces across x have few voxels and count by their size: 5 of 9 rows of the others are
        // above.
        let dims = [600u32, 9, 9];
        let at = |i: u32| i / 600 % 9;
        let voxels = (0..600 * 81).map(|i| if at(i) < 5 { 200 } else { 0 }).collect();
        let of = |voxels| Volume::new(dims, Vec3::ONE, Voxels::U8(voxels), (1.0, 0.0), Default::default());
        let volume = of(voxels).unwrap();
        // Along y: one face is above, one below, and of those along z and across x 5 of 9.
        let expected = (5400.0 + 2.0 * 3000.0 + 2.0 * 45.0) / (4.0 * 5400.0 + 2.0 * 81.0);
        let found = share_above(&volume, &Clip::default().region(&volume.bounds()), 100.0);
        assert!((found - expected).abs() < 1e-4, "{found} {expected}");
    }

    fn cut(normal: Vec3, d: f32) -> Clip {
        Clip { plane: Plane::new(normal, d), bounds: None }
    }

    #[test]
    fn a_plane_leaves_the_faces_that_a_box_of_the_same_leaves() {
        // Without any pattern, in voxels longer than wide.
        let dims = [13u32, 17, 11];
        let voxels = (0..dims.iter().product()).map(|i: u32| (i.wrapping_mul(0x9e37_79b9) >> 24) as u8);
        let spacing = Vec3::new(0.5, 1.0, 2.0);
        let volume =
            Volume::new(dims, spacing, Voxels::U8(voxels.collect()), (1.0, 0.0), Default::default()).unwrap();
        let whole = volume.bounds();
        let share = |clip: Clip| share_above(&volume, &clip.region(&whole), 128.0);
        let mut found = Vec::new();
        for axis in 0..3 {
            let to = [Vec3::X, Vec3::Y, Vec3::Z][axis];
            for i in 0..dims[axis] * 4 {
                // Between voxels too. The last has half a voxel left, and its centre is that of no row.
                let d = whole.min[axis] + (i as f32 - 0.9) * 0.25 * spacing[axis];
                let (mut above, mut below) = (whole, whole);
                (above.min[axis], below.max[axis]) = (d, d);
                for (plane, bounds) in [(cut(to, d), above), (cut(-to, -d), below)] {
                    if (bounds.max - bounds.min)[axis] > 0.5 * spacing[axis] {
                        let (plane, boxed) =
                            (share(plane), share(Clip { bounds: Some(bounds), plane: None }));
                        // Sums of the same numbers in another order.
                        assert!((plane - boxed).abs() < 1e-6, "{to} {i}: {plane} {boxed}");
                        found.push(plane);
                    }
                }
            }
        }
        let differ = found.iter().filter(|s| (**s - share(Clip::default())).abs() > 1e-3).count();
        assert!(differ > found.len() / 2, "{differ} of {} differ from the whole", found.len());
        assert_eq!(share(cut(Vec3::X, 1e3)), 0.0, "nothing is left");
    }

    #[test]
    fn a_plane_across_has_a_face_as_large_as_it_is() {
        // A sheet along a diagonal, so that the plane through it has most of what is above.
        let side = 64u32;
        let at = |i: u32| [i % side, i / side % side].map(|n| n as f32 + 0.5 - 0.5 * side as f32);
        let voxels = (0..side.pow(3)).map(|i| u8::from((at(i)[0] + at(i)[1]).abs() < 2.5));
        let voxels = Voxels::U8(voxels.collect());
        let volume = Volume::new([side; 3], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap();
        let share = |clip: Clip| share_above(&volume, &clip.region(&volume.bounds()), 1.0);
        // In areas of a side: the plane √2, two sides whole and two cut in half. Above are the plane, of each half
        // the rows at 0 to 2 from it, and of each whole side three rows at the edge where it meets the plane.
        let of_halves = 2.0 * (side + (side - 1) + (side - 2)) as f32 / (side * side) as f32;
        let of_whole = 2.0 * 3.0 / side as f32;
        let sqrt = std::f32::consts::SQRT_2;
        let expected = (sqrt + of_halves + of_whole) / (sqrt + 3.0);
        let found = share(cut(Vec3::new(1.0, 1.0, 0.0), 0.0));
        // The plane's face has a row of 64 less, two other sides one each.
        assert!((found - expected).abs() < 0.01, "{found} {expected}");
        assert!(share(Clip::default()) < 0.1);
    }

    #[test]
    fn light_is_held_up_by_the_same_bodies_whether_a_plane_or_a_box_cuts() {
        // Greater values from voxel 14 of 24 on: less than half of the faces of the whole, more of those from voxel
        // 10 on.
        let voxels = (0..24u32.pow(3)).map(|i| if i % 24 < 14 { 50 } else { 150 });
        let voxels = Voxels::U8(voxels.collect());
        let volume = Volume::new([24; 3], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap();
        let whole = volume.bounds();
        let sheets = [Sheet { stored: 100.0, tau: 9.0, is_opaque: true }];
        let sigma = |clip: Clip| {
            let region = clip.region(&whole);
            Extinction::of(&volume, Matter::Surfaces(&sheets), &region, Detail::Final).sigma
        };
        let mut kept = whole;
        kept.min.x += 10.0;
        let boxed = sigma(Clip { bounds: Some(kept), plane: None });
        let planar = sigma(cut(Vec3::X, kept.min.x));
        // Sizes of numbers of the order of 10.
        assert!(boxed.iter().zip(&planar).all(|(a, b)| (a - b).abs() < 1e-4));
        // Full is what is open in the whole.
        let (uncut, at) = (sigma(Clip::default()), |x: usize| x + 24 * (12 + 24 * 12));
        assert!(boxed[at(11)] > 1.0 && boxed[at(20)] == 0.0, "{} {}", boxed[at(11)], boxed[at(20)]);
        assert!(uncut[at(11)] == 0.0 && uncut[at(20)] > 1.0);
    }
}
