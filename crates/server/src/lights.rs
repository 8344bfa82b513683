//! Scenes of the shown volume with final shade, computed beside the rendering thread.
//!
//! While somebody changes the look, the generator makes frames with a draft of the shade. When the look rests, the
//! final shade is computed here, one look at a time for all viewers. Frames use it from then on.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::volume::{Detail, Volume};
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
                keep(&known, of, &scene);
            }
            (scene, turn)
        });
        let (scene, _turn) = work.await.inspect_err(|e| tracing::error!("no light: {e}")).ok()?;
        if let Some((generator, number)) = shown {
            generator.light_pages(number, &scene).await;
            keep(&self.known, look.clone(), &scene);
        }
        Some(scene)
    }

    fn scenes(&self) -> MutexGuard<'_, Vec<(Look, Scene)>> {
        lock(&self.known)
    }
}

/// Keeps a scene as the newest.
fn keep(known: &Mutex<Vec<(Look, Scene)>>, look: Look, scene: &Scene) {
    let mut known = lock(known);
    if known.len() == MAX_KNOWN {
        known.remove(0);
    }
    known.push((look, scene.clone()));
}

/// Every change is one step, so a panic leaves the list in order.
fn lock(known: &Mutex<Vec<(Look, Scene)>>) -> MutexGuard<'_, Vec<(Look, Scene)>> {
    known.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Scenes that are kept, of a byte or two per voxel each. With more looks in use at once, some are computed again.
const MAX_KNOWN: usize = 3;
