// Where a layered frame holds nothing. Twin of crates/core/src/kernels/empty_space.rs; what the cells are is said there.

// The cell of a depth in units.
fn cell_of_depth(depth: f32) -> u32 {
    return u32(clamp(depth * (1.0 / f32(CELL_UNITS)), 0.0, f32(DEPTH_CELLS) - 1.0));
}

// Bits first to last.
fn cell_bits(first: u32, last: u32) -> u32 {
    // In two steps: a shift by 32 is none.
    return (0xffffffffu << first) & ~(0xfffffffeu << last);
}

// Lists along the side of a tile.
const TILE: u32 = 8;
// Slices between near and far: one bit each of a word.
const DEPTH_CELLS: u32 = 32;
// Depth units of a slice.
const CELL_UNITS: u32 = 2048;
