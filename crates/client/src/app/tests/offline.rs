//! What the window says while there is no connection.

use egui_kittest::kittest::NodeT;
use isinglass_net::ConnectError;

use super::*;

fn problem() -> ConnectError {
    ConnectError::Lost("gone".into())
}

fn states() -> [State; 2] {
    [State::Reconnecting { since_micros: 0, attempt: 2, problem: problem() }, State::Refused(problem())]
}

#[test]
fn what_rests_is_offline_and_nothing_is_received() {
    let mut w = window([900.0, 700.0]);
    press(&mut w, Modifiers::NONE, Key::O);
    w.state().viewing.source().here().stats.bytes_per_second = 43_000.0;
    rest(&mut w);
    assert!(w.query_by_label("43 kB/s").is_some() && w.query_by_label("offline").is_none());
    for state in states() {
        w.state().viewing.source().here().state = state;
        rest(&mut w);
        assert!(w.query_by_label("offline").is_some() && w.query_by_label("0 B/s").is_some());
    }
}

#[test]
fn nothing_is_on_its_way_that_nobody_works_on() {
    let mut w = window([900.0, 700.0]);
    w.state().viewing.source().here().sleeps = true;
    press(&mut w, Modifiers::NONE, Key::M);
    assert!(w.query_by_label_contains("the new one is on its way").is_some());
    let is_said = |w: &Harness<'_, ViewerApp<HereSource>>, text| w.query_by_label_contains(text).is_some();
    for (state, text) in
        states().into_iter().zip(["waits until connected again", "there is no connection for"])
    {
        w.state().viewing.source().here().state = state;
        rest(&mut w);
        assert!(is_said(&w, text) && !is_said(&w, "on its way"), "{text}");
        press(&mut w, Modifiers::NONE, Key::F12);
        assert!(is_said(&w, "No picture: "), "the refusal is seen");
        assert!(!w.state().screenshots.is_busy() && w.state().viewing.source().here().num_shots == 0);
        press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
        assert!(w.get_by_label("Take the picture").accesskit_node().is_disabled());
        press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
    }
    // One that was asked for before waits as well.
    w.state().viewing.source().here().state = State::Connected;
    press(&mut w, Modifiers::NONE, Key::F12);
    assert!(is_said(&w, "the server renders the picture"));
    w.state().viewing.source().here().state = states()[0].clone();
    rest(&mut w);
    assert!(is_said(&w, "the picture waits until connected again") && !is_said(&w, "the server renders the"));
}

#[test]
fn a_server_that_does_not_answer_is_offline_before_the_connection_is_lost() {
    let mut w = window([900.0, 700.0]);
    let offline = |w: &Harness<'_, ViewerApp<HereSource>>| {
        (
            w.query_by_label("offline").is_some(),
            w.query_by_label_contains("No answer from the server").is_some(),
        )
    };
    for (silence_micros, is_offline) in [(900_000, false), (2_300_000, true), (0, false)] {
        w.state().viewing.source().here().stats.silence_micros = silence_micros;
        rest(&mut w);
        assert_eq!(offline(&w), (is_offline, is_offline), "{silence_micros} us");
    }
}

#[test]
fn fingerprints_are_behind_details_and_a_new_link_can_be_pasted() {
    let mut w = window([900.0, 700.0]);
    w.state_mut().leave_volumes_to_others();
    let [expected, found] = ["ab", "cd"].map(|byte| format!("sha256:{}", byte.repeat(32)));
    let [of_link, of_server] = [&expected, &found].map(|text| text.parse().unwrap());
    let problem =
        ConnectError::Certificate { host: "far".into(), port: 4433, expected: of_link, found: of_server };
    assert!(w.query_by_label("Paste new link").is_none());
    w.state().viewing.source().here().state = State::Refused(problem);
    rest(&mut w);
    assert!(w.query_by_label_contains("is not the link's").is_some());
    assert!(w.query_by_label_contains(&found).is_none());
    w.get_by_label("Details").click();
    rest(&mut w);
    assert!(w.query_by_label_contains(&expected).is_some() && w.query_by_label_contains(&found).is_some());
    w.get_by_label("Paste new link").click();
    w.step();
    let commands = &w.output().viewport_output[&egui::ViewportId::ROOT].commands;
    assert!(commands.contains(&egui::ViewportCommand::RequestPaste), "{commands:?}");
    w.event(Event::Paste(format!("isinglass://far:4433/#token={}&cert={found}", "0".repeat(32))));
    w.step();
    match w.state_mut().take_wish() {
        Some(AppWish::Server(server)) => {
            assert_eq!(server.0.fingerprint, of_server);
            let seen = server.1.unwrap().state;
            let look = (*w.state().viewing.look().unwrap()).clone();
            assert!(seen.look == Some(look) && seen.camera.is_some());
        }
        _ => panic!("the link connects"),
    }
}

#[test]
fn a_new_link_of_a_silent_server_connects() {
    let mut w = window([900.0, 700.0]);
    w.state_mut().leave_volumes_to_others();
    let text = format!("isinglass://far:4433/#token={}&cert=sha256:{}", "0".repeat(32), "cd".repeat(32));
    w.state_mut().options.link = Some(text.parse().unwrap());
    for (silence_micros, connects) in [(0, false), (2_300_000, true)] {
        w.state().viewing.source().here().stats.silence_micros = silence_micros;
        rest(&mut w);
        w.event(Event::Paste(text.clone()));
        w.step();
        let wish = w.state_mut().take_wish();
        assert_eq!(matches!(wish, Some(AppWish::Server(_))), connects, "{silence_micros} us");
    }
}

/// Nobody else wakes the window then.
#[test]
fn a_picture_without_bars_looks_whether_the_server_falls_silent() {
    let mut w = window([900.0, 700.0]);
    press(&mut w, Modifiers::NONE, Key::F11);
    w.run_steps(600);
    let delay = |w: &Harness<'_, ViewerApp<HereSource>>| {
        w.output().viewport_output[&egui::ViewportId::ROOT].repaint_delay
    };
    assert!(delay(&w) <= Duration::from_millis(500), "{:?}", delay(&w));
    w.state().viewing.source().here().state = State::Refused(problem());
    w.run_steps(600);
    assert!(delay(&w) > Duration::from_secs(60), "the control: {:?}", delay(&w));
}
