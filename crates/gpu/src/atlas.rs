//! The texels of pages in textures with slots, which are reused, and what a march finds them by. Kernel:
//! `shaders/march/pages.wgsl`.

use std::collections::HashMap;
use std::sync::{Arc, Weak};

use isinglass_core::kernels::march::{NOTHING, PageCell, PageLook, Scene, ScenePages};
use isinglass_core::volume::{BRICK, Lit, PAGE_POINTS, Page, PageSet};

use crate::device::Gpu;
use crate::error::GpuError;
use crate::gpu_types::PageField;
use crate::scene::Texels;
use crate::textures::{Place, Staging, bytes_of, format_of, texture, view};

/// The slots. They keep what earlier scenes have shown, as long as there is room: viewers take turns.
pub(crate) struct Atlas {
    slots: Vec<Slot>,
    /// Most slots, by the device's limits or by its memory.
    pub(crate) most: usize,
    textures: Textures,
    /// Occupancy of each slot; table and fields of the scene's pages.
    buffers: Option<[wgpu::Buffer; 3]>,
    /// Counts the scenes.
    turn: u64,
    /// Pretends that the device has memory for so many slots of all textures together.
    #[cfg(test)]
    pub(crate) most_of_all: Option<usize>,
}

/// Textures with the same slots.
#[derive(Clone, Default)]
struct Textures {
    /// By the channel's number.
    channels: Vec<(usize, wgpu::Texture)>,
    shares: Option<wgpu::Texture>,
    /// Of one channel.
    gaps: Option<(usize, wgpu::Texture)>,
}

/// What a slot has in it.
#[derive(Default)]
struct Slot {
    page: Weak<Page>,
    /// The textures of channels that have it, by their place.
    channels: Vec<bool>,
    has_gaps: bool,
    lit: Weak<Lit>,
    /// The look whose occupancy is there.
    look: Weak<PageLook>,
    /// When it was shown last.
    turn: u64,
}

/// A page that may be seen, and its place in the set.
struct Seen<'a> {
    place: usize,
    page: &'a Arc<Page>,
    look: &'a Arc<PageLook>,
}

impl Atlas {
    pub(crate) fn new(gpu: &Gpu) -> Self {
        // A texture of 2048 texels a side has them on every device.
        let widest = gpu.device().limits().max_texture_dimension_3d / PAGE_POINTS;
        let most = (SLOTS_A_SIDE * SLOTS_A_SIDE * widest) as usize;
        Self {
            slots: Vec::new(),
            most,
            textures: Textures::default(),
            buffers: None,
            turn: 0,
            #[cfg(test)]
            most_of_all: None,
        }
    }

    /// Uploads what is new of a scene's pages.
    ///
    /// # Errors
    /// [`GpuError::Pages`] if the device has too little memory for them.
    pub(crate) fn show(&mut self, gpu: &Gpu, scene: &Scene, pages: &ScenePages) -> Result<(), GpuError> {
        self.turn += 1;
        let all = pages.set.pages().iter().zip(&pages.looks).enumerate();
        let seen = all.filter(|(_, (_, look))| look.is_visible);
        let seen: Vec<_> = seen.map(|(place, (page, look))| Seen { place, page, look }).collect();
        if seen.len() > self.slots.len() || !self.complete(gpu, scene, &seen)? {
            self.grow(gpu, scene, &seen)?;
        }
        let slots = self.assign(&seen)?;
        self.upload(gpu, scene, &seen, &slots)?;
        self.write_fields(gpu, pages, scene, &seen, &slots);
        Ok(())
    }

