//! This module turns the axes of a file into the three axes of a volume. They point right, to the front and up where
//! the file describes a body. Otherwise they run along +x, +y and +z of its space. So nothing appears mirrored or on
//! its side.
//!
//! World space has the volume's own axes. A rotation that is not a multiple of 90° is not shown. It is reported, and
//! [`Placement`] keeps it.

use std::ops::Range;

use glam::{DVec3, Vec3};
use isinglass_core::space::IMAGE_AXES;
use isinglass_core::volume::{Placement, Voxels};

use crate::selection::Region;
use crate::warning::{Warning, WarningKind};

/// How the three axes of a file lie in its world. The world of a body is RAS+: right, front and top.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Geometry {
    /// Step of one voxel along each axis.
    pub(crate) steps: [DVec3; 3],
    /// Centre of the first voxel, if known.
    pub(crate) origin: Option<DVec3>,
    /// What the world is of.
    pub(crate) world: World,
    /// Unit of length, if known.
    pub(crate) unit: Option<String>,
}

impl Geometry {
    /// Axes that run along x, y and z of a space without a body.
    pub(crate) fn along_axes(spacing: [f64; 3], unit: Option<String>) -> Self {
        let steps = std::array::from_fn(|i| DVec3::AXES[i] * spacing[i]);
        Self { steps, origin: None, world: World::Space, unit }
    }

    /// The axes of an image: columns, rows and slices.
    pub(crate) fn of_image(spacing: [f64; 3], unit: Option<String>) -> Self {
        Self { world: World::Image, ..Self::along_axes(spacing, unit) }
    }

    /// The same mirrored along some of the volume's axes, about its middle. The file has so many voxels along its own.
    pub(crate) fn flipped(&self, flip: [bool; 3], file_dims: [u64; 3]) -> Result<Self, String> {
        let mut flipped = self.clone();
        if flip == [false; 3] {
            return Ok(flipped);
        }
        for ((axis, _), _) in order(self.steps)?.into_iter().zip(flip).filter(|(_, is_flipped)| *is_flipped) {
            let step = self.steps[axis];
            // What was the last voxel is the first.
            flipped.origin = flipped.origin.map(|p| p + step * (file_dims[axis] as f64 - 1.0));
            flipped.steps[axis] = -step;
        }
        Ok(flipped)
    }

    /// The same directions with these distances along x, y and z of the volume.
    pub(crate) fn with_spacing(&self, spacing: Vec3) -> Result<Self, String> {
        let mut geometry = self.clone();
        // A step without length has no direction, and is taken as along its own axis.
        let has_length = |v: DVec3| v.length().is_finite() && v.length() > 0.0;
        geometry.steps =
            std::array::from_fn(|i| if has_length(self.steps[i]) { self.steps[i] } else { DVec3::AXES[i] });
        let steps = geometry.steps;
        for (k, (axis, _)) in order(steps)?.into_iter().enumerate() {
            geometry.steps[axis] = steps[axis].normalize() * f64::from(spacing[k]);
        }
        Ok(geometry)
    }
}

/// What a world is of. It decides which side is seen from the front.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum World {
    /// A body, in RAS+.
    Body,
    /// An image: x to the right, y down, z back from the viewer.
    Image,
    /// Anything else: x to the right, y up, z towards the viewer.
    Space,
}

impl World {
    /// The letters of its axes.
    fn letters(self) -> Option<&'static str> {
        match self {
            Self::Body => Some("RAS"),
            Self::Image => Some(IMAGE_AXES),
            Self::Space => None,
        }
    }
}

/// Converts between LPS, the frame of DICOM and ITK, and RAS.
pub(crate) fn ras_from_lps(v: DVec3) -> DVec3 {
    DVec3::new(-v.x, -v.y, v.z)
}

/// The grid of a volume, and the order in which its file has the voxels.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Grid {
    /// Voxels along the axes of the file.
    pub(crate) file_dims: [u64; 3],
    /// The part that is read along each axis of the file.
    pub(crate) ranges: [Range<u64>; 3],
    /// One voxel in so many is read along each axis of the file.
    pub(crate) thin: [u64; 3],
    /// Which axis of the file becomes x, y and z, and whether it is reversed.
    pub(crate) order: [(usize, bool); 3],
    /// Distances along x, y and z.
    pub(crate) spacing: Vec3,
    pub(crate) orientation: Option<String>,
    is_body: bool,
    pub(crate) placement: Option<Placement>,
    pub(crate) warnings: Vec<Warning>,
}

