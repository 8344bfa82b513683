//! Does the viewer's window show what the CPU twin casts from the same frame and camera?
//!
//! Opens a real window, so it needs a display (`xvfb-run` will do) and a Vulkan driver (lavapipe will do). Without a
//! display it is skipped with a line, or fails if `ISINGLASS_STRICT=1`. Windows belong to the main thread: there is no
//! test harness around this file.
#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test without the harness that would allow both"
)]

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use isinglass_client::camera_controls::InitialOrbit;
use isinglass_client::{
    BACKGROUND, FrameSize, FrameSource, Probe, ScriptStep, Shot, Standing, Stereo, StereoMode, WindowOptions,
    display_available, run_window,
};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::kernels::combine::combine;
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::lens::raycast_mean;
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::look::Look;
use isinglass_core::session::ClientSession;
use isinglass_core::session::ledger::Life;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::wire::{Token, VolumeDescription, Welcome};
use isinglass_net::{Clock, LinkStats, ReceivedFrame, State, Talking};

fn main() {
    if !display_available() {
        assert!(
            std::env::var("ISINGLASS_STRICT").as_deref() != Ok("1"),
            "no display: DISPLAY names no X server that answers"
        );
        println!("skipped: no display (run under xvfb-run to open the window)");
        return;
    }
    window_shows_what_the_twin_casts();
    println!("ok: the window shows what the CPU twin casts");
    window_shows_what_kept_frames_saw();
    println!("ok: the window shows what the CPU twin combines of two frames");
    for mode in [StereoMode::SideBySide, StereoMode::RedCyan] {
        window_shows_each_eye_its_view(mode);
    }
    println!("ok: each eye is shown what the CPU twin casts for it");
}

/// First a frame of another pose is shown, as while the hand moves; then the camera's own.
fn window_shows_what_the_twin_casts() {
    let answers_wishes = Arc::new(AtomicBool::new(false));
    let shots: Arc<Mutex<Vec<Shot>>> = Arc::default();
    let probes: Arc<Mutex<Vec<Probe>>> = Arc::default();
    let mut awaited = 0;
    let script = {
        let (answers_wishes, shots, probes) = (answers_wishes.clone(), shots.clone(), probes.clone());
        move |probe: &Probe| {
            assert!(probe.now < Duration::from_secs(120), "the window never came to rest");
            let Some(refresh) = &probe.refresh else { return ScriptStep::Continue };
            let have = shots.lock().unwrap().len();
            if have == 2 {
                return ScriptStep::Close;
            }
            if have == 1 {
                answers_wishes.store(true, Ordering::Relaxed);
            }
            let ready = match have {
                0 => refresh.frame.is_some() && refresh.standing == Standing::Refining,
                _ => refresh.standing == Standing::Exact,
            };
            if !ready || awaited != have || refresh.changed {
                return ScriptStep::Continue;
            }
            awaited += 1;
            probes.lock().unwrap().push(probe.clone());
            let shots = shots.clone();
            ScriptStep::Capture(Box::new(move |shot| shots.lock().unwrap().push(shot)))
        }
    };
    let options = WindowOptions {
        size: [360, 260],
        initial_orbit: InitialOrbit {
            azimuth_degrees: 25.0,
            elevation_degrees: 15.0,
            distance_in_radii: Some(2.6),
        },
        frame_size: FrameSize::default(),
        shows_bars: false,
        script: Some(Box::new(script)),
        ..Default::default()
    };
    run_window(options, Clock::start(), move |_wake| Ok(StillSource::new(answers_wishes))).unwrap();

    let probes = probes.lock().unwrap();
    let shots = shots.lock().unwrap();
    assert_eq!((probes.len(), shots.len()), (2, 2));
    for (probe, shot) in probes.iter().zip(shots.iter()) {
        let refresh = probe.refresh.as_ref().unwrap();
        let frame = &refresh.frame.as_ref().unwrap().frame;
        let camera = refresh.camera;
        assert_eq!(
            (shot.width, shot.height),
            (camera.intrinsics.width as usize, camera.intrinsics.height as usize)
        );
        let twin = raycast(frame, &refresh.bounds, &camera).to_srgb8(BACKGROUND);
        let (max, mean) = difference(&shot.rgb, &twin);
        println!(
            "{:?}, turned by {:.1}°: max {max}, mean {mean:.4}",
            refresh.standing,
            refresh.turned_degrees.unwrap()
        );
        // The GPU's exp and the fused products of its compiler: the bound of every kernel against its twin.
        assert!(max <= 2 && mean < 0.1, "{:?}: max {max}, mean {mean}", refresh.standing);

        // Negative control: two degrees more and the comparison fails, so it does see the camera.
        let q = glam::Quat::from_rotation_y(2f32.to_radians());
        let pose = Pose { eye: q * camera.pose.eye, world_from_view: q * camera.pose.world_from_view };
        let turned = Camera::new(pose, camera.intrinsics, &refresh.bounds);
        let (max, mean) =
            difference(&shot.rgb, &raycast(frame, &refresh.bounds, &turned).to_srgb8(BACKGROUND));
        assert!(max > 10 && mean > 0.1, "turned by two degrees: max {max}, mean {mean}");
    }
    let exact = probes[1].refresh.as_ref().unwrap();
    // The corners of the volume are outside of the picture, so its frame has a margin, or gets one a moment later.
    let of_frame = exact.frame.as_ref().unwrap().frame.header.camera;
    let margin = of_frame.intrinsics.margin_around(&exact.camera.intrinsics).unwrap();
    assert_eq!(of_frame.pose, exact.camera.pose);
    assert!(probes[0].refresh.as_ref().unwrap().turned_degrees.unwrap() > 5.0);
    // What "exact" promises: the server's own picture, to one step of eight bits.
    let own = exact.frame.as_ref().unwrap().frame.flatten().cropped(margin).to_srgb8(BACKGROUND);
    let (max, _) = difference(&shots[1].rgb, &own);
    assert!(max <= 1, "exact, against the frame's own picture: max {max}");
    let (max, _) = difference(&shots[0].rgb, &own);
    assert!(max > 4, "negative control: the turned frame is not exact, max {max}");
}

