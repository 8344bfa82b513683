//! A server with a model of a renderer, and a viewer that turns its camera.

use std::sync::Arc;
use std::time::Duration;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::blocks::{Reference, References};
use isinglass_core::codec::{Chunk, Coding, HEADER_BYTES};
use isinglass_core::ids::{FrameId, LookVersion};
use isinglass_core::layer::LayeredFrame;
use isinglass_core::look::Look;
use isinglass_core::session::frames::{Asked, FramesServer, Sending};
use isinglass_core::session::ledger::Stage;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::session::schedule::{Schedule, Station};
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::wire::VolumeDescription;
use tokio::time::Instant;

use crate::client::model::ModelClient;
use crate::server::{Greeting, Session};

/// What frames take and how long they are.
#[derive(Clone, Copy, Debug)]
pub(super) struct Renderer {
    pub(super) generate: Duration,
    pub(super) code: Duration,
    /// Bytes of the worst picture, of the best in blocks, and of an exact one.
    pub(super) bytes: [f64; 3],
}

impl Default for Renderer {
    fn default() -> Self {
        let millis = Duration::from_millis;
        Self { generate: millis(2), code: millis(5), bytes: [6e3, 90e3, 240e3] }
    }
}

impl Renderer {
    fn bytes_of(&self, coding: &Coding) -> usize {
        let [worst, best, exact] = self.bytes;
        match coding {
            Coding::Exact => exact as usize,
            Coding::Blocks(settings) => {
                (worst * (best / worst).powf(f64::from(settings.quality) / 100.0)) as usize
            }
        }
    }
}

/// Lists of a frame, as the control of the coding counts them.
pub(super) const INTRINSICS: Intrinsics = Intrinsics::perspective(200, 150, 0.6);
const BOUNDS: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };

pub(super) fn pose(angle_deg: f32) -> Pose {
    Pose::orbit(Vec3::ZERO, angle_deg.to_radians(), 0.1, 5.0)
}

pub(super) fn greeting() -> Greeting {
    let point = |x| ControlPoint { x, color: [1.0, 0.5, 0.0], opacity: x };
    let transfer = TransferFunction {
        name: "ramp".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![point(0.0), point(1.0)],
    };
    let volume = VolumeDescription {
        name: "model".into(),
        dims: [8; 3],
        spacing: [1.0; 3],
        unit: None,
        orientation: None,
        placement: None,
        value_unit: None,
        value_range: (0.0, 1.0),
        histogram_range: (0.0, 1.0),
        histogram: vec![1; 4],
        channels: vec![],
    };
    Greeting {
        volume,
        look_version: LookVersion(1),
        look: Look { k: 4, shaded: false, ..Look::new(transfer) },
    }
}

/// One station's work: when it ends, and on what.
type At<T> = Option<(Instant, T)>;

/// Answers the poses of one viewer until it leaves.
pub(super) async fn serve(mut session: Session, renderer: Renderer) {
    let clock = session.journal.clock().clone();
    let (mut frames, mut schedule) = (FramesServer::new(CodingPlan::default()), Schedule::default());
    let mut references = References::default();
    let lists = INTRINSICS.num_pixels();
    let mut generating: At<Asked> = None;
    let mut made: Option<Asked> = None;
    let mut coding: At<Coded> = None;
    let mut coded: Option<Coded> = None;
    let mut sending: Option<(tokio::task::JoinHandle<bool>, Sending)> = None;
    loop {
        let (now, at) = (clock.now_micros(), Instant::now());
        if let Some((_, asked)) = generating.take_if(|(end, _)| *end <= at) {
            frames.handle_generated(renderer.generate.as_micros() as u64);
            schedule.handle_done(now, Station::Generate, true);
            made = Some(asked);
        }
        if let Some((_, done)) = coding.take_if(|(end, _)| *end <= at) {
            schedule.handle_done(now, Station::Code, done.sending.is_usual());
            let micros = renderer.code.as_micros() as u64;
            frames.handle_encoded(&done.sending, done.is_predicted, done.chunk.bytes.len(), micros);
            if let Some(reference) = &done.reference {
                references.insert(reference.clone());
            }
            coded = Some(done);
        }
        if sending.is_none()
            && let Some(next) = coded.take()
        {
            schedule.handle_begun(now, Station::Send, lists);
            let (sender, header) = (session.frames.clone(), next.sending.asked.header);
            let (is_finer, chunks) = (next.sending.is_finer, vec![next.chunk]);
            let task = tokio::spawn(async move {
                match is_finer {
                    true => sender.send_finer(header.frame, header.pose, chunks).await.is_ok(),
                    false => sender.send(header.frame, header.pose, chunks).await.is_ok(),
                }
            });
            sending = Some((task, next.sending));
        }
        if let Some(asked) = made.take_if(|_| coding.is_none() && coded.is_none()) {
            let reported = session.talk().quietly().chunks.reported();
            let reference = references.next(reported);
            let link = session.frames.link_state();
            let sending = frames.choose_coding(link, asked, Default::default(), reference.is_some());
            let next = Coded::of(sending, reference.map(|r| &**r), &renderer);
            schedule.handle_begun(now, Station::Code, lists);
            coding = Some((at + renderer.code, next));
        }
        let mut due = None;
        let request = session.talk().quietly().pose.newest();
        let is_idle = generating.is_none() && made.is_none() && coding.is_none() && coded.is_none();
        if let Some(request) = request {
            let mut talk = session.control.talk();
            let look = &talk.quietly().look;
            if !frames.is_answered(request.id, look.version()) {
                match schedule.begin_at(now, lists) {
                    Some(begin) if begin <= now => {
                        let asked = frames.begin(now, &request, look, &BOUNDS);
                        schedule.handle_begun(now, Station::Generate, lists);
                        generating = Some((at + renderer.generate, asked));
                    }
                    begin => due = begin,
                }
            } else if is_idle && sending.is_none() {
                due = frames.finer_due(look);
                if let Some(finer) = frames.poll_finer(now, look) {
                    schedule.handle_begun(now, Station::Code, lists);
                    coding = Some((at + renderer.code, Coded::of(finer, None, &renderer)));
                    due = None;
                }
            }
        }
        let wait = due.map(|due| at + Duration::from_micros(due.saturating_sub(now)));
        let ends = generating.as_ref().map(|g| g.0).into_iter().chain(coding.as_ref().map(|c| c.0));
        let next = wait.into_iter().chain(ends).min();
        tokio::select! {
            biased;
            sent = ended(&mut sending) => {
                let Some(sent) = sent else { return };
                schedule.handle_done(clock.now_micros(), Station::Send, sent.is_usual());
                frames.handle_sent(sent);
            }
            () = tokio::time::sleep_until(next.unwrap_or(at)), if next.is_some() => {}
            is_here = session.hear() => {
                if !is_here {
                    return;
                }
                let mut talk = session.talk();
                let pose = talk.quietly().pose.poll_new();
                drop(talk);
                if let Some(pose) = pose {
                    frames.handle_pose(clock.now_micros(), &pose, None);
                }
            }
        }
    }
}

