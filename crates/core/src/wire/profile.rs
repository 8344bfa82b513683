//! The values along a line: the client asks, and the server answers.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::control::ControlError;
use crate::ids::ProbeId;
use crate::space::MAX_COORDINATE;
use crate::volume::ValuesAt;

/// Asks for values at equal distances along a line. Of several waiting questions, the newest is answered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProfileRequest {
    /// Number of the question, among those for profiles.
    pub id: ProbeId,
    /// The ends of the line in world space.
    pub ends: [[f32; 3]; 2],
    /// Number of points, both ends included: 2 to [`MAX_PROFILE_POINTS`].
    pub num_points: u16,
}

/// The answer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Profile {
    /// Number of the question.
    pub id: ProbeId,
    /// The values between voxels, from one end of the line to the other; `None` outside the volume.
    pub values: Vec<Option<f32>>,
}

impl ProfileRequest {
    /// Checks what the type cannot say.
    pub(crate) fn validate(&self) -> Result<(), ControlError> {
        let is_line = self.ends.iter().flatten().all(|x| x.abs() <= MAX_COORDINATE);
        let is_number = (2..=MAX_PROFILE_POINTS).contains(&self.num_points);
        if is_line && is_number { Ok(()) } else { Err(ControlError::Value("line of a profile")) }
    }

    /// Looks the answer up.
    pub fn answer(&self, values: &mut dyn ValuesAt) -> Profile {
        let [from, to] = self.ends.map(Vec3::from_array);
        let last = f32::from(self.num_points.max(2) - 1);
        let mut at = |i: u16| values.between(from.lerp(to, f32::from(i) / last));
        Profile { id: self.id, values: (0..self.num_points.min(MAX_PROFILE_POINTS)).map(&mut at).collect() }
    }
}

impl Profile {
    /// Checks what the type cannot say.
    pub(super) fn validate(&self) -> Result<(), ControlError> {
        let is_short = self.values.len() <= usize::from(MAX_PROFILE_POINTS);
        let is_finite = self.values.iter().flatten().all(|value| value.is_finite());
        if is_short && is_finite { Ok(()) } else { Err(ControlError::Value("values of a profile")) }
    }
}

/// Points of the longest profile.
pub const MAX_PROFILE_POINTS: u16 = 512;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::{Volume, VolumeInfo, Voxels};

    /// Values 3x − 2y + 5z of the voxels' indices, plus 7.
    fn ramp() -> Volume {
        let [nx, ny, nz] = [6u32, 5, 7];
        let value = |i: u32| 3.0 * (i % nx) as f32 - 2.0 * (i / nx % ny) as f32 + 5.0 * (i / nx / ny) as f32;
        let voxels = Voxels::F32((0..nx * ny * nz).map(value).collect());
        Volume::new([nx, ny, nz], Vec3::new(0.5, 1.0, 2.0), voxels, (1.0, 7.0), VolumeInfo::default())
            .unwrap()
    }

    fn ask(from: Vec3, to: Vec3, num_points: u16) -> Profile {
        let question = ProfileRequest { id: ProbeId(4), ends: [from.to_array(), to.to_array()], num_points };
        assert!(question.validate().is_ok());
        question.answer(&mut &ramp())
    }

    #[test]
    fn the_profile_of_a_linear_ramp_is_linear() {
        let volume = ramp();
        // Between the centres of the first and the last voxels, so that nothing is outside.
        let inner = |share: Vec3| {
            let half = volume.bounds().max - volume.spacing() * 0.5;
            half * (share * 2.0 - 1.0)
        };
        for (from, to) in [
            (Vec3::ZERO, Vec3::ONE),
            (Vec3::new(0.0, 1.0, 0.3), Vec3::new(0.9, 0.1, 0.3)),
            (Vec3::splat(0.4), Vec3::splat(0.4)),
        ] {
            let profile = ask(inner(from), inner(to), 101);
            let expected =
                |share: Vec3| 7.0 + (Vec3::new(3.0 * 5.0, -2.0 * 4.0, 5.0 * 6.0) * share).element_sum();
            assert!(profile.values.len() == 101 && profile.validate().is_ok());
            for (i, value) in profile.values.iter().enumerate() {
                let wanted = expected(from.lerp(to, i as f32 / 100.0));
                assert!((value.unwrap() - wanted).abs() < 1e-4, "{i}: {value:?} {wanted}");
            }
        }
        // Control: other ends, other values.
        assert_ne!(ask(inner(Vec3::ZERO), inner(Vec3::ONE), 3), ask(inner(Vec3::ONE), inner(Vec3::ZERO), 3));
    }

    #[test]
    fn outside_there_is_no_value_and_nonsense_is_refused() {
        let far = Vec3::X * 100.0;
        let values = ask(-far, far, 201).values;
        assert!(values[0].is_none() && values[200].is_none() && values[100].is_some());
        assert_eq!(values.iter().flatten().count(), 3, "points at −1, 0 and 1 of a width of 3");
        let question = |x: f32, num_points| ProfileRequest {
            id: ProbeId(1),
            ends: [[0.0; 3], [x, 0.0, 0.0]],
            num_points,
        };
        for (x, num_points) in [(1.0, 0), (1.0, 1), (1.0, 513), (f32::NAN, 2), (f32::INFINITY, 2), (2e18, 2)]
        {
            assert!(question(x, num_points).validate().is_err(), "{x} {num_points}");
        }
        assert!(question(1.0, 512).validate().is_ok());
        let profile = |values| Profile { id: ProbeId(1), values };
        assert!(profile(vec![Some(1.0); 513]).validate().is_err());
        assert!(profile(vec![Some(f32::NAN)]).validate().is_err());
        assert!(profile(vec![None; 512]).validate().is_ok());
    }
}
