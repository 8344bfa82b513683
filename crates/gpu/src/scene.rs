//! A scene on the GPU: voxels and brightness as 3-D textures, the transfer table and occupancy as storage buffers.

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::channels::Blend;
use isinglass_core::kernels::march;
use isinglass_core::kernels::march::modes::{Surface, key_limit};
use isinglass_core::mode::MAX_ISOS;
use isinglass_core::transfer::TransferTable;
use isinglass_core::volume::{Lit, Occupancy, Volume, VoxelGaps, Voxels};

use crate::device::{Gpu, bind, scene_layout};
use crate::error::GpuError;
use crate::gpu_types;
use crate::shaders::{MarchPurpose, MixedPurpose, TexelKind};

/// An uploaded scene. A new look rewrites two small buffers, and a texture if the light changes; the voxels stay.
pub(crate) struct SceneOnGpu {
    /// The volume whose channels are uploaded when a look first shows them.
    whole: Arc<Volume>,
    uploaded: Vec<(Arc<Volume>, wgpu::Texture)>,
    lit: Option<Arc<Lit>>,
    shares: wgpu::Texture,
    gaps: Option<(Arc<VoxelGaps>, wgpu::Texture)>,
    uniform: wgpu::Buffer,
    tables: wgpu::Buffer,
    occupancy: wgpu::Buffer,
    /// What the kernels must do.
    pub(crate) purpose: MarchPurpose,
    /// Number of steps on the longest ray.
    pub(crate) max_steps: u32,
    /// Group 0 of the marching kernels.
    pub(crate) bind_group: wgpu::BindGroup,
}

impl SceneOnGpu {
    pub(crate) fn new(gpu: &Gpu, scene: &march::Scene) -> Result<Self, GpuError> {
        gpu.attempt("uploading the volume", || {
            let uploaded = upload_channels(gpu, scene, &[])?;
            let (shares, gaps) = (upload_lit(gpu, scene, None)?, upload_gaps(gpu, scene)?);
            let occupancy_bytes = scene.occupancy.words.len() as u64 * 8;
            gpu.check_binding("occupancy in bytes", occupancy_bytes)?;
            let uniform = gpu.uniform::<gpu_types::Scene>("scene");
            let tables = gpu.storage("tables", tables_words(scene).len() as u64 * 4);
            let occupancy = gpu.storage("occupancy", occupancy_bytes);
            let purpose = purpose(scene);
            let bind_group =
                bind_scene(gpu, purpose, scene, [&uniform, &tables, &occupancy], &uploaded, (&shares, &gaps));
            let on_gpu = Self {
                whole: scene.whole().clone(),
                uploaded,
                lit: scene.illumination.lit().cloned(),
                shares,
                gaps,
                uniform,
                tables,
                occupancy,
                purpose,
                max_steps: scene.max_steps(),
                bind_group,
            };
            on_gpu.write_look(gpu, scene);
            Ok(on_gpu)
        })
    }

    /// Replaces the scene; unchanged voxels are not uploaded again.
    pub(crate) fn set(&mut self, gpu: &Gpu, scene: &march::Scene) -> Result<(), GpuError> {
        if !Arc::ptr_eq(&self.whole, scene.whole()) {
            *self = Self::new(gpu, scene)?;
            return Ok(());
        }
        gpu.attempt("changing the look", || {
            let is_lit_alike = match (&self.lit, scene.illumination.lit()) {
                (Some(old), Some(new)) => Arc::ptr_eq(old, new),
                (old, new) => old.is_none() && new.is_none(),
            };
            if !is_lit_alike {
                self.shares = upload_lit(gpu, scene, Some(&self.shares))?;
                self.lit = scene.illumination.lit().cloned();
            }
            let num_uploaded = self.uploaded.len();
            self.uploaded.extend(upload_channels(gpu, scene, &self.uploaded)?);
            let gaps_of =
                |gaps: &Option<(Arc<VoxelGaps>, wgpu::Texture)>| gaps.as_ref().map(|g| Arc::as_ptr(&g.0));
            let is_gapped_alike = gaps_of(&self.gaps) == scene.volume.gaps().map(Arc::as_ptr);
            if !is_gapped_alike {
                self.gaps = upload_gaps(gpu, scene)?;
            }
            let size = tables_words(scene).len() as u64 * 4;
            if self.tables.size() < size {
                self.tables = gpu.storage("tables", size);
            }
            let purpose = purpose(scene);
            let is_mixed = purpose.mixed.is_some() || self.purpose.mixed.is_some();
            let has_new = !is_lit_alike || !is_gapped_alike || self.uploaded.len() != num_uploaded;
            if has_new || is_mixed || purpose != self.purpose {
                let buffers = [&self.uniform, &self.tables, &self.occupancy];
                let light_and_gaps = (&self.shares, &self.gaps);
                self.bind_group = bind_scene(gpu, purpose, scene, buffers, &self.uploaded, light_and_gaps);
            }
            (self.purpose, self.max_steps) = (purpose, scene.max_steps());
            self.write_look(gpu, scene);
            Ok(())
        })
    }

