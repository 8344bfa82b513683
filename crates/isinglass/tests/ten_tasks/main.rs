//! Can a new user do ten tasks in the window? Real windows, a mouse, keys and a clipboard do them, and what comes of each
//! is checked: the viewer's log of poses, files, and the pictures on the screen.
#![cfg(target_os = "linux")]
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "../common/mod.rs"]
mod common;
#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "../common/screen.rs"]
mod screen;
#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "../common/viewer.rs"]
mod viewer;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use isinglass_core::camera::Pose;
use isinglass_core::mode::Mode;
use isinglass_formats::{SavedState, read_state};

use common::Bench;
use screen::{Screen, Shot};
use viewer::{Viewer, has_window, serve};

/// A viewer with its window, and the screen that it is on.
struct Desk<'a> {
    viewer: Viewer,
    screen: &'a Screen,
    window: u32,
    num_before: usize,
}

impl<'a> Desk<'a> {
    fn open(bench: &Bench, screen: &'a Screen, line: &str) -> Self {
        let [width, height] = SIZE;
        let mut viewer = Viewer::start(bench, &format!("{line} --size {width}x{height}"));
        let window = viewer.wait("window", |_| screen.window(SIZE));
        Self { viewer, screen, window, num_before: 0 }
    }

    /// Waits for the server's own picture after what was done last. The picture and its pose.
    fn rest(&mut self) -> (Shot, Pose) {
        let before = self.num_before;
        let mut x = 0;
        let (num, pose) = self.viewer.wait("rest", |all| {
            // A window at rest draws nothing, so a pointer that moves over it makes it draw.
            x = (x + 1) % 2;
            self.screen.point_at(self.window, START[0] + x, START[1]);
            std::thread::sleep(Duration::from_millis(20));
            let is_calm = all.len() >= before + CALM && all[all.len() - CALM..].iter().all(|r| r.is_exact);
            is_calm.then(|| (all.len(), all[all.len() - 1].camera))
        });
        self.num_before = num;
        (self.screen.shot(self.window, SIZE), pose)
    }

    /// The picture at rest once it differs from another one: the display's pipelines are compiled at their first use, so
    /// a window may be at rest before it has painted what is new.
    fn rest_unlike(&mut self, before: &Shot) -> (Shot, Pose) {
        let patience = Instant::now() + Duration::from_secs(60);
        loop {
            let (shot, pose) = self.rest();
            if difference(before, &shot) > CHANGED {
                return (shot, pose);
            }
            assert!(Instant::now() < patience, "the picture stays as it was");
        }
    }

    /// Opens the volume whose name begins with a letter from the start page. The page and its list take their time.
    fn open_file(&mut self, letter: &str) {
        let patience = Instant::now() + Duration::from_secs(120);
        while self.viewer.refreshes().is_empty() {
            assert!(Instant::now() < patience, "the file does not open");
            self.screen.click(self.window, CHOOSE_FILE[0], CHOOSE_FILE[1]);
            self.screen.click(self.window, LIST[0], LIST[1]);
            self.key(letter);
            self.key("Enter");
            std::thread::sleep(Duration::from_millis(700));
        }
    }

    fn key(&self, chord: &str) {
        self.screen.key(self.window, chord);
    }

    fn drag(&self, from: [i16; 2], by: [i16; 2]) {
        self.screen.point_at(self.window, from[0], from[1]);
        self.screen.press(true);
        for part in 1..=4 {
            self.screen.point_at(self.window, from[0] + by[0] * part / 4, from[1] + by[1] * part / 4);
            std::thread::sleep(Duration::from_millis(30));
        }
        self.screen.press(false);
    }

    fn paste(&self, text: &str) {
        self.screen.hand_over(text, || self.key("ctrl+v"));
    }
}

