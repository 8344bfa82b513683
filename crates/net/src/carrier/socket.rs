//! A socket for QUIC over byte streams, and over UDP beside them.

use std::io::{self, IoSliceMut};
use std::net::{Ipv6Addr, SocketAddr};
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::mpsc;

use super::is_stream_address;
use super::streams::{MAX_RECEIVED, Received, StreamDoor, Streams, carry};
use crate::conditioner::AlwaysWritable;

/// Sends each packet to the stream of its address, and all others over UDP.
#[derive(Debug)]
pub(crate) struct CarrierSocket {
    udp: Option<Arc<dyn AsyncUdpSocket>>,
    streams: Arc<Streams>,
    received: Mutex<FromStreams>,
}

#[derive(Debug)]
struct FromStreams {
    queue: mpsc::Receiver<Received>,
    /// Whether UDP comes first at the next call: streams and UDP take turns.
    is_udp_first: bool,
}

impl CarrierSocket {
    /// A socket over UDP to which streams can be added.
    pub(crate) fn with_streams(udp: Arc<dyn AsyncUdpSocket>) -> (Arc<Self>, StreamDoor) {
        Self::new(Some(udp))
    }

    /// A socket over one byte stream to this address. It needs a tokio runtime, and fails when the stream ends.
    pub(crate) fn of_stream(
        stream: impl AsyncRead + AsyncWrite + Send + 'static,
        address: SocketAddr,
    ) -> Arc<Self> {
        let (socket, door) = Self::new(None);
        let end = door.add(address);
        tokio::spawn(async move {
            if let Err(e) = carry(stream, end).await {
                tracing::debug!("the stream that carried packets broke: {e}");
            }
        });
        socket
    }

    fn new(udp: Option<Arc<dyn AsyncUdpSocket>>) -> (Arc<Self>, StreamDoor) {
        let (received, queue) = mpsc::channel(MAX_RECEIVED);
        let streams = Arc::<Streams>::default();
        let door = StreamDoor { streams: streams.clone(), received };
        let received = Mutex::new(FromStreams { queue, is_udp_first: false });
        (Arc::new(Self { udp, streams, received }), door)
    }

    /// Fills buffers from the streams; an error if there will never be any more.
    fn poll_streams(
        &self,
        cx: &mut Context<'_>,
        queue: &mut mpsc::Receiver<Received>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut n = 0;
        while n < bufs.len().min(meta.len()) {
            match queue.poll_recv(cx) {
                Poll::Ready(Some((addr, packet))) => {
                    n += usize::from(put(packet, addr, &mut bufs[n], &mut meta[n]));
                }
                Poll::Ready(None) if n == 0 && self.udp.is_none() => {
                    return Poll::Ready(Err(io::ErrorKind::UnexpectedEof.into()));
                }
                Poll::Ready(None) | Poll::Pending => break,
            }
        }
        if n > 0 { Poll::Ready(Ok(n)) } else { Poll::Pending }
    }

    fn poll_udp(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        self.udp.as_ref().map_or(Poll::Pending, |udp| udp.poll_recv(cx, bufs, meta))
    }
}

/// Puts a packet into a buffer of the endpoint. One that is longer than any buffer can only be garbage.
fn put(packet: Bytes, addr: SocketAddr, buf: &mut IoSliceMut<'_>, meta: &mut RecvMeta) -> bool {
    let length = packet.len();
    let Some(space) = buf.get_mut(..length).filter(|_| length > 0) else { return false };
    space.copy_from_slice(&packet);
    (meta.addr, meta.len, meta.stride, meta.ecn, meta.dst_ip) = (addr, length, length, None, None);
    true
}

impl Drop for CarrierSocket {
    fn drop(&mut self) {
        self.streams.close_all();
    }
}

impl AsyncUdpSocket for CarrierSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        match &self.udp {
            Some(udp) => udp.clone().create_io_poller(),
            // Packets to a stream never wait for room.
            None => Box::pin(AlwaysWritable),
        }
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        match &self.udp {
            Some(udp) if !is_stream_address(transmit.destination) => udp.try_send(transmit),
            _ => {
                let length = transmit.segment_size.unwrap_or(transmit.contents.len()).max(1);
                for packet in transmit.contents.chunks(length) {
                    self.streams.send(transmit.destination, packet);
                }
                Ok(())
            }
        }
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut received = self.received.lock().unwrap_or_else(PoisonError::into_inner);
        let FromStreams { queue, is_udp_first } = &mut *received;
        *is_udp_first = !*is_udp_first;
        if *is_udp_first && let Poll::Ready(ready) = self.poll_udp(cx, bufs, meta) {
            return Poll::Ready(ready);
        }
        if let Poll::Ready(ready) = self.poll_streams(cx, queue, bufs, meta) {
            return Poll::Ready(ready);
        }
        if *is_udp_first {
            return Poll::Pending;
        }
        let ready = ready!(self.poll_udp(cx, bufs, meta));
        Poll::Ready(ready)
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        match &self.udp {
            Some(udp) => udp.local_addr(),
            None => Ok((Ipv6Addr::LOCALHOST, 0).into()),
        }
    }

    fn max_transmit_segments(&self) -> usize {
        self.udp.as_ref().map_or(1, |udp| udp.max_transmit_segments())
    }

    fn max_receive_segments(&self) -> usize {
        self.udp.as_ref().map_or(1, |udp| udp.max_receive_segments())
    }

    fn may_fragment(&self) -> bool {
        self.udp.as_ref().is_some_and(|udp| udp.may_fragment())
    }
}
