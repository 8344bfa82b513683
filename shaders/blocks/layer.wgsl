// Decodes a layer of a block (twin of crates/core/src/codec/blocks/coding/layer.rs): which of its lists have matter, and
// its planes of opacity and colour.

// The mask of the layer in front, of the first lane.
var<private> mask_before: OptionalMask;

fn decode_layer(i: u32, at: vec2u, block: vec2i, index: u32, kind: u32, lane: u32) {
    let planes = note_planes(OWN, i);
    let shift = shifts[i];
    var fetched = Fetched(vec4i(0), false);
    let is_known = frame.reference_blocks.x > 0u && shift.is_seen;
    if (frame.reference_blocks.x > 0u) {
        fetched = fetch(block, planes, shift.to, lane);
    }
    for (var c = 0u; c < 4u; c++) {
        levels[64u * c + lane] = 0;
    }
    workgroupBarrier();
    if (lane == 0u) {
        expected = OptionalMask(vec2u(atomicLoad(&ballot[0]), atomicLoad(&ballot[1])), is_known);
        read_layer(i, at, planes, kind, inside(block));
        atomicStore(&mean_sum, 0);
        atomicStore(&least_front, 65535u);
        atomicStore(&ballot[0], 0u);
        atomicStore(&ballot[1], 0u);
    }
    let mask = workgroupUniformLoad(&layer_mask);
    if (is_empty(mask)) {
        if (lane == 0u) {
            write_layer(index, planes, Layer(vec2u(0u), 0u, 0u));
        }
        return;
    }
    let head = workgroupUniformLoad(&layer_head);
    let means = workgroupUniformLoad(&layer_means);
    let is_inter = head.x == 1u;
    let has_matter = bit_of(mask, lane);
    let num_lists = i32(num_bits(mask));

    // Opacity, by how visible the layer is.
    if (has_matter) {
        atomicAdd(&mean_sum, kappa);
    }
    let visibility = workgroup_sum() / num_lists;
    let step = per_root(frame.opacity, max(visibility, KAPPA_FLOOR));
    let u = select(means.x, fetched.values.x, is_inter) + difference(0u, step, lane);
    let code = code_from_quarters(u);
    let alpha = opacity_of(code);

    // Colours, by how visible they are.
    if (has_matter) {
        atomicAdd(&mean_sum, seen(max(kappa, KAPPA_FLOOR), alpha));
    }
    let color_step = per_root(frame.color, max(workgroup_sum() / num_lists, SEEN_FLOOR));
    let chroma_step = of_chroma(color_step);
    let ycc = select(means.yzw, fetched.values.yzw, is_inter) + differences(1u, color_step, chroma_step, lane);
    let stored = (clamp(ycc, vec3i(0, -32768, -32768), vec3i(49152, 32768, 32768)) + 2) >> vec3u(2u);
    if (lane == 0u) {
        // The differences of the means are those of the first coefficients.
        let mean_differences = (vec4i(levels[0], levels[64], levels[128], levels[192]) + 4) >> vec4u(3u);
        note_matter_is(OWN, i, means + mean_differences, head.y, mask);
    }
    place(index, planes, has_matter, vec3u(u32(code), two_halves(stored.x, stored.y), u32(stored.z) & 0xffffu), lane);
}

// The sum of all lanes, which is nothing afterwards.
fn workgroup_sum() -> i32 {
    workgroupBarrier();
    let sum = atomicLoad(&mean_sum);
    workgroupBarrier();
    atomicStore(&mean_sum, 0);
    workgroupBarrier();
    return sum;
}

