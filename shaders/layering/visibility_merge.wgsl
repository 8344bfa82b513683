// One march with a bounded number of open segments, reduced to a budget that the whole frame shares. Twin of
// crates/core/src/kernels/layering/visibility_merge.rs, which derives it. OPEN pieces are
// gathered.
//
// Before this part stands the budget (budget.wgsl).

// The pieces of one ray while they are gathered are those of `list`.
struct Gather {
    // Length of a step, world units.
    h: f32,
    // Pieces that cost no more than this are merged.
    tolerance: f32,
    transmittance: f32,
    // Weight of collected colour against collected opacity.
    color_weight: f32,
    // Transmittance in front, at least VISIBILITY_FLOOR; at the end the weight of what a group that begins here gets
    // wrong.
    visibility: array<f32, OPEN + 1>,
    // What merging has cost each piece up to now.
    spent: array<f32, OPEN + 1>,
    // Cost of merging a piece with the one behind it.
    cost: array<f32, OPEN + 1>,
}

var<private> sink: Gather;

fn gather(ray: Ray, lattice: Lattice, tolerance: f32) {
    sink.h = lattice.unit;
    sink.tolerance = tolerance;
    sink.transmittance = 1.0;
    list.len = 0u;
    march(ray, lattice);
    finish();
}

// Cost of merging piece i with `behind`, which has cost `spent`.
fn pair_cost(i: u32, behind: OpenSegment, spent: f32) -> f32 {
    return merge_cost(list.segments[i], behind, sink.h) * sink.visibility[i] + (sink.spent[i] + spent);
}

// Of OPEN + 1 pieces merges neighbours, and raises the tolerance to where most of the cheap pairs merge. A pair that costs
// more than the one behind it waits for another time, as does one with a piece that was merged just now.
fn thin_out() {
    // The harmonic mean is that of the cheap ones; at least one is no dearer.
    var sum_of_inverses = 0.0;
    var least = INFINITE_COST;
    for (var i = 0u; i < OPEN; i++) {
        let cost = pair_cost(i, list.segments[i + 1u], sink.spent[i + 1u]);
        sink.cost[i] = cost;
        sum_of_inverses += 1.0 / max(cost, COST_LEAST);
        least = min(least, cost);
    }
    sink.cost[OPEN] = INFINITE_COST;
    // But for rounding.
    sink.tolerance = max(max(f32(OPEN) / sum_of_inverses, 2.0 * sink.tolerance), least);
    var kept = 0u;
    var i = 0u;
    while (i <= OPEN) {
        var piece = list.segments[i];
        var spent = sink.spent[i];
        sink.visibility[kept] = sink.visibility[i];
        if (i < OPEN && sink.cost[i] <= sink.tolerance && sink.cost[i] <= sink.cost[min(i + 1u, OPEN)]) {
            spent = sink.cost[i];
            i += 1u;
            piece = appended(piece, list.segments[i]);
        }
        list.segments[kept] = piece;
        sink.spent[kept] = spent;
        kept += 1u;
        i += 1u;
    }
    list.len = kept;
}

fn sink_step(step: Step) -> u32 {
    let visibility = max(sink.transmittance, VISIBILITY_FLOOR);
    sink.transmittance *= 1.0 - step.alpha;
    let pace = pace_behind(sink.transmittance);
    if (list.len > 0u) {
        let last = list.len - 1u;
        let cost = pair_cost(last, step, 0.0);
        if (cost <= sink.tolerance) {
            list.segments[last] = appended(list.segments[last], step);
            sink.spent[last] = cost;
            return pace;
        }
    }
    list.segments[list.len] = step;
    sink.spent[list.len] = 0.0;
    sink.visibility[list.len] = visibility;
    list.len += 1u;
    if (list.len > OPEN) {
        thin_out();
    }
    return pace;
}

fn num_gathered() -> u32 {
    return list.len;
}

