// Lists of segments from the steps of a march. Twin of crates/core/src/kernels/layering/mod.rs.
//
// The parts after this one have
//   fn generate_list(ray: Ray, lattice: Lattice)
// which marches and hands its segments to push, front to back, and
//   fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment
// which makes of two segments one that a ray through both sees as them. Segments go to slots as they come, and
// layering/compact.wgsl packs them.

@group(1) @binding(0) var<uniform> camera: Basis;
@group(1) @binding(1) var<uniform> band: Band;
// Length of each list in the band.
@group(1) @binding(2) var<storage, read_write> counts: array<u32>;
// Packed words of segment j of list i at (3·j + word)·num_pixels + i, so that neighbouring invocations write side by
// side.
@group(1) @binding(3) var<storage, read_write> slots: array<u32>;

// An unfinished segment: a step that may span many.
alias OpenSegment = Step;

// The list of a ray so far.
struct Out {
    len: u32,
    // Index of the ray in the band, and in the workgroup.
    i: u32,
    lane: u32,
    s_per_depth: f32,
    // Whether segments are only counted.
    is_counted: bool,
    // Depth units: the front of the first segment, and the back of the last before and after thin ones are thickened.
    first_front: f32,
    last_back: f32,
    behind: f32,
}

var<private> out: Out;

fn begin_list(i: u32, lane: u32, s_per_depth: f32, is_counted: bool) {
    out = Out(0u, i, lane, s_per_depth, is_counted, 0.0, 0.0, 0.0);
}

// Adds a segment at the back.
fn push(segment: OpenSegment) {
    if (!out.is_counted && out.len < budget.longest) {
        let front = max(units(segment.s0 / out.s_per_depth), out.behind);
        if (out.len == 0u) {
            out.first_front = front;
        }
        out.last_back = units(segment.s1 / out.s_per_depth);
        out.behind = max(out.last_back, front + f32(MIN_UNITS));
        put_segment(out.len, segment, front, out.behind);
    }
    out.len += 1u;
}

fn put_segment(j: u32, segment: OpenSegment, front: f32, back: f32) {
    let ends = min(vec2f(front, back), vec2f(DEPTH_UNITS));
    let words = pack(Segment(u32(ends.x), u32(ends.y), segment.c, min(segment.tau, TAU_MAX)));
    slots[slot(j, 0u)] = words.x;
    slots[slot(j, 1u)] = words.y;
    slots[slot(j, 2u)] = words.z;
}

// A written segment, with ends in depth units.
fn taken(j: u32) -> OpenSegment {
    let depths = slots[slot(j, 0u)];
    let rg = unpack_halves(slots[slot(j, 1u)]);
    let b_tau = unpack_halves(slots[slot(j, 2u)]);
    let c = vec3f(rg, b_tau.x);
    return OpenSegment(c, b_tau.y, f32(depths & 0xffffu), f32(depths >> 16u), opacity(b_tau.y));
}

fn slot(j: u32, word: u32) -> u32 {
    return (3u * j + word) * band.num_pixels + out.i;
}

// Casts end where the volume does, so a list that becomes longer than its matter is pushed back from its end. A list
// without room for all of its segments becomes one. Twin of crates/core/src/kernels/layering/close.rs.
fn close_list() {
    let least = f32(MIN_UNITS);
    var end = max(out.last_back, out.first_front + least);
    if (out.len == 0u || out.behind <= end) {
        return;
    }
    if (out.last_back < out.first_front + f32(out.len) * least) {
        var all = taken(0u);
        for (var j = 1u; j < out.len; j++) {
            all = united(all, taken(j));
        }
        put_segment(0u, all, out.first_front, end);
        out.len = 1u;
        return;
    }
    for (var j = out.len; j > 0u; j--) {
        let depths = slots[slot(j - 1u, 0u)];
        let back = min(f32(depths >> 16u), end);
        end = min(f32(depths & 0xffffu), back - least);
        slots[slot(j - 1u, 0u)] = u32(end) | u32(back) << 16u;
    }
}

// The nearest depth unit to a view depth, with room for a segment behind it.
fn units(depth: f32) -> f32 {
    return floor(clamp(depth_to_units(camera, depth) + 0.5, 0.0, DEPTH_UNITS - f32(MIN_UNITS)));
}

// An open segment with a piece appended.
fn appended(open: OpenSegment, piece: Step) -> OpenSegment {
    return OpenSegment(
        open.c + piece.c * (1.0 - open.alpha),
        open.tau + piece.tau,
        open.s0,
        piece.s1,
        open.alpha + piece.alpha * (1.0 - open.alpha),
    );
}

// A brick is visible from elsewhere, whatever is in front of it.
fn is_beaten(brick: u32) -> bool {
    return false;
}

@compute @workgroup_size(8, 4)
fn generate(
    @builtin(global_invocation_id) id: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let width = u32(camera.width);
    if (id.x >= width || id.y >= band.num_rows) {
        return;
    }
    let from_camera = basis_ray(camera, f32(id.x) + 0.5, f32(band.first_row + id.y) + 0.5);
    let lattice = scene_lattice(from_camera.ray, camera.near * from_camera.s_per_depth);
    begin_list(id.y * width + id.x, lane, from_camera.s_per_depth, false);
    if (lattice.n > 0u) {
        generate_list(from_camera.ray, lattice);
        close_list();
    }
    counts[out.i] = min(out.len, budget.longest);
}

// Least thickness of a segment in depth units.
const MIN_UNITS: u32 = 4;
// Least opacity of a part of a step that is divided by.
const ALPHA_LEAST: f32 = 1e-30;
