//! A scene whose volume is read by pages.

use std::collections::HashMap;
use std::sync::Arc;

use rayon::prelude::*;

use super::{MarchedChannel, Scene, modes};
use crate::transfer::TransferTable;
use crate::volume::{
    Bricks, Detail, Lit, Occupancy, Page, PageId, PageRanges, PageSet, Pyramid, PyramidLevel, Volume,
    opacity_table, opacity_volume,
};

/// The pages of a scene, each under the scene's look.
#[derive(Clone, Debug)]
pub struct ScenePages {
    /// The pages.
    pub set: Arc<PageSet>,
    /// What the look makes of each page, in the order of the set.
    pub looks: Vec<Arc<PageLook>>,
    /// What stands for each page of the finest level, x fastest.
    pub table: Arc<[PageCell]>,
    /// The pages of which anything may be seen, if values are known.
    seen: Option<Arc<SeenPages>>,
}

/// What stands for a page of the finest level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PageCell {
    /// The place of a page in the set, or [`NOTHING`].
    pub slot: u32,
    /// The coarsest level whose page around this one has that slot everywhere. A ray marches such a block at once.
    pub block: u8,
}

/// Marks a page of the finest level in which the look shows nothing. No coarser page is shown in its place.
pub const NOTHING: u32 = u32::MAX;

/// A page under a look.
#[derive(Debug)]
pub struct PageLook {
    /// Its bricks that the mode leaves visible.
    pub occupancy: Occupancy,
    /// Whether it has any.
    pub is_visible: bool,
    /// Brightness of its voxels.
    lit: Option<Arc<Lit>>,
    /// The brightness of the coarsest level that the same inputs made.
    lit_for: Option<Arc<Lit>>,
}

impl PageLook {
    /// The brightness of the voxels, if they are lit.
    pub fn lit(&self) -> Option<&Arc<Lit>> {
        self.lit.as_ref()
    }

    /// Whether it is as bright as the inputs of that brightness of the coarsest level make it.
    fn is_lit_for(&self, lit: Option<&Arc<Lit>>) -> bool {
        self.lit_for.as_ref().map(Arc::as_ptr) == lit.map(Arc::as_ptr)
    }
}

/// A page that is lit.
#[derive(Clone, Debug)]
pub struct LitPage {
    page: Arc<Page>,
    look: Arc<PageLook>,
}

impl ScenePages {
    /// Whether every page is lit by the light of that brightness of the coarsest level.
    pub(super) fn are_lit_for(&self, lit: Option<&Arc<Lit>>) -> bool {
        self.looks.iter().all(|look| look.is_lit_for(lit))
    }
}

impl Scene {
    /// The same scene, shown by pages. Its volume is the coarsest level of theirs. What stays is shared with the pages of
    /// `before`, or with its own.
    pub fn with_pages(&self, set: Arc<PageSet>, before: Option<&Self>) -> Self {
        let pages = self.look_at(set, Some(before.unwrap_or(self)));
        Self { pages: Some(pages), ..self.clone() }
    }

    /// The same scene, shown by the volume in memory.
    pub fn without_pages(&self) -> Self {
        Self { pages: None, ..self.clone() }
    }

    /// The same picture without pages, if one level is held whole in their place.
    pub fn of_level(&self) -> Option<Self> {
        let ScenePages { set, looks, .. } = self.pages.as_ref()?;
        let (level, look) = (set.level()?, looks.first()?);
        let volume = |channel: usize| level.channel(channel).clone();
        let others = self.others.iter().cloned();
        Some(Self {
            volume: volume(self.first_channel),
            others: others.map(|other| MarchedChannel { volume: volume(other.channel), ..other }).collect(),
            occupancy: look.occupancy.clone(),
            illumination: self.illumination.with_lit(look.lit.clone()),
            pages: None,
            ..self.clone()
        })
    }

