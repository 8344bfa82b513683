//! Slices through the volume: the viewer lists what it wants, and the server sends one after another.
//!
//! | message | content |
//! |---|---|
//! | [`ClientMessage::WantSlices`] | all slices that are wanted now, the most urgent first; at most 30 a second |
//! | stream `IGSL` | the values of one slice; see [`crate::wire::slice`] |
//!
//! A later list replaces the one before: what it leaves out is given up. A slice that has come is kept until others
//! need its memory or another volume comes.

use std::collections::VecDeque;
use std::sync::Arc;

use super::pace::Pace;
use crate::ids::{LookVersion, SliceId};
use crate::volume::{Slice, SliceSpec};
use crate::wire::slice::MAX_WANTED_SLICES;
use crate::wire::{ClientMessage, ServerMessage, SliceRequest, VolumeDescription, WantedSlices};

/// The client's half: what is wanted, and what has come.
#[derive(Debug)]
pub struct SlicesClient {
    newest: SliceId,
    wanted: Vec<SliceRequest>,
    /// Those of `wanted` whose stream is read, once for each stream.
    reading: Vec<SliceId>,
    /// How often each slice has failed on this connection.
    failures: Vec<(SliceSpec, u8)>,
    outbox: Pace<()>,
    /// The volume, and the look version with which it came.
    volume: Option<(LookVersion, VolumeDescription)>,
    /// The last used is at the end.
    kept: VecDeque<KeptSlice>,
    num_kept_bytes: usize,
}

/// A slice that has come.
#[derive(Debug)]
struct KeptSlice {
    spec: SliceSpec,
    slice: Arc<Slice>,
    /// Whether a finer one follows.
    is_draft: bool,
}

impl Default for SlicesClient {
    fn default() -> Self {
        Self {
            newest: SliceId(0),
            wanted: Vec::new(),
            reading: Vec::new(),
            failures: Vec::new(),
            outbox: Pace::new(PERIOD_MICROS),
            volume: None,
            kept: VecDeque::new(),
            num_kept_bytes: 0,
        }
    }
}

impl SlicesClient {
    /// A slice that has come.
    pub fn get(&self, spec: &SliceSpec) -> Option<Arc<Slice>> {
        self.kept.iter().rev().find(|kept| kept.spec == *spec).map(|kept| kept.slice.clone())
    }

    /// Whether [`SlicesClient::want`] of this list changes anything.
    pub fn is_news(&self, specs: &[(SliceSpec, bool)]) -> bool {
        let missing = self.missing(specs);
        !missing.eq(self.wanted.iter().map(|w| (w.spec, w.is_ahead)))
    }

    /// Lists the slices that are wanted now, the most urgent first, and whether each is only for later. At most
    /// [`MAX_WANTED_SLICES`] are requested. Those that have come stay longest.
    pub fn want(&mut self, specs: &[(SliceSpec, bool)]) {
        for (spec, _) in specs.iter().rev() {
            if let Some(at) = self.kept.iter().position(|kept| kept.spec == *spec) {
                let used = self.kept.remove(at);
                self.kept.extend(used);
            }
        }
        let missing: Vec<_> = self.missing(specs).collect();
        let request = |(spec, is_ahead): (SliceSpec, bool)| {
            let before = self.wanted.iter().find(|w| w.spec == spec).map(|w| w.id);
            let id = before.unwrap_or_else(|| {
                self.newest = self.newest.next();
                self.newest
            });
            SliceRequest { id, spec, is_ahead }
        };
        let wanted: Vec<_> = missing.into_iter().map(request).collect();
        self.reading.retain(|id| wanted.iter().any(|w| w.id == *id));
        if wanted != self.wanted {
            self.wanted = wanted;
            self.outbox.offer(Some(()));
        }
    }

    /// Whether a slice is still wanted.
    pub fn wants(&self, id: SliceId) -> bool {
        self.wanted.iter().any(|w| w.id == id)
    }

