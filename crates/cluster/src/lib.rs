//! One volume in the memory of several processes, which make its frames and pictures together.
//!
//! A process holds the voxels of its own box and a few around it. What must be the same everywhere is found together:
//! the range of values, the histogram, and on which side of surfaces bodies lie. Kernels that know no network do the
//! rest ([`isinglass_core::kernels::layering::parts`]). A volume that no memory holds is read by pages
//! ([`PartReader`]). An [`Exchange`] carries their words: MPI, or channels between threads.

mod asides;
mod cluster;
mod coding;
mod exchange;
mod in_process;
mod jobs;
#[cfg(feature = "mpi")]
mod mpi_world;
mod orders;
mod pages;
mod whole;
mod words;

pub use asides::FrameOfAll;
pub use cluster::{Cluster, Report};
pub use exchange::{ClusterError, Exchange, ExchangeError, agree, are_alike, same_everywhere};
pub use in_process::InProcess;
pub use orders::{OrderQueue, Orders, orders};
pub use pages::PartReader;
pub use whole::{FinestNumbers, in_whole};

/// Joins the processes that `mpirun` started.
///
/// # Errors
/// If this program was built without MPI, or MPI does not start.
pub fn join() -> Result<Box<dyn Exchange>, ExchangeError> {
    #[cfg(feature = "mpi")]
    return Ok(Box::new(mpi_world::Mpi::start()?));
    #[cfg(not(feature = "mpi"))]
    Err(ExchangeError::WithoutMpi)
}
