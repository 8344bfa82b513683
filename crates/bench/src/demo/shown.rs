//! What a viewer showed along a path: ages of frames, their rate, freezes, and the way to an exact picture.

use std::time::Duration;

use isinglass_client::Standing;
use serde::Serialize;

use super::play::Tick;
use super::script::Script;

/// The figures of a played path.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct ShownFrames {
    /// Time since the displayed frame's pose was set, while the camera moved: mean, median and 99th percentile.
    pub(crate) frame_age_ms_mean: f64,
    pub(crate) frame_age_ms_p50: f64,
    pub(crate) frame_age_ms_p99: f64,
    /// New server frames on the screen a second, while the camera moved.
    pub(crate) frames_per_second: f64,
    /// Number of freezes as in the WebRTC statistics: gaps between new server frames while the camera moved, longer
    /// than three mean gaps and than a mean gap and 150 ms. The time from a movement's start, minus a round trip, and
    /// that to its end count as gaps.
    pub(crate) freezes: usize,
    /// The longest of these gaps, freeze or not.
    pub(crate) longest_gap_ms: f64,
    /// From each stop of the path to the first exact picture; `None` where none came.
    pub(crate) exact_after_ms: Vec<Option<f64>>,
}

impl ShownFrames {
    pub(crate) fn of(script: &Script, ticks: &[Tick], round_trip: Duration) -> Self {
        let ages: Vec<f64> = moving(script, ticks).filter_map(|t| Some(millis(t.frame_age?))).collect();
        let is_new = |pair: &&[Tick]| pair[0].frame != pair[1].frame && script.is_moving(pair[1].at);
        let num_new = ticks.windows(2).filter(is_new).count();
        let moving_seconds = script.moving().as_secs_f64();
        let gaps = Gaps::of(script, ticks, round_trip);
        Self {
            frame_age_ms_mean: ages.iter().sum::<f64>() / ages.len().max(1) as f64,
            frame_age_ms_p50: percentile(ages.clone(), 0.5),
            frame_age_ms_p99: percentile(ages, 0.99),
            frames_per_second: num_new as f64 / moving_seconds.max(1e-3),
            freezes: gaps.freezes(),
            longest_gap_ms: gaps.all().fold(0.0, f64::max) * 1e3,
            exact_after_ms: settle_times(script, ticks).map(|t| t.map(millis)).collect(),
        }
    }

    /// The exact pictures, for people.
    pub(crate) fn exact_in_words(&self) -> String {
        let word = |t: &Option<f64>| t.map_or("never".to_owned(), |ms| format!("{ms:.0} ms"));
        self.exact_after_ms.iter().map(word).collect::<Vec<_>>().join(" and ")
    }
}

/// The refreshes at which the camera moved. A recorded path may stop on its way.
pub(crate) fn moving<'a>(script: &Script, ticks: &'a [Tick]) -> impl Iterator<Item = &'a Tick> {
    let has_moved = |i: usize| i == 0 || ticks[i].input != ticks[i - 1].input;
    ticks.iter().enumerate().filter(move |(i, t)| script.is_moving(t.at) && has_moved(*i)).map(|(_, t)| t)
}

/// Times between new frames while the camera moved, seconds.
struct Gaps {
    /// Between two frames.
    closed: Vec<f64>,
    /// From a start, or to a stop.
    open: Vec<f64>,
}

impl Gaps {
    /// A round trip always passes before the first frame of a movement. A frame of the present pose freezes nothing.
    fn of(script: &Script, ticks: &[Tick], round_trip: Duration) -> Self {
        let (mut closed, mut open) = (Vec::new(), Vec::new());
        // Start of the gap, and whether that is a frame.
        let mut since: Option<(Duration, bool)> = None;
        for pair in ticks.windows(2) {
            let [before, now] = pair else { continue };
            let gap = |until: Duration, from: Duration| until.saturating_sub(from).as_secs_f64();
            match since {
                None if script.is_moving(now.at) => since = Some((now.at + round_trip, false)),
                None => {}
                Some((from, _)) if !script.is_moving(now.at) => {
                    open.push(gap(before.at, from));
                    since = None;
                }
                Some((from, is_frame)) if before.frame != now.frame => {
                    if is_frame { &mut closed } else { &mut open }.push(gap(now.at, from));
                    since = Some((now.at, true));
                }
                Some(_) if now.frame_age == Some(Duration::ZERO) => {
                    since = Some((now.at + round_trip, false));
                }
                Some(_) => {}
            }
        }
        Self { closed, open }
    }

    fn all(&self) -> impl Iterator<Item = f64> {
        self.closed.iter().chain(&self.open).copied()
    }

    fn freezes(&self) -> usize {
        let mean = self.closed.iter().sum::<f64>() / self.closed.len().max(1) as f64;
        self.all().filter(|&gap| gap > (3.0 * mean).max(mean + 0.150)).count()
    }
}

/// For each rest, the time from the camera's last movement to the first exact picture. A recorded path may end with a
/// rest of its own.
fn settle_times(script: &Script, ticks: &[Tick]) -> impl Iterator<Item = Option<Duration>> {
    script.rests().into_iter().map(|rest| {
        let until = &ticks[..ticks.partition_point(|t| t.at < rest.end)];
        let stop = until.windows(2).rposition(|pair| pair[0].input != pair[1].input).map_or(0, |i| i + 1);
        let stopped = until.get(stop)?.at;
        let exact = until[stop..].iter().find(|t| t.standing == Standing::Exact)?;
        Some(exact.at - stopped)
    })
}

