// Novel views from several layered frames. Twin of crates/core/src/kernels/combine.rs; the derivation is there. Each frame
// is cast by raycast.wgsl, whose `caster` and planes are here those of one frame after the other.

@group(0) @binding(0) var<uniform> combination: Combination;
// Of each frame, the newest first, its two buffers: offsets and depths, from the first word and from `places.x`;
// occupied cells, e_rg, e_b_tau and summaries, from the first word, `places.y`, `places.z` and `places.w`.
@group(0) @binding(1) var<storage, read> lists_0: array<u32>;
@group(0) @binding(2) var<storage, read> matter_0: array<u32>;
@group(0) @binding(3) var<storage, read> lists_1: array<u32>;
@group(0) @binding(4) var<storage, read> matter_1: array<u32>;
@group(0) @binding(5) var<storage, read> lists_2: array<u32>;
@group(0) @binding(6) var<storage, read> matter_2: array<u32>;
@group(0) @binding(7) var<storage, read> lists_3: array<u32>;
@group(0) @binding(8) var<storage, read> matter_3: array<u32>;

// The frame that is cast.
var<private> layer: u32;
var<private> caster: Raycaster;
var<private> places: vec4u;

// Parts of a ray, in world distance, and the ray in the pixels of a frame's camera.
struct Parts {
    line: PixelLine,
    // Where the frame sees anything; empty if its end is not after its start.
    outer: vec2f,
    // Where its coverage is 1; empty likewise.
    inner: vec2f,
}

// Premultiplied colour and opacity seen along a ray of world space (`cast` and `cast_pieces` in the twin).
fn cast_ray(ray: Ray) -> Over {
    caster = combination.casters[0];
    var acc = identity();
    let clipped = clip_region(
        combination.bounds_min,
        combination.bounds_max,
        combination.clip_normal,
        combination.clip_offset,
        ray,
    );
    if (clipped.s1 <= clipped.s0) {
        return over_identity();
    }
    let whole = vec2f(clipped.s0, clipped.s1);
    var parts = array<Parts, MAX_FRAMES>();
    parts[0] = parts_of(0u, ray, whole);
    // What the newest frame sees all of it shows alone.
    let num = select(combination.num_frames, 1u, all(parts[0].inner == whole));
    for (var n = 1u; n < num; n++) {
        parts[n] = parts_of(n, ray, whole);
    }
    // A frame that is alone from one cut to the next is cast over both pieces at once.
    var alone = NONE;
    var piece = whole;
    var from_s = whole.x;
    loop {
        let is_done = from_s >= whole.y;
        var to = whole.y;
        for (var n = 0u; n < num; n++) {
            to = min(to, cut_after(parts[n], from_s, to));
        }
        let middle = 0.5 * (from_s + to);
        var first = NONE;
        var is_full = false;
        var has_others = false;
        for (var n = 0u; n < num && !is_done; n++) {
            if (!holds(parts[n].outer, middle)) {
                continue;
            }
            if (first == NONE) {
                first = n;
                is_full = holds(parts[n].inner, middle);
            } else {
                has_others = true;
            }
        }
        let next = select(first, MIXED, has_others && !is_full);
        if (next < MIXED && next == alone) {
            piece.y = to;
        } else {
            if (alone != NONE) {
                add(&acc, ray, &parts, alone, piece);
            }
            alone = next;
            piece = vec2f(from_s, to);
        }
        if (is_done || ends_cast(acc)) {
            break;
        }
        from_s = to;
    }
    return shown(acc, ray);
}

fn parts_of(n: u32, ray: Ray, whole: vec2f) -> Parts {
    let basis = combination.casters[n].basis;
    let line = pixel_line(basis, ray);
    return Parts(line, clip_inset(n, line, 0.0, whole), clip_inset(n, line, band_of(n), whole));
}

// The part of `within` that lies at least `inset` pixels inside the frustum of a frame.
fn clip_inset(n: u32, line: PixelLine, inset: f32, within: vec2f) -> vec2f {
    let o = line.o;
    let d = line.d;
    let right = combination.casters[n].basis.width - inset;
    let bottom = combination.casters[n].basis.height - inset;
    let near = combination.casters[n].basis.near;
    var planes = array<vec2f, 5>(
        vec2f(line.depth.x - near, line.depth.y),
        vec2f(o.x - inset * o.z, d.x - inset * d.z),
        vec2f(right * o.z - o.x, right * d.z - d.x),
        vec2f(o.y - inset * o.z, d.y - inset * d.z),
        vec2f(bottom * o.z - o.y, bottom * d.z - d.y),
    );
    var s = within;
    for (var i = 0u; i < 5u; i++) {
        // Inside where a + b·s ≥ 0.
        let a = planes[i].x;
        let b = planes[i].y;
        if (b > 0.0) {
            s.x = max(s.x, -a / b);
        } else if (b < 0.0) {
            s.y = min(s.y, -a / b);
        } else if (a < 0.0) {
            return s.yy;
        }
    }
    return s;
}

// Lists from the border on which a frame's coverage grows to 1.
fn band_of(n: u32) -> f32 {
    return select(BAND, combination.band, n == 0u);
}

fn holds(part: vec2f, s: f32) -> bool {
    return part.x < part.y && part.x <= s && s <= part.y;
}

