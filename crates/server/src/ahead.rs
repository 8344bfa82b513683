//! Points in time that are read before a viewer requests them, and those that were shown before.
//!
//! A viewer that plays a file requests one time after the other. So the next times in that direction are read while
//! the present one is shown. They take memory within a bound, and the nearest of them come first.

use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::wire::{Choices, Part};

use crate::frame_memory::{FrameMemory, Held};
use crate::paging::Pager;

/// A part that was read and can be shown at once.
#[derive(Debug)]
pub(crate) struct Read {
    pub(crate) scene: Scene,
    /// The look that the part comes with.
    pub(crate) look: Look,
    /// What the file holds, and this part.
    pub(crate) parts: Choices,
    /// Reads the pages, if the volume is read by pages.
    pub(crate) pager: Option<Pager>,
}

impl Read {
    fn bytes(&self) -> u64 {
        self.scene.whole().bytes_in_memory() + self.pager.as_ref().map_or(0, Pager::max_bytes)
    }
}

/// What is read ahead, and what comes next.
#[derive(Debug)]
pub(crate) struct ReadAhead {
    known: Vec<Read>,
    /// Whether times are played forwards; `None` if nobody plays them.
    is_forwards: Option<bool>,
    /// Whether nothing more is read until another part is shown.
    is_full: bool,
    /// Most memory of all volumes, bytes.
    volume_memory: u64,
    frame_memory: FrameMemory,
    /// What is missing of the memory for volumes, and is taken from that for frames.
    held: Held,
}

impl ReadAhead {
    pub(crate) fn new(volume_memory: u64, frame_memory: &FrameMemory) -> Self {
        Self {
            known: Vec::new(),
            is_forwards: None,
            is_full: false,
            volume_memory,
            frame_memory: frame_memory.clone(),
            held: frame_memory.nothing(),
        }
    }

    /// Memory of all that is known, bytes.
    pub(crate) fn bytes(&self) -> u64 {
        self.known.iter().map(Read::bytes).sum()
    }

    /// Most memory for parts that are not shown, bytes. It is what the shown one, of `shown` bytes, and the frames leave.
    /// It is at least a quarter of the memory for frames.
    pub(crate) fn limit(&self, shown: u64) -> u64 {
        self.spare(shown).max(self.frame_memory.limit() / 4)
    }

    fn spare(&self, shown: u64) -> u64 {
        self.volume_memory.saturating_sub(shown).saturating_sub(self.frame_memory.limit())
    }

    /// Takes a part out, if it is known.
    pub(crate) fn take(&mut self, part: &Part) -> Option<Read> {
        let at = self.known.iter().position(|read| read.parts.shown == *part)?;
        Some(self.known.swap_remove(at))
    }

    /// Forgets all parts.
    pub(crate) fn clear(&mut self) {
        self.known.clear();
        self.held.set(0);
    }

    /// Another part is shown now, of `shown` bytes. `before` is the part before it, which may be shown again.
    pub(crate) fn follow(&mut self, before: Option<Read>, now: &Choices, shown: u64) {
        let is_alike = |read: &Read| line_of(&read.parts.shown) == line_of(&now.shown);
        let number = now.num_times.max(1);
        self.is_forwards = before.as_ref().filter(|read| is_alike(read)).and_then(|read| {
            let by = steps(time_of(&read.parts.shown), time_of(&now.shown), number);
            [1, number - 1].contains(&by).then_some(by == 1)
        });
        self.is_full = false;
        self.known.extend(before);
        self.known.retain(|read| is_alike(read) && read.parts.shown != now.shown);
        self.fit(now, shown);
    }

    /// The next time that is worth reading while `now` is shown.
    pub(crate) fn next(&self, now: &Choices) -> Option<Part> {
        let number = now.num_times;
        self.is_forwards.filter(|_| !self.is_full)?;
        let times = (1..number).take(MOST_AHEAD).map(|distance| {
            let by = if self.is_forwards == Some(true) { distance } else { number - distance };
            ((u64::from(time_of(&now.shown)) + u64::from(by)) % u64::from(number)) as u32
        });
        let mut parts = times.map(|time| Part { time: Some(time), ..now.shown });
        parts.find(|part| !self.known.iter().any(|read| read.parts.shown == *part))
    }

    /// Keeps a part that was read ahead while `now` is shown, of `shown` bytes.
    pub(crate) fn add(&mut self, read: Read, now: &Choices, shown: u64) {
        let part = read.parts.shown;
        self.known.push(read);
        self.fit(now, shown);
        // If it went at once, what is farther away would go, too.
        self.is_full = !self.known.iter().any(|read| read.parts.shown == part);
    }

    /// There is no room to read `part`: what is farther away goes. If there is nothing, no more is read.
    pub(crate) fn make_room(&mut self, part: &Part, now: &Choices, shown: u64) {
        let distance = self.distance(part, now);
        match self.farthest(now) {
            Some(at) if self.distance(&self.known[at].parts.shown, now) > distance => {
                self.known.swap_remove(at);
                self.fit(now, shown);
            }
            _ => self.is_full = true,
        }
    }

    /// Reads no more until another part is shown.
    pub(crate) fn rest(&mut self) {
        self.is_full = true;
    }

    /// Drops the farthest parts until the rest is within the bound.
    fn fit(&mut self, now: &Choices, shown: u64) {
        while self.bytes() > self.limit(shown)
            && let Some(at) = self.farthest(now)
        {
            self.known.swap_remove(at);
        }
        self.held.set(self.bytes().saturating_sub(self.spare(shown)));
    }