// Reads which lists of a layer have matter, and the levels of its planes. `layer_head` gets whether they are predicted
// from the reference, and classes as bytes; `num_levels` the numbers of levels.
fn read_layer(i: u32, at: vec2u, planes: Planes, kind: u32, inside: vec2u) {
    if (i == 0u) {
        mask_before = OptionalMask(vec2u(0u), false);
    }
    var in_front = vec4i(0);
    if (i > 0u) {
        in_front = note_means(OWN, i - 1u);
    }
    layer_mask = vec2u(0u);
    note_matter_is(OWN, i, in_front, 0u, vec2u(0u));
    let num_expected = num_bits(expected.mask);
    let likely = select(0u, 1u + u32(num_expected > 0u) + u32(num_expected > 8u) + u32(num_expected == 64u), expected.is_there);
    let of_planes = select(select(1u, 2u, kind == KEPT), 0u, kind == FRESH);
    if (!bit(HAS_MATTER + 6u * of_planes + likely)) {
        return;
    }
    let left = select(NOWHERE, overlapping(max(at.x, 1u) - 1u, planes), at.x > 0u);
    let above = select(NOWHERE, overlapping(at.x, planes), at.y > 0u);
    let has_left = left != NOWHERE;
    let has_above = above != NOWHERE;
    let left_mask = OptionalMask(note_mask_or_none(max(at.x, 1u) - 1u, left), has_left);
    let above_mask = OptionalMask(note_mask_or_none(at.x, above), has_above);
    let mask = read_mask(mask_before, expected, left_mask, above_mask) & inside;
    if (is_empty(mask)) {
        return;
    }
    mask_before = OptionalMask(mask, true);
    layer_mask = mask;
    var means = in_front;
    if (has_left && has_above) {
        means = (note_means(at.x - 1u, left) + note_means(at.x, above)) >> vec4u(1u);
    } else if (has_left) {
        means = note_means(at.x - 1u, left);
    } else if (has_above) {
        means = note_means(at.x, above);
    }
    let known = select(0u, num_bits(expected.mask & mask), expected.is_there);
    let is_inter = 2u * known > num_bits(mask);
    layer_means = means;
    if (is_inter) {
        layer_means = vec4i(atomicLoad(&sums[0]), atomicLoad(&sums[1]), atomicLoad(&sums[2]), atomicLoad(&sums[3])) / 64;
    }
    var classes = 0u;
    for (var c = 0u; c < 4u; c++) {
        var beside = NO_CLASS;
        if (has_left) {
            beside = note_class(at.x - 1u, left, c);
        }
        if (has_above) {
            let of_above = note_class(at.x, above, c);
            beside = select(of_above, (beside + of_above) / 2u, has_left);
        }
        let in_front_class = select(NO_CLASS, note_class(OWN, max(i, 1u) - 1u, c), i > 0u);
        let read = coefficients(min(c, 2u) + select(0u, 4u, is_inter), vec2u(in_front_class, beside), c);
        num_levels[c] = read >> 16u;
        classes |= (read & 0xffu) << (8u * c);
    }
    layer_head = vec4u(u32(is_inter), classes, 0u, 0u);
}

fn note_mask_or_none(neighbor: u32, layer: u32) -> vec2u {
    if (layer == NOWHERE) {
        return vec2u(0u);
    }
    return note_mask(neighbor, layer);
}

// The layer of a neighbour that shares most depth with a pair of planes.
fn overlapping(neighbor: u32, planes: Planes) -> u32 {
    var most = 1;
    var best = NOWHERE;
    for (var i = 0u; i < counts[neighbor]; i++) {
        let other = note_planes(neighbor, i);
        let shared_depth = min(other.back.x, planes.back.x) - max(other.front.x, planes.front.x);
        if (shared_depth >= most) {
            most = shared_depth;
            best = i;
        }
    }
    return best;
}

// The lists of a block inside the frame.
fn inside(block: vec2i) -> vec2u {
    let num = min(frame.size - 8u * vec2u(block), vec2u(8u));
    let row = (1u << num.x) - 1u;
    var mask = vec2u(0u);
    for (var y = 0u; y < num.y; y++) {
        let bits = row << (8u * (y & 3u));
        mask |= select(vec2u(bits, 0u), vec2u(0u, bits), y >= 4u);
    }
    return mask;
}

