//! The march through a volume: steps along a ray, classified and shaded, handed to a [`Sink`].
//!
//! Twin of `shaders/march.wgsl`. What becomes of the steps is the sink's choice: a picture ([`render`]) or the lists
//! of a layered frame ([`super::layering`]).
//!
//! The interval of the ray inside the volume's box is divided into n equal steps of at most
//! `step_in_voxels`·(least spacing). Both ends of a step are sampled trilinearly and the step is classified by the
//! pre-integrated table ([`crate::transfer`]), so the step length changes neither opacity nor which features are
//! seen. Steps between lattice points that lie in one invisible brick are jumped; the lattice stays, so the picture
//! with and without skipping is the same.

use std::sync::Arc;

use glam::Vec3;
use rayon::prelude::*;

use crate::camera::Camera;
use crate::layer::Over;
use crate::picture::Picture;
use crate::space::{Ray, safe_dir};
use crate::transfer::{TABLE_BINS, TransferFunction, TransferTable};
pub use crate::volume::Shading;
use crate::volume::{BRICK, Bricks, Histogram, LIT_MAX, Lit, Occupancy, Volume};

/// How to march.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarchSettings {
    /// Greatest step, in units of the least spacing.
    pub step_in_voxels: f32,
    /// Shading, or none.
    pub shading: Option<Shading>,
}

impl Default for MarchSettings {
    fn default() -> Self {
        Self { step_in_voxels: 0.5, shading: Some(Shading::default()) }
    }
}

/// A volume ready to be marched: with bricks, and a transfer function tabulated for it.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The voxels.
    pub volume: Arc<Volume>,
    /// Their min/max.
    pub bricks: Arc<Bricks>,
    /// Their histogram.
    pub histogram: Arc<Histogram>,
    /// Classification.
    pub table: TransferTable,
    /// Bricks that `table` leaves visible.
    pub occupancy: Occupancy,
    /// Brightness of the voxels, if `settings` ask for shading.
    pub lit: Option<Arc<Lit>>,
    /// Step and shading.
    pub settings: MarchSettings,
}

impl Scene {
    /// Prepares a volume. `transfer` must be valid.
    pub fn new(volume: Arc<Volume>, transfer: &TransferFunction, settings: MarchSettings) -> Self {
        let bricks = Arc::new(Bricks::of(&volume));
        let histogram = Arc::new(Histogram::of(&volume));
        let table = transfer.table(&volume, &histogram);
        let occupancy = bricks.occupancy(&table);
        let lit = settings.shading.map(|shading| Arc::new(Lit::of(&volume, shading, table.x_scale)));
        Self { volume, bricks, histogram, table, occupancy, lit, settings }
    }

    /// The same volume with another look; bricks and histogram are shared, and so is the brightness of the voxels unless
    /// the domain's width or the shading is another.
    pub fn with_look(&self, transfer: &TransferFunction, settings: MarchSettings) -> Self {
        let table = transfer.table(&self.volume, &self.histogram);
        let occupancy = self.bricks.occupancy(&table);
        let lit = settings.shading.map(|shading| match &self.lit {
            Some(lit) if lit.suits(shading, table.x_scale) => Arc::clone(lit),
            _ => Arc::new(Lit::of(&self.volume, shading, table.x_scale)),
        });
        Self { table, occupancy, lit, settings, ..self.clone() }
    }

    /// The lattice of steps of a ray inside the volume, in front of the camera's near plane.
    pub fn lattice(&self, ray: &Ray, near: f32) -> Option<Lattice> {
        let (s0, s1) = self.volume.bounds().clip(ray)?;
        let s0 = s0.max(near);
        if s1 <= s0 {
            return None;
        }
        let h = self.settings.step_in_voxels * self.volume.spacing().min_element();
        let n = ((s1 - s0) / h).ceil().clamp(1.0, MAX_STEPS);
        Some(Lattice { s0, h: (s1 - s0) / n, n: n as u32 })
    }
}

