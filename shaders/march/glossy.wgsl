// Matter with highlights. Twin of crates/core/src/kernels/march/glossy.rs; the derivation is there.

// What matter of an opacity sends to the eye from a point of voxel space, premultiplied. `dir` is the ray's direction there.
fn sent(color: vec3f, alpha: f32, p: vec3f, dir: vec3f) -> vec3f {
    let brightness = shade(p);
    // Voxels of the finest level.
    let v = scene.voxel_from_world / scene.steepness;
    let slope = slope_at(p) * (steepness() * (0.5 * scene.x_scale));
    let per_voxel = clamp(slope, vec3f(-GRADIENT_MAX), vec3f(GRADIENT_MAX));
    let square = dot(per_voxel, per_voxel);
    let weight = square / max(square + scene.half_gradient * scene.half_gradient, LEAST_SQUARE);
    // Only the direction matters; this scale keeps squares from overflowing.
    let n = per_voxel * (v / max(max(v.x, v.y), v.z));
    let normal = n / sqrt(max(dot(n, n), LEAST_SQUARE));
    var strength = scene.specular * weight;
    if (scene.open_diffuse > 0.0) {
        let lambert = 0.5 + (abs(dot(normal, scene.light)) - 0.5) * weight;
        let open = max(scene.open_diffuse * lambert, LEAST_DIFFUSE);
        strength *= clamp((brightness - scene.open_ambient) / open, 0.0, 1.0);
    }
    let from_eye = dir / (v * steepness());
    let mirrored = strength * (lobe(normal, scene.light - from_eye) + lobe(normal, scene.light + from_eye));
    return min(color * brightness + vec3f(mirrored), vec3f(COLOR_MAX)) * alpha;
}

// The part of the highlight around one of the half-way directions. Its length is 2·√x.
fn lobe(normal: vec3f, halfway: vec3f) -> f32 {
    let square = dot(halfway, halfway);
    let facing = abs(dot(normal, halfway)) / sqrt(max(square, LEAST_SQUARE));
    let x = 0.25 * square;
    return x * x * (3.0 - 2.0 * x) * pow(facing, scene.shininess);
}

// How the stored numbers grow over two voxels at a point of voxel space: differences at the voxels around, interpolated
// trilinearly.
fn slope_at(p: vec3f) -> vec3f {
    let u = p - 0.5;
    let c = vec3i(floor(u));
    let t = u - floor(u);
    let v000 = v(c, 0, 0, 0);
    let v100 = v(c, 1, 0, 0);
    let v010 = v(c, 0, 1, 0);
    let v110 = v(c, 1, 1, 0);
    let v001 = v(c, 0, 0, 1);
    let v101 = v(c, 1, 0, 1);
    let v011 = v(c, 0, 1, 1);
    let v111 = v(c, 1, 1, 1);
    let x00 = lerp(v100 - v(c, -1, 0, 0), v(c, 2, 0, 0) - v000, t.x);
    let x10 = lerp(v110 - v(c, -1, 1, 0), v(c, 2, 1, 0) - v010, t.x);
    let x01 = lerp(v101 - v(c, -1, 0, 1), v(c, 2, 0, 1) - v001, t.x);
    let x11 = lerp(v111 - v(c, -1, 1, 1), v(c, 2, 1, 1) - v011, t.x);
    let y00 = lerp(v010 - v(c, 0, -1, 0), v(c, 0, 2, 0) - v000, t.y);
    let y10 = lerp(v110 - v(c, 1, -1, 0), v(c, 1, 2, 0) - v100, t.y);
    let y01 = lerp(v011 - v(c, 0, -1, 1), v(c, 0, 2, 1) - v001, t.y);
    let y11 = lerp(v111 - v(c, 1, -1, 1), v(c, 1, 2, 1) - v101, t.y);
    let z00 = lerp(v001 - v(c, 0, 0, -1), v(c, 0, 0, 2) - v000, t.z);
    let z10 = lerp(v101 - v(c, 1, 0, -1), v(c, 1, 0, 2) - v100, t.z);
    let z01 = lerp(v011 - v(c, 0, 1, -1), v(c, 0, 1, 2) - v010, t.z);
    let z11 = lerp(v111 - v(c, 1, 1, -1), v(c, 1, 1, 2) - v110, t.z);
    return vec3f(
        lerp(lerp(x00, x10, t.y), lerp(x01, x11, t.y), t.z),
        lerp(lerp(y00, y10, t.x), lerp(y01, y11, t.x), t.z),
        lerp(lerp(z00, z10, t.x), lerp(z01, z11, t.x), t.y),
    );
}

// Guards divisions by the length of a vector that may be 0.
const LEAST_SQUARE: f32 = 1e-37;
// Guards the division by the diffuse light.
const LEAST_DIFFUSE: f32 = 1e-3;
// Steepest gradient, domain positions per voxel.
const GRADIENT_MAX: f32 = 1e6;
