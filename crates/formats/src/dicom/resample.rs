//! Evenly spaced slices at right angles, from slices that are uneven, missing or tilted.

use isinglass_core::volume::Volume;

use super::gaps::Gaps;

/// How stored slices become shown ones.
#[derive(Clone, Debug)]
pub(super) struct Resampling {
    /// For each shown slice: the stored ones below and above, and how much the one above counts. Nothing lies in a
    /// gap between blocks.
    slices: Vec<Option<(usize, usize, f32)>>,
    /// Columns and rows by which each stored slice is shifted in the shown volume.
    shifts: Vec<[f64; 2]>,
    /// Columns and rows of stored and of shown slices.
    stored: [usize; 2],
    pub(super) shown: [usize; 2],
    /// Distance of shown slices in millimetres.
    pub(super) distance: f64,
    /// From the first pixel of the first stored slice to that of the first shown one, in columns and rows.
    pub(super) corner: [f64; 2],
}

impl Resampling {
    /// `places` are positions along the normal, with their `gaps`. `offsets` say how far each slice is shifted
    /// against the first one, in columns and rows. Returns `None` if the result has too many voxels along a side.
    pub(super) fn of(places: &[f64], gaps: &Gaps, offsets: &[[f64; 2]], stored: [usize; 2]) -> Option<Self> {
        let max = f64::from(Volume::MAX_SIDE);
        let (count, distance) = gaps.even_slices();
        let range = |axis: usize| {
            let all = offsets.iter().map(|o| o[axis]);
            (all.clone().fold(f64::INFINITY, f64::min), all.fold(f64::NEG_INFINITY, f64::max))
        };
        let (low, high) = ([range(0).0, range(1).0], [range(0).1, range(1).1]);
        let sides = [0, 1].map(|i| stored[i] as f64 + (high[i] - low[i]).ceil());
        if !(count <= max && sides[0] <= max && sides[1] <= max) {
            return None;
        }
        let slice = |k: usize| {
            let place = places[0] + k as f64 * distance;
            let above = places.partition_point(|p| *p < place - SAME_PLACE * distance).min(places.len() - 1);
            if above == 0 || (places[above] - place).abs() <= SAME_PLACE * distance {
                return Some((above, above, 0.0));
            }
            let (lower, upper) = (places[above - 1], places[above]);
            let part = (place - lower) / (upper - lower);
            if gaps.part_blocks(upper - lower) {
                // Half a distance around each block belongs to it.
                let nearest = if part < 0.5 { above - 1 } else { above };
                let is_near = (places[nearest] - place).abs() <= distance / 2.0;
                return is_near.then_some((nearest, nearest, 0.0));
            }
            Some((above - 1, above, part as f32))
        };
        Some(Self {
            slices: (0..count as usize).map(slice).collect(),
            shifts: offsets.iter().map(|o| [o[0] - low[0], o[1] - low[1]]).collect(),
            stored,
            shown: sides.map(|n| n as usize),
            distance,
            corner: low,
        })
    }

    pub(super) fn num_slices(&self) -> usize {
        self.slices.len()
    }

    /// The stored slice beside a shown one: the one above, or the last one below where there is nothing.
    pub(super) fn beside(&self, k: usize) -> usize {
        self.slices[..=k].iter().rev().flatten().next().map_or(0, |(_, above, _)| *above)
    }

    /// The pixels of a shown slice. `stored` returns those of a stored one, which are NaN where there is nothing.
    pub(super) fn slice<E>(
        &self,
        k: usize,
        mut stored: impl FnMut(usize) -> Result<Vec<f32>, E>,
    ) -> Result<Vec<f32>, E> {
        let Some((below, above, part)) = self.slices[k] else {
            return Ok(vec![f32::NAN; self.shown[0] * self.shown[1]]);
        };
        let mut pixels = self.shifted(stored(below)?, below);
        if above != below {
            let others = self.shifted(stored(above)?, above);
            for (a, b) in pixels.iter_mut().zip(others) {
                *a = if a.is_nan() {
                    b
                } else if b.is_nan() {
                    *a
                } else {
                    *a + (b - *a) * part
                };
            }
        }
        Ok(pixels)
    }

