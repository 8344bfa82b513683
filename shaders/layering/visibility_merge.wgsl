// Pieces of matter, and their error as homogeneous segments. Twin of
// crates/core/src/kernels/layering/visibility_merge.rs, which derives it. The part before this one is stream.wgsl.

// A piece of a ray, by integrals over its steps.
struct Piece {
    // The piece as one segment.
    c: vec3f,
    tau: f32,
    s0: f32,
    s1: f32,
    alpha: f32,
    // Transmittance in front, at least VISIBILITY_FLOOR.
    visibility: f32,
    // Integral over colour of the distance from the front, in steps.
    color_first: vec3f,
    // Integrals over opacity of the same distance and of its square.
    first: f32,
    second: f32,
}

const PIECE_WORDS: u32 = 13u;

fn piece_at(place: u32) -> Piece {
    return Piece(
        vec3f(open_words[place], open_words[place + LANES], open_words[place + 2u * LANES]),
        open_words[place + 3u * LANES],
        open_words[place + 4u * LANES],
        open_words[place + 5u * LANES],
        open_words[place + 6u * LANES],
        open_words[place + 7u * LANES],
        vec3f(open_words[place + 8u * LANES], open_words[place + 9u * LANES], open_words[place + 10u * LANES]),
        open_words[place + 11u * LANES],
        open_words[place + 12u * LANES],
    );
}

fn put_piece(place: u32, piece: Piece) {
    open_words[place] = piece.c.x;
    open_words[place + LANES] = piece.c.y;
    open_words[place + 2u * LANES] = piece.c.z;
    open_words[place + 3u * LANES] = piece.tau;
    open_words[place + 4u * LANES] = piece.s0;
    open_words[place + 5u * LANES] = piece.s1;
    open_words[place + 6u * LANES] = piece.alpha;
    open_words[place + 7u * LANES] = piece.visibility;
    open_words[place + 8u * LANES] = piece.color_first.x;
    open_words[place + 9u * LANES] = piece.color_first.y;
    open_words[place + 10u * LANES] = piece.color_first.z;
    open_words[place + 11u * LANES] = piece.first;
    open_words[place + 12u * LANES] = piece.second;
}

var<private> steps_per_length: f32;
// Transmittance in front of the next step.
var<private> transmittance: f32;

fn begin_pieces(lattice: Lattice) {
    steps_per_length = 1.0 / lattice.unit;
    transmittance = 1.0;
}

fn end_pieces() {
}

fn sink_step(step: Step) -> u32 {
    let length = (step.s1 - step.s0) * steps_per_length;
    let even = even_moments(step.tau, step.alpha) * vec2f(length, length * length);
    stream_step(
        Piece(
            step.c,
            step.tau,
            step.s0,
            step.s1,
            step.alpha,
            max(transmittance, VISIBILITY_FLOOR),
            step.c * (even.x / max(step.alpha, ALPHA_LEAST)),
            even.x,
            even.y,
        ),
        step.s0,
    );
    transmittance *= 1.0 - step.alpha;
    return pace_behind(transmittance);
}

fn joined(front: Piece, behind: Piece) -> Piece {
    let distance = (behind.s0 - front.s0) * steps_per_length;
    let through = 1.0 - front.alpha;
    let first = behind.first + distance * behind.alpha;
    let second = behind.second + distance * (behind.first + first);
    let color_first = behind.color_first + behind.c * distance;
    return Piece(
        front.c + behind.c * through,
        front.tau + behind.tau,
        front.s0,
        behind.s1,
        front.alpha + behind.alpha * through,
        front.visibility,
        front.color_first + color_first * through,
        front.first + through * first,
        front.second + through * second,
    );
}

fn error_of(piece: Piece) -> f32 {
    let length = max((piece.s1 - piece.s0) * steps_per_length, LENGTH_LEAST);
    let per_alpha = 1.0 / max(piece.alpha, ALPHA_LEAST);
    let even = even_moments(piece.tau, piece.alpha) * vec2f(length, length * length);
    let moved = abs(piece.first - even.x);
    let spread = piece.alpha
        * abs(deviation(piece.first, piece.second, per_alpha) - deviation(even.x, even.y, per_alpha));
    let color = abs(piece.color_first - piece.c * (even.x * per_alpha));
    let displaced = max(moved + spread, COLOR_WEIGHT * max(max(color.x, color.y), color.z));
    return displaced * sqrt(sqrt(length)) * piece.visibility;
}

// Compares the fourth power of the error without its spread: this takes no root and one division.
fn is_within(piece: Piece, limit: f32) -> bool {
    let length = (piece.s1 - piece.s0) * steps_per_length;
    let even_first = even_moments(piece.tau, piece.alpha).x * length;
    let color = abs(piece.color_first * piece.alpha - piece.c * even_first);
    let moved = abs(piece.first - even_first) * piece.alpha;
    var error = max(moved, COLOR_WEIGHT * max(max(color.x, color.y), color.z)) * piece.visibility;
    error *= error;
    let bound = (limit * piece.alpha) * (limit * piece.alpha);
    return error * error * length <= bound * bound;
}

// ∫s dα and ∫s² dα through a homogeneous medium of unit length.
fn even_moments(tau: f32, alpha: f32) -> vec2f {
    if (tau < SERIES_BELOW) {
        return tau * vec2f(
            1.0 / 2.0 - tau * (1.0 / 3.0 - tau * (1.0 / 8.0 - tau * (1.0 / 30.0))),
            1.0 / 3.0 - tau * (1.0 / 4.0 - tau * (1.0 / 10.0 - tau * (1.0 / 36.0))),
        );
    }
    let lost = tau * (1.0 - alpha);
    let per_tau = 1.0 / tau;
    let first = (alpha - lost) * per_tau;
    return vec2f(first, (2.0 * first - lost) * per_tau);
}

// Standard deviation of a distance, from its integrals over a total of 1/per_total.
fn deviation(first: f32, second: f32, per_total: f32) -> f32 {
    let mean = first * per_total;
    return sqrt(max(second * per_total - mean * mean, 0.0));
}

// Least visibility of matter.
const VISIBILITY_FLOOR: f32 = 0.1;
// Weight of displaced colour, as sRGB, against displaced opacity.
const COLOR_WEIGHT: f32 = 6.0;
// Least length that is divided by: surfaces may coincide.
const LENGTH_LEAST: f32 = 1e-30;
// Below this optical depth the series are used. Their first omitted term is below 10⁻⁵, like the rounding of the
// differences.
const SERIES_BELOW: f32 = 0.1;
