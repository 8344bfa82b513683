//! Where kernels run.

use anyhow::Result;
use clap::Args;
use isinglass_bench::progress::note;
use isinglass_core::kernels::march::Scene;
use isinglass_render::{Backend, BackendChoice, Devices, GpuCount, Renderer};

/// Where kernels run.
#[derive(Args, Clone, Debug)]
pub(crate) struct BackendArgs {
    /// Where kernels run: auto, gpu or cpu
    #[arg(long, value_name = "BACKEND", default_value_t = BackendChoice::default())]
    pub(crate) backend: BackendChoice,
}

/// How many GPUs are used.
#[derive(Args, Clone, Copy, Debug)]
pub(crate) struct GpusArgs {
    /// GPUs to use, of the best kind: all, one, or a number. Each viewer's frames are made by the one with the least load
    #[arg(long, value_name = "N", default_value_t = GpuCount::default())]
    pub(crate) gpus: GpuCount,
}

impl GpusArgs {
    /// Opens the chosen backend, of GPUs as many as there should be.
    pub(crate) fn open(self, backend: &BackendArgs) -> Result<Devices> {
        Ok(Devices::open(backend.backend, self.gpus)?)
    }
}

impl BackendArgs {
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
