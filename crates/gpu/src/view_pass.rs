//! Novel views drawn into somebody else's render pass, such as that of a user interface: the ray caster as a fragment
//! shader. Kernels: `shaders/raycast.wgsl`, `shaders/raycast_view.wgsl`, `shaders/combine.wgsl`.
//!
//! Order of calls: [`ViewPass::new`] once a device; [`ViewPass::upload`] whenever a frame comes; [`ViewPass::show`]
//! whenever a picture is to be made of other frames; each refresh [`ViewPass::prepare`] before, [`ViewPass::paint`]
//! inside the pass. The viewport of the pass decides where the picture goes. Until the first frame only the background
//! is painted.
//!
//! For a stereo pair: [`ViewPass::prepare_eyes`] before, [`ViewPass::paint_eye`] twice inside; the frame is uploaded
//! once.

use std::sync::OnceLock;

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::space::Aabb;

use crate::combine::FramesOnGpu;
use crate::device::{
    CasterLayouts, EMPTY_SPACE, UNIFORM, bind, buffer, compute_pipeline, layout, shader_module,
};
use crate::error::{GpuError, scoped};
use crate::gpu_types::{Basis, Display};
use crate::raycast::GridBuilder;
use crate::shaders::{Frames, Kernel};
use crate::upscale::Upscale;
use crate::warm_up::{Draw, WarmUp};

/// Pipeline, buffers and bind groups for one target format.
pub struct ViewPass {
    device: wgpu::Device,
    /// Of one frame and of several.
    casts: [Cast; 2],
    frames: FramesOnGpu,
    /// Of the left and of the right eye; a picture of one eye is the left one's.
    eyes: [(wgpu::Buffer, wgpu::BindGroup); 2],
    display: wgpu::Buffer,
    /// View and group of the picture that is cast apart.
    apart: (wgpu::Buffer, wgpu::BindGroup),
    upscale: Upscale,
    encode_srgb: bool,
    target: wgpu::TextureFormat,
}

/// The ray caster of one frame or of several.
struct Cast {
    layout: wgpu::PipelineLayout,
    module: wgpu::ShaderModule,
    /// By [`Channels`]. Most drivers compile a kernel once more for each, so those that few look through are made when they
    /// are needed.
    pipelines: [OnceLock<wgpu::RenderPipeline>; 3],
}

impl Cast {
    fn pipeline(
        &self,
        device: &wgpu::Device,
        target: wgpu::TextureFormat,
        channels: Channels,
    ) -> &wgpu::RenderPipeline {
        let make = || pipeline(device, target, &self.module, &self.layout, channels);
        self.pipelines[channels as usize].get_or_init(make)
    }
}

/// One of two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Eye {
    /// The left one.
    Left,
    /// The right one.
    Right,
}

/// Which channels of the target an eye's picture goes to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channels {
    /// All.
    All,
    /// Red: the left eye of an anaglyph.
    Red,
    /// All but red: the right eye of an anaglyph.
    Cyan,
}

impl Channels {
    fn mask(self) -> wgpu::ColorWrites {
        match self {
            Self::All => wgpu::ColorWrites::ALL,
            Self::Red => wgpu::ColorWrites::RED,
            Self::Cyan => wgpu::ColorWrites::ALL - wgpu::ColorWrites::RED,
        }
    }
}

