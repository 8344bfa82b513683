// Lists of segments from the steps of a march. Twin of crates/core/src/kernels/layering/mod.rs.
//
// Before this part stand generated lines: const OPEN: u32, segments open at once, and fn longest_list() -> u32, the greatest
// length of a list.
// The part after this one is the rule:
//   fn generate_list(ray: Ray, lattice: Lattice)
// marches and leaves the list in `list`, and
//   fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment
// makes of two segments one that a ray through both sees as them. The lists go to slots; layering/compact.wgsl packs them.

@group(1) @binding(0) var<uniform> camera: Basis;
@group(1) @binding(1) var<uniform> band: Band;
// Length of each list of the band.
@group(1) @binding(2) var<storage, read_write> counts: array<u32>;
// Packed words of segment j of list i at (3·j + word)·num_pixels + i: neighbouring invocations write side by side.
@group(1) @binding(3) var<storage, read_write> slots: array<u32>;

// A segment while it is made: a step that may span many.
alias OpenSegment = Step;

// One more than there are in the end: visibility-merge opens a segment before it merges two.
struct SegmentList {
    len: u32,
    segments: array<OpenSegment, OPEN + 1>,
}

var<private> list: SegmentList;

fn push(segment: OpenSegment) {
    list.segments[list.len] = segment;
    list.len += 1u;
}

fn no_segment() -> OpenSegment {
    return OpenSegment(vec3f(0.0), 0.0, 0.0, 0.0, 0.0);
}

// An open segment with a piece added to its back.
fn appended(open: OpenSegment, piece: Step) -> OpenSegment {
    return OpenSegment(
        open.c + piece.c * (1.0 - open.alpha),
        open.tau + piece.tau,
        open.s0,
        piece.s1,
        open.alpha + piece.alpha * (1.0 - open.alpha),
    );
}

// Whatever is in front of it, a brick is seen from elsewhere.
fn is_beaten(brick: u32) -> bool {
    return false;
}

struct Parts {
    near: Step,
    far: Step,
}

// The two parts of a step that is cut, as a homogeneous medium, behind the share `part` of its length.
fn split(step: Step, part: f32) -> Parts {
    let s_cut = step.s0 + (step.s1 - step.s0) * part;
    return Parts(
        piece(step, step.s0, s_cut, step.tau * part),
        piece(step, s_cut, step.s1, step.tau * (1.0 - part)),
    );
}

fn piece(step: Step, s0: f32, s1: f32, tau: f32) -> Step {
    let alpha = opacity(tau);
    return Step(step.c * (alpha / max(step.alpha, ALPHA_LEAST)), tau, s0, s1, alpha);
}

@compute @workgroup_size(8, 8)
fn generate(@builtin(global_invocation_id) id: vec3u) {
    let width = u32(camera.width);
    if (id.x >= width || id.y >= band.num_rows) {
        return;
    }
    let from_camera = basis_ray(camera, f32(id.x) + 0.5, f32(band.first_row + id.y) + 0.5);
    let lattice = scene_lattice(from_camera.ray, camera.near * from_camera.s_per_depth);
    list.len = 0u;
    if (lattice.n > 0u) {
        generate_list(from_camera.ray, lattice);
    }
    let i = id.y * width + id.x;
    let len = close_list(from_camera.s_per_depth);
    counts[i] = len;
    for (var j = 0u; j < len; j++) {
        let open = list.segments[j];
        let words = pack(Segment(u32(open.s0), u32(open.s1), open.c, min(open.tau, TAU_MAX)));
        slots[3u * j * band.num_pixels + i] = words.x;
        slots[(3u * j + 1u) * band.num_pixels + i] = words.y;
        slots[(3u * j + 2u) * band.num_pixels + i] = words.z;
    }
}

// Makes the distances of the segments depth units, and returns how many there are. Twin of
// crates/core/src/kernels/layering/close.rs.
fn close_list(s_per_depth: f32) -> u32 {
    var len = min(list.len, longest_list());
    if (len == 0u) {
        return 0u;
    }
    let first_front = units(list.segments[0].s0 / s_per_depth);
    let last_back = units(list.segments[len - 1u].s1 / s_per_depth);
    if (last_back < first_front + f32(len * MIN_UNITS)) {
        for (var j = 1u; j < len; j++) {
            let s1 = list.segments[j].s1;
            list.segments[0] = united(list.segments[0], list.segments[j]);
            list.segments[0].s1 = s1;
        }
        len = 1u;
    }
    let least = f32(MIN_UNITS);
    var before = 0.0;
    for (var j = 0u; j < len; j++) {
        let front = max(units(list.segments[j].s0 / s_per_depth), before);
        before = max(units(list.segments[j].s1 / s_per_depth), front + least);
        list.segments[j].s0 = front;
        list.segments[j].s1 = before;
    }
    var end = max(last_back, first_front + least);
    for (var j = len; j > 0u; j--) {
        let back = min(list.segments[j - 1u].s1, end);
        end = min(list.segments[j - 1u].s0, back - least);
        list.segments[j - 1u].s0 = end;
        list.segments[j - 1u].s1 = back;
    }
    return len;
}

// The depth unit nearest to a view depth, with room for a segment behind it.
fn units(depth: f32) -> f32 {
    return floor(clamp(depth_to_units(camera, depth) + 0.5, 0.0, DEPTH_UNITS - f32(MIN_UNITS)));
}

// Least thickness of a segment in depth units.
const MIN_UNITS: u32 = 4;
// A part of a step without any opacity is divided by this.
const ALPHA_LEAST: f32 = 1e-30;
