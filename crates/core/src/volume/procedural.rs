//! The built-in volumes: `cloud` (soft, translucent), `cubus` (opaque cubes), `shells` (thin nested surfaces).
//!
//! All are 8-bit with sides of two world units. A formula of the voxel's position gives each value, so every machine
//! makes the same ones. The side in voxels can be chosen.

use std::ops::Range;

use glam::Vec3;
use rayon::prelude::*;

use super::grid::{Volume, VolumeInfo, Voxels};

/// A built-in volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Builtin {
    /// Fractal noise in a soft ball.
    Cloud,
    /// A lattice of 3×3×3 opaque cubes of different values.
    Cubus,
    /// Nested, perforated thin shells.
    Shells,
}

impl Builtin {
    /// Every built-in volume, in the order of their names.
    pub const ALL: [Self; 3] = [Self::Cloud, Self::Cubus, Self::Shells];

    /// The name after `builtin:`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cloud => "cloud",
            Self::Cubus => "cubus",
            Self::Shells => "shells",
        }
    }

    /// Inverse of [`Builtin::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|b| b.name() == name)
    }

    /// The volume with `n` voxels along each side, `n` in 8 to [`Volume::MAX_SIDE`].
    pub fn volume(self, n: u32) -> Volume {
        let n = n.clamp(8, Volume::MAX_SIDE);
        let spacing = 2.0 / n as f32;
        let voxels = self.planes(n, 0..n);
        let info = VolumeInfo {
            name: format!("builtin:{}", self.name()),
            dtype: "uint8".into(),
            ..Default::default()
        };
        Volume::new([n; 3], Vec3::splat(spacing), Voxels::U8(voxels), (1.0, 0.0), info)
            .expect("the sides are bounded and the count is their product")
    }

    /// The voxels in planes `z` of the volume with `n` along each side, x fastest.
    pub fn planes(self, n: u32, z: Range<u32>) -> Vec<u8> {
        let spacing = 2.0 / n as f32;
        let at = |i: usize| (i as f32 + 0.5) * spacing - 1.0;
        let side = n as usize;
        let first = z.start as usize;
        let mut voxels = vec![0u8; side * side * z.len()];
        voxels.par_chunks_mut(side * side).enumerate().for_each(|(plane, slice)| {
            for (i, voxel) in slice.iter_mut().enumerate() {
                let p = Vec3::new(at(i % side), at(i / side), at(first + plane));
                let value = match self {
                    Self::Cloud => cloud(p),
                    Self::Cubus => cubus(p, spacing),
                    Self::Shells => shells(p),
                };
                *voxel = (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
            }
        });
        voxels
    }

    /// Default number of voxels along each side.
    pub const DEFAULT_SIDE: u32 = 128;
}

fn cloud(p: Vec3) -> f32 {
    let ball = 1.0 - (p.length() / 0.95).powi(2);
    if ball <= 0.0 {
        return 0.0;
    }
    let mut sum = 0.0;
    let mut amplitude = 0.5;
    let mut q = p * 2.5 + Vec3::splat(17.0);
    for _ in 0..5 {
        sum += amplitude * value_noise(q);
        amplitude *= 0.5;
        q = q * 2.03 + Vec3::new(3.1, 1.7, 5.3);
    }
    (1.6 * sum - 0.62 + 0.55 * ball).max(0.0) * smoothstep(0.0, 0.25, ball)
}

fn cubus(p: Vec3, spacing: f32) -> f32 {
    let cell = ((p + 1.0) * 1.5).floor().clamp(Vec3::ZERO, Vec3::splat(2.0));
    let center = (cell + 0.5) / 1.5 - 1.0;
    let distance = (p - center).abs().max_element() - 0.2;
    // A ramp of one voxel band-limits the cube's faces.
    let inside = (0.5 - distance / spacing).clamp(0.0, 1.0);
    let number = cell.x + 3.0 * cell.y + 9.0 * cell.z;
    inside * (0.9 + 0.1 * ((number * 11.0) % 27.0) / 26.0)
}

fn shells(p: Vec3) -> f32 {
    let r = p.length();
    let mut value: f32 = 0.0;
    for i in 0..4 {
        let radius = 0.25 + 0.22 * i as f32;
        let thickness = 0.035;
        let shell = (1.0 - ((r - radius) / thickness).abs()).max(0.0);
        if shell == 0.0 {
            continue;
        }
        let f = 5.0 + 2.0 * i as f32;
        let holes = (f * p.x).sin() * (f * p.y + 1.0).sin() * (f * p.z + 2.0).sin();
        value = value.max(shell * smoothstep(-0.15, 0.0, holes) * (0.4 + 0.2 * i as f32));
    }
    value
}

fn smoothstep(a: f32, b: f32, x: f32) -> f32 {
    let t = ((x - a) / (b - a)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Smooth noise in [0, 1] with lattice spacing 1: trilinear between hashed lattice values, with smoothed weights.
fn value_noise(p: Vec3) -> f32 {
    let cell = p.floor();
    let t = p - cell;
    let w = t * t * (Vec3::splat(3.0) - 2.0 * t);
    let [x, y, z] = [cell.x as i32, cell.y as i32, cell.z as i32];
    let v = |dx: i32, dy: i32, dz: i32| hash(x + dx, y + dy, z + dz);
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let plane = |dz: i32| lerp(lerp(v(0, 0, dz), v(1, 0, dz), w.x), lerp(v(0, 1, dz), v(1, 1, dz), w.x), w.y);
    lerp(plane(0), plane(1), w.z)
}

fn hash(x: i32, y: i32, z: i32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    (h >> 8) as f32 / (1u32 << 24) as f32
}
