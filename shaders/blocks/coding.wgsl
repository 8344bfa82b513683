// Decodes the blocks of a tile or a quarter of one (twin of crates/core/src/codec/blocks/coding/). A workgroup has a
// stream: its first lane reads bits, and each lane has a list of the present block.

@group(0) @binding(0) var<uniform> frame: BlockFrame;
@group(0) @binding(1) var<storage, read> scales: array<u32>;
// Probabilities of a one, two to a word.
@group(0) @binding(2) var<storage, read> probabilities: array<u32>;
// For each stream the first of its words of 16 bits, their number, and the first word of its probabilities; column and row
// of its first block, and columns and rows of blocks, two in a word. Then the streams.
@group(0) @binding(3) var<storage, read> payload: array<u32>;
@group(0) @binding(4) var<storage, read> before: array<u32>;
@group(0) @binding(5) var<storage, read_write> after: array<u32>;
// How often each context had a zero and a one; then the number of layers, that of cells, and of damaged streams.
@group(0) @binding(6) var<storage, read_write> tally: array<atomic<u32>>;
// For each block whether it is corrected. Then for each of its lists what it composites to and what it should.
@group(0) @binding(7) var<storage, read_write> pictures: array<u32>;

// Layers of the blocks of the row above, which those of the present row replace, and of the present block.
var<workgroup> notes: array<i32, 2808>;
var<workgroup> counts: array<u32, 9>;
var<workgroup> origins: array<u32, 9>;
// For each block of the tile, column and row of the reference's block to which it moves, or `NOWHERE`.
var<workgroup> moved_to: array<u32, 64>;
// Motion of the present block's layers.
var<workgroup> shifts: array<Shift, 24>;
// Levels and then coefficients of four planes. Then a plane that is transformed along one axis.
var<workgroup> levels: array<i32, 256>;
var<workgroup> half_of_inverse: array<i32, 64>;
// Numbers of levels up to the last that is not zero.
var<workgroup> num_levels: vec4u;
// What the first lane has read, for all.
var<workgroup> block_head: vec4u;
var<workgroup> layer_mask: vec2u;
var<workgroup> layer_head: vec4u;
var<workgroup> layer_means: vec4i;
var<workgroup> expected: OptionalMask;
var<workgroup> mean_sum: atomic<i32>;
var<workgroup> least_front: atomic<u32>;
// 0 between two layers, and at first.
var<workgroup> layer_back: atomic<u32>;
// Whether the present block has cells.
var<workgroup> block_cells: atomic<u32>;
var<workgroup> has_cells: u32;
var<workgroup> is_damaged: u32;

// The list of a lane in the present block.
var<private> kappa: i32;
var<private> last_back: i32;
var<private> colors: vec3i;

@compute @workgroup_size(64)
fn tiles(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let at = WORDS_OF_STREAM * group.x;
    let stream = vec3u(payload[at], payload[at + 1u], payload[at + 2u]);
    let first = vec2u(payload[at + 3u] & 0xffffu, payload[at + 3u] >> 16u);
    let num = vec2u(payload[at + 4u] & 0xffffu, payload[at + 4u] >> 16u);
    let own_block = vec2u(lane & 7u, lane >> 3u);
    moved_to[lane] = reference_block(vec2i(first + own_block));
    if (lane == 0u) {
        open_stream(stream);
        has_cells = 0u;
        is_damaged = 0u;
    }
    workgroupBarrier();
    for (var y = 0u; y < num.y; y++) {
        for (var x = 0u; x < num.x; x++) {
            decode_block(vec2u(x, y), first, lane);
            if (workgroupUniformLoad(&is_damaged) != 0u) {
                return;
            }
        }
    }
    if (workgroupUniformLoad(&has_cells) != 0u) {
        for (var block = 0u; block < num.x * num.y; block++) {
            decode_correction(block, num.x, first, lane);
            if (workgroupUniformLoad(&is_damaged) != 0u) {
                return;
            }
        }
    }
    if (lane == 0u && !is_at_end()) {
        give_up();
    }
}

