// Stored numbers of float volumes (core::kernels::march::Texels).

@group(0) @binding(3) var voxels: texture_3d<f32>;

fn stored(p: vec3i) -> f32 {
    return textureLoad(voxels, p, 0).x;
}
