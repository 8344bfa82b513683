//! Scenes of the shown volume with final shade, which all rendering threads share.
//!
//! While somebody changes the look, the generator makes frames with a draft of the shade. When the look rests, the
//! final shade is computed here, one look at a time for all viewers. Frames use it from then on. A look without shade is
//! computed when it is first shown.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isinglass_core::kernels::march::{LitPage, Scene};
use isinglass_core::look::Look;
use isinglass_core::volume::{Detail, Lit, Page, PageSet, Volume};
use tokio::sync::Semaphore;

use crate::generator::Generator;
use crate::selection::SceneNumber;

/// Clones share the scenes.
#[derive(Clone, Debug)]
pub(crate) struct Lights {
    /// The volume, under any look.
    base: Arc<Scene>,
    /// Known scenes, the newest last.
    known: Arc<Mutex<Vec<(Look, Scene)>>>,
    turns: Arc<Semaphore>,
    /// Held while a rendering thread computes a look without shade.
    computing: Arc<Mutex<()>>,
    /// The newest scene with pages, which shares with the next one what stays.
    paged: Arc<Mutex<Option<Scene>>>,
    /// Whether the volume is read by pages, whose light takes a while.
    is_paged: bool,
}

impl Lights {
    /// A look that shows each value in any volume as this one does.
    pub(crate) fn at_values(&self, look: &Look) -> Look {
        look.at_values(&self.base)
    }

    /// `scene` belongs to `look` and has all of its shade.
    pub(crate) fn new(scene: &Scene, look: &Look, is_paged: bool) -> Self {
        let known = vec![(look.clone(), scene.clone())];
        Self {
            base: Arc::new(scene.clone()),
            known: Arc::new(Mutex::new(known)),
            turns: Arc::new(Semaphore::new(1)),
            computing: Arc::default(),
            paged: Arc::default(),
            is_paged,
        }
    }

    /// The scene that was there first, with its look's shade.
    pub(crate) fn first_scene(&self) -> &Scene {
        &self.base
    }

    pub(crate) fn volume(&self) -> &Volume {
        self.base.whole()
    }

    /// Whether all of a look's shade is there, or it has none.
    pub(crate) fn is_fine(&self, look: &Look) -> bool {
        !(look.lighting.is_on() || self.is_paged) || self.known(look).is_some()
    }

    /// The scene of a look, if known; it becomes the newest.
    pub(crate) fn known(&self, look: &Look) -> Option<Scene> {
        let mut scenes = self.scenes();
        let at = scenes.iter().position(|(known, _)| known.marches_like(look))?;
        scenes[at..].rotate_left(1);
        scenes.last().map(|(_, scene)| scene.clone())
    }

    /// The scene of a look without ambient occlusion and shadows, computed if necessary from the volume under another
    /// look. `None` if the look has any of both.
    pub(crate) fn known_without_shade(&self, look: &Look, from: impl FnOnce() -> Scene) -> Option<Scene> {
        if look.lighting.is_on() || self.is_paged {
            return None;
        }
        // Nobody computes the same meanwhile.
        let _turn = lock(&self.computing);
        self.known(look).or_else(|| {
            let scene = from().under(look, Detail::Final, None);
            remember(&mut self.scenes(), look.clone(), scene.clone());
            Some(scene)
        })
    }

    /// A scene by other pages. What stays is shared with the pages that any thread has shown last.
    pub(crate) fn with_pages(&self, scene: &Scene, set: &Arc<PageSet>) -> Scene {
        // Who comes meanwhile waits, and then finds what both have in common.
        let mut newest = lock(&self.paged);
        let scene = scene.with_pages(set.clone(), newest.as_ref());
        *newest = Some(scene.clone());
        scene
    }

    /// The same for a scene that waits for its light. Pages that are lit for it meanwhile stay noted.
    pub(crate) fn with_dark_pages(&self, scene: &Scene, set: &Arc<PageSet>) -> Scene {
        let newest = lock(&self.paged).clone();
        let scene = scene.with_pages(set.clone(), newest.as_ref());
        let mut newest = lock(&self.paged);
        if newest.as_ref().is_none_or(|newest| !newest.is_seen_like(&scene)) {
            *newest = Some(scene.clone());
        }
        scene
    }

