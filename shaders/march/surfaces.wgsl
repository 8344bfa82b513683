// Surfaces with thickness. Twin of crates/core/src/kernels/march/surfaces.rs, which says why.

// The last crossing; its matter begins at step.s0.
struct Pending {
    step: Step,
    place: f32,
    // Whether the matter is behind the place.
    enters: bool,
    is_there: bool,
}

var<private> pending: Pending;

fn crossing(step: Step, to_greater: bool, lattice: Lattice) -> u32 {
    let place = step.s0;
    let enters = to_greater != (tables[0].has_lesser_bodies != 0u);
    let thickness = THICKNESS_IN_VOXELS * voxel_length();
    let reach = select(thickness, UNBOUNDED, step.tau > OPAQUE_TAU);
    var pace = 1u;
    // An opaque body that the ray begins in would hide what is in it.
    var before = max(place - min(reach, thickness), lattice.s0);
    if (pending.is_there) {
        let both = pending.enters && !enters;
        let border = select(place, 0.5 * (pending.place + place), both);
        pace = hand_on(border);
        before = max(place - reach, select(pending.place, border, both));
    }
    pending = Pending(step, place, enters, pace != 0u);
    pending.step.s0 = select(before, place, enters);
    // No strides: a thin sheet would be stepped over.
    return min(pace, 1u);
}

// `most` bounds what is behind the place.
fn hand_on(most: f32) -> u32 {
    var step = pending.step;
    let voxel = voxel_length();
    let reach = select(THICKNESS_IN_VOXELS * voxel, UNBOUNDED, step.tau > OPAQUE_TAU);
    let back = select(pending.place, pending.place + reach, pending.enters);
    step.s1 = max(min(back, most), step.s0);
    if (step.tau > OPAQUE_TAU) {
        // So dense that a voxel of it is opaque.
        let denser = max((step.s1 - step.s0) / voxel, 1.0);
        let alpha = opacity(step.tau * denser);
        step.c *= alpha / step.alpha;
        step.tau *= denser;
        step.alpha = alpha;
    }
    pending.is_there = false;
    return sink_step(step);
}

fn end_march(lattice: Lattice) {
    if (pending.is_there) {
        let end = lattice.s0 + lattice.h * f32(lattice.n);
        let pace = hand_on(end);
    }
}

// The least spacing, world units.
fn voxel_length() -> f32 {
    return 1.0 / max(max(scene.voxel_from_world.x, scene.voxel_from_world.y), scene.voxel_from_world.z);
}

// Optical depth above which a crossing is opaque.
const OPAQUE_TAU: f32 = 8.0;
// What translucent surfaces have.
const THICKNESS_IN_VOXELS: f32 = 2.0;
// More than any distance.
const UNBOUNDED: f32 = 3e38;
