// Segments of like colour, by a threshold that is found ray by ray, by bisection: one march for every threshold that is
// tried, and one that writes. Twin of crates/core/src/kernels/layering/homogeneity.rs.

// What is done with one ray: counted with a threshold, or written.
struct Homogeneity {
    // Length of a step, world units.
    h: f32,
    threshold: f32,
    // Whether a gap need not end a segment.
    bridges_gaps: bool,
    // Whether the segments are kept: at most K of them, the last with what is left.
    writes: bool,
    // Segments so far, the open one among them.
    count: u32,
    // Pieces of matter without a gap so far.
    pieces: u32,
    transmittance: f32,
    open: OpenSegment,
}

var<private> sink: Homogeneity;

fn sink_begin(h: f32, threshold: f32, bridges_gaps: bool, writes: bool) {
    sink = Homogeneity(h, threshold, bridges_gaps, writes, 0u, 0u, 1.0, no_segment());
}

fn generate_list(ray: Ray, lattice: Lattice) {
    var threshold = THRESHOLD_FIRST;
    var low = 0.0;
    var high = THRESHOLD_GREATEST;
    var bridges_gaps = false;
    var least = 0u;
    // Counted up to MAX_TRIES times; the last turn writes.
    var writes = false;
    for (var turn = 0u; turn <= MAX_TRIES; turn++) {
        writes = writes || turn == MAX_TRIES;
        sink_begin(lattice.h, threshold, bridges_gaps, writes);
        march(ray, lattice);
        if (writes) {
            break;
        }
        if (sink.count > K) {
            low = threshold;
        } else if (sink.count < least) {
            high = threshold;
        } else {
            writes = true;
            continue;
        }
        // Known from the first march on.
        bridges_gaps = bridges_gaps || sink.pieces > K;
        least = K - K * ACCEPTED_BELOW_PERCENT / 100u;
        if (high - low < BRACKET_LEAST) {
            threshold = high;
            writes = true;
            continue;
        }
        threshold = 0.5 * (low + high);
    }
    close();
}

// Whether the open segment ends in front of the sample.
fn ends(step: Step, has_gap: bool) -> bool {
    if (sink.writes && sink.count == K) {
        return false;
    }
    if (has_gap) {
        if (!sink.bridges_gaps || difference(sink.open.s1, vec3f(0.0), sink.h) >= sink.threshold) {
            return true;
        }
    }
    return difference(step.s0, step.c, step.s1 - step.s0) >= sink.threshold;
}

fn close() {
    if (sink.writes && sink.count > 0u) {
        push(sink.open);
    }
}

fn sink_step(step: Step) -> u32 {
    // Half a step: lattice points are equal up to rounding.
    let has_gap = step.s0 > sink.open.s1 + 0.5 * sink.h;
    if (sink.count == 0u || has_gap) {
        sink.pieces += 1u;
    }
    if (sink.count == 0u || ends(step, has_gap)) {
        close();
        sink.open = step;
        sink.count += 1u;
    } else {
        sink.open = appended(sink.open, step);
    }
    sink.transmittance *= 1.0 - step.alpha;
    return pace_behind(sink.transmittance);
}

// Distance between the premultiplied colours of the open segment up to s_end, over the length of the sample, and of the
// sample: c over the length h.
fn difference(s_end: f32, c: vec3f, h: f32) -> f32 {
    let part = h / (s_end - sink.open.s0);
    return length(sink.open.c * (opacity(sink.open.tau * part) / sink.open.alpha) - c);
}

// Tried first; a ray that has at most K segments with it is accepted at once.
const THRESHOLD_FIRST: f32 = 1e-4;
// Greatest distance of two colours.
const THRESHOLD_GREATEST: f32 = 1.7320508;
// A bracket of thresholds below this is not halved again.
const BRACKET_LEAST: f32 = 1e-6;
// A count is accepted down to so many percent below K.
const ACCEPTED_BELOW_PERCENT: u32 = 15;
// Marches that count.
const MAX_TRIES: u32 = 24;
