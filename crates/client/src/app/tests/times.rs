//! Are the times of a file played by a key and by a button, one after the other, and does playing end where it should? Can
//! a volume be mirrored?

use isinglass_core::ids::LoadId;
use isinglass_core::wire::{Choices, LoadState, LoadStatus};

use super::*;

type Window = Harness<'static, ViewerApp<HereSource>>;

fn at(time: u32) -> Part {
    Part { channel: Some(0), time: Some(time), level: Some(0), series: Some(0), ..Part::default() }
}

/// The server shows a time of a film of three, one every half second.
fn show_time(w: &Window, time: u32) {
    let choices = Choices {
        shown: at(time),
        whole_dims: [24; 3],
        num_channels: 2,
        num_times: 3,
        num_series: 1,
        time_step: Some(0.5),
        ..Choices::default()
    };
    w.state().viewing.source().talk().selection.handle_choices(choices);
}

/// The server has read the part that was requested last, and shows it.
fn answer(w: &Window) {
    let (number, part) = {
        let here = w.state().viewing.source().here();
        (here.selected.len() as u32, *here.selected.last().unwrap())
    };
    show_time(w, part.time.unwrap());
    let load =
        LoadStatus { load: LoadId(number), is_own: true, part, bytes_needed: 0, state: LoadState::Done };
    w.state().viewing.source().talk().selection.handle_load(load);
}

/// The times that were requested so far.
fn requested(w: &Window) -> Vec<u32> {
    w.state().viewing.source().talk();
    w.state().viewing.source().here().selected.iter().filter_map(|part| part.time).collect()
}

/// Seconds at 60 refreshes.
fn pass(w: &mut Window, seconds: f64) {
    w.run_steps((seconds * 60.0) as usize);
}

fn is_playing(w: &Window) -> bool {
    w.state().parts_bar.is_playing()
}

#[test]
fn space_plays_the_times_as_fast_as_they_are_shown_and_stops_them() {
    let mut w = window([1280.0, 720.0]);
    show_time(&w, 0);
    w.run_steps(4);
    w.key_press(Key::Space);
    w.run_steps(4);
    assert_eq!(requested(&w), [1]);
    // The server is slow: nothing queues.
    pass(&mut w, 3.0);
    assert_eq!(requested(&w), [1]);
    answer(&w);
    w.run_steps(4);
    assert_eq!(requested(&w), [1, 2], "it was due long ago");
    for expected in [&[1, 2, 0][..], &[1, 2, 0, 1]] {
        answer(&w);
        pass(&mut w, 0.3);
        assert_eq!(requested(&w).len(), expected.len() - 1, "the next one is not due yet");
        pass(&mut w, 0.3);
        assert_eq!(requested(&w), expected);
    }
    answer(&w);
    w.key_press(Key::Space);
    pass(&mut w, 2.0);
    assert_eq!((requested(&w).len(), is_playing(&w)), (4, false));
}

#[test]
fn the_button_plays_too_and_a_choice_by_hand_ends_it() {
    let mut w = window([1280.0, 720.0]);
    show_time(&w, 0);
    w.run_steps(4);
    assert!(w.query_by_label("pause").is_none());
    w.get_by_label("play the times").click();
    w.run_steps(4);
    assert_eq!((requested(&w), is_playing(&w)), (vec![1], true));
    answer(&w);
    w.get_by_label("pause").click();
    w.run_steps(4);
    assert!(!is_playing(&w) && w.query_by_label("play the times").is_some());
    for by_key in [true, false] {
        w.get_by_label("play the times").click();
        w.run_steps(4);
        answer(&w);
        assert!(is_playing(&w));
        match by_key {
            true => w.key_press(Key::OpenBracket),
            false => w.get_by_label("the time before").click(),
        }
        w.run_steps(4);
        answer(&w);
        assert!(!is_playing(&w), "{by_key}");
        let number = requested(&w).len();
        pass(&mut w, 2.0);
        assert_eq!(requested(&w).len(), number, "{by_key}");
    }
}

#[test]
fn playing_ends_with_the_connection_and_does_not_begin_without_one() {
    let mut w = window([1280.0, 720.0]);
    show_time(&w, 0);
    press(&mut w, Modifiers::NONE, Key::Space);
    assert!(is_playing(&w));
    let problem = isinglass_net::ConnectError::Lost("gone".into());
    let lost = State::Reconnecting { since_micros: 0, attempt: 2, problem };
    w.state().viewing.source().here().state = lost;
    rest(&mut w);
    assert!(!is_playing(&w));
    press(&mut w, Modifiers::NONE, Key::Space);
    assert!(!is_playing(&w) && w.query_by_label_contains("no connection").is_some());
    w.state().viewing.source().here().state = State::Connected;
    rest(&mut w);
    assert!(!is_playing(&w), "it does not go on by itself");
    // A file of one time.
    let mut w = window([1280.0, 720.0]);
    press(&mut w, Modifiers::NONE, Key::Space);
    assert!(!is_playing(&w) && w.query_by_label_contains("nothing to play").is_some());
}

#[test]
fn a_volume_is_mirrored_by_the_menu_with_its_region() {
    let mut w = window([1280.0, 720.0]);
    w.get_by_label("Views").click();
    rest(&mut w);
    assert!(w.query_by_label_contains("Mirror").is_none(), "this server shows one part only");
    w.get_by_label("Views").click();
    rest(&mut w);
    let region = Some([[2, 9], [0, u32::MAX], [5, 24]]);
    let shown = Part { region, ..at(0) };
    let choices =
        Choices { shown, whole_dims: [24; 3], num_channels: 1, num_series: 1, ..Choices::default() };
    w.state().viewing.source().talk().selection.handle_choices(Choices { num_times: 1, ..choices });
    rest(&mut w);
    w.get_by_label("Views").click();
    rest(&mut w);
    w.get_by_label_contains("Mirror").click();
    rest(&mut w);
    w.get_by_label("Along x").click();
    rest(&mut w);
    let wanted =
        Part { flip: [true, false, false], region: Some([[15, 22], [0, u32::MAX], [5, 24]]), ..shown };
    assert_eq!(w.state().viewing.source().here().selected, [wanted]);
}
