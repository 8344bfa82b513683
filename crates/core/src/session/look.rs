//! The look of the frames: a viewer chooses it, the server counts its versions, and each frame names its version.
//!
//! [`ClientMessage::SetLook`] carries the viewer's look. At most 30 go out a second, and the newest wins.
//! [`ServerMessage::LookChanged`] announces the version of later frames, and whether they show a draft of its shade.
//! [`ServerMessage::VolumeChanged`] does the same for a new volume, which is never a draft.
//!
//! A look whose shade is not computed yet is a draft. When it has not changed for [`REST_MICROS`], the server
//! computes the shade beside the frames and announces the version again.

use std::collections::VecDeque;
use std::sync::Arc;

use super::pace::Pace;
use crate::ids::LookVersion;
use crate::look::{Look, LookError};
use crate::transfer::TransferFunction;
use crate::wire::{ClientMessage, ServerMessage, VolumeChange, VolumeDescription};

/// The client's half: the look that the viewer wants, and the one in force at the server.
///
/// Call `handle_welcome` for each connection and `handle_message` for each message. Then send what `poll_message`
/// returns, and poll again at `due`.
#[derive(Debug)]
pub struct LookClient {
    in_force: Option<(LookVersion, Arc<Look>)>,
    is_draft: bool,
    /// The viewer's own last look, requested again over a new connection.
    own: Option<Arc<Look>>,
    /// Set while the server has not confirmed `own`.
    unanswered: Option<Unanswered>,
    outbox: Pace<Arc<Look>>,
    /// The server's look once it has read everything that was sent.
    asked: Option<Arc<Look>>,
    /// Looks of frames that may still be in flight, the newest last.
    known: VecDeque<(LookVersion, Arc<Look>)>,
}

/// A request without an answer.
#[derive(Clone, Copy, Debug)]
struct Unanswered {
    /// The version in force at the request.
    since: Option<LookVersion>,
    at_micros: u64,
}

impl Default for LookClient {
    fn default() -> Self {
        Self {
            in_force: None,
            is_draft: false,
            own: None,
            unanswered: None,
            outbox: Pace::new(PERIOD_MICROS),
            asked: None,
            known: VecDeque::new(),
        }
    }
}

impl LookClient {
    /// Sets the viewer's look.
    ///
    /// # Errors
    /// If the look is not valid. Then nothing changes.
    pub fn set(&mut self, now_micros: u64, look: Look) -> Result<(), LookError> {
        look.validate()?;
        let look = Arc::new(look);
        let is_in_force = self.in_force.as_ref().is_some_and(|(_, known)| *known == look);
        if self.unanswered.is_some() || !is_in_force {
            let since = self.in_force.as_ref().map(|(version, _)| *version);
            self.unanswered = Some(Unanswered { since, at_micros: now_micros });
        }
        self.own = Some(look.clone());
        self.outbox.offer(Some(look));
        Ok(())
    }

    /// The viewer's look: its own until the server confirms it, then the one in force.
    pub fn chosen(&self) -> Option<Arc<Look>> {
        let own = self.own.as_ref().filter(|_| self.unanswered.is_some());
        own.or(self.in_force.as_ref().map(|(_, look)| look)).cloned()
    }

    /// The look that the server renders with, and its version.
    pub fn in_force(&self) -> Option<(LookVersion, Arc<Look>)> {
        self.in_force.clone()
    }

    /// Whether a look waits to be sent.
    pub fn is_waiting(&self) -> bool {
        self.outbox.waiting().is_some()
    }

    /// Whether frames of the version in force show a draft, so that final ones follow.
    pub fn is_draft(&self) -> bool {
        self.is_draft
    }

    /// Whether a frame of this version has the viewer's look.
    pub fn is_chosen(&self, version: LookVersion) -> bool {
        let Some((in_force, look)) = &self.in_force else { return self.unanswered.is_none() };
        *in_force == version && (self.unanswered.is_none() || self.own.as_ref() == Some(look))
    }

