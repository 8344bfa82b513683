//! What carries QUIC's packets: UDP, or a byte stream where UDP does not come through.
//!
//! A session is the same over each of them: the same streams, priorities, datagrams, keys and congestion control. A
//! byte stream is TCP with TLS, or the same through a tunnel, such as that of `ssh`. On it each packet follows its
//! length in two bytes, big endian. Nothing is lost there, so no parity is sent, and the congestion control keeps
//! the stream's buffers short.

mod socket;
mod streams;

use std::fmt;
use std::net::{IpAddr, SocketAddr, SocketAddrV6};

pub(crate) use socket::CarrierSocket;
pub(crate) use streams::{StreamDoor, carry};

/// What carries the packets of a connection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Carrier {
    /// UDP.
    #[default]
    Udp,
    /// TCP with TLS.
    Tcp,
    /// The same through a tunnel.
    Tunnel,
}

impl fmt::Display for Carrier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Udp => "UDP",
            Self::Tcp => "TCP",
            Self::Tunnel => "tunnel",
        })
    }
}

/// The address of the other end of a byte stream, as QUIC sees it. It differs from that of the same peer over UDP.
pub(crate) fn stream_address(peer: SocketAddr) -> SocketAddr {
    let ip = match peer.ip() {
        IpAddr::V4(four) => four.to_ipv6_mapped(),
        IpAddr::V6(six) => six,
    };
    SocketAddrV6::new(ip, peer.port(), STREAM_MARK, 0).into()
}

/// Whether this is the address of a byte stream's other end.
pub(crate) fn is_stream_address(address: SocketAddr) -> bool {
    matches!(address, SocketAddr::V6(six) if six.flowinfo() == STREAM_MARK)
}

/// The real address of a peer, whatever carries its packets.
pub(crate) fn peer_address(address: SocketAddr) -> SocketAddr {
    SocketAddr::new(address.ip().to_canonical(), address.port())
}

/// A flow label that no received packet has: the system reports none.
const STREAM_MARK: u32 = 0x1515;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_address_of_a_stream_is_marked_and_can_be_read_back() {
        for peer in ["192.0.2.7:4433", "[2001:db8::1]:4433", "127.0.0.1:1"] {
            let peer: SocketAddr = peer.parse().unwrap();
            let address = stream_address(peer);
            assert!(is_stream_address(address) && !is_stream_address(peer));
            assert_eq!(peer_address(address), peer);
        }
        // The same peer over UDP, at a socket for both families.
        let mapped: SocketAddr = "[::ffff:192.0.2.7]:4433".parse().unwrap();
        assert_ne!(stream_address("192.0.2.7:4433".parse().unwrap()), mapped);
    }
}
