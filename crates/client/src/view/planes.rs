//! The planes of the slices: which one a pane shows, where its slices lie, and how it is turned on the screen.

use std::ops::RangeInclusive;

use glam::{Quat, Vec2, Vec3};
use isinglass_core::space::Aabb;
use isinglass_core::volume::{MAX_SLICE_SIDE, SlabMode, SlicePlane, SliceSpec};
use isinglass_core::wire::VolumeDescription;
use isinglass_formats::UpAxis;

use crate::input::bindings::Side;
use crate::input::orientation::Orientation;

/// What a pane shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum PlaneChoice {
    /// A plane across an axis, seen as a standard view sees the volume.
    Standard(Side),
    /// The plane across a view, by its rotation from view to world space.
    Oblique(Quat),
}

/// A slab about a plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Slab {
    /// World units; 0: the plane alone.
    pub(crate) thickness: f32,
    pub(crate) mode: SlabMode,
}

/// A stack of parallel slices through a volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Stack {
    /// Unit vectors of world space: to the right and down on the screen, and towards the person.
    pub(crate) right: Vec3,
    pub(crate) down: Vec3,
    pub(crate) towards: Vec3,
    /// None for an oblique stack.
    axis: Option<usize>,
    /// Distance between slices, world units.
    step: f32,
    dims: [u32; 3],
    spacing: Vec3,
    bounds: Aabb,
}

impl PlaneChoice {
    /// The planes of three panes at first.
    pub(crate) const FIRST: [Self; 3] =
        [Self::Standard(Side::Top), Self::Standard(Side::Front), Self::Standard(Side::Right)];

    /// The name of the plane: of a body's plane, or of the axis that it lies across.
    pub(crate) fn name(self, orientation: &Orientation) -> &'static str {
        match (self, orientation.is_body()) {
            (Self::Oblique(_), _) => "oblique",
            (Self::Standard(Side::Top), true) => "axial",
            (Self::Standard(Side::Front), true) => "coronal",
            (Self::Standard(Side::Right), true) => "sagittal",
            (Self::Standard(side), false) => {
                let across = orientation.standard_view(side, false).0;
                ["across x", "across y", "across z"][axis_along(across)]
            }
        }
    }
}

/// How the planes lie. Those of a body stay as radiologists see them, whichever axis is up.
pub(crate) fn orientation_of_planes(letters: Option<&str>, up: UpAxis) -> Orientation {
    let own = Orientation::of(letters);
    if own.is_body() { own } else { own.with_up(up) }
}

/// The axis that a direction is nearest to.
fn axis_along(direction: Vec3) -> usize {
    direction.abs().max_position()
}

impl Stack {
    pub(crate) fn new(choice: PlaneChoice, orientation: &Orientation, volume: &VolumeDescription) -> Self {
        let (dims, spacing, bounds) = (volume.dims, Vec3::from_array(volume.spacing), volume.bounds());
        let (towards, up) = match choice {
            PlaneChoice::Standard(side) => {
                // Radiologists see a body from the feet and from its left side.
                let opposite = orientation.is_body() && side != Side::Front;
                orientation.standard_view(side, opposite)
            }
            PlaneChoice::Oblique(world_from_view) => (world_from_view * Vec3::Z, world_from_view * Vec3::Y),
        };
        let axis = match choice {
            PlaneChoice::Standard(_) => Some(axis_along(towards)),
            PlaneChoice::Oblique(_) => None,
        };
        let step = axis.map_or(spacing.min_element(), |axis| spacing[axis]);
        Self { right: up.cross(towards), down: -up, towards, axis, step, dims, spacing, bounds }
    }

    /// Half of the volume's extent along a direction, world units.
    fn half_extent(&self, direction: Vec3) -> f32 {
        direction.abs().dot(self.bounds.max)
    }

    /// Half of the stack's width and height, world units.
    pub(crate) fn half_size(&self) -> Vec2 {
        Vec2::new(self.half_extent(self.right), self.half_extent(self.down))
    }

    /// The numbers of the slices.
    pub(crate) fn range(&self) -> RangeInclusive<i32> {
        match self.axis {
            Some(axis) => 0..=self.dims[axis] as i32 - 1,
            None => {
                let last = (self.half_extent(self.towards) / self.step).floor().min(MAX_OBLIQUE) as i32;
                -last..=last
            }
        }
    }

    /// The number of the slice that a point lies in, or of the nearest.
    pub(crate) fn index_of(&self, point: Vec3) -> i32 {
        let at = match self.axis {
            Some(axis) => ((point[axis] - self.bounds.min[axis]) / self.step).floor(),
            None => (point.dot(self.towards) / self.step).round(),
        };
        (at as i32).clamp(*self.range().start(), *self.range().end())
    }

