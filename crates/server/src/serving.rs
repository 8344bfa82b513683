//! The server's task, and one task per viewer.

mod following;
mod frames;
mod inquiries;
mod pages;
mod sizes;

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::codec::blocks::References;
use isinglass_core::ids::{LookVersion, PoseId};
use isinglass_core::session::frames::FramesServer;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::session::selection::Load;
use isinglass_core::volume::Occlusion;
use isinglass_net::{AfterWork, Journal, Server, Session};
use isinglass_render::Workers;
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::Instant;
use tracing::Instrument;

use crate::audience::{Audience, Presence};
use crate::counters::Counters;
use crate::frame_memory::{FrameMemory, Held};
use crate::generator::Generator;
use crate::paging::Pager;
use crate::pipeline::{Coders, Pipeline, Sent};
use crate::screenshots::Screenshots;
use crate::selection::{Order, Present, SelectionReader};
use crate::slices::{SliceMakers, Slices};
use crate::{Attendance, Command};

use following::{Led, next_led};
use inquiries::Inquiries;
use sizes::FrameSizes;

/// State that all viewers share.
#[derive(Clone)]
pub(crate) struct Common {
    pub(crate) generator: Generator,
    pub(crate) present: watch::Receiver<Arc<Present>>,
    pub(crate) load: watch::Receiver<Option<Load>>,
    pub(crate) orders: mpsc::Sender<Order>,
    pub(crate) plan: CodingPlan,
    pub(crate) after_work: AfterWork,
    pub(crate) coders: Coders,
    /// One for each slice that may be made at a time.
    pub(crate) slice_makers: Arc<SliceMakers>,
    /// The processes that have the volume, if they are several.
    pub(crate) workers: Option<Arc<dyn Workers>>,
    pub(crate) memory: FrameMemory,
    pub(crate) counters: Counters,
    pub(crate) audience: Audience,
}