/// Near to the volume the camera's own frame comes first and then one from aside, which does not see all of the picture.
fn window_shows_what_kept_frames_saw() {
    let answers_wishes = Arc::new(AtomicBool::new(true));
    let shots: Arc<Mutex<Vec<(Probe, Shot)>>> = Arc::default();
    let mut has_asked = false;
    let script = {
        let (answers_wishes, shots) = (answers_wishes.clone(), shots.clone());
        move |probe: &Probe| {
            assert!(probe.now < Duration::from_secs(120), "no frame was kept");
            let Some(refresh) = &probe.refresh else { return ScriptStep::Continue };
            if !shots.lock().unwrap().is_empty() {
                return ScriptStep::Close;
            }
            if refresh.standing == Standing::Exact && !refresh.changed {
                answers_wishes.store(false, Ordering::Relaxed);
            }
            if refresh.kept.is_empty() || refresh.changed || has_asked {
                return ScriptStep::Continue;
            }
            has_asked = true;
            let probe = probe.clone();
            let shots = shots.clone();
            ScriptStep::Capture(Box::new(move |shot| shots.lock().unwrap().push((probe, shot))))
        }
    };
    let options = WindowOptions {
        size: [200, 150],
        initial_orbit: InitialOrbit { distance_in_radii: Some(0.9), ..InitialOrbit::default() },
        shows_bars: false,
        script: Some(Box::new(script)),
        ..Default::default()
    };
    run_window(options, Clock::start(), move |_wake| Ok(StillSource::new(answers_wishes))).unwrap();

    let (probe, shot) = shots.lock().unwrap().pop().unwrap();
    let refresh = probe.refresh.unwrap();
    let newest = &refresh.frame.as_ref().unwrap().frame;
    let frames: Vec<&LayeredFrame> =
        std::iter::once(newest).chain(refresh.kept.iter().map(|f| &f.frame)).collect();
    let twin = combine(&frames, &refresh.bounds, &refresh.camera).to_srgb8(BACKGROUND);
    let (max, mean) = difference(&shot.rgb, &twin);
    println!("{} frames: max {max}, mean {mean:.4}", frames.len());
    // The bound of every kernel against its twin, as above.
    assert!(max <= 2 && mean < 0.1, "{} frames: max {max}, mean {mean}", frames.len());
    // Negative control: kept frames left out.
    let alone = raycast(newest, &refresh.bounds, &refresh.camera).to_srgb8(BACKGROUND);
    let (max, mean) = difference(&shot.rgb, &alone);
    assert!(max > 10 && mean > 0.1, "the newest alone: max {max}, mean {mean}");
}

