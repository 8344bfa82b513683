// What is seen along a ray with over. Twin of OverSink in crates/core/src/kernels/march.rs.
//
// The part before this one defines STOP_AT: the march stops when no more than that of what is behind can be seen.

var<private> over_sink: Over;

fn sink_step(step: Step) -> u32 {
    over_sink.c += step.c * over_sink.transmittance;
    over_sink.transmittance *= 1.0 - step.alpha;
    return select(0u, 1u, over_sink.transmittance > STOP_AT);
}

// Premultiplied colour and transmittance.
fn collected(ray: Ray, lattice: Lattice) -> vec4f {
    over_sink = over_identity();
    march(ray, lattice);
    return vec4f(over_sink.c, over_sink.transmittance);
}

fn shown(collected: vec4f, lattice: Lattice) -> vec4f {
    return over_rgba(Over(collected.xyz, collected.w));
}

// Nothing is beaten by what is in front of it.
fn is_beaten(brick: u32) -> bool {
    return false;
}