    /// The look of frames of a version, if it is still known.
    pub fn of_version(&self, version: LookVersion) -> Option<Arc<Look>> {
        self.known.iter().find(|(known, _)| *known == version).map(|(_, look)| look.clone())
    }

    /// A connection is up; the server begins with its own look. The viewer's look is requested again, unless the
    /// server now has another file.
    pub fn handle_welcome(&mut self, now_micros: u64, version: LookVersion, look: Look, is_other_file: bool) {
        self.put_in_force(version, look, false);
        let in_force = self.in_force.as_ref().map(|(_, look)| look.clone());
        if is_other_file {
            self.own = None;
        }
        let own = self.own.clone().filter(|own| in_force.as_ref() != Some(own));
        self.unanswered = own.as_ref().map(|_| Unanswered { since: Some(version), at_micros: now_micros });
        self.outbox.offer(own);
        self.asked = in_force;
    }

    /// A message has arrived.
    pub fn handle_message(&mut self, now_micros: u64, message: &ServerMessage) {
        match message {
            ServerMessage::LookChanged { version, look, is_draft } => {
                self.handle_changed(now_micros, *version, look.clone(), *is_draft);
            }
            ServerMessage::VolumeChanged(change) => {
                self.handle_volume_changed(change.look_version, change.look.clone());
            }
            _ => {}
        }
    }

    /// The server has another look in force.
    pub fn handle_changed(&mut self, now_micros: u64, version: LookVersion, look: Look, is_draft: bool) {
        self.put_in_force(version, look, is_draft);
        self.note_answer(now_micros);
        if self.unanswered.is_none() {
            self.asked = self.in_force.as_ref().map(|(_, look)| look.clone());
        }
    }

    /// The server shows another volume. Its look applies, unless the viewer's own look is on its way.
    pub fn handle_volume_changed(&mut self, version: LookVersion, look: Look) {
        let before = self.in_force.as_ref().map(|(_, look)| look.clone());
        let has_sent = self.outbox.waiting().is_none();
        let is_pending = self.unanswered.is_some() && !(has_sent && self.own == before);
        self.put_in_force(version, look, false);
        let in_force = self.in_force.as_ref().map(|(_, look)| look.clone());
        if !is_pending {
            self.unanswered = None;
            self.own = self.own.take().and(in_force.clone());
            self.outbox.offer(None);
        }
        self.asked = if is_pending && has_sent { self.own.clone() } else { in_force };
    }

    /// The next message, while there is a connection.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ClientMessage> {
        self.note_answer(now_micros);
        let look = self.outbox.poll(now_micros).filter(|look| self.asked.as_ref() != Some(look))?;
        self.asked = Some(look.clone());
        Some(ClientMessage::SetLook(Arc::unwrap_or_clone(look)))
    }

    /// When to poll again if nothing arrives, µs.
    pub fn due(&self) -> Option<u64> {
        let answer = self.unanswered.as_ref().map(|u| u.at_micros + PATIENCE_MICROS);
        let has_own = self.in_force.as_ref().map(|(_, look)| look) == self.own.as_ref();
        self.outbox.due().into_iter().chain(answer.filter(|_| has_own)).min()
    }

    fn put_in_force(&mut self, version: LookVersion, look: Look, is_draft: bool) {
        let look = Arc::new(look);
        self.known.retain(|(known, _)| *known != version);
        if self.known.len() == MAX_KNOWN {
            self.known.pop_front();
        }
        self.known.push_back((version, look.clone()));
        (self.in_force, self.is_draft) = (Some((version, look)), is_draft);
    }

    /// Checks whether the server has confirmed the look. While an earlier request is in flight, the previous look may
    /// come into force again. So a version that was in force at the request counts as an answer only after a while.
    fn note_answer(&mut self, now_micros: u64) {
        let (Some(unanswered), Some((version, look))) = (self.unanswered, &self.in_force) else { return };
        let is_later = unanswered.since != Some(*version);
        let is_answer = is_later || now_micros >= unanswered.at_micros + PATIENCE_MICROS;
        if is_answer && self.outbox.waiting().is_none() && self.own.as_ref() == Some(look) {
            self.unanswered = None;
        }
    }
}

