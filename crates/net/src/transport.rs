//! Settings of QUIC, and the codes that close connections and streams.

use std::sync::Arc;
use std::time::Duration;

use quinn::congestion::ControllerFactory;
use quinn::crypto::rustls::HandshakeData;
use quinn::{AckFrequencyConfig, Connection, IdleTimeout, TransportConfig, VarInt};

use isinglass_core::wire::{ALPN_ANY, POSE_BYTES};

use crate::congestion::ViewerWindow;

/// A side leaves by its own choice.
pub(crate) const CLOSE_BYE: VarInt = VarInt::from_u32(0);
/// The client is refused or dismissed; the reason is one line of text.
pub(crate) const CLOSE_REFUSED: VarInt = VarInt::from_u32(1);
/// The peer broke the protocol.
pub(crate) const CLOSE_PROTOCOL: VarInt = VarInt::from_u32(2);
/// The same viewer has connected again.
pub(crate) const CLOSE_REPLACED: VarInt = VarInt::from_u32(3);
/// The server ends this session; the viewer may reconnect.
pub(crate) const CLOSE_SESSION: VarInt = VarInt::from_u32(4);
/// No packet arrived for [`SILENCE_LIMIT`].
pub(crate) const CLOSE_SILENT: VarInt = VarInt::from_u32(5);
/// The peers share no version of the protocol; the reason is the server's version notice.
pub(crate) const CLOSE_VERSION: VarInt = VarInt::from_u32(6);
/// The frame of a stream is superseded.
pub(crate) const RESET_SUPERSEDED: VarInt = VarInt::from_u32(1);
/// The client has restored the rest of the stream from its parity.
pub(crate) const STOP_REPAIRED: VarInt = VarInt::from_u32(3);
/// The content of a stream is unusable.
pub(crate) const STOP_UNUSABLE: VarInt = VarInt::from_u32(2);

/// Time limit for the handshake, and another for the hello up to the welcome.
pub(crate) const AUTH_DEADLINE: Duration = Duration::from_secs(5);
/// A server gives up a silent connection after this time. Clients send a packet every [`KEEP_ALIVE`].
pub(crate) const SILENCE_LIMIT: Duration = Duration::from_secs(8);
/// So short that a viewer notices a dead server within two seconds.
const KEEP_ALIVE: Duration = Duration::from_millis(500);
/// Long, because a client tries its old connection as long as it has no other.
const IDLE_MILLIS: u32 = 120_000;

/// A packet counts as lost when so many later ones have arrived. Radio links let packets overtake each other. Waiting
/// for them costs little, because parity restores what a moving camera needs.
const REORDERED_PACKETS: u32 = 16;
/// The same as a time, in round trips.
const REORDERED_ROUND_TRIPS: f32 = 1.25;

/// Settings of both sides.
fn common(congestion: Arc<dyn ControllerFactory + Send + Sync>) -> TransportConfig {
    let mut acks = AckFrequencyConfig::default();
    acks.ack_eliciting_threshold(2u32.into()).max_ack_delay(Some(Duration::from_millis(5)));
    let mut t = TransportConfig::default();
    t.congestion_controller_factory(congestion)
        .ack_frequency_config(Some(acks))
        .packet_threshold(REORDERED_PACKETS)
        .time_threshold(REORDERED_ROUND_TRIPS)
        .initial_rtt(Duration::from_millis(100))
        .max_idle_timeout(Some(IdleTimeout::from(VarInt::from_u32(IDLE_MILLIS))));
    t
}

/// The server accepts one control stream and small datagrams.
pub(crate) fn server(congestion: Arc<dyn ControllerFactory + Send + Sync>) -> TransportConfig {
    let mut t = common(congestion);
    t.max_concurrent_bidi_streams(1u32.into())
        .max_concurrent_uni_streams(0u32.into())
        .stream_receive_window((256u32 << 10).into())
        .receive_window((1u32 << 20).into())
        .send_window(64 << 10)
        .datagram_receive_buffer_size(Some(64 << 10))
        .datagram_send_buffer_size(256 << 10);
    t
}

/// The client accepts frames. At 60 frames a second and a round trip of 300 ms, twenty streams are open.
pub(crate) fn client() -> TransportConfig {
    let mut t = common(Arc::new(ViewerWindow));
    t.max_concurrent_bidi_streams(0u32.into())
        .max_concurrent_uni_streams(1024u32.into())
        .stream_receive_window((32u32 << 20).into())
        .receive_window((64u32 << 20).into())
        .datagram_receive_buffer_size(Some(256 << 10))
        // The newest wins: quinn drops the oldest datagrams of a full buffer.
        .datagram_send_buffer_size(2 * POSE_BYTES)
        .keep_alive_interval(Some(KEEP_ALIVE));
    t
}

/// Whether the handshake of a connection has found no common version of the protocol.
pub(crate) fn has_no_common_version(connection: &Connection) -> bool {
    let data = connection.handshake_data().and_then(|data| data.downcast::<HandshakeData>().ok());
    data.is_some_and(|data| data.protocol.as_deref() == Some(ALPN_ANY))
}
