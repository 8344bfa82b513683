//! The device: opened once, shared by everything that computes on it.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};

use isinglass_core::kernels::combine::MAX_FRAMES;
use wgpu::{BindingType, BufferBindingType, ShaderStages, TextureSampleType, TextureViewDimension};

use crate::adapters::info_of;
use crate::error::{GpuError, one_line, scoped};
use crate::gpu_types::Band;
use crate::pass_clock::PassClock;
use crate::shaders::{Frames, Kernel, MarchPurpose, TexelKind};

/// Facts about a device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GpuInfo {
    /// Name of the device.
    pub name: String,
    /// Vulkan, Metal or DirectX 12.
    pub backend: String,
    /// Driver, with its version.
    pub driver: String,
    /// Where it is on the PCI bus; empty if that is not known.
    pub bus: String,
    /// Whether the "GPU" runs on the CPU, such as lavapipe.
    pub is_software: bool,
}

impl std::fmt::Display for GpuInfo {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let kind = if self.is_software { "software" } else { "hardware" };
        write!(f, "{} ({}, {kind}, {})", self.name, self.backend, self.driver)
    }
}

/// An open device with its queue and the kernels compiled so far. Clones share all of it.
#[derive(Clone)]
pub struct Gpu {
    shared: Arc<Shared>,
}

struct Shared {
    device: wgpu::Device,
    queue: wgpu::Queue,
    info: GpuInfo,
    layouts: Layouts,
    /// A handful of pipelines, so a linear search is enough.
    pipelines: Mutex<Vec<(Kernel, &'static str, wgpu::ComputePipeline)>>,
    lost: Arc<Mutex<Option<String>>>,
    device_type: wgpu::DeviceType,
    pass_clock: Option<PassClock>,
}

/// The bind group layouts of the compute kernels.
pub(crate) struct Layouts {
    /// Group 1 of `render` and `raycast`.
    pub(crate) picture: wgpu::BindGroupLayout,
    /// Group 1 of `generate`.
    pub(crate) generate: wgpu::BindGroupLayout,
    /// Group 1 of `gather`.
    pub(crate) gather: wgpu::BindGroupLayout,
    /// Group 0 of `compact`.
    pub(crate) compact: wgpu::BindGroupLayout,
    /// Group 0 of `raycast`.
    pub(crate) caster: CasterLayouts,
    pub(crate) empty_space: wgpu::BindGroupLayout,
}

/// Group 0 of the kernels that make novel views.
#[derive(Clone)]
pub(crate) struct CasterLayouts {
    one: wgpu::BindGroupLayout,
    several: wgpu::BindGroupLayout,
}

impl CasterLayouts {
    pub(crate) fn new(device: &wgpu::Device, visibility: ShaderStages) -> Self {
        Self {
            one: layout(device, "frame", visibility, &ONE_FRAME),
            several: layout(device, "frames", visibility, &SEVERAL_FRAMES),
        }
    }

