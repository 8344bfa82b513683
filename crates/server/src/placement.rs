//! Which device makes a viewer's frames. This is pure: it reads no clock and renders nothing.
//!
//! The load of a device is the mean number of orders at it lately, waiting or in work. A viewer comes to the device with
//! the least load, and stays until another has so much less that the step pays.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use isinglass_core::session::admission::ViewerId;

/// The devices of a server, and whose frames they make.
#[derive(Debug)]
pub(crate) struct Placement {
    devices: Vec<Device>,
    viewers: HashMap<ViewerId, Placed>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Device {
    /// Nobody has needed it yet: it holds nothing.
    Idle,
    /// It gets ready, or makes room.
    Busy,
    Ready,
    /// It makes no frames of this volume.
    Lost,
}

#[derive(Debug)]
struct Placed {
    device: usize,
    /// Orders without an answer.
    orders: u32,
    /// Their mean number lately, as of `at`.
    load: f64,
    at: Instant,
    moved: Instant,
}

/// Where the next order of a viewer goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    /// The device to use now: the viewer's own, or another until that is ready. `None` if none is ready.
    pub(crate) device: Option<usize>,
    /// A device that must get ready; it counts as busy from now on.
    pub(crate) start: Option<usize>,
}

impl Placement {
    /// So many devices, at least 1, all idle.
    pub(crate) fn new(num_devices: usize) -> Self {
        Self { devices: vec![Device::Idle; num_devices.max(1)], viewers: HashMap::new() }
    }

    pub(crate) fn state(&self, device: usize) -> Device {
        self.devices[device]
    }

    /// Notes what has become of a device.
    pub(crate) fn set(&mut self, device: usize, state: Device) {
        self.devices[device] = state;
    }

    /// A device makes no more frames of this volume. Returns false if it is the last one: then it stays as it is.
    pub(crate) fn lose(&mut self, device: usize) -> bool {
        let has_others = (0..self.devices.len()).any(|i| i != device && self.devices[i] != Device::Lost);
        if has_others {
            self.devices[device] = Device::Lost;
        }
        has_others
    }

    /// The same, but the last one gets ready again when somebody needs it.
    pub(crate) fn lose_or_rest(&mut self, device: usize) -> bool {
        let has_others = self.lose(device);
        if !has_others {
            self.devices[device] = Device::Idle;
        }
        has_others
    }

    /// The device of a viewer's orders, if it has one.
    pub(crate) fn device_of(&self, viewer: ViewerId) -> Option<usize> {
        self.viewers.get(&viewer).map(|placed| placed.device)
    }

    /// Where the next order of a viewer goes.
    pub(crate) fn place(&mut self, viewer: ViewerId, now: Instant) -> Place {
        self.viewers.values_mut().for_each(|placed| placed.advance(now));
        let own = self.viewers.get(&viewer).filter(|placed| self.devices[placed.device] != Device::Lost);
        let is_usable = |device: Device| device != Device::Lost;
        let device = match own {
            None => self.least(is_usable).unwrap_or(0),
            Some(placed) if now.saturating_duration_since(placed.moved) < STAY => placed.device,
            Some(placed) => {
                let other = self.least(is_usable).unwrap_or(placed.device);
                let pays = self.load(other) + placed.load + MARGIN < self.load(placed.device);
                if pays { other } else { placed.device }
            }
        };
        // One that comes is taken for busy, so that several at once go to different devices.
        let new = || Placed { device, orders: 0, load: 1.0, at: now, moved: now };
        let placed = self.viewers.entry(viewer).or_insert_with(new);
        if placed.device != device {
            (placed.device, placed.moved) = (device, now);
        }
        let start = (self.devices[device] == Device::Idle).then_some(device);
        if let Some(start) = start {
            self.devices[start] = Device::Busy;
        }
        let is_ready = |device: Device| device == Device::Ready;
        let now_at = if is_ready(self.devices[device]) { Some(device) } else { self.least(is_ready) };
        Place { device: now_at, start }
    }

    /// A viewer has another order.
    pub(crate) fn begin(&mut self, viewer: ViewerId, now: Instant) {
        if let Some(placed) = self.viewers.get_mut(&viewer) {
            placed.advance(now);
            placed.orders += 1;
        }
    }

