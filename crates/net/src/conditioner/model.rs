//! The fate of a packet.

use std::time::Duration;

use rand::rngs::Xoshiro256PlusPlus;
use rand::{RngExt, SeedableRng};

/// A link, the same in both directions.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkModel {
    /// Round-trip delay; each way has half of it.
    pub rtt: Duration,
    /// Greatest additional delay each way, uniformly distributed.
    pub jitter: Duration,
    /// Probability that a packet is lost, each way.
    pub loss: f64,
    /// Mean number of packets that are lost in a row (Gilbert 1960); at most 1 for independent losses.
    pub burst: f64,
    /// Rate each way, 10⁶ bit/s; `None` for no limit.
    pub bandwidth_mbit: Option<f64>,
    /// Longest wait in the queue; packets beyond it are dropped.
    pub queue: Duration,
    /// Whether jitter may let packets overtake each other.
    pub reorder: bool,
    /// Seed of the random numbers.
    pub seed: u64,
}

impl Default for LinkModel {
    /// A link without any effect.
    fn default() -> Self {
        Self {
            rtt: Duration::ZERO,
            jitter: Duration::ZERO,
            loss: 0.0,
            burst: 1.0,
            bandwidth_mbit: None,
            queue: Duration::from_millis(200),
            reorder: false,
            seed: 1,
        }
    }
}

/// Why a link model is invalid.
#[derive(Clone, Debug, thiserror::Error, PartialEq)]
pub enum LinkModelError {
    /// A delay is implausibly long.
    #[error("{what} is {found:?}, expected at most {MAX_DELAY:?}")]
    Delay {
        /// Its name.
        what: &'static str,
        /// Its value.
        found: Duration,
    },
    /// The loss is not a probability below one.
    #[error("loss is {0}, expected 0 to below 1")]
    Loss(f64),
    /// The length of runs of losses is unusable.
    #[error("burst is {0}, expected 0 to 1000 packets")]
    Burst(f64),
    /// The rate is not a positive number.
    #[error("bandwidth is {0} Mbit/s, expected more than 0.001")]
    Bandwidth(f64),
}

impl LinkModel {
    /// Checks what the type cannot express.
    ///
    /// # Errors
    /// Names the first invalid number.
    pub fn validate(&self) -> Result<(), LinkModelError> {
        for (what, found) in [("rtt", self.rtt), ("jitter", self.jitter), ("queue", self.queue)] {
            if found > MAX_DELAY {
                return Err(LinkModelError::Delay { what, found });
            }
        }
        if !(0.0..1.0).contains(&self.loss) {
            return Err(LinkModelError::Loss(self.loss));
        }
        if !(0.0..=1000.0).contains(&self.burst) {
            return Err(LinkModelError::Burst(self.burst));
        }
        match self.bandwidth_mbit {
            Some(b) if !(b > 0.001 && b.is_finite()) => Err(LinkModelError::Bandwidth(b)),
            _ => Ok(()),
        }
    }
}

/// The fate of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// It arrives at this time, µs on the caller's clock.
    Arrives(u64),
    /// It is lost by chance.
    Lost,
    /// It finds the queue full.
    Dropped,
}

/// One direction of a link. Its random numbers depend only on the seed and on the number of earlier packets.
#[derive(Clone, Debug)]
pub struct Direction {
    model: LinkModel,
    rng: Xoshiro256PlusPlus,
    busy_until: f64,
    last_arrival: u64,
    has_lost: bool,
}

