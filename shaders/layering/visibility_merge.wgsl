// One march with a bounded number of open segments, reduced to a budget that the whole frame shares. Twin of
// crates/core/src/kernels/layering/visibility_merge.rs, which derives it. K is the longest list that is gathered.
//
// Before this part stand generated lines: const MEAN_K: u32, the segments a list may have on average, and const MOST: u32,
// those it may have at most.

struct Budget {
    num_lists: atomic<u32>,
    num_pieces: atomic<u32>,
    threshold: f32,
    // Joins of the sample by the bin of their cost.
    joins: array<atomic<u32>, COST_BINS>,
}

@group(1) @binding(4) var<storage, read_write> budget: Budget;

// A linked list, so that nothing moves when two segments become one.
struct Gather {
    // Length of a step, world units.
    h: f32,
    len: u32,
    // The rearmost segment, or NO_SLOT.
    last: u32,
    // The slot that is not in use, when all others are.
    free: u32,
    transmittance: f32,
    open: array<OpenSegment, K + 1>,
    // Cost of merging a segment with the one behind it; infinite where there is none.
    cost: array<f32, K + 1>,
    // Transmittance in front, at least VISIBILITY_FLOOR.
    visibility: array<f32, K + 1>,
    // Slot of the segment behind, or NO_SLOT.
    next: array<u32, K + 1>,
    // Slot of the segment in front, or NO_SLOT.
    prev: array<u32, K + 1>,
}

var<private> sink: Gather;

fn gather(ray: Ray, lattice: Lattice) {
    sink.h = lattice.h;
    sink.len = 0u;
    sink.last = NO_SLOT;
    sink.free = K;
    sink.transmittance = 1.0;
    for (var slot = 0u; slot <= K; slot++) {
        sink.cost[slot] = INFINITE_COST;
    }
    march(ray, lattice);
    finish();
}

// Cost of merging `slot` with what is behind it.
fn pair_cost(slot: u32) -> f32 {
    return merge_cost(sink.open[slot], sink.open[sink.next[slot]], sink.h) * sink.visibility[slot];
}

// Merges the pair that costs least.
fn merge_cheapest() {
    var least = 0u;
    for (var slot = 1u; slot <= K; slot++) {
        if (sink.cost[slot] < sink.cost[least]) {
            least = slot;
        }
    }
    let behind = sink.next[least];
    sink.open[least] = merged(sink.open[least], sink.open[behind]);
    sink.next[least] = sink.next[behind];
    sink.cost[behind] = INFINITE_COST;
    sink.free = behind;
    if (sink.next[least] == NO_SLOT) {
        sink.last = least;
        sink.cost[least] = INFINITE_COST;
    } else {
        sink.prev[sink.next[least]] = least;
        sink.cost[least] = pair_cost(least);
    }
    if (sink.prev[least] != NO_SLOT) {
        sink.cost[sink.prev[least]] = pair_cost(sink.prev[least]);
    }
}

fn sink_step(step: Step) -> u32 {
    let is_full = sink.len == K;
    let slot = select(sink.len, sink.free, is_full);
    sink.open[slot] = step;
    sink.cost[slot] = INFINITE_COST;
    sink.visibility[slot] = max(sink.transmittance, VISIBILITY_FLOOR);
    sink.next[slot] = NO_SLOT;
    sink.prev[slot] = sink.last;
    if (sink.last != NO_SLOT) {
        sink.next[sink.last] = slot;
        sink.cost[sink.last] = pair_cost(sink.last);
    }
    sink.last = slot;
    sink.transmittance *= 1.0 - step.alpha;
    if (is_full) {
        merge_cheapest();
    } else {
        sink.len += 1u;
    }
    return pace_behind(sink.transmittance);
}

// What one ray gathered, front to back: the pieces are in `list`.
var<private> weight: array<f32, K>;

fn finish() {
    list.len = sink.len;
    var slot = sink.last;
    for (var i = sink.len; i > 0u; i--) {
        list.segments[i - 1u] = sink.open[slot];
        weight[i - 1u] = sink.visibility[slot];
        slot = sink.prev[slot];
    }
    var c = vec3f(0.0);
    var transmittance = 1.0;
    for (var i = 0u; i < list.len; i++) {
        c += list.segments[i].c * transmittance;
        transmittance *= 1.0 - list.segments[i].alpha;
    }
    // An error counts as what it changes in an sRGB picture, whose slope is about ½/√colour.
    let slope = 0.5 / sqrt(max(max(max(c.x, c.y), c.z), COLOR_DARK));
    for (var i = 0u; i < list.len; i++) {
        weight[i] *= slope;
    }
}

