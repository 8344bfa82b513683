// The matter of the reference between two depth planes (twin of crates/core/src/codec/blocks/fetch.rs). A workgroup
// fetches for the 64 lists of a block.

// A layer of the reference.
fn layer_before(layer: u32) -> Layer {
    let at = frame.reference_first_layer + WORDS_OF_LAYER * layer + 6u;
    return Layer(vec2u(before[at], before[at + 1u]), before[at + 2u], before[at + 3u]);
}

fn planes_before(layer: u32) -> Planes {
    let at = frame.reference_first_layer + WORDS_OF_LAYER * layer;
    return Planes(
        vec3i(i32(before[at]), i32(before[at + 1u]), i32(before[at + 2u])),
        vec3i(i32(before[at + 3u]), i32(before[at + 4u]), i32(before[at + 5u])),
    );
}

// The words of the reference's block at a column and a row: 0, 0 outside, and where nothing was sent.
fn block_before(at: vec2i) -> vec2u {
    if (any(at < vec2i(0)) || any(vec2u(at) >= frame.reference_blocks)) {
        return vec2u(0u);
    }
    let word = WORDS_OF_BLOCK * (u32(at.y) * frame.reference_blocks.x + u32(at.x));
    return vec2u(before[word], before[word + 1u]);
}

// What lists have between two depths: opacity, code of u, and Y, Co, Cg times opacity in eighths. 81 lists.
var<workgroup> found: array<i32, 405>;
// Sums over the lists with matter, and these.
var<workgroup> sums: array<atomic<i32>, 4>;
var<workgroup> ballot: array<atomic<u32>, 2>;

// Writes what a list of the reference has between the planes at `place`, as list `index` of `found`.
fn find(list: vec2i, place: vec2i, planes: Planes, depth: i32, index: u32) {
    let block = block_before(list >> vec2u(3u));
    let own = u32(8 * (list.y & 7) + (list.x & 7));
    let low = depth_at(planes.front, place) + depth;
    let high = max(depth_at(planes.back, place) + depth, low + frame.depth * 16);
    var alpha_sum = 0;
    var code_sum = 0;
    var ycc_sum = vec3i(0);
    var kappa = UNIT - 1;
    var log = 0;
    var count = 0;
    let end = block.y + num_layers_of(block.x);
    for (var i = block.y; i < end; i++) {
        let layer = layer_before(i);
        if (!bit_of(layer.mask, own)) {
            continue;
        }
        let cell = frame.reference_first_cell + WORDS_OF_CELL * (layer.first_cell + rank(layer.mask, own));
        let ends = before[cell];
        let front = 16 * i32(ends & 0xffffu);
        let back = 16 * i32(ends >> 16u);
        if (back <= low || front >= high) {
            continue;
        }
        let u_y = before[cell + 1u];
        let co_cg = before[cell + 2u];
        var code = i32(u_y & 0xffffu);
        let shared_length = min(back, high) - max(front, low);
        if (shared_length + (shared_length >> 10u) < back - front) {
            code = code_of_log(log_of_tau(code) + log_of(shared_length) - log_of(back - front));
        }
        let alpha = opacity_of(code);
        let own_log = log_of_tau(code);
        log = select(own_log, log_of_sum(log, own_log), count > 0);
        let part = max(seen(kappa, alpha), 1);
        alpha_sum += part;
        code_sum = code;
        ycc_sum += part * vec3i(i16_at(u_y, 1u), i16_at(co_cg, 0u), i16_at(co_cg, 1u));
        kappa = behind(kappa, alpha);
        count++;
    }
    if (count > 1) {
        code_sum = code_of_log(log);
    }
    ycc_sum = (ycc_sum + 4) >> vec3u(3u);
    found[index] = alpha_sum;
    found[81u + index] = code_sum;
    found[162u + index] = ycc_sum.x;
    found[243u + index] = ycc_sum.y;
    found[324u + index] = ycc_sum.z;
}

// What the reference says of a layer's own list: u, Y, Co, Cg, and whether it has matter there.
struct Fetched {
    values: vec4i,
    is_there: bool,
}

// Fetches a layer of the block at a column and a row of blocks for list `lane`. All lanes of the workgroup call it
// together. Afterwards `ballot` has the mask of the lists with matter, and `sums` those of the values of all lists.
fn fetch(block: vec2i, planes: Planes, to: vec3i, lane: u32) -> Fetched {
    let quarters = (to.xy + 8) >> vec2u(4u);
    let part = quarters & vec2i(3);
    let first = 8 * block + (quarters >> vec2u(2u));
    // The ninth row and the ninth column are for some lanes.
    for (var i = lane; i < 81u; i += 64u) {
        let list = vec2i(i32(i % 9u), i32(i / 9u));
        find(first + list, quarters_from_middle(list) - part, planes, to.z, i);
    }
    if (lane < 4u) {
        atomicStore(&sums[lane], 0);
    }
    if (lane < 2u) {
        atomicStore(&ballot[lane], 0u);
    }
    workgroupBarrier();
    let at = 9u * (lane >> 3u) + (lane & 7u);
    var weight = 0;
    var alpha = 0;
    var code = 0;
    var ycc = vec3i(0);
    for (var tap = 0u; tap < 4u; tap++) {
        let step = vec2u(tap & 1u, tap >> 1u);
        let w = select(4 - part.x, part.x, step.x == 1u) * select(4 - part.y, part.y, step.y == 1u);
        let i = at + 9u * step.y + step.x;
        weight += select(0, w, found[i] > 0);
        alpha += w * found[i];
        code += w * found[81u + i];
        ycc += w * vec3i(found[162u + i], found[243u + i], found[324u + i]);
    }
    var out = Fetched(vec4i(0), weight > 8);
    let divisor = max(alpha, 1);
    let whole = ycc / divisor;
    out.values = vec4i((4 * code + (weight >> 1u)) / max(weight, 1), 32 * whole + (32 * (ycc - whole * divisor)) / divisor);
    if (out.is_there) {
        let own_bit = mask_of(lane);
        atomicOr(&ballot[0], own_bit.x);
        atomicOr(&ballot[1], own_bit.y);
        for (var c = 0u; c < 4u; c++) {
            atomicAdd(&sums[c], out.values[c]);
        }
    }
    workgroupBarrier();
    let num_lists = i32(num_bits(vec2u(atomicLoad(&ballot[0]), atomicLoad(&ballot[1]))));
    let all = vec4i(atomicLoad(&sums[0]), atomicLoad(&sums[1]), atomicLoad(&sums[2]), atomicLoad(&sums[3]));
    workgroupBarrier();
    if (num_lists > 0 && !out.is_there) {
        out.values = all / num_lists;
        for (var c = 0u; c < 4u; c++) {
            atomicAdd(&sums[c], out.values[c]);
        }
    }
    workgroupBarrier();
    return out;
}
