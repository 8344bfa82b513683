//! A layered frame on the GPU, and its novel views as pictures. Kernels: `shaders/raycast.wgsl`,
//! `shaders/raycast_compute.wgsl`.

use isinglass_core::camera::Camera;
use isinglass_core::kernels::empty_space::{DEPTH_CELLS, TILE};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;

use crate::device::{Gpu, bind, buffer, check_binding};
use crate::error::{GpuError, scoped};
use crate::gpu_types::Raycaster;
use crate::picture_target::PictureTarget;
use crate::shaders::Kernel;

/// Counts the segments of coarse cells. Kernel: `shaders/empty_space_build.wgsl`.
#[derive(Clone)]
pub(crate) struct GridBuilder {
    pub(crate) pipeline: wgpu::ComputePipeline,
    pub(crate) layout: wgpu::BindGroupLayout,
}

/// Group 0 of `raycast.wgsl`: buffers that grow when a larger frame comes and are reused otherwise.
pub(crate) struct FrameOnGpu {
    builder: GridBuilder,
    caster: wgpu::Buffer,
    /// What `caster` holds.
    uniform: Raycaster,
    buffers: Buffers,
    /// Made for exactly these buffers.
    pub(crate) bind_group: wgpu::BindGroup,
    build_group: wgpu::BindGroup,
}

struct Buffers {
    /// Offsets, depth, c_rg, c_b_tau.
    planes: [wgpu::Buffer; 4],
    /// Occupied cells and counts.
    grid: [wgpu::Buffer; 2],
}

impl FrameOnGpu {
    /// Buffers without a frame: nothing is seen.
    pub(crate) fn new(device: &wgpu::Device, layout: &wgpu::BindGroupLayout, builder: GridBuilder) -> Self {
        let caster = buffer(device, "caster", size_of::<Raycaster>() as u64, wgpu::BufferUsages::UNIFORM);
        let buffers = Buffers::new(device, [8; 6]);
        let (bind_group, build_group) = buffers.bind(device, layout, &builder, &caster);
        Self { builder, caster, uniform: bytemuck::Zeroable::zeroed(), buffers, bind_group, build_group }
    }

    /// Replaces the frame. `bounds` is the box of the volume that it was made of. A frame that is refused leaves the
    /// former one.
    pub(crate) fn upload(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        layout: &wgpu::BindGroupLayout,
        frame: &LayeredFrame,
        bounds: &Aabb,
    ) -> Result<(), GpuError> {
        check_indices(frame)?;
        let size = frame.header.camera.intrinsics;
        let tiles = [size.width.div_ceil(TILE), size.height.div_ceil(TILE)];
        let num_tiles = u64::from(tiles[0]) * u64::from(tiles[1]);
        let planes = [&frame.offsets, &frame.depth, &frame.c_rg, &frame.c_b_tau];
        let [a, b, c, d] = planes.map(|plane| plane.len() as u64 * 4);
        let bytes = [a, b, c, d, num_tiles * 4, num_tiles * u64::from(DEPTH_CELLS) * 4];
        for bytes in bytes {
            check_binding(device, "plane of a layered frame in bytes", bytes)?;
        }
        // A quarter more than needed: frames of a moving camera vary, and every growth makes a new bind group.
        let limit = device.limits().max_storage_buffer_binding_size;
        if bytes.iter().zip(self.buffers.all()).any(|(&needed, buffer)| buffer.size() < needed) {
            (self.buffers, (self.bind_group, self.build_group)) = scoped(device, "growing buffers", || {
                let buffers = Buffers::new(device, bytes.map(|bytes| (bytes + bytes / 4).min(limit)));
                let groups = buffers.bind(device, layout, &self.builder, &self.caster);
                Ok((buffers, groups))
            })?;
        }
        let former = self.uniform;
        self.uniform = Raycaster::of(&frame.header.camera, bounds);
        self.uniform.set_options(&former.options());
        let written = scoped(device, "writing a layered frame", || {
            for (buffer, plane) in self.buffers.planes.iter().zip(planes) {
                queue.write_buffer(buffer, 0, bytemuck::cast_slice(plane));
            }
            self.write_uniform(queue);
            let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                pass.set_pipeline(&self.builder.pipeline);
                pass.set_bind_group(0, &self.build_group, &[]);
                pass.dispatch_workgroups(tiles[0], tiles[1], 1);
            }
            queue.submit([encoder.finish()]);
            Ok(())
        });
        if written.is_err() {
            // Half a frame is none.
            self.uniform.has_frame = 0;
            self.write_uniform(queue);
        }
        written
    }

    /// How the frame is cast from now on.
    pub(crate) fn set_options(&mut self, queue: &wgpu::Queue, options: &CastOptions) {
        let former = self.uniform;
        self.uniform.set_options(options);
        if self.uniform != former {
            self.write_uniform(queue);
        }
    }

    fn write_uniform(&self, queue: &wgpu::Queue) {
        queue.write_buffer(&self.caster, 0, bytemuck::bytes_of(&self.uniform));
    }
}

