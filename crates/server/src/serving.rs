//! The task of the server, and one task for each viewer.

use std::collections::HashSet;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::codec::blocks::References;
use isinglass_core::codec::{Coding, Settings};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::layer::{FrameHeader, max_lists};
use isinglass_core::look::Look;
use isinglass_core::session::ledger::Stage;
use isinglass_core::session::rate::{Mode, Pilot, Plan};
use isinglass_core::session::server::Request;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::wire::{LoadStatus, PoseRequest, ProbeRequest, VolumeChange};
use isinglass_net::server::ControlSender;
use isinglass_net::{AfterWork, Journal, Server, Session, SessionClosed};
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::Instant;
use tracing::Instrument;

use crate::generator::{GenerateError, Generated, Generator, Wish};
use crate::parts::{Librarian, Load, Order, Present, TELL_PERIOD, load_due};
use crate::sending::{Sending, Sent, Ticket, finished, send};
use crate::shots::Shots;
use crate::{Attendance, Command};

/// What all viewers share.
#[derive(Clone)]
pub(crate) struct House {
    pub(crate) generator: Generator,
    pub(crate) present: watch::Receiver<Arc<Present>>,
    pub(crate) load: watch::Receiver<Option<Load>>,
    pub(crate) orders: mpsc::Sender<Order>,
    pub(crate) plan: Plan,
    pub(crate) after_work: AfterWork,
}

/// Lets viewers in until told to close.
pub(crate) async fn serve(
    mut server: Server,
    librarian: Librarian,
    house: House,
    mut commands: mpsc::Receiver<Command>,
    attendance: watch::Sender<Attendance>,
    newest: watch::Sender<Option<Journal>>,
) {
    let mut viewers = JoinSet::new();
    let mut known = HashSet::new();
    let mut present = house.present.clone();
    let librarian = tokio::spawn(librarian.run());
    let left = server.left();
    loop {
        tokio::select! {
            session = server.accept() => {
                let Some(session) = session else { break };
                let span = tracing::info_span!("session", id = session.id, viewer = session.name, remote = %session.remote);
                let is_new = known.insert(session.viewer);
                newest.send_replace(Some(session.journal.clone()));
                let viewer = Viewer::new(session, house.clone(), is_new);
                viewers.spawn(viewer.run().instrument(span));
            }
            Some(_) = viewers.join_next() => {}
            () = left.notified() => {}
            Ok(()) = present.changed() => {
                server.set_greeting(present.borrow_and_update().greeting.clone());
            }
            command = commands.recv() => match command {
                Some(Command::MintLink { host, reply }) => {
                    let _ = reply.send(server.mint_link(&host));
                }
                Some(Command::Close) | None => break,
            },
        }
        let now = Attendance { connected: viewers.len(), used_links: server.num_used_links() };
        attendance.send_if_modified(|before| std::mem::replace(before, now) != now);
    }
    librarian.abort();
    server.close().await;
}

/// One viewer: turns its newest pose into frames until the connection is over.
struct Viewer {
    session: Session,
    house: House,
    /// The volume that its frames are of.
    present: Arc<Present>,
    look: Arc<Look>,
    /// The transfer function that suits the volume, which the look has unless somebody chose another.
    usual: TransferFunction,
    version: LookVersion,
    mode: Mode,
    pilot: Pilot,
    /// What the pilot's clock counts from.
    since: Instant,
    frame: FrameId,
    /// What the newest frame was made for.
    answered: Option<(PoseId, LookVersion)>,
    /// Encoding and handing over of the frame before: runs while the next one is generated.
    sending: Option<Sending>,
    /// Frames that later ones may be predicted from.
    sent: References,
    /// The newest frame, once the network has it: at rest it is sent again, finer.
    resting: Option<Sent>,
    /// Whether it is here for the first time.
    is_new: bool,
    /// Whether the frame before was given up, so that this one is not.
    has_given_up: bool,
    /// Whether the renderer was lost on the frame before.
    has_failed: bool,
    /// When a load may be told of again.
    tell_at: Instant,
    /// Whether frames of this version show a draft of the shade.
    is_draft: bool,
    /// When the look has rested, and all of its shade is to be worked out.
    refine_at: Option<Instant>,
    /// The same at work.
    refining: Option<JoinHandle<bool>>,
    shots: Shots,
    /// Answers questions beside the frames.
    probing: JoinHandle<()>,
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.probing.abort();
        self.stop_refining();
    }
}