// Only the first lane calls it.
fn give_up() {
    is_damaged = 1u;
    atomicAdd(&tally[NUM_DAMAGED], 1u);
}

// Column and row of the reference's block to which the middle of a block moves.
fn reference_block(block: vec2i) -> u32 {
    // The depth of the move is the reference's, here or in a neighbour.
    for (var i = 0u; i < 5u; i++) {
        let beside = vec2i(select(0, 1, i == 3u) - select(0, 1, i == 2u), select(0, 1, i == 4u) - select(0, 1, i == 1u));
        let there = block_before(block + beside);
        if (num_layers_of(there.x) > 0u) {
            let shift = shift_of(middle_of(block), planes_before(there.y).front.x);
            let to = (64 * middle_of(block) + shift.to.xy) >> vec2u(9u);
            if (shift.is_seen && num_layers_of(block_before(to).x) > 0u) {
                return u32(to.x) | (u32(to.y) << 16u);
            }
            return NOWHERE;
        }
    }
    return NOWHERE;
}

fn decode_block(at: vec2u, first: vec2u, lane: u32) {
    let block = vec2i(first + at);
    let own = 8u * at.y + at.x;
    if (lane == 0u) {
        read_block(at, block, moved_to[own]);
    }
    let head = workgroupUniformLoad(&block_head);
    let kind = head.x;
    let num_layers = head.y;
    kappa = UNIT - 1;
    last_back = 0;
    colors = vec3i(0);
    if (kind == COPIED) {
        copy_block(block, head.z, num_layers, lane);
    } else {
        if (lane < num_layers) {
            if (kind == KEPT) {
                keep(lane, block, moved_to[own]);
            } else if (kind == LEFT || kind == ABOVE) {
                let neighbor = select(at.x, at.x - 1u, kind == LEFT);
                let planes = note_planes(neighbor, lane);
                let step = select(vec2i(0, 1), vec2i(1, 0), kind == LEFT);
                note_planes_are(OWN, lane, Planes(continued(planes.front, step), continued(planes.back, step)));
            }
            let planes = note_planes(OWN, lane);
            shifts[lane] = shift_of(middle_of(block), (planes.front.x + planes.back.x) >> 1u);
        }
        workgroupBarrier();
        for (var i = 0u; i < num_layers; i++) {
            decode_layer(i, at, block, head.z + i, kind, lane);
        }
    }
    // The present block is what later blocks look at.
    for (var i = lane; i < WORDS_OF_NOTE * num_layers; i += 64u) {
        notes[MAX_LAYERS * WORDS_OF_NOTE * at.x + i] = notes[MAX_LAYERS * WORDS_OF_NOTE * OWN + i];
    }
    write_picture(block, lane);
    if (lane == 0u) {
        counts[at.x] = num_layers;
        origins[at.x] = kind;
        let word = WORDS_OF_BLOCK * (u32(block.y) * frame.num_blocks.x + u32(block.x));
        after[word] = (num_layers + 1u) | select(0u, HAS_CELLS, atomicLoad(&block_cells) > 0u);
        after[word + 1u] = head.z;
        if (is_overrun()) {
            give_up();
        }
    }
    storageBarrier();
    workgroupBarrier();
}

// Reads what a block is: `block_head` gets its kind, the number of its layers and the first of them.
fn read_block(at: vec2u, block: vec2i, moved: u32) {
    let num_left = select(0u, counts[max(at.x, 1u) - 1u], at.x > 0u);
    let num_above = select(0u, counts[at.x], at.y > 0u);
    let there = block_before(block);
    atomicStore(&block_cells, 0u);
    if (frame.is_still == 1u && (there.x & HAS_CELLS) != 0u && bit(IS_COPIED + around(at, COPIED, COPIED))) {
        block_head = vec4u(COPIED, num_layers_of(there.x), 0u, 0u);
    } else {
        let states = 3u * select(0u, 1u + u32(num_left > 0u), at.x > 0u) + select(0u, 1u + u32(num_above > 0u), at.y > 0u);
        let known = select(0u, 1u + u32(num_layers_of(there.x) > 0u), there.x > 0u);
        block_head = vec4u(FRESH, 0u, 0u, 0u);
        if (bit(HAS_PLANES + 3u * states + known)) {
            read_origin(at, moved, num_left, num_above);
        }
    }
    let first = atomicAdd(&tally[NUM_LAYERS_SO_FAR], block_head.y);
    block_head.z = first;
    if (first + block_head.y > frame.most_layers) {
        block_head.y = 0u;
        give_up();
    }
}

