// The picture of the volume from a camera: full volume rendering. Twin of render in crates/core/src/kernels/march.rs. The part
// before this one (render/*.wgsl) says what is seen of a ray:
//   fn collected(ray: Ray, lattice: Lattice) -> vec4f
// along a lattice or a part of one, and which colour that is
//   fn shown(collected: vec4f, lattice: Lattice) -> vec4f

@group(1) @binding(0) var<uniform> camera: Basis;
@group(1) @binding(1) var<uniform> band: Band;
// Premultiplied linear colour of the band's pixels.
@group(1) @binding(2) var<storage, read_write> pixels: array<vec4f>;

@compute @workgroup_size(8, 8)
fn render(@builtin(global_invocation_id) id: vec3u) {
    let width = u32(camera.width);
    if (id.x >= width || id.y >= band.num_rows) {
        return;
    }
    let from_camera = basis_ray(camera, f32(id.x) + 0.5, f32(band.first_row + id.y) + 0.5);
    let lattice = scene_lattice(from_camera.ray, camera.near * from_camera.s_per_depth);
    pixels[id.y * width + id.x] = shown(collected(from_camera.ray, lattice), lattice);
}