fn finish() {
    var c = vec3f(0.0);
    var transmittance = 1.0;
    for (var i = 0u; i < list.len; i++) {
        c += list.segments[i].c * transmittance;
        transmittance *= 1.0 - list.segments[i].alpha;
    }
    // The slope of sRGB. Errors of colour show in proportion to it, those of opacity less.
    let slope = 0.5 / sqrt(max(max(max(c.x, c.y), c.z), COLOR_DARK));
    sink.color_weight = COLOR_WEIGHT * slope;
    for (var i = 0u; i < list.len; i++) {
        sink.visibility[i] *= sqrt(slope);
    }
}

// Groups of neighbouring pieces, with borders that may lie inside of pieces: group g has what is between first[g] and
// first[g + 1], counted in pieces (3.25 is a quarter into the fourth).
struct Groups {
    len: u32,
    first: array<f32, OPEN + 1>,
    // Error of each group.
    error: array<f32, OPEN>,
    // Error of each group joined with the one behind it.
    joined: array<f32, OPEN>,
}

var<private> groups: Groups;

// What of piece i is between two borders: matter is spread evenly in a piece.
fn part_of(i: u32, begin: f32, end: f32) -> OpenSegment {
    var part = list.segments[i];
    let first = max(begin - f32(i), 0.0);
    let last = min(end - f32(i), 1.0);
    if (last - first == 1.0) {
        return part;
    }
    let s0 = part.s0;
    let length = part.s1 - s0;
    part.s0 = s0 + first * length;
    if (last < 1.0) {
        part.s1 = s0 + last * length;
    }
    part.tau *= last - first;
    let alpha = 1.0 - exp(-part.tau);
    part.c *= alpha / max(part.alpha, ALPHA_LEAST);
    part.alpha = alpha;
    return part;
}

// The number of the last piece that has a part in front of a border.
fn last_piece(end: f32) -> u32 {
    return u32(ceil(end)) - 1u;
}

// What is between two borders as one segment.
fn composite(begin: f32, end: f32) -> OpenSegment {
    let first = u32(begin);
    var all = part_of(first, begin, end);
    for (var i = first + 1u; i <= last_piece(end); i++) {
        all = appended(all, part_of(i, begin, end));
    }
    return all;
}

// How far the colour and opacity that a ray collects on its way from one border to another are from what it collects in
// the homogeneous composite of that way: the mean distance over the way, times the 11/8-th power of its length in steps.
fn group_error(begin: f32, end: f32) -> f32 {
    let first = u32(begin);
    let last = last_piece(end);
    if (first == last) {
        return 0.0;
    }
    return error_of(first, last, part_of(first, begin, end), part_of(last, begin, end));
}

// The same for the pieces `first` to `last`, with what of these two is in the group.
fn error_of(first: u32, last: u32, front: OpenSegment, back: OpenSegment) -> f32 {
    var all = front;
    for (var i = first + 1u; i < last; i++) {
        all = appended(all, list.segments[i]);
    }
    all = appended(all, back);
    let length = max(all.s1 - all.s0, LENGTH_LEAST);
    let tau_per_length = all.tau / length;
    var collected = front;
    var s_before = all.s0;
    var distance_before = 0.0;
    // Twice the error. Ends of the parts and, where there is a gap, beginnings; both ways agree at the two ends of the group.
    var error = 0.0;
    for (var i = first + 1u; i <= last; i++) {
        var next = back;
        if (i < last) {
            next = list.segments[i];
        }
        let s_end = collected.s1;
        let s_begin = max(next.s0, s_end);
        let at_end = distance_at(collected, all, tau_per_length * (s_end - all.s0));
        let at_begin = distance_at(collected, all, tau_per_length * (s_begin - all.s0));
        error += (distance_before + at_end) * (s_end - s_before) + (at_end + at_begin) * (s_begin - s_end);
        s_before = s_begin;
        distance_before = at_begin;
        collected = appended(collected, next);
    }
    error += distance_before * (all.s1 - s_before);
    let fourth_root = sqrt(sqrt(length / sink.h));
    return 0.5 * error / sink.h * (fourth_root * sqrt(fourth_root)) * sink.visibility[first];
}

