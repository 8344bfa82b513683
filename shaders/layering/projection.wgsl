// Lists of the projections. Twin of crates/core/src/kernels/layering/projection.rs, which derives it. OPEN pieces are
// gathered.
//
// Before this part stand the budget (budget.wgsl) and generated lines: const NUM_CUTS: u32, cuts at equal lengths instead of merging, if not 0, const IS_POINT: bool, whether a
// segment stands where the greatest key is, and const IS_MEAN: bool. The part behind it makes segments of the pieces:
//   fn push_pieces(lattice: Lattice)

// A piece of a ray, by sums over its steps.
struct Piece {
    shown: vec3f,
    s0: f32,
    s1: f32,
    // Greatest key, and the ends of the step that has it.
    peak: f32,
    peak_ends: vec2f,
    // Integrals of the key and its square; of a mean, of the brightness and of that times the distance.
    first: f32,
    second: f32,
    // Integral of the brightness times the square of the distance.
    third: f32,
}

// The pieces of one ray.
struct Gather {
    lattice: Lattice,
    tolerance: f32,
    len: u32,
    pieces: array<Piece, OPEN + 1>,
    // Cost of merging a piece with the one behind it.
    cost: array<f32, OPEN + 1>,
}

var<private> sink: Gather;

fn gather(ray: Ray, lattice: Lattice, tolerance: f32) {
    sink.lattice = lattice;
    sink.tolerance = tolerance;
    sink.len = 0u;
    march(ray, lattice);
}

fn piece_of(step: Step) -> Piece {
    let length = step.s1 - step.s0;
    let ends = vec2f(step.s0, step.s1);
    if IS_MEAN {
        let brightness = max(max(step.c.x, step.c.y), step.c.z);
        let middle = 0.5 * (step.s0 + step.s1) - sink.lattice.s0;
        let around = middle * middle + length * length * (1.0 / 12.0);
        return Piece(step.c, step.s0, step.s1, 0.0, ends, brightness, brightness * middle, brightness * around);
    }
    return Piece(vec3f(0.0), step.s0, step.s1, step.tau, ends, step.alpha * length, step.c.x * length, 0.0);
}

fn joined(front: Piece, behind: Piece) -> Piece {
    let is_higher = behind.peak > front.peak;
    return Piece(
        front.shown + behind.shown,
        front.s0,
        behind.s1,
        max(front.peak, behind.peak),
        select(front.peak_ends, behind.peak_ends, is_higher),
        front.first + behind.first,
        front.second + behind.second,
        front.third + behind.third,
    );
}

// The key that it shows if it does not hold the greatest of its ray.
fn key_of_piece(piece: Piece) -> f32 {
    let mean = piece.first / (piece.s1 - piece.s0);
    return mean + (piece.peak - mean) * PEAK_SHARE;
}

fn error_of(piece: Piece) -> f32 {
    let length = piece.s1 - piece.s0;
    let h = sink.lattice.unit;
    if IS_MEAN {
        let per_brightness = 1.0 / max(piece.first, BRIGHTNESS_LEAST);
        let mean = piece.second * per_brightness;
        let deviation = sqrt(max(piece.third * per_brightness - mean * mean, 0.0));
        let middle = 0.5 * (piece.s0 + piece.s1) - sink.lattice.s0;
        let apart = abs(mean - middle) + abs(deviation - length * EVEN_DEVIATION);
        return piece.first * apart / (h * h);
    }
    let key = key_of_piece(piece);
    let square = key * key * length - 2.0 * key * piece.first + piece.second;
    return piece.peak * piece.peak * max(square, 0.0) / h;
}

// What joining piece i with `behind` adds to the sum of errors.
fn growth(i: u32, behind: Piece) -> f32 {
    let front = sink.pieces[i];
    let growth = error_of(joined(front, behind)) - error_of(front) - error_of(behind);
    // Not a number where errors are infinite: pieces must be joined.
    return select(0.0, growth, growth <= 0.0 || growth > 0.0);
}

fn sink_step(step: Step) -> u32 {
    let piece = piece_of(step);
    if (NUM_CUTS > 0u) {
        add_to_cut(piece);
        return 1u;
    }
    if (sink.len > 0u && growth(sink.len - 1u, piece) <= sink.tolerance) {
        sink.pieces[sink.len - 1u] = joined(sink.pieces[sink.len - 1u], piece);
        return 1u;
    }
    sink.pieces[sink.len] = piece;
    sink.len += 1u;
    if (sink.len > OPEN) {
        thin_out();
    }
    return 1u;
}

