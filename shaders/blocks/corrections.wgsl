// Reads the corrections of a tile, and says what its lists should composite to (twin of
// crates/core/src/codec/blocks/corrections.rs).

// Classes of the corrections in the row above, which those of the present row replace; `NOTHING` without one.
var<workgroup> corrected: array<u32, 8>;

fn decode_correction(block: u32, across: u32, first: vec2u, lane: u32) {
    let at = vec2u(block % across, block / across);
    for (var c = 0u; c < 3u; c++) {
        levels[64u * c + lane] = 0;
    }
    workgroupBarrier();
    if (lane == 0u) {
        read_correction(at);
        if (is_overrun()) {
            give_up();
        }
    }
    let head = workgroupUniformLoad(&layer_head);
    if (head.x == 0u) {
        return;
    }
    let ycc = differences(0u, frame.picture, of_chroma(frame.picture), lane);
    let stored = (clamp(ycc, vec3i(-32768), vec3i(32768)) + 2) >> vec3u(2u);
    let index = (first.y + at.y) * frame.num_blocks.x + first.x + at.x;
    let picture = picture_at(index, lane);
    let found = found_at(picture);
    let wanted = found + roots_from_ycc(4 * stored);
    for (var c = 0u; c < 3u; c++) {
        pictures[picture + 2u + c] = u32(wanted[c]);
    }
    if (lane == 0u) {
        pictures[index] = 1u;
    }
    workgroupBarrier();
}

fn read_correction(at: vec2u) {
    let left = select(NOTHING, corrected[max(at.x, 1u) - 1u], at.x > 0u);
    let above = select(NOTHING, corrected[at.x], at.y > 0u);
    let states = 3u * select(0u, 1u + u32(left != NOTHING), at.x > 0u) + select(0u, 1u + u32(above != NOTHING), at.y > 0u);
    layer_head = vec4u(0u);
    corrected[at.x] = NOTHING;
    if (!bit(HAS_CORRECTION + states)) {
        return;
    }
    layer_head.x = 1u;
    var class_before = NO_CLASS;
    var classes = 0u;
    for (var c = 0u; c < 3u; c++) {
        let of_left = (left >> (8u * c)) & 0xffu;
        let of_above = (above >> (8u * c)) & 0xffu;
        var beside = select(NO_CLASS, of_left, left != NOTHING);
        if (above != NOTHING) {
            beside = select(of_above, (of_left + of_above) / 2u, left != NOTHING);
        }
        let read = coefficients(select(7u, 3u, c == 0u), vec2u(class_before, beside), c);
        class_before = read & 0xffu;
        classes |= class_before << (8u * c);
        num_levels[c] = read >> 16u;
    }
    corrected[at.x] = classes;
}

// Writes what a lane's list composites to.
fn write_picture(block: vec2i, lane: u32) {
    let index = u32(block.y) * frame.num_blocks.x + u32(block.x);
    let picture = picture_at(index, lane);
    let found = max(vec3i(root_of(colors.x), root_of(colors.y), root_of(colors.z)), vec3i(LEAST_ROOT));
    pictures[picture] = two_halves(found.x, found.y);
    pictures[picture + 1u] = two_halves(found.z, i32(last_back > 0));
}

fn found_at(picture: u32) -> vec3i {
    let words = vec2u(pictures[picture], pictures[picture + 1u]);
    return vec3i(vec3u(words.x & 0xffffu, words.x >> 16u, words.y & 0xffffu));
}

const NOTHING: u32 = 0xffffffffu;
const LEAST_ROOT: i32 = 104;
