//! What can go wrong while measuring.

use std::path::Path;

use isinglass_core::codec::CodecError;
use isinglass_core::image_error::ImageErrorError;
use isinglass_core::kernels::layering::all_samples::AllSamplesError;
use isinglass_core::mode::Mode;
use isinglass_formats::FormatError;
use isinglass_gpu::GpuError;

use crate::rivals::Method;

/// Why there is no result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BenchError {
    /// A volume or a transfer function cannot be had.
    #[error("{0}")]
    Format(FormatError),
    /// The GPU did not do it.
    #[error("{0}")]
    Gpu(GpuError),
    /// A frame cannot be encoded or decoded.
    #[error("{0}")]
    Codec(CodecError),
    /// Not every sample can be kept.
    #[error("{0}")]
    AllSamples(AllSamplesError),
    /// Pictures cannot be compared.
    #[error("{0}")]
    Compare(ImageErrorError),
    /// A scene that is none.
    #[error("unknown scene {found:?}, expected one of {expected}")]
    UnknownScene {
        /// What was asked for.
        found: String,
        /// What there is.
        expected: String,
    },
    /// A method that knows nothing but the composite mode.
    #[error("--method {method}: composites with over, expected layers in mode {mode}")]
    Mode {
        /// The method.
        method: Method,
        /// The mode.
        mode: Mode,
    },
    /// Nothing is left to measure.
    #[error("no scene to measure: {0}")]
    NoScene(String),
    /// A file cannot be written or read.
    #[error("{path}: {cause}")]
    Io {
        /// The file.
        path: String,
        /// What the system said.
        cause: std::io::Error,
    },
    /// A picture cannot be read or written.
    #[error("{path}: {cause}")]
    Picture {
        /// The file, or what the picture is.
        path: String,
        /// What is wrong.
        cause: String,
    },
    /// The codec of somebody else did not do it.
    #[error("{codec}: {cause}")]
    Rival {
        /// Its name.
        codec: &'static str,
        /// What is wrong.
        cause: String,
    },
    /// A codec that there is not.
    #[error("unknown codec {found:?}, expected one of {expected}")]
    UnknownCodec {
        /// What was asked for.
        found: String,
        /// What there is.
        expected: String,
    },
    /// The demonstration could not be played.
    #[error("demo: {0}")]
    Demo(String),
}

impl BenchError {
    /// Whether something was asked for that there is not.
    pub fn is_usage(&self) -> bool {
        matches!(self, Self::UnknownScene { .. } | Self::UnknownCodec { .. } | Self::Mode { .. })
    }

    /// For `map_err` on anything that touches `path`.
    pub fn io(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        move |cause| Self::Io { path: path.display().to_string(), cause }
    }
}

macro_rules! from {
    ($($variant:ident($inner:ty)),*) => {
        $(impl From<$inner> for BenchError {
            fn from(cause: $inner) -> Self {
                Self::$variant(cause)
            }
        })*
    };
}

from!(
    Format(FormatError),
    Gpu(GpuError),
    Codec(CodecError),
    Compare(ImageErrorError),
    AllSamples(AllSamplesError)
);
