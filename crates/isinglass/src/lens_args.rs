//! The flags of `render` and `reproject` that combine several views: stereo pair, depth of field, motion blur.

use anyhow::{Context, Result};
use clap::Args;
use isinglass_core::camera::Camera;
use isinglass_core::kernels::lens::{Exposure, MAX_SAMPLES, View};
use isinglass_core::orbit::Orbit;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_formats::png::Rgb8;
use serde_json::{Value, json};

/// Lengths are in radii of the volume's bounding sphere, like DIST of `--orbit`.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Lens (lengths in radii of the volume's bounding sphere, as DIST)")]
#[command(group(clap::ArgGroup::new("averaged").args(["aperture", "shutter"]).multiple(true)))]
#[command(group(clap::ArgGroup::new("focused").args(["aperture", "stereo"]).multiple(true)))]
pub(crate) struct LensArgs {
    /// Two views from eyes IPD apart, the left one on the left; a thirtieth of the distance is comfortable. A
    /// negative IPD swaps them, for crossed eyes
    #[arg(long, value_name = "IPD", value_parser = parse_ipd, allow_hyphen_values = true)]
    stereo: Option<f32>,
    /// Both eyes in one picture for red-cyan glasses: red from the left eye, green and blue from the right
    #[arg(long, requires = "stereo")]
    anaglyph: bool,
    /// Radius of a thin lens: what is not at the focus is blurred
    #[arg(long, value_name = "RADIUS", value_parser = parse_aperture)]
    aperture: Option<f32>,
    /// View depth of the plane that is sharp, and that both eyes see in the same place [default: that of the volume's
    /// centre]
    #[arg(long, value_name = "DIST", value_parser = parse_focus, requires = "focused")]
    focus: Option<f32>,
    /// Camera position when the shutter closes, after turning around the volume's centre: motion blur [DIST: the
    /// initial distance]
    #[arg(long, value_name = "AZ,EL[,DIST]", allow_hyphen_values = true)]
    shutter: Option<Orbit>,
    /// Views per eye to average for --aperture and --shutter [default: 64]
    #[arg(long, value_name = "N", value_parser = parse_samples, requires = "averaged")]
    samples: Option<u32>,
}

/// The views to draw, and how to combine their pictures.
pub(crate) struct Plan {
    /// For each of one or two eyes, the views whose mean it sees.
    eyes: Vec<Vec<View>>,
    is_anaglyph: bool,
    /// The JSON description of it.
    pub(crate) json: Value,
}

impl LensArgs {
    /// Whether a picture has two eyes.
    pub(crate) fn has_two_eyes(&self) -> bool {
        self.stereo.is_some()
    }

    /// `bounds` is a box around the volume with its centre and its bounding sphere, whose axes point to `letters`. On
    /// a turntable, the camera and the shutter's end are turned by `degrees`.
    pub(crate) fn plan(
        &self,
        camera: &Camera,
        bounds: &Aabb,
        letters: Option<&str>,
        turned_degrees: f32,
    ) -> Result<Plan> {
        let (center, radius) = (bounds.center(), bounds.radius());
        let of_center = (center - camera.pose.eye).dot(camera.pose.forward());
        let needs_focus = self.stereo.is_some() || self.aperture.is_some();
        let focus_depth = match self.focus {
            Some(focus) => focus * radius,
            None if needs_focus && of_center <= 0.0 => {
                return Err(anyhow::anyhow!("the volume's centre is not before the camera"))
                    .context("expected --focus DIST");
            }
            None => of_center,
        };
        let shutter = self.shutter.map(|close| {
            let distance = camera.pose.eye.distance(center) / radius;
            let distance_in_radii = close.distance_in_radii.or(Some(distance));
            let azimuth_degrees = close.azimuth_degrees + turned_degrees;
            Orbit { azimuth_degrees, distance_in_radii, ..close }
                .upright(letters)
                .pose(&camera.intrinsics, bounds)
        });
        let exposure = Exposure {
            aperture_radius: self.aperture.unwrap_or(0.0) * radius,
            focus_depth,
            shutter,
            num_samples: self.samples.unwrap_or(DEFAULT_SAMPLES),
        };
        let views = exposure.views(camera, bounds);
        let num_samples = views.len();
        let eyes = match self.stereo {
            None => vec![views],
            Some(ipd) => (0..2)
                .map(|eye| views.iter().map(|view| view.stereo(ipd * radius, focus_depth)[eye]).collect())
                .collect(),
        };
        let json = json!({
            "stereo": self.stereo.map(|ipd| json!({
                "ipd_world": ipd * radius,
                "eye_angle_deg": 2.0 * (0.5 * ipd * radius / focus_depth).atan().to_degrees(),
                "layout": if self.anaglyph { "anaglyph" } else { "side-by-side" },
            })),
            "aperture_world": self.aperture.map(|a| a * radius),
            "focus_world": needs_focus.then_some(focus_depth),
            "shutter_deg": self.shutter.map(|o| [o.azimuth_degrees, o.elevation_degrees]),
            "samples": num_samples,
        });
        Ok(Plan { eyes, is_anaglyph: self.anaglyph, json })
    }
}

