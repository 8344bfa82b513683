//! A whole volume cut into boxes, one for each process.
//!
//! A step of a ray belongs to the box that holds its front point. Everybody finds the steps of every box by the same
//! arithmetic, so no step is lost or taken twice, and nobody needs to sort.

use std::ops::Range;

use glam::Vec3;

use super::bricks::BRICK;
use super::pyramid::PAGE_CELLS;
use super::world::VoxelBox;

/// Boxes that fill a grid, by planes between voxels at multiples of [`BRICK`], or between pages.
#[derive(Clone, Debug, PartialEq)]
pub struct Split {
    dims: [u32; 3],
    /// Voxels between possible planes.
    unit: u32,
    nodes: Vec<Node>,
    boxes: Vec<VoxelBox>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Node {
    /// All of it is in this box.
    Box(usize),
    /// Voxels below `at` along `axis` are in the node `low`, the others in `high`.
    Cut { axis: usize, at: u32, low: usize, high: usize },
}

/// A grid has too few voxels for so many boxes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{parts} parts of {dims:?} voxels, expected fewer: each needs {unit} voxels along the axis that is cut"
)]
pub struct SplitError {
    /// The wanted number of parts.
    pub parts: usize,
    /// Voxels of the whole.
    pub dims: [u32; 3],
    /// Voxels between possible planes.
    pub unit: u32,
}

/// Places along a ray that say which box has its steps. That of step i is at origin + dir·(s0 + (i + place)·h) − shift.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointLine {
    /// A point in voxel space.
    pub origin: Vec3,
    /// Voxels per world distance.
    pub dir: Vec3,
    /// World distance of the first point.
    pub s0: f32,
    /// World distance between points.
    pub h: f32,
    /// What of a step counts, in steps: 0 is its front, and a half its middle.
    pub place: f32,
    /// Where planes lie between voxels: 0 if at the edge of a voxel, a half if at its centre.
    pub shift: f32,
}

impl PointLine {
    /// One coordinate of the place of step i, by the arithmetic of a march.
    #[inline(always)]
    fn at(&self, axis: usize, i: u32) -> f32 {
        self.origin[axis] + self.dir[axis] * (self.s0 + (i as f32 + self.place) * self.h) - self.shift
    }
}

impl Split {
    /// Cuts a grid of `dims` into `parts` boxes of about the same size, each time along the longest axis.
    ///
    /// # Errors
    /// If there are too few voxels.
    pub fn evenly(dims: [u32; 3], parts: usize) -> Result<Self, SplitError> {
        Self::evenly_by(dims, parts, BRICK)
    }

    /// The same between pages: no page of the finest level lies in two boxes.
    ///
    /// # Errors
    /// If there are too few voxels.
    pub fn between_pages(dims: [u32; 3], parts: usize) -> Result<Self, SplitError> {
        Self::evenly_by(dims, parts, PAGE_CELLS)
    }

    fn evenly_by(dims: [u32; 3], parts: usize, unit: u32) -> Result<Self, SplitError> {
        let mut split = Self { dims, unit, nodes: Vec::new(), boxes: Vec::new() };
        split.cut_evenly(VoxelBox::of(dims), parts.max(1)).ok_or(SplitError { parts, dims, unit })?;
        Ok(split)
    }

    /// Cuts a grid of `dims` into a number of layers along each axis.
    ///
    /// # Errors
    /// If there are too few voxels.
    pub fn grid(dims: [u32; 3], layers: [u32; 3]) -> Result<Self, SplitError> {
        let unit = BRICK;
        let mut split = Self { dims, unit, nodes: Vec::new(), boxes: Vec::new() };
        let error = SplitError { parts: layers.iter().map(|&n| n as usize).product(), dims, unit };
        split.cut_layers(VoxelBox::of(dims), layers.map(|n| n.max(1))).ok_or(error)?;
        Ok(split)
    }