/// The server's half: the look of this viewer's frames, and its version.
///
/// Take the viewer's look with `poll_wanted`, and confirm it with `begin`. Compute the shade that `poll_refine`
/// requests, and stop when `is_refining` turns false. Call `handle_generated` for each frame.
#[derive(Debug)]
pub struct LookServer {
    look: Arc<Look>,
    /// The volume's own transfer function. The look uses it unless somebody chose another.
    usual: TransferFunction,
    version: LookVersion,
    shade: ShadeProgress,
    wanted: Option<Look>,
    /// A new volume that is not announced yet.
    volume: Option<VolumeDescription>,
    /// Whether the version is not announced yet.
    is_untold: bool,
}

/// The progress of the look's shade.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ShadeProgress {
    Whole,
    /// A draft. The full shade is due at this time, µs.
    Draft(u64),
    /// A draft. The full shade is being computed.
    Refining,
    /// A permanent draft: the computation failed.
    Failed,
}

/// The fate of a generated frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GeneratedLook {
    /// The frame matches its version.
    Usable,
    /// It shows a draft although its version is final. A new version has begun, and the pose needs another answer.
    Draft,
}

impl LookServer {
    /// Begins with the look in the viewer's welcome.
    pub fn new(version: LookVersion, look: Look) -> Self {
        let usual = look.transfer.clone();
        let (look, shade) = (Arc::new(look), ShadeProgress::Whole);
        let (wanted, volume, is_untold) = (None, None, false);
        Self { look, usual, version, shade, wanted, volume, is_untold }
    }

    /// The look of frames from now on.
    pub fn look(&self) -> &Arc<Look> {
        &self.look
    }

    /// Its version.
    pub fn version(&self) -> LookVersion {
        self.version
    }

    /// Whether the shade is a draft, so that better frames of the next version will come.
    pub fn is_draft(&self) -> bool {
        self.shade != ShadeProgress::Whole
    }

    /// A message has arrived. Only the newest look remains.
    pub fn handle_message(&mut self, message: &ClientMessage) {
        if let ClientMessage::SetLook(look) = message {
            self.wanted = Some(look.clone());
        }
    }

    /// Takes the newest look that the viewer wants.
    pub fn poll_wanted(&mut self) -> Option<Look> {
        self.wanted.take()
    }

    /// Later frames have this look; `is_whole` if all of its shade is there.
    pub fn begin(&mut self, now_micros: u64, look: Look, is_whole: bool) {
        self.look = Arc::new(look);
        self.begin_version(now_micros, is_whole);
    }

    /// Later frames show another volume, whose own look is `suited`. `at_values` is this viewer's look with the
    /// colour of each value kept; it is given where values mean the same in both volumes. `is_whole` says whether all
    /// of a look's shade is there.
    pub fn handle_volume(
        &mut self,
        now_micros: u64,
        volume: VolumeDescription,
        suited: &Look,
        at_values: Option<Look>,
        is_whole: impl Fn(&Look) -> bool,
    ) {
        let is_usual = self.look.transfer == self.usual;
        if let Some(look) = at_values {
            self.look = Arc::new(look);
        } else {
            self.usual = suited.transfer.clone();
            let transfer = if is_usual { self.usual.clone() } else { self.look.transfer.clone() };
            let channels = suited.channels.clone();
            self.look = Arc::new(Look { transfer, channels, ..(*self.look).clone() });
        }
        if is_usual {
            self.usual = self.look.transfer.clone();
        }
        self.volume = Some(volume);
        self.begin_version(now_micros, is_whole(&self.look));
    }

