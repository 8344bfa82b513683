//! Novel views drawn inside another render pass, such as that of a user interface: the ray caster as a fragment
//! shader. Kernels: `shaders/raycast.wgsl`, `shaders/raycast_view.wgsl`, `shaders/combine.wgsl`.
//!
//! Call [`ViewPass::new`] once per device, [`ViewPass::upload`] for each frame and [`ViewPass::show`] to select
//! frames. At each refresh call [`ViewPass::prepare`] before and [`ViewPass::paint`] inside the pass, whose viewport
//! places the picture. Until the first frame only the background is painted.
//!
//! For a stereo pair, call [`ViewPass::prepare_eyes`] before and [`ViewPass::paint_eye`] twice inside; the frame is
//! uploaded once.

use std::sync::Arc;

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::space::Aabb;

use crate::casts::{Casts, purposes_of_viewers};
use crate::combine::FramesOnGpu;
use crate::device::{CasterLayouts, EMPTY_SPACE, UNIFORM, bind, buffer, compute_pipeline, layout};
use crate::error::{GpuError, scoped};
use crate::gpu_types::{Basis, Display};
use crate::raycast::{GridBuilder, Lists};
use crate::shaders::{Kernel, Purpose};
use crate::upscale::Upscale;
use crate::warm_up::{Draw, Pipeline, WarmUp};

/// Pipeline, buffers and bind groups for one target format.
pub struct ViewPass {
    casts: Arc<Casts>,
    frames: FramesOnGpu,
    /// Uniforms of the left and the right eye; a single picture uses the left.
    eyes: [(wgpu::Buffer, wgpu::BindGroup); 2],
    display: wgpu::Buffer,
    /// Uniform of a picture that is cast into a texture.
    apart: (wgpu::Buffer, wgpu::BindGroup),
    upscale: Upscale,
    target: wgpu::TextureFormat,
}

/// One of two eyes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Eye {
    /// The left one.
    Left,
    /// The right one.
    Right,
}

/// The channels that an eye's picture is written to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channels {
    /// All channels.
    All,
    /// Red: the left eye of an anaglyph.
    Red,
    /// All but red: the right eye of an anaglyph.
    Cyan,
}

impl Channels {
    pub(crate) fn mask(self) -> wgpu::ColorWrites {
        match self {
            Self::All => wgpu::ColorWrites::ALL,
            Self::Red => wgpu::ColorWrites::RED,
            Self::Cyan => wgpu::ColorWrites::ALL - wgpu::ColorWrites::RED,
        }
    }
}