fn read_origin(at: vec2u, moved: u32, num_left: u32, num_above: u32) {
    let is_kept = around(at, KEPT, KEPT);
    let is_merged = around(at, LEFT, ABOVE);
    if (moved != NOWHERE && bit(IS_KEPT + is_kept)) {
        let there = block_before(vec2i(i32(moved & 0xffffu), i32(moved >> 16u)));
        block_head = vec4u(KEPT, num_layers_of(there.x), 0u, 0u);
        return;
    }
    if (num_left + num_above > 0u && bit(IS_MERGED + is_merged)) {
        var is_above = num_above > 0u;
        if (num_left > 0u && num_above > 0u) {
            let left = origins[at.x - 1u];
            is_above = bit(IS_ABOVE + select(u32(left == LEFT), 2u, left == ABOVE));
        }
        block_head = select(vec4u(LEFT, num_left, 0u, 0u), vec4u(ABOVE, num_above, 0u, 0u), is_above);
        return;
    }
    let contexts = NUM_LAYERS + (7u * count_class(num_left) + count_class(num_above)) * 32u;
    block_head = vec4u(FRESH, min(tree(contexts, 5u), MAX_LAYERS), 0u, 0u);
    read_planes(at, num_left, num_above);
}

// Context of the origins of the left and upper blocks: whether they are one of two.
fn around(at: vec2u, a: u32, b: u32) -> u32 {
    var context = 0u;
    if (at.x > 0u) {
        let origin = origins[at.x - 1u];
        context = 3u * (1u + u32(origin == a || origin == b));
    }
    if (at.y > 0u) {
        let origin = origins[at.x];
        context += 1u + u32(origin == a || origin == b);
    }
    return context;
}

// Writes the planes of a layer of the reference's block, moved.
fn keep(layer: u32, block: vec2i, moved: u32) {
    let to = vec2i(i32(moved & 0xffffu), i32(moved >> 16u));
    let planes = planes_before(block_before(to).y + layer);
    let apart = 64 * (middle_of(block) - middle_of(to));
    note_planes_are(OWN, layer, Planes(moved_plane(planes.front, block, apart), moved_plane(planes.back, block, apart)));
}

fn moved_plane(plane: vec3i, block: vec2i, apart: vec2i) -> vec3i {
    let shift = shift_of(middle_of(block), plane.x);
    let to = select(vec3i(0), shift.to, shift.is_seen);
    let by = apart + to.xy;
    let across = (plane.y * by.x + plane.z * by.y) >> 6u;
    return bounded(vec3i(plane.x + across - to.z, plane.yz));
}

// Copies the layers and cells of the reference's block at the same place.
fn copy_block(block: vec2i, first_layer: u32, num_layers: u32, lane: u32) {
    let there = block_before(block);
    for (var i = 0u; i < num_layers; i++) {
        let layer = layer_before(there.y + i);
        if (lane == 0u) {
            let cells = num_bits(layer.mask);
            let first = atomicAdd(&tally[NUM_CELLS_SO_FAR], cells);
            layer_head = vec4u(first, 0u, 0u, 0u);
            if (first + cells > frame.most_cells) {
                layer_head.y = 1u;
                give_up();
            }
            let planes = planes_before(there.y + i);
            note_planes_are(OWN, i, planes);
            note_matter_is(OWN, i, vec4i(0), 0u, vec2u(0u));
            write_layer(first_layer + i, planes, Layer(layer.mask, layer.bounds, first));
            atomicMax(&block_cells, u32(cells > 0u));
            has_cells |= u32(cells > 0u);
        }
        let head = workgroupUniformLoad(&layer_head);
        if (bit_of(layer.mask, lane) && head.y == 0u) {
            let cell = frame.reference_first_cell + WORDS_OF_CELL * (layer.first_cell + rank(layer.mask, lane));
            let words = vec3u(before[cell], before[cell + 1u], before[cell + 2u]);
            write_cell(head.x + rank(layer.mask, lane), words);
        }
        workgroupBarrier();
    }
}