impl Viewer {
    fn new(session: Session, mut house: House, is_new: bool) -> Self {
        let plan = house.plan;
        session.frames.set_rate(plan.bytes_per_second);
        let present = house.present.borrow_and_update().clone();
        // What is being read now is news; what was read before is not.
        let is_reading = house.load.borrow_and_update().as_ref().is_some_and(Load::is_reading);
        if is_reading {
            house.load.mark_changed();
        }
        let probes = answer_probes(session.probes.clone(), session.control.clone(), house.present.clone());
        let shots = Shots::new(house.generator.clone(), session.frames.clone(), session.control.clone());
        Self {
            look: Arc::new(session.greeting.look.clone()),
            usual: session.greeting.look.transfer.clone(),
            session,
            house,
            present,
            version: LookVersion(1),
            mode: plan.mode,
            pilot: Pilot::new(plan),
            since: Instant::now(),
            frame: FrameId(0),
            answered: None,
            sending: None,
            sent: References::default(),
            resting: None,
            has_given_up: false,
            has_failed: false,
            is_new,
            tell_at: Instant::now(),
            is_draft: false,
            refine_at: None,
            refining: None,
            shots,
            probing: tokio::spawn(probes),
        }
    }

    async fn run(mut self) {
        tracing::info!("viewer connected");
        // Another volume may have come since it was let in.
        let is_welcome = if Arc::ptr_eq(&self.session.greeting, &self.present.greeting) {
            self.tell_parts().await && (!self.is_new || self.tell_oddities().await)
        } else {
            self.turn_to_present(None).await
        };
        while is_welcome && self.wait_for_work().await {
            let Some(request) = *self.session.poses.borrow_and_update() else { continue };
            if self.answered == Some((request.id, self.version)) {
                continue;
            }
            if !self.answer(&request).await {
                break;
            }
        }
        tracing::info!(frames = self.frame.0, "viewer gone");
    }

    /// Waits for a pose or a request, and meanwhile sends the frame of a resting camera finer and finer; false when the
    /// viewer has left.
    async fn wait_for_work(&mut self) -> bool {
        // An outdated frame is not made finer: another is about to be asked for.
        let finer = self.resting.as_ref().and_then(|sent| self.finer(sent));
        let finer_at = finer.zip(self.resting.as_ref()).map(|(_, sent)| sent.ticket.asked_at + REST);
        tokio::select! {
            biased;
            // Poses last: while the camera moves there is always another.
            Ok(()) = self.house.present.changed() => {
                let before = self.present.clone();
                self.present = self.house.present.borrow_and_update().clone();
                self.turn_to_present(Some(&before)).await
            }
            request = self.session.requests.recv() => match request {
                Some(request) => self.take(request).await,
                None => false,
            },
            () = load_due(&mut self.house.load, self.tell_at) => self.tell_load().await,
            is_refined = refined(&mut self.refining), if self.refining.is_some() => self.note_refined(is_refined).await,
            () = tokio::time::sleep_until(self.refine_at.unwrap_or_else(Instant::now)), if self.refine_at.is_some() => {
                self.refine();
                true
            }
            changed = self.session.poses.changed() => changed.is_ok(),
            ended = finished(&mut self.sending), if self.sending.is_some() => self.note_sent(ended),
            () = tokio::time::sleep_until(finer_at.unwrap_or_else(Instant::now)),
                if finer_at.is_some() && self.sending.is_none() => {
                if let (Some(coding), Some(sent)) = (finer, self.resting.take()) {
                    self.send_finer(sent, coding);
                }
                true
            }
        }
    }

