//! Where kernels run.

use anyhow::Result;
use clap::Args;
use isinglass_bench::progress::note;
use isinglass_core::kernels::march::Scene;
use isinglass_render::{Backend, BackendChoice, Renderer};

/// Where kernels run.
#[derive(Args, Clone, Debug)]
pub(crate) struct BackendArgs {
    /// Where kernels run: auto, gpu or cpu
    #[arg(long, value_name = "BACKEND", default_value_t = BackendChoice::default())]
    pub(crate) backend: BackendChoice,
}

impl BackendArgs {
    /// Opens the backend.
    pub(crate) fn open(&self) -> Result<Backend> {
        Ok(Backend::open(self.backend)?)
    }

    /// A renderer of a scene and its backend: the CPU if the GPU cannot render it and nobody insisted on one.
    pub(crate) fn renderer(&self, scene: Scene) -> Result<(Renderer, Backend)> {
        let backend = self.open()?;
        match backend.renderer(scene.clone()) {
            Err(e) if e.asks_for_cpu() && self.backend == BackendChoice::Auto => {
                note(&format!("note: rendering on the CPU: {e}"));
                Ok((Backend::Cpu.renderer(scene)?, Backend::Cpu))
            }
            made => Ok((made?, backend)),
        }
    }
}