fn add_to_cut(piece: Piece) {
    let middle = 0.5 * (piece.s0 + piece.s1) - sink.lattice.s0;
    let share = middle / (sink.lattice.h * f32(sink.lattice.n));
    let cut = min(u32(share * f32(NUM_CUTS)), max(NUM_CUTS, 1u) - 1u);
    // Those before are there, if only empty; what follows is where it belongs.
    while (sink.len <= cut) {
        sink.pieces[sink.len] = Piece(vec3f(0.0), 0.0, 0.0, -1.0, vec2f(0.0), 0.0, 0.0, 0.0);
        sink.len += 1u;
    }
    if (sink.pieces[cut].peak < 0.0) {
        sink.pieces[cut] = piece;
    } else {
        sink.pieces[cut] = joined(sink.pieces[cut], piece);
    }
}

// Of OPEN + 1 pieces merges neighbours, and raises the tolerance to where most of the cheap pairs merge.
fn thin_out() {
    var sum_of_inverses = 0.0;
    var least = INFINITE_COST;
    for (var i = 0u; i < OPEN; i++) {
        let cost = growth(i, sink.pieces[i + 1u]);
        sink.cost[i] = cost;
        sum_of_inverses += 1.0 / max(cost, COST_LEAST);
        least = min(least, cost);
    }
    sink.cost[OPEN] = INFINITE_COST;
    sink.tolerance = max(max(f32(OPEN) / sum_of_inverses, 2.0 * sink.tolerance), least);
    var kept = 0u;
    var i = 0u;
    while (i <= OPEN) {
        var piece = sink.pieces[i];
        if (i < OPEN && sink.cost[i] <= sink.tolerance && sink.cost[i] <= sink.cost[min(i + 1u, OPEN)]) {
            i += 1u;
            piece = joined(piece, sink.pieces[i]);
        }
        sink.pieces[kept] = piece;
        kept += 1u;
        i += 1u;
    }
    sink.len = kept;
}

fn num_gathered() -> u32 {
    return sink.len;
}

// Joins pieces, cheapest first, until there are at most `most` and the next join costs more than `threshold`. With
// `is_sample` the greatest cost so far is counted before each join.
fn join(most: u32, threshold: f32, is_sample: bool) {
    for (var i = 0u; i < sink.len; i++) {
        sink.cost[i] = INFINITE_COST;
        if (i + 1u < sink.len) {
            sink.cost[i] = growth(i, sink.pieces[i + 1u]);
        }
    }
    var greatest = 0.0;
    while (sink.len > 1u) {
        var least = 0u;
        for (var i = 1u; i + 1u < sink.len; i++) {
            if (sink.cost[i] < sink.cost[least]) {
                least = i;
            }
        }
        greatest = max(greatest, sink.cost[least]);
        if (sink.len <= most && greatest > threshold) {
            break;
        }
        if (is_sample) {
            count_join(greatest);
        }
        sink.pieces[least] = joined(sink.pieces[least], sink.pieces[least + 1u]);
        sink.len -= 1u;
        for (var i = least + 1u; i < sink.len; i++) {
            sink.pieces[i] = sink.pieces[i + 1u];
        }
        for (var i = least; i < sink.len; i++) {
            sink.cost[i] = sink.cost[i + 1u];
        }
        sink.cost[sink.len - 1u] = INFINITE_COST;
        if (least + 1u < sink.len) {
            sink.cost[least] = growth(least, sink.pieces[least + 1u]);
        }
        if (least > 0u) {
            sink.cost[least - 1u] = growth(least - 1u, sink.pieces[least]);
        }
    }
}

fn generate_list(ray: Ray, lattice: Lattice) {
    gather(ray, lattice, tolerance_from(budget.threshold));
    if (NUM_CUTS == 0u) {
        join(longest_list(), budget.threshold, false);
    }
    list.len = 0u;
    push_pieces(lattice);
}

// Of the way from the mean key of a piece to its greatest.
const PEAK_SHARE: f32 = 0.75;
// Deviation of an even distribution, in lengths.
const EVEN_DEVIATION: f32 = 0.28867513;
// A piece without any is divided by this.
const BRIGHTNESS_LEAST: f32 = 1e-30;
