//! A socket that applies the fates: packets wait in a heap until they are due, in both directions.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::future::Future;
use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use quinn::udp::{EcnCodepoint, RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use tokio::sync::Notify;
use tokio::time::{Instant, Sleep};

use super::model::{Direction, Fate, LinkModel};

/// Packet counters of one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DirectionCounters {
    /// Packets that entered the link.
    pub offered: u64,
    /// Packets lost by chance.
    pub lost: u64,
    /// Packets that found the queue full.
    pub dropped: u64,
}

/// Packet counters of a link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkCounters {
    /// From client to server.
    pub up: DirectionCounters,
    /// From server to client.
    pub down: DirectionCounters,
}

#[derive(Debug, Default)]
pub(crate) struct SharedCounters {
    up: Counters,
    down: Counters,
}

#[derive(Debug, Default)]
struct Counters {
    offered: AtomicU64,
    lost: AtomicU64,
    dropped: AtomicU64,
}

impl Counters {
    fn count(&self, fate: Fate) {
        self.offered.fetch_add(1, Ordering::Relaxed);
        match fate {
            Fate::Arrives(_) => return,
            Fate::Lost => &self.lost,
            Fate::Dropped => &self.dropped,
        }
        .fetch_add(1, Ordering::Relaxed);
    }

    fn read(&self) -> DirectionCounters {
        DirectionCounters {
            offered: self.offered.load(Ordering::Relaxed),
            lost: self.lost.load(Ordering::Relaxed),
            dropped: self.dropped.load(Ordering::Relaxed),
        }
    }
}

impl SharedCounters {
    pub(crate) fn read(&self) -> LinkCounters {
        LinkCounters { up: self.up.read(), down: self.down.read() }
    }
}

/// Sits between a client's endpoint and its socket. It needs a tokio runtime. Timers tick in milliseconds, so packets
/// come up to 1 ms later than the model says, never earlier.
#[derive(Debug)]
pub(crate) struct ConditionedSocket {
    inner: Arc<dyn AsyncUdpSocket>,
    epoch: Instant,
    up: Arc<Up>,
    down: Mutex<Down>,
    counters: Arc<SharedCounters>,
}

#[derive(Debug)]
struct Up {
    direction: Mutex<Direction>,
    waiting: Mutex<Waiting<SocketAddr>>,
    changed: Notify,
    is_closed: AtomicBool,
}

struct Down {
    direction: Direction,
    waiting: Waiting<RecvMeta>,
    timer: Option<Pin<Box<Sleep>>>,
    scratch: Vec<u8>,
}

impl ConditionedSocket {
    pub(crate) fn new(
        inner: Arc<dyn AsyncUdpSocket>,
        model: &LinkModel,
        counters: Arc<SharedCounters>,
    ) -> Arc<Self> {
        let epoch = Instant::now();
        let up = Arc::new(Up {
            direction: Mutex::new(Direction::new(model, 0)),
            waiting: Mutex::default(),
            changed: Notify::new(),
            is_closed: AtomicBool::new(false),
        });
        tokio::spawn(send_when_due(inner.clone(), up.clone(), epoch));
        let direction = Direction::new(model, 1);
        let down = Down { direction, waiting: Waiting::default(), timer: None, scratch: vec![0; 1 << 16] };
        Arc::new(Self { inner, epoch, up, down: Mutex::new(down), counters })
    }
}

impl Drop for ConditionedSocket {
    fn drop(&mut self) {
        // The last packets still have to travel, among them the one that closes the connection.
        self.up.is_closed.store(true, Ordering::Release);
        self.up.changed.notify_one();
    }
}

