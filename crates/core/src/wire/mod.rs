//! What rides on which stream or datagram. Every byte that leaves a process is defined here or in [`crate::codec`],
//! and described in `docs/PROTOCOL.md`.
//!
//! | what | direction | carrier |
//! |---|---|---|
//! | [`ClientMessage`], [`ServerMessage`] | both | one bidirectional stream that the client opens; see [`control`] |
//! | [`PoseRequest`] | client to server | datagram, in `wire/pose.rs` |
//! | layered frame | server to client | one unidirectional stream each: its chunks; see [`crate::codec`] |
//! | parity of a frame's stream | server to client | datagrams; see [`parity`] |
//! | picture to keep | server to client | one unidirectional stream each; see [`screenshot`] |
//! | slice through the volume | server to client | one unidirectional stream each; see [`mod@slice`] |

pub mod control;
mod description;
pub mod parity;
mod pose;
mod probe;
mod profile;
pub mod screenshot;
mod selection;
pub mod slice;
mod token;
#[cfg(test)]
mod vectors;
mod version;
mod viewers;

pub use control::{
    ClientMessage, ClientStats, ControlError, Refusal, ServerMessage, ServerStats, VolumeChange, Welcome,
};
pub use description::{ChannelDescription, MAX_BINS, MAX_CHANNEL_BINS, MAX_LABELS, VolumeDescription};
pub use pose::{MAX_SHOWN_TURN_DEG, POSE_BYTES, PoseError, PoseRequest};
pub use probe::{ProbeRequest, Probed, ProbedVoxel};
pub use profile::{MAX_PROFILE_POINTS, Profile, ProfileRequest};
pub use screenshot::ScreenshotRequest;
pub use selection::{Choices, LoadState, LoadStatus, Part};
pub use slice::{SliceRequest, WantedSlices};
pub use token::{Token, TokenError};
pub use version::{ALPN, ALPN_ANY, PROTOCOL_VERSION, version_in_notice, version_notice};
pub use viewers::{MAX_VIEWERS, ViewerEntry};

/// Length of the longest control message.
pub const MAX_CONTROL_BYTES: usize = 256 * 1024;
