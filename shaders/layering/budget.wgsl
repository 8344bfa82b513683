// The threshold that spends a frame's budget. Twin of crates/core/src/kernels/layering/budget.rs, which derives it.
//
// The part after this one is stream.wgsl. An invocation counts one ray at one threshold.

struct Budget {
    num_lists: atomic<u32>,
    // Error limit of a segment.
    threshold: f32,
    // The least counted threshold, and the ratio of successive ones.
    least: f32,
    ratio: f32,
    // Mean and greatest number of segments per list. They are in a buffer, so that no other kernel is needed for
    // other numbers.
    mean_k: u32,
    longest: u32,
    // Segments of the counted rays at each threshold.
    counts: array<atomic<u32>, NUM_THRESHOLDS>,
}

@group(1) @binding(4) var<storage, read_write> budget: Budget;

// The distance of counted pixels along each axis.
fn sample_stride(width: u32, height: u32) -> u32 {
    var stride = 4u;
    while ((stride + 1u) * (stride + 1u) * SAMPLE_RAYS <= width * height) {
        stride += 1u;
    }
    return stride;
}

@compute @workgroup_size(8, 4)
fn count(
    @builtin(global_invocation_id) id: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let width = u32(camera.width);
    let height = u32(camera.height);
    let stride = sample_stride(width, height);
    let x = id.x * stride + min(stride / 2u, width / 2u);
    let y = id.y * stride + min(stride / 2u, height / 2u);
    if (x >= width || y >= height) {
        return;
    }
    let from_camera = basis_ray(camera, f32(x) + 0.5, f32(y) + 0.5);
    let lattice = scene_lattice(from_camera.ray, camera.near * from_camera.s_per_depth);
    if (lattice.n == 0u) {
        return;
    }
    begin_list(0u, lane, from_camera.s_per_depth, true);
    list_at(budget.least * pow(budget.ratio, f32(id.z)), from_camera.ray, lattice);
    if (out.len > 0u) {
        atomicAdd(&budget.counts[id.z], out.len);
        if (id.z == 0u) {
            atomicAdd(&budget.num_lists, 1u);
        }
    }
}

// After the first count: the thresholds to count again. After the second: the threshold.
@compute @workgroup_size(1)
fn choose() {
    let wanted = f32(max(atomicLoad(&budget.num_lists) * budget.mean_k, 1u));
    // The last threshold with more segments, and the counts there and at the next.
    var last = 0u;
    var more = max(f32(atomicLoad(&budget.counts[0])), 1.0);
    var less = more;
    for (var i = 0u; i < NUM_THRESHOLDS; i++) {
        let num = f32(atomicLoad(&budget.counts[i]));
        if (num > wanted) {
            last = i;
            more = num;
            less = num;
        } else if (i == last + 1u) {
            less = max(num, 1.0);
        }
    }
    if (budget.ratio == FIRST_RATIO) {
        budget.least *= pow(FIRST_RATIO, f32(min(last, NUM_THRESHOLDS - 2u)));
        budget.ratio = SECOND_RATIO;
        atomicStore(&budget.num_lists, 0u);
        for (var i = 0u; i < NUM_THRESHOLDS; i++) {
            atomicStore(&budget.counts[i], 0u);
        }
        return;
    }
    let part = saturate(log(more / wanted) / max(log(more / less), LOGARITHM_LEAST));
    budget.threshold = budget.least * pow(SECOND_RATIO, min(f32(last) + part, f32(NUM_THRESHOLDS - 1u)));
}

// Thresholds counted at once.
const NUM_THRESHOLDS: u32 = 8;
// Ratio of successive thresholds in the first and in the second count.
const FIRST_RATIO: f32 = 16.0;
const SECOND_RATIO: f32 = 1.4859943;
// Number of rays that represent a frame.
const SAMPLE_RAYS: u32 = 2048;
// Least difference of logarithms that is divided by.
const LOGARITHM_LEAST: f32 = 1e-6;
