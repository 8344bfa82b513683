// Path lengths of rays through the volume's box, for means. Twin of Way in
// crates/core/src/kernels/raycast/projected.rs.

// The length of a ray in the box, in parts; the longest path has PARTS.
fn parts_of_way(caster: Raycaster, ray: Ray) -> f32 {
    let diagonal = length(caster.volume_max - caster.volume_min);
    let clipped = clip_box(caster.volume_min, caster.volume_max, ray);
    return max(clipped.s1 - clipped.s0, diagonal * LEAST_WAY) * (PARTS / diagonal);
}

// Parts of the longest path.
const PARTS: f32 = 1024.0;
// Shortest path that is divided by, in diagonals.
const LEAST_WAY: f32 = 0.0078125;
