//! Decides when the server begins the next frame, so that it reaches the coder and the network when they are free.
//!
//! Generating, coding and sending each work on a frame of their own. A frame that begins too early waits at the next
//! station and ages. One that begins too late leaves the station idle. So past frames give each station's time, and
//! the next frame begins as late as keeps the slowest station busy. It is then made for the newest pose.

/// The stations that work on a frame, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Station {
    /// Marches and layers it.
    Generate,
    /// Codes it to bytes.
    Code,
    /// Writes it to the network.
    Send,
}

/// Decides when to begin frames. Times are µs on a clock that does not run backwards.
///
/// For each frame and station in order, call `handle_begun` and then `handle_done`. Call `handle_given_up` or
/// `handle_dropped` when the frame stops there. A frame that is sent again starts at the coder.
#[derive(Clone, Debug, Default)]
pub struct Schedule {
    stations: [At; 3],
    begun_at_micros: Option<u64>,
    /// The viewer's decoding time, ns per list.
    decode_nanos_per_list: u16,
}

#[derive(Clone, Copy, Debug, Default)]
struct At {
    time: Estimate,
    /// The start of its current work and the number of lists.
    work: Option<(u64, usize)>,
    /// Number of lists in the frame that waits for it.
    queued: Option<usize>,
}

impl Schedule {
    /// A station begins with a frame of `num_lists` lists.
    pub fn handle_begun(&mut self, now_micros: u64, station: Station, num_lists: usize) {
        let at = &mut self.stations[station as usize];
        (at.work, at.queued) = (Some((now_micros, num_lists)), None);
        if station == Station::Generate {
            self.begun_at_micros = Some(now_micros);
        }
    }

    /// A station has finished its frame, which now waits for the next station. `is_usual` if later frames should take
    /// as long.
    pub fn handle_done(&mut self, now_micros: u64, station: Station, is_usual: bool) {
        let at = &mut self.stations[station as usize];
        let Some((since, num_lists)) = at.work.take() else { return };
        if is_usual {
            at.time.add(now_micros.saturating_sub(since) as f64 / num_lists.max(1) as f64);
        }
        if let Some(next) = self.stations.get_mut(station as usize + 1) {
            next.queued = Some(num_lists);
        }
    }

    /// The frame at a station stops there.
    pub fn handle_given_up(&mut self, station: Station) {
        self.stations[station as usize].work = None;
    }

    /// The frame that waits for a station stops there.
    pub fn handle_dropped(&mut self, station: Station) {
        self.stations[station as usize].queued = None;
    }

    /// Sets the viewer's decoding time; 0 if unknown.
    pub fn handle_decoding(&mut self, nanos_per_list: u16) {
        self.decode_nanos_per_list = nanos_per_list;
    }

    /// When to begin a frame of `num_lists` lists, at `now` or later. `None` while another one is generated or waits
    /// for the coder. Ask again after any event, and at that time: stations may take longer than expected.
    pub fn begin_at(&self, now_micros: u64, num_lists: usize) -> Option<u64> {
        let [generate, code, send] = &self.stations;
        if generate.work.is_some() || code.queued.is_some() {
            return None;
        }
        let takes = |at: &At| at.time.micros(num_lists);
        let coder_free = code.free_at(now_micros, now_micros);
        let sender_free = send.free_at(now_micros, now_micros);
        // Frames at the coder and behind it are sent first.
        let before = code.work.map(|(_, lists)| lists);
        let sender_free =
            before.map_or(sender_free, |lists| coder_free.max(sender_free) + send.time.micros(lists));
        // An idle station costs more than a short wait, so the frame begins a little earlier.
        let early = generate.time.micros(num_lists) + generate.time.spread(num_lists);
        let for_coder = coder_free.saturating_sub(early);
        let for_sender = sender_free.saturating_sub(early + takes(code));
        let decoding = u64::from(self.decode_nanos_per_list) * num_lists as u64 / 1000;
        let for_viewer = self.begun_at_micros.map_or(0, |at| at + decoding);
        Some(for_coder.max(for_sender).max(for_viewer).max(now_micros))
    }
}

