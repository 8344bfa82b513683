//! The visible part of the volume: a box, and one side of a plane. Twin of `clip_region` in
//! `shaders/shared/space.wgsl`.
//!
//! Clipping cuts the interval of a ray before anything else happens along it: box ∩ volume's box, then the
//! half-space. So nothing outside is marched, and a segment that reaches out is cut to its length inside.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::space::{Aabb, MAX_COORDINATE, Ray};

/// The visible part of a volume: the intersection of both, where given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Clip {
    /// The visible box, world space; `None` for all of the volume.
    #[serde(rename = "box")]
    pub bounds: Option<Aabb>,
    /// The plane with the visible side; `None` for both sides.
    pub plane: Option<Plane>,
}

/// A plane and its side: the points p with normal·p ≥ offset, world space.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "PlaneNumbers", into = "PlaneNumbers")]
pub struct Plane {
    /// Unit vector towards the visible side.
    pub normal: Vec3,
    /// Distance of the plane from the origin along the normal, world units.
    pub offset: f32,
}

/// Serialized form of a plane.
#[derive(Clone, Copy, Serialize, Deserialize)]
struct PlaneNumbers {
    normal: [f32; 3],
    offset: f32,
}

impl From<PlaneNumbers> for Plane {
    fn from(p: PlaneNumbers) -> Self {
        Self { normal: p.normal.into(), offset: p.offset }
    }
}

impl From<Plane> for PlaneNumbers {
    fn from(p: Plane) -> Self {
        Self { normal: p.normal.into(), offset: p.offset }
    }
}

impl Plane {
    /// The plane n·p = d for a normal of any length; `None` if the normal has no direction.
    pub fn new(normal: Vec3, d: f32) -> Option<Self> {
        let length = normal.length();
        let unit = normal.try_normalize()?;
        Some(Self { normal: unit, offset: d / length })
    }

    /// The same plane with the other side visible.
    pub fn flipped(self) -> Self {
        Self { normal: -self.normal, offset: -self.offset }
    }

    /// Distance of a point from the plane, positive on the visible side.
    pub fn distance(&self, point: Vec3) -> f32 {
        self.normal.dot(point) - self.offset
    }
}

/// Why a clip cannot be used.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
pub enum ClipError {
    /// A side of the box is empty or not a number.
    #[error("the clip box is empty, or not of finite numbers")]
    Box,
    /// The normal is not of unit length, or a number is not finite.
    #[error("the clip plane has no normal of unit length, or an offset that is not finite")]
    Plane,
}

impl Clip {
    /// Checks what the type cannot express.
    ///
    /// # Errors
    /// The first rule that it breaks.
    pub fn validate(&self) -> Result<(), ClipError> {
        let is_sound = |p: Vec3| p.is_finite() && p.abs().max_element() <= MAX_COORDINATE;
        if self.bounds.is_some_and(|b| !is_sound(b.min) || !is_sound(b.max) || b.min.cmpge(b.max).any()) {
            return Err(ClipError::Box);
        }
        let is_unit = |n: Vec3| n.is_finite() && (n.length_squared() - 1.0).abs() < 1e-3;
        if self.plane.is_some_and(|p| !is_unit(p.normal) || !is_sound(Vec3::splat(p.offset))) {
            return Err(ClipError::Plane);
        }
        Ok(())
    }

    /// The visible part of a volume in the box `volume`.
    pub fn region(&self, volume: &Aabb) -> Region {
        let mut region = Region { bounds: *volume, normal: Vec3::ZERO, offset: 0.0 };
        if let Some(plane) = self.plane {
            (region.normal, region.offset) = (plane.normal, plane.offset);
        }
        if let Some(clip) = self.bounds {
            region.bounds = Aabb {
                min: clip.min.clamp(volume.min, volume.max),
                max: clip.max.clamp(volume.min, volume.max),
            };
            if region.bounds.min.cmpge(region.bounds.max).any() {
                // Beside the volume the clamped box is empty, but a margin would give it an inside.
                (region.normal, region.offset) = (Vec3::ZERO, f32::MAX);
            }
        }
        region
    }

