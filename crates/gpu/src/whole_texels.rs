//! The texels of a volume that is in memory whole, as 3-D textures, and its occupancy.

use std::sync::Arc;

use isinglass_core::kernels::march::Scene;
use isinglass_core::volume::{Lit, Occupancy, Volume, VoxelGaps};

use crate::device::Gpu;
use crate::error::GpuError;
use crate::scene::{Texels, marched};
use crate::textures::{Place, Staging, bytes_of, check_side, format_of, texture, view};

/// The textures of a scene. The voxels stay when the look changes.
pub(crate) struct WholeTexels {
    dims: [u32; 3],
    /// The channels that a look has shown.
    channels: Vec<(Arc<Volume>, wgpu::Texture)>,
    lit: Option<Arc<Lit>>,
    shares: wgpu::Texture,
    gaps: Option<(Arc<VoxelGaps>, wgpu::Texture)>,
    occupancy: wgpu::Buffer,
}

impl WholeTexels {
    pub(crate) fn new(gpu: &Gpu, scene: &Scene) -> Result<Self, GpuError> {
        check_side(gpu, scene.volume.dims())?;
        let occupancy_bytes = scene.occupancy.words.len() as u64 * 8;
        gpu.check_binding("occupancy in bytes", occupancy_bytes)?;
        let mut texels = Self {
            dims: scene.volume.dims(),
            channels: Vec::new(),
            lit: None,
            // Without shading, this texel is never read.
            shares: texture(gpu, [1; 3], wgpu::TextureFormat::R8Uint),
            gaps: None,
            occupancy: gpu.storage("occupancy", occupancy_bytes),
        };
        texels.set(gpu, scene)?;
        Ok(texels)
    }

    /// Texels along x, y, z.
    pub(crate) fn dims(&self) -> [u32; 3] {
        self.dims
    }

    /// Takes over a scene of a volume with as many voxels.
    pub(crate) fn set(&mut self, gpu: &Gpu, scene: &Scene) -> Result<(), GpuError> {
        let dims = self.dims;
        let mut staging = Staging::default();
        for (volume, _) in marched(scene) {
            if !self.channels.iter().any(|(known, _)| Arc::ptr_eq(known, volume)) {
                let texture = texture(gpu, dims, format_of(volume));
                staging.write(gpu, &texture, &Place::whole(dims), bytes_of(volume))?;
                self.channels.push((volume.clone(), texture));
            }
        }
        let lit = scene.illumination.lit();
        if let Some(lit) = lit.filter(|lit| self.lit.as_ref().is_none_or(|known| !Arc::ptr_eq(known, lit))) {
            // The queue orders writes after earlier reads.
            if [self.shares.width(), self.shares.height(), self.shares.depth_or_array_layers()] != dims {
                self.shares = texture(gpu, dims, wgpu::TextureFormat::R8Uint);
            }
            staging.write(gpu, &self.shares, &Place::whole(dims), &lit.shares)?;
            self.lit = Some(lit.clone());
        }
        let gaps = scene.volume.gaps();
        if self.gaps.as_ref().map(|(known, _)| Arc::as_ptr(known)) != gaps.map(Arc::as_ptr) {
            self.gaps = None;
            if let Some(gaps) = gaps {
                let texture = texture(gpu, dims, wgpu::TextureFormat::R8Uint);
                staging.write(gpu, &texture, &Place::whole(dims), &gaps.bytes)?;
                self.gaps = Some((gaps.clone(), texture));
            }
        }
        let Occupancy { words, peaks, .. } = &scene.occupancy;
        gpu.queue().write_buffer(&self.occupancy, 0, bytemuck::cast_slice(words));
        // Without peaks, every brick may hold the greatest key.
        let unknown = if peaks.is_empty() { vec![u32::MAX; words.len()] } else { Vec::new() };
        let peaks = if peaks.is_empty() { &unknown[..] } else { peaks };
        gpu.queue().write_buffer(&self.occupancy, words.len() as u64 * 4, bytemuck::cast_slice(peaks));
        Ok(())
    }

    pub(crate) fn texels(&self, scene: &Scene) -> Texels<'_> {
        let of = |volume| self.channels.iter().find(|(known, _)| Arc::ptr_eq(known, volume));
        Texels {
            occupancy: &self.occupancy,
            channels: marched(scene).filter_map(|(volume, _)| of(volume)).map(|(_, t)| view(t)).collect(),
            shares: view(&self.shares),
            gaps: self.gaps.as_ref().map(|(_, texture)| view(texture)),
            pages: None,
        }
    }
}
