//! Does a saved state give the same picture again, from the command line?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use glam::{Quat, Vec3};
use isinglass_client::camera_controls::{CameraControls, InitialOrbit};
use isinglass_core::camera::Intrinsics;
use isinglass_core::look::Look;
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::{
    Dtype, Endian, RawShape, SavedCamera, SavedState, SavedView, SavedVolume, Srgb, VolumeSource, preset,
    state_to_link,
};

use common::{Bench, Running, assert_failed, has_display};

const VOLUME: &str = "builtin:cubus@32";
const FLAGS: &str = "--orbit 25,-15,3 --size 64x48 --fov 35 --tf shells --shading off --backend cpu";

/// What [`FLAGS`] say, with a background.
fn state() -> SavedState {
    let volume = Builtin::Cubus.volume(32);
    let orbit =
        InitialOrbit { azimuth_degrees: 25.0, elevation_degrees: -15.0, distance_in_radii: Some(3.0) };
    let intrinsics = Intrinsics::perspective(64, 48, 35f32.to_radians());
    let controls = CameraControls::new(orbit, Quat::IDENTITY, &volume.bounds(), &intrinsics);
    let (lo, hi) = volume.value_range();
    let saved = SavedVolume {
        name: "cubus".into(),
        source: Some(VOLUME.into()),
        dims: volume.dims(),
        spacing: volume.spacing().to_array(),
        range: [lo, hi],
        ..SavedVolume::default()
    };
    let look = Look { shaded: false, k: 5, ..Look::new(preset("shells").unwrap()) };
    SavedState {
        volume: Some(saved),
        camera: Some(SavedCamera::of(controls.center(), controls.placement(), intrinsics)),
        view: SavedView { background: Some(Srgb([32, 64, 96])), ..SavedView::default() },
        look: Some(look),
        ..SavedState::default()
    }
}

fn bytes(bench: &Bench, name: &str) -> Vec<u8> {
    std::fs::read(bench.path(name)).unwrap()
}

#[test]
fn a_state_renders_to_the_byte_what_its_flags_would() {
    let bench = Bench::new();
    bench.write("seen.toml", state().to_toml());
    bench.ok(&format!("render {VOLUME} {FLAGS} --background #204060 -o flags.png"));
    let flags = bytes(&bench, "flags.png");
    let link = format!("isinglass://h:1/#cert=sha256:{}&state={}", "ab".repeat(32), state_to_link(&state()));
    for from in ["seen.toml", &link] {
        bench.ok(&format!("render --state {from} --backend cpu -o state.png"));
        assert!(bytes(&bench, "state.png") == flags, "{from}");
    }
    // Controls, and flags that hold against the state.
    for more in [
        "--orbit 26,-15,3",
        "--fov 36",
        "--tf ct",
        "--shading on",
        "--background #000000",
        "builtin:cubus@31",
    ] {
        let volume = if more.starts_with("builtin") { "" } else { VOLUME };
        bench.ok(&format!("render {volume} --state seen.toml {more} --backend cpu -o other.png"));
        assert!(bytes(&bench, "other.png") != flags, "{more}");
    }
    bench.ok("render --state seen.toml --size 32x24 --backend cpu -o small.png");
    let facts = bench.json("render --state seen.toml --size 32x24 --backend cpu -o small.png --json");
    assert_eq!(facts["size"], serde_json::json!([32, 24]));
}

#[test]
fn a_state_makes_the_layered_frame_that_its_flags_would() {
    let bench = Bench::new();
    bench.write("seen.toml", state().to_toml());
    bench.ok(&format!("layers {VOLUME} {FLAGS} --k 5 -o flags.iglf"));
    bench.ok("layers --state seen.toml --backend cpu -o state.iglf");
    assert!(bytes(&bench, "flags.iglf") == bytes(&bench, "state.iglf"));
    bench.ok("layers --state seen.toml --k 6 --backend cpu -o other.iglf");
    assert!(bytes(&bench, "flags.iglf") != bytes(&bench, "other.iglf"), "a flag holds");
}