impl Grid {
    /// The grid of `region`, or of the whole file, which has `file_dims` voxels along its axes. One voxel in `thin` is
    /// read along each axis, or fewer where a side would still have more than `max`. The error says what is wrong.
    pub(crate) fn arrange(
        file_dims: [u64; 3],
        geometry: &Geometry,
        region: Option<&Region>,
        thin: u32,
        max: u64,
    ) -> Result<Self, String> {
        let thin = |length: u64| u64::from(thin.max(1)).max(length.div_ceil(max));
        Self::with_steps(file_dims, geometry, region, max, thin)
    }

    /// The same with all voxels, also where a side has more than a volume may have in memory.
    pub(crate) fn whole(
        file_dims: [u64; 3],
        geometry: &Geometry,
        region: Option<&Region>,
    ) -> Result<Self, String> {
        Self::with_steps(file_dims, geometry, region, u64::MAX / MAX_THIN, |_| 1)
    }

    /// The grid with one voxel in `thin` of the length of each axis, for sides of at most `max`.
    fn with_steps(
        file_dims: [u64; 3],
        geometry: &Geometry,
        region: Option<&Region>,
        max: u64,
        thin: impl Fn(u64) -> u64,
    ) -> Result<Self, String> {
        let steps = geometry.steps;
        if !steps.iter().all(|v| v.length().is_finite() && v.length() > 0.0) {
            let [x, y, z] = steps.map(DVec3::length);
            return Err(format!(
                "the distances of voxels along its axes are {x}, {y} and {z}, expected finite numbers above zero; --spacing replaces them"
            ));
        }
        let order = order(steps)?;
        let ranges = ranges(file_dims, order, region)?;
        let length = |axis: usize| ranges[axis].end - ranges[axis].start;
        let most = max * MAX_THIN;
        if let Some(axis) = (0..3).find(|&axis| !(1..=most).contains(&length(axis))) {
            let advice =
                if region.is_none() && length(axis) > most { "; a region can be taken of it" } else { "" };
            return Err(format!("axis {axis} has {} voxels, expected 1 to {most}{advice}", length(axis)));
        }
        let thin = [0, 1, 2].map(|axis| thin(length(axis)));
        let axes =
            order.map(|(axis, is_reversed)| steps[axis].normalize() * if is_reversed { -1.0 } else { 1.0 });
        let placement = geometry.origin.map(|origin| {
            let middle = |i: usize| {
                let last = ranges[i].start + (length(i) - 1) / thin[i] * thin[i];
                (ranges[i].start + last) as f64 / 2.0
            };
            let center = (0..3).fold(origin, |p, i| p + steps[i] * middle(i));
            Placement { center: center.to_array(), axes: axes.map(|a| a.to_array()) }
        });
        let is_body = geometry.world == World::Body;
        let mut warnings = warnings(order, axes, is_body);
        if thin != [1; 3] {
            let [x, y, z] = order.map(|(axis, _)| thin[axis]);
            let long = (0..3).map(length).max().filter(|n| *n > max);
            let why =
                long.map_or(String::new(), |n| format!(", as a side has {n} and {max} are shown at most"));
            let text = format!("one voxel in {x}×{y}×{z} is read{why}; --region reads all voxels of a part");
            warnings.push(Warning::new(WarningKind::Choice, text));
        }
        Ok(Self {
            file_dims,
            ranges,
            order,
            spacing: Vec3::from_array(
                order.map(|(axis, _)| (steps[axis].length() * thin[axis] as f64) as f32),
            ),
            thin,
            orientation: geometry.world.letters().map(str::to_owned),
            is_body,
            placement: placement.filter(|p| p.center.iter().all(|c| c.is_finite())),
            warnings,
        })
    }

    /// Dimensions after reordering.
    pub(crate) fn dims(&self) -> [u32; 3] {
        self.order.map(|(axis, _)| self.read_dims()[axis] as u32)
    }

    /// Voxels that are read along each axis of the file.
    fn read_dims(&self) -> [usize; 3] {
        [0, 1, 2].map(|i| (self.ranges[i].end - self.ranges[i].start).div_ceil(self.thin[i]) as usize)
    }

