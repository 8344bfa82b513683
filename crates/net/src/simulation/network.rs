//! A network of one bottleneck, without sockets of the system, on the paused clock of tokio.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::future::Future;
use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use quinn::udp::{EcnCodepoint, RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use tokio::time::{Instant, Sleep};

use crate::conditioner::{AlwaysWritable, Direction, Fate, LinkModel};

/// All packets from the server's machine share one direction of the link, and all packets to it the other.
#[derive(Clone, Debug)]
pub(super) struct Network(Arc<Mutex<Inner>>);

#[derive(Debug)]
struct Inner {
    epoch: Instant,
    server: SocketAddr,
    up: Direction,
    down: Direction,
    /// Whether nothing arrives.
    is_dark: bool,
    inboxes: Vec<(SocketAddr, Inbox)>,
    num_packets: u64,
    traffic: Traffic,
}

/// What went down the link.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Traffic {
    /// Bytes offered, with those that were lost.
    pub(super) bytes: u64,
    pub(super) lost: u64,
    pub(super) dropped: u64,
    /// The wait of each packet in the queue, µs.
    pub(super) queue_micros: Vec<u64>,
    /// A digest of sizes and times.
    pub(super) digest: u64,
}

#[derive(Debug, Default)]
struct Inbox {
    waiting: BinaryHeap<Reverse<InFlight>>,
    waker: Option<Waker>,
}

#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct InFlight {
    at: u64,
    number: u64,
    from: SocketAddr,
    contents: Vec<u8>,
}

impl Network {
    /// The server's socket has this address.
    pub(super) fn new(model: &LinkModel, server: SocketAddr) -> Self {
        Self(Arc::new(Mutex::new(Inner {
            epoch: Instant::now(),
            server,
            up: Direction::new(model, 0),
            down: Direction::new(model, 1),
            is_dark: false,
            inboxes: vec![],
            num_packets: 0,
            traffic: Traffic::default(),
        })))
    }

    pub(super) fn socket(&self, address: SocketAddr) -> Arc<SimulatedSocket> {
        let mut inner = self.lock();
        inner.inboxes.push((address, Inbox::default()));
        let number = inner.inboxes.len() - 1;
        Arc::new(SimulatedSocket { network: self.clone(), number, timer: Mutex::default() })
    }

    /// From now on the link is another one.
    pub(super) fn set_model(&self, model: &LinkModel) {
        let mut inner = self.lock();
        inner.up.set_model(model);
        inner.down.set_model(model);
    }

    /// Whether nothing arrives from now on.
    pub(super) fn set_dark(&self, is_dark: bool) {
        self.lock().is_dark = is_dark;
    }

    /// A socket has another address from now on.
    pub(super) fn readdress(&self, from: SocketAddr, to: SocketAddr) {
        for (address, _) in &mut self.lock().inboxes {
            if *address == from {
                *address = to;
            }
        }
    }

    pub(super) fn traffic(&self) -> Traffic {
        self.lock().traffic.clone()
    }

    /// The same, and begins to count anew.
    pub(super) fn take_traffic(&self) -> Traffic {
        std::mem::take(&mut self.lock().traffic)
    }

    /// Number of packets on their way.
    pub(super) fn num_in_flight(&self) -> usize {
        self.lock().inboxes.iter().map(|(_, inbox)| inbox.waiting.len()).sum()
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    fn now(&self) -> u64 {
        self.epoch.elapsed().as_micros() as u64
    }

    fn send(&mut self, number: usize, transmit: &Transmit<'_>) {
        let now = self.now();
        let (from, bytes) = (self.inboxes[number].0, transmit.contents.len());
        let is_down = from.ip() == self.server.ip();
        let direction = if is_down { &mut self.down } else { &mut self.up };
        let queued = direction.queue_micros(now);
        let fate = direction.offer(now, bytes);
        if is_down {
            let t = &mut self.traffic;
            t.bytes += bytes as u64;
            t.lost += u64::from(fate == Fate::Lost);
            t.dropped += u64::from(fate == Fate::Dropped);
            t.queue_micros.push(queued);
            for value in [now, bytes as u64] {
                t.digest = (t.digest ^ value).wrapping_mul(0x0100_0000_01b3).rotate_left(23);
            }
        }
        let Fate::Arrives(at) = fate else { return };
        if self.is_dark {
            return;
        }
        self.num_packets += 1;
        let packet = InFlight { at, number: self.num_packets, from, contents: transmit.contents.to_vec() };
        let to = self.inboxes.iter_mut().find(|(address, _)| *address == transmit.destination);
        let Some((_, inbox)) = to else { return };
        inbox.waiting.push(Reverse(packet));
        if let Some(waker) = inbox.waker.take() {
            waker.wake();
        }
    }
}

/// A socket of the network.
#[derive(Debug)]
pub(super) struct SimulatedSocket {
    network: Network,
    number: usize,
    timer: Mutex<Option<Pin<Box<Sleep>>>>,
}

impl SimulatedSocket {
    /// Sends bytes that no endpoint made.
    pub(super) fn send_raw(&self, destination: SocketAddr, contents: &[u8]) {
        let transmit = Transmit { destination, ecn: None, contents, segment_size: None, src_ip: None };
        self.network.lock().send(self.number, &transmit);
    }
}

impl AsyncUdpSocket for SimulatedSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Box::pin(AlwaysWritable)
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        self.network.lock().send(self.number, transmit);
        Ok(())
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        loop {
            let (epoch, due);
            {
                let mut inner = self.network.lock();
                let now = inner.now();
                epoch = inner.epoch;
                let (address, inbox) = &mut inner.inboxes[self.number];
                let mut num = 0;
                while num < bufs.len() && inbox.waiting.peek().is_some_and(|Reverse(p)| p.at <= now) {
                    let Some(Reverse(packet)) = inbox.waiting.pop() else { break };
                    let len = packet.contents.len();
                    bufs[num][..len].copy_from_slice(&packet.contents);
                    let ecn: Option<EcnCodepoint> = None;
                    let dst_ip = Some(address.ip());
                    meta[num] = RecvMeta { addr: packet.from, len, stride: len, ecn, dst_ip };
                    num += 1;
                }
                if num > 0 {
                    return Poll::Ready(Ok(num));
                }
                inbox.waker = Some(cx.waker().clone());
                let Some(Reverse(next)) = inbox.waiting.peek() else { return Poll::Pending };
                due = epoch + Duration::from_micros(next.at);
            }
            let mut timer = self.timer.lock().unwrap_or_else(PoisonError::into_inner);
            let timer = timer.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(due)));
            timer.as_mut().reset(due);
            if timer.as_mut().poll(cx).is_pending() {
                return Poll::Pending;
            }
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.network.lock().inboxes[self.number].0)
    }

    fn may_fragment(&self) -> bool {
        false
    }
}
