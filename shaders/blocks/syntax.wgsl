// The syntax of masks and coefficients (twin of crates/core/src/codec/blocks/syntax.rs).

// Reads the levels of a plane's coefficients into `levels` at their places. Returns their class, and in the upper half
// their number up to the last that is not zero.
fn coefficients(component: u32, near: vec2u, plane: u32) -> u32 {
    if (bit(IS_ZERO + (component * 13u + near.x) * 13u + near.y)) {
        return 0u;
    }
    let contexts = CLASS + ((component * 5u + coarse(near.x)) * 5u + coarse(near.y)) * 16u;
    let class_number = min(tree(contexts, 4u) + 1u, 11u);
    let first = class_first(class_number);
    let count = class_first(class_number + 1u) - first;
    var rest = 0u;
    if (count > 1u) {
        rest = min(tree(REST + 32u * class_number, firstLeadingBit(count - 1u) + 1u), count - 1u);
    }
    let length = first + rest;
    var one = 0u;
    var two = 0u;
    for (var k = 0u; k < length; k++) {
        let activity = min((2u * one + two + 1u) / 2u, 3u);
        let size_contexts = SIZE + ((component * 6u + position(k)) * 4u + activity) * 15u;
        // The last coefficient is not zero.
        let least = u32(k + 1u == length);
        var size = least + unary(size_contexts + least, 15u - least);
        if (size == 15u) {
            size += number(ESCAPE);
        }
        var level = i32(size);
        if (size > 0u && raw(1u) == 1u) {
            level = -level;
        }
        levels[64u * plane + zigzag(k)] = level;
        two = one;
        one = size;
    }
    return class_number | (length << 16u);
}

// Least number of coefficients of each class, and one more than the most.
fn class_first(number: u32) -> u32 {
    // Bytes of three words.
    let word = select(select(0x3020150fu, 0x0a070504u, number < 8u), 0x03020100u, number < 4u);
    return select((word >> (8u * (number & 3u))) & 0xffu, 65u, number == 12u);
}

fn coarse(number: u32) -> u32 {
    if (number < 3u) {
        return min(number, 1u);
    }
    return select(select(3u, 4u, number == 12u), 2u, number < 7u);
}

// Context of a coefficient's place in coding order.
fn position(k: u32) -> u32 {
    return u32(k >= 1u) + u32(k >= 3u) + u32(k >= 6u) + u32(k >= 10u) + u32(k >= 21u);
}

// A mask that may be missing.
struct OptionalMask {
    mask: vec2u,
    is_there: bool,
}

// Reads the mask of a layer's lists with matter. `before` is that of the layer in front, `expected` that of the moved
// reference; `left` and `above` are those of the matching layers beside it.
fn read_mask(before: OptionalMask, expected: OptionalMask, left: OptionalMask, above: OptionalMask) -> vec2u {
    let reference = select(0u, 1u + u32(is_full(expected.mask)), expected.is_there);
    let shape = select(0u, 1u + u32(is_full(before.mask)), before.is_there);
    if (bit(IS_FULL + reference * 4u + shape)) {
        return vec2u(0xffffffffu);
    }
    let previous = select(vec2u(0xffffffffu), before.mask, before.is_there);
    if (before.is_there && !is_full(before.mask) && bit(IS_SAME + 2u * reference)) {
        return previous;
    }
    // List (x, y) is bit x + 1 of its row. Around the block are the masks of the matching layers beside it. Without
    // one, it is the edge of the layer in front.
    let edge_above = select(row_of(previous, 0u), row_of(above.mask, 7u), above.is_there);
    var row_above = (edge_above << 1u) | (edge_above & 1u) | ((edge_above & 0x80u) << 2u);
    var coded = vec2u(0u);
    for (var y = 0u; y < 8u; y++) {
        var row = select(row_of(previous, y) & 1u, row_of(left.mask, y) >> 7u, left.is_there);
        for (var x = 0u; x < 8u; x++) {
            let list = 8u * y + x;
            let context = ((row >> x) & 1u)
                | (((row_above >> x) & 7u) << 1u)
                | (u32(bit_of(previous, list)) << 4u)
                | (u32(y == 0u && !above.is_there) << 5u)
                | (u32(x == 0u && !left.is_there) << 6u)
                | (u32(!before.is_there) << 7u);
            let likely = select(0u, 1u + u32(bit_of(expected.mask, list)), expected.is_there);
            if (bit(OCCUPANCY + 256u * likely + context)) {
                row |= 2u << x;
                coded |= mask_of(list);
            }
        }
        row_above = row | ((row & 0x100u) << 1u);
    }
    return coded;
}

// Class of a number of layers.
fn count_class(count: u32) -> u32 {
    return u32(count >= 1u) + u32(count >= 2u) + u32(count >= 3u) + u32(count >= 5u) + u32(count >= 8u) + u32(count >= 12u);
}

// The class of a missing layer.
const NO_CLASS: u32 = 12u;

// Places of contexts.
const HAS_PLANES: u32 = 0u;
const IS_COPIED: u32 = 27u;
const IS_KEPT: u32 = 36u;
const IS_MERGED: u32 = 45u;
const IS_ABOVE: u32 = 54u;
const NUM_LAYERS: u32 = 57u;
const TOUCHES: u32 = 1625u;
const DEPTH: u32 = 1627u;
const SLOPE: u32 = 2383u;
const HAS_MATTER: u32 = 2719u;
const IS_FULL: u32 = 2737u;
const IS_SAME: u32 = 2749u;
const OCCUPANCY: u32 = 2755u;
const HAS_CORRECTION: u32 = 3523u;
const IS_ZERO: u32 = 3532u;
const CLASS: u32 = 4884u;
const REST: u32 = 8084u;
const SIZE: u32 = 8468u;
const ESCAPE: u32 = 11348u;
// Contexts of a signed number.
const SIGNED: u32 = 42u;
