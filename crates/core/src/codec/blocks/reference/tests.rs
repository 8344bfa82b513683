use super::super::model::TilePlace;
use super::super::tile::OpenBlock;
use super::*;
use crate::camera::{Camera, Intrinsics, Pose};
use crate::layer::FrameHeader;
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
            let plane =
                |z: f32| DepthPlane { z: z + 1500.0 * n as f32, dx: 40.0 - 30.0 * n as f32, dy: 25.0 };
            let planes = (plane(20_000.0), plane(21_100.0));
            let u = std::array::from_fn(|i| (300 + 97 * n + 13 * i + 41 * block) as u16);
            let ycc = [5000, 400, -700].map(|v| std::array::from_fn(|i| v + (29 * i + 7 * block) as i16));
            let mask = [u64::MAX, 0x0fff_ffff_f0ff_ff7e, 0xff00_0000_0000_0081][(n + block) % 3];
            let alphas = u.map(|code: u16| scales().alpha[usize::from(code)]);
            tile.planes.push(planes);
            lists.push(&planes, mask, &u, &ycc, &alphas);
        }
        tile.push(first_plane, &mut lists);
    }
    let bounds = Aabb { min: glam::Vec3::NEG_ONE, max: glam::Vec3::ONE };
    let pose = Pose::orbit(glam::Vec3::ZERO, 0.3, 0.2, 5.0);
    let camera = Camera::new(pose, Intrinsics::perspective(24, 24, 0.7), &bounds);
    Reference::new(FrameHeader::alone(camera, 8), None, vec![Arc::new(tile)], Counts::default())
}

/// Opacity, u, and Y, Co, Cg times opacity of a list of the reference between two depths, cell by cell.
fn content(reference: &Reference, [x, y]: [i32; 2], low: f32, high: f32) -> [f32; 5] {
    let (s, side) = (scales(), BLOCK as i32);
    let Some((tile, block)) = reference.block(x.div_euclid(side), y.div_euclid(side)) else {
        return [0.0; 5];
    };
    let list = (y.rem_euclid(side) * side + x.rem_euclid(side)) as usize;
    let (mut spread, mut values, mut tau_sum, mut kappa, mut count) = (NO_CELLS, [0.0; 5], 0.0, 1.0, 0);
    let mut walk = tile.cells_of(block).walk(&mut spread);
    while let Some((layer, cells)) = walk.next() {
        let [front, back, code, ycc @ ..] = cells.map(|plane| plane[list]);
        let (front, back) = (f32::from(front), f32::from(back));
        if layer.mask >> list & 1 == 0 || back <= low.floor() || front >= high.ceil() {
            continue;
        }
        let part = (back.min(high) - front.max(low)) / (back - front);
        let of_cell = s.tau_and_alpha(code)[0];
        let code = if part > WHOLE { code } else { s.code(s.u_from_tau(of_cell * part)) };
        let [tau, alpha] = s.tau_and_alpha(code);
        let seen = kappa * alpha;
        for (value, color) in values[2..].iter_mut().zip(ycc) {
            *value += seen * f32_from_fixed(color as i16);
        }
        (values[0], values[1]) = (values[0] + seen, s.u(code));
        tau_sum += tau;
        kappa *= 1.0 - alpha;
        count += 1;
    }
    if count > 1 {
        values[1] = s.u_from_tau(tau_sum);
    }
    values
}

#[test]
fn what_is_fetched_is_what_each_list_has_between_the_planes() {
    let reference = reference();
    let (mut num_lists, mut num_cut) = (0, 0);
    for (case, (x, y)) in
        [(1.0, 0.0), (0.1, 0.4), (-2.3, 3.6), (7.8, -6.2), (-13.5, 0.5), (30.0, 1.0)].into_iter().enumerate()
    {
        for (front, back) in [(20_000.0, 21_100.0), (20_700.0, 23_300.0), (26_000.0, 27_000.0)] {
            let plane = |z| DepthPlane { z, dx: 35.0, dy: 20.0 + case as f32 };
            let (planes, shift) = ((plane(front), plane(back)), Shift { x, y, z: 3.5 });
            let fetched = with_each(|| {
                let mut fetched = Fetched::new();
                fetch(&mut fetched, &reference, (1, 1), &planes, shift, 16.0);
                fetched
            });
            let quarters = [x, y].map(|v| (v * 4.0 + 0.5).floor() as i32);
            let part = quarters.map(|q| (q & 3) as f32 * 0.25);
            for i in 0..BLOCK_LISTS {
                let (mut sums, mut weight) = ([0.0; 5], 0.0);
                for (dy, dx) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    let column = (i % BLOCK) as i32 + dx;
                    let row = (i / BLOCK) as i32 + dy;
                    let [wx, wy] =
                        [(dx, part[0]), (dy, part[1])].map(|(d, p)| if d == 0 { 1.0 - p } else { p });
                    let at =
                        [BLOCK as i32 + (quarters[0] >> 2) + column, BLOCK as i32 + (quarters[1] >> 2) + row];
                    let [px, py] = [column as f32 - part[0] - MIDDLE, row as f32 - part[1] - MIDDLE];
                    let depth = |p: DepthPlane| p.z + p.dx * px + p.dy * py + shift.z;
                    let found = content(&reference, at, depth(planes.0), depth(planes.1));
                    weight += if found[0] > 0.0 { wx * wy } else { 0.0 };
                    sums.iter_mut().zip(found).for_each(|(sum, value)| *sum += wx * wy * value);
                }
                for fetched in &fetched {
                    let is_there = fetched.mask >> i & 1 == 1;
                    assert_eq!(is_there, weight > 0.5, "{x} {y} {front} {i}");
                    if is_there {
                        let values = fetched.planes.each_ref().map(|plane| plane[i]);
                        let [alpha, u, ycc @ ..] = sums;
                        assert_eq!(values[0], u / weight, "{x} {y} {front} {i}");
                        assert_eq!(values[1..], ycc.map(|sum| sum / alpha), "{x} {y} {front} {i}");
                        num_lists += 1;
                        num_cut += usize::from(weight < 1.0);
                    }
                }
            }
        }
    }
    assert!(num_lists > 1000 && num_cut > 50, "{num_lists} {num_cut}");
}
