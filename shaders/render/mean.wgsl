// What a projection shows of a ray: the mean. Twin of Shown in crates/core/src/kernels/march/modes.rs.

var<private> integral: vec3f;

fn sink_step(step: Step) -> u32 {
    integral += step.c;
    return 1u;
}

fn seen(ray: Ray, lattice: Lattice) -> vec4f {
    integral = vec3f(0.0);
    march(ray, lattice);
    if (lattice.n == 0u) {
        return vec4f(0.0);
    }
    return projected_rgba(integral / (lattice.h * f32(lattice.n)));
}

// Nothing is beaten by what is in front of it.
fn is_beaten(brick: u32) -> bool {
    return false;
}
