//! Connections before their hello. Their number is bounded, overall and per network. Without room, the one that has
//! waited longest gives way.

use std::collections::VecDeque;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::Instant;

use crate::transport::AUTH_DEADLINE;

#[derive(Debug, Default)]
pub(super) struct PendingHellos {
    room: Mutex<Room>,
}

#[derive(Debug, Default)]
struct Room {
    seats: Vec<Occupied>,
    next: u64,
    /// The last wrong tokens: from where and when.
    wrong: VecDeque<(IpAddr, Instant)>,
}

#[derive(Debug)]
struct Occupied {
    number: u64,
    from: IpAddr,
    since: Instant,
    /// Dropped when another connection takes the seat.
    _stays: oneshot::Sender<()>,
}

/// A seat, given back on drop.
#[derive(Debug)]
pub(super) struct Seat {
    pending: Arc<PendingHellos>,
    number: u64,
    stays: oneshot::Receiver<()>,
}

impl PendingHellos {
    /// A seat for a connection from an address. Who shows many wrong tokens gets none for a while. Without a free seat,
    /// the oldest connection of the same network gives way, or the oldest of all if the room is full. It must have had
    /// the time that a hello takes. `None` if all are too young.
    pub(super) fn enter(self: &Arc<Self>, from: IpAddr, now: Instant) -> Option<Seat> {
        let from = place_of(from);
        let mut room = self.room();
        if room.is_guessing(from, now) {
            return None;
        }
        let is_of_place = |seat: &Occupied| seat.from == from;
        let num_of_place = room.seats.iter().filter(|seat| is_of_place(seat)).count();
        let is_crowded = num_of_place >= MAX_OF_PLACE && !from.is_loopback();
        if is_crowded || room.seats.len() >= MAX_PENDING {
            let first = room.seats.iter().position(|seat| !is_crowded || is_of_place(seat));
            let tired = first.filter(|&i| now.duration_since(room.seats[i].since) >= PATIENCE);
            room.seats.remove(tired?);
        }
        let (sender, stays) = oneshot::channel();
        let number = room.next;
        room.next += 1;
        room.seats.push(Occupied { number, from, since: now, _stays: sender });
        Some(Seat { pending: self.clone(), number, stays })
    }

    /// A connection from an address has shown a token that admits nobody.
    pub(super) fn note_wrong_token(&self, from: IpAddr, now: Instant) {
        let mut room = self.room();
        if room.wrong.len() == MAX_WRONG {
            room.wrong.pop_front();
        }
        room.wrong.push_back((place_of(from), now));
    }

    fn room(&self) -> MutexGuard<'_, Room> {
        // Every change is one step, so a panic leaves the room in order.
        self.room.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Room {
    /// Whether this place has shown too many wrong tokens lately. On this machine, many come through one tunnel.
    fn is_guessing(&self, from: IpAddr, now: Instant) -> bool {
        let is_recent = |(place, at): &&(IpAddr, Instant)| {
            *place == from && now.saturating_duration_since(*at) < GUESSING_PERIOD
        };
        let most = if from.is_loopback() { 10 * MAX_GUESSES } else { MAX_GUESSES };
        self.wrong.iter().filter(is_recent).count() >= most
    }
}

impl Seat {
    /// Returns when another connection has taken the seat.
    async fn is_lost(&mut self) {
        // Nothing is ever sent; only the drop counts.
        let _ = (&mut self.stays).await;
    }

    /// Returns why a connection without a hello is given up, when another has its seat or a hello is long overdue.
    pub(super) async fn is_given_up(&mut self) -> String {
        tokio::select! {
            () = self.is_lost() => "no hello yet, and others want to come in".into(),
            () = tokio::time::sleep(2 * AUTH_DEADLINE) => format!("no hello within {:?}", 2 * AUTH_DEADLINE),
        }
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.pending.room().seats.retain(|seat| seat.number != self.number);
    }
}

/// The network of one owner: an IPv4 address, or 64 bits of IPv6.
pub(super) fn place_of(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(six) if !six.is_loopback() => {
            IpAddr::V6(Ipv6Addr::from_bits(six.to_bits() & !u128::from(u64::MAX)))
        }
        other => other,
    }
}

