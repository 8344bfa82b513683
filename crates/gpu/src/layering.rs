//! Layered frames on the GPU. `generate` writes the lists of a band of rows to slots. Three passes of `compact`
//! append them to the planes, which are read back.
//!
//! A frame is one submission and one wait for the planes. Its threshold comes from the previous frame or is counted
//! on the device. The number of copied segments is a guess from the previous frame. On a slow device the host also
//! waits between bands, so that a frame can be given up.

use std::time::{Duration, Instant};

use isinglass_core::cancel::Wanted;
use isinglass_core::kernels::layering::budget::{
    Budget, FIRST_LEAST, FIRST_RATIO, NUM_THRESHOLDS, THRESHOLD_GREATEST, longest_list, sample_stride,
};
use isinglass_core::layer::{FrameHeader, LayeredFrame, MAX_K};

use crate::device::{Gpu, bands, bind, rows_per_band};
use crate::error::GpuError;
use crate::gpu_types::{BLOCK, Band, Basis, GROUP_HEIGHT, WORKGROUP_SIDE};
use crate::readback::Readback;
use crate::scene::SceneOnGpu;
use crate::shaders::Kernel;

/// Buffers for the frames of one size and greatest list length.
pub(crate) struct FrameTarget {
    width: u32,
    height: u32,
    k: u8,
    max_steps: u32,
    capacity: usize,
    camera: wgpu::Buffer,
    offsets: wgpu::Buffer,
    /// `Budget` of `budget.wgsl`.
    budget: wgpu::Buffer,
    /// Depth, c_rg, c_b_tau.
    planes: [wgpu::Buffer; 3],
    bands: Vec<BandOnGpu>,
    readback: Readback,
    /// Segments to copy before their number is known.
    guess: usize,
    /// Time for the last frame.
    took: Duration,
}

/// Some rows of a frame, with the inputs of their kernels.
struct BandOnGpu {
    band: Band,
    generate: wgpu::BindGroup,
    compact: wgpu::BindGroup,
}

impl FrameTarget {
    /// Buffers for frames of a scene whose rays take at most `max_steps`.
    pub(crate) fn new(gpu: &Gpu, header: &FrameHeader, max_steps: u32) -> Result<Self, GpuError> {
        if !header.camera.is_valid() {
            return Err(GpuError::Camera);
        }
        let (width, height) = (header.camera.intrinsics.width, header.camera.intrinsics.height);
        let k = clamp_k(header.k);
        let num_pixels = u64::from(width) * u64::from(height);
        let longest = longest_list(k.into()) as u8;
        // A budget from sampled rays may be exceeded somewhat.
        let slack = if longest == k { 0 } else { num_pixels * u64::from(k) / 8 + SLACK_SEGMENTS };
        let capacity = (num_pixels * u64::from(k) + slack).min(num_pixels * u64::from(longest));
        let plane_bytes = capacity * 4;
        gpu.check_binding("plane of segments in bytes", plane_bytes)?;
        let slot_bytes_per_pixel = u32::from(longest) * 12;
        let max_pixels = gpu.max_dispatch_pixels(max_steps);
        let slot_limit = if gpu.info().is_software { SLOT_BYTES_OF_SOFTWARE } else { SLOT_BYTES };
        let max_pixels = max_pixels.min(slot_limit / slot_bytes_per_pixel);
        let band_pixels = rows_per_band(width, height, max_pixels) * width;
        let slot_bytes = u64::from(band_pixels) * u64::from(slot_bytes_per_pixel);
        gpu.check_binding("slots of a row in bytes", slot_bytes)?;
        let camera = gpu.uniform::<Basis>("camera");
        let counts = gpu.storage("counts", u64::from(band_pixels) * 4);
        let slots = gpu.storage("slots", slot_bytes);
        let block_sums = gpu.storage("block_sums", u64::from(band_pixels.div_ceil(BLOCK)) * 4);
        // Entry 0 stays 0, as new buffers are.
        let offsets = gpu.storage("offsets", (num_pixels + 1) * 4);
        let planes = ["depth", "c_rg", "c_b_tau"].map(|label| gpu.storage(label, plane_bytes));
        let budget = gpu.storage("budget", BUDGET_WORDS as u64 * 4);
        let bands = bands(width, height, max_pixels).map(|band| {
            let uniform = gpu.uniform::<Band>("band");
            gpu.queue().write_buffer(&uniform, 0, bytemuck::bytes_of(&band));
            let [uniform, camera, counts, slots, budget, block_sums, offsets, depth, c_rg, c_b_tau] = [
                &uniform,
                &camera,
                &counts,
                &slots,
                &budget,
                &block_sums,
                &offsets,
                &planes[0],
                &planes[1],
                &planes[2],
            ]
            .map(wgpu::Buffer::as_entire_binding);
            let generate = [camera, uniform.clone(), counts.clone(), slots.clone(), budget];
            let compact = [uniform, counts, slots, block_sums, offsets, depth, c_rg, c_b_tau];
            BandOnGpu {
                band,
                generate: bind(gpu.device(), "generate", &gpu.layouts().generate, &generate),
                compact: bind(gpu.device(), "compact", &gpu.layouts().compact, &compact),
            }
        });
        Ok(Self {
            width,
            height,
            k,
            max_steps,
            capacity: capacity as usize,
            bands: bands.collect(),
            camera,
            offsets,
            budget,
            planes,
            readback: Readback::default(),
            guess: 0,
            took: Duration::ZERO,
        })
    }

