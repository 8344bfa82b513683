//! Layered frames on the GPU: `generate` writes the lists of a band of rows to slots, three passes of `compact` pack
//! them into the planes behind those of the band before, and the planes are read back.

use isinglass_core::kernels::layering::Layering;
use isinglass_core::kernels::layering::visibility_merge::{COST_BINS, sample_stride};
use isinglass_core::layer::{FrameHeader, LayeredFrame, MAX_K};
use isinglass_core::wanted::Wanted;

use crate::device::{Gpu, bands, bind, rows_per_band};
use crate::error::GpuError;
use crate::gpu_types::{BLOCK, Band, Basis, WORKGROUP_SIDE};
use crate::readback::Readback;
use crate::scene::SceneOnGpu;
use crate::shaders::Kernel;

/// Buffers for the frames of one size and greatest list length.
pub(crate) struct FrameTarget {
    width: u32,
    height: u32,
    layering: Layering,
    k: u8,
    max_pixels: u32,
    /// Segments that the planes hold.
    capacity: usize,
    camera: wgpu::Buffer,
    band: wgpu::Buffer,
    offsets: wgpu::Buffer,
    /// `Budget` of `visibility_merge.wgsl`.
    budget: wgpu::Buffer,
    /// Depth, c_rg, c_b_tau.
    planes: [wgpu::Buffer; 3],
    generate: wgpu::BindGroup,
    compact: wgpu::BindGroup,
    readback: Readback,
}

impl FrameTarget {
    pub(crate) fn new(gpu: &Gpu, header: &FrameHeader, layering: Layering) -> Result<Self, GpuError> {
        if !header.camera.is_valid() {
            return Err(GpuError::Camera);
        }
        let (width, height) = (header.camera.intrinsics.width, header.camera.intrinsics.height);
        let k = clamp_k(header.k);
        let num_pixels = u64::from(width) * u64::from(height);
        let longest = layering.longest_list(k);
        // A budget estimated from a sample may be missed by some.
        let slack = if longest == k { 0 } else { num_pixels * u64::from(k) / 8 + SLACK_SEGMENTS };
        let capacity = (num_pixels * u64::from(k) + slack).min(num_pixels * u64::from(longest));
        let plane_bytes = capacity * 4;
        gpu.check_binding("plane of segments in bytes", plane_bytes)?;
        let slot_bytes_per_pixel = u32::from(longest) * 12;
        let max_pixels = gpu.max_dispatch_pixels(1).min(SLOT_BYTES / slot_bytes_per_pixel);
        let band_pixels = rows_per_band(width, height, max_pixels) * width;
        let slot_bytes = u64::from(band_pixels) * u64::from(slot_bytes_per_pixel);
        gpu.check_binding("slots of a row in bytes", slot_bytes)?;
        let (camera, band) = (gpu.uniform::<Basis>("camera"), gpu.uniform::<Band>("band"));
        let counts = gpu.storage("counts", u64::from(band_pixels) * 4);
        let slots = gpu.storage("slots", slot_bytes);
        let block_sums = gpu.storage("block_sums", u64::from(band_pixels.div_ceil(BLOCK)) * 4);
        // Entry 0 stays 0, as new buffers are.
        let offsets = gpu.storage("offsets", (num_pixels + 1) * 4);
        let planes = ["depth", "c_rg", "c_b_tau"].map(|label| gpu.storage(label, plane_bytes));
        let budget = gpu.storage("budget", (BUDGET_JOINS + COST_BINS as u64) * 4);
        let generate = bind(
            gpu.device(),
            "generate",
            &gpu.layouts().generate,
            &[
                camera.as_entire_binding(),
                band.as_entire_binding(),
                counts.as_entire_binding(),
                slots.as_entire_binding(),
                budget.as_entire_binding(),
            ],
        );
        let compact = bind(
            gpu.device(),
            "compact",
            &gpu.layouts().compact,
            &[
                band.as_entire_binding(),
                counts.as_entire_binding(),
                slots.as_entire_binding(),
                block_sums.as_entire_binding(),
                offsets.as_entire_binding(),
                planes[0].as_entire_binding(),
                planes[1].as_entire_binding(),
                planes[2].as_entire_binding(),
            ],
        );
        let readback = Readback::default();
        Ok(Self {
            width,
            height,
            layering,
            k,
            max_pixels,
            capacity: capacity as usize,
            camera,
            band,
            offsets,
            budget,
            planes,
            generate,
            compact,
            readback,
        })
    }

