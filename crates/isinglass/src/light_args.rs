//! The flags for the direction of the light, the strength of shade, and highlights.

use clap::Args;
use isinglass_core::volume::{
    Lighting, OCCLUSION_RADIUS_MAX, OCCLUSION_RADIUS_MIN, SHININESS_MAX, SOFTNESS_MAX_DEGREES,
};

/// Flags that are not given keep the defaults of a look.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Light")]
pub(crate) struct LightArgs {
    /// Ambient occlusion: how much matter darkens that sees little of the sky, 0 to 1
    #[arg(long, value_name = "S", value_parser = parse_strength, default_value_t = Lighting::default().ambient_occlusion)]
    ambient_occlusion: f32,
    /// Distance over which matter occludes the sky, in radii of the volume's bounding sphere
    #[arg(long, value_name = "R", value_parser = parse_reach, default_value_t = Lighting::default().occlusion_radius)]
    occlusion_radius: f32,
    /// Shadows: fraction of the light that comes from one place, 0 to 1
    #[arg(long, value_name = "S", value_parser = parse_strength, default_value_t = Lighting::default().shadows)]
    shadows: f32,
    /// Angular radius of the light, degrees: softness of the shadows
    #[arg(long, value_name = "DEG", value_parser = parse_softness, default_value_t = Lighting::default().softness_degrees)]
    softness: f32,
    /// Direction of the light, in degrees like the eye's in --orbit, fixed to the volume [default: -34.29,36.9]
    #[arg(long, value_name = "AZ,EL", value_parser = parse_light, allow_hyphen_values = true)]
    light: Option<[f32; 2]>,
    /// Highlights: how strongly shaded matter mirrors the light, 0 to 1
    #[arg(long, value_name = "S", value_parser = parse_strength, default_value_t = Lighting::default().specular)]
    specular: f32,
    /// Exponent of the highlights, 1 to 128: the higher, the smaller they are
    #[arg(long, value_name = "N", value_parser = parse_shininess, default_value_t = Lighting::default().shininess)]
    shininess: f32,
}

impl LightArgs {
    pub(crate) fn lighting(&self) -> Lighting {
        let defaults = Lighting::default();
        let [azimuth_degrees, elevation_degrees] =
            self.light.unwrap_or([defaults.azimuth_degrees, defaults.elevation_degrees]);
        Lighting {
            ambient_occlusion: self.ambient_occlusion,
            occlusion_radius: self.occlusion_radius,
            shadows: self.shadows,
            softness_degrees: self.softness,
            azimuth_degrees,
            elevation_degrees,
            specular: self.specular,
            shininess: self.shininess,
        }
    }
}

fn parse_strength(text: &str) -> Result<f32, String> {
    within(text, 0.0, 1.0)
}

fn parse_reach(text: &str) -> Result<f32, String> {
    within(text, OCCLUSION_RADIUS_MIN, OCCLUSION_RADIUS_MAX)
}

fn parse_softness(text: &str) -> Result<f32, String> {
    within(text, 0.0, SOFTNESS_MAX_DEGREES)
}

fn parse_shininess(text: &str) -> Result<f32, String> {
    within(text, 1.0, SHININESS_MAX)
}

fn within(text: &str, least: f32, most: f32) -> Result<f32, String> {
    let number = text.parse::<f32>().ok().filter(|x| (least..=most).contains(x));
    number.ok_or_else(|| format!("expected {least} to {most}"))
}

/// `AZ,EL`.
fn parse_light(text: &str) -> Result<[f32; 2], String> {
    let angles = text.split_once(',').and_then(|(azimuth, elevation)| {
        let azimuth = azimuth.trim().parse::<f32>().ok().filter(|a| (-180.0..=180.0).contains(a))?;
        let elevation = elevation.trim().parse::<f32>().ok().filter(|e| (-90.0..=90.0).contains(e))?;
        Some([azimuth, elevation])
    });
    angles.ok_or_else(|| "expected AZ,EL: degrees, -180 to 180 and -90 to 90, such as -35,40".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_out_of_range_is_refused() {
        assert_eq!(parse_light("-35, 40.5"), Ok([-35.0, 40.5]));
        for bad in ["", "3", "1,2,3", "190,0", "0,91", "nan,0"] {
            assert!(parse_light(bad).is_err(), "{bad}");
        }
        assert_eq!(parse_strength("0.5"), Ok(0.5));
        for bad in ["-0.1", "1.01", "x", "nan"] {
            assert!(parse_strength(bad).is_err(), "{bad}");
        }
        assert_eq!(parse_shininess("128"), Ok(128.0));
        for bad in ["0.5", "129", "-20", "nan"] {
            assert_eq!(parse_shininess(bad), Err("expected 1 to 128".into()), "{bad}");
        }
    }
}