    /// A point moved along the stack into another slice.
    pub(crate) fn moved(&self, point: Vec3, index: i32) -> Vec3 {
        let index = index.clamp(*self.range().start(), *self.range().end());
        match self.axis {
            Some(axis) => {
                let mut moved = point;
                moved[axis] = self.bounds.min[axis] + (index as f32 + 0.5) * self.step;
                moved
            }
            None => point + self.towards * (index as f32 * self.step - point.dot(self.towards)),
        }
    }

    /// The request for a slice; none beyond the ends.
    pub(crate) fn spec(&self, index: i32, slab: Slab) -> Option<SliceSpec> {
        if !self.range().contains(&index) {
            return None;
        }
        let plane = match self.axis {
            Some(axis) => SlicePlane::Axis { axis: axis as u8, index: index as u32 },
            None => {
                // The grid stays when the point moves within the plane, so a kept slice serves again.
                let size = 2.0 * self.half_size();
                let pitch = self.step.max(size.max_element() / (MAX_SLICE_SIDE - 1) as f32);
                let sides = (size / pitch).ceil() + 1.0;
                let sides = sides.clamp(Vec2::ONE, Vec2::splat(MAX_SLICE_SIDE as f32));
                let (column, row) = (self.right * pitch, self.down * pitch);
                let middle = self.towards * (index as f32 * self.step);
                let origin = middle - (column * (sides.x - 1.0) + row * (sides.y - 1.0)) * 0.5;
                SlicePlane::Oblique {
                    origin: origin.into(),
                    column: column.into(),
                    row: row.into(),
                    size: [sides.x as u16, sides.y as u16],
                }
            }
        };
        let spec = SliceSpec { plane, thickness: slab.thickness, mode: slab.mode };
        // Of the plane alone, every mode shows the same.
        let spec = if slab.thickness <= self.step { SliceSpec { thickness: 0.0, ..spec } } else { spec };
        let mode = if spec.thickness == 0.0 { SlabMode::Mean } else { spec.mode };
        Some(SliceSpec { mode, ..spec })
    }

    /// What the volume's box leaves of the plane through a point: up to six corners, in order.
    pub(crate) fn outline(&self, point: Vec3) -> Vec<Vec3> {
        outline(&self.bounds, point, self.towards)
    }

    /// Distance between slices, world units.
    pub(crate) fn step(&self) -> f32 {
        self.step
    }

    /// The nearest point of the volume.
    pub(crate) fn nearest(&self, point: Vec3) -> Vec3 {
        point.clamp(self.bounds.min, self.bounds.max)
    }

    /// A point, if it lies in the volume but for rounding.
    pub(crate) fn inside(&self, point: Vec3) -> Option<Vec3> {
        let nearest = self.nearest(point);
        (nearest.distance(point) <= self.spacing.min_element() * 1e-2).then_some(nearest)
    }

    /// The volume's size in voxels, and their size.
    pub(crate) fn voxels(&self) -> ([u32; 3], Vec3) {
        (self.dims, self.spacing)
    }
}

/// The corners of the plane through `point` with this unit normal inside a box, in order around the normal.
fn outline(bounds: &Aabb, point: Vec3, normal: Vec3) -> Vec<Vec3> {
    let corners = bounds.corners();
    let distance = corners.map(|corner| (corner - point).dot(normal));
    let mut found: Vec<Vec3> = Vec::with_capacity(6);
    for a in 0..8usize {
        for b in (0..3).map(|axis| a | 1 << axis).filter(|b| *b != a) {
            let (da, db) = (distance[a], distance[b]);
            if (da < 0.0) != (db < 0.0) {
                found.push(corners[a] + (corners[b] - corners[a]) * (da / (da - db)));
            }
        }
    }
    let Some(middle) = (!found.is_empty()).then(|| found.iter().sum::<Vec3>() / found.len() as f32) else {
        return found;
    };
    let (u, v) = normal.any_orthonormal_pair();
    let angle = |p: &Vec3| (*p - middle).dot(v).atan2((*p - middle).dot(u));
    found.sort_by(|a, b| angle(a).total_cmp(&angle(b)));
    found
}

/// Most slices of an oblique stack on a side of the middle.
const MAX_OBLIQUE: f32 = 1e5;

#[cfg(test)]
mod tests {
    use super::*;

    fn volume(orientation: Option<&str>) -> VolumeDescription {
        VolumeDescription {
            name: "v".into(),
            dims: [10, 20, 30],
            spacing: [1.0, 0.5, 2.0],
            unit: None,
            orientation: orientation.map(Into::into),
            placement: None,
            value_unit: None,
            value_range: (0.0, 1.0),
            histogram_range: (0.0, 1.0),
            histogram: vec![1],
            channels: vec![],
        }
    }

    fn stack(choice: PlaneChoice, letters: Option<&str>) -> Stack {
        Stack::new(choice, &Orientation::of(letters), &volume(letters))
    }

