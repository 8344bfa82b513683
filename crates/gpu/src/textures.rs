//! 3-D textures of single numbers, and how bytes get there.

use isinglass_core::volume::{Volume, Voxels};

use crate::device::Gpu;
use crate::error::GpuError;

/// Where some texels go.
pub(crate) struct Place {
    /// The first texel.
    pub(crate) first: [u32; 3],
    /// Texels along x, y, z.
    pub(crate) dims: [u32; 3],
}

impl Place {
    pub(crate) fn whole(dims: [u32; 3]) -> Self {
        Self { first: [0; 3], dims }
    }
}

/// Integer voxels stay integers, which is exact on every device and needs no optional feature for 16 bits.
pub(crate) fn format_of(volume: &Volume) -> wgpu::TextureFormat {
    match volume.voxels() {
        Voxels::U8(_) => wgpu::TextureFormat::R8Uint,
        Voxels::U16(_) => wgpu::TextureFormat::R16Uint,
        Voxels::F32(_) => wgpu::TextureFormat::R32Float,
    }
}

pub(crate) fn bytes_of(volume: &Volume) -> &[u8] {
    match volume.voxels() {
        Voxels::U8(v) => v,
        Voxels::U16(v) => bytemuck::cast_slice(v),
        Voxels::F32(v) => bytemuck::cast_slice(v),
    }
}

/// Returns an error if a texture would be too long for the device.
pub(crate) fn check_side(gpu: &Gpu, dims: [u32; 3]) -> Result<(), GpuError> {
    let limit = gpu.device().limits().max_texture_dimension_3d;
    let longest = dims.into_iter().max().unwrap_or(0);
    if longest <= limit {
        return Ok(());
    }
    let (needed, limit) = (longest.into(), limit.into());
    Err(GpuError::TooLarge { what: "longest side of the volume in voxels", needed, limit })
}

/// A texture without contents.
pub(crate) fn texture(
    gpu: &Gpu,
    [width, height, depth]: [u32; 3],
    format: wgpu::TextureFormat,
) -> wgpu::Texture {
    gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: Some("voxels"),
        size: wgpu::Extent3d { width, height, depth_or_array_layers: depth },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D3,
        format,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    })
}

pub(crate) fn view(texture: &wgpu::Texture) -> wgpu::TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor::default())
}

/// Writes texels, and waits now and then, so that the memory of what is on its way has a bound.
#[derive(Default)]
pub(crate) struct Staging {
    num_bytes: usize,
}

impl Staging {
    /// Writes texels, x fastest, to a place in a texture.
    pub(crate) fn write(
        &mut self,
        gpu: &Gpu,
        texture: &wgpu::Texture,
        place: &Place,
        bytes: &[u8],
    ) -> Result<(), GpuError> {
        let [width, height, depth] = place.dims;
        let bytes_per_slice = bytes.len() / depth as usize;
        let bytes_per_row = (bytes_per_slice / height as usize) as u32;
        // Rows are staged at multiples of this many bytes.
        let staged_per_slice = bytes_per_row.next_multiple_of(ROW_ALIGNMENT) as usize * height as usize;
        let slices_per_slab = (SLAB_BYTES / staged_per_slice).max(1);
        for (slab, bytes) in bytes.chunks(slices_per_slab * bytes_per_slice).enumerate() {
            let [x, y, z] = place.first;
            let num_slices = bytes.len() / bytes_per_slice;
            gpu.queue().write_texture(
                wgpu::TexelCopyTextureInfo {
                    texture,
                    mip_level: 0,
                    origin: wgpu::Origin3d { x, y, z: z + (slab * slices_per_slab) as u32 },
                    aspect: wgpu::TextureAspect::All,
                },
                bytes,
                wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(bytes_per_row),
                    rows_per_image: Some(height),
                },
                wgpu::Extent3d { width, height, depth_or_array_layers: num_slices as u32 },
            );
            self.num_bytes += num_slices * staged_per_slice;
            if self.num_bytes >= SLAB_BYTES {
                // Staging memory is free again once its contents have arrived.
                gpu.queue().submit([]);
                gpu.wait("uploading the volume")?;
                self.num_bytes = 0;
            }
        }
        Ok(())
    }
}

/// Bytes that are staged at once.
const SLAB_BYTES: usize = 32 << 20;
/// What wgpu pads rows to.
const ROW_ALIGNMENT: u32 = wgpu::COPY_BYTES_PER_ROW_ALIGNMENT;