impl At {
    /// When it finishes its current and waiting work, at `now` or later, if nothing begins before `from`.
    fn free_at(&self, now_micros: u64, from_micros: u64) -> u64 {
        let working = self.work.map_or(from_micros, |(since, lists)| {
            let expected = since + self.time.micros(lists);
            // Work that is late may be as late again, so a stalled network gets no frames.
            expected.max(now_micros + now_micros.saturating_sub(expected))
        });
        working + self.queued.map_or(0, |lists| self.time.micros(lists))
    }
}

/// Time per list, µs: a moving mean, and the mean deviation from it.
#[derive(Clone, Copy, Debug, Default)]
struct Estimate {
    mean: Option<f64>,
    spread: f64,
}

impl Estimate {
    fn add(&mut self, value: f64) {
        let mean = self.mean.get_or_insert(value);
        let off = value - *mean;
        *mean += GAIN * off;
        self.spread += GAIN * (off.abs() - self.spread);
    }

    fn micros(&self, num_lists: usize) -> u64 {
        (self.mean.unwrap_or(0.0) * num_lists as f64) as u64
    }

    fn spread(&self, num_lists: usize) -> u64 {
        (self.spread * num_lists as f64) as u64
    }
}

/// Weight of the newest time: about the last eight count.
const GAIN: f64 = 0.125;

#[cfg(test)]
mod tests {
    use super::*;

    /// What a pipeline with stations of constant times made.
    struct Run {
        /// For each frame: when it was begun, generated, taken up by the coder, coded, taken up by the sender, sent;
        /// ms.
        frames: Vec<[u64; 6]>,
    }

    const LISTS: usize = 1000;

    /// Plays `seconds` in steps of a tenth of a millisecond, with a new pose each `pose_ms`.
    fn run(times_ms: [u64; 3], pose_ms: u64, seconds: u64, times_at: impl Fn(u64, usize) -> u64) -> Run {
        let mut schedule = Schedule::default();
        let mut frames: Vec<[u64; 6]> = vec![];
        // The frame at each station, and the one in front of it.
        let (mut at, mut waits): ([Option<usize>; 3], [Option<usize>; 3]) = ([None; 3], [None; 3]);
        let mut answered = None;
        let stations = [Station::Generate, Station::Code, Station::Send];
        for now in (0..seconds * 1_000_000).step_by(100) {
            for (i, &station) in stations.iter().enumerate().rev() {
                if let Some(frame) = at[i]
                    && now >= frames[frame][2 * i] + times_at(now, i).max(times_ms[i] * 1000)
                {
                    frames[frame][2 * i + 1] = now;
                    at[i] = None;
                    schedule.handle_done(now, station, true);
                    if i < 2 {
                        assert_eq!(waits[i + 1], None, "two frames wait for one station");
                        waits[i + 1] = Some(frame);
                    }
                }
            }
            for (i, &station) in stations.iter().enumerate().skip(1) {
                let may_begin = at[i].is_none() && (i == 2 || waits[2].is_none());
                if may_begin && let Some(frame) = waits[i].take() {
                    frames[frame][2 * i] = now;
                    at[i] = Some(frame);
                    schedule.handle_begun(now, station, LISTS);
                }
            }
            let pose = now / (pose_ms * 1000);
            if answered != Some(pose) && schedule.begin_at(now, LISTS).is_some_and(|at| at <= now) {
                answered = Some(pose);
                at[0] = Some(frames.len());
                frames.push([now, 0, 0, 0, 0, 0]);
                schedule.handle_begun(now, Station::Generate, LISTS);
            }
        }
        frames.retain(|frame| frame[5] > 0);
        Run { frames }
    }

    fn steady(times_ms: [u64; 3], pose_ms: u64) -> Run {
        let run = run(times_ms, pose_ms, 4, |_, _| 0);
        // The first frames teach.
        Run { frames: run.frames[run.frames.len() / 4..].to_vec() }
    }

