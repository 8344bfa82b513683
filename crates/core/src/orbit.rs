//! Views as written on a command line: `AZ,EL[,DIST]` around the volume's centre.

use std::str::FromStr;

use crate::camera::{Camera, Intrinsics, Pose};
use crate::layer::FrameHeader;
use crate::space::{Aabb, world_from_upright};
use glam::{Quat, Vec3};

/// A place on a sphere around the volume's centre, looking at it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orbit {
    /// Azimuth, degrees; positive moves the eye towards +x of its space.
    pub azimuth_degrees: f32,
    /// Elevation, degrees; positive moves the eye towards +y of its space.
    pub elevation_degrees: f32,
    /// Distance of the eye from the centre, radii of the bounding sphere; `None` fits the sphere into the view.
    pub distance_in_radii: Option<f32>,
    /// Rotation from the space of the angles to world space; the identity uses the volume's own axes.
    pub world_from_angles: Quat,
}

impl Default for Orbit {
    fn default() -> Self {
        Self {
            azimuth_degrees: 30.0,
            elevation_degrees: 20.0,
            distance_in_radii: None,
            world_from_angles: Quat::IDENTITY,
        }
    }
}

impl Orbit {
    /// The same place, turned by `degrees` of azimuth.
    pub fn turned(self, degrees: f32) -> Self {
        Self { azimuth_degrees: self.azimuth_degrees + degrees, ..self }
    }

    /// The same angles in the upright space of a volume whose axes point to `letters`.
    pub fn upright(self, letters: Option<&str>) -> Self {
        Self { world_from_angles: world_from_upright(letters), ..self }
    }

    /// The camera at this place.
    pub fn camera(&self, intrinsics: Intrinsics, bounds: &Aabb) -> Camera {
        Camera::new(self.pose(&intrinsics, bounds), intrinsics, bounds)
    }

    /// The pose at this place.
    pub fn pose(&self, intrinsics: &Intrinsics, bounds: &Aabb) -> Pose {
        let distance = self.distance_in_radii.unwrap_or_else(|| intrinsics.fit_distance()) * bounds.radius();
        self.pose_at(bounds.center(), distance)
    }

    fn pose_at(&self, center: Vec3, distance: f32) -> Pose {
        let (azimuth, elevation) = (self.azimuth_degrees.to_radians(), self.elevation_degrees.to_radians());
        let upright = Pose::orbit(Vec3::ZERO, azimuth, elevation, distance);
        let turn = self.world_from_angles;
        Pose {
            eye: center + turn * upright.eye,
            world_from_view: (turn * upright.world_from_view).normalize(),
        }
    }
}

impl FromStr for Orbit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected =
            || format!("found {text:?}, expected AZ,EL or AZ,EL,DIST: degrees and radii, such as 30,20");
        let numbers = text
            .split(',')
            .map(|part| part.trim().parse::<f32>().ok().filter(|x| x.is_finite()).ok_or_else(expected))
            .collect::<Result<Vec<_>, _>>()?;
        let (azimuth_degrees, elevation_degrees, distance_in_radii) = match numbers[..] {
            [azimuth, elevation] => (azimuth, elevation, None),
            [azimuth, elevation, distance] => (azimuth, elevation, Some(distance)),
            _ => return Err(expected()),
        };
        if distance_in_radii.is_some_and(|d| !(0.0..=MAX_DISTANCE_IN_RADII).contains(&d)) {
            return Err(format!(
                "distance in {text:?} is out of range, expected 0 to {MAX_DISTANCE_IN_RADII} radii"
            ));
        }
        Ok(Self { azimuth_degrees, elevation_degrees, distance_in_radii, ..Self::default() })
    }
}

