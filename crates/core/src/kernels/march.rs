//! The march through a volume: it classifies and shades steps along a ray and hands them to a [`Sink`].
//!
//! Twin of `shaders/march.wgsl`. The sink makes a picture of the steps ([`render`]) or the lists of a layered frame
//! ([`super::layering`]).
//!
//! The ray's interval inside the box is divided into n equal steps. Each is at most `step_in_voxels` long in voxel
//! space, in any direction. Both ends of a step are sampled trilinearly, and the pre-integrated table classifies it
//! ([`crate::transfer`]). So the step length changes neither opacity nor the visible features. The march skips steps
//! between lattice points within one invisible brick. The lattice stays, so the picture is the same without skipping.

mod field;
mod glossy;
mod grid;
mod mixed;
pub mod modes;
mod pages;
mod scene;
mod skipper;
mod surfaces;
#[cfg(test)]
mod whole_marches;

use std::ops::Range;

use glam::Vec3;
use rayon::prelude::*;

use self::field::{Fields, MarchField, Run};
pub use self::glossy::Highlight;
use self::glossy::{LightLanes, VoxelRay};
use self::grid::{LANES, Lanes, mix};
pub use self::grid::{Texels, TexelsOf};
use self::mixed::{MIXED, MixedChannel};
use self::modes::{Collected, SURFACES, SamplePair};
pub use self::pages::{LitPage, NOTHING, PageCell, PageLook, ScenePages, SeenPages};
pub use self::scene::{ChannelFacts, MarchedChannel, Scene};
use self::skipper::{Skipper, VisibleBins};
pub(crate) use self::surfaces::Thicken;
use crate::camera::Camera;
use crate::clip::Clip;
use crate::layer::Over;
use crate::mode::{Isos, Mode};
use crate::picture::Picture;
use crate::simd::has_avx2;
use crate::space::{Ray, safe_dir};
use crate::transfer::{TABLE_BINS, TransferTable};
pub use crate::volume::Shading;
use crate::volume::{Detail, Lighting, PointLine};

/// Settings of a march.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarchSettings {
    /// Greatest step, in units of the least spacing.
    pub step_in_voxels: f32,
    /// Shading, if any.
    pub shading: Option<Shading>,
    /// The part of the volume that is marched.
    pub clip: Clip,
    /// Shade and highlights. Where both come from a [`Look`](crate::look::Look), shading uses the same light.
    pub lighting: Lighting,
    /// The detail of the lighting.
    pub detail: Detail,
    /// What a ray collects.
    pub mode: Mode,
    /// The surfaces of [`Mode::Iso`].
    pub isos: Isos,
}

impl Default for MarchSettings {
    fn default() -> Self {
        let (lighting, detail) = (Lighting::default(), Detail::Final);
        let (clip, mode, isos) = (Clip::default(), Mode::default(), Isos::default());
        let shading = Some(Shading::default());
        Self { step_in_voxels: 0.5, shading, clip, lighting, detail, mode, isos }
    }
}

impl MarchSettings {
    /// Full detail, with or without shading, by the light of `lighting`.
    pub fn of(shaded: bool, lighting: Lighting) -> Self {
        let shading = Shading { light: lighting.direction(), ..Shading::default() };
        Self { shading: shaded.then_some(shading), lighting, ..Self::default() }
    }
}

/// Equal steps along a ray: lattice point i is at world distance s0 + i·h, i in 0..=n. A part of a lattice has the steps
/// from `first` on, and an earlier end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Distance of the first point.
    pub s0: f32,
    /// Step length.
    pub h: f32,
    /// The first step that is marched: 0 but for a part.
    pub first: u32,
    /// Number of steps, at least 1; of a part, the end of its last step.
    pub n: u32,
    /// The unit of length for merging errors: about the least step of all rays, in any direction.
    pub unit: f32,
}

/// A visible step of a march.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Step {
    /// World distance of the front.
    pub s0: f32,
    /// World distance of the back.
    pub s1: f32,
    /// Premultiplied colour of the step alone.
    pub c: Vec3,
    /// Optical depth, above [`TAU_MIN`].
    pub tau: f32,
    /// Opacity, 1 − e^−τ.
    pub alpha: f32,
}

