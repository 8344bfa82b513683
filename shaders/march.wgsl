// The march through a volume: steps along a ray, classified and shaded, handed to sink_step. Twin of
// crates/core/src/kernels/march.rs; the derivations are there.
//
// Parts after this one define five things. First, the fields of texels that a ray meets (march/whole.wgsl or pages.wgsl):
//   fn run_at(line: Line, lattice: Lattice, from_point: u32, stride: u32) -> Run
// which enters the field at a lattice point. Until the next call, the others of that part tell of this field.
// Second, a sample (march/one.wgsl or mixed.wgsl):
//   At, fn at_point(p: vec3f) -> At
// Third, where there is nothing (march/gaps.wgsl or a generated line):
//   fn is_gap(p: vec3f) -> bool
// Fourth, what matter sends to the eye (march/matte.wgsl or glossy.wgsl):
//   fn sent(color: vec3f, alpha: f32, p: vec3f, dir: vec3f) -> vec3f
// Fifth, what the mode makes of two neighbouring samples (the other march/*.wgsl):
//   fn take(between: Between) -> u32
// It hands what is visible between them, front to back, to a part that says what becomes of the steps:
//   fn sink_step(step: Step) -> u32
// Both return how the march goes on (Pace): the lattice points to the next end of a step, 1 or STRIDE; 0 for not at all;
// NO_STEP where there was nothing. In the end comes
//   fn end_march(lattice: Lattice)
// Which bricks are of no use any more, beside those that are invisible, says
//   fn is_beaten(brick: u32) -> bool

@group(0) @binding(0) var<uniform> scene: Scene;
// One for each channel that is marched.
@group(0) @binding(1) var<storage, read> tables: array<TransferTable>;
@group(0) @binding(2) var<storage, read> occupancy: array<u32>;
// Binding 3 are the voxels, and those from 5 on the voxels of more channels.
@group(0) @binding(4) var lit: texture_3d<u32>;

// Equal steps along a ray: lattice point i is at world distance s0 + i·h, i in 0..=n. No steps if the ray misses. A part of
// a lattice has the steps from `first` on, and an earlier end.
struct Lattice {
    s0: f32,
    h: f32,
    first: u32,
    n: u32,
    unit: f32,
}

// A visible step of a march.
struct Step {
    // Premultiplied colour of the step on its own.
    c: vec3f,
    // Optical depth, above TAU_MIN.
    tau: f32,
    // World distance of the front.
    s0: f32,
    // World distance of the back.
    s1: f32,
    // Opacity, 1 − e^−τ.
    alpha: f32,
}

// Two neighbouring samples of a march, and their world distances.
struct Between {
    x0: At,
    x1: At,
    s0: f32,
    s1: f32,
    // The ray among the texels.
    line: Line,
    lattice: Lattice,
}

// A ray in voxel space, or among the texels of a field.
struct Line {
    origin: vec3f,
    dir: vec3f,
}

// A part of a ray that is marched in one field, in lattice points.
struct Run {
    // The first point; at the end of the lattice if nothing follows.
    first: u32,
    // Steps begin before this point,
    end: u32,
    // and end before or at this one.
    limit: u32,
    // Lattice points of a step.
    pace: u32,
}

fn scene_lattice(ray: Ray, near: f32) -> Lattice {
    let clipped =
        clip_region(scene.bounds_min, scene.bounds_max, scene.clip_normal, scene.clip_offset, ray);
    let s0 = max(clipped.s0, near);
    let s1 = clipped.s1;
    if (s1 <= s0) {
        return Lattice(0.0, 0.0, 0u, 0u, 0.0);
    }
    let v = scene.voxel_from_world;
    let share = min(length(ray.dir * v) / max(max(v.x, v.y), v.z), 1.0);
    let n = clamp(ceil((s1 - s0) / scene.step_length * share), 1.0, MAX_STEPS);
    let h = (s1 - s0) / n;
    return Lattice(s0, h, 0u, u32(n), h * share);
}

// STRIDE behind matter that nothing can be seen through.
fn pace_behind(transmittance: f32) -> u32 {
    return select(1u, STRIDE, transmittance < TRANSMITTANCE_HIDDEN);
}

// A brick, and how many bricks away the nearest visible one is.
struct Brick {
    brick: vec3f,
    empty: u32,
}

