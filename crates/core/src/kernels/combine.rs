//! Novel views from several layered frames: what the newest frame does not see is taken from older ones (the open
//! question of Mueller 1999). Twin of `shaders/combine.wgsl`.
//!
//! A frame knows what lies in the frustum of its camera. On a new ray that is one interval, since every plane of the
//! frustum is linear along it in homogeneous pixel coordinates. The planes cut the ray into pieces, and in each piece
//! the first frame, the newest first, that sees it is cast. Frames of different cameras show the same matter by
//! different segments, so a hard change would be a seam. Inside a frame's border its coverage c therefore grows over a
//! band of a few lists from 0 to 1, and in the band the media of the frames are mixed: frame n has the weight
//! w_n = c_n·Π_{m<n}(1 − c_m), normalised to a sum of 1, so that where no other frame sees anything the one that does is
//! shown as it is. Extinctions are weighted, source colours with them:
//!
//!   τ = Σ w_n·τ_n,  C = Σ w_n·τ_n·E_n / τ · (1 − e^−τ).
//!
//! In a projection the greatest key wins over all pieces, or colours add, and in the band colours and keys are weighted.
//!
//! The newest frame's band is no wider than what the picture shows beyond its border. So from its own pose, and as long
//! as it sees all of the picture, the picture is that of the newest frame alone; and a camera that turns away from
//! it makes the band grow from nothing.

use glam::Vec3;
use rayon::prelude::*;

use super::march::TRANSMITTANCE_MIN;
use super::raycast::{CastOptions, MARGIN_UNITS, Raycaster, clip_by_planes, frustum_planes};
use crate::camera::{Basis, Camera, PixelLine};
use crate::clip::{Clip, Region};
use crate::layer::{DEPTH_UNITS, LayeredFrame, Over, Projected};
use crate::mode::Compositing;
use crate::picture::Picture;
use crate::space::{Aabb, Ray};

/// Several frames, with everything that is constant over the rays of a picture.
pub struct Combiner {
    layers: Vec<FrameLayer>,
    /// The visible part of the volume, with the widest of the margins.
    region: Region,
    options: CastOptions,
}

/// One frame.
struct FrameLayer {
    caster: Raycaster,
    view: FrameFrustum,
    /// Width of the border band in which its coverage grows to 1, lists.
    band: f32,
}

/// The frustum of a frame's camera.
#[derive(Clone, Copy)]
struct FrameFrustum {
    basis: Basis,
    near: f32,
}

/// Intervals of a ray, world distance.
#[derive(Clone, Copy)]
struct Parts {
    line: PixelLine,
    /// Where the frame has any coverage.
    outer: (f32, f32),
    /// Where its coverage is 1.
    inner: (f32, f32),
}

/// What a ray has collected: by *over*, or in a projection.
struct Acc {
    compositing: Compositing,
    over: Over,
    projected: Projected,
}

impl Acc {
    /// Puts something behind what was collected.
    fn put(&mut self, seen: &Over) {
        self.over.c += seen.c * self.over.transmittance;
        self.over.transmittance *= seen.transmittance;
    }

    fn collect(&mut self, collected: &Projected) {
        self.projected.add(self.compositing, collected.c, collected.key);
    }
}

/// What is cast between two cuts of a ray.
#[derive(Clone, Copy)]
enum CastPiece {
    /// One frame.
    Alone(usize),
    /// Several frames, in a band where the coverage of one changes.
    Mixed,
}

impl FrameFrustum {
    fn of(camera: &Camera) -> Self {
        Self { basis: camera.basis(), near: camera.near }
    }

    /// The part of `within` at least `inset` pixels inside the frustum; empty unless its end is after its start.
    fn clip(&self, line: &PixelLine, inset: f32, within: (f32, f32)) -> (f32, f32) {
        let planes = frustum_planes(line, [self.basis.width, self.basis.height], self.near, inset);
        clip_by_planes(planes, within)
    }