/// How a march continues after a step, in lattice points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Advance {
    /// The march stops.
    Stop,
    /// The march goes to the next point.
    Step,
    /// The march goes on by [`STRIDE`]: matter behind is hidden from here and visible only from elsewhere.
    Stride,
}

impl Advance {
    /// Chooses [`Advance::Stride`] behind opaque matter.
    pub fn behind(transmittance: f32) -> Self {
        if transmittance < TRANSMITTANCE_HIDDEN { Self::Stride } else { Self::Step }
    }
}

/// Takes the visible steps of a ray from front to back.
pub trait Sink {
    /// Takes the next step and says how to continue.
    fn step(&mut self, step: Step) -> Advance;

    /// The key that a useful step of a projection must exceed; negative where all steps are useful.
    #[inline(always)]
    fn least_key(&self) -> f32 {
        -1.0
    }
}

/// Calls `$body` with `$texels` bound to the typed voxels of `$scene`.
#[macro_export]
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
pub use with_texels;

/// A scene with typed voxels and everything that is constant over all rays.
pub struct Marcher<'a, T> {
    scene: &'a Scene,
    fields: Fields<'a, T>,
    highlight: Option<Highlight>,
    /// All visible channels, if the march mixes them.
    channels: Vec<MixedChannel<'a>>,
    visible_bins: VisibleBins,
    /// See [`modes::key_limit`].
    pub(crate) key_limit: f32,
    voxel_from_world: Vec3,
    voxel_origin: Vec3,
    /// The inverse spacing of the finest level, relative to its greatest.
    finest_from_world: Vec3,
    has_avx2: bool,
}

/// Where a march is on its ray.
struct Walk {
    /// The next lattice point.
    i: u32,
    /// 1, or [`STRIDE`].
    stride: u32,
    /// Domain position of the last sample, if that was lattice point i.
    x_front: Option<f32>,
    has_stopped: bool,
}

impl Walk {
    /// Obeys a sink after a step that ends at the point `next`. Whether the run ends, because the march stops or has
    /// another stride.
    #[inline(always)]
    fn turns(&mut self, advance: Advance, next: u32, limit: u32) -> bool {
        let stride = match advance {
            Advance::Stop => {
                (self.has_stopped, self.i) = (true, u32::MAX);
                return true;
            }
            Advance::Step => 1,
            Advance::Stride => STRIDE,
        };
        if stride == self.stride {
            return false;
        }
        (self.stride, self.i) = (stride, next.min(limit));
        true
    }
}

impl<'a, T: TexelsOf<'a>> Marcher<'a, T> {
    /// `texels` are the voxels of `scene`.
    pub fn new(scene: &'a Scene, texels: T) -> Self {
        let finest_from_world = scene.volume.finest_spacing().recip();
        let (spacing, voxel_origin) = scene.voxel_space();
        Self {
            scene,
            fields: Fields::of(scene, texels),
            highlight: scene.highlight(),
            channels: MixedChannel::all(scene),
            visible_bins: VisibleBins::of(&scene.table),
            key_limit: modes::key_limit(scene.settings.mode, &scene.table),
            voxel_from_world: spacing.recip(),
            voxel_origin,
            finest_from_world: finest_from_world / finest_from_world.max_element(),
            has_avx2: has_avx2(),
        }
    }
}