    /// Whether this shows nothing that `other` hides, for a volume in the box `volume`.
    pub fn is_within(&self, other: &Self, volume: &Aabb) -> bool {
        let (inner, outer) = (self.region(volume), other.region(volume));
        let is_boxed =
            inner.bounds.min.cmpge(outer.bounds.min).all() && inner.bounds.max.cmple(outer.bounds.max).all();
        // Tests all corners of the visible box, slightly inside because products round.
        let is_on_side = other.plane.is_none_or(|p| {
            let slack = 1e-6 * (volume.radius() + p.offset.abs());
            self.plane.is_some_and(|own| own.normal == p.normal && own.offset >= p.offset)
                || inner.bounds.corners().iter().all(|c| p.distance(*c) >= -slack)
        });
        inner.is_empty() || (is_boxed && is_on_side)
    }
}

/// The visible part of one volume: a box and a half-space. Without a plane the normal is zero, and every point is on
/// the visible side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// The box, world space.
    pub bounds: Aabb,
    /// Unit vector towards the visible side; zero without a plane.
    pub normal: Vec3,
    /// See [`Plane::offset`].
    pub offset: f32,
}

impl Region {
    /// The interval `[s0, s1]` of the ray inside, cut at the ray's origin; `None` if they do not meet.
    #[inline]
    pub fn clip(&self, ray: &Ray) -> Option<(f32, f32)> {
        let (mut s0, mut s1) = self.bounds.clip(ray)?;
        let a = self.normal.dot(ray.origin) - self.offset;
        let b = self.normal.dot(ray.dir);
        // Inside where a + b·s ≥ 0.
        if b > 0.0 {
            s0 = s0.max(-a / b);
        } else if b < 0.0 {
            s1 = s1.min(-a / b);
        } else if a < 0.0 {
            return None;
        }
        (s1 > s0).then_some((s0, s1))
    }

    /// The same, larger by `margin` on all sides.
    pub fn grown(&self, margin: f32) -> Self {
        let by = Vec3::splat(margin);
        let bounds = Aabb { min: self.bounds.min - by, max: self.bounds.max + by };
        Self { bounds, normal: self.normal, offset: self.offset - margin * self.normal.length() }
    }

    /// Whether it contains a point.
    pub fn contains(&self, point: Vec3) -> bool {
        let Aabb { min, max } = self.bounds;
        point.cmpge(min).all() && point.cmple(max).all() && self.normal.dot(point) >= self.offset
    }

