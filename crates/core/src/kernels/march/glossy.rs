//! Highlights: what shaded matter mirrors of the light towards the eye, by Blinn and Phong. Twin of
//! `shaders/march/glossy.wgsl`.
//!
//! With the unit vectors l towards the light and e towards the eye, two directions lie half-way: h₁ between e and l, and
//! h₂ between e and −l, because the light is two-sided. The side that the eye is on counts most: with x = (1 ± e·l)/2,
//! each has the share q(x) = x²·(3 − 2x). So highlights change evenly as the eye goes around. They are white and add
//!
//! specular·w·o·( q₁·|n·h₁|^shininess + q₂·|n·h₂|^shininess ).
//!
//! n is the direction of the gradient at the point itself, not mixed from the voxels' brightness as the diffuse light
//! is. w is the weight of its size, as in [`Lit`]. o is what shade leaves of the source's light.

use glam::Vec3;

use super::field::MarchField;
use super::grid::{LANES, Lanes};
use super::{Marcher, Scene, Texels};
use crate::layer::COLOR_MAX;
use crate::volume::{GRADIENT_MAX, LIT_MAX, Lit};

/// The highlights of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Highlight {
    /// Unit vector towards the light, world space.
    pub light: Vec3,
    /// Strength, above 0 to 1.
    pub specular: f32,
    /// Exponent.
    pub shininess: f32,
    /// Gradient at which a highlight has half of its strength, domain positions per voxel.
    pub half_gradient: f32,
    /// Brightness without shade, as ambient and diffuse; zeros if there is no shade.
    pub open: (f32, f32),
}

impl Scene {
    /// The highlights, if there are any: projections, matter without shading and mixed channels have none.
    pub fn highlight(&self) -> Option<Highlight> {
        let lighting = self.settings.lighting;
        let has_gradient = !self.settings.mode.is_projection() && !self.is_mixed();
        let is_glossy = lighting.specular > 0.0 && has_gradient;
        let shading = self.settings.shading.filter(|_| is_glossy)?;
        Some(Highlight {
            light: shading.light,
            specular: lighting.specular,
            shininess: lighting.shininess,
            half_gradient: shading.half_gradient,
            open: self.illumination.open().unwrap_or_default(),
        })
    }
}

/// A ray in voxel space.
#[derive(Clone, Copy, Debug)]
pub(super) struct VoxelRay {
    pub(super) origin: Vec3,
    pub(super) dir: Vec3,
    /// Directions half-way between the eye and both sides of the light, world space.
    pub(super) halfways: [Vec3; 2],
    /// Shares of both sides.
    pub(super) shares: [f32; 2],
}

impl VoxelRay {
    /// `dir` is the unit direction in world space.
    pub(super) fn new(
        origin: Vec3,
        dir: Vec3,
        voxel_from_world: Vec3,
        highlight: Option<&Highlight>,
    ) -> Self {
        let light = highlight.map_or(Vec3::ZERO, |h| h.light);
        let sums = [light - dir, light + dir];
        let squares = sums.map(Vec3::length_squared);
        let halfways = [0, 1].map(|i| sums[i] / squares[i].max(LEAST_SQUARE).sqrt());
        let share = |square: f32| {
            let x = 0.25 * square;
            x * x * (3.0 - 2.0 * x)
        };
        Self { origin, dir: dir * voxel_from_world, halfways, shares: squares.map(share) }
    }
}

/// Light on the middles of steps.
pub(super) struct LightLanes {
    brightness: Lanes,
    strength: Lanes,
    facing: [Lanes; 2],
}

impl LightLanes {
    /// Of matter that shows its plain colour.
    pub(super) const PLAIN: Self =
        Self { brightness: [1.0; LANES], strength: [0.0; LANES], facing: [[0.0; LANES]; 2] };
}

/// How bright matter is at a point, and what it adds to its colour as a mirror.
#[derive(Clone, Copy, Debug)]
pub(super) struct PointLight {
    pub(super) brightness: f32,
    pub(super) mirrored: f32,
}

