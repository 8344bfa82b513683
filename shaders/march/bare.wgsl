// A rendering composites surfaces without thickness.

fn crossing(step: Step, to_greater: bool, lattice: Lattice) -> u32 {
    return sink_step(step);
}

fn end_march(lattice: Lattice) {
}
