//! Turns decoded blocks into a layered frame.

use rayon::prelude::*;

use super::super::bands::split_off;
use super::model::{BLOCK, BLOCK_LISTS, TILE, lists_of, tiles_along};
use super::reference::Reference;
use super::scales::{roots, scales};
use super::tile::{CellPlanes, NO_CELLS};
use crate::camera::Intrinsics;
use crate::layer::{LayeredFrame, pack_halves};

impl Reference {
    /// Returns the frame that a client shows.
    pub fn to_frame(&self) -> LayeredFrame {
        self.to_frame_in(None)
    }

    /// The same, in the memory of `spare`.
    pub(in crate::codec) fn to_frame_in(&self, spare: Option<LayeredFrame>) -> LayeredFrame {
        let Intrinsics { width, height, .. } = self.header.camera.intrinsics;
        let columns = width as usize;
        let mut num_cells = vec![0; tiles_along(height)];
        for tile in &self.tiles {
            num_cells[tile.place.first[1] / TILE] += tile.num_cells();
        }
        let total: usize = num_cells.iter().sum();
        let mut frame = LayeredFrame::in_memory_of(spare, self.header, total);
        let mut ends = &mut frame.offsets[1..];
        let mut planes = [&mut frame.depth[..], &mut frame.c_rg[..], &mut frame.c_b_tau[..]];
        let mut work = Vec::with_capacity(num_cells.len());
        let mut offset = 0;
        for (row, count) in num_cells.into_iter().enumerate() {
            let lists = (TILE * BLOCK * columns).min(ends.len());
            work.push((
                row * TILE,
                offset as u32,
                split_off(&mut ends, lists),
                planes.each_mut().map(|plane| split_off(plane, count)),
            ));
            offset += count;
        }
        work.into_par_iter()
            .for_each(|(row, offset, ends, planes)| write_words(self, row, offset, ends, planes));
        frame
    }
}

wide! {
    /// Writes the segments of the rows of blocks from `first_row` on, list by list, in the packed form of
    /// [`LayeredFrame`]. Also writes the end of each list, counted from `offset`.
    fn write_words(
        reference: &Reference,
        first_row: usize,
        offset: u32,
        ends: &mut [u32],
        planes: [&mut [u32]; 3],
    ) = write_words_any;
}

#[inline(always)]
fn write_words_any(
    reference: &Reference,
    first_row: usize,
    offset: u32,
    ends: &mut [u32],
    [depth, c_rg, c_b_tau]: [&mut [u32]; 3],
) {
    let columns = reference.header.camera.intrinsics.width as usize;
    let mut to = 0;
    let mut spread = NO_CELLS;
    for (y, ends) in ends.chunks_mut(columns * BLOCK).enumerate() {
        // Column, tile and index of each block of the row that was sent.
        let blocks = (0..columns.div_ceil(BLOCK)).filter_map(|x| {
            let (tile, block) = reference.block(x as i32, (first_row + y) as i32)?;
            Some((x, tile, block))
        });
        // First the length of each list, then its end.
        ends.fill(0);
        for (x, tile, block) in blocks.clone() {
            let mut lengths = [0; BLOCK_LISTS];
            for layer in tile.cells_of(block).layers {
                for (i, length) in lengths.iter_mut().enumerate() {
                    *length += (layer.mask >> i & 1) as u32;
                }
            }
            for (ends, lengths) in ends.chunks_mut(columns).zip(lengths.chunks_exact(BLOCK)) {
                for (end, length) in ends[x * BLOCK..].iter_mut().zip(lengths) {
                    *end = *length;
                }
            }
        }
        let first = to;
        for end in &mut *ends {
            to += *end;
            *end = offset + to;
        }
        for (x, tile, block) in blocks {
            // Index of the next segment of each list.
            let mut places = [0; BLOCK_LISTS];
            for (row, places) in places.chunks_exact_mut(BLOCK).enumerate() {
                for (column, place) in places.iter_mut().enumerate() {
                    let list = row * columns + x * BLOCK + column;
                    // There are no lists below the last row of the frame.
                    *place = match list.checked_sub(1) {
                        Some(before) => ends.get(before).map_or(0, |end| end - offset),
                        None => first,
                    };
                }
            }
            let mut walk = tile.cells_of(block).walk(&mut spread);
            while let Some((layer, cells)) = walk.next() {
                let words = words_of(cells);
                for i in lists_of(layer.mask) {
                    let place = places[i] as usize;
                    places[i] += 1;
                    depth[place] = words[0][i];
                    c_rg[place] = words[1][i];
                    c_b_tau[place] = words[2][i];
                }
            }
        }
    }
}

/// Converts cells to segments in the packed form.
#[inline(always)]
fn words_of([front, back, u, y, co, cg]: &CellPlanes) -> [[u32; BLOCK_LISTS]; 3] {
    let scales = scales();
    let (mut alpha, mut tau) = ([0.0; BLOCK_LISTS], [0; BLOCK_LISTS]);
    for (i, code) in u.iter().enumerate() {
        alpha[i] = scales.alpha[usize::from(*code)];
        tau[i] = u32::from(scales.tau_half[usize::from(*code)]);
    }
    let mut words = [[0; BLOCK_LISTS]; 3];
    let [depth, rg, b_tau] = &mut words;
    for i in 0..BLOCK_LISTS {
        let roots = roots([y[i] as i16, co[i] as i16, cg[i] as i16]);
        let [r, g, b] = roots.map(|root| (root * root) as f32 * (ONE_SQUARED * alpha[i]));
        depth[i] = u32::from(front[i]) | u32::from(back[i]) << 16;
        rg[i] = pack_halves(r, g);
        b_tau[i] = pack_halves(b, 0.0) | tau[i] << 16;
    }
    words
}

/// A root is in units of 1/8192.
const ONE_SQUARED: f32 = 1.0 / (1 << 26) as f32;
