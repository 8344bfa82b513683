//! The conversation of a viewer with its server, without any I/O: one subject a file, with both halves and their tests.
//!
//! Bytes and times come in through `handle_*`; decisions come out of `poll_*`. Times are microseconds on the clock of the
//! side that asks. No clock of one machine is ever subtracted from the other's.
//!
//! - [`client`], [`server`]: all halves of a side.
//! - [`link`]: the connection itself; [`admission`]: who is let in.
//! - [`pose`]: where frames are wanted from; [`look`]: what they look like; [`selection`]: which part of the file they show.
//! - [`frames`]: which frames are made; [`rate`]: how they are coded; [`schedule`]: when they are begun; [`chunks`]: what of
//!   them is sent, given up and decoded.
//! - [`probe`], [`screenshot`]: the value at a point, and a picture to keep.
//! - [`ledger`]: every frame's life, on either side.
//! - [`pace`]: the newest of many values, at a bounded rate.
//! - `pair`: both sides joined by a simulated link, for tests.

pub mod admission;
mod bucket;
pub mod chunks;
pub mod client;
pub mod frames;
pub mod ledger;
pub mod link;
pub mod look;
pub mod pace;
#[cfg(test)]
pub(crate) mod pair;
pub mod pose;
pub mod probe;
pub mod rate;
mod round_trip;
pub mod schedule;
pub mod screenshot;
pub mod selection;
pub mod server;

pub use client::ClientSession;
pub use server::ServerSession;
