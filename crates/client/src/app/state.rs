//! From the view to a saved state, and back from a file, a link or the command line.

use std::time::Duration;

use egui::{Event, ThemePreference};
use isinglass_core::camera::Intrinsics;
use isinglass_core::ids::LoadId;
use isinglass_core::wire::{LoadState, LoadStatus, Part};
use isinglass_formats::{
    MAX_LINK_BYTES, ReadState, SavedCamera, SavedState, SavedView, SavedVolume, Srgb, Theme, state_from_link,
    state_to_link,
};
use isinglass_net::{Link, State, state_of_link};

use super::state_part::{StatePart, names_part, save_part};
use super::{AppWish, ViewerApp};
use crate::panels::background::Written;
use crate::panels::file_field::FileOutcome;
use crate::panels::state_files::{FileContent, StateWish};
use crate::view::frame_source::FrameSource;
use crate::view::waker_of;

pub(super) struct ComingState {
    read: ReadState,
    /// Whether it is shown already, as far as the present volume allows.
    is_shown: bool,
    /// Whether the person knows that it waits for a connection.
    is_told: bool,
    asked: Option<AskedPart>,
    /// The server may list the parts of its file until then.
    until: Option<Duration>,
}

/// The part of the file that was requested from the server.
#[derive(Clone, Copy)]
struct AskedPart {
    part: Part,
    /// The server's newest load when the part was requested.
    before: LoadId,
    step: AskedStep,
    /// The next step must come before then. The server's last message stays visible, so a step counts once.
    until: Duration,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum AskedStep {
    Asked,
    Reading {
        permille: u16,
    },
    /// The description is on the way, or is not the expected one.
    Read,
}

impl ComingState {
    pub(super) fn new(read: ReadState) -> Self {
        Self { read, is_shown: false, is_told: false, asked: None, until: None }
    }
}

impl AskedPart {
    fn new(now: Duration, part: Part, before: LoadId) -> Self {
        Self { part, before, step: AskedStep::Asked, until: now + PART_PATIENCE }
    }

    /// Follows the server's newest load. Returns whether the part may still come.
    ///
    /// # Errors
    /// Why the part does not come.
    fn follow(&mut self, now: Duration, load: Option<LoadStatus>) -> Result<bool, String> {
        let step = match load.filter(|l| l.load > self.before) {
            Some(load) if load.part == self.part => match load.state {
                LoadState::Failed(problem) => return Err(problem),
                LoadState::Cancelled => return Err("reading its part of the file was cancelled".into()),
                LoadState::Reading { permille } => AskedStep::Reading { permille },
                LoadState::Done => AskedStep::Read,
            },
            Some(_) if self.step != AskedStep::Asked => {
                return Err("another part of the file was asked for than it is of".into());
            }
            // A load that was requested before.
            Some(_) | None => self.step,
        };
        if step != self.step {
            let patience = match step {
                AskedStep::Reading { .. } => READING_PATIENCE,
                AskedStep::Asked | AskedStep::Read => PART_PATIENCE,
            };
            (self.step, self.until) = (step, now + patience);
        }
        match step {
            _ if now < self.until => Ok(true),
            AskedStep::Asked => Err("the server does not open the part of the file that it is of".into()),
            AskedStep::Reading { .. } => {
                Err("the server tells no more of reading the part that it is of".into())
            }
            AskedStep::Read => Ok(false),
        }
    }
}

impl<S: FrameSource> ViewerApp<S> {
    /// Everything that is seen, in a window whose picture is `picture`. None before the volume is known.
    pub(super) fn saved_state(&self, ctx: &egui::Context, picture: Intrinsics) -> Option<SavedState> {
        let description = self.viewing.source().description()?;
        let (_, controls) = self.controls.as_ref()?;
        let volume = SavedVolume::of(&description.volume);
        let volume = match &self.options.volume_source {
            Some(source) => volume.opened_from(source),
            None => SavedVolume { server: self.options.link.as_ref().map(Link::place), ..volume },
        };
        let parts = self.viewing.source().talk().selection.choices();
        let volume = match parts {
            // The part may have changed since the server opened the file.
            Some(parts) => save_part(volume, &parts.shown),
            None => volume,
        };
        let view = SavedView {
            shows_box: Some(self.aids.shows_box),
            shows_axes: Some(self.aids.shows_axes),
            shows_legend: Some(self.aids.shows_legend),
            shows_numbers: Some(self.shows_numbers),
            background: Some(Srgb(self.aids.background)),
            theme: THEMES
                .iter()
                .find(|(_, t)| *t == ctx.options(|o| o.theme_preference))
                .map(|(theme, _)| *theme),
            stereo: Some(self.stereo.mode),
            orthographic: Some(self.is_orthographic),
            eye_angle_degrees: Some(self.stereo.eye_angle_degrees),
            frame_scale: Some(self.viewing.frame_size.scale),
            slices: Some(self.saved_slices()),
            up: Some(self.up_axis),
        };
        let views = (!self.named_views.is_empty()).then(|| self.named_views.clone());
        let measures = self.measures.measures();
        let measures = (!measures.is_empty()).then(|| measures.to_vec());
        Some(SavedState {
            volume: Some(volume),
            camera: Some(SavedCamera::of(controls.center(), controls.placement(), picture)),
            view,
            look: self.viewing.look().map(|look| (*look).clone()),
            views,
            measures,
        })
    }

