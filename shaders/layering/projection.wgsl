// Lists of the projections. Twin of crates/core/src/kernels/layering/projection.rs, which derives it. The part before this
// one is stream.wgsl.
//
// Before that stands a generated line: const IS_MEAN: bool. The part behind this one makes segments of the pieces:
//   fn push_piece(piece: Piece)
//   fn end_pieces()

// A piece of a ray, by sums over its steps.
struct Piece {
    shown: vec3f,
    s0: f32,
    s1: f32,
    // Greatest key.
    peak: f32,
    // Integrals of the key and its square. For a mean: of the brightness, and of the brightness times the distance.
    first: f32,
    second: f32,
    // Integral of the brightness times the square of the distance.
    third: f32,
}

const PIECE_WORDS: u32 = 9u;

fn piece_at(place: u32) -> Piece {
    return Piece(
        vec3f(open_words[place], open_words[place + LANES], open_words[place + 2u * LANES]),
        open_words[place + 3u * LANES],
        open_words[place + 4u * LANES],
        open_words[place + 5u * LANES],
        open_words[place + 6u * LANES],
        open_words[place + 7u * LANES],
        open_words[place + 8u * LANES],
    );
}

fn put_piece(place: u32, piece: Piece) {
    open_words[place] = piece.shown.x;
    open_words[place + LANES] = piece.shown.y;
    open_words[place + 2u * LANES] = piece.shown.z;
    open_words[place + 3u * LANES] = piece.s0;
    open_words[place + 4u * LANES] = piece.s1;
    open_words[place + 5u * LANES] = piece.peak;
    open_words[place + 6u * LANES] = piece.first;
    open_words[place + 7u * LANES] = piece.second;
    open_words[place + 8u * LANES] = piece.third;
}

var<private> lattice_of_ray: Lattice;

fn begin_pieces(lattice: Lattice) {
    lattice_of_ray = lattice;
    begin_segments();
}

fn sink_step(step: Step) -> u32 {
    stream_step(piece_of(step), step.s0);
    return 1u;
}

fn piece_of(step: Step) -> Piece {
    let length = step.s1 - step.s0;
    if IS_MEAN {
        let brightness = max(max(step.c.x, step.c.y), step.c.z);
        let middle = 0.5 * (step.s0 + step.s1) - lattice_of_ray.s0;
        let around = middle * middle + length * length * (1.0 / 12.0);
        return Piece(step.c, step.s0, step.s1, 0.0, brightness, brightness * middle, brightness * around);
    }
    return Piece(vec3f(0.0), step.s0, step.s1, step.tau, step.alpha * length, step.c.x * length, 0.0);
}

fn joined(front: Piece, behind: Piece) -> Piece {
    return Piece(
        front.shown + behind.shown,
        front.s0,
        behind.s1,
        max(front.peak, behind.peak),
        front.first + behind.first,
        front.second + behind.second,
        front.third + behind.third,
    );
}

// The key of a segment that does not hold the greatest of its ray.
fn key_of_piece(piece: Piece) -> f32 {
    let mean = piece.first / (piece.s1 - piece.s0);
    return mean + (piece.peak - mean) * PEAK_SHARE;
}

fn error_of(piece: Piece) -> f32 {
    let length = piece.s1 - piece.s0;
    let h = lattice_of_ray.unit;
    var error = 0.0;
    if IS_MEAN {
        let per_brightness = 1.0 / max(piece.first, BRIGHTNESS_LEAST);
        let mean = piece.second * per_brightness;
        let deviation = sqrt(max(piece.third * per_brightness - mean * mean, 0.0));
        let middle = 0.5 * (piece.s0 + piece.s1) - lattice_of_ray.s0;
        let apart = abs(mean - middle) + abs(deviation - length * EVEN_DEVIATION);
        error = piece.first * apart / (h * h);
    } else {
        let key = key_of_piece(piece);
        let square = key * key * length - 2.0 * key * piece.first + piece.second;
        error = piece.peak * piece.peak * max(square, 0.0) / h;
    }
    // Infinite errors give NaN; then pieces are simply joined.
    return select(0.0, error, error >= 0.0);
}

fn is_within(piece: Piece, limit: f32) -> bool {
    return error_of(piece) <= limit;
}

// Position between the mean key of a piece (0) and its greatest (1).
const PEAK_SHARE: f32 = 0.75;
// Standard deviation of a uniform distribution, in lengths.
const EVEN_DEVIATION: f32 = 0.28867513;
// Least brightness that is divided by.
const BRIGHTNESS_LEAST: f32 = 1e-30;
