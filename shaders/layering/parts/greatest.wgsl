// Pieces of a projection of the greatest or the least value (projection.wgsl). Twin of GreatestForm.

const ITEM_WORDS: u32 = 5u;

fn gather_items(ray: Ray, lattice: Lattice) {
    generate_list(ray, lattice);
}

fn begin_segments() {
}

fn push_piece(piece: Piece) {
    put_word(0u, bitcast<u32>(piece.s0));
    put_word(1u, bitcast<u32>(piece.s1));
    put_word(2u, bitcast<u32>(piece.peak));
    put_word(3u, bitcast<u32>(piece.first));
    put_word(4u, bitcast<u32>(piece.second));
    end_item();
}

fn end_pieces() {
}
