//! Makes the pipelines that a viewer may need, and draws with each, ahead of time and off the screen.
//!
//! Software devices and some drivers compile a kernel at the first draw, which may take more than a second. The
//! window stands still meanwhile, as all draws of a device wait for each other. Software devices share a cache of
//! compiled kernels, so less urgent ones are first drawn on another device.

use std::sync::Arc;
use std::time::Duration;

use crate::casts::Casts;
use crate::device::{NoAnswer, poll};
use crate::error::{GpuError, scoped};
use crate::shaders::Purpose;
use crate::view_pass::{Channels, ViewPass};

/// Invisible draws of one pixel. It owns what it needs, so any thread can run it while the window draws.
pub struct WarmUp {
    pub(crate) target: wgpu::TextureFormat,
    pub(crate) casts: Arc<Casts>,
    /// The draws, the most urgent first.
    pub(crate) draws: Vec<Draw>,
}

/// A pipeline and its groups.
pub(crate) struct Draw {
    pub(crate) pipeline: Pipeline,
    pub(crate) groups: Vec<wgpu::BindGroup>,
}

/// A pipeline for one colour target.
pub(crate) enum Pipeline {
    Made(wgpu::RenderPipeline),
    /// A casting pipeline that must be made.
    Cast(Purpose),
}

impl WarmUp {
    /// Draws with each pipeline and waits for it, so that other draws wait for at most one kernel. A software
    /// `adapter` with a cache in use draws only for the first picture. Returns the number of pipelines.
    ///
    /// `submit` passes commands to the queue of `device`, or ends this by returning `None`. A window must submit
    /// where it draws: a surface cannot be configured while another thread submits.
    ///
    /// # Errors
    /// If the device reports one.
    pub fn run(
        &self,
        adapter: Option<&wgpu::Adapter>,
        device: &wgpu::Device,
        submit: impl Fn(wgpu::CommandBuffer) -> Option<wgpu::SubmissionIndex>,
    ) -> Result<usize, GpuError> {
        let is_software = |a: &&wgpu::Adapter| a.get_info().device_type == wgpu::DeviceType::Cpu;
        // Without another device the first draws just take longer here.
        let beside = adapter.filter(is_software).and_then(|adapter| self.beside(adapter, device).ok());
        let view = self.view(device)?;
        for (number, draw) in self.draws.iter().enumerate() {
            // The first picture's kernels are urgent, and compiling them twice at once would take longer.
            if number >= NUM_AT_ONCE
                && let Some((device, queue, warm_up, view)) = &beside
                && let Some(draw) = warm_up.draws.get(number)
            {
                let submit = |commands| Some(queue.submit([commands]));
                scoped(device, "drawing one pixel beside", || {
                    draw.run(device, &warm_up.casts, &submit, view)
                })?;
                std::thread::sleep(CACHE_DELAY);
            }
            if !scoped(device, "drawing one pixel", || draw.run(device, &self.casts, &submit, &view))? {
                return Ok(number);
            }
        }
        Ok(self.draws.len())
    }

    /// Draws on another device of the adapter.
    fn beside(
        &self,
        adapter: &wgpu::Adapter,
        device: &wgpu::Device,
    ) -> Result<(wgpu::Device, wgpu::Queue, Self, wgpu::TextureView), GpuError> {
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("warm-up"),
            required_features: device.features(),
            required_limits: device.limits(),
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| GpuError::Failed { what: "opening a device", reason: e.to_string() })?;
        let warm_up = ViewPass::new(&device, self.target)?.warm_up(&device, &queue)?;
        let view = warm_up.view(&device)?;
        Ok((device, queue, warm_up, view))
    }

    fn view(&self, device: &wgpu::Device) -> Result<wgpu::TextureView, GpuError> {
        scoped(device, "making a target of one pixel", || {
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
        })
    }
}

impl Draw {
    /// Draws once; returns whether it was submitted and is done.
    fn run(
        &self,
        device: &wgpu::Device,
        casts: &Casts,
        submit: &impl Fn(wgpu::CommandBuffer) -> Option<wgpu::SubmissionIndex>,
        view: &wgpu::TextureView,
    ) -> Result<bool, GpuError> {
        let pipeline = match &self.pipeline {
            Pipeline::Made(pipeline) => pipeline.clone(),
            Pipeline::Cast(purpose) => {
                let made = casts.get(*purpose, Channels::All);
                made.unwrap_or_else(|| casts.make(*purpose, Channels::All))
            }
        };
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
            pass.set_pipeline(&pipeline);
            for (i, group) in (0..).zip(&self.groups) {
                pass.set_bind_group(i, group, &[]);
            }
            pass.draw(0..3, 0..1);
        }
        let Some(submission) = submit(encoder.finish()) else { return Ok(false) };
        // The waits are short, because a long one keeps others from destroying resources.
        let wait = wgpu::PollType::Wait { submission_index: Some(submission), timeout: Some(WAIT) };
        loop {
            let what = "drawing one pixel";
            match poll(device, wait.clone()) {
                Ok(Ok(_)) => break,
                Ok(Err(wgpu::PollError::Timeout)) => {}
                Ok(Err(e)) => return Err(GpuError::Failed { what, reason: e.to_string() }),
                Err(NoAnswer) => {
                    return Err(GpuError::Lost { what, reason: "the device stopped answering".into() });
                }
            }
        }
        if let Pipeline::Cast(purpose) = self.pipeline {
            casts.add(purpose, Channels::All, &pipeline);
        }
        Ok(true)
    }
}

/// Draws for the first picture: of one frame, and of a smaller picture enlarged.
const NUM_AT_ONCE: usize = 2;
/// A thread of the driver writes the cache.
const CACHE_DELAY: Duration = Duration::from_millis(50);
const WAIT: Duration = Duration::from_millis(10);