    fn write_look(&self, gpu: &Gpu, scene: &march::Scene) {
        let uniform = gpu_types::Scene::of(scene);
        gpu.queue().write_buffer(&self.uniform, 0, bytemuck::bytes_of(&uniform));
        gpu.queue().write_buffer(&self.tables, 0, bytemuck::cast_slice(&tables_words(scene)));
        let Occupancy { words, peaks, .. } = &scene.occupancy;
        gpu.queue().write_buffer(&self.occupancy, 0, bytemuck::cast_slice(words));
        // Without peaks, every brick may hold the greatest key.
        let unknown = if peaks.is_empty() { vec![u32::MAX; words.len()] } else { Vec::new() };
        let peaks = if peaks.is_empty() { &unknown } else { peaks };
        gpu.queue().write_buffer(&self.occupancy, words.len() as u64 * 4, bytemuck::cast_slice(peaks));
    }
}

/// The channels that are marched together, with their tables.
fn marched(scene: &march::Scene) -> impl Iterator<Item = (&Arc<Volume>, &TransferTable)> {
    let others = scene.others.iter().map(|other| (&other.volume, &other.table));
    std::iter::once((&scene.volume, &scene.table)).chain(others)
}

fn kind_of(volume: &Volume) -> TexelKind {
    match volume.voxels() {
        Voxels::U8(_) | Voxels::U16(_) => TexelKind::Uint,
        Voxels::F32(_) => TexelKind::Float,
    }
}

fn purpose(scene: &march::Scene) -> MarchPurpose {
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
    let (mode, is_glossy) = (scene.settings.mode, scene.highlight().is_some());
    let has_gaps = scene.volume.gaps().is_some();
    MarchPurpose { kind: kind_of(&scene.volume), mode, is_glossy, has_gaps, mixed }
}

