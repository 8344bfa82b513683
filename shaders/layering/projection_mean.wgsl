// Segments of the mean (projection.wgsl).

fn begin_segments() {
}

fn push_piece(piece: Piece) {
    let length = lattice_of_ray.h * f32(lattice_of_ray.n);
    if (piece.first > 0.0) {
        push(OpenSegment(piece.shown / length, 0.0, piece.s0, piece.s1, 0.0));
    }
}

fn end_pieces() {
}

fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment {
    return OpenSegment(segment.c + behind.c, 0.0, segment.s0, behind.s1, 0.0);
}
