//! The badge at the top left, and the numbers behind it: connection, age of the frame, times and rates.

use std::time::Duration;

use egui::{Align2, Color32, RichText, Ui, vec2};
use isinglass_core::volume::PageProgress;
use isinglass_net::{Carrier, State};
use lucide_icons::Icon;

use super::style::{self, bright, icon, pane_at, quiet};
use super::text::{format_duration, format_rate, sentence};
use crate::view::viewing::Standing;

/// Everything that the overlay shows; an unknown number is shown as a dash.
#[derive(Clone, Debug, PartialEq)]
pub struct OverlayModel {
    /// The connection.
    pub state: State,
    /// What carries its packets.
    pub carrier: Carrier,
    /// How the picture relates to the server's.
    pub standing: Standing,
    /// How far the pages of a volume are that is read by pages.
    pub pages: Option<PageProgress>,
    /// How long a connected server has not answered, if it should have.
    pub silence: Option<Duration>,
    /// Round-trip time of the connection.
    pub round_trip: Option<Duration>,
    /// Time since the camera was last at the pose of the frame on screen.
    pub frame_age: Option<Duration>,
    /// Angle between the pose of the frame on screen and the camera, around the volume's centre.
    pub turned_degrees: Option<f32>,
    /// The time of drawing.
    pub view_time: ViewTime,
    /// Time the server took for the newest frame.
    pub generate: Option<Duration>,
    /// Bytes received in about the last second.
    pub bytes_per_second: f64,
    /// Frames of the server that were decoded in the last second.
    pub new_frames_per_second: u32,
    /// Refreshes in the last second; none at rest.
    pub refreshes_per_second: Option<f64>,
}

/// The time of a novel view, as exactly as the adapter can tell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ViewTime {
    /// Measured on the GPU with timestamps.
    Gpu(Duration),
    /// The time between refreshes, for an adapter without timestamps: it includes waiting for the display.
    FrameInterval(Duration),
    /// Nothing was drawn lately.
    Unknown,
}