/// Uniform, tables and occupancy; voxels of the channels, shares of light and gaps.
fn bind_scene(
    gpu: &Gpu,
    purpose: MarchPurpose,
    scene: &march::Scene,
    [uniform, tables, occupancy]: [&wgpu::Buffer; 3],
    uploaded: &[(Arc<Volume>, wgpu::Texture)],
    (shares, gaps): (&wgpu::Texture, &Option<(Arc<VoxelGaps>, wgpu::Texture)>),
) -> wgpu::BindGroup {
    let view = |texture: &wgpu::Texture| texture.create_view(&wgpu::TextureViewDescriptor::default());
    let texture = |volume| uploaded.iter().find(|(known, _)| Arc::ptr_eq(known, volume));
    let mut views: Vec<_> =
        marched(scene).filter_map(|(volume, _)| texture(volume)).map(|(_, t)| view(t)).collect();
    views.insert(1.min(views.len()), view(shares));
    views.extend(gaps.as_ref().map(|(_, texture)| view(texture)));
    let buffers = [uniform, tables, occupancy].map(wgpu::Buffer::as_entire_binding);
    let textures = views.iter().map(wgpu::BindingResource::TextureView);
    let resources: Vec<_> = buffers.into_iter().chain(textures).collect();
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

/// Uploads the channels that a scene marches and that are not `known`.
fn upload_channels(
    gpu: &Gpu,
    scene: &march::Scene,
    known: &[(Arc<Volume>, wgpu::Texture)],
) -> Result<Vec<(Arc<Volume>, wgpu::Texture)>, GpuError> {
    let is_new = |volume: &&Arc<Volume>| !known.iter().any(|(old, _)| Arc::ptr_eq(old, volume));
    let new = marched(scene).map(|(volume, _)| volume).filter(is_new);
    new.map(|volume| Ok((volume.clone(), upload_volume(gpu, volume)?))).collect()
}

/// Integer voxels stay integers, which is exact on every device and needs no optional feature for 16 bits.
fn upload_volume(gpu: &Gpu, volume: &Volume) -> Result<wgpu::Texture, GpuError> {
    let (format, bytes): (_, &[u8]) = match volume.voxels() {
        Voxels::U8(v) => (wgpu::TextureFormat::R8Uint, v),
        Voxels::U16(v) => (wgpu::TextureFormat::R16Uint, bytemuck::cast_slice(v)),
        Voxels::F32(v) => (wgpu::TextureFormat::R32Float, bytemuck::cast_slice(v)),
    };
    upload_texture(gpu, volume.dims(), format, bytes, None)
}

/// Uploads which voxels of the first channel have nothing in them, if there are any.
fn upload_gaps(gpu: &Gpu, scene: &march::Scene) -> Result<Option<(Arc<VoxelGaps>, wgpu::Texture)>, GpuError> {
    let Some(gaps) = scene.volume.gaps() else { return Ok(None) };
    let dims = scene.volume.dims();
    let texture = upload_texture(gpu, dims, wgpu::TextureFormat::R8Uint, &gaps.bytes, None)?;
    Ok(Some((gaps.clone(), texture)))
}

/// Uploads the voxels' brightness; without shading, a single texel that is never read. A texture of the same size is
/// reused: the queue orders writes after earlier reads.
fn upload_lit(
    gpu: &Gpu,
    scene: &march::Scene,
    before: Option<&wgpu::Texture>,
) -> Result<wgpu::Texture, GpuError> {
    let (dims, shares): (_, &[u8]) = match scene.illumination.lit() {
        Some(lit) => (scene.volume.dims(), &lit.shares),
        None => ([1; 3], &[0]),
    };
    upload_texture(gpu, dims, wgpu::TextureFormat::R8Uint, shares, before)
}

/// A 3-D texture of single numbers, x fastest; `before` is reused if it has this size.
fn upload_texture(
    gpu: &Gpu,
    [width, height, depth]: [u32; 3],
    format: wgpu::TextureFormat,
    bytes: &[u8],
    before: Option<&wgpu::Texture>,
) -> Result<wgpu::Texture, GpuError> {
    let limit = gpu.device().limits().max_texture_dimension_3d;
    let longest = width.max(height).max(depth);
    if longest > limit {
        let (needed, limit) = (longest.into(), limit.into());
        return Err(GpuError::TooLarge { what: "longest side of the volume in voxels", needed, limit });
    }
    let size = wgpu::Extent3d { width, height, depth_or_array_layers: depth };
    let new = || {
        gpu.device().create_texture(&wgpu::TextureDescriptor {
            label: Some("voxels"),
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        })
    };
    let texture = before.filter(|t| t.size() == size && t.format() == format).cloned().unwrap_or_else(new);
    let bytes_per_slice = bytes.len() / depth as usize;
    let bytes_per_row = (bytes_per_slice / height as usize) as u32;
    let slices_per_slab = (SLAB_BYTES / bytes_per_slice).max(1);
    for (slab, bytes) in bytes.chunks(slices_per_slab * bytes_per_slice).enumerate() {
        gpu.queue().write_texture(
            wgpu::TexelCopyTextureInfo {
                texture: &texture,
                mip_level: 0,
                origin: wgpu::Origin3d { x: 0, y: 0, z: (slab * slices_per_slab) as u32 },
                aspect: wgpu::TextureAspect::All,
            },
            bytes,
            wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(bytes_per_row),
                rows_per_image: Some(height),
            },
            wgpu::Extent3d { width, height, depth_or_array_layers: (bytes.len() / bytes_per_slice) as u32 },
        );
        // Each slab's staging memory is free again once it has arrived.
        gpu.queue().submit([]);
        gpu.wait("uploading the volume")?;
    }
    Ok(texture)
}

/// Bytes of a volume that are staged at once.
const SLAB_BYTES: usize = 32 << 20;
