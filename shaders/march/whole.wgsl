// A march through one grid of voxels, which is the whole volume. The other way is march/pages.wgsl.

// The whole ray is one run.
fn run_at(line: Line, lattice: Lattice, from_point: u32, stride: u32) -> Run {
    return Run(from_point, lattice.n, lattice.n, 1u);
}

fn line_in_field(line: Line) -> Line {
    return line;
}

fn first_texel() -> vec3i {
    return vec3i(0);
}

fn last_texel() -> vec3i {
    return scene.dims - 1;
}

fn first_brick() -> vec3f {
    return scene.first_brick;
}

fn steepness() -> vec3f {
    return scene.steepness;
}

fn light_scale() -> vec2f {
    return vec2f(scene.ambient, scene.diffuse);
}

fn brick_dims() -> vec3u {
    return scene.brick_dims;
}

fn occupancy_byte(plane: u32, i: u32) -> u32 {
    let num_words = (scene.brick_dims.x * scene.brick_dims.y * scene.brick_dims.z + 3u) / 4u;
    return byte_of(occupancy[plane * num_words + i / 4u], i);
}
