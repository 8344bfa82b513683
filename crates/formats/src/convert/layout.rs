//! How the numbers of a file become chunks of an image: the axes of the stream, and parts of it in memory.

use std::ops::Range;

use crate::axes::Grid;
use crate::dtype::{Dtype, Endian};
use crate::plan::{Chosen, Plan, Role};

/// The axes of a file, and the axes of the image that it becomes.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    /// Selected numbers along each axis of the file, the fastest first, and the meaning of the axis.
    pub(super) axes: Vec<(u64, Role)>,
    /// Voxels of the image along x, y and z.
    pub(super) dims: [u64; 3],
    /// Which axis in space of the file becomes x, y and z, and whether it is reversed.
    order: [(usize, bool); 3],
    /// The places of the axes in space among all.
    in_space: [usize; 3],
    dtype: Dtype,
    endian: Endian,
    /// Sides of a chunk along x, y and z.
    chunk: [u64; 3],
}

/// Numbers in memory: a range of the selected ones along each axis of the file, the fastest first.
pub(super) struct Block<'a> {
    pub(super) ranges: Vec<Range<u64>>,
    pub(super) bytes: &'a [u8],
}

/// The voxels of a chunk that the image has.
pub(super) struct ChunkNumbers {
    /// Time and channel, counted in the block's file.
    pub(super) of: [u64; 2],
    /// The number of the chunk along x, y and z.
    pub(super) at: [u64; 3],
    /// Little-endian, x fastest.
    pub(super) bytes: Vec<u8>,
    /// Voxels along x, y and z.
    pub(super) dims: [u64; 3],
}

impl Layout {
    /// The layout of what is chosen of a file, with chunks of `chunk` voxels along x, y and z.
    pub(super) fn new(plan: &Plan, chosen: &Chosen, side: u64) -> Self {
        let axes: Vec<_> =
            plan.axes.iter().zip(&chosen.selected).map(|(axis, steps)| (steps.len(), axis.role)).collect();
        let place = |i: usize| axes.iter().position(|a| a.1 == Role::Space(i)).unwrap_or(0);
        let in_space = [place(0), place(1), place(2)];
        let Grid { order, .. } = chosen.grid;
        let dims = order.map(|(axis, _)| axes[in_space[axis]].0);
        let chunk = dims.map(|n| n.min(side));
        Self { axes, dims, order, in_space, dtype: plan.dtype, endian: plan.endian, chunk }
    }

    fn length_of(&self, role: Role) -> u64 {
        self.axes.iter().find(|axis| axis.1 == role).map_or(1, |axis| axis.0)
    }

    /// Points in time of the file.
    pub(super) fn num_times(&self) -> u64 {
        self.length_of(Role::Time)
    }

    /// Channels along an axis of the file.
    pub(super) fn num_channels(&self) -> u64 {
        self.length_of(Role::Channel)
    }

    /// The place of the slowest axis in space.
    fn slow(&self) -> usize {
        self.in_space[2]
    }

    /// The axis of the image that the axis `i` in space of the file becomes, and whether it is reversed.
    fn becomes(&self, i: usize) -> (usize, bool) {
        let k = (0..3).find(|k| self.order[*k].0 == i).unwrap_or(i);
        (k, self.order[k].1)
    }

    /// The parts of the axis `i` in space of the file that are layers of `num` chunks each, in the file's order.
    pub(super) fn layers(&self, i: usize, num: u64) -> Vec<Range<u64>> {
        let (k, is_reversed) = self.becomes(i);
        let (n, side) = (self.dims[k], self.chunk[k] * num.max(1));
        let count = n.div_ceil(side);
        let layer = |j: u64| {
            let j = if is_reversed { count - 1 - j } else { j };
            let (from, to) = (j * side, ((j + 1) * side).min(n));
            if is_reversed { n - to..n - from } else { from..to }
        };
        (0..count).map(layer).collect()
    }

    /// The groups of numbers that follow each other in the file, each a layer of chunks across its slowest axis in space.
    pub(super) fn groups(&self) -> Vec<Vec<Range<u64>>> {
        let slow = self.slow();
        let layers = self.layers(2, 1);
        let num_outer: u64 = self.axes[slow + 1..].iter().map(|axis| axis.0).product();
        let mut groups = Vec::new();
        for outer in 0..num_outer {
            for layer in &layers {
                let mut rest = outer;
                let ranges = self.axes.iter().enumerate().map(|(axis, &(length, _))| match axis {
                    _ if axis < slow => 0..length,
                    _ if axis == slow => layer.clone(),
                    _ => {
                        let at = rest % length;
                        rest /= length;
                        at..at + 1
                    }
                });
                groups.push(ranges.collect());
            }
        }
        groups
    }

