//! A preview of a novel view for when the full cast does not make the refresh: a number of samples a ray instead of all
//! crossings (Gupta 2022, section 5). Twin of `shaders/subsample.wgsl`.
//!
//! The ray is walked twice by tiles of the grid of counts ([`super::empty_space`]). The first walk sums the lengths of
//! the stretches that are not empty, each weighted by the mean count of its cells. The second gives each stretch its
//! share of the samples, at the middles of parts of equal world length; a sample only looks up the segment that holds
//! it and stands for the length of its part: opacity 1 − e^(−σ·Δs). A stretch whose share is below one sample hands
//! its length on to the next, and the last takes what is left, so all lengths are seen: a homogeneous medium has its
//! exact opacity with any number of samples.

use glam::Vec4;

use super::empty_space::{DEPTH_CELLS, TILE, cell_of_depth};
use super::march::TRANSMITTANCE_MIN;
use super::raycast::{AXIS_BIAS, Columns, Line, Raycaster, Reconstruction, greater, lesser, opacity};
use crate::layer::{Over, Projected};
use crate::mode::Compositing;

/// The part of a line inside of one column of tiles.
struct TileStretch {
    /// World distances from the start of the line.
    ends: [f32; 2],
    /// Columns of lists.
    columns: [i32; 2],
    /// Mean count of the cells that it runs through.
    count: f32,
}

/// Walks a line by columns of tiles.
struct TileWalk<'a> {
    caster: &'a Raycaster,
    line: &'a Line,
    along: usize,
    columns: Columns,
    column: i32,
    t: f32,
    is_done: bool,
}

impl<'a> TileWalk<'a> {
    fn new(caster: &'a Raycaster, line: &'a Line, along: usize) -> Self {
        let columns = Columns::new(line.p0[along], line.d[along]);
        let column = (line.p0[along] as i32).clamp(0, caster.size[along] - 1);
        Self { caster, line, along, columns, column, t: 0.0, is_done: false }
    }
}

impl Iterator for TileWalk<'_> {
    type Item = TileStretch;

    fn next(&mut self) -> Option<TileStretch> {
        let size = self.caster.size;
        if self.is_done {
            return None;
        }
        let num = self.columns.num_in_tile(self.column, size[self.along]);
        let t_out = lesser(self.columns.t(self.column, num - 1), 1.0);
        let [enter, leave] = [self.t, t_out].map(|t| self.caster.at(self.line, t));
        let across = 1 - self.along;
        let rows = [self.t, t_out].map(|t| self.line.p0[across] + self.line.d[across] * t - 0.5);
        let last = self.column + self.columns.step * (num - 1);
        let stretch = TileStretch {
            ends: [enter.1, leave.1],
            columns: [self.column.min(last), self.column.max(last)],
            count: self.caster.mean_count(self.column, rows, [enter.0, leave.0], self.along),
        };
        self.t = t_out;
        self.column = last + self.columns.step;
        self.is_done = t_out >= 1.0 || self.column < 0 || self.column >= size[self.along];
        Some(stretch)
    }
}

impl Raycaster {
    /// Premultiplied colour and opacity along a line by `num_samples` samples.
    pub(super) fn sample(&self, line: &Line, reconstruction: Reconstruction, num_samples: u32) -> Over {
        let (mut color, mut transmittance) = (Vec4::ZERO, 1.0);
        self.for_samples(line, reconstruction, num_samples, |sample| {
            color += sample * transmittance;
            transmittance *= 1.0 - sample.w;
            transmittance >= TRANSMITTANCE_MIN
        });
        Over { c: color.truncate(), transmittance }
    }

    /// What a projection collects along a line by `num_samples` samples.
    pub(super) fn sample_projected(
        &self,
        line: &Line,
        reconstruction: Reconstruction,
        num_samples: u32,
    ) -> Projected {
        let mut collected = Projected::default();
        self.for_samples(line, reconstruction, num_samples, |sample| {
            collected.add(self.compositing, sample.truncate(), sample.w);
            true
        });
        collected
    }

