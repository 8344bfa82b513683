//! The work of a viewer at every refresh, with or without a window: request the camera's frame, take the newest one,
//! and relate the two. Nothing here waits, draws or reads a clock.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::camera::{Camera, Intrinsics, Pose, Projection};
use isinglass_core::clip::Clip;
use isinglass_core::ids::PoseId;
use isinglass_core::layer::{Fineness, MAX_K, max_lists};
use isinglass_core::look::Look;
use isinglass_core::prediction::Predictor;
use isinglass_core::session::ledger::Stage;
use isinglass_core::space::Aabb;
use isinglass_net::{ReceivedFrame, State};

use crate::input::camera_controls::angle_between_degrees;
use crate::view::foresight::{Foresight, Limits, camera_of, eye_of, guard_band, widest};
use crate::view::frame_source::FrameSource;
use crate::view::kept::KeptFrames;

/// How the displayed picture relates to the server's picture of the same camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// No frame has arrived yet, or nothing can be drawn yet.
    Waiting,
    /// The camera moves; the picture is a novel view of the newest frame.
    Moving,
    /// The camera rests; its own frame is not complete yet.
    Refining,
    /// The camera rests without a connection, so nothing better can arrive.
    Offline,
    /// The camera rests, and the frames are those of a viewer that this one follows.
    Following,
    /// The camera's own frame is complete, but in blocks or of another size than the picture, or the picture is for two
    /// eyes.
    Settled,
    /// The camera's own frame is complete, exact and of the picture's size: casting it gives the server's picture.
    Exact,
}

/// The size of requested frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameSize {
    /// Greatest width of a frame.
    pub max_width: u32,
    /// Greatest height of a frame.
    pub max_height: u32,
    /// Size of a frame in units of the picture's, at most 1.
    pub scale: f32,
    /// Longest time of the server for a frame of a moving camera; frames shrink to keep it. A coarser fresh frame
    /// beats a fine late one. At rest they have their full size again.
    pub moving_budget: Option<Duration>,
}

impl Default for FrameSize {
    fn default() -> Self {
        Self { max_width: 1920, max_height: 1200, scale: 1.0, moving_budget: None }
    }
}

impl FrameSize {
    /// The frame to request for the picture `picture`: the same view, scaled down evenly if it is too large. The
    /// server's limit is `max_side`.
    pub fn frame_for(&self, picture: Intrinsics, max_side: u32) -> Intrinsics {
        let (width, height) = (picture.width.max(1) as f32, picture.height.max(1) as f32);
        let fit = |limit: u32, side: f32| limit.min(max_side) as f32 / side;
        let scale = self.scale.min(fit(self.max_width, width)).min(fit(self.max_height, height)).min(1.0);
        let scaled = |x: f32| (x * scale).round().max(1.0) as u32;
        Intrinsics { width: scaled(width), height: scaled(height), ..picture }
    }

    /// The same for a moving camera, if a list costs the server `micros_per_list`.
    fn moving_frame_for(
        &self,
        picture: Intrinsics,
        max_side: u32,
        micros_per_list: Option<f32>,
    ) -> Intrinsics {
        let full = self.frame_for(picture, max_side);
        let (Some(budget), Some(micros_per_list)) = (self.moving_budget, micros_per_list) else {
            return full;
        };
        let cost = full.num_pixels() as f32 * micros_per_list;
        let affordable = (budget.as_micros() as f32 / cost).sqrt();
        let step = MOVING_SCALES.into_iter().find(|s| *s <= affordable).unwrap_or(LEAST_MOVING_SCALE);
        Self { scale: self.scale * step, ..*self }.frame_for(picture, max_side)
    }
}