#[test]
fn another_volume_and_unknown_keys_are_told_and_mistakes_are_one_line() {
    let bench = Bench::new();
    bench.write("seen.toml", state().to_toml() + "fog = 1\n");
    let line = "render builtin:cubus@24 --state seen.toml --backend cpu -o a.png";
    let output = bench.run(line);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && told.contains("32×32×32") && told.contains("24×24×24"), "{told}");
    assert!(told.contains("left out: \"volume.fog\""), "{told}");
    bench.write("bad.toml", state().to_toml().replace("k = 5", "k = 500"));
    bench.write("nowhere.toml", "isinglass_state = 1\n");
    std::fs::remove_file(bench.path("a.png")).unwrap();
    for (line, code, words) in [
        ("render --state bad.toml -o a.png", 1, &["bad.toml", "look"][..]),
        ("render --state absent.toml -o a.png", 1, &["absent.toml"]),
        ("render --state nowhere.toml -o a.png", 1, &["expected VOLUME"]),
        ("render --state isinglass://h:1/#state=AAAA -o a.png", 1, &["the link's state"]),
        ("render --state isinglass://h:1/#cert=sha256:00 -o a.png", 1, &["link"]),
        ("render -o a.png", 2, &["VOLUME"]),
        ("view isinglass://h:1/#state=AAAA", 2, &["a link of their own"]),
    ] {
        assert_failed(line, &bench.run(line), code, words);
    }
}

#[test]
fn a_state_of_a_raw_file_brings_what_the_file_does_not_say_and_flags_hold() {
    let bench = Bench::new();
    // The first time of the film.
    let offset = 100;
    let voxels = film().split_off(film().len() - 3 * 16 * 16 * 16);
    let scan = bench.write("scan.raw", [vec![0xff; 100], voxels].concat());
    let raw =
        RawShape { dims: [16; 3], dtype: Dtype::Uint8, spacing: Vec3::ONE, endian: Endian::Little, offset };
    let given = VolumeSource {
        raw: Some(raw),
        spacing: Some(Vec3::new(1.0, 1.0, 2.0)),
        ..VolumeSource::new(scan.to_str().unwrap())
    };
    let state = third_time("");
    let volume = SavedVolume { time: None, dims: [16; 3], ..state.volume.clone().unwrap() };
    let state_of = |source: &VolumeSource| SavedState {
        volume: Some(volume.clone().opened_from(source)),
        ..state.clone()
    };
    bench.write("seen.toml", state_of(&given).to_toml());
    let shape = format!("--dims 16,16,16 --dtype uint8 --offset {offset}");
    let render = |what: &str, name: &str| {
        bench.ok(&format!("render {what} --state seen.toml --backend cpu -o {name}"));
        bytes(&bench, name)
    };
    let flags = render(&format!("{} {shape} --spacing 1,1,2", scan.display()), "flags.png");
    assert!(render("", "state.png") == flags);
    // The controls: flags that read it otherwise hold, and without its shape it says nothing of itself.
    assert!(render("--spacing 1,1,1", "other.png") != flags);
    assert!(render("--dims 16,16,8 --dtype uint8", "other.png") != flags);
    bench.write("bare.toml", state_of(&VolumeSource::new(scan.to_str().unwrap())).to_toml());
    assert_failed("bare", &bench.run("render --state bare.toml -o a.png"), 1, &["scan.raw"]);
}

/// A film of three times: a ball that moves, in NRRD.
fn film() -> Vec<u8> {
    const SIDE: usize = 16;
    let header = "NRRD0004\ntype: uchar\ndimension: 4\nsizes: 16 16 16 3\nspacings: 1 1 1 nan\n\
                  kinds: domain domain domain time\nencoding: raw\n\n";
    let voxels = (0..3 * SIDE.pow(3)).map(|i| {
        let (time, i) = (i / SIDE.pow(3), i % SIDE.pow(3));
        let [x, y, z] = [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE].map(|n| n as f32 - 7.5);
        let distance = ((x - 4.0 * time as f32 + 4.0).powi(2) + y * y + z * z).sqrt();
        (255.0 - 40.0 * distance).max(0.0) as u8
    });
    header.bytes().chain(voxels).collect()
}

