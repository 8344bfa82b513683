//! The segments of a frame, unpacked to what a crossing needs.

use glam::{Vec3, Vec4};
use rayon::prelude::*;

use super::pieces::opacity;
use super::projected::Way;
use crate::camera::Basis;
use crate::layer::{LayeredFrame, key_from_slot, pack_halves};
use crate::mode::Compositing;

/// A segment as a homogeneous medium, in 16 bytes: memory limits casting as much as arithmetic does. A projection
/// stores other numbers in the same fields, see [`super::projected`].
#[derive(Clone, Copy, Default)]
#[repr(C, align(16))]
pub(in crate::kernels) struct Medium {
    /// Front and back as in a frame's depth plane.
    pub(super) depth: u32,
    /// Extinction along the list's centre, 1/world unit.
    pub(in crate::kernels) sigma: f32,
    /// Source colour E = C/α, and 1, as half floats.
    pub(super) e: [u16; 4],
}

impl Medium {
    pub(in crate::kernels) fn front(&self) -> f32 {
        (self.depth & 0xffff) as i32 as f32
    }

    pub(in crate::kernels) fn back(&self) -> f32 {
        (self.depth >> 16) as i32 as f32
    }

    /// The source colour and 1.
    pub(in crate::kernels) fn e(&self) -> Vec4 {
        unpacked(self.e)
    }
}

/// Unpacks four half floats, which are not negative.
#[inline(always)]
pub(super) fn unpacked(halves: [u16; 4]) -> Vec4 {
    Vec4::from_array(halves.map(|h| f32::from_bits(u32::from(h) << 13))) * HALF_SCALE
}

/// The cells of a list between two depths, one bit each.
#[inline]
pub(super) fn list_cells(lo: u16, hi: u16) -> u64 {
    (u64::MAX << (lo >> 10)) & (u64::MAX >> (63 - (hi >> 10)))
}

/// Unpacks the backs and segments of all lists, row by row in parallel.
pub(super) fn unpack(
    frame: &LayeredFrame,
    basis: &Basis,
    depth_per_unit: f32,
    row_length: usize,
    way: &Way,
) -> (Vec<u16>, Vec<u64>, Vec<Medium>) {
    let width = frame.header.camera.intrinsics.width as usize;
    let num_lists = frame.offsets.len() - 1;
    let mut backs = vec![u16::MAX; num_lists * row_length];
    let mut occupied = vec![0; num_lists];
    // The index behind the last segment is read too.
    let mut media = vec![Medium::default(); frame.num_segments() + 1];
    let mut rest_of_media = &mut media[..];
    let mut rest_of_backs = &mut backs[..];
    let mut rows = Vec::with_capacity(num_lists / width);
    for (y, occupied) in occupied.chunks_mut(width).enumerate() {
        let num = frame.offsets[(y + 1) * width] - frame.offsets[y * width];
        let (media, others) = rest_of_media.split_at_mut(num as usize);
        rest_of_media = others;
        let (backs, others) = rest_of_backs.split_at_mut(width * row_length);
        rest_of_backs = others;
        rows.push((y, backs, occupied, media));
    }
    rows.into_par_iter().for_each(|(y, backs, occupied, media)| {
        let start_of_row = frame.offsets[y * width] as usize;
        for (x, occupied) in occupied.iter_mut().enumerate() {
            // World length of one depth unit along the centre of this list.
            let center = basis.direction(x as f32 + 0.5, y as f32 + 0.5);
            let length_per_unit = depth_per_unit * center.length();
            let compositing = frame.header.mode.compositing();
            let parts_of_way = match compositing {
                Compositing::Mean => way.parts(&basis.ray(x as f32 + 0.5, y as f32 + 0.5).0),
                _ => 1.0,
            };
            for (i, index) in frame.list(y * width + x).enumerate() {
                let segment = frame.segment(index);
                if row_length > 0 {
                    backs[x * row_length + i] = segment.back;
                }
                *occupied |= list_cells(segment.front, segment.back.saturating_sub(1));
                let alpha = opacity(segment.tau);
                let length = f32::from(segment.back.saturating_sub(segment.front)) * length_per_unit;
                let (e, sigma) = match compositing {
                    Compositing::Over if alpha > 0.0 => (segment.c / alpha, segment.tau / length),
                    Compositing::Over => (Vec3::ZERO, segment.tau / length),
                    Compositing::Greatest => (segment.c, key_from_slot(segment.tau)),
                    Compositing::Mean => (segment.c * parts_of_way, 1.0 / length),
                };
                let (rg, b1) = (pack_halves(e.x, e.y), pack_halves(e.z, 1.0));
                media[index - start_of_row] = Medium {
                    depth: frame.depth[index],
                    sigma,
                    e: [rg as u16, (rg >> 16) as u16, b1 as u16, (b1 >> 16) as u16],
                };
            }
        }
    });
    (backs, occupied, media)
}

/// Scales a half float's bits, moved to their place in a float, to its value: 2¹¹².
const HALF_SCALE: f32 = f32::from_bits((254 - 15) << 23);
