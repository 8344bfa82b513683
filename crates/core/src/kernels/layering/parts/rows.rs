//! Rows of a frame that go from one process to another.

use rayon::prelude::*;

use super::AskedFrame;
use crate::kernels::layering::pieces::join_rows;
use crate::kernels::part_rows::PartsError;
use crate::layer::{FrameHeader, LayeredFrame};

/// The frame with the lists of `rows`, which [`unite`](super::unite) has `made`. All other rows are empty.
pub fn frame_of_rows(frame: &AskedFrame, rows: &[u32], made: Vec<LayeredFrame>) -> LayeredFrame {
    with_rows(frame.of_frame(), rows.iter().copied().zip(made))
}

fn with_rows(header: FrameHeader, rows: impl Iterator<Item = (u32, LayeredFrame)>) -> LayeredFrame {
    let [width, height] = [header.camera.intrinsics.width, header.camera.intrinsics.height];
    let empty = || LayeredFrame {
        header,
        offsets: vec![0; width as usize],
        depth: vec![],
        c_rg: vec![],
        c_b_tau: vec![],
    };
    let mut all: Vec<LayeredFrame> = (0..height).map(|_| empty()).collect();
    for (y, row) in rows {
        if let Some(place) = all.get_mut(y as usize) {
            *place = row;
        }
    }
    join_rows(header, all)
}

/// Rows of a frame as words: for each its ends of lists, and its planes.
pub fn words_from_rows(frame: &LayeredFrame, rows: &[u32]) -> Vec<u32> {
    let width = frame.header.camera.intrinsics.width as usize;
    let row = |y: &u32| {
        let ends = &frame.offsets[*y as usize * width..=(*y as usize + 1) * width];
        let segments = ends[0] as usize..ends[width] as usize;
        let mut words = Vec::with_capacity(width + 3 * segments.len());
        words.extend(ends[1..].iter().map(|end| end - ends[0]));
        for plane in [&frame.depth, &frame.c_rg, &frame.c_b_tau] {
            words.extend_from_slice(&plane[segments.clone()]);
        }
        words
    };
    rows.par_iter().map(row).collect::<Vec<_>>().concat()
}

/// The frame with the rows that each process sent, as [`words_from_rows`] wrote them. `rows` has the rows of each. All
/// other rows are empty.
///
/// # Errors
/// If one did not send its rows.
pub fn frame_from_words(
    header: FrameHeader,
    rows: &[Vec<u32>],
    words: &[Vec<u32>],
) -> Result<LayeredFrame, PartsError> {
    if rows.len() != words.len() {
        return Err(PartsError::Processes { found: words.len(), expected: rows.len() });
    }
    let width = header.camera.intrinsics.width as usize;
    let mut found = Vec::new();
    for (rank, (words, rows)) in words.iter().zip(rows).enumerate() {
        let mut at = 0;
        let mut take = |num: usize| {
            let taken = words.get(at..at + num).map(<[u32]>::to_vec);
            at += num;
            taken.ok_or(PartsError::Words { rank, found: words.len(), expected: at })
        };
        for &y in rows {
            let offsets = take(width)?;
            if !offsets.is_sorted() {
                return Err(PartsError::Lists { rank, row: y });
            }
            let num = offsets.last().copied().unwrap_or(0) as usize;
            let (depth, c_rg, c_b_tau) = (take(num)?, take(num)?, take(num)?);
            found.push((y, LayeredFrame { header, offsets, depth, c_rg, c_b_tau }));
        }
        if at != words.len() {
            return Err(PartsError::Words { rank, found: words.len(), expected: at });
        }
    }
    Ok(with_rows(header, found.into_iter()))
}
