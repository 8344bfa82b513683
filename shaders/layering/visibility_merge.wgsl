// One march with at most K + 1 open segments; each step opens one, and when there are too many the neighbouring pair
// that costs least is merged. Twin of crates/core/src/kernels/layering/visibility_merge.rs. The open segments are
// those of `list`.

struct VisibilityMerge {
    // Length of a step, world units.
    h: f32,
    transmittance: f32,
    // Cost of merging segment i with i + 1.
    cost: array<f32, K + 1>,
    // Transmittance in front of segment i, at least VISIBILITY_FLOOR.
    visibility: array<f32, K + 1>,
}

var<private> sink: VisibilityMerge;

fn generate_list(ray: Ray, lattice: Lattice) {
    sink.h = lattice.h;
    sink.transmittance = 1.0;
    march(ray, lattice);
}

// Cost of merging segment i with its neighbour behind.
fn pair_cost(i: u32) -> f32 {
    return merge_cost(list.segments[i], list.segments[i + 1u], sink.h) * sink.visibility[i];
}

// Merges segment i with its neighbour behind and closes the ranks.
fn merge(i: u32) {
    list.segments[i] = merged(list.segments[i], list.segments[i + 1u]);
    for (var j = i + 1u; j + 1u < list.len; j++) {
        list.segments[j] = list.segments[j + 1u];
        sink.cost[j] = sink.cost[j + 1u];
        sink.visibility[j] = sink.visibility[j + 1u];
    }
    list.len -= 1u;
    if (i + 1u < list.len) {
        sink.cost[i] = pair_cost(i);
    }
    if (i > 0u) {
        sink.cost[i - 1u] = pair_cost(i - 1u);
    }
}

fn sink_step(step: Step) -> u32 {
    let n = list.len;
    list.segments[n] = step;
    sink.visibility[n] = max(sink.transmittance, VISIBILITY_FLOOR);
    sink.transmittance *= 1.0 - step.alpha;
    list.len = n + 1u;
    if (n > 0u) {
        sink.cost[n - 1u] = pair_cost(n - 1u);
    }
    if (list.len > K) {
        var least = 0u;
        for (var i = 1u; i < list.len - 1u; i++) {
            if (sink.cost[i] < sink.cost[least]) {
                least = i;
            }
        }
        merge(least);
    }
    return pace_behind(sink.transmittance);
}

// The homogeneous segment with the composite of a over b, from the front of a to the back of b.
fn merged(a: OpenSegment, b: OpenSegment) -> OpenSegment {
    return OpenSegment(
        a.c + b.c * (1.0 - a.alpha),
        a.tau + b.tau,
        a.s0,
        b.s1,
        a.alpha + b.alpha * (1.0 - a.alpha),
    );
}

// The image error, seen from nearby views, of reading a, the gap and b as one homogeneous piece.
fn merge_cost(a: OpenSegment, b: OpenSegment, h: f32) -> f32 {
    let length = b.s1 - a.s0;
    let per_length = (a.tau + b.tau) / length;
    let gap = max(b.s0 - a.s1, 0.0);
    let moved = 0.5
        * (abs(a.tau - per_length * (a.s1 - a.s0)) + abs(b.tau - per_length * (b.s1 - b.s0)) + per_length * gap);
    // |Ea − Eb|·αa·αb with E = C/α.
    let difference = abs(a.c * b.alpha - b.c * a.alpha);
    let mixed = max(max(difference.x, difference.y), difference.z);
    return (MOVED_WEIGHT * moved / (1.0 + moved) + mixed) * (length / h);
}

// Least visibility that matter hidden behind opaque matter is counted with: a turned camera will see it.
const VISIBILITY_FLOOR: f32 = 0.2;
// Weight of moved opacity against mixed colour.
const MOVED_WEIGHT: f32 = 2.0;
