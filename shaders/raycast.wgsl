// Novel views: ray casts a layered frame from any camera. Twin of crates/core/src/kernels/raycast.rs; the derivations
// are there. What `caster` and the planes are is said by one_frame.wgsl, or by combine.wgsl for several frames. Run by
// raycast_compute.wgsl into a buffer and by raycast_view.wgsl onto the screen.

// A ray clipped to the frame's frustum: a straight line in pixel space, and the three constants.
struct Line {
    // Pixel position at t = 0.
    p0: vec2f,
    // Pixel position at t = 1 minus that at t = 0.
    d: vec2f,
    s_w0: f32,
    w1: f32,
    w0_minus_w1: f32,
    depth_over_w: f32,
    depth_slope: f32,
    // Whether the ray meets the frustum and the box at all.
    hit: bool,
}

// The purpose of a pipeline (Purpose in crates/gpu/src/shaders.rs). These constants cost neither registers nor
// branches.

// How segments become one colour: core::mode::Compositing.
override COMPOSITING: u32;
// Whether only the nearest list is read (`CastOptions::reconstruction`).
override IS_NEAREST: bool;
// Whether empty cells are skipped.
override SKIPS_EMPTY_SPACE: bool;

// Clips the ray in homogeneous coordinates, to the visible part of the volume and to two world distances.
fn clip(ray: Ray, within: vec2f) -> Line {
    var line = Line();
    let clipped =
        clip_region(caster.bounds_min, caster.bounds_max, caster.clip_normal, caster.clip_offset, ray);
    if (clipped.s1 <= clipped.s0) {
        return line;
    }
    let pixels = pixel_line(caster.basis, ray);
    let o = pixels.o;
    let d = pixels.d;
    let width = caster.basis.width;
    let height = caster.basis.height;
    let near = caster.basis.near;
    let perspective = caster.basis.perspective;
    var planes = array<vec2f, 5>(
        vec2f(pixels.depth.x - near, pixels.depth.y),
        vec2f(o.x, d.x),
        vec2f(width * o.z - o.x, width * d.z - d.x),
        vec2f(o.y, d.y),
        vec2f(height * o.z - o.y, height * d.z - d.y),
    );
    var s0 = max(clipped.s0, within.x);
    var s1 = min(clipped.s1, within.y);
    for (var i = 0u; i < 5u; i++) {
        // Inside where a + b·s ≥ 0.
        let a = planes[i].x;
        let b = planes[i].y;
        if (b > 0.0) {
            s0 = max(s0, -a / b);
        } else if (b < 0.0) {
            s1 = min(s1, -a / b);
        } else if (a < 0.0) {
            return line;
        }
    }
    if (s1 <= s0) {
        return line;
    }
    let h0 = o + d * s0;
    let h1 = o + d * s1;
    let w0 = max(h0.z, near * perspective);
    let w1 = max(h1.z, near * perspective);
    line.p0 = h0.xy / w0;
    line.d = h1.xy / w1 - line.p0;
    line.s_w0 = (s1 - s0) * w0;
    line.w1 = w1;
    line.w0_minus_w1 = w0 - w1;
    let depth_0 = pixels.depth.x + pixels.depth.y * s0;
    line.depth_over_w = w0 * w1 * perspective + depth_0 * (1.0 - perspective);
    line.depth_slope = pixels.depth.y * (s1 - s0) * (1.0 - perspective);
    line.hit = true;
    return line;
}

