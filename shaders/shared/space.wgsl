// Rays, boxes and cameras. Twin of crates/core/src/space.rs and crates/core/src/camera.rs.

struct Ray {
    origin: vec3f,
    dir: vec3f,
}

// The interval of a ray inside a box; empty unless s1 > s0.
struct Interval {
    s0: f32,
    s1: f32,
}

fn clip_box(bounds_min: vec3f, bounds_max: vec3f, ray: Ray) -> Interval {
    let inv = 1.0 / safe_dir(ray.dir);
    let a = (bounds_min - ray.origin) * inv;
    let b = (bounds_max - ray.origin) * inv;
    let enter = min(a, b);
    let leave = max(a, b);
    let s0 = max(max(max(enter.x, enter.y), enter.z), 0.0);
    let s1 = min(min(leave.x, leave.y), leave.z);
    return Interval(s0, s1);
}

fn safe_dir(dir: vec3f) -> vec3f {
    let tiny = bitcast<vec3f>((bitcast<vec3u>(dir) & vec3u(0x80000000u)) | vec3u(bitcast<u32>(TINY_DIR)));
    return select(dir, tiny, abs(dir) < vec3f(TINY_DIR));
}

// Smallest magnitude of a direction component that is divided by.
const TINY_DIR: f32 = 1e-9;

// A ray, and world distance per unit of view depth along it.
struct CameraRay {
    ray: Ray,
    s_per_depth: f32,
}

fn basis_ray(basis: Basis, x: f32, y: f32) -> CameraRay {
    let nx = 2.0 * x / basis.width - 1.0;
    let ny = 1.0 - 2.0 * y / basis.height;
    let d = basis.forward + basis.right * nx + basis.up * ny;
    let length = length(d);
    return CameraRay(Ray(basis.eye, d / length), length);
}

// Homogeneous pixel coordinates (x·w, y·w, w) of a world-space vector; w is the view depth.
fn pixel_from_world(basis: Basis, v: vec3f) -> vec3f {
    let w = dot(v, basis.forward);
    let x = dot(v, basis.right) / dot(basis.right, basis.right);
    let y = dot(v, basis.up) / dot(basis.up, basis.up);
    return vec3f((w + x) * 0.5 * basis.width, (w - y) * 0.5 * basis.height, w);
}
