//! Layered frames kept on the GPU, cast alone or together. Kernel: `shaders/combine.wgsl`.
//!
//! Each frame is uploaded once to a slot; a bind group selects the slots of a picture.

use isinglass_core::kernels::combine::{MAX_FRAMES, band_of_newest};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::space::Aabb;

use crate::device::{CasterLayouts, bind, buffer};
use crate::error::GpuError;
use crate::gpu_types::Combination;
use crate::raycast::{FrameOnGpu, GridBuilder, Lists};
use crate::shaders::{Frames, Purpose};

pub(crate) struct FramesOnGpu {
    layouts: CasterLayouts,
    builder: GridBuilder,
    /// All slots; at least one.
    slots: Vec<FrameOnGpu>,
    /// Slots of the displayed frames, the newest first; at least one.
    shown: Vec<usize>,
    /// The slots that are cast together and their group, if there are several.
    several: Option<(Vec<usize>, wgpu::BindGroup)>,
    combination: wgpu::Buffer,
    options: CastOptions,
}

impl FramesOnGpu {
    /// Starts with one displayed slot without a frame.
    pub(crate) fn new(device: &wgpu::Device, layouts: &CasterLayouts, builder: GridBuilder) -> Self {
        let first = FrameOnGpu::new(device, layouts.of(Frames::One), builder.clone());
        Self {
            layouts: layouts.clone(),
            builder,
            slots: vec![first],
            shown: vec![0],
            several: None,
            combination: buffer(
                device,
                "combination",
                size_of::<Combination>() as u64,
                wgpu::BufferUsages::UNIFORM,
            ),
            options: CastOptions::default(),
        }
    }

    /// Puts a frame into a slot. `bounds` is the box of its volume. A rejected frame leaves the former one.
    pub(crate) fn upload(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        slot: usize,
        lists: &Lists<'_>,
        bounds: &Aabb,
    ) -> Result<(), GpuError> {
        let layout = self.layouts.of(Frames::One);
        while self.slots.len() <= slot {
            self.slots.push(FrameOnGpu::new(device, layout, self.builder.clone()));
        }
        let result = self.slots[slot].upload(device, queue, layout, lists, bounds);
        self.slots[slot].set_options(queue, &self.options);
        if self.shown.contains(&slot) {
            // Its buffers may have changed.
            self.bind(device);
        }
        result
    }

    /// Selects the slots to cast, the newest first. Empty slots are skipped, and older frames that the device cannot
    /// bind as well.
    pub(crate) fn show(&mut self, device: &wgpu::Device, slots: &[usize]) {
        let slots: Vec<usize> =
            slots.iter().copied().filter(|&slot| slot < self.slots.len()).take(MAX_FRAMES).collect();
        if !slots.is_empty() && slots != self.shown {
            self.shown = slots;
            self.bind(device);
        }
    }

    /// Group 0 of a kernel for a draw that shows nothing; `None` if the device cannot bind it.
    pub(crate) fn warm_up(&self, device: &wgpu::Device, frames: Frames) -> Option<wgpu::BindGroup> {
        let empty = FrameOnGpu::new(device, self.layouts.of(Frames::One), self.builder.clone());
        match frames {
            Frames::One => Some(empty.bind_group),
            Frames::Several => {
                let buffers = empty.whole_buffers(device)?;
                let of_all = (0..MAX_FRAMES).flat_map(|_| buffers.clone());
                let resources: Vec<_> =
                    std::iter::once(self.combination.as_entire_binding()).chain(of_all).collect();
                Some(bind(device, "no frames", self.layouts.of(frames), &resources))
            }
        }
    }

    pub(crate) fn set_options(&mut self, queue: &wgpu::Queue, options: &CastOptions) {
        self.options = *options;
        for slot in &mut self.slots {
            slot.set_options(queue, options);
        }
    }

    /// Prepares pictures of these views.
    pub(crate) fn prepare(&self, queue: &wgpu::Queue, views: &[View]) {
        let Some((slots, _)) = &self.several else { return };
        let mut combination: Combination = bytemuck::Zeroable::zeroed();
        let layers: Vec<&FrameOnGpu> = slots.iter().map(|&slot| &self.slots[slot]).collect();
        for (n, layer) in layers.iter().enumerate() {
            let caster = layer.uniform();
            // The widest margin, around the box of each frame.
            let (min, max) = if n == 0 {
                (caster.bounds_min, caster.bounds_max)
            } else {
                (
                    std::array::from_fn(|i| combination.bounds_min[i].min(caster.bounds_min[i])),
                    std::array::from_fn(|i| combination.bounds_max[i].max(caster.bounds_max[i])),
                )
            };
            (combination.bounds_min, combination.bounds_max) = (min, max);
            combination.clip_normal = caster.clip_normal;
            combination.clip_offset =
                if n == 0 { caster.clip_offset } else { combination.clip_offset.min(caster.clip_offset) };
            combination.casters[n] = caster;
            combination.places[n] = layer.places();
        }
        combination.num_frames = layers.len() as u32;
        if let Some((newest, bounds)) = layers[0].seen_by() {
            // Two eyes share one band, so that they see the same mixture.
            let band = |view: &View| band_of_newest(newest, &view.basis, bounds);
            combination.band = views.iter().map(band).fold(0.0, f32::max);
        }
        queue.write_buffer(&self.combination, 0, bytemuck::bytes_of(&combination));
    }

    /// The current purpose and its group 0.
    pub(crate) fn cast(&self) -> (Purpose, &wgpu::BindGroup) {
        match &self.several {
            Some((_, group)) => (self.purpose(Frames::Several), group),
            None => self.cast_newest(),
        }
    }

    /// The fallback without a pipeline for several frames: the newest alone.
    pub(crate) fn cast_newest(&self) -> (Purpose, &wgpu::BindGroup) {
        (self.purpose(Frames::One), &self.slots[self.shown[0]].bind_group)
    }

    fn purpose(&self, frames: Frames) -> Purpose {
        Purpose::new(frames, self.slots[self.shown[0]].compositing(), &self.options)
    }

    fn bind(&mut self, device: &wgpu::Device) {
        self.several = None;
        let bindable = |&slot: &usize| {
            let frame = &self.slots[slot];
            let buffers = frame.seen_by().and_then(|_| frame.whole_buffers(device))?;
            Some((slot, buffers))
        };
        let Some(newest) = bindable(&self.shown[0]) else { return };
        let older: Vec<_> = self.shown[1..].iter().filter_map(bindable).collect();
        if older.is_empty() {
            return;
        }
        // Bindings of absent frames are never read.
        let unused = std::iter::repeat(&newest);
        let bound = std::iter::once(&newest).chain(&older).chain(unused).take(MAX_FRAMES);
        let mut resources = vec![self.combination.as_entire_binding()];
        resources.extend(bound.flat_map(|(_, buffers)| buffers.clone()));
        let group = bind(device, "frames", self.layouts.of(Frames::Several), &resources);
        let slots = std::iter::once(&newest).chain(&older).map(|(slot, _)| *slot).collect();
        self.several = Some((slots, group));
    }
}
