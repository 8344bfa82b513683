//! Shade against closed forms, and against lines that are followed one by one.

use super::*;

/// Extinctions of cells, by their numbers along x, y, z.
fn matter(dims: [usize; 3], cell: Vec3, sigma: impl Fn([usize; 3]) -> f32) -> Extinction {
    let [nx, ny, nz] = dims;
    let sigma = (0..nx * ny * nz).map(|i| sigma([i % nx, i / nx % ny, i / nx / ny])).collect();
    Extinction { dims, voxels: [1; 3], cell, sigma }
}

fn at(shade: &Shade, [x, y, z]: [usize; 3]) -> f32 {
    shade.shares[(z * shade.dims[1] + y) * shade.dims[0] + x]
}

fn light(azimuth_degrees: f32, elevation_degrees: f32, softness_degrees: f32) -> Lighting {
    Lighting { azimuth_degrees, elevation_degrees, softness_degrees, shadows: 1.0, ..Lighting::default() }
}

#[test]
fn the_exponential_is_right() {
    for i in 0..4000 {
        let x = i as f32 * 0.005;
        let exact = (-x).exp();
        assert!((exp_of_minus(x) - exact).abs() <= 1e-5 * exact, "{x}: {} for {exact}", exp_of_minus(x));
    }
    assert_eq!(exp_of_minus(0.0), 1.0);
    assert!(exp_of_minus(1e30) < 1e-11 && exp_of_minus(f32::INFINITY) < 1e-11);
}

#[test]
fn nothing_has_no_shade() {
    let empty = matter([9, 7, 11], Vec3::new(1.0, 2.0, 0.5), |_| 0.0);
    for detail in [Detail::Draft, Detail::Final] {
        let occlusion = Shade::occlusion(&empty, 4.0, detail);
        let shadow = Shade::shadow(&empty, &light(20.0, 30.0, 10.0), detail);
        for share in occlusion.shares.iter().chain(&shadow.shares) {
            assert!((share - 1.0).abs() < 1e-6, "{share}");
        }
    }
}

/// Half of a unit of 1/1023 a direction, and the mixing of four lines twice.
const TOLERANCE: f32 = 1e-3;

#[test]
fn inside_a_homogeneous_medium_occlusion_is_the_exponential_of_the_reach() {
    let (sigma, radius, cell) = (0.3, 5.0, 0.5);
    let medium = matter([48; 3], Vec3::splat(cell), |_| sigma);
    let near = NEAR_IN_CELLS * cell;
    let exact = (-sigma * (radius - near)).exp();
    for detail in [Detail::Draft, Detail::Final] {
        let found = at(&Shade::occlusion(&medium, radius, detail), [24, 23, 25]);
        assert!((found - 2.0 * exact).abs() < 2.0 * TOLERANCE, "{found} for {}", 2.0 * exact);
    }
    // Negative control: another reach.
    let other = at(&Shade::occlusion(&medium, 1.2 * radius, Detail::Final), [24, 23, 25]);
    assert!((other - 2.0 * exact).abs() > 0.1);
}

#[test]
fn below_a_face_the_shadow_is_the_exponential_of_the_slant_depth() {
    // Matter below z = 40 of 48, lit from above at an angle to z.
    let sigma = 0.11;
    let half_space = matter([60, 20, 48], Vec3::ONE, |[_, _, z]| if z < 40 { sigma } else { 0.0 });
    for angle in [0.0f32, 30.0, 44.0, 58.0] {
        let shadow = Shade::shadow(&half_space, &light(angle, 0.0, 0.0), Detail::Final);
        let cos = angle.to_radians().cos();
        for z in [37, 34, 30] {
            let slant = (40.0 - (z as f32 + 0.5)) / cos;
            let exact = (-sigma * (slant - NEAR_IN_CELLS)).exp();
            let found = at(&shadow, [20, 10, z]);
            // Lines that cross the face beside the cells' middles see it up to a tenth of a cell off.
            assert!(
                (found - exact).abs() < TOLERANCE + 0.1 * sigma * exact,
                "{angle}° {z}: {found} for {exact}"
            );
        }
    }
    // Negative control: the light from below.
    let below = at(&Shade::shadow(&half_space, &light(180.0, 0.0, 0.0), Detail::Final), [20, 10, 37]);
    assert!(below < 0.05, "{below}");
}

#[test]
fn a_flat_surface_keeps_its_light_a_groove_half_and_a_corner_a_quarter() {
    let walls = |num: usize| {
        matter([40; 3], Vec3::ONE, move |p| if p.iter().take(num).any(|&x| x < 12) { 9.0 } else { 0.0 })
    };
    // The middle of the cell is half a cell off the walls, and a line that grazes a wall runs where its cells are mixed
    // with air: some of the sky is lost over any surface.
    let beside = |num: usize| {
        let mut place = [25; 3];
        place[..num].fill(12);
        at(&Shade::occlusion(&walls(num), 9.0, Detail::Final), place)
    };
    let flat = beside(1);
    assert!((0.85..=1.0).contains(&flat), "{flat}");
    for (num, expected) in [(1, 1.0), (2, 0.5), (3, 0.25)] {
        // 64 directions stand for all.
        let found = beside(num) / flat;
        assert!((found - expected).abs() < 0.07, "{num} walls: {found} for {expected}");
        // Far from the walls nothing is taken away.
        let far = at(&Shade::occlusion(&walls(num), 9.0, Detail::Final), [30; 3]);
        assert!(far > 0.999, "{far}");
    }
}

/// Where a profile crosses a level, by linear interpolation, from the left.
fn crossing(profile: &[f32], level: f32, from: usize) -> f32 {
    let after =
        (from + 1..profile.len()).find(|&i| (profile[i - 1] - level) * (profile[i] - level) <= 0.0).unwrap();
    let (a, b) = (profile[after - 1], profile[after]);
    after as f32 - 1.0 + (level - a) / (b - a)
}

