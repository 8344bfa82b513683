//! Novel views in double precision that look at every segment: what the cast is held against.

use glam::DVec3;
use isinglass_core::clip::Region;
use isinglass_core::kernels::empty_space::TILE;
use isinglass_core::kernels::raycast::{MARGIN_UNITS, Reconstruction};
use isinglass_core::layer::{DEPTH_UNITS, LayeredFrame};
use isinglass_core::space::Ray;

/// Cuts a ray by the sides of every column of lists, intersects it with every segment of the two lists it runs
/// between there (or, for the nearest list, cuts it by the sides of rows too), sorts and composites: in double
/// precision, without a DDA, a search or a clipped line.
pub(crate) fn brute_force(
    frame: &LayeredFrame,
    region: &Region,
    ray: &Ray,
    reconstruction: Reconstruction,
) -> [f64; 4] {
    let old = &frame.header.camera;
    let basis = old.basis();
    let size = [old.intrinsics.width, old.intrinsics.height].map(f64::from);
    let (forward, right, up) = (basis.forward.as_dvec3(), basis.right.as_dvec3(), basis.up.as_dvec3());
    let o = (ray.origin - basis.eye).as_dvec3();
    let d = ray.dir.as_dvec3();
    let unit = f64::from(old.far - old.near) / f64::from(DEPTH_UNITS);
    let Some((enter, leave)) = region.grown(MARGIN_UNITS * unit as f32).clip(ray) else { return [0.0; 4] };
    let is_parallel = old.intrinsics.projection.is_orthographic();
    // Homogeneous pixel coordinates of a point or a direction: x·w, y·w, w.
    let homogeneous = |v: DVec3, is_point: bool| {
        let w = match is_parallel {
            true => f64::from(u8::from(is_point)),
            false => v.dot(forward),
        };
        let x = v.dot(right) / right.length_squared();
        let y = v.dot(up) / up.length_squared();
        [(w + x) * 0.5 * size[0], (w - y) * 0.5 * size[1], w]
    };
    let (oh, dh) = (homogeneous(o, true), homogeneous(d, false));
    let depth = (o.dot(forward), d.dot(forward));
    let pixel = |s: f64, axis: usize| (oh[axis] + s * dh[axis]) / (oh[2] + s * dh[2]);
    let mut inside = (f64::from(enter), f64::from(leave));
    half_space(&mut inside, depth.0 - f64::from(old.near), depth.1);
    for axis in 0..2 {
        half_space(&mut inside, oh[axis], dh[axis]);
        half_space(&mut inside, size[axis] * oh[2] - oh[axis], size[axis] * dh[2] - dh[axis]);
    }
    if inside.1 <= inside.0 {
        return [0.0; 4];
    }
    let moved = |axis| (pixel(inside.1, axis) - pixel(inside.0, axis)).abs();
    let (along, across) = if moved(0) + 1e-2 >= moved(1) { (0, 1) } else { (1, 0) };
    let mut columns = Vec::new();
    for column in 0..size[along] as u32 {
        let (lo, hi) = (f64::from(column), f64::from(column) + 1.0);
        let mut part = inside;
        half_space(&mut part, oh[along] - lo * oh[2], dh[along] - lo * dh[2]);
        half_space(&mut part, hi * oh[2] - oh[along], hi * dh[2] - dh[along]);
        if part.1 <= part.0 {
            continue;
        }
        if reconstruction == Reconstruction::Nearest {
            for row in 0..size[across] as u32 {
                let (lo, hi) = (f64::from(row), f64::from(row) + 1.0);
                let mut part = part;
                half_space(&mut part, oh[across] - lo * oh[2], dh[across] - lo * dh[2]);
                half_space(&mut part, hi * oh[2] - oh[across], hi * dh[2] - dh[across]);
                if part.1 > part.0 {
                    let (x, y) = if along == 0 { (column, row) } else { (row, column) };
                    let (c, t) = brute_force_list(frame, x, y, part, depth, unit);
                    columns.push((part.0, column, [(c, 1.0 - t); 2], 0.0));
                }
            }
            continue;
        }
        let at_across = 0.5 * (pixel(part.0, across) + pixel(part.1, across)) - 0.5;
        let lists = [at_across.floor(), at_across.floor() + 1.0].map(|row| {
            let row = row.clamp(0.0, size[across] - 1.0) as u32;
            let (x, y) = if along == 0 { (column, row) } else { (row, column) };
            let (c, t) = brute_force_list(frame, x, y, part, depth, unit);
            (c, 1.0 - t)
        });
        columns.push((part.0, column, lists, at_across.rem_euclid(1.0)));
    }
    columns.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut c, mut t) = (DVec3::ZERO, 1.0);
    let (mut tile, mut bias) = (u32::MAX, 0.0);
    for (_, column, [first, second], fraction) in columns {
        // The less is seen of a tile, the more of the weight has the nearer list.
        if column / TILE != tile {
            (tile, bias) = (column / TILE, f64::min(0.005 / (t * t), 0.48));
        }
        let fraction = f64::clamp((fraction - bias) / (1.0 - 2.0 * bias), 0.0, 1.0);
        c += first.0.lerp(second.0, fraction) * t;
        t *= 1.0 - (first.1 + (second.1 - first.1) * fraction);
    }
    [c.x, c.y, c.z, 1.0 - t]
}

/// Colour and transmittance of the part [s0, s1] of a ray with depth w + s·dw through one list.
fn brute_force_list(
    frame: &LayeredFrame,
    x: u32,
    y: u32,
    part: (f64, f64),
    (w, dw): (f64, f64),
    unit: f64,
) -> (DVec3, f64) {
    let old = &frame.header.camera;
    let (_, per_depth) = old.ray(x as f32 + 0.5, y as f32 + 0.5);
    let mut pieces = Vec::new();
    for i in frame.list((y * old.intrinsics.width + x) as usize) {
        let segment = frame.segment(i);
        let front = f64::from(old.near) + f64::from(segment.front) * unit;
        let back = f64::from(old.near) + f64::from(segment.back) * unit;
        let mut inside = part;
        half_space(&mut inside, w - front, dw);
        half_space(&mut inside, back - w, -dw);
        if inside.1 > inside.0 {
            let tau =
                f64::from(segment.tau) * (inside.1 - inside.0) / ((back - front) * f64::from(per_depth));
            let color = segment.c.as_dvec3() / (1.0 - (-f64::from(segment.tau)).exp());
            pieces.push((inside.0, tau, color));
        }
    }
    pieces.sort_by(|a, b| a.0.total_cmp(&b.0));
    pieces.iter().fold((DVec3::ZERO, 1.0), |(c, t), (_, tau, color)| {
        (c + *color * t * (1.0 - (-tau).exp()), t * (-tau).exp())
    })
}

/// Keeps the part of [s0, s1] where a + b·s ≥ 0.
fn half_space((s0, s1): &mut (f64, f64), a: f64, b: f64) {
    if b > 0.0 {
        *s0 = s0.max(-a / b);
    } else if b < 0.0 {
        *s1 = s1.min(-a / b);
    } else if a < 0.0 {
        *s1 = f64::NEG_INFINITY;
    }
}