/// What to draw at a refresh, and its relation to the server.
#[derive(Clone, Debug)]
pub struct Refresh {
    /// The camera of the picture.
    pub camera: Camera,
    /// The box of the volume.
    pub bounds: Aabb,
    /// The part of the volume to show now, whatever the frame holds.
    pub clip: Clip,
    /// The frame to cast.
    pub frame: Option<Arc<ReceivedFrame>>,
    /// Older frames for what it lacks; usually none.
    pub kept: Vec<Arc<ReceivedFrame>>,
    /// Relation of the picture to the server's.
    pub standing: Standing,
    /// Time since the frame's pose was last requested: zero while the camera rests there.
    pub frame_age: Option<Duration>,
    /// Angle between the frame's pose and the camera's.
    pub turned_degrees: Option<f32>,
    /// Whether the requested pose is a predicted one. A camera that stops needs one more refresh to request its own.
    pub is_ahead: bool,
    /// Whether the camera or the frame differs from the previous refresh.
    pub changed: bool,
    /// Since when the picture has an older look than the chosen one. `None` if it has that look, or one that shows
    /// more and is cut here.
    pub older_look_since: Option<Duration>,
}

/// Keeps the requests and the newest frame. Call [`Viewing::refresh`] once for each picture.
pub struct Viewing<S> {
    source: S,
    /// The size of frames.
    pub frame_size: FrameSize,
    foresight: Foresight,
    predictor: Predictor,
    kept: KeptFrames,
    /// The pose of the newest frame whose delay was measured.
    measured: PoseId,
    asked: Option<(Pose, Intrinsics)>,
    /// Requested poses, and when each was last requested.
    left: VecDeque<(Pose, Duration)>,
    last: Option<(Camera, Option<Arc<ReceivedFrame>>)>,
    /// The time of the first refresh.
    began_at: Option<Duration>,
    moved_at: Duration,
    refreshed_at: Duration,
    /// The server's last known cost of generating and encoding a list.
    micros_per_list: Option<f32>,
    /// The last change of the chosen look.
    look_changed_at: Option<Duration>,
    older_look_since: Option<Duration>,
    /// The box of the newest frame's volume.
    frame_bounds: Option<Aabb>,
}

impl<S: FrameSource> Viewing<S> {
    /// Shows the frames of `source`.
    pub fn new(source: S, frame_size: FrameSize, foresight: Foresight) -> Self {
        Self {
            source,
            frame_size,
            foresight,
            predictor: Predictor::default(),
            kept: KeptFrames::default(),
            measured: PoseId(0),
            asked: None,
            left: VecDeque::new(),
            last: None,
            began_at: None,
            moved_at: Duration::ZERO,
            refreshed_at: Duration::ZERO,
            micros_per_list: None,
            look_changed_at: None,
            older_look_since: None,
            frame_bounds: None,
        }
    }

    /// Takes the source of frames.
    pub fn into_source(self) -> S {
        self.source
    }

    /// The source of frames.
    pub fn source(&self) -> &S {
        &self.source
    }

    /// The source of frames, for anything else that the viewer says.
    pub fn source_mut(&mut self) -> &mut S {
        &mut self.source
    }

