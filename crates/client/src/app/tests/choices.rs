//! What the window remembers, and the light and legend that it begins with.

use isinglass_core::volume::Lighting;
use isinglass_core::wire::ServerStats;
use isinglass_formats::Remembered;

use super::*;
use crate::panels::light::usual_lighting;

fn remembering(file: &Path, choices: Remembered) -> Harness<'static, ViewerApp<HereSource>> {
    let options = WindowOptions {
        choices,
        choices_file: Some(file.to_owned()),
        frame_size: SMALL,
        ..WindowOptions::default()
    };
    window_with(options, fast(), [900.0, 700.0], 1.0)
}

/// A server that reports its times.
fn timed(generate_micros: u64) -> HereSource {
    let source = HereSource::new();
    let stats = ServerStats { frame: FrameId(1), generate_micros, ..ServerStats::default() };
    source.here().stats.server = stats;
    source
}

fn fast() -> HereSource {
    timed(10_000)
}

fn read(file: &Path) -> Result<Remembered, isinglass_formats::FormatError> {
    Remembered::read(file, |left_out| panic!("{left_out}"))
}

/// Waits for a file that holds what is expected. Threads write it.
fn wait_for(w: &mut Harness<'_, ViewerApp<HereSource>>, file: &Path, is_there: fn(&Remembered) -> bool) {
    for _ in 0..2000 {
        w.step();
        if read(file).is_ok_and(|read| is_there(&read)) {
            return;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    panic!("not written: {:?}", read(file));
}

#[test]
fn choices_are_kept_and_reset() {
    let folder = tempfile::TempDir::new().unwrap();
    let file = folder.path().join("inside").join("choices.toml");
    let mut w = remembering(&file, Remembered::default());
    // Ambient occlusion is on, but not in the first frame.
    let lighting = |w: &Harness<'_, ViewerApp<HereSource>>| w.state().viewing.source().here().look.1.lighting;
    assert_eq!(lighting(&w), usual_lighting());
    assert_eq!(w.state().viewing.source().here().num_looks, 1, "behind the first frame, and once");
    w.run_steps(80);
    assert!(!file.exists(), "nobody chose anything");
    press(&mut w, Modifiers::NONE, Key::B);
    press(&mut w, Modifiers::NONE, Key::L);
    let now = Duration::from_secs(1);
    let look = w.state().viewing.look().unwrap();
    let lighting_of = |ambient_occlusion| Lighting { ambient_occlusion, ..usual_lighting() };
    // A light that comes from elsewhere is no choice.
    w.state_mut().viewing.set_look(now, Look { lighting: lighting_of(0.75), ..(*look).clone() });
    rest(&mut w);
    wait_for(&mut w, &file, |read| read.view.shows_box.is_some());
    w.run_steps(80);
    assert_eq!(read(&file).unwrap().light, None);
    w.get_by_label("Light").scroll_to_me();
    rest(&mut w);
    w.get_by_label("Light").click();
    rest(&mut w);
    w.get_by_role_and_label(egui::Role::Slider, "ambient occlusion").set_value_accesskit(25.0);
    rest(&mut w);
    wait_for(&mut w, &file, |read| read.light.is_some());
    let read = read(&file).unwrap();
    assert_eq!((read.view.shows_box, read.panel), (Some(true), Some(true)));
    assert_eq!((read.light, read.view.theme, read.view.background), (Some(lighting_of(0.25)), None, None));
    // The next window has the light.
    let again = remembering(&file, read.clone());
    assert_eq!(lighting(&again), lighting_of(0.25));
    // A volume that comes with a light keeps it.
    let options = WindowOptions {
        choices: read,
        choices_file: Some(file.clone()),
        has_light: true,
        frame_size: SMALL,
        ..WindowOptions::default()
    };
    let given = window_with(options, fast(), [900.0, 700.0], 1.0);
    assert_eq!(lighting(&given), Lighting::default());
    // A slow server gets no shade that nobody asked for.
    let options = WindowOptions {
        choices_file: Some(folder.path().join("other.toml")),
        frame_size: SMALL,
        ..WindowOptions::default()
    };
    let slow = window_with(options, timed(3_000_000), [900.0, 700.0], 1.0);
    assert_eq!(lighting(&slow), Lighting::default());
    w.get_by_label("View").scroll_to_me();
    rest(&mut w);
    w.get_by_label("View").click();
    rest(&mut w);
    w.get_by_label("Reset settings").scroll_to_me();
    rest(&mut w);
    w.get_by_label("Reset settings").click();
    rest(&mut w);
    wait_for(&mut w, &file, |read| *read == Remembered::default());
    assert!(!w.state().aids.shows_box && lighting(&w) == usual_lighting());
}

#[test]
fn the_legend_is_shown_by_its_key() {
    let mut w = window([900.0, 700.0]);
    assert!(w.query_by_label_contains("legend: ").is_none());
    press(&mut w, Modifiers::NONE, Key::K);
    assert!(w.query_by_label_contains("legend: colours of the values from").is_some());
    press(&mut w, Modifiers::NONE, Key::K);
    assert!(w.query_by_label_contains("legend: ").is_none());
}

#[test]
fn the_last_choice_is_kept_at_exit() {
    let folder = tempfile::TempDir::new().unwrap();
    let file = folder.path().join("choices.toml");
    let mut w = remembering(&file, Remembered::default());
    w.key_press(Key::K);
    w.run_steps(2);
    assert!(!file.exists(), "it may change again");
    w.state_mut().finish_choices();
    assert_eq!(read(&file).unwrap().view.shows_legend, Some(true));
}
