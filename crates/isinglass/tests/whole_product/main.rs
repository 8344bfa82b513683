//! Does the viewer's picture follow the hand over a bad link, and is it right?
//!
//! The server and the viewer are processes of the binary. The link between them has 200 ms of round trip, jitter and
//! 1 % loss. A mouse drags the window, and pictures are read back from the X server. Each is compared with a full
//! rendering by `render` from the same pose. The viewer's log tells the pose of each refresh.
//!
//! The test counts refreshes, not milliseconds, so a slow machine does not fail it. The closed form of a drag says how
//! far the camera has turned: 180° across the shorter side of the window.
#![cfg(target_os = "linux")]
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "../common/mod.rs"]
mod common;
mod relay;
#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "../common/screen.rs"]
mod screen;
#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "../common/viewer.rs"]
mod viewer;

use std::ops::RangeInclusive;
use std::time::Duration;

use glam::Vec3;
use isinglass_client::DEFAULT_FOV_Y_DEGREES;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::image_error::{ImageError, compare};
use isinglass_core::volume::Lighting;
use isinglass_formats::{Remembered, SavedCamera, SavedState};
use isinglass_net::{Link, LinkModel};

use common::Bench;
use relay::Relay;
use screen::{Screen, Shot};
use viewer::{Viewer, has_window, serve};

/// A picture of the window while the hand moves.
struct Seen {
    shot: Shot,
    /// The pose of the picture, as the log says.
    camera: Pose,
    /// The pose of the newest frame from the server.
    frame: Pose,
}

/// What a drag showed.
#[derive(Default)]
struct Drag {
    seen: Vec<Seen>,
    /// For each step of the hand: the refreshes before it, and the turn from the first pose that it leads to, degrees.
    steps: Vec<(usize, f32)>,
}

#[test]
fn the_picture_follows_the_hand_over_a_bad_link() {
    if !has_window() {
        return;
    }
    let bench = Bench::new();
    // Without the light that a window begins with, as `render` shows it.
    let choices = Remembered { light: Some(Lighting::default()), ..Remembered::default() };
    std::fs::create_dir_all(bench.path("remembered/isinglass")).unwrap();
    bench.write("remembered/isinglass/choices.toml", choices.to_toml());
    let (server, link) = serve(&bench, VOLUME);
    let ms = Duration::from_millis;
    let model = LinkModel { rtt: ms(200), jitter: ms(10), loss: 0.01, ..LinkModel::default() };
    let relay = Relay::new(link.place().parse().unwrap(), &model);
    let link = Link { port: relay.port(), ..link };
    // With `--refresh 1` a slow machine casts as fine a picture as a fast one.
    let [width, height] = SIZE;
    let line = format!("view {link} --size {width}x{height} --bars off --axes off --refresh 1");
    let mut viewer = Viewer::start(&bench, &line);
    let screen = Screen::open();
    let window = viewer.wait("window", |_| screen.window(SIZE));

    let (first, at_first) = rest(&mut viewer, &screen, window);
    let Drag { seen, steps } = drag(&mut viewer, &screen, window, &at_first);
    let (last, at_last) = rest(&mut viewer, &screen, window);
    let cameras: Vec<Pose> = viewer.refreshes().iter().map(|refresh| refresh.camera).collect();
    assert!(relay.lost() > 0, "the link loses packets");
    drop((viewer, relay, server));

    // Input is answered within two refreshes. One may have begun before the input came.
    let delays = delays(&cameras, &steps);
    println!("input is answered after {delays:?} refreshes");
    assert!(delays.iter().all(|delay| *delay <= 2), "{delays:?}");
    // Negative control: a viewer that shows each pose two refreshes late.
    let late: Vec<Pose> = [&[at_first; 2], &cameras[..]].concat();
    let late = self::delays(&late, &steps);
    assert!(late.iter().any(|delay| *delay > 2), "{late:?}");

    // While the hand moves, the pictures are near to full renderings from the same poses.
    assert_eq!(seen.len(), NUM_SHOTS, "after {} steps", steps.len());
    let mut errors = Vec::new();
    for Seen { shot, camera, frame } in &seen {
        let own = error(shot, &full_rendering(&bench, camera)).dssim;
        // Negative control: the picture of a viewer that shows what the server last sent.
        let of_server = error(shot, &full_rendering(&bench, frame)).dssim;
        println!("{:.1}° beside the frame: DSSIM {own:.4}, {of_server:.4}", degrees_between(camera, frame));
        // A frame on a lossy link may be a coarse one.
        assert!(own < NEARER * of_server, "{own}, {of_server}");
        errors.push([own, of_server]);
    }
    let [own, of_server] = [0, 1].map(|which| {
        let mut each: Vec<f64> = errors.iter().map(|e| e[which]).collect();
        each.sort_unstable_by(f64::total_cmp);
        each[each.len() / 2]
    });
    assert!(own < MAX_DSSIM && of_server > MAX_DSSIM, "medians {own}, {of_server}");

    // At rest they are the full renderings: half floats carry a list to less than half a step of 8 bits.
    for (shot, pose, other) in [(&first, at_first, at_last), (&last, at_last, at_first)] {
        let own = error(shot, &full_rendering(&bench, &pose));
        assert!(own.max_abs_255 <= 1, "{own:?}");
        let other = error(shot, &full_rendering(&bench, &other));
        assert!(other.max_abs_255 > 1, "negative control: the other end of the drag is another picture");
    }
}

