//! A layered frame on the GPU, and its novel views as pictures. Kernels: `shaders/raycast.wgsl`,
//! `shaders/raycast_compute.wgsl`.

use isinglass_core::camera::Camera;
use isinglass_core::kernels::lens::View;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;

use crate::device::{Gpu, bind, buffer, check_binding};
use crate::error::{GpuError, scoped};
use crate::gpu_types::Raycaster;
use crate::picture_target::PictureTarget;
use crate::shaders::Kernel;

/// Group 0 of `raycast.wgsl`: buffers that grow when a larger frame comes and are reused otherwise.
pub(crate) struct FrameOnGpu {
    caster: wgpu::Buffer,
    /// Offsets, depth, c_rg, c_b_tau.
    planes: [wgpu::Buffer; 4],
    /// Made for exactly these buffers.
    pub(crate) bind_group: wgpu::BindGroup,
}

impl FrameOnGpu {
    /// Buffers without a frame: nothing is seen.
    pub(crate) fn new(device: &wgpu::Device, layout: &wgpu::BindGroupLayout) -> Self {
        let caster = buffer(device, "caster", size_of::<Raycaster>() as u64, wgpu::BufferUsages::UNIFORM);
        let planes = PLANES.map(|label| plane_buffer(device, label, 8));
        let bind_group = Self::bind(device, layout, &caster, &planes);
        Self { caster, planes, bind_group }
    }

    fn bind(
        device: &wgpu::Device,
        layout: &wgpu::BindGroupLayout,
        caster: &wgpu::Buffer,
        [offsets, depth, c_rg, c_b_tau]: &[wgpu::Buffer; 4],
    ) -> wgpu::BindGroup {
        bind(device, "frame", layout, &[caster, offsets, depth, c_rg, c_b_tau].map(|b| b.as_entire_binding()))
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
        let planes = [&frame.offsets, &frame.depth, &frame.c_rg, &frame.c_b_tau];
        for plane in planes {
            check_binding(device, "plane of a layered frame in bytes", plane.len() as u64 * 4)?;
        }
        // A quarter more than needed: frames of a moving camera vary, and every growth makes a new bind group.
        let limit = device.limits().max_storage_buffer_binding_size;
        let bytes = planes.map(|plane| plane.len() as u64 * 4);
        if bytes.iter().zip(&self.planes).any(|(&needed, plane)| plane.size() < needed) {
            (self.planes, self.bind_group) = scoped(device, "growing buffers", || {
                let sizes = std::array::from_fn::<_, 4, _>(|i| (bytes[i] + bytes[i] / 4).min(limit));
                let planes = std::array::from_fn(|i| plane_buffer(device, PLANES[i], sizes[i]));
                let bind_group = Self::bind(device, layout, &self.caster, &planes);
                Ok((planes, bind_group))
            })?;
        }
        let mut caster = Raycaster::of(&frame.header.camera, bounds);
        let written = scoped(device, "writing a layered frame", || {
            for (buffer, plane) in self.planes.iter().zip(planes) {
                queue.write_buffer(buffer, 0, bytemuck::cast_slice(plane));
            }
            Ok(())
        });
        // Half a frame is none.
        caster.has_frame = written.is_ok().into();
        queue.write_buffer(&self.caster, 0, bytemuck::bytes_of(&caster));
        written
    }
}

fn plane_buffer(device: &wgpu::Device, label: &str, bytes: u64) -> wgpu::Buffer {
    buffer(device, label, bytes, wgpu::BufferUsages::STORAGE)
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
            let on_gpu = FrameOnGpu::new(gpu.device(), &gpu.layouts().caster);
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
        if !camera.is_valid() {
            return Err(GpuError::Camera);
        }
        self.raycast_view(&camera.into())
    }

    /// The same for a view that may be off-axis.
    pub fn raycast_view(&mut self, view: &View) -> Result<Picture, GpuError> {
        let Self { gpu, frame, picture } = self;
        gpu.attempt("casting a novel view", || {
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

const PLANES: [&str; 4] = ["offsets", "depth", "c_rg", "c_b_tau"];