    /// A picture from `pose` at `now`, the time on the clock of the source's stamps. `bounds` is the box of the volume.
    pub fn refresh(&mut self, now: Duration, pose: Pose, picture: Intrinsics, bounds: &Aabb) -> Refresh {
        let camera = Camera::new(pose, picture, bounds);
        let max_side = self.source.description().map_or(u32::MAX, |d| d.max_side);
        let full = self.frame_size.frame_for(picture, max_side);
        self.began_at.get_or_insert(now);
        let newest = self.source.latest_frame();
        self.note_cost(newest.as_deref());
        self.note_delay(now, newest.as_deref());
        let frame = self.choose(now, newest, (pose, full));
        if self.last.as_ref().is_some_and(|(last, _)| has_moved(last, &camera)) {
            self.moved_at = now;
        }
        let eye = eye_of(&camera, bounds);
        self.predictor.observe(now, eye, bounds.center());
        let predicted = self.predictor.predict().filter(|ahead| self.foresight.predicts && *ahead != eye);
        let ahead_camera = predicted.map_or(camera, |ahead| camera_of(ahead, &camera, bounds));
        let ahead = ahead_camera.pose;
        let has_own = frame.as_deref().filter(|f| self.is_settled(now, f, (pose, full)));
        let has_older_look = frame.as_ref().is_some_and(|f| !self.shows_wanted_look(f, bounds));
        let is_editing = self.is_changing_look(now, has_older_look);
        let size = self.size((now, is_editing), ahead_camera, &camera, has_own, max_side, bounds);
        if let Some((left, _)) = self.asked.filter(|(asked, _)| *asked != ahead) {
            if self.left.len() == MAX_LEFT {
                self.left.pop_front();
            }
            self.left.push_back((left, self.refreshed_at));
        }
        let is_of_volume = frame.as_deref().is_none_or(|f| self.source.is_of_volume(f));
        // Exact frames say nothing about frames in blocks: they arrive at rest, or in another way.
        let tells = |f: &&ReceivedFrame| !f.is_exact && is_of_volume && self.is_moving(now);
        let told = frame.as_deref().filter(tells).map(|f| turned_degrees(f, &camera, bounds));
        self.source.talk().quietly().pose.note_turn(told);
        let wish = (ahead, size);
        if self.asked.replace(wish) != Some(wish) {
            self.source.set_pose(now, ahead, size);
        }
        self.refreshed_at = now;
        let is_same = |(last_camera, last_frame): &(Camera, Option<Arc<ReceivedFrame>>)| {
            *last_camera == camera
                && match (last_frame, &frame) {
                    (Some(a), Some(b)) => Arc::ptr_eq(a, b),
                    (a, b) => a.is_none() == b.is_none(),
                }
        };
        let changed = !self.last.as_ref().is_some_and(is_same);
        if let Some(f) = frame.as_ref().filter(|_| changed) {
            self.source.note_shown(f.frame.header.frame);
        }
        self.last = Some((camera, frame.clone()));
        // Until the first frame of another volume arrives, the previous volume stays at its size.
        let drawn = *self.frame_bounds.get_or_insert(*bounds);
        let (drawn, camera) = match is_of_volume {
            true => (*self.frame_bounds.insert(*bounds), camera),
            false => (drawn, scaled(&camera, bounds, &drawn)),
        };
        let mut kept = Vec::new();
        if let Some(frame) = frame.as_ref().filter(|_| self.foresight.keeps) {
            self.kept.note(frame, &drawn);
            kept = self.kept.choose(frame, &camera, &drawn);
        }
        let turned_degrees = frame.as_deref().map(|f| turned_degrees(f, &camera, &drawn));
        self.older_look_since = has_older_look.then(|| self.older_look_since.unwrap_or(now));
        Refresh {
            standing: self.standing(now, frame.as_deref(), (pose, full), picture),
            frame_age: frame.as_deref().and_then(|f| self.age(now, f, (pose, full))),
            turned_degrees,
            is_ahead: predicted.is_some(),
            kept,
            camera,
            bounds: drawn,
            clip: self.look().map_or_else(Clip::default, |look| look.clip),
            frame,
            changed,
            older_look_since: self.older_look_since,
        }
    }