// Walks the columns of lists along the line, a tile's width at a time. The rays of a group search together, then
// cross what they found together. Each turn of the inner loop looks at one column or skips one column of tiles; only
// possible hits go on to `cross`.
fn walk(line: Line, acc: ptr<function, Over>) {
    let size = vec2i(i32(caster.basis.width), i32(caster.basis.height));
    let along = select(0u, 1u, abs(line.d.x) + AXIS_BIAS < abs(line.d.y));
    let across = 1u - along;
    let p_across = line.p0[across];
    let d_across = line.d[across];
    let columns = columns_of(line.p0[along], line.d[along]);
    let rows = columns_of(p_across, d_across);
    let strides = select(vec2i(size.x, 1), vec2i(1, size.x), along == 0u);
    var column = clamp(i32(floor(line.p0[along])), 0, size[along] - 1);
    var row = clamp(i32(floor(p_across)), 0, size[across] - 1);
    var num_left = 0;
    // Nearness below which a list is ignored.
    var bias = 0.0;
    var enter = at(line, 0.0);
    var is_done = false;
    loop {
        // The value is explicit because some compilers zero a variable only once, and earlier hits must not be met
        // again.
        var met = Met();
        var leave = enter;
        loop {
            if (num_left == 0) {
                // The batch ends at the border of the tile or frame, or at the end of the line.
                let num = num_in_tile(columns, column, size[along]);
                let border = at(line, min(column_end(columns, column, num - 1), 1.0));
                let row_in = p_across + d_across * enter.t - 0.5;
                let row_out = p_across + d_across * border.t - 0.5;
                if (!SKIPS_EMPTY_SPACE || is_occupied(column, row_in, row_out, enter.depth, border.depth, along, size[across])) {
                    num_left = num;
                    bias = nearer_bias(*acc);
                } else {
                    column += columns.step * num;
                    row = select(row, i32(floor(row_out + 0.5)), IS_NEAREST);
                    enter = border;
                    is_done = border.t >= 1.0 || column < 0 || column >= size[along];
                }
            }
            if (num_left > 0) {
                // The batch is a column, or for the nearest list its part up to the border of the row.
                let column_t = min(column_end(columns, column, 0), 1.0);
                let row_t = select(NEVER, column_end(rows, row, 0), IS_NEAREST);
                leave = at(line, max(min(column_t, row_t), enter.t));
                let at_across = p_across + d_across * (0.5 * (enter.t + leave.t)) - 0.5;
                let first = floor(at_across);
                let first_row = select(i32(first), row, IS_NEAREST);
                let lists = clamp(vec2i(first_row, first_row + 1), vec2i(0), vec2i(size[across] - 1));
                let fraction = select(saturate((at_across - first - bias) / (1.0 - 2.0 * bias)), 0.0, IS_NEAREST);
                met.lists = vec2u(column * strides.x + lists * strides.y);
                met.column = f32(column);
                met.rows = vec2f(lists);
                met.nearness = vec2f(1.0 - fraction, fraction);
                met.lo = min(enter.depth, leave.depth);
                met.hi = max(enter.depth, leave.depth);
                met.is_met = vec2<bool>(
                    met.nearness.x >= MIN_NEARNESS && may_meet(summary_of(met.lists.x), met.lo, met.hi),
                    met.nearness.y >= MIN_NEARNESS && may_meet(summary_of(met.lists.y), met.lo, met.hi),
                );
                met.length = leave.distance - enter.distance;
                enter = leave;
                if (row_t < column_t) {
                    row += rows.step;
                } else {
                    column += columns.step;
                    num_left -= 1;
                }
                is_done = leave.t >= 1.0 || column < 0 || column >= size[along];
            }
            if (any(met.is_met) || is_done) {
                break;
            }
        }
        if (any(met.is_met) && met.length > 0.0) {
            cross(met, along, line.w0_minus_w1 - line.depth_slope <= 0.0, acc);
        }
        if (is_done || ends_cast(*acc)) {
            return;
        }
    }
}

// Nearness below which a list is ignored: it grows as less is visible (line.rs).
fn nearer_bias(acc: Over) -> f32 {
    let bias = min(NEARER_SHARE / (acc.transmittance * acc.transmittance), MOST_NEARER);
    return select(0.0, bias, COMPOSITING == BY_OVER);
}

// For a projection, an Over holds the collected colour, and the greatest key in place of transmittance, 0 for
// nothing.

// Nothing yet.
fn identity() -> Over {
    return Over(vec3f(0.0), select(0.0, 1.0, COMPOSITING == BY_OVER));
}

// Puts colour and opacity behind the others, or in a projection colour and key.
fn put(acc: ptr<function, Over>, seen: vec4f) {
    if (COMPOSITING == BY_OVER) {
        (*acc).c += seen.xyz * (*acc).transmittance;
        (*acc).transmittance *= 1.0 - seen.w;
    } else if (COMPOSITING == BY_MEAN) {
        (*acc).c += seen.xyz;
    } else if (seen.w > (*acc).transmittance) {
        *acc = Over(seen.xyz, seen.w);
    }
}

// Whether nothing behind this matters.
fn ends_cast(acc: Over) -> bool {
    let is_opaque = acc.transmittance < TRANSMITTANCE_MIN;
    return select(acc.transmittance >= KEY_FULL, is_opaque, COMPOSITING == BY_OVER);
}

// What a ray shows.
fn shown(acc: Over, ray: Ray) -> Over {
    if (COMPOSITING == BY_OVER) {
        return acc;
    }
    let c = acc.c / select(1.0, parts_of_way(caster, ray), COMPOSITING == BY_MEAN);
    return Over(c, 1.0 - projected_rgba(c).w);
}

