//! Laws of [`super::Viewing`].

use std::cell::RefCell;
use std::sync::Mutex;

use glam::Vec3;
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::session::ClientSession;
use isinglass_core::session::ledger::{Life, Stage};
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::PageProgress;
use isinglass_core::wire::{ClientMessage, ServerMessage, ServerStats, Token, VolumeDescription, Welcome};
use isinglass_net::{ConnectError, LinkStats, Talking};

use super::*;

/// Remembers what it was asked and shows what the test puts into it.
#[derive(Default)]
pub(crate) struct FakeSource {
    pub(crate) asked: Vec<(Pose, Intrinsics)>,
    pub(crate) frame: Option<Arc<ReceivedFrame>>,
    pub(crate) session: Mutex<ClientSession>,
    pub(crate) wanted_looks: RefCell<Vec<Look>>,
    pub(crate) shown: Vec<FrameId>,
    pub(crate) max_side: Option<u32>,
    pub(crate) stats: LinkStats,
    /// Whether frames come in blocks.
    pub(crate) in_blocks: bool,
    pub(crate) fineness: Fineness,
    /// Frames of older looks are of the volume before.
    pub(crate) volume_since: LookVersion,
    /// Why there is no connection.
    pub(crate) refused: Option<ConnectError>,
}

impl FrameSource for FakeSource {
    /// Looks are sent at once.
    fn talk(&self) -> Talking<'_, ClientSession> {
        let mut talk = Talking::alone(&self.session);
        if let Some(due) = talk.look.due().filter(|_| talk.look.is_waiting())
            && let Some(ClientMessage::SetLook(look)) = talk.look.poll_message(due)
        {
            self.wanted_looks.borrow_mut().push(look);
        }
        talk
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        self.frame.clone()
    }

    fn note_shown(&mut self, frame: FrameId) {
        self.shown.push(frame);
    }

    fn state(&self) -> State {
        self.refused.clone().map_or(State::Connected, State::Refused)
    }

    fn stats(&self) -> LinkStats {
        self.stats
    }

    fn set_pose(&mut self, _now: Duration, pose: Pose, intrinsics: Intrinsics) {
        self.asked.push((pose, intrinsics));
    }

    fn description(&self) -> Option<Arc<Welcome>> {
        let volume = VolumeDescription {
            name: "volume".into(),
            dims: [2, 2, 2],
            spacing: [1.0; 3],
            unit: None,
            orientation: None,
            placement: None,
            value_unit: None,
            value_range: (0.0, 1.0),
            histogram_range: (0.0, 1.0),
            histogram: vec![],
            channels: vec![],
        };
        Some(Arc::new(Welcome {
            ticket: Token::new([0; 16]),
            volume,
            look_version: LookVersion(0),
            look: look("first"),
            max_side: self.max_side?,
            max_poses_per_second: 100,
        }))
    }

    fn is_of_volume(&self, frame: &ReceivedFrame) -> bool {
        frame.frame.header.look >= self.volume_since
    }
}

impl FakeSource {
    /// The server has another look in force.
    fn put_look(&self, version: u32, look: Look) {
        self.talk().look.handle_changed(0, LookVersion(version), look, false);
    }

    fn turned(&self) -> Option<u8> {
        self.talk().pose.shown_turn_deg()
    }

    /// Answers the wish number `pose`, from 1, that was made at `pose_set`.
    fn answer(&mut self, pose: u32, pose_set: Duration) {
        let (at, intrinsics) = self.asked[pose as usize - 1];
        let header = FrameHeader {
            frame: FrameId(pose),
            pose: PoseId(pose),
            look: self.talk().look.in_force().map_or(LookVersion(0), |l| l.0),
            camera: Camera::new(at, intrinsics, &BOUNDS),
            k: 4,
            mode: Default::default(),
            fineness: self.fineness,
        };
        let micros = pose_set.as_micros() as u64;
        let times = Life::default().with(Stage::Asked, micros).with(Stage::Decoded, micros);
        let frame = LayeredFrame::empty(header);
        self.frame = Some(Arc::new(ReceivedFrame { frame, is_exact: !self.in_blocks, times }));
    }
}

