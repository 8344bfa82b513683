//! Errors of comparisons.

use isinglass_bench::BenchError;
use isinglass_core::codec::CodecError;
use isinglass_core::image_error::ImageErrorError;
use isinglass_core::mode::Mode;
use isinglass_formats::FormatError;
use isinglass_gpu::GpuError;

use crate::rivals::Method;
use crate::rules::all_samples::AllSamplesError;

/// Why there is no result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LabError {
    /// Measuring the product failed.
    #[error(transparent)]
    Bench(#[from] BenchError),
    /// Not every sample can be kept.
    #[error(transparent)]
    AllSamples(#[from] AllSamplesError),
    /// The method only knows the composite mode.
    #[error("--method {method}: composites with over, expected layers in mode {mode}")]
    Mode {
        /// The method.
        method: Method,
        /// The mode.
        mode: Mode,
    },
    /// A rival codec failed.
    #[error("{codec}: {cause}")]
    Rival {
        /// Its name.
        codec: &'static str,
        /// The problem.
        cause: String,
    },
    /// No codec has that name.
    #[error("unknown codec {found:?}, expected one of {expected}")]
    UnknownCodec {
        /// The requested name.
        found: String,
        /// The existing names.
        expected: String,
    },
}

macro_rules! from {
    ($($inner:ty),*) => {
        $(impl From<$inner> for LabError {
            fn from(cause: $inner) -> Self {
                Self::Bench(cause.into())
            }
        })*
    };
}

from!(FormatError, GpuError, CodecError, ImageErrorError);
