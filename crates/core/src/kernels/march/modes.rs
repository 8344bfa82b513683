//! What each mode makes of a step: a piece of an absorbing medium, of a projection, or surfaces. Twin of
//! `shaders/march/*.wgsl`.
//!
//! A projection uses the fields of [`Step`] in its own way: see [`Values`] for the greatest and the least value. For
//! the mean, `c` is the integral of the shown colour over the step. Keys represent values: the position x for the
//! greatest, 1 − x for the least. So the greatest key always wins.

use std::sync::Arc;

use glam::Vec3;

use super::field::MarchField;
use super::glossy::{PointLight, VoxelRay};
use super::grid::Lanes;
use super::surfaces::sheets;
use super::{Advance, Lattice, MarchSettings, Marcher, Scene, Sink, Step, TAU_MIN, Texels, lookup};
use crate::kernels::raycast::opacity;
use crate::layer::Over;
use crate::mode::{Iso, Isos, Mode};
use crate::transfer::{MAX_OPACITY, TABLE_BINS, TransferFunction, TransferTable};
use crate::volume::{Bricks, Histogram, Illumination, Lighting, Matter, Occlusion, Occupancy, Volume};

/// A surface of one value, as the march finds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Position in the transfer function's domain, not clamped.
    pub x: f32,
    /// The stored number.
    pub stored: f32,
    /// Linear colour, not premultiplied: that of the transfer function at this value.
    pub color: Vec3,
    /// Optical depth of a crossing.
    pub tau: f32,
}

/// The brightness of the voxels. See [`Illumination::of`] for `before`.
pub(super) fn illuminate(
    volume: &Arc<Volume>,
    table: &TransferTable,
    surfaces: &[Surface],
    settings: MarchSettings,
    before: Option<(&Illumination, Option<&Occlusion>)>,
) -> Illumination {
    let MarchSettings { mut shading, mut lighting, detail, clip, mode, .. } = settings;
    if mode.is_projection() {
        (shading, lighting) = (None, Lighting::default());
    }
    let region = clip.region(&volume.bounds());
    let sheets = sheets(surfaces);
    let matter = if mode == Mode::Iso { Matter::Surfaces(&sheets) } else { Matter::Medium(table) };
    Illumination::of(volume, table, matter, shading, &region, lighting, detail, before)
}

/// The surfaces by ascending position; by default the value that splits the histogram best.
pub(super) fn surfaces(
    transfer: &TransferFunction,
    table: &TransferTable,
    volume: &Volume,
    histogram: &Histogram,
    isos: &Isos,
) -> Vec<Surface> {
    let parting = [Iso { value: histogram.parting_value(), ..Iso::default() }];
    let isos = if isos.as_slice().is_empty() { &parting } else { isos.as_slice() };
    let (scale, offset) = volume.value_map();
    let each = isos.iter().map(|iso| {
        // Double precision, like the map of positions.
        let stored = (f64::from(iso.value) - f64::from(offset)) / f64::from(scale);
        let scaled = stored * f64::from(table.x_scale);
        let x = scaled + f64::from(table.x_offset);
        // The tiny offset exceeds all roundings of a march, so that voxels of this exact value lie inside.
        let x = (x - f64::from(2.0 * f32::EPSILON) * (scaled.abs() + x.abs())) as f32;
        let (color, _) = transfer.at(x.clamp(0.0, 1.0));
        let tau = -(1.0 - iso.opacity.min(MAX_OPACITY)).ln();
        let x = x.clamp(-0.5 * FARTHEST, 0.5 * FARTHEST);
        Surface { x, stored: stored as f32, color: color.into(), tau }
    });
    let mut surfaces: Vec<Surface> = each.filter(|s| s.tau > TAU_MIN).collect();
    surfaces.sort_by(|a, b| a.x.total_cmp(&b.x));
    surfaces
}

/// The bricks that a mode leaves visible. For the greatest or the least value also the keys that they may have.
pub(super) fn occupancy(
    bricks: &Bricks,
    mode: Mode,
    table: &TransferTable,
    surfaces: &[Surface],
) -> Occupancy {
    let peak = |lo: f32, hi: f32| match mode {
        Mode::Mip => Some(table.positions(lo, hi).1),
        Mode::MinIp => Some(1.0 - table.positions(lo, hi).0),
        _ => None,
    };
    bricks.occupancy_by(|lo, hi| is_visible(mode, table, surfaces, lo, hi), peak)
}

/// Whether a sample between two stored numbers may be visible; it errs on the side of yes.
pub(super) fn is_visible(mode: Mode, table: &TransferTable, surfaces: &[Surface], lo: f32, hi: f32) -> bool {
    let (a, b) = table.positions(lo, hi);
    let clamped = |x: f32| x.clamp(0.0, 1.0);
    match mode {
        Mode::Composite | Mode::Average => table.is_visible(lo, hi),
        // A key that is as dark as every lower one neither shows nor hides anything.
        Mode::Mip => table.has_any(0.0, clamped(b)),
        Mode::MinIp => table.has_any(clamped(a), 1.0),
        Mode::Iso => {
            let rounding = POSITION_ROUNDING * (a.abs() + b.abs());
            surfaces.iter().any(|s| a - rounding <= s.x && s.x <= b + rounding)
        }
    }
}

