//! The user's choices for lighting: shade, highlights, and the direction of the light.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::space::IMAGE_AXES;

/// Direction of the light, strength of the shade, and highlights. Light is fixed in the world, so only highlights
/// depend on the view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Lighting {
    /// Strength of ambient occlusion, 0 for none to 1.
    pub ambient_occlusion: f32,
    /// Reach of occlusion, radii of the volume's bounding sphere, [`OCCLUSION_RADIUS_MIN`] to
    /// [`OCCLUSION_RADIUS_MAX`].
    pub occlusion_radius: f32,
    /// Fraction of the light that comes from the one source and throws shadows, 0 for none to 1.
    pub shadows: f32,
    /// Angular radius of that source, degrees, 0 to [`SOFTNESS_MAX_DEGREES`].
    pub softness_degrees: f32,
    /// Direction of the light as an orbit's azimuth: 0 from +z, 90 from +x; degrees, -180 to 180.
    pub azimuth_degrees: f32,
    /// Direction of the light as an orbit's elevation: 90 from +y; degrees, -90 to 90.
    pub elevation_degrees: f32,
    /// Strength of the highlights of shaded matter, 0 for none to 1.
    pub specular: f32,
    /// Exponent of the highlights: the higher, the smaller they are. 1 to [`SHININESS_MAX`].
    pub shininess: f32,
}

/// A number of a [`Lighting`] is out of range.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq)]
#[error("{what} is {found}, expected {least} to {most}")]
pub struct LightingError {
    /// Name of the number.
    pub what: &'static str,
    /// Its value.
    pub found: f32,
    /// Least accepted value.
    pub least: f32,
    /// Greatest accepted value.
    pub most: f32,
}

impl Default for Lighting {
    fn default() -> Self {
        Self {
            ambient_occlusion: 0.0,
            occlusion_radius: 0.15,
            shadows: 0.0,
            softness_degrees: 8.0,
            azimuth_degrees: -34.29,
            elevation_degrees: 36.9,
            specular: 0.0,
            shininess: 20.0,
        }
    }
}

impl Lighting {
    /// Whether there is any occlusion or shadow.
    pub fn is_on(&self) -> bool {
        self.ambient_occlusion > 0.0 || self.shadows > 0.0
    }

    /// Unit vector towards the light, world space.
    pub fn direction(&self) -> Vec3 {
        let (sin_az, cos_az) = self.azimuth_degrees.to_radians().sin_cos();
        let (sin_el, cos_el) = self.elevation_degrees.to_radians().sin_cos();
        Vec3::new(sin_az * cos_el, sin_el, cos_az * cos_el)
    }

    /// The same with the light in a direction, which need not be of unit length.
    pub fn towards(self, direction: Vec3) -> Self {
        let Some(d) = direction.try_normalize() else { return self };
        let elevation_degrees = d.y.clamp(-1.0, 1.0).asin().to_degrees();
        // Straight above, the azimuth is kept, so a drag over the pole comes out where it went in.
        let flat = d.x.hypot(d.z) > 1e-6;
        let azimuth_degrees = if flat { d.x.atan2(d.z).to_degrees() } else { self.azimuth_degrees };
        Self { azimuth_degrees, elevation_degrees, ..self }
    }

    /// The same light for a volume whose axes point to `letters`. The first slice of an image is nearest, so its light
    /// comes from there: half a turn about x. The light of a body is fixed to its axes.
    pub fn upright(self, letters: Option<&str>) -> Self {
        if letters != Some(IMAGE_AXES) {
            return self;
        }
        let azimuth_degrees = 180f32.copysign(self.azimuth_degrees) - self.azimuth_degrees;
        Self { azimuth_degrees, elevation_degrees: -self.elevation_degrees, ..self }
    }