pub(crate) const BOUNDS: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
const PICTURE: Intrinsics = Intrinsics::perspective(60, 40, 0.7);

fn ms(x: u64) -> Duration {
    Duration::from_millis(x)
}

fn at(azimuth_degrees: f32) -> Pose {
    Pose::orbit(Vec3::ZERO, azimuth_degrees.to_radians(), 0.2, 6.0)
}

fn look(name: &str) -> Look {
    let points = vec![ControlPoint { x: 0.0, color: [1.0; 3], opacity: 0.5 }];
    let (domain, unit_length) = (Domain::Full, UnitLength::Voxel);
    let transfer = TransferFunction { name: name.into(), domain, unit_length, points };
    Look::new(transfer)
}

fn viewing() -> Viewing<FakeSource> {
    Viewing::new(FakeSource::default(), FrameSize::default(), Foresight::default())
}

#[test]
fn the_first_frame_asked_for_is_small() {
    let picture = Intrinsics { width: 1200, height: 800, ..PICTURE };
    let frame_size = FrameSize { moving_budget: Some(ms(300)), ..FrameSize::default() };
    let asked = |frame_size, picture, times: &[u64]| {
        let mut v = Viewing::new(FakeSource::default(), frame_size, Foresight::default());
        for &time in times {
            v.refresh(ms(time), at(0.0), picture, &BOUNDS);
        }
        v.source().asked.iter().map(|(_, i)| i.width).collect::<Vec<_>>()
    };
    assert_eq!(asked(frame_size, picture, &[0, 30, 60, 90, 120]), [300, 1200]);
    // One that is small anyway is asked for at once, and so is every frame if nothing is said of time.
    assert_eq!(asked(frame_size, PICTURE, &[0, 30, 90]), [60]);
    assert_eq!(asked(FrameSize::default(), picture, &[0, 30, 90]), [1200]);
    // A first frame that is there soon is followed by a whole one at once.
    let mut v = Viewing::new(FakeSource::default(), frame_size, Foresight::default());
    v.refresh(ms(0), at(0.0), picture, &BOUNDS);
    v.source_mut().answer(1, ms(0));
    v.refresh(ms(10), at(0.0), picture, &BOUNDS);
    let refresh = v.refresh(ms(20), at(0.0), picture, &BOUNDS);
    assert_eq!(v.source().asked.last().map(|(_, i)| *i), Some(picture));
    assert_eq!(refresh.standing, Standing::Refining);
    // Without a connection it will not come.
    v.source_mut().refused = Some(ConnectError::Lost("gone".into()));
    assert_eq!(v.refresh(ms(30), at(0.0), picture, &BOUNDS).standing, Standing::Offline);
    let moving = v.refresh(ms(40), at(5.0), picture, &BOUNDS);
    assert_eq!(moving.standing, Standing::Moving);
    v.source_mut().refused = None;
    assert_eq!(v.refresh(ms(400), at(5.0), picture, &BOUNDS).standing, Standing::Refining);
    // The server's own picture is there still, but nobody stands behind it.
    let number = v.source().asked.len() as u32;
    v.source_mut().answer(number, ms(400));
    assert_eq!(v.refresh(ms(410), at(5.0), picture, &BOUNDS).standing, Standing::Exact);
    v.source_mut().refused = Some(ConnectError::Lost("gone".into()));
    assert_eq!(v.refresh(ms(420), at(5.0), picture, &BOUNDS).standing, Standing::Offline);
}

