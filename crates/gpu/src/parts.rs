//! What a process sends about its own part of a volume, gathered on the GPU. Kernel: `shaders/layering/parts.wgsl`.
//!
//! The rays and their steps come from the host. A dispatch gathers along as many of them as there is room for. Rays with
//! more items than usual are gathered again, with more room.

use isinglass_core::kernels::layering::parts::Gathered;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::part_rays::{self, RayItems};

use crate::device::{Gpu, bind};
use crate::error::GpuError;
use crate::gpu_types::{Basis, PartBudget, PartRay, RAYS_IN_GROUP};
use crate::readback::Readback;
use crate::scene::SceneOnGpu;
use crate::shaders::Kernel;

/// Buffers for the rays of a dispatch; they grow for more.
pub(crate) struct GatherTarget {
    camera: wgpu::Buffer,
    budget: wgpu::Buffer,
    num_items: wgpu::Buffer,
    of_rays: OfRays,
    readback: Readback,
    items_readback: Readback,
}

/// Buffers for so many rays and words of items, and group 1 of the kernel.
struct OfRays {
    rays: wgpu::Buffer,
    spans: wgpu::Buffer,
    slots: wgpu::Buffer,
    items: wgpu::Buffer,
    bind_group: wgpu::BindGroup,
}

impl OfRays {
    fn new(gpu: &Gpu, head: [&wgpu::Buffer; 3], num_rays: u64, num_words: u64) -> Self {
        let [camera, budget, num_items] = head.map(wgpu::Buffer::as_entire_binding);
        let rays = gpu.storage("rays", num_rays * size_of::<PartRay>() as u64);
        let spans = gpu.storage("spans", num_rays * 8);
        let [slots, items] = ["slots", "items"].map(|label| gpu.storage(label, num_words * 4));
        let [of_rays, of_spans, of_slots, of_items] =
            [&rays, &spans, &slots, &items].map(wgpu::Buffer::as_entire_binding);
        let all = [camera, budget, of_rays, of_spans, of_slots, of_items, num_items];
        let bind_group = bind(gpu.device(), "gather", &gpu.layouts().gather, &all);
        Self { rays, spans, slots, items, bind_group }
    }

    fn has_room(&self, num_rays: u64, num_words: u64) -> bool {
        self.rays.size() >= num_rays * size_of::<PartRay>() as u64 && self.slots.size() >= num_words * 4
    }
}

impl GatherTarget {
    pub(crate) fn new(gpu: &Gpu) -> Self {
        let (camera, budget) = (gpu.uniform::<Basis>("camera"), gpu.uniform::<PartBudget>("budget"));
        let num_items = gpu.storage("num_items", 4);
        let of_rays = OfRays::new(gpu, [&camera, &budget, &num_items], 1, 1);
        let [readback, items_readback] = [Readback::default(), Readback::default()];
        Self { camera, budget, num_items, of_rays, readback, items_readback }
    }

    /// Gathers `what` along each ray of a view, in the order of the rays.
    pub(crate) fn gather(
        &mut self,
        gpu: &Gpu,
        scene: &SceneOnGpu,
        view: &View,
        rays: &[part_rays::PartRay],
        what: Gathered,
    ) -> Result<RayItems, GpuError> {
        if !view.is_valid() {
            return Err(GpuError::Camera);
        }
        gpu.queue().write_buffer(&self.camera, 0, bytemuck::bytes_of(&Basis::of(*view)));
        let words_per_item = what.words_per_item(scene.purpose.mode);
        let mut all = RayItems { spans: vec![[0; 2]; rays.len()], words: Vec::new(), words_per_item };
        let mut left: Vec<usize> = (0..rays.len()).collect();
        let mut capacity = what.usual_items() as u64;
        while !left.is_empty() {
            let mut again = Vec::new();
            let slot_bytes = capacity * words_per_item as u64 * 4;
            let most = if gpu.info().is_software { SLOT_BYTES_OF_SOFTWARE } else { SLOT_BYTES };
            let most = (most / slot_bytes).clamp(1, gpu.max_dispatch_pixels(scene.max_steps).into());
            gpu.check_binding("items of a ray in bytes", slot_bytes)?;
            let mut longest = capacity;
            for batch in left.chunks(most as usize) {
                let of_batch: Vec<PartRay> = batch.iter().map(|&i| PartRay::from(&rays[i])).collect();
                let (spans, words) = self.batch(gpu, scene, &of_batch, what, (capacity, words_per_item))?;
                let before = all.words.len() as u32;
                for (&ray, &[place, num]) in batch.iter().zip(&spans) {
                    if u64::from(num) > capacity {
                        again.push(ray);
                        longest = longest.max(num.into());
                    } else {
                        all.spans[ray] = [before + place * words_per_item as u32, num];
                    }
                }
                all.words.extend(words);
                let (needed, limit) = (all.words.len() as u64, u32::MAX.into());
                if needed > limit {
                    return Err(GpuError::TooLarge { what: "items of rays in words", needed, limit });
                }
            }
            (left, capacity) = (again, longest);
        }
        Ok(all)
    }

