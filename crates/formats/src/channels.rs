//! Divides the selected numbers of a file among its channels, so that one pass reads them all.

use std::collections::TryReserveError;
use std::ops::Range;

use isinglass_core::volume::Voxels;
use rayon::prelude::*;

use crate::decode::{Decoded, VoxelSink};
use crate::dtype::{Dtype, Endian};
use crate::hyperslab::Steps;

/// A sink for each channel that is read.
pub(crate) struct ChannelSinks {
    sinks: Vec<VoxelSink>,
    /// Numbers of one channel that follow each other.
    run: u64,
    /// Channels in the stream. Those beyond the sinks are left out.
    num_slots: u64,
    /// Selected numbers so far.
    taken: u64,
    /// Selected numbers in all.
    num_selected: u64,
    bytes_per_number: usize,
    scratch: Vec<u8>,
    layout: Vec<AxisLayout>,
}

/// An axis of the plan, the fastest first.
#[derive(Clone, Copy, Debug)]
struct AxisLayout {
    /// Distance of its neighbours in the voxels of a channel; zero for the axis of channels.
    stride: usize,
    length: usize,
}

/// Voxels of one channel in a box.
pub(crate) struct Piece {
    /// Its number among the channels that are read.
    pub(crate) channel: usize,
    /// The box along each axis of the plan, counted in selected numbers. The axis of channels has one.
    pub(crate) ranges: Vec<Range<usize>>,
    /// The voxels, the first axis fastest.
    pub(crate) sink: VoxelSink,
}

/// How the selection lies in the stream.
pub(crate) struct StreamShape<'a> {
    pub(crate) dtype: Dtype,
    pub(crate) endian: Endian,
    /// The selection along each axis of the plan, the fastest first.
    pub(crate) selected: &'a [Steps],
    /// The axis of channels, if there is one.
    pub(crate) channel_axis: Option<usize>,
    /// Channels to keep.
    pub(crate) num_channels: usize,
    pub(crate) num_voxels: usize,
}

impl ChannelSinks {
    /// Sinks with room for all voxels. With `fill`, each voxel is that number already.
    pub(crate) fn new(shape: &StreamShape, fill: Option<&[u8]>) -> Result<Self, TryReserveError> {
        let lengths: Vec<u64> = shape.selected.iter().map(Steps::len).collect();
        let num_slots = shape.channel_axis.map_or(1, |axis| lengths[axis]);
        let run = lengths[..shape.channel_axis.unwrap_or(0)].iter().product();
        let mut next = 1;
        let layout = lengths.iter().enumerate().map(|(axis, &length)| {
            let (length, is_channel) = (length as usize, Some(axis) == shape.channel_axis);
            let stride = if is_channel { 0 } else { next };
            next *= if is_channel { 1 } else { length };
            AxisLayout { stride, length }
        });
        let layout = layout.collect();
        let sinks = (0..shape.num_channels).map(|_| match fill {
            Some(number) => VoxelSink::filled(shape.dtype, shape.endian, shape.num_voxels, number),
            None => VoxelSink::new(shape.dtype, shape.endian, shape.num_voxels),
        });
        Ok(Self {
            sinks: sinks.collect::<Result<_, _>>()?,
            run,
            num_slots,
            taken: 0,
            num_selected: lengths.iter().product(),
            bytes_per_number: shape.dtype.num_bytes(),
            scratch: Vec::new(),
            layout,
        })
    }

    /// The fraction of the selected numbers that has passed.
    pub(crate) fn progress(&self) -> f32 {
        (self.taken as f64 / self.num_selected.max(1) as f64) as f32
    }

    /// Adds each `step`th number of `bytes`, which contain whole numbers, the next ones of the selection.
    pub(crate) fn push(&mut self, bytes: &[u8], step: usize) {
        if step == 1 {
            return self.push_run(bytes);
        }
        let mut picked = std::mem::take(&mut self.scratch);
        pick(bytes, self.bytes_per_number, 0, step, &mut picked);
        self.push_run(&picked);
        self.scratch = picked;
    }