// The first end of a frame's parts behind a distance, or `otherwise`.
fn cut_after(parts: Parts, s: f32, otherwise: f32) -> f32 {
    if (parts.outer.x >= parts.outer.y) {
        return otherwise;
    }
    let outer = min(select(otherwise, parts.outer.x, parts.outer.x > s), select(otherwise, parts.outer.y, parts.outer.y > s));
    if (parts.inner.x >= parts.inner.y) {
        return outer;
    }
    let inner = min(select(otherwise, parts.inner.x, parts.inner.x > s), select(otherwise, parts.inner.y, parts.inner.y > s));
    return min(outer, inner);
}

// Pixels from the nearest border, at most the band and at least 0.
fn inset_at(n: u32, part: Parts, s: f32) -> f32 {
    let basis = combination.casters[n].basis;
    let h = part.line.o + part.line.d * s;
    if (part.outer.x >= part.outer.y || part.line.depth.x + part.line.depth.y * s < basis.near) {
        return 0.0;
    }
    let p = h.xy / h.z;
    let nearest = min(min(p.x, basis.width - p.x), min(p.y, basis.height - p.y));
    return clamp(nearest, 0.0, band_of(n));
}

// Puts a piece behind what is there: of the frame that is alone in it, or MIXED, in steps of about a list. There is one
// call of the caster for both: devices in software compile each, and that takes them seconds.
fn add(acc: ptr<function, Over>, ray: Ray, parts: ptr<function, array<Parts, MAX_FRAMES>>, alone: u32, piece: vec2f) {
    var change = 0.0;
    for (var n = 0u; n < combination.num_frames && alone == MIXED; n++) {
        change = max(change, abs(inset_at(n, (*parts)[n], piece.x) - inset_at(n, (*parts)[n], piece.y)));
    }
    let steps = clamp(ceil(change), 1.0, BAND);
    for (var i = 0.0; i < steps; i += 1.0) {
        let step = mix(piece.xx, piece.yy, vec2f(i, i + 1.0) / steps);
        var weights = array<f32, MAX_FRAMES>();
        var rest = 1.0;
        for (var n = 0u; n < combination.num_frames; n++) {
            let part = (*parts)[n];
            // The newest frame's band can have no width: then all that it sees is covered.
            var covered = select(0.0, 1.0, part.outer.x < part.outer.y);
            if (alone != MIXED) {
                covered = select(0.0, 1.0, n == alone);
            } else if (band_of(n) > 0.0) {
                covered = inset_at(n, part, 0.5 * (step.x + step.y)) / band_of(n);
            }
            weights[n] = rest * covered;
            rest -= weights[n];
        }
        let sum = 1.0 - rest;
        if (sum <= 0.0) {
            continue;
        }
        let is_over = COMPOSITING == BY_OVER;
        var tau = 0.0;
        var light = vec3f(0.0);
        for (var n = 0u; n < combination.num_frames; n++) {
            if (weights[n] <= LEAST_WEIGHT) {
                continue;
            }
            let seen = cast_between(n, ray, step);
            if (alone != MIXED) {
                put(acc, vec4f(seen.c, select(seen.transmittance, 1.0 - seen.transmittance, is_over)));
            } else if (!is_over) {
                tau += weights[n] / sum * seen.transmittance;
                light += seen.c * (weights[n] / sum);
            } else if (seen.transmittance < 1.0) {
                // Where nothing can be seen through, casting stops: how much more there is was not looked at.
                let tau_n = -log(max(seen.transmittance, TRANSMITTANCE_MIN));
                tau += weights[n] / sum * tau_n;
                light += seen.c * (weights[n] / sum * tau_n / (1.0 - seen.transmittance));
            }
        }
        if (alone == MIXED && !is_over) {
            put(acc, vec4f(light, tau));
        } else if (tau > 0.0) {
            put(acc, vec4f(light * (opacity(tau) / tau), opacity(tau)));
        }
    }
}

// Premultiplied colour and opacity that one frame shows between two world distances from the ray's origin.
fn cast_between(n: u32, ray: Ray, within: vec2f) -> Over {
    layer = n;
    caster = combination.casters[n];
    places = combination.places[n];
    var acc = identity();
    let line = clip(ray, within);
    if (line.hit) {
        walk(line, &acc);
    }
    return acc;
}

fn depth_at(i: u32) -> u32 {
    return lists_word(places.x + i);
}

fn occupied_at(i: i32) -> u32 {
    return matter_word(u32(i));
}

fn e_rg_at(i: u32) -> u32 {
    return matter_word(places.y + i);
}

fn e_b_tau_at(i: u32) -> u32 {
    return matter_word(places.z + i);
}

fn summary_at(list: u32) -> vec4u {
    let i = places.w + 4u * list;
    return vec4u(matter_word(i), matter_word(i + 1u), matter_word(i + 2u), matter_word(i + 3u));
}

fn lists_word(i: u32) -> u32 {
    switch (layer) {
        case 1u: { return lists_1[i]; }
        case 2u: { return lists_2[i]; }
        case 3u: { return lists_3[i]; }
        default: { return lists_0[i]; }
    }
}

fn matter_word(i: u32) -> u32 {
    switch (layer) {
        case 1u: { return matter_1[i]; }
        case 2u: { return matter_2[i]; }
        case 3u: { return matter_3[i]; }
        default: { return matter_0[i]; }
    }
}

// No frame.
const NONE: u32 = 0xffffffff;
// Several frames.
const MIXED: u32 = 0xfffffffe;
// Width of the band in which frames are mixed, lists.
const BAND: f32 = 8.0;
// A frame with less weight is left out.
const LEAST_WEIGHT: f32 = 1e-3;