/// A line of the overlay: name and value.
pub type Row = (&'static str, String);

impl OverlayModel {
    /// The lines under the badge, in a fixed order, so that each number keeps its place.
    pub fn rows(&self) -> Vec<Row> {
        let duration = |d: Option<Duration>| d.map_or_else(dash, format_duration);
        let is_current = self.frame_age == Some(Duration::ZERO);
        let view = match self.view_time {
            ViewTime::Gpu(d) => ("novel view", format_duration(d)),
            ViewTime::FrameInterval(d) => ("frame interval", format_duration(d)),
            ViewTime::Unknown => ("novel view", dash()),
        };
        let mut rows = vec![
            ("link", self.link()),
            ("round trip", duration(self.round_trip)),
            ("frame age", if is_current { "current".to_owned() } else { duration(self.frame_age) }),
            ("turned by", self.turned_degrees.map_or_else(dash, |d| format!("{d:.1}°"))),
            view,
            ("server frame", duration(self.generate)),
            ("new frames", format!("{} /s", self.new_frames_per_second)),
            ("received", format_rate(self.bytes_per_second)),
            (
                "refresh",
                self.refreshes_per_second.map_or_else(|| "at rest".to_owned(), |f| format!("{f:.0} fps")),
            ),
        ];
        rows.extend(self.pages.map(|p| ("parts", format!("{} of {}", p.num_resident, p.num_wanted))));
        rows
    }

    /// The word on the badge.
    fn word(&self) -> String {
        let word = self.standing.word();
        match self.pages.filter(|pages| self.standing == Standing::Refining && pages.is_loading()) {
            // It is not all there until the last part is.
            Some(pages) => format!("{word} {} %", (pages.share() * 100.0).min(99.0) as u32),
            None => word.into(),
        }
    }

    /// Its hover text.
    fn explanation(&self) -> String {
        let Some(pages) = self.pages.filter(|pages| !pages.is_exact()) else {
            return self.standing.explanation().into();
        };
        let mut lines = Vec::new();
        if pages.is_loading() {
            lines.push("Finer parts of the volume are being read.".into());
        } else if pages.coarse_share > 0.0 {
            let percent = (pages.coarse_share * 100.0).ceil();
            lines.push(format!("The finest that fits: {percent:.0} % of the view is coarser than the file."));
        }
        if pages.num_damaged > 0 {
            let num = pages.num_damaged;
            lines.push(format!("Unreadable parts of the file: {num}. Coarser ones stand for them."));
        }
        lines.join("\n")
    }

    fn link(&self) -> String {
        let word = state_word(&self.state);
        if self.state == State::Connected { format!("{word}, {}", self.carrier) } else { word.to_owned() }
    }

    /// One line about trouble of the connection. The last picture stays in use.
    pub fn banner(&self) -> Option<String> {
        match &self.state {
            State::Connected => {
                let seconds = self.silence?.as_secs();
                Some(format!("No answer from the server for {seconds} s; the last picture stays usable."))
            }
            State::Connecting { .. } => None,
            State::Reconnecting { problem, .. } => {
                Some(format!("Reconnecting; the last picture stays usable. {}", sentence(problem)))
            }
            State::Refused(problem) => Some(format!("Disconnected. {}", sentence(problem))),
        }
    }

    /// What only an expert reads of the trouble.
    pub fn details(&self) -> Option<String> {
        match &self.state {
            State::Reconnecting { problem, .. } | State::Refused(problem) => problem.details(),
            State::Connected | State::Connecting { .. } => None,
        }
    }
}

impl Standing {
    /// The word on the badge.
    pub fn word(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Moving => "moving",
            Self::Refining => "refining",
            Self::Following => "following",
            Self::Offline => "offline",
            Self::Settled => "settled",
            Self::Exact => "exact",
        }
    }

    /// The explanation of the word, as hover text.
    pub fn explanation(self) -> &'static str {
        match self {
            Self::Waiting => "There is no picture yet.",
            Self::Moving => "Drawn here, at once, from the newest layered frame.",
            Self::Refining => "The server's frame for this view is on its way.",
            Self::Following => "Drawn here from the pictures of the person that you follow.",
            Self::Offline => "Drawn here from the last frame that came: there is no connection.",
            Self::Settled => {
                "The server's whole frame for this view, at another size than the window's or for two eyes."
            }
            Self::Exact => "The server's own picture of this view, pixel by pixel.",
        }
    }
}

fn state_word(state: &State) -> &'static str {
    match state {
        State::Connecting { .. } => "connecting",
        State::Connected => "connected",
        State::Reconnecting { .. } => "reconnecting",
        State::Refused(_) => "refused",
    }
}

/// What the badge takes of the picture's upper left corner, with the numbers or without, with gaps, points.
pub(crate) fn size_taken(room_width: f32, shows_numbers: bool) -> egui::Vec2 {
    let height = if shows_numbers { 230.0 } else { 40.0 };
    vec2(width_in(room_width, shows_numbers) + GAPS, height)
}

/// Width of the pane's content in a room, points. In a small room, the line at the bottom has the name alone.
fn width_in(room_width: f32, shows_numbers: bool) -> f32 {
    match shows_numbers {
        true => NUMBERS_WIDTH,
        false if has_name_in(room_width) => BADGE_WIDTH,
        false => WIDTH_WITHOUT_NAME,
    }
}

fn has_name_in(room_width: f32) -> bool {
    room_width >= LEAST_ROOM_WITH_NAME
}

