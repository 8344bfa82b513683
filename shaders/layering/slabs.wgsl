// Image-aligned slabs: planes at equal view depths from the nearest to the farthest corner of the volume's box, the same
// for every list. Twin of crates/core/src/kernels/layering/slabs.rs. The part before this one is cuts.wgsl.

fn generate_list(ray: Ray, lattice: Lattice) {
    let s_per_depth = 1.0 / dot(ray.dir, camera.forward);
    let middle = dot((scene.bounds_min + scene.bounds_max) * 0.5 - camera.eye, camera.forward);
    let reach = dot((scene.bounds_max - scene.bounds_min) * 0.5, abs(camera.forward));
    let first = max(middle - reach, camera.near);
    let thickness = (middle + reach - first) / f32(K);
    cuts_begin(first * s_per_depth, thickness * s_per_depth, false);
    march(ray, lattice);
    close();
}

fn sink_step(step: Step) -> u32 {
    return cuts_step(step);
}
