//! Links by name.

use std::fmt;
use std::time::Duration;

use super::model::LinkModel;

/// A kind of link that people have, with typical properties.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NamedLink {
    /// Its name on the command line.
    pub name: &'static str,
    /// What it is, in a few words.
    pub about: &'static str,
    bandwidth_mbit: f64,
    rtt_ms: u64,
    jitter_ms: u64,
    loss: f64,
    burst: f64,
    queue_ms: u64,
}

impl NamedLink {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self {
            name: "wifi",
            about: "a server in the building, over a shared wireless network",
            bandwidth_mbit: 50.0,
            rtt_ms: 10,
            jitter_ms: 8,
            loss: 0.002,
            burst: 3.0,
            queue_ms: 100,
        },
        Self {
            name: "lte",
            about: "a mobile network",
            bandwidth_mbit: 20.0,
            rtt_ms: 60,
            jitter_ms: 15,
            loss: 0.002,
            burst: 3.0,
            queue_ms: 300,
        },
        Self {
            name: "dsl",
            about: "a home line to a server in the same country",
            bandwidth_mbit: 16.0,
            rtt_ms: 30,
            jitter_ms: 2,
            loss: 0.0005,
            burst: 2.0,
            queue_ms: 150,
        },
        Self {
            name: "wan",
            about: "a fast line to another continent",
            bandwidth_mbit: 100.0,
            rtt_ms: 150,
            jitter_ms: 2,
            loss: 0.001,
            burst: 2.0,
            queue_ms: 100,
        },
        Self {
            name: "satellite",
            about: "a satellite that seems to stand still",
            bandwidth_mbit: 20.0,
            rtt_ms: 600,
            jitter_ms: 10,
            loss: 0.005,
            burst: 4.0,
            queue_ms: 300,
        },
        Self {
            name: "lossy",
            about: "a long way on which every fiftieth packet is lost",
            bandwidth_mbit: 50.0,
            rtt_ms: 150,
            jitter_ms: 0,
            loss: 0.02,
            burst: 1.0,
            queue_ms: 200,
        },
    ];

    /// The link with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|link| link.name == name)
    }

    /// Its properties. Packets keep their order.
    pub fn model(&self) -> LinkModel {
        LinkModel {
            rtt: Duration::from_millis(self.rtt_ms),
            jitter: Duration::from_millis(self.jitter_ms),
            loss: self.loss,
            burst: self.burst,
            bandwidth_mbit: Some(self.bandwidth_mbit),
            queue: Duration::from_millis(self.queue_ms),
            ..LinkModel::default()
        }
    }
}

/// What it is, and its figures.
impl fmt::Display for NamedLink {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { about, bandwidth_mbit, rtt_ms, jitter_ms, loss, burst, queue_ms, .. } = self;
        let percent = loss * 100.0;
        write!(
            f,
            "{about}: {bandwidth_mbit} Mbit/s, round trip {rtt_ms} ms, jitter {jitter_ms} ms, loss {percent} % \
             in runs of {burst}, queue {queue_ms} ms"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_is_a_usable_link_of_its_own() {
        for (i, link) in NamedLink::ALL.into_iter().enumerate() {
            assert_eq!(link.model().validate(), Ok(()), "{}", link.name);
            assert_eq!(NamedLink::named(link.name), Some(link));
            let others = NamedLink::ALL.iter().skip(i + 1);
            assert!(others.into_iter().all(|other| other.name != link.name && other.model() != link.model()));
        }
        assert_eq!(NamedLink::named("fibre"), None);
        let lossy = NamedLink::named("lossy").unwrap().to_string();
        assert!(
            lossy.ends_with("50 Mbit/s, round trip 150 ms, jitter 0 ms, loss 2 % in runs of 1, queue 200 ms"),
            "{lossy}"
        );
    }
}
