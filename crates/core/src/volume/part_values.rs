//! Values at points of a volume of which each of several processes has a part. One asks all of them for the points that a
//! question needs ([`AskedPoints`]). It answers the question from what they found ([`FoundPoints`]).

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::grid::Volume;
use super::page_values::{FoundVoxel, ValuesAt, finest_voxel};
use super::world::VoxelBox;

impl ValuesAt for &Volume {
    fn voxel(&mut self, point: Vec3) -> Option<FoundVoxel> {
        PartValues { volume: self, own: self.held() }.voxel(point)
    }

    fn between(&mut self, point: Vec3) -> Option<f32> {
        self.value_between(point)
    }
}

/// The values of the voxels in a box of the whole volume.
#[derive(Clone, Copy, Debug)]
pub struct PartValues<'a> {
    /// The volume, or a part of it with the box.
    pub volume: &'a Volume,
    /// The box.
    pub own: VoxelBox,
}

impl ValuesAt for PartValues<'_> {
    fn voxel(&mut self, point: Vec3) -> Option<FoundVoxel> {
        let Self { volume, own } = *self;
        let bounds = volume.bounds();
        if !(point.cmpge(bounds.min).all() && point.cmple(bounds.max).all()) {
            return None;
        }
        let at = point / volume.spacing() + volume.voxel_origin();
        let dims = volume.whole_dims();
        let here: [u32; 3] = std::array::from_fn(|i| (at[i].max(0.0) as u32).min(dims[i] - 1));
        if !own.contains(here) {
            return None;
        }
        let index = if volume.finest().is_some() { finest_voxel(volume, point) } else { here };
        let value = volume.value_from_stored(volume.stored_in_world(here));
        Some(FoundVoxel { index, value, level: 0 })
    }

    fn between(&mut self, point: Vec3) -> Option<f32> {
        self.volume.value_between_in(&self.own, point)
    }
}

/// A point that a question needs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AskedPoint {
    /// The point, world space.
    pub point: [f32; 3],
    /// Whether the value between voxels is asked; otherwise the voxel that holds the point.
    pub is_between: bool,
}

/// What was found at a point: a voxel, or a value between voxels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FoundPoint {
    /// The voxel of the finest level; 0 for a value between voxels.
    pub index: [u32; 3],
    /// The value.
    pub value: f32,
    /// The level that the value is of.
    pub level: u8,
}

/// Notes the points that are asked for. All of them have nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AskedPoints(pub Vec<AskedPoint>);

impl AskedPoints {
    /// What some values have at the points.
    pub fn found_in(&self, values: &mut dyn ValuesAt) -> Vec<Option<FoundPoint>> {
        let mut find = |AskedPoint { point, is_between }: &AskedPoint| {
            let point = Vec3::from_array(*point);
            match is_between {
                true => values.between(point).map(|value| FoundPoint { index: [0; 3], value, level: 0 }),
                false => {
                    let found = values.voxel(point);
                    found.map(|FoundVoxel { index, value, level }| FoundPoint { index, value, level })
                }
            }
        };
        self.0.iter().map(&mut find).collect()
    }
}

impl ValuesAt for AskedPoints {
    fn voxel(&mut self, point: Vec3) -> Option<FoundVoxel> {
        self.0.push(AskedPoint { point: point.to_array(), is_between: false });
        None
    }

    fn between(&mut self, point: Vec3) -> Option<f32> {
        self.0.push(AskedPoint { point: point.to_array(), is_between: true });
        None
    }
}

/// What was found at the points, in the order in which they were asked for.
#[derive(Clone, Debug)]
pub struct FoundPoints(std::vec::IntoIter<Option<FoundPoint>>);

impl FoundPoints {
    /// The first thing that any part has found at each of `num` points.
    pub fn of_parts(num: usize, parts: impl IntoIterator<Item = Vec<Option<FoundPoint>>>) -> Self {
        let mut all = vec![None; num];
        for part in parts {
            all.iter_mut().zip(part).for_each(|(all, found)| *all = all.or(found));
        }
        Self(all.into_iter())
    }
}

impl ValuesAt for FoundPoints {
    fn voxel(&mut self, _: Vec3) -> Option<FoundVoxel> {
        let found = self.0.next().flatten();
        found.map(|FoundPoint { index, value, level }| FoundVoxel { index, value, level })
    }

    fn between(&mut self, _: Vec3) -> Option<f32> {
        self.0.next().flatten().map(|found| found.value)
    }
}
