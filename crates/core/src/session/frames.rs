//! Which frames the server makes for one viewer: the next pose, the coding, and what is given up or sent again.
//!
//! A frame names its pose and its look version (see [`crate::layer::FrameHeader`]). No pose is answered twice with
//! the same look. At rest the server sends the same frame again, with a finer coding.

use super::look::LookServer;
use super::rate::{CodingControl, CodingMode, CodingPlan, LinkState};
use crate::camera::{Camera, Intrinsics};
use crate::codec::Coding;
use crate::ids::{FrameId, LookVersion, PoseId};
use crate::layer::{Fineness, FrameHeader, max_lists};
use crate::mode::Compositing;
use crate::space::Aabb;
use crate::wire::PoseRequest;

/// The purpose of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Asked {
    /// The pose.
    pub request: PoseRequest,
    /// The header of the frame.
    pub header: FrameHeader,
    /// When work on the pose began, µs.
    pub at_micros: u64,
    /// Whether the same pose was already answered with another look or shade.
    pub is_again: bool,
}

/// How a frame is sent.
#[derive(Clone, Debug, PartialEq)]
pub struct Sending {
    /// The frame's purpose.
    pub asked: Asked,
    /// Its coding.
    pub coding: Coding,
    /// Whether a coarser version of the same frame went before.
    pub is_finer: bool,
    /// Whether the viewer already has the exact picture with another margin.
    pub is_margin: bool,
    /// Whether it is sent without its less visible segments ([`thinned`](crate::layer::LayeredFrame::thinned)).
    pub is_thinned: bool,
}

impl Sending {
    /// Whether it belongs to a moving camera, so that the next frames are similar.
    pub fn is_usual(&self) -> bool {
        !self.is_finer && !self.is_margin
    }
}

/// Decides which frames one viewer gets.
///
/// Call `begin` for a pose that is not `is_answered`. Then call `handle_generated` and `choose_coding`,
/// `handle_encoded` when it is coded, and `handle_sent` when the network has it. After that, `poll_finer` says
/// whether it goes out again. Call `handle_pose` for each new pose. Times are µs.
#[derive(Debug)]
pub struct FramesServer {
    coding: CodingControl,
    mode: CodingMode,
    newest: FrameId,
    /// The start of the newest frame.
    begun_at: Option<u64>,
    /// Whether no newer pose has arrived since.
    rests: bool,
    /// Whether no other look has come since.
    keeps_look: bool,
    /// What the newest frame was made for.
    answered: Option<(PoseId, LookVersion)>,
    /// The newest frame that the network has, unless it is being sent again.
    sent: Option<Sending>,
    /// Number of frames given up since the last one that was generated.
    num_given_up: u8,
    /// Whether the renderer was lost during the previous frame.
    has_failed: bool,
    /// Most lists of the next frame, beside the limits of all frames.
    max_lists: usize,
    /// Whether that is only for a moving camera.
    is_bound_in_motion: bool,
    /// Whether the newest frame is smaller than it will be at rest.
    is_small: bool,
}

impl FramesServer {
    /// Starts without any frame.
    pub fn new(plan: CodingPlan) -> Self {
        Self {
            coding: CodingControl::new(plan),
            mode: plan.mode,
            newest: FrameId(0),
            begun_at: None,
            rests: false,
            keeps_look: false,
            answered: None,
            sent: None,
            num_given_up: 0,
            has_failed: false,
            max_lists: usize::MAX,
            is_bound_in_motion: false,
            is_small: false,
        }
    }

    /// The newest frame.
    pub fn newest(&self) -> FrameId {
        self.newest
    }

    /// Whether a frame for this pose and look has begun.
    pub fn is_answered(&self, pose: PoseId, version: LookVersion) -> bool {
        self.answered == Some((pose, version))
    }

    /// Bounds the next frame. If that is only for a moving camera, a larger frame follows at rest.
    pub fn bound(&mut self, max_lists: usize, only_in_motion: bool) {
        (self.max_lists, self.is_bound_in_motion) = (max_lists, only_in_motion);
    }

    /// The size of the next frame for this request.
    pub fn size_of(&self, request: &PoseRequest, k: u8) -> Intrinsics {
        within(bounded(request.intrinsics, k), self.max_lists)
    }

