//! Copies from the GPU to memory.

use bytemuck::Pod;

use crate::device::Gpu;
use crate::error::GpuError;

/// Staging buffers that are kept from one readback to the next.
#[derive(Default)]
pub(crate) struct Readback {
    staging: Vec<wgpu::Buffer>,
}

impl Readback {
    /// Adds copies of the first `counts[i]` elements of each source to `encoder`, submits it, waits, and appends the
    /// elements to the `targets`.
    pub(crate) fn read<T: Pod, const N: usize>(
        &mut self,
        gpu: &Gpu,
        mut encoder: wgpu::CommandEncoder,
        sources: [(&wgpu::Buffer, usize); N],
        targets: [&mut Vec<T>; N],
    ) -> Result<(), GpuError> {
        const WHAT: &str = "reading back";
        let bytes = sources.map(|(_, count)| (count * size_of::<T>()) as u64);
        for (i, &needed) in bytes.iter().enumerate() {
            if self.staging.get(i).is_none_or(|b| b.size() < needed) {
                self.staging.truncate(i);
                self.staging.push(gpu.device().create_buffer(&wgpu::BufferDescriptor {
                    label: Some("staging"),
                    size: needed.max(4),
                    usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                    mapped_at_creation: false,
                }));
            }
            if needed > 0 {
                encoder.copy_buffer_to_buffer(sources[i].0, 0, &self.staging[i], 0, needed);
            }
        }
        gpu.queue().submit([encoder.finish()]);
        for (staging, &needed) in self.staging.iter().zip(&bytes).filter(|(_, needed)| **needed > 0) {
            staging.map_async(wgpu::MapMode::Read, ..needed, |_| ());
        }
        gpu.wait(WHAT)?;
        for ((staging, &needed), target) in self.staging.iter().zip(&bytes).zip(targets) {
            if needed > 0 {
                {
                    // Mapping fails when the device is lost or out of memory.
                    let failed =
                        |e: wgpu::MapRangeError| GpuError::Failed { what: WHAT, reason: e.to_string() };
                    let view = staging.slice(..needed).get_mapped_range().map_err(failed)?;
                    target.extend_from_slice(bytemuck::cast_slice(&view));
                }
                staging.unmap();
            }
        }
        Ok(())
    }
}