impl<T: Texels> Marcher<'_, T> {
    /// Marches the lattice of one ray in a mode that composites with *over*, until the sink stops it. Surfaces have
    /// thickness, see `surfaces`.
    pub fn march(&self, ray: &Ray, lattice: Lattice, sink: &mut impl Sink) {
        if !self.channels.is_empty() {
            return self.march_mode::<MIXED>(ray, lattice, sink);
        }
        if self.scene.settings.mode != Mode::Iso {
            return self.march_mode::<{ Mode::Composite as u8 }>(ray, lattice, sink);
        }
        let mut thicken = self.thicken(lattice, sink);
        self.crossings(ray, lattice, &mut thicken);
        thicken.finish();
    }

    /// Marches to surfaces without thickness. A crossing ends at infinity: at +∞ if values rise there, or else at −∞.
    pub(crate) fn crossings(&self, ray: &Ray, lattice: Lattice, sink: &mut impl Sink) {
        self.march_mode::<{ Mode::Iso as u8 }>(ray, lattice, sink);
    }

    /// Gives thickness to the crossings of a ray with this whole lattice.
    pub(crate) fn thicken<'s, S: Sink>(&self, lattice: Lattice, sink: &'s mut S) -> Thicken<'s, S> {
        let voxel = self.scene.voxel_space().0.min_element();
        Thicken::new(sink, lattice, voxel, self.scene.has_lesser_bodies)
    }

    /// The lattice points of a ray in the voxel space of the whole volume, by the march's own arithmetic. A step belongs to
    /// the box of its front point, and to the page of its middle.
    pub(crate) fn point_line(&self, ray: &Ray, lattice: Lattice) -> PointLine {
        let origin = ray.origin * self.voxel_from_world + self.voxel_origin;
        let dir = safe_dir(ray.dir) * self.voxel_from_world;
        let half = if self.scene.pages.is_some() { 0.5 } else { 0.0 };
        PointLine { origin, dir, s0: lattice.s0, h: lattice.h, place: half, shift: half }
    }

    /// The same for a projection, with steps as in [`modes::Values`].
    pub fn project(&self, ray: &Ray, lattice: Lattice, sink: &mut impl Sink) {
        match self.scene.settings.mode {
            Mode::Mip => self.march_mode::<{ Mode::Mip as u8 }>(ray, lattice, sink),
            Mode::MinIp => self.march_mode::<{ Mode::MinIp as u8 }>(ray, lattice, sink),
            _ => self.march_mode::<{ Mode::Average as u8 }>(ray, lattice, sink),
        }
    }

    fn march_mode<const MODE: u8>(&self, ray: &Ray, lattice: Lattice, sink: &mut impl Sink) {
        #[cfg(target_arch = "x86_64")]
        if self.has_avx2 {
            #[expect(unsafe_code, reason = "the one way to instructions that not every processor has")]
            // SAFETY: the processor supports these instructions.
            unsafe {
                self.march_avx2::<MODE>(ray, lattice, sink);
            }
            return;
        }
        self.march_lanes::<MODE>(ray, lattice, sink);
    }

    /// The same with wider instructions. No multiplication is fused with an addition, so the bits are the same.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn march_avx2<const MODE: u8>(&self, ray: &Ray, lattice: Lattice, sink: &mut impl Sink) {
        self.march_lanes::<MODE>(ray, lattice, sink);
    }

    /// Marches one field after another: the whole volume, or the pages on the ray's way.
    #[inline(always)]
    fn march_lanes<const MODE: u8>(&self, ray: &Ray, lattice: Lattice, sink: &mut impl Sink) {
        let origin = ray.origin * self.voxel_from_world + self.voxel_origin;
        let ray = VoxelRay::new(origin, safe_dir(ray.dir), self.voxel_from_world, self.highlight.as_ref());
        let mut walk = Walk { i: lattice.first, stride: 1, x_front: None, has_stopped: false };
        let mut i = lattice.first;
        while let Some((field, run)) = self.fields.run(&ray, lattice, &mut i, walk.stride) {
            if i != walk.i {
                (walk.i, walk.x_front) = (i, None);
            }
            let local = field.ray(&ray);
            if MODE == MIXED {
                self.march_channels((field, &local), lattice, run, &mut walk, sink);
            } else {
                self.march_field::<MODE>((field, &local), lattice, run, &mut walk, sink);
            }
            if walk.has_stopped {
                return;
            }
            if run.limit < lattice.n {
                // Another level has other values at the same point.
                walk.x_front = None;
            }
            i = walk.i;
        }
    }

    /// The shader takes step after step. Here [`LANES`] steps are sampled at once and then taken in order, even if
    /// the last are not needed.
    #[inline(always)]
    fn march_field<const MODE: u8>(
        &self,
        (field, ray): (&MarchField<'_, T>, &VoxelRay),
        lattice: Lattice,
        run: Run,
        walk: &mut Walk,
        sink: &mut impl Sink,
    ) {
        let Lattice { s0, h, .. } = lattice;
        let Run { end, limit, pace } = run;
        let (origin, dir) = (ray.origin, ray.dir);
        let skipper = Skipper::new(field, (origin, dir), lattice, run);
        while walk.i < end {
            let stride = walk.stride * pace;
            let i = skipper.skip(walk.i, stride, sink.least_key());
            if i > walk.i {
                (walk.i, walk.x_front) = (i, None);
                if i >= end {
                    return;
                }
            }
            // The backs of the next steps, and the samples there.
            let mut s_back = [0.0; LANES];
            for (m, s) in s_back.iter_mut().enumerate() {
                let back = (i + stride * (m as u32 + 1)).min(limit) as i32;
                *s = s0 + back as f32 * h;
            }
            let s_first = s0 + i as f32 * h;
            let mut x1 = field.voxels.sample_lanes(origin, dir, &s_back);
            for x in &mut x1 {
                *x = self.domain::<MODE>(*x);
            }
            let first = || self.domain::<MODE>(field.voxels.sample(origin + dir * s_first));
            let x_first = walk.x_front.unwrap_or_else(first);
            let (s_front, x0) = (behind(s_first, &s_back), behind(x_first, &x1));
            let mut steps = self.visible_steps::<MODE>(&x0, &x1);
            if let Some(gaps) = &field.gaps {
                steps &= gaps.steps_without(origin, dir, &s_front, &s_back);
            }
            let num_steps = (end - i).div_ceil(stride).min(LANES as u32);
            steps &= (1 << num_steps) - 1;
            if steps != 0 {
                let light = if MODE == Mode::Composite as u8 {
                    self.light_lanes(field, ray, &s_front, &s_back)
                } else {
                    LightLanes::PLAIN
                };
                while steps != 0 {
                    let m = steps.trailing_zeros() as usize % LANES;
                    steps &= steps - 1;
                    let between = SamplePair { x0: x0[m], x1: x1[m], s0: s_front[m], s1: s_back[m] };
                    let light = self.light_of_lane(&light, ray, m);
                    if let Some(advance) = self.take::<MODE>(&between, light, (field, ray), sink)
                        && walk.turns(advance, i + stride * (m as u32 + 1), limit)
                    {
                        walk.x_front = Some(x1[m]);
                        return;
                    }
                }
            }
            walk.i = (i + stride * num_steps).min(limit);
            walk.x_front = Some(x1[num_steps as usize - 1]);
        }
    }

    /// Premultiplied colour and opacity along a ray from the distance `near` on, until the transmittance is at most
    /// `stop_at`.
    pub(crate) fn seen(&self, ray: &Ray, near: f32, stop_at: f32) -> [f32; 4] {
        let Some(lattice) = self.scene.lattice(ray, near) else { return [0.0; 4] };
        let seen = self.seen_in(ray, lattice, stop_at);
        self.scene.seen_of_parts(lattice, std::iter::once(seen))
    }

    /// What is seen along a lattice or a part of one: premultiplied colour and transmittance, or what a projection
    /// collects.
    pub(crate) fn seen_in(&self, ray: &Ray, lattice: Lattice, stop_at: f32) -> [f32; 4] {
        if self.scene.settings.mode.is_projection() {
            let mut shown = Collected::new(self.scene);
            self.project(ray, lattice, &mut shown);
            return shown.numbers();
        }
        let mut sink = OverSink { over: Over::default(), stop_at };
        // A picture needs no thickness of surfaces.
        if self.scene.settings.mode == Mode::Iso {
            self.crossings(ray, lattice, &mut sink);
        } else {
            self.march(ray, lattice, &mut sink);
        }
        let Over { c, transmittance } = sink.over;
        [c.x, c.y, c.z, transmittance]
    }

    /// Colour (not premultiplied) and optical depth of a step of length `h` between the domain positions `x0`, `x1`.
    #[inline(always)]
    fn classify(&self, x0: f32, x1: f32, h: f32) -> (Vec3, f32) {
        classify_by(&self.scene.table, x0, x1, h)
    }

    /// A stored number as a position in the transfer function's domain, which may lie outside for surfaces.
    #[inline(always)]
    fn domain<const MODE: u8>(&self, stored: f32) -> f32 {
        let x = stored * self.scene.table.x_scale + self.scene.table.x_offset;
        if MODE == SURFACES {
            return x.clamp(-modes::FARTHEST, modes::FARTHEST);
        }
        let x = if x > 0.0 { x } else { 0.0 };
        if x < 1.0 { x } else { 1.0 }
    }
}

