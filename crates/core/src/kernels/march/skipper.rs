//! What a march need not sample: invisible bricks, and steps that the table shows to be clear.

use glam::{BVec3, Vec3};

use super::field::{MarchField, Run};
use super::grid::{LANES, Lanes};
use super::{Lattice, STRIDE, bin};
use crate::transfer::{TABLE_BINS, TransferTable};
use crate::volume::{BRICK, Occupancy};

/// Skips invisible bricks along one ray.
pub(super) struct Skipper<'a> {
    occupancy: &'a Occupancy,
    max_brick: Vec3,
    origin: Vec3,
    dir: Vec3,
    inv_dir: Vec3,
    is_ascending: BVec3,
    lattice: Lattice,
    run: Run,
    /// Whether both ends of every step lie in the same or in touching bricks.
    is_fine: bool,
}

impl<'a> Skipper<'a> {
    #[inline(always)]
    pub(super) fn new<T>(
        field: &'a MarchField<'_, T>,
        (origin, dir): (Vec3, Vec3),
        lattice: Lattice,
        run: Run,
    ) -> Self {
        let step = dir.abs().max_element() * lattice.h * run.pace as f32;
        Self {
            occupancy: field.occupancy,
            max_brick: field.max_brick,
            origin: origin - field.first_brick,
            dir,
            inv_dir: dir.recip(),
            is_ascending: dir.cmpgt(Vec3::ZERO),
            lattice,
            run,
            is_fine: step * (STRIDE as f32) < BRICK as f32,
        }
    }

    /// The first lattice point from `i` on, by strides, whose step may be visible and above the key `least`; the end of
    /// the run or more if none.
    #[inline(always)]
    pub(super) fn skip(&self, mut i: u32, stride: u32, least: f32) -> u32 {
        let Lattice { s0, h, .. } = self.lattice;
        let Run { end, limit, .. } = self.run;
        let (mut brick, mut empty) = self.brick_at(i, least);
        while empty > 0 {
            // The last lattice point within the surrounding invisible bricks, of which a page knows its own only.
            let reach = if self.is_fine { empty as f32 } else { 1.0 };
            let leaves =
                brick + Vec3::select(self.is_ascending, Vec3::splat(reach), Vec3::splat(1.0 - reach));
            let exit = ((leaves * BRICK as f32 - self.origin) * self.inv_dir).min_element();
            let j = ((exit - s0) / h).clamp(0.0, end as f32) as u32;
            if j > i {
                i += (j - i) / stride * stride;
            }
            // A step between invisible bricks that touch is invisible as well.
            let next = (i + stride).min(limit);
            if i >= end || !self.is_fine {
                break;
            }
            (brick, empty) = self.brick_at(next, least);
            if empty > 0 {
                i = next;
            }
        }
        i
    }

    /// The brick of lattice point `i`, and the distance to the nearest visible one, in bricks. It is at least one if
    /// nothing in this brick is above the key `least`.
    #[inline(always)]
    fn brick_at(&self, i: u32, least: f32) -> (Vec3, u32) {
        let p = self.origin + self.dir * (self.lattice.s0 + i as f32 * self.lattice.h);
        let brick = (p * (1.0 / BRICK as f32)).clamp(Vec3::ZERO, self.max_brick);
        let [x, y, z] = [brick.x as u32, brick.y as u32, brick.z as u32];
        let mut empty = self.occupancy.distance(x, y, z);
        if empty == 0 && least >= 0.0 && self.occupancy.is_beaten(x, y, z, least) {
            empty = 1;
        }
        (Vec3::new(x as f32, y as f32, z as f32), empty)
    }
}

/// The bins of a table with any extinction, so that two look-ups answer for a range of bins. The lower half of a word
/// counts such bins before it, the upper half up to and including it.
pub(super) struct VisibleBins(Box<[u32; TABLE_BINS]>);

impl VisibleBins {
    pub(super) fn of(table: &TransferTable) -> Self {
        let mut counts = Box::new([0; TABLE_BINS]);
        let mut before = 0;
        for (bin, count) in counts.iter_mut().enumerate() {
            let grows = table.integral[bin + 1][3] > table.integral[bin][3];
            let is_dense = table.density[bin][3] > 0.0 || table.density[bin + 1][3] > 0.0;
            let with = before + u32::from(grows || is_dense);
            *count = before | with << 16;
            before = with;
        }
        Self(counts)
    }

    /// One bit per step between the domain positions `x0` and `x1`, set where it may have any extinction.
    #[inline(always)]
    pub(super) fn between(&self, x0: &Lanes, x1: &Lanes) -> u32 {
        let (mut a, mut b) = ([0; LANES], [0; LANES]);
        for m in 0..LANES {
            a[m] = self.0[bin(x0[m])];
            b[m] = self.0[bin(x1[m])];
        }
        let mut bits = 0;
        for m in 0..LANES {
            let before = (a[m] & 0xffff).min(b[m] & 0xffff);
            let with = (a[m] >> 16).max(b[m] >> 16);
            bits |= u32::from(before != with) << m;
        }
        bits
    }
}
