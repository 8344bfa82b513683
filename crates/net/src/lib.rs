//! Carries the sessions of `isinglass-core` over QUIC, on UDP, or on TCP where UDP does not come through. It has
//! certificates and links, a server, and a client that never blocks a display loop. A link conditioner adds delay, loss
//! and a rate limit to real endpoints.
//!
//! This crate holds no rule of the protocol. `isinglass_core::session` decides which chunks to send, whom to admit
//! and what to decode. Here are sockets, streams, timers, threads and the generator of secrets.

mod carrier;
pub mod client;
mod clock;
pub mod conditioner;
mod congestion;
mod control_stream;
pub mod identity;
mod journal;
pub mod link;
pub mod server;
#[cfg(test)]
mod simulation;
mod talk;
mod transport;
mod work;

pub use carrier::Carrier;
pub use client::{Client, ClientError, ClientOptions, ConnectError, LinkStats, ReceivedFrame, State, Tunnel};
pub use clock::Clock;
pub use conditioner::{LinkModel, NamedLink};
pub use identity::{Fingerprint, Identity, random_token};
pub use journal::Journal;
pub use link::{Link, LinkError, place_of, state_of_link};
pub use server::{BindError, Greeting, Server, ServerOptions, Session, SessionClosed};
pub use talk::Talking;
pub use work::{AfterWork, Work};
