//! What is seen as a saved state, and back: from a file, a link, or the command line.

use std::time::Duration;

use egui::{Event, ThemePreference};
use isinglass_core::camera::Intrinsics;
use isinglass_core::wire::Part;
use isinglass_formats::{
    SavedCamera, SavedState, SavedView, SavedVolume, Srgb, StereoPicture, Theme, state_from_link,
    state_to_link,
};
use isinglass_net::state_of_link;

use super::ViewerApp;
use crate::frame_source::FrameSource;
use crate::state_files::{Outcome, StateWish};
use crate::stereo::StereoMode;

impl<S: FrameSource> ViewerApp<S> {
    /// All that is seen, and how, in a window whose picture is `picture`. None before the volume is known.
    pub(super) fn saved_state(&self, ctx: &egui::Context, picture: Intrinsics) -> Option<SavedState> {
        let description = self.viewing.source().description()?;
        let (_, controls) = self.controls.as_ref()?;
        let volume = SavedVolume::of(&description.volume);
        let volume = match &self.options.volume_source {
            Some((source, selection)) => volume.opened_from(source, selection),
            None => volume,
        };
        let volume = match self.viewing.source().parts() {
            // The part may have been changed since.
            Some(parts) => {
                let Part { channel, time, level, series, .. } = parts.shown;
                SavedVolume { channel, time, level, series, ..volume }
            }
            None => volume,
        };
        let view = SavedView {
            shows_box: Some(self.aids.shows_box),
            shows_axes: Some(self.aids.shows_axes),
            shows_numbers: Some(self.shows_overlay),
            background: Some(Srgb(self.aids.background)),
            theme: Some(match ctx.options(|o| o.theme_preference) {
                ThemePreference::Dark => Theme::Dark,
                ThemePreference::Light => Theme::Light,
                ThemePreference::System => Theme::System,
            }),
            stereo: Some(match self.stereo.mode {
                StereoMode::Off => StereoPicture::Off,
                StereoMode::SideBySide => StereoPicture::SideBySide,
                StereoMode::Anaglyph => StereoPicture::RedCyan,
            }),
            orthographic: Some(self.is_orthographic),
            eye_angle_degrees: Some(self.stereo.eye_angle_degrees),
            frame_scale: Some(self.viewing.frame_size.scale),
            method: Some(self.novel_views.names[self.novel_views.selected].into()),
        };
        Some(SavedState {
            volume: Some(volume),
            camera: Some(SavedCamera::of(controls.center(), controls.placement(), picture)),
            view,
            look: self.viewing.look().map(|look| (*look).clone()),
        })
    }

    /// Shows what a state says. What cannot be as it says is the answer, in one line.
    pub(super) fn restore(
        &mut self,
        ctx: &egui::Context,
        now: Duration,
        window: Intrinsics,
        state: &SavedState,
    ) -> Option<String> {
        let mut note = None;
        let description = self.viewing.source().description()?;
        if let Some(volume) = &state.volume {
            note = volume.difference(&SavedVolume::of(&description.volume));
        }
        let view = &state.view;
        let set = |to: &mut bool, from: Option<bool>| *to = from.unwrap_or(*to);
        set(&mut self.aids.shows_box, view.shows_box);
        set(&mut self.aids.shows_axes, view.shows_axes);
        set(&mut self.shows_overlay, view.shows_numbers);
        set(&mut self.is_orthographic, view.orthographic);
        self.aids.background = view.background.map_or(self.aids.background, |Srgb(rgb)| rgb);
        if let Some(theme) = view.theme {
            ctx.set_theme(theme_preference(theme));
        }
        self.stereo.mode = match view.stereo {
            Some(StereoPicture::Off) => StereoMode::Off,
            Some(StereoPicture::SideBySide) => StereoMode::SideBySide,
            Some(StereoPicture::RedCyan) => StereoMode::Anaglyph,
            None => self.stereo.mode,
        };
        self.stereo.eye_angle_degrees = view.eye_angle_degrees.unwrap_or(self.stereo.eye_angle_degrees);
        self.viewing.frame_size.scale = view.frame_scale.unwrap_or(self.viewing.frame_size.scale);
        if let Some(method) = &view.method {
            match self.novel_views.names.iter().position(|name| name == method) {
                Some(index) => self.novel_views.selected = index,
                None => note = note.or_else(|| Some(format!("pictures by {method:.40} cannot be made here"))),
            }
        }
        if let Some(camera) = &state.camera {
            self.options.fov_y = camera.fov_y();
            let picture = self.stereo().eye_intrinsics(window.with_fov_y(camera.fov_y()));
            let placed = self.controls(&picture).map(|(_, c)| c.place(camera.center(), camera.placement()));
            if placed == Some(false) {
                note = note
                    .or_else(|| Some("the state's camera is too near to this volume or too far away".into()));
            }
        }
        if let Some(look) = &state.look
            && self.viewing.look().as_deref() != Some(look)
        {
            self.viewing.set_look(now, look.clone());
        }
        ctx.request_repaint();
        note
    }