    /// Whether this fits frames with this header's size and K, and rays of this many steps.
    pub(crate) fn fits(&self, header: &FrameHeader, max_steps: u32) -> bool {
        let i = header.camera.intrinsics;
        (self.width, self.height, self.k, self.max_steps) == (i.width, i.height, clamp_k(header.k), max_steps)
    }

    /// The frame, by the threshold that `budget` knows or a counted one; `None` if it is no longer wanted.
    pub(crate) fn generate(
        &mut self,
        gpu: &Gpu,
        scene: &SceneOnGpu,
        header: FrameHeader,
        (budget, reach): (&mut Budget, f32),
        wanted: Wanted<'_>,
    ) -> Result<Option<LayeredFrame>, GpuError> {
        if !header.camera.is_valid() {
            return Err(GpuError::Camera);
        }
        let started = Instant::now();
        let asked = FrameHeader { k: self.k, ..header };
        let header = FrameHeader { k: longest_list(self.k.into()) as u8, ..header };
        gpu.queue().write_buffer(&self.camera, 0, bytemuck::bytes_of(&Basis::of(&header.camera)));
        let mut threshold = budget.threshold(&asked, reach);
        let num_offsets = header.camera.intrinsics.num_pixels() + 1;
        loop {
            self.write_budget(gpu, threshold);
            let mut encoder = encoder(gpu);
            if threshold.is_none() {
                self.count(gpu, scene, &mut encoder);
            }
            let Some(encoder) = self.fill_planes(gpu, scene, encoder, wanted)? else { return Ok(None) };
            let mut frame = LayeredFrame::empty(header);
            let mut head = Vec::new();
            frame.offsets.clear();
            let guess = self.guess;
            let LayeredFrame { offsets, depth, c_rg, c_b_tau, .. } = &mut frame;
            let [a, b, c] = &self.planes;
            self.readback.read(
                gpu,
                encoder,
                [
                    (&self.budget, BUDGET_WORDS),
                    (&self.offsets, num_offsets),
                    (a, guess),
                    (b, guess),
                    (c, guess),
                ],
                [&mut head, offsets, depth, c_rg, c_b_tau],
            )?;
            // When they end a dispatch, some drivers return old buffer contents without an error.
            if !frame.offsets.is_sorted() {
                let what = "generating a layered frame";
                return Err(GpuError::Lost { what, reason: "what came back is no frame".into() });
            }
            let total = frame.offsets.last().map_or(0, |&total| total as usize);
            let used = head.get(BUDGET_THRESHOLD).map_or(0.0, |&bits| f32::from_bits(bits));
            if total <= self.capacity {
                self.read_planes(gpu, &mut frame, total)?;
                self.took = started.elapsed();
                budget.note(&asked, used, &frame);
                return Ok(Some(frame));
            }
            // The sampled rays have missed what most rays meet.
            if !(0.0..THRESHOLD_GREATEST).contains(&used) {
                return Err(GpuError::Frame(format!(
                    "more than {} segments at any threshold",
                    self.capacity
                )));
            }
            if !wanted() {
                return Ok(None);
            }
            // The number of segments falls at most as the root of the threshold.
            let excess = total as f32 / self.capacity as f32;
            threshold = Some((used * (excess * excess).clamp(2.0, 16.0)).max(FIRST_LEAST));
        }
    }

    /// Reads the rest of the planes up to `total` segments.
    fn read_planes(&mut self, gpu: &Gpu, frame: &mut LayeredFrame, total: usize) -> Result<(), GpuError> {
        let LayeredFrame { depth, c_rg, c_b_tau, .. } = frame;
        if total > self.guess {
            [&mut *depth, &mut *c_rg, &mut *c_b_tau].into_iter().for_each(Vec::clear);
            let planes = self.planes.each_ref().map(|plane| (plane, total));
            self.readback.read(gpu, encoder(gpu), planes, [&mut *depth, &mut *c_rg, &mut *c_b_tau])?;
        }
        [depth, c_rg, c_b_tau].into_iter().for_each(|plane| plane.truncate(total));
        self.guess = (total + total / 8).min(self.capacity);
        Ok(())
    }

