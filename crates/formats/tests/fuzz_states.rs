//! Do damaged states and links of states give a state or one line, in bounded memory?

#[path = "../../core/tests/common/fuzzing.rs"]
mod fuzzing;

use std::path::Path;
use std::sync::atomic::Ordering::Relaxed;

use fuzzing::{ALLOCATED, MOST, Random};
use isinglass_core::look::Look;
use isinglass_formats::{
    SavedCamera, SavedState, SavedVolume, preset, preset_names, state_from_bytes, state_from_link,
    state_to_link,
};

fn seeds() -> Vec<SavedState> {
    let state = |name| {
        let transfer = preset(name).expect("a preset");
        let camera = SavedCamera {
            center: [0.0; 3],
            rotation: [0.0, 0.0, 0.0, 1.0],
            eye_from_center: [0.1, 0.2, 3.0],
            fov_degrees: 40.0,
            size: [640, 480],
        };
        let volume = SavedVolume { name: name.into(), dims: [1, 2, 3], ..SavedVolume::default() };
        SavedState {
            volume: Some(volume),
            camera: Some(camera),
            look: Some(Look::new(transfer)),
            ..Default::default()
        }
    };
    preset_names().map(state).collect()
}

fn mutate(bytes: &mut Vec<u8>, random: &mut Random) {
    const WORDS: [&str; 14] = [
        "nan",
        "inf",
        "-1",
        "1e999",
        "99999999999999999999",
        "\"",
        "[[look]]\n",
        "[",
        "{",
        "= ",
        "\n",
        "é",
        "isinglass_state = 1\n",
        "a.b.c.d = 1\n",
    ];
    for _ in 0..1 + random.below(4) {
        let at = random.below(bytes.len().max(1)).min(bytes.len());
        let end = (at + random.below(40)).min(bytes.len());
        match random.below(7) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
            1 => drop(bytes.drain(at..end)),
            2 => bytes.truncate(at),
            3 => {
                let again = bytes[at..end].to_vec();
                drop(bytes.splice(at..at, again));
            }
            // As deep as it goes.
            4 => drop(bytes.splice(at..at, "[".repeat(1 + random.below(3000)).into_bytes())),
            _ => drop(bytes.splice(at..end.min(at + random.below(4)), random.of(&WORDS).bytes())),
        }
    }
}

fn check<E: std::fmt::Display>(read: Result<(), E>, state: u64) -> bool {
    read.map_err(|e| {
        let message = e.to_string();
        assert!(!message.contains(char::is_control) && message.len() < 2000, "{message:?}, state {state:#x}");
    })
    .is_ok()
}

#[test]
fn damage_gives_a_state_or_one_line() {
    let seeds = seeds();
    let mut random = Random(11);
    let (mut opened, mut largest) = (0, 0);
    for _ in 0..INPUTS {
        let before = random.0;
        let seed = &seeds[random.below(seeds.len())];
        let allocated = ALLOCATED.load(Relaxed);
        MOST.store(allocated, Relaxed);
        let is_open = if random.below(3) == 0 {
            let mut link = state_to_link(seed).into_bytes();
            mutate(&mut link, &mut random);
            let link = String::from_utf8_lossy(&link);
            check(state_from_link(&link).map(drop), before)
        } else {
            let mut bytes = seed.to_toml().into_bytes();
            mutate(&mut bytes, &mut random);
            let read = state_from_bytes(&bytes, Path::new("a.toml"));
            if let Ok(read) = &read {
                // What was understood is written and understood again.
                let again = state_from_bytes(read.state.to_toml().as_bytes(), Path::new("b.toml"));
                assert_eq!(
                    again.map(|r| r.state).map_err(|e| e.to_string()),
                    Ok(read.state.clone()),
                    "{before:#x}"
                );
            }
            check(read.map(drop), before)
        };
        opened += u32::from(is_open);
        let used = MOST.load(Relaxed) - allocated;
        assert!(used < MOST_BYTES, "{used} bytes, state {before:#x}");
        largest = largest.max(used);
    }
    eprintln!("{INPUTS} inputs, {opened} opened, at most {largest} bytes");
    assert!(opened > 0 && opened < INPUTS, "{opened}");
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

const INPUTS: u32 = 3000;
/// Text, its tables and their copies, of a megabyte at most; most inputs take a hundredth of it.
const MOST_BYTES: usize = 64 << 20;