/// The key up to which steps neither show nor hide anything in a projection: everything below is black.
pub fn key_limit(mode: Mode, table: &TransferTable) -> f32 {
    let is_black = |node: &[f32; 4]| node[3] <= 0.0;
    let black = match mode {
        Mode::Mip => table.density.iter().take_while(|n| is_black(n)).count(),
        Mode::MinIp => table.density.iter().rev().take_while(|n| is_black(n)).count(),
        _ => 0,
    };
    if black == 0 { -1.0 } else { (black - 1) as f32 / TABLE_BINS as f32 }
}

/// Linear display colour of a key.
pub fn shown_of_key(table: &TransferTable, is_least: bool, key: f32) -> Vec3 {
    let key = key.clamp(0.0, 1.0);
    let shown = lookup(&table.density, if is_least { 1.0 - key } else { key });
    Vec3::new(shown[0], shown[1], shown[2])
}

/// The keys of a step in a projection of the greatest or the least value, stored in the fields of a [`Step`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Values {
    /// Greatest key.
    pub peak: f32,
    /// Mean key.
    pub mean: f32,
    /// Mean of the key's square.
    pub square: f32,
}

impl Values {
    /// The keys of a step with a linear key between its ends.
    fn between(y0: f32, y1: f32) -> Self {
        let square = (y0 * y0 + y0 * y1 + y1 * y1) * (1.0 / 3.0);
        Self { peak: if y0 > y1 { y0 } else { y1 }, mean: 0.5 * (y0 + y1), square }
    }

    /// Reads the keys from a step.
    pub fn of(step: &Step) -> Self {
        Self { peak: step.tau, mean: step.alpha, square: step.c.x }
    }

    fn step(self, s0: f32, s1: f32) -> Step {
        Step { s0, s1, c: Vec3::new(self.square, 0.0, 0.0), tau: self.peak, alpha: self.mean }
    }
}

/// Two neighbouring samples of a march.
pub(super) struct SamplePair {
    /// Positions in the domain.
    pub(super) x0: f32,
    pub(super) x1: f32,
    /// World distances.
    pub(super) s0: f32,
    pub(super) s1: f32,
}

impl<T: Texels> Marcher<'_, T> {
    /// One bit per step, set where it may be visible.
    #[inline(always)]
    pub(super) fn visible_steps<const MODE: u8>(&self, x0: &Lanes, x1: &Lanes) -> u32 {
        let mut bits = 0;
        if MODE == SURFACES {
            for surface in &self.scene.surfaces {
                for (m, (a, b)) in x0.iter().zip(x1).enumerate() {
                    bits |= u32::from((*a < surface.x) != (*b < surface.x)) << m;
                }
            }
        } else if MODE == GREATEST || MODE == LEAST {
            for (m, (a, b)) in x0.iter().zip(x1).enumerate() {
                let (a, b) = if MODE == LEAST { (1.0 - a, 1.0 - b) } else { (*a, *b) };
                bits |= u32::from((a > self.key_limit) | (b > self.key_limit)) << m;
            }
        } else {
            bits = self.visible_bins.between(x0, x1);
        }
        bits
    }

    /// Hands the step between two samples to the sink, if it is visible.
    #[inline(always)]
    pub(super) fn take<const MODE: u8>(
        &self,
        &SamplePair { x0, x1, s0, s1 }: &SamplePair,
        light: PointLight,
        (field, ray): (&MarchField<'_, T>, &VoxelRay),
        sink: &mut impl Sink,
    ) -> Option<Advance> {
        if MODE == SURFACES {
            return self.cross(&SamplePair { x0, x1, s0, s1 }, (field, ray), sink);
        }
        if MODE == GREATEST {
            return Some(sink.step(Values::between(x0, x1).step(s0, s1)));
        }
        if MODE == LEAST {
            return Some(sink.step(Values::between(1.0 - x0, 1.0 - x1).step(s0, s1)));
        }
        let (color, tau) = self.classify(x0, x1, s1 - s0);
        if MODE == MEAN {
            // In a projection, the table has the greatest channel in place of extinction, which multiplies the
            // colour.
            let step = Step { s0, s1, c: color * tau, tau: 0.0, alpha: 0.0 };
            return (tau > 0.0).then(|| sink.step(step));
        }
        // A closure would not use wider instructions.
        if tau <= TAU_MIN {
            return None;
        }
        let alpha = opacity(tau);
        Some(sink.step(Step { s0, s1, c: self.sent(color, alpha, light), tau, alpha }))
    }

    /// Hands on the surfaces between two samples. A step into greater values begins at the crossing, and one into
    /// lesser values ends there; [`super::surfaces`] makes segments of them.
    fn cross(
        &self,
        ends: &SamplePair,
        (field, ray): (&MarchField<'_, T>, &VoxelRay),
        sink: &mut impl Sink,
    ) -> Option<Advance> {
        let mut pace = None;
        let to_greater = ends.x1 > ends.x0;
        let num = self.scene.surfaces.len();
        let mut last = ends.s0;
        for i in 0..num {
            let surface = &self.scene.surfaces[if to_greater { i } else { num - 1 - i }];
            if (ends.x0 < surface.x) == (ends.x1 < surface.x) {
                continue;
            }
            // The secant method: once on the chord, and twice on the chord of the part with the crossing.
            let (mut a, mut b) = ((ends.s0, ends.x0), (ends.s1, ends.x1));
            let chord = |a: (f32, f32), b: (f32, f32)| {
                (a.0 + (b.0 - a.0) * ((surface.x - a.1) / (b.1 - a.1))).clamp(a.0, b.0)
            };
            let mut s = chord(a, b);
            for _ in 0..REFINEMENTS {
                let x = self.domain::<SURFACES>(field.voxels.sample(ray.origin + ray.dir * s));
                if (x < surface.x) == (ends.x0 < surface.x) {
                    a = (s, x);
                } else {
                    b = (s, x);
                }
                s = chord(a, b);
            }
            s = s.max(last);
            last = s;
            let alpha = opacity(surface.tau);
            let c = self.sent(surface.color, alpha, self.light_at(field, ray, s));
            let s1 = if to_greater { f32::INFINITY } else { f32::NEG_INFINITY };
            let next = sink.step(Step { s0: s, s1, c, tau: surface.tau, alpha });
            pace = Some(next);
            if next == Advance::Stop {
                break;
            }
        }
        pace
    }
}

/// What a projection has collected along a ray.
pub(super) struct Collected<'a> {
    scene: &'a Scene,
    /// Greatest key; negative before any step.
    key: f32,
    integral: Vec3,
}

