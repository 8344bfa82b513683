// From the lengths of lists to their offsets, by a prefix sum: sum_blocks (a workgroup a block of lists), then scan_blocks
// (one workgroup). Integer sums in a fixed order: offsets do not depend on scheduling. Another part says how long lists
// are (`count`), how many there are (`num_lists`), and how many segments are in front of them (`segments_before`).

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
    let num_blocks = (num_lists() + BLOCK - 1u) / BLOCK;
    let per_invocation = (num_blocks + BLOCK - 1u) / BLOCK;
    let first = min(local * per_invocation, num_blocks);
    let after = min(first + per_invocation, num_blocks);
    var own = 0u;
    for (var i = first; i < after; i++) {
        own += block_sums[i];
    }
    var before = segments_before() + inclusive_sum(local, own) - own;
    for (var i = first; i < after; i++) {
        let in_block = block_sums[i];
        block_sums[i] = before;
        before += in_block;
    }
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