    /// Parts of a file of chunks, each of at most `most` bytes if one layer of chunks is not larger: a layer across the
    /// slowest axis in space, of one time, with all channels or one, perhaps cut across the second slowest axis.
    pub(super) fn blocks(&self, most: u64) -> Vec<Vec<Range<u64>>> {
        let single = |role: Role, part: &[Range<u64>]| -> Vec<Vec<Range<u64>>> {
            let Some(axis) = self.axes.iter().position(|axis| axis.1 == role) else {
                return vec![part.to_vec()];
            };
            let with = |i: u64| {
                let mut ranges = part.to_vec();
                ranges[axis] = i..i + 1;
                ranges
            };
            part[axis].clone().map(with).collect()
        };
        let whole: Vec<Range<u64>> = self.axes.iter().map(|axis| 0..axis.0).collect();
        let layers = |part: Vec<Range<u64>>| {
            self.layers(2, 1).into_iter().map(move |layer| {
                let mut ranges = part.clone();
                ranges[self.in_space[2]] = layer;
                ranges
            })
        };
        let mut parts: Vec<_> = single(Role::Time, &whole).into_iter().flat_map(layers).collect();
        let fits = |parts: &[Vec<Range<u64>>]| parts.iter().all(|part| self.num_bytes(part) <= most);
        if !fits(&parts) {
            parts = parts.iter().flat_map(|part| single(Role::Channel, part)).collect();
        }
        if !fits(&parts) {
            let row =
                parts.iter().flat_map(|part| self.strips(part)).map(|strip| self.num_bytes(&strip)).max();
            let num = most / row.unwrap_or(1).max(1);
            let rows = self.layers(1, num);
            let cut = |part: &Vec<Range<u64>>| {
                rows.iter()
                    .map(|rows| {
                        let mut ranges = part.clone();
                        ranges[self.in_space[1]] = rows.clone();
                        ranges
                    })
                    .collect::<Vec<_>>()
            };
            parts = parts.iter().flat_map(cut).collect();
        }
        parts
    }

    /// Bytes of a box of numbers.
    pub(super) fn num_bytes(&self, ranges: &[Range<u64>]) -> u64 {
        count(ranges).saturating_mul(self.dtype.num_bytes() as u64)
    }

    /// The parts of a group, each of one layer of chunks across the second slowest axis in space.
    pub(super) fn strips(&self, group: &[Range<u64>]) -> Vec<Vec<Range<u64>>> {
        let with = |rows: Range<u64>| {
            let mut ranges = group.to_vec();
            ranges[self.in_space[1]] = rows;
            ranges
        };
        self.layers(1, 1).into_iter().map(with).collect()
    }

    /// Where the numbers of a strip lie in its group, in bytes: pieces of the same length, in the order of the strip.
    pub(super) fn pieces(&self, group: &[Range<u64>], strip: &[Range<u64>]) -> (u64, Vec<u64>) {
        let size = self.dtype.num_bytes() as u64;
        let at = self.in_space[1];
        let length = count(&strip[..=at]) * size;
        let whole = count(&group[..=at]) * size;
        let first = count(&group[..at]) * (strip[at].start - group[at].start) * size;
        let num = count(&group[at + 1..]);
        (length, (0..num).map(|i| i * whole + first).collect())
    }

    /// What each chunk is that a block has whole: time, channel, and its number along x, y and z.
    pub(super) fn chunks_in(&self, block: &Block) -> Vec<([u64; 2], [u64; 3])> {
        let along = |role: Role| {
            let axis = self.axes.iter().position(|axis| axis.1 == role);
            axis.map_or(0..1, |axis| block.ranges[axis].clone())
        };
        let within: [Range<u64>; 3] = std::array::from_fn(|k| {
            let range = self.out_range(block, k);
            range.start / self.chunk[k]..range.end.div_ceil(self.chunk[k])
        });
        let [xs, ys, zs] = within;
        let mut chunks = Vec::new();
        for time in along(Role::Time) {
            for channel in along(Role::Channel) {
                for z in zs.clone() {
                    for y in ys.clone() {
                        chunks.extend(xs.clone().map(|x| ([time, channel], [x, y, z])));
                    }
                }
            }
        }
        chunks
    }

    /// The part of axis `k` of the image that a block has.
    fn out_range(&self, block: &Block, k: usize) -> Range<u64> {
        let (axis, is_reversed) = self.order[k];
        let range = &block.ranges[self.in_space[axis]];
        let n = self.dims[k];
        if is_reversed { n - range.end..n - range.start } else { range.clone() }
    }

