// A preview by a number of samples a ray. Twin of crates/core/src/kernels/subsample.rs; the derivation is there.

// The part of a line inside of one column of tiles.
struct TileStretch {
    // World distances from the start of the line.
    ends: vec2f,
    // Columns of lists.
    columns: vec2i,
    // Mean count of the cells that it runs through.
    count: f32,
}

// Walks a line by columns of tiles.
struct TileWalk {
    columns: Columns,
    column: i32,
    t: f32,
    is_done: bool,
}

fn tile_walk(line: Line, along: u32, size_along: i32) -> TileWalk {
    let column = clamp(i32(line.p0[along]), 0, size_along - 1);
    return TileWalk(columns_of(line.p0[along], line.d[along]), column, 0.0, false);
}

fn next_stretch(walk: ptr<function, TileWalk>, line: Line, along: u32, size: vec2i) -> TileStretch {
    let columns = (*walk).columns;
    let num = num_in_tile(columns, (*walk).column, size[along]);
    let t_out = min(column_end(columns, (*walk).column, num - 1), 1.0);
    let enter = at(line, (*walk).t);
    let leave = at(line, t_out);
    let row_in = line.p0[1u - along] + line.d[1u - along] * enter.t - 0.5;
    let row_out = line.p0[1u - along] + line.d[1u - along] * leave.t - 0.5;
    let last = (*walk).column + columns.step * (num - 1);
    let stretch = TileStretch(
        vec2f(enter.distance, leave.distance),
        vec2i(min((*walk).column, last), max((*walk).column, last)),
        mean_count((*walk).column, vec2f(row_in, row_out), vec2f(enter.depth, leave.depth), along, size[1u - along]),
    );
    (*walk).t = t_out;
    (*walk).column = last + columns.step;
    (*walk).is_done = t_out >= 1.0 || (*walk).column < 0 || (*walk).column >= size[along];
    return stretch;
}

// Premultiplied colour and opacity along a line by a number of samples.
fn sample_line(line: Line, acc: ptr<function, Over>) {
    let size = vec2i(i32(caster.basis.width), i32(caster.basis.height));
    let along = select(0u, 1u, abs(line.d.x) + AXIS_BIAS < abs(line.d.y));
    var total = 0.0;
    var first = tile_walk(line, along, size[along]);
    while (!first.is_done) {
        let stretch = next_stretch(&first, line, along, size);
        total += stretch.count * (stretch.ends.y - stretch.ends.x);
    }
    if (total <= 0.0) {
        return;
    }
    let samples_per_weight = f32(caster.num_samples) / total;
    var weight = 0.0;
    var num_before = 0.0;
    var length_before = 0.0;
    var second = tile_walk(line, along, size[along]);
    while (!second.is_done) {
        let stretch = next_stretch(&second, line, along, size);
        if (stretch.count <= 0.0) {
            continue;
        }
        let length = stretch.ends.y - stretch.ends.x;
        weight += stretch.count * length;
        // The sum of all weights is the same as above, so the last stretch gets to the whole number.
        let num = floor(weight * samples_per_weight + ROUNDING);
        let num_here = num - num_before;
        if (num_here < 1.0) {
            length_before += length;
            continue;
        }
        let part = length / num_here;
        // What was handed on is spread evenly.
        let stands_for = (length_before + length) / num_here;
        for (var i = 0u; i < u32(num_here); i++) {
            let sample = sample_at(line, stretch.ends.x + part * (f32(i) + 0.5), stands_for, stretch, along);
            put(acc, sample);
        }
        // Of a projection all samples are taken.
        if (COMPOSITING == BY_OVER && ends_cast(*acc)) {
            return;
        }
        num_before = num;
        length_before = 0.0;
    }
}

// Colour and opacity of the matter at a distance along the line, for a length of it.
fn sample_at(line: Line, distance: f32, length: f32, stretch: TileStretch, along: u32) -> vec4f {
    let t = distance * line.w1 / (line.s_w0 - distance * line.w0_minus_w1);
    let depth = at(line, t).depth;
    let position = line.p0 + line.d * t;
    let column = clamp(i32(position[along]), stretch.columns.x, stretch.columns.y);
    if (IS_NEAREST) {
        return look_up(column, i32(position[1u - along]), depth, length, along);
    }
    let at_across = position[1u - along] - 0.5;
    let row = floor(at_across);
    let nearness = at_across - row;
    return look_up(column, i32(row), depth, length, along) * (1.0 - nearness)
        + look_up(column, i32(row) + 1, depth, length, along) * nearness;
}

// Colour and opacity of a length of the segment of a list that holds a depth.
fn look_up(column: i32, row_unclamped: i32, depth: f32, length: f32, along: u32) -> vec4f {
    let row = clamp(row_unclamped, 0, i32(select(caster.basis.width, caster.basis.height, along == 0u)) - 1);
    let position = select(vec2i(row, column), vec2i(column, row), along == 0u);
    let list = u32(position.y * i32(caster.basis.width) + position.x);
    let summary = summary_of(list);
    if (depth >= summary.range.y) {
        return vec4f(0.0);
    }
    var i = first_behind(summary, depth);
    while (range_from_word(depth_at(i)).y <= depth) {
        i += 1u;
    }
    let medium = medium_at(i);
    if (medium.ends.x > depth) {
        return vec4f(0.0);
    }
    // Inverse of the segment's length.
    let per_length = caster.units_per_depth
        / ((medium.ends.y - medium.ends.x) * length_per_depth(f32(column), f32(row), along));
    if (COMPOSITING == BY_GREATEST) {
        return vec4f(medium.e, medium.tau);
    }
    if (COMPOSITING == BY_MEAN) {
        return vec4f(medium.e * (length * per_length), 0.0);
    }
    let crossed = opacity(medium.tau * per_length * length);
    return vec4f(medium.e * crossed, crossed);
}

// Mean count of the cells that a stretch of a line runs through, inside of one column of tiles.
fn mean_count(column: i32, rows: vec2f, depths: vec2f, along: u32, size_across: i32) -> f32 {
    let tiles = tiles_across(rows, size_across);
    let first_cell = cell_of_depth(min(depths.x, depths.y));
    let last_cell = cell_of_depth(max(depths.x, depths.y));
    var count = 0u;
    for (var tile = tiles.x; tile <= tiles.y; tile++) {
        let first = u32(tile_index(column, tile, along)) * DEPTH_CELLS;
        for (var cell = first_cell; cell <= last_cell; cell++) {
            count += count_at(first + cell);
        }
    }
    let num_cells = u32(tiles.y - tiles.x + 1) * (last_cell - first_cell + 1u) * TILE * TILE;
    return f32(count) / f32(num_cells);
}

// So much may be missing from a whole number of samples by rounding.
const ROUNDING: f32 = 1e-2;
