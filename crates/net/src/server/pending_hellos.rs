//! Connections before their hello. Their number is bounded. Without room, the network with the most of them gives one
//! up, or the one that has waited longest does. Nobody is kept out for what others of its network did.

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
    /// A seat for a connection from an address. Without a free seat, the network with the most seats gives up its oldest
    /// one, if it has more than its share. Otherwise the oldest of all gives way, once it has had the time that a hello
    /// takes. `None` if all are too young.
    pub(super) fn enter(self: &Arc<Self>, from: IpAddr, now: Instant) -> Option<Seat> {
        let from = place_of(from);
        let mut room = self.room();
        if room.seats.len() >= MAX_PENDING {
            let leaves = room.oldest_of_a_crowd().or_else(|| {
                let oldest = room.seats.first()?;
                (now.duration_since(oldest.since) >= PATIENCE).then_some(0)
            });
            room.seats.remove(leaves?);
        }
        let (sender, stays) = oneshot::channel();
        let number = room.next;
        room.next += 1;
        room.seats.push(Occupied { number, from, since: now, _stays: sender });
        Some(Seat { pending: self.clone(), number, stays })
    }

    fn room(&self) -> MutexGuard<'_, Room> {
        // Every change is one step, so a panic leaves the room in order.
        self.room.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Room {
    /// The oldest seat of the network with the most, if it has more than its share. Seats are in the order of their age.
    fn oldest_of_a_crowd(&self) -> Option<usize> {
        let num_of = |place: IpAddr| self.seats.iter().filter(|seat| seat.from == place).count();
        let most = self.seats.iter().map(|seat| num_of(seat.from)).max().filter(|most| *most > SHARE)?;
        self.seats.iter().position(|seat| num_of(seat.from) == most)
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
/// Seats that one network keeps while others want them: eight viewers behind one office address may connect in the same
/// second.
const SHARE: usize = 8;
/// Time in which nobody gives way within its share: a hello follows a round trip after the handshake, which takes two.
const PATIENCE: Duration = Duration::from_secs(1);

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
    fn a_crowd_of_one_place_gives_way_at_once_and_others_keep_their_seats() {
        let (room, start) = (Arc::new(PendingHellos::default()), Instant::now());
        let mut other = room.enter(four(1), start).unwrap();
        let of_net = |i: u128| IpAddr::from(Ipv6Addr::from_bits((0x2001_0db8 << 96) + i));
        let mut crowd: Vec<_> =
            (1..MAX_PENDING).map(|i| room.enter(of_net(i as u128), start).unwrap()).collect();
        // Of the same place or another one, whoever comes has a seat, and the oldest of the crowd has none.
        let mut guests = [of_net(77), of_net(1 << 64), four(2)].map(|from| room.enter(from, start).unwrap());
        assert!(crowd[..3].iter_mut().all(is_lost) && !is_lost(&mut crowd[3]) && !is_lost(&mut other));
        assert!(guests.iter_mut().all(|seat| !is_lost(seat)));
        assert_eq!(room.room().seats.len(), MAX_PENDING);
        // The control: places with no more than their share keep it for a while.
        let (room, places) = (Arc::new(PendingHellos::default()), MAX_PENDING / SHARE);
        let _full: Vec<_> = (0..MAX_PENDING).map(|i| room.enter(four(i % places), start).unwrap()).collect();
        assert!(room.enter(four(0), start).is_none() && room.enter(four(999), start).is_none());
        assert!(room.enter(four(999), start + PATIENCE).is_some());
    }
}
