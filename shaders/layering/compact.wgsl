// From slots to planes: list lengths become offsets by a prefix sum, and the lists of a band move to their places. The
// serial twin is the loop over rows in crates/core/src/kernels/layering/mod.rs.
//
// Three dispatches a band: sum_blocks (a workgroup a block of lists), scan_blocks (one workgroup), compact (a workgroup
// a block). Integer sums in a fixed order: the planes do not depend on scheduling. The base of a band is the last
// offset of the band before it.

@group(0) @binding(0) var<uniform> band: Band;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
// Number of segments in each block; after scan_blocks, the number in the frame before it.
@group(0) @binding(3) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(5) var<storage, read_write> depth: array<u32>;
@group(0) @binding(6) var<storage, read_write> c_rg: array<u32>;
@group(0) @binding(7) var<storage, read_write> c_b_tau: array<u32>;

var<workgroup> sums: array<u32, BLOCK>;

@compute @workgroup_size(BLOCK)
fn sum_blocks(
    @builtin(workgroup_id) block: vec3u,
    @builtin(global_invocation_id) id: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let total = inclusive_sum(local, count(id.x));
    if (local == BLOCK - 1u) {
        block_sums[block.x] = total;
    }
}

@compute @workgroup_size(BLOCK)
fn scan_blocks(@builtin(local_invocation_index) local: u32) {
    let num_blocks = (band.num_pixels + BLOCK - 1u) / BLOCK;
    let per_invocation = (num_blocks + BLOCK - 1u) / BLOCK;
    let first = min(local * per_invocation, num_blocks);
    let after = min(first + per_invocation, num_blocks);
    var own = 0u;
    for (var i = first; i < after; i++) {
        own += block_sums[i];
    }
    var before = offsets[band.first_pixel] + inclusive_sum(local, own) - own;
    for (var i = first; i < after; i++) {
        let in_block = block_sums[i];
        block_sums[i] = before;
        before += in_block;
    }
}

@compute @workgroup_size(BLOCK)
fn compact(
    @builtin(workgroup_id) block: vec3u,
    @builtin(global_invocation_id) id: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let len = count(id.x);
    let end = block_sums[block.x] + inclusive_sum(local, len);
    if (id.x >= band.num_pixels) {
        return;
    }
    offsets[band.first_pixel + id.x + 1u] = end;
    let start = end - len;
    // A frame that does not fit is made again with longer segments.
    if (end > arrayLength(&depth)) {
        return;
    }
    for (var j = 0u; j < len; j++) {
        depth[start + j] = slots[3u * j * band.num_pixels + id.x];
        c_rg[start + j] = slots[(3u * j + 1u) * band.num_pixels + id.x];
        c_b_tau[start + j] = slots[(3u * j + 2u) * band.num_pixels + id.x];
    }
}

fn count(i: u32) -> u32 {
    if (i >= band.num_pixels) {
        return 0u;
    }
    return counts[i];
}

// Sum of `value` over the invocations up to this one (Hillis & Steele 1986).
fn inclusive_sum(local: u32, value: u32) -> u32 {
    sums[local] = value;
    workgroupBarrier();
    for (var reach = 1u; reach < BLOCK; reach <<= 1u) {
        var sum = sums[local];
        if (local >= reach) {
            sum += sums[local - reach];
        }
        workgroupBarrier();
        sums[local] = sum;
        workgroupBarrier();
    }
    return sums[local];
}

// Lists that a workgroup sums.
const BLOCK: u32 = 256;
