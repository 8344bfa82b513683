// Ways of rays through the volume's box, of which means are taken. Twin of Way in
// crates/core/src/kernels/raycast/projected.rs.

// The length of a ray in the box, in parts of which the longest way has PARTS.
fn parts_of_way(caster: Raycaster, ray: Ray) -> f32 {
    let diagonal = length(caster.volume_max - caster.volume_min);
    let clipped = clip_box(caster.volume_min, caster.volume_max, ray);
    return max(clipped.s1 - clipped.s0, diagonal * LEAST_WAY) * (PARTS / diagonal);
}

// Parts of the longest way.
const PARTS: f32 = 1024.0;
// Shortest way that is divided by, in diagonals.
const LEAST_WAY: f32 = 0.0078125;
