//! Packets on byte streams: one task a stream reads and writes, and the socket exchanges packets with it.

use std::collections::HashMap;
use std::io;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::{Buf, BufMut, Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::sync::{Notify, mpsc};

/// A packet and where it comes from.
pub(super) type Received = (SocketAddr, Bytes);

/// The streams of a socket, by the addresses of their other ends.
#[derive(Debug, Default)]
pub(super) struct Streams(Mutex<HashMap<SocketAddr, Arc<Outgoing>>>);

/// Packets that wait to be written to a stream, each behind its length.
#[derive(Debug, Default)]
struct Outgoing {
    waiting: Mutex<Unwritten>,
    changed: Notify,
    /// Notified when the client is let in or refused.
    decided: Notify,
    is_viewer: AtomicBool,
}

#[derive(Debug, Default)]
struct Unwritten {
    bytes: BytesMut,
    is_closed: bool,
    has_connection: bool,
}

impl Outgoing {
    fn waiting(&self) -> MutexGuard<'_, Unwritten> {
        // Every change is one step, so a panic leaves it in order.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes all that waits; `None` after the end.
    async fn next(&self) -> Option<BytesMut> {
        loop {
            {
                let mut waiting = self.waiting();
                if !waiting.bytes.is_empty() {
                    return Some(waiting.bytes.split());
                }
                if waiting.is_closed {
                    return None;
                }
            }
            self.changed.notified().await;
        }
    }
}

impl Streams {
    fn lock(&self) -> MutexGuard<'_, HashMap<SocketAddr, Arc<Outgoing>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn get(&self, address: SocketAddr) -> Option<Arc<Outgoing>> {
        self.lock().get(&address).cloned()
    }

    /// Hands a packet to the stream at this address. As on any network, it may be lost: where the stream is gone, or
    /// so much waits that the congestion control cannot know of this stream.
    pub(super) fn send(&self, address: SocketAddr, packet: &[u8]) {
        let (Some(outgoing), Ok(length)) = (self.get(address), u16::try_from(packet.len())) else { return };
        let mut waiting = outgoing.waiting();
        if waiting.bytes.len() + packet.len() > MAX_WAITING_BYTES {
            return;
        }
        waiting.bytes.put_u16(length);
        waiting.bytes.put_slice(packet);
        drop(waiting);
        outgoing.changed.notify_one();
    }

    /// What waits is still written, and then the stream ends.
    pub(super) fn close(&self, address: SocketAddr) {
        if let Some(outgoing) = self.lock().remove(&address) {
            outgoing.waiting().is_closed = true;
            outgoing.changed.notify_one();
        }
    }

    pub(super) fn close_all(&self) {
        let addresses: Vec<_> = self.lock().keys().copied().collect();
        addresses.into_iter().for_each(|address| self.close(address));
    }
}

/// Adds byte streams to a socket.
#[derive(Clone, Debug)]
pub(crate) struct StreamDoor {
    pub(super) streams: Arc<Streams>,
    pub(super) received: mpsc::Sender<Received>,
}

impl StreamDoor {
    /// A stream to or from this address, which [`carry`] then serves.
    pub(crate) fn add(&self, address: SocketAddr) -> StreamEnd {
        let outgoing = Arc::<Outgoing>::default();
        self.streams.lock().insert(address, outgoing.clone());
        StreamEnd { address, outgoing, door: self.clone() }
    }

    /// Whether the first connection over this stream begins: it carries one.
    pub(crate) fn begin(&self, address: SocketAddr) -> bool {
        let Some(outgoing) = self.streams.get(address) else { return false };
        !std::mem::replace(&mut outgoing.waiting().has_connection, true)
    }

    /// The viewer over this stream is let in.
    pub(crate) fn admit(&self, address: SocketAddr) {
        self.decide(address, true);
    }

    /// The client over this stream is refused, and only has to hear it.
    pub(crate) fn refuse(&self, address: SocketAddr) {
        self.decide(address, false);
    }

    fn decide(&self, address: SocketAddr, is_viewer: bool) {
        if let Some(outgoing) = self.streams.get(address) {
            outgoing.is_viewer.store(is_viewer, Ordering::Relaxed);
            outgoing.decided.notify_one();
        }
    }

    /// The connection over this stream is over: what waits is still written.
    pub(crate) fn close(&self, address: SocketAddr) {
        self.streams.close(address);
    }
}

/// A byte stream as the socket sees it.
#[derive(Debug)]
pub(crate) struct StreamEnd {
    address: SocketAddr,
    outgoing: Arc<Outgoing>,
    door: StreamDoor,
}

impl StreamEnd {
    /// Returns when the client over this stream is let in or refused, and whether it is let in.
    pub(crate) fn decided(&self) -> impl Future<Output = bool> + use<> {
        let outgoing = self.outgoing.clone();
        async move {
            outgoing.decided.notified().await;
            outgoing.is_viewer.load(Ordering::Relaxed)
        }
    }
}

impl Drop for StreamEnd {
    fn drop(&mut self) {
        let mut streams = self.door.streams.lock();
        // Another stream from the same address may have taken its place.
        if streams.get(&self.address).is_some_and(|outgoing| Arc::ptr_eq(outgoing, &self.outgoing)) {
            streams.remove(&self.address);
        }
    }
}

