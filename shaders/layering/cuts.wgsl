// Segments between planes at equal distances along a ray: what equal-length and slabs share. Twin of
// crates/core/src/kernels/layering/cuts.rs.

struct Cuts {
    // World distance of plane 0.
    first: f32,
    // World distance from one plane to the next.
    length: f32,
    // Whether a segment spans all of its interval; else it spans its content.
    spans_all: bool,
    // The open segment lies between the planes i and i + 1.
    i: u32,
    open: OpenSegment,
    transmittance: f32,
}

var<private> cuts: Cuts;

fn cuts_begin(first: f32, length: f32, spans_all: bool) {
    cuts = Cuts(first, length, spans_all, 0u, no_segment(), 1.0);
}

// World distance of plane i.
fn plane(i: u32) -> f32 {
    return cuts.first + cuts.length * f32(i);
}

// Adds a piece to the open segment.
fn extend(piece: Step) {
    if (piece.tau > 0.0) {
        if (cuts.open.tau == 0.0) {
            cuts.open.s0 = piece.s0;
        }
        cuts.open = appended(cuts.open, piece);
    }
}

// Ends the open segment.
fn close() {
    if (cuts.open.tau > TAU_MIN) {
        if (cuts.spans_all) {
            cuts.open.s0 = plane(cuts.i);
            cuts.open.s1 = plane(cuts.i + 1u);
        }
        push(cuts.open);
    }
    cuts.open = no_segment();
    cuts.i += 1u;
}

fn cuts_step(step: Step) -> u32 {
    var rest = step;
    while (cuts.i + 1u < K && rest.s1 > plane(cuts.i + 1u)) {
        let part = (plane(cuts.i + 1u) - rest.s0) / (rest.s1 - rest.s0);
        let parts = split(rest, clamp(part, 0.0, 1.0));
        extend(parts.near);
        rest = parts.far;
        close();
    }
    extend(rest);
    cuts.transmittance *= 1.0 - step.alpha;
    return pace_behind(cuts.transmittance);
}