    /// The volume is another from now on. A look that nobody has chosen gives way to the one that suits it.
    async fn turn_to_present(&mut self, before: Option<&Present>) -> bool {
        self.version = self.version.next();
        let is_usual = self.look.transfer == self.usual;
        if let Some(before) = before.filter(|before| before.has_values_like(&self.present)) {
            // What has one value has one colour, now and later.
            self.look = Arc::new(before.lights.at_values(&self.look));
        } else {
            self.usual = self.present.greeting.look.transfer.clone();
            if is_usual {
                let transfer = self.usual.clone();
                self.look = Arc::new(Look { transfer, ..(*self.look).clone() });
            }
        }
        if is_usual {
            self.usual = self.look.transfer.clone();
        }
        (self.answered, self.resting, self.sent) = (None, None, References::default());
        self.session.poses.mark_changed();
        let change = VolumeChange {
            volume: self.present.greeting.volume.clone(),
            look_version: self.version,
            look: (*self.look).clone(),
        };
        if self.session.control.volume_changed(change).await.is_err()
            || !self.tell_parts().await
            || !self.tell_oddities().await
        {
            return false;
        }
        self.stop_refining();
        // What was told is no draft.
        match self.present.lights.is_fine(&self.look) {
            true => {
                (self.is_draft, self.refine_at) = (false, None);
                true
            }
            false => self.tell_version(true).await,
        }
    }

    /// What a person should know who sees the volume.
    async fn tell_oddities(&self) -> bool {
        let warnings = &self.present.lights.volume().info.warnings;
        warnings.is_empty() || self.session.control.notice(&warnings.join("; ")).await.is_ok()
    }

    async fn tell_parts(&self) -> bool {
        match self.present.parts.clone() {
            Some(parts) => self.session.control.parts(parts).await.is_ok(),
            None => true,
        }
    }

    async fn tell_load(&mut self) -> bool {
        self.tell_at = Instant::now() + TELL_PERIOD;
        let load = self.house.load.borrow_and_update().clone();
        let Some(Load { id, viewer, part, bytes_needed, state }) = load else { return true };
        let is_own = viewer == self.session.viewer;
        let status = LoadStatus { load: id, is_own, part, bytes_needed, state };
        self.session.control.load(status).await.is_ok()
    }

    /// How a frame that was sent shall be sent again if the camera rests where it is.
    fn finer(&self, sent: &Sent) -> Option<Coding> {
        let header = &sent.generated.frame.header;
        // Nor is a draft: it is about to be made anew.
        let is_newest = !self.is_draft
            && self.answered == Some((header.pose, self.version))
            && header.look == self.version;
        let num_lists = header.camera.intrinsics.num_pixels();
        is_newest.then(|| self.pilot.finer(num_lists, &sent.ticket.coding)).flatten()
    }

    fn send_finer(&mut self, sent: Sent, coding: Coding) {
        self.frame = self.frame.next();
        let mut generated = sent.generated;
        generated.frame.header.frame = self.frame;
        // It may be too many frames ago by now.
        let reference = sent.ticket.reference.clone().filter(|r| self.sent.get(r.frame()).is_some());
        self.send(generated, Ticket { coding, reference, is_finer: true, ..sent.ticket });
    }

    /// Takes all that has come by now. Of several looks the newest wins: none is rendered that is out of date.
    async fn take(&mut self, first: Request) -> bool {
        let mut newest_look = None;
        let mut newest_shot = None;
        let mut next = Some(first);
        while let Some(request) = next {
            match request {
                Request::SetLook(look) => newest_look = Some(look),
                Request::Stats(stats) => tracing::debug!(?stats, "viewer"),
                Request::Bye => return false,
                Request::Shoot(shot) => newest_shot = Some(Some(shot)),
                Request::CancelShot => newest_shot = Some(None),
                // The session has a lane of its own for these.
                Request::Probe(_) => {}
                // A librarian that is gone leaves the volume as it is.
                Request::OpenPart(part) => {
                    let _ = self.house.orders.send(Order::Open(self.session.viewer, part)).await;
                }
                Request::CancelPart => drop(self.house.orders.send(Order::Cancel).await),
            }
            next = self.session.requests.try_recv().ok();
        }
        let is_there = match newest_look {
            Some(look) => self.set_look(look).await,
            None => true,
        };
        if let Some(shot) = newest_shot {
            self.shots.set(shot, &self.look, &self.present);
        }
        is_there
    }

    async fn set_look(&mut self, look: Look) -> bool {
        tracing::info!(transfer = look.transfer.name, layering = %look.layering, k = look.k, "new look");
        let is_draft = !self.present.lights.is_fine(&look);
        self.look = Arc::new(look);
        self.stop_refining();
        self.begin_version(is_draft).await
    }

