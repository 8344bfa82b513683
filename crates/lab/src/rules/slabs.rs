//! Image-aligned slabs (Mueller 1999): planes at equal view depths from the nearest to the farthest corner of the
//! volume's box, the same for every list.
//!
//! A list has one segment for every slab in which its ray meets matter, spanning that matter. Slabs are rendered one by
//! one, so matter behind opaque matter is kept.

use isinglass_core::camera::Basis;
use isinglass_core::space::Aabb;

use super::cuts::PlaneCuts;

/// Cuts a ray at the planes of `k` slabs. `s_per_depth` is the ray's distance per unit of view depth.
pub(super) fn cuts(k: usize, basis: &Basis, near: f32, bounds: &Aabb, s_per_depth: f32) -> PlaneCuts {
    let middle = (bounds.center() - basis.eye).dot(basis.forward);
    let reach = ((bounds.max - bounds.min) * 0.5).dot(basis.forward.abs());
    let first = (middle - reach).max(near);
    let thickness = (middle + reach - first) / k as f32;
    PlaneCuts::new(k, first * s_per_depth, thickness * s_per_depth, false)
}
