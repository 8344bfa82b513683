// Reads the depth planes of a block, predicted from those to the left and above (twin of
// crates/core/src/codec/blocks/coding/depth.rs). The first lane does.

fn read_planes(at: vec2u, num_left: u32, num_above: u32) {
    var last = vec3i(0);
    for (var i = 0u; i < 2u * block_head.y; i++) {
        let side = i & 1u;
        var code = last;
        if (side == 1u || i == 0u || !bit(TOUCHES + u32(i > 2u))) {
            var behind = plane_of(last).x - select(8 * frame.depth, 0, side == 1u);
            if (i == 0u) {
                behind = -NEVER;
            }
            code = read_plane(at, num_left, num_above, behind, side, select(vec3i(0), last, side == 1u));
        }
        if (side == 1u) {
            note_planes_are(OWN, i / 2u, Planes(plane_of(last), plane_of(code)));
        }
        last = code;
    }
}

// Reads the code of a front (`side` 0) or back (1). The prediction is each neighbour's first plane that is behind a
// depth; without any, `otherwise`.
fn read_plane(at: vec2u, num_left: u32, num_above: u32, behind: i32, side: u32, otherwise: vec3i) -> vec3i {
    var left = vec3i(0);
    var above = vec3i(0);
    for (var i = 0u; i < 2u; i++) {
        left = above;
        let neighbor = select(at.x, max(at.x, 1u) - 1u, i == 0u);
        above = next_plane(neighbor, select(num_above, num_left, i == 0u), vec2i(1 - i32(i), i32(i)), behind, side, otherwise);
    }
    var near = otherwise;
    var context = NUM_DEPTH_CONTEXTS - 1u;
    if (left.x != NEVER && above.x != NEVER) {
        let apart = u32(abs(left.x - above.x)) / u32(16 * frame.depth);
        context = min(firstLeadingBit(apart + 1u) + u32(apart > 0u), NUM_DEPTH_CONTEXTS - 3u);
        let mean = (left + above) >> vec3u(1u);
        near = code_of(select(select(above, left, left.x < above.x), mean, apart < 4u));
    } else if (left.x != NEVER || above.x != NEVER) {
        context = NUM_DEPTH_CONTEXTS - 2u;
        near = code_of(select(above, left, left.x != NEVER));
    }
    let slopes = SLOPE + (4u * side + min(context / 3u, 3u)) * SIGNED;
    for (var i = 0u; i < 3u; i++) {
        let read = signed_number(select(slopes, DEPTH + (NUM_DEPTH_CONTEXTS * side + context) * SIGNED, i == 0u));
        near += select(vec3i(0), vec3i(read), vec3u(0u, 1u, 2u) == vec3u(i));
    }
    return near;
}

// The first plane of a neighbour that is behind a depth, continued into the block. Its depth is `NEVER` without any.
fn next_plane(neighbor: u32, num: u32, step: vec2i, behind: i32, side: u32, front: vec3i) -> vec3i {
    var next = vec3i(NEVER, 0, 0);
    for (var i = 0u; i < num; i++) {
        let planes = note_planes(neighbor, i);
        var plane = continued(planes.front, step);
        if (side == 1u) {
            // Half-way between the neighbour's back and one that makes the layer as thick as the neighbour's.
            plane = continued(planes.back, step) + ((plane_of(front) - plane) >> vec3u(1u));
        }
        if (plane.x > behind && plane.x < next.x) {
            next = plane;
        }
    }
    return next;
}

fn plane_of(code: vec3i) -> vec3i {
    let step = vec3i(16 * frame.depth, 4 * frame.depth, 4 * frame.depth);
    let most = vec3i(1 << 24u) / step;
    return bounded(clamp(code, -most, most) * step);
}

// The code of the nearest plane.
fn code_of(plane: vec3i) -> vec3i {
    let step = vec3i(16 * frame.depth, 4 * frame.depth, 4 * frame.depth);
    let number = plane + (step >> vec3u(1u));
    let whole = number / step;
    return whole - select(vec3i(0), vec3i(1), whole * step > number);
}

const NUM_DEPTH_CONTEXTS: u32 = 9u;
// Behind every plane.
const NEVER: i32 = 1073741824;