    /// Distance of a homogeneous pixel from the nearest border, pixels: negative outside, minus infinity behind the
    /// near plane.
    fn inset(&self, h: Vec3, depth: f32) -> f32 {
        if depth < self.near {
            return f32::NEG_INFINITY;
        }
        let (x, y) = (h.x / h.z, h.y / h.z);
        x.min(self.basis.width - x).min(y).min(self.basis.height - y)
    }

    /// The same for a point in world space.
    fn inset_of(&self, point: Vec3) -> f32 {
        self.inset(self.basis.pixel_from_point(point), self.basis.depth_of(point))
    }
}

impl Combiner {
    /// Takes at most [`MAX_FRAMES`] frames of one volume and look, the newest first. `bounds` is the box of the
    /// volume, `display` the picture's camera, and `clip` the visible part.
    pub fn new(frames: &[&LayeredFrame], bounds: &Aabb, display: &Camera, clip: &Clip) -> Self {
        let mut rounding = 0f32;
        let layers = frames.iter().take(MAX_FRAMES).enumerate().map(|(n, frame)| {
            let camera = &frame.header.camera;
            rounding = rounding.max(MARGIN_UNITS * (camera.far - camera.near) / DEPTH_UNITS);
            let view = FrameFrustum::of(camera);
            let band = if n == 0 { band_of_newest(camera, &display.basis(), bounds) } else { BAND };
            FrameLayer { caster: Raycaster::new(frame, bounds), view, band }
        });
        let layers = layers.collect();
        let options = CastOptions { clip: *clip, ..CastOptions::default() };
        Self { layers, region: clip.region(bounds).grown(rounding), options }
    }

    /// Premultiplied colour and opacity along a ray in world space.
    pub fn cast(&self, ray: &Ray) -> Over {
        let Some((newest, older)) = self.layers.split_first() else { return Over::default() };
        let Some(all) = self.region.clip(ray) else { return Over::default() };
        let line = newest.view.basis.line(ray);
        if older.is_empty() || newest.view.clip(&line, newest.band, all) == all {
            return newest.caster.cast(ray, &self.options);
        }
        let acc = self.cast_pieces(ray, all, newest.caster.compositing);
        if newest.caster.compositing == Compositing::Over {
            acc.over
        } else {
            newest.caster.shown(&acc.projected, ray)
        }
    }

    fn cast_pieces(&self, ray: &Ray, all: (f32, f32), compositing: Compositing) -> Acc {
        let mut cuts = [all.1; 4 * MAX_FRAMES + 2];
        cuts[0] = all.0;
        let parts: [Option<Parts>; MAX_FRAMES] = std::array::from_fn(|n| {
            let layer = self.layers.get(n)?;
            let line = layer.view.basis.line(ray);
            let outer = layer.view.clip(&line, 0.0, all);
            if outer.1 <= outer.0 {
                return None;
            }
            let inner = layer.view.clip(&line, layer.band, all);
            cuts[4 * n + 2..4 * n + 4].copy_from_slice(&[outer.0, outer.1]);
            if inner.1 > inner.0 {
                cuts[4 * n + 4..4 * n + 6].copy_from_slice(&[inner.0, inner.1]);
            }
            Some(Parts { line, outer, inner })
        });
        cuts.sort_unstable_by(f32::total_cmp);
        let mut acc = Acc { compositing, over: Over::default(), projected: Projected::default() };
        // A frame that is alone in neighbouring pieces is cast over all of them at once.
        let mut pending: Option<(CastPiece, (f32, f32))> = None;
        for pair in cuts.windows(2) {
            let [from, to] = [pair[0], pair[1]];
            if to <= from {
                continue;
            }
            if acc.over.transmittance < TRANSMITTANCE_MIN {
                return acc;
            }
            let middle = 0.5 * (from + to);
            let holds = |(a, b): (f32, f32)| a <= middle && middle <= b;
            let first = parts.iter().position(|p| p.is_some_and(|p| holds(p.outer)));
            let next = first.map(|n| {
                let is_full = parts[n].is_some_and(|p| holds(p.inner));
                let has_others = parts[n + 1..].iter().any(|p| p.is_some_and(|p| holds(p.outer)));
                if has_others && !is_full { CastPiece::Mixed } else { CastPiece::Alone(n) }
            });
            match (next, &mut pending) {
                (Some(CastPiece::Alone(n)), Some((CastPiece::Alone(before), (_, end)))) if *before == n => {
                    *end = to
                }
                _ => {
                    if let Some((piece, within)) = pending.take() {
                        self.add(&mut acc, ray, &parts, piece, within);
                    }
                    pending = next.map(|piece| (piece, (from, to)));
                }
            }
        }
        if let Some((piece, within)) = pending {
            self.add(&mut acc, ray, &parts, piece, within);
        }
        acc
    }