    /// Checks that every number is in its range.
    ///
    /// # Errors
    /// The first one that is not.
    pub fn validate(&self) -> Result<(), LightingError> {
        let ranges = [
            ("ambient occlusion", self.ambient_occlusion, 0.0, 1.0),
            (
                "radius of the ambient occlusion",
                self.occlusion_radius,
                OCCLUSION_RADIUS_MIN,
                OCCLUSION_RADIUS_MAX,
            ),
            ("strength of the shadows", self.shadows, 0.0, 1.0),
            ("softness of the shadows", self.softness_degrees, 0.0, SOFTNESS_MAX_DEGREES),
            ("azimuth of the light", self.azimuth_degrees, -180.0, 180.0),
            ("elevation of the light", self.elevation_degrees, -90.0, 90.0),
            ("specular", self.specular, 0.0, 1.0),
            ("shininess", self.shininess, 1.0, SHININESS_MAX),
        ];
        for (what, found, least, most) in ranges {
            if !(least..=most).contains(&found) {
                return Err(LightingError { what, found, least, most });
            }
        }
        Ok(())
    }
}

/// Least reach of ambient occlusion, in radii of the bounding sphere.
pub const OCCLUSION_RADIUS_MIN: f32 = 0.02;
/// Farthest reach of ambient occlusion.
pub const OCCLUSION_RADIUS_MAX: f32 = 0.5;
/// Widest source of light, degrees.
pub const SOFTNESS_MAX_DEGREES: f32 = 45.0;
/// Smallest highlights.
pub const SHININESS_MAX: f32 = 128.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::space::world_from_upright;

    #[test]
    fn the_light_is_where_its_angles_say() {
        let at = |azimuth_degrees, elevation_degrees| {
            Lighting { azimuth_degrees, elevation_degrees, ..Lighting::default() }.direction()
        };
        for (found, expected) in [
            (at(0.0, 0.0), Vec3::Z),
            (at(90.0, 0.0), Vec3::X),
            (at(77.0, 90.0), Vec3::Y),
            (at(-180.0, 0.0), -Vec3::Z),
        ] {
            assert!((found - expected).length() < 1e-6, "{found} for {expected}");
        }
        let image = Lighting::default().upright(Some(IMAGE_AXES));
        let turned = world_from_upright(Some(IMAGE_AXES)) * Lighting::default().direction();
        assert!((image.direction() - turned).length() < 1e-6 && image.validate() == Ok(()));
        assert_eq!(Lighting::default().upright(Some("RAS")), Lighting::default());
        for d in [Vec3::new(0.3, -0.2, 0.9), Vec3::new(-5.0, 2.0, -1.0), Vec3::Y, Vec3::NEG_Y] {
            let towards = Lighting::default().towards(d);
            assert_eq!(towards.validate(), Ok(()));
            assert!((towards.direction() - d.normalize()).length() < 1e-6);
        }
        assert_eq!(Lighting::default().towards(Vec3::ZERO), Lighting::default());
    }

    #[test]
    fn numbers_out_of_range_are_named() {
        let good = Lighting::default();
        assert_eq!(good.validate(), Ok(()));
        for bad in [
            Lighting { ambient_occlusion: 1.1, ..good },
            Lighting { occlusion_radius: 0.0, ..good },
            Lighting { shadows: f32::NAN, ..good },
            Lighting { softness_degrees: 46.0, ..good },
            Lighting { azimuth_degrees: 181.0, ..good },
            Lighting { elevation_degrees: f32::INFINITY, ..good },
            Lighting { specular: f32::NAN, ..good },
            Lighting { specular: -0.1, ..good },
            Lighting { specular: 1.01, ..good },
            Lighting { shininess: f32::NAN, ..good },
            Lighting { shininess: 0.5, ..good },
            Lighting { shininess: 129.0, ..good },
        ] {
            let error = bad.validate().expect_err("a number is out of range").to_string();
            assert!(error.contains(", expected ") && !error.contains('\n'), "{error}");
        }
    }
}
