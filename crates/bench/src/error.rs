//! Errors of measurements.

use std::path::Path;

use isinglass_core::codec::CodecError;
use isinglass_core::image_error::ImageErrorError;
use isinglass_formats::FormatError;
use isinglass_gpu::GpuError;

/// Why there is no result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BenchError {
    /// A volume or transfer function is not available.
    #[error("{0}")]
    Format(FormatError),
    /// The GPU failed.
    #[error("{0}")]
    Gpu(GpuError),
    /// A frame cannot be encoded or decoded.
    #[error("{0}")]
    Codec(CodecError),
    /// Pictures cannot be compared.
    #[error("{0}")]
    Compare(ImageErrorError),
    /// The scene does not exist.
    #[error("unknown scene {found:?}, expected one of {expected}")]
    UnknownScene {
        /// The requested name.
        found: String,
        /// The existing names.
        expected: String,
    },
    /// Nothing is left to measure.
    #[error("no scene to measure: {0}")]
    NoScene(String),
    /// A file cannot be written or read.
    #[error("{path}: {cause}")]
    Io {
        /// The file.
        path: String,
        /// The system's message.
        cause: std::io::Error,
    },
    /// A picture cannot be read or written.
    #[error("{path}: {cause}")]
    Picture {
        /// The file, or a description of the picture.
        path: String,
        /// The problem.
        cause: String,
    },
    /// The demonstration could not be played.
    #[error("demo: {0}")]
    Demo(String),
}

impl BenchError {
    /// Whether the request names something that does not exist.
    pub fn is_usage(&self) -> bool {
        matches!(self, Self::UnknownScene { .. })
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

from!(Format(FormatError), Gpu(GpuError), Codec(CodecError), Compare(ImageErrorError));
