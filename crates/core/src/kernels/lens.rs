//! Pictures that are averages of pinhole pictures: stereo pair, depth of field, motion blur (Lochmann 2016, section
//! 4.3). Every pinhole view is cast by the kernel of the plain picture from the same layered frame; there is no kernel
//! of its own here, only the choice of the views and their mean.
//!
//! **A shifted eye.** An eye that is moved by o within the plane of the camera sees the plane at view depth f, the
//! focus, in place if its picture is shifted back (an off-axis frustum, not a turned camera: no vertical parallax).
//! As the direction of a pixel has view depth 1,
//!
//!   eye' = eye + o,   forward' = forward − o/f,   right' = right,   up' = up,
//!
//! so a [`Basis`] whose `forward` is no longer perpendicular holds it, and view depths stay what they were. A point at
//! depth z then moves in the picture by o·(1/f − 1/z)/tan(fov/2) half pictures: nothing at the focus.
//!
//! **Stereo**: o = ∓½ eye distance to the right. **Thin lens**: o over a disc; what is at depth z becomes a disc of
//! radius a·|1/f − 1/z| times half the picture's height over tan(fov_y/2), in pixels. **Shutter**: the pose moves from
//! one to another. Lens and shutter together take sample i of both.

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::march::{Marcher, Scene, TRANSMITTANCE_MIN, Texels, with_texels};
use super::raycast::{CastOptions, Raycaster};
use crate::camera::{Basis, Camera, MAX_SIDE, Pose};
use crate::layer::LayeredFrame;
use crate::picture::Picture;
use crate::space::Aabb;

/// A pinhole view whose frustum may be off-axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Eye and picture plane; `forward` has view depth 1 and need not be perpendicular to `right` and `up`.
    pub basis: Basis,
    /// Least view depth that is drawn.
    pub near: f32,
    /// Greatest view depth of the volume.
    pub far: f32,
}

impl From<&Camera> for View {
    fn from(camera: &Camera) -> Self {
        Self { basis: camera.basis(), near: camera.near, far: camera.far }
    }
}

impl View {
    /// The view from an eye moved by `offset` (right and up, world units) that keeps the plane at `focus_depth` in
    /// place. A zero offset gives the same view to the bit.
    pub fn shifted(&self, offset: Vec2, focus_depth: f32) -> Self {
        let Basis { right, up, .. } = self.basis;
        let o = right.normalize() * offset.x + up.normalize() * offset.y;
        let basis =
            Basis { eye: self.basis.eye + o, forward: self.basis.forward - o / focus_depth, ..self.basis };
        Self { basis, ..*self }
    }

    /// The views of the left and the right eye around this one, `eye_distance` apart in world units. Points at view
    /// depth `focus_depth` coincide, so they appear on the screen.
    pub fn stereo(&self, eye_distance: f32, focus_depth: f32) -> [Self; 2] {
        [-0.5, 0.5].map(|side| self.shifted(Vec2::X * (side * eye_distance), focus_depth))
    }

    /// Whether it can be drawn: it is finite, ordered and of bounded size.
    pub fn is_valid(&self) -> bool {
        let Basis { eye, forward, right, up, width, height, perspective } = self.basis;
        let is_side = |side: f32| (1.0..=MAX_SIDE as f32).contains(&side);
        [eye, forward, right, up].iter().all(|v| v.is_finite())
            && (perspective == 0.0 || perspective == 1.0)
            && is_side(width)
            && is_side(height)
            && self.near > 0.0
            && self.far > self.near
            && self.far.is_finite()
    }
}

/// What a picture is averaged over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Radius of the lens, world units; 0 for a pinhole.
    pub aperture_radius: f32,
    /// View depth in focus, world units, positive.
    pub focus_depth: f32,
    /// The pose at which the shutter closes, if the camera moves. It opens at the camera's own.
    pub shutter: Option<Pose>,
    /// Number of views to average, at least 1.
    pub num_samples: u32,
}

impl Exposure {
    /// The views whose mean is the picture of `camera`; only its own if nothing moves and the lens is a point.
    /// `bounds` is the box of the volume: the camera turns around its centre.
    pub fn views(&self, camera: &Camera, bounds: &Aabb) -> Vec<View> {
        let shutter = self.shutter.filter(|close| *close != camera.pose);
        let n = self.num_samples.max(1);
        if self.aperture_radius <= 0.0 && shutter.is_none() {
            return vec![View::from(camera)];
        }
        let stride = coprime_stride(n);
        (0..n)
            .map(|i| {
                let view = match shutter {
                    None => View::from(camera),
                    Some(close) => {
                        // This visits every time once, in an order unrelated to the lens points.
                        let turn = u64::from(i) * u64::from(stride) % u64::from(n);
                        let t = (turn as f32 + 0.5) / n as f32;
                        let pose = pose_between(&camera.pose, &close, bounds.center(), t);
                        View::from(&Camera::new(pose, camera.intrinsics, bounds))
                    }
                };
                if self.aperture_radius > 0.0 {
                    view.shifted(disc_point(i, n) * self.aperture_radius, self.focus_depth)
                } else {
                    view
                }
            })
            .collect()
    }
}