impl Direction {
    /// `stream` distinguishes the two directions of a link, which draw independent numbers.
    pub fn new(model: &LinkModel, stream: u64) -> Self {
        let rng = Xoshiro256PlusPlus::seed_from_u64(model.seed ^ stream.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        Self { model: model.clone(), rng, busy_until: 0.0, last_arrival: 0, has_lost: false }
    }

    /// From now on the link has these properties. Packets on their way are not affected.
    #[cfg(test)]
    pub(crate) fn set_model(&mut self, model: &LinkModel) {
        self.model = model.clone();
    }

    /// How long a packet that enters now waits in the queue, µs.
    #[cfg(test)]
    pub(crate) fn queue_micros(&self, now_micros: u64) -> u64 {
        (self.busy_until - now_micros as f64).max(0.0) as u64
    }

    /// A packet with this many bytes of UDP payload enters now.
    pub fn offer(&mut self, now_micros: u64, bytes: usize) -> Fate {
        // Every packet draws both numbers, so that one packet's fate does not shift the others' draws.
        let (luck, lateness): (f64, f64) = (self.rng.random(), self.rng.random());
        let now = now_micros as f64;
        let start = self.busy_until.max(now);
        if start - now > micros(self.model.queue) {
            return Fate::Dropped;
        }
        let on_wire =
            self.model.bandwidth_mbit.map_or(0.0, |mbit| (bytes + IP_UDP_BYTES) as f64 * 8.0 / mbit);
        self.busy_until = start + on_wire;
        // A lost packet has used the pipe all the same.
        self.has_lost = luck < self.chance_of_loss();
        if self.has_lost {
            return Fate::Lost;
        }
        let delay = micros(self.model.rtt) / 2.0 + lateness * micros(self.model.jitter);
        let mut arrival = (self.busy_until + delay).ceil() as u64;
        if !self.model.reorder {
            arrival = arrival.max(self.last_arrival);
            self.last_arrival = arrival;
        }
        Fate::Arrives(arrival)
    }
}

impl Direction {
    /// After a loss, the next packet is lost as often as runs have the wanted mean length. The chance after a packet
    /// that arrived makes up for it.
    fn chance_of_loss(&self) -> f64 {
        let &LinkModel { loss, burst, .. } = &self.model;
        match (burst > 1.0, self.has_lost) {
            (false, _) => loss,
            (true, true) => 1.0 - 1.0 / burst,
            (true, false) => loss / (burst * (1.0 - loss)),
        }
    }
}

fn micros(d: Duration) -> f64 {
    d.as_secs_f64() * 1e6
}

/// Longest delay; more is a typing error.
const MAX_DELAY: Duration = Duration::from_secs(60);
/// Bytes of headers before the payload on an IPv4 link.
const IP_UDP_BYTES: usize = 28;

#[cfg(test)]
mod tests {
    use super::*;

    fn fates(model: &LinkModel, stream: u64, spacing_micros: u64) -> Vec<Fate> {
        let mut d = Direction::new(model, stream);
        (0..10_000).map(|i| d.offer(i * spacing_micros, 1200)).collect()
    }

    fn lossy() -> LinkModel {
        let ms = Duration::from_millis;
        LinkModel { rtt: ms(100), jitter: ms(10), loss: 0.05, ..Default::default() }
    }

    #[test]
    fn the_same_seed_gives_the_same_fates_and_another_does_not() {
        let a = fates(&lossy(), 0, 1000);
        assert_eq!(a, fates(&lossy(), 0, 1000));
        assert_ne!(a, fates(&LinkModel { seed: 2, ..lossy() }, 0, 1000));
        assert_ne!(a, fates(&lossy(), 1, 1000), "both directions draw the same");
        // Other times and sizes do not change which packets are lost.
        let lost = |f: &[Fate]| f.iter().map(|f| *f == Fate::Lost).collect::<Vec<_>>();
        assert_eq!(lost(&a), lost(&fates(&lossy(), 0, 77)));
    }

    #[test]
    fn delays_and_losses_are_those_of_the_model() {
        let f = fates(&lossy(), 0, 1000);
        let delays: Vec<u64> = f
            .iter()
            .zip(0u64..)
            .filter_map(|(f, i)| if let Fate::Arrives(at) = f { Some(at - i * 1000) } else { None })
            .collect();
        assert!(delays.iter().all(|d| (50_000..=60_000).contains(d)));
        let lost = f.iter().filter(|f| **f == Fate::Lost).count();
        // 10 000 draws at 5 %: standard deviation √(10⁴·0.05·0.95) = 22; five of them.
        assert!((390..=610).contains(&lost), "{lost}");
        assert!(
            fates(&LinkModel { loss: 0.0, ..lossy() }, 0, 1000).iter().all(|f| matches!(f, Fate::Arrives(_)))
        );
    }