    /// Puts lit pages in the place of those that were shown last, and returns some that the light of `lit` has not
    /// reached.
    pub(crate) fn pages_to_light(&self, lit: &Scene, pages: &[LitPage]) -> Vec<Arc<Page>> {
        let mut newest = lock(&self.paged);
        // Pages under another look have other visible bricks.
        let Some(paged) = newest.as_mut().filter(|paged| paged.is_seen_like(lit)) else { return Vec::new() };
        if !pages.is_empty() {
            *paged = paged.with_lit_pages(pages);
        }
        paged.pages_to_light(lit, PAGES_AT_ONCE)
    }

    /// Forgets the pages that were shown last. A rendering thread may hold them for a while, so another thread waits.
    pub(crate) async fn forget_pages(&self) {
        let paged = self.paged.clone();
        if let Err(e) = tokio::task::spawn_blocking(move || *lock(&paged) = None).await {
            tracing::error!("pages are not forgotten: {e}");
        }
    }

    /// The scene of a look, computed if necessary. `None` if that failed. Pages that the generator shows are lit, too,
    /// before any frame has the scene.
    pub(crate) async fn scene(&self, look: &Look, shown: Option<(&Generator, SceneNumber)>) -> Option<Scene> {
        let turn = self.turns.clone().acquire_owned().await.ok()?;
        if let Some(scene) = self.known(look) {
            return Some(scene);
        }
        let (of, base, known) = (look.clone(), self.base.clone(), self.known.clone());
        let shown = shown.filter(|_| self.is_paged);
        let is_whole = shown.is_none();
        // The requester may leave meanwhile. The result serves the next one, whose turn comes when this has ended.
        let work = tokio::task::spawn_blocking(move || {
            // What the newest look has in common with this one need not be worked out again.
            let newest = lock(&known).last().map_or_else(|| (*base).clone(), |(_, scene)| scene.clone());
            let occlusion = newest.illumination.occlusion();
            let scene = newest.under(&of, Detail::Final, occlusion.as_ref());
            if is_whole {
                remember(&mut lock(&known), of, scene.clone());
            }
            (scene, turn)
        });
        let (scene, _turn) = work.await.inspect_err(|e| tracing::error!("no light: {e}")).ok()?;
        if let Some((generator, number)) = shown {
            generator.light_pages(number, self, &scene).await;
            remember(&mut self.scenes(), look.clone(), scene.clone());
        }
        Some(scene)
    }

    fn scenes(&self) -> MutexGuard<'_, Vec<(Look, Scene)>> {
        lock(&self.known)
    }
}

/// Notes the scene of a look. What was used least lately goes, as far as there is no room.
fn remember(known: &mut Vec<(Look, Scene)>, look: Look, scene: Scene) {
    known.push((look, scene));
    while known.len() > MIN_KNOWN && bytes_of(known) > MAX_BYTES {
        known.remove(0);
    }
}

/// Memory of what scenes do not share, bytes.
fn bytes_of(known: &[(Look, Scene)]) -> usize {
    // Ambient occlusion and shadows take about as much as the brightness that comes of them.
    let cost = |look: &Look, lit: &Lit| lit.shares.len() * if look.lighting.is_on() { 2 } else { 1 };
    let of_scene = |(look, scene): &(Look, Scene)| {
        scene.illumination.lit().map(|lit| (Arc::as_ptr(lit), cost(look, lit)))
    };
    let mut lights: Vec<(*const Lit, usize)> = known.iter().filter_map(of_scene).collect();
    lights.sort_unstable();
    lights.dedup_by_key(|(lit, _)| *lit);
    let lights: usize = lights.iter().map(|(_, bytes)| bytes).sum();
    let occupancy = |scene: &Scene| 4 * (scene.occupancy.words.len() + scene.occupancy.peaks.len());
    let tables: usize = known.iter().map(|(_, scene)| occupancy(scene) + TABLE_BYTES).sum();
    lights + tables
}

/// Every change is one step, so a panic leaves what it guards in order.
fn lock<T>(guarded: &Mutex<T>) -> MutexGuard<'_, T> {
    guarded.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Scenes that are kept in any case, of a byte or two per voxel each.
const MIN_KNOWN: usize = 3;
/// Memory for more of them, bytes. With more looks in use at once, some are computed again.
const MAX_BYTES: usize = 128 << 20;
/// Pages that are lit in a piece, beside the frames.
const PAGES_AT_ONCE: usize = 64;
/// Tables of a scene, bytes.
const TABLE_BYTES: usize = 64 << 10;

#[cfg(test)]
mod tests;
