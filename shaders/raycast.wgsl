// Novel views: ray casts a layered frame from any camera. Twin of crates/core/src/kernels/raycast.rs; the derivations
// are there. Run by raycast_compute.wgsl into a buffer and by raycast_view.wgsl onto the screen.

@group(0) @binding(0) var<uniform> caster: Raycaster;
@group(0) @binding(1) var<storage, read> offsets: array<u32>;
@group(0) @binding(2) var<storage, read> depth_plane: array<u32>;
@group(0) @binding(3) var<storage, read> c_rg: array<u32>;
@group(0) @binding(4) var<storage, read> c_b_tau: array<u32>;

// A ray clipped to the old frustum: a straight line in pixel space, and the three constants.
struct Line {
    // Pixel position at t = 0.
    p0: vec2f,
    // Pixel position at t = 1 minus that at t = 0.
    d: vec2f,
    s_w0: f32,
    w1: f32,
    w0_minus_w1: f32,
    w0_w1: f32,
    // Whether the ray meets the frustum and the box at all.
    hit: bool,
}

// Premultiplied colour and opacity seen along a ray of world space (`cast` in the twin: a reserved word here).
fn cast_ray(ray: Ray) -> Over {
    var acc = over_identity();
    if (caster.has_frame == 0u) {
        return acc;
    }
    let line = clip(ray);
    if (line.hit) {
        walk(line, &acc);
    }
    return acc;
}

// Clips in homogeneous coordinates.
fn clip(ray: Ray) -> Line {
    var line: Line;
    let clipped = clip_box(caster.bounds_min, caster.bounds_max, ray);
    if (clipped.s1 <= clipped.s0) {
        return line;
    }
    let o = pixel_from_world(caster.basis, ray.origin - caster.basis.eye);
    let d = pixel_from_world(caster.basis, ray.dir);
    let width = caster.basis.width;
    let height = caster.basis.height;
    let near = caster.basis.near;
    var planes = array<vec2f, 5>(
        vec2f(o.z - near, d.z),
        vec2f(o.x, d.x),
        vec2f(width * o.z - o.x, width * d.z - d.x),
        vec2f(o.y, d.y),
        vec2f(height * o.z - o.y, height * d.z - d.y),
    );
    var s0 = clipped.s0;
    var s1 = clipped.s1;
    for (var i = 0u; i < 5u; i++) {
        // Inside where a + b·s ≥ 0.
        let a = planes[i].x;
        let b = planes[i].y;
        if (b > 0.0) {
            s0 = max(s0, -a / b);
        } else if (b < 0.0) {
            s1 = min(s1, -a / b);
        } else if (a < 0.0) {
            return line;
        }
    }
    if (s1 <= s0) {
        return line;
    }
    let h0 = o + d * s0;
    let h1 = o + d * s1;
    let w0 = max(h0.z, near);
    let w1 = max(h1.z, near);
    line.p0 = h0.xy / w0;
    line.d = h1.xy / w1 - line.p0;
    line.s_w0 = (s1 - s0) * w0;
    line.w1 = w1;
    line.w0_minus_w1 = w0 - w1;
    line.w0_w1 = w0 * w1;
    line.hit = true;
    return line;
}

// Walks the columns of lists along the line.
fn walk(line: Line, acc: ptr<function, Over>) {
    let size = vec2i(i32(caster.basis.width), i32(caster.basis.height));
    let along = select(0u, 1u, abs(line.d.x) + AXIS_BIAS < abs(line.d.y));
    let across = 1u - along;
    var column = clamp(i32(floor(line.p0[along])), 0, size[along] - 1);
    let columns = axis(line.p0[along], line.d[along], column);
    var t_next = columns.t;
    var hints = vec2u(0u);
    var t_in = 0.0;
    var enter = at(line, t_in);
    loop {
        let t_out = min(t_next, 1.0);
        let leave = at(line, t_out);
        if (leave.distance > enter.distance) {
            let crossing = crossing_between(line, enter, leave);
            let at_across = line.p0[across] + line.d[across] * (0.5 * (t_in + t_out)) - 0.5;
            let first = floor(at_across);
            let nearness = vec2f(1.0 - (at_across - first), at_across - first);
            var mixed = vec4f(0.0);
            for (var side = 0u; side < 2u; side++) {
                if (nearness[side] < MIN_NEARNESS) {
                    continue;
                }
                let row = clamp(i32(first) + i32(side), 0, size[across] - 1);
                let xy = select(vec2i(row, column), vec2i(column, row), along == 0u);
                var list = over_identity();
                hints[side] = cross_list(xy.x, xy.y, crossing, hints[side], &list);
                mixed += vec4f(list.c, 1.0 - list.transmittance) * nearness[side];
            }
            (*acc).c += mixed.xyz * (*acc).transmittance;
            (*acc).transmittance *= 1.0 - mixed.w;
            if ((*acc).transmittance < TRANSMITTANCE_MIN) {
                return;
            }
        }
        if (t_out >= 1.0) {
            return;
        }
        t_in = t_out;
        enter = leave;
        column += columns.step;
        t_next += columns.dt;
        if (column < 0 || column >= size[along]) {
            return;
        }
    }
}

// A point of the line: depth in units and world distance from its start.
struct Point {
    depth: f32,
    distance: f32,
}

