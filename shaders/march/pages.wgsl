// A march through the pages of a volume, whose texels lie in an atlas. Twin of Fields in
// crates/core/src/kernels/march/field.rs. TABLE and FIELDS stand for the numbers of two bindings.

// For each page of the finest level, x fastest: in x the index of the field that stands for it, and above LEVEL_SHIFT its
// level, or NOTHING; in y the binary logarithms of the sides of the block around it that has no other, a byte each.
@group(0) @binding(TABLE) var<storage, read> page_table: array<vec2u>;
@group(0) @binding(FIELDS) var<storage, read> page_fields: array<PageField>;

// What the march keeps of the page that it is in.
struct Page {
    scale: vec3f,
    offset: vec3f,
    first: vec3i,
    last: vec3i,
    light_scale: vec2f,
    first_word: u32,
}

var<private> page: Page;

// A step belongs to the page of its middle, so both ends are at most half a step outside.
fn run_at(line: Line, lattice: Lattice, from_point: u32, stride: u32) -> Run {
    let n = lattice.n;
    let half = 0.5 * f32(stride);
    var i = from_point;
    while (i < n) {
        let cell = cell_at(line, lattice, f32(i) + half);
        let entry_and_block = entry_of(cell);
        let entry = entry_and_block.x;
        let is_nothing = entry == NOTHING;
        let index = select(entry & ((1u << LEVEL_SHIFT) - 1u), 0u, is_nothing);
        let ascends = line.dir > vec3f(0.0);
        // Finer pages may stand for other parts of the same page.
        let sides = (vec3u(entry_and_block.y) >> vec3u(0u, 8u, 16u)) & vec3u(0xffu);
        let edge = ((cell >> sides) + select(vec3u(0u), vec3u(1u), ascends)) << sides;
        let is_outer = (edge == vec3u(0u)) | (edge >= scene.page_grid);
        let inner = vec3f(edge * PAGE_CELLS) + 0.5;
        let faces = select(inner, select(vec3f(-FAR), vec3f(FAR), ascends), is_outer);
        let exits = (faces - line.origin) / line.dir;
        let exit = min(min(exits.x, exits.y), exits.z);
        let leaves = ceil((exit - lattice.s0) / lattice.h - half);
        let end = select(n, max(u32(max(leaves, 0.0)), i + 1u), leaves < f32(n));
        let scale = select(page_fields[index].scale, vec3f(1.0), is_nothing);
        // Lattice points from one voxel of the page to the next, as many as at the finest level.
        let pace = max(u32(length(line.dir) / length(line.dir * scale) * (1.0 + 1e-4)), 1u);
        if (is_nothing || page_fields[index].is_visible == 0u) {
            let step = stride * pace;
            i = min(i + (end - i + step - 1u) / step * step, n);
            continue;
        }
        let next = entry_of(cell_at(line, lattice, f32(end) + half)).x;
        let level = select(next >> LEVEL_SHIFT, 0u, next == NOTHING);
        let is_same = end >= n || level == entry >> LEVEL_SHIFT;
        page = Page(
            scale,
            page_fields[index].offset,
            page_fields[index].first,
            page_fields[index].last,
            vec2f(page_fields[index].ambient, page_fields[index].diffuse),
            page_fields[index].first_word,
        );
        return Run(i, end, select(end, n, is_same), pace);
    }
    return Run(n, n, n, 1u);
}

// The page of the finest level at a place of the lattice, in steps.
fn cell_at(line: Line, lattice: Lattice, place: f32) -> vec3u {
    let p = line.origin + line.dir * (lattice.s0 + place * lattice.h);
    let index = clamp(p - 0.5, vec3f(0.0), vec3f(scene.dims - 1));
    return min(vec3u(index) / PAGE_CELLS, scene.page_grid - 1u);
}

fn entry_of(at: vec3u) -> vec2u {
    return page_table[(at.z * scene.page_grid.y + at.y) * scene.page_grid.x + at.x];
}

fn line_in_field(line: Line) -> Line {
    return Line(line.origin * page.scale + page.offset, line.dir * page.scale);
}

fn first_texel() -> vec3i {
    return page.first;
}

fn last_texel() -> vec3i {
    return page.last;
}

fn first_brick() -> vec3f {
    return vec3f(page.first);
}

fn steepness() -> vec3f {
    return page.scale;
}

fn light_scale() -> vec2f {
    return page.light_scale;
}

fn brick_dims() -> vec3u {
    return vec3u(PAGE_BRICKS);
}

fn occupancy_byte(plane: u32, i: u32) -> u32 {
    return byte_of(occupancy[page.first_word + plane * PAGE_WORDS + i / 4u], i);
}

// Marks a page of the finest level in which the look shows nothing.
const NOTHING: u32 = 0xffffffffu;
// Farther away than any point of a volume.
const FAR: f32 = 1e30;
// Where the level begins in an entry of the table.
const LEVEL_SHIFT: u32 = 24;
// Cells along the side of a page.
const PAGE_CELLS: u32 = 64;
// Bricks along the side of a page, and the words of a plane of its occupancy.
const PAGE_BRICKS: u32 = 9;
const PAGE_WORDS: u32 = 183;
