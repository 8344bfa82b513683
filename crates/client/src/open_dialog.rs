//! The dialog over the picture that opens a file of this machine: another volume, a state, or colours and opacities.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use egui::{Align2, Context, Key, Modifiers, RichText, vec2};

use crate::start::LocalServers;
use crate::start::browser::{Browser, Chosen};

/// See the module.
#[derive(Default)]
pub(crate) struct OpenDialog {
    is_open: bool,
    /// From the first time on.
    browser: Option<Browser>,
    /// Who opens volumes in this window, and the bytes of the one before; none: nobody does.
    volumes: Option<(Arc<dyn LocalServers>, u64)>,
    /// Where the list begins.
    folder: Option<PathBuf>,
}

impl OpenDialog {
    /// Volumes are opened by `servers` beside the bytes `held`; the list begins with `folder`.
    pub(crate) fn offer_volumes(&mut self, servers: Arc<dyn LocalServers>, held: u64, folder: &Path) {
        self.volumes = Some((servers, held));
        self.folder.get_or_insert_with(|| folder.to_owned());
    }

    /// Whether the keyboard is the dialog's.
    pub(crate) fn is_open(&self) -> bool {
        self.is_open
    }

    /// Opens it, with the keyboard in its list.
    pub(crate) fn open(&mut self, ctx: &Context) {
        self.is_open = true;
        let browser = self.browser.get_or_insert_with(|| {
            let here = || std::env::current_dir().ok().filter(|here| here.parent().is_some());
            let folder = self.folder.clone().or_else(here).or_else(std::env::home_dir);
            let ctx = ctx.clone();
            let wake = Arc::new(move || ctx.request_repaint());
            Browser::with_texts(folder.unwrap_or_else(|| PathBuf::from("/")), &(wake as _))
        });
        browser.focus();
    }

    /// Shows it if it is open; what shall be opened.
    pub(crate) fn show(&mut self, ctx: &Context) -> Option<Chosen> {
        let browser = self.browser.as_mut().filter(|_| self.is_open)?;
        let room = ctx.content_rect().size() - vec2(60.0, 110.0);
        let (width, height) = (room.x.clamp(200.0, 640.0), room.y.clamp(120.0, 480.0));
        let window =
            egui::Window::new(RichText::new("Open a file").size(14.0)).id(egui::Id::unique("open a file"));
        let window = window.anchor(Align2::CENTER_CENTER, vec2(0.0, 0.0)).resizable(false).collapsible(false);
        let shown = window.open(&mut self.is_open).show(ctx, |ui| {
            ui.set_width(width);
            ui.set_height(height);
            let volumes = self.volumes.as_ref().map(|(servers, held)| (servers, *held));
            browser.show(ui, volumes, height)
        });
        let chosen = shown.and_then(|shown| shown.inner).flatten();
        if chosen.is_some() || ctx.input_mut(|i| i.consume_key(Modifiers::NONE, Key::Escape)) {
            self.is_open = false;
        }
        chosen
    }

    #[cfg(test)]
    pub(crate) fn begin_at(&mut self, folder: &Path) {
        self.folder = Some(folder.to_owned());
    }
}
