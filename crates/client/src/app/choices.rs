//! Remembers what the person chooses: panel, size, theme, background, axes, box, legend and light. A choice is what changes in
//! the window; flags, settings and states are none.

use std::path::PathBuf;
use std::time::Duration;

use egui::ThemePreference;
use isinglass_core::look::Look;
use isinglass_core::volume::Lighting;
use isinglass_formats::{Remembered, SavedView, Srgb};

use super::ViewerApp;
use super::state::{THEMES, theme_preference};
use crate::paint::view_aids::ViewAids;
use crate::panels::background::{Background, write_own};
use crate::panels::light::usual_lighting;
use crate::view::frame_source::FrameSource;
use crate::view::waker_of;

/// The choices, and their file.
#[derive(Default)]
pub(super) struct ChoiceKeeper {
    /// None where nothing is remembered.
    file: Option<PathBuf>,
    chosen: Remembered,
    /// What the window showed when it was last compared.
    shown: Option<Remembered>,
    /// When a choice that is not written yet was made.
    changed_at: Option<Duration>,
    writing: Background<()>,
    /// Whether the volume shown has its first light already.
    is_lit: bool,
    /// A size that a state asks for, and until when it may come. It is no choice.
    awaited_size: Option<([u32; 2], Duration)>,
}

impl ChoiceKeeper {
    /// `is_lit` if the first volume comes with a light that somebody chose.
    pub(super) fn new(file: Option<PathBuf>, chosen: Remembered, is_lit: bool) -> Self {
        Self { file, chosen, is_lit, ..Self::default() }
    }

    /// What changes until the next comparison is no choice: a state sets it. `has_light` if it sets the light, too.
    pub(super) fn forget_shown(&mut self, has_light: bool) {
        self.shown = None;
        self.is_lit |= has_light;
    }

    /// A state asks for a size of the window.
    pub(super) fn await_size(&mut self, now: Duration, size: [u32; 2]) {
        self.awaited_size = Some((size, now + SIZE_PATIENCE));
    }

    /// The person has set the light.
    pub(super) fn note_light(&mut self, now: Duration, light: Lighting) {
        (self.is_lit, self.chosen.light, self.changed_at) = (true, Some(light), Some(now));
    }

    /// Another source is shown.
    pub(super) fn turn(&mut self) {
        (self.shown, self.is_lit) = (None, false);
    }

    /// Takes over what differs from what was shown before.
    fn note(&mut self, now: Duration, mut shown: Remembered) {
        if let Some((wanted, until)) = self.awaited_size {
            let is_near = |size: [u32; 2]| (0..2).all(|side| size[side].abs_diff(wanted[side]) <= 1);
            match shown.size.is_some_and(is_near) || now >= until {
                true => self.awaited_size = None,
                false => shown.size = None,
            }
        }
        let Some(before) = self.shown.replace(shown.clone()) else { return };
        let chosen = self.chosen.clone();
        fn newer<T: PartialEq>(before: Option<T>, shown: Option<T>, chosen: &mut Option<T>) {
            if before != shown && before.is_some() && shown.is_some() {
                *chosen = shown;
            }
        }
        newer(before.size, shown.size, &mut self.chosen.size);
        newer(before.panel, shown.panel, &mut self.chosen.panel);
        let (of_before, of_shown, view) = (before.view, shown.view, &mut self.chosen.view);
        newer(of_before.theme, of_shown.theme, &mut view.theme);
        newer(of_before.background, of_shown.background, &mut view.background);
        newer(of_before.shows_axes, of_shown.shows_axes, &mut view.shows_axes);
        newer(of_before.shows_box, of_shown.shows_box, &mut view.shows_box);
        newer(of_before.shows_legend, of_shown.shows_legend, &mut view.shows_legend);
        if self.chosen != chosen {
            self.changed_at = Some(now);
        }
    }

    /// Writes choices that have not changed for a while. A disk that fails loses them, and nothing else.
    fn write(&mut self, ctx: &egui::Context, now: Duration) {
        if let Some(Err(problem)) = self.writing.take() {
            tracing::warn!("choices are not kept: {problem}");
        }
        let Some(file) = self.file.clone() else { return };
        let Some(at) = self.changed_at.filter(|_| !self.writing.is_busy()) else { return };
        if now < at + WRITE_AFTER {
            ctx.request_repaint_after(at + WRITE_AFTER - now);
            return;
        }
        self.changed_at = None;
        let text = self.chosen.to_toml();
        self.writing = Background::run(&waker_of(ctx), move || write_own(&file, text.as_bytes()));
    }

    /// Writes at once what is not written yet, for a window that has closed.
    fn finish(&mut self) {
        let running = self.writing.finish().unwrap_or(Ok(()));
        let file = self.file.as_ref().filter(|_| self.changed_at.take().is_some());
        let rest = file.map_or(Ok(()), |file| write_own(file, self.chosen.to_toml().as_bytes()));
        if let Err(problem) = running.and(rest) {
            tracing::warn!("choices are not kept: {problem}");
        }
    }
}

impl<S: FrameSource> ViewerApp<S> {
    /// Call this once in a refresh.
    pub(super) fn keep_choices(&mut self, ctx: &egui::Context, now: Duration, has_frame: bool) {
        if self.keeper.file.is_none() {
            return;
        }
        if has_frame {
            self.light_once(now);
        }
        let theme = ctx.options(|o| o.theme_preference);
        let view = SavedView {
            theme: THEMES.iter().find(|(_, t)| *t == theme).map(|(theme, _)| *theme),
            background: Some(Srgb(self.aids.background)),
            shows_axes: Some(self.aids.shows_axes),
            shows_box: Some(self.aids.shows_box),
            shows_legend: Some(self.aids.shows_legend),
            ..SavedView::default()
        };
        let panel = self.shows_bars.then_some(self.is_look_open);
        let shown = Remembered { size: window_size(ctx), panel, view, light: None };
        self.keeper.note(now, shown);
        self.keeper.write(ctx, now);
    }