    /// Frames from now on have another number, and the newest pose shall be answered again.
    async fn begin_version(&mut self, is_draft: bool) -> bool {
        self.version = self.version.next();
        self.session.poses.mark_changed();
        self.tell_version(is_draft).await
    }

    async fn tell_version(&mut self, is_draft: bool) -> bool {
        self.is_draft = is_draft;
        self.refine_at = is_draft.then(|| Instant::now() + LOOK_REST);
        self.session.control.look_changed(self.version, (*self.look).clone(), is_draft).await.is_ok()
    }

    /// The look rests: all of its shade is worked out beside the frames.
    fn refine(&mut self) {
        self.refine_at = None;
        let (lights, look) = (self.present.lights.clone(), self.look.clone());
        self.refining = Some(tokio::spawn(async move { lights.scene(&look).await.is_some() }));
    }

    /// The look is another: nobody waits for this shade.
    fn stop_refining(&mut self) {
        if let Some(refining) = self.refining.take() {
            refining.abort();
        }
    }

    /// Frames can be made with all of their shade; false when the viewer has left.
    async fn note_refined(&mut self, is_refined: bool) -> bool {
        if !is_refined {
            let told = self.session.control.notice("the server cannot work out the shade of this look").await;
            return told.is_ok();
        }
        self.begin_version(false).await
    }

    /// Generates the frame for a pose, and hands it over to be encoded and sent; false when the viewer has left.
    async fn answer(&mut self, request: &PoseRequest) -> bool {
        let asked_at = Instant::now();
        self.give_up_finer(request);
        self.frame = self.frame.next();
        // The look is another, or its shade: what was said of the camera's movement then has been taken.
        let is_again = self.answered.is_some_and(|(pose, _)| pose == request.id);
        self.answered = Some((request.id, self.version));
        let header = FrameHeader {
            frame: self.frame,
            pose: request.id,
            look: self.version,
            camera: Camera::new(request.pose, bounded(request.intrinsics, self.look.k), &self.present.bounds),
            k: self.look.k,
            mode: Default::default(),
        };
        self.session.journal.open(self.frame, request.id);
        self.session.journal.stamp(self.frame, Stage::Begun);
        let generated = match self.generate(request, header).await {
            Some(Ok(generated)) => generated,
            None => return false,
            Some(Err(GenerateError::GivenUp)) => {
                tracing::trace!("frame {} given up: the camera moves on", self.frame);
                self.has_given_up = true;
                self.session.journal.give_up(self.frame);
                self.answered = None;
                return true;
            }
            Some(Err(GenerateError::OtherVolume)) => {
                // The change is about to be told, and the pose answered with it.
                self.answered = None;
                return true;
            }
            Some(Err(e)) => {
                tracing::warn!("frame {}: {e}", self.frame);
                // Another renderer has taken the place of a lost one: once more.
                if e.is_lost() && !std::mem::replace(&mut self.has_failed, true) {
                    self.answered = None;
                    self.session.poses.mark_changed();
                }
                return self.session.control.notice(&format!("the server cannot render: {e}")).await.is_ok();
            }
        };
        (self.has_given_up, self.has_failed) = (false, false);
        self.session.journal.stamp(self.frame, Stage::Generated);
        if generated.is_draft && !self.is_draft {
            // Other viewers' looks have taken the place of its shade.
            self.answered = None;
            return self.begin_version(true).await;
        }
        if self.is_draft && !generated.is_draft {
            // Nothing of the shade had changed.
            self.stop_refining();
            if !self.tell_version(false).await {
                return false;
            }
        }
        self.pilot.handle_generated(generated.generate_micros);
        if self.sending.is_some() {
            let waiting = Instant::now();
            let (mut is_watching, mut has_changed) = (true, false);
            while self.sending.is_some() {
                tokio::select! {
                    biased;
                    ended = finished(&mut self.sending) => if !self.note_sent(ended) {
                        return false;
                    },
                    changed = self.session.poses.changed(), if is_watching => {
                        // Whoever moves does not wait for what only makes a rest finer.
                        (is_watching, has_changed) = (changed.is_ok(), true);
                        let newest = *self.session.poses.borrow_and_update();
                        if let Some(newest) = newest {
                            self.give_up_finer(&newest);
                        }
                    }
                }
            }
            if has_changed {
                // They have yet to be answered.
                self.session.poses.mark_changed();
            }
            // Where the network is slower than the renderer, a frame for the newest pose is made sooner than this one
            // has waited. It finds the network free, so no frame is passed over twice in a row.
            let is_outdated = self.session.poses.borrow().is_some_and(|newest| newest.id != request.id);
            if is_outdated && waiting.elapsed() > Duration::from_micros(generated.generate_micros) {
                tracing::trace!("frame {} waited too long", self.frame);
                self.session.journal.give_up(self.frame);
                self.answered = None;
                self.session.poses.mark_changed();
                return true;
            }
        }
        self.pilot.handle_turned(request.shown_turn_deg.filter(|_| !is_again));
        let reference = self.sent.next(self.session.frames.newest_decoded()).cloned();
        let num_lists = header.camera.intrinsics.num_pixels();
        let is_margin = self.shows_exactly(&header.camera);
        let coding = if is_margin {
            Coding::Exact(Settings { num_groups: 1, ..Settings::default() })
        } else {
            self.pilot.next(num_lists, reference.is_some())
        };
        let coding = coding.for_mode(generated.frame.header.mode);
        let ticket = Ticket {
            request: *request,
            version: header.look,
            asked_at,
            coding,
            reference,
            is_finer: false,
            is_margin,
            wish: Wish::default(),
        };
        self.send(generated, ticket);
        true
    }

