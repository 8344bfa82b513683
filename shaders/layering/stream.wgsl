// Lists made while their rays are marched, with few pieces open at once. Twin of
// crates/core/src/kernels/layering/stream.rs, which derives it. The piece that comes in is in registers. Those that are open
// are asked for rarely and stay in the memory of the workgroup: in registers they would halve the waves that hide each
// other's waits, and in private memory they would be far away.
//
// The part after this one says what a piece is:
//   struct Piece, whose s1 is the world distance of its back
//   const PIECE_WORDS: u32, fn piece_at(place: u32) -> Piece and fn put_piece(place: u32, piece: Piece), which read and write
//   the words of one in open_words, a workgroup's lanes apart
//   fn begin_pieces(lattice: Lattice)
//   fn joined(front: Piece, behind: Piece) -> Piece
//   fn error_of(piece: Piece) -> f32
//   fn is_within(piece: Piece, limit: f32) -> bool, which is about whether the error is
//   fn push_piece(piece: Piece), which makes it a segment
//   fn end_pieces()
// and hands its steps to stream_step.

struct Stream {
    threshold: f32,
    // World distance of the ray's start, and the inverse of its length.
    s0: f32,
    per_length: f32,
    // Number of segments so far.
    num_out: u32,
    has_coming: bool,
    // The error limit of the coming piece.
    coming_limit: f32,
    num_open: u32,
    // Places of the open pieces, four bits each, followed by the free ones.
    order: u32,
    // Index of the ray in its workgroup.
    lane: u32,
}

var<private> stream: Stream;
var<private> coming: Piece;

fn generate_list(ray: Ray, lattice: Lattice) {
    list_at(budget.threshold, ray, lattice);
}

fn list_at(threshold: f32, ray: Ray, lattice: Lattice) {
    let start = lattice.s0 + f32(lattice.first) * lattice.h;
    let per_length = 1.0 / (lattice.h * f32(lattice.n - lattice.first));
    stream = Stream(threshold, start, per_length, 0u, false, 0.0, 0u, 0x43210u, out.lane);
    begin_pieces(lattice);
    march(ray, lattice);
    finish_stream();
    end_pieces();
}

// The greatest error of a segment when the ray has reached s.
fn limit(s: f32) -> f32 {
    let passed = (s - stream.s0) * stream.per_length;
    let haste = max(f32(stream.num_out) / f32(budget.longest) / (passed + HEAD_START), 1.0);
    return stream.threshold * ((haste * haste) * (haste * haste));
}

// Takes the next step, which begins at the world distance s0.
fn stream_step(step: Piece, s0: f32) {
    if (stream.has_coming) {
        let both = joined(coming, step);
        // Joining across a gap spreads matter as well as moving it.
        var fits = is_within(both, stream.coming_limit);
        if (fits && s0 > coming.s1) {
            fits = error_of(both) <= stream.coming_limit;
        }
        if (fits) {
            coming = both;
            return;
        }
        open_piece(coming);
    }
    coming = step;
    stream.has_coming = true;
    stream.coming_limit = COMING_SHARE * limit(s0);
}

fn place_of(k: u32) -> u32 {
    return (stream.order >> (4u * k)) & 15u;
}

fn open_at(k: u32) -> Piece {
    return piece_at(place_of(k) * PIECE_WORDS * LANES + stream.lane);
}

fn put(k: u32, piece: Piece) {
    put_piece(place_of(k) * PIECE_WORDS * LANES + stream.lane, piece);
}

// Closes piece k and frees its place.
fn remove(k: u32) {
    let before = (1u << (4u * k)) - 1u;
    let place = place_of(k);
    stream.order = (stream.order & before) | ((stream.order >> 4u) & ~before) | (place << (4u * WINDOW));
    stream.num_open -= 1u;
}

// Index of the joint error of open piece k and the one behind it.
fn joint_at(k: u32) -> u32 {
    return place_of(k) * LANES + stream.lane;
}

fn joint(front: Piece, behind: Piece) -> f32 {
    return error_of(joined(front, behind));
}

fn open_piece(come: Piece) {
    if (stream.num_open > 0u) {
        let last = stream.num_open - 1u;
        joints[joint_at(last)] = joint(open_at(last), come);
    }
    put(stream.num_open, come);
    stream.num_open += 1u;
    if (stream.num_open <= WINDOW) {
        return;
    }
    let least = least_joint();
    let is_over = joints[joint_at(least)] > limit(open_at(0u).s1);
    if (is_over && stream.num_out + WINDOW < budget.longest) {
        push_piece(open_at(0u));
        stream.num_out += 1u;
        remove(0u);
    } else {
        join(least);
    }
}

// Joins the open piece `first` with the one behind it.
fn join(first: u32) {
    let both = joined(open_at(first), open_at(first + 1u));
    put(first, both);
    remove(first + 1u);
    // Its joint error changes, and so does that of the piece in front.
    if (first > 0u) {
        joints[joint_at(first - 1u)] = joint(open_at(first - 1u), both);
    }
    if (first + 1u < stream.num_open) {
        joints[joint_at(first)] = joint(both, open_at(first + 1u));
    }
}

// The first of the least joint errors.
fn least_joint() -> u32 {
    var least = 0u;
    var error = joints[joint_at(0u)];
    for (var k = 1u; k + 1u < stream.num_open; k++) {
        let other = joints[joint_at(k)];
        if (other < error) {
            least = k;
            error = other;
        }
    }
    return least;
}

// Ends the ray: neighbours are joined, cheapest first, and the rest become segments.
fn finish_stream() {
    if (stream.has_coming) {
        open_piece(coming);
    }
    while (stream.num_open > 1u) {
        let least = least_joint();
        if (joints[joint_at(least)] > stream.threshold) {
            break;
        }
        join(least);
    }
    for (var k = 0u; k < stream.num_open; k++) {
        push_piece(open_at(k));
    }
}

// Open pieces of all rays of a workgroup.
var<workgroup> open_words: array<f32, (WINDOW + 1) * PIECE_WORDS * LANES>;
// Joint error of each open piece and the one behind it.
var<workgroup> joints: array<f32, (WINDOW + 1) * LANES>;

// Number of open pieces.
const WINDOW: u32 = 4u;
// Share of the limit for the coming piece.
const COMING_SHARE: f32 = 0.5;
// How far a list's fill may run ahead of its ray.
const HEAD_START: f32 = 0.05;
// Rays of a workgroup.
const LANES: u32 = 32u;