    fn farthest(&self, now: &Choices) -> Option<usize> {
        (0..self.known.len()).max_by_key(|&i| self.distance(&self.known[i].parts.shown, now))
    }

    /// Steps from the shown time to that of `part`, in the direction that is played.
    fn distance(&self, part: &Part, now: &Choices) -> u32 {
        let (from, to) = (time_of(&now.shown), time_of(part));
        match self.is_forwards {
            Some(false) => steps(to, from, now.num_times),
            _ => steps(from, to, now.num_times),
        }
    }
}

fn time_of(part: &Part) -> u32 {
    part.time.unwrap_or(0)
}

/// All but the time: parts with the same line differ by their time alone.
fn line_of(part: &Part) -> Part {
    Part { time: None, ..*part }
}

/// Steps forwards from one time to another in a circle of so many.
fn steps(from: u32, to: u32, number: u32) -> u32 {
    let (from, to, number) = (u64::from(from), u64::from(to), u64::from(number.max(1)));
    ((to + number - from % number) % number) as u32
}

/// Most times that are read ahead.
const MOST_AHEAD: usize = 64;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use isinglass_core::kernels::march::MarchSettings;
    use isinglass_core::volume::procedural::Builtin;

    use super::*;

    fn choices(time: u32) -> Choices {
        let shown =
            Part { channel: Some(0), time: Some(time), level: Some(0), series: Some(0), ..Part::default() };
        Choices {
            shown,
            num_times: 6,
            num_channels: 2,
            num_series: 1,
            whole_dims: [8; 3],
            ..Choices::default()
        }
    }

    fn read(time: u32) -> Read {
        let transfer = isinglass_formats::load_transfer("shells").unwrap();
        let volume = Arc::new(Builtin::Shells.volume(8));
        let scene = Scene::new(volume, &transfer, MarchSettings::default());
        Read { scene, look: Look::new(transfer), parts: choices(time), pager: None }
    }

    fn times(ahead: &ReadAhead) -> Vec<u32> {
        let mut times: Vec<u32> = ahead.known.iter().map(|read| time_of(&read.parts.shown)).collect();
        times.sort_unstable();
        times
    }

    /// Plays from `from` to `to`, and reads ahead all that there is room for.
    fn play(ahead: &mut ReadAhead, from: u32, to: u32) -> Vec<u32> {
        let (now, bytes) = (choices(to), read(0).bytes());
        let before = read(from);
        ahead.follow(Some(before), &now, bytes);
        let mut order = Vec::new();
        while let Some(part) = ahead.next(&now) {
            if ahead.bytes() + bytes <= ahead.limit(bytes) {
                order.push(time_of(&part));
                ahead.add(read(time_of(&part)), &now, bytes);
            } else {
                ahead.make_room(&part, &now, bytes);
            }
            assert!(ahead.bytes() <= ahead.limit(bytes));
        }
        order
    }

    #[test]
    fn the_nearest_times_are_read_within_the_bound_and_those_before_go_first() {
        let bytes = read(0).bytes();
        // Room for the shown one, for frames, and for three more.
        let memory = FrameMemory::new(4 * bytes - 1);
        let mut ahead = ReadAhead::new(bytes + 4 * bytes - 1 + 3 * bytes, &memory);
        assert_eq!(play(&mut ahead, 0, 1), [2, 3, 4]);
        assert_eq!(times(&ahead), [2, 3, 4]);
        assert!(ahead.take(&choices(2).shown).is_some());
        assert_eq!((play(&mut ahead, 1, 2), times(&ahead)), (vec![5], vec![3, 4, 5]));
        assert!(ahead.take(&choices(3).shown).is_some());
        assert_eq!((play(&mut ahead, 2, 3), times(&ahead)), (vec![0], vec![0, 4, 5]), "it begins anew");
        // Backwards, what lies ahead is what was shown before.
        assert_eq!((play(&mut ahead, 3, 2), times(&ahead)), (vec![1], vec![0, 1, 5]));
        // A jump reads nothing ahead, and another channel forgets all.
        assert_eq!(play(&mut ahead, 2, 5), [0; 0]);
        let mut other = choices(5);
        other.shown.channel = Some(1);
        ahead.follow(Some(read(5)), &other, bytes);
        assert_eq!((times(&ahead).len(), ahead.next(&other)), (0, None));
    }

    #[test]
    fn without_room_nothing_is_read_and_what_frames_lack_is_counted() {
        let bytes = read(0).bytes();
        let memory = FrameMemory::new(8 * bytes);
        // Volumes may take no more than the one that is shown: a quarter of the frames' memory is left.
        let mut ahead = ReadAhead::new(bytes, &memory);
        assert_eq!(play(&mut ahead, 0, 1), [2, 3]);
        assert_eq!(memory.room(), 6 * bytes);
        ahead.clear();
        assert_eq!(memory.room(), 8 * bytes);
        let memory = FrameMemory::new(4 * bytes - 1);
        let mut ahead = ReadAhead::new(bytes, &memory);
        assert_eq!((play(&mut ahead, 0, 1), times(&ahead)), (vec![], vec![]));
        assert_eq!(memory.room(), 4 * bytes - 1);
        // Control: all of a short file fits, and is read once.
        let memory = FrameMemory::new(100 * bytes);
        let mut ahead = ReadAhead::new(0, &memory);
        assert_eq!(play(&mut ahead, 0, 1), [2, 3, 4, 5]);
        for time in [2, 3, 4, 5, 0, 1, 2] {
            let before = (time + 5) % 6;
            assert!(ahead.take(&choices(time).shown).is_some(), "{time}");
            assert_eq!(play(&mut ahead, before, time), [0; 0], "{time}");
        }
    }
}
