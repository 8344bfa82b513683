//! Brightness of every voxel under a light that is fixed in the world, computed once for a look.
//!
//! What light does to matter depends only on the gradient, not on the view or the classification. So each voxel keeps
//! it in a byte, and a march interpolates it (Gouraud shading in three dimensions). That costs one more sample, in
//! place of the 32 voxels and the square root of a gradient.

use glam::Vec3;
use rayon::prelude::*;

use super::grid::{Volume, Voxels};
use super::lighting::Lighting;

/// Two-sided diffuse shading by the gradient, from a light fixed in the world. It does not depend on the view, like
/// the colours of a layered frame (Lochmann 2016, section 5: isotropic emission).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shading {
    /// Brightness of matter seen edge-on by the light.
    pub ambient: f32,
    /// Brightness added where the gradient points along the light.
    pub diffuse: f32,
    /// Unit direction towards the light, world space.
    pub light: Vec3,
    /// Gradient at which half of the shading acts, domain positions per voxel. Flatter matter tends to the mean over
    /// all directions, |cos| = ½.
    pub half_gradient: f32,
}

impl Default for Shading {
    fn default() -> Self {
        Self { ambient: 0.25, diffuse: 0.85, light: Lighting::default().direction(), half_gradient: 0.01 }
    }
}

/// The diffuse share of every voxel, in units of 1/[`LIT_MAX`]: its brightness is ambient + diffuse·share.
#[derive(Clone, Debug, PartialEq)]
pub struct Lit {
    /// The shares, x fastest.
    pub shares: Vec<u8>,
    /// Brightness of share 0.
    pub ambient: f32,
    /// Brightness added by a full share.
    pub diffuse: f32,
}

impl Lit {
    /// Lights a volume by its gradients, in parallel. `x_scale`: domain positions per stored unit
    /// ([`x_scale`](crate::transfer::TransferTable::x_scale)).
    pub fn of(volume: &Volume, shading: Shading, x_scale: f32) -> Self {
        let shares = match volume.voxels() {
            Voxels::U8(v) => light(v, volume, &shading, x_scale),
            Voxels::U16(v) => light(v, volume, &shading, x_scale),
            Voxels::F32(v) => light(v, volume, &shading, x_scale),
        };
        Self { shares, ambient: shading.ambient, diffuse: shading.diffuse }
    }
}

/// Computes the share of every voxel, row by row.
fn light<T: Copy + Into<f32> + Sync>(
    voxels: &[T],
    volume: &Volume,
    shading: &Shading,
    x_scale: f32,
) -> Vec<u8> {
    let [nx, ny, nz] = volume.dims().map(|d| d as usize);
    // Only the direction matters; this scale keeps squares from overflowing.
    let spacing = volume.finest_spacing();
    let voxel_from_world = spacing.min_element() / spacing;
    let half_scale = volume.steepness() * (0.5 * x_scale);
    let half_squared = shading.half_gradient * shading.half_gradient;
    let mut shares = vec![0u8; voxels.len()];
    shares.par_chunks_mut(nx * ny).enumerate().for_each(|(z, slice)| {
        let mut rows = RowDifferences::new(nx);
        for (y, out) in slice.chunks_mut(nx).enumerate() {
            let row = |y: usize, z: usize| &voxels[(z * ny + y) * nx..][..nx];
            rows.difference(
                row(y, z),
                [row(y.saturating_sub(1), z), row((y + 1).min(ny - 1), z)],
                [row(y, z.saturating_sub(1)), row(y, (z + 1).min(nz - 1))],
            );
            for (((share, &dx), &dy), &dz) in out.iter_mut().zip(&rows.dx).zip(&rows.dy).zip(&rows.dz) {
                let per_voxel = (Vec3::new(dx, dy, dz) * half_scale)
                    .clamp(Vec3::splat(-GRADIENT_MAX), Vec3::splat(GRADIENT_MAX));
                let strength = per_voxel.length_squared();
                let normal = per_voxel * voxel_from_world;
                // Without a gradient the weight is zero; the floor only avoids a division by zero.
                let length = normal.length_squared().max(f32::MIN_POSITIVE).sqrt();
                let lambert = normal.dot(shading.light).abs() / length;
                let weight = strength / (strength + half_squared).max(f32::MIN_POSITIVE);
                let lit = 0.5 + (lambert - 0.5) * weight;
                *share = (lit * LIT_MAX + 0.5) as u8;
            }
        }
    });
    shares
}

/// Central differences along one row, twice the gradient. They have a loop of their own so that both loops compile to
/// vector instructions.
struct RowDifferences {
    dx: Vec<f32>,
    dy: Vec<f32>,
    dz: Vec<f32>,
}