#[test]
fn a_plate_throws_a_shadow_where_the_light_says_and_as_soft_as_the_light_is_wide() {
    // A plate of 16×16×1 cells at z = 28, and what it does to the air at z = 4.
    let plate = matter([64, 64, 48], Vec3::ONE, |[x, y, z]| {
        if (24..40).contains(&x) && (24..40).contains(&y) && z == 28 { 20.0 } else { 0.0 }
    });
    let profile = |softness: f32, along_x: bool| -> Vec<f32> {
        let shadow = Shade::shadow(&plate, &light(30.0, 0.0, softness), Detail::Final);
        (0..64).map(|i| at(&shadow, if along_x { [i, 32, 4] } else { [18, i, 4] })).collect()
    };
    // The light comes from +x, so the shadow lies towards −x: from the top of the plate's near edge to the bottom of its
    // far one. A cell's middle is at half.
    let tan = 30f32.to_radians().tan();
    let hard = profile(0.0, true);
    let edges = [crossing(&hard, 0.5, 0), crossing(&hard, 0.5, 18)];
    let expected = [24.0 - 24.5 * tan - 0.5, 40.0 - 23.5 * tan - 0.5];
    for (found, expected) in edges.iter().zip(expected) {
        // Matter is mixed linearly between middles, so an opaque edge is up to a cell farther out.
        assert!((found - expected).abs() < 1.1, "{edges:?} for {expected}");
    }
    assert!(hard[18] < 1e-3, "umbra");
    // Across: of a disc of angular radius r in the distance s, a tenth is hidden at 0.687·s·tan r on one side of the
    // edge, and nine tenths on the other.
    let width = |softness: f32| {
        let across = profile(softness, false);
        (crossing(&across, 0.1, 0) - crossing(&across, 0.9, 0)).abs()
    };
    let distance = 24.0 / 30f32.to_radians().cos();
    for softness in [5.0f32, 8.0] {
        let expected = 2.0 * 0.687 * distance * softness.to_radians().tan();
        let found = width(softness);
        // A cell of mixing at either end.
        assert!((found - expected).abs() < 1.3, "{softness}°: {found} for {expected}");
    }
    // Negative control: a point has sharp shadows.
    assert!(width(0.0) < 1.7, "{}", width(0.0));
}

/// Transmittance along one line in small steps, with extinction mixed of eight cells.
fn marched(extinction: &Extinction, cell: [usize; 3], towards: Vec3, stretch: ShadingInterval) -> f32 {
    let [near, far] = stretch.in_direction(extinction, towards);
    let start = Vec3::from_array(cell.map(|i| i as f32));
    let sigma = |p: Vec3| {
        let corner = p.floor();
        (0..8)
            .map(|i| {
                let offset = Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32);
                let q = corner + offset;
                let is_inside = (0..3).all(|a| q[a] >= 0.0 && q[a] < extinction.dims[a] as f32);
                let [x, y, z] = [q.x as usize, q.y as usize, q.z as usize];
                let weight = (Vec3::ONE - (p - q).abs()).to_array().iter().product::<f32>();
                if is_inside {
                    weight * extinction.sigma[(z * extinction.dims[1] + y) * extinction.dims[0] + x]
                } else {
                    0.0
                }
            })
            .sum::<f32>()
    };
    let step = 0.02 * extinction.cell.min_element();
    let num = ((far.min(100.0) - near) / step) as usize;
    let tau =
        (0..num).map(|i| sigma(start + towards * (near + (i as f32 + 0.5) * step) / extinction.cell) * step);
    (-tau.sum::<f32>()).exp()
}

#[test]
fn sweeps_find_what_lines_find_that_are_followed_one_by_one() {
    // Smooth matter in cells that are no cubes, and directions of every octant and axis.
    let wave = |x: usize, k: f32| (x as f32 * k).sin();
    let smooth = matter([19, 23, 17], Vec3::new(1.0, 0.7, 1.6), |[x, y, z]| {
        0.12 * (1.0 + wave(x, 0.5) * wave(y, 0.4) + 0.5 * wave(z, 0.7)).max(0.0)
    });
    for far in [f32::INFINITY, 6.0] {
        let stretch = ShadingInterval { near_in_cells: NEAR_IN_CELLS, far };
        let mut worst = 0f32;
        let mut other = 0f32;
        for i in 0..14 {
            let towards = on_sphere(i, 14);
            let shade = Shade::mean(&smooth, &[towards], stretch);
            for cell in [[9, 11, 8], [2, 20, 3], [16, 4, 14], [0, 0, 0], [18, 22, 16]] {
                let found = at(&shade, cell);
                let exact = marched(&smooth, cell, towards, stretch);
                worst = worst.max((found - exact).abs());
                other = other.max((found - marched(&smooth, cell, -towards, stretch)).abs());
            }
        }
        // Matter is mixed twice, of cells and of lines, which rounds its waves off; at the grid's faces it is cut.
        assert!(worst < 0.06, "far {far}: off by {worst}");
        assert!(other > 0.3, "negative control: the other way, {other}");
    }
}

#[test]
fn a_sum_does_not_depend_on_the_number_of_threads() {
    let some = matter([13, 8, 21], Vec3::ONE, |[x, y, z]| ((x * 7 + y * 5 + z * 3) % 11) as f32 * 0.05);
    let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let several = rayon::ThreadPoolBuilder::new().num_threads(5).build().unwrap();
    let shade = || Shade::occlusion(&some, 4.0, Detail::Final);
    assert_eq!(alone.install(shade), several.install(shade));
}
