// What a process sends about its own part of a volume: items of some words along each ray. Twin of
// crates/core/src/kernels/layering/parts/forms.rs.
//
// The host says which steps of a ray lie in the part, because roundings must not decide that. The parts after this one
// (layering/parts/*.wgsl) have
//   const ITEM_WORDS: u32
//   fn gather_items(ray: Ray, lattice: Lattice)
// which marches, and hands the words of each item to put_word and ends it by end_item, front to back.

@group(1) @binding(0) var<uniform> camera: Basis;
@group(1) @binding(1) var<uniform> budget: PartBudget;
@group(1) @binding(2) var<storage, read> rays: array<PartRay>;
// Of each ray the place of its first item and their number. A ray with more items than there is room for has no place.
@group(1) @binding(3) var<storage, read_write> spans: array<vec2u>;
// Word w of item j of ray i at (ITEM_WORDS·j + w)·num_rays + i, so that neighbouring invocations write side by side.
@group(1) @binding(4) var<storage, read_write> slots: array<u32>;
// The items of all rays without holes.
@group(1) @binding(5) var<storage, read_write> items: array<u32>;
@group(1) @binding(6) var<storage, read_write> num_items: atomic<u32>;

// The items of a ray so far.
struct Out {
    len: u32,
    // Index of the ray in the dispatch, and in the workgroup.
    i: u32,
    lane: u32,
}

var<private> out: Out;

fn put_word(word: u32, bits: u32) {
    if (out.len < budget.capacity) {
        slots[(ITEM_WORDS * out.len + word) * budget.num_rays + out.i] = bits;
    }
}

fn end_item() {
    out.len += 1u;
}

@compute @workgroup_size(RAYS_IN_GROUP)
fn gather(
    @builtin(global_invocation_id) id: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    if (id.x >= budget.num_rays) {
        return;
    }
    let own = rays[id.x];
    let from_camera = basis_ray(camera, f32(own.pixel & 0xffffu) + 0.5, f32(own.pixel >> 16u) + 0.5);
    out = Out(0u, id.x, lane);
    gather_items(from_camera.ray, Lattice(own.s0, own.h, own.first, own.end, own.unit));
    if (out.len > budget.capacity) {
        spans[id.x] = vec2u(0u, out.len);
        return;
    }
    let place = atomicAdd(&num_items, out.len);
    spans[id.x] = vec2u(place, out.len);
    for (var i = 0u; i < out.len * ITEM_WORDS; i++) {
        items[place * ITEM_WORDS + i] = slots[i * budget.num_rays + id.x];
    }
}

// Least opacity that is divided by.
const ALPHA_LEAST: f32 = 1e-30;
// Rays of a workgroup.
const RAYS_IN_GROUP: u32 = 32u;