    impl Run {
        fn frames_per_second(&self) -> f64 {
            let [first, last] = [self.frames[0][5], self.frames[self.frames.len() - 1][5]];
            (self.frames.len() - 1) as f64 * 1e6 / (last - first) as f64
        }

        /// Of a frame's life, ms.
        fn longest_wait(&self) -> f64 {
            let wait = |f: &[u64; 6]| (f[2] - f[1]) + (f[4] - f[3]);
            self.frames.iter().map(wait).max().unwrap_or(0) as f64 / 1e3
        }
    }

    #[test]
    fn the_slowest_station_is_busy_and_no_frame_waits() {
        for times in [[2, 6, 1], [19, 35, 2], [5, 20, 33], [40, 10, 10], [20, 20, 20], [1, 2, 50]] {
            let run = steady(times, 4);
            let slowest = *times.iter().max().unwrap() as f64;
            let rate = run.frames_per_second();
            assert!(rate > 0.93e3 / (slowest + 0.2), "{times:?}: {rate} frames a second");
            // Poses come each 4 ms, and time goes by tenths.
            assert!(run.longest_wait() <= 2.0, "{times:?}: a frame waits for {} ms", run.longest_wait());
        }
        // A pipeline that is faster than the poses answers each of them at once.
        let run = steady([2, 6, 1], 16);
        assert!((run.frames_per_second() - 62.5).abs() < 1.0, "{}", run.frames_per_second());
        assert!(run.longest_wait() <= 0.3);
    }

    #[test]
    fn a_network_that_stands_still_is_fed_once_and_not_again() {
        // Nothing is sent between 1 s and 2 s.
        let run = run([5, 10, 5], 4, 4, |now, station| {
            if station == 2 && (1_000_000..2_000_000).contains(&now) { u64::MAX / 2 } else { 0 }
        });
        let begun = run.frames.iter().filter(|f| (1_050_000..2_000_000).contains(&f[0])).count();
        assert!(begun <= 1, "{begun} frames are begun while none is sent");
        // And goes on at once.
        let next = run.frames.iter().find(|f| f[0] >= 2_000_000).unwrap();
        assert!(next[0] < 2_020_000, "{next:?}");
    }

    #[test]
    fn the_viewer_is_sent_no_more_than_it_decodes() {
        let mut schedule = Schedule::default();
        schedule.handle_begun(1000, Station::Generate, LISTS);
        schedule.handle_done(2000, Station::Generate, true);
        schedule.handle_begun(2000, Station::Code, LISTS);
        schedule.handle_done(3000, Station::Code, true);
        assert_eq!(schedule.begin_at(2500, LISTS), Some(2500));
        schedule.handle_decoding(30_000);
        assert_eq!(schedule.begin_at(2500, LISTS), Some(31_000));
    }

    #[test]
    fn larger_frames_take_longer_and_unusual_ones_teach_nothing() {
        let mut schedule = Schedule::default();
        let mut once = |lists: usize, is_usual: bool| {
            schedule.handle_begun(0, Station::Code, lists);
            schedule.handle_done(10 * lists as u64, Station::Code, is_usual);
            schedule.handle_begun(0, Station::Send, lists);
            schedule.handle_done(0, Station::Send, is_usual);
        };
        once(100, true);
        once(100, false);
        schedule.handle_begun(0, Station::Code, 50);
        assert_eq!(schedule.begin_at(0, 50), Some(500));
        // What waits for the coder is in the way of another.
        schedule.handle_begun(0, Station::Generate, 50);
        assert_eq!(schedule.begin_at(0, 50), None);
        schedule.handle_done(0, Station::Generate, true);
        assert_eq!(schedule.begin_at(0, 50), None);
        // Of two that are given up, nothing is left.
        schedule.handle_dropped(Station::Code);
        assert_eq!(schedule.begin_at(0, 50), Some(500));
        schedule.handle_given_up(Station::Code);
        assert_eq!(schedule.begin_at(0, 50), Some(0));
    }
}
