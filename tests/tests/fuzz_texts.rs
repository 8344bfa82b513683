//! Can any text that a person is sent make a parser do more than fail?
//!
//! States, links, settings with their bindings, and presets of all programs are damaged by a seeded generator: bits, words at
//! their limits, cuts, repeats, depth without end, parts of others. Each gives what it may, which is then written and read
//! again to the same, or one line, in bounded memory.

#[path = "../../crates/core/tests/common/fuzzing.rs"]
mod fuzzing;

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use fuzzing::{ALLOCATED, MOST, Random};
use glam::Vec3;
use isinglass_client::Bindings;
use isinglass_core::look::Look;
use isinglass_core::transfer::{Domain, TransferFunction, UnitLength};
use isinglass_formats::{
    Dtype, Endian, RawShape, Recent, RecentEntry, RecentPlace, SavedCamera, SavedState, SavedVolume,
    Selection, SettingValue, VolumeSource, import_transfers, preset, preset_names, settings_from_toml,
    state_from_bytes, state_from_link, state_to_link, transfer_from_toml, transfer_to_toml,
};
use isinglass_net::{Link, LinkError, state_of_link};

/// One parser at a time, so that what is allocated is its own.
static ONE: Mutex<()> = Mutex::new(());

/// A parser and texts that it takes.
trait Target {
    fn seeds() -> Vec<Vec<u8>>;

    /// Reads it, and holds what was read to its promises; or one line.
    fn read(bytes: &[u8], file: &Path) -> Result<(), String>;
}

const RAW: RawShape =
    RawShape { dims: [1, 2, 3], dtype: Dtype::Half, spacing: Vec3::ONE, endian: Endian::Big, offset: 512 };

fn states() -> Vec<SavedState> {
    let state = |name: &str| {
        let camera = SavedCamera {
            center: [0.0; 3],
            rotation: [0.0, 0.0, 0.0, 1.0],
            eye_from_center: [0.1, 0.2, 3.0],
            fov_degrees: 40.0,
            size: [640, 480],
        };
        let volume = SavedVolume {
            name: name.into(),
            source: Some("/data/a b/head.nrrd".into()),
            channel: Some(2),
            region: Some("0:5,1:,:".into()),
            given_spacing: (name == "ct").then_some([0.1, 0.2, 3.0]),
            raw: (name == "ct").then_some(RAW),
            dims: [1, 2, 3],
            ..SavedVolume::default()
        };
        SavedState {
            volume: Some(volume),
            camera: Some(camera),
            look: Some(Look::new(preset(name).expect("a preset"))),
            ..Default::default()
        }
    };
    preset_names().map(state).collect()
}

struct States;

impl Target for States {
    fn seeds() -> Vec<Vec<u8>> {
        states().iter().map(|state| state.to_toml().into_bytes()).collect()
    }

    fn read(bytes: &[u8], file: &Path) -> Result<(), String> {
        let state = state_from_bytes(bytes, file).map_err(|e| e.to_string())?.state;
        // What was understood is written and understood again.
        let again = state_from_bytes(state.to_toml().as_bytes(), file).map(|read| read.state);
        assert_eq!(again.map_err(|e| e.to_string()), Ok(state));
        Ok(())
    }
}

struct StateLinks;

impl Target for StateLinks {
    fn seeds() -> Vec<Vec<u8>> {
        states().iter().map(|state| state_to_link(state).into_bytes()).collect()
    }

    fn read(bytes: &[u8], _: &Path) -> Result<(), String> {
        let state = state_from_link(&String::from_utf8_lossy(bytes)).map_err(|e| e.to_string())?.state;
        let again = state_from_link(&state_to_link(&state)).map(|read| read.state);
        assert_eq!(again.map_err(|e| e.to_string()), Ok(state));
        Ok(())
    }
}

struct Links;

