// The grid of a frame, one workgroup a tile and one invocation a list. Twin of EmptySpace::new in
// crates/core/src/kernels/empty_space.rs.

@group(0) @binding(0) var<uniform> caster: Raycaster;
@group(0) @binding(1) var<storage, read> offsets: array<u32>;
@group(0) @binding(2) var<storage, read> depth_plane: array<u32>;
@group(0) @binding(3) var<storage, read_write> occupied: array<u32>;
// DEPTH_CELLS counts a tile.
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;

var<workgroup> tile_counts: array<atomic<u32>, DEPTH_CELLS>;
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
            for (var cell = first; cell <= last; cell++) {
                atomicAdd(&tile_counts[cell], 1u);
            }
            list_occupied |= cell_bits(first, last);
        }
        atomicOr(&tile_occupied, list_occupied);
    }
    workgroupBarrier();
    let index = tile.y * tiles.x + tile.x;
    if (lane < DEPTH_CELLS) {
        counts[index * DEPTH_CELLS + lane] = atomicLoad(&tile_counts[lane]);
    }
    if (lane == 0u) {
        occupied[index] = atomicLoad(&tile_occupied);
    }
}
