// Multiplies the colours of the cells of corrected lists, so that these composite to what they should (twin of
// crates/core/src/codec/blocks/corrections.rs). A workgroup has a block, an invocation a list.

@group(0) @binding(0) var<uniform> frame: BlockFrame;
@group(0) @binding(1) var<storage, read> pictures: array<u32>;
@group(0) @binding(2) var<storage, read_write> after: array<u32>;

@compute @workgroup_size(64)
fn factors(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let block = group.x + groups.x * group.y;
    if (block >= frame.num_blocks.x * frame.num_blocks.y || pictures[block] == 0u) {
        return;
    }
    let picture = picture_at(block, lane);
    let found = vec3u(pictures[picture] & 0xffffu, pictures[picture] >> 16u, pictures[picture + 1u] & 0xffffu);
    let roots = vec3i(i32(pictures[picture + 2u]), i32(pictures[picture + 3u]), i32(pictures[picture + 4u]));
    let wanted = vec3u(max(roots, vec3i(0)));
    let by = vec3i(clamp(quotients(wanted, found), vec3u(ONE / 2u), vec3u(ONE * 2u)));
    if (all(by == vec3i(i32(ONE)))) {
        return;
    }
    let first = after[WORDS_OF_BLOCK * block + 1u];
    let end = first + num_layers_of(after[WORDS_OF_BLOCK * block]);
    for (var i = first; i < end; i++) {
        let layer = frame.first_layer + WORDS_OF_LAYER * i;
        let mask = vec2u(after[layer + 6u], after[layer + 7u]);
        if (!bit_of(mask, lane)) {
            continue;
        }
        let cell = frame.first_cell + WORDS_OF_CELL * (after[layer + 9u] + rank(mask, lane));
        let u_y = after[cell + 1u];
        let co_cg = after[cell + 2u];
        let own = cell_roots(vec3i(i16_at(u_y, 1u), i16_at(co_cg, 0u), i16_at(co_cg, 1u)));
        let changed = min((own * by) >> vec3u(12u), vec3i(4 * MAX_ROOT));
        let r = changed.x;
        let g = changed.y;
        let b = changed.z;
        after[cell + 1u] = (u_y & 0xffffu) | (u32((r + 2 * g + b + 8) >> 4u) << 16u);
        after[cell + 2u] = two_halves((r - b + 4) >> 3u, (2 * g - r - b + 8) >> 4u);
    }
}

// The factors in units of 2⁻¹⁴. What is wanted has up to 19 bits, so that much is divided at a time.
fn quotients(wanted: vec3u, found: vec3u) -> vec3u {
    let high = (wanted << vec3u(12u)) / found;
    let rest = (wanted << vec3u(12u)) - high * found;
    return (high << vec3u(2u)) + (rest << vec3u(2u)) / found;
}

const ONE: u32 = 16384u;