    pub(crate) fn of(&self, frames: Frames) -> &wgpu::BindGroupLayout {
        match frames {
            Frames::One => &self.one,
            Frames::Several => &self.several,
        }
    }
}

impl Gpu {
    /// Opens a device of its own.
    pub(crate) fn open_adapter(adapter: &wgpu::Adapter) -> Result<Self, GpuError> {
        let info = info_of(adapter);
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("isinglass"),
            required_features: PassClock::features(adapter),
            required_limits: required_limits(&adapter.limits()),
            ..Default::default()
        }))
        .map_err(|e| GpuError::Open { adapter: info.name.clone(), reason: one_line(&e.to_string()) })?;
        device.on_uncaptured_error(Arc::new(|error: wgpu::Error| {
            tracing::error!("uncaptured GPU error: {}", one_line(&error.to_string()));
        }));
        let lost = Arc::new(Mutex::new(None));
        let on_lost = Arc::clone(&lost);
        device.set_device_lost_callback(move |reason, message| {
            let text = one_line(&format!("{reason:?} {message}"));
            *on_lost.lock().unwrap_or_else(PoisonError::into_inner) = Some(text);
        });
        let layouts = scoped(&device, "making layouts", || Ok(Layouts::new(&device)))?;
        let pass_clock = PassClock::new(&device, &queue);
        let device_type = adapter.get_info().device_type;
        let pipelines = Mutex::default();
        let shared = Shared { device, queue, info, layouts, pipelines, lost, device_type, pass_clock };
        Ok(Self { shared: Arc::new(shared) })
    }

    /// Facts about the device.
    pub fn info(&self) -> &GpuInfo {
        &self.shared.info
    }

    /// Whether the device is lost: it is useless, but another can be opened.
    pub fn is_lost(&self) -> bool {
        self.shared.lost.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// The device, for passes outside this crate.
    pub fn device(&self) -> &wgpu::Device {
        &self.shared.device
    }

    /// The queue of the device.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.shared.queue
    }

    /// `None` if the adapter has no timestamps.
    pub(crate) fn pass_clock(&self) -> Option<&PassClock> {
        self.shared.pass_clock.as_ref()
    }

    pub(crate) fn layouts(&self) -> &Layouts {
        &self.shared.layouts
    }

    /// Runs `body`; errors that the device reports meanwhile become its error.
    pub(crate) fn attempt<T>(
        &self,
        what: &'static str,
        body: impl FnOnce() -> Result<T, GpuError>,
    ) -> Result<T, GpuError> {
        let result = scoped(self.device(), what, body);
        match self.shared.lost.lock().unwrap_or_else(PoisonError::into_inner).clone() {
            Some(reason) => Err(GpuError::Lost { what, reason }),
            None => result,
        }
    }

    /// Waits until everything submitted is done.
    pub(crate) fn wait(&self, what: &'static str) -> Result<(), GpuError> {
        match poll(self.device(), wgpu::PollType::wait_indefinitely()) {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(e)) => Err(GpuError::Failed { what, reason: e.to_string() }),
            Err(NoAnswer) => Err(GpuError::Lost { what, reason: "the device stopped answering".into() }),
        }
    }

    /// The pipeline of one entry point of a kernel, compiled on first use.
    pub(crate) fn pipeline(&self, kernel: Kernel, entry: &'static str) -> wgpu::ComputePipeline {
        let mut pipelines = self.shared.pipelines.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((.., pipeline)) = pipelines.iter().find(|(k, e, _)| (*k, *e) == (kernel, entry)) {
            return pipeline.clone();
        }
        let pipeline = self.compile(kernel, entry);
        pipelines.push((kernel, entry, pipeline.clone()));
        pipeline
    }

    fn compile(&self, kernel: Kernel, entry: &'static str) -> wgpu::ComputePipeline {
        let layouts = self.layouts();
        let groups: &[Option<&wgpu::BindGroupLayout>] = match kernel {
            Kernel::Render(purpose, _) => {
                &[Some(&scene_layout(self.device(), purpose)), Some(&layouts.picture)]
            }
            Kernel::Generate(purpose) => {
                &[Some(&scene_layout(self.device(), purpose)), Some(&layouts.generate)]
            }
            Kernel::Gather(purpose, _) => {
                &[Some(&scene_layout(self.device(), purpose)), Some(&layouts.gather)]
            }
            Kernel::Compact => &[Some(&layouts.compact)],
            Kernel::EmptySpace => &[Some(&layouts.empty_space)],
            // Owners make their pipelines.
            Kernel::Upscale | Kernel::RaycastView(..) | Kernel::Blocks(..) => &[],
            Kernel::RaycastCompute(purpose) => {
                &[Some(layouts.caster.of(purpose.frames)), Some(&layouts.picture)]
            }
        };
        compute_pipeline(self.device(), kernel, entry, groups)
    }

    #[cfg(test)]
    pub(crate) fn replace(&self, kernel: Kernel, entry: &'static str, text: &str) {
        let layouts = self.layouts();
        let groups = [Some(layouts.caster.of(Frames::One)), Some(&layouts.picture)];
        let pipeline = pipeline_of_text(self.device(), text, &kernel.constants(), entry, &groups);
        self.shared
            .pipelines
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(0, (kernel, entry, pipeline));
    }

    /// Most pixels of one dispatch whose pixels take at most `steps` each. It is short enough for the watchdogs of
    /// window systems and long enough to fill a device.
    pub(crate) fn max_dispatch_pixels(&self, steps: u32) -> u32 {
        let (most, most_steps) = match self.shared.device_type {
            wgpu::DeviceType::Cpu => return 1 << 16,
            // A discrete GPU reads some 10¹⁰ texels a second, at least eight per step; watchdogs allow two seconds.
            wgpu::DeviceType::DiscreteGpu => (1 << 20, STEPS_OF_DISCRETE),
            _ => (1 << 20, STEPS_OF_OTHERS),
        };
        (most_steps / steps.max(1)).clamp(LEAST_DISPATCH, most)
    }

    /// Returns an error if the device cannot cast several frames into a buffer.
    pub fn check_combining(&self) -> Result<(), GpuError> {
        let limit = self.device().limits().max_storage_buffers_per_shader_stage.into();
        let needed = u64::from(NUM_BUFFERS_OF_FRAMES) + 1;
        let what = "a picture of several frames in storage buffers";
        if needed > limit { Err(GpuError::TooLarge { what, needed, limit }) } else { Ok(()) }
    }

    /// Returns an error if a storage buffer of `bytes` cannot be bound.
    pub(crate) fn check_binding(&self, what: &'static str, bytes: u64) -> Result<(), GpuError> {
        check_binding(self.device(), what, bytes)
    }

    /// A buffer that kernels read and write, and that copies can read and write.
    pub(crate) fn storage(&self, label: &'static str, bytes: u64) -> wgpu::Buffer {
        buffer(self.device(), label, bytes, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC)
    }

    /// A buffer of uniforms.
    pub(crate) fn uniform<T>(&self, label: &'static str) -> wgpu::Buffer {
        buffer(self.device(), label, size_of::<T>() as u64, wgpu::BufferUsages::UNIFORM)
    }
}