    #[test]
    fn a_body_is_seen_as_radiologists_see_it() {
        let seen = |side| {
            let s = stack(PlaneChoice::Standard(side), Some("RAS"));
            (s.right, s.down)
        };
        assert_eq!(seen(Side::Top), (Vec3::NEG_X, Vec3::NEG_Y), "left to the right, posterior below");
        assert_eq!(seen(Side::Front), (Vec3::NEG_X, Vec3::NEG_Z), "left to the right, inferior below");
        assert_eq!(seen(Side::Right), (Vec3::NEG_Y, Vec3::NEG_Z), "posterior to the right");
        let plain = stack(PlaneChoice::Standard(Side::Front), None);
        assert_eq!((plain.right, plain.down), (Vec3::X, Vec3::NEG_Y));
    }

    #[test]
    fn another_axis_up_turns_no_plane_of_a_body_and_planes_are_named_by_their_axis() {
        let sides = [Side::Top, Side::Front, Side::Right].map(PlaneChoice::Standard);
        let body = Orientation::of(Some("RAS"));
        assert_ne!(body.clone().with_up(UpAxis::X), body, "control");
        for up in UpAxis::ALL {
            assert_eq!(orientation_of_planes(Some("RAS"), up), body);
        }
        assert_eq!(sides.map(|side| side.name(&body)), ["axial", "coronal", "sagittal"]);
        let plain = orientation_of_planes(None, UpAxis::Own);
        assert_eq!(sides.map(|side| side.name(&plain)), ["across y", "across z", "across x"]);
        let z_up = orientation_of_planes(None, UpAxis::Z);
        assert_eq!(sides.map(|side| side.name(&z_up)), ["across z", "across y", "across x"]);
        for side in sides {
            let stack = Stack::new(side, &z_up, &volume(None));
            assert_eq!(stack.axis, Some(axis_along(stack.towards)));
            assert!(side.name(&z_up).ends_with(['x', 'y', 'z'][axis_along(stack.towards)]));
        }
    }

    #[test]
    fn slices_are_numbered_by_voxels_and_points_move_to_their_middles() {
        let s = stack(PlaneChoice::Standard(Side::Front), None);
        assert_eq!(s.range(), 0..=29);
        assert_eq!(
            [-100.0, -30.0, -27.9, 0.1, 29.9, 99.0].map(|z| s.index_of(Vec3::Z * z)),
            [0, 0, 1, 15, 29, 29]
        );
        assert_eq!(s.moved(Vec3::new(1.0, 2.0, 0.0), 0), Vec3::new(1.0, 2.0, -29.0));
        for index in s.range() {
            assert_eq!(s.index_of(s.moved(Vec3::ONE, index)), index);
        }
        assert!(s.spec(30, Slab::default()).is_none() && s.spec(-1, Slab::default()).is_none());
        let spec = s.spec(7, Slab { thickness: 1.0, mode: SlabMode::Max }).unwrap();
        assert_eq!(spec, s.spec(7, Slab::default()).unwrap(), "less than a voxel is the plane alone");
        assert_ne!(spec, s.spec(7, Slab { thickness: 5.0, mode: SlabMode::Max }).unwrap());
    }

    #[test]
    fn an_oblique_stack_covers_the_volume_and_its_grid_lies_in_its_planes() {
        let turn = Quat::from_euler(glam::EulerRot::YXZ, 0.6, -0.4, 0.2);
        let s = stack(PlaneChoice::Oblique(turn), None);
        for index in s.range() {
            let middle = s.moved(Vec3::ZERO, index);
            assert_eq!(s.index_of(middle), index);
            let spec = s.spec(index, Slab::default()).unwrap();
            assert!(spec.is_valid());
            let (dims, spacing) = s.voxels();
            let grid = spec.grid(dims, spacing);
            for corner in s.outline(middle) {
                assert!(((corner - middle).dot(s.towards)).abs() < 1e-3);
                let [column, row] = grid.place(corner);
                assert!((-0.6..grid.size[0] as f32).contains(&column), "{column} of {}", grid.size[0]);
                assert!((-0.6..grid.size[1] as f32).contains(&row), "{row} of {}", grid.size[1]);
            }
        }
        // The point may lie anywhere in the plane.
        let aside = s.moved(Vec3::new(3.0, -2.0, 11.0), 4);
        assert_eq!(s.spec(s.index_of(aside), Slab::default()), s.spec(4, Slab::default()));
    }

    #[test]
    fn the_outline_is_what_the_box_leaves() {
        let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        assert_eq!(outline(&bounds, Vec3::ZERO, Vec3::Z).len(), 4);
        let six = outline(&bounds, Vec3::ZERO, Vec3::ONE.normalize());
        assert_eq!(six.len(), 6);
        for (a, b) in six.iter().zip(six.iter().cycle().skip(1)) {
            assert!((a.distance(*b) - 2f32.sqrt()).abs() < 1e-5, "a regular hexagon in order");
        }
        assert!(outline(&bounds, Vec3::Z * 1.5, Vec3::Z).is_empty());
    }
}
