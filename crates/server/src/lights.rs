//! Scenes of the volume that is shown, whose shade is worked out for the picture that stays, beside the thread that makes frames.
//!
//! While somebody changes the look, frames are made with a draft of the shade, on the generator's thread. When the look
//! rests, the fine one is worked out here, one at a time whoever asks, and frames take it from then on.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::mode::{Isos, Mode};
use isinglass_core::volume::Volume;
use tokio::sync::Semaphore;

/// Clones share the scenes.
#[derive(Clone, Debug)]
pub(crate) struct Lights {
    /// The volume, under any look.
    base: Arc<Scene>,
    /// The newest last.
    known: Arc<Mutex<Vec<(Look, Scene)>>>,
    turns: Arc<Semaphore>,
}

impl Lights {
    /// A look that shows each value in any volume as it does in this one.
    pub(crate) fn at_values(&self, look: &Look) -> Look {
        let Scene { volume, histogram, .. } = &*self.base;
        let isos = match look.mode {
            Mode::Iso if look.isos.as_slice().is_empty() => Isos::one(histogram.parting_value()),
            _ => look.isos,
        };
        Look { transfer: look.transfer.at_values(volume, histogram), isos, ..look.clone() }
    }

    /// `scene` is that of `look`, with all of its shade.
    pub(crate) fn new(scene: &Scene, look: &Look) -> Self {
        let known = vec![(look.clone(), scene.clone())];
        Self {
            base: Arc::new(scene.clone()),
            known: Arc::new(Mutex::new(known)),
            turns: Arc::new(Semaphore::new(1)),
        }
    }

    /// The volume.
    pub(crate) fn volume(&self) -> &Volume {
        &self.base.volume
    }

    /// Whether all of the shade of a look is there, or it has none.
    pub(crate) fn is_fine(&self, look: &Look) -> bool {
        !look.lighting.is_on() || self.known(look).is_some()
    }

    /// The scene of a look, if it is there. It was used last, then.
    pub(crate) fn known(&self, look: &Look) -> Option<Scene> {
        let mut scenes = self.scenes();
        let at = scenes.iter().position(|(known, _)| known.marches_like(look))?;
        scenes[at..].rotate_left(1);
        scenes.last().map(|(_, scene)| scene.clone())
    }

    /// The scene of a look, worked out if it is not there yet. `None` if that failed.
    pub(crate) async fn scene(&self, look: &Look) -> Option<Scene> {
        let turn = self.turns.clone().acquire_owned().await.ok()?;
        if let Some(scene) = self.known(look) {
            return Some(scene);
        }
        let (look, base, known) = (look.clone(), self.base.clone(), self.known.clone());
        // Whoever asked may have gone meanwhile; what is found serves the next, whose turn comes when this one has ended.
        let work = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            let scene = base.with_look(&look.transfer, look.march_settings());
            let mut known = lock(&known);
            if known.len() == MAX_KNOWN {
                known.remove(0);
            }
            known.push((look, scene.clone()));
            scene
        });
        work.await.inspect_err(|e| tracing::error!("no light: {e}")).ok()
    }

    fn scenes(&self) -> MutexGuard<'_, Vec<(Look, Scene)>> {
        lock(&self.known)
    }
}

/// Every change is one step.
fn lock(known: &Mutex<Vec<(Look, Scene)>>) -> MutexGuard<'_, Vec<(Look, Scene)>> {
    known.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Looks that are kept, of a byte or two a voxel each: with more of them in use at once, some are worked out again.
const MAX_KNOWN: usize = 3;
