use std::sync::Arc;

use super::super::model::TilePlace;
use super::super::scales::QUARTERS_PER_U;
use super::super::tables::Counts;
use super::super::tile::{FrameTile, OpenBlock};
use super::*;
use crate::camera::{Camera, Intrinsics, Pose};
use crate::layer::{FrameHeader, unpack_halves};
use crate::simd::tests::with_each;
use crate::space::Aabb;

/// A frame of 3×3 blocks with layers whose lists differ in what they have, one block without any.
fn reference() -> Reference {
    let size = [3 * BLOCK; 2];
    let mut tile = FrameTile::new(TilePlace { first: [0; 2], across: 3, num_rows: 3, size }, 0);
    let mut lists = OpenBlock::default();
    for block in 0..9usize {
        let first_plane = tile.planes.len();
        lists.clear();
        for n in 0..if block == 6 { 0 } else { 2 + block % 4 } {
            let deeper = n as i32;
            let plane = |z| DepthPlane { z: 16 * (z + 1500 * deeper), dx: 16 * (40 - 30 * deeper), dy: 400 };
            let planes = (plane(20_000), plane(21_100));
            let u = std::array::from_fn(|i| (300 + 97 * n + 13 * i + 41 * block) as u16);
            let ycc = [5000, 400, -700].map(|v| std::array::from_fn(|i| v + (29 * i + 7 * block) as i16));
            let mask = [u64::MAX, 0x0fff_ffff_f0ff_ff7e, 0xff00_0000_0000_0081][(n + block) % 3];
            let opacities = u.map(|code: u16| scales().opacity(code));
            tile.planes.push(planes);
            lists.push(&planes, mask, &u, &ycc, &opacities);
        }
        tile.push(first_plane, &mut lists);
    }
    let bounds = Aabb { min: glam::Vec3::NEG_ONE, max: glam::Vec3::ONE };
    let pose = Pose::orbit(glam::Vec3::ZERO, 0.3, 0.2, 5.0);
    let camera = Camera::new(pose, Intrinsics::perspective(24, 24, 0.7), &bounds);
    Reference::new(FrameHeader::alone(camera, 8), None, vec![Arc::new(tile)], Counts::default())
}

/// Opacity, u, and Y, Co, Cg times opacity of a list of the reference between two depths, cell by cell. In exact
/// arithmetic, by the functions of which the tables are made.
fn content(reference: &Reference, [x, y]: [i32; 2], low: f64, high: f64) -> [f64; 5] {
    let side = BLOCK as i32;
    let Some((tile, block)) = reference.block(x.div_euclid(side), y.div_euclid(side)) else {
        return [0.0; 5];
    };
    let list = (y.rem_euclid(side) * side + x.rem_euclid(side)) as usize;
    let (mut spread, mut values, mut tau, mut kappa) = (NO_CELLS, [0.0; 5], 0.0, 1.0);
    let mut walk = tile.cells_of(block).walk(&mut spread);
    while let Some((layer, cells)) = walk.next() {
        let [front, back, code, ycc @ ..] = cells.map(|plane| plane[list]);
        let (front, back) = (f64::from(front), f64::from(back));
        if layer.mask >> list & 1 == 0 || back <= low || front >= high {
            continue;
        }
        let whole = f64::from(unpack_halves(scales().tau_half[usize::from(code)].into()).0);
        let own = whole * (back.min(high) - front.max(low)) / (back - front);
        let seen = kappa * (1.0 - (-own).exp());
        for (value, color) in values[2..].iter_mut().zip(ycc) {
            *value += seen * f64::from(color as i16) / 8192.0;
        }
        values[0] += seen;
        tau += own;
        kappa *= (-own).exp();
    }
    values[1] = 0.5 * (1.0 - (-tau).exp()).sqrt() + 0.1 * tau.ln_1p();
    values
}

#[test]
fn what_is_fetched_is_what_each_list_has_between_the_planes() {
    let reference = reference();
    let (mut num_lists, mut num_cut, mut worst) = (0, 0, [0.0f64; 4]);
    for (case, [x, y]) in
        [[64, 0], [6, 26], [-147, 230], [499, -397], [-864, 32], [1920, 64]].into_iter().enumerate()
    {
        for (front, back) in [(20_000, 21_100), (20_700, 23_300), (26_000, 27_000)] {
            let plane = |z| DepthPlane { z: 16 * z, dx: 560, dy: 320 + 16 * case as i32 };
            let (planes, shift) = ((plane(front), plane(back)), Shift { x, y, z: 56 });
            let fetched = with_each(|| {
                let mut fetched = Fetched::new();
                fetch(&mut fetched, &reference, [1, 1], &planes, shift, 16);
                fetched
            });
            assert!(fetched.iter().all(|f| (&f.planes, f.mask) == (&fetched[0].planes, fetched[0].mask)));
            let quarters = [x, y].map(|v| (v + 8) >> 4);
            let part = quarters.map(|q| f64::from(q & 3) / 4.0);
            for i in 0..BLOCK_LISTS {
                let (mut sums, mut weight) = ([0.0; 5], 0.0);
                for (dy, dx) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    let column = (i % BLOCK) as i32 + dx;
                    let row = (i / BLOCK) as i32 + dy;
                    let [wx, wy] =
                        [(dx, part[0]), (dy, part[1])].map(|(d, p)| if d == 0 { 1.0 - p } else { p });
                    let at =
                        [BLOCK as i32 + (quarters[0] >> 2) + column, BLOCK as i32 + (quarters[1] >> 2) + row];
                    let place = [(column, part[0]), (row, part[1])]
                        .map(|(v, part)| (4.0 * (f64::from(v) - part)) as i32 - 14);
                    let depth = |p: DepthPlane| f64::from(p.at(place) + shift.z) / 16.0;
                    let found = content(&reference, at, depth(planes.0), depth(planes.1));
                    weight += if found[0] > 0.0 { wx * wy } else { 0.0 };
                    sums.iter_mut().zip(found).for_each(|(sum, value)| *sum += wx * wy * value);
                }
                let is_there = fetched[0].mask >> i & 1 == 1;
                assert_eq!(is_there, weight > 0.5, "{x} {y} {front} {i}");
                if is_there {
                    let values = fetched[0].planes.each_ref().map(|plane| f64::from(plane[i]));
                    let [alpha, u, ycc @ ..] = sums;
                    let exact = [u / weight * f64::from(QUARTERS_PER_U), 0.0, 0.0, 0.0];
                    for c in 0..4 {
                        let exact = if c == 0 { exact[0] } else { ycc[c - 1] / alpha * 32_768.0 };
                        worst[c] = worst[c].max((values[c] - exact).abs());
                    }
                    num_lists += 1;
                    num_cut += usize::from(weight < 1.0);
                }
            }
        }
    }
    assert!(num_lists > 400 && num_cut > 20, "{num_lists} {num_cut}");
    // Two codes of u; colours of 1/8192, which parts of cells mix by opacities of 2⁻¹⁶.
    assert!(worst[0] < 8.0 && worst[1..].iter().all(|c| *c < 8.0), "{worst:?}");
}
