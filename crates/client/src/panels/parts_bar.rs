//! The bar at the bottom: channel, time, level and series of the server's file, a choice of others, and the progress
//! of reading.

mod player;

use std::time::Duration;

use egui::{Align2, ProgressBar, RichText, Ui, vec2};
use isinglass_core::ids::LoadId;
use isinglass_core::wire::{Choices, LoadState, LoadStatus, Part};
use lucide_icons::Icon;

use super::part_pickers::{channel_list, label, list, numbered, time_field};
use super::style::{amber, icon, named, pane_at};
use super::text::{format_bytes, format_duration};
use crate::input::bindings::{Action, Bindings};
use player::Player;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PartsWish {
    Open(Part),
    Cancel,
}

#[derive(Debug, Default)]
pub(crate) struct PartsBar {
    /// The requested part, and the server's newest load at that time. It counts until the server reports a later
    /// load.
    asked: Option<(Part, LoadId)>,
    /// A load that failed, and when that was first shown.
    failed: Option<(LoadId, Duration)>,
    /// The time to which the person drags the number.
    dragged: Option<u32>,
    player: Player,
    height: f32,
    /// Distance of the bar from the window's left, points.
    left: f32,
    /// Width of the pickers in one row, as last drawn, points.
    row_width: f32,
}

impl PartsBar {
    /// The part to count from: the requested one, or the one being read, or the one shown.
    fn chosen(&self, parts: &Choices, load: Option<&LoadStatus>) -> Part {
        let is_reading = |l: &&LoadStatus| matches!(l.state, LoadState::Reading { .. });
        let read = load.filter(is_reading).map(|l| whole(l.part, parts));
        self.asked.map(|(part, _)| part).or(read).unwrap_or(parts.shown)
    }

    /// A step in time, if there is another time.
    pub(crate) fn step(&mut self, parts: &Choices, load: Option<&LoadStatus>, by: i32) -> Option<PartsWish> {
        let chosen = self.chosen(parts, load);
        let now = chosen.time.unwrap_or(0);
        let time = now.saturating_add_signed(by).min(parts.num_times - 1);
        (time != now).then(|| self.open(Part { time: Some(time), ..chosen }, load))
    }

    /// Requests a part, from which steps count until the server reports its load. Playing ends.
    pub(crate) fn open(&mut self, part: Part, load: Option<&LoadStatus>) -> PartsWish {
        self.player.stop();
        self.request(part, load)
    }

    fn request(&mut self, part: Part, load: Option<&LoadStatus>) -> PartsWish {
        self.asked = Some((part, load.map_or(LoadId(0), |l| l.load)));
        self.failed = None;
        PartsWish::Open(part)
    }

    /// Drops the request: it is lost with the connection.
    pub(crate) fn forget(&mut self) {
        self.asked = None;
        self.player.stop();
    }

    /// Begins to play the times, or ends it. Returns whether there are times to play.
    pub(crate) fn toggle_play(&mut self, now: Duration, parts: &Choices, load: Option<&LoadStatus>) -> bool {
        match self.player.is_playing() {
            true => self.player.stop(),
            false if parts.num_times > 1 => self.player.start(now, load),
            false => return false,
        }
        true
    }

    /// Whether the times are being played.
    pub(crate) fn is_playing(&self) -> bool {
        self.player.is_playing()
    }

    /// The next time of a film that plays. `is_shown` if a frame of the present part is on the screen.
    pub(crate) fn play(
        &mut self,
        now: Duration,
        parts: &Choices,
        load: Option<&LoadStatus>,
        is_shown: bool,
    ) -> Option<PartsWish> {
        self.follow(now, load);
        let time = self.player.step(now, parts, load, (self.asked.is_some(), is_shown))?;
        Some(self.request(Part { time: Some(time), ..self.chosen(parts, load) }, load))
    }

    /// How long the next time is not due yet.
    pub(crate) fn wait(&self, now: Duration) -> Option<Duration> {
        self.player.wait(now)
    }

    /// The height of the bar with the space below it, points.
    pub(crate) fn height(&self) -> f32 {
        self.height
    }

    /// The same if the bar covers the window's first `width` points, else 0.
    pub(crate) fn height_over(&self, width: f32) -> f32 {
        if self.left < width { self.height } else { 0.0 }
    }

