//! Where the bands of a frame end: at rows of blocks, so that all of them take about as long.

use std::ops::Range;

use super::super::{CodecError, MAX_BANDS, MAX_CHUNK_SEGMENTS};
use super::band::blocks_along;
use super::model::{BLOCK, BLOCK_LISTS};
use super::relayer::BlockLists;
use crate::layer::LayeredFrame;

/// Where all bands but the last end, in rows of blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Borders {
    ends: [u16; MAX_BANDS - 1],
    num: u8,
}

impl Borders {
    /// Those of a frame in `num_bands` bands of about the same work. `None` for a frame of one band, for one without
    /// matter, for one with fewer rows of blocks than bands, and for one so large that a band would have more blocks than
    /// a chunk may correct: bands of equal height have no more.
    pub(super) fn of(frame: &LayeredFrame, num_bands: u8) -> Option<Self> {
        let intrinsics = frame.header.camera.intrinsics;
        let (across, down) = (blocks_along(intrinsics.width), blocks_along(intrinsics.height));
        let num = usize::from(num_bands).checked_sub(1).filter(|num| (1..MAX_BANDS).contains(num))?;
        let work: Vec<usize> = (0..down)
            .map(|y| {
                let lists =
                    |y: usize| (y * BLOCK).min(intrinsics.height as usize) * intrinsics.width as usize;
                let segments = frame.offsets[lists(y + 1)] - frame.offsets[lists(y)];
                let is_filled = |x: &usize| !BlockLists::is_nothing(frame, *x as u32, y as u32);
                segments as usize + WORK_OF_BLOCK * (0..across).filter(is_filled).count()
            })
            .collect();
        let total: usize = work.iter().sum();
        if total == 0 || down < num + 1 {
            return None;
        }
        let mut ends = [0; MAX_BANDS - 1];
        let (mut row, mut done) = (0, 0);
        for (n, end) in ends[..num].iter_mut().enumerate() {
            // A row at least for this band, and for each of those behind it.
            let (least, most) = (row + 1, down - (num - n));
            let goal = total * (n + 1) / (num + 1);
            while row < least || (row < most && done + work[row] / 2 < goal) {
                done += work[row];
                row += 1;
            }
            *end = row as u16;
        }
        let borders = Self { ends, num: num as u8 };
        let most = MAX_CHUNK_SEGMENTS / BLOCK_LISTS;
        let is_within = |band: u8| borders.rows(band, down).len() * across <= most;
        (0..num_bands).all(is_within).then_some(borders)
    }

    /// Takes them from the front of `bytes`: those of a frame in `num_bands` bands with so many rows of blocks.
    pub(super) fn read(bytes: &mut &[u8], num_bands: u8, num_rows: usize) -> Result<Self, CodecError> {
        let damaged = |problem: String| CodecError::Payload { plane: "head", problem };
        let num = usize::from(num_bands).saturating_sub(1).min(MAX_BANDS - 1);
        if num == 0 {
            return Err(damaged("borders of one band".into()));
        }
        let Some((stated, rest)) = bytes.split_at_checked(2 * num) else {
            return Err(damaged(format!("{} bytes of borders, expected {}", bytes.len(), 2 * num)));
        };
        let mut ends = [0; MAX_BANDS - 1];
        let mut last = 0;
        for (end, stated) in ends.iter_mut().zip(stated.as_chunks::<2>().0) {
            *end = u16::from_le_bytes(*stated);
            if *end <= last || usize::from(*end) >= num_rows {
                let expected = format!("more than {last} and less than {num_rows}");
                return Err(damaged(format!("a band that ends at row {end}, expected {expected}")));
            }
            last = *end;
        }
        *bytes = rest;
        Ok(Self { ends, num: num as u8 })
    }

    /// As [`Borders::read`] takes them.
    pub(super) fn write(&self, out: &mut Vec<u8>) {
        self.ends().iter().for_each(|end| out.extend(end.to_le_bytes()));
    }

    /// The rows of blocks of a band, of a frame with so many.
    pub(super) fn rows(&self, band: u8, num_rows: usize) -> Range<usize> {
        let end = |n: usize| self.ends().get(n).map_or(num_rows, |end| usize::from(*end));
        let band = usize::from(band);
        let first = band.checked_sub(1).map_or(0, end);
        first..end(band)
    }

    fn ends(&self) -> &[u16] {
        &self.ends[..usize::from(self.num)]
    }
}

