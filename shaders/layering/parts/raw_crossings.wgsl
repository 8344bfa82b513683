// Crossings of surfaces as steps (steps.wgsl). They end at infinity: at the positive one where values rise.

fn crossing(step: Step, to_greater: bool, lattice: Lattice) -> u32 {
    put_step(step, select(0xff800000u, 0x7f800000u, to_greater));
    return 1u;
}

fn end_march(lattice: Lattice) {
}