/// Colour (not premultiplied) and optical depth of a step of length `h` between the positions `x0`, `x1` of a table.
#[inline(always)]
fn classify_by(table: &TransferTable, x0: f32, x1: f32, h: f32) -> (Vec3, f32) {
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

/// The values at the fronts of steps, given the first front and all backs.
#[inline(always)]
fn behind(first: f32, backs: &Lanes) -> Lanes {
    let mut fronts = [first; LANES];
    fronts[1..].copy_from_slice(&backs[..LANES - 1]);
    fronts
}

/// Composites steps front to back until the transmittance is at most `stop_at`.
struct OverSink {
    over: Over,
    stop_at: f32,
}

impl Sink for OverSink {
    fn step(&mut self, step: Step) -> Advance {
        self.over.c += step.c * self.over.transmittance;
        self.over.transmittance *= 1.0 - step.alpha;
        if self.over.transmittance > self.stop_at { Advance::Step } else { Advance::Stop }
    }
}

/// The picture of the volume from a camera, premultiplied linear: full volume rendering, the reference of all novel
/// views.
pub fn render(scene: &Scene, camera: &Camera) -> Picture {
    render_until(scene, camera, 0..camera.intrinsics.height, TRANSMITTANCE_MIN)
}

/// Some rows of [`render`], equal to the bit.
pub fn render_rows(scene: &Scene, camera: &Camera, rows: Range<u32>) -> Picture {
    render_until(scene, camera, rows, TRANSMITTANCE_MIN)
}

/// The same picture by a march that also covers matter behind opaque matter, step by step. A layered frame must know
/// all matter, so its time is compared with this.
pub fn render_through(scene: &Scene, camera: &Camera) -> Picture {
    render_until(scene, camera, 0..camera.intrinsics.height, STOP_NOWHERE)
}

fn render_until(scene: &Scene, camera: &Camera, rows: Range<u32>, stop_at: f32) -> Picture {
    with_texels!(scene, texels => render_with(&Marcher::new(scene, texels), camera, rows, stop_at))
}

fn render_with<T: Texels>(
    marcher: &Marcher<'_, T>,
    camera: &Camera,
    rows: Range<u32>,
    stop_at: f32,
) -> Picture {
    let mut picture = Picture::new(camera.intrinsics.width, rows.end.saturating_sub(rows.start));
    let basis = camera.basis();
    let width = picture.width as usize;
    picture.pixels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let row = rows.start as usize + y;
            let (ray, s_per_depth) = basis.ray(x as f32 + 0.5, row as f32 + 0.5);
            *pixel = marcher.seen(&ray, camera.near * s_per_depth, stop_at);
        }
    });
    picture
}

