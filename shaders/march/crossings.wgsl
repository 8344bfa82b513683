// Where the values pass those of surfaces. Twin of `cross` in crates/core/src/kernels/march/modes.rs. The part behind this
// one says what becomes of a crossing:
//   fn crossing(step: Step, to_greater: bool, lattice: Lattice) -> u32

fn take(between: Between) -> u32 {
    var pace = NO_STEP;
    let to_greater = between.x1 > between.x0;
    let num = tables[0].num_surfaces;
    var last = between.s0;
    for (var n = 0u; n < num; n++) {
        let surface = tables[0].surfaces[select(num - 1u - n, n, to_greater)];
        let is_before = between.x0 < surface.x;
        if (is_before == (between.x1 < surface.x)) {
            continue;
        }
        // On the chord, and twice on the chord of the part that still passes the value.
        var a = vec2f(between.s0, between.x0);
        var b = vec2f(between.s1, between.x1);
        var s = chord(a, b, surface.x);
        for (var i = 0u; i < REFINEMENTS; i++) {
            let x = domain_at(between.line.origin + between.line.dir * s);
            if ((x < surface.x) == is_before) {
                a = vec2f(s, x);
            } else {
                b = vec2f(s, x);
            }
            s = chord(a, b, surface.x);
        }
        s = max(s, last);
        last = s;
        let alpha = opacity(surface.tau);
        let c = sent(surface.color, alpha, between.line.origin + between.line.dir * s, between.line.dir);
        pace = crossing(Step(c, surface.tau, s, s, alpha), to_greater, between.lattice);
        if (pace == 0u) {
            break;
        }
    }
    return pace;
}

fn chord(a: vec2f, b: vec2f, x: f32) -> f32 {
    return clamp(a.x + (b.x - a.x) * ((x - a.y) / (b.y - a.y)), a.x, b.x);
}

// How often the place of a crossing is looked for again.
const REFINEMENTS: u32 = 2;
// Surfaces may be of values outside of the domain.
const X_LEAST: f32 = -1e30;
const X_GREATEST: f32 = 1e30;
