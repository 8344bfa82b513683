//! Intra prediction: the coefficients of a plane from the edges of the decoded planes to its left and above. Waves along an
//! edge between two blocks continue behind it and fade, short ones first. A slope along an edge gives the mean behind it.

use super::model::BLOCK;
use super::transform::{BlockPlane, Line8, along_edges};

/// Cosine transforms of the last column and the last row of a plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Edges {
    right: Line8,
    bottom: Line8,
}

impl Edges {
    /// Those of a plane.
    pub(super) fn of(values: &BlockPlane) -> Self {
        let [right, bottom] = along_edges(values);
        Self { right, bottom }
    }

    /// Those of a plane that is the same everywhere.
    pub(super) fn flat(value: f32) -> Self {
        let line = constant_wave(value * ROOT_OF_BLOCK);
        Self { right: line, bottom: line }
    }
}

/// The edges of the layers of two rows of blocks: the one that is coded, and the one above it.
#[derive(Clone, Debug, Default)]
pub(super) struct EdgeRows {
    above: Row,
    own: Row,
}

#[derive(Clone, Debug, Default)]
struct Row {
    /// Number of its first layer in the band.
    first: usize,
    layers: Vec<[Edges; 4]>,
}

impl EdgeRows {
    /// Begins a row whose first layer has number `first`.
    pub(super) fn begin_row(&mut self, first: usize) {
        std::mem::swap(&mut self.above, &mut self.own);
        self.own.first = first;
        self.own.layers.clear();
    }

    /// Appends the edges of a layer's planes.
    pub(super) fn push(&mut self, edges: [Edges; 4]) {
        self.own.layers.push(edges);
    }

    /// Those of layer number `layer` of the band, if it lies in either row.
    pub(super) fn get(&self, layer: usize) -> Option<&[Edges; 4]> {
        let row = if layer < self.own.first { &self.above } else { &self.own };
        row.layers.get(layer.checked_sub(row.first)?)
    }
}

/// Coefficients of the plane that lies to the right of one, below another, or both; `None` for neither. All but the constant one
/// are left out if none of them is a tenth of the step in which the plane is coded.
pub(super) fn spread(left: Option<&Edges>, above: Option<&Edges>, step: f32) -> Option<BlockPlane> {
    let (left, above) = match (left, above) {
        (Some(left), Some(above)) => (left.right, above.bottom),
        // Nothing is known of the other edge but how bright it may be.
        (Some(left), None) => (left.right, constant_wave(left.right[0])),
        (None, Some(above)) => (constant_wave(above.bottom[0]), above.bottom),
        (None, None) => return None,
    };
    Some(from_lines(&left, &above, FAINT * step))
}

wide! {
    fn from_lines(left: &Line8, above: &Line8, least: f32) -> BlockPlane = from_lines_any;
}

#[inline(always)]
fn from_lines_any(left: &Line8, above: &Line8, least: f32) -> BlockPlane {
    let mut coefficients = [0.0; BLOCK * BLOCK];
    for (v, row) in coefficients.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        for (h, out) in row.iter_mut().enumerate() {
            *out = BELOW[v][h] * above[h] + BESIDE[v][h] * left[v];
        }
    }
    let tilt = TILT * (left[0] - above[0]);
    coefficients[1] += tilt;
    coefficients[BLOCK] -= tilt;
    let is_flat = coefficients[1..].iter().fold(true, |is_flat, c| is_flat & (c.abs() < least));
    let constant =
        ROOT_OF_TWO * (left[0] + above[0]) - SLOPE * (left[1] + above[1]) - BEND * (left[3] + above[3]);
    if is_flat {
        coefficients = [0.0; BLOCK * BLOCK];
    }
    coefficients[0] = constant;
    coefficients
}

fn constant_wave(size: f32) -> Line8 {
    let mut line = [0.0; BLOCK];
    line[0] = size;
    line
}

/// Waves below so many steps are not worth the time to add them.
const FAINT: f32 = 0.1;
const ROOT_OF_TWO: f32 = std::f32::consts::SQRT_2;
const ROOT_OF_BLOCK: f32 = 2.828_427;
/// How much less the mean behind two edges is for a wave that falls once, or three halves, along either.
const SLOPE: f32 = 0.8;
const BEND: f32 = 0.45;
/// How much a difference of both edges' means turns into a slope from one to the other.
const TILT: f32 = 0.21;
/// How much of each wave along an edge, from the second, is found behind it in each wave away from it: seven tenths of what a
/// regression over planes of six scenes at middling steps gives, as planes of layers go on less smoothly. The constant wave is
/// told apart.
const FADING: [[f32; BLOCK]; BLOCK] = [
    [0.0; BLOCK],
    [0.903, 0.259, 0.063, 0.035, 0.014, 0.007, 0.0, 0.0],
    [0.574, 0.35, 0.126, 0.063, 0.035, 0.014, 0.007, 0.0],
    [0.378, 0.28, 0.147, 0.084, 0.049, 0.028, 0.014, 0.007],
    [0.273, 0.238, 0.119, 0.077, 0.042, 0.028, 0.021, 0.007],
    [0.189, 0.182, 0.105, 0.063, 0.042, 0.028, 0.021, 0.007],
    [0.147, 0.147, 0.084, 0.049, 0.035, 0.021, 0.014, 0.014],
    [0.147, 0.126, 0.07, 0.049, 0.042, 0.014, 0.014, 0.007],
];
/// [`FADING`] by the wave downwards and that along a row: behind an edge above, and beside a left one.
const BELOW: [[f32; BLOCK]; BLOCK] = {
    let mut table = [[0.0; BLOCK]; BLOCK];
    let mut i = 0;
    while i < BLOCK * BLOCK {
        table[i / BLOCK][i % BLOCK] = FADING[i % BLOCK][i / BLOCK];
        i += 1;
    }
    table
};
const BESIDE: [[f32; BLOCK]; BLOCK] = FADING;

