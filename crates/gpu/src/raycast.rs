//! A layered frame on the GPU, and novel views as pictures. Kernels: `shaders/raycast.wgsl`, `shaders/one_frame.wgsl`,
//! `shaders/raycast_compute.wgsl`.

use isinglass_core::camera::Camera;
use isinglass_core::kernels::combine::MAX_FRAMES;
use isinglass_core::kernels::empty_space::TILE;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::Compositing;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;

use crate::blocks::{BlockDecoder, DeviceFrame, ListPlanes};
use crate::combine::FramesOnGpu;
use crate::device::{Gpu, bind, buffer, check_binding};
use crate::error::{GpuError, scoped};
use crate::gpu_types::{GROUP_HEIGHT, Raycaster};
use crate::picture_target::PictureTarget;
use crate::shaders::Kernel;

/// Prepares a frame for casting. Kernel: `shaders/empty_space_build.wgsl`.
#[derive(Clone)]
pub(crate) struct GridBuilder {
    pub(crate) pipeline: wgpu::ComputePipeline,
    pub(crate) layout: wgpu::BindGroupLayout,
}

/// A frame's planes and grid: buffers that grow when a larger frame comes and are reused otherwise.
pub(crate) struct FrameOnGpu {
    builder: GridBuilder,
    caster: wgpu::Buffer,
    /// The contents of `caster`.
    uniform: Raycaster,
    options: CastOptions,
    /// The camera of the frame and the box of its volume.
    seen_by: Option<(Camera, Aabb)>,
    compositing: Compositing,
    buffers: Buffers,
    /// Group 0 of `one_frame.wgsl` for these buffers.
    pub(crate) bind_group: wgpu::BindGroup,
    build_group: wgpu::BindGroup,
}

/// Where the lists of a frame are.
pub(crate) enum Lists<'a> {
    Memory(&'a LayeredFrame),
    /// On the device, in blocks.
    Device(&'a BlockDecoder, &'a DeviceFrame),
}

impl Lists<'_> {
    fn header(&self) -> &FrameHeader {
        match self {
            Self::Memory(frame) => &frame.header,
            Self::Device(_, frame) => frame.header(),
        }
    }

    fn most_segments(&self) -> u64 {
        match self {
            Self::Memory(frame) => frame.depth.len() as u64,
            Self::Device(_, frame) => frame.room().cells.into(),
        }
    }
}

/// The planes that memory has of a frame.
fn written(frame: &LayeredFrame) -> [(usize, &[u32]); 4] {
    let LayeredFrame { offsets, depth, c_rg, c_b_tau, .. } = frame;
    [(OFFSETS, offsets), (DEPTH, depth), (C_RG, c_rg), (C_B_TAU, c_b_tau)]
}

/// Two buffers hold six planes. So a kernel of four frames binds eight, and no kernel writes a grid to a buffer that
/// it reads.
struct Buffers {
    /// First offsets and depth; then occupied cells, colours and summaries of the lists.
    buffers: [wgpu::Buffer; 2],
    planes: [Plane; NUM_PLANES],
}

/// A part of a buffer, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Plane {
    buffer: usize,
    start: u64,
    size: u64,
}

impl FrameOnGpu {
    /// Buffers without a frame, which show nothing.
    pub(crate) fn new(device: &wgpu::Device, layout: &wgpu::BindGroupLayout, builder: GridBuilder) -> Self {
        let caster = buffer(device, "caster", size_of::<Raycaster>() as u64, wgpu::BufferUsages::UNIFORM);
        let buffers = Buffers::new(device, planes([SUMMARY_BYTES; NUM_PLANES], alignment(device)));
        let (bind_group, build_group) = buffers.bind(device, layout, &builder, &caster);
        let uniform = bytemuck::Zeroable::zeroed();
        let options = CastOptions::default();
        let compositing = Compositing::Over;
        Self {
            builder,
            caster,
            uniform,
            options,
            seen_by: None,
            compositing,
            buffers,
            bind_group,
            build_group,
        }
    }

