// Prepares a frame for casting, with one workgroup per tile and one invocation per list. It makes the grid (twin of
// EmptySpace::new in crates/core/src/kernels/empty_space.rs), a summary of each list, and E = C/α in place of C. A
// projection has other numbers in place of E and τ (crates/core/src/kernels/raycast/projected.rs).

@group(0) @binding(0) var<uniform> caster: Raycaster;
@group(0) @binding(1) var<storage, read> offsets: array<u32>;
@group(0) @binding(2) var<storage, read> depth_plane: array<u32>;
@group(0) @binding(3) var<storage, read_write> occupied: array<u32>;

// For each list: its depth range as the word of a segment, its cells with a segment, those in which one ends, and the
// index of its first segment. An empty list has an empty range.
@group(0) @binding(4) var<storage, read_write> summaries: array<vec4u>;
// C before, E after.
@group(0) @binding(5) var<storage, read_write> rg: array<u32>;
@group(0) @binding(6) var<storage, read_write> b_tau: array<u32>;

var<workgroup> tile_occupied: atomic<u32>;

@compute @workgroup_size(8, 8)
fn empty_space(
    @builtin(global_invocation_id) id: vec3u,
    @builtin(workgroup_id) tile: vec3u,
    @builtin(num_workgroups) tiles: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let width = u32(caster.basis.width);
    if (id.x < width && id.y < u32(caster.basis.height)) {
        let list = id.y * width + id.x;
        var list_occupied = 0u;
        for (var i = offsets[list]; i < offsets[list + 1u]; i++) {
            let word = depth_plane[i];
            let first = (word & 0xffffu) / CELL_UNITS;
            let last = (max(word >> 16u, 1u) - 1u) / CELL_UNITS;
            list_occupied |= cell_bits(first, last);
        }
        atomicOr(&tile_occupied, list_occupied);
        summarize(list);
    }
    workgroupBarrier();
    if (lane == 0u) {
        occupied[tile.y * tiles.x + tile.x] = atomicLoad(&tile_occupied);
    }
}

fn summarize(list: u32) {
    let start = offsets[list];
    let end = offsets[list + 1u];
    var word = NOTHING;
    var is_ascending = true;
    let width = u32(caster.basis.width);
    let center = basis_ray(caster.basis, f32(list % width) + 0.5, f32(list / width) + 0.5);
    let parts = parts_of_way(caster, center.ray);
    for (var i = start; i < end; i++) {
        let next = depth_plane[i];
        is_ascending = is_ascending && (next >> 16u) >= (word >> 16u);
        word = min(word & 0xffffu, next & 0xffffu) | max(word & 0xffff0000u, next & 0xffff0000u);
        light(i, parts);
    }
    // A cast finds the end of a list by its range, so a list in disorder shows nothing.
    word = select(NOTHING, word, is_ascending);
    let range = range_from_word(word);
    var cells = vec2u(0u);
    for (var i = start; i < end; i++) {
        let ends = range_from_word(depth_plane[i]);
        let last = list_cell(range, ends.y);
        cells |= vec2u(cell_bits(list_cell(range, ends.x), last), 1u << last);
    }
    summaries[list] = vec4u(word, cells, start);
}

// An empty range.
const NOTHING: u32 = 0xffffu;

// From C to E; `parts` are those of the list's way.
fn light(i: u32, parts: f32) {
    let b_and_tau = unpack_halves(b_tau[i]);
    let alpha = opacity(b_and_tau.y);
    var factor = select(1.0 / alpha, 0.0, alpha <= 0.0);
    var tau = b_and_tau.y;
    if (caster.compositing == BY_GREATEST) {
        factor = 1.0;
        tau = key_from_slot(tau);
    } else if (caster.compositing == BY_MEAN) {
        factor = parts;
    }
    let e_rg = unpack_halves(rg[i]) * factor;
    rg[i] = pack_halves(e_rg.x, e_rg.y);
    b_tau[i] = pack_halves(b_and_tau.x * factor, tau);
}