    /// Shows what a state says of the present volume. Returns one line about what cannot be shown as it says.
    fn restore(
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
        set(&mut self.aids.shows_legend, view.shows_legend);
        set(&mut self.shows_numbers, view.shows_numbers);
        set(&mut self.is_orthographic, view.orthographic);
        if let Some(axis) = view.up {
            self.set_up_axis(axis);
        }
        // A state of the whole view leaves no list of the one before.
        let is_whole = state.camera.is_some() && state.look.is_some();
        if state.views.is_some() || is_whole {
            self.named_views = state.views.clone().unwrap_or_default();
        }
        if state.measures.is_some() || is_whole {
            self.measures.set(state.measures.clone().unwrap_or_default());
        }
        self.aids.background = view.background.map_or(self.aids.background, |Srgb(rgb)| rgb);
        if let Some(theme) = view.theme {
            ctx.set_theme(theme_preference(theme));
        }
        self.stereo.mode = view.stereo.unwrap_or(self.stereo.mode);
        self.stereo.eye_angle_degrees = view.eye_angle_degrees.unwrap_or(self.stereo.eye_angle_degrees);
        self.viewing.frame_size.scale = view.frame_scale.unwrap_or(self.viewing.frame_size.scale);
        if let Some(slices) = &view.slices {
            self.restore_slices(slices);
        }
        if let Some(camera) = &state.camera {
            self.moves.stop();
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
            self.editor.note_present();
            self.viewing.set_look(now, look.clone());
        }
        self.keeper.forget_shown(state.look.is_some());
        ctx.request_repaint();
        note
    }