    /// The pages under this scene's look. In a draft, pages keep the brightness that they have in `before`.
    pub(super) fn look_at(&self, set: Arc<PageSet>, before: Option<&Self>) -> ScenePages {
        let with_pages = before.and_then(|before| Some((before, before.pages.as_ref()?)));
        let pages_before = with_pages.map(|(_, pages)| pages.set.pages().iter().zip(&pages.looks));
        let known: HashMap<PageId, (&Arc<Page>, &Arc<PageLook>)> =
            pages_before.into_iter().flatten().map(|(page, look)| (page.id, (page, look))).collect();
        let is_alike = with_pages.is_some_and(|(before, _)| before.is_seen_like(self));
        let look = |page: &Arc<Page>| {
            let known = known.get(&page.id).filter(|(known, _)| Arc::ptr_eq(known, page));
            let known = known.map(|(_, look)| *look);
            match known.filter(|known| is_alike && known.is_lit_for(self.illumination.lit())) {
                Some(known) => known.clone(),
                None => Arc::new(self.look_at_page(page, known.map(|known| (&**known, is_alike)))),
            }
        };
        let looks = set.pages().par_iter().map(look).collect();
        let known = with_pages.filter(|_| is_alike).map(|(_, pages)| pages.seen.clone());
        let seen = known.unwrap_or_else(|| self.seen_pages(&set));
        let table = table_of(&set, seen.as_deref());
        ScenePages { set, looks, table, seen }
    }

    fn seen_pages(&self, set: &PageSet) -> Option<Arc<SeenPages>> {
        let ranges = self.whole().paging()?.ranges.as_ref()?;
        Some(Arc::new(SeenPages::of(set.pyramid(), self, &**ranges)))
    }

    /// A page under this scene's look. `known` is what it was before, and whether the same was visible then.
    fn look_at_page(&self, page: &Page, known: Option<(&PageLook, bool)>) -> PageLook {
        let (own, can_wait) = (self.illumination.lit(), self.settings.detail == Detail::Draft);
        let occupancy = match known.filter(|(_, is_alike)| *is_alike) {
            Some((known, _)) => known.occupancy.clone(),
            None => self.occupancy_of(page),
        };
        let is_nothing = page.are_nothing[self.first_channel];
        let is_visible = !is_nothing && occupancy.words.iter().any(|word| has_zero_byte(*word));
        let known = known.map(|(known, _)| known).filter(|known| known.lit.is_some());
        let (lit, lit_for) = match known {
            _ if own.is_none() => (None, None),
            Some(known) if known.is_lit_for(own) => (known.lit.clone(), own),
            Some(known) if can_wait => (known.lit.clone(), known.lit_for.as_ref()),
            // What nobody sees needs no light.
            _ if !is_visible => (None, own),
            _ => (self.light_of(page).map(Arc::new), own),
        };
        // A march of a lit scene expects light everywhere.
        let is_visible = is_visible && (lit.is_some() || own.is_none());
        PageLook { occupancy, is_visible, lit, lit_for: lit_for.cloned() }
    }

    /// At most `max_pages` of the shown pages that the light of `lit` has not reached.
    pub fn pages_to_light(&self, lit: &Self, max_pages: usize) -> Vec<Arc<Page>> {
        let Some(pages) = &self.pages else { return Vec::new() };
        let all = pages.set.pages().iter().zip(&pages.looks);
        let dark = all.filter(|(_, look)| !look.is_lit_for(lit.illumination.lit()));
        dark.take(max_pages).map(|(page, _)| page.clone()).collect()
    }

    /// Pages under this scene's look, with its light.
    pub fn light_pages(&self, pages: Vec<Arc<Page>>) -> Vec<LitPage> {
        let light = |page: Arc<Page>| LitPage { look: Arc::new(self.look_at_page(&page, None)), page };
        pages.into_iter().map(light).collect()
    }

    /// The same scene with some pages as they were lit elsewhere.
    pub fn with_lit_pages(&self, lit: &[LitPage]) -> Self {
        let Some(pages) = &self.pages else { return self.clone() };
        let lit: HashMap<PageId, &LitPage> = lit.iter().map(|lit| (lit.page.id, lit)).collect();
        let all = pages.set.pages().iter().zip(&pages.looks);
        let newest = |(page, look): (&Arc<Page>, &Arc<PageLook>)| match lit.get(&page.id) {
            Some(lit) if Arc::ptr_eq(&lit.page, page) => lit.look.clone(),
            _ => look.clone(),
        };
        let looks = all.map(newest).collect();
        Self { pages: Some(ScenePages { looks, ..pages.clone() }), ..self.clone() }
    }