    /// One of its orders is answered.
    pub(crate) fn end(&mut self, viewer: ViewerId, now: Instant) {
        if let Some(placed) = self.viewers.get_mut(&viewer) {
            placed.advance(now);
            placed.orders = placed.orders.saturating_sub(1);
        }
    }

    /// A viewer has left.
    pub(crate) fn forget(&mut self, viewer: ViewerId) {
        self.viewers.remove(&viewer);
    }

    /// Viewers whose orders go to a device.
    pub(crate) fn num_viewers(&self, device: usize) -> usize {
        self.viewers.values().filter(|placed| placed.device == device).count()
    }

    fn load(&self, device: usize) -> f64 {
        self.viewers.values().filter(|placed| placed.device == device).map(|placed| placed.load).sum()
    }

    /// The usable device with the least load, rounded; of several, the first with the fewest viewers.
    fn least(&self, is_usable: impl Fn(Device) -> bool) -> Option<usize> {
        let usable = (0..self.devices.len()).filter(|&i| is_usable(self.devices[i]));
        usable.min_by_key(|&i| ((self.load(i) * STEPS).round() as u64, self.num_viewers(i)))
    }
}

impl Placed {
    /// Brings the mean up to date.
    fn advance(&mut self, now: Instant) {
        let past = now.saturating_duration_since(self.at).as_secs_f64();
        let kept = (-past / MEMORY.as_secs_f64()).exp();
        self.load = self.load * kept + f64::from(self.orders) * (1.0 - kept);
        self.at = self.at.max(now);
    }
}

/// How long what was counts for the load.
const MEMORY: Duration = Duration::from_secs(1);
/// A viewer does not change its device again sooner.
const STAY: Duration = Duration::from_secs(2);
/// How much less load there must be at another device, in orders.
const MARGIN: f64 = 0.25;
/// Loads that are nearer than one part of so many count as equal.
const STEPS: f64 = 16.0;

#[cfg(test)]
mod tests {
    use super::*;

    /// Viewers that always have an order for a share of the time, in steps of 10 ms.
    struct Play {
        placement: Placement,
        now: Instant,
        moves: usize,
    }

    impl Play {
        fn new(num_devices: usize) -> Self {
            let mut placement = Placement::new(num_devices);
            (0..num_devices).for_each(|i| placement.set(i, Device::Ready));
            Self { placement, now: Instant::now(), moves: 0 }
        }

        fn run(&mut self, shares: &[(u32, f64)], seconds: f64) {
            for step in 0..(seconds * 100.0) as u32 {
                for &(viewer, share) in shares {
                    let (viewer, phase) = (ViewerId(viewer), f64::from((step + viewer * 3) % 10) / 10.0);
                    if phase == 0.0 && share > 0.0 {
                        let before = self.placement.device_of(viewer);
                        let place = self.placement.place(viewer, self.now);
                        assert_eq!(place.device, self.placement.device_of(viewer), "all are ready");
                        self.moves += usize::from(before.is_some() && before != place.device);
                        self.placement.begin(viewer, self.now);
                    }
                    if (phase - share).abs() < 0.05 {
                        self.placement.end(viewer, self.now);
                    }
                }
                self.now += Duration::from_millis(10);
            }
        }

        fn devices(&self, viewers: impl Iterator<Item = u32>) -> Vec<usize> {
            viewers.map(|viewer| self.placement.device_of(ViewerId(viewer)).unwrap()).collect()
        }
    }

    fn counts(devices: &[usize], num: usize) -> Vec<usize> {
        (0..num).map(|i| devices.iter().filter(|device| **device == i).count()).collect()
    }

    #[test]
    fn viewers_spread_over_the_devices_and_stay() {
        for (num_viewers, num_devices) in [(2, 2), (8, 4), (7, 3), (1, 4)] {
            let mut play = Play::new(num_devices);
            let shares: Vec<(u32, f64)> = (0..num_viewers).map(|viewer| (viewer, 0.9)).collect();
            play.run(&shares, 20.0);
            let counts = counts(&play.devices(0..num_viewers), num_devices);
            let (least, most) = (counts.iter().min().unwrap(), counts.iter().max().unwrap());
            assert!(most - least <= 1, "{counts:?}");
            assert_eq!(play.moves, 0, "{num_viewers} on {num_devices}");
        }
    }