/// Equal steps along a ray: lattice point i is at world distance s0 + i·h, i in 0..=n.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Distance of the first point.
    pub s0: f32,
    /// Step length.
    pub h: f32,
    /// Number of steps, at least 1.
    pub n: u32,
}

/// A visible step of a march.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Step {
    /// World distance of the front.
    pub s0: f32,
    /// World distance of the back.
    pub s1: f32,
    /// Premultiplied colour of the step on its own.
    pub c: Vec3,
    /// Optical depth, above [`TAU_MIN`].
    pub tau: f32,
    /// Opacity, 1 − e^−τ.
    pub alpha: f32,
}

/// How a march goes on after a step, in lattice points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// Not at all.
    Stop,
    /// From one to the next.
    Step,
    /// By [`STRIDE`]: what is behind cannot be seen from here, only from elsewhere.
    Stride,
}

impl Pace {
    /// [`Pace::Stride`] behind matter that nothing can be seen through.
    pub fn behind(transmittance: f32) -> Self {
        if transmittance < TRANSMITTANCE_HIDDEN { Self::Stride } else { Self::Step }
    }
}

/// Takes the visible steps of a ray, front to back.
pub trait Sink {
    /// Takes the next step, and says how to go on.
    fn step(&mut self, step: Step) -> Pace;
}

/// Opacity of optical depth `tau`, accurate for small ones too.
pub fn opacity(tau: f32) -> f32 {
    if tau < 0.01 { tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0))) } else { 1.0 - (-tau).exp() }
}

/// Stored numbers in memory, by index.
pub trait Texels: Copy + Send + Sync {
    /// The stored number at index `i`.
    fn at(self, i: usize) -> f32;
}

impl Texels for &[u8] {
    fn at(self, i: usize) -> f32 {
        f32::from(self[i])
    }
}

impl Texels for &[u16] {
    fn at(self, i: usize) -> f32 {
        f32::from(self[i])
    }
}

impl Texels for &[f32] {
    fn at(self, i: usize) -> f32 {
        self[i]
    }
}

/// Calls `$body` with `$texels` bound to the typed voxels of `$scene`.
macro_rules! with_texels {
    ($scene:expr, $texels:ident => $body:expr) => {
        match $scene.volume.voxels() {
            $crate::volume::Voxels::U8(v) => {
                let $texels = v.as_slice();
                $body
            }
            $crate::volume::Voxels::U16(v) => {
                let $texels = v.as_slice();
                $body
            }
            $crate::volume::Voxels::F32(v) => {
                let $texels = v.as_slice();
                $body
            }
        }
    };
}
pub(crate) use with_texels;

/// A scene with typed voxels and what is constant over all rays.
pub struct Marcher<'a, T> {
    scene: &'a Scene,
    texels: T,
    lit: Option<(&'a [u8], Shading)>,
    dims: [i32; 3],
    strides: [usize; 3],
    voxel_from_world: Vec3,
    half_dims: Vec3,
    max_brick: Vec3,
}

impl<'a, T: Texels> Marcher<'a, T> {
    /// `texels` are the voxels of `scene`.
    pub fn new(scene: &'a Scene, texels: T) -> Self {
        let dims = scene.volume.dims();
        let [bx, by, bz] = scene.occupancy.dims;
        Self {
            scene,
            texels,
            lit: scene
                .lit
                .as_ref()
                .zip(scene.settings.shading)
                .map(|(lit, shading)| (&lit.shares[..], shading)),
            dims: dims.map(|d| d as i32),
            strides: [1, dims[0] as usize, dims[0] as usize * dims[1] as usize],
            voxel_from_world: scene.volume.spacing().recip(),
            half_dims: scene.volume.dims_f32() * 0.5,
            max_brick: Vec3::new(bx as f32 - 1.0, by as f32 - 1.0, bz as f32 - 1.0),
        }
    }