/// Radius of the bounding sphere of a frame's volume. Its centre is the world's origin, and it ends at the far plane
/// ([`Camera::new`]).
pub fn radius_from_header(header: &FrameHeader) -> f32 {
    let camera = &header.camera;
    let center_depth = (-camera.pose.eye).dot(camera.pose.forward());
    let sphere = camera.far - center_depth;
    // A camera that looks away from the volume has a clamped far plane, with the whole frame in front of it.
    if sphere > 0.0 { sphere } else { camera.pose.eye.length() + camera.far }
}

/// A box around a frame's volume: that of its bounding sphere, because the header does not know the volume's own.
pub fn bounds_from_header(header: &FrameHeader) -> Aabb {
    let half = Vec3::splat(radius_from_header(header));
    Aabb { min: -half, max: half }
}

/// A camera around a stored frame's volume. Without a distance it is as far away as the frame's own.
pub fn orbit_of_frame(orbit: &Orbit, intrinsics: Intrinsics, header: &FrameHeader) -> Camera {
    let radius = radius_from_header(header);
    let distance = orbit.distance_in_radii.map_or_else(|| header.camera.pose.eye.length(), |d| d * radius);
    Camera::new(orbit.pose_at(Vec3::ZERO, distance), intrinsics, &sphere_box_from_header(header))
}

/// The cube inside the bounding sphere of a frame's volume. The volume's own box may reach beyond its sides.
pub fn sphere_box_from_header(header: &FrameHeader) -> Aabb {
    let half = Vec3::splat(radius_from_header(header) / 3f32.sqrt());
    Aabb { min: -half, max: half }
}

/// Pictures from farther away are empty.
const MAX_DISTANCE_IN_RADII: f32 = 1e4;

#[cfg(test)]
mod tests {

    use super::*;

    #[test]
    fn an_orbit_is_read_and_nonsense_is_refused() {
        let orbit = |s: &str| s.parse::<Orbit>();
        let read = Orbit {
            azimuth_degrees: -30.5,
            elevation_degrees: 20.0,
            distance_in_radii: Some(2.5),
            ..Orbit::default()
        };
        assert_eq!(orbit("-30.5,20,2.5"), Ok(read));
        assert_eq!(orbit("0, -90").unwrap().elevation_degrees, -90.0);
        for bad in ["", "1", "1,2,3,4", "a,b", "nan,0", "0,inf", "0,0,-1", "0,0,1e9", "1;2"] {
            let error = orbit(bad).unwrap_err();
            assert!(error.contains(&format!("{bad:?}")), "{error}");
        }
    }

    /// The header does not hold the volume's box; what is derived from it must bring back the generating camera.
    #[test]
    fn a_frame_is_seen_from_where_it_was_made() {
        let bounds = Aabb { min: Vec3::new(-1.0, -2.0, -0.5), max: Vec3::new(1.0, 2.0, 0.5) };
        let intrinsics = Intrinsics::perspective(40, 30, 0.6);
        for distance_in_radii in [None, Some(0.5), Some(0.0), Some(7.0)] {
            let turned = Orbit { azimuth_degrees: 33.0, elevation_degrees: -12.0, ..Orbit::default() };
            let orbit = Orbit { distance_in_radii, ..turned }.upright(Some("LPS"));
            let camera = orbit.camera(intrinsics, &bounds);
            let header = FrameHeader::alone(camera, 8);
            // Single precision over a few operations on numbers of the order of 10.
            assert!((radius_from_header(&header) - bounds.radius()).abs() < 1e-4);
            let again = orbit_of_frame(&Orbit { distance_in_radii: None, ..orbit }, intrinsics, &header);
            assert!((again.pose.eye - camera.pose.eye).length() < 1e-4);
            assert!((again.far - camera.far).abs() < 1e-4);
            let turned = orbit_of_frame(&orbit.turned(10.0), intrinsics, &header);
            let other = distance_in_radii == Some(0.0) || (turned.pose.eye - camera.pose.eye).length() > 0.1;
            assert!(other, "a turned camera must not pass for the same");
        }
    }
}