    /// Voxels of the whole along x, y, z.
    pub fn dims(&self) -> [u32; 3] {
        self.dims
    }

    /// The boxes, by the number of their process.
    pub fn boxes(&self) -> &[VoxelBox] {
        &self.boxes
    }

    /// The voxels that a process holds: its box with `ghosts` more on each side. [`GHOSTS`] suffice for a march.
    pub fn held(&self, rank: usize, ghosts: u32) -> VoxelBox {
        self.boxes[rank].grown(ghosts, self.dims)
    }

    /// Hands on the steps of each box that a ray meets, from front to back.
    pub fn runs(&self, line: &PointLine, steps: Range<u32>, each: &mut impl FnMut(usize, Range<u32>)) {
        self.runs_below(0, line, steps, each);
    }

    fn runs_below(
        &self,
        node: usize,
        line: &PointLine,
        steps: Range<u32>,
        each: &mut impl FnMut(usize, Range<u32>),
    ) {
        if steps.is_empty() {
            return;
        }
        match self.nodes[node] {
            Node::Box(rank) => each(rank, steps),
            Node::Cut { axis, at, low, high } => {
                let ascends = line.dir[axis] >= 0.0;
                let is_before = |i: u32| (line.at(axis, i) < at as f32) == ascends;
                let between = first_not(steps.clone(), is_before);
                let (front, back) = if ascends { (low, high) } else { (high, low) };
                self.runs_below(front, line, steps.start..between, each);
                self.runs_below(back, line, between..steps.end, each);
            }
        }
    }

    /// Adds the nodes of `parts` boxes within `voxels`; `None` if there is no room.
    fn cut_evenly(&mut self, voxels: VoxelBox, parts: usize) -> Option<()> {
        if parts == 1 {
            return self.add_box(voxels);
        }
        let dims = voxels.dims();
        let axis = (0..3).rev().max_by_key(|&axis| dims[axis])?;
        let low = parts / 2;
        let share = (u64::from(dims[axis]) * low as u64 / parts as u64) as u32;
        let at = self.border(voxels.first[axis] + share, &voxels, axis)?;
        self.cut(
            voxels,
            axis,
            at,
            |split, voxels| split.cut_evenly(voxels, low),
            |split, voxels| split.cut_evenly(voxels, parts - low),
        )
    }

    fn cut_layers(&mut self, voxels: VoxelBox, layers: [u32; 3]) -> Option<()> {
        let Some(axis) = (0..3).rev().find(|&axis| layers[axis] > 1) else { return self.add_box(voxels) };
        let mut first = layers;
        first[axis] = 1;
        let mut others = layers;
        others[axis] -= 1;
        let at = self.border(voxels.first[axis] + voxels.dims()[axis] / layers[axis], &voxels, axis)?;
        self.cut(
            voxels,
            axis,
            at,
            |split, voxels| split.cut_layers(voxels, first),
            |split, voxels| split.cut_layers(voxels, others),
        )
    }

    fn add_box(&mut self, voxels: VoxelBox) -> Option<()> {
        self.nodes.push(Node::Box(self.boxes.len()));
        self.boxes.push(voxels);
        Some(())
    }

    fn cut(
        &mut self,
        voxels: VoxelBox,
        axis: usize,
        at: u32,
        fill_low: impl FnOnce(&mut Self, VoxelBox) -> Option<()>,
        fill_high: impl FnOnce(&mut Self, VoxelBox) -> Option<()>,
    ) -> Option<()> {
        let here = self.nodes.len();
        self.nodes.push(Node::Box(0));
        let (mut below, mut above) = (voxels, voxels);
        (below.end[axis], above.first[axis]) = (at, at);
        let low = self.nodes.len();
        fill_low(self, below)?;
        let high = self.nodes.len();
        fill_high(self, above)?;
        self.nodes[here] = Node::Cut { axis, at, low, high };
        Some(())
    }