    /// The shade that `poll_refine` requested is there or has failed. Results for an older version are ignored.
    /// Returns a line for the user if it has failed.
    pub fn handle_refined(
        &mut self,
        now_micros: u64,
        version: LookVersion,
        is_there: bool,
    ) -> Option<String> {
        if version != self.version || self.shade != ShadeProgress::Refining {
            return None;
        }
        if is_there {
            self.begin_version(now_micros, true);
            return None;
        }
        self.shade = ShadeProgress::Failed;
        Some("the server cannot work out the shade of this look".into())
    }

    /// A frame of this version was generated, with a draft of the shade or all of it.
    pub fn handle_generated(
        &mut self,
        now_micros: u64,
        version: LookVersion,
        is_draft: bool,
    ) -> GeneratedLook {
        if version != self.version || is_draft == self.is_draft() {
            return GeneratedLook::Usable;
        }
        if is_draft {
            // Other viewers' looks have evicted its shade.
            self.begin_version(now_micros, false);
            return GeneratedLook::Draft;
        }
        // The shade is the same as before.
        (self.shade, self.is_untold) = (ShadeProgress::Whole, true);
        GeneratedLook::Usable
    }

    /// Takes the look whose shade to compute now, with its version.
    pub fn poll_refine(&mut self, now_micros: u64) -> Option<(LookVersion, Arc<Look>)> {
        if !matches!(self.shade, ShadeProgress::Draft(at) if at <= now_micros) {
            return None;
        }
        self.shade = ShadeProgress::Refining;
        Some((self.version, self.look.clone()))
    }

    /// Whether the shade of this version is still needed.
    pub fn is_refining(&self, version: LookVersion) -> bool {
        version == self.version && self.shade == ShadeProgress::Refining
    }

    /// When to call `poll_refine` again, µs.
    pub fn due(&self) -> Option<u64> {
        if let ShadeProgress::Draft(at) = self.shade { Some(at) } else { None }
    }

    /// The next message to the viewer.
    pub fn poll_message(&mut self) -> Option<ServerMessage> {
        let look = |server: &Self| (*server.look).clone();
        if let Some(volume) = self.volume.take() {
            // The volume change announces the version, unless it is a draft.
            self.is_untold = self.is_draft();
            let change = VolumeChange { volume, look_version: self.version, look: look(self) };
            return Some(ServerMessage::VolumeChanged(Box::new(change)));
        }
        let (version, is_draft) = (self.version, self.is_draft());
        std::mem::take(&mut self.is_untold).then(|| ServerMessage::LookChanged {
            version,
            look: look(self),
            is_draft,
        })
    }

    fn begin_version(&mut self, now_micros: u64, is_whole: bool) {
        self.version = self.version.next();
        self.shade =
            if is_whole { ShadeProgress::Whole } else { ShadeProgress::Draft(now_micros + REST_MICROS) };
        self.is_untold = true;
    }
}

