// From the layers of blocks to the lists of a layered frame (twin of crates/core/src/codec/blocks/to_frame.rs). Three
// dispatches: those of `offsets.wgsl`, then write_lists (a workgroup a block of lists).

@group(0) @binding(0) var<uniform> frame: BlockFrame;
@group(0) @binding(1) var<storage, read> scales: array<u32>;
@group(0) @binding(2) var<storage, read> words: array<u32>;
// Number of segments in each block of lists; after scan_blocks, the number in the frame before it.
@group(0) @binding(3) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> offsets: array<u32>;
@group(0) @binding(5) var<storage, read_write> depth: array<u32>;
@group(0) @binding(6) var<storage, read_write> c_rg: array<u32>;
@group(0) @binding(7) var<storage, read_write> c_b_tau: array<u32>;

@compute @workgroup_size(BLOCK)
fn write_lists(
    @builtin(workgroup_id) group: vec3u,
    @builtin(global_invocation_id) id: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let len = count(id.x);
    var to = block_sums[group.x] + inclusive_sum(local, len) - len;
    if (id.x >= num_lists()) {
        return;
    }
    if (id.x == 0u) {
        offsets[0] = 0u;
    }
    offsets[id.x + 1u] = to + len;
    let list = 8u * (id.x / frame.size.x % 8u) + id.x % frame.size.x % 8u;
    let block = words_of_block(id.x);
    let end = block.y + num_layers_of(block.x);
    for (var i = block.y; i < end; i++) {
        let layer = frame.first_layer + WORDS_OF_LAYER * i;
        let mask = vec2u(words[layer + 6u], words[layer + 7u]);
        if (!bit_of(mask, list) || to >= arrayLength(&depth)) {
            continue;
        }
        let cell = frame.first_cell + WORDS_OF_CELL * (words[layer + 9u] + rank(mask, list));
        let u_y = words[cell + 1u];
        let co_cg = words[cell + 2u];
        let roots = vec3f(cell_roots(vec3i(i16_at(u_y, 1u), i16_at(co_cg, 0u), i16_at(co_cg, 1u))));
        let code = u_y & 0xffffu;
        let color = roots * roots * (ONE_SQUARED * bitcast<f32>(scales[ALPHAS + code]));
        let tau = u16_at(scales[HALVES_OF_TAU + (code >> 1u)], code & 1u);
        depth[to] = words[cell];
        c_rg[to] = pack_halves(color.x, color.y);
        c_b_tau[to] = (pack_halves(color.z, 0.0) & 0xffffu) | (tau << 16u);
        to++;
    }
}

fn count(i: u32) -> u32 {
    if (i >= num_lists()) {
        return 0u;
    }
    let list = 8u * (i / frame.size.x % 8u) + i % frame.size.x % 8u;
    let block = words_of_block(i);
    let end = block.y + num_layers_of(block.x);
    var num = 0u;
    for (var layer = block.y; layer < end; layer++) {
        let at = frame.first_layer + WORDS_OF_LAYER * layer + 6u;
        num += u32(bit_of(vec2u(words[at], words[at + 1u]), list));
    }
    return num;
}

// The words of the block of a list.
fn words_of_block(i: u32) -> vec2u {
    let at = vec2u(i % frame.size.x, i / frame.size.x) / 8u;
    let word = WORDS_OF_BLOCK * (at.y * frame.num_blocks.x + at.x);
    return vec2u(words[word], words[word + 1u]);
}

fn num_lists() -> u32 {
    return frame.size.x * frame.size.y;
}

fn segments_before() -> u32 {
    return 0u;
}

// Roots are in units of 1/8192.
const ONE_SQUARED: f32 = 1.4901161e-8;
