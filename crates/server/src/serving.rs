//! The task of the server, and one task for each viewer.

mod frames;

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::codec::blocks::References;
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::look::Look;
use isinglass_core::session::rate::{Mode, Pilot, Plan};
use isinglass_core::session::server::Request;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::wire::{LoadStatus, ProbeRequest, VolumeChange};
use isinglass_net::server::ControlSender;
use isinglass_net::{AfterWork, Journal, Server, Session};
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::Instant;
use tracing::Instrument;

use crate::generator::Generator;
use crate::parts::{Librarian, Load, Order, Present, TELL_PERIOD, load_due};
use crate::pipeline::{Coders, Pipeline, Sent};
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
    pub(crate) coders: Coders,
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
    /// When the newest frame was begun.
    begun_at: Option<Instant>,
    /// Whether no newer pose has come since.
    rests: bool,
    /// What the newest frame was made for.
    answered: Option<(PoseId, LookVersion)>,
    /// The frames in the works.
    pipeline: Pipeline,
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
        let (frames, control) = (session.frames.clone(), session.control.clone());
        let pipeline = Pipeline::new(frames, control, session.journal.clone(), &house);
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
            begun_at: None,
            rests: false,
            answered: None,
            pipeline,
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
        while is_welcome && self.step().await {}
        tracing::info!(frames = self.frame.0, "viewer gone");
    }

    /// Moves frames on, and takes the next thing that happens; false when the viewer has left.
    async fn step(&mut self) -> bool {
        self.send_finer();
        let look_again_at = self.advance();
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
            event = self.pipeline.next() => self.handle(event).await,
            changed = self.session.poses.changed() => {
                self.note_pose();
                changed.is_ok()
            }
            () = tokio::time::sleep_until(look_again_at.unwrap_or_else(Instant::now)), if look_again_at.is_some() => true,
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
        tracing::info!(transfer = look.transfer.name, k = look.k, "new look");
        let is_draft = !self.present.lights.is_fine(&look);
        self.look = Arc::new(look);
        self.stop_refining();
        self.begin_version(is_draft).await
    }

    /// Frames from now on have another number, and the newest pose shall be answered again.
    async fn begin_version(&mut self, is_draft: bool) -> bool {
        self.version = self.version.next();
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

/// A look that has not changed for so long rests: dragging does not have to wait for shade that is out of date.
const LOOK_REST: Duration = Duration::from_millis(150);
