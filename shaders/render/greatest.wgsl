// What a projection shows of a ray: the greatest key. Twin of Shown in crates/core/src/kernels/march/modes.rs.

var<private> greatest: f32;

fn sink_step(step: Step) -> u32 {
    greatest = max(greatest, step.tau);
    return 1u;
}

// The key comes last; negative where there is nothing.
fn collected(ray: Ray, lattice: Lattice) -> vec4f {
    greatest = -1.0;
    march(ray, lattice);
    return vec4f(0.0, 0.0, 0.0, greatest);
}

fn shown(collected: vec4f, lattice: Lattice) -> vec4f {
    if (collected.w < 0.0) {
        return vec4f(0.0);
    }
    return projected_rgba(shown_of_key(collected.w));
}

// Whether no key of a brick is above the greatest so far.
fn is_beaten(brick: u32) -> bool {
    return f32(occupancy_byte(1u, brick)) * (1.0 / PEAK_MAX) <= greatest;
}

// Units of the greatest key.
const PEAK_MAX: f32 = 255.0;