// The first lattice point from first on, by strides, whose step may be visible; the end of the run or more if none.
fn skip(line: Line, lattice: Lattice, run: Run, first: u32, stride: u32) -> u32 {
    var i = first;
    var at = brick_at(line, lattice, i);
    while (at.empty > 0u) {
        // Whether neighbouring ends of steps are in one brick or in bricks that touch.
        let widest = max(max(abs(line.dir.x), abs(line.dir.y)), abs(line.dir.z));
        let is_fine = widest * lattice.h * f32(run.pace * STRIDE) < f32(BRICK);
        // The last lattice point inside of the invisible bricks around.
        let reach = select(1.0, f32(at.empty), is_fine);
        let leaves = at.brick + select(vec3f(1.0 - reach), vec3f(reach), line.dir > vec3f(0.0));
        let exits = (leaves * f32(BRICK) + first_brick() - line.origin) / line.dir;
        let exit = min(min(exits.x, exits.y), exits.z);
        let j = u32(clamp((exit - lattice.s0) / lattice.h, 0.0, f32(run.end)));
        if (j > i) {
            i += (j - i) / stride * stride;
        }
        // A step between invisible bricks that touch is invisible as well.
        let next = min(i + stride, run.limit);
        if (i >= run.end || !is_fine) {
            break;
        }
        at = brick_at(line, lattice, next);
        if (at.empty > 0u) {
            i = next;
        }
    }
    return i;
}

fn brick_at(line: Line, lattice: Lattice, i: u32) -> Brick {
    let p = line.origin + line.dir * (lattice.s0 + f32(i) * lattice.h) - first_brick();
    let brick = floor(clamp(p * (1.0 / f32(BRICK)), vec3f(0.0), vec3f(brick_dims()) - 1.0));
    let at = vec3u(brick);
    let index = (at.z * brick_dims().y + at.y) * brick_dims().x + at.x;
    var empty = occupancy_byte(0u, index);
    if (empty == 0u && is_beaten(index)) {
        empty = 1u;
    }
    return Brick(brick, empty);
}

// Byte i of some words, of which this one has it. Plane 0 of an occupancy are the distances, plane 1 the peaks
// (core::volume::Occupancy).
fn byte_of(word: u32, i: u32) -> u32 {
    return (word >> (8u * (i % 4u))) & 0xffu;
}

fn march(ray: Ray, lattice: Lattice) {
    let s0 = lattice.s0;
    let h = lattice.h;
    let n = lattice.n;
    let origin = ray.origin * scene.voxel_from_world + scene.voxel_origin;
    let whole = Line(origin, safe_dir(ray.dir) * scene.voxel_from_world);
    var i = lattice.first;
    var stride = 1u;
    // The last sample, if it was lattice point i.
    var x_front = At();
    var has_x_front = false;
    var run = run_at(whole, lattice, i, 1u);
    var line = line_in_field(whole);
    i = run.first;
    // One loop for all runs, so that invocations in fields of other sizes do not wait for each other.
    while (i < n) {
        if (i >= run.end) {
            // Another level has other values at the same point.
            has_x_front = has_x_front && run.limit == n;
            run = run_at(whole, lattice, i, stride);
            if (run.first > i) {
                i = run.first;
                has_x_front = false;
                if (i >= n) {
                    break;
                }
            }
            line = line_in_field(whole);
        }
        let visible = skip(line, lattice, run, i, stride * run.pace);
        if (visible > i) {
            i = visible;
            has_x_front = false;
            if (i >= run.end) {
                continue;
            }
        }
        let s_front = s0 + f32(i) * h;
        var x0 = x_front;
        if (!has_x_front) {
            x0 = at_point(line.origin + line.dir * s_front);
        }
        let next = min(i + stride * run.pace, run.limit);
        let s_back = s0 + f32(next) * h;
        let x1 = at_point(line.origin + line.dir * s_back);
        var pace = NO_STEP;
        if (!is_gap(line.origin + line.dir * s_front) && !is_gap(line.origin + line.dir * s_back)) {
            pace = take(Between(x0, x1, s_front, s_back, line, lattice));
        }
        if (pace == 0u) {
            break;
        }
        stride = select(pace, stride, pace == NO_STEP);
        x_front = x1;
        has_x_front = true;
        i = next;
    }
    end_march(lattice);
}