/// The third time of a film at `source`.
fn third_time(source: &str) -> SavedState {
    let camera = SavedCamera::of(
        Vec3::ZERO,
        (Quat::from_rotation_y(0.4), Vec3::new(0.0, 0.0, 40.0)),
        Intrinsics::perspective(64, 48, 0.8),
    );
    let volume = SavedVolume {
        name: "film.nrrd".into(),
        source: Some(source.into()),
        time: Some(2),
        dims: [16; 3],
        spacing: [1.0; 3],
        range: [0.0, 235.0],
        ..SavedVolume::default()
    };
    SavedState { volume: Some(volume), camera: Some(camera), look: state().look, ..SavedState::default() }
}

#[test]
fn a_state_names_its_part_and_finds_its_file_where_both_were_moved() {
    let bench = Bench::new();
    bench.write("film.nrrd", film());
    bench.write("seen.toml", third_time("/not/there/any/more/film.nrrd").to_toml());
    bench.ok("render --state seen.toml --backend cpu -o state.png");
    let mut first = third_time("film.nrrd");
    first.volume.as_mut().unwrap().time = None;
    bench.write("first.toml", first.to_toml());
    bench.ok("render film.nrrd --time 2 --state first.toml --backend cpu -o flags.png");
    assert!(bytes(&bench, "state.png") == bytes(&bench, "flags.png"));
    // The control: the time counts.
    bench.ok("render --state first.toml --backend cpu -o first.png");
    assert!(bytes(&bench, "state.png") != bytes(&bench, "first.png"));

    let mut far = third_time("film.nrrd");
    let volume = far.volume.as_mut().unwrap();
    (volume.source, volume.server) = (None, Some("render-01:4433".into()));
    bench.write("far.toml", far.to_toml());
    bench.fails("render --state far.toml -o a.png", 1, &["render-01:4433", "expected VOLUME"]);
    bench.write("link.toml", third_time("isinglass://h:1/#cert=sha256:00").to_toml());
    bench.fails("view --state link.toml", 1, &["the link of the state's volume"]);
}

/// Without a link: `view` opens what the state names, by a server in the same process, and remembers it; a file that is not
/// there is named, and the window stays.
#[test]
fn view_opens_the_volume_of_a_state() {
    if !has_display() {
        return;
    }
    let bench = Bench::new();
    bench.write("film.nrrd", film());
    bench.write("seen.toml", third_time("film.nrrd").to_toml());
    bench.write("missing.toml", third_time("/nowhere/none.nrrd").to_toml());
    let view = |what: &str| {
        let mut command = bench.command(&format!("view {what} --backend cpu"));
        command.env("DISPLAY", std::env::var_os("DISPLAY").unwrap_or_default());
        command.env("XDG_STATE_HOME", bench.path("remembered")).env("RUST_LOG", "warn");
        let log = std::fs::File::create(bench.path("log")).unwrap();
        Running(command.stdout(std::process::Stdio::null()).stderr(log).spawn().unwrap())
    };
    let until = |viewer: &mut Running, file: &str, words: &[&str]| {
        let patience = std::time::Instant::now() + std::time::Duration::from_secs(120);
        loop {
            let text = std::fs::read_to_string(bench.path(file)).unwrap_or_default();
            if words.iter().all(|word| text.contains(word)) {
                return;
            }
            let ended = viewer.0.try_wait().unwrap();
            assert!(
                ended.is_none(),
                "the window is closed: {}",
                std::fs::read_to_string(bench.path("log")).unwrap()
            );
            assert!(std::time::Instant::now() < patience, "{words:?} in {file}: {text}");
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
    };
    let mut viewer = view("--state seen.toml");
    until(&mut viewer, "remembered/isinglass/recent.toml", &["film.nrrd", "time = 2"]);
    drop(viewer);
    // The link that a window copies of a volume of this machine.
    std::fs::remove_file(bench.path("remembered/isinglass/recent.toml")).unwrap();
    let link = format!("isinglass://127.0.0.1:1/#cert=sha256:{}&state=", "ab".repeat(32));
    let link = link + &state_to_link(&third_time("film.nrrd"));
    let mut viewer = view(&link);
    until(&mut viewer, "remembered/isinglass/recent.toml", &["film.nrrd", "time = 2"]);
    drop(viewer);
    let mut viewer = view("--state missing.toml");
    until(&mut viewer, "log", &["/nowhere/none.nrrd"]);
    assert!(viewer.0.try_wait().unwrap().is_none(), "the page stays");
}
