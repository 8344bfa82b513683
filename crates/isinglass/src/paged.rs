//! Pictures of volumes that are read by pages: each waits until all pages of its view are there.

use anyhow::{Result, bail};
use isinglass_bench::progress::note;
use isinglass_core::camera::Camera;
use isinglass_core::kernels::march::Scene;
use isinglass_core::layer::Fineness;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::volume::{PageProgress, PageView};
use isinglass_gpu::GpuError;
use isinglass_render::Renderer;
use isinglass_server::{FramePages, Pager};

/// The pages of a command's volume, if it has any.
pub(crate) struct Pages(Option<Pager>);

impl Pages {
    /// Starts to read the pages of a scene's volume.
    pub(crate) fn of(scene: &Scene) -> Result<Self> {
        Ok(Self(Pager::of(scene.whole())?))
    }

    /// The finest pages for a camera that fit into memory, when they are there.
    pub(crate) fn settled(&self, scene: &Scene, camera: &Camera) -> Option<FramePages> {
        let view = PageView { camera: *camera, region: scene.region(), rests: true };
        self.0.as_ref().map(|pager| pager.settled(ViewerId(0), &view, scene, &|| true))
    }

    /// Shows a camera the finest pages that fit into memory. A note says what is not of the finest level.
    pub(crate) fn show(&self, renderer: &mut Renderer, camera: &Camera) -> Result<Fineness> {
        let scene = renderer.scene().without_pages();
        let (Some(pager), Some(mut pages)) = (&self.0, self.settled(&scene, camera)) else {
            return Ok(Fineness::Whole);
        };
        let mut shown = renderer.set_scene(scene.with_pages(pages.set.clone(), None));
        while let Err(GpuError::Pages { most }) = shown
            && pager.limit(most)
        {
            pages = self.settled(&scene, camera).unwrap_or(pages);
            shown = renderer.set_scene(scene.with_pages(pages.set.clone(), None));
        }
        shown?;
        check(&pages.part.progress, true)
    }
}

/// Checks that there is something to see, and returns how fine it is. A note says what is not of the finest level.
pub(crate) fn check(progress: &PageProgress, says_notes: bool) -> Result<Fineness> {
    if progress.num_wanted > 0 && progress.num_resident == 0 {
        bail!("none of the {} parts that the view needs can be read", progress.num_wanted);
    }
    if progress.coarse_share > 0.0 && says_notes {
        let percent = (progress.coarse_share * 100.0).ceil();
        note(&format!("note: {percent} % of the view is coarser than the file; --max-memory allows more"));
    }
    if progress.num_damaged > 0 && says_notes {
        note(&format!("note: {} parts of the file cannot be read", progress.num_damaged));
    }
    Ok(if progress.is_exact() { Fineness::Whole } else { Fineness::Bounded })
}
