//! The viewer's door to the frames: what it asks of whoever brings them. The network client is one; tests have others.

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::{FrameId, LookVersion, ShotId};
use isinglass_core::look::Look;
use isinglass_core::wire::{ClientStats, LoadStatus, Part, Parts, Probed, Welcome};
use isinglass_net::{Client, LinkStats, ReceivedFrame, ReceivedShot, State};

/// Brings layered frames. No call waits for anything: the viewer polls it at every refresh.
pub trait FrameSource {
    /// Asks for a frame from `pose`; the newest wish wins.
    fn set_pose(&mut self, pose: Pose, intrinsics: Intrinsics);

    /// The newest frame that can be shown. The same `Arc` as long as nothing has changed.
    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>>;

    /// Where the connection stands.
    fn state(&self) -> State;

    /// Number of the newest connection: over another, the server begins with its own look.
    fn connection(&self) -> u32 {
        1
    }

    /// What the connection costs.
    fn stats(&self) -> LinkStats;

    /// What the server said of the volume, once it did.
    fn description(&self) -> Option<Arc<Welcome>>;

    /// The look that the server renders with now, once known.
    fn look(&self) -> Option<(LookVersion, Arc<Look>)>;

    /// Asks for another look. One that cannot be used is ignored.
    fn set_look(&mut self, look: Look);

    /// A line that the server wants shown; taken when it is asked for.
    fn take_notice(&mut self) -> Option<String>;

    /// A frame was on the screen, for the ledger.
    fn note_shown(&mut self, frame: FrameId);

    /// What the next wish says of [`isinglass_core::wire::PoseRequest::shown_turn_deg`], degrees.
    fn note_turn(&mut self, _degrees: Option<f32>) {}

    /// How the viewer fares, for the server.
    fn report(&mut self, stats: ClientStats);

    /// Whether a frame is of the volume that is described, and not of the one before.
    fn is_of_volume(&self, _frame: &ReceivedFrame) -> bool {
        true
    }

    /// What the server's file holds beside what is shown, if there is anything to choose.
    fn parts(&self) -> Option<Arc<Parts>> {
        None
    }

    /// How the reading of another part stands, as last heard.
    fn load(&self) -> Option<LoadStatus> {
        None
    }

    /// Asks for another part, for all viewers of the server; none: the one that is being read is not wanted any more.
    fn open_part(&mut self, _part: Option<Part>) {}

    /// Whether frames of the look that the server renders with show a draft of it.
    fn is_draft(&self) -> bool {
        false
    }

    /// Asks for the value at a point of world space; the newest question wins.
    fn probe(&mut self, _point: Vec3) {}

    /// The newest answer.
    fn probed(&self) -> Option<Probed> {
        None
    }

    /// Asks for a picture to keep, rendered in full; it takes the place of one that has not come.
    fn shoot(&mut self, _pose: Pose, _intrinsics: Intrinsics, _background: [u8; 3]) -> ShotId {
        ShotId(0)
    }

    /// That picture is no longer wanted.
    fn cancel_shot(&mut self) {}

    /// What has become of it; taken when it is asked for.
    fn take_shot(&mut self) -> Option<Arc<ReceivedShot>> {
        None
    }
}

impl<S: FrameSource + ?Sized> FrameSource for Box<S> {
    fn set_pose(&mut self, pose: Pose, intrinsics: Intrinsics) {
        (**self).set_pose(pose, intrinsics);
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        (**self).latest_frame()
    }

    fn state(&self) -> State {
        (**self).state()
    }

    fn connection(&self) -> u32 {
        (**self).connection()
    }

    fn stats(&self) -> LinkStats {
        (**self).stats()
    }

    fn description(&self) -> Option<Arc<Welcome>> {
        (**self).description()
    }

    fn look(&self) -> Option<(LookVersion, Arc<Look>)> {
        (**self).look()
    }

    fn set_look(&mut self, look: Look) {
        (**self).set_look(look);
    }

    fn take_notice(&mut self) -> Option<String> {
        (**self).take_notice()
    }

    fn note_shown(&mut self, frame: FrameId) {
        (**self).note_shown(frame);
    }

    fn note_turn(&mut self, degrees: Option<f32>) {
        (**self).note_turn(degrees);
    }

    fn report(&mut self, stats: ClientStats) {
        (**self).report(stats);
    }

    fn is_of_volume(&self, frame: &ReceivedFrame) -> bool {
        (**self).is_of_volume(frame)
    }

    fn parts(&self) -> Option<Arc<Parts>> {
        (**self).parts()
    }

    fn load(&self) -> Option<LoadStatus> {
        (**self).load()
    }

    fn open_part(&mut self, part: Option<Part>) {
        (**self).open_part(part);
    }

    fn is_draft(&self) -> bool {
        (**self).is_draft()
    }

    fn probe(&mut self, point: Vec3) {
        (**self).probe(point);
    }

    fn probed(&self) -> Option<Probed> {
        (**self).probed()
    }

    fn shoot(&mut self, pose: Pose, intrinsics: Intrinsics, background: [u8; 3]) -> ShotId {
        (**self).shoot(pose, intrinsics, background)
    }

    fn cancel_shot(&mut self) {
        (**self).cancel_shot();
    }

    fn take_shot(&mut self) -> Option<Arc<ReceivedShot>> {
        (**self).take_shot()
    }
}

impl FrameSource for Client {
    fn set_pose(&mut self, pose: Pose, intrinsics: Intrinsics) {
        Client::set_pose(self, pose, intrinsics);
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        Client::latest_frame(self)
    }

    fn state(&self) -> State {
        Client::state(self)
    }

    fn connection(&self) -> u32 {
        Client::connection(self)
    }

    fn stats(&self) -> LinkStats {
        Client::stats(self)
    }

    fn description(&self) -> Option<Arc<Welcome>> {
        Client::description(self)
    }

    fn look(&self) -> Option<(LookVersion, Arc<Look>)> {
        Client::look(self)
    }

    fn set_look(&mut self, look: Look) {
        if let Err(e) = Client::set_look(self, look) {
            tracing::warn!("look not sent: {e}");
        }
    }

    fn take_notice(&mut self) -> Option<String> {
        Client::take_notice(self)
    }

    fn note_shown(&mut self, frame: FrameId) {
        Client::note_shown(self, frame);
    }

    fn note_turn(&mut self, degrees: Option<f32>) {
        Client::note_turn(self, degrees);
    }

    fn report(&mut self, stats: ClientStats) {
        Client::report(self, stats);
    }

    fn is_of_volume(&self, frame: &ReceivedFrame) -> bool {
        Client::is_of_volume(self, frame)
    }

    fn parts(&self) -> Option<Arc<Parts>> {
        Client::parts(self)
    }

    fn load(&self) -> Option<LoadStatus> {
        Client::load(self)
    }

    fn open_part(&mut self, part: Option<Part>) {
        Client::open_part(self, part);
    }

    fn is_draft(&self) -> bool {
        Client::is_draft(self)
    }

    fn probe(&mut self, point: Vec3) {
        Client::probe(self, point.to_array());
    }

    fn probed(&self) -> Option<Probed> {
        Client::probed(self)
    }

    fn shoot(&mut self, pose: Pose, intrinsics: Intrinsics, background: [u8; 3]) -> ShotId {
        Client::shoot(self, pose, intrinsics, background)
    }

    fn cancel_shot(&mut self) {
        Client::cancel_shot(self);
    }

    fn take_shot(&mut self) -> Option<Arc<ReceivedShot>> {
        Client::take_shot(self)
    }
}
