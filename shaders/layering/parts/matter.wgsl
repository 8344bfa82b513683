// Pieces of matter (visibility_merge.wgsl): both ends, optical depth and colour, and how far opacity and colour are
// displaced. Twin of MatterForm.

const ITEM_WORDS: u32 = 7u;

fn gather_items(ray: Ray, lattice: Lattice) {
    generate_list(ray, lattice);
}

// Colours are those of opaque matter. Displacements are against a homogeneous medium, as shares of the length.
fn push_piece(piece: Piece) {
    let per_alpha = 1.0 / max(piece.alpha, ALPHA_LEAST);
    let color = piece.c * per_alpha;
    let length = max((piece.s1 - piece.s0) * steps_per_length, LENGTH_LEAST);
    let even = even_moments(piece.tau, piece.alpha) * per_alpha;
    let per_moment = 1.0 / max(length * piece.alpha, ALPHA_LEAST);
    let first = piece.first * per_moment - even.x;
    let second = piece.second * per_moment / length - even.y;
    let moved = (piece.color_first * per_moment - color * even.x) * (1.0 / COLOR_MAX);
    put_word(0u, bitcast<u32>(piece.s0));
    put_word(1u, bitcast<u32>(piece.s1));
    put_word(2u, bitcast<u32>(piece.tau));
    put_word(3u, pack_halves(color.x, color.y));
    put_word(4u, pack_halves(color.z, 0.0) | (code(first) << 16u));
    put_word(5u, code(second) | (code(moved.x) << 16u));
    put_word(6u, code(moved.y) | (code(moved.z) << 16u));
    end_item();
}

// A number from -1 to 1 in 16 bits.
fn code(x: f32) -> u32 {
    return u32(i32(round(clamp(x, -1.0, 1.0) * CODES))) & 0xffffu;
}

// Codes of positive numbers.
const CODES: f32 = 32767.0;
