//! Trilinear samples of a grid in memory: one at a time, as in the shader, and eight along a ray at once, for vector
//! instructions. Both do the same arithmetic in the same order, so their bits are equal.

use glam::Vec3;

use crate::volume::Voxels;

/// Points sampled at once.
pub(super) const LANES: usize = 8;

/// One number for each of [`LANES`] points.
pub(super) type Lanes = [f32; LANES];

/// Stored numbers by index.
pub trait Texels: Copy + Send + Sync {
    /// The stored number at index `i`.
    fn at(self, i: usize) -> f32;

    /// The stored numbers at the indices `i` and at each next index.
    fn pairs(self, i: [u32; LANES]) -> [Lanes; 2];

    /// The number of texels.
    fn count(self) -> usize;
}

impl Texels for &[u8] {
    fn at(self, i: usize) -> f32 {
        f32::from(self[i])
    }

    #[inline(always)]
    fn pairs(self, i: [u32; LANES]) -> [Lanes; 2] {
        // One load covers both; vector instructions separate them.
        let mut both = [0u16; LANES];
        for m in 0..LANES {
            if let Some(&pair) = self[i[m] as usize..].first_chunk() {
                both[m] = u16::from_le_bytes(pair);
            }
        }
        let (mut a, mut b) = ([0.0; LANES], [0.0; LANES]);
        for m in 0..LANES {
            a[m] = f32::from(both[m] & 0xff);
            b[m] = f32::from(both[m] >> 8);
        }
        [a, b]
    }

    fn count(self) -> usize {
        self.len()
    }
}

impl Texels for &[u16] {
    fn at(self, i: usize) -> f32 {
        f32::from(self[i])
    }

    #[inline(always)]
    fn pairs(self, i: [u32; LANES]) -> [Lanes; 2] {
        let (mut a, mut b) = ([0u16; LANES], [0u16; LANES]);
        for m in 0..LANES {
            let i = i[m] as usize;
            (a[m], b[m]) = (self[i], self[i + 1]);
        }
        let (mut x, mut y) = ([0.0; LANES], [0.0; LANES]);
        for m in 0..LANES {
            (x[m], y[m]) = (f32::from(a[m]), f32::from(b[m]));
        }
        [x, y]
    }

    fn count(self) -> usize {
        self.len()
    }
}

impl Texels for &[f32] {
    fn at(self, i: usize) -> f32 {
        self[i]
    }

    #[inline(always)]
    fn pairs(self, i: [u32; LANES]) -> [Lanes; 2] {
        let (mut a, mut b) = ([0.0; LANES], [0.0; LANES]);
        for m in 0..LANES {
            let i = i[m] as usize;
            (a[m], b[m]) = (self[i], self[i + 1]);
        }
        [a, b]
    }

    fn count(self) -> usize {
        self.len()
    }
}

/// Texels of the type of some voxels.
pub trait TexelsOf<'a>: Texels {
    /// The voxels, which must have this type.
    fn of(voxels: &'a Voxels) -> Self;
}

impl<'a> TexelsOf<'a> for &'a [u8] {
    fn of(voxels: &'a Voxels) -> Self {
        if let Voxels::U8(v) = voxels { v } else { &[] }
    }
}

impl<'a> TexelsOf<'a> for &'a [u16] {
    fn of(voxels: &'a Voxels) -> Self {
        if let Voxels::U16(v) = voxels { v } else { &[] }
    }
}

impl<'a> TexelsOf<'a> for &'a [f32] {
    fn of(voxels: &'a Voxels) -> Self {
        if let Voxels::F32(v) = voxels { v } else { &[] }
    }
}

/// Where texels lie in memory and in space.
#[derive(Clone, Copy, Debug)]
pub(super) struct GridShape {
    strides: [u32; 3],
    /// Index that the first texel would have in a grid from 0 on.
    base: usize,
    /// Coordinates of the first centre.
    least: [f32; 3],
    /// Coordinates of the last centre.
    last: [f32; 3],
    /// Greatest first corner of a cell.
    greatest: [i32; 3],
    /// Whether every cell has two texels along each axis, at 32-bit indices.
    has_lanes: bool,
}

impl GridShape {
    /// The texels in memory of a grid: `dims` of them from `first` on. Beyond them the nearest repeats.
    pub(super) fn held(dims: [u32; 3], first: [u32; 3]) -> Self {
        Self::new(dims, first, std::array::from_fn(|i| first[i] + dims[i] - 1))
    }

    /// The index of the texel at coordinates inside, if it has 32 bits.
    #[inline(always)]
    fn index(&self, [x, y, z]: [u32; 3]) -> u32 {
        let [_, sy, sz] = self.strides;
        z.wrapping_mul(sz).wrapping_add(y.wrapping_mul(sy)).wrapping_add(x).wrapping_sub(self.base as u32)
    }

    /// The part of a grid of `dims` that begins at `first` and has `side` texels along each axis. Beyond the grid its
    /// last texels repeat.
    pub(super) fn part(side: [u32; 3], first: [u32; 3], dims: [u32; 3]) -> Self {
        Self::new(side, first, std::array::from_fn(|i| (first[i] + side[i]).min(dims[i]) - 1))
    }

