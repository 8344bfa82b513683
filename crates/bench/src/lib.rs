//! How fast and how late: scenes, tables of speed and of a frame's way, and the demonstration without a window, which plays a camera path against a real server over a real, slowed-down link and compares what was shown
//! with the truth.
//!
//! This crate measures and never renders in its own way: pictures come from the kernels behind
//! [`isinglass_render::Backend`], frames from the server, errors from `isinglass_core::image_error`. It writes files whole
//! or not at all, and draws progress on standard error only.

pub mod demo;
mod error;
pub mod latency;
pub mod paths;
pub mod pipeline;
pub mod progress;
pub mod scenes;
pub mod speed;
pub mod subject;

pub use error::BenchError;
