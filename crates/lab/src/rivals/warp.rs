//! Common parts of the methods that redraw an old picture: the map between two cameras' pixels, the order that needs
//! no sort, and compositing into a band of rows.

use glam::Vec3;
use isinglass_core::camera::{Basis, Camera};
use isinglass_core::kernels::march::TRANSMITTANCE_MIN;
use isinglass_core::picture::Picture;
use rayon::prelude::*;

/// The map from an old camera's pixels to a new camera's. The point that the old camera sees at (x, y) of its pixel
/// space in view depth w has the new homogeneous pixel coordinates (x'·w', y'·w', w') = w·(x·X + y·Y + Z) + O.
#[derive(Clone, Copy, Debug)]
pub(super) struct Warp {
    /// The vector X.
    pub(super) per_x: Vec3,
    /// The vector Y.
    pub(super) per_y: Vec3,
    /// The vector Z.
    pub(super) per_depth: Vec3,
    /// The vector O.
    pub(super) offset: Vec3,
}

impl Warp {
    /// From the pixels of `old` to those of `new`.
    pub(super) fn new(old: &Basis, new: &Basis) -> Self {
        Self {
            per_x: new.pixel_from_direction(old.right * (2.0 / old.width)),
            per_y: new.pixel_from_direction(old.up * (-2.0 / old.height)),
            per_depth: new.pixel_from_direction(old.forward - old.right + old.up),
            offset: new.pixel_from_point(old.eye),
        }
    }

    /// New homogeneous pixel coordinates of a point.
    pub(super) fn apply(&self, x: f32, y: f32, depth: f32) -> Vec3 {
        (self.per_x * x + self.per_y * y + self.per_depth) * depth + self.offset
    }
}

/// The order in which the cells of an old picture hide each other in a new one, nearest first, found without a sort
/// (McMillan's, used by Zellmann 2012): all rows in the order of the first list, in each all columns in the order of
/// the second.
///
/// The new eye's image in the old picture, the epipole, cuts it into four quadrants, of which none hides another. All
/// points that can meet in a new pixel lie on one line through the epipole. Let θ be a point's angle at the old eye
/// from the direction of the new eye, and φ > θ its angle at the new eye: by the law of sines it is
/// |eyes apart|·sin θ/sin(φ − θ) away from the new eye, which grows with θ. So if the new eye lies in front of the old,
/// points nearer to the epipole are in front; if it lies behind, θ is counted from the other side and it is the
/// reverse.
pub(super) struct ScanOrder {
    pub(super) rows: Vec<u32>,
    pub(super) columns: Vec<u32>,
}

impl ScanOrder {
    /// For `columns`×`rows` cells of side `cell` pixels.
    pub(super) fn new(old: &Basis, new: &Basis, columns: u32, rows: u32, cell: f32) -> Self {
        let h = old.pixel_from_point(new.eye);
        let is_ahead = h.z >= 0.0;
        // An eye moved sideways has its epipole at infinity; the sign of a zero depth is that of `is_ahead`.
        let depth = if is_ahead { h.z.max(f32::MIN_POSITIVE) } else { h.z };
        let order = |epipole: f32, n: u32| -> Vec<u32> {
            // Saturates; NaN, of an eye that has not moved, gives 0, and any order is right.
            let split = ((epipole / cell).clamp(0.0, n as f32).round() as u32).min(n);
            let (low, high) = (0..split, split..n);
            if is_ahead { low.rev().chain(high).collect() } else { low.chain(high.rev()).collect() }
        };
        Self { rows: order(h.y / depth, rows), columns: order(h.x / depth, columns) }
    }
}

/// Some rows of an unfinished picture; drawing goes behind what is there.
pub(super) struct Band<'a> {
    pub(super) y0: usize,
    /// Row after the last.
    pub(super) y1: usize,
    pub(super) width: usize,
    pixels: &'a mut [[f32; 4]],
}

impl Band<'_> {
    /// Puts a premultiplied colour behind a pixel; `color` is only called if something shines through.
    pub(super) fn put_behind(&mut self, x: usize, y: usize, color: impl FnOnce() -> [f32; 4]) {
        let pixel = &mut self.pixels[(y - self.y0) * self.width + x];
        let transmittance = 1.0 - pixel[3];
        if transmittance > TRANSMITTANCE_MIN {
            let color = color();
            for (p, c) in pixel.iter_mut().zip(color) {
                *p += c * transmittance;
            }
        }
    }
}

/// A picture of the camera's size, drawn in parallel bands.
pub(super) fn in_bands(camera: &Camera, draw: impl Fn(Band<'_>) + Sync) -> Picture {
    let mut picture = Picture::new(camera.intrinsics.width, camera.intrinsics.height);
    let (width, height) = (picture.width as usize, picture.height as usize);
    picture.pixels.par_chunks_mut(width * BAND_ROWS).enumerate().for_each(|(i, pixels)| {
        let y0 = i * BAND_ROWS;
        draw(Band { y0, y1: (y0 + BAND_ROWS).min(height), width, pixels });
    });
    picture
}

/// The colour at a point of pixel space between the centres of four texels, the edge's own beyond the edge. Exact at a
/// centre.
pub(super) fn bilinear(
    [width, height]: [usize; 2],
    at: [f32; 2],
    texel: impl Fn(usize, usize) -> [f32; 4],
) -> [f32; 4] {
    let axis = |p: f32, n: usize| {
        let p = (p - 0.5).clamp(0.0, (n - 1) as f32);
        let i = p as usize;
        (i, (i + 1).min(n - 1), p - i as f32)
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (axis(at[0], width), axis(at[1], height));
    let (a, b, c, d) = (texel(x0, y0), texel(x1, y0), texel(x0, y1), texel(x1, y1));
    std::array::from_fn(|i| {
        let (top, bottom) = (a[i] + (b[i] - a[i]) * fx, c[i] + (d[i] - c[i]) * fx);
        top + (bottom - top) * fy
    })
}

/// Rows of a band: enough bands for every thread, and few enough to search each for its points.
const BAND_ROWS: usize = 16;
