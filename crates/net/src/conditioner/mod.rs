//! A simulated link with delay, jitter, loss and a rate limit, under a real QUIC endpoint.
//!
//! [`LinkModel`] describes the link. [`Direction`] decides the fate of each packet, without clock or I/O. A socket
//! under the client's endpoint applies it in both directions; the server's endpoint is unaware of it.

mod model;
mod socket;

pub use model::{Direction, Fate, LinkModel, LinkModelError};
pub(crate) use socket::{AlwaysWritable, ConditionedSocket, SharedCounters};
pub use socket::{DirectionCounters, LinkCounters};