    /// Takes states that arrived since the last refresh: from the command line, files, drops, or links in the
    /// clipboard.
    pub(super) fn take_states(&mut self, ctx: &egui::Context, now: Duration, window: Intrinsics) {
        if self.viewing.source().description().is_none() || self.viewing.look().is_none() {
            return;
        }
        if let Some(state) = self.options.state.take() {
            if let Some(camera) = state.camera.as_ref().filter(|_| self.options.state_sets_size) {
                // What the bars take and the number of pixels a point were not known when the window opened.
                let [width, height] = camera.size.map(|side| side as f32 / ctx.pixels_per_point());
                let bars = ctx.content_rect().size() - self.room.size();
                let size = egui::vec2(width, height) + bars;
                self.keeper.await_size(now, [size.x.round() as u32, size.y.round() as u32]);
                ctx.send_viewport_cmd(egui::ViewportCommand::InnerSize(size));
            }
            self.turn_to_state(ReadState { state, note: None });
        }
        let text = match self.state_files.take() {
            Some(Ok(FileOutcome::Read(FileContent::State(read)))) => {
                match self.is_of_other_volume(&read.state) {
                    true => self.wish = Some(AppWish::State(read)),
                    false => self.turn_to_state(*read),
                }
                None
            }
            Some(Ok(FileOutcome::Read(FileContent::Other(path)))) => {
                // The editor reads the file, and says what is wrong with it.
                self.is_look_open = true;
                self.editor.open(path, &waker_of(ctx));
                None
            }
            Some(Ok(FileOutcome::Written(Written::At(path)))) => Some(format!("saved as {}", path.display())),
            Some(Ok(FileOutcome::Written(Written::Exists(path)))) => {
                Some(format!("{} is there; save again to replace it", path.display()))
            }
            Some(Err(problem)) => Some(problem),
            None => None,
        };
        if let Some(text) = text {
            self.tell(now, text);
        }
        if let Some(file) = ctx.input(|i| i.raw.dropped_files.first().cloned()) {
            self.state_files.open_any(file.path().to_owned(), &waker_of(ctx));
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
        self.follow_state(ctx, now, window);
    }

    /// A link of another server, or of this one when it is lost, connects and keeps camera and look. The state in
    /// any other link is shown.
    fn paste(&mut self, ctx: &egui::Context, now: Duration, window: Intrinsics, text: &str) {
        let link = text.trim().parse::<Link>();
        let is_present = |link: &Link| {
            let present = self.options.link.as_ref().map(|present| present.fingerprint);
            let source = self.viewing.source();
            let answers = source.state() == State::Connected && !source.is_silent();
            present == Some(link.fingerprint) && answers
        };
        if let Some(link) = link.as_ref().ok().filter(|link| self.opens_volumes && !is_present(link)) {
            let state = self.saved_state(ctx, window).map(|state| ReadState { state, note: None });
            self.wish = Some(AppWish::Server(Box::new((link.clone(), state))));
            return;
        }
        let read = state_of_link(text).map_err(|e| e.to_string());
        match read.and_then(|state| state_from_link(&state).map_err(|e| e.to_string())) {
            Ok(read) => self.turn_to_state(read),
            Err(_) if link.is_ok() && self.opens_volumes => self.tell(now, SAME_SERVER),
            Err(_) if link.is_ok() => self.tell(now, ONE_SERVER),
            Err(problem) => self.tell(now, problem),
        }
    }

    /// Shows a state, in place of one that still waits.
    fn turn_to_state(&mut self, read: ReadState) {
        self.coming = Some(ComingState::new(read));
    }

    /// Continues to show a state. The server is first asked for the state's part of its file.
    fn follow_state(&mut self, ctx: &egui::Context, now: Duration, window: Intrinsics) {
        let Some(mut coming) = self.coming.take() else { return };
        let source = self.viewing.source();
        if source.state() != State::Connected {
            if !coming.is_told {
                self.tell(now, STATE_WAITS);
            }
            // The request may be lost, and another server may come next.
            self.coming = Some(ComingState { asked: None, until: None, is_told: true, ..coming });
            return;
        }
        let (parts, load) = {
            let talk = source.talk();
            (talk.selection.choices(), talk.selection.load())
        };
        let Some(description) = source.description() else { return };
        let saved = coming.read.state.volume.as_ref();
        let part = saved.zip(parts.as_deref()).map(|(v, parts)| StatePart::of(v, &description.volume, parts));
        let mut problem = None;
        let until = *coming.until.get_or_insert(now + PARTS_PATIENCE);
        match (part, coming.asked) {
            (Some(StatePart::Shown), _) => {}
            (Some(StatePart::Elsewhere(line)), None) => problem = Some(line),
            (Some(StatePart::Other(part)), None) => {
                let wish = self.parts_bar.open(part, load.as_ref());
                let before = load.map_or(LoadId(0), |l| l.load);
                coming.asked = Some(AskedPart::new(now, part, before));
                if std::mem::take(&mut coming.is_shown) {
                    self.notice = None;
                }
                self.do_part(now, Some(wish));
                self.coming = Some(coming);
                return;
            }
            (Some(found), Some(mut asked)) => match asked.follow(now, load) {
                Ok(true) => {
                    coming.asked = Some(asked);
                    ctx.request_repaint_after(asked.until.saturating_sub(now));
                    self.coming = Some(coming);
                    return;
                }
                Ok(false) => {
                    problem = Some(match found {
                        StatePart::Elsewhere(line) => line,
                        _ => "the server shows another part of its file than the state is of".into(),
                    });
                }
                Err(problem) => {
                    self.tell(now, format!("the state is not shown: {problem}"));
                    return;
                }
            },
            // A server lists the parts of its file as soon as it lets the viewer in, if it offers any.
            (None, _) if saved.is_some_and(names_part) && now < until => {
                if !std::mem::replace(&mut coming.is_shown, true) {
                    self.restore_with_note(ctx, now, window, &coming.read, None);
                }
                ctx.request_repaint_after(until.saturating_sub(now));
                self.coming = Some(coming);
                return;
            }
            (None, _) => {}
        }
        // Changes by hand since then stay.
        match (coming.is_shown, problem) {
            (true, None) => {}
            (true, problem) => self.notice = problem.map(|problem| (problem, now)),
            (false, problem) => self.restore_with_note(ctx, now, window, &coming.read, problem),
        }
    }

    fn restore_with_note(
        &mut self,
        ctx: &egui::Context,
        now: Duration,
        window: Intrinsics,
        read: &ReadState,
        problem: Option<String>,
    ) {
        let unlike = self.restore(ctx, now, window, &read.state);
        if let Some(note) = problem.or(unlike).or_else(|| read.note.clone()) {
            self.tell(now, note);
        }
    }

    /// Whether a state names another volume of this machine that can be opened in this window.
    fn is_of_other_volume(&self, state: &SavedState) -> bool {
        let named = |source: &str| match source.starts_with("builtin:") {
            true => source.into(),
            false => std::path::absolute(source).unwrap_or_else(|_| source.into()),
        };
        let present = self.options.volume_source.as_ref().filter(|_| self.opens_volumes);
        let wanted = state.volume.as_ref().and_then(|v| v.volume_source().ok()?);
        present.zip(wanted).is_some_and(|(present, wanted)| {
            named(&present.source) != named(&wanted.source)
                // A raw file holds other volumes if it is read in another way. Without a shape there is no other way.
                || (wanted.raw.is_some() && wanted.raw != present.raw)
                || wanted.spacing != present.spacing
        })
    }

    #[cfg(test)]
    pub(crate) fn notice(&self) -> &str {
        self.notice.as_ref().map_or("", |(text, _)| text)
    }

    #[cfg(test)]
    pub(crate) fn seen(&self) -> Option<(isinglass_core::look::Look, isinglass_core::camera::Pose)> {
        Some(((*self.viewing.look()?).clone(), self.controls.as_ref()?.1.pose()))
    }

    pub(super) fn do_state(&mut self, ctx: &egui::Context, now: Duration, wish: StateWish) {
        if wish == StateWish::Open {
            if !self.state_files.open(&waker_of(ctx)) {
                self.open_dialog.open(ctx);
            }
            return;
        }
        let Some(state) = self.window.and_then(|window| self.saved_state(ctx, window)) else { return };
        if wish == StateWish::Save {
            let name = state.volume.as_ref().map_or("", |v| &v.name);
            return self.state_files.save(state.to_toml(), name, &waker_of(ctx));
        }
        let text = match self.link_to(state) {
            Some(link) => {
                ctx.copy_text(link);
                match self.options.volume_source {
                    Some(_) => {
                        "a link to this view is in the clipboard; `isinglass view` opens it on this computer"
                    }
                    None => "a link to this view is in the clipboard; it gives no access to the server",
                }
            }
            None => "there is no server that a link could name",
        };
        self.tell(now, text);
    }

    /// A link to the view for people who have access to the server, or to the file where a window has opened that.
    pub(super) fn link_to(&self, state: SavedState) -> Option<String> {
        let volume = match self.options.volume_source {
            Some(_) => state.volume,
            // The path on a server's disk is no business of the recipient.
            None => state.volume.map(SavedVolume::without_place),
        };
        let state = SavedState { volume, ..state };
        let text = state_to_link(&state);
        // Many long paths do not fit.
        let text = match text.len() <= MAX_LINK_BYTES {
            true => text,
            false => state_to_link(&SavedState { measures: None, views: None, ..state }),
        };
        Some(self.options.link.as_ref()?.of_state(&text))
    }
}

pub(crate) fn theme_preference(theme: Theme) -> ThemePreference {
    THEMES.iter().find(|(t, _)| *t == theme).map_or(ThemePreference::Dark, |(_, preference)| *preference)
}

pub(super) const THEMES: [(Theme, ThemePreference); 3] = [
    (Theme::Dark, ThemePreference::Dark),
    (Theme::Light, ThemePreference::Light),
    (Theme::System, ThemePreference::System),
];

const STATE_WAITS: &str = "there is no connection to the server: the state is shown when there is one again";
const SAME_SERVER: &str = "this window is connected to that server already";
const ONE_SERVER: &str = "this window stays with its server";
/// How long a server may take to list the parts of its file after it lets a viewer in. It does so at once.
const PARTS_PATIENCE: Duration = Duration::from_secs(3);
/// How long a server may take to begin to read a part, and to describe it afterwards. It does both at once.
const PART_PATIENCE: Duration = Duration::from_secs(10);
/// How long reading may show no progress. A server reports whole percents: of 100 GB at 10 MB/s, slower than any
/// disk, one takes 100 s.
const READING_PATIENCE: Duration = Duration::from_secs(600);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_step_of_a_part_that_was_asked_for_has_its_time_and_an_end() {
        let wanted = Part { channel: Some(2), ..Part::default() };
        let load = |number: u32, part: Part, state: LoadState| {
            Some(LoadStatus { load: LoadId(number), is_own: true, part, bytes_needed: 0, state })
        };
        let reading = |permille| load(8, wanted, LoadState::Reading { permille });
        let done = || load(8, wanted, LoadState::Done);
        let second = Duration::from_secs;
        let new = || AskedPart::new(Duration::ZERO, wanted, LoadId(7));

        // One that was read before, or that somebody else has asked for, is none of ours.
        let mut asked = new();
        assert_eq!(asked.follow(second(1), load(7, wanted, LoadState::Done)), Ok(true));
        assert_eq!(asked.follow(second(9), load(8, Part::default(), LoadState::Done)), Ok(true));
        assert!(asked.follow(second(10), None).unwrap_err().contains("does not open"));

        // A large one is read for an hour. What was told last is there to be read at any time.
        let mut asked = new();
        for s in 0..3600 {
            assert_eq!(asked.follow(second(s), reading((s / 36 * 10) as u16)), Ok(true));
        }
        for told in [reading(990), None] {
            // Since 3564 s.
            let mut stuck = asked;
            assert_eq!(stuck.follow(second(4163), told.clone()), Ok(true));
            assert!(stuck.follow(second(4164), told).unwrap_err().contains("tells no more"));
        }
        assert_eq!(asked.follow(second(3690), reading(1000)), Ok(true));
        // Once it is read it is shown soon, or never.
        assert_eq!(asked.follow(second(3700), done()), Ok(true));
        assert_eq!(asked.follow(second(3709), done()), Ok(true));
        assert_eq!(asked.follow(second(3710), done()), Ok(false));
        let other = load(9, Part::default(), LoadState::Reading { permille: 0 });
        assert!(asked.follow(second(3701), other).unwrap_err().contains("another part"));
        let failed = load(9, wanted, LoadState::Failed("a bad disk".into()));
        assert_eq!(new().follow(second(1), failed), Err("a bad disk".into()));
        assert!(new().follow(second(1), load(8, wanted, LoadState::Cancelled)).is_err());
    }
}
