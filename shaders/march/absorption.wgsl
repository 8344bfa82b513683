// Emission and absorption. Twin of `take` in crates/core/src/kernels/march/modes.rs.

fn take(between: Between) -> u32 {
    let classified = classify(0u, between.x0, between.x1, between.s1 - between.s0);
    let tau = classified.w;
    if (tau <= TAU_MIN) {
        return NO_STEP;
    }
    let alpha = opacity(tau);
    let p = between.line.origin + between.line.dir * (0.5 * (between.s0 + between.s1));
    let c = sent(classified.xyz, alpha, p, between.line.dir);
    return sink_step(Step(c, tau, between.s0, between.s1, alpha));
}

fn end_march(lattice: Lattice) {
}

// Positions are clamped to the domain.
const X_LEAST: f32 = 0.0;
const X_GREATEST: f32 = 1.0;
