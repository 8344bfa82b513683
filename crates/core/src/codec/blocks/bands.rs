//! Divides rows of tiles into bands that each take about the same time to code.

use super::super::bands::Borders;
use super::super::limits::MAX_CHUNK_SEGMENTS;
use super::model::{BLOCK, BLOCK_LISTS, TILE, blocks_along, tiles_along};
use crate::layer::LayeredFrame;

/// Estimated work for each row of tiles of a frame.
pub(in crate::codec) fn work_of_rows(frame: &LayeredFrame) -> Vec<usize> {
    let intrinsics = frame.header.camera.intrinsics;
    let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
    let mut longest = vec![0; width];
    let mut of_blocks = |y: usize| -> usize {
        longest.fill(0);
        for row in y * BLOCK..((y + 1) * BLOCK).min(height) {
            let ends = &frame.offsets[row * width..=(row + 1) * width];
            for ((longest, start), end) in longest.iter_mut().zip(ends).zip(&ends[1..]) {
                *longest = (end - start).max(*longest);
            }
        }
        let of_block = |columns: &[u32]| columns.iter().fold(0, |most, length| most.max(*length));
        longest.chunks(BLOCK).map(|columns| work_of(of_block(columns))).sum()
    };
    let down = blocks_along(intrinsics.height);
    let rows = (0..tiles_along(intrinsics.height)).map(|row| row * TILE..((row + 1) * TILE).min(down));
    rows.map(|row| row.map(&mut of_blocks).sum()).collect()
}

/// Where the bands of a frame of `width` lists a row end, in rows of tiles, given the work of these. If a band would
/// have more blocks than a chunk may correct, all bands are equally high.
pub(super) fn borders(work: &[usize], width: u32, num_bands: u8) -> Borders {
    let (across, down) = (blocks_along(width), work.len());
    let borders = Borders::sharing(work, num_bands);
    let most = MAX_CHUNK_SEGMENTS / BLOCK_LISTS;
    let is_within = |band| borders.rows(band, down).len() * TILE * across <= most;
    if (0..usize::from(num_bands)).all(is_within) {
        borders
    } else {
        Borders::sharing(&vec![1; down], num_bands)
    }
}

/// Estimated work for a block whose longest list has `longest` segments. Time is proportional to its layers, which
/// are not many more.
fn work_of(longest: u32) -> usize {
    match longest {
        0 => 0,
        1 => 1,
        longest => 4 * (longest as usize - 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Intrinsics, Pose};
    use crate::layer::FrameHeader;
    use crate::space::Aabb;
    use glam::Vec3;

    /// A frame with so many segments in each list of a row of tiles.
    fn frame(width: u32, per_list: &[u32]) -> LayeredFrame {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let intrinsics = Intrinsics::perspective(width, (per_list.len() * TILE * BLOCK) as u32 - 3, 0.7);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 5.0), intrinsics, &bounds);
        let mut frame = LayeredFrame::empty(FrameHeader::alone(camera, 8));
        let mut end = 0;
        for (i, offset) in frame.offsets[1..].iter_mut().enumerate() {
            end += per_list[i / width as usize / BLOCK / TILE];
            *offset = end;
        }
        let total = end as usize;
        (frame.depth, frame.c_rg, frame.c_b_tau) = (vec![1 << 16; total], vec![0; total], vec![0; total]);
        frame
    }

    #[test]
    fn blocks_without_matter_are_no_work() {
        // Rows of tiles, of which two hold anything: each band gets one of these.
        let rows = |per_list: &[u32]| {
            let borders = borders(&work_of_rows(&frame(64, per_list)), 64, 2);
            [0, 1].map(|band| borders.rows(band, per_list.len()))
        };
        assert_eq!(rows(&[0, 0, 0, 0, 1, 1]), [0..5, 5..6]);
        assert_eq!(rows(&[1, 1, 0, 0, 0, 0]), [0..1, 1..6]);
    }

    #[test]
    fn a_band_has_no_more_blocks_than_its_chunk_may_correct() {
        // Empty rows of 2048 blocks above four with matter: the first band has them and one of those. 64 are 2^17 blocks.
        let of = |num_empty: usize| {
            let work = [&vec![0; num_empty][..], &[1; 4]].concat();
            borders(&work, 16384, 4)
        };
        assert_eq!(of(7).rows(0, 11), 0..8);
        assert_eq!(of(8), Borders::sharing(&[1; 12], 4));
    }
}