    /// The part of the grid from voxel `min` to the one before `max` along x, y and z, none of them thinned.
    pub(crate) fn part(&self, min: [u64; 3], max: [u64; 3]) -> Self {
        let mut part = self.clone();
        for (k, (axis, is_reversed)) in self.order.into_iter().enumerate() {
            let (start, thin, count) = (self.ranges[axis].start, self.thin[axis], u64::from(self.dims()[k]));
            let (first, last) =
                if is_reversed { (count - max[k], count - 1 - min[k]) } else { (min[k], max[k] - 1) };
            part.ranges[axis] = start + first * thin..start + last * thin + 1;
        }
        part
    }

    /// One voxel in `steps` of the grid along x, y and z, from the first on.
    pub(crate) fn thinned(&self, steps: [u32; 3]) -> Self {
        let mut thinned = self.clone();
        for (k, (axis, is_reversed)) in self.order.into_iter().enumerate() {
            let range = &mut thinned.ranges[axis];
            let step = self.thin[axis] * u64::from(steps[k]);
            if is_reversed {
                // The first voxel of the volume is the last of the file.
                range.start += (range.end - 1 - range.start) % step;
            }
            thinned.thin[axis] = step;
            thinned.spacing[k] *= steps[k] as f32;
        }
        thinned
    }

    /// The grid of a coarser level, whose file has its axes as the volume has them: `dims` voxels, each of so many.
    pub(crate) fn coarser(&self, dims: [u32; 3], factors: [u32; 3]) -> Self {
        Self {
            file_dims: dims.map(u64::from),
            ranges: dims.map(|n| 0..u64::from(n)),
            thin: [1; 3],
            order: FILE_ORDER,
            spacing: self.spacing * Vec3::from_array(factors.map(|n| n as f32)),
            warnings: Vec::new(),
            ..self.clone()
        }
    }

    /// Dimensions of the whole file after reordering.
    pub(crate) fn whole_dims(&self) -> [u64; 3] {
        self.order.map(|(axis, _)| self.file_dims[axis])
    }

    /// Where the axes of the file point, such as `LPS` or `+x-y+z`.
    pub(crate) fn file_axes(&self) -> String {
        file_axes(self.order, self.is_body)
    }

    /// Whether reordering needs a second copy of the voxels.
    pub(crate) fn is_permuted(&self) -> bool {
        self.order.map(|o| o.0) != FILE_ORDER.map(|o| o.0)
    }

    /// The voxels in the order of the volume.
    pub(crate) fn reorder(&self, voxels: Voxels) -> Voxels {
        match voxels {
            Voxels::U8(v) => Voxels::U8(self.reorder_vec(v)),
            Voxels::U16(v) => Voxels::U16(self.reorder_vec(v)),
            Voxels::F32(v) => Voxels::F32(self.reorder_vec(v)),
        }
    }

    /// Numbers of `size` bytes in the order of the volume.
    pub(crate) fn reorder_numbers(&self, bytes: Vec<u8>, size: usize) -> Vec<u8> {
        if self.order == FILE_ORDER {
            return bytes;
        }
        match size {
            1 => self.reorder_vec(bytes),
            2 => self.reorder_vec(bytes.as_chunks::<2>().0.to_vec()).into_flattened(),
            4 => self.reorder_vec(bytes.as_chunks::<4>().0.to_vec()).into_flattened(),
            _ => self.reorder_vec(bytes.as_chunks::<8>().0.to_vec()).into_flattened(),
        }
    }

    fn reorder_vec<T: Copy>(&self, mut voxels: Vec<T>) -> Vec<T> {
        let [nx, ny, nz] = self.dims().map(|d| d as usize);
        if self.is_permuted() {
            let file = self.read_dims();
            let file_strides = [1, file[0], file[0] * file[1]];
            let strides = self.order.map(|(axis, _)| file_strides[axis]);
            voxels = (0..nz)
                .flat_map(|z| (0..ny).map(move |y| y * strides[1] + z * strides[2]))
                .flat_map(|start| (0..nx).map(move |x| start + x * strides[0]))
                .map(|i| voxels[i])
                .collect();
        }
        let [flip_x, flip_y, flip_z] = self.order.map(|o| o.1);
        if flip_x {
            voxels.chunks_exact_mut(nx).for_each(<[T]>::reverse);
        }
        if flip_y {
            voxels.chunks_exact_mut(nx * ny).for_each(|slice| reverse_blocks(slice, nx));
        }
        if flip_z {
            reverse_blocks(&mut voxels, nx * ny);
        }
        voxels
    }
}

