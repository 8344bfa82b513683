// From slots to planes: list lengths become offsets by a prefix sum, and the lists of a band move to their places. The
// serial twin is the loop over rows in crates/core/src/kernels/layering/mod.rs.
//
// Three dispatches a band: those of `offsets.wgsl`, then compact (a workgroup a block). The base of a band is the last
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

fn num_lists() -> u32 {
    return band.num_pixels;
}

fn segments_before() -> u32 {
    return offsets[band.first_pixel];
}