    /// The pixels of stored slice `i` at their place in a shown slice.
    fn shifted(&self, pixels: Vec<f32>, i: usize) -> Vec<f32> {
        let [width, height] = self.stored;
        if self.shown == self.stored && self.shifts[i] == [0.0; 2] {
            return pixels;
        }
        // For each column or row: the stored ones on both sides, and how much the second counts.
        let taps = |axis: usize| -> Vec<Option<(usize, usize, f32)>> {
            let most = self.stored[axis] as f64 - 1.0;
            let tap = |at: usize| {
                let from = at as f64 - self.shifts[i][axis];
                // Each pixel reaches half of the way to the next.
                (-0.5..=most + 0.5).contains(&from).then(|| {
                    let from = from.clamp(0.0, most);
                    let first = from as usize;
                    (first, (first + 1).min(most as usize), (from - from.floor()) as f32)
                })
            };
            (0..self.shown[axis]).map(tap).collect()
        };
        let (columns, rows) = (taps(0), taps(1));
        debug_assert_eq!(pixels.len(), width * height);
        let mix = |a: f32, b: f32, part: f32| match (a.is_nan(), b.is_nan()) {
            (true, _) => b,
            (_, true) => a,
            _ => a + (b - a) * part,
        };
        rows.iter()
            .flat_map(|row| columns.iter().map(move |column| (row, column)))
            .map(|(row, column)| match (row, column) {
                (Some((y0, y1, v)), Some((x0, x1, u))) => {
                    let along = |y: usize| mix(pixels[y * width + x0], pixels[y * width + x1], *u);
                    mix(along(*y0), along(*y1), *v)
                }
                _ => f32::NAN,
            })
            .collect()
    }
}

/// A place this near to a stored slice is that slice, in distances of slices.
const SAME_PLACE: f64 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;

    fn of(places: &[f64], offsets: &[[f64; 2]]) -> Resampling {
        Resampling::of(places, &Gaps::of(places), offsets, [3, 1]).unwrap()
    }

    fn shown(resampling: &Resampling, stored: &[[f32; 3]]) -> Vec<Vec<f32>> {
        let slice = |k: usize| resampling.slice(k, |i| Ok::<_, ()>(stored[i].to_vec())).unwrap();
        (0..resampling.num_slices()).map(slice).collect()
    }

    #[test]
    fn missing_slices_are_blended_and_blocks_stay_apart() {
        let even = [[0.0; 2]; 4];
        let stored = [[0.0; 3], [10.0; 3], [30.0; 3], [40.0; 3]];
        let missing = of(&[0.0, 3.0, 9.0, 12.0], &even);
        assert_eq!((missing.distance, missing.corner), (3.0, [0.0; 2]));
        let first = |slices: Vec<Vec<f32>>| slices.iter().map(|s| s[0]).collect::<Vec<_>>();
        assert_eq!(first(shown(&missing, &stored)), [0.0, 10.0, 20.0, 30.0, 40.0]);
        // Nothing is between blocks.
        let blocks = first(shown(&of(&[0.0, 1.0, 8.0, 9.0], &even), &stored));
        assert_eq!((blocks[1], blocks[8], blocks.len()), (10.0, 30.0, 10));
        assert!(blocks[2..8].iter().all(|x| x.is_nan()), "{blocks:?}");
    }

    #[test]
    fn tilted_slices_are_shifted_and_none_is_cut() {
        let tilted = of(&[0.0, 2.0, 4.0], &[[0.0; 2], [0.5, 0.0], [1.0, 0.0]]);
        assert_eq!((tilted.shown, tilted.corner), ([4, 1], [0.0; 2]));
        let slices = shown(&tilted, &[[1.0, 2.0, 3.0]; 3]);
        assert_eq!(slices[0][..3], [1.0, 2.0, 3.0]);
        assert_eq!(slices[1], [1.0, 1.5, 2.5, 3.0]);
        assert_eq!(slices[2][1..], [1.0, 2.0, 3.0]);
        assert!(slices[0][3].is_nan() && slices[2][0].is_nan());
        // A shift to the other side moves the corner.
        assert_eq!(of(&[0.0, 2.0], &[[0.0; 2], [-1.0, 0.0]]).corner, [-1.0, 0.0]);
    }

    #[test]
    fn what_would_be_too_large_is_not_made() {
        let places = [0.0, 1.0, 2.0, 9000.0];
        assert!(Resampling::of(&places, &Gaps::of(&places), &[[0.0; 2]; 4], [3, 1]).is_none());
        let places = [0.0, 1.0];
        assert!(Resampling::of(&places, &Gaps::of(&places), &[[0.0; 2], [9000.0, 0.0]], [3, 1]).is_none());
    }
}