#[test]
fn the_picture_has_the_present_camera_whatever_the_frame() {
    let mut v = Viewing::new(FakeSource::default(), FrameSize::default(), Foresight::NONE);
    let mut turned = vec![];
    for i in 0..20u64 {
        let pose = at(i as f32);
        let r = v.refresh(ms(i * 16), pose, PICTURE, &BOUNDS);
        assert_eq!(r.camera, Camera::new(pose, PICTURE, &BOUNDS));
        turned.extend(r.turned_degrees);
        // The answer to a wish comes ten refreshes later.
        if i >= 10 {
            v.source.answer(i as u32 - 9, ms((i - 10) * 16));
        }
    }
    assert_eq!(v.source.asked.len(), 20);
    let r = v.refresh(ms(20 * 16), at(20.0), PICTURE, &BOUNDS);
    assert_eq!((r.frame_age, r.standing), (Some(ms(11 * 16)), Standing::Moving));
    // Azimuths apart at this elevation: the arc is cos(elevation) shorter.
    assert!((r.turned_degrees.unwrap() - 11.0 * 0.2f32.cos()).abs() < 0.1, "{r:?}");
    assert!(turned.len() == 9);
    // How far frames in blocks are turned is told to the server, of exact ones not.
    assert_eq!(v.source.turned(), None);
    v.source.in_blocks = true;
    v.source.answer(12, ms(11 * 16));
    let r = v.refresh(ms(21 * 16), at(21.0), PICTURE, &BOUNDS);
    assert!(r.turned_degrees > Some(8.0) && v.source.turned() == Some(10), "{r:?}");
    // A rest is told before anything is asked for because of it.
    v.refresh(ms(21 * 16 + 200), at(21.0), PICTURE, &BOUNDS);
    assert_eq!(v.source.turned(), None);
}

#[test]
fn at_rest_the_standing_goes_from_moving_over_refining_to_exact() {
    let mut v = viewing();
    assert_eq!(v.refresh(ms(0), at(0.0), PICTURE, &BOUNDS).standing, Standing::Waiting);
    v.source.answer(1, ms(0));
    assert_eq!(v.refresh(ms(10), at(0.0), PICTURE, &BOUNDS).standing, Standing::Exact);
    assert_eq!(v.refresh(ms(20), at(5.0), PICTURE, &BOUNDS).standing, Standing::Moving);
    assert_eq!(v.refresh(ms(160), at(5.0), PICTURE, &BOUNDS).standing, Standing::Moving);
    assert_eq!(v.refresh(ms(171), at(5.0), PICTURE, &BOUNDS).standing, Standing::Refining);
    // The second wish was for where the camera seemed to go; the third is for where it stopped.
    assert!(v.source.asked[1].0 != at(5.0));
    v.source.answer(2, ms(20));
    assert_eq!(v.refresh(ms(175), at(5.0), PICTURE, &BOUNDS).standing, Standing::Refining);
    v.source.in_blocks = true;
    v.source.answer(3, ms(160));
    assert_eq!(v.refresh(ms(180), at(5.0), PICTURE, &BOUNDS).standing, Standing::Refining);
    v.source.in_blocks = false;
    v.source.answer(3, ms(160));
    let r = v.refresh(ms(190), at(5.0), PICTURE, &BOUNDS);
    assert_eq!(r.standing, Standing::Exact);
    assert_eq!(r.frame_age, Some(Duration::ZERO));
    // What "exact" promises: the frame's camera is the picture's.
    assert_eq!(r.frame.unwrap().frame.header.camera, r.camera);
    assert_eq!(v.source.asked.len(), 3, "a resting camera asks for nothing");
}

#[test]
fn a_moving_camera_asks_for_where_it_will_be_and_a_resting_one_for_where_it_is() {
    let play = |foresight: Foresight| {
        let mut v = Viewing::new(FakeSource::default(), FrameSize::default(), foresight);
        let mut turned = vec![];
        let mut last = None;
        for i in 0..60u64 {
            let r = v.refresh(ms(i * 16), at(i.min(40) as f32), PICTURE, &BOUNDS);
            turned.extend(r.turned_degrees);
            last = Some(r);
            // The server makes a frame for every wish, which is there ten refreshes later.
            let wish = v.source.asked.len().min(i.saturating_sub(8) as usize);
            if i >= 9 && v.source.frame.as_ref().is_none_or(|f| f.frame.header.frame.0 < wish as u32) {
                v.source.answer(wish as u32, ms((wish as u64 - 1) * 16));
            }
        }
        (v, turned, last.unwrap())
    };
    let (asks_now, lagging, _) = play(Foresight::NONE);
    let (asks_ahead, foreseeing, last) = play(Foresight { predicts: true, ..Foresight::NONE });
    // In the middle of the steady turn frames are ten refreshes old: ten degrees of azimuth at this elevation.
    assert!((lagging[20] - 10.0 * 0.2f32.cos()).abs() < 0.1, "{}", lagging[20]);
    assert!(foreseeing[20] < 0.5, "{}", foreseeing[20]);
    // At rest both ask for the same, and the frame is the camera's own.
    assert_eq!(asks_now.source.asked.last(), Some(&(at(40.0), PICTURE)));
    assert_eq!(asks_ahead.source.asked.last(), Some(&(at(40.0), PICTURE)));
    assert_eq!(
        (last.standing, last.is_ahead, last.frame_age),
        (Standing::Exact, false, Some(Duration::ZERO))
    );
}