    /// When the newest pose needs a larger frame, µs; `None` if its frame has its whole size.
    pub fn larger_due(&self) -> Option<u64> {
        self.begun_at.filter(|_| self.is_small).map(|at| at + REST_MICROS)
    }

    /// Begins the frame for a pose, of a volume with this box.
    pub fn begin(
        &mut self,
        now_micros: u64,
        request: &PoseRequest,
        look: &LookServer,
        bounds: &Aabb,
    ) -> Asked {
        self.newest = self.newest.next();
        // The turn that was reported for the camera's movement has been used.
        let is_again = self.answered.is_some_and(|(pose, _)| pose == request.id);
        self.answered = Some((request.id, look.version()));
        (self.rests, self.keeps_look) = (true, true);
        self.is_small = self.is_bound_in_motion;
        // This is the time between frames of a moving camera.
        let since = self.begun_at.replace(now_micros).map(|at| now_micros.saturating_sub(at));
        if let Some(interval) = since.filter(|interval| *interval < LONG_REST_MICROS) {
            self.coding.handle_interval(interval);
        }
        let k = look.look().k;
        let header = FrameHeader {
            frame: self.newest,
            pose: request.id,
            look: look.version(),
            camera: Camera::new(request.pose, self.size_of(request, k), bounds),
            k,
            mode: Default::default(),
            fineness: Default::default(),
        };
        Asked { request: *request, header, at_micros: now_micros, is_again }
    }

    /// A newer pose has arrived. Returns whether the `generated` frame is given up for it.
    ///
    /// A frame for a resting camera is larger and blocks the frames of a moving one. While anything changes, even only
    /// the look, the viewer requests smaller frames, and a much larger one ends for them at once.
    pub fn handle_pose(&mut self, now_micros: u64, newest: &PoseRequest, generated: Option<&Asked>) -> bool {
        let has_rested = std::mem::take(&mut self.rests);
        generated.is_some_and(|asked| {
            let is_smaller = newest.intrinsics.num_pixels() < asked.request.intrinsics.num_pixels();
            let is_outdated = newest.pose != asked.request.pose || is_smaller;
            let is_long = is_outdated && has_rested && self.is_long(now_micros, asked);
            let is_after_one = self.num_given_up < MOST_GIVEN_UP && is_much_larger(asked, newest);
            is_after_one || (is_long && self.num_given_up == 0)
        })
    }

    /// The viewer has another look. Returns whether the `generated` frame is given up for it. An edit that begins
    /// comes with a smaller request, see [`Self::handle_pose`]. While edits follow each other, frames are finished.
    pub fn handle_look(&mut self, now_micros: u64, generated: Option<&Asked>) -> bool {
        let is_first = std::mem::take(&mut self.keeps_look) && self.num_given_up == 0;
        generated.is_some_and(|asked| is_first && self.is_long(now_micros, asked))
    }

    /// Whether a frame at the coder or before it is given up: it is much larger than what the viewer requests now, and
    /// of another look. A smaller frame of the new look takes its place, and never ends in this way itself.
    pub fn is_overtaken(asked: &Asked, newest: &PoseRequest, version: LookVersion) -> bool {
        asked.header.look != version && is_much_larger(asked, newest)
    }

    fn is_long(&self, now_micros: u64, asked: &Asked) -> bool {
        now_micros >= asked.at_micros + LONG_REST_MICROS
    }

    /// Notes the time to generate a frame, µs.
    pub fn handle_generated(&mut self, micros: u64) {
        (self.num_given_up, self.has_failed) = (0, false);
        self.coding.handle_generated(micros);
    }

    /// A frame was given up during generation. The newest pose still needs an answer.
    pub fn handle_given_up(&mut self) {
        self.num_given_up = self.num_given_up.saturating_add(1);
        self.answered = None;
    }

    /// A frame could not be generated; `is_lost` if another renderer replaces a lost one. Then the pose is tried once
    /// more.
    pub fn handle_failed(&mut self, is_lost: bool) {
        if is_lost && !std::mem::replace(&mut self.has_failed, true) {
            self.answered = None;
        }
    }