/// Reads and writes the packets of a byte stream until either side ends it.
///
/// # Errors
/// If it ends otherwise.
pub(crate) async fn carry(stream: impl AsyncRead + AsyncWrite, end: StreamEnd) -> io::Result<()> {
    let (read, mut write) = tokio::io::split(stream);
    let writing = async {
        while let Some(mut bytes) = end.outgoing.next().await {
            write.write_all_buf(&mut bytes).await?;
            write.flush().await?;
        }
        write.shutdown().await
    };
    tokio::select! {
        ended = writing => ended,
        ended = receive(read, &end) => ended,
    }
}

async fn receive(mut read: impl AsyncRead + Unpin, end: &StreamEnd) -> io::Result<()> {
    let mut bytes = BytesMut::new();
    loop {
        while let Some(length) = bytes.first_chunk().map(|prefix| usize::from(u16::from_be_bytes(*prefix)))
            && bytes.len() >= 2 + length.min(MAX_PACKET_BYTES)
        {
            if length > MAX_PACKET_BYTES {
                return Err(io::Error::other("a packet is longer than any of QUIC's"));
            }
            bytes.advance(2);
            let packet = bytes.split_to(length).freeze();
            if end.door.received.send((end.address, packet)).await.is_err() {
                return Ok(());
            }
        }
        bytes.reserve(READ_BYTES);
        if read.read_buf(&mut bytes).await? == 0 {
            return Ok(());
        }
    }
}

/// Packets that wait for a stream. Congestion control bounds them long before, unless the stream stands still.
const MAX_WAITING_BYTES: usize = 4 << 20;
/// Longest packet that is read; those of QUIC have at most 1472 bytes here.
const MAX_PACKET_BYTES: usize = 2048;
/// Room for a read.
const READ_BYTES: usize = 64 << 10;
/// Packets of all streams that wait to be read; then the streams wait.
pub(super) const MAX_RECEIVED: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    fn door() -> (StreamDoor, mpsc::Receiver<Received>) {
        let (received, receiver) = mpsc::channel(MAX_RECEIVED);
        (StreamDoor { streams: Arc::default(), received }, receiver)
    }

    fn address(port: u16) -> SocketAddr {
        super::super::stream_address(([192, 0, 2, 1], port).into())
    }

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
    }

    #[test]
    fn packets_arrive_whole_and_in_order_however_the_stream_cuts_them() {
        runtime().block_on(async {
            // Three bytes a read: no packet comes in one piece.
            let (here, there) = tokio::io::duplex(3);
            let ((near, _stay), (far, mut received)) = (door(), door());
            tokio::spawn(carry(here, near.add(address(1))));
            tokio::spawn(carry(there, far.add(address(2))));
            let packets: Vec<Vec<u8>> = (0..40).map(|n| vec![n as u8; n * 37 % 1500]).collect();
            packets.iter().for_each(|packet| near.streams.send(address(1), packet));
            // The negative control: nobody is at another address.
            near.streams.send(address(7), b"lost");
            for packet in packets {
                assert_eq!(received.recv().await.unwrap(), (address(2), packet.into()));
            }
            assert!(received.try_recv().is_err());
        });
    }

    #[test]
    fn what_waits_is_bounded_and_written_before_the_end() {
        runtime().block_on(async {
            let (near, _stay) = door();
            let end = near.add(address(1));
            for _ in 0..10_000 {
                near.streams.send(address(1), &[7; 1400]);
            }
            let waiting = end.outgoing.waiting().bytes.len();
            assert!(waiting <= MAX_WAITING_BYTES && waiting > MAX_WAITING_BYTES - 2000, "{waiting}");
            near.close(address(1));
            let (here, mut there) = tokio::io::duplex(1 << 16);
            let reading = tokio::spawn(async move {
                let mut all = Vec::new();
                there.read_to_end(&mut all).await.map(|_| all.len())
            });
            carry(here, end).await.unwrap();
            assert_eq!(reading.await.unwrap().unwrap(), waiting);
            assert!(near.streams.lock().is_empty());
        });
    }

    #[test]
    fn a_packet_longer_than_any_ends_its_stream() {
        runtime().block_on(async {
            for (length, is_taken) in [(MAX_PACKET_BYTES, true), (MAX_PACKET_BYTES + 1, false)] {
                let (here, mut there) = tokio::io::duplex(1 << 16);
                let (door, mut received) = door();
                let carrying = tokio::spawn(carry(here, door.add(address(1))));
                let _ = there.write_u16(length as u16).await;
                let _ = there.write_all(&vec![0; length]).await;
                let _ = there.shutdown().await;
                assert_eq!(carrying.await.unwrap().is_ok(), is_taken);
                assert_eq!(received.try_recv().is_ok(), is_taken);
            }
        });
    }

    #[test]
    fn a_stream_carries_one_connection_and_a_newer_stream_takes_its_place() {
        let (door, _stay) = door();
        let first = door.add(address(1));
        assert!(door.begin(address(1)) && !door.begin(address(1)) && !door.begin(address(2)));
        let _second = door.add(address(1));
        drop(first);
        assert!(door.begin(address(1)), "the newer stream is still there");
    }
}