    /// Replaces the frame. `bounds` is the box of its volume. A rejected frame leaves the former one.
    pub(crate) fn upload(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        layout: &wgpu::BindGroupLayout,
        lists: &Lists<'_>,
        bounds: &Aabb,
    ) -> Result<(), GpuError> {
        if let Lists::Memory(frame) = lists {
            check_indices(frame)?;
        }
        let FrameHeader { camera, mode, .. } = *lists.header();
        let tiles = [camera.intrinsics.width.div_ceil(TILE), camera.intrinsics.height.div_ceil(TILE)];
        self.fit(device, layout, lists, u64::from(tiles[0]) * u64::from(tiles[1]))?;
        self.compositing = mode.compositing();
        self.uniform = Raycaster::of(&camera, bounds, self.compositing, &self.options);
        let is_written = scoped(device, "writing a layered frame", || {
            if let Lists::Memory(frame) = lists {
                for (plane, words) in written(frame) {
                    let Plane { buffer, start, .. } = self.buffers.planes[plane];
                    queue.write_buffer(&self.buffers.buffers[buffer], start, bytemuck::cast_slice(words));
                }
            }
            self.write_uniform(queue);
            let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                if let Lists::Device(decoder, frame) = lists {
                    let [offsets, depth, c_rg, c_b_tau] =
                        [OFFSETS, DEPTH, C_RG, C_B_TAU].map(|plane| self.buffers.plane(plane));
                    decoder.write_lists(&mut pass, frame, &ListPlanes { offsets, depth, c_rg, c_b_tau });
                }
                pass.set_pipeline(&self.builder.pipeline);
                pass.set_bind_group(0, &self.build_group, &[]);
                pass.dispatch_workgroups(tiles[0], tiles[1], 1);
            }
            queue.submit([encoder.finish()]);
            Ok(())
        });
        self.seen_by = Some((camera, *bounds));
        if is_written.is_err() {
            // If the upload fails half-way, nothing is shown.
            self.seen_by = None;
            self.uniform = bytemuck::Zeroable::zeroed();
            self.compositing = Compositing::Over;
            self.write_uniform(queue);
        }
        is_written
    }

    /// Makes room for a frame with so many tiles.
    fn fit(
        &mut self,
        device: &wgpu::Device,
        layout: &wgpu::BindGroupLayout,
        lists: &Lists<'_>,
        num_tiles: u64,
    ) -> Result<(), GpuError> {
        let num_lists = lists.header().camera.intrinsics.num_pixels() as u64;
        let mut bytes = [lists.most_segments() * 4; NUM_PLANES];
        bytes[OFFSETS] = (num_lists + 1) * 4;
        bytes[OCCUPIED] = num_tiles * 4;
        bytes[SUMMARIES] = num_lists * SUMMARY_BYTES;
        for bytes in bytes {
            check_binding(device, "plane of a layered frame in bytes", bytes)?;
        }
        if bytes.iter().zip(&self.buffers.planes).any(|(&needed, plane)| plane.size < needed) {
            let planes = roomy_planes(device, bytes)?;
            (self.buffers, (self.bind_group, self.build_group)) = scoped(device, "growing buffers", || {
                let buffers = Buffers::new(device, planes);
                let groups = buffers.bind(device, layout, &self.builder, &self.caster);
                Ok((buffers, groups))
            })?;
        }
        Ok(())
    }

    pub(crate) fn set_options(&mut self, queue: &wgpu::Queue, options: &CastOptions) {
        if self.options == *options {
            return;
        }
        self.options = *options;
        if let Some((camera, bounds)) = &self.seen_by {
            self.uniform = Raycaster::of(camera, bounds, self.compositing, options);
            self.write_uniform(queue);
        }
    }

    fn write_uniform(&self, queue: &wgpu::Queue) {
        queue.write_buffer(&self.caster, 0, bytemuck::bytes_of(&self.uniform));
    }

    /// The camera of the frame and the box of its volume; `None` without a frame.
    pub(crate) fn seen_by(&self) -> Option<(&Camera, &Aabb)> {
        self.seen_by.as_ref().map(|(camera, bounds)| (camera, bounds))
    }

    /// How its segments become one colour.
    pub(crate) fn compositing(&self) -> Compositing {
        self.compositing
    }

    pub(crate) fn uniform(&self) -> Raycaster {
        self.uniform
    }

    /// `places` of `shaders/combine.wgsl`.
    pub(crate) fn places(&self) -> [u32; 4] {
        let word = |plane: usize| (self.buffers.planes[plane].start / 4) as u32;
        [word(DEPTH), word(C_RG), word(C_B_TAU), word(SUMMARIES)]
    }

    /// Both buffers for `shaders/combine.wgsl`; `None` if the device cannot bind them.
    pub(crate) fn whole_buffers(&self, device: &wgpu::Device) -> Option<[wgpu::BindingResource<'_>; 2]> {
        let limit = device.limits().max_storage_buffer_binding_size;
        let end = |plane: usize| self.buffers.planes[plane].start + self.buffers.planes[plane].size;
        let [lists, matter] = &self.buffers.buffers;
        let is_bindable = end(DEPTH) <= limit && end(SUMMARIES) <= limit;
        is_bindable.then(|| {
            [(lists, DEPTH), (matter, SUMMARIES)].map(|(buffer, last)| binding(buffer, 0, end(last)))
        })
    }
}

