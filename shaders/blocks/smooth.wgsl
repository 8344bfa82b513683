// The deblocking filter (twin of crates/core/src/codec/blocks/smooth.rs). An invocation smooths a line across a border
// between two corrected blocks: first all borders between blocks side by side, then those between upper and lower ones.

@group(0) @binding(0) var<uniform> frame: BlockFrame;
@group(0) @binding(1) var<storage, read_write> pictures: array<u32>;

// Whether the second block of a border is the lower one; else it is the right one.
override IS_BELOW: bool = false;

@compute @workgroup_size(64)
fn smooth_borders(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
    let line = id.x + 64u * groups.x * id.y;
    let block = line / 8u;
    var step = vec2u(1u, 0u);
    if (IS_BELOW) {
        step = vec2u(0u, 1u);
    }
    let at = vec2u(block % frame.num_blocks.x, block / frame.num_blocks.x);
    if (any(at + step >= frame.num_blocks)) {
        return;
    }
    let next = block + step.x + step.y * frame.num_blocks.x;
    if (pictures[block] == 0u || pictures[next] == 0u) {
        return;
    }
    // The last three lists of the first block and the first three of the second.
    let p = vec3u(list_at(block, 7u, line % 8u), list_at(block, 6u, line % 8u), list_at(block, 5u, line % 8u));
    let q = vec3u(list_at(next, 0u, line % 8u), list_at(next, 1u, line % 8u), list_at(next, 2u, line % 8u));
    for (var i = 0u; i < 3u; i++) {
        if ((pictures[p[i] + 1u] & pictures[q[i] + 1u] & IS_THERE) == 0u) {
            return;
        }
    }
    let p0 = wanted_at(p.x);
    let p1 = wanted_at(p.y);
    let p2 = wanted_at(p.z);
    let q0 = wanted_at(q.x);
    let q1 = wanted_at(q.y);
    let q2 = wanted_at(q.z);
    let yp0 = ycc_from_roots(p0);
    let yp1 = ycc_from_roots(p1);
    let yp2 = ycc_from_roots(p2);
    let yq0 = ycc_from_roots(q0);
    let yq1 = ycc_from_roots(q1);
    let yq2 = ycc_from_roots(q2);
    let steps = vec3i(frame.picture, of_chroma(frame.picture), of_chroma(frame.picture));
    let most = (MOST * steps) >> vec3u(8u);
    let bent = abs(yp2 - 2 * yp1 + yp0) + abs(yq2 - 2 * yq1 + yq0);
    let apart = (9 * (yq0 - yp0) - 3 * (yq1 - yp1)) >> vec3u(4u);
    let is_smoothed = (bent <= ((BEND * steps) >> vec3u(8u))) & (abs(apart) <= ((FAR * steps) >> vec3u(8u)));
    let by = select(vec3i(0), within(apart, most), is_smoothed);
    let of_p1 = within((((yp2 + yp0) >> vec3u(1u)) - yp1 + by) >> vec3u(1u), most >> vec3u(1u));
    let of_q1 = within((((yq2 + yq0) >> vec3u(1u)) - yq1 - by) >> vec3u(1u), most >> vec3u(1u));
    write_wanted(p.y, p1 + roots_from_ycc(select(vec3i(0), of_p1, is_smoothed)));
    write_wanted(p.x, p0 + roots_from_ycc(by));
    write_wanted(q.x, q0 + roots_from_ycc(-by));
    write_wanted(q.y, q1 + roots_from_ycc(select(vec3i(0), of_q1, is_smoothed)));
}

// Word of the list of a block that is `away` from its first row or column, in a line.
fn list_at(block: u32, away: u32, line: u32) -> u32 {
    if (IS_BELOW) {
        return picture_at(block, 8u * away + line);
    }
    return picture_at(block, 8u * line + away);
}

fn wanted_at(picture: u32) -> vec3i {
    return vec3i(i32(pictures[picture + 2u]), i32(pictures[picture + 3u]), i32(pictures[picture + 4u]));
}

fn write_wanted(picture: u32, roots: vec3i) {
    pictures[picture + 2u] = u32(roots.x);
    pictures[picture + 3u] = u32(roots.y);
    pictures[picture + 4u] = u32(roots.z);
}

fn within(x: vec3i, most: vec3i) -> vec3i {
    return max(min(x, most), -most);
}

fn ycc_from_roots(roots: vec3i) -> vec3i {
    let r = roots.x;
    let g = roots.y;
    let b = roots.z;
    return vec3i((r + 2 * g + b) >> 2u, (r - b) >> 1u, (2 * g - r - b) >> 2u);
}

// In 256ths of a step.
const MOST: i32 = 31;
const BEND: i32 = 512;
const FAR: i32 = 461;
// In the second word of a list.
const IS_THERE: u32 = 65536u;