    /// The newest pose needs another answer.
    pub fn handle_unanswered(&mut self) {
        self.answered = None;
    }

    /// Another volume is shown, so no earlier frame is useful.
    pub fn handle_volume(&mut self) {
        (self.answered, self.sent) = (None, None);
    }

    /// Chooses the coding of a frame in this mode for the current link; `has_reference` if it can be predicted from
    /// another.
    pub fn choose_coding(
        &mut self,
        link: LinkState,
        asked: Asked,
        mode: crate::mode::Mode,
        has_reference: bool,
    ) -> Sending {
        self.coding.handle_link(link);
        self.coding.handle_turned(asked.request.shown_turn_deg.filter(|_| !asked.is_again));
        let is_margin = self.shows_exactly(&asked.header);
        let num_lists = asked.header.camera.intrinsics.num_pixels();
        let coding = match is_margin {
            true => Coding::Exact,
            false => self.coding.next(num_lists, has_reference),
        };
        // The greatest values alone are the exact picture of their own pose.
        let can_be_thinned = !is_margin && mode.compositing() == Compositing::Greatest;
        let is_thinned = can_be_thinned && self.coding.takes_long(num_lists);
        Sending { asked, coding: coding.for_mode(mode), is_finer: false, is_margin, is_thinned }
    }

    /// A frame is coded.
    pub fn handle_encoded(&mut self, sending: &Sending, is_predicted: bool, bytes: usize, micros: u64) {
        // What a frame predicted from itself takes says nothing about others.
        if !sending.is_thinned && (!sending.is_finer || sending.coding == Coding::Exact) {
            let num_lists = sending.asked.header.camera.intrinsics.num_pixels();
            self.coding.handle_encoded(&sending.coding, is_predicted, num_lists, bytes, micros);
        }
    }

    /// The network has a frame.
    pub fn handle_sent(&mut self, sending: Sending) {
        self.sent = Some(sending);
    }

    /// When to call `poll_finer` if no frame is in progress, µs.
    pub fn finer_due(&self, look: &LookServer) -> Option<u64> {
        let sent = self.sent.as_ref().filter(|_| !self.is_small)?;
        self.finer(sent, look).map(|_| sent.asked.at_micros + REST_MICROS)
    }

    /// Returns the frame to send again for a resting camera, with a new number and a finer coding.
    pub fn poll_finer(&mut self, now_micros: u64, look: &LookServer) -> Option<Sending> {
        self.finer_due(look).filter(|due| *due <= now_micros)?;
        let sent = self.sent.take()?;
        let coding = self.finer(&sent, look)?;
        self.newest = self.newest.next();
        let header = FrameHeader { frame: self.newest, ..sent.asked.header };
        let asked = Asked { header, ..sent.asked };
        Some(Sending { asked, coding, is_finer: true, is_thinned: false, ..sent })
    }

    /// Whether a finer frame or a margin is no longer worth its time, given this pose and look.
    pub fn is_outdated(sending: &Sending, newest: &PoseRequest, version: LookVersion) -> bool {
        let Asked { request, header, .. } = &sending.asked;
        let is_same = request.pose == newest.pose && is_same_picture(&request.intrinsics, &newest.intrinsics);
        let is_wanted = is_same && header.look == version;
        !sending.is_usual() && !is_wanted
    }

    /// The finer coding of a frame that was sent, if the camera rests.
    fn finer(&self, sent: &Sending, look: &LookServer) -> Option<Coding> {
        let header = &sent.asked.header;
        // A draft is about to be replaced.
        let is_newest = !look.is_draft()
            && header.fineness != Fineness::Draft
            && self.is_answered(header.pose, look.version())
            && header.look == look.version();
        let num_lists = header.camera.intrinsics.num_pixels();
        match is_newest && sent.is_thinned {
            true => Some(sent.coding),
            false => is_newest.then(|| self.coding.finer(num_lists, &sent.coding)).flatten(),
        }
    }

