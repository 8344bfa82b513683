// Segments of the greatest or the least value (projection.wgsl).

// The greatest peak of the written segments, and the index of the first one with it.
var<private> greatest: f32;
var<private> holder: u32;

fn begin_segments() {
    greatest = -1.0;
    holder = 0u;
}

fn push_piece(piece: Piece) {
    let key = key_of_piece(piece);
    if (piece.peak > greatest) {
        greatest = piece.peak;
        holder = out.len;
    } else if (key <= tables[0].key_limit) {
        // It neither shows nor hides anything.
        return;
    }
    push(OpenSegment(shown_of_key(key), slot_from_key(key), piece.s0, piece.s1, 0.0));
}

// Gives the ray's greatest key to the segment that holds it, and lower ones to all others.
fn end_pieces() {
    if (out.is_counted || out.len == 0u) {
        return;
    }
    // The greatest key stays at least one codec step above those below it.
    let key = max(greatest, 2.0 * KEY_LEAST);
    let below = half_below(slot_from_key(key));
    for (var j = 0u; j < out.len; j++) {
        var segment = taken(j);
        segment.tau = min(segment.tau, below);
        if (j == holder) {
            segment.c = shown_of_key(key);
            segment.tau = slot_from_key(key);
        }
        put_segment(j, segment, segment.s0, segment.s1);
    }
}

fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment {
    if (behind.tau > segment.tau) {
        return OpenSegment(behind.c, behind.tau, segment.s0, behind.s1, 0.0);
    }
    return segment;
}
