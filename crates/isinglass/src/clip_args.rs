//! Arguments for the visible part of a volume.

use clap::Args;
use glam::Vec3;
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::space::Aabb;

/// A box and a plane.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Clipping")]
pub(crate) struct ClipArgs {
    /// Show only what is inside a box: its ends along x, y and z in the unit of the voxels' spacing, relative to the
    /// middle of the volume
    #[arg(long, value_name = "X0,X1,Y0,Y1,Z0,Z1", value_parser = parse_box, allow_hyphen_values = true)]
    clip_box: Option<Aabb>,
    /// Show only what is on one side of a plane: the points p with n·p ≥ d; N has any length, D the same unit
    #[arg(long, value_name = "NX,NY,NZ,D", value_parser = parse_plane, allow_hyphen_values = true)]
    clip_plane: Option<Plane>,
}

impl ClipArgs {
    /// Combines both.
    pub(crate) fn clip(&self) -> Clip {
        Clip { bounds: self.clip_box, plane: self.clip_plane }
    }
}

fn parse_box(text: &str) -> Result<Aabb, String> {
    let [x0, x1, y0, y1, z0, z1] = numbers(text).ok_or("expected six numbers between commas")?;
    let bounds = Aabb { min: Vec3::new(x0, y0, z0), max: Vec3::new(x1, y1, z1) };
    let clip = Clip { bounds: Some(bounds), plane: None };
    clip.validate().map_err(|_| "expected finite numbers, the first of each pair below the second")?;
    Ok(bounds)
}

fn parse_plane(text: &str) -> Result<Plane, String> {
    let [x, y, z, d] = numbers(text).ok_or("expected four numbers between commas")?;
    let plane = Plane::new(Vec3::new(x, y, z), d).ok_or("expected a normal that is not zero")?;
    Clip { bounds: None, plane: Some(plane) }.validate().map_err(|_| "expected finite numbers")?;
    Ok(plane)
}

fn numbers<const N: usize>(text: &str) -> Option<[f32; N]> {
    let numbers = text.split(',').map(|part| part.trim().parse().ok()).collect::<Option<Vec<f32>>>()?;
    numbers.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_and_planes_are_read_and_nonsense_is_refused() {
        let bounds = Aabb { min: Vec3::new(-1.0, 0.0, -3.5), max: Vec3::new(1.0, 2.0, 4.0) };
        assert_eq!(parse_box("-1,1, 0,2,-3.5,4"), Ok(bounds));
        assert_eq!(parse_plane("0,-2,0,4"), Ok(Plane { normal: Vec3::NEG_Y, offset: 2.0 }));
        for bad in
            ["", "1,2,3,4,5", "0,1,0,1,1,1", "1,0,0,1,0,1", "0,1,0,1,0,nan", "0,1,0,1,0,inf", "0,1,0,1,0,1,0"]
        {
            assert!(parse_box(bad).is_err(), "{bad}");
        }
        for bad in ["0,0,0,1", "1,0,0", "nan,0,0,0", "1,0,0,inf"] {
            assert!(parse_plane(bad).is_err(), "{bad}");
        }
    }
}
