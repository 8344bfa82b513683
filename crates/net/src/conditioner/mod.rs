//! A link with delay, jitter, loss and a narrow pipe, under a real QUIC endpoint.
//!
//! [`LinkModel`] says what the link is like, [`Direction`] decides what becomes of each packet (without clock or
//! I/O), and a socket under the client's endpoint carries it out in both directions. The server's endpoint knows
//! nothing of it.

mod model;
mod socket;

pub use model::{Direction, Fate, LinkModel, LinkModelError};
pub(crate) use socket::{ConditionedSocket, SharedCounters};
pub use socket::{DirectionCounters, LinkCounters};
