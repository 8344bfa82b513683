//! Measures speed and latency: scenes, tables of speed and of a frame's stages, and the demonstration without a
//! window. That plays a camera path against a real server over a real, slowed-down link, and compares every displayed
//! picture with the truth. Visits play the same on any server, with pictures of the viewer and without a truth.
//!
//! This crate measures and has no rendering of its own. Pictures come from the kernels behind
//! [`isinglass_render::Backend`], frames from the server, errors from `isinglass_core::image_error`. It writes files
//! whole or not at all, and draws progress on standard error only.

pub mod demo;
mod error;
pub mod latency;
pub mod paths;
pub mod pipeline;
pub mod progress;
pub mod scenes;
pub mod speed;
pub mod subject;
pub mod viewers;
pub mod visit;

pub use error::BenchError;
