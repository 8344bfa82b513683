// Cuts at equal distances between the first and the last content; two marches. Twin of
// crates/core/src/kernels/layering/equal_length.rs. The part before this one is cuts.wgsl.

// March 1: where the content of a ray begins and ends.
struct Extent {
    s_first: f32,
    s_last: f32,
    transmittance: f32,
}

var<private> extent: Extent;
// Which of the two sinks the march feeds.
var<private> cutting: bool;

fn generate_list(ray: Ray, lattice: Lattice) {
    extent = Extent(OUT_OF_REACH, 0.0, 1.0);
    cutting = false;
    march(ray, lattice);
    let length = (extent.s_last - extent.s_first) / f32(K);
    if (length <= 0.0) {
        return;
    }
    cuts_begin(extent.s_first, length, true);
    cutting = true;
    march(ray, lattice);
    close();
}

fn sink_step(step: Step) -> u32 {
    if (cutting) {
        return cuts_step(step);
    }
    return extent_step(step);
}

fn extent_step(step: Step) -> u32 {
    extent.s_first = min(extent.s_first, step.s0);
    extent.s_last = step.s1;
    extent.transmittance *= 1.0 - step.alpha;
    return pace_behind(extent.transmittance);
}

// More than any distance.
const OUT_OF_REACH: f32 = 3e38;