    /// Shows the bar in `room` if there is a choice; returns the choice.
    pub(crate) fn show(
        &mut self,
        ctx: &egui::Context,
        now: Duration,
        room: egui::Rect,
        bindings: &Bindings,
        parts: Option<&Choices>,
        load: Option<&LoadStatus>,
    ) -> Option<PartsWish> {
        self.height = 0.0;
        let parts = parts.filter(|p| p.has_choice() || load.is_some())?;
        self.follow(now, load);
        let mut chosen = self.chosen(parts, load);
        let before = chosen;
        let (mut wish, mut plays) = (None, false);
        let width = (room.width() - 44.0).max(160.0);
        let place = (Align2::CENTER_BOTTOM, [0.0, -10.0]);
        let shown = pane_at(ctx, "parts", room, place, |ui| {
            ui.spacing_mut().item_spacing = vec2(6.0, 4.0);
            ui.set_max_width(width);
            let is_wide = self.row_width > width;
            let (dragged, is_playing) = (&mut self.dragged, self.player.is_playing());
            let row = |ui: &mut Ui| pickers(ui, parts, &mut chosen, dragged, bindings, is_playing);
            let row = if is_wide { ui.horizontal_wrapped(row) } else { ui.horizontal(row) };
            if !is_wide {
                self.row_width = row.response.rect.width();
            }
            plays = row.inner;
            let is_news = |load: &&LoadStatus| !(load.is_own && self.player.is_swift(now));
            if let Some(load) = load.filter(is_news)
                && self.status_row(ui, load)
            {
                wish = Some(PartsWish::Cancel);
            }
        });
        let rect = shown.response.rect;
        (self.height, self.left) = (rect.height() + 10.0, rect.left() - room.left());
        if plays {
            self.toggle_play(now, parts, load);
        }
        if chosen.time != before.time {
            wish = Some(self.open(chosen, load));
        } else if chosen != before {
            wish = Some(self.request(chosen, load));
        }
        if wish == Some(PartsWish::Cancel) {
            self.forget();
        }
        wish
    }

    fn follow(&mut self, now: Duration, load: Option<&LoadStatus>) {
        let Some(load) = load else { return };
        let is_over = !matches!(load.state, LoadState::Reading { .. });
        if is_over && self.asked.is_some_and(|(_, before)| load.load > before) {
            self.asked = None;
        }
        if matches!(load.state, LoadState::Failed(_)) {
            if self.failed.is_none_or(|(id, _)| id != load.load) {
                self.failed = Some((load.load, now));
            }
        } else {
            self.failed = None;
        }
        if self.failed.is_some_and(|(_, since)| now > since + FAILURE_TIME) {
            self.failed = Some((load.load, Duration::ZERO));
        }
    }

    /// The progress of a load; returns whether to cancel it.
    fn status_row(&self, ui: &mut Ui, load: &LoadStatus) -> bool {
        match &load.state {
            LoadState::Reading { permille } => {
                let row = ui.horizontal(|ui| {
                    let whose = if load.is_own { "reading" } else { "reading for another viewer" };
                    let size = match load.bytes_needed {
                        0 => String::new(),
                        bytes => format!(", {}", format_bytes(bytes)),
                    };
                    ui.label(RichText::new(format!("{whose} {}{size}", in_words(&load.part))).size(12.0));
                    let bar = ProgressBar::new(f32::from(*permille) / 1000.0).desired_width(130.0);
                    let bar = ui.add(
                        bar.desired_height(12.0)
                            .text(RichText::new(format!("{} %", permille / 10)).size(10.0)),
                    );
                    named(&bar, egui::Role::ProgressIndicator, "read");
                    let cancel = ui.small_button("cancel").on_hover_text("what is shown stays");
                    cancel.clicked()
                });
                row.inner
            }
            LoadState::Failed(problem) if self.failed.is_some_and(|(_, since)| !since.is_zero()) => {
                let color = amber(ui.ctx());
                ui.add(egui::Label::new(RichText::new(problem).size(12.0).color(color)).wrap());
                false
            }
            LoadState::Failed(_) | LoadState::Done | LoadState::Cancelled => false,
        }
    }
}

/// A row with a picker for each axis with more than one entry. Returns whether to begin or end playing.
fn pickers(
    ui: &mut Ui,
    parts: &Choices,
    chosen: &mut Part,
    dragged: &mut Option<u32>,
    bindings: &Bindings,
    is_playing: bool,
) -> bool {
    let mut plays = false;
    if parts.num_times > 1 {
        let last = parts.num_times - 1;
        let mut time = dragged.take().or(chosen.time).unwrap_or(0);
        label(ui, "time");
        let back = ui
            .add_enabled(time > 0, egui::Button::new("−").small())
            .on_hover_text(bindings.with_key("the time before", Action::StepTime(-1)));
        named(&back, egui::Role::Button, "the time before");
        let (symbol, name) = if is_playing { (Icon::Pause, "pause") } else { (Icon::Play, "play the times") };
        let hint = match is_playing {
            true => "stop at this time".to_owned(),
            false => format!("play, a time every {}", format_duration(player::interval(parts))),
        };
        let play = ui.add(egui::Button::new(icon(symbol).size(12.0)).small());
        let play = play.on_hover_text(bindings.with_key(&hint, Action::Play));
        named(&play, egui::Role::Button, name);
        plays = play.clicked();
        let number = time_field(ui, &mut time, last);
        let on = ui
            .add_enabled(time < last, egui::Button::new("+").small())
            .on_hover_text(bindings.with_key("the next time", Action::StepTime(1)));
        named(&on, egui::Role::Button, "the next time");
        time = time + u32::from(on.clicked()) - u32::from(back.clicked() && time > 0);
        // A dragged number counts when it is released.
        match number.dragged() {
            true => *dragged = Some(time),
            false => chosen.time = Some(time.min(last)),
        }
        label(ui, &format!("of 0 to {last}"));
    }
    if parts.num_channels > 1 {
        let name = |i: u32| numbered(i, parts.channels.get(i as usize));
        channel_list(ui, parts.num_channels as usize, parts.joins_channels, &mut chosen.channel, name);
    }
    if parts.levels.len() > 1 {
        let mut level = chosen.level.unwrap_or(0);
        let name = |i: u32| {
            let [x, y, z] = parts.levels.get(i as usize).copied().unwrap_or_default();
            format!("{i}: {x}×{y}×{z}")
        };
        if list(ui, "level", parts.levels.len(), &mut level, name) {
            // A region counts the voxels of its level.
            *chosen = Part { level: Some(level), region: None, ..*chosen };
        }
    }
    if parts.num_series > 1 {
        let mut series = chosen.series.unwrap_or(0);
        let name = |i: u32| numbered(i, parts.series.get(i as usize));
        if list(ui, "series", parts.num_series as usize, &mut series, name) {
            // Another series has its own channels, times and levels.
            *chosen = Part { series: Some(series), ..Part::default() };
        }
    }
    plays
}