/// Shows the name of the volume and the badge at the top left of `room`, and the numbers below if they are wanted.
/// Returns whether the person switches the numbers.
pub(crate) fn show(
    ctx: &egui::Context,
    room: egui::Rect,
    name: &str,
    model: &OverlayModel,
    shows_numbers: bool,
) -> bool {
    let place = (Align2::LEFT_TOP, [10.0, 10.0]);
    let shown = pane_at(ctx, "overlay", room, place, |ui| {
        // A fixed width: the pane must not change its size with the digits.
        ui.set_width(width_in(room.width(), shows_numbers).min((room.width() - GAPS).max(60.0)));
        ui.spacing_mut().item_spacing = vec2(6.0, 2.0);
        ui.spacing_mut().interact_size.y = 0.0;
        let line = vec2(ui.available_width(), 20.0);
        let has_name = shows_numbers || has_name_in(room.width());
        let switched =
            ui.allocate_ui_with_layout(line, egui::Layout::right_to_left(egui::Align::Center), |ui| {
                let numbers = egui::Button::new(icon(Icon::Info).size(14.0)).frame(false);
                let numbers = ui.add(numbers).on_hover_text("network and frames, in numbers");
                numbers.widget_info(|| {
                    egui::WidgetInfo::selected(egui::Role::CheckBox, true, shows_numbers, "numbers")
                });
                if has_name {
                    badge(ui, model);
                }
                ui.with_layout(egui::Layout::left_to_right(egui::Align::Center), |ui| match has_name {
                    true => {
                        let name = RichText::new(name).color(bright(ctx)).size(13.0);
                        ui.add(egui::Label::new(name).truncate());
                    }
                    false => badge(ui, model),
                });
                numbers.clicked()
            });
        if shows_numbers {
            ui.add_space(3.0);
            for (name, value) in model.rows() {
                row(ui, name, &value);
            }
        }
        switched.inner
    });
    shown.inner
}

/// A dot in the colour of the connection's state.
pub(crate) fn connection_dot(ui: &mut Ui, state: &State, is_silent: bool) {
    let standing = match state {
        State::Connected if is_silent => Standing::Offline,
        State::Connected => Standing::Exact,
        State::Connecting { .. } => Standing::Waiting,
        State::Reconnecting { .. } | State::Refused(_) => Standing::Offline,
    };
    let color = color(ui, standing);
    let (dot, response) = ui.allocate_exact_size(vec2(9.0, 14.0), egui::Sense::hover());
    ui.painter().circle_filled(dot.center(), 4.0, color);
    response.on_hover_text(if is_silent { "no answer" } else { state_word(state) });
}

fn color(ui: &Ui, standing: Standing) -> Color32 {
    match standing {
        Standing::Exact | Standing::Settled => style::done(ui.ctx()),
        Standing::Moving | Standing::Refining | Standing::Following => style::accent(ui.ctx()),
        Standing::Offline => style::amber(ui.ctx()),
        Standing::Waiting => quiet(ui.ctx()),
    }
}

fn badge(ui: &mut Ui, model: &OverlayModel) {
    let color = color(ui, model.standing);
    // The dot is before the word, whichever way the line goes.
    let is_reversed = ui.layout().prefer_right_to_left();
    let dot = |ui: &mut Ui| {
        let (dot, _) = ui.allocate_exact_size(vec2(9.0, 14.0), egui::Sense::hover());
        ui.painter().circle_filled(dot.center(), 4.0, color);
    };
    if !is_reversed {
        dot(ui);
    }
    let word = ui.label(RichText::new(model.word()).color(color).strong().size(13.0));
    if is_reversed {
        dot(ui);
    }
    word.on_hover_text(model.explanation());
}

fn row(ui: &mut Ui, name: &str, value: &str) {
    ui.horizontal(|ui| {
        ui.label(RichText::new(name).color(quiet(ui.ctx())).size(11.5));
        ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
            ui.label(RichText::new(value).color(bright(ui.ctx())).size(11.5));
        });
    });
}

fn dash() -> String {
    "–".to_owned()
}

/// Width of the numbers, points.
const NUMBERS_WIDTH: f32 = 220.0;
/// Width of the name and the badge, points.
const BADGE_WIDTH: f32 = 220.0;
/// Width of the badge alone, points.
const WIDTH_WITHOUT_NAME: f32 = 98.0;
/// Rooms this wide have the name beside the badge, points.
const LEAST_ROOM_WITH_NAME: f32 = 520.0;
/// Gaps around the pane and in it, points.
const GAPS: f32 = 42.0;

#[cfg(test)]
mod tests {
    use isinglass_net::ConnectError;

    use super::*;

    fn model() -> OverlayModel {
        OverlayModel {
            state: State::Connected,
            carrier: Carrier::Udp,
            standing: Standing::Moving,
            pages: None,
            silence: None,
            round_trip: Some(Duration::from_millis(201)),
            frame_age: Some(Duration::from_millis(268)),
            turned_degrees: Some(7.94),
            view_time: ViewTime::Gpu(Duration::from_micros(2340)),
            generate: Some(Duration::from_micros(41_200)),
            bytes_per_second: 3.21e6,
            new_frames_per_second: 23,
            refreshes_per_second: Some(59.7),
        }
    }

