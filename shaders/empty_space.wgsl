// The empty cells of a layered frame. Twin of crates/core/src/kernels/empty_space.rs, which defines them.

// The cell at a depth in units.
fn cell_of_depth(depth: f32) -> u32 {
    return u32(clamp(depth * (1.0 / f32(CELL_UNITS)), 0.0, f32(DEPTH_CELLS) - 1.0));
}

// Bits first to last.
fn cell_bits(first: u32, last: u32) -> u32 {
    // In two steps, because a shift by 32 does nothing.
    return (0xffffffffu << first) & ~(0xfffffffeu << last);
}

// Unpacks two depths.
fn range_from_word(word: u32) -> vec2f {
    return vec2f(f32(word & 0xffffu), f32(word >> 16u));
}

// The cell of a depth within a list, whose own depth range is divided into cells.
fn list_cell(range: vec2f, depth: f32) -> u32 {
    let scale = LIST_CELLS / max(range.y - range.x, 1.0);
    return u32(clamp((depth - range.x) * scale, 0.0, LIST_CELLS - 1.0));
}

// Cells of a list: one bit of a word each.
const LIST_CELLS: f32 = 32.0;
// Lists along the side of a tile.
const TILE: u32 = 8;
// Slices between near and far: one bit of a word each.
const DEPTH_CELLS: u32 = 32;
// Depth units of a slice.
const CELL_UNITS: u32 = 2048;
