//! The methods of the papers beside the product's: layering rules, pictures from depths, and image codecs on the
//! planes of layered frames.
//!
//! This crate compares, and nothing depends on it. Pictures of the product come from its own kernels, frames from its
//! own server, and errors from `isinglass_core::image_error`.

pub mod choices;
pub mod codec;
mod error;
pub mod latency;
pub mod quality;
pub mod rivals;
pub mod rules;

pub use error::LabError;
