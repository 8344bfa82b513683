// The whole ray as one colour at one representative depth. Twin of
// crates/core/src/kernels/layering/single_depth.rs.
//
// Before the rule stands a generated line, which depth: const REPRESENTATIVE: u32 = …;

// The greatest value so far, and where it is.
struct Greatest {
    value: f32,
    s: f32,
}

struct SingleDepth {
    // Opacity whose place is looked for.
    alpha_sought: f32,
    // Sums over the steps: what each adds to the picture, and that times its distance behind the entry.
    weight: f32,
    weighted_s: f32,
    transmittance: f32,
    peak: Greatest,
    gradient: Greatest,
    has_sought: bool,
    s_sought: f32,
    // Front of the last step.
    s_exit: f32,
    // The whole ray, from entry to exit.
    all: OpenSegment,
}

var<private> sink: SingleDepth;

fn generate_list(ray: Ray, lattice: Lattice) {
    sink_begin(OUT_OF_REACH);
    march(ray, lattice);
    if (REPRESENTATIVE == THRESHOLD) {
        sink_begin(THRESHOLD_SHARE * sink.all.alpha);
        march(ray, lattice);
    }
    if (sink.weight > 0.0) {
        let s = representative();
        sink.all.s0 = s;
        sink.all.s1 = s;
        push(sink.all);
    }
}

fn sink_begin(alpha_sought: f32) {
    let none = Greatest(0.0, 0.0);
    sink = SingleDepth(alpha_sought, 0.0, 0.0, 1.0, none, none, false, 0.0, 0.0, no_segment());
}

fn representative() -> f32 {
    let s0 = sink.all.s0;
    let s1 = sink.all.s1;
    switch REPRESENTATIVE {
        case ENTRY: { return s0; }
        case EXIT: { return sink.s_exit; }
        case MIDPOINT: { return 0.5 * (s0 + s1); }
        case PEAK: { return sink.peak.s; }
        case GRADIENT: { return sink.gradient.s; }
        case THRESHOLD: { return select(sink.s_exit, sink.s_sought, sink.has_sought); }
        default: { return s0 + sink.weighted_s / sink.weight; }
    }
}

// Of equal values the first counts, also if rounding tells them apart.
fn greater_of(a: Greatest, value: f32, s: f32) -> Greatest {
    if (value > a.value * GREATER) {
        return Greatest(value, s);
    }
    return a;
}

fn sink_step(step: Step) -> u32 {
    if (sink.weight == 0.0) {
        sink.all.s0 = step.s0;
    }
    let middle = 0.5 * (step.s0 + step.s1);
    let added = sink.transmittance * step.alpha;
    sink.weight += added;
    sink.weighted_s += added * (middle - sink.all.s0);
    sink.peak = greater_of(sink.peak, step.alpha, middle);
    sink.gradient = greater_of(sink.gradient, added, middle);
    sink.all = appended(sink.all, step);
    sink.s_exit = step.s0;
    sink.transmittance *= 1.0 - step.alpha;
    if (sink.all.alpha >= sink.alpha_sought && !sink.has_sought) {
        sink.has_sought = true;
        sink.s_sought = middle;
    }
    return select(0u, 1u, sink.transmittance > TRANSMITTANCE_MIN);
}

// The representatives by number; MEAN is the default of the switch.
const MEAN: u32 = 0;
const ENTRY: u32 = 1;
const EXIT: u32 = 2;
const MIDPOINT: u32 = 3;
const PEAK: u32 = 4;
const GRADIENT: u32 = 5;
const THRESHOLD: u32 = 6;
// Share of the ray's opacity that THRESHOLD looks for.
const THRESHOLD_SHARE: f32 = 0.8;
// A value counts as greater if it is by this factor.
const GREATER: f32 = 1.001;
// More than any opacity.
const OUT_OF_REACH: f32 = 3e38;