    /// The voxels in a page of the channel that is marched first.
    pub(super) fn first_of_page<'a>(&self, page: &'a Page) -> &'a Volume {
        page.channel(self.first_channel)
    }

    /// The voxels in a page of all channels that are mixed, in their order.
    pub(super) fn channels_of_page<'a>(&'a self, page: &'a Page) -> impl Iterator<Item = &'a Volume> {
        self.marched_channels().filter(|_| self.is_mixed()).map(|channel| &**page.channel(channel))
    }

    /// The channels that are marched, the first one first.
    pub fn marched_channels(&self) -> impl Iterator<Item = usize> {
        std::iter::once(self.first_channel).chain(self.others.iter().map(|other| other.channel))
    }

    fn tables(&self) -> impl Iterator<Item = (usize, &TransferTable)> {
        let others = self.others.iter().map(|other| (other.channel, &other.table));
        std::iter::once((self.first_channel, &self.table)).chain(others)
    }

    fn occupancy_of(&self, page: &Page) -> Occupancy {
        if self.is_mixed() {
            let all: Vec<_> = self.tables().map(|(channel, table)| (&page.bricks[channel], table)).collect();
            return Bricks::occupancy_of_channels(&all);
        }
        let bricks = &page.bricks[self.first_channel];
        modes::occupancy(bricks, self.settings.mode, &self.table, &self.surfaces)
    }

    /// Whether any of the marched channels may be seen where its stored numbers are within a range.
    fn sees_values(&self, range: &dyn Fn(usize) -> Option<(f32, f32)>) -> bool {
        self.tables().any(|(channel, table)| {
            range(channel).is_none_or(|(lo, hi)| {
                if self.is_mixed() {
                    table.is_visible(lo, hi)
                } else {
                    modes::is_visible(self.settings.mode, table, &self.surfaces, lo, hi)
                }
            })
        })
    }

    fn light_of(&self, page: &Page) -> Option<Lit> {
        if !self.is_mixed() {
            return self.illumination.of_page(self.first_of_page(page), &self.table);
        }
        let all: Vec<_> = self.tables().map(|(i, table)| (&**page.channel(i), table)).collect();
        let opacities = opacity_volume(&all, self.blend)?;
        self.illumination.of_page(&opacities, &opacity_table(&opacities))
    }

    /// Whether the same values are visible in both.
    pub fn is_seen_like(&self, other: &Self) -> bool {
        (self.settings.mode, self.first_channel, &self.surfaces, self.blend)
            == (other.settings.mode, other.first_channel, &other.surfaces, other.blend)
            && self.tables().eq(other.tables())
    }
}

/// The pages of which anything may be seen under a look, by their known values.
#[derive(Debug)]
pub struct SeenPages {
    /// Pages of each level along x, y, z, and whether each is seen.
    levels: Vec<([u32; 3], Vec<bool>)>,
}

impl SeenPages {
    /// The pages that `scene` leaves visible. A page whose values are unknown may be seen.
    pub fn of(pyramid: &Pyramid, scene: &Scene, ranges: &dyn PageRanges) -> Self {
        let mut levels = Vec::new();
        let grid = pyramid.pages(0);
        let is_seen = |at| scene.sees_values(&|channel| ranges.range(channel, at));
        let finest: Vec<bool> = places(grid).map(is_seen).collect();
        for (level, PyramidLevel { factor, .. }) in pyramid.levels.iter().enumerate() {
            let pages = pyramid.pages(level);
            let index = |[x, y, z]: [u32; 3]| ((z * pages[1] + y) * pages[0] + x) as usize;
            let mut seen = vec![false; pages.iter().map(|n| *n as usize).product()];
            // A page of means has no value that its parts do not enclose.
            for (at, _) in places(grid).zip(&finest).filter(|(_, is_seen)| **is_seen) {
                seen[index(std::array::from_fn(|i| (at[i] / factor[i]).min(pages[i] - 1)))] = true;
            }
            levels.push((pages, seen));
        }
        Self { levels }
    }