#[test]
fn a_frame_in_blocks_is_waited_behind_for_the_exact_one() {
    let near = Pose::orbit(Vec3::ZERO, 0.0, 0.2, 2.0);
    let foresight = Foresight { predicts: false, ..Foresight::default() };
    let mut v = Viewing::new(FakeSource::default(), FrameSize::default(), foresight);
    let picture = Intrinsics::perspective(320, 200, 0.7);
    let refresh = |v: &mut Viewing<FakeSource>, at| {
        let r = v.refresh(ms(at), near, picture, &BOUNDS);
        (r.standing, r.frame.is_some_and(|f| f.is_exact), v.source.asked.len())
    };
    v.source.in_blocks = true;
    refresh(&mut v, 0);
    v.source.answer(1, ms(10));
    assert_eq!(refresh(&mut v, 20), (Standing::Refining, false, 1));
    v.source.in_blocks = false;
    v.source.answer(1, ms(100));
    // Now a margin is asked for; as long as that comes in blocks, the picture stays exact.
    assert_eq!(refresh(&mut v, 110), (Standing::Exact, true, 2));
    v.source.in_blocks = true;
    v.source.answer(2, ms(200));
    assert_eq!(refresh(&mut v, 210), (Standing::Exact, true, 2));
    // A server that leaves it at blocks.
    let mut v = Viewing::new(FakeSource::default(), FrameSize::default(), foresight);
    refresh(&mut v, 0);
    v.source.in_blocks = true;
    v.source.answer(1, ms(10));
    assert_eq!(refresh(&mut v, 20), (Standing::Refining, false, 1));
    assert_eq!(refresh(&mut v, 2000), (Standing::Settled, false, 2));
}

#[test]
fn zoomed_in_the_own_frame_comes_first_and_then_one_with_a_margin() {
    let near = |azimuth: f32| Pose::orbit(Vec3::ZERO, azimuth, 0.2, 2.0);
    let foresight = Foresight { predicts: false, ..Foresight::default() };
    let mut v = Viewing::new(FakeSource::default(), FrameSize::default(), foresight);
    v.source.max_side = Some(4096);
    let picture = Intrinsics::perspective(320, 200, 0.7);
    v.refresh(ms(0), near(0.0), picture, &BOUNDS);
    assert_eq!(v.source.asked, [(near(0.0), picture)]);
    v.source.answer(1, ms(0));
    assert_eq!(v.refresh(ms(10), near(0.0), picture, &BOUNDS).standing, Standing::Exact);
    let wide = v.source.asked[1].1;
    assert_eq!((v.source.asked[1].0, wide.margin_around(&picture)), (near(0.0), Some(48)));
    // As long as the wide frame is not exact, the picture stays what it is.
    v.source.in_blocks = true;
    v.source.answer(2, ms(10));
    let r = v.refresh(ms(20), near(0.0), picture, &BOUNDS);
    assert_eq!((r.standing, r.frame.unwrap().frame.header.camera.intrinsics), (Standing::Exact, picture));
    v.source.in_blocks = false;
    v.source.answer(2, ms(10));
    let r = v.refresh(ms(30), near(0.0), picture, &BOUNDS);
    assert_eq!((r.standing, r.frame.unwrap().frame.header.camera.intrinsics), (Standing::Exact, wide));
    v.refresh(ms(999), near(0.0), picture, &BOUNDS);
    assert_eq!(v.source.asked.len(), 2, "a resting camera asks for nothing");
    // On the way to another pose there is a margin; where it stops, the bare frame comes first again.
    v.refresh(ms(1000), near(0.1), picture, &BOUNDS);
    v.refresh(ms(1016), near(0.2), picture, &BOUNDS);
    assert!(v.source.asked[3].1.margin_around(&picture).unwrap() > 0);
    v.refresh(ms(1050), near(0.2), picture, &BOUNDS);
    assert_eq!(v.source.asked[4], (near(0.2), picture));
    // A new look begins with the bare frame, too.
    v.source.answer(5, ms(1050));
    v.refresh(ms(1300), near(0.2), picture, &BOUNDS);
    assert!(v.source.asked[5].1 != picture);
    v.source.put_look(7, look("bone"));
    v.refresh(ms(1400), near(0.2), picture, &BOUNDS);
    assert_eq!(v.source.asked[6], (near(0.2), picture));
}