#[test]
fn ten_tasks_of_a_new_user() {
    if !has_window() {
        return;
    }
    let bench = Bench::new();
    bench.write("ball.nrrd", ball());
    let screen = Screen::open();

    // 1. Open a file.
    let mut desk = Desk::open(&bench, &screen, "view --backend cpu");
    desk.open_file("b");
    let (first, at_first) = desk.rest();

    // 2. Turn it.
    desk.drag(START, [80, 0]);
    let (turned, at_turned) = desk.rest_unlike(&first);
    let degrees = at_first.world_from_view.angle_between(at_turned.world_from_view).to_degrees();
    assert!((10.0..60.0).contains(&degrees), "{degrees}");

    // 3. Slices beside it.
    desk.key("x");
    let (slices, _) = desk.rest_unlike(&turned);
    desk.key("x");
    desk.rest_unlike(&slices);

    // 4. Measure between two points of the ball.
    desk.key("d");
    for [x, y] in [[420, 320], [480, 330]] {
        screen.click(desk.window, x, y);
    }
    desk.rest();
    desk.key("d");
    desk.rest();

    // 5. A better picture: another mode.
    desk.key("m");
    let (mip, _) = desk.rest_unlike(&turned);

    // 6. Clip.
    desk.key("c");
    desk.rest();
    desk.drag(TOP_HANDLE, [0, 120]);
    let (clipped, _) = desk.rest_unlike(&mip);

    // 7. Save what is seen.
    desk.key("ctrl+s");
    let saved = wait_for(&bench, "ball.nrrd.state.toml");
    let state: SavedState = read_state(&saved).unwrap().state;
    assert_eq!(state.look.as_ref().unwrap().mode, Mode::Mip);
    let clip = state.look.as_ref().unwrap().clip.bounds.unwrap();
    assert!(clip.max.y < 10.0 && clip.min.y == -16.0, "{clip:?}");

    let measures = state.measures.unwrap();
    let [a, b] = measures[0].points[..] else { panic!("{measures:?}") };
    let distance = glam::Vec3::from(a).distance(b.into());
    assert!((1.0..24.0).contains(&distance), "{distance}");

    // 8. A picture of it as a file.
    desk.key("F12");
    let picture = wait_for(&bench, ".png");
    bench.ok("render --state ball.nrrd.state.toml -o full.png --backend cpu");
    let [picture, full] = [picture, bench.path("full.png")].map(|path| image::open(path).unwrap().to_rgb8());
    assert_eq!(picture.dimensions(), full.dimensions());
    let largest = picture.iter().zip(full.iter()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(largest <= Some(1), "{largest:?}");
    drop(desk);

    // 9. Open it again.
    let mut desk = Desk::open(&bench, &screen, "view --state ball.nrrd.state.toml --backend cpu");
    let (_, at_again) = desk.rest();
    assert!(is_same(&at_again, &at_turned), "{at_again:?}, {at_turned:?}");
    // The measurements of the state bring their bar, which takes a part of the window.
    desk.key("d");
    desk.rest();
    // The picture is painted once the display's pipelines are compiled. It is the same but for handles and hints.
    desk.viewer.wait("picture of the state", |_| {
        std::thread::sleep(Duration::from_millis(200));
        let again = screen.shot(desk.window, SIZE);
        (difference(&again, &clipped) < 0.6 * difference(&again, &first)).then_some(())
    });
    drop(desk);

    // 10. Connect again to a server that died and was started anew.
    let (server, link) = serve(&bench, "ball.nrrd");
    let mut desk = Desk::open(&bench, &screen, &format!("view {link}"));
    desk.rest();
    desk.drag(START, [0, 40]);
    let (_, before) = desk.rest();
    drop(server);
    desk.viewer.wait("word of the dead server", |all| all.last().filter(|r| r.is_offline).map(drop));
    let (_server, link) = serve(&bench, "ball.nrrd");
    desk.num_before = desk.viewer.refreshes().len();
    desk.paste(&link.to_string());
    let (_, after) = desk.rest();
    assert!(is_same(&before, &after), "{before:?}, {after:?}");
}

/// The file in the folder whose name ends so, once it is there.
fn wait_for(bench: &Bench, ending: &str) -> PathBuf {
    let patience = Instant::now() + Duration::from_secs(120);
    loop {
        if let Some(name) = bench.files().iter().find(|name| name.ends_with(ending) && !name.starts_with('.'))
        {
            return bench.path(name);
        }
        assert!(Instant::now() < patience, "no file {ending} in {:?}", bench.files());
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A ball of 200 with a kernel of 90, off its centre, in a NRRD file.
fn ball() -> Vec<u8> {
    let side = 32;
    let mut bytes =
        format!("NRRD0004\ntype: uchar\ndimension: 3\nsizes: {side} {side} {side}\nencoding: raw\n\n")
            .into_bytes();
    for (z, y, x) in (0..side).flat_map(|z| (0..side).flat_map(move |y| (0..side).map(move |x| (z, y, x)))) {
        let distance2 = |cx: i32, cy: i32, cz: i32| (x - cx).pow(2) + (y - cy).pow(2) + (z - cz).pow(2);
        let value = match () {
            () if distance2(20, 18, 12) < 25 => 90,
            () if distance2(16, 16, 16) < 144 => 200,
            () => 0,
        };
        bytes.push(value);
    }
    bytes
}

/// Mean difference of two pictures, 0 to 255.
fn difference(a: &Shot, b: &Shot) -> f64 {
    let sum: u64 = a.rgb.iter().zip(&b.rgb).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / a.rgb.len() as f64
}

fn is_same(a: &Pose, b: &Pose) -> bool {
    a.world_from_view.angle_between(b.world_from_view) < 1e-3
        && (a.eye - b.eye).length() < 1e-3 * a.eye.length()
}

/// Columns and rows of the window.
const SIZE: [u16; 2] = [900, 640];
/// Where the hand takes the volume.
const START: [i16; 2] = [400, 330];
/// The button of the start page, and the empty part of the list that it opens.
const CHOOSE_FILE: [i16; 2] = [100, 136];
const LIST: [i16; 2] = [400, 480];
/// The clip handle at the top after the turn.
const TOP_HANDLE: [i16; 2] = [474, 168];
/// Exact refreshes in a row that make a rest.
const CALM: usize = 4;
/// Mean difference of pictures that show different things.
const CHANGED: f64 = 0.5;
