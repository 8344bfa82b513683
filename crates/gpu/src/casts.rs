//! The pipelines that cast novel views into a colour target, one for each purpose.
//!
//! Drivers compile each anew, which takes them up to seconds, so all that a viewer may need are made beforehand by a thread
//! ([`crate::WarmUp`]). As long as that is at work a window waits for none: it casts with what there is.

use std::sync::{Arc, Mutex, PoisonError};

use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::mode::Compositing;

use crate::device::{CasterLayouts, shader_module};
use crate::shaders::{Frames, Kernel, Purpose};
use crate::view_pass::Channels;

/// What pipelines are made of, and those that there are. Whoever makes them ahead of need holds it too.
pub(crate) struct Casts {
    device: wgpu::Device,
    target: wgpu::TextureFormat,
    /// Of one frame and of several.
    texts: [(wgpu::PipelineLayout, wgpu::ShaderModule); 2],
    /// A dozen; found by looking at each.
    made: Mutex<Vec<(Purpose, Channels, wgpu::RenderPipeline)>>,
}

impl Casts {
    /// Without any. `view` is the layout of group 1.
    pub(crate) fn new(
        device: &wgpu::Device,
        target: wgpu::TextureFormat,
        casters: &CasterLayouts,
        view: &wgpu::BindGroupLayout,
    ) -> Self {
        let texts = [Frames::One, Frames::Several].map(|frames| {
            let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some("view"),
                bind_group_layouts: &[Some(casters.of(frames)), Some(view)],
                immediate_size: 0,
            });
            let purpose = Purpose { frames, ..Purpose::default() };
            (layout, shader_module(device, Kernel::RaycastView(purpose, false)))
        });
        Self { device: device.clone(), target, texts, made: Mutex::default() }
    }

    /// That of a purpose, if there is one.
    pub(crate) fn get(&self, purpose: Purpose, channels: Channels) -> Option<wgpu::RenderPipeline> {
        let made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        let found = made.iter().find(|(p, c, _)| (*p, *c) == (purpose, channels));
        found.map(|(.., pipeline)| pipeline.clone())
    }

    /// That of a purpose, made now if there is none.
    pub(crate) fn get_or_make(&self, purpose: Purpose, channels: Channels) -> wgpu::RenderPipeline {
        self.get(purpose, channels).unwrap_or_else(|| {
            let pipeline = self.make(purpose, channels);
            self.add(purpose, channels, &pipeline);
            pipeline
        })
    }

    /// From now on there is this one. Whoever makes it beforehand draws with it first.
    pub(crate) fn add(&self, purpose: Purpose, channels: Channels, pipeline: &wgpu::RenderPipeline) {
        if self.get(purpose, channels).is_none() {
            let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
            made.push((purpose, channels, pipeline.clone()));
        }
    }

    /// A new one.
    pub(crate) fn make(&self, purpose: Purpose, channels: Channels) -> wgpu::RenderPipeline {
        let (layout, module) = &self.texts[purpose.frames as usize];
        let constants = Kernel::RaycastView(purpose, !self.target.is_srgb()).constants();
        let options = wgpu::PipelineCompilationOptions { constants: &constants, ..Default::default() };
        self.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("view"),
            layout: Some(layout),
            vertex: wgpu::VertexState {
                module,
                entry_point: Some("view_vertex"),
                compilation_options: options.clone(),
                buffers: &[],
            },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: None,
            multisample: wgpu::MultisampleState::default(),
            fragment: Some(wgpu::FragmentState {
                module,
                entry_point: Some("view_fragment"),
                compilation_options: options,
                targets: &[Some(wgpu::ColorTargetState {
                    write_mask: channels.mask(),
                    ..self.target.into()
                })],
            }),
            multiview_mask: None,
            cache: None,
        })
    }

    /// Whether somebody makes pipelines ahead of need.
    pub(crate) fn are_coming(self: &Arc<Self>) -> bool {
        Arc::strong_count(self) > 1
    }
}

/// All that a viewer casts for, the soonest needed first.
pub(crate) fn purposes_of_viewers() -> impl Iterator<Item = Purpose> {
    let of = |compositing| {
        [Frames::One, Frames::Several]
            .map(|frames| Purpose::new(frames, compositing, &CastOptions::default()))
    };
    [Compositing::Over, Compositing::Greatest, Compositing::Mean].into_iter().flat_map(of)
}
