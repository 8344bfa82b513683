// Stored numbers of 8- and 16-bit volumes (core::kernels::march::Texels): integers, so a texel is exact.

@group(0) @binding(3) var voxels: texture_3d<u32>;

fn stored(p: vec3i) -> f32 {
    return f32(textureLoad(voxels, p, 0).x);
}