    /// The places and numbers of the items of some rays, and the items of those that have room.
    fn batch(
        &mut self,
        gpu: &Gpu,
        scene: &SceneOnGpu,
        rays: &[PartRay],
        what: Gathered,
        (capacity, words_per_item): (u64, usize),
    ) -> Result<(Vec<[u32; 2]>, Vec<u32>), GpuError> {
        let num_rays = rays.len() as u64;
        let num_words = num_rays * capacity * words_per_item as u64;
        if !self.of_rays.has_room(num_rays, num_words) {
            let head = [&self.camera, &self.budget, &self.num_items];
            self.of_rays = OfRays::new(gpu, head, num_rays, num_words);
        }
        let threshold = if let Gathered::Pieces(threshold) = what { threshold } else { 0.0 };
        let (longest, num_rays) = (what.usual_items() as u32, rays.len() as u32);
        let budget = PartBudget { threshold, longest, num_rays, capacity: capacity as u32 };
        gpu.queue().write_buffer(&self.budget, 0, bytemuck::bytes_of(&budget));
        gpu.queue().write_buffer(&self.num_items, 0, bytemuck::bytes_of(&0u32));
        gpu.queue().write_buffer(&self.of_rays.rays, 0, bytemuck::cast_slice(rays));
        let pipeline = gpu.pipeline(Kernel::Gather(scene.purpose, what.into()), "gather");
        let mut commands = encoder(gpu);
        {
            let mut pass = commands.begin_compute_pass(&gpu.pass());
            pass.set_pipeline(&pipeline);
            pass.set_bind_group(0, &scene.bind_group, &[]);
            pass.set_bind_group(1, &self.of_rays.bind_group, &[]);
            pass.dispatch_workgroups(num_rays.div_ceil(RAYS_IN_GROUP), 1, 1);
        }
        let (mut num_items, mut spans) = (Vec::<u32>::new(), Vec::<u32>::new());
        let sources = [(&self.num_items, 1), (&self.of_rays.spans, 2 * rays.len())];
        self.readback.read(gpu, commands, sources, [&mut num_items, &mut spans])?;
        let spans = spans.as_chunks().0.to_vec();
        let num_items = num_items.first().copied().unwrap_or(0);
        // When they end a dispatch, some drivers return old buffer contents without an error.
        let is_inside = |&[place, num]: &[u32; 2]| {
            u64::from(num) > capacity || u64::from(place) + u64::from(num) <= num_items.into()
        };
        let num_words_found = u64::from(num_items) * words_per_item as u64;
        if num_words_found > num_words || !spans.iter().all(is_inside) {
            let reason = "what came back is about no rays".into();
            return Err(GpuError::Lost { what: "gathering along rays", reason });
        }
        let mut words = Vec::new();
        if num_items > 0 {
            let sources = [(&self.of_rays.items, num_words_found as usize)];
            self.items_readback.read(gpu, encoder(gpu), sources, [&mut words])?;
        }
        Ok((spans, words))
    }
}

fn encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
}

/// Bytes of slots in a dispatch: pieces of matter along 1.5·10⁵ rays.
const SLOT_BYTES: u64 = 1 << 27;
const SLOT_BYTES_OF_SOFTWARE: u64 = 1 << 26;