fn in_words(part: &Part) -> String {
    let named =
        [("series", part.series), ("level", part.level), ("channel", part.channel), ("time", part.time)];
    let words: Vec<String> = named
        .into_iter()
        .filter_map(|(what, n)| n.filter(|n| *n > 0).map(|n| format!("{what} {n}")))
        .collect();
    if words.is_empty() { "the first part".into() } else { words.join(", ") }
}

/// Fills what a part does not name from the part shown.
fn whole(part: Part, parts: &Choices) -> Part {
    let shown = parts.shown;
    Part {
        channel: part.channel.or(if parts.joins_channels { None } else { shown.channel }),
        time: part.time.or(shown.time),
        level: part.level.or(shown.level),
        series: part.series.or(shown.series),
        region: part.region,
        flip: part.flip,
    }
}

const FAILURE_TIME: Duration = Duration::from_secs(12);

#[cfg(test)]
mod tests {
    use super::*;

    fn parts() -> Choices {
        Choices {
            shown: Part {
                channel: Some(0),
                time: Some(1),
                level: Some(0),
                series: Some(0),
                ..Part::default()
            },
            whole_dims: [4; 3],
            num_channels: 2,
            num_times: 4,
            num_series: 1,
            ..Choices::default()
        }
    }

    fn load(number: u32, part: Part, state: LoadState) -> LoadStatus {
        LoadStatus { load: LoadId(number), is_own: true, part, bytes_needed: 0, state }
    }

    fn at(time: u32) -> Part {
        Part { time: Some(time), ..parts().shown }
    }

    #[test]
    fn steps_count_from_what_was_asked_for_and_end_at_the_ends() {
        let (mut bar, parts) = (PartsBar::default(), parts());
        for time in [2, 3] {
            assert_eq!(bar.step(&parts, None, 1), Some(PartsWish::Open(at(time))));
        }
        assert_eq!(bar.step(&parts, None, 1), None);
        for time in [2, 1, 0] {
            assert_eq!(bar.step(&parts, None, -1), Some(PartsWish::Open(at(time))));
        }
        assert_eq!(bar.step(&parts, None, -1), None);
    }

    #[test]
    fn a_wish_holds_until_the_server_has_told_of_a_later_load() {
        let (mut bar, parts) = (PartsBar::default(), parts());
        let earlier = load(3, at(2), LoadState::Failed("no".into()));
        assert_eq!(bar.step(&parts, Some(&earlier), 1), Some(PartsWish::Open(at(2))));
        bar.follow(Duration::ZERO, Some(&earlier));
        assert_eq!(bar.chosen(&parts, Some(&earlier)), at(2), "the server has not heard of it");
        let reading = load(4, at(2), LoadState::Reading { permille: 10 });
        bar.follow(Duration::ZERO, Some(&reading));
        assert_eq!(bar.chosen(&parts, Some(&reading)), at(2));
        let failed = load(4, at(2), LoadState::Failed("no".into()));
        bar.follow(Duration::from_secs(1), Some(&failed));
        assert_eq!(bar.chosen(&parts, Some(&failed)), at(1), "what is shown stays");
        // What another viewer asks for is what is counted from.
        let others = LoadStatus {
            is_own: false,
            ..load(5, Part { time: Some(3), ..Part::default() }, LoadState::Reading { permille: 0 })
        };
        bar.follow(Duration::from_secs(2), Some(&others));
        assert_eq!(bar.chosen(&parts, Some(&others)), at(3));
    }

    #[test]
    fn parts_are_called_by_what_is_not_the_first() {
        assert_eq!(in_words(&at(0)), "the first part");
        let part = Part { series: Some(2), channel: Some(1), ..at(3) };
        assert_eq!(in_words(&part), "series 2, channel 1, time 3");
        assert_eq!(numbered(1, Some(&"GFP".into())), "1: GFP");
        assert_eq!(numbered(1, Some(&"1".into())), "1");
        assert_eq!(numbered(7, None), "7");
    }
}
