//! The dialog over the picture that opens a file: another volume, a state, or colours and opacities.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use egui::{Align2, Context, Key, Modifiers, vec2};

use crate::panels::browser::{Browser, Chosen, Volumes};
use crate::view::local_servers::LocalServers;
use crate::view::waker_of;

#[derive(Default)]
pub(crate) struct OpenDialog {
    is_open: bool,
    browser: Option<Browser>,
    /// What opens volumes in this window, and the size of the volume shown, bytes; none: volumes do not open here.
    volumes: Option<(Arc<dyn LocalServers>, u64)>,
    folder: Option<PathBuf>,
}

impl OpenDialog {
    /// See `ViewerApp::offer_volumes`.
    pub(crate) fn offer_volumes(&mut self, servers: Arc<dyn LocalServers>, held: u64, folder: &Path) {
        self.volumes = Some((servers, held));
        self.folder.get_or_insert_with(|| folder.to_owned());
    }

    pub(crate) fn is_open(&self) -> bool {
        self.is_open
    }

    /// Opens the dialog and gives its list the keyboard.
    pub(crate) fn open(&mut self, ctx: &Context) {
        self.is_open = true;
        let browser = self.browser.get_or_insert_with(|| {
            let here = || std::env::current_dir().ok().filter(|here| here.parent().is_some());
            let folder = self.folder.clone().or_else(here).or_else(std::env::home_dir);
            Browser::with_texts(folder.unwrap_or_else(|| PathBuf::from("/")), &waker_of(ctx))
        });
        browser.focus();
    }

    /// Opens the dialog at a volume. See [`Browser::select_volume`].
    pub(crate) fn open_at(&mut self, ctx: &Context, volume: PathBuf, is_folder: bool) {
        self.open(ctx);
        if let Some(browser) = &mut self.browser {
            browser.select_volume(volume, is_folder);
        }
    }

    /// Shows the dialog if it is open; returns the file to open.
    pub(crate) fn show(&mut self, ctx: &Context) -> Option<Chosen> {
        let browser = self.browser.as_mut()?;
        let volumes = self.volumes.as_ref().map(|(servers, held)| (servers, *held));
        file_window(ctx, &mut self.is_open, browser, volumes)
    }

    #[cfg(test)]
    pub(crate) fn begin_at(&mut self, folder: &Path) {
        self.folder = Some(folder.to_owned());
    }
}

/// Shows a list of files over the window while it is open; returns the file to open.
pub(crate) fn file_window(
    ctx: &Context,
    is_open: &mut bool,
    browser: &mut Browser,
    volumes: Option<Volumes<'_>>,
) -> Option<Chosen> {
    if !*is_open {
        return None;
    }
    let room = ctx.content_rect().size() - vec2(60.0, 110.0);
    let (width, height) = (room.x.clamp(200.0, 640.0), room.y.clamp(120.0, 480.0));
    let window = egui::Window::new("Open a file").id(egui::Id::unique("open a file"));
    let window = window.anchor(Align2::CENTER_CENTER, vec2(0.0, 0.0)).resizable(false).collapsible(false);
    let shown = window.open(is_open).show(ctx, |ui| {
        ui.set_width(width);
        ui.set_height(height);
        browser.show(ui, volumes, height)
    });
    let chosen = shown.and_then(|shown| shown.inner).flatten();
    if chosen.is_some() || ctx.input_mut(|i| i.consume_key(Modifiers::NONE, Key::Escape)) {
        *is_open = false;
    }
    chosen
}
