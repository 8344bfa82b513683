// Lists of segments from the steps of a march. Twin of crates/core/src/kernels/layering/mod.rs.
//
// Before this part stands a generated line, the greatest length of a list: const K: u32 = …;
// The part after this one is the rule:
//   fn generate_list(ray: Ray, lattice: Lattice)
// marches and leaves the list in `list`. The lists go to slots; layering/compact.wgsl packs them.

@group(1) @binding(0) var<uniform> camera: Basis;
@group(1) @binding(1) var<uniform> band: Band;
// Length of each list of the band.
@group(1) @binding(2) var<storage, read_write> counts: array<u32>;
// Packed words of segment j of list i at (3·j + word)·num_pixels + i: neighbouring invocations write side by side.
@group(1) @binding(3) var<storage, read_write> slots: array<u32>;

// A segment while it is made: a step that may span many.
alias OpenSegment = Step;

// One more than K: visibility-merge opens a segment before it merges two.
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
    let len = min(list.len, K);
    counts[i] = len;
    var last_back = 0u;
    for (var j = 0u; j < len; j++) {
        let segment = close_segment(list.segments[j], from_camera.s_per_depth, last_back);
        last_back = segment.back;
        let words = pack(segment);
        slots[3u * j * band.num_pixels + i] = words.x;
        slots[(3u * j + 1u) * band.num_pixels + i] = words.y;
        slots[(3u * j + 2u) * band.num_pixels + i] = words.z;
    }
}

// Rounds the ends of a segment to depth units, behind last_back. A segment thinner than MIN_UNITS is made so
// thick; the units kept free at the far end are for those.
fn close_segment(segment: OpenSegment, s_per_depth: f32, last_back: u32) -> Segment {
    let front = max(units(segment.s0 / s_per_depth), last_back);
    let back = max(units(segment.s1 / s_per_depth), front + MIN_UNITS);
    return Segment(front, back, segment.c, min(segment.tau, TAU_MAX));
}

fn units(depth: f32) -> u32 {
    let greatest = DEPTH_UNITS - f32(K * MIN_UNITS);
    return u32(clamp(depth_to_units(camera, depth) + 0.5, 0.0, greatest));
}

// Least thickness of a segment in depth units.
const MIN_UNITS: u32 = 4;
// A part of a step without any opacity is divided by this.
const ALPHA_LEAST: f32 = 1e-30;
