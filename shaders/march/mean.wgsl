// The integral of what is shown. Twin of `take` in crates/core/src/kernels/march/modes.rs.

fn take(between: Between) -> u32 {
    let classified = classify(0u, between.x0, between.x1, between.s1 - between.s0);
    if (classified.w <= 0.0) {
        return NO_STEP;
    }
    return sink_step(Step(classified.xyz * classified.w, 0.0, between.s0, between.s1, 0.0));
}

fn end_march(lattice: Lattice) {
}

// Positions are clamped to the domain.
const X_LEAST: f32 = 0.0;
const X_GREATEST: f32 = 1.0;