#[cfg(test)]
mod tests {
    use super::super::model::BLOCK_LISTS;
    use super::super::transform::inverse;
    use super::*;

    /// A plane out of a picture, in blocks of which (0, 0) is the first.
    fn plane([x, y]: [usize; 2], picture: impl Fn(f32, f32) -> f32) -> BlockPlane {
        std::array::from_fn(|i| picture((x * BLOCK + i % BLOCK) as f32, (y * BLOCK + i / BLOCK) as f32))
    }

    /// Mean square that the plane at (1, 1) is off, expected from edges and from means.
    fn errors(picture: impl Fn(f32, f32) -> f32 + Copy) -> [f32; 2] {
        let [left, above, wanted] = [[0, 1], [1, 0], [1, 1]].map(|at| plane(at, picture));
        let off = |found: &BlockPlane| -> f32 {
            found.iter().zip(&wanted).map(|(a, b)| (a - b).powi(2)).sum::<f32>() / BLOCK_LISTS as f32
        };
        let mean = (left.iter().sum::<f32>() + above.iter().sum::<f32>()) / (2 * BLOCK_LISTS) as f32;
        let waves = spread(Some(&Edges::of(&left)), Some(&Edges::of(&above)), 0.0).unwrap();
        [off(&inverse(&waves)), off(&[mean; BLOCK_LISTS])]
    }

    #[test]
    fn what_goes_on_is_expected_and_what_does_not_costs_little() {
        let [slope, by_mean] = errors(|x, y| 0.3 + 0.02 * x + 0.01 * y);
        assert!(slope < 0.25 * by_mean, "{slope} {by_mean}");
        let [wave, by_mean] = errors(|x, y| (0.3 * x).sin() + (0.2 * y).cos());
        assert!(wave < 0.6 * by_mean, "{wave} {by_mean}");
        // Nothing is known of noise.
        let noise = |x: f32, y: f32| ((x * 12.9 + y * 78.2).sin() * 43_758.5).fract();
        let [edges, by_mean] = errors(noise);
        assert!(edges < 1.9 * by_mean, "{edges} {by_mean}");
    }

    #[test]
    fn constants_stay_and_sides_are_alike() {
        let [a, b] = [Edges::flat(0.4), Edges::flat(0.8)];
        let mean = |left, above| spread(left, above, 0.0).unwrap()[0] / BLOCK as f32;
        for (left, above, wanted) in [(Some(&a), None, 0.4), (None, Some(&b), 0.8), (Some(&a), Some(&b), 0.6)]
        {
            assert!((mean(left, above) - wanted).abs() < 1e-5);
        }
        assert_eq!(spread(None, None, 0.0), None);
        let found = Edges::of(&[0.4; BLOCK_LISTS]);
        for (found, wanted) in [(found.right, a.right), (found.bottom, a.bottom)] {
            assert!(found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-5));
        }
        let rough: BlockPlane = std::array::from_fn(|i| ((i * 37) % 11) as f32 * 0.1);
        let Edges { right, bottom } = Edges::of(&rough);
        let one = spread(Some(&Edges { right, bottom }), Some(&a), 0.0).unwrap();
        let other = spread(Some(&a), Some(&Edges { right: bottom, bottom: right }), 0.0).unwrap();
        let transposed: BlockPlane = std::array::from_fn(|i| other[i % BLOCK * BLOCK + i / BLOCK]);
        assert!(one.iter().zip(&transposed).all(|(a, b)| (a - b).abs() < 1e-5));
        // Faint waves are none, but the constant one stays.
        let faint = spread(Some(&Edges { right, bottom }), Some(&a), 1000.0).unwrap();
        assert!(
            faint[0] == one[0] && faint[1..].iter().all(|c| *c == 0.0) && one[1..].iter().any(|c| *c != 0.0)
        );
    }

    #[test]
    fn layers_of_two_rows_are_found_by_their_numbers() {
        let edges = |layer: usize| [Edges::flat(layer as f32); 4];
        let mut rows = EdgeRows::default();
        let mut next = 0;
        for (row, length) in [3, 0, 2, 4].into_iter().enumerate() {
            let above = [0, 0, 3, 3][row];
            rows.begin_row(next);
            for _ in 0..length {
                assert_eq!(rows.get(next), None);
                rows.push(edges(next));
                next += 1;
            }
            for layer in above..next {
                assert_eq!(rows.get(layer), Some(&edges(layer)), "row {row}");
            }
            assert!(above == 0 || rows.get(above - 1).is_none());
        }
    }

    #[test]
    fn planes_that_are_only_expected_do_not_grow() {
        const SIDE: usize = 40;
        let rough = Edges::of(&std::array::from_fn(|i| if (i * 7 + i / 8) % 5 < 2 { 1.0 } else { -1.0 }));
        let mut edges = vec![rough; SIDE * SIDE];
        let mut most: f32 = 0.0;
        for i in 0..SIDE * SIDE {
            if i < SIDE || i % SIDE == 0 {
                continue;
            }
            let values = inverse(&spread(Some(&edges[i - 1]), Some(&edges[i - SIDE]), 0.0).unwrap());
            edges[i] = Edges::of(&values);
            most = values.iter().fold(most, |most, v| most.max(v.abs()));
        }
        assert!(most < 2.0, "{most}");
    }
}