/// The part that is read along each axis of the file.
fn ranges(
    file_dims: [u64; 3],
    order: [(usize, bool); 3],
    region: Option<&Region>,
) -> Result<[Range<u64>; 3], String> {
    let mut ranges = file_dims.map(|n| 0..n);
    let Some(region) = region else { return Ok(ranges) };
    for (k, (axis, is_reversed)) in order.into_iter().enumerate() {
        let n = file_dims[axis];
        let (from, to) = (u64::from(region.min[k]), region.max[k].map_or(n, u64::from));
        if from >= to || to > n {
            let name = ["x", "y", "z"][k];
            return Err(format!("region {from}:{to} along {name}, expected a part of 0:{n}"));
        }
        ranges[axis] = if is_reversed { n - to..n - from } else { from..to };
    }
    Ok(ranges)
}

fn file_axes(order: [(usize, bool); 3], is_body: bool) -> String {
    let letters = if is_body { BODY_LETTERS } else { SPACE_LETTERS };
    let letter = |axis: usize| {
        let target = order.iter().position(|o| o.0 == axis).unwrap_or(axis);
        letters[target][usize::from(order[target].1)]
    };
    (0..3).map(letter).collect()
}

/// Warnings about what the grid cannot show. `axes` are the unit vectors along x, y and z.
fn warnings(order: [(usize, bool); 3], axes: [DVec3; 3], is_body: bool) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let mut warn = |text: String| warnings.push(Warning::new(WarningKind::Geometry, text));
    if order != FILE_ORDER {
        let (from, to) = (file_axes(order, is_body), file_axes(FILE_ORDER, is_body));
        warn(format!("the axes of the file point to {from}; the voxels were reordered to {to}"));
    }
    let tilt = axes.iter().zip(DVec3::AXES).map(|(a, e)| a.dot(e).clamp(-1.0, 1.0).acos().to_degrees());
    let tilt = tilt.fold(0.0, f64::max);
    if tilt > MAX_TILT_DEG {
        warn(format!("the axes are rotated by up to {tilt:.1}° from their space, which is not shown"));
    }
    let [x, y, z] = axes;
    let shear = [x.dot(y), y.dot(z), z.dot(x)].map(f64::abs).into_iter().fold(0.0, f64::max);
    let shear = shear.min(1.0).asin().to_degrees();
    if shear > MAX_TILT_DEG {
        warn(format!("the axes are {shear:.1}° away from right angles, which is not shown"));
    }
    warnings
}

/// Reverses the order of the blocks of `n` elements. The order within a block stays.
fn reverse_blocks<T>(list: &mut [T], n: usize) {
    let num_blocks = list.len() / n;
    for i in 0..num_blocks / 2 {
        let (head, tail) = list.split_at_mut((num_blocks - 1 - i) * n);
        head[i * n..(i + 1) * n].swap_with_slice(&mut tail[..n]);
    }
}

/// For x, y and z, the axis of the file that is nearest to it in either direction. Of the six assignments, the one
/// with the largest sum of cosines wins.
fn order(steps: [DVec3; 3]) -> Result<[(usize, bool); 3], String> {
    let units = steps.map(DVec3::normalize);
    let volume = units[0].dot(units[1].cross(units[2])).abs();
    // The square of a length can overflow, and the unit vector is then not a number.
    if volume.is_nan() || volume < MIN_BOX_VOLUME {
        return Err("the directions of the axes lie in one plane, expected three independent ones".into());
    }
    let score = |p: &[usize; 3]| (0..3).map(|k| units[p[k]][k].abs()).sum::<f64>();
    // `max_by` returns the last of equal scores, so the order of the file comes last.
    const ASSIGNMENTS: [[usize; 3]; 6] = [[2, 1, 0], [2, 0, 1], [1, 2, 0], [1, 0, 2], [0, 2, 1], [0, 1, 2]];
    let best = ASSIGNMENTS.iter().max_by(|a, b| score(a).total_cmp(&score(b))).expect("there are six");
    Ok(std::array::from_fn(|k| (best[k], units[best[k]][k] < 0.0)))
}

