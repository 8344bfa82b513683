//! Whose work comes next on the rendering thread. Viewers share its time, however long their pieces of work are.

use std::collections::HashMap;

use isinglass_core::session::admission::ViewerId;

/// Start-time fair queueing: next is the viewer whose turn starts first in a virtual time, in which everyone's clock
/// goes on by the work done for them alone.
#[derive(Debug, Default)]
pub(crate) struct Turns {
    /// The start of the latest turn, µs of virtual time.
    now: u64,
    /// The start of each viewer's next turn.
    next: HashMap<ViewerId, u64>,
}

impl Turns {
    /// A viewer that had no work has some. It has saved nothing up while it had none.
    pub(crate) fn enter(&mut self, viewer: ViewerId) {
        let start = self.next.entry(viewer).or_default();
        *start = self.now.max(*start);
    }

    /// The place of the next one among the viewers of waiting work; the first of several with equal claims.
    pub(crate) fn choose(&mut self, waiting: impl Iterator<Item = ViewerId>) -> Option<usize> {
        let start = |viewer| self.next.get(&viewer).copied().unwrap_or(self.now);
        let (place, start) =
            waiting.enumerate().map(|(i, viewer)| (i, start(viewer))).min_by_key(|(_, at)| *at)?;
        self.now = self.now.max(start);
        Some(place)
    }

    /// A turn of this viewer took `micros`.
    pub(crate) fn charge(&mut self, viewer: ViewerId, micros: u64) {
        let now = self.now;
        *self.next.entry(viewer).or_insert(now) += micros;
        if self.next.len() > MAX_REMEMBERED {
            self.next.retain(|_, start| *start > now);
        }
    }
}

/// Viewers with a history. Those beyond are forgotten once it no longer counts.
const MAX_REMEMBERED: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    /// The time that each viewer gets if all always have work, in pieces of these lengths, and their longest wait.
    fn shares(pieces: &[u64], until: u64) -> (Vec<u64>, Vec<u64>) {
        let mut turns = Turns::default();
        let viewers: Vec<ViewerId> = (0..pieces.len() as u32).map(ViewerId).collect();
        viewers.iter().for_each(|v| turns.enter(*v));
        let (mut used, mut last, mut waits, mut now) =
            (vec![0; pieces.len()], vec![0; pieces.len()], vec![0; pieces.len()], 0);
        while now < until {
            let i = turns.choose(viewers.iter().copied()).unwrap();
            waits[i] = waits[i].max(now - last[i]);
            now += pieces[i];
            (used[i], last[i]) = (used[i] + pieces[i], now);
            turns.charge(viewers[i], pieces[i]);
        }
        (used, waits)
    }

    #[test]
    fn viewers_share_time_and_not_turns() {
        let (used, waits) = shares(&[100, 1000, 37], 300_000);
        for time in &used {
            assert!((95_000..=105_000).contains(time), "{used:?}");
        }
        // The one with short pieces waits for no more than a few long ones.
        assert!(waits[2] <= 2200, "{waits:?}");
        // The control: turns in a row would give the second one most of the time.
        let in_a_row = 1000 * 300_000 / (100 + 1000 + 37);
        assert!(in_a_row > 2 * used[1]);
    }

    #[test]
    fn an_idle_viewer_saves_nothing_up_and_owes_what_it_used() {
        let (mut turns, busy, idle) = (Turns::default(), ViewerId(1), ViewerId(2));
        turns.enter(busy);
        for _ in 0..100 {
            assert_eq!(turns.choose([busy].into_iter()), Some(0));
            turns.charge(busy, 1000);
        }
        turns.enter(idle);
        let mut order = Vec::new();
        for _ in 0..6 {
            let both = [busy, idle];
            let i = turns.choose(both.into_iter()).unwrap();
            order.push(both[i].0);
            turns.charge(both[i], 1000);
        }
        // It comes first, and then they alternate: it has not saved up a hundred turns.
        assert_eq!(order[0], 2);
        assert_eq!(order.iter().filter(|v| **v == 2).count(), 3, "{order:?}");
        // Who leaves and comes back at once has no fresh start.
        turns.charge(idle, 50_000);
        turns.enter(idle);
        for _ in 0..40 {
            assert_eq!(turns.choose([idle, busy].into_iter()), Some(1));
            turns.charge(busy, 1000);
        }
    }

    #[test]
    fn histories_are_bounded() {
        let mut turns = Turns::default();
        for i in 1..10_000 {
            let both = [ViewerId(0), ViewerId(i)];
            both.into_iter().for_each(|viewer| turns.enter(viewer));
            for _ in 0..3 {
                let place = turns.choose(both.into_iter()).unwrap();
                turns.charge(both[place], 10);
            }
        }
        assert!(turns.next.len() <= MAX_REMEMBERED + 1);
        assert_eq!(turns.choose(std::iter::empty()), None);
    }
}
