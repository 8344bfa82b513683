// Segments of the mean (projection.wgsl).

fn push_pieces(lattice: Lattice) {
    let length = lattice.h * f32(lattice.n);
    for (var i = 0u; i < sink.len; i++) {
        let piece = sink.pieces[i];
        if (piece.first <= 0.0) {
            continue;
        }
        var ends = vec2f(piece.s0, piece.s1);
        if IS_POINT {
            ends = vec2f(lattice.s0 + piece.second / piece.first);
        }
        push(OpenSegment(piece.shown / length, 0.0, ends.x, ends.y, 0.0));
    }
}

fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment {
    return OpenSegment(segment.c + behind.c, 0.0, segment.s0, behind.s1, 0.0);
}