    /// Puts a piece behind what was collected: of one frame, or mixed in steps of about a list.
    fn add(
        &self,
        acc: &mut Acc,
        ray: &Ray,
        parts: &[Option<Parts>; MAX_FRAMES],
        piece: CastPiece,
        within: (f32, f32),
    ) {
        let project = |n: usize, within| self.layers[n].caster.project_between(ray, within, &self.options);
        if let CastPiece::Alone(n) = piece {
            if acc.compositing == Compositing::Over {
                acc.put(&self.layers[n].caster.cast_between(ray, within, &self.options));
            } else {
                acc.collect(&project(n, within));
            }
            return;
        }
        let insets = |s: f32| -> [f32; MAX_FRAMES] {
            std::array::from_fn(|n| match (parts[n], self.layers.get(n)) {
                (Some(p), Some(layer)) => {
                    layer.view.inset(p.line.at(s), p.line.depth_at(s)).clamp(0.0, layer.band)
                }
                _ => 0.0,
            })
        };
        let (a, b) = (insets(within.0), insets(within.1));
        let change = (0..MAX_FRAMES).map(|n| (a[n] - b[n]).abs()).fold(0.0, f32::max);
        let steps = (change.ceil() as usize).clamp(1, BAND as usize);
        let at = |i: usize| within.0 + (within.1 - within.0) * (i as f32 / steps as f32);
        for i in 0..steps {
            let (from, to) = (at(i), at(i + 1));
            let insets = insets(0.5 * (from + to));
            let mut weights = [0.0; MAX_FRAMES];
            let mut rest = 1.0;
            for (n, layer) in self.layers.iter().enumerate() {
                // The newest frame's band may have no width; then it covers all that it sees.
                let covered = if layer.band > 0.0 {
                    insets[n] / layer.band
                } else {
                    f32::from(u8::from(parts[n].is_some()))
                };
                weights[n] = rest * covered;
                rest -= weights[n];
            }
            let sum = 1.0 - rest;
            if sum <= 0.0 {
                continue;
            }
            let weights = weights.into_iter().enumerate().filter(|(_, w)| *w > LEAST_WEIGHT);
            if acc.compositing != Compositing::Over {
                let mut mixture = Projected::default();
                for (n, weight) in weights {
                    let collected = project(n, (from, to));
                    mixture.c += collected.c * (weight / sum);
                    mixture.key += collected.key * (weight / sum);
                }
                acc.collect(&mixture);
                continue;
            }
            let (mut tau, mut light) = (0.0, Vec3::ZERO);
            for (n, weight) in weights {
                let seen = self.layers[n].caster.cast_between(ray, (from, to), &self.options);
                // Casting stops at opaque matter, so this optical depth is a lower bound.
                let tau_n = -seen.transmittance.max(TRANSMITTANCE_MIN).ln();
                if tau_n > 0.0 {
                    tau += weight / sum * tau_n;
                    light += seen.c * (weight / sum * tau_n / (1.0 - seen.transmittance));
                }
            }
            if tau > 0.0 {
                let transmittance = (-tau).exp();
                acc.put(&Over { c: light * ((1.0 - transmittance) / tau), transmittance });
            }
        }
    }
}