impl<T: Texels> Marcher<'_, T> {
    /// What matter of an opacity sends to the eye, premultiplied. Highlights end at the greatest colour that the wire
    /// carries, so the viewer's picture is the server's.
    #[inline(always)]
    pub(super) fn sent(&self, color: Vec3, alpha: f32, light: PointLight) -> Vec3 {
        if self.highlight.is_none() {
            return color * (light.brightness * alpha);
        }
        (color * light.brightness + Vec3::splat(light.mirrored)).min(Vec3::splat(COLOR_MAX)) * alpha
    }

    /// Light on the middles of steps; brightness is interpolated trilinearly between voxels.
    #[inline(always)]
    pub(super) fn light_lanes(
        &self,
        field: &MarchField<'_, T>,
        ray: &VoxelRay,
        s_front: &Lanes,
        s_back: &Lanes,
    ) -> LightLanes {
        let mut light = LightLanes::PLAIN;
        let Some((grid, lit)) = &field.lit else { return light };
        let mut middle = [0.0; LANES];
        for m in 0..LANES {
            middle[m] = 0.5 * (s_front[m] + s_back[m]);
        }
        light.brightness = grid.sample_lanes(ray.origin, ray.dir, &middle);
        for b in &mut light.brightness {
            *b = brightness_of(lit, *b);
        }
        let Some(highlight) = &self.highlight else { return light };
        let [mut x, mut y, mut z] = [[0.0; LANES]; 3];
        for (slope, axis) in [(&mut x, Vec3::X), (&mut y, Vec3::Y), (&mut z, Vec3::Z)] {
            let before = field.voxels.sample_lanes(ray.origin - axis, ray.dir, &middle);
            *slope = field.voxels.sample_lanes(ray.origin + axis, ray.dir, &middle);
            for m in 0..LANES {
                slope[m] -= before[m];
            }
        }
        for m in 0..LANES {
            let slope = Vec3::new(x[m], y[m], z[m]);
            let (strength, facing) =
                self.facing(highlight, ray, slope * field.steepness, light.brightness[m]);
            light.strength[m] = strength;
            (light.facing[0][m], light.facing[1][m]) = (facing[0], facing[1]);
        }
        light
    }

    /// One of these.
    #[inline(always)]
    pub(super) fn light_of_lane(&self, light: &LightLanes, ray: &VoxelRay, m: usize) -> PointLight {
        let facing = [light.facing[0][m], light.facing[1][m]];
        let mirrored = self.highlight.as_ref().map_or(0.0, |h| mirrored(h, ray, light.strength[m], facing));
        PointLight { brightness: light.brightness[m], mirrored }
    }

    /// The same for any distance along the ray.
    pub(super) fn light_at(&self, field: &MarchField<'_, T>, ray: &VoxelRay, s: f32) -> PointLight {
        let p = ray.origin + ray.dir * s;
        let brightness = field.lit.as_ref().map_or(1.0, |(grid, lit)| brightness_of(lit, grid.sample(p)));
        let mirrored = self.highlight.as_ref().map_or(0.0, |highlight| {
            let slope = [Vec3::X, Vec3::Y, Vec3::Z]
                .map(|axis| field.voxels.sample(p + axis) - field.voxels.sample(p - axis));
            let slope = Vec3::from(slope) * field.steepness;
            let (strength, facing) = self.facing(highlight, ray, slope, brightness);
            mirrored(highlight, ray, strength, facing)
        });
        PointLight { brightness, mirrored }
    }

    /// Strength of the highlight where the stored numbers grow by `slope` over two voxels of the finest level, and how squarely the matter
    /// faces the half-way directions.
    #[inline(always)]
    fn facing(&self, h: &Highlight, ray: &VoxelRay, slope: Vec3, brightness: f32) -> (f32, [f32; 2]) {
        let per_voxel = (slope * (0.5 * self.scene.table.x_scale))
            .clamp(Vec3::splat(-GRADIENT_MAX), Vec3::splat(GRADIENT_MAX));
        let square = per_voxel.length_squared();
        let weight = square / (square + h.half_gradient * h.half_gradient).max(LEAST_SQUARE);
        // Only the direction matters; this scale keeps squares from overflowing.
        let normal = per_voxel * self.finest_from_world;
        let normal = normal / normal.length_squared().max(LEAST_SQUARE).sqrt();
        let mut strength = h.specular * weight;
        let (ambient, diffuse) = h.open;
        if diffuse > 0.0 {
            let lambert = 0.5 + (normal.dot(h.light).abs() - 0.5) * weight;
            strength *= ((brightness - ambient) / (diffuse * lambert).max(LEAST_DIFFUSE)).clamp(0.0, 1.0);
        }
        (strength, ray.halfways.map(|half| normal.dot(half).abs()))
    }
}

#[inline(always)]
fn brightness_of(lit: &Lit, share: f32) -> f32 {
    lit.ambient + lit.diffuse * (share * (1.0 / LIT_MAX))
}

/// What is mirrored of white light.
#[inline(always)]
fn mirrored(h: &Highlight, ray: &VoxelRay, strength: f32, facing: [f32; 2]) -> f32 {
    let lobe = |i: usize| ray.shares[i] * facing[i].powf(h.shininess);
    strength * (lobe(0) + lobe(1))
}

/// Guards divisions by the length of a vector that may be 0.
const LEAST_SQUARE: f32 = 1e-37;
/// Guards the division by the diffuse light.
const LEAST_DIFFUSE: f32 = 1e-3;
