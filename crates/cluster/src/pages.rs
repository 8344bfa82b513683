//! Volumes that no memory holds: each process reads the pages of its own part, as far as its memory goes.

use std::sync::Arc;

use isinglass_core::kernels::march::Scene;
use isinglass_core::volume::{PageProgress, PageSet, PageView, PartProgress, PlanKey};
use serde::{Deserialize, Serialize};

use crate::cluster::Cluster;
use crate::exchange::ClusterError;
use crate::jobs::JobCamera;

/// Reads the pages of the own part, and knows how far they are.
pub trait PartReader: Send + Sync {
    /// The pages for a viewer's next frame of a scene, and how far they are. What is missing is read from now on.
    fn pages(&self, key: PlanKey, view: &PageView, scene: &Scene) -> (Arc<PageSet>, PartProgress);

    /// How far the own pages for a viewer are now.
    fn progress(&self, key: PlanKey) -> PartProgress;

    /// The viewers that pages are read for.
    fn viewers(&self) -> Vec<PlanKey>;

    /// Only these viewers are left.
    fn keep(&self, viewers: &[PlanKey]);

    /// Takes note how far the pages of all other processes are for a viewer: now, or in the frame that is being made.
    fn note_others(&self, key: PlanKey, others: PartProgress, in_frame: bool);
}

/// The pages that a scene is shown by.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct PagesOrder {
    key: PlanKey,
    camera: JobCamera,
    rests: bool,
    /// All viewers of process 0.
    viewers: Vec<PlanKey>,
}

impl PagesOrder {
    pub(crate) fn key(&self) -> PlanKey {
        self.key
    }
}

impl Cluster<'_> {
    /// What the other processes must know about the pages of an ordered scene.
    pub(crate) fn pages_order(&self, scene: &Scene) -> Option<PagesOrder> {
        let (key, view) = scene.pages.as_ref()?.set.seen_by()?;
        let PageView { camera, rests, .. } = view;
        let viewers = self.reader.map(PartReader::viewers).unwrap_or_default();
        Some(PagesOrder { key: *key, camera: camera.into(), rests: *rests, viewers })
    }

    /// A scene with the pages of the own part that have arrived, or without pages, and the progress of those.
    pub(crate) fn by_own_pages(&self, scene: &Scene, order: Option<&PagesOrder>) -> (Scene, PartProgress) {
        let (Some(order), Some(reader)) = (order, self.reader) else {
            return (scene.without_pages(), PartProgress::default());
        };
        reader.keep(&order.viewers);
        let view = PageView { camera: order.camera.camera(), region: scene.region(), rests: order.rests };
        let (set, part) = reader.pages(order.key, &view, scene);
        let scene = match &scene.pages {
            Some(shown) if Arc::ptr_eq(&shown.set, &set) => scene.clone(),
            _ => scene.with_pages(set, None),
        };
        (scene, part)
    }

    /// Tells process 0 how far the pages of all others are now. Returns whether any are still to come.
    pub(crate) fn tell_progress(&self, viewers: &[PlanKey]) -> Result<bool, ClusterError> {
        let Some(reader) = self.reader else { return Ok(false) };
        reader.keep(viewers);
        let parts: Vec<_> = viewers.iter().map(|key| (*key, reader.progress(*key))).collect();
        self.tell_parts(&parts, false)
    }

    /// The same for these parts, which are those of the frame that is being made, or of now. Each process gives its own.
    pub(crate) fn tell_parts(
        &self,
        parts: &[(PlanKey, PartProgress)],
        in_frame: bool,
    ) -> Result<bool, ClusterError> {
        let Some(reader) = self.reader else { return Ok(false) };
        let own: Vec<u32> = parts.iter().flat_map(|(_, part)| words_of(*part)).collect();
        let Some(all) = self.exchange().gather(own)? else { return Ok(false) };
        let mut is_loading = false;
        for (place, (key, _)) in parts.iter().enumerate() {
            let parts = all.iter().skip(1).map(|words| part_of(words, place));
            let others = parts.fold(PartProgress::default(), PartProgress::and);
            is_loading |= others.progress.is_loading();
            reader.note_others(*key, others, in_frame);
        }
        Ok(is_loading)
    }

    /// How far the pages of all processes are, in all of them.
    ///
    /// # Errors
    /// If the processes cannot talk.
    pub fn progress_of_all(&self, own: PartProgress) -> Result<PageProgress, ClusterError> {
        let all = self.exchange().all_gather(&words_of(own))?;
        let parts = all.iter().map(|words| part_of(words, 0));
        Ok(parts.fold(PartProgress::default(), PartProgress::and).progress)
    }
}

/// Words that tell how far a part is.
const WORDS: usize = 7;

fn words_of(part: PartProgress) -> [u32; WORDS] {
    let PartProgress { progress, size, version } = part;
    let PageProgress { num_wanted, num_resident, num_damaged, coarse_share } = progress;
    let version = [version as u32, (version >> 32) as u32];
    [num_wanted, num_resident, num_damaged, coarse_share.to_bits(), size.to_bits(), version[0], version[1]]
}

/// The part at a place among words; nothing if there are too few.
fn part_of(words: &[u32], place: usize) -> PartProgress {
    let Some(&[num_wanted, num_resident, num_damaged, coarse, size, low, high]) =
        words.as_chunks::<WORDS>().0.get(place)
    else {
        return PartProgress::default();
    };
    let coarse_share = f32::from_bits(coarse);
    let progress = PageProgress { num_wanted, num_resident, num_damaged, coarse_share };
    let version = u64::from(low) | u64::from(high) << 32;
    PartProgress { progress, size: f32::from_bits(size), version }
}