impl ViewPass {
    /// For passes with one colour target of `target`, no depth and no multisampling. What is stored is sRGB in any case:
    /// encoded by the shader unless the format does it.
    pub fn new(device: &wgpu::Device, target: wgpu::TextureFormat) -> Result<Self, GpuError> {
        scoped(device, "making the view pass", || {
            let fragment = wgpu::ShaderStages::FRAGMENT;
            let view_layout =
                layout(device, "view", fragment | wgpu::ShaderStages::VERTEX, &[UNIFORM, UNIFORM]);
            let grid_layout = layout(device, "empty space", wgpu::ShaderStages::COMPUTE, &EMPTY_SPACE);
            let grid_pipeline =
                compute_pipeline(device, Kernel::EmptySpace, "empty_space", &[Some(&grid_layout)]);
            let builder = GridBuilder { pipeline: grid_pipeline, layout: grid_layout };
            let caster_layouts = CasterLayouts::new(device, fragment);
            let casts = [Frames::One, Frames::Several].map(|frames| {
                let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                    label: Some("view"),
                    bind_group_layouts: &[Some(caster_layouts.of(frames)), Some(&view_layout)],
                    immediate_size: 0,
                });
                let module = shader_module(device, Kernel::RaycastView(frames));
                let cast = Cast { layout, module, pipelines: Default::default() };
                cast.pipeline(device, target, Channels::All);
                cast
            });
            let upscale = Upscale::new(device, target);
            let frames = FramesOnGpu::new(device, &caster_layouts, builder);
            let uniform =
                |label, bytes: usize| buffer(device, label, bytes as u64, wgpu::BufferUsages::UNIFORM);
            let display = uniform("display", size_of::<Display>());
            let eyes = ["left view", "right view"].map(|label| {
                let view = uniform(label, size_of::<Basis>());
                let resources = [view.as_entire_binding(), display.as_entire_binding()];
                let bind_group = bind(device, label, &view_layout, &resources);
                (view, bind_group)
            });
            let apart = uniform("view apart", size_of::<Basis>());
            let resources = [apart.as_entire_binding(), display.as_entire_binding()];
            let apart_group = bind(device, "view apart", &view_layout, &resources);
            let apart = (apart, apart_group);
            let encode_srgb = !target.is_srgb();
            let device = device.clone();
            Ok(Self { device, casts, frames, eyes, display, apart, upscale, encode_srgb, target })
        })
    }

    /// What the pictures of one eye are drawn with, for a first draw ahead of the first frame. Call it before anything else
    /// is prepared; it can be run at any time.
    ///
    /// # Errors
    /// If the device has no room for it.
    pub fn warm_up(&self, device: &wgpu::Device, queue: &wgpu::Queue) -> Result<WarmUp, GpuError> {
        scoped(device, "preparing the first draws", || {
            // Nothing is in the one pixel, but its ray is one.
            let pixel = Intrinsics::perspective(1, 1, 1.0);
            let nowhere = Aabb { min: glam::Vec3::ZERO, max: glam::Vec3::ZERO };
            let camera = Camera::new(Pose::orbit(glam::Vec3::ONE, 0.0, 0.0, 1.0), pixel, &nowhere);
            self.prepare(queue, &camera, [0.0; 3]);
            let (_, view) = &self.eyes[0];
            let casts = [Frames::One, Frames::Several].into_iter().filter_map(|frames| {
                let pipeline = self.pipeline(frames, Channels::All).clone();
                let group = self.frames.warm_up(device, frames)?;
                Some(Draw { pipeline, groups: vec![group, view.clone()] })
            });
            let mut draws: Vec<Draw> = casts.collect();
            draws.insert(1, self.upscale.warm_up(device));
            Ok(WarmUp { target: self.target, draws })
        })
    }

    /// Puts `frame` into a slot below [`NUM_SLOTS`]; slot 0 is shown until [`ViewPass::show`] says otherwise. `bounds` is
    /// the box of the volume that the frame was made of. Buffers are reused and grow when needed. A frame that is refused
    /// leaves the former one.
    pub fn upload(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        slot: usize,
        frame: &LayeredFrame,
        bounds: &Aabb,
    ) -> Result<(), GpuError> {
        let frames = &mut self.frames;
        let slot = slot.min(NUM_SLOTS - 1);
        scoped(device, "uploading a layered frame", || frames.upload(device, queue, slot, frame, bounds))
    }

    /// Shows the frames of these slots from now on: the newest, and older ones of the same volume and look for what it does
    /// not see (see [`isinglass_core::kernels::combine`]). With the newest alone a picture costs no more than if there were
    /// no slots. An older frame too large to be bound along with the newest is left out, and all of them are as long as
    /// rays are sampled.
    pub fn show(&mut self, device: &wgpu::Device, slots: &[usize]) -> Result<(), GpuError> {
        let frames = &mut self.frames;
        scoped(device, "binding layered frames", || {
            frames.show(device, slots);
            Ok(())
        })
    }

    /// How frames are cast from now on.
    pub fn set_options(&mut self, queue: &wgpu::Queue, options: &CastOptions) {
        self.frames.set_options(queue, options);
    }

    /// Sets the camera of the next [`ViewPass::paint`]; its aspect ratio should be that of the viewport. `background`
    /// is linear and opaque.
    pub fn prepare(&self, queue: &wgpu::Queue, camera: &Camera, background: [f32; 3]) {
        self.prepare_views(queue, &[camera.into()], background);
    }

    /// Sets the views of the left and of the right eye for the next two [`ViewPass::paint_eye`].
    pub fn prepare_eyes(&self, queue: &wgpu::Queue, views: &[View; 2], background: [f32; 3]) {
        self.prepare_views(queue, views, background);
    }

    /// Casts a picture of `camera`, whose own size it has, into a texture for [`ViewPass::paint_apart`]: by `encoder`, before
    /// the pass, in one with these timestamps. `background` is linear and opaque.
    pub fn prepare_apart(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        encoder: &mut wgpu::CommandEncoder,
        camera: &Camera,
        background: [f32; 3],
        timestamps: Option<wgpu::RenderPassTimestampWrites<'_>>,
    ) {
        queue.write_buffer(&self.apart.0, 0, bytemuck::bytes_of(&Basis::of(camera)));
        let display = Display { background, encode_srgb: self.encode_srgb.into() };
        queue.write_buffer(&self.display, 0, bytemuck::bytes_of(&display));
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        self.frames.prepare(queue, &[camera.into()]);
        let (frames, group) = self.frames.cast();
        let pipeline = self.casts[frames as usize].pipeline(device, self.target, Channels::All);
        self.upscale.cast(device, encoder, size, pipeline, [group, &self.apart.1], timestamps);
    }

    /// Fills the viewport with that picture, however often: copied if it has as many pixels, enlarged if it is smaller.
    pub fn paint_apart(&self, pass: &mut wgpu::RenderPass<'_>) {
        self.upscale.paint(pass);
    }

    fn pipeline(&self, frames: Frames, channels: Channels) -> &wgpu::RenderPipeline {
        self.casts[frames as usize].pipeline(&self.device, self.target, channels)
    }

    fn prepare_views(&self, queue: &wgpu::Queue, views: &[View], background: [f32; 3]) {
        for ((buffer, _), view) in self.eyes.iter().zip(views) {
            queue.write_buffer(buffer, 0, bytemuck::bytes_of(&Basis::of(*view)));
        }
        self.frames.prepare(queue, views);
        let display = Display { background, encode_srgb: self.encode_srgb.into() };
        queue.write_buffer(&self.display, 0, bytemuck::bytes_of(&display));
    }

    /// Fills the viewport.
    pub fn paint(&self, pass: &mut wgpu::RenderPass<'_>) {
        self.paint_eye(pass, Eye::Left, Channels::All);
    }

    /// Fills the given channels of the viewport with what an eye sees.
    pub fn paint_eye(&self, pass: &mut wgpu::RenderPass<'_>, eye: Eye, channels: Channels) {
        let (_, bind_group) = &self.eyes[eye as usize];
        let (frames, group) = self.frames.cast();
        pass.set_pipeline(self.pipeline(frames, channels));
        pass.set_bind_group(0, group, &[]);
        pass.set_bind_group(1, bind_group, &[]);
        pass.draw(0..3, 0..1);
    }
}

fn pipeline(
    device: &wgpu::Device,
    target: wgpu::TextureFormat,
    module: &wgpu::ShaderModule,
    layout: &wgpu::PipelineLayout,
    channels: Channels,
) -> wgpu::RenderPipeline {
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("view"),
        layout: Some(layout),
        vertex: wgpu::VertexState {
            module,
            entry_point: Some("view_vertex"),
            compilation_options: Default::default(),
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: None,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module,
            entry_point: Some("view_fragment"),
            compilation_options: Default::default(),
            targets: &[Some(wgpu::ColorTargetState { write_mask: channels.mask(), ..target.into() })],
        }),
        multiview_mask: None,
        cache: None,
    })
}

/// Frames that can be held at a time: as many as the viewer keeps, and one that is not kept.
pub const NUM_SLOTS: usize = 8;