    /// The size to request. `ahead` is the camera of the request, `shown` the displayed one, and `own` its frame, if
    /// present. While the look `is_editing`, a small frame shows it.
    fn size(
        &self,
        (now, is_editing): (Duration, bool),
        ahead: Camera,
        shown: &Camera,
        own: Option<&ReceivedFrame>,
        max_side: u32,
        bounds: &Aabb,
    ) -> Intrinsics {
        let picture = ahead.intrinsics;
        let full = self.frame_size.frame_for(picture, max_side);
        let k = self.source.talk().look.in_force().map_or(MAX_K as u8, |(_, look)| look.k);
        let limits = Limits { max_side, max_lists: max_lists(k) };
        if let Some(own) = own {
            // The picture is already the server's own; matter beside it is for the next movement.
            let has_margin = own.frame.header.camera.intrinsics != full;
            return match self.foresight.guards {
                true if has_margin => own.frame.header.camera.intrinsics,
                true => widest(Camera { intrinsics: full, ..ahead }, bounds, limits),
                false => full,
            };
        }
        if self.is_beginning(now) {
            return self.frame_size.moving_frame_for(picture, max_side, Some(UNKNOWN_MICROS_PER_LIST));
        }
        if !self.is_moving(now) {
            return match is_editing {
                true => self.draft_size(picture, max_side),
                false => full,
            };
        }
        let of_size = |growth: f32| {
            self.frame_size.moving_frame_for(picture, max_side, self.micros_per_list.map(|m| m * growth))
        };
        let bare = of_size(1.0);
        let reach = self.predictor.reach().filter(|_| self.foresight.guards && !self.predictor.is_resting());
        let Some(reach) = reach else { return bare };
        let reach = camera_of(reach, shown, bounds);
        let wide = |i| guard_band(Camera { intrinsics: i, ..ahead }, shown, &reach, bounds, limits);
        let growth = wide(bare).num_pixels() as f32 / bare.num_pixels() as f32;
        wide(of_size(growth))
    }

    /// The frame to show: the newest. The exception is a picture that is already the server's own, if the newest has
    /// the same pose but is not exact.
    fn choose(
        &self,
        now: Duration,
        newest: Option<Arc<ReceivedFrame>>,
        own: (Pose, Intrinsics),
    ) -> Option<Arc<ReceivedFrame>> {
        let newest = newest?;
        let shown = self.last.as_ref().and_then(|(_, frame)| frame.as_ref());
        let shown = shown.filter(|f| {
            f.is_exact && !newest.is_exact && is_own(&newest, own) && self.is_settled(now, f, own)
        });
        Some(shown.cloned().unwrap_or(newest))
    }

    /// Measures the time from a request to its frame. A pose that is answered again, with another look or connection,
    /// does not count.
    fn note_delay(&mut self, now: Duration, frame: Option<&ReceivedFrame>) {
        let Some(frame) = frame.filter(|f| f.frame.header.pose > self.measured) else { return };
        self.measured = frame.frame.header.pose;
        if let Some(asked_at) = frame.times.at(Stage::Asked) {
            self.predictor.note_shown(now, Duration::from_micros(asked_at));
        }
    }

    /// The chosen look: the last request until the server has it.
    pub fn look(&self) -> Option<Arc<Look>> {
        self.source.talk().look.chosen()
    }

    /// Requests another look; an invalid one is ignored.
    pub fn set_look(&mut self, now: Duration, look: Look) {
        let set = self.source.talk().look.set(now.as_micros() as u64, look);
        match set {
            Ok(()) => {
                self.look_changed_at = Some(now);
                self.ask_for_draft(now);
            }
            Err(e) => tracing::warn!("look ignored: {e}"),
        }
    }

    /// Requests a small frame in the moment of an edit. Otherwise the server begins a whole frame of the new look before
    /// the next refresh says that the hand is at work.
    fn ask_for_draft(&mut self, now: Duration) {
        let Some((pose, _)) = self.asked.filter(|_| !self.is_moving(now)) else { return };
        let Some((camera, Some(_))) = &self.last else { return };
        let max_side = self.source.description().map_or(u32::MAX, |d| d.max_side);
        let wish = (pose, self.draft_size(camera.intrinsics, max_side));
        if self.asked.replace(wish) != Some(wish) {
            self.source.set_pose(now, wish.0, wish.1);
        }
    }

    /// The size of a frame that shows an edit first.
    fn draft_size(&self, picture: Intrinsics, max_side: u32) -> Intrinsics {
        let cost = self.micros_per_list.unwrap_or(UNKNOWN_MICROS_PER_LIST);
        self.frame_size.moving_frame_for(picture, max_side, Some(cost))
    }

