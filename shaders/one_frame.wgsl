// Novel views from one layered frame: its planes, and the function `cast` of crates/core/src/kernels/raycast.rs.

@group(0) @binding(0) var<uniform> caster: Raycaster;
@group(0) @binding(2) var<storage, read> depth_plane: array<u32>;
// E of red and green; E of blue and τ (empty_space_build.wgsl).
@group(0) @binding(3) var<storage, read> e_rg: array<u32>;
@group(0) @binding(4) var<storage, read> e_b_tau: array<u32>;
// One word per tile: its cells that hold a segment (empty_space.wgsl).
@group(0) @binding(5) var<storage, read> occupied: array<u32>;
// One per list (empty_space.wgsl).
@group(0) @binding(1) var<storage, read> summaries: array<vec4u>;

fn depth_at(i: u32) -> u32 {
    return depth_plane[i];
}

fn e_rg_at(i: u32) -> u32 {
    return e_rg[i];
}

fn e_b_tau_at(i: u32) -> u32 {
    return e_b_tau[i];
}

fn occupied_at(i: i32) -> u32 {
    return occupied[i];
}

fn summary_at(list: u32) -> vec4u {
    return summaries[list];
}

// Premultiplied colour and opacity along a ray in world space (`cast` in the twin, which is a reserved word here).
fn cast_ray(ray: Ray) -> Over {
    var acc = identity();
    let line = clip(ray, vec2f(0.0, NEVER));
    if (line.hit) {
        walk(line, &acc);
    }
    return shown(acc, ray);
}
