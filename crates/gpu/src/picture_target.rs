//! A picture made band by band: `render` and `raycast` write the same buffer.

use std::ops::Range;

use isinglass_core::kernels::lens::View;
use isinglass_core::picture::Picture;

use crate::device::{Gpu, bands, bind, rows_per_band};
use crate::error::GpuError;
use crate::gpu_types::{Band, Basis, WORKGROUP_SIDE};
use crate::readback::Readback;

/// Buffers for one band of a picture; they grow for a larger one.
pub(crate) struct PictureTarget {
    camera: wgpu::Buffer,
    band: wgpu::Buffer,
    pixels: wgpu::Buffer,
    bind_group: wgpu::BindGroup,
    readback: Readback,
    /// Height of the kernel's workgroups.
    group_height: u32,
}

impl PictureTarget {
    /// For kernels of square workgroups.
    pub(crate) fn new(gpu: &Gpu) -> Self {
        Self::of_groups(gpu, WORKGROUP_SIDE)
    }

    /// For kernels of workgroups of this height.
    pub(crate) fn of_groups(gpu: &Gpu, group_height: u32) -> Self {
        let (camera, band) = (gpu.uniform::<Basis>("camera"), gpu.uniform::<Band>("band"));
        let pixels = gpu.storage("pixels", BYTES_PER_PIXEL);
        let bind_group = Self::bind(gpu, &camera, &band, &pixels);
        Self { camera, band, pixels, bind_group, readback: Readback::default(), group_height }
    }

    fn bind(gpu: &Gpu, camera: &wgpu::Buffer, band: &wgpu::Buffer, pixels: &wgpu::Buffer) -> wgpu::BindGroup {
        bind(
            gpu.device(),
            "picture",
            &gpu.layouts().picture,
            &[camera.as_entire_binding(), band.as_entire_binding(), pixels.as_entire_binding()],
        )
    }

    /// Runs a kernel over all pixels of `view`; `group_0` is the kernel's own input.
    pub(crate) fn draw(
        &mut self,
        gpu: &Gpu,
        pipeline: &wgpu::ComputePipeline,
        group_0: &wgpu::BindGroup,
        view: &View,
        max_steps: u32,
    ) -> Result<Picture, GpuError> {
        self.draw_rows(gpu, pipeline, group_0, view, max_steps, 0..view.basis.height as u32)
    }

    /// Draws some rows; the picture has only those. No pixel takes more than `max_steps`.
    pub(crate) fn draw_rows(
        &mut self,
        gpu: &Gpu,
        pipeline: &wgpu::ComputePipeline,
        group_0: &wgpu::BindGroup,
        view: &View,
        max_steps: u32,
        rows: Range<u32>,
    ) -> Result<Picture, GpuError> {
        let is_inside = rows.start < rows.end && rows.end <= view.basis.height as u32;
        if !view.is_valid() || !is_inside {
            return Err(GpuError::Camera);
        }
        let (width, height) = (view.basis.width as u32, rows.end - rows.start);
        let max_pixels = gpu.max_dispatch_pixels(max_steps);
        let bytes = u64::from(rows_per_band(width, height, max_pixels)) * u64::from(width) * BYTES_PER_PIXEL;
        if self.pixels.size() < bytes {
            gpu.check_binding("picture in bytes", bytes)?;
            self.pixels = gpu.storage("pixels", bytes);
            self.bind_group = Self::bind(gpu, &self.camera, &self.band, &self.pixels);
        }
        gpu.queue().write_buffer(&self.camera, 0, bytemuck::bytes_of(&Basis::of(*view)));
        let mut pixels = Vec::with_capacity(width as usize * height as usize);
        for band in bands(width, height, max_pixels) {
            let band = Band { first_row: rows.start + band.first_row, ..band };
            gpu.queue().write_buffer(&self.band, 0, bytemuck::bytes_of(&band));
            let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            {
                let mut pass = encoder.begin_compute_pass(&gpu.pass());
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, group_0, &[]);
                pass.set_bind_group(1, &self.bind_group, &[]);
                pass.dispatch_workgroups(
                    width.div_ceil(WORKGROUP_SIDE),
                    band.num_rows.div_ceil(self.group_height),
                    1,
                );
            }
            self.readback.read(gpu, encoder, [(&self.pixels, band.num_pixels as usize)], [&mut pixels])?;
        }
        Ok(Picture { width, height, pixels })
    }
}

const BYTES_PER_PIXEL: u64 = 16;