// The differences of three planes.
fn differences(first: u32, step: i32, chroma_step: i32, lane: u32) -> vec3i {
    var all = vec3i(0);
    for (var c = 0u; c < 3u; c++) {
        let own = difference(first + c, select(step, chroma_step, c > 0u), lane);
        all = select(all, vec3i(own), vec3u(0u, 1u, 2u) == vec3u(c));
    }
    return all;
}

// The difference of a plane from its prediction, of a lane's list. The levels become coefficients.
fn difference(plane: u32, step: i32, lane: u32) -> i32 {
    let length = workgroupUniformLoad(&num_levels)[plane];
    let level = levels[64u * plane + lane];
    let towards_zero = select(0, (step * TOWARDS_ZERO) >> 8u, lane > 0u);
    let size = abs(level) * step - towards_zero;
    let coefficient = select(select(size, -size, level < 0), 0, level == 0);
    levels[64u * plane + lane] = coefficient;
    workgroupBarrier();
    if (length < 2u) {
        return select(0, (levels[64u * plane] + 4) >> 3u, length == 1u);
    }
    // Along columns, and then along rows.
    let row = 8u * (lane >> 3u);
    let column = lane & 7u;
    var half_way = 2048;
    for (var k = 0u; k < 8u; k++) {
        half_way += levels[64u * plane + 8u * k + column] * wave(k, lane >> 3u);
    }
    half_of_inverse[lane] = half_way;
    workgroupBarrier();
    var value = 2048;
    for (var k = 0u; k < 8u; k++) {
        value += wave(k, column) * (half_of_inverse[row + k] >> 12u);
    }
    workgroupBarrier();
    return value >> 12u;
}

// Places a cell behind the last one of a lane's list, if it has matter. `words` are the code of u, Y and Co, and Cg.
fn place(index: u32, planes: Planes, has_matter: bool, words: vec3u, lane: u32) {
    let at = quarters_from_middle(vec2i(i32(lane & 7u), i32(lane >> 3u)));
    let front = (min(max(depth_at(planes.front, at), 16 * last_back), 16 * 65500) + 8) >> 4u;
    let back = (min(max(depth_at(planes.back, at), 16 * (front + LEAST_LENGTH)), 16 * 65535) + 8) >> 4u;
    // The last cell may end so deep that none fits behind it.
    let fits = has_matter && back > front && front >= last_back;
    if (fits) {
        let own = mask_of(lane);
        atomicOr(&ballot[0], own.x);
        atomicOr(&ballot[1], own.y);
        atomicMin(&least_front, u32(front));
        atomicMax(&layer_back, u32(back));
    }
    workgroupBarrier();
    let mask = vec2u(atomicLoad(&ballot[0]), atomicLoad(&ballot[1]));
    if (lane == 0u) {
        let cells = num_bits(mask);
        let first = atomicAdd(&tally[NUM_CELLS_SO_FAR], cells);
        layer_head.x = first;
        layer_head.y = u32(first + cells > frame.most_cells);
        if (layer_head.y == 1u) {
            give_up();
        }
        let bounds = atomicLoad(&least_front) | (atomicExchange(&layer_back, 0u) << 16u);
        write_layer(index, planes, Layer(mask, select(bounds, 0u, cells == 0u), first));
        atomicMax(&block_cells, u32(cells > 0u));
        has_cells |= u32(cells > 0u);
    }
    let head = workgroupUniformLoad(&layer_head);
    if (fits && head.y == 0u) {
        let ends = u32(front) | (u32(back) << 16u);
        write_cell(head.x + rank(mask, lane), vec3u(ends, words.x | (words.y << 16u), (words.y >> 16u) | (words.z << 16u)));
    }
    workgroupBarrier();
}

// Least visibility for the steps: .2, and of colours .02.
const KAPPA_FLOOR: i32 = 13107;
const SEEN_FLOOR: i32 = 1311;
// In 256ths of a step.
const TOWARDS_ZERO: i32 = 13;
// Least length of a cell, depth units.
const LEAST_LENGTH: i32 = 16;
