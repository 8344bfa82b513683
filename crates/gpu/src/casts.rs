//! The pipelines that cast novel views into a colour target, one per purpose.
//!
//! Drivers compile each anew, which takes up to seconds. So a thread makes all that a viewer may need beforehand
//! ([`crate::WarmUp`]). Meanwhile a window never waits: it casts with the pipelines that exist.

use std::sync::{Arc, Mutex, PoisonError};

use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::mode::Compositing;

use crate::device::{CasterLayouts, shader_module};
use crate::shaders::{Frames, Kernel, Purpose};
use crate::view_pass::Channels;

/// The sources of pipelines, and the finished ones. The thread that makes them ahead of need shares it.
pub(crate) struct Casts {
    device: wgpu::Device,
    target: wgpu::TextureFormat,
    /// Texts for one frame and for several.
    texts: [(wgpu::PipelineLayout, wgpu::ShaderModule); 2],
    /// A dozen pipelines, so a linear search is enough.
    made: Mutex<Vec<(Purpose, Channels, wgpu::RenderPipeline)>>,
}

impl Casts {
    /// Starts without pipelines. `view` is the layout of group 1.
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

    /// The pipeline for a purpose, if it exists.
    pub(crate) fn get(&self, purpose: Purpose, channels: Channels) -> Option<wgpu::RenderPipeline> {
        let made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        let found = made.iter().find(|(p, c, _)| (*p, *c) == (purpose, channels));
        found.map(|(.., pipeline)| pipeline.clone())
    }

    /// The pipeline for a purpose, made now if necessary.
    pub(crate) fn get_or_make(&self, purpose: Purpose, channels: Channels) -> wgpu::RenderPipeline {
        self.get(purpose, channels).unwrap_or_else(|| {
            let pipeline = self.make(purpose, channels);
            self.add(purpose, channels, &pipeline);
            pipeline
        })
    }

    /// Adds a pipeline. A thread that makes it ahead of need first draws with it.
    pub(crate) fn add(&self, purpose: Purpose, channels: Channels, pipeline: &wgpu::RenderPipeline) {
        if self.get(purpose, channels).is_none() {
            let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
            made.push((purpose, channels, pipeline.clone()));
        }
    }

    /// Makes a new pipeline.
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

    /// Whether another holder still makes pipelines ahead of need.
    pub(crate) fn are_coming(self: &Arc<Self>) -> bool {
        Arc::strong_count(self) > 1
    }
}

/// All purposes of a viewer, the most urgent first.
pub(crate) fn purposes_of_viewers() -> impl Iterator<Item = Purpose> {
    let of = |compositing| {
        [Frames::One, Frames::Several]
            .map(|frames| Purpose::new(frames, compositing, &CastOptions::default()))
    };
    [Compositing::Over, Compositing::Greatest, Compositing::Mean].into_iter().flat_map(of)
}