fn at(line: Line, t: f32) -> Point {
    let r = 1.0 / (line.w1 + t * line.w0_minus_w1);
    return Point((line.w0_w1 * r - caster.basis.near) * caster.units_per_depth, line.s_w0 * t * r);
}

// The part of a ray inside a column of lists.
struct Crossing {
    // Least and greatest depth, in units.
    lo: f32,
    hi: f32,
    // World length of the ray for each unit of depth.
    length_per_unit: f32,
    // Whether the ray runs away from the old eye.
    is_forward: bool,
}

fn crossing_between(line: Line, enter: Point, leave: Point) -> Crossing {
    let lo = min(enter.depth, leave.depth);
    // A ray along the old image plane stays at one depth; the guard makes the share of the crossing 1.
    let hi = max(max(enter.depth, leave.depth), lo + MIN_CROSSING);
    return Crossing(lo, hi, (leave.distance - enter.distance) / (hi - lo), line.w0_minus_w1 <= 0.0);
}

// Composites the segments of list (x, y) that the crossing meets. `hint` is the index at which the list before was
// left; returns that for the next list.
fn cross_list(x: i32, y: i32, crossing: Crossing, hint: u32, acc: ptr<function, Over>) -> u32 {
    let list = u32(y) * u32(caster.basis.width) + u32(x);
    let start = offsets[list];
    let end = offsets[list + 1u];
    if (start >= end) {
        return hint;
    }
    let lo = crossing.lo;
    let hi = crossing.hi;
    // World length of one depth unit along the centre of this list.
    let nx = (2.0 * f32(x) + 1.0) / caster.basis.width - 1.0;
    let ny = 1.0 - (2.0 * f32(y) + 1.0) / caster.basis.height;
    let center = caster.basis.forward + caster.basis.right * nx + caster.basis.up * ny;
    let ratio = crossing.length_per_unit * caster.units_per_depth / length_of(center);
    // Previous-index search (Gupta 2022, algorithm 1): neighbouring lists are alike, so start where the last list was
    // left and walk to the first segment that the ray meets.
    var i = start + min(hint, end - start - 1u);
    if (crossing.is_forward) {
        while (i > start && ends(i - 1u).y > lo) {
            i -= 1u;
        }
        while (i < end && ends(i).y <= lo) {
            i += 1u;
        }
        while (i < end && ends(i).x < hi) {
            cross_segment(i, ends(i), lo, hi, ratio, acc);
            i += 1u;
        }
        return max(i, start + 1u) - start - 1u;
    }
    while (i + 1u < end && ends(i + 1u).x < hi) {
        i += 1u;
    }
    var after = i + 1u;
    while (after > start && ends(after - 1u).x >= hi) {
        after -= 1u;
    }
    while (after > start && ends(after - 1u).y > lo) {
        cross_segment(after - 1u, ends(after - 1u), lo, hi, ratio, acc);
        after -= 1u;
    }
    return after - start;
}

// Front and back of segment i, depth units.
fn ends(i: u32) -> vec2f {
    let word = depth_plane[i];
    return vec2f(f32(word & 0xffffu), f32(word >> 16u));
}

// Composites the part of segment i between the depths lo and hi; `ratio` is the ray's length over the list's own
// length, for the same depth.
fn cross_segment(i: u32, front_back: vec2f, lo: f32, hi: f32, ratio: f32, acc: ptr<function, Over>) {
    let overlap = min(hi, front_back.y) - max(lo, front_back.x);
    if (overlap <= 0.0) {
        return;
    }
    let rg = unpack_halves(c_rg[i]);
    let b_tau = unpack_halves(c_b_tau[i]);
    let c = vec3f(rg, b_tau.x);
    let tau = b_tau.y;
    let tau_crossed = tau * (overlap / (front_back.y - front_back.x)) * ratio;
    let alpha = opacity(tau);
    if (alpha <= 0.0) {
        return;
    }
    let alpha_crossed = opacity(tau_crossed);
    (*acc).c += c * ((*acc).transmittance * alpha_crossed / alpha);
    (*acc).transmittance *= 1.0 - alpha_crossed;
}

fn length_of(v: vec3f) -> f32 {
    return sqrt(dot(v, v));
}

// DDA along one axis: step of the index, parameter of the first crossing, parameter between crossings.
struct Axis {
    step: i32,
    t: f32,
    dt: f32,
}

fn axis(p: f32, d: f32, index: i32) -> Axis {
    if (abs(d) < MIN_SLOPE) {
        return Axis(0, NEVER, NEVER);
    }
    let forward = d > 0.0;
    let edge = select(f32(index), f32(index) + 1.0, forward);
    return Axis(select(-1, 1, forward), (edge - p) / d, 1.0 / abs(d));
}

// Shortest depth interval that is divided by, in depth units.
const MIN_CROSSING: f32 = 1e-2;
// A list with less weight than this is left out.
const MIN_NEARNESS: f32 = 1e-3;
// A row must win by so many pixels.
const AXIS_BIAS: f32 = 1e-2;
// A line that moves less than this many pixels in all crosses no border worth a division.
const MIN_SLOPE: f32 = 1e-6;
// The parameter of a crossing that does not come: far beyond the end of the line at 1.
const NEVER: f32 = 1e30;