impl Target for Links {
    fn seeds() -> Vec<Vec<u8>> {
        let (token, cert) = ("00112233445566778899aabbccddeeff", "ab".repeat(32));
        let state = state_to_link(&SavedState::default());
        let link = |host: &str, more: &str| {
            format!("isinglass://{host}:4433/#token={token}&cert=sha256:{cert}{more}").into_bytes()
        };
        let shown = format!("isinglass://far:1/#cert=sha256:{cert}&state={state}").into_bytes();
        vec![
            link("127.0.0.1", ""),
            link("[fe80::1%eth0]", ""),
            link("a.b-c.org", &format!("&state={state}")),
            shown,
        ]
    }

    fn read(bytes: &[u8], _: &Path) -> Result<(), String> {
        let text = String::from_utf8_lossy(bytes);
        if let Ok(state) = state_of_link(&text) {
            let _ = state_from_link(&state);
        }
        let link: Link = match text.parse() {
            // It shows a state and lets nobody in.
            Err(LinkError::StateOnly) => return Ok(()),
            read => read.map_err(|e| e.to_string())?,
        };
        let again: Link = link.to_string().parse().map_err(|e| format!("{e}"))?;
        assert_eq!(again.to_string(), link.to_string());
        Ok(())
    }
}

struct Settings;

impl Target for Settings {
    fn seeds() -> Vec<Vec<u8>> {
        let bindings: String = Bindings::names()
            .map(|name| format!("{name} = {:?}\n", Bindings::default().chords(name)))
            .collect();
        let some =
            "[look]\nk = 12 # twelve\ntf = \"a b\"\n\n[window]\nfov=35.5\nbox = true\nlist = [\"a\", 2]\n";
        let [server, viewer] = ["server", "viewer"].map(|name| {
            let path = format!("{}/../configs/{name}.toml", env!("CARGO_MANIFEST_DIR"));
            // As somebody would who wants it all.
            let text = std::fs::read_to_string(path).expect("an example");
            text.lines()
                .map(|line| line.strip_prefix("# ").unwrap_or(line).to_owned() + "\n")
                .collect::<String>()
        });
        [format!("[bindings]\n{bindings}"), some.into(), server, viewer].map(String::into_bytes).into()
    }

    fn read(bytes: &[u8], file: &Path) -> Result<(), String> {
        let text = std::str::from_utf8(bytes).map_err(|_| "no text".to_owned())?;
        let mut bindings = Bindings::default();
        for setting in settings_from_toml(text, file).map_err(|e| e.to_string())? {
            let again = format!("[a]\nb = {}", setting.value.literal());
            let again = settings_from_toml(&again, file).map_err(|e| e.to_string())?;
            assert_eq!(again[0].value, setting.value, "{}", setting.value.literal());
            let chords = match setting.value {
                SettingValue::Text(text) => vec![text],
                SettingValue::List(list) => list,
            };
            bindings.set(&setting.key, &chords).map_err(|e| e.to_string())?;
            let shown = bindings.chords(&setting.key);
            let mut again = bindings.clone();
            again.set(&setting.key, &shown).map_err(|e| format!("{e} in {shown:?}"))?;
            assert_eq!(again.chords(&setting.key), shown);
        }
        bindings.check().map_err(|e| e.to_string())
    }
}

struct OwnPresets;

impl Target for OwnPresets {
    fn seeds() -> Vec<Vec<u8>> {
        let files =
            std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/presets")).expect("presets");
        let mut texts: Vec<_> =
            files.map(|file| std::fs::read(file.expect("a file").path()).expect("a text")).collect();
        texts.sort();
        texts.extend(preset_names().map(|name| transfer_to_toml(&preset(name).expect("it")).into_bytes()));
        texts
    }

    fn read(bytes: &[u8], file: &Path) -> Result<(), String> {
        let text = String::from_utf8_lossy(bytes);
        let transfer = transfer_from_toml(&text, "a.toml").map_err(|e| e.to_string())?;
        assert_eq!(transfer.validate(), Ok(()));
        let again = transfer_from_toml(&transfer_to_toml(&transfer), "a.toml").map_err(|e| e.to_string());
        assert_eq!(again, Ok(transfer));
        import(bytes, file)
    }
}

