// A march through several channels at once, and through labels. Twin of crates/core/src/kernels/march/mixed.rs; the
// derivations are there.
//
// Before this part stand march/channel.wgsl, once for each channel but the first, and generated lines:
//   const IS_OVER: bool, whether media mix and light does not add up;
//   fn at_point(p: vec3f) -> At
//   fn mixed_between(x0: At, x1: At, h: f32) -> Mixed
// which read and classify each channel by its number. So no array is indexed by a variable.

// A sample: the position of each channel in its transfer function's domain.
struct At {
    a: vec4f,
    b: vec4f,
}

// What the channels of a step come to.
struct Mixed {
    // Sum of colour times optical depth.
    color: vec3f,
    // Sum and greatest of the optical depths.
    total: f32,
    greatest: f32,
}

fn with_channel(mixed: Mixed, part: vec4f) -> Mixed {
    return Mixed(mixed.color + part.xyz * part.w, mixed.total + part.w, max(mixed.greatest, part.w));
}

fn take(between: Between) -> u32 {
    let mixed = mixed_between(between.x0, between.x1, between.s1 - between.s0);
    let tau = select(mixed.greatest, mixed.total, IS_OVER);
    if (tau <= TAU_MIN) {
        return NO_STEP;
    }
    let alpha = opacity(tau);
    let p = between.line.origin + between.line.dir * (0.5 * (between.s0 + between.s1));
    let c = sent(min(mixed.color / tau, vec3f(1.0)), alpha, p, between.line.dir);
    return sink_step(Step(c, tau, between.s0, between.s1, alpha));
}

// The position of a stored label of a channel: its node. Many labels share the nodes from 1 on.
fn label_position(channel: u32, stored: f32) -> f32 {
    let x = stored * tables[channel].x_scale + tables[channel].x_offset;
    let label = u32(max(x * f32(TABLE_BINS) + 0.5, 0.0));
    let folded = select((label - 1u) % (LABEL_NODES - 1u) + 1u, 0u, label == 0u);
    return f32(folded) * (1.0 / f32(TABLE_BINS));
}

// Colour (not premultiplied) and, in w, optical depth of a step of length h between two labels.
fn classify_labels(channel: u32, x0: f32, x1: f32, h: f32) -> vec4f {
    let sum = tables[channel].density[u32(x0 * f32(TABLE_BINS))] + tables[channel].density[u32(x1 * f32(TABLE_BINS))];
    if (sum.w <= 0.0) {
        return vec4f(0.0);
    }
    return vec4f(sum.xyz / sum.w, 0.5 * sum.w * h);
}

fn end_march(lattice: Lattice) {
}

// Positions are clamped to the domain.
const X_LEAST: f32 = 0.0;
const X_GREATEST: f32 = 1.0;
// Labels with a node of their own.
const LABEL_NODES: u32 = 1024;