#[test]
fn a_frame_that_was_shown_comes_in_for_what_the_newest_does_not_see() {
    let near = |azimuth: f32| Pose::orbit(Vec3::ZERO, azimuth, 0.2, 2.0);
    for keeps in [true, false] {
        let foresight = Foresight { keeps, ..Foresight::NONE };
        let mut v = Viewing::new(FakeSource::default(), FrameSize::default(), foresight);
        for (i, azimuth) in [0.0, 0.6].into_iter().enumerate() {
            let at = ms(1000 * i as u64);
            v.refresh(at, near(azimuth), PICTURE, &BOUNDS);
            v.source.answer(i as u32 + 1, at);
            let r = v.refresh(at + ms(500), near(azimuth), PICTURE, &BOUNDS);
            assert!(r.standing == Standing::Exact && r.kept.is_empty());
        }
        // On the way back the newest frame is that of 0.6.
        let r = v.refresh(ms(2000), near(0.1), PICTURE, &BOUNDS);
        let kept: Vec<u32> = r.kept.iter().map(|f| f.frame.header.frame.0).collect();
        assert_eq!(kept, if keeps { vec![1] } else { vec![] });
    }
}

/// What a frame says of itself counts, whatever the server has told of its pages by then.
#[test]
fn a_frame_that_a_finer_one_follows_is_not_final_and_one_that_stays_coarse_is_not_exact() {
    let pages = |num_resident| PageProgress { num_wanted: 9, num_resident, ..PageProgress::default() };
    for told in [pages(9), pages(5)] {
        let mut v = viewing();
        v.refresh(ms(0), at(0.0), PICTURE, &BOUNDS);
        v.source.talk().pages.handle_message(&ServerMessage::Pages(told));
        for (fineness, standing) in [
            (Fineness::Draft, Standing::Refining),
            (Fineness::Bounded, Standing::Settled),
            (Fineness::Whole, Standing::Exact),
        ] {
            v.source.fineness = fineness;
            v.source.answer(1, ms(0));
            let refresh = v.refresh(ms(400), at(0.0), PICTURE, &BOUNDS);
            assert_eq!(refresh.standing, standing, "{told:?}");
        }
    }
}

#[test]
fn a_frame_of_another_size_settles_but_is_never_exact() {
    let mut v =
        Viewing::new(FakeSource::default(), FrameSize { scale: 0.5, ..Default::default() }, Foresight::NONE);
    v.refresh(ms(0), at(0.0), PICTURE, &BOUNDS);
    assert_eq!(v.source.asked[0].1, Intrinsics::perspective(30, 20, 0.7));
    v.source.answer(1, ms(0));
    assert_eq!(v.refresh(ms(10), at(0.0), PICTURE, &BOUNDS).standing, Standing::Settled);
}

