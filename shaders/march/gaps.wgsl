// Voxels with nothing in them (core::volume::VoxelGaps): no step begins or ends there. BINDING stands for the number of theirs.

@group(0) @binding(BINDING) var gaps: texture_3d<u32>;

fn is_gap(p: vec3f) -> bool {
    return textureLoad(gaps, nearest_voxel(p), 0).x != 0u;
}
