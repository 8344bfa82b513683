//! Novel views cast into a texture before the user interface's pass, and copied or enlarged inside it. Kernels:
//! `shaders/raycast_view.wgsl`, `shaders/upscale.wgsl`.

use crate::device::{bind, layout, shader_module};
use crate::shaders::Kernel;
use crate::warm_up::{Draw, Pipeline};

/// The texture, and the pipelines that write and read it.
pub(crate) struct Upscale {
    enlarge: wgpu::RenderPipeline,
    layout: wgpu::BindGroupLayout,
    sampler: wgpu::Sampler,
    /// The screen's format: stored values are interpolated. On a software device that is three times as fast as
    /// mixing light, and nobody sees the difference in movement.
    format: wgpu::TextureFormat,
    target: Option<Target>,
}

struct Target {
    size: [u32; 2],
    view: wgpu::TextureView,
    bind_group: wgpu::BindGroup,
}

impl Upscale {
    /// `format` is that of the target.
    pub(crate) fn new(device: &wgpu::Device, format: wgpu::TextureFormat) -> Self {
        let texture = wgpu::BindingType::Texture {
            sample_type: wgpu::TextureSampleType::Float { filterable: true },
            view_dimension: wgpu::TextureViewDimension::D2,
            multisampled: false,
        };
        let sampling = wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering);
        let group_layout = layout(device, "upscale", wgpu::ShaderStages::FRAGMENT, &[texture, sampling]);
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("upscale"),
            bind_group_layouts: &[Some(&group_layout)],
            immediate_size: 0,
        });
        let module = shader_module(device, Kernel::Upscale);
        let enlarge = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("upscale"),
            layout: Some(&pipeline_layout),
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("upscale_vertex"),
                compilation_options: Default::default(),
                buffers: &[],
            },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: None,
            multisample: wgpu::MultisampleState::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("upscale_fragment"),
                compilation_options: Default::default(),
                targets: &[Some(format.into())],
            }),
            multiview_mask: None,
            cache: None,
        });
        Self {
            enlarge,
            layout: group_layout,
            sampler: device.create_sampler(&wgpu::SamplerDescriptor {
                label: Some("between pixels"),
                mag_filter: wgpu::FilterMode::Linear,
                min_filter: wgpu::FilterMode::Linear,
                ..Default::default()
            }),
            format,
            target: None,
        }
    }

    /// Casts into a texture of `size` with a pipeline for the screen's format.
    pub(crate) fn cast(
        &mut self,
        device: &wgpu::Device,
        encoder: &mut wgpu::CommandEncoder,
        size: [u32; 2],
        pipeline: &wgpu::RenderPipeline,
        groups: [&wgpu::BindGroup; 2],
        timestamps: Option<wgpu::RenderPassTimestampWrites<'_>>,
    ) {
        if self.target.as_ref().is_none_or(|t| t.size != size) {
            self.target = Some(self.target(device, size));
        }
        let Some(target) = &self.target else { return };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("picture apart"),
            timestamp_writes: timestamps,
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &target.view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                    store: wgpu::StoreOp::Store,
                },
            })],
            ..Default::default()
        });
        pass.set_pipeline(pipeline);
        for (i, group) in (0..).zip(groups) {
            pass.set_bind_group(i, group, &[]);
        }
        pass.draw(0..3, 0..1);
    }

    /// A first draw with the enlarging pipeline.
    pub(crate) fn warm_up(&self, device: &wgpu::Device) -> Draw {
        Draw {
            pipeline: Pipeline::Made(self.enlarge.clone()),
            groups: vec![self.target(device, [1, 1]).bind_group],
        }
    }

    /// Fills the viewport with the cast picture.
    pub(crate) fn paint(&self, pass: &mut wgpu::RenderPass<'_>) {
        let Some(target) = &self.target else { return };
        pass.set_pipeline(&self.enlarge);
        pass.set_bind_group(0, &target.bind_group, &[]);
        pass.draw(0..3, 0..1);
    }

    fn target(&self, device: &wgpu::Device, size: [u32; 2]) -> Target {
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("picture apart"),
            size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: self.format,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        });
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let resources =
            [wgpu::BindingResource::TextureView(&view), wgpu::BindingResource::Sampler(&self.sampler)];
        let bind_group = bind(device, "upscale", &self.layout, &resources);
        Target { size, view, bind_group }
    }
}
