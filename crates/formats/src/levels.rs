//! How the levels of a pyramid lie in the finest one.

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::volume::{Finest, Histogram, Volume};

use crate::axes::Grid;
use crate::selection::Region;

/// A level in the finest one, along the axes of the file.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct LevelGrid {
    /// Voxels of the finest level.
    pub(crate) finest_dims: [u64; 3],
    /// Voxels of the finest level from one voxel to the next.
    pub(crate) step: [f64; 3],
    /// The finest level's index of the first voxel.
    pub(crate) first: [f64; 3],
}

/// The selected part of a level in the finest one, along the axes of the volume.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct InFinest {
    /// What the volume takes from the finest level. Range and histogram are not known yet.
    pub(crate) finest: Finest,
    /// The same part of the finest level; `None` if that is the whole.
    pub(crate) region: Option<Region>,
}

/// The numbers of a channel of the finest level.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct KnownNumbers {
    /// Least and greatest stored number.
    pub(crate) stored_range: (f32, f32),
    pub(crate) histogram: Arc<Histogram>,
}

impl LevelGrid {
    /// The finest level itself.
    pub(crate) fn finest(finest_dims: [u64; 3]) -> Self {
        Self { finest_dims, step: [1.0; 3], first: [0.0; 3] }
    }

    /// Whether a level of `dims` voxels covers the box of the finest one, up to one of its voxels.
    pub(crate) fn is_alike(&self, dims: [u64; 3]) -> bool {
        (0..3).all(|i| {
            let (step, first) = (self.step[i], self.first[i]);
            let last = first + step * (dims[i] as f64 - 0.5);
            let is_near = |a: f64, b: f64| (a - b).abs() <= step + 0.01;
            step.is_finite()
                && step >= 1.0 - 1e-3
                && is_near(first - 0.5 * step, -0.5)
                && is_near(last, self.finest_dims[i] as f64 - 0.5)
        })
    }

    /// The part of the level that is read, in the finest level. The grid's place becomes that of the finest level. `flip`
    /// are the axes that are mirrored against the file.
    pub(crate) fn place(&self, grid: &mut Grid, flip: [bool; 3]) -> InFinest {
        let (mut dims, mut spacing, mut first) = ([1; 3], Vec3::ONE, Vec3::ZERO);
        let mut region = Region { min: [0; 3], max: [None; 3] };
        let small = |n: u64| u32::try_from(n).unwrap_or(u32::MAX);
        for (k, (axis, is_reversed)) in grid.order.into_iter().enumerate() {
            let (range, thin, whole) = (&grid.ranges[axis], grid.thin[axis], self.finest_dims[axis]);
            let start = (self.step[axis] * range.start as f64).round() as u64;
            let start = start.min(whole - 1);
            let end = match range.end == grid.file_dims[axis] {
                true => whole,
                false => ((self.step[axis] * range.end as f64).round() as u64).clamp(start + 1, whole),
            };
            let count = (range.end - range.start).div_ceil(thin);
            let step = self.step[axis] * thin as f64;
            let mut at = self.first[axis] + self.step[axis] * range.start as f64 - start as f64;
            let (mut from, mut to) = (start, end);
            if is_reversed {
                at = (end - start) as f64 - 1.0 - (at + step * (count as f64 - 1.0));
                (from, to) = (whole - end, whole - start);
            }
            dims[k] = small(end - start);
            spacing[k] = (f64::from(grid.spacing[k]) / step) as f32;
            first[k] = at as f32;
            region.min[k] = small(from);
            region.max[k] = (to < whole).then_some(small(to));
            // The world's origin is the middle of the finest level's box.
            let shift = ((end - start) as f64 - 1.0) / 2.0 - at - step * (count as f64 - 1.0) / 2.0;
            if let Some(place) = &mut grid.placement {
                // A mirrored volume stays in its place, so its parts change theirs.
                let shift = if flip[k] { -shift } else { shift };
                let length = shift / step * f64::from(grid.spacing[k]);
                place.center = [0, 1, 2].map(|i| place.center[i] + place.axes[k][i] * length);
            }
        }
        let is_whole = region == Region { min: [0; 3], max: [None; 3] };
        let finest = Finest { dims, spacing, first, stored_range: None, histogram: None };
        InFinest { finest, region: (!is_whole).then_some(region) }
    }
}

impl InFinest {
    /// What a channel takes from the finest level, with its numbers if they are known.
    pub(crate) fn of_channel(&self, known: Option<&KnownNumbers>) -> Finest {
        Finest {
            stored_range: known.map(|k| k.stored_range),
            histogram: known.map(|k| Arc::clone(&k.histogram)),
            ..self.finest.clone()
        }
    }
}

impl KnownNumbers {
    /// Those of a volume that is the finest level.
    pub(crate) fn of(volume: &Volume) -> Self {
        Self { stored_range: volume.stored_range(), histogram: Arc::new(Histogram::of(volume)) }
    }
}