/// Most connections in handshake or before their hello.
pub(super) const MAX_PENDING: usize = 64;
/// Most of these from one network: eight viewers behind one office address may connect in the same second.
const MAX_OF_PLACE: usize = 8;
/// Time in which nobody gives way: a hello follows a round trip after the handshake, which takes two.
const PATIENCE: Duration = Duration::from_secs(1);
/// Most wrong tokens of one place in a period.
const MAX_GUESSES: usize = 10;
const GUESSING_PERIOD: Duration = Duration::from_secs(30);
/// Wrong tokens that are remembered.
const MAX_WRONG: usize = 1024;

#[cfg(test)]
mod tests {
    use std::future::Future;
    use std::pin::pin;
    use std::task::{Context, Poll, Waker};

    use super::*;

    fn is_lost(seat: &mut Seat) -> bool {
        pin!(seat.is_lost()).poll(&mut Context::from_waker(Waker::noop())) == Poll::Ready(())
    }

    fn four(last: usize) -> IpAddr {
        IpAddr::from([203, 0, (last >> 8) as u8, last as u8])
    }

    #[test]
    fn who_holds_seats_keeps_nobody_out() {
        let (room, start) = (Arc::new(PendingHellos::default()), Instant::now());
        let mut seats: Vec<_> = (0..MAX_PENDING).map(|i| room.enter(four(i), start).unwrap()).collect();
        assert!(room.enter(four(999), start).is_none(), "nobody is sent away at once");
        let late = start + PATIENCE;
        let mut guest = room.enter(four(999), late).unwrap();
        assert!(is_lost(&mut seats[0]) && !is_lost(&mut seats[1]) && !is_lost(&mut guest));
        // The seats of those that have left are free at once.
        seats.truncate(10);
        assert!(room.enter(four(1000), start).is_some());
        assert_eq!(room.room().seats.len(), 10, "one lost its seat, one came and left, and one stays");
    }

    #[test]
    fn one_place_has_few_seats_and_others_keep_theirs() {
        let (room, start) = (Arc::new(PendingHellos::default()), Instant::now());
        let mut other = room.enter(four(1), start).unwrap();
        let of_net = |i: u128| IpAddr::from(Ipv6Addr::from_bits((0x2001_0db8 << 96) + i));
        let mut seats: Vec<_> =
            (0..MAX_OF_PLACE).map(|i| room.enter(of_net(i as u128), start).unwrap()).collect();
        assert!(room.enter(of_net(77), start).is_none());
        assert!(room.enter(of_net(1 << 64), start).is_some(), "another network");
        let _guest = room.enter(of_net(77), start + PATIENCE).unwrap();
        assert!(is_lost(&mut seats[0]) && !is_lost(&mut seats[1]) && !is_lost(&mut other));
        // Whoever comes through a tunnel is of this machine, like everybody else there.
        let local: Vec<_> = (0..2 * MAX_OF_PLACE).map(|_| room.enter([127, 0, 0, 1].into(), start)).collect();
        assert!(local.iter().all(Option::is_some));
    }

    #[test]
    fn who_guesses_tokens_waits_and_others_do_not() {
        let (room, start) = (Arc::new(PendingHellos::default()), Instant::now());
        let later = start + GUESSING_PERIOD;
        for _ in 0..MAX_GUESSES {
            assert!(room.enter(four(1), start).is_some());
            room.note_wrong_token(four(1), start);
        }
        assert!(room.enter(four(1), start).is_none() && room.enter(four(2), start).is_some());
        assert!(room.enter(four(1), later).is_some(), "it may try again");
        // Others on this machine come through the same tunnel, so there the limit is higher, but there is one.
        let local = IpAddr::from([127, 0, 0, 1]);
        let num = (0..1000).take_while(|_| {
            room.note_wrong_token(local, start);
            room.enter(local, start).is_some()
        });
        assert_eq!(num.count(), 10 * MAX_GUESSES - 1);
        // What is remembered is bounded.
        (0..5000).for_each(|i| room.note_wrong_token(four(i), start));
        assert_eq!(room.room().wrong.len(), MAX_WRONG);
    }
}