impl Buffers {
    fn new(device: &wgpu::Device, planes: [Plane; NUM_PLANES]) -> Self {
        let buffers = std::array::from_fn(|n| {
            buffer(device, LABELS[n], num_bytes(&planes, n), wgpu::BufferUsages::STORAGE)
        });
        Self { buffers, planes }
    }

    fn plane(&self, plane: usize) -> wgpu::BindingResource<'_> {
        let Plane { buffer, start, size } = self.planes[plane];
        binding(&self.buffers[buffer], start, size)
    }

    /// The groups for casting and for building the grid.
    fn bind(
        &self,
        device: &wgpu::Device,
        layout: &wgpu::BindGroupLayout,
        builder: &GridBuilder,
        caster: &wgpu::Buffer,
    ) -> (wgpu::BindGroup, wgpu::BindGroup) {
        let plane = |plane| self.plane(plane);
        let caster = || caster.as_entire_binding();
        let [offsets, depth] = [plane(OFFSETS), plane(DEPTH)];
        let [occupied, rg, b_tau, summaries] = [OCCUPIED, C_RG, C_B_TAU, SUMMARIES].map(plane);
        let build = [
            caster(),
            offsets,
            depth.clone(),
            occupied.clone(),
            summaries.clone(),
            rg.clone(),
            b_tau.clone(),
        ];
        let cast = [caster(), summaries, depth, rg, b_tau, occupied];
        (bind(device, "frame", layout, &cast), bind(device, "grid", &builder.layout, &build))
    }
}

fn binding(buffer: &wgpu::Buffer, offset: u64, size: u64) -> wgpu::BindingResource<'_> {
    wgpu::BindingResource::Buffer(wgpu::BufferBinding { buffer, offset, size: wgpu::BufferSize::new(size) })
}

fn alignment(device: &wgpu::Device) -> u64 {
    device.limits().min_storage_buffer_offset_alignment.into()
}

/// Planes of at least these sizes, and a quarter more if the device allows it. Frames of a moving camera vary, and
/// each growth needs new bind groups.
fn roomy_planes(device: &wgpu::Device, bytes: [u64; NUM_PLANES]) -> Result<[Plane; NUM_PLANES], GpuError> {
    let limits = device.limits();
    let (max_binding, max_buffer) = (limits.max_storage_buffer_binding_size, limits.max_buffer_size);
    let largest = |planes| num_bytes(planes, 0).max(num_bytes(planes, 1));
    let roomy = planes(bytes.map(|n| (n + n / 4).min(max_binding)), alignment(device));
    if largest(&roomy) <= max_binding.min(max_buffer) {
        return Ok(roomy);
    }
    let tight = planes(bytes, alignment(device));
    let needed = largest(&tight);
    let what = "half of a layered frame in bytes";
    if needed > max_buffer { Err(GpuError::TooLarge { what, needed, limit: max_buffer }) } else { Ok(tight) }
}

/// Planes of these sizes, one after the other.
fn planes(bytes: [u64; NUM_PLANES], alignment: u64) -> [Plane; NUM_PLANES] {
    let mut ends = [0u64; 2];
    std::array::from_fn(|plane| {
        let buffer = usize::from(plane >= OCCUPIED);
        let (start, size) =
            (ends[buffer].next_multiple_of(alignment), bytes[plane].max(4).next_multiple_of(4));
        ends[buffer] = start + size;
        Plane { buffer, start, size }
    })
}

fn num_bytes(planes: &[Plane; NUM_PLANES], buffer: usize) -> u64 {
    planes.iter().filter(|p| p.buffer == buffer).map(|p| p.start + p.size).max().unwrap_or(0)
}

/// Layered frames kept on the GPU for any number of novel views.
pub struct GpuReprojector {
    gpu: Gpu,
    frames: FramesOnGpu,
    picture: PictureTarget,
}

impl GpuReprojector {
    /// Uploads a frame. `bounds` is the box of its volume.
    pub fn new(gpu: &Gpu, frame: &LayeredFrame, bounds: &Aabb) -> Result<Self, GpuError> {
        Self::of_frames(gpu, &[frame], bounds)
    }

    /// Uploads several frames: see [`Self::set_frames`].
    pub fn of_frames(gpu: &Gpu, frames: &[&LayeredFrame], bounds: &Aabb) -> Result<Self, GpuError> {
        let mut reprojector = gpu.attempt("making buffers", || {
            let builder = GridBuilder {
                pipeline: gpu.pipeline(Kernel::EmptySpace, "empty_space"),
                layout: gpu.layouts().empty_space.clone(),
            };
            let on_gpu = FramesOnGpu::new(gpu.device(), &gpu.layouts().caster, builder);
            Ok(Self {
                gpu: gpu.clone(),
                frames: on_gpu,
                picture: PictureTarget::of_groups(gpu, GROUP_HEIGHT),
            })
        })?;
        reprojector.set_frames(frames, bounds)?;
        Ok(reprojector)
    }