    /// The stream of a slice begins. Returns its columns and rows if it is worth reading: the slice is wanted, and few
    /// other streams of it are read.
    pub fn begin(&mut self, id: SliceId) -> Option<[u32; 2]> {
        let volume = &self.volume.as_ref()?.1;
        let wanted = self.wanted.iter().find(|w| w.id == id)?;
        if self.reading.iter().filter(|other| **other == id).count() == MAX_READING {
            return None;
        }
        self.reading.push(id);
        Some(wanted.spec.grid(volume.dims, volume.spacing.into()).size)
    }

    /// The stream of a slice was unusable. It is requested again, but not for ever.
    pub fn handle_failed(&mut self, id: SliceId) {
        let Some(at) = self.wanted.iter().position(|w| w.id == id) else { return };
        let spec = self.wanted.remove(at).spec;
        self.reading.retain(|other| *other != id);
        if let Some((_, num)) = self.failures.iter_mut().find(|(failed, _)| *failed == spec) {
            *num = num.saturating_add(1);
        } else if self.failures.len() < MAX_KEPT {
            self.failures.push((spec, 1));
        }
    }

    /// A connection is up. What is wanted is requested again. Slices of another volume are dropped.
    pub fn handle_welcome(&mut self, volume: &VolumeDescription, version: LookVersion) {
        if self.volume.as_ref().is_some_and(|(_, before)| before != volume) {
            self.drop_all();
        }
        (self.reading, self.failures) = (Vec::new(), Vec::new());
        self.volume = Some((version, volume.clone()));
        self.outbox.offer((!self.wanted.is_empty()).then_some(()));
    }

    /// Streams on the way are of the volume before, so numbers begun before are no longer wanted.
    fn drop_all(&mut self) {
        (self.wanted, self.reading, self.failures) = (Vec::new(), Vec::new(), Vec::new());
        self.kept.clear();
        self.num_kept_bytes = 0;
    }

    /// A message has arrived. A new volume makes all slices useless.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        if let ServerMessage::VolumeChanged(change) = message {
            self.drop_all();
            self.volume = Some((change.look_version, change.volume.clone()));
            self.outbox.offer(None);
        }
    }

    /// The stream of a slice has ended. `slice` has the size that [`Self::begin`] returned. A finer one follows a draft.
    pub fn handle_slice(&mut self, id: SliceId, slice: Slice, is_draft: bool) {
        if let Some(at) = self.reading.iter().position(|other| *other == id) {
            self.reading.remove(at);
        }
        let Some(at) = self.wanted.iter().position(|w| w.id == id) else { return };
        let spec = self.wanted[at].spec;
        if !is_draft {
            self.wanted.remove(at);
        }
        if let Some(at) = self.kept.iter().position(|kept| kept.spec == spec)
            && let Some(before) = self.kept.remove(at)
        {
            self.num_kept_bytes -= before.slice.num_bytes();
        }
        self.num_kept_bytes += slice.num_bytes();
        self.kept.push_back(KeptSlice { spec, slice: Arc::new(slice), is_draft });
        while self.num_kept_bytes > MAX_KEPT_BYTES || self.kept.len() > MAX_KEPT {
            let Some(oldest) = self.kept.pop_front() else { break };
            self.num_kept_bytes -= oldest.slice.num_bytes();
        }
    }

    /// The next message.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ClientMessage> {
        self.outbox.poll(now_micros)?;
        let volume = self.volume.as_ref()?.0;
        Some(ClientMessage::WantSlices(WantedSlices { volume, slices: self.wanted.clone() }))
    }

    /// When to poll again, µs.
    pub fn due(&self) -> Option<u64> {
        self.outbox.due()
    }

    fn missing(&self, specs: &[(SliceSpec, bool)]) -> impl Iterator<Item = (SliceSpec, bool)> {
        let has_failed =
            |spec: &SliceSpec| self.failures.iter().any(|(other, num)| other == spec && *num >= MAX_TRIES);
        let is_kept = |spec: &SliceSpec| {
            has_failed(spec) || self.kept.iter().any(|kept| kept.spec == *spec && !kept.is_draft)
        };
        let mut missing: Vec<(SliceSpec, bool)> = Vec::new();
        for (spec, is_ahead) in specs {
            let is_double = missing.iter().any(|(other, _)| other == spec);
            if missing.len() < MAX_WANTED_SLICES && !is_double && !is_kept(spec) {
                missing.push((*spec, *is_ahead));
            }
        }
        missing.into_iter()
    }
}