/// Admits viewers until told to close.
pub(crate) async fn serve(
    mut server: Server,
    reader: SelectionReader,
    common: Common,
    mut commands: mpsc::Receiver<Command>,
    attendance: watch::Sender<Attendance>,
    newest: watch::Sender<Option<Journal>>,
) {
    let mut viewers = JoinSet::new();
    let mut known = HashSet::new();
    let mut present = common.present.clone();
    let reader = tokio::spawn(reader.run());
    let left = server.left();
    loop {
        tokio::select! {
            session = server.accept() => {
                let Some(session) = session else { break };
                let span = tracing::info_span!("session", id = session.id, viewer = session.name, remote = %session.remote);
                let is_new = known.insert(session.viewer);
                newest.send_replace(Some(session.journal.clone()));
                let viewer = Viewer::new(session, common.clone(), is_new);
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
    reader.abort();
    server.close().await;
    viewers.shutdown().await;
    common.generator.dispatch.stop().await;
}

/// One viewer: turns its newest pose into frames until the connection ends.
struct Viewer {
    session: Session,
    common: Common,
    present: Arc<Present>,
    frames: FramesServer,
    pipeline: Pipeline,
    /// References for later frames.
    sent: References,
    /// Their memory.
    held: Held,
    sizes: FrameSizes,
    /// The newest frame, once the network has it: at rest it is sent again, finer.
    resting: Option<Sent>,
    /// Whether this is its first connection.
    is_new: bool,
    /// The ambient occlusion of the last frame that was no draft.
    occlusion: Option<Occlusion>,
    /// The pages of its newest frame, of a volume that is read by pages.
    shown_pages: Option<pages::ShownPages>,
    /// The pose whose frames show the pages of a resting camera.
    resting_pose: Option<PoseId>,
    /// Notified when pages come or go.
    page_changes: Option<watch::Receiver<u64>>,
    /// The shade that is being computed, with its look version.
    refining: Option<(LookVersion, JoinHandle<bool>)>,
    screenshots: Screenshots,
    slices: Slices,
    inquiries: Inquiries,
    presence: Presence,
    /// Notified when viewers come, leave or follow.
    viewers_changed: watch::Receiver<()>,
    /// Whom it follows.
    led: Option<Led>,
}

impl Drop for Viewer {
    fn drop(&mut self) {
        if let Some((_, refining)) = &self.refining {
            refining.abort();
        }
        // From now on, its last orders leave nothing behind.
        let has_left = self.common.generator.dispatch.forget(self.session.viewer);
        if let Some(pager) = self.present.pager.as_ref().filter(|_| has_left) {
            pager.forget(self.session.viewer.0);
        }
    }
}

impl Viewer {
    fn new(session: Session, mut common: Common, is_new: bool) -> Self {
        let plan = common.plan;
        session.frames.set_rate(plan.bytes_per_second);
        let present = common.present.borrow_and_update().clone();
        // Only a reading in progress is news for the viewer.
        let is_reading = common.load.borrow_and_update().as_ref().is_some_and(Load::is_reading);
        if is_reading {
            common.load.mark_changed();
        }
        let screenshots = Screenshots::new(
            session.viewer,
            common.generator.clone(),
            session.frames.clone(),
            session.control.clone(),
        );
        let (frames, control) = (session.frames.clone(), session.control.clone());
        let slices = Slices::new(common.slice_makers.clone(), frames.clone(), control.clone());
        let inquiries = Inquiries::new(control.clone(), common.workers.clone());
        let pipeline = Pipeline::new(frames, control, session.journal.clone(), &common);
        let held = common.memory.nothing();
        let page_changes = present.pager.as_ref().map(Pager::changes);
        let mut viewers_changed = common.audience.subscribe();
        let presence = common.audience.enter(session.viewer, session.id, &session.name);
        common.generator.dispatch.enter(session.viewer);
        viewers_changed.mark_changed();
        Self {
            session,
            common,
            present,
            frames: FramesServer::new(plan),
            pipeline,
            sent: References::default(),
            held,
            sizes: FrameSizes::default(),
            resting: None,
            is_new,
            occlusion: None,
            shown_pages: None,
            resting_pose: None,
            page_changes,
            refining: None,
            screenshots,
            slices,
            inquiries,
            presence,
            viewers_changed,
            led: None,
        }
    }

    async fn run(mut self) {
        tracing::info!("viewer connected");
        // Another volume may have come since its welcome.
        if !Arc::ptr_eq(&self.session.greeting, &self.present.greeting) {
            self.turn_to_present(None);
        } else {
            self.tell_parts();
            if self.is_new {
                self.tell_oddities();
            }
        }
        while self.step().await {}
        tracing::info!(frames = self.frames.newest().0, "viewer gone");
    }

    /// Moves frames on and handles the next event; false when the viewer has left.
    async fn step(&mut self) -> bool {
        self.take_requests().await;
        self.send_finer();
        let dues = [self.advance(), self.refine(), self.look_after_leader()];
        let due = dues.into_iter().flatten().min();
        tokio::select! {
            biased;
            Ok(()) = self.common.present.changed() => {
                let before = self.present.clone();
                self.present = self.common.present.borrow_and_update().clone();
                self.turn_to_present(Some(&before));
                true
            }
            Ok(()) = self.common.load.changed() => {
                if let Some(load) = self.common.load.borrow_and_update().clone() {
                    self.session.talk().selection.handle_load(load);
                }
                true
            }
            (version, is_there) = refined(&mut self.refining) => {
                let now = self.now_micros();
                let mut talk = self.session.talk();
                if let Some(problem) = talk.look.handle_refined(now, version, is_there) {
                    talk.link.notice(&problem);
                }
                true
            }
            () = changed(&mut self.page_changes) => true,
            event = self.pipeline.next() => self.handle(event),
            () = self.slices.next() => true,
            Ok(()) = self.viewers_changed.changed() => {
                self.tell_viewers();
                true
            }
            () = self.presence.joined() => {
                self.lead_at_rest();
                true
            }
            frame = next_led(&mut self.led) => {
                self.take_led(frame);
                true
            }
            // This comes last because a moving camera always has another pose.
            is_here = self.session.hear() => is_here,
            () = tokio::time::sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => true,
        }
    }

    /// Takes the viewer's requests so far.
    async fn take_requests(&mut self) {
        let now = self.now_micros();
        let (pose, order, shot, look, leader, is_new_look);
        {
            let mut talk = self.session.talk();
            let wanted = talk.quietly().look.poll_wanted();
            is_new_look = wanted.is_some();
            if let Some(look) = wanted {
                tracing::info!(transfer = look.transfer.name, k = look.k, "new look");
                let is_whole = self.present.lights.is_fine(&look);
                talk.look.begin(now, look, is_whole);
            }
            if talk.probe.is_asked() || talk.profile.is_asked() {
                self.inquiries.answer(&mut talk, &self.present);
            }
            let quiet = talk.quietly();
            (pose, order) = (quiet.pose.poll_new(), quiet.selection.poll_order());
            (shot, look) = (quiet.screenshot.poll_request(), quiet.look.look().clone());
            leader = quiet.viewers.poll_wanted();
        }
        if let Some(leader) = leader {
            self.follow(leader);
        }
        if is_new_look {
            // An own look is for own frames.
            if self.led.is_some() {
                self.follow(None);
            }
            self.note_look();
        }
        if let Some(pose) = pose.filter(|_| self.led.is_none()) {
            self.note_pose(&pose);
        }
        if let Some(shot) = shot {
            self.screenshots.set(shot, &look, &self.present);
        }
        self.slices.advance(&self.present);
        if let Some(part) = order {
            // Without a reader the volume stays as it is.
            let _ = self.common.orders.send((self.session.viewer, part)).await;
        }
    }

    /// From now on the viewer gets the present volume.
    fn turn_to_present(&mut self, before: Option<&Present>) {
        let now = self.now_micros();
        self.inquiries.give_up();
        let Present { greeting, lights, .. } = &*self.present;
        {
            let mut talk = self.session.talk();
            talk.probe.handle_volume();
            talk.profile.handle_volume();
            // Equal values keep their colours.
            let before = before.filter(|before| before.has_values_like(&self.present));
            let at_values = before.map(|before| before.lights.at_values(talk.look.look()));
            let volume = greeting.volume.clone();
            talk.look.handle_volume(now, volume, &greeting.look, at_values, |look| lights.is_fine(look));
            let since = talk.look.version();
            talk.slices.handle_volume(since);
        }
        self.frames.handle_volume();
        self.session.talk().pages.handle_volume();
        (self.shown_pages, self.resting_pose) = (None, None);
        self.page_changes = self.present.pager.as_ref().map(Pager::changes);
        if let Some(led) = &mut self.led {
            led.request = None;
        }
        self.sizes = FrameSizes::default();
        self.forget_sent();
        self.occlusion = None;
        self.tell_parts();
        // The times of a film share theirs.
        let warnings = |present: &Present| present.lights.volume().info.warnings.clone();
        if before.is_none_or(|before| warnings(before) != warnings(&self.present)) {
            self.tell_oddities();
        }
    }

    /// Tells the user about oddities of the volume.
    fn tell_oddities(&self) {
        let warnings = &self.present.lights.volume().info.warnings;
        if !warnings.is_empty() {
            self.session.talk().link.notice(&warnings.join("; "));
        }
    }

    fn tell_parts(&self) {
        if let Some(parts) = self.present.parts.clone() {
            self.session.talk().selection.handle_choices(parts);
        }
    }

    /// Computes the shade of a resting look beside the frames, and cancels that of a replaced one. Returns when to
    /// ask again.
    fn refine(&mut self) -> Option<Instant> {
        if self.led.is_some() {
            // The leader has it computed.
            return None;
        }
        let now = self.now_micros();
        let mut talk = self.session.talk();
        if let Some((_, outdated)) = self.refining.take_if(|(version, _)| !talk.look.is_refining(*version)) {
            outdated.abort();
        }
        if let Some((version, look)) = talk.quietly().look.poll_refine(now) {
            let (present, generator) = (self.present.clone(), self.common.generator.clone());
            let work = tokio::spawn(async move {
                present.lights.scene(&look, Some((&generator, present.scene))).await.is_some()
            });
            self.refining = Some((version, work));
        }
        talk.look.due().map(|due| Instant::now() + Duration::from_micros(due.saturating_sub(now)))
    }

    fn now_micros(&self) -> u64 {
        self.session.journal.clock().now_micros()
    }
}

/// Returns when pages have come or gone; never if there are none.
async fn changed(pages: &mut Option<watch::Receiver<u64>>) {
    let Some(pages) = pages else { return std::future::pending().await };
    if pages.changed().await.is_err() {
        std::future::pending::<()>().await;
    }
}

/// Returns when the shade is there or has failed, with its look version; never if none is being computed.
async fn refined(refining: &mut Option<(LookVersion, JoinHandle<bool>)>) -> (LookVersion, bool) {
    let Some((version, running)) = refining else { return std::future::pending().await };
    let ended = (*version, running.await.unwrap_or(false));
    *refining = None;
    ended
}
