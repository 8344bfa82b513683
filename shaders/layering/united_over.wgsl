// Segments of a medium (visibility_merge.wgsl), and two of them as one.

fn push_piece(piece: Piece) {
    push(OpenSegment(piece.c, piece.tau, piece.s0, piece.s1, piece.alpha));
}

fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment {
    return appended(segment, behind);
}