/// The server's half: what is wanted and not begun.
///
/// Begin what `poll_next` returns, and give up what `wanted` no longer finds.
#[derive(Debug)]
pub struct SlicesServer {
    /// The first look version of the shown volume.
    since: LookVersion,
    wanted: Vec<SliceRequest>,
    /// Those of `wanted` that were begun.
    begun: Vec<SliceId>,
}

impl SlicesServer {
    /// Begins with the look version in the viewer's welcome.
    pub fn new(since: LookVersion) -> Self {
        Self { since, wanted: Vec::new(), begun: Vec::new() }
    }

    /// Another volume is shown from this look version on.
    pub fn handle_volume(&mut self, since: LookVersion) {
        *self = Self::new(since);
    }

    /// A message has arrived. The newest list remains, unless it is for an earlier volume.
    pub fn handle_message(&mut self, message: &ClientMessage) {
        if let ClientMessage::WantSlices(list) = message
            && list.volume >= self.since
        {
            self.wanted.clone_from(&list.slices);
            self.begun.retain(|id| list.slices.iter().any(|w| w.id == *id));
        }
    }

    /// Takes the most urgent slice that was not begun, of those that `has_room` lets begin.
    pub fn poll_next(&mut self, has_room: impl Fn(&SliceRequest) -> bool) -> Option<SliceRequest> {
        let next = *self.wanted.iter().find(|w| !self.begun.contains(&w.id) && has_room(w))?;
        self.begun.push(next.id);
        Some(next)
    }

    /// What is wanted of a slice now: one that was only for later may have become urgent.
    pub fn wanted(&self, id: SliceId) -> Option<&SliceRequest> {
        self.wanted.iter().find(|w| w.id == id)
    }
}

