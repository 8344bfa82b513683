// A smaller picture enlarged onto the screen, linearly between its pixels. Nothing of it has a twin: the picture it
// enlarges is that of raycast_view.wgsl, in the format of the screen, so that nothing but copying is left to do for the
// many pixels.

@group(0) @binding(0) var smaller: texture_2d<f32>;
@group(0) @binding(1) var between: sampler;

struct Vertex {
    @builtin(position) position: vec4f,
    @location(0) place: vec2f,
}

@vertex
fn upscale_vertex(@builtin(vertex_index) index: u32) -> Vertex {
    let corner = vec2f(f32((index & 1u) << 1u), f32(index & 2u));
    return Vertex(vec4f(corner.x * 2.0 - 1.0, 1.0 - corner.y * 2.0, 0.0, 1.0), corner);
}

@fragment
fn upscale_fragment(vertex: Vertex) -> @location(0) vec4f {
    return textureSampleLevel(smaller, between, vertex.place, 0.0);
}
