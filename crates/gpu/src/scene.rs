//! A scene on the GPU: texels as 3-D textures, transfer tables and occupancy as storage buffers.

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::channels::Blend;
use isinglass_core::kernels::march;
use isinglass_core::kernels::march::modes::{Surface, key_limit};
use isinglass_core::mode::MAX_ISOS;
use isinglass_core::transfer::TransferTable;
use isinglass_core::volume::{PAGE_VOXELS, Volume, Voxels};

use crate::atlas::Atlas;
use crate::device::{Gpu, bind, scene_layout};
use crate::error::GpuError;
use crate::gpu_types;
use crate::shaders::{MarchPurpose, MixedPurpose, TexelKind};
use crate::whole_texels::WholeTexels;

/// An uploaded scene. A new look rewrites small buffers, and textures if the light changes; the voxels stay.
pub(crate) struct SceneOnGpu {
    /// The volume whose channels are uploaded when a look first shows them.
    volume: Arc<Volume>,
    whole: Option<WholeTexels>,
    pub(crate) atlas: Option<Atlas>,
    uniform: wgpu::Buffer,
    tables: wgpu::Buffer,
    /// What the kernels must do.
    pub(crate) purpose: MarchPurpose,
    /// Number of steps on the longest ray.
    pub(crate) max_steps: u32,
    /// Group 0 of the marching kernels.
    pub(crate) bind_group: wgpu::BindGroup,
}

/// What a march reads of the texels.
pub(crate) struct Texels<'a> {
    pub(crate) occupancy: &'a wgpu::Buffer,
    /// The marched channels in their order.
    pub(crate) channels: Vec<wgpu::TextureView>,
    /// Shares of light.
    pub(crate) shares: wgpu::TextureView,
    pub(crate) gaps: Option<wgpu::TextureView>,
    /// Table and fields of pages.
    pub(crate) pages: Option<[&'a wgpu::Buffer; 2]>,
}

impl SceneOnGpu {
    pub(crate) fn new(gpu: &Gpu, scene: &march::Scene) -> Result<Self, GpuError> {
        let level = scene.of_level();
        let scene = level.as_ref().unwrap_or(scene);
        gpu.attempt("uploading the volume", || {
            let (mut whole, mut atlas) = (None, None);
            let texels = texels(gpu, scene, &mut whole, &mut atlas)?;
            let uniform = gpu.uniform::<gpu_types::Scene>("scene");
            let tables = gpu.storage("tables", tables_words(scene).len() as u64 * 4);
            let purpose = purpose(scene, &texels);
            let bind_group = bind_scene(gpu, purpose, [&uniform, &tables], &texels);
            let (volume, max_steps) = (scene.whole().clone(), scene.max_steps());
            let on_gpu = Self { volume, whole, atlas, uniform, tables, purpose, max_steps, bind_group };
            on_gpu.write_look(gpu, scene);
            Ok(on_gpu)
        })
    }

    /// Replaces the scene; unchanged voxels are not uploaded again.
    pub(crate) fn set(&mut self, gpu: &Gpu, scene: &march::Scene) -> Result<(), GpuError> {
        if !Arc::ptr_eq(&self.volume, scene.whole()) {
            *self = Self::new(gpu, scene)?;
            return Ok(());
        }
        let level = scene.of_level();
        let set = self.set_texels(gpu, level.as_ref().unwrap_or(scene));
        match (set, &level) {
            // Pages may still fit.
            (Err(GpuError::OutOfMemory(_) | GpuError::TooLarge { .. }), Some(level)) => {
                Err(GpuError::Pages { most: level.volume.voxels().len() / PAGE_VOXELS / 10 * 9 })
            }
            (set, _) => set,
        }
    }

    fn set_texels(&mut self, gpu: &Gpu, scene: &march::Scene) -> Result<(), GpuError> {
        gpu.attempt("changing the look", || {
            let texels = texels(gpu, scene, &mut self.whole, &mut self.atlas)?;
            let size = tables_words(scene).len() as u64 * 4;
            if self.tables.size() < size {
                self.tables = gpu.storage("tables", size);
            }
            let purpose = purpose(scene, &texels);
            self.bind_group = bind_scene(gpu, purpose, [&self.uniform, &self.tables], &texels);
            (self.purpose, self.max_steps) = (purpose, scene.max_steps());
            self.write_look(gpu, scene);
            Ok(())
        })
    }

    fn write_look(&self, gpu: &Gpu, scene: &march::Scene) {
        let uniform = gpu_types::Scene::of(scene);
        gpu.queue().write_buffer(&self.uniform, 0, bytemuck::bytes_of(&uniform));
        gpu.queue().write_buffer(&self.tables, 0, bytemuck::cast_slice(&tables_words(scene)));
    }
}

