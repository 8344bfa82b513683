// A novel view on the screen over a background, as one triangle that covers the viewport.

// Whether the shader encodes sRGB, because the target does not.
override ENCODES_SRGB: bool;

// The new camera.
@group(1) @binding(0) var<uniform> view: Basis;
@group(1) @binding(1) var<uniform> display: Display;

struct Vertex {
    @builtin(position) position: vec4f,
    // Pixel space of the new camera, whatever the size of the viewport.
    @location(0) pixel: vec2f,
}

@vertex
fn view_vertex(@builtin(vertex_index) index: u32) -> Vertex {
    // (0, 0), (2, 0), (0, 2): twice the viewport along both axes.
    let corner = vec2f(f32((index & 1u) << 1u), f32(index & 2u));
    let position = vec4f(corner.x * 2.0 - 1.0, 1.0 - corner.y * 2.0, 0.0, 1.0);
    return Vertex(position, corner * vec2f(view.width, view.height));
}

@fragment
fn view_fragment(vertex: Vertex) -> @location(0) vec4f {
    let acc = cast_ray(basis_ray(view, vertex.pixel.x, vertex.pixel.y).ray);
    let linear = acc.c + display.background * acc.transmittance;
    if (!ENCODES_SRGB) {
        return vec4f(linear, 1.0);
    }
    return vec4f(srgb_from_linear(linear.x), srgb_from_linear(linear.y), srgb_from_linear(linear.z), 1.0);
}
