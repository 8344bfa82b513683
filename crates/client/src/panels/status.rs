//! What the overlay says: numbers to words, without a window.

use std::time::Duration;

use isinglass_net::State;

use crate::viewing::Standing;

/// All that the overlay shows; what is not known is absent and shown as a dash.
#[derive(Clone, Debug, PartialEq)]
pub struct OverlayModel {
    /// The connection.
    pub state: State,
    /// How the picture stands to the server's.
    pub standing: Standing,
    /// Round-trip time of the connection.
    pub round_trip: Option<Duration>,
    /// Time since the camera was last at the pose that the frame on screen answers.
    pub frame_age: Option<Duration>,
    /// Angle between the pose of the frame on screen and the camera, around the volume's centre.
    pub turned_degrees: Option<f32>,
    /// What drawing costs.
    pub view_time: ViewTime,
    /// Time the server took for the newest frame.
    pub generate: Option<Duration>,
    /// Bytes received in about the last second.
    pub bytes_per_second: f64,
    /// Frames of the server that were decoded in the last second.
    pub new_frames_per_second: u32,
    /// Refreshes in the last second; none while nothing moves.
    pub refreshes_per_second: Option<f64>,
}

/// The cost of a novel view, as well as the adapter can tell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ViewTime {
    /// Measured on the GPU with timestamps.
    Gpu(Duration),
    /// From refresh to refresh, where the adapter has no timestamps: it holds waiting for the display too.
    FrameInterval(Duration),
    /// Nothing was drawn lately.
    Unknown,
}

/// One line of the overlay.
pub type Row = (&'static str, String);

impl OverlayModel {
    /// The lines under the badge, in a fixed order, so that a number stays in its place.
    pub fn rows(&self) -> Vec<Row> {
        let duration = |d: Option<Duration>| d.map_or_else(dash, format_duration);
        let is_current = self.frame_age == Some(Duration::ZERO);
        let view = match self.view_time {
            ViewTime::Gpu(d) => ("novel view", format_duration(d)),
            ViewTime::FrameInterval(d) => ("frame interval", format_duration(d)),
            ViewTime::Unknown => ("novel view", dash()),
        };
        vec![
            ("link", state_word(&self.state).to_owned()),
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
        ]
    }

    /// One calm line when the connection is not what it should be; the last picture stays in use under it.
    pub fn banner(&self) -> Option<String> {
        match &self.state {
            State::Connected | State::Connecting { .. } => None,
            State::Reconnecting { problem, .. } => {
                Some(format!("Reconnecting; the last picture stays usable. {}", sentence(problem)))
            }
            State::Refused(problem) => Some(format!("Disconnected. {}", sentence(problem))),
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
            Self::Offline => "offline",
            Self::Settled => "settled",
            Self::Exact => "exact",
        }
    }

    /// What the word means, for the person who points at it.
    pub fn explanation(self) -> &'static str {
        match self {
            Self::Waiting => "No frame has arrived yet.",
            Self::Moving => "Drawn here, at once, from the newest layered frame.",
            Self::Refining => "The server's frame for this view is on its way.",
            Self::Offline => "Drawn here from the last frame that came: there is no connection.",
            Self::Settled => {
                "The server's whole frame for this view, at another size than the window's or for two eyes."
            }
            Self::Exact => "The server's own picture of this view, pixel by pixel.",
        }
    }
}

/// The state in one word.
fn state_word(state: &State) -> &'static str {
    match state {
        State::Connecting { .. } => "connecting",
        State::Connected => "connected",
        State::Reconnecting { .. } => "reconnecting",
        State::Refused(_) => "refused",
    }
}

/// An error message as a sentence of its own.
pub(crate) fn sentence(problem: &impl std::fmt::Display) -> String {
    let mut text = problem.to_string();
    if let Some(first) = text.get_mut(..1) {
        first.make_ascii_uppercase();
    }
    if !text.ends_with(['.', '?', '!']) {
        text.push('.');
    }
    text
}

/// A duration with two or three figures: `0.8 ms`, `42 ms`, `1.3 s`.
pub fn format_duration(d: Duration) -> String {
    let ms = d.as_secs_f64() * 1e3;
    match ms {
        ms if ms < 9.95 => format!("{ms:.1} ms"),
        ms if ms < 999.5 => format!("{ms:.0} ms"),
        ms if ms < 99_950.0 => format!("{:.1} s", ms / 1e3),
        ms => format!("{:.0} min", ms / 6e4),
    }
}

/// Bytes per second with two or three figures, in decimal units.
pub fn format_rate(bytes_per_second: f64) -> String {
    match bytes_per_second {
        b if b < 1e3 => format!("{b:.0} B/s"),
        b if b < 999.5e3 => format!("{:.0} kB/s", b / 1e3),
        b if b < 9.95e6 => format!("{:.1} MB/s", b / 1e6),
        b => format!("{:.0} MB/s", b / 1e6),
    }
}

/// Bytes with two or three figures, in decimal units.
pub fn format_bytes(bytes: u64) -> String {
    match bytes as f64 {
        b if b < 999.5 => format!("{bytes} bytes"),
        b if b < 999.5e3 => format!("{:.0} kB", b / 1e3),
        b if b < 9.95e6 => format!("{:.1} MB", b / 1e6),
        b if b < 999.5e6 => format!("{:.0} MB", b / 1e6),
        b if b < 99.5e9 => format!("{:.1} GB", b / 1e9),
        b => format!("{:.0} GB", b / 1e9),
    }
}

fn dash() -> String {
    "–".to_owned()
}

#[cfg(test)]
mod tests {
    use isinglass_net::ConnectError;

    use super::*;

    fn model() -> OverlayModel {
        OverlayModel {
            state: State::Connected,
            standing: Standing::Moving,
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
            ("link", "connected"),
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
        let problem = ConnectError::NoAnswer { host: "render-01".into(), port: 4433 };
        let reconnecting = State::Reconnecting { since_micros: 0, attempt: 2, problem: problem.clone() };
        for state in [reconnecting, State::Refused(problem)] {
            let banner = OverlayModel { state, ..model() }.banner().unwrap();
            assert!(banner.contains("No answer from render-01") && !banner.contains('\n'), "{banner}");
            assert!(banner.ends_with('?'), "{banner}");
        }
    }

    #[test]
    fn a_sentence_begins_and_ends_as_one() {
        assert_eq!(sentence(&"connection lost: closed"), "Connection lost: closed.");
        assert_eq!(sentence(&"ärger?"), "ärger?");
        assert_eq!(sentence(&""), ".");
    }

    #[test]
    fn durations_and_rates_keep_two_or_three_figures() {
        let ms = |x: f64| format_duration(Duration::from_secs_f64(x / 1e3));
        assert_eq!([ms(0.04), ms(9.94), ms(9.96), ms(999.0)], ["0.0 ms", "9.9 ms", "10 ms", "999 ms"]);
        assert_eq!([ms(999.6), ms(61_000.0), ms(600_000.0)], ["1.0 s", "61.0 s", "10 min"]);
        assert_eq!(
            [0.0, 999.0, 4_300.0, 1.04e6, 12.3e6].map(format_rate),
            ["0 B/s", "999 B/s", "4 kB/s", "1.0 MB/s", "12 MB/s"]
        );
        assert_eq!(
            [999, 4_300, 1_040_000, 12_300_000_000, 250_000_000_000].map(format_bytes),
            ["999 bytes", "4 kB", "1.0 MB", "12.3 GB", "250 GB"]
        );
    }
}