    /// Takes the states that have arrived since the last refresh: from the command line, as soon as there is a volume to show;
    /// from files; from a drop; or from a link in the clipboard.
    pub(super) fn take_states(&mut self, ctx: &egui::Context, now: Duration, window: Intrinsics) {
        if self.viewing.source().description().is_none() || self.viewing.look().is_none() {
            return;
        }
        if let Some(state) = self.options.state.take() {
            if let Some(camera) = &state.camera
                && ctx.pixels_per_point() != 1.0
                && self.options.state_sets_size
            {
                // The window was opened before it was known how many pixels a point has.
                let [width, height] = camera.size.map(|side| side as f32 / ctx.pixels_per_point());
                ctx.send_viewport_cmd(egui::ViewportCommand::InnerSize(egui::vec2(width, height)));
            }
            self.restore_with_note(ctx, now, window, &state, None);
        }
        if let Some(outcome) = self.state_files.take() {
            match outcome {
                Outcome::Read(read) => {
                    self.restore_with_note(ctx, now, window, &read.state, read.note.clone());
                }
                Outcome::NoState(path) => {
                    // What the file holds, or what is wrong with it, is said there.
                    self.is_look_open = true;
                    self.editor.open(path, ctx);
                }
                Outcome::Written(path) => self.notice = Some((format!("saved as {}", path.display()), now)),
                Outcome::Exists(path) => {
                    let text = format!("{} is there; save again to replace it", path.display());
                    self.notice = Some((text, now));
                }
                Outcome::Failed(problem) => self.notice = Some((problem, now)),
            }
        }
        if let Some(file) = ctx.input(|i| i.raw.dropped_files.first().cloned()) {
            self.state_files.open_any(file.path().to_owned(), ctx);
        }
        if !ctx.text_edit_focused() {
            let is_link = |text: &String| text.trim_start().starts_with("isinglass://");
            let pasted = ctx.input(|i| {
                let mut texts =
                    i.events.iter().filter_map(|e| if let Event::Paste(t) = e { Some(t) } else { None });
                texts.rfind(|t| is_link(t)).cloned()
            });
            if let Some(text) = pasted {
                self.paste(ctx, now, window, &text);
            }
        }
    }

    fn paste(&mut self, ctx: &egui::Context, now: Duration, window: Intrinsics, link: &str) {
        let read = state_of_link(link).map_err(|e| e.to_string());
        match read.and_then(|state| state_from_link(&state).map_err(|e| e.to_string())) {
            Ok(read) => self.restore_with_note(ctx, now, window, &read.state, read.note),
            Err(problem) => self.notice = Some((problem, now)),
        }
    }

    fn restore_with_note(
        &mut self,
        ctx: &egui::Context,
        now: Duration,
        window: Intrinsics,
        state: &SavedState,
        note: Option<String>,
    ) {
        let problem = self.restore(ctx, now, window, state);
        if let Some(note) = problem.or(note) {
            self.notice = Some((note, now));
        }
    }

    /// Does what was asked for by key or in the panel.
    pub(super) fn do_state(&mut self, ctx: &egui::Context, now: Duration, wish: StateWish) {
        if wish == StateWish::Open {
            if !self.state_files.open(ctx) {
                self.open_dialog.open(ctx);
            }
            return;
        }
        let Some(state) = self.window.and_then(|window| self.saved_state(ctx, window)) else { return };
        if wish == StateWish::Save {
            let name = state.volume.as_ref().map_or("", |v| &v.name);
            return self.state_files.save(state.to_toml(), name, ctx);
        }
        let text = match self.link_to(state) {
            Some(link) => {
                ctx.copy_text(link);
                "a link to this view is in the clipboard; it lets nobody in"
            }
            None => "there is no server that a link could name",
        };
        self.notice = Some((text.into(), now));
    }

    /// A link to what is seen, for those who have a link of their own.
    pub(super) fn link_to(&self, state: SavedState) -> Option<String> {
        // Where the volume lies on a disk is not for whoever gets the link.
        let volume = state.volume.map(|v| SavedVolume { source: None, ..v });
        Some(self.options.link.as_ref()?.of_state(&state_to_link(&SavedState { volume, ..state })))
    }
}

/// In egui's terms.
pub(crate) fn theme_preference(theme: Theme) -> ThemePreference {
    match theme {
        Theme::Dark => ThemePreference::Dark,
        Theme::Light => ThemePreference::Light,
        Theme::System => ThemePreference::System,
    }
}