    /// Whether the viewer has, or will have, the exact picture of this frame, differing only in its margin.
    fn shows_exactly(&self, header: &FrameHeader) -> bool {
        let is_exact = self.sent.as_ref().is_some_and(|sent| {
            let of_sent = &sent.asked.header;
            matches!(sent.coding, Coding::Exact)
                && of_sent.fineness != Fineness::Draft
                && of_sent.camera.pose == header.camera.pose
                && is_same_picture(&of_sent.camera.intrinsics, &header.camera.intrinsics)
                && of_sent.look == header.look
        });
        self.mode == CodingMode::Auto && is_exact
    }
}

/// The size of the frame for a request: the same shape, at most [`max_lists`] pixels.
pub fn bounded(request: Intrinsics, k: u8) -> Intrinsics {
    within(request, max_lists(k))
}

/// The same shape with at most `max_lists` pixels, and at least one.
pub fn within(request: Intrinsics, max_lists: usize) -> Intrinsics {
    let excess = request.num_pixels() as f32 / max_lists.max(1) as f32;
    if excess <= 1.0 {
        return request;
    }
    let shrink = |side: u32| ((side as f32 / excess.sqrt()) as u32).max(1);
    Intrinsics { width: shrink(request.width), height: shrink(request.height), ..request }
}

/// Whether frames of two sizes differ only in their margins.
fn is_same_picture(a: &Intrinsics, b: &Intrinsics) -> bool {
    a.margin_around(b).is_some() || b.margin_around(a).is_some()
}

/// Whether a frame has so many more lists than the newest request that it should not keep it waiting.
fn is_much_larger(asked: &Asked, newest: &PoseRequest) -> bool {
    newest.intrinsics.num_pixels() * 5 <= asked.request.intrinsics.num_pixels() * 2
}

