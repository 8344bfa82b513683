// Rays, boxes and cameras. Twin of crates/core/src/space.rs, crates/core/src/clip.rs and crates/core/src/camera.rs.

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

// The same for a box and a half-space (core::clip::Region).
fn clip_region(bounds_min: vec3f, bounds_max: vec3f, normal: vec3f, offset: f32, ray: Ray) -> Interval {
    var clipped = clip_box(bounds_min, bounds_max, ray);
    // Inside where a + b·s ≥ 0.
    let a = dot(normal, ray.origin) - offset;
    let b = dot(normal, ray.dir);
    if (b > 0.0) {
        clipped.s0 = max(clipped.s0, -a / b);
    } else if (b < 0.0) {
        clipped.s1 = min(clipped.s1, -a / b);
    } else if (a < 0.0) {
        clipped.s1 = clipped.s0;
    }
    return clipped;
}

fn safe_dir(dir: vec3f) -> vec3f {
    let tiny = bitcast<vec3f>((bitcast<vec3u>(dir) & vec3u(0x80000000u)) | vec3u(bitcast<u32>(TINY_DIR)));
    return select(dir, tiny, abs(dir) < vec3f(TINY_DIR));
}

// Least magnitude of a direction component that is divided by.
const TINY_DIR: f32 = 1e-9;

// A ray, and world distance per unit of view depth along it.
struct CameraRay {
    ray: Ray,
    s_per_depth: f32,
}

fn basis_ray(basis: Basis, x: f32, y: f32) -> CameraRay {
    let n = vec2f(2.0 * x / basis.width - 1.0, 1.0 - 2.0 * y / basis.height);
    let of_dir = n * basis.perspective;
    let of_origin = n * (1.0 - basis.perspective);
    let d = basis.forward + basis.right * of_dir.x + basis.up * of_dir.y;
    let origin = basis.eye + basis.right * of_origin.x + basis.up * of_origin.y;
    let length = length(d);
    return CameraRay(Ray(origin, d / length), length);
}

// A ray in the homogeneous pixel coordinates (x·w, y·w, w) of a camera: o + d·s.
struct PixelLine {
    o: vec3f,
    d: vec3f,
    // View depth of the origin, and its change per unit of s.
    depth: vec2f,
}

fn pixel_line(basis: Basis, ray: Ray) -> PixelLine {
    let from_eye = ray.origin - basis.eye;
    let depth = vec2f(dot(from_eye, basis.forward), dot(ray.dir, basis.forward));
    return PixelLine(
        pixel_from_world(basis, from_eye, 1.0 - basis.perspective),
        pixel_from_world(basis, ray.dir, 0.0),
        depth,
    );
}

// The pixel of a vector from the eye. With parallel rays, `weight` is 1 for a point and 0 for a direction.
fn pixel_from_world(basis: Basis, v: vec3f, weight: f32) -> vec3f {
    let w = dot(v, basis.forward) * basis.perspective + weight;
    let x = dot(v, basis.right) / dot(basis.right, basis.right);
    let y = dot(v, basis.up) / dot(basis.up, basis.up);
    return vec3f((w + x) * 0.5 * basis.width, (w - y) * 0.5 * basis.height, w);
}