    /// Calls `take` with each sample, until it says no and the stretch ends.
    fn for_samples(
        &self,
        line: &Line,
        reconstruction: Reconstruction,
        num_samples: u32,
        mut take: impl FnMut(Vec4) -> bool,
    ) {
        let along = usize::from(line.d[0].abs() + AXIS_BIAS < line.d[1].abs());
        let mut total = 0.0;
        for stretch in TileWalk::new(self, line, along) {
            total += stretch.count * (stretch.ends[1] - stretch.ends[0]);
        }
        if total <= 0.0 {
            return;
        }
        let samples_per_weight = num_samples as f32 / total;
        let (mut weight, mut num_before, mut length_before) = (0.0, 0.0, 0.0);
        for stretch in TileWalk::new(self, line, along) {
            if stretch.count <= 0.0 {
                continue;
            }
            let length = stretch.ends[1] - stretch.ends[0];
            weight += stretch.count * length;
            // The sum of all weights is the same as above, so the last stretch gets to the whole number.
            let num = (weight * samples_per_weight + ROUNDING).floor();
            let num_here = num - num_before;
            if num_here < 1.0 {
                length_before += length;
                continue;
            }
            let part = length / num_here;
            // What was handed on is spread evenly.
            let stands_for = (length_before + length) / num_here;
            let mut goes_on = true;
            for i in 0..num_here as u32 {
                let at = stretch.ends[0] + part * (i as f32 + 0.5);
                goes_on = take(self.sample_at(line, at, stands_for, &stretch, along, reconstruction));
            }
            if !goes_on {
                break;
            }
            (num_before, length_before) = (num, 0.0);
        }
    }

    /// Colour and opacity of the matter at a distance along the line, for a length of it.
    fn sample_at(
        &self,
        line: &Line,
        distance: f32,
        length: f32,
        stretch: &TileStretch,
        along: usize,
        reconstruction: Reconstruction,
    ) -> Vec4 {
        let t = distance * line.w1 / (line.s_w0 - distance * line.w0_minus_w1);
        let (depth, _) = self.at(line, t);
        let position = [0, 1].map(|axis| line.p0[axis] + line.d[axis] * t);
        let column = (position[along] as i32).clamp(stretch.columns[0], stretch.columns[1]);
        match reconstruction {
            Reconstruction::Nearest => self.look_up(column, position[1 - along] as i32, depth, length, along),
            Reconstruction::Mixed => {
                let at_across = position[1 - along] - 0.5;
                let row = at_across.floor();
                let nearness = at_across - row;
                self.look_up(column, row as i32, depth, length, along) * (1.0 - nearness)
                    + self.look_up(column, row as i32 + 1, depth, length, along) * nearness
            }
        }
    }

    /// Colour and opacity of a length of the segment of a list that holds a depth; in a projection, colour and key.
    fn look_up(&self, column: i32, row: i32, depth: f32, length: f32, along: usize) -> Vec4 {
        let media = self.list(column, row, along);
        let first = media.partition_point(|medium| medium.back() <= depth);
        match media.get(first).filter(|medium| medium.front() <= depth) {
            None => Vec4::ZERO,
            Some(medium) => match self.compositing {
                Compositing::Over => medium.e() * opacity(medium.sigma * length),
                Compositing::Greatest => medium.e().truncate().extend(medium.sigma),
                Compositing::Mean => medium.e() * (medium.sigma * length),
            },
        }
    }

    /// Mean count of the cells that a stretch of a line runs through, inside of one column of tiles.
    fn mean_count(&self, column: i32, rows: [f32; 2], depths: [f32; 2], along: usize) -> f32 {
        let [first, last] = self.tiles_across(rows, self.size[1 - along]);
        let (start, stride) = self.tiles_along(column, along);
        let first_cell = cell_of_depth(lesser(depths[0], depths[1]));
        let last_cell = cell_of_depth(greater(depths[0], depths[1]));
        let mut count = 0;
        for tile in first..=last {
            let tile = (start + tile * stride) as u32 * DEPTH_CELLS;
            for cell in first_cell..=last_cell {
                count += self.empty_space().counts[(tile + cell) as usize];
            }
        }
        let num_cells = (last - first + 1) as u32 * (last_cell - first_cell + 1) * TILE * TILE;
        count as f32 / num_cells as f32
    }
}

/// So much may be missing from a whole number of samples by rounding.
const ROUNDING: f32 = 1e-2;