/// Uploads what is new of a scene's texels: those of its pages, or of the volume in memory.
fn texels<'a>(
    gpu: &Gpu,
    scene: &march::Scene,
    whole: &'a mut Option<WholeTexels>,
    atlas: &'a mut Option<Atlas>,
) -> Result<Texels<'a>, GpuError> {
    if let Some(pages) = &scene.pages {
        let atlas = atlas.get_or_insert_with(|| Atlas::new(gpu));
        atlas.show(gpu, scene, pages)?;
        return atlas.texels(gpu, scene);
    }
    if scene.volume.paging().is_none() {
        // A level that is held whole takes the place of the pages.
        *atlas = None;
    }
    let known = whole.take().filter(|known| known.dims() == scene.volume.dims());
    let whole = match known {
        Some(mut known) => {
            known.set(gpu, scene)?;
            whole.insert(known)
        }
        None => whole.insert(WholeTexels::new(gpu, scene)?),
    };
    Ok(whole.texels(scene))
}

/// The channels that are marched together, with their tables.
pub(crate) fn marched(scene: &march::Scene) -> impl Iterator<Item = (&Arc<Volume>, &TransferTable)> {
    let others = scene.others.iter().map(|other| (&other.volume, &other.table));
    std::iter::once((&scene.volume, &scene.table)).chain(others)
}

fn kind_of(volume: &Volume) -> TexelKind {
    match volume.voxels() {
        Voxels::U8(_) | Voxels::U16(_) => TexelKind::Uint,
        Voxels::F32(_) => TexelKind::Float,
    }
}

fn purpose(scene: &march::Scene, texels: &Texels<'_>) -> MarchPurpose {
    let mask = |has: &dyn Fn(&Volume, &TransferTable) -> bool| {
        let bits = (0..).zip(marched(scene)).map(|(i, (volume, table))| u8::from(has(volume, table)) << i);
        bits.sum()
    };
    let mixed = scene.is_mixed().then(|| MixedPurpose {
        num_channels: marched(scene).count() as u8,
        floats: mask(&|volume, _| kind_of(volume) == TexelKind::Float),
        labels: mask(&|_, table| table.are_labels),
        is_over: scene.blend == Blend::Over,
    });
    MarchPurpose {
        kind: kind_of(&scene.volume),
        mode: scene.settings.mode,
        is_glossy: scene.highlight().is_some(),
        has_gaps: texels.gaps.is_some(),
        has_pages: texels.pages.is_some(),
        mixed,
    }
}

/// Uniform, tables and occupancy; voxels of the channels, shares of light and gaps; table and fields of pages.
fn bind_scene(
    gpu: &Gpu,
    purpose: MarchPurpose,
    [uniform, tables]: [&wgpu::Buffer; 2],
    Texels { occupancy, channels, shares, gaps, pages }: &Texels<'_>,
) -> wgpu::BindGroup {
    let mut views: Vec<_> = channels.iter().collect();
    views.insert(1.min(views.len()), shares);
    views.extend(gaps);
    let buffers = [uniform, tables, occupancy].map(wgpu::Buffer::as_entire_binding);
    let textures = views.into_iter().map(wgpu::BindingResource::TextureView);
    let pages = pages.iter().flatten().map(|buffer| buffer.as_entire_binding());
    let resources: Vec<_> = buffers.into_iter().chain(textures).chain(pages).collect();
    bind(gpu.device(), "scene", &scene_layout(gpu.device(), purpose), &resources)
}

/// The tables in the order of `TransferTable` in `shaders/shared/types.wgsl`. Only the first has surfaces.
fn tables_words(scene: &march::Scene) -> Vec<f32> {
    let unused = Surface { x: 0.0, stored: 0.0, color: Vec3::ZERO, tau: 0.0 };
    let mut words = Vec::new();
    for (channel, (_, table)) in marched(scene).enumerate() {
        words.extend(table.integral.iter().chain(&table.density).flatten());
        let surfaces = if channel == 0 { &scene.surfaces[..] } else { &[] };
        for Surface { x, color, tau, .. } in surfaces.iter().chain(std::iter::repeat(&unused)).take(MAX_ISOS)
        {
            words.extend([color.x, color.y, color.z, *tau, *x, 0.0, 0.0, 0.0]);
        }
        let key_limit = key_limit(scene.settings.mode, table);
        let [num_surfaces, has_lesser_bodies] =
            [surfaces.len() as u32, u32::from(scene.has_lesser_bodies)].map(f32::from_bits);
        words.extend([num_surfaces, key_limit, has_lesser_bodies, table.x_scale, table.x_offset]);
        words.extend([0.0; 3]);
    }
    words
}
