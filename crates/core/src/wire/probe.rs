//! The value at a point of the volume: the client asks, and the server answers.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::control::ControlError;
use crate::ids::ProbeId;
use crate::volume::{FoundVoxel, ValuesAt};

/// Asks for the value at a point. Of several waiting questions, the newest is answered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProbeRequest {
    /// Number of the question.
    pub id: ProbeId,
    /// The point in world space.
    pub point: [f32; 3],
}

/// The answer.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Probed {
    /// Number of the question.
    pub id: ProbeId,
    /// The point of the question.
    pub point: [f32; 3],
    /// The voxel there; `None` outside the volume.
    pub voxel: Option<ProbedVoxel>,
}

/// A voxel and its value.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProbedVoxel {
    /// Its indices along x, y and z, from 0.
    pub index: [u32; 3],
    /// Its value.
    pub value: f32,
    /// The level that the value is of, 0 for the finest.
    pub level: u8,
}

impl ProbeRequest {
    /// Checks what the type cannot say.
    pub(super) fn validate(&self) -> Result<(), ControlError> {
        check_point(self.point)
    }

    /// Looks the answer up.
    pub fn answer(&self, values: &mut dyn ValuesAt) -> Probed {
        let found = values.voxel(Vec3::from_array(self.point));
        let voxel = found.map(|FoundVoxel { index, value, level }| ProbedVoxel { index, value, level });
        Probed { id: self.id, point: self.point, voxel }
    }
}

impl Probed {
    /// Checks what the type cannot say.
    pub(super) fn validate(&self) -> Result<(), ControlError> {
        if self.voxel.is_some_and(|v| !v.value.is_finite()) {
            return Err(ControlError::Value("value of a probe"));
        }
        check_point(self.point)
    }
}

fn check_point(point: [f32; 3]) -> Result<(), ControlError> {
    if point.iter().all(|x| x.is_finite()) { Ok(()) } else { Err(ControlError::Value("point of a probe")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::{Volume, VolumeInfo, Voxels};

    #[test]
    fn the_answer_is_the_voxel_that_holds_the_point() {
        let voxels = Voxels::U16((0..60).collect());
        let spacing = Vec3::new(1.0, 0.5, 2.0);
        let volume = Volume::new([3, 4, 5], spacing, voxels, (2.0, -7.0), VolumeInfo::default()).unwrap();
        let ask = |point: Vec3| ProbeRequest { id: ProbeId(3), point: point.to_array() }.answer(&mut &volume);
        for (i, [x, y, z]) in [[0, 0, 0], [2, 3, 4], [1, 2, 3]].into_iter().enumerate() {
            let center = volume.bounds().min + (Vec3::new(x as f32, y as f32, z as f32) + 0.5) * spacing;
            for aside in [Vec3::ZERO, spacing * 0.4, spacing * -0.4] {
                let found = ask(center + aside);
                let value = ((z * 4 + y) * 3 + x) as f32 * 2.0 - 7.0;
                assert_eq!(found.voxel, Some(ProbedVoxel { index: [x, y, z], value, level: 0 }), "{i}");
                assert_eq!((found.id, found.validate().is_ok()), (ProbeId(3), true));
            }
        }
        // The faces belong to the volume; what is beyond does not.
        assert!(ask(volume.bounds().max).voxel.is_some() && ask(volume.bounds().min).voxel.is_some());
        assert!(ask(volume.bounds().max + 1e-3).voxel.is_none());
        assert!(ProbeRequest { id: ProbeId(0), point: [f32::NAN, 0.0, 0.0] }.validate().is_err());
    }
}
