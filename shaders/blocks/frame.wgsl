// A frame in blocks. Its words: two for each block, ten for each layer, three for each cell.

struct BlockFrame {
    // Columns and rows of lists, and of blocks.
    size: vec2u,
    num_blocks: vec2u,
    // Rows of the motion to the reference; see crates/core/src/codec/blocks/motion.rs.
    along: array<vec4i, 4>,
    here: array<vec4i, 4>,
    shift: u32,
    is_still: u32,
    // Blocks of the reference; 0 without one.
    reference_blocks: vec2u,
    // First words of layers and cells, and room for these, in the frame and in the reference.
    first_layer: u32,
    first_cell: u32,
    most_layers: u32,
    most_cells: u32,
    reference_first_layer: u32,
    reference_first_cell: u32,
    // Steps; see crates/core/src/codec/blocks/steps.rs.
    depth: i32,
    opacity: u32,
    color: u32,
    picture: i32,
    chroma: i32,
    padding_0: u32,
}

// Front and back of a layer, in sixteenths of a depth unit: depth at the middle of the block, growth for each list.
struct Planes {
    front: vec3i,
    back: vec3i,
}

// A layer of a frame.
struct Layer {
    mask: vec2u,
    // The least front and the greatest back of its cells.
    bounds: u32,
    first_cell: u32,
}

fn depth_at(plane: vec3i, at: vec2i) -> i32 {
    return plane.x + ((plane.y * at.x + plane.z * at.y) >> 2u);
}

fn bounded(plane: vec3i) -> vec3i {
    let most = vec3i(MAX_DEPTH, MAX_SLOPE, MAX_SLOPE);
    return clamp(plane, -most, most);
}

fn continued(plane: vec3i, step: vec2i) -> vec3i {
    return bounded(vec3i(plane.x + 8 * (step.x * plane.y + step.y * plane.z), plane.yz));
}

fn of_chroma(step: i32) -> i32 {
    return (step * frame.chroma) >> 4u;
}

fn middle_of(block: vec2i) -> vec2i {
    return 8 * block + 4;
}

// Place of a list along an axis, in quarters of a list from the middle of its block.
fn quarters_from_middle(list: vec2i) -> vec2i {
    return 4 * list - 14;
}

fn picture_at(block: u32, list: u32) -> u32 {
    return frame.num_blocks.x * frame.num_blocks.y + WORDS_OF_PICTURE * (64u * block + list);
}

fn two_halves(low: i32, high: i32) -> u32 {
    return (u32(low) & 0xffffu) | (u32(high) << 16u);
}

fn num_layers_of(block: u32) -> u32 {
    return select(0u, (block & 0xffffu) - 1u, block > 0u);
}

const MAX_DEPTH: i32 = 4194304;
const MAX_SLOPE: i32 = 524288;
const WORDS_OF_BLOCK: u32 = 2u;
const WORDS_OF_LAYER: u32 = 10u;
const WORDS_OF_CELL: u32 = 3u;
// Roots of red, green and blue and whether the list has matter, and the roots that it should have.
const WORDS_OF_PICTURE: u32 = 5u;
