//! Turns the segments of a ray in world distance into those of a frame in depth units. Twin of the end of
//! `shaders/layering/generate.wgsl`.
//!
//! A segment is at least [`MIN_UNITS`] thick, so thin segments push those behind them away. Casts end where the
//! volume does, so a list that becomes too long is pushed back from its end. A list without room for all of its
//! segments spans less than two tenths of a scan's voxel. It becomes one segment; no view tells its parts apart.

use super::{OpenSegment, SegmentList, append};
use crate::camera::Camera;
use crate::layer::{DEPTH_UNITS, MAX_K, Segment, TAU_MAX, depth_to_units};
use crate::mode::Compositing;

/// Emits the segments of a list front to back.
pub(super) fn list(
    camera: &Camera,
    compositing: Compositing,
    list: &mut SegmentList,
    s_per_depth: f32,
    push: impl FnOnce(&[Segment]),
) {
    let Some(last) = list.len.checked_sub(1) else { return };
    let first_front = units(camera, list.segments[0].s0 / s_per_depth);
    let last_back = units(camera, list.segments[last].s1 / s_per_depth);
    let [front, back] = [first_front, last_back].map(usize::from);
    if last > 0 && back < front + list.len * usize::from(MIN_UNITS) {
        let (one, others) = list.segments.split_at_mut(1);
        for other in &others[..last] {
            unite(compositing, &mut one[0], other);
        }
        list.len = 1;
    }
    let mut closed = [Segment::default(); MAX_K];
    let closed = &mut closed[..list.len];
    let mut before = 0;
    for (segment, closed) in list.segments.iter().zip(closed.iter_mut()) {
        *closed = segment_behind(camera, segment, s_per_depth, before);
        before = closed.back;
    }
    let mut end = last_back.max(first_front + MIN_UNITS);
    for segment in closed.iter_mut().rev() {
        segment.back = segment.back.min(end);
        segment.front = segment.front.min(segment.back - MIN_UNITS);
        end = segment.front;
    }
    push(closed);
}

/// Rounds the ends of a segment to depth units behind `last_back`, at least [`MIN_UNITS`] apart.
pub fn segment_behind(camera: &Camera, segment: &OpenSegment, s_per_depth: f32, last_back: u16) -> Segment {
    let front = units(camera, segment.s0 / s_per_depth).max(last_back);
    let back = units(camera, segment.s1 / s_per_depth).max(front.saturating_add(MIN_UNITS));
    Segment { front, back, c: segment.c, tau: segment.tau.min(TAU_MAX) }
}

/// The nearest depth unit to a view depth, with room for a segment behind it.
fn units(camera: &Camera, depth: f32) -> u16 {
    let greatest = DEPTH_UNITS - f32::from(MIN_UNITS);
    (depth_to_units(camera, depth) + 0.5).clamp(0.0, greatest) as u16
}

/// Merges a segment with the one behind it, so that a ray through both sees the same.
fn unite(compositing: Compositing, segment: &mut OpenSegment, behind: &OpenSegment) {
    match compositing {
        Compositing::Over => append(segment, behind),
        Compositing::Greatest if behind.tau > segment.tau => {
            (segment.c, segment.tau) = (behind.c, behind.tau);
        }
        Compositing::Greatest => (),
        Compositing::Mean => segment.c += behind.c,
    }
    segment.s1 = behind.s1;
}

/// Least thickness of a segment, depth units. Single precision finds a crossing to about 1/200 of a unit, so the
/// crossed part of such a segment is known to 1/1000. A unit is 1/16384 of the volume's diameter, far below any
/// parallax.
pub const MIN_UNITS: u16 = 4;