// What a line may meet in a column of lists: the two that it runs between.
struct Met {
    // The column, and the rows of both lists.
    column: f32,
    rows: vec2f,
    lists: vec2u,
    nearness: vec2f,
    is_met: vec2<bool>,
    // Least and greatest depth, in units.
    lo: f32,
    hi: f32,
    // World length.
    length: f32,
}

// Composites a column of lists: each list by itself, then mixed by nearness. Where the ray runs towards the old eye,
// each segment goes in front of the previous ones.
fn cross(met: Met, along: u32, is_forward: bool, acc: ptr<function, Over>) {
    // A ray parallel to the old image plane stays at one depth; the guard makes its share of the crossing 1.
    let hi = max(met.hi, met.lo + MIN_CROSSING);
    // The ray's length relative to the lists' own lengths, for the same depth.
    let lengths = vec2f(
        length_per_depth(met.column, met.rows.x, along),
        length_per_depth(met.column, met.rows.y, along),
    );
    let ratios = met.length / (hi - met.lo) * caster.units_per_depth / lengths;
    let summary = summary_of(met.lists.x);
    let summary_2 = summary_of(met.lists.y);
    let second = first_behind(summary_2, met.lo);
    // Each list is left at the end of the stretch or of its last segment.
    let last_back = min(hi, summary_2.range.y);
    var side = select(1u, 0u, met.is_met.x);
    var i = select(second, first_behind(summary, met.lo), met.is_met.x);
    var back = select(last_back, min(hi, summary.range.y), met.is_met.x);
    var mixture = vec4f(0.0);
    let is_over = COMPOSITING == BY_OVER;
    let is_greatest = COMPOSITING == BY_GREATEST;
    var list = identity();
    loop {
        let medium = medium_at(i);
        let overlap = max(min(hi, medium.ends.y) - max(met.lo, medium.ends.x), 0.0);
        let share = overlap / max(medium.ends.y - medium.ends.x, 1.0);
        let passed = share * ratios[side];
        // A mean uses the share itself; with a key, it is all or nothing.
        let is_higher = overlap > 0.0 && medium.tau > list.transmittance;
        let crossed = select(select(passed, f32(is_higher), is_greatest), opacity(medium.tau * passed), is_over);
        let kept = select(1.0, 1.0 - crossed, select(is_greatest, !is_forward, is_over));
        let before = select(1.0, list.transmittance, is_over && is_forward);
        list.c = list.c * kept + medium.e * (crossed * before);
        let key = select(list.transmittance, medium.tau, is_greatest && is_higher);
        list.transmittance = select(key, list.transmittance * (1.0 - crossed), is_over);
        i += 1u;
        var is_done = false;
        if (medium.ends.y >= back) {
            let w = select(list.transmittance, 1.0 - list.transmittance, is_over);
            mixture += vec4f(list.c, w) * met.nearness[side];
            list = identity();
            is_done = side == 1u || !met.is_met.y;
            i = second;
            back = last_back;
            side = 1u;
        }
        if (is_done) {
            break;
        }
    }
    put(acc, mixture);
}

// Facts about a list without a look at its segments (empty_space_build.wgsl).
struct Summary {
    // Least front and greatest back, depth units.
    range: vec2f,
    // The list's cells with a segment, and those in which one ends.
    occupied: u32,
    ended: u32,
    // The first segment.
    first: u32,
}

fn summary_of(list: u32) -> Summary {
    let words = summary_at(list);
    return Summary(range_from_word(words.x), words.y, words.z, words.w);
}

// Whether a list may have a segment between two depths.
fn may_meet(list: Summary, lo: f32, hi: f32) -> bool {
    let cells = cell_bits(list_cell(list.range, lo), list_cell(list.range, hi));
    return lo < list.range.y && hi > list.range.x && (list.occupied & cells) != 0u;
}

// The first segment of a list that may end behind a depth, by the cells in which segments end. The twin looks at all
// ends of a list at once.
fn first_behind(list: Summary, depth: f32) -> u32 {
    let before = (1u << list_cell(list.range, depth)) - 1u;
    return list.first + countOneBits(list.ended & before);
}

// Whether a stretch of the line within one column of tiles may meet a segment. The rows are its ends across, for the
// first of its two lists.
fn is_occupied(column: i32, row_in: f32, row_out: f32, depth_in: f32, depth_out: f32, along: u32, size_across: i32) -> bool {
    let tiles = tiles_across(vec2f(row_in, row_out), size_across);
    var cells = 0u;
    for (var tile = tiles.x; tile <= tiles.y; tile++) {
        cells |= occupied_at(tile_index(column, tile, along));
    }
    return (cells & cell_bits(cell_of_depth(min(depth_in, depth_out)), cell_of_depth(max(depth_in, depth_out)))) != 0u;
}

