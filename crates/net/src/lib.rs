//! Drives the sessions of `isinglass-core` over QUIC: certificates and links, a server, a client that never makes a
//! display loop wait, and a link conditioner that puts delay, loss and a narrow pipe under real endpoints.
//!
//! This crate holds no rule of the protocol: which chunk is worth sending, who is let in and what is decoded next is
//! decided by `isinglass_core::session`; here are sockets, streams, timers, threads and the generator of secrets.

pub mod client;
mod clock;
pub mod conditioner;
mod control_stream;
pub mod identity;
mod journal;
pub mod link;
pub mod server;
mod talk;
mod transport;
mod work;

pub use client::{Client, ClientError, ClientOptions, ConnectError, LinkStats, ReceivedFrame, State};
pub use clock::Clock;
pub use conditioner::LinkModel;
pub use identity::{Fingerprint, Identity, random_token};
pub use journal::Journal;
pub use link::{Link, LinkError, place_of, state_of_link};
pub use server::{BindError, Greeting, Server, ServerOptions, Session, SessionClosed};
pub use talk::Talking;
pub use work::{AfterWork, Work};