/// Lists go out at most 30 times a second.
const PERIOD_MICROS: u64 = 33_334;
/// Most memory of kept slices: 500 slices of 512×512 with 16 bits.
pub const MAX_KEPT_BYTES: usize = 256 << 20;
/// Most kept slices, so that finding one stays fast.
const MAX_KEPT: usize = 1024;
/// Most streams of one slice that are read at a time: drafts, and what follows them.
const MAX_READING: usize = 4;
/// Most requests of one slice whose streams are unusable.
const MAX_TRIES: u8 = 3;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::{Pair, look, welcome};
    use crate::volume::{SlabMode, SliceCodes, SlicePlane};
    use crate::wire::VolumeChange;

    fn spec(index: u32) -> SliceSpec {
        let plane = SlicePlane::Axis { axis: 2, index };
        SliceSpec { plane, thickness: 0.0, mode: SlabMode::Mean }
    }

    fn wanted(indices: impl IntoIterator<Item = u32>) -> Vec<(SliceSpec, bool)> {
        indices.into_iter().enumerate().map(|(i, index)| (spec(index), i > 0)).collect()
    }

    fn slice(side: u32) -> Slice {
        let codes = SliceCodes::U8(vec![0; (side * side) as usize]);
        Slice { size: [side; 2], lo: 0.0, step: 1.0, codes }
    }

    #[test]
    fn what_is_wanted_comes_over_any_link_and_paging_past_slices_gives_them_up() {
        for (loss, seed) in [(0.0, 1), (0.3, 2)] {
            let mut pair = Pair::new(80_000, loss, seed);
            pair.client.slices.want(&wanted([3]));
            pair.run(3_000_000);
            let kept = pair.client.slices.get(&spec(3)).expect("wanted before there was a connection");
            assert_eq!(kept.size, [8; 2]);
            // Somebody pages through the volume in 70 ms, and stays at the last one.
            for index in 0..8 {
                pair.client.slices.want(&wanted([index]));
                pair.run(9_000);
            }
            pair.run(3_000_000);
            assert!(pair.client.slices.get(&spec(7)).is_some(), "the last one is there");
            assert!(pair.num_slices < 8, "those between were never begun: {}", pair.num_slices);
            let before = pair.num_slices;
            pair.client.slices.want(&wanted([7, 6, 5, 4]));
            pair.run(3_000_000);
            assert!((4..8).all(|index| pair.client.slices.get(&spec(index)).is_some()));
            assert!(pair.num_slices <= before + 3, "what is there is not sent again");
            // Nothing more is said while nothing is missing.
            assert!(!pair.client.slices.is_news(&wanted([7, 6])));
        }
    }

    #[test]
    fn over_another_connection_what_is_missing_is_requested_again_and_the_rest_is_kept() {
        let mut pair = Pair::new(80_000, 0.1, 5);
        pair.client.slices.want(&wanted([1]));
        pair.run(2_000_000);
        pair.client.slices.want(&wanted([1, 2]));
        pair.connect();
        pair.run(2_000_000);
        assert!([1, 2].iter().all(|i| pair.client.slices.get(&spec(*i)).is_some()));
        assert_eq!(pair.num_slices, 2, "the first was kept");
    }

    #[test]
    fn a_slice_of_an_earlier_volume_is_never_taken_for_one_of_the_next() {
        let mut client = SlicesClient::default();
        client.handle_welcome(&welcome("a").volume, LookVersion(1));
        client.want(&wanted([1, 2]));
        let Some(ClientMessage::WantSlices(old)) = client.poll_message(0) else { panic!("a list") };
        client.handle_slice(old.slices[0].id, slice(8), false);
        assert!(client.get(&spec(1)).is_some());
        let change =
            VolumeChange { volume: welcome("b").volume, look_version: LookVersion(4), look: look("b") };
        client.handle_message(&ServerMessage::VolumeChanged(Box::new(change)));
        client.handle_slice(old.slices[1].id, slice(8), false);
        assert!(client.get(&spec(1)).is_none() && client.get(&spec(2)).is_none());
        client.want(&wanted([1]));
        let Some(ClientMessage::WantSlices(new)) = client.poll_message(100_000) else { panic!("a list") };
        assert!(new.volume == LookVersion(4) && !client.wants(old.slices[1].id));
        // The server ignores a list that crossed the change.
        let mut server = SlicesServer::new(LookVersion(1));
        server.handle_message(&ClientMessage::WantSlices(old.clone()));
        assert_eq!(server.poll_next(|_| true).map(|w| w.id), Some(old.slices[0].id));
        server.handle_volume(LookVersion(3));
        server.handle_message(&ClientMessage::WantSlices(old));
        assert_eq!(server.poll_next(|_| true), None);
        server.handle_message(&ClientMessage::WantSlices(new.clone()));
        assert_eq!(server.poll_next(|_| true), Some(new.slices[0]));
    }

    #[test]
    fn each_is_begun_once_in_the_order_of_the_newest_list() {
        let mut client = SlicesClient::default();
        client.handle_welcome(&welcome("a").volume, LookVersion(1));
        let mut server = SlicesServer::new(LookVersion(1));
        let mut now = 0;
        let mut tell = |client: &mut SlicesClient, server: &mut SlicesServer| {
            now += 100_000;
            server.handle_message(&client.poll_message(now).expect("a list"));
        };
        let index = |request: SliceRequest| match request.spec.plane {
            SlicePlane::Axis { index, .. } => index,
            SlicePlane::Oblique { .. } => u32::MAX,
        };
        client.want(&wanted([1, 2, 3]));
        tell(&mut client, &mut server);
        let first = server.poll_next(|_| true).unwrap();
        assert_eq!((index(first), first.is_ahead), (1, false));
        client.want(&wanted([3, 1]));
        tell(&mut client, &mut server);
        assert!(server.wanted(first.id).is_some_and(|w| w.is_ahead), "its number stays");
        assert_eq!(server.poll_next(|_| true).map(index), Some(3));
        assert_eq!(server.poll_next(|_| true), None, "the others were begun or given up");
        client.want(&[]);
        tell(&mut client, &mut server);
        assert!(server.wanted(first.id).is_none());
    }

    #[test]
    fn a_draft_is_shown_until_the_finer_one_is_there_and_is_requested_again() {
        let mut client = SlicesClient::default();
        client.handle_welcome(&welcome("a").volume, LookVersion(1));
        client.want(&wanted([1]));
        let id = client.newest;
        client.handle_slice(id, slice(8), true);
        assert!(client.get(&spec(1)).is_some() && client.wants(id));
        // Nobody looks for a while: the draft stays, and the finer one is asked for anew.
        client.want(&[]);
        assert!(client.get(&spec(1)).is_some() && !client.wants(id));
        client.want(&wanted([1]));
        assert!(client.wants(client.newest) && client.newest != id);
        let before = client.num_kept_bytes;
        client.handle_slice(client.newest, slice(16), false);
        assert_eq!(client.get(&spec(1)).map(|kept| kept.size), Some([16; 2]));
        assert_eq!(client.num_kept_bytes, before + 16 * 16 - 8 * 8, "it replaces the draft");
        client.want(&wanted([1]));
        assert!(!client.wants(client.newest), "control: what is final is not asked for");
    }

    #[test]
    fn memory_is_bounded_and_the_last_used_stay() {
        let side = 2048;
        let mut volume = welcome("a").volume;
        volume.dims = [side, side, 200];
        let mut client = SlicesClient::default();
        client.handle_welcome(&volume, LookVersion(1));
        for index in 0..80 {
            client.want(&wanted([index]));
            client.handle_slice(client.newest, slice(side), false);
            // The first is looked at again and again.
            client.want(&wanted([0]));
        }
        assert!(client.num_kept_bytes <= MAX_KEPT_BYTES && client.kept.len() == 64);
        assert!(client.get(&spec(0)).is_some() && client.get(&spec(1)).is_none());
        assert!(client.get(&spec(79)).is_some());
        // Many small ones are bounded, too.
        for index in 0..2 * MAX_KEPT as u32 {
            client.want(&[(SliceSpec { thickness: index as f32, ..spec(1) }, false)]);
            client.handle_slice(client.newest, slice(8), false);
        }
        assert_eq!(client.kept.len(), MAX_KEPT);
    }

    #[test]
    fn a_stream_is_read_once_and_one_that_fails_is_requested_again_but_not_for_ever() {
        let mut client = SlicesClient::default();
        client.handle_welcome(&welcome("a").volume, LookVersion(1));
        let mut ids = Vec::new();
        for _ in 0..2 * MAX_TRIES {
            client.want(&wanted([1]));
            if !client.wants(client.newest) {
                break;
            }
            ids.push(client.newest);
            for _ in 0..MAX_READING {
                assert_eq!(client.begin(client.newest), Some([8; 2]));
            }
            assert_eq!(client.begin(client.newest), None);
            client.handle_failed(client.newest);
        }
        assert_eq!(ids.len(), usize::from(MAX_TRIES));
        assert!(ids.windows(2).all(|pair| pair[0] != pair[1]), "each request has a number of its own");
        // Over another connection it may succeed.
        client.handle_welcome(&welcome("a").volume, LookVersion(1));
        client.want(&wanted([1]));
        assert!(client.begin(client.newest).is_some());
        assert_eq!(client.begin(SliceId(99)), None, "nobody wants it");
    }
}