// Groups of neighbouring pieces: group g has the pieces first[g]..first[g + 1].
struct Groups {
    len: u32,
    first: array<u32, K + 1>,
    // Error of each group.
    error: array<f32, K>,
    // Error of each group joined with the one behind it.
    joined: array<f32, K>,
}

var<private> groups: Groups;

fn composite(first: u32, end: u32) -> OpenSegment {
    var all = list.segments[first];
    for (var i = first + 1u; i < end; i++) {
        all = merged(all, list.segments[i]);
    }
    return all;
}

// How far the colour and opacity that a ray collects on its way through the pieces first..end are from what it collects
// in their homogeneous composite: the mean distance over the way, times the 3/2-th power of its length in steps.
fn group_error(first: u32, end: u32) -> f32 {
    let all = composite(first, end);
    let tau_per_length = all.tau / (all.s1 - all.s0);
    let collected_per_opacity = 1.0 / max(all.alpha, ALPHA_LEAST);
    var c = vec3f(0.0);
    var transmittance = 1.0;
    var s_before = all.s0;
    var distance_before = 0.0;
    var error = 0.0;
    // Ends of the pieces and, where there is a gap, beginnings; both ways agree at the two ends of the group.
    for (var i = first; i < end; i++) {
        let piece = list.segments[i];
        if (i > first && piece.s0 > list.segments[i - 1u].s1) {
            let share = (1.0 - exp(-tau_per_length * (piece.s0 - all.s0))) * collected_per_opacity;
            let distance = distance_collected(c - all.c * share, 1.0 - transmittance - all.alpha * share);
            error += 0.5 * (distance_before + distance) * (piece.s0 - s_before);
            s_before = piece.s0;
            distance_before = distance;
        }
        c += piece.c * transmittance;
        transmittance *= 1.0 - piece.alpha;
        if (i + 1u < end) {
            let share = (1.0 - exp(-tau_per_length * (piece.s1 - all.s0))) * collected_per_opacity;
            let distance = distance_collected(c - all.c * share, 1.0 - transmittance - all.alpha * share);
            error += 0.5 * (distance_before + distance) * (piece.s1 - s_before);
            s_before = piece.s1;
            distance_before = distance;
        }
    }
    error += 0.5 * distance_before * (all.s1 - s_before);
    return error / sink.h * sqrt((all.s1 - all.s0) / sink.h) * weight[first];
}

fn distance_collected(color: vec3f, opacity: f32) -> f32 {
    let difference = abs(color);
    return max(abs(opacity), COLOR_WEIGHT * max(max(difference.x, difference.y), difference.z));
}

// What joining group g with the one behind it adds to the error.
fn growth(g: u32) -> f32 {
    return groups.joined[g] - groups.error[g] - groups.error[g + 1u];
}

// Joins groups, cheapest first, until there are at most `most` and the next join costs more than `threshold`. With
// `is_sample` the greatest cost so far is counted before each join.
fn join(most: u32, threshold: f32, is_sample: bool) {
    groups.len = list.len;
    for (var g = 0u; g < list.len; g++) {
        groups.first[g] = g;
        groups.error[g] = 0.0;
        groups.joined[g] = INFINITE_COST;
        if (g + 1u < list.len) {
            groups.joined[g] = group_error(g, g + 2u);
        }
    }
    groups.first[list.len] = list.len;
    var greatest = 0.0;
    while (groups.len > 1u) {
        var least = 0u;
        for (var g = 1u; g + 1u < groups.len; g++) {
            if (growth(g) < growth(least)) {
                least = g;
            }
        }
        greatest = max(greatest, growth(least));
        if (groups.len <= most && greatest > threshold) {
            break;
        }
        if (is_sample) {
            atomicAdd(&budget.joins[bitcast<u32>(greatest) >> BIN_SHIFT], 1u);
        }
        groups.error[least] = groups.joined[least];
        groups.len -= 1u;
        for (var g = least + 1u; g < groups.len; g++) {
            groups.error[g] = groups.error[g + 1u];
            groups.joined[g] = groups.joined[g + 1u];
            groups.first[g] = groups.first[g + 1u];
        }
        groups.first[groups.len] = list.len;
        groups.joined[least] = joined_error(least);
        if (least > 0u) {
            groups.joined[least - 1u] = joined_error(least - 1u);
        }
    }
}