impl AsyncUdpSocket for ConditionedSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Box::pin(AlwaysWritable)
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        let now = micros_since(self.epoch);
        let length = transmit.segment_size.unwrap_or(transmit.contents.len()).max(1);
        for contents in transmit.contents.chunks(length) {
            let fate = lock(&self.up.direction).offer(now, contents.len());
            self.counters.up.count(fate);
            if let Fate::Arrives(at) = fate {
                lock(&self.up.waiting).push(at, contents, transmit.ecn, transmit.destination);
            }
        }
        self.up.changed.notify_one();
        Ok(())
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut down = lock(&self.down);
        let Down { direction, waiting, timer, scratch } = &mut *down;
        for round in 0.. {
            let mut one = [RecvMeta::default()];
            let filled = self.inner.poll_recv(cx, &mut [IoSliceMut::new(scratch)], &mut one);
            match filled {
                Poll::Pending => break,
                Poll::Ready(Err(e)) => return Poll::Ready(Err(e)),
                Poll::Ready(Ok(_)) => {}
            }
            let now = micros_since(self.epoch);
            let m = one[0];
            for contents in scratch[..m.len].chunks(m.stride.max(1)) {
                let fate = direction.offer(now, contents.len());
                self.counters.down.count(fate);
                if let Fate::Arrives(at) = fate {
                    waiting.push(at, contents, m.ecn, m);
                }
            }
            if round == MAX_READS {
                // Other tasks get their turn first.
                cx.waker().wake_by_ref();
                break;
            }
        }
        loop {
            let now = micros_since(self.epoch);
            let mut n = 0;
            while n < bufs.len().min(meta.len()) {
                let Some(packet) = waiting.pop_due(now) else { break };
                let length = packet.contents.len();
                // A packet longer than any buffer of the endpoint can only be garbage.
                if let Some(space) = bufs[n].get_mut(..length) {
                    space.copy_from_slice(&packet.contents);
                    meta[n] = RecvMeta { len: length, stride: length, ..packet.peer };
                    n += 1;
                }
            }
            if n > 0 {
                return Poll::Ready(Ok(n));
            }
            let Some(at) = waiting.next_due() else { return Poll::Pending };
            let at = self.epoch + Duration::from_micros(at);
            let sleep = timer.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(at)));
            sleep.as_mut().reset(at);
            if sleep.as_mut().poll(cx).is_pending() {
                return Poll::Pending;
            }
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.inner.local_addr()
    }

    fn may_fragment(&self) -> bool {
        self.inner.may_fragment()
    }
}

/// Sends packets when they are due, until the socket is gone and nothing waits.
async fn send_when_due(socket: Arc<dyn AsyncUdpSocket>, up: Arc<Up>, epoch: Instant) {
    loop {
        let due = lock(&up.waiting).pop_due(micros_since(epoch));
        if let Some(Packet { contents, ecn, peer, .. }) = due {
            let transmit =
                Transmit { destination: peer, ecn, contents: &contents, segment_size: None, src_ip: None };
            while let Err(e) = socket.try_send(&transmit) {
                if e.kind() != io::ErrorKind::WouldBlock {
                    tracing::debug!("a packet could not be sent: {e}");
                    break;
                }
                let mut poller = socket.clone().create_io_poller();
                if std::future::poll_fn(|cx| poller.as_mut().poll_writable(cx)).await.is_err() {
                    break;
                }
            }
            continue;
        }
        let next = lock(&up.waiting).next_due();
        match next {
            Some(at) => {
                tokio::select! {
                    () = tokio::time::sleep_until(epoch + Duration::from_micros(at)) => {}
                    () = up.changed.notified() => {}
                }
            }
            None if up.is_closed.load(Ordering::Acquire) => return,
            None => up.changed.notified().await,
        }
    }
}

/// Packets by due time, and by arrival where that is equal.
#[derive(Debug)]
struct Waiting<P> {
    heap: BinaryHeap<Reverse<Packet<P>>>,
    count: u64,
}

#[derive(Debug)]
struct Packet<P> {
    due: (u64, u64),
    contents: Box<[u8]>,
    ecn: Option<EcnCodepoint>,
    peer: P,
}

impl<P> Default for Waiting<P> {
    fn default() -> Self {
        Self { heap: BinaryHeap::new(), count: 0 }
    }
}

impl<P> Waiting<P> {
    fn push(&mut self, at: u64, contents: &[u8], ecn: Option<EcnCodepoint>, peer: P) {
        if self.heap.len() < MAX_WAITING {
            self.count += 1;
            self.heap.push(Reverse(Packet { due: (at, self.count), contents: contents.into(), ecn, peer }));
        }
    }

    fn pop_due(&mut self, now: u64) -> Option<Packet<P>> {
        if self.next_due()? > now {
            return None;
        }
        self.heap.pop().map(|Reverse(packet)| packet)
    }

    fn next_due(&self) -> Option<u64> {
        self.heap.peek().map(|Reverse(packet)| packet.due.0)
    }
}

impl<P> PartialEq for Packet<P> {
    fn eq(&self, other: &Self) -> bool {
        self.due == other.due
    }
}

impl<P> Eq for Packet<P> {}

impl<P> PartialOrd for Packet<P> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl<P> Ord for Packet<P> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.due.cmp(&other.due)
    }
}

impl std::fmt::Debug for Down {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Down").field("waiting", &self.waiting.heap.len()).finish_non_exhaustive()
    }
}

#[derive(Debug)]
pub(crate) struct AlwaysWritable;

impl UdpPoller for AlwaysWritable {
    fn poll_writable(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

fn micros_since(epoch: Instant) -> u64 {
    epoch.elapsed().as_micros() as u64
}

/// A panic elsewhere leaves the queues in order.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Most waiting packets in one direction: a minute of the longest delay at a megabit a second, and 90 MB at worst.
const MAX_WAITING: usize = 1 << 16;
/// Reads in a row before other tasks get their turn.
const MAX_READS: usize = 64;