impl ViewPass {
    /// For passes with one colour target of format `target`, without depth and multisampling. The result is sRGB in
    /// any case: the shader encodes it unless the format does.
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
            let casts = Arc::new(Casts::new(device, target, &caster_layouts, &view_layout));
            // The first picture needs this pipeline, and a failure must show now.
            casts.get_or_make(Purpose::default(), Channels::All);
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
            Ok(Self { casts, frames, eyes, display, apart, upscale, target })
        })
    }

    /// Everything that draws the pictures of one eye, to be made ahead of need. Call it before preparing anything
    /// else, and run it at any time. Until it is dropped, pictures do not wait for missing pipelines: they show only
    /// the newest frame, or nothing.
    ///
    /// # Errors
    /// If the device has no room for it.
    pub fn warm_up(&self, device: &wgpu::Device, queue: &wgpu::Queue) -> Result<WarmUp, GpuError> {
        scoped(device, "preparing the first draws", || {
            // The single pixel shows nothing, but its ray is valid.
            let pixel = Intrinsics::perspective(1, 1, 1.0);
            let nowhere = Aabb { min: glam::Vec3::ZERO, max: glam::Vec3::ZERO };
            let camera = Camera::new(Pose::orbit(glam::Vec3::ONE, 0.0, 0.0, 1.0), pixel, &nowhere);
            self.prepare(queue, &camera, [0.0; 3]);
            let (_, view) = &self.eyes[0];
            let casts = purposes_of_viewers().filter_map(|purpose| {
                let group = self.frames.warm_up(device, purpose.frames)?;
                Some(Draw { pipeline: Pipeline::Cast(purpose), groups: vec![group, view.clone()] })
            });
            let mut draws: Vec<Draw> = casts.collect();
            draws.insert(1, self.upscale.warm_up(device));
            Ok(WarmUp { target: self.target, casts: self.casts.clone(), draws })
        })
    }

    /// Uploads `frame` to a slot below [`NUM_SLOTS`]; slot 0 is shown until [`ViewPass::show`] selects others.
    /// `bounds` is the box of its volume. Buffers are reused and grow as needed. A rejected frame leaves the former
    /// one.
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
        scoped(device, "uploading a layered frame", || {
            frames.upload(device, queue, slot, &Lists::Memory(frame), bounds)
        })
    }

    /// Selects the displayed slots: the newest frame first, then older ones of the same volume and look for what it
    /// lacks (see [`isinglass_core::kernels::combine`]). The newest alone costs no more than a single slot. An older
    /// frame that cannot be bound as well is left out.
    pub fn show(&mut self, device: &wgpu::Device, slots: &[usize]) -> Result<(), GpuError> {
        let frames = &mut self.frames;
        scoped(device, "binding layered frames", || {
            frames.show(device, slots);
            Ok(())
        })
    }

    /// Sets how frames are cast.
    pub fn set_options(&mut self, queue: &wgpu::Queue, options: &CastOptions) {
        self.frames.set_options(queue, options);
    }

    /// Sets the camera of the next [`ViewPass::paint`]; its aspect ratio should be that of the viewport. `background`
    /// is linear and opaque.
    pub fn prepare(&self, queue: &wgpu::Queue, camera: &Camera, background: [f32; 3]) {
        self.prepare_views(queue, &[camera.into()], background);
    }

    /// Sets the views of both eyes for the next two [`ViewPass::paint_eye`].
    pub fn prepare_eyes(&self, queue: &wgpu::Queue, views: &[View; 2], background: [f32; 3]) {
        self.prepare_views(queue, views, background);
    }

    /// Casts a picture of `camera`, in its own size, into a texture for [`ViewPass::paint_apart`]. `encoder` runs
    /// this before the pass, with these timestamps. `background` is linear and opaque.
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
        let display = Display { background, padding_0: 0 };
        queue.write_buffer(&self.display, 0, bytemuck::bytes_of(&display));
        let size = [camera.intrinsics.width, camera.intrinsics.height];
        self.frames.prepare(queue, &[camera.into()]);
        let Some((pipeline, group)) = self.cast(Channels::All) else { return };
        self.upscale.cast(device, encoder, size, &pipeline, [&group, &self.apart.1], timestamps);
    }

    /// Fills the viewport with that picture, any number of times. It is copied at equal size and enlarged if it is
    /// smaller.
    pub fn paint_apart(&self, pass: &mut wgpu::RenderPass<'_>) {
        self.upscale.paint(pass);
    }

    /// Whether the pipeline for the current pictures is ready. Until then, pictures may lack requested features.
    pub fn casts_as_asked(&self) -> bool {
        !self.casts.are_coming() || self.casts.get(self.frames.cast().0, Channels::All).is_some()
    }

    /// Whether the current pictures can be cast at all. Until then, nothing is painted.
    pub fn can_cast(&self) -> bool {
        let has = |purpose| self.casts.get(purpose, Channels::All).is_some();
        !self.casts.are_coming() || has(self.frames.cast().0) || has(self.frames.cast_newest().0)
    }

    /// The pipeline to cast with, and its group 0. `None` if it is not ready.
    fn cast(&self, channels: Channels) -> Option<(wgpu::RenderPipeline, wgpu::BindGroup)> {
        let wanted = self.frames.cast();
        let made = |(purpose, group): (Purpose, &wgpu::BindGroup)| {
            Some((self.casts.get(purpose, channels)?, group.clone()))
        };
        if let Some(found) = made(wanted) {
            return Some(found);
        }
        if channels == Channels::All && self.casts.are_coming() {
            return made(self.frames.cast_newest());
        }
        let (purpose, group) = wanted;
        Some((self.casts.get_or_make(purpose, channels), group.clone()))
    }

    fn prepare_views(&self, queue: &wgpu::Queue, views: &[View], background: [f32; 3]) {
        for ((buffer, _), view) in self.eyes.iter().zip(views) {
            queue.write_buffer(buffer, 0, bytemuck::bytes_of(&Basis::of(*view)));
        }
        self.frames.prepare(queue, views);
        let display = Display { background, padding_0: 0 };
        queue.write_buffer(&self.display, 0, bytemuck::bytes_of(&display));
    }

    /// Fills the viewport.
    pub fn paint(&self, pass: &mut wgpu::RenderPass<'_>) {
        self.paint_eye(pass, Eye::Left, Channels::All);
    }

    /// Fills these channels of the viewport with an eye's picture.
    pub fn paint_eye(&self, pass: &mut wgpu::RenderPass<'_>, eye: Eye, channels: Channels) {
        let (_, bind_group) = &self.eyes[eye as usize];
        let Some((pipeline, group)) = self.cast(channels) else { return };
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.set_bind_group(1, bind_group, &[]);
        pass.draw(0..3, 0..1);
    }
}

/// Number of slots: as many as the viewer keeps, and one more.
pub const NUM_SLOTS: usize = 8;
