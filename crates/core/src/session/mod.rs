//! The conversation between a viewer and its server, without any I/O: one subject per file, with both halves and
//! tests.
//!
//! Bytes and times come in through `handle_*`; decisions come out of `poll_*`. Times are microseconds on the clock of
//! the calling side. The clocks of two machines are never mixed.
//!
//! - [`client`], [`server`]: all halves of a side.
//! - [`link`]: the connection itself; [`admission`]: who may join.
//! - [`pose`]: the camera of the frames; [`look`]: their look; [`selection`]: the part of the file that they show.
//! - [`frames`]: which frames are made; [`rate`]: how they are coded; [`schedule`]: when they begin; [`chunks`]: what
//!   is sent, given up and decoded.
//! - [`repair`]: restores lost parts of frames.
//! - [`inquiry`]: a question about the volume. [`probe`], [`profile`]: the value at a point, the values along a line.
//! - [`screenshot`]: a picture to keep; [`slices`]: slices through the volume.
//! - [`viewers`]: who is there, and whose frames a viewer gets. [`pages`]: how far a large volume is read.
//! - [`ledger`]: the life of every frame, on either side.
//! - [`pace`]: the newest of many values, at a bounded rate.
//! - `pair`: both sides joined by a simulated link, for tests.

pub mod admission;
mod bucket;
pub mod chunks;
pub mod client;
pub mod frames;
pub mod inquiry;
pub mod ledger;
pub mod link;
pub mod look;
pub mod pace;
pub mod pages;
#[cfg(test)]
pub(crate) mod pair;
pub mod pose;
pub mod probe;
pub mod profile;
pub mod rate;
pub mod repair;
pub mod schedule;
pub mod screenshot;
pub mod selection;
pub mod server;
pub mod slices;
pub mod viewers;

pub use client::ClientSession;
pub use server::ServerSession;
