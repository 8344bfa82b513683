//! The levels of a pyramid: where each is halved, and where its voxels lie.

/// A level of a pyramid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PyramidLevel {
    /// Voxels along x, y and z.
    pub(crate) dims: [u64; 3],
    /// Voxels of the level above that make one, along x, y and z: 1 or 2.
    pub(crate) factors: [u64; 3],
    /// Distances between centres along x, y and z.
    pub(crate) spacing: [f64; 3],
    /// From the centre of the finest level's first voxel to that of this one, along x, y and z.
    pub(crate) shift: [f64; 3],
}

/// The levels of a volume, the finest first. An axis is halved where its voxels are not much longer than the shortest
/// ones, so flat voxels become nearly cubes first. The last level has at most [`COARSEST`] voxels a side.
pub(crate) fn pyramid_levels(dims: [u64; 3], spacing: [f64; 3]) -> Vec<PyramidLevel> {
    let mut level = PyramidLevel { dims, factors: [1; 3], spacing, shift: [0.0; 3] };
    let mut levels = vec![level];
    while level.dims.iter().any(|n| *n > COARSEST) {
        let long = |k: &usize| level.dims[*k] > 1;
        let finest = (0..3).filter(long).map(|k| level.spacing[k]).fold(f64::INFINITY, f64::min);
        let is_fine = |k: usize| level.dims[k] > 1 && level.spacing[k] <= finest * MOST_RATIO;
        let factors = [0, 1, 2].map(|k| if is_fine(k) { 2 } else { 1 });
        level = level.reduced(factors);
        levels.push(level);
    }
    levels
}

impl PyramidLevel {
    /// The level of which a voxel is the mean of so many. The last voxel of an odd side is that of one.
    fn reduced(self, factors: [u64; 3]) -> Self {
        let step = |k: usize| self.spacing[k] * (factors[k] as f64 - 1.0) / 2.0;
        Self {
            dims: [0, 1, 2].map(|k| self.dims[k].div_ceil(factors[k])),
            factors,
            spacing: [0, 1, 2].map(|k| self.spacing[k] * factors[k] as f64),
            shift: [0, 1, 2].map(|k| self.shift[k] + step(k)),
        }
    }

    /// Its number of voxels.
    pub(crate) fn num_voxels(&self) -> u64 {
        self.dims.iter().fold(1, |n, side| n.saturating_mul(*side))
    }
}

/// Most voxels along a side of the coarsest level.
const COARSEST: u64 = 128;
/// An axis is halved if its voxels are at most so many times as long as the shortest ones: the square root of two.
const MOST_RATIO: f64 = 1.415;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flat_voxels_become_cubes_before_all_axes_are_halved() {
        let found = pyramid_levels([512, 500, 100], [0.5, 0.5, 2.0]);
        let factors: Vec<_> = found.iter().map(|l| l.factors).collect();
        assert_eq!(factors, [[1; 3], [2, 2, 1], [2, 2, 1]]);
        assert_eq!(found[2].dims, [128, 125, 100]);
        assert_eq!((found[2].spacing, found[2].shift), ([2.0; 3], [0.75, 0.75, 0.0]));
        // The control: cubes are halved along all axes.
        let cubes = pyramid_levels([512, 500, 100], [1.0; 3]);
        assert_eq!(cubes[1].factors, [2; 3]);
        assert_eq!(cubes[2].dims, [128, 125, 25]);
    }

    #[test]
    fn every_pyramid_ends_with_few_voxels_that_are_nearly_cubes() {
        for dims in [[1, 1, 1], [129, 1, 1], [131_072; 3], [5000, 3, 1], [7, 9000, 1025]] {
            for spacing in [[1.0; 3], [1.0, 1.0, 30.0], [1e-6, 1.0, 1e6], [2.0, 3.0, 5.0]] {
                let found = pyramid_levels(dims, spacing);
                let last = found.last().unwrap();
                assert!(last.dims.iter().all(|n| (1..=128).contains(n)) && found.len() < 64, "{dims:?}");
                assert!(found.len() == 1 || found[found.len() - 2].dims.iter().any(|n| *n > 128));
                for (above, level) in found.iter().zip(&found[1..]) {
                    assert_ne!(level.factors, [1; 3]);
                    for k in 0..3 {
                        assert_eq!(level.dims[k], above.dims[k].div_ceil(level.factors[k]));
                    }
                }
            }
        }
        let found = pyramid_levels([4096; 3], [1.0, 1.3, 3.0]);
        let [x, y, z] = found.last().unwrap().spacing;
        assert!([x / y, y / z, x / z].iter().all(|r| (0.5..2.0).contains(r)), "{x} {y} {z}");
    }
}