/// Most frames given up in a row: a second one only for a much smaller request, and the next is generated. Otherwise a
/// viewer with a low refresh rate would get none.
const MOST_GIVEN_UP: u8 = 2;
/// The camera rests when no newer pose arrives for this time: three refreshes at 30 Hz.
const REST_MICROS: u64 = 100_000;
/// After this time a camera rests even at four refreshes a second. Its frame is given up when it moves.
const LONG_REST_MICROS: u64 = 250_000;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::camera::Pose;
    use crate::mode::Mode;
    use crate::session::pair::look;

    const BOUNDS: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
    const LINK: LinkState = LinkState { bytes_per_second: 1e12, is_measured: true, least_rtt_micros: 1000 };

    fn request(id: u32, azimuth: f32) -> PoseRequest {
        let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.0, 3.0);
        PoseRequest { id: PoseId(id), ..PoseRequest::of_view(pose, Intrinsics::perspective(64, 64, 0.5)) }
    }

    fn of_server() -> (FramesServer, LookServer) {
        (FramesServer::new(CodingPlan::default()), LookServer::new(LookVersion(1), look("first")))
    }

    /// Makes and sends the frame for a pose.
    fn send(frames: &mut FramesServer, looks: &LookServer, now: u64, request: &PoseRequest) -> Sending {
        let asked = frames.begin(now, request, looks, &BOUNDS);
        frames.handle_generated(1000);
        let sending = frames.choose_coding(LINK, asked, Default::default(), false);
        frames.handle_encoded(&sending, false, 1000, 1000);
        frames.handle_sent(sending.clone());
        sending
    }

    #[test]
    fn sizes_are_bounded_and_keep_their_shape() {
        for k in [1, 8, 15, 32] {
            let size = |width, height| bounded(Intrinsics::perspective(width, height, 1.0), k);
            assert_eq!(size(1920, 1200), Intrinsics::perspective(1920, 1200, 1.0));
            let (big, most) = (size(8192, 4096), max_lists(k));
            assert!(big.num_pixels() <= most && big.num_pixels() > most * 9 / 10);
            assert!((big.width as f32 / big.height as f32 - 2.0).abs() < 0.01);
            assert!(size(8192, 1).num_pixels() >= 1);
        }
    }

    #[test]
    fn a_small_frame_of_a_moving_camera_gives_way_to_its_whole_size_at_rest() {
        let (mut frames, looks) = of_server();
        frames.bound(1000, true);
        let small = send(&mut frames, &looks, 0, &request(1, 0.0));
        assert!((800..=1000).contains(&small.asked.header.camera.intrinsics.num_pixels()));
        assert_eq!((frames.finer_due(&looks), frames.larger_due()), (None, Some(REST_MICROS)));
        frames.handle_unanswered();
        frames.bound(usize::MAX, false);
        let whole = send(&mut frames, &looks, REST_MICROS, &request(1, 0.0));
        assert_eq!(whole.asked.header.camera.intrinsics, request(1, 0.0).intrinsics);
        assert_eq!((frames.finer_due(&looks), frames.larger_due()), (Some(2 * REST_MICROS), None));
        assert!(within(request(1, 0.0).intrinsics, 0).num_pixels() >= 1);
    }

    #[test]
    fn a_pose_is_answered_once_with_each_look() {
        let (mut frames, mut looks) = of_server();
        assert!(!frames.is_answered(PoseId(1), looks.version()));
        assert!(!frames.begin(0, &request(1, 0.0), &looks, &BOUNDS).is_again);
        assert!(frames.is_answered(PoseId(1), looks.version()));
        looks.begin(0, look("second"), true);
        assert!(!frames.is_answered(PoseId(1), looks.version()));
        let again = frames.begin(0, &request(1, 0.0), &looks, &BOUNDS);
        assert_eq!(
            (again.is_again, again.header.frame, again.header.look),
            (true, FrameId(2), LookVersion(2))
        );
        // A lost renderer is forgiven once.
        for is_answered in [false, true] {
            frames.handle_failed(true);
            assert_eq!(frames.is_answered(PoseId(1), looks.version()), is_answered);
            frames.begin(0, &request(1, 0.0), &looks, &BOUNDS);
        }
    }

    #[test]
    fn the_frame_of_a_rest_is_given_up_when_the_camera_moves_but_never_two_in_a_row() {
        let (mut frames, looks) = of_server();
        let asked = frames.begin(0, &request(1, 0.0), &looks, &BOUNDS);
        assert!(!frames.handle_pose(249_999, &request(2, 0.1), Some(&asked)), "it has not rested");
        let asked = frames.begin(300_000, &request(2, 0.1), &looks, &BOUNDS);
        assert!(!frames.handle_pose(600_000, &request(3, 0.1), Some(&asked)), "the same pose");
        let asked = frames.begin(700_000, &request(3, 0.1), &looks, &BOUNDS);
        assert!(frames.handle_pose(950_000, &request(4, 0.2), Some(&asked)));
        frames.handle_given_up();
        assert!(!frames.is_answered(PoseId(3), looks.version()));
        let asked = frames.begin(1_000_000, &request(4, 0.2), &looks, &BOUNDS);
        assert!(!frames.handle_pose(2_000_000, &request(5, 0.3), Some(&asked)), "the one before was");
        frames.handle_generated(1000);
        let asked = frames.begin(2_000_000, &request(5, 0.3), &looks, &BOUNDS);
        assert!(frames.handle_pose(2_250_000, &request(6, 0.4), Some(&asked)));
    }

    #[test]
    fn an_edit_ends_the_frame_in_work_and_its_smaller_frame_is_made() {
        let of_size = |id: u32, side: u32| PoseRequest {
            intrinsics: Intrinsics::perspective(side, side, 0.5),
            ..request(id, 0.0)
        };
        let (mut frames, mut looks) = of_server();
        // The look comes before the smaller request: the whole frame of the new look ends at once.
        let asked = frames.begin(0, &of_size(1, 64), &looks, &BOUNDS);
        assert!(!frames.handle_look(249_999, Some(&asked)), "it is about to be there");
        assert!(!frames.handle_look(280_000, Some(&asked)), "edits follow each other");
        let asked = frames.begin(0, &of_size(1, 64), &looks, &BOUNDS);
        assert!(frames.handle_look(250_000, Some(&asked)));
        frames.handle_given_up();
        looks.begin(250_000, look("second"), true);
        let asked = frames.begin(250_000, &of_size(1, 64), &looks, &BOUNDS);
        assert!(!frames.handle_pose(251_000, &of_size(2, 63), Some(&asked)), "hardly smaller");
        assert!(frames.handle_pose(252_000, &of_size(3, 32), Some(&asked)));
        frames.handle_given_up();
        // Whatever comes now, the smaller one is made.
        let asked = frames.begin(253_000, &of_size(3, 32), &looks, &BOUNDS);
        assert!(!frames.handle_look(900_000, Some(&asked)));
        for side in [64, 32, 16, 1] {
            assert!(!frames.handle_pose(900_000, &of_size(4, side), Some(&asked)), "{side}");
        }
        frames.handle_generated(1000);
        // A frame at the coder gives way to a much smaller one of another look, and to no other.
        let (old, new) = (looks.version(), LookVersion(looks.version().0 + 1));
        assert!(FramesServer::is_overtaken(&asked, &of_size(5, 16), new));
        assert!(!FramesServer::is_overtaken(&asked, &of_size(5, 16), old));
        assert!(!FramesServer::is_overtaken(&asked, &of_size(5, 32), new));
    }

    #[test]
    fn at_rest_the_frame_goes_out_again_exactly_and_once() {
        let (mut frames, looks) = of_server();
        let first = send(&mut frames, &looks, 0, &request(1, 0.0));
        assert!(matches!(first.coding, Coding::Blocks(_)), "nothing is known of the link yet");
        assert_eq!(frames.finer_due(&looks), Some(REST_MICROS));
        assert_eq!(frames.poll_finer(REST_MICROS - 1, &looks), None);
        let finer = frames.poll_finer(REST_MICROS, &looks).unwrap();
        assert!(finer.is_finer && matches!(finer.coding, Coding::Exact));
        assert_eq!((finer.asked.header.frame, frames.newest()), (FrameId(2), FrameId(2)));
        assert_eq!(frames.finer_due(&looks), None, "it is on its way");
        frames.handle_sent(finer.clone());
        assert_eq!(frames.finer_due(&looks), None, "it cannot be better");
        // A margin around the exact picture is exact, too, and goes when the camera moves.
        let wide = PoseRequest { intrinsics: request(2, 0.0).intrinsics.with_margin(16), ..request(2, 0.0) };
        let margin = send(&mut frames, &looks, 200_000, &wide);
        assert!(margin.is_margin && matches!(margin.coding, Coding::Exact));
        assert!(!FramesServer::is_outdated(&margin, &request(3, 0.0), looks.version()));
        assert!(FramesServer::is_outdated(&margin, &request(3, 0.1), looks.version()));
        assert!(FramesServer::is_outdated(&margin, &request(3, 0.0), LookVersion(2)));
        assert!(!FramesServer::is_outdated(&first, &request(3, 0.1), looks.version()), "a usual one is sent");
        // On a slow link a projection goes without its less visible segments first.
        for (link, is_thinned) in [(LINK, false), (LinkState { bytes_per_second: 1e4, ..LINK }, true)] {
            let (mut frames, looks) = of_server();
            let asked = frames.begin(0, &request(1, 0.0), &looks, &BOUNDS);
            frames.choose_coding(link, asked, Mode::Mip, false);
            let first = frames.choose_coding(link, asked, Mode::Mip, false);
            assert_eq!((first.coding, first.is_thinned), (Coding::Exact, is_thinned));
            assert!(!frames.choose_coding(link, asked, Mode::Average, false).is_thinned);
            frames.handle_sent(first);
            let finer = frames.poll_finer(REST_MICROS, &looks);
            assert_eq!(finer.map(|f| (f.is_finer, f.is_thinned)), is_thinned.then_some((true, false)));
        }
        // Neither a draft nor an older look is made finer.
        let (mut frames, mut looks) = of_server();
        let mut sending = send(&mut frames, &looks, 300_000, &request(4, 0.5));
        assert!(frames.finer_due(&looks).is_some());
        sending.asked.header.fineness = Fineness::Draft;
        frames.handle_sent(Sending { coding: Coding::Exact, ..sending.clone() });
        assert!(!frames.shows_exactly(&sending.asked.header), "finer pages come");
        frames.handle_sent(sending.clone());
        assert_eq!(frames.finer_due(&looks), None);
        sending.asked.header.fineness = Fineness::Bounded;
        frames.handle_sent(sending);
        assert!(frames.finer_due(&looks).is_some());
        looks.begin(300_000, look("other"), false);
        assert_eq!(frames.finer_due(&looks), None);
    }
}