impl RowDifferences {
    fn new(nx: usize) -> Self {
        let row = vec![0.0; nx];
        Self { dx: row.clone(), dy: row.clone(), dz: row }
    }

    /// `here` is the row itself; `beside` and `across` are its neighbours along y and z. Beyond the grid the
    /// outermost voxel repeats.
    fn difference<T: Copy + Into<f32>>(&mut self, here: &[T], beside: [&[T]; 2], across: [&[T]; 2]) {
        let difference = |a: &T, b: &T| (*b).into() - (*a).into();
        let n = here.len();
        let inner = self.dx.get_mut(1..n - 1).unwrap_or_default();
        for (d, (a, b)) in inner.iter_mut().zip(here.iter().zip(here.get(2..).unwrap_or_default())) {
            *d = difference(a, b);
        }
        self.dx[0] = difference(&here[0], &here[1.min(n - 1)]);
        self.dx[n - 1] = difference(&here[n.saturating_sub(2)], &here[n - 1]);
        for (d, (a, b)) in self.dy.iter_mut().zip(beside[0].iter().zip(beside[1])) {
            *d = difference(a, b);
        }
        for (d, (a, b)) in self.dz.iter_mut().zip(across[0].iter().zip(across[1])) {
            *d = difference(a, b);
        }
    }
}

/// Units of a full share.
pub const LIT_MAX: f32 = 255.0;
/// Steepest gradient, domain positions per voxel: its square is finite. Only domains far narrower than the values
/// have steeper ones.
pub const GRADIENT_MAX: f32 = 1e6;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::VolumeInfo;

    /// Shares of the volume whose voxel (x, y, z) stores `f(x, y, z)`.
    fn lit(dims: [u32; 3], spacing: Vec3, shading: Shading, f: impl Fn(f32, f32, f32) -> f32) -> Vec<u8> {
        let [nx, ny, nz] = dims;
        let voxels = (0..nx * ny * nz)
            .map(|i| f((i % nx) as f32, (i / nx % ny) as f32, (i / nx / ny) as f32))
            .collect();
        let volume =
            Volume::new(dims, spacing, Voxels::F32(voxels), (1.0, 0.0), VolumeInfo::default()).unwrap();
        Lit::of(&volume, shading, 0.1).shares
    }

    #[test]
    fn a_ramp_is_lit_by_the_angle_of_its_gradient() {
        let shading = Shading::default();
        let slope = Vec3::new(0.3, -0.5, 0.2);
        let spacing = Vec3::new(1.0, 2.0, 0.5);
        let ramp = |x: f32, y: f32, z: f32| slope.dot(Vec3::new(x, y, z));
        let shares = lit([5, 6, 7], spacing, shading, ramp);
        let inner = shares[(3 * 6 + 3) * 5 + 2];
        let lambert = (slope / spacing).normalize().dot(shading.light).abs();
        let strength = (slope * 0.1).length_squared();
        let weight = strength / (strength + shading.half_gradient * shading.half_gradient);
        let exact = 0.5 + (lambert - 0.5) * weight;
        // Half a unit of rounding, and single precision.
        assert!((f32::from(inner) - exact * LIT_MAX).abs() < 0.501, "{inner} for {}", exact * LIT_MAX);
        // Two-sided: matter that grows the other way is as bright.
        assert_eq!(shares, lit([5, 6, 7], spacing, shading, |x, y, z| -ramp(x, y, z)));
        // Negative controls: the spacing and the light count.
        assert_ne!(inner, lit([5, 6, 7], Vec3::ONE, shading, ramp)[(3 * 6 + 3) * 5 + 2]);
        let from_above = Shading { light: Vec3::Y, ..shading };
        assert_ne!(inner, lit([5, 6, 7], spacing, from_above, ramp)[(3 * 6 + 3) * 5 + 2]);
    }

    #[test]
    fn matter_without_a_gradient_has_the_mean_of_all_directions() {
        for dims in [[1, 1, 1], [2, 1, 3], [4, 4, 4]] {
            let shares = lit(dims, Vec3::ONE, Shading::default(), |_, _, _| 7.0);
            assert!(shares.iter().all(|&s| s == 128), "{shares:?}");
        }
        // A single slice has no gradient across; along it, one face voxel sees half of the difference.
        let shading = Shading { light: Vec3::Z, half_gradient: 0.0, ..Shading::default() };
        assert!(lit([4, 4, 1], Vec3::ONE, shading, |x, _, _| x).iter().all(|&s| s == 0));
        assert!(lit([1, 1, 4], Vec3::ONE, shading, |_, _, z| z).iter().all(|&s| s == 255));
    }
}