    /// Whether this is for frames by this rule with this header's size and K.
    pub(crate) fn fits(&self, header: &FrameHeader, layering: Layering) -> bool {
        let i = header.camera.intrinsics;
        (self.width, self.height, self.k, self.layering) == (i.width, i.height, clamp_k(header.k), layering)
    }

    pub(crate) fn generate(
        &mut self,
        gpu: &Gpu,
        scene: &SceneOnGpu,
        header: FrameHeader,
        wanted: Wanted<'_>,
    ) -> Result<Option<LayeredFrame>, GpuError> {
        if !header.camera.is_valid() {
            return Err(GpuError::Camera);
        }
        let header = FrameHeader { k: self.layering.longest_list(header.k), ..header };
        gpu.queue().write_buffer(&self.camera, 0, bytemuck::bytes_of(&Basis::of(&header.camera)));
        if self.layering == Layering::VisibilityMerge {
            self.choose_threshold(gpu, scene);
        } else {
            self.write_limits(gpu);
        }
        let mut frame = LayeredFrame::empty(header);
        let num_offsets = header.camera.intrinsics.num_pixels() + 1;
        loop {
            if !self.fill_planes(gpu, scene, wanted)? {
                return Ok(None);
            }
            frame.offsets.clear();
            self.readback.read(gpu, encoder(gpu), [(&self.offsets, num_offsets)], [&mut frame.offsets])?;
            // Some drivers give back what is in a buffer, and no error, where they had to end a dispatch.
            if !frame.offsets.is_sorted() {
                let what = "generating a layered frame";
                return Err(GpuError::Lost { what, reason: "what came back is no frame".into() });
            }
            let total = frame.offsets.last().map_or(0, |&total| total as usize);
            if total <= self.capacity {
                let LayeredFrame { depth, c_rg, c_b_tau, .. } = &mut frame;
                self.readback.read(
                    gpu,
                    encoder(gpu),
                    self.planes.each_ref().map(|plane| (plane, total)),
                    [depth, c_rg, c_b_tau],
                )?;
                return Ok(Some(frame));
            }
            self.raise_threshold(gpu)?;
        }
    }

    /// How many segments lists may have on average, and at most.
    fn write_limits(&self, gpu: &Gpu) {
        let limits = [self.k, self.layering.longest_list(self.k)].map(u32::from);
        gpu.queue().write_buffer(&self.budget, BUDGET_LIMITS as u64 * 4, bytemuck::bytes_of(&limits));
    }

    /// Marches the sample of rays and sets the threshold that their joins ask for.
    fn choose_threshold(&self, gpu: &Gpu, scene: &SceneOnGpu) {
        let kernel = Kernel::generate(scene.kind, scene.mode, self.layering, self.k);
        let [sample, choose] = ["sample_budget", "choose_threshold"].map(|entry| gpu.pipeline(kernel, entry));
        let mut clear = encoder(gpu);
        clear.clear_buffer(&self.budget, 0, None);
        gpu.queue().submit([clear.finish()]);
        self.write_limits(gpu);
        let stride = sample_stride(self.width, self.height);
        let (width, height) = (self.width.div_ceil(stride), self.height.div_ceil(stride));
        let max_pixels = self.max_pixels.min(gpu.max_dispatch_pixels(scene.max_steps));
        for band in bands(width, height, max_pixels) {
            gpu.queue().write_buffer(&self.band, 0, bytemuck::bytes_of(&band));
            let mut encoder = encoder(gpu);
            {
                let mut pass = encoder.begin_compute_pass(&gpu.pass());
                pass.set_pipeline(&sample);
                pass.set_bind_group(0, &scene.bind_group, &[]);
                pass.set_bind_group(1, &self.generate, &[]);
                let (x, y) = (width.div_ceil(WORKGROUP_SIDE), band.num_rows.div_ceil(WORKGROUP_SIDE));
                pass.dispatch_workgroups(x, y, 1);
                if band.first_row + band.num_rows == height {
                    pass.set_pipeline(&choose);
                    pass.dispatch_workgroups(1, 1, 1);
                }
            }
            gpu.queue().submit([encoder.finish()]);
        }
    }

