// Segments of the greatest or the least value (projection.wgsl).

fn push_pieces(lattice: Lattice) {
    var greatest = -1.0;
    for (var i = 0u; i < sink.len; i++) {
        greatest = max(greatest, sink.pieces[i].peak);
    }
    let below = half_below(slot_from_key(max(greatest, 2.0 * KEY_LEAST)));
    var has_greatest = false;
    for (var i = 0u; i < sink.len; i++) {
        let piece = sink.pieces[i];
        // The first of equals: one must win.
        let is_greatest = piece.peak == greatest && !has_greatest;
        has_greatest = has_greatest || is_greatest;
        let is_plain = NUM_CUTS > 0u;
        var key = piece.peak;
        if (!is_greatest && !is_plain) {
            key = key_of_piece(piece);
        }
        if (piece.peak < 0.0 || key <= table.key_limit) {
            continue;
        }
        var ends = vec2f(piece.s0, piece.s1);
        if IS_POINT {
            ends = piece.peak_ends;
        }
        // Apart from those below it by a code of the codec at least.
        let slot = slot_from_key(select(key, max(key, 2.0 * KEY_LEAST), is_greatest));
        push(OpenSegment(shown_of_key(key), select(min(slot, below), slot, is_greatest), ends.x, ends.y, 0.0));
    }
}

fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment {
    if (behind.tau > segment.tau) {
        return OpenSegment(behind.c, behind.tau, segment.s0, behind.s1, 0.0);
    }
    return segment;
}