/// The least value with at least this share at or below it.
pub(crate) fn percentile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let at = ((values.len() as f64 * share).ceil() as usize).clamp(1, values.len().max(1)) - 1;
    values.get(at).copied().unwrap_or(0.0)
}

pub(crate) fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

#[cfg(test)]
pub(super) mod tests {
    use glam::Vec3;
    use isinglass_core::camera::{Camera, Intrinsics};
    use isinglass_core::ids::FrameId;
    use isinglass_core::orbit::Orbit;
    use isinglass_core::space::Aabb;

    use super::*;
    use crate::demo::script::Motion;

    /// A refresh every 0.1 s; each shows `frame` and is off the input by `late` refreshes.
    pub(crate) fn ticks(frames: &[u32], late: usize) -> Vec<Tick> {
        let bounds = Aabb { min: -Vec3::ONE, max: Vec3::ONE };
        let intrinsics = Intrinsics::perspective(8, 8, 0.7);
        let camera = |i: usize| -> Camera { Orbit::default().turned(i as f32).camera(intrinsics, &bounds) };
        let tick = |(i, &frame): (usize, &u32)| Tick {
            at: Duration::from_millis(100 * i as u64),
            azimuth_degrees: i as f32,
            input: camera(i).pose,
            camera: camera(i.saturating_sub(late)),
            frame: FrameId(frame),
            frame_bytes: u64::from(frame) * 100,
            kept: None,
            older: Vec::new(),
            standing: Standing::Moving,
            frame_age: None,
            turned_degrees: None,
        };
        frames.iter().enumerate().map(tick).collect()
    }

    fn script() -> Script {
        Script::new(Motion::Orbit { start: Orbit::default(), degrees_per_second: 30.0 }, Duration::ZERO)
    }

    #[test]
    fn a_gap_among_steady_frames_is_a_freeze() {
        let steady: Vec<u32> = (1..20).collect();
        let freezes = |frames: &[u32]| {
            ShownFrames::of(&script(), &ticks(frames, 0), Duration::from_millis(200)).freezes
        };
        assert_eq!(freezes(&steady), 0);
        let mut stuck = steady.clone();
        stuck[8..13].fill(8);
        assert_eq!(freezes(&stuck), 1);
        // A server that is slow all the time does not freeze.
        let slow: Vec<u32> = (1..20).map(|i| i / 4).collect();
        assert_eq!(freezes(&slow), 0);
        // One that is there no more, from the start, in the midst or after a frame, does.
        let tail = |n: u32| (1..60).map(|i: u32| i.min(n)).collect::<Vec<_>>();
        assert_eq!([1, 5, 15].map(|n| freezes(&tail(n))), [2, 2, 2], "in both movements");
        let late: Vec<u32> = (1..30).map(|i: u32| if i < 18 { 1 } else { i }).collect();
        assert_eq!(freezes(&late), 1);
    }

    #[test]
    fn the_picture_of_a_camera_that_stops_on_its_way_does_not_freeze() {
        let mut stuck =
            ticks(&(1..20).map(|i| if (8..13).contains(&i) { 8 } else { i }).collect::<Vec<_>>(), 0);
        let shown = |ticks: &[Tick]| ShownFrames::of(&script(), ticks, Duration::ZERO);
        assert_eq!(shown(&stuck).freezes, 1);
        assert!((shown(&stuck).longest_gap_ms - 500.0).abs() < 1e-6, "{:?}", shown(&stuck));
        for tick in &mut stuck[8..13] {
            (tick.frame_age, tick.input) = (Some(Duration::ZERO), tick.camera.pose);
        }
        assert_eq!(shown(&stuck).freezes, 0);
    }

    #[test]
    fn ages_count_while_the_camera_moves_and_exact_pictures_while_it_rests() {
        let mut ticks = ticks(&(1..60).collect::<Vec<_>>(), 0);
        for tick in &mut ticks {
            tick.frame_age = Some(Duration::from_millis(if tick.at.as_millis() < 1900 { 50 } else { 90 }));
        }
        // The first rest begins after two seconds, the second movement after 3.5, and a rest is in it before it ends.
        let inputs: Vec<_> = ticks.iter().map(|t| t.input).collect();
        for (i, tick) in ticks.iter_mut().enumerate() {
            tick.input = inputs[if (20..35).contains(&i) { 20 } else { i.min(50) }];
        }
        ticks[25].standing = Standing::Exact;
        ticks[53].standing = Standing::Exact;
        let shown = ShownFrames::of(&script(), &ticks, Duration::ZERO);
        assert_eq!((shown.frame_age_ms_p50, shown.frame_age_ms_p99), (50.0, 90.0));
        assert_eq!(shown.exact_after_ms, [Some(500.0), Some(300.0)]);
        ticks[53].standing = Standing::Refining;
        let shown = ShownFrames::of(&script(), &ticks, Duration::ZERO);
        assert_eq!(shown.exact_in_words(), "500 ms and never");
        // A new frame at each refresh: ten a second.
        assert!((8.0..=10.0).contains(&shown.frames_per_second), "{shown:?}");
    }

    #[test]
    fn percentiles_are_values_that_occur() {
        let values: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        assert_eq!(percentile(values.clone(), 0.95), 95.0);
        assert_eq!(percentile(values, 1.0), 100.0);
        assert_eq!(percentile(vec![], 0.95), 0.0);
    }
}