#[test]
fn while_the_camera_moves_frames_are_as_small_as_the_budget_wants() {
    let size = FrameSize { moving_budget: Some(ms(150)), ..Default::default() };
    let mut v = Viewing::new(FakeSource::default(), size, Foresight::NONE);
    v.refresh(ms(1), at(0.0), PICTURE, &BOUNDS);
    v.source.answer(1, ms(1));
    v.source.stats.server = ServerStats { frame: FrameId(1), generate_micros: 590_000, ..Default::default() };
    assert_eq!(v.refresh(ms(10), at(0.0), PICTURE, &BOUNDS).standing, Standing::Exact);
    // A quarter of the lists costs 147.5 ms.
    let half = Intrinsics::perspective(30, 20, 0.7);
    v.refresh(ms(20), at(5.0), PICTURE, &BOUNDS);
    assert_eq!(v.source.asked[1], (at(5.0), half));
    v.source.answer(2, ms(20));
    assert_eq!(v.refresh(ms(30), at(5.0), PICTURE, &BOUNDS).standing, Standing::Moving);
    // At rest the full size is asked for, once, and then shown as exact.
    assert_eq!(v.refresh(ms(171), at(5.0), PICTURE, &BOUNDS).standing, Standing::Refining);
    assert_eq!(v.source.asked[2], (at(5.0), PICTURE));
    v.source.answer(3, ms(171));
    assert_eq!(v.refresh(ms(180), at(5.0), PICTURE, &BOUNDS).standing, Standing::Exact);
    assert_eq!(v.refresh(ms(999), at(5.0), PICTURE, &BOUNDS).standing, Standing::Exact);
    assert_eq!(v.source.asked.len(), 3);
    // A fast server is asked for full frames throughout.
    v.source.stats.server = ServerStats { frame: FrameId(3), generate_micros: 40_000, ..Default::default() };
    v.refresh(ms(1000), at(9.0), PICTURE, &BOUNDS);
    assert_eq!(v.source.asked[3], (at(9.0), PICTURE));
}

#[test]
fn a_look_that_is_on_its_way_is_not_exact() {
    let mut v = viewing();
    v.source.put_look(1, look("bone"));
    v.refresh(ms(0), at(0.0), PICTURE, &BOUNDS);
    v.source.answer(1, ms(0));
    assert_eq!(v.refresh(ms(10), at(0.0), PICTURE, &BOUNDS).standing, Standing::Exact);
    v.set_look(ms(20), look("skin"));
    assert_eq!(v.look(), Some(Arc::new(look("skin"))));
    assert_eq!(*v.source.wanted_looks.borrow(), [look("skin")]);
    assert_eq!(v.refresh(ms(30), at(0.0), PICTURE, &BOUNDS).standing, Standing::Refining);
    v.source.put_look(2, look("skin"));
    assert_eq!(v.refresh(ms(40), at(0.0), PICTURE, &BOUNDS).standing, Standing::Refining);
    v.source.answer(1, ms(0));
    assert_eq!(v.refresh(ms(50), at(0.0), PICTURE, &BOUNDS).standing, Standing::Exact);
    // A wish that no server can grant is none.
    v.set_look(ms(60), Look { k: 0, ..look("no such thing") });
    assert_eq!(v.look(), Some(Arc::new(look("skin"))));
    assert_eq!(v.refresh(ms(4_000), at(0.0), PICTURE, &BOUNDS).standing, Standing::Exact);
}

#[test]
fn while_a_look_is_edited_the_picture_says_that_it_is_older() {
    let mut v = viewing();
    v.source.put_look(1, look("0"));
    v.refresh(ms(0), at(0.0), PICTURE, &BOUNDS);
    v.source.answer(1, ms(0));
    assert_eq!(v.refresh(ms(1), at(0.0), PICTURE, &BOUNDS).older_look_since, None);
    for i in 1..=125u64 {
        v.set_look(ms(i * 8), look(&i.to_string()));
        assert_eq!(v.look(), Some(Arc::new(look(&i.to_string()))), "the panel shows the newest at once");
        let refresh = v.refresh(ms(i * 8), at(0.0), PICTURE, &BOUNDS);
        assert_eq!(refresh.older_look_since, Some(ms(8)));
    }
    // Granted, but the frame is still of the look before; then it is there.
    v.source.put_look(2, look("125"));
    assert_eq!(v.refresh(ms(1100), at(0.0), PICTURE, &BOUNDS).older_look_since, Some(ms(8)));
    v.source.answer(1, ms(0));
    let refresh = v.refresh(ms(1200), at(0.0), PICTURE, &BOUNDS);
    assert_eq!((refresh.older_look_since, refresh.standing), (None, Standing::Exact));
}