// Writes a cell, and adds it to what the list composites to.
fn write_cell(cell: u32, words: vec3u) {
    let to = frame.first_cell + WORDS_OF_CELL * cell;
    after[to] = words.x;
    after[to + 1u] = words.y;
    after[to + 2u] = words.z;
    let alpha = opacity_of(i32(words.y & 0xffffu));
    let ycc = vec3i(i16_at(words.y, 1u), i16_at(words.z, 0u), i16_at(words.z, 1u));
    colors += visible(seen(kappa, alpha), cell_roots(ycc));
    kappa = behind(kappa, alpha);
    last_back = i32(words.x >> 16u);
}

fn write_layer(index: u32, planes: Planes, layer: Layer) {
    let at = frame.first_layer + WORDS_OF_LAYER * index;
    for (var i = 0u; i < 3u; i++) {
        after[at + i] = u32(planes.front[i]);
        after[at + 3u + i] = u32(planes.back[i]);
    }
    after[at + 6u] = layer.mask.x;
    after[at + 7u] = layer.mask.y;
    after[at + 8u] = layer.bounds;
    after[at + 9u] = layer.first_cell;
}

fn note_at(block: u32, layer: u32) -> u32 {
    return WORDS_OF_NOTE * (MAX_LAYERS * block + layer);
}

fn note_planes(block: u32, layer: u32) -> Planes {
    let at = note_at(block, layer);
    return Planes(
        vec3i(notes[at], notes[at + 1u], notes[at + 2u]),
        vec3i(notes[at + 3u], notes[at + 4u], notes[at + 5u]),
    );
}

fn note_planes_are(block: u32, layer: u32, planes: Planes) {
    let at = note_at(block, layer);
    for (var i = 0u; i < 3u; i++) {
        notes[at + i] = planes.front[i];
        notes[at + 3u + i] = planes.back[i];
    }
}

// Four means, four classes as bytes, and a mask.
fn note_matter_is(block: u32, layer: u32, means: vec4i, classes: u32, mask: vec2u) {
    let at = note_at(block, layer) + 6u;
    for (var c = 0u; c < 4u; c++) {
        notes[at + c] = means[c];
    }
    notes[at + 4u] = i32(classes);
    notes[at + 5u] = bitcast<i32>(mask.x);
    notes[at + 6u] = bitcast<i32>(mask.y);
}

fn note_means(block: u32, layer: u32) -> vec4i {
    let at = note_at(block, layer) + 6u;
    return vec4i(notes[at], notes[at + 1u], notes[at + 2u], notes[at + 3u]);
}

fn note_class(block: u32, layer: u32, plane: u32) -> u32 {
    return (u32(notes[note_at(block, layer) + 10u]) >> (8u * plane)) & 0xffu;
}

fn note_mask(block: u32, layer: u32) -> vec2u {
    let at = note_at(block, layer) + 11u;
    return vec2u(bitcast<u32>(notes[at]), bitcast<u32>(notes[at + 1u]));
}

const WORDS_OF_STREAM: u32 = 5u;
const MAX_LAYERS: u32 = 24u;
const WORDS_OF_NOTE: u32 = 13u;
// The present block among those of `notes`.
const OWN: u32 = 8u;
const NOWHERE: u32 = 0xffffffffu;
// In the word of a block.
const HAS_CELLS: u32 = 0x80000000u;
// What the planes of a block come from.
const FRESH: u32 = 0u;
const LEFT: u32 = 1u;
const ABOVE: u32 = 2u;
const KEPT: u32 = 3u;
const COPIED: u32 = 4u;
// Words of `tally` behind the contexts.
const NUM_LAYERS_SO_FAR: u32 = 22776u;
const NUM_CELLS_SO_FAR: u32 = 22777u;
const NUM_DAMAGED: u32 = 22778u;
