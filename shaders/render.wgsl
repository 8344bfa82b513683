// The picture of the volume from a camera: full volume rendering. Second half of the twin
// crates/core/src/kernels/march.rs (OverSink, render).

// The part before this one defines STOP_AT: the march stops when no more than that of what is behind can be seen.

@group(1) @binding(0) var<uniform> camera: Basis;
@group(1) @binding(1) var<uniform> band: Band;
// Premultiplied linear colour of the band's pixels.
@group(1) @binding(2) var<storage, read_write> pixels: array<vec4f>;

var<private> over_sink: Over;

fn sink_step(step: Step) -> u32 {
    over_sink.c += step.c * over_sink.transmittance;
    over_sink.transmittance *= 1.0 - step.alpha;
    return select(0u, 1u, over_sink.transmittance > STOP_AT);
}

@compute @workgroup_size(8, 8)
fn render(@builtin(global_invocation_id) id: vec3u) {
    let width = u32(camera.width);
    if (id.x >= width || id.y >= band.num_rows) {
        return;
    }
    let from_camera = basis_ray(camera, f32(id.x) + 0.5, f32(band.first_row + id.y) + 0.5);
    over_sink = over_identity();
    march(from_camera.ray, scene_lattice(from_camera.ray, camera.near * from_camera.s_per_depth));
    pixels[id.y * width + id.x] = over_rgba(over_sink);
}