    fn push_run(&mut self, bytes: &[u8]) {
        let size = self.bytes_per_number;
        let count = (bytes.len() / size) as u64;
        if self.num_slots == 1 {
            self.sinks[0].push_bytes(bytes);
        } else if self.run == 1 {
            let mut picked = Vec::new();
            let next = self.taken % self.num_slots;
            for (slot, sink) in (0..).zip(&mut self.sinks) {
                let first = (slot + self.num_slots - next) % self.num_slots;
                pick(bytes, size, first as usize, self.num_slots as usize, &mut picked);
                sink.push_bytes(&picked);
            }
        } else {
            let (mut at, mut passed) = (0, self.taken);
            while at < count {
                let length = (self.run - passed % self.run).min(count - at);
                let slot = (passed / self.run % self.num_slots) as usize;
                if let Some(sink) = self.sinks.get_mut(slot) {
                    sink.push_bytes(&bytes[at as usize * size..(at + length) as usize * size]);
                }
                (at, passed) = (at + length, passed + length);
            }
        }
        self.taken += count;
    }

    /// Adds one number that was written as text. Returns `false` if the type cannot hold it.
    pub(crate) fn push_number(&mut self, number: f64) -> bool {
        let slot = (self.taken / self.run % self.num_slots) as usize;
        self.taken += 1;
        self.sinks.get_mut(slot).is_none_or(|sink| sink.push_number(number))
    }

    /// Puts boxes of voxels in their places, and counts `num_passed` selected numbers. The sinks must be full.
    pub(crate) fn place(&mut self, pieces: Vec<Piece>, num_passed: u64) {
        self.taken += num_passed;
        let layout = &self.layout[..];
        for (channel, sink) in self.sinks.iter_mut().enumerate() {
            let (voxels, num_rounded) = sink.parts_mut();
            let own = pieces.iter().filter(|piece| piece.channel == channel);
            *num_rounded += own.clone().map(|piece| piece.sink.num_rounded()).sum::<u64>();
            macro_rules! copy {
                ($kind:path, $to:expr) => {{
                    let sources = own.filter_map(|piece| match piece.sink.voxels() {
                        $kind(from) => Some((piece, &from[..])),
                        _ => None,
                    });
                    copy_planes($to, layout, &sources.collect::<Vec<_>>());
                }};
            }
            match voxels {
                Voxels::U8(v) => copy!(Voxels::U8, v),
                Voxels::U16(v) => copy!(Voxels::U16, v),
                Voxels::F32(v) => copy!(Voxels::F32, v),
            }
        }
    }

    /// The sink of the first channel.
    pub(crate) fn into_first(self) -> Option<VoxelSink> {
        self.sinks.into_iter().next()
    }

    /// Fewest voxels of a channel so far.
    pub(crate) fn num_taken(&self) -> usize {
        self.sinks.iter().map(VoxelSink::len).min().unwrap_or(0)
    }

    /// What each channel has collected.
    pub(crate) fn finish(self, has_gaps: bool) -> Vec<Decoded> {
        self.sinks.into_iter().map(|sink| sink.finish(has_gaps)).collect()
    }
}

/// Each `step`th number of `bytes` from number `first` on.
pub(crate) fn pick(bytes: &[u8], size: usize, first: usize, step: usize, picked: &mut Vec<u8>) {
    picked.clear();
    for number in bytes.chunks_exact(size).skip(first).step_by(step) {
        picked.extend_from_slice(number);
    }
}

/// Copies boxes to their places. Each thread has whole planes across the slowest axis.
fn copy_planes<T: Copy + Send + Sync>(voxels: &mut [T], layout: &[AxisLayout], sources: &[(&Piece, &[T])]) {
    let is_long = |axis: &AxisLayout| axis.length > 1 && axis.stride > 0;
    let slow = layout.iter().rposition(is_long).unwrap_or(0);
    let in_plane = layout[slow].stride.max(1);
    let first = sources.iter().map(|(p, _)| p.ranges[slow].start).min().unwrap_or(0);
    let last = sources.iter().map(|(p, _)| p.ranges[slow].end).max().unwrap_or(0);
    let Some(part) = voxels.get_mut(first * in_plane..last * in_plane) else { return };
    part.par_chunks_mut(in_plane).enumerate().for_each(|(i, plane)| {
        let at = first + i;
        for (piece, source) in sources.iter().filter(|(p, _)| p.ranges[slow].contains(&at)) {
            copy_plane(plane, layout, (slow, at), piece, source);
        }
    });
}

