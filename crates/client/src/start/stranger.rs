//! What a state names that is not of this computer: a server, or addresses of the web. Whoever wrote the state chose it,
//! so nothing is called before the person says so.

use egui::{Align2, Context, Key, RichText};
use isinglass_formats::{ReadState, SavedVolume};
use isinglass_net::Link;

use super::page::Act;
use crate::panels::style::{named, pane_at};
use crate::panels::text::sentence;

/// A state that waits for an answer.
pub(super) struct Stranger {
    /// How the state came.
    pub(super) act: Act,
    pub(super) read: Box<ReadState>,
    /// Names of the machines that would be called.
    hosts: String,
}

impl Stranger {
    /// The state, if opening its volume calls another machine.
    ///
    /// # Errors
    /// The link in it is none.
    pub(super) fn of(act: Act, read: &ReadState) -> Result<Option<Self>, String> {
        let Some(volume) = &read.state.volume else { return Ok(None) };
        let server = link_of(volume)?.map(|link| link.place());
        let hosts: Vec<String> = server.into_iter().chain(volume.web_hosts()).collect();
        let (read, hosts) = (Box::new(read.clone()), hosts.join(" and "));
        Ok((!hosts.is_empty()).then_some(Self { act, read, hosts }))
    }

    /// Shows the question. Returns the answer.
    pub(super) fn show(&self, ctx: &Context) -> Option<bool> {
        let mut answer = None;
        let room = ctx.content_rect();
        pane_at(ctx, "stranger", room, (Align2::CENTER_CENTER, [0.0, 0.0]), |ui| {
            ui.set_max_width((room.width() - 40.0).clamp(180.0, 420.0));
            ui.label(RichText::new(format!("Call {}?", self.hosts)).strong());
            ui.label("The state names it for its volume. Whoever wrote the state chose it.");
            ui.horizontal_wrapped(|ui| {
                for (text, is_yes) in [("Cancel", false), (&*format!("Call {}", self.hosts), true)] {
                    let button = ui.button(text);
                    named(&button, egui::Role::Button, text);
                    if button.clicked() {
                        answer = Some(is_yes);
                    }
                }
            });
        });
        if ctx.input_mut(|input| input.consume_key(egui::Modifiers::NONE, Key::Escape)) {
            answer = Some(false);
        }
        answer
    }
}

/// The link to a server, if the volume's source is one.
///
/// # Errors
/// One sentence if it is no good link.
pub(super) fn link_of(volume: &SavedVolume) -> Result<Option<Link>, String> {
    let bad = |e| sentence(&format!("the link of the state's volume: {e}"));
    volume.link().map(|link| link.parse::<Link>().map_err(bad)).transpose()
}