/// Waits until the picture is said to be exact. The picture and its pose.
fn rest(viewer: &mut Viewer, screen: &Screen, window: u32) -> (Shot, Pose) {
    let num = viewer.wait("rest", |all| all.last().is_some_and(|r| r.is_exact).then_some(all.len()));
    // A window at rest draws nothing, so a pointer that moves over it makes it draw.
    let mut x = 0;
    let pose = viewer.wait("refresh at rest", |all| {
        x = (x + 1) % 2;
        screen.point_at(window, START[0] + x, START[1]);
        all.last().filter(|r| r.is_exact && all.len() >= num + IN_FLIGHT).map(|r| r.camera)
    });
    (screen.shot(window, SIZE), pose)
}

/// Drags in steps with the button held. After each step the hand stays until the picture of it must be on the screen,
/// which is long before the server answers.
fn drag(viewer: &mut Viewer, screen: &Screen, window: u32, first: &Pose) -> Drag {
    let mut drag = Drag::default();
    let mut answer = 0;
    screen.point_at(window, START[0], START[1]);
    screen.press(true);
    for pixels in (1..=MAX_STEPS).map(|step| step * STEP_PIXELS) {
        screen.point_at(window, START[0] + pixels, START[1]);
        let before = viewer.refreshes().len();
        let degrees = f32::from(pixels) * 180.0 / f32::from(SIZE[0].min(SIZE[1]));
        drag.steps.push((before, degrees));
        answer += viewer.wait("answer", |all| {
            all[answer..].iter().position(|refresh| is_turned(&refresh.camera, first, degrees))
        });
        viewer.wait("refresh", |all| (all.len() > answer + IN_FLIGHT).then_some(()));
        let newest = *viewer.refreshes().last().unwrap();
        let shot = screen.shot(window, SIZE);
        let after = *viewer.refreshes().last().unwrap();
        // The pictures that count are those of which the server's own is not there yet.
        let is_behind =
            |frame: Option<Pose>| BEHIND_DEGREES.contains(&degrees_between(&frame.unwrap(), &newest.camera));
        if is_behind(newest.frame) && is_behind(after.frame) {
            drag.seen.push(Seen { shot, camera: newest.camera, frame: newest.frame.unwrap() });
        }
        if drag.seen.len() == NUM_SHOTS {
            break;
        }
    }
    screen.press(false);
    drag
}

/// For each step, the refreshes from the input to the first one from the pose that the step leads to, that one included.
fn delays(cameras: &[Pose], steps: &[(usize, f32)]) -> Vec<usize> {
    let mut answer = 0;
    let delay = |(before, degrees): &(usize, f32)| {
        let is_answer = |camera: &Pose| is_turned(camera, &cameras[0], *degrees);
        answer += cameras[answer..].iter().position(is_answer).unwrap();
        (answer + 1).saturating_sub(*before)
    };
    steps.iter().map(delay).collect()
}

/// Whether the hand has turned the camera by so much. Single precision adds up the steps.
fn is_turned(camera: &Pose, first: &Pose, degrees: f32) -> bool {
    let between = 180.0 - (degrees.rem_euclid(360.0) - 180.0).abs();
    (degrees_between(camera, first) - between).abs() < 0.1
}

fn degrees_between(a: &Pose, b: &Pose) -> f32 {
    a.world_from_view.angle_between(b.world_from_view).to_degrees()
}

/// Compares what lies below the buttons of the window.
fn error(a: &Shot, b: &Shot) -> ImageError {
    assert_eq!(a.size, b.size);
    let [width, height] = a.size.map(|n| n as usize);
    let [a, b] = [a, b].map(|shot| &shot.rgb[3 * width * BUTTON_ROWS..]);
    compare(a, b, width, height - BUTTON_ROWS, [0; 3]).unwrap()
}

/// The picture that `render` makes from a pose.
fn full_rendering(bench: &Bench, pose: &Pose) -> Shot {
    let [width, height] = SIZE.map(u32::from);
    let intrinsics = Intrinsics::perspective(width, height, DEFAULT_FOV_Y_DEGREES.to_radians());
    let placement = (pose.world_from_view, pose.world_from_view.inverse() * pose.eye);
    let camera = Some(SavedCamera::of(Vec3::ZERO, placement, intrinsics));
    bench.write("pose.toml", SavedState { camera, ..SavedState::default() }.to_toml());
    bench.ok(&format!("render {VOLUME} --state pose.toml -o full.png --backend cpu"));
    let picture = image::open(bench.path("full.png")).unwrap().to_rgb8();
    Shot { size: [picture.width(), picture.height()], rgb: picture.into_raw() }
}

/// Soft, so that a turn changes all of it.
const VOLUME: &str = "builtin:cloud@32";
/// Columns and rows of the window.
const SIZE: [u16; 2] = [320, 240];
/// Rows of the window that its buttons cover. The volume lies below them.
const BUTTON_ROWS: usize = 52;
/// Where the hand takes the volume.
const START: [i16; 2] = [40, 120];
/// 12°.
const STEP_PIXELS: i16 = 16;
/// Pictures while the hand moves.
const NUM_SHOTS: usize = 6;
/// So many that pictures that do not count are no matter, and few enough for a small screen.
const MAX_STEPS: i16 = 30;
/// Turn of the newest frame from the camera for a picture to count: one or two steps. A hand that stops and goes can
/// have the server asked for poses that are farther away.
const BEHIND_DEGREES: RangeInclusive<f32> = 11.5..=26.0;
/// Two pictures may be on their way to the screen when a refresh begins.
const IN_FLIGHT: usize = 3;
/// Such novel views have 0.001 to 0.010, and single ones 0.016, on a loaded machine, whose server makes coarser frames.
/// The server's own pictures, one or two steps late, have 0.020 and more.
const MAX_DSSIM: f64 = 0.012;
/// Share of the error of the server's own picture that a novel view may have.
const NEARER: f64 = 0.7;
