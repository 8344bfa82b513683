// One cost at which all rays of a frame stop joining: crates/core/src/kernels/layering/visibility_merge.rs derives it.
//
// The part after it gathers a ray in pieces, says how many there are, and joins them:
//   fn gather(ray: Ray, lattice: Lattice, tolerance: f32)
//   fn num_gathered() -> u32
//   fn join(most: u32, threshold: f32, is_sample: bool)

struct Budget {
    num_lists: atomic<u32>,
    num_pieces: atomic<u32>,
    threshold: f32,
    // Segments that a list may have on average, and at most. In a buffer, so that other numbers need no other kernel.
    mean_k: u32,
    longest: u32,
    // Joins of the sample by the bin of their cost.
    joins: array<atomic<u32>, COST_BINS>,
}

@group(1) @binding(4) var<storage, read_write> budget: Budget;

// The cost up to which steps are merged at once, where rays stop joining at `threshold`.
fn tolerance_from(threshold: f32) -> f32 {
    if budget.mean_k < TOLERANT_K {
        return 0.0;
    }
    return threshold * TOLERANCE_SHARE;
}

// A join of a ray of the sample.
fn count_join(cost: f32) {
    atomicAdd(&budget.joins[bitcast<u32>(cost) >> BIN_SHIFT], 1u);
}

// Every so many pixels along each axis one is of the sample: as many that at least SAMPLE_RAYS are, but no fewer than 4.
fn sample_stride(width: u32, height: u32) -> u32 {
    var stride = 4u;
    while ((stride + 1u) * (stride + 1u) * SAMPLE_RAYS <= width * height) {
        stride += 1u;
    }
    return stride;
}

// One ray of the sample: what the joins cost.
@compute @workgroup_size(8, 8)
fn sample_budget(@builtin(global_invocation_id) id: vec3u) {
    let width = u32(camera.width);
    let height = u32(camera.height);
    let stride = sample_stride(width, height);
    let x = id.x * stride + min(stride / 2u, width / 2u);
    let y = (band.first_row + id.y) * stride + min(stride / 2u, height / 2u);
    if (x >= width || y >= height || id.y >= band.num_rows) {
        return;
    }
    let from_camera = basis_ray(camera, f32(x) + 0.5, f32(y) + 0.5);
    let lattice = scene_lattice(from_camera.ray, camera.near * from_camera.s_per_depth);
    if (lattice.n == 0u) {
        return;
    }
    gather(from_camera.ray, lattice, 0.0);
    if (num_gathered() == 0u) {
        return;
    }
    atomicAdd(&budget.num_lists, 1u);
    atomicAdd(&budget.num_pieces, num_gathered());
    join(1u, INFINITE_COST, true);
}

// Joins of each part of the bins.
var<workgroup> joins_of_part: array<u32, NUM_PARTS>;

// The least lower end of a bin such that joins below it leave at most mean_k segments a list. Every invocation adds up a part
// of the bins, so that the one that looks for the bin waits for memory in one part only.
@compute @workgroup_size(NUM_PARTS)
fn choose_threshold(@builtin(local_invocation_index) part: u32) {
    var sum = 0u;
    for (var i = 0u; i < BINS_OF_PART; i++) {
        sum += atomicLoad(&budget.joins[part * BINS_OF_PART + i]);
    }
    joins_of_part[part] = sum;
    workgroupBarrier();
    if (part > 0u) {
        return;
    }
    let allowed = atomicLoad(&budget.num_lists) * budget.mean_k;
    var left = atomicLoad(&budget.num_pieces);
    var bin = 0u;
    while (bin < COST_BINS && left > allowed + joins_of_part[bin / BINS_OF_PART]) {
        left -= joins_of_part[bin / BINS_OF_PART];
        bin += BINS_OF_PART;
    }
    while (left > allowed && bin < COST_BINS) {
        left -= atomicLoad(&budget.joins[bin]);
        bin += 1u;
    }
    budget.threshold = bitcast<f32>(bin << BIN_SHIFT);
}

// Costs below this are equal.
const COST_LEAST: f32 = 1e-20;
// Surfaces can lie at one place. Optical depths over this length are finite.
const LENGTH_LEAST: f32 = 1e-30;
// More than any cost: WGSL has no infinity.
const INFINITE_COST: f32 = 3.4e38;
// Rays that say enough of a frame.
const SAMPLE_RAYS: u32 = 2048;
// Bits of a float left out in the number of its bin: 1/32 of an octave each.
const BIN_SHIFT: u32 = 18;
// Bins of all finite costs.
const COST_BINS: u32 = 8192;
// Bins are added up in so many parts of so many.
const NUM_PARTS: u32 = 256;
const BINS_OF_PART: u32 = 32;
// See tolerance_from.
const TOLERANCE_SHARE: f32 = 0.15;
const TOLERANT_K: u32 = 12u;