// Colour (not premultiplied) and, in w, optical depth of a step of length h between the domain positions x0, x1 of a
// channel.
fn classify(channel: u32, x0: f32, x1: f32, h: f32) -> vec4f {
    let dx = x1 - x0;
    if (abs(dx) < 0.5 / f32(TABLE_BINS)) {
        let m = lookup_density(channel, 0.5 * (x0 + x1));
        let sigma = m.w;
        if (sigma <= 0.0) {
            return vec4f(0.0);
        }
        return vec4f(m.xyz / sigma, sigma * h);
    }
    let a = lookup_integral(channel, x0);
    let b = lookup_integral(channel, x1);
    let d_t = b.w - a.w;
    if (d_t == 0.0) {
        return vec4f(0.0);
    }
    let color = (b.xyz - a.xyz) / d_t;
    return vec4f(clamp(color, vec3f(0.0), vec3f(1.0)), h * d_t / dx);
}

// Trilinear sample at a point of voxel space, as a position in the transfer function's domain.
fn domain_at(p: vec3f) -> f32 {
    let u = p - 0.5;
    let c = vec3i(floor(u));
    let t = u - floor(u);
    let x00 = lerp(v(c, 0, 0, 0), v(c, 1, 0, 0), t.x);
    let x10 = lerp(v(c, 0, 1, 0), v(c, 1, 1, 0), t.x);
    let x01 = lerp(v(c, 0, 0, 1), v(c, 1, 0, 1), t.x);
    let x11 = lerp(v(c, 0, 1, 1), v(c, 1, 1, 1), t.x);
    let value = lerp(lerp(x00, x10, t.y), lerp(x01, x11, t.y), t.z);
    return clamp(value * scene.x_scale + scene.x_offset, X_LEAST, X_GREATEST);
}

// The voxel around a point of voxel space.
fn nearest_voxel(p: vec3f) -> vec3i {
    return vec3i(clamp(p, vec3f(first_texel()), vec3f(last_texel())));
}

// Brightness of matter at a point of voxel space: that of the voxels, interpolated trilinearly.
fn shade(p: vec3f) -> f32 {
    if (scene.shaded == 0u) {
        return 1.0;
    }
    let u = p - 0.5;
    let c = vec3i(floor(u));
    let t = u - floor(u);
    let x00 = lerp(l(c, 0, 0, 0), l(c, 1, 0, 0), t.x);
    let x10 = lerp(l(c, 0, 1, 0), l(c, 1, 1, 0), t.x);
    let x01 = lerp(l(c, 0, 0, 1), l(c, 1, 0, 1), t.x);
    let x11 = lerp(l(c, 0, 1, 1), l(c, 1, 1, 1), t.x);
    let share = lerp(lerp(x00, x10, t.y), lerp(x01, x11, t.y), t.z) * (1.0 / LIT_MAX);
    return light_scale().x + light_scale().y * share;
}

// The stored number beside the corner c of a cell.
fn v(c: vec3i, dx: i32, dy: i32, dz: i32) -> f32 {
    return stored(texel(c, dx, dy, dz));
}

// The share of light beside the corner c of a cell, in units of 1/LIT_MAX.
fn l(c: vec3i, dx: i32, dy: i32, dz: i32) -> f32 {
    return f32(textureLoad(lit, texel(c, dx, dy, dz), 0).x);
}

// The texel beside the corner c of a cell, clamped to the field.
fn texel(c: vec3i, dx: i32, dy: i32, dz: i32) -> vec3i {
    return clamp(c + vec3i(dx, dy, dz), first_texel(), last_texel());
}

// Linear interpolation in a table over [0, 1].
fn lookup_density(channel: u32, x: f32) -> vec4f {
    let u = x * f32(TABLE_BINS);
    let i = min(u32(u), TABLE_BINS - 1u);
    let a = tables[channel].density[i];
    return a + (tables[channel].density[i + 1u] - a) * (u - f32(i));
}

fn lookup_integral(channel: u32, x: f32) -> vec4f {
    let u = x * f32(TABLE_BINS);
    let i = min(u32(u), TABLE_BINS - 1u);
    let a = tables[channel].integral[i];
    return a + (tables[channel].integral[i + 1u] - a) * (u - f32(i));
}

// a + (b − a)·t, in this form: the built-in mix may be evaluated in another.
fn lerp(a: f32, b: f32, t: f32) -> f32 {
    return a + (b - a) * t;
}

// Steps at or below this optical depth are dropped.
const TAU_MIN: f32 = 1e-7;
// Matter behind this transmittance is marched by strides.
const TRANSMITTANCE_HIDDEN: f32 = 1e-3;
// Units of a whole share of light.
const LIT_MAX: f32 = 255.0;
// There was nothing to take.
const NO_STEP: u32 = 0xffffffff;
// Lattice points of a stride.
const STRIDE: u32 = 2;
// Bound on the steps of one ray.
const MAX_STEPS: f32 = 65536.0;