impl Layouts {
    fn new(device: &wgpu::Device) -> Self {
        let compute = ShaderStages::COMPUTE;
        Self {
            picture: layout(device, "picture", compute, &[UNIFORM, UNIFORM, WRITE]),
            generate: layout(device, "generate", compute, &[UNIFORM, UNIFORM, WRITE, WRITE, WRITE]),
            gather: layout(device, "gather", compute, &[UNIFORM, UNIFORM, READ, WRITE, WRITE, WRITE, WRITE]),
            compact: layout(
                device,
                "compact",
                compute,
                &[UNIFORM, READ, READ, WRITE, WRITE, WRITE, WRITE, WRITE],
            ),
            caster: CasterLayouts::new(device, compute),
            empty_space: layout(device, "empty space", compute, &EMPTY_SPACE),
        }
    }
}

/// Group 0 of the marching kernels: uniform, tables, occupancy, voxels, shares of light, voxels of more channels, gaps,
/// and the table and fields of pages.
pub(crate) fn scene_layout(device: &wgpu::Device, purpose: MarchPurpose) -> wgpu::BindGroupLayout {
    let texels = |kind: TexelKind| BindingType::Texture {
        sample_type: match kind {
            TexelKind::Uint => TextureSampleType::Uint,
            TexelKind::Float => TextureSampleType::Float { filterable: false },
        },
        view_dimension: TextureViewDimension::D3,
        multisampled: false,
    };
    let mut types = vec![UNIFORM, READ, READ];
    types.extend(purpose.kinds().into_iter().map(texels));
    types.insert(4, texels(TexelKind::Uint));
    types.extend(purpose.has_gaps.then(|| texels(TexelKind::Uint)));
    types.extend([READ; 2].iter().filter(|_| purpose.has_pages));
    layout(device, "scene", ShaderStages::COMPUTE, &types)
}

/// These limits with buffers as large as a frame needs and the adapter offers.
pub fn with_large_buffers(limits: wgpu::Limits, offered: &wgpu::Limits) -> wgpu::Limits {
    let within = |default: u64, offered: u64| offered.min(LARGEST_BUFFER).max(default);
    wgpu::Limits {
        max_storage_buffer_binding_size: within(
            limits.max_storage_buffer_binding_size,
            offered.max_storage_buffer_binding_size,
        ),
        max_buffer_size: within(limits.max_buffer_size, offered.max_buffer_size),
        ..limits
    }
}

/// A lost device does not answer.
#[derive(Debug)]
pub struct NoAnswer;

/// Polls a device. wgpu panics if the device is lost meanwhile; here that becomes an error.
pub fn poll(
    device: &wgpu::Device,
    poll: wgpu::PollType,
) -> Result<Result<wgpu::PollStatus, wgpu::PollError>, NoAnswer> {
    catch_unwind(AssertUnwindSafe(|| device.poll(poll))).map_err(|_| NoAnswer)
}

/// The default limits with large buffers, one more storage buffer for pictures of several frames, and volumes as
/// large as the adapter allows.
fn required_limits(offered: &wgpu::Limits) -> wgpu::Limits {
    let defaults = wgpu::Limits::default();
    wgpu::Limits {
        max_texture_dimension_3d: offered.max_texture_dimension_3d.max(defaults.max_texture_dimension_3d),
        max_storage_buffers_per_shader_stage: offered
            .max_storage_buffers_per_shader_stage
            .min(NUM_BUFFERS_OF_FRAMES + 1)
            .max(defaults.max_storage_buffers_per_shader_stage),
        ..with_large_buffers(defaults, offered)
    }
}

/// A bind group layout with the given types at bindings 0, 1, 2 …
pub(crate) fn layout(
    device: &wgpu::Device,
    label: &str,
    visibility: ShaderStages,
    types: &[BindingType],
) -> wgpu::BindGroupLayout {
    let entries: Vec<_> = (0..)
        .zip(types)
        .map(|(binding, &ty)| wgpu::BindGroupLayoutEntry { binding, visibility, ty, count: None })
        .collect();
    device
        .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries })
}

/// A bind group with the given resources at bindings 0, 1, 2 …
pub(crate) fn bind(
    device: &wgpu::Device,
    label: &str,
    layout: &wgpu::BindGroupLayout,
    resources: &[wgpu::BindingResource<'_>],
) -> wgpu::BindGroup {
    let entries: Vec<_> = (0..)
        .zip(resources)
        .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource: resource.clone() })
        .collect();
    device.create_bind_group(&wgpu::BindGroupDescriptor { label: Some(label), layout, entries: &entries })
}