    /// The sample has missed what most rays meet.
    fn raise_threshold(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        let mut head = Vec::new();
        self.readback.read(gpu, encoder(gpu), [(&self.budget, BUDGET_JOINS as usize)], [&mut head])?;
        let threshold = head.get(BUDGET_THRESHOLD).map_or(0.0, |&bits| f32::from_bits(bits));
        if threshold.is_nan() || threshold >= f32::MAX {
            return Err(GpuError::Frame(format!("more than {} segments at any threshold", self.capacity)));
        }
        let raised = (threshold * 2.0).clamp(THRESHOLD_LEAST, f32::MAX);
        gpu.queue().write_buffer(&self.budget, BUDGET_THRESHOLD as u64 * 4, bytemuck::bytes_of(&raised));
        Ok(())
    }

    /// Generates and compacts band by band. `false` if the frame is no longer wanted, which is asked when a band but the
    /// last is done.
    fn fill_planes(&self, gpu: &Gpu, scene: &SceneOnGpu, wanted: Wanted<'_>) -> Result<bool, GpuError> {
        let march = gpu.pipeline(Kernel::generate(scene.kind, scene.mode, self.layering, self.k), "generate");
        let [sum_blocks, scan_blocks, compact] =
            ["sum_blocks", "scan_blocks", "compact"].map(|entry| gpu.pipeline(Kernel::Compact, entry));
        let asked_at = self.width * self.height.div_ceil(BANDS_AT_LEAST);
        let max_steps = scene.max_steps * marches_at_most(self.layering);
        let max_pixels = (self.max_pixels / marches_at_most(self.layering))
            .min(gpu.max_dispatch_pixels(max_steps))
            .min(asked_at.max(PIXELS_AT_LEAST));
        for band in bands(self.width, self.height, max_pixels) {
            gpu.queue().write_buffer(&self.band, 0, bytemuck::bytes_of(&band));
            let mut encoder = encoder(gpu);
            {
                let mut pass = encoder.begin_compute_pass(&gpu.pass());
                pass.set_pipeline(&march);
                pass.set_bind_group(0, &scene.bind_group, &[]);
                pass.set_bind_group(1, &self.generate, &[]);
                let (x, y) = (self.width.div_ceil(WORKGROUP_SIDE), band.num_rows.div_ceil(WORKGROUP_SIDE));
                pass.dispatch_workgroups(x, y, 1);
                let num_blocks = band.num_pixels.div_ceil(BLOCK);
                pass.set_bind_group(0, &self.compact, &[]);
                for (pipeline, workgroups) in
                    [(&sum_blocks, num_blocks), (&scan_blocks, 1), (&compact, num_blocks)]
                {
                    pass.set_pipeline(pipeline);
                    pass.dispatch_workgroups(workgroups, 1, 1);
                }
            }
            gpu.queue().submit([encoder.finish()]);
            if band.first_row + band.num_rows < self.height {
                gpu.wait("generating a layered frame")?;
                if !wanted() {
                    return Ok(false);
                }
            }
        }
        Ok(true)
    }
}

/// Marches of a ray, so that a dispatch of a rule with many takes no longer than that of another.
fn marches_at_most(layering: Layering) -> u32 {
    if layering == Layering::Homogeneity { 25 } else { 1 }
}

fn encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
}

/// As the twin reads it.
fn clamp_k(k: u8) -> u8 {
    k.clamp(1, MAX_K as u8)
}

/// Bytes of slots that a band may take: half of a storage binding, so that bands are long and memory is not.
const SLOT_BYTES: u32 = 64 << 20;
/// A large frame has so many bands, so that it can be given up early, but none of fewer pixels: a device in hardware fills
/// those in about a millisecond, beside which waiting for it does not count.
const BANDS_AT_LEAST: u32 = 8;
const PIXELS_AT_LEAST: u32 = 1 << 15;
/// Segments beyond the budget that any frame has room for.
const SLACK_SEGMENTS: u64 = 1 << 14;
/// Words of `Budget` that hold the threshold and the lengths of lists, and the first of its bins.
const BUDGET_THRESHOLD: usize = 2;
const BUDGET_LIMITS: usize = 3;
const BUDGET_JOINS: u64 = 5;
/// Where a threshold of nothing is raised from.
const THRESHOLD_LEAST: f32 = 1e-6;