    #[test]
    fn losses_come_in_runs_of_the_wanted_length() {
        let runs = |burst: f64| {
            let lost: Vec<bool> = (0..20)
                .flat_map(|seed| fates(&LinkModel { burst, seed, ..lossy() }, 0, 1000))
                .map(|fate| fate == Fate::Lost)
                .collect();
            let num_lost = lost.iter().filter(|lost| **lost).count();
            let num_runs = lost.windows(2).filter(|pair| !pair[0] && pair[1]).count();
            (num_lost as f64 / lost.len() as f64, num_lost as f64 / num_runs as f64)
        };
        // 200 000 draws at 5 %, in about 10 000 or 2500 runs.
        let (alone, in_fours) = (runs(1.0), runs(4.0));
        assert!(
            (alone.0 - 0.05).abs() < 0.005 && (in_fours.0 - 0.05).abs() < 0.005,
            "{alone:?} {in_fours:?}"
        );
        assert!((alone.1 - 1.05).abs() < 0.05 && (in_fours.1 - 4.0).abs() < 0.4, "{alone:?} {in_fours:?}");
    }

    #[test]
    fn packets_keep_their_order_unless_asked_otherwise() {
        let arrivals = |reorder| {
            let model = LinkModel { reorder, ..lossy() };
            let all = fates(&model, 0, 100).into_iter();
            all.filter_map(|f| if let Fate::Arrives(at) = f { Some(at) } else { None }).collect::<Vec<_>>()
        };
        assert!(arrivals(false).is_sorted());
        assert!(!arrivals(true).is_sorted());
    }

    #[test]
    fn the_pipe_is_as_wide_and_its_queue_as_long_as_said() {
        let queue = Duration::from_millis(50);
        let model = LinkModel { bandwidth_mbit: Some(10.0), queue, ..Default::default() };
        // 1228 bytes every 500 µs are 19.6 Mbit/s into 10: about half are dropped, the rest arrive at 10.
        let f = fates(&model, 0, 500);
        let arrivals: Vec<u64> =
            f.iter().filter_map(|f| if let Fate::Arrives(at) = f { Some(*at) } else { None }).collect();
        let bits = (arrivals.len() - 1) as f64 * 1228.0 * 8.0;
        let mbit = bits / (arrivals[arrivals.len() - 1] - arrivals[0]) as f64;
        // The pipe is never idle here, so only rounding to whole microseconds remains.
        assert!((mbit - 10.0).abs() < 0.01, "{mbit}");
        let wait = f.iter().zip(0u64..).filter_map(|(f, i)| match f {
            Fate::Arrives(at) => Some(at - i * 500),
            _ => None,
        });
        // The queue and the packet's own time on the wire (983 µs).
        assert!(wait.max().unwrap() <= 50_000 + 984);
        assert!(f.contains(&Fate::Dropped));
    }

    #[test]
    fn unusable_models_are_named() {
        let with = |f: &dyn Fn(&mut LinkModel)| {
            let mut m = lossy();
            f(&mut m);
            m.validate()
        };
        assert_eq!(lossy().validate(), Ok(()));
        assert_eq!(with(&|m| m.loss = 1.0), Err(LinkModelError::Loss(1.0)));
        assert!(matches!(with(&|m| m.loss = f64::NAN), Err(LinkModelError::Loss(_))));
        assert!(matches!(with(&|m| m.burst = f64::NAN), Err(LinkModelError::Burst(_))));
        assert_eq!(with(&|m| m.bandwidth_mbit = Some(0.0)), Err(LinkModelError::Bandwidth(0.0)));
        assert!(matches!(
            with(&|m| m.rtt = Duration::from_secs(61)),
            Err(LinkModelError::Delay { what: "rtt", .. })
        ));
    }
}
