// Pieces of a mean (projection.wgsl). Twin of MeanForm.

const ITEM_WORDS: u32 = 8u;

fn gather_items(ray: Ray, lattice: Lattice) {
    generate_list(ray, lattice);
}

fn begin_segments() {
}

fn push_piece(piece: Piece) {
    put_word(0u, bitcast<u32>(piece.s0));
    put_word(1u, bitcast<u32>(piece.s1));
    put_word(2u, bitcast<u32>(piece.first));
    put_word(3u, bitcast<u32>(piece.second));
    put_word(4u, bitcast<u32>(piece.third));
    put_word(5u, bitcast<u32>(piece.shown.x));
    put_word(6u, bitcast<u32>(piece.shown.y));
    put_word(7u, bitcast<u32>(piece.shown.z));
    end_item();
}

fn end_pieces() {
}
