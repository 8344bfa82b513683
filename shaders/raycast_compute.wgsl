// Novel view into a buffer. Twin of the function raycast in crates/core/src/kernels/raycast.rs.

// The new camera.
@group(1) @binding(0) var<uniform> view: Basis;
@group(1) @binding(1) var<uniform> band: Band;
// Premultiplied linear colour of the band's pixels.
@group(1) @binding(2) var<storage, read_write> pixels: array<vec4f>;

// As many pixels as a warp has lanes: a group waits for its slowest ray.
@compute @workgroup_size(8, 4)
fn raycast(@builtin(global_invocation_id) id: vec3u) {
    let width = u32(view.width);
    if (id.x >= width || id.y >= band.num_rows) {
        return;
    }
    let from_camera = basis_ray(view, f32(id.x) + 0.5, f32(band.first_row + id.y) + 0.5);
    pixels[id.y * width + id.x] = over_rgba(cast_ray(from_camera.ray));
}