/// `None` if the viewer has left.
async fn ended(sending: &mut Option<(tokio::task::JoinHandle<bool>, Sending)>) -> Option<Sending> {
    let Some((task, _)) = sending else { return std::future::pending().await };
    let is_sent = task.await.unwrap_or(false);
    sending.take().filter(|_| is_sent).map(|(_, sent)| sent)
}

struct Coded {
    sending: Sending,
    is_predicted: bool,
    reference: Option<Arc<Reference>>,
    chunk: Chunk,
}

impl Coded {
    /// A real header and head of a chunk, with as many bytes behind it as the model says.
    fn of(sending: Sending, reference: Option<&Reference>, renderer: &Renderer) -> Self {
        let mut header = sending.asked.header;
        header.camera = Camera::new(sending.asked.request.pose, Intrinsics::perspective(8, 8, 0.6), &BOUNDS);
        let frame = LayeredFrame::empty(header);
        let encoded = sending.coding.encode_while(&frame, reference, &|| true);
        let (mut encoded, of_this) = encoded.expect("an empty frame can be coded");
        let mut chunk = encoded.chunks.swap_remove(0);
        let length = renderer.bytes_of(&sending.coding).max(chunk.bytes.len());
        chunk.bytes.resize(length, 0);
        let payload_bytes = (length - HEADER_BYTES) as u32;
        chunk.bytes[HEADER_BYTES - 4..HEADER_BYTES].copy_from_slice(&payload_bytes.to_le_bytes());
        Self { sending, is_predicted: reference.is_some(), reference: of_this, chunk }
    }
}

/// What a viewer has shown.
#[derive(Clone, Debug, Default)]
pub(super) struct Shown {
    /// At each refresh: when it was, and the age of the frame on the screen, ms since the movement began.
    pub(super) ages: Vec<(f64, f64)>,
    /// When frames came, ms.
    pub(super) frames: Vec<(f64, FrameId)>,
    /// When an exact frame of the newest pose came, ms.
    pub(super) exact: Vec<f64>,
    /// Received bytes of frames.
    pub(super) bytes: u64,
}

impl Shown {
    /// The age that so many of all refreshes between two times did not exceed, ms.
    pub(super) fn age(&self, share: f64, from_ms: f64, to_ms: f64) -> f64 {
        let within = self.ages.iter().filter(|(at, _)| (from_ms..to_ms).contains(at));
        let mut ages: Vec<f64> = within.map(|(_, age)| *age).collect();
        ages.sort_by(f64::total_cmp);
        ages.get(((ages.len() as f64 * share) as usize).min(ages.len().saturating_sub(1)))
            .copied()
            .unwrap_or(f64::INFINITY)
    }

    pub(super) fn frames_per_second(&self, from_ms: f64, to_ms: f64) -> f64 {
        let num = self.frames.iter().filter(|(at, _)| (from_ms..to_ms).contains(at)).count();
        num as f64 * 1e3 / (to_ms - from_ms)
    }
}

/// Turns the camera for `moving`, then rests for `resting`. The screen refreshes 60 times a second.
pub(super) async fn view(client: ModelClient, moving: Duration, resting: Duration) -> Shown {
    let mut shown = Shown::default();
    let start = Instant::now();
    let mut newest = None;
    let mut refresh = 0u32;
    let end = start + moving + resting;
    let mut tick = tokio::time::interval(Duration::from_millis(1));
    while Instant::now() < end {
        tick.tick().await;
        let elapsed = start.elapsed();
        let now_ms = elapsed.as_secs_f64() * 1e3;
        for (life, is_exact) in client.decode() {
            shown.frames.push((now_ms, life.frame));
            shown.bytes += life.bytes;
            if is_exact {
                shown.exact.push(now_ms);
            }
            newest = Some(life);
        }
        if elapsed.as_micros() * 60 < u128::from(refresh) * 1_000_000 {
            continue;
        }
        refresh += 1;
        if elapsed < moving {
            client.set_pose(pose(refresh as f32 * 0.5), INTRINSICS);
        }
        if let Some(asked) = newest.as_ref().and_then(|life| life.at(Stage::Asked)) {
            let age_ms = client.now_micros().saturating_sub(asked) as f64 / 1e3;
            shown.ages.push((now_ms, age_ms));
        }
    }
    shown
}