    /// The possible plane inside a box that is nearest to `wanted`.
    fn border(&self, wanted: u32, voxels: &VoxelBox, axis: usize) -> Option<u32> {
        let unit = self.unit;
        let least = (voxels.first[axis] / unit + 1) * unit;
        // Pages consist of cells between voxels, so a plane before the last voxel would leave no cell behind it.
        let end = voxels.end[axis] - u32::from(unit == PAGE_CELLS && voxels.end[axis] == self.dims[axis]);
        let most = end.checked_sub(1)? / unit * unit;
        (least <= most).then(|| ((wanted + unit / 2) / unit * unit).clamp(least, most))
    }
}

/// The first step of a range for which `holds` does not hold; it holds for none behind.
fn first_not(steps: Range<u32>, holds: impl Fn(u32) -> bool) -> u32 {
    let (mut low, mut high) = (steps.start, steps.end);
    while low < high {
        let middle = low + (high - low) / 2;
        if holds(middle) {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    low
}

/// Voxels that a process needs around its box. The far point of a last step may be a stride outside, and a march reads
/// the voxel beyond it. Brightness there comes from the next voxels.
pub const GHOSTS: u32 = 3;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_fill_the_grid_and_none_overlap() {
        for (dims, parts) in [([40, 24, 17], 1), ([40, 24, 17], 7), ([64, 64, 64], 8), ([9, 8, 8], 2)] {
            let split = Split::evenly(dims, parts).unwrap();
            assert_eq!(split.boxes().len(), parts);
            let all = VoxelBox::of(dims);
            assert_eq!(split.boxes().iter().map(VoxelBox::count).sum::<u64>(), all.count());
            let corners = split.boxes().iter().map(|b| b.first);
            assert!(corners.clone().all(|c| split.boxes().iter().filter(|b| b.contains(c)).count() == 1));
            assert!(corners.flatten().all(|first| first % BRICK == 0));
        }
        let split = Split::grid([48, 40, 33], [3, 2, 1]).unwrap();
        assert_eq!(split.boxes().len(), 6);
        assert_eq!(split.held(0, 3), VoxelBox { first: [0; 3], end: [19, 27, 33] });
        // The controls: no room.
        let error = Split::evenly([9, 8, 8], 3).unwrap_err();
        assert!(error.to_string().starts_with("3 parts of [9, 8, 8] voxels, expected fewer"), "{error}");
        assert!(Split::grid([16, 16, 16], [3, 1, 1]).is_err());
    }

    #[test]
    fn each_step_belongs_to_the_box_of_its_front() {
        let split = Split::grid([48, 40, 32], [3, 2, 2]).unwrap();
        let lines = [
            (Vec3::new(-3.0, 5.0, 2.0), Vec3::new(0.8, 0.5, 0.33)),
            (Vec3::new(50.0, 39.0, 31.0), Vec3::new(-0.8, -0.5, -0.33)),
            (Vec3::new(24.0, -1.0, 16.0), Vec3::new(0.0, 1.0, -0.0)),
            (Vec3::new(16.0, 20.0, 40.0), Vec3::new(1e-9, -1e-9, -1.0)),
        ];
        for (origin, dir) in lines {
            let line = PointLine { origin, dir, s0: 0.25, h: 0.5, place: 0.0, shift: 0.0 };
            let mut next = 0;
            split.runs(&line, 0..90, &mut |rank, steps| {
                assert_eq!(steps.start, next, "runs follow each other");
                next = steps.end;
                let held = split.boxes()[rank];
                for i in steps {
                    for axis in 0..3 {
                        let p = line.at(axis, i);
                        let is_low = held.first[axis] == 0 || p >= held.first[axis] as f32;
                        let is_high = held.end[axis] == split.dims()[axis] || p < held.end[axis] as f32;
                        assert!(is_low && is_high, "step {i} of {dir}");
                    }
                }
            });
            assert_eq!(next, 90);
        }
    }
}