    /// Sets the budget on the device; without a threshold it must be counted.
    fn write_budget(&self, gpu: &Gpu, threshold: Option<f32>) {
        let mut words = [0; BUDGET_WORDS];
        words[BUDGET_THRESHOLD] = threshold.unwrap_or(0.0).to_bits();
        words[2] = FIRST_LEAST.to_bits();
        words[3] = FIRST_RATIO.to_bits();
        words[4] = u32::from(self.k);
        words[5] = longest_list(self.k.into()) as u32;
        gpu.queue().write_buffer(&self.budget, 0, bytemuck::cast_slice(&words));
    }

    /// Counts some rays twice at several thresholds, and chooses one.
    fn count(&self, gpu: &Gpu, scene: &SceneOnGpu, encoder: &mut wgpu::CommandEncoder) {
        let Some(BandOnGpu { generate, .. }) = self.bands.first() else { return };
        let kernel = Kernel::Generate(scene.purpose);
        let [count, choose] = ["count", "choose"].map(|entry| gpu.pipeline(kernel, entry));
        let stride = sample_stride(self.width, self.height);
        let groups = |side: u32, of: u32| side.div_ceil(stride).div_ceil(of);
        let mut pass = encoder.begin_compute_pass(&gpu.pass());
        pass.set_bind_group(0, &scene.bind_group, &[]);
        pass.set_bind_group(1, generate, &[]);
        for _ in 0..2 {
            pass.set_pipeline(&count);
            let (x, y) = (groups(self.width, WORKGROUP_SIDE), groups(self.height, GROUP_HEIGHT));
            pass.dispatch_workgroups(x, y, NUM_THRESHOLDS as u32);
            pass.set_pipeline(&choose);
            pass.dispatch_workgroups(1, 1, 1);
        }
    }

    /// Generates and compacts band by band, and returns the commands that are not submitted yet. `None` if the frame
    /// is no longer wanted, which a slow device checks after each band but the last.
    fn fill_planes(
        &self,
        gpu: &Gpu,
        scene: &SceneOnGpu,
        mut encoder: wgpu::CommandEncoder,
        wanted: Wanted<'_>,
    ) -> Result<Option<wgpu::CommandEncoder>, GpuError> {
        let march = gpu.pipeline(Kernel::Generate(scene.purpose), "generate");
        let [sum_blocks, scan_blocks, compact] =
            ["sum_blocks", "scan_blocks", "compact"].map(|entry| gpu.pipeline(Kernel::Compact, entry));
        let is_slow = gpu.info().is_software || self.took > SLOW_FRAME;
        for (i, BandOnGpu { band, generate, compact: packed }) in self.bands.iter().enumerate() {
            if is_slow && i > 0 {
                gpu.queue().submit([encoder.finish()]);
                gpu.wait("generating a layered frame")?;
                if !wanted() {
                    return Ok(None);
                }
                encoder = self::encoder(gpu);
            }
            let mut pass = encoder.begin_compute_pass(&gpu.pass());
            pass.set_pipeline(&march);
            pass.set_bind_group(0, &scene.bind_group, &[]);
            pass.set_bind_group(1, generate, &[]);
            let (x, y) = (self.width.div_ceil(WORKGROUP_SIDE), band.num_rows.div_ceil(GROUP_HEIGHT));
            pass.dispatch_workgroups(x, y, 1);
            let num_blocks = band.num_pixels.div_ceil(BLOCK);
            pass.set_bind_group(0, packed, &[]);
            for (pipeline, workgroups) in
                [(&sum_blocks, num_blocks), (&scan_blocks, 1), (&compact, num_blocks)]
            {
                pass.set_pipeline(pipeline);
                pass.dispatch_workgroups(workgroups, 1, 1);
            }
        }
        Ok(Some(encoder))
    }
}

fn encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
}

fn clamp_k(k: u8) -> u8 {
    k.clamp(1, MAX_K as u8)
}

/// Most bytes of slots in a band: a frame of 1280×720 lists at K = 8 is one band.
const SLOT_BYTES: u32 = 1 << 28;
const SLOT_BYTES_OF_SOFTWARE: u32 = 1 << 26;
/// A device that takes longer for a frame counts as slow.
const SLOW_FRAME: Duration = Duration::from_millis(50);
/// Segments beyond the budget that every frame has room for.
const SLACK_SEGMENTS: u64 = 1 << 14;
/// Words of `Budget`, and which of them is the threshold.
const BUDGET_WORDS: usize = 6 + NUM_THRESHOLDS;
const BUDGET_THRESHOLD: usize = 1;
