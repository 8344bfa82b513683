// All steps of a ray, from which the frame's threshold follows. Twin of RawStep.
//
// Before this part stands a generated line: const HIDES: bool, whether matter hides what is behind it.

const ITEM_WORDS: u32 = 7u;

var<private> transmittance: f32;

fn gather_items(ray: Ray, lattice: Lattice) {
    transmittance = 1.0;
    march(ray, lattice);
}

fn sink_step(step: Step) -> u32 {
    put_step(step, bitcast<u32>(step.s1));
    if HIDES {
        transmittance *= 1.0 - step.alpha;
    }
    return pace_behind(transmittance);
}

fn put_step(step: Step, s1_bits: u32) {
    put_word(0u, bitcast<u32>(step.s0));
    put_word(1u, s1_bits);
    put_word(2u, bitcast<u32>(step.c.x));
    put_word(3u, bitcast<u32>(step.c.y));
    put_word(4u, bitcast<u32>(step.c.z));
    put_word(5u, bitcast<u32>(step.tau));
    put_word(6u, bitcast<u32>(step.alpha));
    end_item();
}