    fn row(m: &OverlayModel, name: &str) -> String {
        m.rows().into_iter().find(|(n, _)| *n == name).unwrap_or_else(|| panic!("no row {name}")).1
    }

    #[test]
    fn every_number_is_shown_with_its_unit() {
        let m = model();
        for (name, text) in [
            ("link", "connected, UDP"),
            ("round trip", "201 ms"),
            ("frame age", "268 ms"),
            ("turned by", "7.9°"),
            ("novel view", "2.3 ms"),
            ("server frame", "41 ms"),
            ("new frames", "23 /s"),
            ("received", "3.2 MB/s"),
            ("refresh", "60 fps"),
        ] {
            assert_eq!(row(&m, name), text, "{name}");
        }
    }

    #[test]
    fn the_badge_tells_how_far_the_pages_are() {
        let of = |standing, num_resident, num_damaged, coarse_share| {
            let pages = PageProgress { num_wanted: 200, num_resident, num_damaged, coarse_share };
            OverlayModel { standing, pages: Some(pages), ..model() }
        };
        let loading = of(Standing::Refining, 124, 0, 0.0);
        assert_eq!((loading.word(), row(&loading, "parts")), ("refining 62 %".into(), "124 of 200".into()));
        assert_eq!(of(Standing::Refining, 199, 0, 0.0).word(), "refining 99 %");
        assert_eq!(of(Standing::Moving, 124, 0, 0.0).word(), "moving");
        let coarse = of(Standing::Settled, 198, 2, 0.375).explanation();
        assert!(coarse.contains("38 %") && coarse.contains("Unreadable parts of the file: 2."), "{coarse}");
        // All there, or no pages at all: nothing is added.
        let whole = of(Standing::Exact, 200, 0, 0.0);
        assert_eq!(
            (whole.word(), whole.explanation()),
            ("exact".into(), Standing::Exact.explanation().into())
        );
        assert!(model().rows().iter().all(|(name, _)| *name != "parts"));
    }

    #[test]
    fn a_frame_interval_is_never_called_the_time_of_a_novel_view() {
        let m = OverlayModel { view_time: ViewTime::FrameInterval(Duration::from_millis(16)), ..model() };
        assert_eq!(row(&m, "frame interval"), "16 ms");
        assert!(m.rows().iter().all(|(name, _)| *name != "novel view"));
    }

    #[test]
    fn the_unknown_is_a_dash_and_the_rows_stay_in_place() {
        let m = OverlayModel {
            round_trip: None,
            frame_age: None,
            turned_degrees: None,
            view_time: ViewTime::Unknown,
            generate: None,
            refreshes_per_second: None,
            ..model()
        };
        for name in ["round trip", "frame age", "turned by", "novel view", "server frame"] {
            assert_eq!(row(&m, name), "–");
        }
        assert_eq!(row(&m, "refresh"), "at rest");
        assert_eq!(m.rows().len(), model().rows().len());
    }

    #[test]
    fn a_frame_of_the_present_pose_is_current() {
        let m = OverlayModel { frame_age: Some(Duration::ZERO), ..model() };
        assert_eq!(row(&m, "frame age"), "current");
    }

    #[test]
    fn the_banner_is_one_line_and_only_when_needed() {
        assert_eq!(model().banner(), None);
        let silent = OverlayModel { silence: Some(Duration::from_millis(2400)), ..model() };
        assert!(silent.banner().unwrap().contains("for 2 s"));
        let problem = ConnectError::NoAnswer { host: "render-01".into(), port: 4433 };
        let reconnecting = State::Reconnecting { since_micros: 0, attempt: 2, problem: problem.clone() };
        for state in [reconnecting, State::Refused(problem)] {
            let banner = OverlayModel { state, ..model() }.banner().unwrap();
            assert!(banner.contains("No answer from render-01") && !banner.contains('\n'), "{banner}");
            assert!(banner.ends_with('?'), "{banner}");
        }
    }
}
