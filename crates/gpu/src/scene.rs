//! A scene on the GPU: voxels and brightness as 3-D textures, the transfer table and occupancy as storage buffers.

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::kernels::march;
use isinglass_core::kernels::march::modes::{Surface, key_limit};
use isinglass_core::mode::MAX_ISOS;
use isinglass_core::volume::{Lit, Occupancy, Volume, Voxels};

use crate::device::{Gpu, bind};
use crate::error::GpuError;
use crate::gpu_types;
use crate::shaders::{MarchPurpose, TexelKind};

/// An uploaded scene. A new look rewrites two small buffers, and a texture if the light changes; the voxels stay.
pub(crate) struct SceneOnGpu {
    volume: Arc<Volume>,
    lit: Option<Arc<Lit>>,
    voxels: wgpu::Texture,
    shares: wgpu::Texture,
    uniform: wgpu::Buffer,
    table: wgpu::Buffer,
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
            let (kind, voxels) = upload_volume(gpu, &scene.volume)?;
            let shares = upload_lit(gpu, scene, None)?;
            let table_bytes = table_words(scene).len() as u64 * 4;
            let occupancy_bytes = scene.occupancy.words.len() as u64 * 8;
            gpu.check_binding("occupancy in bytes", occupancy_bytes)?;
            let uniform = gpu.uniform::<gpu_types::Scene>("scene");
            let table = gpu.storage("table", table_bytes);
            let occupancy = gpu.storage("occupancy", occupancy_bytes);
            let bind_group = bind_scene(gpu, kind, [&uniform, &table, &occupancy], [&voxels, &shares]);
            let volume = Arc::clone(&scene.volume);
            let lit = scene.illumination.lit().cloned();
            let (purpose, max_steps) = (purpose(kind, scene), scene.max_steps());
            let on_gpu = Self {
                volume,
                lit,
                voxels,
                shares,
                uniform,
                table,
                occupancy,
                purpose,
                max_steps,
                bind_group,
            };
            on_gpu.write_look(gpu, scene);
            Ok(on_gpu)
        })
    }

    /// Replaces the scene; unchanged voxels are not uploaded again.
    pub(crate) fn set(&mut self, gpu: &Gpu, scene: &march::Scene) -> Result<(), GpuError> {
        if !Arc::ptr_eq(&self.volume, &scene.volume) {
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
                let buffers = [&self.uniform, &self.table, &self.occupancy];
                self.bind_group = bind_scene(gpu, self.purpose.kind, buffers, [&self.voxels, &self.shares]);
                self.lit = scene.illumination.lit().cloned();
            }
            (self.purpose, self.max_steps) = (purpose(self.purpose.kind, scene), scene.max_steps());
            self.write_look(gpu, scene);
            Ok(())
        })
    }

    fn write_look(&self, gpu: &Gpu, scene: &march::Scene) {
        let uniform = gpu_types::Scene::of(scene);
        gpu.queue().write_buffer(&self.uniform, 0, bytemuck::bytes_of(&uniform));
        gpu.queue().write_buffer(&self.table, 0, bytemuck::cast_slice(&table_words(scene)));
        let Occupancy { words, peaks, .. } = &scene.occupancy;
        gpu.queue().write_buffer(&self.occupancy, 0, bytemuck::cast_slice(words));
        // Without peaks, every brick may hold the greatest key.
        let unknown = if peaks.is_empty() { vec![u32::MAX; words.len()] } else { Vec::new() };
        let peaks = if peaks.is_empty() { &unknown } else { peaks };
        gpu.queue().write_buffer(&self.occupancy, words.len() as u64 * 4, bytemuck::cast_slice(peaks));
    }
}

fn purpose(kind: TexelKind, scene: &march::Scene) -> MarchPurpose {
    MarchPurpose { kind, mode: scene.settings.mode, is_glossy: scene.highlight().is_some() }
}

/// Uniform, table and occupancy; voxels and shares of light.
fn bind_scene(
    gpu: &Gpu,
    kind: TexelKind,
    [uniform, table, occupancy]: [&wgpu::Buffer; 3],
    textures: [&wgpu::Texture; 2],
) -> wgpu::BindGroup {
    let [voxels, shares] = textures.map(|t| t.create_view(&wgpu::TextureViewDescriptor::default()));
    bind(
        gpu.device(),
        "scene",
        gpu.layouts().scene(kind),
        &[
            uniform.as_entire_binding(),
            table.as_entire_binding(),
            occupancy.as_entire_binding(),
            wgpu::BindingResource::TextureView(&voxels),
            wgpu::BindingResource::TextureView(&shares),
        ],
    )
}

/// The table in the order of `TransferTable` in `shaders/shared/types.wgsl`.
fn table_words(scene: &march::Scene) -> Vec<f32> {
    let mut words: Vec<f32> =
        scene.table.integral.iter().chain(&scene.table.density).flatten().copied().collect();
    let unused = Surface { x: 0.0, stored: 0.0, color: Vec3::ZERO, tau: 0.0 };
    for Surface { x, color, tau, .. } in
        scene.surfaces.iter().chain(std::iter::repeat(&unused)).take(MAX_ISOS)
    {
        words.extend([color.x, color.y, color.z, *tau, *x, 0.0, 0.0, 0.0]);
    }
    let key_limit = key_limit(scene.settings.mode, &scene.table);
    let [num_surfaces, has_lesser_bodies] =
        [scene.surfaces.len() as u32, u32::from(scene.has_lesser_bodies)].map(f32::from_bits);
    words.extend([num_surfaces, key_limit, has_lesser_bodies, 0.0]);
    words
}

/// Integer voxels stay integers, which is exact on every device and needs no optional feature for 16 bits.
fn upload_volume(gpu: &Gpu, volume: &Volume) -> Result<(TexelKind, wgpu::Texture), GpuError> {
    let (kind, format, bytes): (_, _, &[u8]) = match volume.voxels() {
        Voxels::U8(v) => (TexelKind::Uint, wgpu::TextureFormat::R8Uint, v),
        Voxels::U16(v) => (TexelKind::Uint, wgpu::TextureFormat::R16Uint, bytemuck::cast_slice(v)),
        Voxels::F32(v) => (TexelKind::Float, wgpu::TextureFormat::R32Float, bytemuck::cast_slice(v)),
    };
    Ok((kind, upload_texture(gpu, volume.dims(), format, bytes, None)?))
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