    /// The frame; none when the viewer has left. One for a camera that has rested is given up as soon as the camera moves:
    /// it is larger than those of a moving camera, and none of them can be made before it is done.
    async fn generate(
        &mut self,
        request: &PoseRequest,
        header: FrameHeader,
    ) -> Option<Result<Generated, GenerateError>> {
        let wish = Wish::default();
        let asked_at = Instant::now();
        let mut generating = pin!(self.house.generator.generate(
            self.present.scene,
            (*self.look).clone(),
            header,
            wish.clone()
        ));
        // Without a viewer nobody waits: an order that is dropped is taken out of the queue.
        let mut poses = self.session.poses.clone();
        let mut over = pin!(async move { while poses.changed().await.is_ok() {} });
        // Never twice in a row: a viewer that is slow to ask would get no frame at all.
        let mut is_watching = !self.has_given_up;
        loop {
            tokio::select! {
                biased;
                generated = &mut generating => return generated,
                () = &mut over => {
                    wish.give_up();
                    return None;
                }
                _ = self.session.poses.changed(), if is_watching => {
                    is_watching = false;
                    let newest = *self.session.poses.borrow();
                    // Smaller frames are asked for while something changes, if only the look.
                    let size = |of: &PoseRequest| of.intrinsics.num_pixels();
                    let is_outdated = |n: PoseRequest| n.pose != request.pose || size(&n) < size(request);
                    if newest.is_some_and(is_outdated) && asked_at.elapsed() >= LONG_REST {
                        wish.give_up();
                    }
                    // It has yet to be answered.
                    self.session.poses.mark_changed();
                }
            }
        }
    }

    /// Whether the viewer has, or will have, the exact picture that this camera sees: a frame for it has another margin
    /// only.
    fn shows_exactly(&self, camera: &Camera) -> bool {
        let sent = self.resting.as_ref();
        let is_exact = sent.is_some_and(|sent| {
            let header = &sent.generated.frame.header;
            matches!(sent.ticket.coding, Coding::Exact(_))
                && header.camera.pose == camera.pose
                && is_same_picture(&header.camera.intrinsics, &camera.intrinsics)
                && header.look == self.version
        });
        self.mode == Mode::Auto && is_exact
    }

    /// Ends the sending of a frame that is not of what is asked for now, if it was only to be finer, or to have a margin for
    /// the movement that has begun: the camera moves, or it rests and its full size is wished for instead of a moving camera's. Others may name one in blocks, so that is sent to
    /// its end when it has begun.
    fn give_up_finer(&mut self, wanted: &PoseRequest) {
        let version = self.version;
        let is_wanted =
            |r: &PoseRequest| r.pose == wanted.pose && is_same_picture(&r.intrinsics, &wanted.intrinsics);
        let is_extra = |t: &Ticket| t.is_finer || t.is_margin;
        let is_outdated = |t: &Ticket| is_extra(t) && (!is_wanted(&t.request) || t.version != version);
        if let Some(sending) = self.sending.take_if(|s| is_outdated(&s.ticket)) {
            sending.ticket.wish.give_up();
            match sending.ticket.coding {
                Coding::Exact(_) => sending.task.abort(),
                Coding::Blocks(_) => self.sending = Some(sending),
            }
        }
    }