/// The presets in a file, each put onto a curve.
fn import(bytes: &[u8], file: &Path) -> Result<(), String> {
    std::fs::write(file, bytes).expect("a folder of our own");
    let ramp = TransferFunction {
        domain: Domain::Percentiles(1.0, 99.0),
        unit_length: UnitLength::Radius(0.5),
        ..preset("smooth").expect("a preset")
    };
    for found in import_transfers(file).map_err(|e| e.to_string())? {
        assert_eq!(found.onto(&ramp).validate(), Ok(()), "{}", found.name());
    }
    Ok(())
}

struct ParaviewJson;

impl Target for ParaviewJson {
    fn seeds() -> Vec<Vec<u8>> {
        vec![br#"[ // two maps and one for categories
            {"ColorSpace": "Diverging", "Name": "Cool", "NanColor": [1, 1, 0],
             "RGBPoints": [-1, 0.23137254902, 0.298039215686, 0.752941176471, 0, 0.865, 0.865, 0.865, 1, 0.70, 0.015, 0.15,],},
            {"Name": "Lab", "ColorSpace": "Lab", "RGBPoints": [0, 0, 0, 0, 1e3, 1, 0.5, 0.25], "Creator": "\u00e9\n"},
            {"Name": "HSV", "ColorSpace": "HSV", "RGBPoints": [0, 0, 0, 1, 5, 1, 0, 0]},
            {"Name": "Step", "ColorSpace": "Step", "RGBPoints": [10, 1, 0, 0, 20, 0, 1, 0], "Points": [10, 0, 0.5, 0, 20, 1, 0.5, NaN]},
            {"Name": "Set", "IndexedColors": [1, 0, 0], "Annotations": ["0", "a"]},
        ]"#.to_vec()]
    }

    fn read(bytes: &[u8], file: &Path) -> Result<(), String> {
        import(bytes, file)
    }
}

struct SlicerXml;

impl Target for SlicerXml {
    fn seeds() -> Vec<Vec<u8>> {
        vec![br#"<?xml version="1.0"?><!-- <VolumeProperty name="not this"/> -->
            <SlicerVolumeRenderingPresets version="2">
            <VolumeProperty id="v1" name="CT &amp; bone" interpolation="1" shade="1" ambient="0.2"
                scalarOpacity="8 -1000 0 150 0 300 0.5 3000 0.9" gradientOpacity="4 0 1 255 1"
                colorTransfer="12 -1000 0 0 0 300 0.8 0.4 0.2 3000 1 1 1" effectiveRange="150 3000"/>
            <VolumeProperty name='air' scalarOpacity="4 -250.0.0 0 100 1" colorTransfer="8 -1000 1 0 0 100 0 0 1" shade="0"></VolumeProperty>
            <VolumeProperty name="empty" scalarOpacity="0" colorTransfer="0"/>
            </SlicerVolumeRenderingPresets>"#.to_vec()]
    }

    fn read(bytes: &[u8], file: &Path) -> Result<(), String> {
        import(bytes, file)
    }
}

struct SlicerVpJson;

impl Target for SlicerVpJson {
    fn seeds() -> Vec<Vec<u8>> {
        vec![br#"{"@schema": "volume-property-schema-v1.0.0.json#", "volumeProperties": [{
            "effectiveRange": [0.0, 200.0], "components": [{"shade": true, "scalarOpacityUnitDistance": 0.5,
            "rgbTransferFunction": {"type": "colorTransferFunction", "points": [
                {"x": 0.0, "color": [0.0, 0.0, 0.0], "midpoint": 0.5, "sharpness": 0.0},
                {"x": 200.0, "color": [1.0, 0.5, 0.25], "midpoint": 0.5, "sharpness": 0.0}]},
            "scalarOpacity": {"points": [{"x": 0, "y": 0}, {"x": 100, "y": "0.2.1"}, {"x": 200, "y": 0.8}]}}]}]}"#
            .to_vec()]
    }

    fn read(bytes: &[u8], file: &Path) -> Result<(), String> {
        import(bytes, file)
    }
}

struct RecentLists;