    /// Marches the lattice of one ray; stops when the sink says so.
    pub fn march(&self, ray: &Ray, lattice: Lattice, sink: &mut impl Sink) {
        let Lattice { s0, h, n } = lattice;
        let origin = ray.origin * self.voxel_from_world + self.half_dims;
        let dir = safe_dir(ray.dir) * self.voxel_from_world;
        let inv_dir = dir.recip();
        let leaves_high = Vec3::select(dir.cmpgt(Vec3::ZERO), Vec3::splat(BRICK as f32), Vec3::ZERO);
        let mut i = 0;
        let mut stride = 1;
        // Position x in the domain of the last sample, if it was lattice point i.
        let mut x_front = None;
        while i < n {
            let s_front = s0 + i as f32 * h;
            let p_front = origin + dir * s_front;
            let brick = (p_front * (1.0 / BRICK as f32)).clamp(Vec3::ZERO, self.max_brick);
            let [x, y, z] = [brick.x as u32, brick.y as u32, brick.z as u32];
            if !self.scene.occupancy.get(x, y, z) {
                let brick = Vec3::new(x as f32, y as f32, z as f32);
                let exit = ((brick * BRICK as f32 + leaves_high - origin) * inv_dir).min_element();
                // The last lattice point inside the brick.
                let j = ((exit - s0) / h).floor().clamp(0.0, n as f32) as u32;
                if j > i {
                    i = j;
                    x_front = None;
                    continue;
                }
            }
            let x0 = x_front.unwrap_or_else(|| self.domain_at(p_front));
            let next = (i + stride).min(n);
            let s_back = s0 + next as f32 * h;
            let x1 = self.domain_at(origin + dir * s_back);
            let (color, tau) = self.classify(x0, x1, s_back - s_front);
            if tau > TAU_MIN {
                let alpha = opacity(tau);
                let c = color * (self.shade(origin + dir * (0.5 * (s_front + s_back))) * alpha);
                match sink.step(Step { s0: s_front, s1: s_back, c, tau, alpha }) {
                    Pace::Stop => return,
                    Pace::Step => stride = 1,
                    Pace::Stride => stride = STRIDE,
                }
            }
            x_front = Some(x1);
            i = next;
        }
    }

    /// Colour (not premultiplied) and optical depth of a step of length `h` between the domain positions `x0`, `x1`.
    fn classify(&self, x0: f32, x1: f32, h: f32) -> (Vec3, f32) {
        let table = &self.scene.table;
        let dx = x1 - x0;
        if dx.abs() < 0.5 / TABLE_BINS as f32 {
            let m = lookup(&table.density, 0.5 * (x0 + x1));
            let sigma = m[3];
            if sigma <= 0.0 {
                return (Vec3::ZERO, 0.0);
            }
            return (Vec3::new(m[0], m[1], m[2]) / sigma, sigma * h);
        }
        let a = lookup(&table.integral, x0);
        let b = lookup(&table.integral, x1);
        let d_t = b[3] - a[3];
        if d_t == 0.0 {
            return (Vec3::ZERO, 0.0);
        }
        let color = Vec3::new(b[0] - a[0], b[1] - a[1], b[2] - a[2]) / d_t;
        (color.max(Vec3::ZERO).min(Vec3::ONE), h * d_t / dx)
    }

    /// Trilinear sample at a point of voxel space, as a position in the transfer function's domain.
    fn domain_at(&self, p: Vec3) -> f32 {
        let stored = self.trilinear(self.texels, p);
        let table = &self.scene.table;
        (stored * table.x_scale + table.x_offset).clamp(0.0, 1.0)
    }

    /// Brightness of matter at a point of voxel space: that of the voxels, interpolated trilinearly.
    fn shade(&self, p: Vec3) -> f32 {
        let Some((lit, shading)) = self.lit else { return 1.0 };
        let share = self.trilinear(lit, p) * (1.0 / LIT_MAX);
        shading.ambient + shading.diffuse * share
    }