    /// Whether a picture of a frame has the last requested look. That holds for a frame with it, or with one that
    /// only shows more of the volume, which the viewer cuts.
    fn shows_wanted_look(&self, frame: &ReceivedFrame, bounds: &Aabb) -> bool {
        let version = frame.frame.header.look;
        let (is_chosen, looks) = {
            let talk = self.source.talk();
            (talk.look.is_chosen(version), talk.look.of_version(version).zip(talk.look.chosen()))
        };
        is_chosen
            || looks.is_some_and(|(of_frame, wanted)| {
                self.source.is_of_volume(frame)
                    && wanted.clip.is_within(&of_frame.clip, bounds)
                    && *of_frame == Look { clip: of_frame.clip, ..(*wanted).clone() }
            })
    }

    /// Whether the first frame is being requested. It is small, so that something appears while the server makes a
    /// whole one. That is requested a moment later, when the server is at work.
    fn is_beginning(&self, now: Duration) -> bool {
        let has_frame = self.last.as_ref().is_some_and(|(_, frame)| frame.is_some());
        !has_frame && self.began_at.is_some_and(|began| now < began + BEGINNING)
    }

    fn is_moving(&self, now: Duration) -> bool {
        self.moved_at > Duration::ZERO && now < self.moved_at + REST
    }

    /// Whether an edit first appears in a small frame. The full one is requested when the hand rests and the small one
    /// is there. Before that, a busy server would begin the full one without the small one.
    fn is_changing_look(&self, now: Duration, has_older_look: bool) -> bool {
        let patience = if has_older_look { DRAFT_PATIENCE } else { REST };
        self.look_changed_at.is_some_and(|at| now < at + patience)
    }

    /// Learns the cost of a list from the server's report on the displayed frame.
    fn note_cost(&mut self, frame: Option<&ReceivedFrame>) {
        let cost = self.source.stats().server;
        if let Some(header) = frame.map(|f| &f.frame.header).filter(|h| h.frame == cost.frame) {
            let micros = (cost.generate_micros + cost.encode_micros) as f32;
            self.micros_per_list = Some(micros / header.camera.intrinsics.num_pixels() as f32);
        }
    }

    /// The server's time for a whole frame of the picture, once it is known.
    pub fn time_of_frame(&self) -> Option<Duration> {
        let (camera, _) = self.last.as_ref()?;
        let whole = self.frame_size.frame_for(camera.intrinsics, u32::MAX);
        Some(Duration::from_micros((self.micros_per_list? * whole.num_pixels() as f32) as u64))
    }

    fn standing(
        &self,
        now: Duration,
        frame: Option<&ReceivedFrame>,
        (pose, full): (Pose, Intrinsics),
        picture: Intrinsics,
    ) -> Standing {
        let Some(frame) = frame else { return Standing::Waiting };
        let is_connected = self.source.state() == State::Connected && !self.source.stats().is_silent();
        if is_connected && self.is_settled(now, frame, (pose, full)) {
            let is_whole = frame.frame.header.fineness == Fineness::Whole;
            if full == picture && frame.is_exact && is_whole { Standing::Exact } else { Standing::Settled }
        } else if self.is_moving(now) {
            Standing::Moving
        } else if is_connected && self.source.talk().viewers.following().is_some() {
            Standing::Following
        } else if is_connected {
            Standing::Refining
        } else {
            Standing::Offline
        }
    }

    /// Whether a frame is the camera's own and of the chosen look, and no better one will come.
    fn is_settled(&self, now: Duration, frame: &ReceivedFrame, own: (Pose, Intrinsics)) -> bool {
        // A server may send a frame in blocks again exactly, or not.
        let since = frame.times.at(Stage::Decoded).map(Duration::from_micros);
        let is_last = frame.is_exact || since.is_some_and(|since| now >= since + FINER_PATIENCE);
        let is_of_look = || {
            let talk = self.source.talk();
            !talk.look.is_draft() && talk.look.is_chosen(frame.frame.header.look)
        };
        let is_final = frame.frame.header.fineness != Fineness::Draft;
        is_own(frame, own) && is_last && is_final && is_of_look()
    }