#[test]
fn a_look_being_edited_is_seen_in_small_frames() {
    let size = FrameSize { moving_budget: Some(ms(150)), ..Default::default() };
    let mut v = Viewing::new(FakeSource::default(), size, Foresight::NONE);
    v.source.put_look(1, look("bone"));
    v.refresh(ms(1), at(0.0), PICTURE, &BOUNDS);
    v.source.answer(1, ms(1));
    v.source.stats.server = ServerStats { frame: FrameId(1), generate_micros: 590_000, ..Default::default() };
    v.refresh(ms(100), at(0.0), PICTURE, &BOUNDS);
    let num_asked = v.source.asked.len();
    let half = Intrinsics::perspective(30, 20, 0.7);
    v.set_look(ms(200), look("skin"));
    assert_eq!(v.source.asked[num_asked..], [(at(0.0), half)], "with the look, not a refresh later");
    v.refresh(ms(201), at(0.0), PICTURE, &BOUNDS);
    v.refresh(ms(349), at(0.0), PICTURE, &BOUNDS);
    assert_eq!(v.source.asked[num_asked..], [(at(0.0), half)]);
    v.refresh(ms(351), at(0.0), PICTURE, &BOUNDS);
    assert_eq!(v.source.asked[num_asked + 1..], [], "the server has not made it yet");
    v.source.put_look(2, look("skin"));
    v.source.answer(1, ms(1));
    v.refresh(ms(500), at(0.0), PICTURE, &BOUNDS);
    assert_eq!(v.source.asked[num_asked + 1..], [(at(0.0), PICTURE)]);
    // Control: a server that never makes it is asked for the full one in the end.
    v.set_look(ms(600), look("muscle"));
    v.refresh(ms(3500), at(0.0), PICTURE, &BOUNDS);
    assert_ne!(v.source.asked.last().unwrap().1, PICTURE);
    v.refresh(ms(3700), at(0.0), PICTURE, &BOUNDS);
    assert_eq!(v.source.asked.last().unwrap(), &(at(0.0), PICTURE));
}

#[test]
fn frames_are_asked_for_in_the_picture_s_shape_within_the_limits() {
    let size = FrameSize::default();
    let picture = |width, height| Intrinsics::perspective(width, height, 1.0);
    assert_eq!(size.frame_for(picture(800, 600), 4096), picture(800, 600));
    assert_eq!(size.frame_for(picture(3840, 2160), 4096), picture(1920, 1080));
    assert_eq!(size.frame_for(picture(1000, 2400), 4096), picture(500, 1200));
    assert_eq!(FrameSize { scale: 0.5, ..size }.frame_for(picture(801, 1), 4096), picture(401, 1));
    assert_eq!(size.frame_for(picture(800, 600), 400), picture(400, 300), "the server's limit");
}

#[test]
fn a_refresh_knows_whether_anything_changed_and_tells_of_new_frames_once() {
    let mut v = viewing();
    assert!(v.refresh(ms(0), at(0.0), PICTURE, &BOUNDS).changed);
    assert!(!v.refresh(ms(1), at(0.0), PICTURE, &BOUNDS).changed);
    v.source.answer(1, ms(0));
    assert!(v.refresh(ms(2), at(0.0), PICTURE, &BOUNDS).changed);
    assert!(!v.refresh(ms(3), at(0.0), PICTURE, &BOUNDS).changed);
    assert_eq!(v.source.shown, [FrameId(1)]);
}