/// Point `i` of `n` on the unit disc: a spiral of equal areas by the golden angle (Vogel 1979), well spread for any
/// `n` and without a seed.
pub fn disc_point(i: u32, n: u32) -> Vec2 {
    let radius = ((i as f32 + 0.5) / n.max(1) as f32).sqrt();
    // Single precision would lose the digits of a turn by thousands of radians.
    let angle = f64::from(i) * GOLDEN_ANGLE;
    Vec2::new(angle.cos() as f32, angle.sin() as f32) * radius
}

/// The pose at fraction `t` from `open` to `close`, turning around `center`. The rotation is a slerp along the short
/// way; the eye's offset from the centre moves linearly in view space. Between poses of one orbit the distance stays
/// constant, where a straight line in the world would dip towards the volume.
pub fn pose_between(open: &Pose, close: &Pose, center: Vec3, t: f32) -> Pose {
    let in_view = |pose: &Pose| pose.world_from_view.inverse() * (pose.eye - center);
    let world_from_view = open.world_from_view.slerp(close.world_from_view, t).normalize();
    Pose { eye: center + world_from_view * in_view(open).lerp(in_view(close), t), world_from_view }
}

/// The mean over `views` of a layered frame's pictures, premultiplied linear. `bounds` is the box of the volume. All
/// views have the size of the first; without any the picture has no pixels.
pub fn raycast_mean(frame: &LayeredFrame, bounds: &Aabb, views: &[View]) -> Picture {
    mean_of_casts(&Raycaster::new(frame, bounds), views, &CastOptions::default())
}

/// The same with a prepared frame, cast with `options`.
pub fn mean_of_casts(caster: &Raycaster, views: &[View], options: &CastOptions) -> Picture {
    mean_of(views, |view, x, y| caster.cast(&view.basis.ray(x, y).0, options).rgba())
}

/// The mean over `views` of full volume renderings: the reference for [`raycast_mean`].
pub fn render_mean(scene: &Scene, views: &[View]) -> Picture {
    with_texels!(scene, texels => render_mean_with(&Marcher::new(scene, texels), views))
}

fn render_mean_with<T: Texels>(marcher: &Marcher<'_, T>, views: &[View]) -> Picture {
    mean_of(views, |view, x, y| {
        let (ray, s_per_depth) = view.basis.ray(x, y);
        marcher.seen(&ray, view.near * s_per_depth, TRANSMITTANCE_MIN)
    })
}

/// The mean over views of `pixel`, which takes points in pixel space.
fn mean_of(views: &[View], pixel: impl Fn(&View, f32, f32) -> [f32; 4] + Sync) -> Picture {
    let (width, height) = views.first().map_or((0, 0), |v| (v.basis.width as u32, v.basis.height as u32));
    let mut picture = Picture::new(width, height);
    picture.pixels.par_chunks_mut(width.max(1) as usize).enumerate().for_each(|(y, row)| {
        for (x, out) in row.iter_mut().enumerate() {
            for view in views {
                add(out, pixel(view, x as f32 + 0.5, y as f32 + 0.5));
            }
        }
    });
    scale(&mut picture, views.len());
    picture
}

/// The mean of pictures of one size, made one after the other; `None` without any.
pub fn mean_picture<E>(pictures: impl Iterator<Item = Result<Picture, E>>) -> Result<Option<Picture>, E> {
    let mut sum: Option<(Picture, usize)> = None;
    for picture in pictures {
        let picture = picture?;
        match &mut sum {
            None => sum = Some((picture, 1)),
            Some((sum, n)) => {
                sum.pixels.iter_mut().zip(&picture.pixels).for_each(|(sum, p)| add(sum, *p));
                *n += 1;
            }
        }
    }
    Ok(sum.map(|(mut picture, n)| {
        scale(&mut picture, n);
        picture
    }))
}

fn add(sum: &mut [f32; 4], pixel: [f32; 4]) {
    sum.iter_mut().zip(pixel).for_each(|(sum, p)| *sum += p);
}

fn scale(picture: &mut Picture, num_views: usize) {
    let share = (num_views.max(1) as f32).recip();
    picture.pixels.iter_mut().flatten().for_each(|p| *p *= share);
}

/// A number coprime to `n`, near n over the golden ratio. Its multiples modulo n visit every number once, each far
/// from the previous ones.
fn coprime_stride(n: u32) -> u32 {
    let gcd = |mut a: u32, mut b: u32| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let near = (f64::from(n) * (GOLDEN_RATIO - 1.0)).round() as u32;
    (near.max(1)..=n).find(|&stride| gcd(stride, n) == 1).unwrap_or(1)
}

/// Most views of one picture: more make no visible difference, and a typing error would take for ever.
pub const MAX_SAMPLES: u32 = 4096;
const GOLDEN_RATIO: f64 = 1.618_033_988_749_895;
/// π(3 − √5), radians.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
