//! Full volume rendering and layered frames of one scene on the GPU. Kernels: `shaders/march.wgsl`,
//! `shaders/render.wgsl`, `shaders/layering/`.

use std::ops::Range;

use isinglass_core::camera::Camera;
use isinglass_core::cancel::{ALWAYS, Wanted};
use isinglass_core::kernels::layering::budget::Budget;
use isinglass_core::kernels::layering::parts::Gathered;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::Scene;
use isinglass_core::kernels::part_rays::{PartRay, RayItems};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;

use crate::device::Gpu;
use crate::error::GpuError;
use crate::layering::FrameTarget;
use crate::parts::GatherTarget;
use crate::picture_target::PictureTarget;
use crate::scene::SceneOnGpu;
use crate::shaders::{Extent, Kernel};

/// A scene on the GPU and its drawing buffers, which are kept between pictures.
pub struct GpuRenderer {
    gpu: Gpu,
    scene: Scene,
    on_gpu: SceneOnGpu,
    picture: PictureTarget,
    frame: Option<FrameTarget>,
    gathered: Option<GatherTarget>,
    budget: Budget,
}

impl GpuRenderer {
    /// Uploads a scene.
    pub fn new(gpu: &Gpu, scene: Scene) -> Result<Self, GpuError> {
        let on_gpu = SceneOnGpu::new(gpu, &scene)?;
        let picture = gpu.attempt("making buffers", || Ok(PictureTarget::new(gpu)))?;
        Ok(Self {
            gpu: gpu.clone(),
            scene,
            on_gpu,
            picture,
            frame: None,
            gathered: None,
            budget: Budget::default(),
        })
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Replaces the scene. Voxels and pages are uploaded only if they are new. A scene with more pages than the device
    /// has memory for is shown by its coarsest level, and [`GpuError::Pages`] tells how many there may be.
    pub fn set_scene(&mut self, scene: Scene) -> Result<(), GpuError> {
        self.budget.forget();
        let set = self.on_gpu.set(&self.gpu, &scene);
        if matches!(set, Err(GpuError::Pages { .. })) {
            self.scene = scene.without_pages();
            self.on_gpu.set(&self.gpu, &self.scene)?;
        } else if set.is_ok() {
            self.scene = scene;
        }
        set
    }

    /// Pretends that the device has memory for so many pages.
    #[cfg(test)]
    pub(crate) fn limit_pages(&mut self, most: usize) {
        self.atlas().most = most;
    }

    /// The atlas of pages, for tests of its limits.
    #[cfg(test)]
    pub(crate) fn atlas(&mut self) -> &mut crate::atlas::Atlas {
        self.on_gpu.atlas.get_or_insert_with(|| crate::atlas::Atlas::new(&self.gpu))
    }

    /// See [`isinglass_core::kernels::march::render`].
    pub fn render(&mut self, camera: &Camera) -> Result<Picture, GpuError> {
        if !camera.is_valid() {
            return Err(GpuError::Camera);
        }
        self.render_view(&camera.into())
    }

    /// See [`isinglass_core::kernels::march::render_rows`].
    pub fn render_rows(&mut self, camera: &Camera, rows: Range<u32>) -> Result<Picture, GpuError> {
        if !camera.is_valid() {
            return Err(GpuError::Camera);
        }
        let Self { gpu, on_gpu, picture, .. } = self;
        gpu.attempt("rendering", || {
            let pipeline = gpu.pipeline(Kernel::Render(on_gpu.purpose, Extent::Opaque), "render");
            picture.draw_rows(gpu, &pipeline, &on_gpu.bind_group, &camera.into(), on_gpu.max_steps, rows)
        })
    }

    /// The same for a view that may be off-axis.
    pub fn render_view(&mut self, view: &View) -> Result<Picture, GpuError> {
        self.render_to(view, Extent::Opaque)
    }

    /// See [`isinglass_core::kernels::march::render_through`].
    pub fn render_through(&mut self, camera: &Camera) -> Result<Picture, GpuError> {
        if !camera.is_valid() {
            return Err(GpuError::Camera);
        }
        self.render_to(&camera.into(), Extent::Through)
    }

    fn render_to(&mut self, view: &View, extent: Extent) -> Result<Picture, GpuError> {
        let Self { gpu, on_gpu, picture, .. } = self;
        gpu.attempt("rendering", || {
            let pipeline = gpu.pipeline(Kernel::Render(on_gpu.purpose, extent), "render");
            picture.draw(gpu, &pipeline, &on_gpu.bind_group, view, on_gpu.max_steps)
        })
    }

    /// Gathers along rays of a view, for [`isinglass_core::kernels::layering::parts`].
    ///
    /// # Errors
    /// If the device fails, or the view is none.
    pub fn gather(&mut self, view: &View, rays: &[PartRay], what: Gathered) -> Result<RayItems, GpuError> {
        let Self { gpu, on_gpu, gathered, .. } = self;
        gpu.attempt("gathering along rays", || {
            let target = gathered.get_or_insert_with(|| GatherTarget::new(gpu));
            target.gather(gpu, on_gpu, view, rays, what)
        })
    }

    /// See [`isinglass_core::kernels::layering::generate`].
    pub fn generate(&mut self, header: FrameHeader) -> Result<LayeredFrame, GpuError> {
        self.budget.forget();
        Ok(self.generate_while(header, ALWAYS)?.unwrap_or_else(|| LayeredFrame::empty(header)))
    }

    /// The same for successive frames; `None` when the frame is no longer wanted, which a slow device checks between
    /// passes. See [`isinglass_core::kernels::layering::generate_while`].
    pub fn generate_while(
        &mut self,
        header: FrameHeader,
        wanted: Wanted<'_>,
    ) -> Result<Option<LayeredFrame>, GpuError> {
        let Self { gpu, on_gpu, frame, scene, budget, .. } = self;
        gpu.attempt("generating a layered frame", || {
            let mode = on_gpu.purpose.mode;
            let steps = on_gpu.max_steps;
            let target = match frame.take().filter(|target| target.fits(&header, steps)) {
                Some(target) => frame.insert(target),
                None => frame.insert(FrameTarget::new(gpu, &header, steps)?),
            };
            let reach = scene.volume.bounds().radius();
            target.generate(gpu, on_gpu, FrameHeader { mode, ..header }, (budget, reach), wanted)
        })
    }
}