    fn age(&self, now: Duration, frame: &ReceivedFrame, own: (Pose, Intrinsics)) -> Option<Duration> {
        let Camera { pose: of_frame, intrinsics, .. } = &frame.frame.header.camera;
        // With parallel rays the pose does not tell the visible height.
        let is_parallel = intrinsics.projection.is_orthographic();
        let is_zoomed = is_parallel && intrinsics.projection != own.1.projection && !is_own(frame, own);
        if *of_frame == own.0 && !is_zoomed {
            return Some(Duration::ZERO);
        }
        let left = self.left.iter().rev().find(|(p, _)| p == of_frame && !is_parallel).map(|(_, at)| *at);
        // A forgotten pose is older than all remembered ones.
        let since = left.or_else(|| Some(Duration::from_micros(frame.times.at(Stage::Asked)?)))?;
        now.checked_sub(since)
    }
}

/// The angle between a camera and a frame's, about the middle of the box, degrees.
fn turned_degrees(frame: &ReceivedFrame, camera: &Camera, bounds: &Aabb) -> f32 {
    let (of_frame, shown) = (eye_of(&frame.frame.header.camera, bounds), eye_of(camera, bounds));
    angle_between_degrees(&of_frame, &shown, bounds.center())
}

/// The camera that sees the box `to` as `camera` sees the box `from`, where both are the same but for their size.
fn scaled(camera: &Camera, from: &Aabb, to: &Aabb) -> Camera {
    let growth = to.radius() / from.radius();
    let Camera { pose, mut intrinsics, .. } = *camera;
    if let Projection::Orthographic { height } = &mut intrinsics.projection {
        *height *= growth;
    }
    let eye = to.center() + (pose.eye - from.center()) * growth;
    Camera::new(Pose { eye, ..pose }, intrinsics, to)
}

/// Whether two cameras see different things. The size of a window may change without that.
fn has_moved(a: &Camera, b: &Camera) -> bool {
    let [of_a, of_b] = [a, b].map(|c| c.intrinsics.projection);
    a.pose != b.pose || (of_a != of_b && (of_a.is_orthographic() || of_b.is_orthographic()))
}

/// Whether a frame holds the lists of `full` from `pose`, with or without a margin. A smaller frame of a moving
/// camera settles nothing: the full one must still be requested.
fn is_own(frame: &ReceivedFrame, (pose, full): (Pose, Intrinsics)) -> bool {
    let camera = &frame.frame.header.camera;
    camera.pose == pose && camera.intrinsics.margin_around(&full).is_some()
}

/// A camera rests when it has not moved for this time: longer than a refresh at 10 Hz, and too short to notice.
const REST: Duration = Duration::from_millis(150);
/// How long the small frame of an edit is awaited: longer than any round trip and a slow server's small frame.
const DRAFT_PATIENCE: Duration = Duration::from_secs(3);
/// How long the first frame is requested in a small size: a few refreshes.
const BEGINNING: Duration = Duration::from_millis(80);
/// Assumed cost of a list before the server reports it: that of two cores without a GPU.
const UNKNOWN_MICROS_PER_LIST: f32 = 3.0;
/// Sizes of frames while the camera moves: few, so that they rarely change.
const MOVING_SCALES: [f32; 5] = [1.0, 0.75, 0.5, 0.35, LEAST_MOVING_SCALE];
const LEAST_MOVING_SCALE: f32 = 0.25;
/// How long to wait for an exact frame after the same in blocks. On a narrow link it may take longer; then a margin
/// is merely requested too early.
const FINER_PATIENCE: Duration = Duration::from_millis(1500);
/// Number of remembered poses: four seconds' worth at 60 Hz, longer than any round trip.
const MAX_LEFT: usize = 256;

#[cfg(test)]
pub(crate) mod tests;
