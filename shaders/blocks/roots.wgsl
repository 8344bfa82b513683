// Roots of colours, in units of 1/8192 (twin of crates/core/src/codec/blocks/scales.rs).

fn roots_from_ycc(ycc: vec3i) -> vec3i {
    let rest = ycc.x - ycc.z;
    return vec3i(rest + ycc.y, ycc.x + ycc.z, rest - ycc.y);
}

fn cell_roots(ycc: vec3i) -> vec3i {
    return clamp(roots_from_ycc(ycc), vec3i(0), vec3i(MAX_ROOT));
}

fn root_of(number: i32) -> i32 {
    let about = i32(sqrt(f32(number)));
    var root = about;
    // The root of a float is off by few of its last bits.
    root -= select(0, 1, root * root > number);
    root += select(0, 1, (root + 1) * (root + 1) <= number);
    return root;
}

// The sum that a visible opacity and a root add to a colour, in units of 2⁻³⁰.
fn visible(seen: i32, roots: vec3i) -> vec3i {
    let square = roots * roots;
    return seen * (square >> vec3u(12u)) + ((seen * (square & vec3i(0xfff))) >> vec3u(12u));
}

const MAX_ROOT: i32 = 9830;
