// The keys of the greatest or the least value. Twin of `take` and `Values` in crates/core/src/kernels/march/modes.rs.
//
// Before this part stands a generated line: const IS_LEAST: bool.

fn take(between: Between) -> u32 {
    let y0 = key_of(between.x0);
    let y1 = key_of(between.x1);
    let peak = max(y0, y1);
    if (peak <= tables[0].key_limit) {
        return NO_STEP;
    }
    let square = (y0 * y0 + y0 * y1 + y1 * y1) * (1.0 / 3.0);
    return sink_step(Step(vec3f(square, 0.0, 0.0), peak, between.s0, between.s1, 0.5 * (y0 + y1)));
}

// The key of a position, and the other way round.
fn key_of(x: f32) -> f32 {
    if IS_LEAST {
        return 1.0 - x;
    }
    return x;
}

// Linear colour that is shown of a key.
fn shown_of_key(key: f32) -> vec3f {
    return lookup_density(0u, key_of(clamp(key, 0.0, 1.0))).xyz;
}

fn end_march(lattice: Lattice) {
}

// Positions are clamped to the domain.
const X_LEAST: f32 = 0.0;
const X_GREATEST: f32 = 1.0;