impl<'a> Collected<'a> {
    pub(super) fn new(scene: &'a Scene) -> Self {
        Self { scene, key: -1.0, integral: Vec3::ZERO }
    }

    /// What was collected, as numbers that [`Self::join`] takes.
    pub(super) fn numbers(&self) -> [f32; 4] {
        let Vec3 { x, y, z } = self.integral;
        [x, y, z, self.key]
    }

    /// Adds what another one collected along another part of the ray.
    fn join(&mut self, [x, y, z, key]: [f32; 4]) {
        self.key = if key > self.key { key } else { self.key };
        self.integral += Vec3::new(x, y, z);
    }

    /// The colour, with its greatest channel as opacity.
    pub(super) fn rgba(&self, lattice: Lattice) -> [f32; 4] {
        let c = match self.scene.settings.mode {
            Mode::Average => self.integral / (lattice.h * lattice.n as f32),
            _ if self.key < 0.0 => Vec3::ZERO,
            mode => shown_of_key(&self.scene.table, mode == Mode::MinIp, self.key),
        };
        [c.x, c.y, c.z, c.max_element().min(1.0)]
    }
}

impl Scene {
    /// Premultiplied colour and opacity along a whole lattice, from what is seen along its parts from front to back.
    pub(crate) fn seen_of_parts(&self, lattice: Lattice, parts: impl Iterator<Item = [f32; 4]>) -> [f32; 4] {
        if self.settings.mode.is_projection() {
            let mut all = Collected::new(self);
            parts.for_each(|part| all.join(part));
            return all.rgba(lattice);
        }
        let mut over = Over::default();
        for [x, y, z, transmittance] in parts {
            over.c += Vec3::new(x, y, z) * over.transmittance;
            over.transmittance *= transmittance;
        }
        over.rgba()
    }
}

impl Sink for Collected<'_> {
    #[inline(always)]
    fn step(&mut self, step: Step) -> Advance {
        self.key = if step.tau > self.key { step.tau } else { self.key };
        self.integral += step.c;
        Advance::Step
    }

    #[inline(always)]
    fn least_key(&self) -> f32 {
        self.key
    }
}

const GREATEST: u8 = Mode::Mip as u8;
const LEAST: u8 = Mode::MinIp as u8;
const MEAN: u8 = Mode::Average as u8;
/// [`Mode::Iso`] as a const parameter of the march.
pub(super) const SURFACES: u8 = Mode::Iso as u8;
/// Clamp for positions, which keeps their differences finite.
pub(super) const FARTHEST: f32 = 1e30;
/// Number of secant refinements of a crossing: the field is nearly linear within half a voxel.
const REFINEMENTS: usize = 2;
/// Rounding error of an interpolated position.
const POSITION_ROUNDING: f32 = 1e-5;
