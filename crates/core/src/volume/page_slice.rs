//! Slices of a volume that is read by pages. With all pages of the finest level they are those of the volume in memory.

use std::ops::Range;
use std::sync::atomic::{AtomicU8, Ordering};

use glam::Vec3;
use rayon::prelude::*;

use super::page_values::{PageCursor, PageValues, SLACK};
use super::pyramid::PAGE_CELLS;
use super::slice::{
    MAX_LAYERS, MAX_SLICE_SIDE, SlabMode, Slice, SliceCoding, SliceGrid, SlicePlane, SliceSpec, across,
};
use super::slice_sums::SlabAdder;
use crate::cancel::Wanted;

/// The layers of a slab, over indices of the finest level.
enum Layers {
    Axis { axis: usize, slab: Range<usize>, every: [u32; 2] },
    Oblique { grid: SliceGrid, num: usize, normal: Vec3, thickness: f32 },
}

impl Layers {
    fn of(values: &PageValues<'_>, spec: &SliceSpec, grid: SliceGrid) -> Self {
        let base = values.base();
        let (dims, spacing) = (base.finest_dims(), base.finest_spacing());
        match spec.plane {
            SlicePlane::Axis { axis, index } => {
                let axis = usize::from(axis.min(2));
                let slab = spec.slab(index, dims[axis], spacing[axis]);
                let every = across(axis).map(|i| dims[i].div_ceil(MAX_SLICE_SIDE));
                Self::Axis { axis, slab, every }
            }
            SlicePlane::Oblique { .. } => {
                // A thicker slab has no more of the volume.
                let thickness = spec.thickness.min(2.0 * base.bounds().radius());
                let num = (thickness / spacing.min_element()).round().clamp(1.0, MAX_LAYERS) as usize;
                let normal = grid.column.cross(grid.row).normalize_or_zero();
                Self::Oblique { grid, num, normal, thickness }
            }
        }
    }

    fn num(&self) -> usize {
        match self {
            Self::Axis { slab, .. } => slab.len(),
            Self::Oblique { num, .. } => *num,
        }
    }

    /// The index of the finest level at a column and row of layer `n`; none outside the volume.
    fn index(&self, cursor: &PageCursor<'_>, spacing: Vec3, [x, y]: [u32; 2], n: usize) -> Option<Vec3> {
        match self {
            Self::Axis { axis, slab, every } => {
                let [a, b] = across(*axis);
                let mut index = Vec3::ZERO;
                index[*axis] = (slab.start + n) as f32;
                (index[a], index[b]) = ((x * every[0]) as f32, (y * every[1]) as f32);
                Some(index)
            }
            Self::Oblique { grid, num, normal, thickness } => {
                let aside = ((n as f32 + 0.5) / *num as f32 - 0.5) * thickness;
                let point = grid.point(x as f32, y as f32) + *normal * aside;
                cursor.index_of(point, spacing * SLACK)
            }
        }
    }
}

impl Slice {
    /// Makes a slice of pages, and says the coarsest level that it has values of; `None` if nobody waits for it any more.
    /// It is as [`Slice::of`] the finest level, where that is known or can be read.
    pub fn of_pages(values: &PageValues<'_>, spec: &SliceSpec, wanted: Wanted<'_>) -> Option<(Self, u8)> {
        let base = values.base();
        let spacing = base.finest_spacing();
        let grid = spec.grid(base.finest_dims(), spacing);
        let layers = Layers::of(values, spec, grid);
        let [width, height] = grid.size;
        let mut stored = vec![0.0; width as usize * height as usize];
        let coarsest = AtomicU8::new(0);
        // The points of a tile lie in few pages.
        let step = (grid.column / spacing).abs().max((grid.row / spacing).abs()).max_element();
        let side = (PAGE_CELLS as f32 / step).clamp(1.0, PAGE_CELLS as f32) as u32;
        let bands = stored.par_chunks_mut(width as usize * side as usize).enumerate();
        bands.for_each(|(i, band)| {
            let mut cursor = values.cursor();
            let rows = i as u32 * side..(i as u32 * side + side).min(height);
            for first in (0..width).step_by(side as usize) {
                if !wanted() {
                    return;
                }
                let columns = first..(first + side).min(width);
                let mut tile = Tile { band: &mut *band, width: width as usize, columns, rows: rows.clone() };
                tile.fill(&layers, &mut cursor, values, spec.mode);
            }
            coarsest.fetch_max(cursor.coarsest(), Ordering::Relaxed);
        });
        if !wanted() {
            return None;
        }
        // Finer pages may have numbers that a coarser level has not.
        let (lo, hi) = base.stored_range();
        let range = stored.iter().fold((lo, hi), |(lo, hi), v| (lo.min(*v as f32), hi.max(*v as f32)));
        let slice = SliceCoding::of(base, spec, range).slice(base, grid.size, &stored);
        Some((slice, coarsest.into_inner()))
    }
}

/// Some columns of some rows of a slice.
struct Tile<'a> {
    /// The numbers of the rows, of `width` columns each.
    band: &'a mut [f64],
    width: usize,
    columns: Range<u32>,
    rows: Range<u32>,
}

impl Tile<'_> {
    fn fill(
        &mut self,
        layers: &Layers,
        cursor: &mut PageCursor<'_>,
        values: &PageValues<'_>,
        mode: SlabMode,
    ) {
        let spacing = values.base().finest_spacing();
        let adder = SlabAdder::of(values.base(), mode);
        let mut nums = vec![0u32; self.columns.len() * self.rows.len()];
        for n in 0..layers.num() {
            let mut nums = nums.iter_mut();
            for y in self.rows.clone() {
                let row = (y - self.rows.start) as usize * self.width;
                for (x, num) in self.columns.clone().zip(&mut nums) {
                    let Some(index) = layers.index(cursor, spacing, [x, y], n) else { continue };
                    adder.add(&mut self.band[row + x as usize], num, cursor.stored(index));
                }
            }
        }
        let least = f64::from(values.base().stored_range().0);
        let mut nums = nums.into_iter();
        for y in 0..self.rows.len() {
            for x in self.columns.clone() {
                let value = &mut self.band[y * self.width + x as usize];
                *value = mode.ended(*value, nums.next().unwrap_or(0)).unwrap_or(least);
            }
        }
    }
}