/// Copies the part of a box that is in the plane `at` of axis `slow`.
fn copy_plane<T: Copy>(
    plane: &mut [T],
    layout: &[AxisLayout],
    (slow, at): (usize, usize),
    piece: &Piece,
    source: &[T],
) {
    let lengths: Vec<usize> = piece.ranges.iter().map(ExactSizeIterator::len).collect();
    let mut strides = vec![1; lengths.len()];
    for axis in 1..lengths.len() {
        strides[axis] = strides[axis - 1] * lengths[axis - 1];
    }
    let is_outer = |axis: &usize| *axis != slow && layout[*axis].length > 1 && layout[*axis].stride > 0;
    let mut outer = (0..layout.len()).filter(is_outer);
    // Rows run along the fastest of the other axes.
    let row = outer.next();
    let outer: Vec<usize> = outer.collect();
    let (first, row_length) = row.map_or((0, 1), |axis| (piece.ranges[axis].start, lengths[axis]));
    let first_source = (at - piece.ranges[slow].start) * strides[slow];
    let mut index = vec![0; outer.len()];
    loop {
        let (mut to, mut from) = (first, first_source);
        for (&axis, i) in outer.iter().zip(&index) {
            to += (piece.ranges[axis].start + i) * layout[axis].stride;
            from += i * strides[axis];
        }
        plane[to..to + row_length].copy_from_slice(&source[from..from + row_length]);
        let next = outer.iter().zip(&mut index).find_map(|(&axis, i)| {
            *i = (*i + 1) % lengths[axis];
            (*i > 0).then_some(())
        });
        if next.is_none() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers 0 to 3×4×5×2, in two channels that are the axis `channel_axis`.
    fn shape(selected: &[Steps], channel_axis: usize, num_channels: usize) -> StreamShape<'_> {
        let num_voxels = selected.iter().map(Steps::len).product::<u64>() / selected[channel_axis].len();
        StreamShape {
            dtype: Dtype::Uint8,
            endian: Endian::Little,
            selected,
            channel_axis: Some(channel_axis),
            num_channels,
            num_voxels: num_voxels as usize,
        }
    }

    fn voxels(sinks: ChannelSinks) -> Vec<Vec<u8>> {
        let list = sinks.finish(false).into_iter().map(|decoded| match decoded.voxels {
            Voxels::U8(v) => v,
            other => panic!("{other:?}"),
        });
        list.collect()
    }

    #[test]
    fn a_stream_and_boxes_give_the_same_voxels_for_every_place_of_the_axis_of_channels() {
        for channel_axis in 0..4 {
            let mut sizes = vec![3u64, 4, 5];
            sizes.insert(channel_axis, 2);
            let selected: Vec<Steps> = sizes.iter().map(|&n| Steps::all(0..n)).collect();
            let all: Vec<u8> = (0..120).collect();
            let stride: usize = sizes[..channel_axis].iter().product::<u64>() as usize;
            let expected: Vec<Vec<u8>> = (0..2)
                .map(|c| all.iter().copied().filter(|&i| usize::from(i) / stride % 2 == c).collect())
                .collect();
            for cut in [1, 7, 60, 120] {
                let mut sinks = ChannelSinks::new(&shape(&selected, channel_axis, 2), None).unwrap();
                all.chunks(cut).for_each(|part| sinks.push(part, 1));
                assert!((sinks.progress() - 1.0).abs() < 1e-6);
                assert_eq!(voxels(sinks), expected, "{channel_axis} {cut}");
            }
            let mut one = ChannelSinks::new(&shape(&selected, channel_axis, 1), None).unwrap();
            one.push(&all, 1);
            assert_eq!(voxels(one), expected[..1], "the second is left out");
            // The same in boxes, which part each axis in two.
            let mut sinks = ChannelSinks::new(&shape(&selected, channel_axis, 2), Some(&[255])).unwrap();
            let mut pieces = Vec::new();
            for corner in 0..16u64 {
                let halves: Vec<Range<usize>> = (0..4)
                    .map(|axis| {
                        let (n, middle) = (sizes[axis] as usize, 1);
                        if corner >> axis & 1 == 0 { 0..middle } else { middle..n }
                    })
                    .collect();
                let mut sink = VoxelSink::new(Dtype::Uint8, Endian::Little, 0).unwrap();
                for i in 0..120u64 {
                    let mut rest = i;
                    let is_in = halves.iter().zip(&sizes).all(|(half, n)| {
                        let at = rest % n;
                        rest /= n;
                        half.contains(&(at as usize))
                    });
                    if is_in {
                        sink.push_bytes(&[i as u8]);
                    }
                }
                let channel = halves[channel_axis].start;
                let mut ranges = halves;
                ranges[channel_axis] = 0..1;
                pieces.push(Piece { channel, ranges, sink });
            }
            sinks.place(pieces, 120);
            assert_eq!(voxels(sinks), expected, "{channel_axis}");
        }
    }
}