#[test]
fn another_volume_is_asked_for_at_once_and_the_one_before_stays_as_it_was_until_it_is_there() {
    let mut viewing = Viewing::new(FakeSource::default(), FrameSize::default(), Foresight::NONE);
    viewing.source.put_look(1, look("first"));
    viewing.refresh(ms(0), at(10.0), PICTURE, &BOUNDS);
    viewing.source.answer(1, ms(0));
    let before = viewing.refresh(ms(500), at(10.0), PICTURE, &BOUNDS);
    assert_eq!((before.bounds, before.camera.pose), (BOUNDS, at(10.0)));

    // Ten times as large, seen from ten times as far.
    let large = Aabb { min: BOUNDS.min * 10.0, max: BOUNDS.max * 10.0 };
    let far = Pose { eye: at(10.0).eye * 10.0, ..at(10.0) };
    viewing.source.put_look(2, look("second"));
    viewing.source.volume_since = LookVersion(2);
    let meanwhile = viewing.refresh(ms(510), far, PICTURE, &large);
    assert_eq!(viewing.source.asked.last().unwrap().0, far, "the new volume is asked for");
    assert_eq!(meanwhile.bounds, BOUNDS);
    assert!((meanwhile.camera.pose.eye - before.camera.pose.eye).length() < 1e-5, "the picture stays");
    assert!(meanwhile.standing != Standing::Exact && meanwhile.older_look_since.is_some());
    let number = viewing.source.asked.len() as u32;
    viewing.source.answer(number, ms(510));
    let after = viewing.refresh(ms(900), far, PICTURE, &large);
    assert_eq!((after.bounds, after.camera.pose), (large, far));
    assert!(after.older_look_since.is_none());
}

#[test]
fn a_cut_is_no_older_look_but_anything_else_is() {
    let mut v = viewing();
    let clipped = |max: f32| Look {
        clip: Clip { bounds: Some(Aabb { min: Vec3::NEG_ONE, max: Vec3::splat(max) }), plane: None },
        ..look("first")
    };
    v.source.put_look(3, clipped(0.5));
    v.refresh(ms(10), at(0.0), PICTURE, &BOUNDS);
    v.source.answer(1, ms(10));
    let refresh = |v: &mut Viewing<FakeSource>, time| v.refresh(ms(time), at(0.0), PICTURE, &BOUNDS);
    assert_eq!(refresh(&mut v, 20).older_look_since, None);
    // Smaller: cut here, at once, and not settled before the server has it.
    v.set_look(ms(30), clipped(0.3));
    let cut = refresh(&mut v, 40);
    assert_eq!((cut.older_look_since, cut.clip), (None, clipped(0.3).clip));
    assert_eq!(cut.standing, Standing::Refining);
    // The server has it, the frame that is shown is still the one before.
    v.source.put_look(4, clipped(0.3));
    assert_eq!(refresh(&mut v, 80).older_look_since, None);
    // Larger than the frame knows, or another transfer function: not this picture.
    v.set_look(ms(90), clipped(0.6));
    assert_eq!(refresh(&mut v, 130).older_look_since, Some(ms(130)));
    v.set_look(ms(140), Look { k: 3, ..clipped(0.3) });
    assert_eq!(refresh(&mut v, 180).older_look_since, Some(ms(130)));
    v.set_look(ms(190), clipped(0.5));
    assert_eq!(refresh(&mut v, 230).older_look_since, None);
}

#[test]
fn zooming_with_parallel_rays_is_a_movement_and_is_foreseen() {
    let mut v = viewing();
    v.predictor.note_shown(ms(100), ms(0));
    let camera = |zoom: f32| {
        let pose = Pose::orbit(Vec3::ZERO, 0.3, 0.2, 6.0);
        Camera::new(pose, PICTURE, &BOUNDS).to_orthographic(6.0 * (-zoom).exp(), &BOUNDS)
    };
    let height = |i: Intrinsics| i.half_size_at(1.0).1 / i.height as f32;
    let mut ahead = 0;
    for i in 0..60 {
        let c = camera(i as f32 * 0.01);
        let refresh = v.refresh(ms(100 + 16 * i), c.pose, c.intrinsics, &BOUNDS);
        assert!(i == 0 || refresh.standing == Standing::Waiting || refresh.standing == Standing::Moving);
        let (pose, asked) = *v.source.asked.last().unwrap();
        // The eye stands where all of the volume is in front of it, and only what is shown shrinks.
        assert!((pose.eye - c.pose.eye).length() < 1e-4);
        ahead += usize::from(height(asked) < height(c.intrinsics) * 0.995);
    }
    assert!(ahead > 20, "smaller than now, as it will be: {ahead}");
    let c = camera(0.59);
    for i in 0..20 {
        v.refresh(ms(1100 + 16 * i), c.pose, c.intrinsics, &BOUNDS);
    }
    assert_eq!(*v.source.asked.last().unwrap(), (c.pose, c.intrinsics), "at rest to the bit");
}