impl Target for RecentLists {
    fn seeds() -> Vec<Vec<u8>> {
        let region = "1:5,:,7:".parse().ok();
        let selection = Selection { time: Some(3), region, ..Selection::default() };
        let places = [
            RecentPlace::Server { host: "::1".into(), port: 4433 },
            RecentPlace::Volume(VolumeSource { selection, ..VolumeSource::new("/data/a \"b\".nii") }),
            RecentPlace::Volume(VolumeSource {
                raw: Some(RAW),
                spacing: Some(Vec3::new(0.1, 0.2, 3.0)),
                ..VolumeSource::new("/data/scan.raw")
            }),
        ];
        let entries =
            places.map(|place| RecentEntry { place, shows: "head µ".into(), used_at: 1_700_000_000 });
        vec![Recent { folder: Some("/data".into()), entries: entries.into() }.to_toml().into_bytes()]
    }

    fn read(bytes: &[u8], file: &Path) -> Result<(), String> {
        std::fs::write(file, bytes).expect("a folder of our own");
        let list = Recent::read(file).map_err(|e| e.to_string())?;
        assert!(list.entries.len() <= Recent::MAX);
        std::fs::write(file, list.to_toml()).expect("a folder of our own");
        assert_eq!(Recent::read(file).map_err(|e| e.to_string()), Ok(list));
        Ok(())
    }
}

fn mutate(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    const WORDS: [&str; 26] = [
        "nan",
        "inf",
        "-1",
        "1e999",
        "-1e38",
        "1e-45",
        "99999999999999999999",
        "0",
        "\"",
        "'",
        "[[look]]\n",
        "[",
        "{",
        "}",
        "]",
        "= ",
        "=",
        "\n",
        "é",
        "\u{10ffff}",
        "<!--",
        "&amp;",
        "\\u0000",
        "isinglass_state = 1\n",
        "a.b.c.d = 1\n",
        "#",
    ];
    for _ in 0..1 + random.below(4) {
        let at = random.below(bytes.len().max(1)).min(bytes.len());
        let end = (at + random.below(40)).min(bytes.len());
        match random.below(9) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
            1 => drop(bytes.drain(at..end)),
            2 => bytes.truncate(at),
            3 => {
                let again = bytes[at..end].to_vec();
                drop(bytes.splice(at..at, again));
            }
            // As deep as it goes.
            4 => {
                let deep = random.of(&["[", "{\"a\":", "{a=", "<a>", "a."]);
                drop(bytes.splice(at..at, deep.repeat(1 + random.below(3000)).into_bytes()));
            }
            5 => {
                let from = random.below(other.len());
                let to = (from + random.below(80)).min(other.len());
                drop(bytes.splice(at..at, other[from..to].iter().copied()));
            }
            // A number becomes another.
            6 => {
                let digits: Vec<usize> = (0..bytes.len()).filter(|&i| bytes[i].is_ascii_digit()).collect();
                if !digits.is_empty() {
                    let start = digits[random.below(digits.len())];
                    let end =
                        (start..bytes.len()).find(|&i| !bytes[i].is_ascii_digit()).unwrap_or(bytes.len());
                    let number = random.of(&[
                        "0",
                        "1",
                        "7",
                        "256",
                        "65536",
                        "-5",
                        "1e308",
                        "3e38",
                        "18446744073709551616",
                        "",
                    ]);
                    drop(bytes.splice(start..end, number.bytes()));
                }
            }
            _ => drop(bytes.splice(at..end.min(at + random.below(4)), random.of(&WORDS).bytes())),
        }
    }
}

