//! A simulated link with delay, jitter, loss and a rate limit, under a real QUIC endpoint.
//!
//! [`LinkModel`] describes the link, and [`NamedLink`] has those that people know. [`Direction`] decides the fate of
//! each packet, without clock or I/O. A socket under the client's endpoint applies it in both directions; the server's
//! endpoint is unaware of it.

mod model;
mod named;
mod socket;

pub use model::{Direction, Fate, LinkModel, LinkModelError};
pub use named::NamedLink;
pub(crate) use socket::{AlwaysWritable, ConditionedSocket, SharedCounters};
pub use socket::{DirectionCounters, LinkCounters};