impl Buffers {
    /// Of so many bytes.
    fn new(device: &wgpu::Device, bytes: [u64; 6]) -> Self {
        let [a, b, c, d, occupied, counts] =
            std::array::from_fn(|i| buffer(device, LABELS[i], bytes[i], wgpu::BufferUsages::STORAGE));
        Self { planes: [a, b, c, d], grid: [occupied, counts] }
    }

    fn all(&self) -> impl Iterator<Item = &wgpu::Buffer> {
        self.planes.iter().chain(&self.grid)
    }

    /// The groups for casting and for building the grid.
    fn bind(
        &self,
        device: &wgpu::Device,
        layout: &wgpu::BindGroupLayout,
        builder: &GridBuilder,
        caster: &wgpu::Buffer,
    ) -> (wgpu::BindGroup, wgpu::BindGroup) {
        let Self { planes: [offsets, depth, c_rg, c_b_tau], grid: [occupied, counts] } = self;
        let cast = [caster, offsets, depth, c_rg, c_b_tau, occupied, counts].map(|b| b.as_entire_binding());
        let build = [caster, offsets, depth, occupied, counts].map(|b| b.as_entire_binding());
        (bind(device, "frame", layout, &cast), bind(device, "grid", &builder.layout, &build))
    }
}

/// A layered frame kept on the GPU for any number of novel views.
pub struct GpuReprojector {
    gpu: Gpu,
    frame: FrameOnGpu,
    picture: PictureTarget,
}

impl GpuReprojector {
    /// Uploads a frame. `bounds` is the box of the volume that it was made of.
    pub fn new(gpu: &Gpu, frame: &LayeredFrame, bounds: &Aabb) -> Result<Self, GpuError> {
        let mut reprojector = gpu.attempt("making buffers", || {
            let builder = GridBuilder {
                pipeline: gpu.pipeline(Kernel::EmptySpace, "empty_space"),
                layout: gpu.layouts().empty_space.clone(),
            };
            let on_gpu = FrameOnGpu::new(gpu.device(), &gpu.layouts().caster, builder);
            Ok(Self { gpu: gpu.clone(), frame: on_gpu, picture: PictureTarget::new(gpu) })
        })?;
        reprojector.set_frame(frame, bounds)?;
        Ok(reprojector)
    }

    /// Replaces the frame, reusing the buffers.
    pub fn set_frame(&mut self, frame: &LayeredFrame, bounds: &Aabb) -> Result<(), GpuError> {
        let Self { gpu, frame: on_gpu, .. } = self;
        gpu.attempt("uploading a layered frame", || {
            on_gpu.upload(gpu.device(), gpu.queue(), &gpu.layouts().caster, frame, bounds)
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
        let Self { gpu, frame, picture } = self;
        gpu.attempt("casting a novel view", || {
            frame.set_options(gpu.queue(), options);
            let pipeline = gpu.pipeline(Kernel::RaycastCompute, "raycast");
            picture.draw(gpu, &pipeline, &frame.bind_group, view)
        })
    }
}

/// What the kernel relies on to stay inside the planes and to end.
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

const LABELS: [&str; 6] = ["offsets", "depth", "c_rg", "c_b_tau", "occupied", "counts"];