    /// Hands a frame over.
    fn send(&mut self, generated: Generated, ticket: Ticket) {
        let span = tracing::debug_span!("frame", id = self.frame.0);
        let (frames, control) = (self.session.frames.clone(), self.session.control.clone());
        let task = tokio::spawn(send(frames, control, self.session.journal.clone(), self.house.after_work.clone(), generated, ticket.clone()).instrument(span));
        self.sending = Some(Sending { task, ticket });
    }

    /// Learns from a frame that was handed over; false when the viewer has left.
    fn note_sent(&mut self, ended: Result<Option<Sent>, SessionClosed>) -> bool {
        let Ok(sent) = ended else { return false };
        self.resting = sent;
        if let Some(sent) = &self.resting {
            if let Some(reference) = &sent.reference {
                self.sent.insert(reference.clone());
            }
            let num_lists = sent.generated.frame.header.camera.intrinsics.num_pixels();
            let is_predicted = sent.ticket.reference.is_some();
            let coding = &sent.ticket.coding;
            // What a frame takes that is predicted from itself says nothing of others.
            if !sent.ticket.is_finer || matches!(coding, Coding::Exact(_)) {
                self.pilot.handle_encoded(coding, is_predicted, num_lists, sent.bytes, sent.encode_micros);
            }
            let now_micros = self.since.elapsed().as_micros() as u64;
            self.pilot.handle_link(now_micros, self.session.frames.link_state());
        }
        true
    }
}

/// Answers the newest question as soon as it comes, until the connection is over.
async fn answer_probes(
    mut probes: watch::Receiver<Option<ProbeRequest>>,
    control: ControlSender,
    present: watch::Receiver<Arc<Present>>,
) {
    while probes.changed().await.is_ok() {
        let newest = *probes.borrow_and_update();
        if let Some(probe) = newest {
            let present = present.borrow().clone();
            control.probed(probe.answer(present.lights.volume()));
        }
    }
}

/// Returns when the shade is there, and whether it is; never if nobody works it out.
async fn refined(refining: &mut Option<JoinHandle<bool>>) -> bool {
    let Some(running) = refining else { return std::future::pending().await };
    let is_refined = running.await.unwrap_or(false);
    *refining = None;
    is_refined
}

/// Whether frames of two sizes hold the same lists, but for a margin around them.
fn is_same_picture(a: &Intrinsics, b: &Intrinsics) -> bool {
    a.margin_around(b).is_some() || b.margin_around(a).is_some()
}

/// The picture size that is rendered for a wish: the same shape, at most [`max_lists`] pixels.
fn bounded(wish: Intrinsics, k: u8) -> Intrinsics {
    let excess = wish.num_pixels() as f32 / max_lists(k) as f32;
    if excess <= 1.0 {
        return wish;
    }
    let shrink = |side: u32| ((side as f32 / excess.sqrt()) as u32).max(1);
    Intrinsics { width: shrink(wish.width), height: shrink(wish.height), ..wish }
}

/// A look that has not changed for so long rests: dragging does not have to wait for shade that is out of date.
const LOOK_REST: Duration = Duration::from_millis(150);
/// A camera that no newer pose has come of for so long rests: three refreshes at 30 Hz.
const REST: Duration = Duration::from_millis(100);
/// And one that none has come of for so long does even where the viewer refreshes four times a second only: what it waits
/// for is given up when it moves.
const LONG_REST: Duration = Duration::from_millis(250);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wishes_are_bounded_and_keep_their_shape() {
        for k in [1, 8, 15, 32] {
            let wish = |width, height| bounded(Intrinsics::perspective(width, height, 1.0), k);
            assert_eq!(wish(1920, 1200), Intrinsics::perspective(1920, 1200, 1.0));
            let (big, most) = (wish(8192, 4096), max_lists(k));
            assert!(big.num_pixels() <= most && big.num_pixels() > most * 9 / 10);
            assert!((big.width as f32 / big.height as f32 - 2.0).abs() < 0.01);
            assert!(wish(8192, 1).num_pixels() >= 1);
        }
    }
}