    #[test]
    fn who_is_left_alone_with_others_moves_where_nobody_works() {
        let mut play = Play::new(2);
        let all: Vec<(u32, f64)> = (0..4).map(|viewer| (viewer, 0.9)).collect();
        play.run(&all, 5.0);
        let devices = play.devices(0..4);
        // The two of one device rest, with answers to all they asked; the others share one.
        for viewer in (0..4).filter(|viewer| devices[*viewer as usize] == 1) {
            play.placement.end(ViewerId(viewer), play.now);
        }
        let busy: Vec<(u32, f64)> =
            all.iter().copied().filter(|(viewer, _)| devices[*viewer as usize] == 0).collect();
        assert_eq!(busy.len(), 2);
        play.run(&busy, 10.0);
        assert_eq!(play.moves, 1, "one of them has moved, once");
        let now = play.devices(busy.iter().map(|(viewer, _)| *viewer));
        assert_ne!(now[0], now[1]);
        // The control: two with little to do share a device, which costs nobody anything.
        let mut play = Play::new(2);
        play.run(&[(0, 0.2), (1, 0.2)], 5.0);
        let alike = play.devices(0..1)[0];
        play.placement.viewers.get_mut(&ViewerId(1)).unwrap().device = alike;
        play.run(&[(0, 0.2), (1, 0.2)], 10.0);
        assert_eq!((play.moves, play.devices(0..2)), (0, vec![alike; 2]));
    }

    #[test]
    fn a_device_gets_ready_when_somebody_needs_it_and_others_help_until_then() {
        let (mut placement, now) = (Placement::new(2), Instant::now());
        placement.set(0, Device::Ready);
        assert_eq!(placement.place(ViewerId(0), now), Place { device: Some(0), start: None });
        assert_eq!(placement.state(1), Device::Idle, "the control: one viewer needs one device");
        assert_eq!(placement.place(ViewerId(1), now), Place { device: Some(0), start: Some(1) });
        assert_eq!(placement.place(ViewerId(1), now), Place { device: Some(0), start: None }, "only once");
        placement.set(1, Device::Ready);
        assert_eq!(placement.place(ViewerId(1), now).device, Some(1));
        assert_eq!(placement.place(ViewerId(0), now).device, Some(0));
    }

    #[test]
    fn the_viewers_of_a_lost_device_go_to_the_others_and_the_last_one_stays() {
        let mut play = Play::new(3);
        let all: Vec<(u32, f64)> = (0..6).map(|viewer| (viewer, 0.9)).collect();
        play.run(&all, 3.0);
        assert!(play.placement.lose(1));
        play.run(&all, 3.0);
        assert_eq!(counts(&play.devices(0..6), 3), [3, 0, 3]);
        assert!(play.placement.lose(0));
        play.run(&all, 3.0);
        assert_eq!(counts(&play.devices(0..6), 3), [0, 0, 6]);
        assert!(!play.placement.lose(2), "the CPU steps in there");
        assert_eq!(play.placement.state(2), Device::Ready);
        // One that is there again is used again.
        play.placement.set(0, Device::Ready);
        play.run(&all, 20.0);
        assert_eq!(counts(&play.devices(0..6), 3), [3, 0, 3]);
    }

    #[test]
    fn without_a_ready_device_there_is_none_and_who_leaves_counts_no_more() {
        let (mut placement, now) = (Placement::new(1), Instant::now());
        assert_eq!(placement.place(ViewerId(0), now), Place { device: None, start: Some(0) });
        let mut play = Play::new(2);
        play.run(&[(0, 0.9)], 1.0);
        play.placement.forget(ViewerId(0));
        play.run(&[(1, 0.9)], 1.0);
        assert_eq!(play.devices(1..2), [0]);
        assert_eq!(play.placement.device_of(ViewerId(0)), None);
    }
}