    /// Whether anything of a page may be seen.
    pub fn sees(&self, id: PageId) -> bool {
        let Some(([nx, ny, _], seen)) = self.levels.get(usize::from(id.level)) else { return true };
        let [x, y, z] = id.at;
        seen.get(((z * ny + y) * nx + x) as usize).copied().unwrap_or(true)
    }
}

/// What stands for each page of the finest level.
fn table_of(set: &PageSet, seen: Option<&SeenPages>) -> Arc<[PageCell]> {
    let slots = match seen {
        Some(seen) => seen_slots(set, seen),
        None => set.table().to_vec(),
    };
    let blocks = blocks_of(set, &slots);
    slots.into_iter().zip(blocks).map(|(slot, block)| PageCell { slot, block }).collect()
}

/// The slots of a set, with [`NOTHING`] where the look shows nothing: a coarser page would blur neighbouring matter into
/// it. Beside pages that are still coarse, one that is no coarser stays: their matter would be cut off at a face.
fn seen_slots(set: &PageSet, seen: &SeenPages) -> Vec<u32> {
    let cells = || places(set.grid()).map(|at| PageId { level: 0, at });
    let level_of = |slot: u32| set.pages()[slot as usize].id.level;
    let rough = cells().zip(set.rough()).zip(set.table());
    let level_of_rough = |((id, rough), slot): ((PageId, &bool), &u32)| match *rough && seen.sees(id) {
        true => level_of(*slot),
        false => 0,
    };
    let mut near: Vec<u8> = rough.map(level_of_rough).collect();
    for axis in 0..3 {
        let beside = |at: [u32; 3], step: i64| {
            let moved = u32::try_from(i64::from(at[axis]) + step).ok().filter(|n| *n < set.grid()[axis])?;
            let mut beside = at;
            beside[axis] = moved;
            Some(near[set.cell(beside)])
        };
        near = cells().map(|id| (-1..=1).filter_map(|step| beside(id.at, step)).max().unwrap_or(0)).collect();
    }
    let stands = cells().zip(&near).zip(set.table());
    let slot = |((id, near), slot): ((PageId, &u8), &u32)| match seen.sees(id) || level_of(*slot) <= *near {
        true => *slot,
        false => NOTHING,
    };
    stands.map(slot).collect()
}

/// See [`PageCell::block`].
fn blocks_of(set: &PageSet, slots: &[u32]) -> Vec<u8> {
    let (pyramid, grid) = (set.pyramid(), set.grid());
    let mut blocks = vec![0; slots.len()];
    for (level, PyramidLevel { factor, .. }) in pyramid.levels.iter().enumerate().skip(1) {
        let pages = pyramid.pages(level);
        let index = |[x, y, z]: [u32; 3]| ((z * pages[1] + y) * pages[0] + x) as usize;
        let page = |at: [u32; 3]| index(std::array::from_fn(|i| (at[i] / factor[i]).min(pages[i] - 1)));
        // The slot of each page of the level, as long as it has one alone.
        let mut alone: Vec<Option<Option<u32>>> = vec![None; pages.iter().map(|n| *n as usize).product()];
        for (at, slot) in places(grid).zip(slots) {
            let known = &mut alone[page(at)];
            *known = Some(known.map_or(Some(*slot), |known| known.filter(|known| known == slot)));
        }
        if !alone.iter().any(|known| matches!(known, Some(Some(_)))) {
            break;
        }
        let is_alone = |at| matches!(alone[page(at)], Some(Some(_)));
        let marked = places(grid).zip(&mut blocks).filter(|(at, _)| is_alone(*at));
        marked.for_each(|(_, block)| *block = level as u8);
    }
    blocks
}

fn places([nx, ny, nz]: [u32; 3]) -> impl Iterator<Item = [u32; 3]> {
    (0..nz).flat_map(move |z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])))
}

/// Whether one of the four bytes of a word is 0.
fn has_zero_byte(word: u32) -> bool {
    word.to_le_bytes().contains(&0)
}