    /// Keeps the last choices of a window that has closed.
    pub(crate) fn finish_choices(&mut self) {
        self.keeper.finish();
    }

    /// Gives a volume the person's light behind its first frame, unless it came with a light. So the first frame waits
    /// for no shade. The server's time must be known by then.
    fn light_once(&mut self, now: Duration) {
        if self.keeper.is_lit {
            return;
        }
        let Some(time) = self.viewing.time_of_frame() else { return };
        self.keeper.is_lit = true;
        // On a slow server every edit would wait for its shade at rest. There, the person decides.
        if time > LONGEST_FRAME && self.keeper.chosen.light.is_none() {
            return;
        }
        let Some(welcome) = self.viewing.source().description() else { return };
        let letters = welcome.volume.orientation.as_deref();
        let first = Lighting::default().upright(letters);
        let Some(look) =
            self.viewing.look().filter(|look| [first, Lighting::default()].contains(&look.lighting))
        else {
            return;
        };
        let lighting = self.keeper.chosen.light.unwrap_or_else(|| usual_lighting().upright(letters));
        if lighting != look.lighting {
            self.viewing.set_look(now, Look { lighting, ..(*look).clone() });
        }
    }

    /// Returns to the first choices.
    pub(super) fn reset_choices(&mut self, ctx: &egui::Context, now: Duration) {
        self.keeper.chosen = Remembered::default();
        self.keeper.changed_at = Some(now);
        ctx.set_theme(THEMES.first().map_or(ThemePreference::Dark, |(theme, _)| theme_preference(*theme)));
        let first = ViewAids::default();
        self.aids.background = first.background;
        (self.aids.shows_axes, self.aids.shows_box) = (true, first.shows_box);
        self.aids.shows_legend = first.shows_legend;
        if let Some(look) = self.viewing.look() {
            self.viewing.set_look(now, Look { lighting: usual_lighting(), ..(*look).clone() });
        }
        // What this changes is no choice.
        self.keeper.forget_shown(true);
        self.tell(now, "Settings reset to defaults");
        ctx.request_repaint();
    }
}

/// Columns and rows of the window, points, while it is an ordinary one.
fn window_size(ctx: &egui::Context) -> Option<[u32; 2]> {
    ctx.input(|i| {
        let window = i.viewport();
        let is_whole = [window.fullscreen, window.maximized, window.minimized].contains(&Some(true));
        let size = window.inner_rect.filter(|_| !is_whole)?.size();
        Some([size.x.round() as u32, size.y.round() as u32])
    })
}

/// The longest time of a server for a whole frame with which ambient occlusion is on from the first.
const LONGEST_FRAME: Duration = Duration::from_secs(1);
/// A window takes the size that it is asked for within this time, or never.
const SIZE_PATIENCE: Duration = Duration::from_secs(2);
/// Choices are written when none has changed for this time.
const WRITE_AFTER: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use isinglass_formats::Theme;

    use super::*;

    #[test]
    fn what_changes_in_the_window_is_a_choice_and_what_it_began_with_is_none() {
        let of = |theme, size| Remembered {
            size: Some(size),
            view: SavedView { theme: Some(theme), ..SavedView::default() },
            ..Remembered::default()
        };
        let mut keeper = ChoiceKeeper::default();
        keeper.note(Duration::ZERO, of(Theme::Light, [700, 500]));
        assert_eq!((&keeper.chosen, keeper.changed_at), (&Remembered::default(), None), "flags set this");
        keeper.note(Duration::from_secs(1), of(Theme::System, [700, 500]));
        let theme_only = Remembered { size: None, ..of(Theme::System, [0; 2]) };
        assert_eq!((&keeper.chosen, keeper.changed_at), (&theme_only, Some(Duration::from_secs(1))));
        // A state is no choice either.
        keeper.forget_shown(true);
        keeper.note(Duration::from_secs(2), of(Theme::Dark, [900, 500]));
        assert_eq!(keeper.chosen, theme_only);
        keeper.note(Duration::from_secs(3), of(Theme::Dark, [901, 500]));
        let wide = Remembered { size: Some([901, 500]), ..theme_only };
        assert_eq!(keeper.chosen, wide);
        // Nor is the size that a state asks for, whenever it comes.
        keeper.await_size(Duration::from_secs(4), [640, 480]);
        for (tenths, size) in [(41, [901, 500]), (42, [901, 500]), (43, [641, 480]), (44, [641, 480])] {
            keeper.note(Duration::from_millis(100 * tenths), of(Theme::Dark, size));
            assert_eq!(keeper.chosen, wide, "{size:?}");
        }
        keeper.note(Duration::from_secs(5), of(Theme::Dark, [650, 480]));
        assert_eq!(keeper.chosen.size, Some([650, 480]), "the person's own");
        keeper.await_size(Duration::from_secs(6), [99_999, 480]);
        keeper.note(Duration::from_secs(7), of(Theme::Dark, [1920, 480]));
        keeper.note(Duration::from_secs(9), of(Theme::Dark, [1920, 480]));
        assert_eq!(keeper.chosen.size, Some([650, 480]), "a size that the screen does not have");
        keeper.note(Duration::from_secs(10), of(Theme::Dark, [1900, 480]));
        assert_eq!(keeper.chosen.size, Some([1900, 480]));
    }
}
