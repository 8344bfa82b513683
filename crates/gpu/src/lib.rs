//! The kernels of isinglass-core on wgpu: device, layouts, passes, readback. A kernel's meaning is documented at its
//! Rust twin in core.
//!
//! Nothing here panics without a GPU, memory or a responding driver: all of that is a [`GpuError`].

mod adapters;
mod atlas;
pub mod blocks;
mod casts;
mod combine;
mod device;
mod error;
mod gpu_types;
mod layering;
mod march;
mod parts;
mod pass_clock;
mod picture_target;
mod raycast;
mod readback;
#[cfg(test)]
mod rounding_tests;
mod scene;
#[cfg(test)]
mod shader_tests;
mod shaders;
mod textures;
pub mod upscale;
mod view_pass;
mod warm_up;
mod whole_texels;

pub use device::{Gpu, GpuInfo, NoAnswer, poll, with_large_buffers};
pub use error::GpuError;
pub use march::GpuRenderer;
pub use raycast::GpuReprojector;
pub use view_pass::{Channels, Eye, NUM_SLOTS, ViewPass};
pub use warm_up::WarmUp;
/// The version of wgpu that [`ViewPass`] uses.
pub use wgpu;
