//! The uniforms of `shaders/shared/types.wgsl`, field by field: the same names, order and offsets. A `vec3` is followed
//! by a scalar that fills its fourth word, so there is no hidden padding.

use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use isinglass_core::camera::Camera;
use isinglass_core::clip::Region;
use isinglass_core::kernels::combine::MAX_FRAMES;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march;
use isinglass_core::kernels::part_rays;
use isinglass_core::kernels::raycast::{CastOptions, MARGIN_UNITS};
use isinglass_core::layer::DEPTH_UNITS;
use isinglass_core::mode::Compositing;
use isinglass_core::space::Aabb;
use isinglass_core::volume::{BRICK, Bricks};

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct Basis {
    pub(crate) eye: [f32; 3],
    pub(crate) near: f32,
    pub(crate) forward: [f32; 3],
    pub(crate) far: f32,
    pub(crate) right: [f32; 3],
    pub(crate) width: f32,
    pub(crate) up: [f32; 3],
    pub(crate) height: f32,
    pub(crate) perspective: f32,
    pub(crate) padding_0: u32,
    pub(crate) padding_1: u32,
    pub(crate) padding_2: u32,
}

impl Basis {
    /// A view as every kernel uses it.
    pub(crate) fn of(view: impl Into<View>) -> Self {
        let View { basis, near, far } = view.into();
        Self {
            eye: basis.eye.into(),
            near,
            forward: basis.forward.into(),
            far,
            right: basis.right.into(),
            width: basis.width,
            up: basis.up.into(),
            height: basis.height,
            perspective: basis.perspective,
            padding_0: 0,
            padding_1: 0,
            padding_2: 0,
        }
    }
}

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct Scene {
    pub(crate) bounds_min: [f32; 3],
    pub(crate) x_scale: f32,
    pub(crate) bounds_max: [f32; 3],
    pub(crate) x_offset: f32,
    pub(crate) voxel_from_world: [f32; 3],
    pub(crate) step_length: f32,
    pub(crate) voxel_origin: [f32; 3],
    pub(crate) shaded: u32,
    pub(crate) dims: [i32; 3],
    pub(crate) ambient: f32,
    pub(crate) brick_dims: [u32; 3],
    pub(crate) diffuse: f32,
    pub(crate) clip_normal: [f32; 3],
    pub(crate) clip_offset: f32,
    pub(crate) light: [f32; 3],
    pub(crate) specular: f32,
    pub(crate) shininess: f32,
    pub(crate) half_gradient: f32,
    pub(crate) open_ambient: f32,
    pub(crate) open_diffuse: f32,
    pub(crate) steepness: [f32; 3],
    pub(crate) padding_0: u32,
    pub(crate) page_grid: [u32; 3],
    pub(crate) padding_1: u32,
    pub(crate) first_brick: [f32; 3],
    pub(crate) padding_2: u32,
}

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct PageField {
    pub(crate) scale: [f32; 3],
    pub(crate) ambient: f32,
    pub(crate) offset: [f32; 3],
    pub(crate) diffuse: f32,
    pub(crate) first: [i32; 3],
    pub(crate) first_word: u32,
    pub(crate) last: [i32; 3],
    pub(crate) is_visible: u32,
}

impl Scene {
    /// Everything that is constant over the rays of a scene.
    pub(crate) fn of(scene: &march::Scene) -> Self {
        let volume = &scene.volume;
        let Region { bounds, normal, offset } = scene.region();
        let lit = scene.illumination.lit();
        let highlight = scene.highlight();
        let (open_ambient, open_diffuse) = highlight.map_or((0.0, 0.0), |h| h.open);
        let (spacing, origin_in_whole) = scene.voxel_space();
        let set = scene.pages.as_ref().map(|pages| &pages.set);
        let dims = set.map_or_else(|| volume.dims(), |set| set.pyramid().dims());
        // The texels of a part begin with its own first voxel; those of pages are places in the whole.
        let [first_voxel, first_brick] = match set {
            Some(_) => [Vec3::ZERO; 2],
            None => [volume.first(), Bricks::first(volume).map(|i| i * BRICK)]
                .map(|voxel| Vec3::from_array(voxel.map(|i| i as f32))),
        };
        let voxel_origin = origin_in_whole - first_voxel;
        let steepness = if set.is_some() { Vec3::ONE } else { volume.steepness() };
        Self {
            bounds_min: bounds.min.into(),
            x_scale: scene.table.x_scale,
            bounds_max: bounds.max.into(),
            x_offset: scene.table.x_offset,
            voxel_from_world: spacing.recip().into(),
            step_length: scene.settings.step_in_voxels * spacing.min_element(),
            voxel_origin: voxel_origin.into(),
            shaded: lit.is_some().into(),
            dims: dims.map(|d| d as i32),
            ambient: lit.map_or(1.0, |lit| lit.ambient),
            brick_dims: scene.occupancy.dims,
            diffuse: lit.map_or(0.0, |lit| lit.diffuse),
            clip_normal: normal.into(),
            clip_offset: offset,
            light: highlight.map_or([0.0; 3], |h| h.light.into()),
            specular: highlight.map_or(0.0, |h| h.specular),
            shininess: highlight.map_or(1.0, |h| h.shininess),
            half_gradient: highlight.map_or(0.0, |h| h.half_gradient),
            open_ambient,
            open_diffuse,
            steepness: steepness.into(),
            padding_0: 0,
            page_grid: set.map_or([0; 3], |set| set.grid()),
            padding_1: 0,
            first_brick: (first_brick - first_voxel).into(),
            padding_2: 0,
        }
    }
}

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct Band {
    pub(crate) first_row: u32,
    pub(crate) num_rows: u32,
    pub(crate) first_pixel: u32,
    pub(crate) num_pixels: u32,
}

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct PartRay {
    pub(crate) s0: f32,
    pub(crate) h: f32,
    pub(crate) first: u32,
    pub(crate) end: u32,
    pub(crate) unit: f32,
    pub(crate) pixel: u32,
}