// How far what is collected is from what the composite has collected behind an optical depth.
fn distance_at(collected: OpenSegment, all: OpenSegment, tau: f32) -> f32 {
    let share = (1.0 - exp(-tau)) / max(all.alpha, ALPHA_LEAST);
    let color = abs(collected.c - all.c * share);
    let opacity = abs(collected.alpha - all.alpha * share);
    return max(opacity, sink.color_weight * max(max(color.x, color.y), color.z));
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
        groups.first[g] = f32(g);
        groups.error[g] = 0.0;
        groups.joined[g] = INFINITE_COST;
        if (g + 1u < list.len) {
            groups.joined[g] = error_of(g, g + 1u, list.segments[g], list.segments[g + 1u]);
        }
    }
    groups.first[list.len] = f32(list.len);
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
            count_join(greatest);
        }
        groups.error[least] = groups.joined[least];
        groups.len -= 1u;
        for (var g = least + 1u; g < groups.len; g++) {
            groups.error[g] = groups.error[g + 1u];
            groups.joined[g] = groups.joined[g + 1u];
            groups.first[g] = groups.first[g + 1u];
        }
        groups.first[groups.len] = f32(list.len);
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
    let first = u32(groups.first[g]);
    let last = u32(groups.first[g + 2u]) - 1u;
    return error_of(first, last, list.segments[first], list.segments[last]);
}

// Moves each border by a piece, then half of one, then a quarter where that lessens the error of the two groups.
fn settle() {
    for (var g = 1u; g < groups.len; g++) {
        let begin = groups.first[g - 1u];
        let end = groups.first[g + 1u];
        var least = groups.error[g - 1u] + groups.error[g];
        if (least < SETTLED_SHARE * budget.threshold) {
            continue;
        }
        for (var step = 1.0; step > 0.2; step *= 0.5) {
            let border = groups.first[g];
            for (var side = -1.0; side < 2.0; side += 2.0) {
                let moved = border + side * step;
                // A group never begins in a piece with a number below its own: see generate_list.
                if (moved <= begin || moved >= end || moved < f32(g)) {
                    continue;
                }
                let before = group_error(begin, moved);
                let behind = group_error(moved, end);
                if (before + behind < least) {
                    least = before + behind;
                    groups.first[g] = moved;
                    groups.error[g - 1u] = before;
                    groups.error[g] = behind;
                    // The other way it was worse.
                    break;
                }
            }
        }
    }
}

fn generate_list(ray: Ray, lattice: Lattice) {
    gather(ray, lattice, tolerance_from(budget.threshold));
    if (list.len == 0u) {
        return;
    }
    join(longest_list(), budget.threshold, false);
    // Groups of three pieces or fewer have the borders that joining gave them.
    if (list.len > 3u * groups.len) {
        settle();
    }
    // A group begins behind all groups in front of it, so its place in the list is free.
    for (var g = 0u; g < groups.len; g++) {
        list.segments[g] = composite(groups.first[g], groups.first[g + 1u]);
    }
    list.len = groups.len;
}

// While gathering, the error of reading a, the gap and b as one homogeneous piece.
fn merge_cost(a: OpenSegment, b: OpenSegment, h: f32) -> f32 {
    let length = max(b.s1 - a.s0, LENGTH_LEAST);
    let tau = a.tau + b.tau;
    let gap = max(b.s0 - a.s1, 0.0);
    // Times the length.
    let moved = 0.5
        * (abs(a.tau * length - tau * (a.s1 - a.s0)) + abs(b.tau * length - tau * (b.s1 - b.s0)) + tau * gap);
    // |Ea − Eb|·αa·αb with E = C/α.
    let difference = abs(a.c * b.alpha - b.c * a.alpha);
    let mixed = max(max(difference.x, difference.y), difference.z);
    return (MOVED_WEIGHT * moved / (length + moved) + mixed) * (length / h);
}

// Two groups with less than so much of the threshold as their errors keep their border.
const SETTLED_SHARE: f32 = 0.3;
// Least visibility that matter hidden behind opaque matter is counted with: a turned camera will see it.
const VISIBILITY_FLOOR: f32 = 0.2;
// Weight of moved opacity against mixed colour while gathering.
const MOVED_WEIGHT: f32 = 2.0;
// Weight of collected colour, as sRGB, against collected opacity.
const COLOR_WEIGHT: f32 = 6.0;
// Colour below which the slope of sRGB is taken as constant.
const COLOR_DARK: f32 = 0.02;