// The first and the last tile, across the line, of the lists that a stretch runs between.
fn tiles_across(rows: vec2f, size_across: i32) -> vec2i {
    let first = min(i32(max(min(rows.x, rows.y), 0.0)), size_across - 1);
    let last = min(i32(max(max(rows.x, rows.y), 0.0)) + 1, size_across - 1);
    return vec2i(first, last) / i32(TILE);
}

// The index of a tile across the line, in the column of tiles of a column of lists.
fn tile_index(column: i32, tile: i32, along: u32) -> i32 {
    let tiles_x = (i32(caster.basis.width) + i32(TILE) - 1) / i32(TILE);
    let tile_column = column / i32(TILE);
    return select(tile_column * tiles_x + tile, tile * tiles_x + tile_column, along == 0u);
}

// World length along the centre of a list per unit of view depth.
fn length_per_depth(column: f32, row: f32, along: u32) -> f32 {
    let place = select(vec2f(row, column), vec2f(column, row), along == 0u);
    let n = (2.0 * place + 1.0) / vec2f(caster.basis.width, -caster.basis.height) + vec2f(-1.0, 1.0);
    let d = caster.basis.forward + (caster.basis.right * n.x + caster.basis.up * n.y) * caster.basis.perspective;
    return length_of(d);
}

// A point of the line: its parameter, depth in units and world distance from the start.
struct Point {
    t: f32,
    depth: f32,
    distance: f32,
}

fn at(line: Line, t: f32) -> Point {
    let r = 1.0 / (line.w1 + t * line.w0_minus_w1);
    let depth = line.depth_over_w * r + line.depth_slope * t;
    return Point(t, (depth - caster.basis.near) * caster.units_per_depth, line.s_w0 * t * r);
}

// A segment as a homogeneous medium.
struct Medium {
    // Front and back, depth units.
    ends: vec2f,
    // Source colour E = C/α.
    e: vec3f,
    tau: f32,
}

fn medium_at(i: u32) -> Medium {
    let rg = halves(e_rg_at(i));
    let b_tau = halves(e_b_tau_at(i));
    return Medium(range_from_word(depth_at(i)), vec3f(rg, b_tau.x), b_tau.y);
}

// Like unpack_halves, without a branch; numbers below 2^-14 may become 0.
fn halves(word: u32) -> vec2f {
    return bitcast<vec2f>(vec2u((word & 0x7fffu) << 13u, (word & 0x7fff0000u) >> 3u)) * HALF_SCALE;
}

fn length_of(v: vec3f) -> f32 {
    return sqrt(dot(v, v));
}

// The columns of lists along a line: a DDA along one axis.
struct Columns {
    // Step of the index.
    step: i32,
    // The line crosses the border at pixel position x at the parameter x·slope + offset.
    slope: f32,
    offset: f32,
    // 1 if the line leaves a column at its upper border.
    leaves_by: i32,
}

fn columns_of(p: f32, d: f32) -> Columns {
    if (abs(d) < MIN_SLOPE) {
        return Columns(1, 0.0, NEVER, 1);
    }
    let slope = 1.0 / d;
    return Columns(select(-1, 1, d > 0.0), slope, -p * slope, select(0, 1, d > 0.0));
}

// Number of columns from `column` to the border of the tile or frame.
fn num_in_tile(columns: Columns, column: i32, size: i32) -> i32 {
    let in_tile = column & i32(TILE - 1u);
    return select(in_tile + 1, min(i32(TILE) - in_tile, size - column), columns.step > 0);
}

// The parameter at which the line leaves the column i steps after `column`.
fn column_end(columns: Columns, column: i32, i: i32) -> f32 {
    return f32(column + columns.leaves_by + columns.step * i) * columns.slope + columns.offset;
}

// Shortest depth interval that is divided by, in depth units.
const MIN_CROSSING: f32 = 1e-2;
// No key is greater.
const KEY_FULL: f32 = 0.9995;
// The least weight of a list that is composited.
const MIN_NEARNESS: f32 = 1e-3;
// Nearness below which a list is ignored at full visibility.
const NEARER_SHARE: f32 = 0.005;
const MOST_NEARER: f32 = 0.48;
// Pixels by which rows must win over columns.
const AXIS_BIAS: f32 = 1e-2;
// Pixels that a line must move in all to cross a border.
const MIN_SLOPE: f32 = 1e-6;
// Scales a half float's bits, moved to their place in a float, to its value: 2^112.
const HALF_SCALE: f32 = 5.192296858534828e33;
// The parameter of a crossing that never happens: far beyond the end of the line at 1.
const NEVER: f32 = 1e30;
