//! The named spaces, and the conventions that hold in all of isinglass.
//!
//! - **voxel**: continuous; voxel `i` covers `[i, i+1)` and its centre is at `i + 0.5`. x runs fastest in memory.
//! - **world**: physical length (the unit of the volume's spacing). Right-handed. The centre of the volume's box is
//!   the origin; the axes are the volume's own.
//! - **upright**: world space turned so that +y is up and +z to the front ([`world_from_upright`]): what angles of an
//!   orbit are told in.
//! - **view**: right-handed, +x right, +y up; the camera looks along −z. *Depth* is −z, positive in front.
//! - **pixel**: continuous; pixel `i` covers `[i, i+1)`; x runs right, y runs *down*, row 0 is the top.
//!
//! Transforms are named `a_from_b`. Lengths named `s` are world distances along a ray with a unit direction.

use glam::{Mat3, Quat, Vec3};
use serde::{Deserialize, Serialize};

/// A ray in world space; `dir` has unit length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Start of the ray, world space.
    pub origin: Vec3,
    /// Unit direction, world space.
    pub dir: Vec3,
}

impl Ray {
    /// The point at world distance `s` from the origin.
    pub fn at(&self, s: f32) -> Vec3 {
        self.origin + self.dir * s
    }
}

/// The rotation from upright to world space for axes that point to `letters`, such as `RAS`: a body's superior side
/// is up and its anterior side in front. Without letters that name one end of each axis, up is y and z points to the
/// front. The axes of an image ([`IMAGE_AXES`]) are seen as on a page.
pub fn world_from_upright(letters: Option<&str>) -> Quat {
    match letters {
        // Half a turn about x.
        Some(IMAGE_AXES) => Quat::from_xyzw(1.0, 0.0, 0.0, 0.0),
        letters => letters.and_then(upright_body).unwrap_or(Quat::IDENTITY),
    }
}

/// The letters of an image: x runs to the right, y down, and z back from the viewer. So the first row is at the top,
/// and the first slice is the nearest.
pub const IMAGE_AXES: &str = "RDB";

/// Whether axes that point to `letters` are those of a body, and not of an image or of nothing known.
pub fn are_of_body(letters: Option<&str>) -> bool {
    letters.is_some_and(|letters| upright_body(letters).is_some())
}

fn upright_body(letters: &str) -> Option<Quat> {
    let ends: [char; 3] = letters.chars().collect::<Vec<_>>().try_into().ok()?;
    let towards = |positive: char, negative: char| {
        ends.iter().zip(Vec3::AXES).find_map(|(&end, axis)| match end {
            end if end == positive => Some(axis),
            end if end == negative => Some(-axis),
            _ => None,
        })
    };
    towards('R', 'L')?;
    let (front, up) = (towards('A', 'P')?, towards('S', 'I')?);
    Some(Quat::from_mat3(&Mat3::from_cols(up.cross(front), up, front)).normalize())
}

/// An axis-aligned box in world space.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "Corners", into = "Corners")]
pub struct Aabb {
    /// Least corner.
    pub min: Vec3,
    /// Greatest corner.
    pub max: Vec3,
}

/// Serialized form of a box.
#[derive(Clone, Copy, Serialize, Deserialize)]
struct Corners {
    min: [f32; 3],
    max: [f32; 3],
}

impl From<Corners> for Aabb {
    fn from(corners: Corners) -> Self {
        Self { min: corners.min.into(), max: corners.max.into() }
    }
}

impl From<Aabb> for Corners {
    fn from(bounds: Aabb) -> Self {
        Self { min: bounds.min.into(), max: bounds.max.into() }
    }
}