    /// Texels in memory, `side` of them along each axis, of which those at coordinates `first` to `last` count.
    fn new(side: [u32; 3], first: [u32; 3], last: [u32; 3]) -> Self {
        let count = side.iter().map(|&d| u64::from(d)).product::<u64>();
        let has_lanes = count <= u64::from(u32::MAX) && side.iter().all(|&d| d > 1);
        let strides = [1, side[0], side[0] * side[1]];
        Self {
            strides,
            base: (0..3).map(|i| first[i] as usize * strides[i] as usize).sum(),
            least: first.map(|i| i as f32),
            last: last.map(|i| i as f32),
            greatest: std::array::from_fn(|i| last[i].saturating_sub(1).max(first[i]) as i32),
            has_lanes,
        }
    }
}

/// Texels on a grid, x fastest. Beyond the outermost centres the nearest face continues.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid<T> {
    texels: T,
    shape: GridShape,
}

impl<T: Texels> Grid<T> {
    /// `texels` must be those of the shape.
    pub(super) fn new(texels: T, shape: GridShape) -> Self {
        Self { texels, shape }
    }

    /// The index of the texel at coordinates inside.
    #[inline(always)]
    fn index(&self, at: [u32; 3]) -> usize {
        if self.shape.has_lanes {
            return self.shape.index(at) as usize;
        }
        let place = |i: usize| at[i] as usize * self.shape.strides[i] as usize;
        place(0) + place(1) + place(2) - self.shape.base
    }

    /// The value at a point in voxel space.
    pub(super) fn sample(&self, p: Vec3) -> f32 {
        let (cx, tx) = self.cell(0, p.x);
        let (cy, ty) = self.cell(1, p.y);
        let (cz, tz) = self.cell(2, p.z);
        let corner = [cx, cy, cz];
        let v = |dx: u32, dy: u32, dz: u32| {
            let next = [dx, dy, dz];
            let at = |i: usize| (corner[i] as u32 + next[i]).min(self.shape.last[i] as u32);
            self.texels.at(self.index([at(0), at(1), at(2)]))
        };
        let x00 = mix(v(0, 0, 0), v(1, 0, 0), tx);
        let x10 = mix(v(0, 1, 0), v(1, 1, 0), tx);
        let x01 = mix(v(0, 0, 1), v(1, 0, 1), tx);
        let x11 = mix(v(0, 1, 1), v(1, 1, 1), tx);
        mix(mix(x00, x10, ty), mix(x01, x11, ty), tz)
    }

    /// The value of the voxel around a point in voxel space.
    #[inline(always)]
    pub(super) fn nearest(&self, p: Vec3) -> f32 {
        let at = |i: usize| p[i].max(self.shape.least[i]).min(self.shape.last[i]) as u32;
        self.texels.at(self.index([at(0), at(1), at(2)]))
    }

    /// One bit per step, set where the voxels around both ends have the value 0.
    pub(super) fn steps_without(&self, origin: Vec3, dir: Vec3, s_front: &Lanes, s_back: &Lanes) -> u32 {
        let is_clear = |s: f32| self.nearest(origin + dir * s) == 0.0;
        (0..LANES).map(|m| u32::from(is_clear(s_front[m]) && is_clear(s_back[m])) << m).sum()
    }

    /// The values at the points origin + dir·s in voxel space.
    // These are loops and not `map`, because the compiler does not use wider instructions in closures.
    #[inline(always)]
    pub(super) fn sample_lanes(&self, origin: Vec3, dir: Vec3, s: &Lanes) -> Lanes {
        let mut value = [0.0; LANES];
        if !self.shape.has_lanes {
            for m in 0..LANES {
                value[m] = self.sample(origin + dir * s[m]);
            }
            return value;
        }
        let (cx, tx) = self.cells(0, origin.x, dir.x, s);
        let (cy, ty) = self.cells(1, origin.y, dir.y, s);
        let (cz, tz) = self.cells(2, origin.z, dir.z, s);
        let [_, sy, sz] = self.shape.strides;
        let mut at = [0u32; LANES];
        for m in 0..LANES {
            at[m] = self.shape.index([cx[m], cy[m], cz[m]]);
        }
        let x00 = self.rows(&at, 0, &tx);
        let x10 = self.rows(&at, sy, &tx);
        let x01 = self.rows(&at, sz, &tx);
        let x11 = self.rows(&at, sz.wrapping_add(sy), &tx);
        for m in 0..LANES {
            value[m] = mix(mix(x00[m], x10[m], ty[m]), mix(x01[m], x11[m], ty[m]), tz[m]);
        }
        value
    }

    /// The values interpolated along x between texels at `offset` from `at`.
    #[inline(always)]
    fn rows(&self, at: &[u32; LANES], offset: u32, tx: &Lanes) -> Lanes {
        let mut i = [0u32; LANES];
        for m in 0..LANES {
            i[m] = at[m].wrapping_add(offset);
        }
        let [a, b] = self.texels.pairs(i);
        let mut x = [0.0; LANES];
        for m in 0..LANES {
            x[m] = mix(a[m], b[m], tx[m]);
        }
        x
    }

