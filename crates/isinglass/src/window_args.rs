//! The first appearance of a window.

use clap::{Args, ValueEnum};
use isinglass_client::DEFAULT_EYE_ANGLE_DEGREES;
use isinglass_formats::{SavedView, Srgb, StereoPicture, Theme};

use crate::args::{Switch, parse_background, parse_rate};

/// Settings that the viewer's panel offers too.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Window")]
pub(crate) struct WindowArgs {
    /// Bars and panels around the picture (key F11)
    #[arg(long, value_enum, default_value_t = Switch::On)]
    bars: Switch,
    /// Numbers about network and frames, below the badge
    #[arg(long, value_enum, default_value_t = Switch::Off)]
    overlay: Switch,
    /// Axes and scale bar
    #[arg(long, value_enum, default_value_t = Switch::On)]
    axes: Switch,
    /// The volume's box
    #[arg(long = "box", value_enum, default_value_t = Switch::Off)]
    volume_box: Switch,
    /// Colour behind the volume
    #[arg(long, value_name = "#RRGGBB", value_parser = parse_background, default_value = "#000000")]
    background: [u8; 3],
    /// Of the panels
    #[arg(long, value_enum, default_value_t = ThemeChoice::Dark)]
    theme: ThemeChoice,
    /// The picture for two eyes
    #[arg(long, value_enum, default_value_t = StereoChoice::Off)]
    stereo: StereoChoice,
    /// Angle between the eyes, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_eye_angle, default_value_t = DEFAULT_EYE_ANGLE_DEGREES)]
    eye_angle: f32,
    /// Refresh rate to keep while the camera moves, if necessary by a coarser picture [default: the display's]
    #[arg(long, value_name = "HZ", value_parser = parse_rate)]
    pub(crate) refresh: Option<f32>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ThemeChoice {
    Dark,
    Light,
    System,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum StereoChoice {
    Off,
    SideBySide,
    RedCyan,
}

impl WindowArgs {
    /// Whether bars and panels are shown at first.
    pub(crate) fn shows_bars(&self) -> bool {
        self.bars == Switch::On
    }

    /// The same as a saved state, based on `saved`, with flags where `has` says they were given. What neither says is
    /// as the person `chose` before.
    pub(crate) fn view(&self, saved: SavedView, chose: &SavedView, has: impl Fn(&str) -> bool) -> SavedView {
        fn chosen<T>(saved: Option<T>, is_given: bool, chose: Option<T>) -> Option<T> {
            saved.or_else(|| chose.filter(|_| !is_given))
        }
        let saved = SavedView {
            shows_box: chosen(saved.shows_box, has("volume_box"), chose.shows_box),
            shows_axes: chosen(saved.shows_axes, has("axes"), chose.shows_axes),
            shows_legend: saved.shows_legend.or(chose.shows_legend),
            background: chosen(saved.background, has("background"), chose.background),
            theme: chosen(saved.theme, has("theme"), chose.theme),
            ..saved
        };
        let is_on = |switch| switch == Switch::On;
        fn or<T>(saved: Option<T>, is_given: bool, flag: T) -> Option<T> {
            Some(saved.filter(|_| !is_given).unwrap_or(flag))
        }
        SavedView {
            shows_box: or(saved.shows_box, has("volume_box"), is_on(self.volume_box)),
            shows_axes: or(saved.shows_axes, has("axes"), is_on(self.axes)),
            shows_numbers: or(saved.shows_numbers, has("overlay"), is_on(self.overlay)),
            background: or(saved.background, has("background"), Srgb(self.background)),
            theme: or(
                saved.theme,
                has("theme"),
                match self.theme {
                    ThemeChoice::Dark => Theme::Dark,
                    ThemeChoice::Light => Theme::Light,
                    ThemeChoice::System => Theme::System,
                },
            ),
            stereo: or(
                saved.stereo,
                has("stereo"),
                match self.stereo {
                    StereoChoice::Off => StereoPicture::Off,
                    StereoChoice::SideBySide => StereoPicture::SideBySide,
                    StereoChoice::RedCyan => StereoPicture::RedCyan,
                },
            ),
            eye_angle_degrees: or(saved.eye_angle_degrees, has("eye_angle"), self.eye_angle),
            ..saved
        }
    }
}

fn parse_eye_angle(text: &str) -> Result<f32, String> {
    let degrees = text.parse::<f32>().ok().filter(|d| (0.0..=MAX_EYE_ANGLE_DEGREES).contains(d));
    degrees.ok_or_else(|| format!("expected 0 to {MAX_EYE_ANGLE_DEGREES} degrees"))
}

const MAX_EYE_ANGLE_DEGREES: f32 = 8.0;