    /// The value between eight voxels.
    fn trilinear(&self, texels: impl Texels, p: Vec3) -> f32 {
        let (corner, t) = cell(p);
        let [ix, iy, iz] = self.neighbours(corner);
        let v = |x: usize, y: usize, z: usize| texels.at(iz[z] + iy[y] + ix[x]);
        let x00 = mix(v(0, 0, 0), v(1, 0, 0), t.x);
        let x10 = mix(v(0, 1, 0), v(1, 1, 0), t.x);
        let x01 = mix(v(0, 0, 1), v(1, 0, 1), t.x);
        let x11 = mix(v(0, 1, 1), v(1, 1, 1), t.x);
        mix(mix(x00, x10, t.y), mix(x01, x11, t.y), t.z)
    }

    /// Memory offsets of the two voxels along each axis from `corner` on, clamped to the grid.
    fn neighbours(&self, corner: [i32; 3]) -> [[usize; 2]; 3] {
        std::array::from_fn(|axis| {
            std::array::from_fn(|i| {
                let at = corner[axis].saturating_add(i as i32);
                at.clamp(0, self.dims[axis] - 1) as usize * self.strides[axis]
            })
        })
    }
}

/// Composites steps front to back until what is behind cannot be seen.
#[derive(Default)]
pub(crate) struct OverSink(pub(crate) Over);

impl Sink for OverSink {
    fn step(&mut self, step: Step) -> Pace {
        self.0.c += step.c * self.0.transmittance;
        self.0.transmittance *= 1.0 - step.alpha;
        if self.0.transmittance > TRANSMITTANCE_MIN { Pace::Step } else { Pace::Stop }
    }
}

/// The picture of the volume from a camera: full volume rendering, the reference of all novel views. Premultiplied
/// linear.
pub fn render(scene: &Scene, camera: &Camera) -> Picture {
    with_texels!(scene, texels => render_with(&Marcher::new(scene, texels), camera))
}

fn render_with<T: Texels>(marcher: &Marcher<'_, T>, camera: &Camera) -> Picture {
    let mut picture = Picture::new(camera.intrinsics.width, camera.intrinsics.height);
    let basis = camera.basis();
    let width = picture.width as usize;
    picture.pixels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let (ray, s_per_depth) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
            let mut sink = OverSink::default();
            if let Some(lattice) = marcher.scene.lattice(&ray, camera.near * s_per_depth) {
                marcher.march(&ray, lattice, &mut sink);
            }
            *pixel = sink.0.rgba();
        }
    });
    picture
}

/// Cell and position inside of it of a point of voxel space; the corners of the cell are voxel centres.
fn cell(p: Vec3) -> ([i32; 3], Vec3) {
    // Truncation is the floor above zero, and cheaper where the processor has no instruction for the floor; the march
    // stays within half a voxel of the box.
    let up = p + 0.5;
    let i = [up.x as i32, up.y as i32, up.z as i32];
    // Saturating: an eye that is very far away puts its points anywhere.
    (i.map(|i| i.saturating_sub(1)), up - Vec3::new(i[0] as f32, i[1] as f32, i[2] as f32))
}

/// Linear interpolation in a table over [0, 1].
fn lookup(table: &[[f32; 4]], x: f32) -> [f32; 4] {
    let u = x * TABLE_BINS as f32;
    let i = (u as usize).min(TABLE_BINS - 1);
    let t = u - i as f32;
    let (a, b) = (table[i], table[i + 1]);
    std::array::from_fn(|ch| mix(a[ch], b[ch], t))
}

/// a + (b − a)·t.
fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// Steps at or below this optical depth are dropped: 4000 of them in a row have an opacity below 1/2000 (design,
/// trap 5).
pub const TAU_MIN: f32 = 1e-7;
/// A picture stops marching below this transmittance. In sRGB, 1e-4 of full brightness on black is a third of one
/// step of 1/255.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;
/// Matter behind this transmittance is marched by strides. The pre-integrated classification loses no matter by them, and
/// what they change in its colour is seen at most a thousandth from here.
pub const TRANSMITTANCE_HIDDEN: f32 = 1e-3;
/// Lattice points of a stride: the step is then a voxel, at the default.
pub const STRIDE: u32 = 2;
/// Bound on the steps of one ray: eight diagonals of the largest volume at the default step.
const MAX_STEPS: f32 = 65536.0;