impl Aabb {
    /// The interval `[s0, s1]` of the ray inside the box, cut at the ray's origin; `None` if they do not meet.
    ///
    /// A zero component of the direction is replaced by a tiny one of the same sign, so no NaN can arise (slab
    /// method).
    pub fn clip(&self, ray: &Ray) -> Option<(f32, f32)> {
        let inv = safe_dir(ray.dir).recip();
        let a = (self.min - ray.origin) * inv;
        let b = (self.max - ray.origin) * inv;
        let s0 = a.min(b).max_element().max(0.0);
        let s1 = a.max(b).min_element();
        (s1 > s0).then_some((s0, s1))
    }

    /// The eight corners.
    pub fn corners(&self) -> [Vec3; 8] {
        std::array::from_fn(|i| {
            let side =
                |bit: usize, axis: usize| if i >> bit & 1 == 0 { self.min[axis] } else { self.max[axis] };
            Vec3::new(side(0, 0), side(1, 1), side(2, 2))
        })
    }

    /// Half of the diagonal: the radius of the bounding sphere around [`Aabb::center`].
    pub fn radius(&self) -> f32 {
        (self.max - self.min).length() * 0.5
    }

    /// The middle of the box.
    pub fn center(&self) -> Vec3 {
        (self.min + self.max) * 0.5
    }
}

/// The unit vector `dir` with every component at least 1e-9 away from zero, so that it can be inverted.
pub fn safe_dir(dir: Vec3) -> Vec3 {
    let fix = |c: f32| if c.abs() < TINY_DIR { TINY_DIR.copysign(c) } else { c };
    Vec3::new(fix(dir.x), fix(dir.y), fix(dir.z))
}

/// Least magnitude of a direction component that is divided by.
const TINY_DIR: f32 = 1e-9;

/// Largest coordinate of a point that is given, world units: beyond the largest volume, with products in single
/// precision.
pub const MAX_COORDINATE: f32 = 1e18;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clip_from_outside_inside_and_beside() {
        let cube = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let along_x = |origin| Ray { origin, dir: Vec3::X };
        assert_eq!(cube.clip(&along_x(Vec3::new(-3.0, 0.0, 0.0))), Some((2.0, 4.0)));
        assert_eq!(cube.clip(&along_x(Vec3::ZERO)), Some((0.0, 1.0)));
        assert_eq!(cube.clip(&along_x(Vec3::new(3.0, 0.0, 0.0))), None);
        assert_eq!(cube.clip(&along_x(Vec3::new(-3.0, 1.5, 0.0))), None);
    }

    #[test]
    fn a_body_stands_upright_and_faces_the_front() {
        let axis = |letters: &str, end: char| {
            let opposite =
                |c| "RLAPSI".chars().zip("LRPAIS".chars()).find_map(|(a, b)| (a == c).then_some(b));
            let signs = letters.chars().map(|c| match c {
                c if c == end => 1.0,
                c if Some(c) == opposite(end) => -1.0,
                _ => 0.0,
            });
            Vec3::from_slice(&signs.collect::<Vec<f32>>())
        };
        for letters in ["RAS", "LPS", "LIP", "ASR", "SRA"] {
            let turn = world_from_upright(Some(letters));
            assert!((turn * Vec3::Y - axis(letters, 'S')).length() < 1e-6, "{letters}");
            assert!((turn * Vec3::Z - axis(letters, 'A')).length() < 1e-6, "{letters}");
            // Whoever faces the viewer has the left hand at the viewer's right.
            assert!((turn * Vec3::X - axis(letters, 'L')).length() < 1e-6, "{letters}");
        }
        let image = world_from_upright(Some(IMAGE_AXES));
        assert_eq!([Vec3::X, Vec3::Y, Vec3::Z].map(|v| image * v), [Vec3::X, Vec3::NEG_Y, Vec3::NEG_Z]);
        assert!(are_of_body(Some("LPS")) && !are_of_body(Some(IMAGE_AXES)) && !are_of_body(None));
        for other in [None, Some(""), Some("RAX"), Some("RLS"), Some("RASA"), Some("räs")] {
            assert_eq!(world_from_upright(other), Quat::IDENTITY, "{other:?}");
        }
    }
}