    /// The numbers of a chunk of a block.
    pub(super) fn chunk(&self, block: &Block, of: [u64; 2], at: [u64; 3]) -> ChunkNumbers {
        let size = self.dtype.num_bytes();
        let mut stride = size as i64;
        let mut strides = vec![0; self.axes.len()];
        let mut base = 0i64;
        for (axis, range) in block.ranges.iter().enumerate() {
            strides[axis] = stride;
            let first = match self.axes[axis].1 {
                Role::Time => of[0] - range.start,
                Role::Channel => of[1] - range.start,
                _ => 0,
            };
            base += first as i64 * stride;
            stride *= (range.end - range.start) as i64;
        }
        let dims: [u64; 3] = std::array::from_fn(|k| {
            let from = at[k] * self.chunk[k];
            self.chunk[k].min(self.dims[k] - from)
        });
        let mut steps = [0i64; 3];
        for k in 0..3 {
            let (axis, is_reversed) = self.order[k];
            let (place, from) = (self.in_space[axis], at[k] * self.chunk[k]);
            let in_file = if is_reversed { self.dims[k] - 1 - from } else { from };
            base += (in_file as i64 - block.ranges[place].start as i64) * strides[place];
            steps[k] = if is_reversed { -strides[place] } else { strides[place] };
        }
        let mut bytes = Vec::with_capacity(dims.iter().product::<u64>() as usize * size);
        for z in 0..dims[2] as i64 {
            for y in 0..dims[1] as i64 {
                let row = base + z * steps[2] + y * steps[1];
                if steps[0] == size as i64 {
                    let row = row as usize;
                    bytes.extend_from_slice(&block.bytes[row..row + dims[0] as usize * size]);
                    continue;
                }
                for x in 0..dims[0] as i64 {
                    let number = (row + x * steps[0]) as usize;
                    bytes.extend_from_slice(&block.bytes[number..number + size]);
                }
            }
        }
        if self.endian == Endian::Big && size > 1 {
            bytes.chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
        ChunkNumbers { of, at, bytes, dims }
    }
}

/// Numbers in a box.
pub(super) fn count(ranges: &[Range<u64>]) -> u64 {
    ranges.iter().map(|r| r.end - r.start).product()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use glam::DVec3;

    use super::*;
    use crate::axes::{Geometry, World};
    use crate::plan::Axis;
    use crate::source::OpenOptions;

    /// Each voxel of the image is the one that the reader puts there, for every order and direction of the axes.
    #[test]
    fn chunks_of_groups_and_of_strips_are_those_of_the_reordered_volume() {
        let sizes = [5u64, 7, 6];
        let (num_channels, num_times) = (2u64, 2u64);
        for (number, &order) in
            [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]].iter().enumerate()
        {
            for signs in 0..8 {
                let sign = |k: usize| if signs >> k & 1 == 1 { -1.0 } else { 1.0 };
                let steps = [0, 1, 2].map(|k| DVec3::AXES[order[k]] * sign(k));
                let geometry = Geometry { steps, origin: None, world: World::Space, unit: None };
                let mut axes = Axis::in_space(sizes);
                axes.insert((number + signs) % 4, Axis { size: num_channels, role: Role::Channel });
                axes.insert((2 * number + signs) % 5, Axis { size: num_times, role: Role::Time });
                let plan = Plan::new("test", Dtype::Uint16, Endian::Big, axes, geometry);
                let options = OpenOptions::default();
                let chosen = plan.choose_all(Path::new("test"), &options).unwrap();
                let layout = Layout::new(&plan, &chosen, 3);
                let all: Vec<u8> = (0..840u16).flat_map(u16::to_be_bytes).collect();
                let mut at = 0;
                let mut num_chunks = 0;
                for group in layout.groups() {
                    let length = layout.num_bytes(&group) as usize;
                    let bytes = &all[at..at + length];
                    at += length;
                    let whole = Block { ranges: group.clone(), bytes };
                    let mut seen = layout.chunks_in(&whole);
                    num_chunks += seen.len();
                    for (of, at) in &seen {
                        check(&plan, &chosen, &layout.chunk(&whole, *of, *at));
                    }
                    for strip in layout.strips(&group) {
                        let (piece, places) = layout.pieces(&group, &strip);
                        let parts = places.iter().map(|&at| &bytes[at as usize..(at + piece) as usize]);
                        let bytes = parts.collect::<Vec<_>>().concat();
                        let strip = Block { ranges: strip, bytes: &bytes };
                        for (of, at) in layout.chunks_in(&strip) {
                            let chunk = layout.chunk(&strip, of, at);
                            assert_eq!(chunk.bytes, layout.chunk(&whole, of, at).bytes);
                            seen.retain(|other| *other != (of, at));
                        }
                    }
                    assert!(seen.is_empty());
                }
                assert_eq!(at, all.len());
                let along: u64 = layout.dims.iter().map(|n| n.div_ceil(3)).product();
                assert_eq!(num_chunks as u64, along * num_channels * num_times);
            }
        }
    }

    /// Compares with the place of each voxel in the file, by its number.
    fn check(plan: &Plan, chosen: &Chosen, chunk: &ChunkNumbers) {
        let numbers = chunk.bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b));
        let [nx, ny, _] = chunk.dims;
        for (i, number) in (0..).zip(numbers) {
            let in_chunk = [i % nx, i / nx % ny, i / nx / ny];
            let mut rest = u64::from(number);
            for axis in &plan.axes {
                let found = rest % axis.size;
                rest /= axis.size;
                match axis.role {
                    Role::Time => assert_eq!(found, chunk.of[0]),
                    Role::Channel => assert_eq!(found, chunk.of[1]),
                    Role::Space(i) => {
                        let k = (0..3).find(|k| chosen.grid.order[*k].0 == i).unwrap();
                        let out = chunk.at[k] * 3 + in_chunk[k];
                        let expected = if chosen.grid.order[k].1 { axis.size - 1 - out } else { out };
                        assert_eq!(found, expected, "{:?} {in_chunk:?}", chosen.grid.order);
                    }
                    _ => {}
                }
            }
        }
    }
}