impl Plan {
    /// Draws the pictures of all eyes. `mean` renders the mean of several views.
    pub(crate) fn draw<E>(
        &self,
        mean: impl FnMut(&Vec<View>) -> Result<Picture, E>,
    ) -> Result<Vec<Picture>, E> {
        self.eyes.iter().map(mean).collect()
    }

    /// Combines the pictures of all eyes.
    pub(crate) fn compose(&self, pictures: &[Picture], background: [u8; 3]) -> Rgb8 {
        match pictures {
            [left, right] => {
                let (left, right) = (Rgb8::of(left, background), Rgb8::of(right, background));
                if self.is_anaglyph { anaglyph(&left, &right) } else { stereo_pair(&left, &right) }
            }
            pictures => Rgb8::of(&pictures[0], background),
        }
    }
}

/// What the left eye sees on the left of what the right eye sees. Nothing lies between them: a stereo display splits the
/// picture in its middle.
fn stereo_pair(left: &Rgb8, right: &Rgb8) -> Rgb8 {
    let row_bytes = left.width as usize * 3;
    let rows = left.bytes.chunks_exact(row_bytes).zip(right.bytes.chunks_exact(row_bytes));
    let bytes = rows.flat_map(|(left, right)| [left, right]).flatten().copied().collect();
    Rgb8 { width: left.width * 2, height: left.height, bytes }
}

/// What the left eye sees in red, and what the right eye sees in green and blue.
fn anaglyph(left: &Rgb8, right: &Rgb8) -> Rgb8 {
    let pixels = left.bytes.chunks_exact(3).zip(right.bytes.chunks_exact(3));
    let bytes = pixels.flat_map(|(left, right)| [left[0], right[1], right[2]]).collect();
    Rgb8 { bytes, ..*left }
}

fn parse_ipd(text: &str) -> Result<f32, String> {
    parse_length(text).filter(|ipd| ipd.abs() <= MAX_RADII).ok_or_else(|| {
        format!("expected a number of radii of at most {MAX_RADII}, such as 0.1 for a camera at 3")
    })
}

fn parse_aperture(text: &str) -> Result<f32, String> {
    parse_length(text)
        .filter(|a| (0.0..=MAX_RADII).contains(a))
        .ok_or_else(|| format!("expected 0 to {MAX_RADII} radii, such as 0.1"))
}

fn parse_focus(text: &str) -> Result<f32, String> {
    parse_length(text)
        .filter(|f| (MIN_FOCUS_RADII..=MAX_FOCUS_RADII).contains(f))
        .ok_or_else(|| format!("expected {MIN_FOCUS_RADII} to {MAX_FOCUS_RADII} radii, such as 3"))
}

fn parse_samples(text: &str) -> Result<u32, String> {
    let samples = text.parse::<u32>().ok().filter(|n| (1..=MAX_SAMPLES).contains(n));
    samples.ok_or_else(|| format!("expected 1 to {MAX_SAMPLES}"))
}

fn parse_length(text: &str) -> Option<f32> {
    text.parse().ok()
}

/// At 512×512 and a blur of 30 pixels, neighbouring samples are about four pixels apart.
const DEFAULT_SAMPLES: u32 = 64;
/// Wider eyes and lenses are typing errors.
const MAX_RADII: f32 = 10.0;
const MIN_FOCUS_RADII: f32 = 1e-3;
/// Greatest distance of an orbit.
const MAX_FOCUS_RADII: f32 = 1e4;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_are_read_and_nonsense_is_refused() {
        assert_eq!(parse_ipd("-0.1"), Ok(-0.1));
        assert_eq!(parse_aperture("0"), Ok(0.0));
        assert_eq!((parse_focus("3"), parse_samples("4096")), (Ok(3.0), Ok(4096)));
        for bad in ["", "x", "nan", "inf", "-inf", "11"] {
            assert!(parse_ipd(bad).is_err() && parse_aperture(bad).is_err(), "{bad}");
        }
        assert!(parse_aperture("-0.1").is_err());
        for bad in ["0", "-1", "nan", "1e9"] {
            assert!(parse_focus(bad).is_err(), "{bad}");
        }
        assert!(parse_samples("0").is_err() && parse_samples("4097").is_err());
    }

    #[test]
    fn eyes_stay_on_their_side_and_in_their_channels() {
        let left = Rgb8 { width: 1, height: 2, bytes: vec![1, 2, 3, 4, 5, 6] };
        let right = Rgb8 { bytes: left.bytes.iter().map(|b| b + 10).collect(), ..left };
        let pair = stereo_pair(&left, &right);
        assert_eq!((pair.width, pair.height), (2, 2));
        assert_eq!(pair.bytes, [1, 2, 3, 11, 12, 13, 4, 5, 6, 14, 15, 16]);
        assert_eq!(anaglyph(&left, &right).bytes, [1, 12, 13, 4, 15, 16]);
        assert_ne!(anaglyph(&left, &right), anaglyph(&right, &left));
    }
}
