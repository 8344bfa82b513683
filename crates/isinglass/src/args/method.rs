//! How frames become pictures, and where.

use anyhow::Result;
use clap::Args;
use isinglass_bench::rivals::Method;
use isinglass_gpu::{Backend, BackendChoice};

/// How a frame becomes a picture.
#[derive(Args, Clone, Debug)]
pub(crate) struct MethodArgs {
    /// How frames become pictures: layers, point-warp, slabs-planar, slabs-mesh or last-image
    #[arg(long, value_name = "METHOD", default_value_t = Method::default())]
    pub(crate) method: Method,
}

/// Where kernels run.
#[derive(Args, Clone, Debug)]
pub(crate) struct BackendArgs {
    /// Where kernels run: auto, gpu or cpu
    #[arg(long, value_name = "BACKEND", default_value_t = BackendChoice::default())]
    pub(crate) backend: BackendChoice,
}

impl BackendArgs {
    /// Opens it.
    pub(crate) fn open(&self) -> Result<Backend> {
        Ok(Backend::open(self.backend)?)
    }
}
