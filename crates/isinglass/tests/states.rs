//! Does a saved state give the same picture again, from the command line?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use glam::Quat;
use isinglass_client::camera_controls::{CameraControls, InitialOrbit};
use isinglass_core::camera::Intrinsics;
use isinglass_core::kernels::layering::Layering;
use isinglass_core::look::Look;
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::{SavedCamera, SavedState, SavedView, SavedVolume, Srgb, preset, state_to_link};

use common::{Bench, assert_failed};

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
    let look = Look {
        shaded: false,
        k: 5,
        layering: Layering::EqualTransmittance,
        ..Look::new(preset("shells").unwrap())
    };
    SavedState {
        volume: Some(saved),
        camera: Some(SavedCamera::of(controls.center(), controls.placement(), intrinsics)),
        view: SavedView { background: Some(Srgb([32, 64, 96])), ..SavedView::default() },
        look: Some(look),
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
    bench.ok(&format!("layers {VOLUME} {FLAGS} --layering equal-transmittance --k 5 -o flags.iglf"));
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