/// A buffer that copies can write, of at least four bytes.
pub(crate) fn buffer(
    device: &wgpu::Device,
    label: &str,
    bytes: u64,
    usage: wgpu::BufferUsages,
) -> wgpu::Buffer {
    device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(label),
        size: bytes.max(4).next_multiple_of(4),
        usage: usage | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    })
}

/// Returns an error if a storage buffer of `bytes` cannot be bound on `device`.
pub(crate) fn check_binding(device: &wgpu::Device, what: &'static str, bytes: u64) -> Result<(), GpuError> {
    let limits = device.limits();
    let limit = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
    if bytes > limit { Err(GpuError::TooLarge { what, needed: bytes, limit }) } else { Ok(()) }
}

/// A pipeline of one entry point of a kernel.
pub(crate) fn compute_pipeline(
    device: &wgpu::Device,
    kernel: Kernel,
    entry: &'static str,
    groups: &[Option<&wgpu::BindGroupLayout>],
) -> wgpu::ComputePipeline {
    pipeline_of_text(device, &kernel.source(), &kernel.constants(), entry, groups)
}

fn pipeline_of_text(
    device: &wgpu::Device,
    text: &str,
    constants: &[(&str, f64)],
    entry: &'static str,
    groups: &[Option<&wgpu::BindGroupLayout>],
) -> wgpu::ComputePipeline {
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(entry),
        bind_group_layouts: groups,
        immediate_size: 0,
    });
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(entry),
        layout: Some(&layout),
        module: &module_of_text(device, text),
        entry_point: Some(entry),
        // Kernels write workgroup memory before they read it.
        compilation_options: wgpu::PipelineCompilationOptions {
            constants,
            zero_initialize_workgroup_memory: !matches!(entry, "generate" | "count" | "gather"),
        },
        cache: None,
    })
}

pub(crate) fn shader_module(device: &wgpu::Device, kernel: Kernel) -> wgpu::ShaderModule {
    module_of_text(device, &kernel.source())
}

fn module_of_text(device: &wgpu::Device, text: &str) -> wgpu::ShaderModule {
    device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some("kernel"),
        source: wgpu::ShaderSource::Wgsl(text.into()),
    })
}

/// Divides a picture into bands of whole rows with at most `max_pixels` pixels each, or one row.
pub(crate) fn bands(width: u32, height: u32, max_pixels: u32) -> impl Iterator<Item = Band> {
    let rows = rows_per_band(width, height, max_pixels);
    (0..height).step_by(rows as usize).map(move |first_row| {
        let num_rows = rows.min(height - first_row);
        Band { first_row, num_rows, first_pixel: first_row * width, num_pixels: num_rows * width }
    })
}

/// Rows of the largest band of [`bands`].
pub(crate) fn rows_per_band(width: u32, height: u32, max_pixels: u32) -> u32 {
    (max_pixels / width).clamp(1, height)
}

pub(crate) const UNIFORM: BindingType =
    BindingType::Buffer { ty: BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None };
pub(crate) const READ: BindingType = BindingType::Buffer {
    ty: BufferBindingType::Storage { read_only: true },
    has_dynamic_offset: false,
    min_binding_size: None,
};
pub(crate) const WRITE: BindingType = BindingType::Buffer {
    ty: BufferBindingType::Storage { read_only: false },
    has_dynamic_offset: false,
    min_binding_size: None,
};
/// Steps of all rays in a dispatch.
const STEPS_OF_DISCRETE: u32 = 1 << 30;
const STEPS_OF_OTHERS: u32 = 1 << 27;
/// Pixels of the shortest dispatch: fewer do not fill a device.
const LEAST_DISPATCH: u32 = 1 << 14;
/// A plane of a frame of 3840×2160 lists of 32 segments.
const LARGEST_BUFFER: u64 = 1 << 30;
/// Group 0 of `one_frame.wgsl`.
const ONE_FRAME: [BindingType; 6] = [UNIFORM, READ, READ, READ, READ, READ];
/// Storage buffers of `combine.wgsl`: two a frame, as many as every device can bind.
const NUM_BUFFERS_OF_FRAMES: u32 = 2 * MAX_FRAMES as u32;
/// Group 0 of `combine.wgsl`.
const SEVERAL_FRAMES: [BindingType; 9] = [UNIFORM, READ, READ, READ, READ, READ, READ, READ, READ];
/// Group 0 of `empty_space_build.wgsl`.
pub(crate) const EMPTY_SPACE: [BindingType; 7] = [UNIFORM, READ, READ, WRITE, WRITE, WRITE, WRITE];
