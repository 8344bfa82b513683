// The structs, names and constants that kernels share with crates/gpu/src/gpu_types.rs. A kernel is a concatenation
// of parts in the order of crates/gpu/src/shaders.rs; this part is first.

// A camera as an eye and three vectors (core::camera::Basis), with the depth interval of the camera.
struct Basis {
    eye: vec3f,
    near: f32,
    forward: vec3f,
    far: f32,
    right: vec3f,
    width: f32,
    up: vec3f,
    height: f32,
    // 1 for a perspective, 0 for parallel rays.
    perspective: f32,
    padding_0: u32,
    padding_1: u32,
    padding_2: u32,
}

// A volume, its look and everything that is constant over all rays (core::kernels::march::{Scene, Marcher}).
struct Scene {
    // The visible part of the volume (core::clip::Region).
    bounds_min: vec3f,
    x_scale: f32,
    bounds_max: vec3f,
    x_offset: f32,
    voxel_from_world: vec3f,
    // Greatest step along the shortest side of voxels, world units.
    step_length: f32,
    // The world's origin in voxel space.
    voxel_origin: vec3f,
    // Whether there is any shading.
    shaded: u32,
    dims: vec3i,
    ambient: f32,
    // Bricks along x, y, z.
    brick_dims: vec3u,
    diffuse: f32,
    clip_normal: vec3f,
    clip_offset: f32,
    // Highlights (core::kernels::march::Highlight).
    light: vec3f,
    specular: f32,
    shininess: f32,
    half_gradient: f32,
    open_ambient: f32,
    open_diffuse: f32,
    // Factors from differences of voxels to those of the finest level.
    steepness: vec3f,
    padding_0: u32,
    // Pages of the finest level along x, y, z; zeros for a volume that is in memory whole. With pages, `dims` and all
    // that counts voxels are those of the finest level.
    page_grid: vec3u,
    padding_1: u32,
    // Where the first brick begins, voxel space: below 0 in a process's part of a volume.
    first_brick: vec3f,
    padding_2: u32,
}

// A page and where its texels are (core::kernels::march::field::MarchField).
struct PageField {
    // From the voxel space of the finest level to the atlas: a factor, which is also the page's steepness, and an offset.
    scale: vec3f,
    // Brightness of no light, and what full light adds.
    ambient: f32,
    offset: vec3f,
    diffuse: f32,
    // The first and the last texel of the atlas.
    first: vec3i,
    // Where its occupancy begins.
    first_word: u32,
    last: vec3i,
    is_visible: u32,
}

// core::transfer::TransferTable, and more facts about values for a march (core::kernels::march::modes).
struct TransferTable {
    integral: array<vec4f, TABLE_BINS + 1>,
    density: array<vec4f, TABLE_BINS + 1>,
    surfaces: array<Surface, MAX_ISOS>,
    num_surfaces: u32,
    // Steps whose greatest key is at most this do not matter.
    key_limit: f32,
    // Whether surfaces enclose matter of lesser values.
    has_lesser_bodies: u32,
    // Maps stored numbers to positions.
    x_scale: f32,
    x_offset: f32,
}

// core::kernels::march::modes::Surface.
struct Surface {
    color: vec3f,
    tau: f32,
    x: f32,
}

// The rows of a picture that one dispatch works on.
struct Band {
    first_row: u32,
    num_rows: u32,
    first_pixel: u32,
    num_pixels: u32,
}

// A layered frame with everything that is constant over all new rays (core::kernels::raycast::Raycaster). Before the
// first frame its box is empty.
struct Raycaster {
    basis: Basis,
    // The visible part of the volume, with a margin (core::clip::Region).
    bounds_min: vec3f,
    units_per_depth: f32,
    bounds_max: vec3f,
    padding_0: u32,
    clip_normal: vec3f,
    clip_offset: f32,
    // The whole box of the volume.
    volume_min: vec3f,
    // How segments become one colour: core::mode::Compositing.
    compositing: u32,
    volume_max: vec3f,
    padding_1: u32,
}

// Several layered frames of one volume, the newest first (core::kernels::combine::Combiner).
struct Combination {
    casters: array<Raycaster, MAX_FRAMES>,
    // Start of each frame's planes (combine.wgsl).
    places: array<vec4u, MAX_FRAMES>,
    // The visible part of the volume, with the widest of the margins.
    bounds_min: vec3f,
    // Width of the border band in which the newest frame's coverage grows to 1, lists.
    band: f32,
    bounds_max: vec3f,
    num_frames: u32,
    clip_normal: vec3f,
    clip_offset: f32,
}

// How a picture is written to the screen.
struct Display {
    // Linear background behind the volume.
    background: vec3f,
    padding_0: u32,
}

// Most frames in one picture.
const MAX_FRAMES: u32 = 4;
// The numbers of core::mode::Compositing.
const BY_OVER: u32 = 0;
const BY_GREATEST: u32 = 1;
const BY_MEAN: u32 = 2;
// Most surfaces at once.
const MAX_ISOS: u32 = 8;
// Bins of a transfer table.
const TABLE_BINS: u32 = 1024;
// A ray that meets a process's own part of a volume (core::kernels::part_rays::PartRay).
struct PartRay {
    // Its steps in the part.
    s0: f32,
    h: f32,
    first: u32,
    end: u32,
    unit: f32,
    // The column of its pixel, and in the upper half the row.
    pixel: u32,
}

// What is gathered along the rays of one dispatch.
struct PartBudget {
    // Error limit of a piece.
    threshold: f32,
    // Greatest number of pieces of a ray.
    longest: u32,
    num_rays: u32,
    // Items of a ray that there is room for.
    capacity: u32,
}

// Voxels along the side of a brick.
const BRICK: u32 = 8;
