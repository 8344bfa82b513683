//! The first draw with each pipeline, ahead of time and off the screen.
//!
//! Software devices, and some drivers of hardware, compile a kernel when it is drawn with for the first time: a second
//! or more, in which a window that draws with it stands still.

use std::time::Duration;

use crate::error::{GpuError, scoped};

/// Draws of one pixel that nobody sees. Holds what it needs, so that any thread can run it while the window draws.
pub struct WarmUp {
    pub(crate) target: wgpu::TextureFormat,
    /// The soonest needed first.
    pub(crate) draws: Vec<Draw>,
}

/// A pipeline for one colour target, and its groups.
pub(crate) struct Draw {
    pub(crate) pipeline: wgpu::RenderPipeline,
    pub(crate) groups: Vec<wgpu::BindGroup>,
}

impl WarmUp {
    /// Draws with one pipeline after the other and waits for each, so that whatever else is drawn meanwhile waits for one
    /// kernel at most. Ends early if `goes_on` says so between two of them. Returns how many were drawn with.
    ///
    /// # Errors
    /// If the device reports one.
    pub fn run(
        &self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        mut goes_on: impl FnMut() -> bool,
    ) -> Result<usize, GpuError> {
        let view = scoped(device, "making a target of one pixel", || {
            let texture = device.create_texture(&wgpu::TextureDescriptor {
                label: Some("warm-up"),
                size: wgpu::Extent3d::default(),
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: self.target,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
                view_formats: &[],
            });
            Ok(texture.create_view(&wgpu::TextureViewDescriptor::default()))
        })?;
        for (num_drawn, draw) in self.draws.iter().enumerate() {
            if !goes_on() {
                return Ok(num_drawn);
            }
            scoped(device, "drawing one pixel", || draw.run(device, queue, &view))?;
        }
        Ok(self.draws.len())
    }
}

impl Draw {
    fn run(
        &self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        view: &wgpu::TextureView,
    ) -> Result<(), GpuError> {
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("warm-up"),
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations {
                        load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                        store: wgpu::StoreOp::Store,
                    },
                })],
                ..Default::default()
            });
            pass.set_pipeline(&self.pipeline);
            for (i, group) in (0..).zip(&self.groups) {
                pass.set_bind_group(i, group, &[]);
            }
            pass.draw(0..3, 0..1);
        }
        let submission_index = Some(queue.submit([encoder.finish()]));
        // In short waits: a long one keeps others from destroying what they no longer need.
        let wait = wgpu::PollType::Wait { submission_index, timeout: Some(WAIT) };
        loop {
            match device.poll(wait.clone()) {
                Ok(_) => return Ok(()),
                Err(wgpu::PollError::Timeout) => {}
                Err(e) => return Err(GpuError::Failed { what: "drawing one pixel", reason: e.to_string() }),
            }
        }
    }
}

const WAIT: Duration = Duration::from_millis(10);