impl From<&part_rays::PartRay> for PartRay {
    fn from(ray: &part_rays::PartRay) -> Self {
        let march::Lattice { s0, h, first, n, unit } = ray.lattice;
        let [x, y] = ray.pixel.map(u32::from);
        Self { s0, h, first, end: n, unit, pixel: x | y << 16 }
    }
}

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct PartBudget {
    pub(crate) threshold: f32,
    pub(crate) longest: u32,
    pub(crate) num_rays: u32,
    pub(crate) capacity: u32,
}

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct Raycaster {
    pub(crate) basis: Basis,
    pub(crate) bounds_min: [f32; 3],
    pub(crate) units_per_depth: f32,
    pub(crate) bounds_max: [f32; 3],
    pub(crate) padding_0: u32,
    pub(crate) clip_normal: [f32; 3],
    pub(crate) clip_offset: f32,
    pub(crate) volume_min: [f32; 3],
    pub(crate) compositing: u32,
    pub(crate) volume_max: [f32; 3],
    pub(crate) padding_1: u32,
}

impl Raycaster {
    /// The generating camera of a frame and the box of its volume, cast with `options`. The margin is that of
    /// [`isinglass_core::kernels::raycast::Raycaster::new`].
    pub(crate) fn of(
        camera: &Camera,
        bounds: &Aabb,
        compositing: Compositing,
        options: &CastOptions,
    ) -> Self {
        let depth_per_unit = (camera.far - camera.near) / DEPTH_UNITS;
        let region = options.clip.region(bounds).grown(MARGIN_UNITS * depth_per_unit);
        Self {
            basis: Basis::of(camera),
            bounds_min: region.bounds.min.into(),
            units_per_depth: depth_per_unit.recip(),
            bounds_max: region.bounds.max.into(),
            padding_0: 0,
            clip_normal: region.normal.into(),
            clip_offset: region.offset,
            volume_min: bounds.min.into(),
            compositing: compositing as u32,
            volume_max: bounds.max.into(),
            padding_1: 0,
        }
    }
}

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct Combination {
    pub(crate) casters: [Raycaster; MAX_FRAMES],
    pub(crate) places: [[u32; 4]; MAX_FRAMES],
    pub(crate) bounds_min: [f32; 3],
    pub(crate) band: f32,
    pub(crate) bounds_max: [f32; 3],
    pub(crate) num_frames: u32,
    pub(crate) clip_normal: [f32; 3],
    pub(crate) clip_offset: f32,
}

/// See `shaders/shared/types.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct Display {
    pub(crate) background: [f32; 3],
    pub(crate) padding_0: u32,
}

/// Lists that a workgroup of `shaders/layering/compact.wgsl` sums.
pub(crate) const BLOCK: u32 = 256;
/// Side of the square workgroups of most kernels that work on pixels.
pub(crate) const WORKGROUP_SIDE: u32 = 8;
/// Invocations of a workgroup that decodes blocks: one for each list of a block.
pub(crate) const LANES_OF_BLOCK: u32 = 64;
/// Rays of a workgroup that gathers along them.
pub(crate) const RAYS_IN_GROUP: u32 = 32;
/// Height of the workgroups that cast novel views or make lists: with the side above, they fill one SIMD group.
pub(crate) const GROUP_HEIGHT: u32 = 4;

/// See `shaders/blocks/frame.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct BlockFrame {
    pub(crate) size: [u32; 2],
    pub(crate) num_blocks: [u32; 2],
    pub(crate) along: [[i32; 4]; 4],
    pub(crate) here: [[i32; 4]; 4],
    pub(crate) shift: u32,
    pub(crate) is_still: u32,
    pub(crate) reference_blocks: [u32; 2],
    pub(crate) first_layer: u32,
    pub(crate) first_cell: u32,
    pub(crate) most_layers: u32,
    pub(crate) most_cells: u32,
    pub(crate) reference_first_layer: u32,
    pub(crate) reference_first_cell: u32,
    pub(crate) depth: i32,
    pub(crate) opacity: u32,
    pub(crate) color: u32,
    pub(crate) picture: i32,
    pub(crate) chroma: i32,
    pub(crate) padding_0: u32,
}
