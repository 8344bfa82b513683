// Matter without highlights.

// What matter of an opacity sends to the eye from a point of voxel space, premultiplied. `dir` is the ray's direction there.
fn sent(color: vec3f, alpha: f32, p: vec3f, dir: vec3f) -> vec3f {
    return color * (shade(p) * alpha);
}