    /// Replaces the frame, reusing the buffers.
    pub fn set_frame(&mut self, frame: &LayeredFrame, bounds: &Aabb) -> Result<(), GpuError> {
        self.set_frames(&[frame], bounds)
    }

    /// Replaces the frame with one that the device has decoded.
    pub fn set_blocks(
        &mut self,
        decoder: &BlockDecoder,
        frame: &DeviceFrame,
        bounds: &Aabb,
    ) -> Result<(), GpuError> {
        let Self { gpu, frames, .. } = self;
        gpu.attempt("writing the lists of a frame", || {
            frames.upload(gpu.device(), gpu.queue(), 0, &Lists::Device(decoder, frame), bounds)?;
            frames.show(gpu.device(), &[0]);
            Ok(())
        })
    }

    /// Replaces the frames with several of one volume and look, the newest first: see
    /// [`isinglass_core::kernels::combine`]. If one is rejected, only those before it are cast.
    pub fn set_frames(&mut self, frames: &[&LayeredFrame], bounds: &Aabb) -> Result<(), GpuError> {
        let Self { gpu, frames: on_gpu, .. } = self;
        if frames.len() > 1 {
            gpu.check_combining()?;
        }
        let slots: [usize; MAX_FRAMES] = std::array::from_fn(|slot| slot);
        gpu.attempt("uploading layered frames", || {
            for (slot, frame) in slots.into_iter().zip(frames) {
                on_gpu.upload(gpu.device(), gpu.queue(), slot, &Lists::Memory(frame), bounds)?;
                on_gpu.show(gpu.device(), &slots[..=slot]);
            }
            Ok(())
        })
    }

    /// See [`isinglass_core::kernels::raycast::raycast`].
    pub fn raycast(&mut self, camera: &Camera) -> Result<Picture, GpuError> {
        self.raycast_with(camera, &CastOptions::default())
    }

    /// See [`isinglass_core::kernels::raycast::Raycaster::picture`].
    pub fn raycast_with(&mut self, camera: &Camera, options: &CastOptions) -> Result<Picture, GpuError> {
        if !camera.is_valid() {
            return Err(GpuError::Camera);
        }
        self.raycast_view(&camera.into(), options)
    }

    /// The same for a view that may be off-axis.
    pub fn raycast_view(&mut self, view: &View, options: &CastOptions) -> Result<Picture, GpuError> {
        let Self { gpu, frames, picture } = self;
        gpu.attempt("casting a novel view", || {
            frames.set_options(gpu.queue(), options);
            frames.prepare(gpu.queue(), &[*view]);
            let (purpose, group) = frames.cast();
            let pipeline = gpu.pipeline(Kernel::RaycastCompute(purpose), "raycast");
            picture.draw(gpu, &pipeline, group, view, MAX_CROSSINGS)
        })
    }
}

/// March steps that take as long as the longest path through the lists of a large frame.
const MAX_CROSSINGS: u32 = 1 << 12;

/// Checks what keeps the kernel inside the planes and makes it end.
fn check_indices(frame: &LayeredFrame) -> Result<(), GpuError> {
    let camera = &frame.header.camera;
    if !camera.is_valid() {
        return Err(GpuError::Camera);
    }
    let (lists, segments) = (camera.intrinsics.num_pixels(), frame.depth.len());
    if frame.offsets.len() != lists + 1 {
        return Err(GpuError::Frame(format!("{} offsets for {lists} lists", frame.offsets.len())));
    }
    if !frame.offsets.is_sorted() || frame.offsets[lists] as usize != segments {
        return Err(GpuError::Frame(format!("offsets are not ascending to the {segments} segments")));
    }
    if frame.c_rg.len() != segments || frame.c_b_tau.len() != segments {
        return Err(GpuError::Frame("planes differ in length".into()));
    }
    Ok(())
}

const LABELS: [&str; 2] = ["lists", "matter"];
const NUM_PLANES: usize = 6;
const OFFSETS: usize = 0;
const DEPTH: usize = 1;
const OCCUPIED: usize = 2;
const C_RG: usize = 3;
const C_B_TAU: usize = 4;
const SUMMARIES: usize = 5;
/// Bytes of a list's summary, four words (`shaders/empty_space_build.wgsl`).
const SUMMARY_BYTES: u64 = 16;
