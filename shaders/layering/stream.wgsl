// Lists made while their rays are marched, with few pieces open at once. Twin of
// crates/core/src/kernels/layering/stream.rs, which derives it. All that is open is in registers.
//
// The part after this one says what a piece is:
//   struct Piece, whose s1 is the world distance of its back
//   fn begin_pieces(lattice: Lattice)
//   fn joined(front: Piece, behind: Piece) -> Piece
//   fn error_of(piece: Piece) -> f32
//   fn push_piece(piece: Piece), which makes it a segment
//   fn end_pieces()
// and hands its steps to stream_step.

struct Stream {
    threshold: f32,
    // World distance where the ray begins, and the inverse of its length.
    s0: f32,
    per_length: f32,
    // Pieces that became segments.
    num_out: u32,
    has_coming: bool,
    num_open: u32,
}

var<private> stream: Stream;
var<private> coming: Piece;
// The open pieces; the last is the farthest. Fewer than four are the last ones.
var<private> open_0: Piece;
var<private> open_1: Piece;
var<private> open_2: Piece;
var<private> open_3: Piece;
// Error of two neighbours as one.
var<private> joint_01: f32;
var<private> joint_12: f32;
var<private> joint_23: f32;

fn generate_list(ray: Ray, lattice: Lattice) {
    list_at(budget.threshold, ray, lattice);
}

fn list_at(threshold: f32, ray: Ray, lattice: Lattice) {
    stream = Stream(threshold, lattice.s0, 1.0 / (lattice.h * f32(lattice.n)), 0u, false, 0u);
    joint_01 = INFINITE_ERROR;
    joint_12 = INFINITE_ERROR;
    joint_23 = INFINITE_ERROR;
    begin_pieces(lattice);
    march(ray, lattice);
    finish_stream();
    end_pieces();
}

fn joint(front: Piece, behind: Piece) -> f32 {
    return error_of(joined(front, behind));
}

// The greatest error that a segment may have behind which the ray is at s.
fn limit(s: f32) -> f32 {
    let passed = (s - stream.s0) * stream.per_length;
    let haste = max(f32(stream.num_out) / f32(longest_list()) / (passed + HEAD_START), 1.0);
    return stream.threshold * ((haste * haste) * (haste * haste));
}

// Takes the next step, which begins at the world distance s0.
fn stream_step(step: Piece, s0: f32) {
    if (stream.has_coming) {
        let both = joined(coming, step);
        if (error_of(both) <= COMING_SHARE * limit(s0)) {
            coming = both;
            return;
        }
        open_piece(coming);
    }
    coming = step;
    stream.has_coming = true;
}

fn open_piece(come: Piece) {
    var joint_last = INFINITE_ERROR;
    if (stream.num_open > 0u) {
        joint_last = joint(open_3, come);
    }
    let least = min(min(joint_01, joint_12), min(joint_23, joint_last));
    let is_full = stream.num_open == WINDOW;
    let is_over = least > limit(open_0.s1) && stream.num_out + WINDOW < longest_list();
    if (is_full && is_over) {
        push_piece(open_0);
        stream.num_out += 1u;
    }
    if (!is_full || is_over) {
        stream.num_open = min(stream.num_open + 1u, WINDOW);
        open_0 = open_1;
        open_1 = open_2;
        open_2 = open_3;
        open_3 = come;
        joint_01 = joint_12;
        joint_12 = joint_23;
        joint_23 = joint_last;
        return;
    }
    // The first of the least is joined; what is behind it moves up.
    let is_0 = least == joint_01;
    let is_1 = !is_0 && least == joint_12;
    let is_2 = !is_0 && !is_1 && least == joint_23;
    if (is_0 || is_1 || is_2) {
        if (is_0) {
            open_0 = joined(open_0, open_1);
            open_1 = open_2;
            open_2 = open_3;
            joint_12 = joint_23;
        } else if (is_1) {
            open_1 = joined(open_1, open_2);
            open_2 = open_3;
        } else {
            open_2 = joined(open_2, open_3);
        }
        open_3 = come;
    } else {
        open_3 = joined(open_3, come);
    }
    if (is_0 || is_1) {
        joint_01 = joint(open_0, open_1);
        joint_23 = joint_last;
    } else {
        joint_23 = joint(open_2, open_3);
    }
    if (is_1 || is_2) {
        joint_12 = joint(open_1, open_2);
    }
}

// The ray is over: neighbours are joined, cheapest first, and the rest are segments.
fn finish_stream() {
    if (stream.has_coming) {
        open_piece(coming);
    }
    while (stream.num_open > 1u) {
        let least = min(joint_01, min(joint_12, joint_23));
        if (least > stream.threshold) {
            break;
        }
        if (least == joint_01) {
            open_1 = joined(open_0, open_1);
        } else if (least == joint_12) {
            open_2 = joined(open_1, open_2);
            open_1 = open_0;
        } else {
            open_3 = joined(open_2, open_3);
            open_2 = open_1;
            open_1 = open_0;
        }
        stream.num_open -= 1u;
        joint_01 = INFINITE_ERROR;
        joint_12 = INFINITE_ERROR;
        joint_23 = INFINITE_ERROR;
        if (stream.num_open > 2u) {
            joint_12 = joint(open_1, open_2);
        }
        if (stream.num_open > 1u) {
            joint_23 = joint(open_2, open_3);
        }
    }
    if (stream.num_open > 3u) {
        push_piece(open_0);
    }
    if (stream.num_open > 2u) {
        push_piece(open_1);
    }
    if (stream.num_open > 1u) {
        push_piece(open_2);
    }
    if (stream.num_open > 0u) {
        push_piece(open_3);
    }
}

// Pieces that are open at once.
const WINDOW: u32 = 4u;
// Of the limit, for the piece that comes in.
const COMING_SHARE: f32 = 0.35;
// A list may be filled by this much more than its ray has passed.
const HEAD_START: f32 = 0.05;
// More than any error: WGSL has no infinity.
const INFINITE_ERROR: f32 = 3.4e38;