/// The whole picture is compared: nothing lies between the eyes, and no channel is left over.
fn window_shows_each_eye_its_view(mode: StereoMode) {
    let stereo = Stereo { mode, eye_angle_degrees: 5.0 };
    let shots: Arc<Mutex<Vec<(Probe, Shot)>>> = Arc::default();
    let mut has_asked = false;
    let script = {
        let shots = shots.clone();
        move |probe: &Probe| {
            assert!(probe.now < Duration::from_secs(120), "the window never came to rest");
            let Some(refresh) = &probe.refresh else { return ScriptStep::Continue };
            if !shots.lock().unwrap().is_empty() {
                return ScriptStep::Close;
            }
            assert!(refresh.standing != Standing::Exact, "two eyes see novel views");
            if refresh.standing != Standing::Settled || refresh.changed || has_asked {
                return ScriptStep::Continue;
            }
            has_asked = true;
            let probe = probe.clone();
            let shots = shots.clone();
            ScriptStep::Capture(Box::new(move |shot| shots.lock().unwrap().push((probe, shot))))
        }
    };
    // An odd width: the column in the middle belongs to both halves.
    let options = WindowOptions {
        size: [361, 260],
        initial_orbit: InitialOrbit { azimuth_degrees: 25.0, ..InitialOrbit::default() },
        frame_size: FrameSize::default(),
        stereo,
        shows_bars: false,
        script: Some(Box::new(script)),
        ..Default::default()
    };
    let answers_wishes = Arc::new(AtomicBool::new(true));
    run_window(options, Clock::start(), move |_wake| Ok(StillSource::new(answers_wishes))).unwrap();

    let (probe, shot) = shots.lock().unwrap().pop().unwrap();
    let refresh = probe.refresh.unwrap();
    let frame = &refresh.frame.as_ref().unwrap().frame;
    let eyes = stereo.eyes(&refresh.camera, &refresh.bounds);
    let [left, right] = eyes.map(|eye| raycast_mean(frame, &refresh.bounds, &[eye]).to_srgb8(BACKGROUND));
    let width = refresh.camera.intrinsics.width as usize;
    let expected = |left: &[u8], right: &[u8]| -> Vec<u8> {
        if mode == StereoMode::RedCyan {
            assert_eq!(width, shot.width);
            return left.chunks(3).zip(right.chunks(3)).flat_map(|(l, r)| [l[0], r[1], r[2]]).collect();
        }
        let overlap = 2 * width - shot.width;
        assert!(overlap < 2, "{width} columns an eye in {}", shot.width);
        let rows = left.chunks(3 * width).zip(right.chunks(3 * width));
        rows.flat_map(|(l, r)| [&l[..3 * (width - overlap)], r].concat()).collect()
    };
    let (max, mean) = difference(&shot.rgb, &expected(&left, &right));
    println!("{mode:?}: max {max}, mean {mean:.4}");
    // The bound of every kernel against its twin, as above.
    assert!(max <= 2 && mean < 0.1, "{mode:?}: max {max}, mean {mean}");
    // Negative controls: swapped eyes, and one eye for both.
    for (a, b) in [(&right, &left), (&left, &left)] {
        let (max, mean) = difference(&shot.rgb, &expected(a, b));
        assert!(max > 10 && mean > 0.1, "{mode:?}, wrong eyes: max {max}, mean {mean}");
    }
}

/// Greatest and mean difference, in steps of 8 bits.
fn difference(a: &[u8], b: &[u8]) -> (u8, f64) {
    assert_eq!(a.len(), b.len());
    let each = || a.iter().zip(b).map(|(a, b)| a.abs_diff(*b));
    (each().max().unwrap(), each().map(f64::from).sum::<f64>() / a.len() as f64)
}

/// Renders on the CPU at once; until it is told to answer wishes, from a pose eight degrees beside the wish.
struct StillSource {
    session: Mutex<ClientSession>,
    scene: Scene,
    answers_wishes: Arc<AtomicBool>,
    beside: Option<Arc<ReceivedFrame>>,
    own: Option<Arc<ReceivedFrame>>,
}

impl StillSource {
    fn new(answers_wishes: Arc<AtomicBool>) -> Self {
        let transfer = isinglass_formats::preset("cloud").unwrap();
        let scene = Scene::new(Arc::new(Builtin::Cloud.volume(48)), &transfer, MarchSettings::default());
        Self { session: Mutex::default(), scene, answers_wishes, beside: None, own: None }
    }

    fn frame(&self, pose: Pose, intrinsics: Intrinsics, id: u32) -> Arc<ReceivedFrame> {
        let header = FrameHeader {
            frame: FrameId(id),
            pose: PoseId(id),
            look: LookVersion(0),
            camera: Camera::new(pose, intrinsics, &self.scene.volume.bounds()),
            k: 8,
            mode: Default::default(),
            fineness: Default::default(),
        };
        let frame: LayeredFrame = generate(&self.scene, header);
        let times = Life::default();
        Arc::new(ReceivedFrame { frame, is_exact: true, times })
    }
}

impl FrameSource for StillSource {
    // Without a look there is no look panel over the picture.
    fn talk(&self) -> Talking<'_, ClientSession> {
        Talking::alone(&self.session)
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        if self.answers_wishes.load(Ordering::Relaxed) { self.own.clone() } else { self.beside.clone() }
    }

    fn note_shown(&mut self, _frame: FrameId) {}

    fn state(&self) -> State {
        State::Connected
    }

    fn stats(&self) -> LinkStats {
        LinkStats::default()
    }

    fn set_pose(&mut self, _now: Duration, pose: Pose, intrinsics: Intrinsics) {
        let q = glam::Quat::from_rotation_y(8f32.to_radians());
        let beside = Pose { eye: q * pose.eye, world_from_view: q * pose.world_from_view };
        self.beside = Some(self.frame(beside, intrinsics, 1));
        self.own = Some(self.frame(pose, intrinsics, 2));
    }

    fn description(&self) -> Option<Arc<Welcome>> {
        Some(Arc::new(Welcome {
            ticket: Token::new([0; 16]),
            volume: VolumeDescription::of(&self.scene.volume, &self.scene.histogram),
            look_version: LookVersion(0),
            look: Look::new(isinglass_formats::preset("cloud").unwrap()),
            max_side: 4096,
            max_poses_per_second: 100,
        }))
    }

    fn is_of_volume(&self, _frame: &ReceivedFrame) -> bool {
        true
    }
}
