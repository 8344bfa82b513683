// Novel views: ray casts a layered frame from any camera. Twin of crates/core/src/kernels/raycast.rs; the derivations
// are there. What `caster` and the planes are is said by one_frame.wgsl, or by combine.wgsl for several frames. Run by
// raycast_compute.wgsl into a buffer and by raycast_view.wgsl onto the screen.

// A ray clipped to the old frustum: a straight line in pixel space, and the three constants.
struct Line {
    // Pixel position at t = 0.
    p0: vec2f,
    // Pixel position at t = 1 minus that at t = 0.
    d: vec2f,
    s_w0: f32,
    w1: f32,
    w0_minus_w1: f32,
    w0_w1: f32,
    // Whether the ray meets the frustum and the box at all.
    hit: bool,
}

// The first offset, which is 0 in every frame. Conditions that depend on uniforms alone compare with it: a device in
// software (lavapipe) builds the values of such uniforms into the kernel and compiles it anew for every draw, which takes
// longer than a hundred pictures; what is in a storage buffer it leaves there.
fn zero() -> u32 {
    return offset_at(0u);
}

// Clips in homogeneous coordinates, and to two world distances.
fn clip(ray: Ray, within: vec2f) -> Line {
    var line: Line;
    let clipped = clip_box(caster.bounds_min, caster.bounds_max, ray);
    if (clipped.s1 <= clipped.s0) {
        return line;
    }
    let o = pixel_from_world(caster.basis, ray.origin - caster.basis.eye);
    let d = pixel_from_world(caster.basis, ray.dir);
    let width = caster.basis.width;
    let height = caster.basis.height;
    let near = caster.basis.near;
    var planes = array<vec2f, 5>(
        vec2f(o.z - near, d.z),
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
    let w0 = max(h0.z, near);
    let w1 = max(h1.z, near);
    line.p0 = h0.xy / w0;
    line.d = h1.xy / w1 - line.p0;
    line.s_w0 = (s1 - s0) * w0;
    line.w1 = w1;
    line.w0_minus_w1 = w0 - w1;
    line.w0_w1 = w0 * w1;
    line.hit = true;
    return line;
}

// Walks the columns of lists along the line, as many at a time as a tile is wide.
fn walk(line: Line, acc: ptr<function, Over>) {
    let size = vec2i(i32(caster.basis.width), i32(caster.basis.height));
    let along = select(0u, 1u, abs(line.d.x) + AXIS_BIAS < abs(line.d.y));
    let across = 1u - along;
    let p_across = line.p0[across];
    let d_across = line.d[across];
    let columns = columns_of(line.p0[along], line.d[along]);
    let is_nearest = caster.is_nearest != zero();
    var column = clamp(i32(floor(line.p0[along])), 0, size[along] - 1);
    var hints = vec2u(0u);
    var enter = at(line, 0.0);
    loop {
        // To the border of the tile, of the frame or to the end of the line.
        let num = num_in_tile(columns, column, size[along]);
        let leave = at(line, min(column_end(columns, column, num - 1), 1.0));
        let row_in = p_across + d_across * enter.t - 0.5;
        let row_out = p_across + d_across * leave.t - 0.5;
        if (caster.skips_empty_space == zero()
            || is_occupied(column, row_in, row_out, enter.depth, leave.depth, along, size[across])) {
            for (var i = 0; i < num; i++) {
                let end = at(line, min(column_end(columns, column, i), leave.t));
                if (is_nearest) {
                    nearest(line, column + columns.step * i, enter, end, along, &hints, acc);
                } else {
                    mixed(line, column + columns.step * i, enter, end, along, &hints, acc);
                }
                if ((*acc).transmittance < TRANSMITTANCE_MIN) {
                    return;
                }
                enter = end;
                if (end.t >= leave.t) {
                    break;
                }
            }
        }
        column += columns.step * num;
        enter = leave;
        if (leave.t >= 1.0 || column < 0 || column >= size[along]) {
            return;
        }
    }
}

// Composites one column of lists: the two that the line runs between, mixed by nearness.
fn mixed(line: Line, column: i32, enter: Point, leave: Point, along: u32, hints: ptr<function, vec2u>, acc: ptr<function, Over>) {
    if (leave.distance <= enter.distance) {
        return;
    }
    let crossing = crossing_between(line, enter, leave);
    let at_across = line.p0[1u - along] + line.d[1u - along] * (0.5 * (enter.t + leave.t)) - 0.5;
    let first = floor(at_across);
    let nearness = vec2f(1.0 - (at_across - first), at_across - first);
    var mixture = vec4f(0.0);
    for (var side = 0u; side < 2u; side++) {
        if (nearness[side] < MIN_NEARNESS) {
            continue;
        }
        var list = over_identity();
        (*hints)[side] = cross_list(column, i32(first) + i32(side), along, crossing, (*hints)[side], &list);
        mixture += vec4f(list.c, 1.0 - list.transmittance) * nearness[side];
    }
    (*acc).c += mixture.xyz * (*acc).transmittance;
    (*acc).transmittance *= 1.0 - mixture.w;
}

// Composites one column of lists: the list that the line is in. It runs faster along than across, so it changes its row
// once in a column at most.
fn nearest(line: Line, column: i32, enter: Point, leave: Point, along: u32, hints: ptr<function, vec2u>, acc: ptr<function, Over>) {
    let p = line.p0[1u - along];
    let d = line.d[1u - along];
    let row = floor(p + d * enter.t);
    let row_out = floor(p + d * leave.t);
    var middle = leave;
    if (row != row_out) {
        middle = at(line, clamp((max(row, row_out) - p) / d, enter.t, leave.t));
    }
    if (middle.distance > enter.distance) {
        (*hints).x = cross_list(column, i32(row), along, crossing_between(line, enter, middle), (*hints).x, acc);
    }
    if (leave.distance > middle.distance) {
        (*hints).x = cross_list(column, i32(row_out), along, crossing_between(line, middle, leave), (*hints).x, acc);
    }
}

// Whether a stretch of the line, inside of one column of tiles, may meet a segment: the rows are its ends across, as
// those of the first of the two lists that it runs between.
fn is_occupied(column: i32, row_in: f32, row_out: f32, depth_in: f32, depth_out: f32, along: u32, size_across: i32) -> bool {
    let tiles = tiles_across(vec2f(row_in, row_out), size_across);
    var cells = 0u;
    for (var tile = tiles.x; tile <= tiles.y; tile++) {
        cells |= occupied_at(tile_index(column, tile, along));
    }
    return (cells & cell_bits(cell_of_depth(min(depth_in, depth_out)), cell_of_depth(max(depth_in, depth_out)))) != 0u;
}

// The first and the last tile, across the way, of the lists that a stretch of a line runs between.
fn tiles_across(rows: vec2f, size_across: i32) -> vec2i {
    let first = min(i32(max(min(rows.x, rows.y), 0.0)), size_across - 1);
    let last = min(i32(max(max(rows.x, rows.y), 0.0)) + 1, size_across - 1);
    return vec2i(first, last) / i32(TILE);
}

// The index of a tile, across the way, of the column of tiles of a column of lists.
fn tile_index(column: i32, tile: i32, along: u32) -> i32 {
    let tiles_x = (i32(caster.basis.width) + i32(TILE) - 1) / i32(TILE);
    let tile_column = column / i32(TILE);
    return select(tile_column * tiles_x + tile, tile * tiles_x + tile_column, along == 0u);
}

// A list by its column and row along and across the way; a row outside of the frame is the one at its border.
struct List {
    index: u32,
    // World length along its centre for each unit of view depth.
    length_per_depth: f32,
}

fn list_at(column: i32, row_unclamped: i32, along: u32) -> List {
    let row = clamp(row_unclamped, 0, i32(select(caster.basis.width, caster.basis.height, along == 0u)) - 1);
    let x = select(row, column, along == 0u);
    let y = select(column, row, along == 0u);
    let nx = (2.0 * f32(x) + 1.0) / caster.basis.width - 1.0;
    let ny = 1.0 - (2.0 * f32(y) + 1.0) / caster.basis.height;
    let center = caster.basis.forward + caster.basis.right * nx + caster.basis.up * ny;
    return List(u32(y) * u32(caster.basis.width) + u32(x), length_of(center));
}

// A point of the line: its parameter, depth in units and world distance from the start.
struct Point {
    t: f32,
    depth: f32,
    distance: f32,
}

fn at(line: Line, t: f32) -> Point {
    let r = 1.0 / (line.w1 + t * line.w0_minus_w1);
    return Point(t, (line.w0_w1 * r - caster.basis.near) * caster.units_per_depth, line.s_w0 * t * r);
}

// The part of a ray inside a column of lists.
struct Crossing {
    // Least and greatest depth, in units.
    lo: f32,
    hi: f32,
    // World length of the ray for each unit of depth.
    length_per_unit: f32,
    // Whether the ray runs away from the old eye.
    is_forward: bool,
}

fn crossing_between(line: Line, enter: Point, leave: Point) -> Crossing {
    let lo = min(enter.depth, leave.depth);
    // A ray along the old image plane stays at one depth; the guard makes the share of the crossing 1.
    let hi = max(max(enter.depth, leave.depth), lo + MIN_CROSSING);
    return Crossing(lo, hi, (leave.distance - enter.distance) / (hi - lo), line.w0_minus_w1 <= 0.0);
}

// Composites the segments of a list that the crossing meets. `hint` is the index at which the list before was left;
// returns that for the next list. The twin looks at all of a list's ends at once instead.
fn cross_list(column: i32, row_unclamped: i32, along: u32, crossing: Crossing, hint: u32, acc: ptr<function, Over>) -> u32 {
    let list = list_at(column, row_unclamped, along);
    let start = offset_at(list.index);
    let end = offset_at(list.index + 1u);
    if (start >= end) {
        return hint;
    }
    let lo = crossing.lo;
    let hi = crossing.hi;
    let ratio = crossing.length_per_unit * caster.units_per_depth / list.length_per_depth;
    // Previous-index search (Gupta 2022, algorithm 1): neighbouring lists are alike, so start where the last list was
    // left and walk to the first segment that the ray meets.
    var i = start + min(hint, end - start - 1u);
    if (crossing.is_forward) {
        while (i > start && ends(i - 1u).y > lo) {
            i -= 1u;
        }
        while (i < end && ends(i).y <= lo) {
            i += 1u;
        }
        while (i < end && ends(i).x < hi) {
            cross_segment(i, ends(i), lo, hi, ratio, acc);
            i += 1u;
        }
        return max(i, start + 1u) - start - 1u;
    }
    while (i + 1u < end && ends(i + 1u).x < hi) {
        i += 1u;
    }
    var after = i + 1u;
    while (after > start && ends(after - 1u).x >= hi) {
        after -= 1u;
    }
    while (after > start && ends(after - 1u).y > lo) {
        cross_segment(after - 1u, ends(after - 1u), lo, hi, ratio, acc);
        after -= 1u;
    }
    return after - start;
}

// Front and back of segment i, depth units.
fn ends(i: u32) -> vec2f {
    let word = depth_at(i);
    return vec2f(f32(word & 0xffffu), f32(word >> 16u));
}

// Composites the part of segment i between the depths lo and hi; `ratio` is the ray's length over the list's own
// length, for the same depth.
fn cross_segment(i: u32, front_back: vec2f, lo: f32, hi: f32, ratio: f32, acc: ptr<function, Over>) {
    let overlap = min(hi, front_back.y) - max(lo, front_back.x);
    if (overlap <= 0.0) {
        return;
    }
    let rg = unpack_halves(c_rg_at(i));
    let b_tau = unpack_halves(c_b_tau_at(i));
    let c = vec3f(rg, b_tau.x);
    let tau = b_tau.y;
    let tau_crossed = tau * (overlap / (front_back.y - front_back.x)) * ratio;
    let alpha = opacity(tau);
    if (alpha <= 0.0) {
        return;
    }
    let alpha_crossed = opacity(tau_crossed);
    (*acc).c += c * ((*acc).transmittance * alpha_crossed / alpha);
    (*acc).transmittance *= 1.0 - alpha_crossed;
}

fn length_of(v: vec3f) -> f32 {
    return sqrt(dot(v, v));
}

// The columns of lists along a line: a DDA along one axis.
struct Columns {
    // Step of the index.
    step: i32,
    // The parameter of the border at pixel position x is x·slope + offset.
    slope: f32,
    offset: f32,
    // 1 if the line leaves a column by its upper border.
    leaves_by: i32,
}

fn columns_of(p: f32, d: f32) -> Columns {
    if (abs(d) < MIN_SLOPE) {
        return Columns(1, 0.0, NEVER, 1);
    }
    let slope = 1.0 / d;
    return Columns(select(-1, 1, d > 0.0), slope, -p * slope, select(0, 1, d > 0.0));
}

// From `column` on, how many columns there are to the border of the tile or of the frame.
fn num_in_tile(columns: Columns, column: i32, size: i32) -> i32 {
    let in_tile = column & i32(TILE - 1u);
    return select(in_tile + 1, min(i32(TILE) - in_tile, size - column), columns.step > 0);
}

// Where the line leaves the column i steps behind `column`.
fn column_end(columns: Columns, column: i32, i: i32) -> f32 {
    return f32(column + columns.leaves_by + columns.step * i) * columns.slope + columns.offset;
}

// Shortest depth interval that is divided by, in depth units.
const MIN_CROSSING: f32 = 1e-2;
// A list with less weight than this is left out.
const MIN_NEARNESS: f32 = 1e-3;
// A row must win by so many pixels.
const AXIS_BIAS: f32 = 1e-2;
// A line that moves less than this many pixels in all crosses no border worth a division.
const MIN_SLOPE: f32 = 1e-6;
// The parameter of a crossing that does not come: far beyond the end of the line at 1.
const NEVER: f32 = 1e30;
