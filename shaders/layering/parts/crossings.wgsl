// Bare crossings of surfaces: their place, optical depth and colour, and whether values rise. Twin of CrossingForm.

const ITEM_WORDS: u32 = 4u;

fn gather_items(ray: Ray, lattice: Lattice) {
    march(ray, lattice);
}

fn crossing(step: Step, to_greater: bool, lattice: Lattice) -> u32 {
    put_word(0u, bitcast<u32>(step.s0));
    put_word(1u, bitcast<u32>(step.tau));
    put_word(2u, pack_halves(step.c.x, step.c.y));
    put_word(3u, pack_halves(step.c.z, 0.0) | select(0u, 0x10000u, to_greater));
    end_item();
    return 1u;
}

fn end_march(lattice: Lattice) {
}
