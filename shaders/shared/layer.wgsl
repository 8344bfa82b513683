// Segments, compositing and half floats. Twin of crates/core/src/layer.rs.
//
// Half floats are packed by integer arithmetic: the built-in functions may round either way and drop subnormals, and
// devices may flush subnormal floats.

// One segment, unpacked.
struct Segment {
    front: u32,
    back: u32,
    c: vec3f,
    tau: f32,
}

// The three packed words, in the order depth, c_rg, c_b_tau.
fn pack(segment: Segment) -> vec3u {
    return vec3u(
        segment.front | (segment.back << 16u),
        pack_halves(segment.c.x, segment.c.y),
        pack_halves(segment.c.z, min(segment.tau, TAU_MAX)),
    );
}

// Front-to-back compositing with over, premultiplied.
struct Over {
    c: vec3f,
    transmittance: f32,
}

fn over_identity() -> Over {
    return Over(vec3f(0.0), 1.0);
}

fn over_rgba(acc: Over) -> vec4f {
    return vec4f(acc.c, 1.0 - acc.transmittance);
}

// The colour, with its greatest channel as opacity.
fn projected_rgba(c: vec3f) -> vec4f {
    return vec4f(c, min(max(max(c.x, c.y), c.z), 1.0));
}

// The number that replaces τ for a key in [0, 1].
fn slot_from_key(key: f32) -> f32 {
    let bounded = clamp(key, KEY_LEAST, 1.0);
    return SLOT_MAX * (bounded * bounded * bounded);
}

fn key_from_slot(slot: f32) -> f32 {
    return pow(clamp(slot, 0.0, SLOT_MAX) * (1.0 / SLOT_MAX), 1.0 / 3.0);
}

// The greatest half float below a positive one.
fn half_below(x: f32) -> f32 {
    return f32_from_half(max(half_from_f32(x), 1u) - 1u);
}

// Converts view depth (world units) to a frame's 16-bit scale, unrounded and unclamped.
fn depth_to_units(camera: Basis, depth: f32) -> f32 {
    return (depth - camera.near) * (DEPTH_UNITS / (camera.far - camera.near));
}

fn pack_halves(lo: f32, hi: f32) -> u32 {
    return half_from_f32(lo) | (half_from_f32(hi) << 16u);
}

fn unpack_halves(word: u32) -> vec2f {
    return vec2f(f32_from_half(word & 0xffffu), f32_from_half(word >> 16u));
}

fn f32_from_half(h: u32) -> f32 {
    let bits = h & 0x7fffu;
    if (bits < 0x400u) {
        return f32(bits) * HALF_SUBNORMAL;
    }
    return bitcast<f32>((bits << 13u) + (112u << 23u));
}

fn half_from_f32(x: f32) -> u32 {
    let bounded = min(max(x, 0.0), HALF_MAX);
    if (bounded < HALF_NORMAL_MIN) {
        return u32(round(bounded / HALF_SUBNORMAL));
    }
    let scaled = bitcast<u32>(bounded) - (112u << 23u);
    return (scaled + 0xfffu + ((scaled >> 13u) & 1u)) >> 13u;
}

// Opacity of optical depth tau, accurate for small ones too (crates/core/src/kernels/raycast/pieces.rs).
fn opacity(tau: f32) -> f32 {
    if (tau < 0.01) {
        return tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0)));
    }
    return 1.0 - exp(-tau);
}

// Least key of a segment.
const KEY_LEAST: f32 = 0.005;
// The number that replaces τ for a key of 1.
const SLOT_MAX: f32 = 8.0;
// Greatest optical depth of a segment.
const TAU_MAX: f32 = 1000.0;
// Greatest colour that the wire carries.
const COLOR_MAX: f32 = 1.25;
// Depth units between near and far.
const DEPTH_UNITS: f32 = 65535.0;
// Greatest finite half float.
const HALF_MAX: f32 = 65504.0;
// A picture stops marching below this transmittance.
const TRANSMITTANCE_MIN: f32 = 1e-4;
// Least normal half float, 2^-14.
const HALF_NORMAL_MIN: f32 = 6.103515625e-5;
// Least positive half float, 2^-24.
const HALF_SUBNORMAL: f32 = 5.9604644775390625e-8;
