// What a projection shows of a ray: the mean. Twin of Shown in crates/core/src/kernels/march/modes.rs.

var<private> integral: vec3f;

fn sink_step(step: Step) -> u32 {
    integral += step.c;
    return 1u;
}

// The integral, and no key.
fn collected(ray: Ray, lattice: Lattice) -> vec4f {
    integral = vec3f(0.0);
    march(ray, lattice);
    return vec4f(integral, -1.0);
}

fn shown(collected: vec4f, lattice: Lattice) -> vec4f {
    if (lattice.n == 0u) {
        return vec4f(0.0);
    }
    return projected_rgba(collected.xyz / (lattice.h * f32(lattice.n)));
}

// Nothing is beaten by what is in front of it.
fn is_beaten(brick: u32) -> bool {
    return false;
}
