//! The state of a connection on both sides, without any I/O: bytes and times come in through `handle_*`, decisions
//! come out of `poll_*` and the answers. Times are microseconds on the clock of the side that asks; no clock of one
//! machine is ever subtracted from the other's.
//!
//! - [`admission`]: who is let in.
//! - [`server`]: which poses count, which chunks are worth sending, and in which order.
//! - [`rate`]: how each frame is coded.
//! - [`schedule`]: when the next frame is begun.
//! - [`client`]: which chunks make a frame, and what is decoded next.
//! - [`ledger`]: every frame's life, on either side.

pub mod admission;
mod bucket;
pub mod client;
pub mod ledger;
pub mod rate;
mod round_trip;
pub mod schedule;
pub mod server;