/// The bin of a table for the position `x` in [0, 1].
#[inline(always)]
fn bin(x: f32) -> usize {
    ((x * TABLE_BINS as f32) as i32 as usize).min(TABLE_BINS - 1)
}

/// Linear interpolation in a table over [0, 1].
#[inline(always)]
fn lookup(table: &[[f32; 4]], x: f32) -> [f32; 4] {
    let u = x * TABLE_BINS as f32;
    let i = bin(x);
    let t = u - i as i32 as f32;
    let (a, b) = (table[i], table[i + 1]);
    let mut value = [0.0; 4];
    for ch in 0..4 {
        value[ch] = mix(a[ch], b[ch], t);
    }
    value
}

/// Steps at or below this optical depth are dropped: 4000 of them in a row have an opacity below 1/2000.
pub const TAU_MIN: f32 = 1e-7;
/// A picture stops marching below this transmittance. In sRGB, 1e-4 of full brightness on black is a third of one
/// step of 1/255.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;
/// A transmittance that no matter reaches, so nothing stops the march.
const STOP_NOWHERE: f32 = -1.0;
/// Behind this transmittance the march takes strides. The pre-integrated classification loses no matter, and from
/// here a colour changes by at most a thousandth.
pub const TRANSMITTANCE_HIDDEN: f32 = 1e-3;
/// Lattice points of a stride: a voxel at the default step.
pub const STRIDE: u32 = 2;
/// Most steps of one ray: eight diagonals of the largest volume at the default step.
const MAX_STEPS: f32 = 65536.0;