const FILE_ORDER: [(usize, bool); 3] = [(0, false), (1, false), (2, false)];
const BODY_LETTERS: [[&str; 2]; 3] = [["R", "L"], ["A", "P"], ["S", "I"]];
const SPACE_LETTERS: [[&str; 2]; 3] = [["+x", "-x"], ["+y", "-y"], ["+z", "-z"]];
/// Most voxels for one that is read, where sides are too long. With fewer, there is little left of the volume.
const MAX_THIN: u64 = 64;
/// A smaller rotation is invisible, and many scanners report one.
const MAX_TILT_DEG: f64 = 1.0;
/// If the unit vectors span less than this volume, they count as dependent.
const MIN_BOX_VOLUME: f64 = 0.01;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hyperslab::{Hyperslab, Steps};

    fn arrange(
        file_dims: [u64; 3],
        geometry: &Geometry,
        region: Option<&Region>,
        thin: u32,
    ) -> Result<Grid, String> {
        Grid::arrange(file_dims, geometry, region, thin, u64::from(isinglass_core::volume::Volume::MAX_SIDE))
    }

    fn geometry(steps: [DVec3; 3], is_body: bool) -> Geometry {
        let world = if is_body { World::Body } else { World::Space };
        Geometry { steps, origin: Some(DVec3::new(10.0, -20.0, 30.0)), world, unit: None }
    }

    /// The six orders of three axes and the eight signs, as steps of a file.
    fn every_orientation(lengths: [f64; 3]) -> impl Iterator<Item = ([usize; 3], [bool; 3], [DVec3; 3])> {
        let orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
        orders.into_iter().flat_map(move |p| {
            (0..8).map(move |signs| {
                let negative = [0, 1, 2].map(|k| signs >> k & 1 == 1);
                let step =
                    |k: usize| DVec3::AXES[p[k]] * lengths[p[k]] * if negative[k] { -1.0 } else { 1.0 };
                (p, negative, [step(0), step(1), step(2)])
            })
        })
    }

    /// Every voxel keeps its place in space, in the whole file and in a region.
    #[test]
    fn every_assignment_of_axes_keeps_every_voxel_in_place() {
        let lengths = [1.5, 2.0, 3.0];
        let file = [4u64, 3, 2];
        let part = Region { min: [1, 0, 0], max: [None, Some(2), None] };
        for (p, _, steps) in every_orientation(lengths) {
            for region in [None, Some(&part)] {
                let g = arrange(file, &geometry(steps, true), region, 1).unwrap();
                assert_eq!(g.spacing.to_array(), lengths.map(|l| l as f32), "{steps:?}");
                let placement = g.placement.unwrap();
                let axes: Vec<_> = file.into_iter().zip(g.ranges.clone().map(Steps::all)).collect();
                let mut hyperslab = Hyperslab::new(&axes);
                let mut voxels = Vec::new();
                hyperslab.take(24, |range, _| voxels.extend(range.map(|i| i as u8)));
                let voxels = g.reorder_vec(voxels);
                let dims = g.dims();
                for (i, &voxel) in voxels.iter().enumerate() {
                    let i = i as u32;
                    let at = [i % dims[0], i / dims[0] % dims[1], i / dims[0] / dims[1]];
                    let world = Vec3::from_array(
                        [0, 1, 2].map(|k| (at[k] as f32 - (dims[k] - 1) as f32 / 2.0) * g.spacing[k]),
                    );
                    let n = u64::from(voxel);
                    let file_at = [n % file[0], n / file[0] % file[1], n / file[0] / file[1]];
                    let expected =
                        (0..3).fold(DVec3::new(10.0, -20.0, 30.0), |s, k| s + steps[k] * file_at[k] as f64);
                    // All numbers are halves of small integers, so nothing is rounded.
                    assert_eq!(placement.file_from_world(world), expected.to_array(), "{p:?} {steps:?}");
                }
                let mut seen = voxels.clone();
                seen.sort_unstable();
                seen.dedup();
                assert_eq!(seen.len(), voxels.len());
            }
        }
    }

    /// A mirrored volume has each voxel on the other side of its middle, and stays where it is.
    #[test]
    fn every_flip_of_every_orientation_mirrors_about_the_middle() {
        let file = [4u64, 3, 2];
        for (_, _, steps) in every_orientation([1.5, 2.0, 3.0]) {
            let own = geometry(steps, true);
            let plain = arrange(file, &own, None, 1).unwrap();
            let voxels = |grid: &Grid| grid.reorder_vec((0..24u8).collect());
            for signs in 0..8 {
                let flip = [0, 1, 2].map(|k| signs >> k & 1 == 1);
                let grid = arrange(file, &own.flipped(flip, file).unwrap(), None, 1).unwrap();
                assert_eq!((grid.placement, &grid.orientation), (plain.placement, &plain.orientation));
                let [nx, ny, nz] = grid.dims().map(|n| n as usize);
                let at = |x: usize, y: usize, z: usize| x + nx * (y + ny * z);
                let side = |k: usize, i: usize, n: usize| if flip[k] { n - 1 - i } else { i };
                let (found, before) = (voxels(&grid), voxels(&plain));
                for (x, y, z) in (0..24).map(|i| (i % nx, i / nx % ny, i / nx / ny)) {
                    let from = at(side(0, x, nx), side(1, y, ny), side(2, z, nz));
                    assert_eq!(found[at(x, y, z)], before[from], "{steps:?} {flip:?}");
                }
            }
        }
    }

    #[test]
    fn an_image_has_axes_of_its_own() {
        let grid = |geometry| arrange([4, 3, 2], &geometry, None, 1).unwrap();
        let image = grid(Geometry::of_image([1.0, 2.0, 3.0], None));
        assert_eq!((image.orientation.as_deref(), image.file_axes()), (Some(IMAGE_AXES), "+x+y+z".into()));
        assert!(image.warnings.is_empty() && image.order == FILE_ORDER);
        assert_eq!(grid(Geometry::along_axes([1.0; 3], None)).orientation, None, "control");
    }

    #[test]
    fn the_axes_of_a_file_have_letters() {
        for (p, negative, steps) in every_orientation([1.0; 3]) {
            let g = arrange([2; 3], &geometry(steps, true), None, 1).unwrap();
            let letters: String = (0..3).map(|k| BODY_LETTERS[p[k]][usize::from(negative[k])]).collect();
            assert_eq!(g.file_axes(), letters);
            assert_eq!(g.warnings.is_empty(), letters == "RAS");
        }
    }

    #[test]
    fn regions_outside_are_refused() {
        let g = geometry([DVec3::X, DVec3::Y, DVec3::Z], false);
        let region = Region { min: [0, 0, 1], max: [None, Some(4), None] };
        let e = arrange([9, 3, 2], &g, Some(&region), 1).unwrap_err();
        assert_eq!(e, "region 0:4 along y, expected a part of 0:3");
        let region = Region { min: [0, 0, 2], max: [None; 3] };
        assert!(arrange([9, 3, 2], &g, Some(&region), 1).unwrap_err().contains("2:2 along z"));
        let region = Region { min: [0, 2000, 0], max: [None; 3] };
        assert_eq!(arrange([9, 3000, 2], &g, Some(&region), 1).unwrap().dims(), [9, 1000, 2]);
    }

    #[test]
    fn thinned_voxels_keep_their_places() {
        let steps = [DVec3::X, DVec3::Y * 2.0, DVec3::Z * -1.0];
        // Every third of 10 along x is 0, 3, 6 and 9; of 8 along y, 0, 3 and 6. The last axis is reversed.
        let g = arrange([10, 8, 7], &geometry(steps, false), None, 3).unwrap();
        assert_eq!((g.dims(), g.spacing.to_array()), ([4, 3, 3], [3.0, 6.0, 3.0]));
        assert_eq!(g.placement.unwrap().center, [14.5, -14.0, 27.0]);
        assert!(g.warnings.iter().any(|w| w.text.starts_with("one voxel in 3×3×3 is read; --region")));
        // A side beyond the limit is thinned by itself.
        let g = arrange([9, 3000, 2], &geometry(steps, false), None, 1).unwrap();
        assert_eq!((g.dims(), g.spacing.to_array(), g.thin), ([9, 1500, 2], [1.0, 4.0, 1.0], [1, 2, 1]));
        let text = "one voxel in 1×2×1 is read, as a side has 3000 and 2048 are shown at most; --region";
        assert!(g.warnings.iter().any(|w| w.text.starts_with(text)), "{:?}", g.warnings);
        assert!(
            !arrange([9, 2048, 2], &geometry(steps, false), None, 1)
                .unwrap()
                .warnings
                .iter()
                .any(|w| w.kind == WarningKind::Choice)
        );
    }
}
