//! Volumes on other machines.

use isinglass_net::Tunnel;

use super::*;
use crate::view::remote_servers::{RemoteServer, RemoteServers};

/// One machine that is there, and one that is not.
pub(super) struct Machines;

impl RemoteServers for Machines {
    fn is_place(&self, text: &str) -> bool {
        text.starts_with("there:") || text.starts_with("nowhere:")
    }

    fn start(&self, place: &str) -> Result<RemoteServer, String> {
        if place.starts_with("nowhere:") {
            return Err("ssh does not reach nowhere".into());
        }
        let (runtime, mut links) = porter(&Builtin::Shells.volume(16));
        // A server on another machine goes on by itself.
        std::mem::forget(runtime);
        let tunnel: Tunnel = Arc::new(|| std::process::Command::new("false"));
        Ok(RemoteServer { link: links.remove(0), tunnel })
    }
}

#[test]
fn a_volume_on_another_machine_is_shown_and_opened_again_from_the_list() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    stage.paste("nowhere:/data/a.nrrd");
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "a problem", |w| w.state().problem.is_some());
    assert!(stage.has("Ssh does not reach nowhere") || stage.has("ssh does not reach nowhere"));
    assert!(!stage.list().contains("nowhere"), "what did not open is not remembered");

    stage.paste(" there:/data/a b.nrrd ");
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "the volume", is_shown);
    let file = stage.folder.path().join("recent.toml");
    let read = || Recent::read(&file).unwrap().entries;
    until(&mut stage.window, "the list's file", |_| !read().is_empty());
    let [entry] = &read()[..] else { panic!("{:?}", read()) };
    assert_eq!(entry.place, RecentPlace::Remote { place: "there:/data/a b.nrrd".into() });
    assert!(!stage.list().contains("127.0.0.1"), "the server is gone tomorrow, and the volume is not");

    // The card starts another server.
    stage.window.key_press_modifiers(Modifiers::COMMAND, Key::N);
    stage.window.run_steps(3);
    let port = |window: &Window| window.state().app.source().description().map(|d| d.ticket.reveal());
    let before = port(&stage.window);
    stage.window.get_by_role_and_label(egui::Role::Button, &entry.shows).click();
    stage.window.run_steps(3);
    until(&mut stage.window, "the volume again", |w| is_shown(w) && port(w) != before);
}
