//! A bad link between two processes: a relay of UDP packets that delays and loses them as a [`LinkModel`] says.

use std::collections::VecDeque;
use std::io::ErrorKind;
use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use isinglass_net::LinkModel;
use isinglass_net::conditioner::{Direction, Fate};

/// See the module. Its threads end with it.
pub(crate) struct Relay {
    address: SocketAddr,
    state: Arc<State>,
}

#[derive(Default)]
struct State {
    viewer: OnceLock<SocketAddr>,
    is_over: AtomicBool,
    lost: AtomicU64,
}

impl Relay {
    /// Stands in front of `server` for one viewer.
    pub(crate) fn new(server: SocketAddr, model: &LinkModel) -> Self {
        let front = UdpSocket::bind(("127.0.0.1", 0)).unwrap();
        let back = UdpSocket::bind(("127.0.0.1", 0)).unwrap();
        back.connect(server).unwrap();
        let (address, state) = (front.local_addr().unwrap(), Arc::<State>::default());
        for (number, from, to) in [(0, &front, &back), (1, &back, &front)] {
            let (from, to) = (from.try_clone().unwrap(), to.try_clone().unwrap());
            let (direction, state) = (Direction::new(model, number), state.clone());
            std::thread::spawn(move || carry(direction, &from, &to, &state));
        }
        Self { address, state }
    }

    /// The port that the viewer connects to.
    pub(crate) fn port(&self) -> u16 {
        self.address.port()
    }

    /// Packets lost so far, both ways.
    pub(crate) fn lost(&self) -> u64 {
        self.state.lost.load(Ordering::Relaxed)
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.state.is_over.store(true, Ordering::Relaxed);
    }
}

/// Carries the packets of one direction, in the order in which they came.
fn carry(mut direction: Direction, from: &UdpSocket, to: &UdpSocket, state: &State) {
    let epoch = Instant::now();
    let now = || epoch.elapsed().as_micros() as u64;
    let mut waiting = VecDeque::<(u64, Vec<u8>)>::new();
    let mut buffer = vec![0; 1 << 16];
    while !state.is_over.load(Ordering::Relaxed) {
        while let Some((_, packet)) = waiting.pop_front_if(|(due, _)| *due <= now()) {
            // Whatever the system does not take is lost like any other packet.
            let _ = match to.peer_addr() {
                Ok(_) => to.send(&packet),
                Err(_) => to.send_to(&packet, state.viewer.get().unwrap()),
            };
        }
        let until_due = waiting.front().map_or(20_000, |(due, _)| due.saturating_sub(now()));
        from.set_read_timeout(Some(Duration::from_micros(until_due.clamp(100, 20_000)))).unwrap();
        match from.recv_from(&mut buffer) {
            Ok((length, sender)) => {
                // The front of the relay learns where the viewer is.
                if from.peer_addr().is_err() {
                    state.viewer.get_or_init(|| sender);
                }
                match direction.offer(now(), length) {
                    Fate::Arrives(due) => waiting.push_back((due, buffer[..length].to_vec())),
                    Fate::Lost | Fate::Dropped => {
                        state.lost.fetch_add(1, Ordering::Relaxed);
                    }
                }
            }
            // Nothing came, or the other side has not begun or has ended.
            Err(e)
                if matches!(
                    e.kind(),
                    ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::ConnectionRefused
                ) => {}
            Err(e) => panic!("the relay: {e}"),
        }
    }
}
