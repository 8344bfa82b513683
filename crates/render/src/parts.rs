//! A process's own part of a volume, marched on a GPU or on the CPU.

use std::cell::RefCell;
use std::ops::Range;
use std::sync::{Arc, Weak};

use isinglass_core::kernels::layering::parts::{
    AskedFrame, Gathered, OnProcessors, PartMarcher, pieces_by, seen_by, steps_by,
};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::Scene;
use isinglass_core::kernels::part_rays::{MarchedPart, PartRay, RayItems};
use isinglass_core::volume::PageSet;
use isinglass_gpu::{Gpu, GpuError, GpuRenderer};

use crate::{Backend, BackendChoice};

/// Marches the own part of a process where a backend says. A GPU that fails leaves the work to the CPU for good, and so
/// does one without room for the part. Of a part by pages, the CPU only marches those views whose pages have no room.
pub struct PartRenderer(RefCell<Device>);

enum Device {
    Cpu,
    /// The renderer is made for the first scene. Also the pages that had no room.
    Gpu(Gpu, Option<Box<GpuRenderer>>, Weak<PageSet>),
}

impl PartRenderer {
    /// On the chosen backend. Of several GPUs of the best kind, process number `local` on its machine gets one in turn.
    ///
    /// # Errors
    /// If there is no GPU where one is chosen.
    pub fn open(choice: BackendChoice, local: usize) -> Result<Self, GpuError> {
        Ok(Self::on(&Backend::open_by(choice, || Gpu::open_in_turn(local))?))
    }

    /// On a GPU, or for all other backends on the CPU.
    pub fn on(backend: &Backend) -> Self {
        Self(RefCell::new(match backend {
            Backend::Gpu(gpu) => Device::Gpu(gpu.clone(), None, Weak::new()),
            Backend::Cpu | Backend::Rule(_) | Backend::Workers(_) => Device::Cpu,
        }))
    }

    /// What the GPU makes; `None` if the CPU must do it.
    fn by_gpu<R>(
        &self,
        part: &MarchedPart<'_>,
        make: impl FnOnce(&mut GpuRenderer) -> Result<R, GpuError>,
    ) -> Option<R> {
        let mut device = self.0.borrow_mut();
        let Device::Gpu(gpu, renderer, too_many) = &mut *device else { return None };
        let pages = part.scene.pages.as_ref().map(|pages| &pages.set);
        if pages.is_some_and(|set| std::ptr::eq(too_many.as_ptr(), Arc::as_ptr(set))) {
            return None;
        }
        match renderer_of(gpu, renderer, part.scene).and_then(make) {
            Ok(made) => Some(made),
            Err(e @ GpuError::Pages { .. }) => {
                tracing::debug!("the CPU marches a view of the part of process {}: {e}", part.rank);
                *too_many = pages.map_or_else(Weak::new, Arc::downgrade);
                None
            }
            Err(e) => {
                tracing::error!("the part of process {} is marched on the CPU from now on: {e}", part.rank);
                *device = Device::Cpu;
                None
            }
        }
    }
}

/// The renderer, which shows the scene.
fn renderer_of<'a>(
    gpu: &Gpu,
    renderer: &'a mut Option<Box<GpuRenderer>>,
    scene: &Scene,
) -> Result<&'a mut GpuRenderer, GpuError> {
    let known = match renderer.take() {
        Some(known) => known,
        // The renderer stays even if the pages have no room.
        None => Box::new(GpuRenderer::new(gpu, scene.without_pages())?),
    };
    let known = renderer.insert(known);
    if !is_same(known.scene(), scene) {
        known.set_scene(scene.clone())?;
    }
    Ok(known)
}

/// Whether two scenes are one. After a scene is built, only what all processes find out together changes in it.
fn is_same(a: &Scene, b: &Scene) -> bool {
    let is_lit_alike = match (a.illumination.lit(), b.illumination.lit()) {
        (Some(a), Some(b)) => Arc::ptr_eq(a, b),
        (a, b) => a.is_none() && b.is_none(),
    };
    let are_same_pages = match (&a.pages, &b.pages) {
        (Some(a), Some(b)) => {
            Arc::ptr_eq(&a.set, &b.set) && a.looks.iter().zip(&b.looks).all(|(a, b)| Arc::ptr_eq(a, b))
        }
        (a, b) => a.is_none() && b.is_none(),
    };
    let is_built_once = Arc::ptr_eq(&a.transfer, &b.transfer) && Arc::ptr_eq(&a.volume, &b.volume);
    is_built_once && is_lit_alike && are_same_pages && a.has_lesser_bodies == b.has_lesser_bodies
}

impl PartMarcher for PartRenderer {
    fn pieces(&self, part: &MarchedPart<'_>, frame: &AskedFrame, rows: &[&[u32]]) -> Vec<Vec<u32>> {
        let made = self.by_gpu(part, |gpu| pieces_by(part, frame, rows, gatherer(gpu)));
        made.unwrap_or_else(|| OnProcessors.pieces(part, frame, rows))
    }

    fn steps(&self, part: &MarchedPart<'_>, frame: &AskedFrame) -> Vec<u32> {
        let made = self.by_gpu(part, |gpu| steps_by(part, frame, gatherer(gpu)));
        made.unwrap_or_else(|| OnProcessors.steps(part, frame))
    }

    fn seen(&self, part: &MarchedPart<'_>, view: &View, rows: Range<u32>) -> Vec<u32> {
        let made = self.by_gpu(part, |gpu| seen_by(part, view, rows.clone(), gatherer(gpu)));
        made.unwrap_or_else(|| OnProcessors.seen(part, view, rows))
    }

    fn description(&self) -> String {
        match &*self.0.borrow() {
            Device::Gpu(gpu, ..) => format!("gpu: {}", gpu.info()),
            Device::Cpu => OnProcessors.description(),
        }
    }
}

fn gatherer(gpu: &mut GpuRenderer) -> impl FnOnce(&View, &[PartRay], Gathered) -> Result<RayItems, GpuError> {
    |view, rays, what| gpu.gather(view, rays, what)
}
