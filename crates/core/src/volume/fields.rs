//! Closed-form extinction fields with exact ray integrals, which verify the kernels.
//!
//! Each field fills the box of a volume. Its value *is* its extinction in inverse world units, so a table with linear
//! σ(x) classifies it.

use glam::Vec3;

use super::grid::{Volume, VolumeInfo, Voxels};
use crate::space::Ray;

/// An extinction field σ(p) whose optical depth along any ray is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Field {
    /// The same σ everywhere.
    Constant(f32),
    /// σ = `at_zero` + `slope`·x: a ramp along world x.
    Ramp {
        /// Extinction in the plane x = 0.
        at_zero: f32,
        /// Change per world unit.
        slope: f32,
    },
    /// σ = `peak`·(1 − r²/R²) inside the radius R around the origin, 0 outside.
    Sphere {
        /// Extinction at the centre.
        peak: f32,
        /// Radius, world units.
        radius: f32,
    },
}

impl Field {
    /// Extinction at a point of world space.
    pub fn sigma(&self, p: Vec3) -> f32 {
        match *self {
            Self::Constant(sigma) => sigma,
            Self::Ramp { at_zero, slope } => at_zero + slope * p.x,
            Self::Sphere { peak, radius } => peak * (1.0 - p.length_squared() / (radius * radius)).max(0.0),
        }
    }

    /// Optical depth ∫σ ds between the distances `s0` and `s1` of the ray, exact.
    pub fn optical_depth(&self, ray: &Ray, s0: f32, s1: f32) -> f64 {
        let (s0, s1) = (f64::from(s0), f64::from(s1));
        let (o, d) = (ray.origin.as_dvec3(), ray.dir.as_dvec3());
        match *self {
            Self::Constant(sigma) => f64::from(sigma) * (s1 - s0),
            Self::Ramp { at_zero, slope } => {
                let mid = o.x + d.x * (s0 + s1) * 0.5;
                (f64::from(at_zero) + f64::from(slope) * mid) * (s1 - s0)
            }
            Self::Sphere { peak, radius } => {
                let r2 = f64::from(radius).powi(2);
                let nearest = -o.dot(d);
                let b2 = (o + d * nearest).length_squared();
                if b2 >= r2 {
                    return 0.0;
                }
                let half = (r2 - b2).sqrt();
                let a = (s0 - nearest).clamp(-half, half);
                let b = (s1 - nearest).clamp(-half, half);
                let antiderivative = |t: f64| (1.0 - b2 / r2) * t - t * t * t / (3.0 * r2);
                f64::from(peak) * (antiderivative(b) - antiderivative(a))
            }
        }
    }

    /// The field sampled at the voxel centres of an `n`³ volume with sides of two world units.
    pub fn volume(&self, n: u32) -> Volume {
        let spacing = 2.0 / n as f32;
        let at = |i: u32| (i as f32 + 0.5) * spacing - 1.0;
        let voxels =
            (0..n * n * n).map(|i| self.sigma(Vec3::new(at(i % n), at(i / n % n), at(i / n / n)))).collect();
        let info = VolumeInfo { name: format!("{self:?}"), dtype: "float".into(), ..Default::default() };
        Volume::new([n; 3], Vec3::splat(spacing), Voxels::F32(voxels), (1.0, 0.0), info)
            .expect("a field makes finite voxels of the right number")
    }
}