    /// Corners of the points origin + dir·s along one axis, and their positions within the cells.
    #[inline(always)]
    fn cells(&self, axis: usize, origin: f32, dir: f32, s: &Lanes) -> ([u32; LANES], Lanes) {
        let (mut c, mut t) = ([0u32; LANES], [0.0; LANES]);
        for m in 0..LANES {
            let (corner, inside) = self.cell(axis, origin + dir * s[m]);
            (c[m], t[m]) = (corner as u32, inside);
        }
        (c, t)
    }

    /// The cell along one axis that holds the coordinate `p` of voxel space, between voxel centres, and the position
    /// within.
    #[inline(always)]
    fn cell(&self, axis: usize, p: f32) -> (i32, f32) {
        // The clamp continues the nearest face, and bounds the points of a very distant eye.
        let u = p - 0.5;
        let (least, last) = (self.shape.least[axis], self.shape.last[axis]);
        let u = if u > least { u } else { least };
        let u = if u < last { u } else { last };
        let corner = (u as i32).min(self.shape.greatest[axis]);
        (corner, u - corner as f32)
    }
}

/// a + (b − a)·t.
#[inline(always)]
pub(super) fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lanes_are_the_samples_one_by_one() {
        for dims in [[7u32, 5, 6], [2, 2, 2], [1, 4, 3], [1, 1, 1]] {
            let n = dims.iter().product::<u32>();
            let bytes: Vec<u8> = (0..n).map(|i| (i * 197 % 251) as u8).collect();
            let words: Vec<u16> = bytes.iter().map(|&b| u16::from(b) * 257).collect();
            let floats: Vec<f32> = bytes.iter().map(|&b| f32::from(b) - 100.5).collect();
            agree(&bytes[..], dims);
            agree(&words[..], dims);
            agree(&floats[..], dims);
        }
    }

    /// Compares bits along rays through and beside the grid, and from an eye so far away that nothing is left of it.
    fn agree<T: Texels>(texels: T, dims: [u32; 3]) {
        let grid = Grid::new(texels, GridShape::held(dims, [0; 3]));
        let mut seen = std::collections::BTreeSet::new();
        for (origin, dir, first) in [
            (Vec3::new(-1.0, 0.3, 7.1), Vec3::new(0.61, 0.27, -0.43), 0.0),
            (Vec3::new(3.0, 2.5, -2.0), Vec3::new(1e-9, -1e-9, 1.0), 0.5),
            (Vec3::new(-3e37, 1e20, 5.0), Vec3::new(0.9, -0.4, 0.1), 3e37),
        ] {
            let s: Lanes = std::array::from_fn(|m| first + m as f32 * 1.3);
            let lanes = grid.sample_lanes(origin, dir, &s);
            for m in 0..LANES {
                let sample = grid.sample(origin + dir * s[m]);
                assert_eq!(sample.to_bits(), lanes[m].to_bits(), "{dims:?}, lane {m}: {sample} {}", lanes[m]);
                seen.insert(sample.to_bits());
            }
        }
        // Negative control: the samples differ from each other, unless there is one voxel.
        assert!(seen.len() > 3 || texels.count() == 1);
    }

    #[test]
    fn a_part_has_the_bits_of_the_whole_at_its_coordinates() {
        // With one texel along an axis, indices are found without lanes.
        for (dims, first, side) in [([9u32, 8, 7], [3, 2, 1], [5, 4, 6]), ([9, 1, 7], [3, 0, 2], [6, 1, 4])] {
            let at = |[x, y, z]: [u32; 3]| ((z * dims[1] + y) * dims[0] + x) * 37 % 251;
            let texels = |first: [u32; 3], [nx, ny, nz]: [u32; 3]| -> Vec<u8> {
                let all = (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])));
                all.map(|p| at([0, 1, 2].map(|i| first[i] + p[i])) as u8).collect()
            };
            let (all, some) = (texels([0; 3], dims), texels(first, side));
            let whole = Grid::new(&all[..], GridShape::held(dims, [0; 3]));
            let part = Grid::new(&some[..], GridShape::held(side, first));
            let low = Vec3::from_array(first.map(|i| i as f32 + 0.5));
            let size = Vec3::from_array(side.map(|n| n as f32 - 1.0));
            let s: Lanes = std::array::from_fn(|m| (m as f32 + 0.3) / LANES as f32);
            let pairs = whole.sample_lanes(low, size, &s).into_iter().zip(part.sample_lanes(low, size, &s));
            assert!(pairs.into_iter().all(|(a, b)| a.to_bits() == b.to_bits()), "{dims:?}");
            assert!(s.iter().all(|s| whole.nearest(low + size * *s) == part.nearest(low + size * *s)));
            // Negative control: before the part, its face goes on.
            let before = low - 2.0 * Vec3::X;
            assert_ne!(whole.sample(before), part.sample(before));
            assert_eq!(part.sample(before), whole.sample(low));
        }
    }
}
