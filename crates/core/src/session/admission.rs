//! Admits viewers: each token has one place, bound to the first client that uses it.
//!
//! A token of a link admits one viewer. The first client that shows it binds the place to its own secret, the
//! *instance*. It gets a ticket that replaces the token, and every later admission rotates the ticket. The token
//! before the newest still admits the same instance, because the connection may break before the welcome with the
//! newer one arrives. Nobody else can use it.

use crate::wire::{PROTOCOL_VERSION, Refusal, Token};

/// Number of a viewer, the same for all of its connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ViewerId(pub u32);

/// The places of a server.
#[derive(Debug, Default)]
pub struct Admission {
    places: Vec<ViewerPlace>,
}

#[derive(Debug)]
struct ViewerPlace {
    /// The token in the link, kept only to tell its second user what happened.
    link: Token,
    current: Token,
    bound: Option<Bound>,
}

#[derive(Debug)]
struct Bound {
    instance: Token,
    previous: Token,
}

impl Admission {
    /// Adds a place for one viewer with this token; `None` if there are already [`MAX_PLACES`].
    pub fn add(&mut self, token: Token) -> Option<ViewerId> {
        if self.places.len() >= MAX_PLACES {
            return None;
        }
        self.places.push(ViewerPlace { link: token.clone(), current: token, bound: None });
        Some(ViewerId(self.places.len() as u32 - 1))
    }

    /// Decides on a hello. `ticket` must be fresh random bytes; on success it becomes the viewer's token. A viewer
    /// for whom `is_full` finds no room keeps its token.
    ///
    /// # Errors
    /// What to tell the client.
    pub fn admit(
        &mut self,
        protocol: u32,
        token: &Token,
        instance: &Token,
        ticket: &Token,
        is_full: impl FnOnce(ViewerId) -> Option<Refusal>,
    ) -> Result<ViewerId, Refusal> {
        if protocol != PROTOCOL_VERSION {
            return Err(Refusal::Version { server: PROTOCOL_VERSION, client: protocol });
        }
        let (mut found, mut used) = (None, false);
        // Comparing every place in full keeps the time constant.
        for (i, place) in self.places.iter().enumerate() {
            let current = place.current.matches(token);
            let link = place.link.matches(token);
            let good = match &place.bound {
                None => current,
                Some(b) => b.instance.matches(instance) & (current | b.previous.matches(token)),
            };
            used |= current | link;
            if good {
                found = Some(i);
            }
        }
        let Some(i) = found else {
            return Err(if used { Refusal::TokenUsed } else { Refusal::UnknownToken });
        };
        let viewer = ViewerId(i as u32);
        if let Some(refusal) = is_full(viewer) {
            return Err(refusal);
        }
        self.places[i].bound = Some(Bound { instance: instance.clone(), previous: token.clone() });
        self.places[i].current = ticket.clone();
        Ok(viewer)
    }

    /// Number of places whose token is used.
    pub fn num_used(&self) -> usize {
        self.places.iter().filter(|place| place.bound.is_some()).count()
    }
}

/// Most places that a server can have.
pub const MAX_PLACES: usize = 10_000;

#[cfg(test)]
mod tests {
    use super::*;

    fn t(n: u8) -> Token {
        Token::new([n; 16])
    }

    fn admit(
        a: &mut Admission,
        protocol: u32,
        token: &Token,
        instance: &Token,
        ticket: &Token,
    ) -> Result<ViewerId, Refusal> {
        a.admit(protocol, token, instance, ticket, |_| None)
    }

    #[test]
    fn who_finds_no_room_has_not_spent_the_token() {
        let mut a = Admission::default();
        let viewer = a.add(t(1)).unwrap();
        let v = PROTOCOL_VERSION;
        let full = a.admit(v, &t(1), &t(100), &t(10), |asked| {
            assert_eq!(asked, viewer);
            Some(Refusal::Full(1))
        });
        assert_eq!((full, a.num_used()), (Err(Refusal::Full(1)), 0));
        assert_eq!(admit(&mut a, v, &t(1), &t(101), &t(11)), Ok(viewer), "another one comes with it");
        assert_eq!(a.num_used(), 1);
        // Who is known and finds no room may come back with the same ticket.
        assert!(a.admit(v, &t(11), &t(101), &t(12), |_| Some(Refusal::Full(1))).is_err());
        assert_eq!(admit(&mut a, v, &t(11), &t(101), &t(13)), Ok(viewer));
    }

    #[test]
    fn a_token_lets_in_one_viewer_who_may_come_back() {
        let mut a = Admission::default();
        let first = a.add(t(1)).unwrap();
        let second = a.add(t(2)).unwrap();
        let v = PROTOCOL_VERSION;
        assert_eq!(admit(&mut a, v, &t(9), &t(100), &t(10)), Err(Refusal::UnknownToken));
        assert_eq!(admit(&mut a, v, &t(1), &t(100), &t(10)), Ok(first));
        // Another viewer with the same link, or with a stolen ticket.
        assert_eq!(admit(&mut a, v, &t(1), &t(101), &t(11)), Err(Refusal::TokenUsed));
        assert_eq!(admit(&mut a, v, &t(10), &t(101), &t(11)), Err(Refusal::TokenUsed));
        // Its welcome was lost: the token still counts for the same instance.
        assert_eq!(admit(&mut a, v, &t(1), &t(100), &t(12)), Ok(first));
        // Its ticket; the one that was lost is dead.
        assert_eq!(admit(&mut a, v, &t(12), &t(100), &t(13)), Ok(first));
        assert_eq!(admit(&mut a, v, &t(10), &t(100), &t(14)), Err(Refusal::UnknownToken));
        // The link's token is two rotations old.
        assert_eq!(admit(&mut a, v, &t(13), &t(100), &t(14)), Ok(first));
        assert_eq!(admit(&mut a, v, &t(1), &t(100), &t(15)), Err(Refusal::TokenUsed));
        assert_eq!(admit(&mut a, v, &t(2), &t(101), &t(16)), Ok(second));
    }

    #[test]
    fn another_version_is_refused_before_the_token_is_spent() {
        let mut a = Admission::default();
        a.add(t(1)).unwrap();
        let other = PROTOCOL_VERSION + 1;
        assert!(
            matches!(admit(&mut a, other, &t(1), &t(2), &t(3)), Err(Refusal::Version { client, .. }) if client == other)
        );
        assert!(admit(&mut a, PROTOCOL_VERSION, &t(1), &t(2), &t(3)).is_ok());
    }
}