    /// Makes the textures that the slots lack, such as another channel's. Returns false if there is no memory for them:
    /// then no slot stays, and fewer may follow.
    fn complete(&mut self, gpu: &Gpu, scene: &Scene, seen: &[Seen<'_>]) -> Result<bool, GpuError> {
        let mut textures = self.textures.clone();
        let mut slots = std::mem::take(&mut self.slots);
        let made = self.make(gpu, scene, seen, &mut slots, &mut textures);
        match made {
            Err(GpuError::OutOfMemory(_)) => {
                self.most = fewer(slots.len());
                self.clear(gpu)?;
                Ok(false)
            }
            made => {
                (self.slots, self.textures) = (slots, textures);
                made.map(|()| true)
            }
        }
    }

    /// Makes the textures that a scene needs and that are not there.
    fn make(
        &self,
        gpu: &Gpu,
        scene: &Scene,
        seen: &[Seen<'_>],
        slots: &mut [Slot],
        textures: &mut Textures,
    ) -> Result<(), GpuError> {
        let what = "making room for pages";
        gpu.attempt(what, || {
            textures.complete(gpu, scene, seen, slots);
            #[cfg(test)]
            if self.most_of_all.is_some_and(|most| textures.all().count() * slots.len() > most) {
                return Err(GpuError::OutOfMemory(what));
            }
            Ok(())
        })
    }

    /// Forgets all pages, and frees their memory at once.
    fn clear(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        gpu.wait("making room for pages")?;
        // What is bound to them is not used any more.
        self.textures.all().for_each(wgpu::Texture::destroy);
        (self.textures, self.slots) = Default::default();
        Ok(())
    }

    /// Makes room for so many pages. The textures begin empty.
    fn grow(&mut self, gpu: &Gpu, scene: &Scene, seen: &[Seen<'_>]) -> Result<(), GpuError> {
        let needed = seen.len();
        if needed > self.most {
            return Err(GpuError::Pages { most: self.most });
        }
        let mut num = (self.slots.len() * 2).max(needed).max(LEAST_SLOTS).min(self.most);
        self.clear(gpu)?;
        loop {
            let mut slots = Vec::new();
            slots.resize_with(num, Slot::default);
            let mut textures = Textures::default();
            match self.make(gpu, scene, seen, &mut slots, &mut textures) {
                Ok(()) => (self.slots, self.textures) = (slots, textures),
                Err(GpuError::OutOfMemory(_)) if num > LEAST_SLOTS => {
                    num = fewer(num);
                    self.most = num;
                    continue;
                }
                Err(e) => return Err(e),
            }
            return if num < needed { Err(GpuError::Pages { most: num }) } else { Ok(()) };
        }
    }

    /// A slot for each page: its own, or one that has not been shown for the longest time.
    fn assign(&mut self, seen: &[Seen<'_>]) -> Result<Vec<usize>, GpuError> {
        let known = self.slots.iter().enumerate().filter(|(_, slot)| slot.page.strong_count() > 0);
        let known: HashMap<*const Page, usize> = known.map(|(i, slot)| (slot.page.as_ptr(), i)).collect();
        let found: Vec<_> = seen.iter().map(|seen| known.get(&Arc::as_ptr(seen.page)).copied()).collect();
        for slot in found.iter().flatten() {
            self.slots[*slot].turn = self.turn;
        }
        let mut free: Vec<usize> =
            (0..self.slots.len()).filter(|i| self.slots[*i].turn != self.turn).collect();
        free.sort_by_key(|i| {
            let Slot { page, turn, .. } = &self.slots[*i];
            (page.strong_count() > 0, *turn)
        });
        let mut free = free.into_iter();
        let slots = found.into_iter().zip(seen).map(|(found, seen)| {
            found.or_else(|| {
                let slot = free.next()?;
                self.slots[slot] =
                    Slot { page: Arc::downgrade(seen.page), turn: self.turn, ..Slot::default() };
                Some(slot)
            })
        });
        let slots: Option<Vec<usize>> = slots.collect();
        slots.ok_or(GpuError::Pages { most: self.slots.len() })
    }

    /// Writes texels, shares of light and occupancy as far as the slots have others.
    fn upload(
        &mut self,
        gpu: &Gpu,
        scene: &Scene,
        seen: &[Seen<'_>],
        slots: &[usize],
    ) -> Result<(), GpuError> {
        let occupancy_bytes = self.slots.len() as u64 * u64::from(2 * PAGE_WORDS * 4);
        gpu.check_binding("occupancy in bytes", occupancy_bytes)?;
        let new = || ["occupancy", "page table", "page fields"].map(|label| gpu.storage(label, 16));
        let [occupancy, ..] = self.buffers.get_or_insert_with(new);
        if occupancy.size() < occupancy_bytes {
            *occupancy = gpu.storage("occupancy", occupancy_bytes);
            self.slots.iter_mut().for_each(|slot| slot.look = Weak::new());
        }
        let Textures { channels, shares, gaps } = &self.textures;
        let mut staging = Staging::default();
        for (Seen { page, look, .. }, &number) in seen.iter().zip(slots) {
            let slot = &mut self.slots[number];
            let place = Place { first: slot_origin(number), dims: [PAGE_POINTS; 3] };
            slot.channels.resize(channels.len(), false);
            for channel in scene.marched_channels() {
                let Some(at) = channels.iter().position(|(known, _)| *known == channel) else { continue };
                if !std::mem::replace(&mut slot.channels[at], true) {
                    staging.write(gpu, &channels[at].1, &place, bytes_of(page.channel(channel)))?;
                }
            }
            if let (Some(lit), Some(shares)) = (look.lit(), shares)
                && !std::ptr::eq(slot.lit.as_ptr(), Arc::as_ptr(lit))
            {
                staging.write(gpu, shares, &place, &lit.shares)?;
                slot.lit = Arc::downgrade(lit);
            }
            if let Some((channel, gaps)) = gaps
                && !std::mem::replace(&mut slot.has_gaps, true)
            {
                let volume = page.channel(*channel);
                let none = if volume.gaps().is_none() { vec![0; volume.voxels().len()] } else { Vec::new() };
                let bytes = volume.gaps().map_or(&none, |gaps| &gaps.bytes);
                staging.write(gpu, gaps, &place, bytes)?;
            }
            if !std::ptr::eq(slot.look.as_ptr(), Arc::as_ptr(look)) {
                gpu.queue().write_buffer(
                    occupancy,
                    u64::from(first_word(number)) * 4,
                    bytemuck::cast_slice(&occupancy_words(look)),
                );
                slot.look = Arc::downgrade(look);
            }
        }
        Ok(())
    }

    /// Writes the table, and a field for each page of the set.
    fn write_fields(
        &mut self,
        gpu: &Gpu,
        pages: &ScenePages,
        scene: &Scene,
        seen: &[Seen<'_>],
        slots: &[usize],
    ) {
        let set = &*pages.set;
        let mut fields: Vec<PageField> = set.pages().iter().map(|page| field_of(set, page)).collect();
        for (Seen { place, page, look }, &slot) in seen.iter().zip(slots) {
            let level = set.pyramid().level(page.id);
            let first_point = set.pyramid().first_point(page.id);
            let (origin, field) = (slot_origin(slot), &mut fields[*place]);
            let lit = look.lit().or_else(|| scene.illumination.lit());
            (field.ambient, field.diffuse) = lit.map_or((1.0, 0.0), |lit| (lit.ambient, lit.diffuse));
            for axis in 0..3 {
                field.offset[axis] += origin[axis] as f32 - first_point[axis] as f32;
                field.first[axis] = origin[axis] as i32;
                let side = PAGE_POINTS.min(level.dims[axis] - first_point[axis]);
                field.last[axis] = (origin[axis] + side - 1) as i32;
            }
            (field.first_word, field.is_visible) = (first_word(slot), 1);
        }
        let table: Vec<[u32; 2]> = pages.table.iter().map(|cell| entry_of(set, *cell)).collect();
        let Some([_, table_buffer, fields_buffer]) = &mut self.buffers else { return };
        let contents: [&[u8]; 2] = [bytemuck::cast_slice(&table), bytemuck::cast_slice(&fields)];
        for (buffer, bytes) in [table_buffer, fields_buffer].into_iter().zip(contents) {
            if buffer.size() < bytes.len() as u64 {
                *buffer = gpu.storage("pages", (bytes.len() as u64).next_power_of_two());
            }
            gpu.queue().write_buffer(buffer, 0, bytes);
        }
    }

    /// What a march of the scene that was shown last reads.
    pub(crate) fn texels(&self, gpu: &Gpu, scene: &Scene) -> Result<Texels<'_>, GpuError> {
        let Textures { channels, shares, gaps } = &self.textures;
        let of = |channel| channels.iter().find(|(known, _)| *known == channel);
        let [occupancy, table, fields] = self.buffers.as_ref().ok_or(GpuError::Pages { most: 0 })?;
        let plain = || texture(gpu, [1; 3], wgpu::TextureFormat::R8Uint);
        Ok(Texels {
            occupancy,
            channels: scene.marched_channels().filter_map(of).map(|(_, texture)| view(texture)).collect(),
            shares: shares.as_ref().map_or_else(|| view(&plain()), view),
            gaps: gaps.as_ref().map(|(_, texture)| view(texture)),
            pages: Some([table, fields]),
        })
    }
}

impl Textures {
    fn all(&self) -> impl Iterator<Item = &wgpu::Texture> {
        let channels = self.channels.iter().map(|(_, texture)| texture);
        let gaps = self.gaps.iter().map(|(_, texture)| texture);
        channels.chain(&self.shares).chain(gaps)
    }

    /// Makes the textures that a scene needs and that are not there, for these slots.
    fn complete(&mut self, gpu: &Gpu, scene: &Scene, seen: &[Seen<'_>], slots: &mut [Slot]) {
        let dims = slot_dims(slots.len()).map(|n| n * PAGE_POINTS);
        for (channel, volume) in scene.marched_channels().zip(scene.marched_volumes()) {
            if !self.channels.iter().any(|(known, _)| *known == channel) {
                self.channels.push((channel, texture(gpu, dims, format_of(volume))));
            }
        }
        let bytes = wgpu::TextureFormat::R8Uint;
        if scene.illumination.lit().is_some() && self.shares.is_none() {
            self.shares = Some(texture(gpu, dims, bytes));
        }
        let first = scene.first_channel;
        let has_gaps = |seen: &Seen<'_>| seen.page.channel(first).gaps().is_some();
        let are_known = self.gaps.as_ref().is_some_and(|(known, _)| *known == first);
        // Once there are gaps, the kernel that reads them stays.
        if !are_known && (scene.volume.gaps().is_some() || seen.iter().any(has_gaps)) {
            self.gaps = Some((first, texture(gpu, dims, bytes)));
            slots.iter_mut().for_each(|slot| slot.has_gaps = false);
        } else if !are_known {
            self.gaps = None;
        }
    }
}

/// The entry of a cell in the table: its page with the level above [`LEVEL_SHIFT`], and the binary logarithms of its
/// block's sides, a byte each.
fn entry_of(set: &PageSet, cell: PageCell) -> [u32; 2] {
    let page = set.pages().get(cell.slot as usize);
    let slot = page.map_or(NOTHING, |page| cell.slot | u32::from(page.id.level) << LEVEL_SHIFT);
    let factor = set.pyramid().levels[usize::from(cell.block)].factor;
    let shifts = [0, 1, 2].map(|i| factor[i].ilog2() << (8 * i));
    [slot, shifts[0] | shifts[1] | shifts[2]]
}

/// The field of a page of which nothing is seen.
fn field_of(set: &PageSet, page: &Page) -> PageField {
    let (scale, offset) = set.pyramid().level(page.id).place();
    PageField { scale: scale.into(), offset: offset.into(), ..bytemuck::Zeroable::zeroed() }
}

/// The distances and the peaks of a page. Without peaks, every brick may hold the greatest key.
fn occupancy_words(look: &PageLook) -> Vec<u32> {
    let [mut words, mut peaks] = [&look.occupancy.words, &look.occupancy.peaks].map(|words| words.to_vec());
    words.resize(PAGE_WORDS as usize, 0);
    peaks.resize(PAGE_WORDS as usize, u32::MAX);
    [words, peaks].concat()
}

/// Slots along x, y, z of textures with room for so many. They are narrow, as software devices keep rows one after
/// another: so the texels of a page lie near each other.
fn slot_dims(num: usize) -> [u32; 3] {
    let num = num as u32;
    let z = num.clamp(1, SLOTS_A_SIDE);
    let y = num.div_ceil(z).min(SLOTS_A_SIDE);
    [num.div_ceil(y * z), y, z]
}

/// Slots for the next attempt, after so many had no memory.
fn fewer(num: usize) -> usize {
    (num / 4 * 3).max(LEAST_SLOTS)
}

/// The first texel of a slot.
fn slot_origin(slot: usize) -> [u32; 3] {
    let slot = slot as u32;
    [slot / SLOTS_A_SIDE / SLOTS_A_SIDE, slot / SLOTS_A_SIDE % SLOTS_A_SIDE, slot % SLOTS_A_SIDE]
        .map(|i| i * PAGE_POINTS)
}

/// Where the occupancy of a slot begins, words.
fn first_word(slot: usize) -> u32 {
    slot as u32 * 2 * PAGE_WORDS
}

/// Slots along the shorter sides of the textures.
const SLOTS_A_SIDE: u32 = 2048 / PAGE_POINTS;
/// Slots that are worth having.
const LEAST_SLOTS: usize = 64;
/// Where the level begins in an entry of the table, bits.
const LEVEL_SHIFT: u32 = 24;
/// Bricks along the side of a page.
const PAGE_BRICKS: u32 = 9;
/// Words of the distances, and of the peaks, of a page's bricks.
const PAGE_WORDS: u32 = 183;
const _: () = assert!(PAGE_BRICKS == PAGE_POINTS.div_ceil(BRICK));
const _: () = assert!(PAGE_WORDS == (PAGE_BRICKS * PAGE_BRICKS * PAGE_BRICKS).div_ceil(4));

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::camera::{Camera, Intrinsics, Pose};
    use isinglass_core::kernels::march::MarchSettings;
    use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
    use isinglass_core::volume::procedural::Builtin;
    use isinglass_core::volume::{PageId, Pyramid, Volume, VolumeInfo, Voxels};

    use super::*;
    use crate::march::GpuRenderer;

    #[test]
    fn slots_do_not_overlap_and_lie_inside() {
        for num in [1, 29, 30, 841, 842, 2000] {
            let dims = slot_dims(num).map(|n| n * PAGE_POINTS);
            let mut seen = std::collections::BTreeSet::new();
            for slot in 0..num {
                let origin = slot_origin(slot);
                assert!((0..3).all(|i| origin[i] + PAGE_POINTS <= dims[i]), "{slot} of {num}");
                assert!(seen.insert(origin), "{slot} of {num}");
            }
        }
    }

    fn ramp() -> TransferFunction {
        let point = |x, opacity| ControlPoint { x, color: [0.9, 0.8, 0.5], opacity };
        TransferFunction {
            name: "ramp".into(),
            domain: Domain::Full,
            unit_length: UnitLength::Voxel,
            points: vec![point(0.0, 0.0), point(1.0, 0.1)],
        }
    }

    #[test]
    fn too_many_pages_are_refused_and_fewer_are_shown() {
        let Ok(gpu) = Gpu::open() else {
            eprintln!("skipped: no device");
            return;
        };
        let volume = Arc::new(Builtin::Cloud.volume(140));
        let transfer = ramp();
        let base = Scene::new(volume.clone(), &transfer, MarchSettings::default());
        let pyramid = Arc::new(Pyramid::of(&volume));
        let pages = pyramid.base_pages(&volume).unwrap();
        assert_eq!(pages.len(), 27);
        let set =
            |is_shown: fn(PageId) -> bool| Arc::new(PageSet::new(pyramid.clone(), pages.clone(), is_shown));
        let all = base.with_pages(set(|_| true), None);
        let bounds = volume.bounds();
        let pose = Pose::orbit(bounds.center(), 0.4, 0.3, 3.0 * bounds.radius());
        let camera = Camera::new(pose, Intrinsics::perspective(32, 32, 0.7), &bounds);
        let mut renderer = GpuRenderer::new(&gpu, base).unwrap();
        let whole = renderer.render(&camera).unwrap();
        renderer.limit_pages(20);
        let refused = renderer.set_scene(all.clone());
        assert!(matches!(refused, Err(GpuError::Pages { most: 20 })), "{refused:?}");
        // What is in memory is still shown.
        assert_eq!(renderer.render(&camera).unwrap().pixels, whole.pixels);
        assert!(renderer.scene().pages.is_none());
        // Negative control: with room for them they are shown.
        renderer.limit_pages(27);
        renderer.set_scene(all).unwrap();
        assert!(renderer.scene().pages.is_some());
    }

    /// The light of a look needs a texture more. Without memory for it, there are fewer slots; the device is not lost.
    #[test]
    fn another_texture_without_memory_costs_slots_and_not_the_device() {
        let Ok(gpu) = Gpu::open() else {
            eprintln!("skipped: no device");
            return;
        };
        // The pages are 5 × 5 × 3.
        let (dims, info) = ([280, 280, 190], VolumeInfo::default());
        let voxels = Voxels::U8((0..280 * 280 * 190).map(|i| (i % 255 + 1) as u8).collect());
        let volume = Arc::new(Volume::new(dims, Vec3::ONE, voxels, (1.0, 0.0), info).unwrap());
        let pyramid = Arc::new(Pyramid::of(&volume));
        let pages = pyramid.base_pages(&volume).unwrap();
        assert!(pages.len() > LEAST_SLOTS, "{}", pages.len());
        let scene = |is_lit: bool| {
            let shading = is_lit.then(Default::default);
            let settings = MarchSettings { shading, ..MarchSettings::default() };
            let set = Arc::new(PageSet::new(pyramid.clone(), pages.clone(), |_| true));
            Scene::new(volume.clone(), &ramp(), settings).with_pages(set, None)
        };
        let mut renderer = GpuRenderer::new(&gpu, scene(false).without_pages()).unwrap();
        let num = pages.len();
        for (most_of_all, has_room) in [(2 * num, true), (2 * num - 1, false)] {
            renderer.atlas().clear(&gpu).unwrap();
            renderer.atlas().most_of_all = Some(most_of_all);
            renderer.limit_pages(num);
            renderer.set_scene(scene(false)).unwrap();
            let lit = renderer.set_scene(scene(true));
            let most = fewer(num);
            let refused = Err(GpuError::Pages { most });
            assert_eq!(lit, if has_room { Ok(()) } else { refused }, "{most_of_all}");
            assert_eq!(renderer.scene().pages.is_some(), has_room);
            renderer.set_scene(scene(false).without_pages()).unwrap();
        }
    }
}
