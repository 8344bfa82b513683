//! The meaning of isinglass: volumes, layered frames, the kernels on the CPU, the codec, the wire format and the
//! session state machines.
//!
//! This crate does no I/O, reads no clock and draws no random numbers: bytes, times and seeds are arguments. Bytes
//! from a file or a peer can never make it panic, hang or allocate without bound.
//!
//! A module uses only those above it in the table of docs/ARCHITECTURE.md; `tests/tests/module_order.rs` checks that.

#[macro_use]
mod simd;

pub mod camera;
pub mod cancel;
pub mod channels;
pub mod clip;
pub mod codec;
pub mod ids;
pub mod image_error;
pub mod kernels;
pub mod layer;
pub mod look;
pub mod mode;
pub mod orbit;
pub mod picture;
pub mod prediction;
pub mod session;
pub mod space;
pub mod text;
pub mod transfer;
pub mod volume;
pub mod wire;