// Error of group g joined with the one behind it.
fn joined_error(g: u32) -> f32 {
    if (g + 1u >= groups.len) {
        return INFINITE_COST;
    }
    return group_error(groups.first[g], groups.first[g + 2u]);
}

// Moves each border by one piece where that lessens the error of the two groups.
fn settle() {
    for (var g = 1u; g < groups.len; g++) {
        let first = groups.first[g - 1u];
        let border = groups.first[g];
        let end = groups.first[g + 1u];
        var least = groups.error[g - 1u] + groups.error[g];
        for (var side = 0u; side < 2u; side++) {
            let moved = border - 1u + 2u * side;
            if (moved <= first || moved >= end) {
                continue;
            }
            let before = group_error(first, moved);
            let behind = group_error(moved, end);
            if (before + behind < least) {
                least = before + behind;
                groups.first[g] = moved;
                groups.error[g - 1u] = before;
                groups.error[g] = behind;
            }
        }
    }
}

fn generate_list(ray: Ray, lattice: Lattice) {
    gather(ray, lattice);
    if (list.len == 0u) {
        return;
    }
    join(MOST, budget.threshold, false);
    settle();
    // A group begins behind all groups in front of it, so its place in the list is free.
    for (var g = 0u; g < groups.len; g++) {
        list.segments[g] = composite(groups.first[g], groups.first[g + 1u]);
    }
    list.len = groups.len;
}

// One of SAMPLE_STRIDE² pixels: what the joins cost.
@compute @workgroup_size(8, 8)
fn sample_budget(@builtin(global_invocation_id) id: vec3u) {
    let width = u32(camera.width);
    let height = u32(camera.height);
    let x = id.x * SAMPLE_STRIDE + min(SAMPLE_STRIDE / 2u, width / 2u);
    let y = (band.first_row + id.y) * SAMPLE_STRIDE + min(SAMPLE_STRIDE / 2u, height / 2u);
    if (x >= width || y >= height || id.y >= band.num_rows) {
        return;
    }
    let from_camera = basis_ray(camera, f32(x) + 0.5, f32(y) + 0.5);
    let lattice = scene_lattice(from_camera.ray, camera.near * from_camera.s_per_depth);
    if (lattice.n == 0u) {
        return;
    }
    gather(from_camera.ray, lattice);
    if (list.len == 0u) {
        return;
    }
    atomicAdd(&budget.num_lists, 1u);
    atomicAdd(&budget.num_pieces, list.len);
    join(1u, INFINITE_COST, true);
}

// The least lower end of a bin such that joins below it leave at most MEAN_K segments a list.
@compute @workgroup_size(1)
fn choose_threshold() {
    let allowed = atomicLoad(&budget.num_lists) * MEAN_K;
    var left = atomicLoad(&budget.num_pieces);
    var bin = 0u;
    while (left > allowed && bin < COST_BINS) {
        left -= atomicLoad(&budget.joins[bin]);
        bin += 1u;
    }
    budget.threshold = bitcast<f32>(bin << BIN_SHIFT);
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

// While gathering, the error of reading a, the gap and b as one homogeneous piece.
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

// No segment.
const NO_SLOT: u32 = 0xffffffff;
// More than any cost: WGSL has no infinity.
const INFINITE_COST: f32 = 3.4e38;
// Least visibility that matter hidden behind opaque matter is counted with: a turned camera will see it.
const VISIBILITY_FLOOR: f32 = 0.15;
// Weight of moved opacity against mixed colour while gathering.
const MOVED_WEIGHT: f32 = 2.0;
// Weight of collected colour against collected opacity.
const COLOR_WEIGHT: f32 = 4.0;
// Colour below which the slope of sRGB is taken as constant.
const COLOR_DARK: f32 = 0.02;
// Every so many pixels along each axis one is marched beforehand for the threshold.
const SAMPLE_STRIDE: u32 = 4;
// Bits of a float left out in the number of its bin: 1/32 of an octave each.
const BIN_SHIFT: u32 = 18;
// Bins of all finite costs.
const COST_BINS: u32 = 8192;