    /// Whether nothing is left.
    pub fn is_empty(&self) -> bool {
        let Aabb { min, max } = self.bounds;
        let farthest = Vec3::select(self.normal.cmpge(Vec3::ZERO), max, min);
        min.cmpge(max).any() || self.normal.dot(farthest) < self.offset
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const VOLUME: Aabb = Aabb { min: Vec3::new(-1.0, -2.0, -3.0), max: Vec3::new(1.0, 2.0, 3.0) };

    fn boxed(min: Vec3, max: Vec3) -> Clip {
        Clip { bounds: Some(Aabb { min, max }), plane: None }
    }

    fn plane(normal: Vec3, d: f32) -> Clip {
        Clip { bounds: None, plane: Plane::new(normal, d) }
    }

    /// Directions in all octants, along the axes too.
    fn rays() -> impl Iterator<Item = Ray> {
        (0..343).filter(|i| *i != 171).map(|i| {
            let part = |n: i32| (n % 7 - 3) as f32;
            let dir = Vec3::new(part(i), part(i / 7), part(i / 49)).normalize();
            Ray { origin: Vec3::new(0.3, -0.2, 0.4) - dir * 9.0, dir }
        })
    }

    #[test]
    fn without_anything_to_clip_and_at_the_whole_box_no_bit_changes() {
        for ray in rays() {
            let plain = VOLUME.clip(&ray);
            assert_eq!(Clip::default().region(&VOLUME).clip(&ray), plain);
            assert_eq!(boxed(VOLUME.min, VOLUME.max).region(&VOLUME).clip(&ray), plain);
            assert_eq!(boxed(VOLUME.min * 9.0, VOLUME.max * 2.0).region(&VOLUME).clip(&ray), plain);
            assert_eq!(plane(Vec3::ONE, -50.0).region(&VOLUME).clip(&ray), plain);
        }
    }

    #[test]
    fn an_interval_is_what_is_inside() {
        let both =
            Clip { plane: Plane::new(Vec3::new(1.0, 2.0, -1.0), 0.3), ..boxed(Vec3::NEG_ONE, Vec3::ONE) };
        let (mut inside, mut outside) = (0, 0);
        for clip in [boxed(Vec3::splat(-0.5), Vec3::splat(0.7)), plane(Vec3::new(0.2, -1.0, 0.4), -0.1), both]
        {
            let region = clip.region(&VOLUME);
            for ray in rays() {
                let interval = region.clip(&ray);
                for i in 0..180 {
                    let s = i as f32 * 0.1 + 0.05;
                    let is_in = interval.is_some_and(|(s0, s1)| (s0..=s1).contains(&s));
                    // Within rounding of a border both are right.
                    let near =
                        region.grown(1e-4).contains(ray.at(s)) != region.grown(-1e-4).contains(ray.at(s));
                    assert!(near || is_in == region.contains(ray.at(s)), "{clip:?} {ray:?} {s}");
                    if is_in { inside += 1 } else { outside += 1 }
                }
            }
        }
        assert!(inside > 1000 && outside > 1000);
    }

    #[test]
    fn a_plane_and_its_opposite_share_a_ray_without_gap_or_overlap() {
        let cut = Plane::new(Vec3::new(0.3, 1.0, -0.2), 0.25).unwrap();
        let of = |p: Plane, ray: &Ray| Clip { plane: Some(p), bounds: None }.region(&VOLUME).clip(ray);
        let mut num_cut = 0;
        for ray in rays() {
            let (whole, a, b) = (VOLUME.clip(&ray), of(cut, &ray), of(cut.flipped(), &ray));
            if let (Some(a), Some(b)) = (a, b) {
                let (first, second) = if a.0 < b.0 { (a, b) } else { (b, a) };
                assert_eq!((first.1, Some((first.0, second.1))), (second.0, whole));
                num_cut += 1;
            } else {
                assert_eq!(a.or(b), whole);
            }
        }
        assert!(num_cut > 100, "{num_cut}");
    }

    #[test]
    fn beside_the_volume_nothing_is_left_with_any_margin() {
        let clip = boxed(Vec3::splat(10.0), Vec3::splat(11.0));
        assert_eq!(clip.validate(), Ok(()));
        let region = clip.region(&VOLUME).grown(5.0);
        assert!(clip.region(&VOLUME).is_empty() && rays().all(|ray| region.clip(&ray).is_none()));
        assert!(plane(Vec3::X, 1.5).region(&VOLUME).is_empty());
        assert!(
            !plane(Vec3::X, 0.5).region(&VOLUME).is_empty() && !Clip::default().region(&VOLUME).is_empty()
        );
    }

    #[test]
    fn what_is_within_another_is_known() {
        let (small, large) =
            (boxed(Vec3::splat(-0.5), Vec3::splat(0.5)), boxed(Vec3::splat(-0.6), Vec3::splat(0.5)));
        let (cut, less) = (plane(Vec3::X, 0.2), plane(Vec3::X, 0.1));
        for (inner, outer) in
            [(small, large), (cut, less), (small, Clip::default()), (small, plane(Vec3::X, -0.5))]
        {
            assert!(inner.is_within(&outer, &VOLUME) && inner.is_within(&inner, &VOLUME));
            assert!(!outer.is_within(&inner, &VOLUME));
        }
        assert!(!cut.is_within(&small, &VOLUME) && !small.is_within(&cut, &VOLUME));
    }

    #[test]
    fn numbers_of_a_peer_are_checked() {
        let nan = f32::NAN;
        for bad in [
            boxed(Vec3::ZERO, Vec3::new(1.0, 0.0, 1.0)),
            boxed(Vec3::ONE, Vec3::ZERO),
            boxed(Vec3::new(nan, 0.0, 0.0), Vec3::ONE),
            boxed(Vec3::ZERO, Vec3::splat(f32::INFINITY)),
            boxed(Vec3::splat(-1e30), Vec3::ONE),
        ] {
            assert_eq!(bad.validate(), Err(ClipError::Box), "{bad:?}");
        }
        for (normal, offset) in
            [(Vec3::ZERO, 0.0), (Vec3::X * 2.0, 0.0), (Vec3::X, nan), (Vec3::splat(nan), 0.0)]
        {
            let bad = Clip { bounds: None, plane: Some(Plane { normal, offset }) };
            assert_eq!(bad.validate(), Err(ClipError::Plane), "{bad:?}");
        }
        assert_eq!(Plane::new(Vec3::ZERO, 1.0), None);
        assert_eq!(Plane::new(Vec3::Z * 4.0, 2.0), Some(Plane { normal: Vec3::Z, offset: 0.5 }));
    }
}