/// Time between looks to the server: 30 a second.
const PERIOD_MICROS: u64 = 33_334;
/// After this time, the server need not confirm a look that it already has. It may answer only the last of several
/// requests.
const PATIENCE_MICROS: u64 = 2_000_000;
/// Number of looks that are remembered: four seconds' worth at 30 a second.
const MAX_KNOWN: usize = 128;
/// A look rests when it has not changed for this time, so that dragging does not wait for outdated shade.
pub const REST_MICROS: u64 = 150_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::{Pair, look};

    fn name(look: &Look) -> &str {
        &look.transfer.name
    }

    /// A client of a server that has the look "first" in force, as version 1.
    fn welcomed() -> LookClient {
        let mut client = LookClient::default();
        client.handle_welcome(0, LookVersion(1), look("first"), false);
        client
    }

    #[test]
    fn the_newest_look_wins_over_any_link() {
        for (loss, seed) in [(0.0, 1), (0.1, 2), (0.3, 3)] {
            let mut pair = Pair::new(100_000, loss, seed);
            pair.run(400_000);
            for i in 0..40 {
                let now = pair.now();
                pair.client.look.set(now, look(&i.to_string())).unwrap();
                let before = pair.server.as_ref().map(|s| s.look.version());
                pair.run(8_000);
                assert_eq!(name(&pair.client.look.chosen().unwrap()), i.to_string(), "shown at once");
                assert!(pair.server.as_ref().map(|s| s.look.version()) >= before);
            }
            pair.run(3_000_000);
            let server = &pair.server.as_ref().unwrap().look;
            assert_eq!(name(server.look()), "39");
            let (version, in_force) = pair.client.look.in_force().unwrap();
            assert_eq!((version, name(&in_force)), (server.version(), "39"));
            assert!(pair.client.look.is_chosen(version) && !pair.client.look.is_chosen(LookVersion(1)));
            assert!((2..=14).contains(&version.0), "40 edits in 320 ms are at most eleven: {version}");
        }
    }

    #[test]
    fn a_look_that_was_changed_back_is_not_undone_by_a_late_answer() {
        let mut client = welcomed();
        client.set(100_000, look("skin")).unwrap();
        assert!(client.poll_message(100_000).is_some());
        client.set(200_000, look("first")).unwrap();
        assert!(client.poll_message(200_000).is_some(), "the first is in force, but not for long");
        for (now, version, of_server) in [(300_000, 2, "skin"), (400_000, 3, "first")] {
            client.poll_message(now);
            client.handle_changed(now, LookVersion(version), look(of_server), false);
            assert_eq!(name(&client.chosen().unwrap()), "first", "at {now}");
        }
        // From then on the server's look counts, also where it has answered the last request alone.
        client.handle_changed(450_000, LookVersion(4), look("flesh"), false);
        assert_eq!(name(&client.chosen().unwrap()), "flesh");
        client.set(500_000, look("bone")).unwrap();
        client.set(500_001, look("flesh")).unwrap();
        assert!(client.poll_message(500_001).is_none(), "the server has it");
        assert_eq!(client.due(), Some(2_500_001));
        client.poll_message(2_500_001);
        client.handle_changed(2_600_000, LookVersion(5), look("bone"), false);
        assert_eq!(name(&client.chosen().unwrap()), "bone");
    }

    #[test]
    fn a_look_is_requested_again_over_another_connection_but_of_the_same_file_only() {
        for (is_other_file, expected) in [(false, "skin"), (true, "first")] {
            let mut client = welcomed();
            client.set(10, look("skin")).unwrap();
            client.poll_message(10);
            client.handle_changed(20, LookVersion(2), look("skin"), false);
            client.handle_welcome(100_000, LookVersion(1), look("first"), is_other_file);
            assert_eq!(name(&client.chosen().unwrap()), expected);
            let again = client.poll_message(100_000);
            assert_eq!(again.is_some(), !is_other_file, "{again:?}");
            assert!(client.poll_message(200_000).is_none(), "once");
        }
        // A viewer that never chose one has the server's.
        let mut client = welcomed();
        client.handle_welcome(30, LookVersion(1), look("second"), false);
        assert_eq!(name(&client.chosen().unwrap()), "second");
        assert!(client.poll_message(40).is_none());
    }

    #[test]
    fn the_look_of_another_volume_is_not_undone() {
        let mut client = welcomed();
        client.set(10, look("skin")).unwrap();
        client.poll_message(10);
        client.handle_changed(20, LookVersion(2), look("skin"), false);
        client.handle_volume_changed(LookVersion(3), look("skin of the second"));
        assert_eq!(name(&client.chosen().unwrap()), "skin of the second");
        // Over the next connection that one is requested. The control: one that is on its way stays.
        client.handle_welcome(100_000, LookVersion(1), look("first"), false);
        assert!(
            matches!(client.poll_message(100_000), Some(ClientMessage::SetLook(l)) if name(&l) == "skin of the second")
        );
        client.set(200_000, look("bone")).unwrap();
        client.handle_volume_changed(LookVersion(2), look("third"));
        assert_eq!(name(&client.chosen().unwrap()), "bone");
    }

    #[test]
    fn an_unusable_look_changes_nothing() {
        let mut client = welcomed();
        assert!(client.set(5, Look { k: 0, ..look("none") }).is_err());
        assert!(client.is_chosen(LookVersion(1)) && client.poll_message(5).is_none());
        assert!(client.set(5, Look { k: 1, ..look("one") }).is_ok());
        assert!(!client.is_chosen(LookVersion(1)) && client.poll_message(5).is_some());
    }

    #[test]
    fn a_draft_is_followed_by_all_of_the_shade_once_the_look_rests() {
        let mut server = LookServer::new(LookVersion(1), look("first"));
        assert!(server.poll_message().is_none());
        server.begin(0, look("a"), false);
        server.begin(100_000, look("b"), false);
        let told = server.poll_message();
        assert!(matches!(
            told,
            Some(ServerMessage::LookChanged { version: LookVersion(3), is_draft: true, .. })
        ));
        assert!(server.poll_message().is_none());
        assert_eq!((server.poll_refine(240_000), server.due()), (None, Some(250_000)));
        let (version, of) = server.poll_refine(250_000).unwrap();
        assert_eq!((version, name(&of), server.due()), (LookVersion(3), "b", None));
        // News of another version is none.
        assert_eq!(server.handle_refined(260_000, LookVersion(2), false), None);
        assert!(server.is_refining(version) && server.is_draft());
        assert_eq!(server.handle_refined(260_000, version, true), None);
        let told = server.poll_message();
        assert!(matches!(
            told,
            Some(ServerMessage::LookChanged { version: LookVersion(4), is_draft: false, .. })
        ));
        // A frame that lacks the shade all the same begins a draft, and one that has it ends the draft.
        assert_eq!(server.handle_generated(0, LookVersion(4), true), GeneratedLook::Draft);
        assert!(server.is_draft() && server.version() == LookVersion(5));
        assert_eq!(server.handle_generated(0, LookVersion(4), true), GeneratedLook::Usable, "an old one");
        assert_eq!(server.handle_generated(0, LookVersion(5), false), GeneratedLook::Usable);
        assert!(!server.is_draft() && server.version() == LookVersion(5));
        // What cannot be worked out is said once.
        server.begin(300_000, look("c"), false);
        let (version, _) = server.poll_refine(450_000).unwrap();
        assert!(server.handle_refined(460_000, version, false).is_some());
        assert_eq!((server.poll_refine(u64::MAX), server.is_draft()), (None, true));
    }

    #[test]
    fn another_volume_keeps_what_was_chosen_and_its_values_colours() {
        let volume = || crate::session::pair::volume("second");
        let suited = look("suited");
        let turn = |server: &mut LookServer, at_values, is_whole| {
            server.handle_volume(0, volume(), &suited, at_values, |_| is_whole);
            let Some(ServerMessage::VolumeChanged(change)) = server.poll_message() else {
                panic!("no volume")
            };
            assert_eq!(change.look_version, server.version());
            assert_eq!(server.poll_message().is_some(), !is_whole, "a draft is told beside it");
            name(&change.look).to_owned()
        };
        // Nobody chose: what suits the new one.
        let mut server = LookServer::new(LookVersion(1), look("first"));
        assert_eq!(turn(&mut server, None, true), "suited");
        assert_eq!(turn(&mut server, Some(look("moved")), false), "moved");
        assert_eq!(turn(&mut server, None, true), "suited", "the moved one was the usual one, too");
        // Somebody chose.
        server.begin(0, look("mine"), true);
        assert_eq!(turn(&mut server, None, true), "mine");
    }
}