/// Runs for so long or so many inputs: inputs, and those of them that could be read.
fn fuzz<T: Target>(name: &str, duration: Duration, most: u64, seed: u64) -> (u64, u64) {
    let _one = ONE.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::TempDir::new().expect("a folder");
    // A name of each kind, as some are told apart by it.
    let files = ["a.toml", "a.json", "a.xml", "a.vp.json"].map(|name| folder.path().join(name));
    let seeds = T::seeds();
    for seed in &seeds {
        // But for examples whose settings are of other kinds than bindings.
        if !name.starts_with("settings") {
            T::read(seed, &files[0]).unwrap_or_else(|e| panic!("{name}: a seed is refused: {e}"));
        }
    }
    let mut random = Random(seed);
    let start = Instant::now();
    let (mut inputs, mut opened, mut slowest, mut largest) = (0, 0, Duration::ZERO, 0);
    while inputs < most && start.elapsed() < duration {
        let state = random.0;
        let mut bytes = seeds[random.below(seeds.len())].clone();
        let other = &seeds[random.below(seeds.len())];
        mutate(&mut bytes, other, &mut random);
        let file = &files[random.below(files.len())];
        let allocated = ALLOCATED.load(Relaxed);
        MOST.store(allocated, Relaxed);
        let begin = Instant::now();
        let read = std::panic::catch_unwind(|| T::read(&bytes, file));
        let took = begin.elapsed();
        let used = MOST.load(Relaxed) - allocated;
        let shown = || String::from_utf8_lossy(&bytes[..bytes.len().min(4000)]).into_owned();
        let read = read.unwrap_or_else(|_| panic!("{name}: state {state:#x} of\n{}", shown()));
        assert!(used < MOST_BYTES, "{name}: {used} bytes, state {state:#x} of\n{}", shown());
        // Texts of a few kilobytes take milliseconds; a machine under load may take many times as long.
        assert!(took < Duration::from_secs(30), "{name}: {took:?}, state {state:#x} of\n{}", shown());
        inputs += 1;
        (slowest, largest) = (slowest.max(took), largest.max(used));
        match read {
            Ok(()) => opened += 1,
            Err(message) => {
                let is_line = !message.contains(char::is_control) && message.len() < 2000;
                assert!(is_line, "{name}: {message:?}, state {state:#x}");
            }
        }
    }
    eprintln!("{name}: {inputs} inputs, {opened} read, slowest {slowest:?}, largest {largest} bytes");
    (inputs, opened)
}

fn some<T: Target>(name: &str) {
    let (inputs, opened) = fuzz::<T>(name, Duration::MAX, 1500, 11);
    // Damage that is never met, or nothing but damage, would test nothing.
    assert!(opened > 0 && opened < inputs, "{name}: {opened} of {inputs}");
}

/// `ISINGLASS_FUZZ_SECONDS`, 300 if it is not set, and `ISINGLASS_FUZZ_SEED`.
fn many<T: Target>(name: &str) {
    let number =
        |name: &str, otherwise| std::env::var(name).map_or(otherwise, |v| v.parse().expect("a number"));
    let duration = Duration::from_secs(number("ISINGLASS_FUZZ_SECONDS", 300));
    fuzz::<T>(name, duration, u64::MAX, number("ISINGLASS_FUZZ_SEED", 3));
}

macro_rules! targets {
    ($($name:ident: $target:ty),* $(,)?) => {$(
        mod $name {
            #[test]
            fn some_damage_finds_nothing() {
                super::some::<$target>(stringify!($name));
            }

            #[test]
            #[ignore = "runs for five minutes"]
            fn five_minutes_of_damage_find_nothing() {
                super::many::<$target>(stringify!($name));
            }
        }
    )*};
}

targets! {
    states_in_files: crate::States,
    states_in_links: crate::StateLinks,
    links: crate::Links,
    settings_and_bindings: crate::Settings,
    presets_toml: crate::OwnPresets,
    presets_paraview: crate::ParaviewJson,
    presets_slicer_xml: crate::SlicerXml,
    presets_slicer_vp_json: crate::SlicerVpJson,
    recent: crate::RecentLists,
}

/// A link may unpack to a thousand times its size, and is not let.
#[test]
fn a_link_that_unpacks_without_end_is_refused() {
    // A state of spaces: one mebibyte of them and more packs into a few kilobytes.
    let name = " ".repeat(3 << 20);
    let volume = SavedVolume { name, ..SavedVolume::default() };
    let link = state_to_link(&SavedState { volume: Some(volume), ..SavedState::default() });
    assert!(link.len() < 8 << 10, "{}", link.len());
    let problem = state_from_link(&link).expect_err("it is too large").to_string();
    assert!(problem.contains("more than 1 MiB"), "{problem}");
}

/// Text, its tables and their copies, of a megabyte at most; most inputs take a hundredth of it.
const MOST_BYTES: usize = 64 << 20;
