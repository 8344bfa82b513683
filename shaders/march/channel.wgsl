// Samples of one channel of a mixed march. This part stands once for each channel but the first. CHANNEL stands for its
// number, BINDING for that of its voxels, and TEXEL for u32 or f32.

@group(0) @binding(BINDING) var voxels_CHANNEL: texture_3d<TEXEL>;

fn stored_CHANNEL(p: vec3i) -> f32 {
    return f32(textureLoad(voxels_CHANNEL, p, 0).x);
}

fn v_CHANNEL(c: vec3i, dx: i32, dy: i32, dz: i32) -> f32 {
    return stored_CHANNEL(texel(c, dx, dy, dz));
}

// Trilinear sample at a point of voxel space, as a position in the transfer function's domain.
fn domain_CHANNEL(p: vec3f) -> f32 {
    let u = p - 0.5;
    let c = vec3i(floor(u));
    let t = u - floor(u);
    let x00 = lerp(v_CHANNEL(c, 0, 0, 0), v_CHANNEL(c, 1, 0, 0), t.x);
    let x10 = lerp(v_CHANNEL(c, 0, 1, 0), v_CHANNEL(c, 1, 1, 0), t.x);
    let x01 = lerp(v_CHANNEL(c, 0, 0, 1), v_CHANNEL(c, 1, 0, 1), t.x);
    let x11 = lerp(v_CHANNEL(c, 0, 1, 1), v_CHANNEL(c, 1, 1, 1), t.x);
    let value = lerp(lerp(x00, x10, t.y), lerp(x01, x11, t.y), t.z);
    return clamp(value * tables[CHANNEL].x_scale + tables[CHANNEL].x_offset, X_LEAST, X_GREATEST);
}