/// What a block with matter takes beside its segments, in segments.
const WORK_OF_BLOCK: usize = BLOCK_LISTS;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Intrinsics, Pose};
    use crate::layer::FrameHeader;
    use crate::space::Aabb;
    use glam::Vec3;

    /// A frame of 64 columns with so many segments in each list of a row of blocks.
    fn frame(per_list: &[u32]) -> LayeredFrame {
        frame_of(64, per_list)
    }

    fn frame_of(width: u32, per_list: &[u32]) -> LayeredFrame {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let intrinsics = Intrinsics::perspective(width, (per_list.len() * BLOCK) as u32 - 3, 0.7);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 5.0), intrinsics, &bounds);
        let mut frame = LayeredFrame::empty(FrameHeader::alone(camera, 8));
        let mut end = 0;
        for (i, offset) in frame.offsets[1..].iter_mut().enumerate() {
            end += per_list[i / width as usize / BLOCK];
            *offset = end;
        }
        let total = end as usize;
        (frame.depth, frame.c_rg, frame.c_b_tau) = (vec![1 << 16; total], vec![0; total], vec![0; total]);
        frame
    }

    #[test]
    fn bands_share_the_work_and_have_every_row_once() {
        for per_list in
            [&[0, 0, 1, 9, 9, 8, 9, 7, 2, 0, 0, 0][..], &[8; 4], &[0, 0, 0, 0, 0, 9], &[9, 0, 0, 0, 0]]
        {
            let borders = Borders::of(&frame(per_list), 4).unwrap();
            let rows = [0, 1, 2, 3].map(|band| borders.rows(band, per_list.len()));
            assert!(rows.iter().all(|rows| !rows.is_empty()), "{rows:?}");
            assert!(rows.iter().cloned().flatten().eq(0..per_list.len()), "{rows:?}");
            let mut bytes = vec![];
            borders.write(&mut bytes);
            assert_eq!(bytes.len(), 6);
            let mut rest = &[&bytes[..], &[77]].concat()[..];
            assert_eq!(Borders::read(&mut rest, 4, per_list.len()), Ok(borders));
            assert_eq!(rest, [77]);
        }
        // No band has more than its share and a row; four of equal height have.
        let per_list = [0, 0, 1, 9, 9, 8, 9, 7, 2, 0, 0, 0];
        let borders = Borders::of(&frame(&per_list), 4).unwrap();
        let most = |rows: [Range<usize>; 4]| rows.map(|r| per_list[r].iter().sum::<u32>()).into_iter().max();
        assert!(most([0, 1, 2, 3].map(|b| borders.rows(b, 12))) <= Some(45 / 4 + 9));
        assert!(most([0..3, 3..6, 6..9, 9..12]) > Some(45 / 4 + 9));
    }

    #[test]
    fn what_needs_no_borders_has_none() {
        assert_eq!(Borders::of(&frame(&[8; 9]), 1), None);
        assert_eq!(Borders::of(&frame(&[0; 9]), 4), None);
        assert_eq!(Borders::of(&frame(&[8; 3]), 4), None);
    }

    #[test]
    fn a_band_has_no_more_blocks_than_its_chunk_may_correct() {
        // Empty rows of 2048 blocks above four with matter: the first band has them and one of those. 64 are 2^17 blocks.
        let of =
            |num_empty: usize| Borders::of(&frame_of(16384, &[&vec![0; num_empty][..], &[1; 4]].concat()), 4);
        assert_eq!(of(63).unwrap().rows(0, 67), 0..64);
        assert_eq!(of(64), None);
    }

    #[test]
    fn borders_that_do_not_part_the_rows_are_refused() {
        let read = |ends: &[u16], num_bands, num_rows| {
            let bytes: Vec<u8> = ends.iter().flat_map(|end| end.to_le_bytes()).collect();
            Borders::read(&mut &bytes[..], num_bands, num_rows)
        };
        assert!(read(&[1, 2, 3], 4, 4).is_ok() && read(&[1, 2, 3, 4, 5, 6, 7], 8, 9).is_ok());
        for (ends, num_bands, num_rows) in [
            (&[0, 2, 3][..], 4, 4),
            (&[1, 1, 3], 4, 4),
            (&[2, 1, 3], 4, 4),
            (&[1, 2, 4], 4, 4),
            (&[1, 2, u16::MAX], 4, 1024),
            (&[1, 2], 4, 4),
            (&[], 2, 4),
            (&[1], 1, 4),
            (&[1], 0, 4),
        ] {
            assert!(read(ends, num_bands, num_rows).is_err(), "{ends:?}");
        }
    }
}