/// The picture of several layered frames of one volume and look, the newest first, premultiplied linear. With one
/// frame it equals [`super::raycast::raycast`]. `bounds` is the box of the volume.
pub fn combine(frames: &[&LayeredFrame], bounds: &Aabb, camera: &Camera) -> Picture {
    combine_clipped(frames, bounds, camera, &Clip::default())
}

/// The same with only the part of the volume inside `clip`.
pub fn combine_clipped(frames: &[&LayeredFrame], bounds: &Aabb, camera: &Camera, clip: &Clip) -> Picture {
    let mut picture = Picture::new(camera.intrinsics.width, camera.intrinsics.height);
    let combiner = Combiner::new(frames, bounds, camera, clip);
    let basis = camera.basis();
    let width = picture.width as usize;
    picture.pixels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let (ray, _) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
            *pixel = combiner.cast(&ray).rgba();
        }
    });
    picture
}

/// Chooses the `kept` frames that show what the newest lacks in a picture, by their cameras: at most [`MAX_FRAMES`] −
/// 1. The one that adds most comes first; of two alike, the later in the list does. Empty if the newest sees
/// everything.
pub fn choose(display: &Camera, newest: &Camera, kept: &[Camera], bounds: &Aabb) -> Vec<usize> {
    let sees = |camera: &Camera, p: Vec3, inset: f32| {
        let view = FrameFrustum::of(camera);
        view.inset_of(p) > inset
    };
    let all = points(&display.basis(), bounds);
    // The inset is half a list: a frame sees all points from its own pose, on the rays of its pixels.
    let mut unseen: Vec<Vec3> = all.iter().copied().filter(|p| !sees(newest, *p, -0.5)).collect();
    let worth_while = all.len() / 100 + 1;
    let mut chosen = Vec::new();
    while chosen.len() < MAX_FRAMES - 1 {
        let gain = |n: usize| unseen.iter().filter(|p| sees(&kept[n], **p, 0.0)).count();
        let gains = (0..kept.len()).filter(|n| !chosen.contains(n)).map(|n| (gain(n), n));
        let Some((_, best)) = gains.max().filter(|(gain, _)| *gain >= worth_while) else { break };
        unseen.retain(|p| !sees(&kept[best], *p, 0.0));
        chosen.push(best);
    }
    chosen
}

/// Width of the newest frame's band in a picture of `display`, lists: the most pixels by which the picture shows
/// matter beyond its border.
pub fn band_of_newest(newest: &Camera, display: &Basis, bounds: &Aabb) -> f32 {
    let view = FrameFrustum::of(newest);
    points(display, bounds).into_iter().map(|p| -view.inset_of(p)).fold(0.0, f32::max).clamp(0.0, BAND)
}

/// Points of the box that a picture shows: on a grid of its rays, where each enters and leaves the box, and between.
fn points(basis: &Basis, bounds: &Aabb) -> Vec<Vec3> {
    let side = |n: f32, i: usize| 0.5 + (n - 1.0) * (i as f32 / (GRID - 1) as f32);
    let mut points = Vec::with_capacity(GRID * GRID * DEPTHS);
    for (i, j) in (0..GRID).flat_map(|j| (0..GRID).map(move |i| (i, j))) {
        let (ray, _) = basis.ray(side(basis.width, i), side(basis.height, j));
        if let Some((s0, s1)) = bounds.clip(&ray) {
            points.extend((0..DEPTHS).map(|k| ray.at(s0 + (s1 - s0) * (k as f32 / (DEPTHS - 1) as f32))));
        }
    }
    points
}

/// Most frames in one picture.
pub const MAX_FRAMES: usize = 4;
/// Width of the band that mixes frames, lists: wide enough to hide the border, and only a hundredth or two of a
/// frame.
const BAND: f32 = 8.0;
/// The least weight of a frame that is cast: a quarter of one step of 1/255.
const LEAST_WEIGHT: f32 = 1e-3;
/// Rays along each side of the grid, and points on each ray.
const GRID: usize = 9;
const DEPTHS: usize = 4;
