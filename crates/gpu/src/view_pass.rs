//! Novel views drawn into somebody else's render pass, such as that of a user interface: the ray caster as a fragment
//! shader. Kernels: `shaders/raycast.wgsl`, `shaders/raycast_view.wgsl`.
//!
//! Order of calls: [`ViewPass::new`] once a device; [`ViewPass::upload`] whenever a frame comes; each refresh
//! [`ViewPass::prepare`] before, [`ViewPass::paint`] inside the pass. The viewport of the pass decides where the
//! picture goes. Until the first frame only the background is painted.

use isinglass_core::camera::Camera;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::space::Aabb;

use crate::device::{CASTER, UNIFORM, bind, buffer, layout, shader_module};
use crate::error::{GpuError, scoped};
use crate::gpu_types::{Basis, Display};
use crate::raycast::FrameOnGpu;
use crate::shaders::Kernel;

/// Pipeline, buffers and bind groups for one target format.
pub struct ViewPass {
    pipeline: wgpu::RenderPipeline,
    frame_layout: wgpu::BindGroupLayout,
    frame: FrameOnGpu,
    view: wgpu::Buffer,
    display: wgpu::Buffer,
    bind_group: wgpu::BindGroup,
    encode_srgb: bool,
}

impl ViewPass {
    /// For passes with one colour target of `target`, no depth and no multisampling. What is stored is sRGB in any case:
    /// encoded by the shader unless the format does it.
    pub fn new(device: &wgpu::Device, target: wgpu::TextureFormat) -> Result<Self, GpuError> {
        scoped(device, "making the view pass", || {
            let fragment = wgpu::ShaderStages::FRAGMENT;
            let frame_layout = layout(device, "frame", fragment, &CASTER);
            let view_layout =
                layout(device, "view", fragment | wgpu::ShaderStages::VERTEX, &[UNIFORM, UNIFORM]);
            let pipeline = pipeline(device, target, &frame_layout, &view_layout);
            let frame = FrameOnGpu::new(device, &frame_layout);
            let uniform =
                |label, bytes: usize| buffer(device, label, bytes as u64, wgpu::BufferUsages::UNIFORM);
            let view = uniform("view", size_of::<Basis>());
            let display = uniform("display", size_of::<Display>());
            let resources = [view.as_entire_binding(), display.as_entire_binding()];
            let bind_group = bind(device, "view", &view_layout, &resources);
            let encode_srgb = !target.is_srgb();
            Ok(Self { pipeline, frame_layout, frame, view, display, bind_group, encode_srgb })
        })
    }

    /// Shows `frame` from now on. `bounds` is the box of the volume that it was made of. Buffers are reused and grow
    /// when needed. A frame that is refused leaves the former one.
    pub fn upload(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        frame: &LayeredFrame,
        bounds: &Aabb,
    ) -> Result<(), GpuError> {
        let Self { frame: on_gpu, frame_layout, .. } = self;
        scoped(device, "uploading a layered frame", || {
            on_gpu.upload(device, queue, frame_layout, frame, bounds)
        })
    }

    /// Sets the camera of the next [`ViewPass::paint`]; its aspect ratio should be that of the viewport. `background`
    /// is linear and opaque.
    pub fn prepare(&self, queue: &wgpu::Queue, camera: &Camera, background: [f32; 3]) {
        queue.write_buffer(&self.view, 0, bytemuck::bytes_of(&Basis::of(camera)));
        let display = Display { background, encode_srgb: self.encode_srgb.into() };
        queue.write_buffer(&self.display, 0, bytemuck::bytes_of(&display));
    }

    /// Fills the viewport.
    pub fn paint(&self, pass: &mut wgpu::RenderPass<'_>) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.frame.bind_group, &[]);
        pass.set_bind_group(1, &self.bind_group, &[]);
        pass.draw(0..3, 0..1);
    }
}

fn pipeline(
    device: &wgpu::Device,
    target: wgpu::TextureFormat,
    frame_layout: &wgpu::BindGroupLayout,
    view_layout: &wgpu::BindGroupLayout,
) -> wgpu::RenderPipeline {
    let module = shader_module(device, Kernel::RaycastView);
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("view"),
        bind_group_layouts: &[Some(frame_layout), Some(view_layout)],
        immediate_size: 0,
    });
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("view"),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module: &module,
            entry_point: Some("view_vertex"),
            compilation_options: Default::default(),
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: None,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &module,
            entry_point: Some("view_fragment"),
            compilation_options: Default::default(),
            targets: &[Some(target.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}
