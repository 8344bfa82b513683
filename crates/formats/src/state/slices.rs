//! The slices in a state.

use glam::{Quat, Vec3};
use isinglass_core::space::MAX_COORDINATE;
use isinglass_core::volume::SlabMode;
use serde::{Deserialize, Serialize};

/// The slices beside the picture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct SavedSlices {
    /// Whether they are shown.
    pub shown: bool,
    /// The point that all panes show, world space.
    pub point: [f32; 3],
    /// Thickness of the slab, world units; 0 for the plane alone.
    pub thickness: f32,
    /// What the slab shows.
    pub mode: SlabMode,
    /// The values shown black and white; missing: by the histogram.
    pub window: Option<[f32; 2]>,
    /// The planes of the panes.
    pub planes: [SavedPlane; 3],
    /// Whether the slices themselves are drawn into the picture, or their outlines only.
    pub in_picture: bool,
    /// The pane that takes most of the room, from 1.
    pub large: Option<u8>,
}

/// The plane of a pane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SavedPlane {
    /// The plane that is seen from the top.
    Top,
    /// The plane that is seen from the front.
    Front,
    /// The plane that is seen from the right.
    Right,
    /// The plane across a view: its rotation from view to world space, x, y, z, w of a quaternion.
    Oblique([f32; 4]),
}

impl Default for SavedSlices {
    fn default() -> Self {
        Self {
            shown: false,
            point: [0.0; 3],
            thickness: 0.0,
            mode: SlabMode::default(),
            window: None,
            planes: [SavedPlane::Top, SavedPlane::Front, SavedPlane::Right],
            in_picture: false,
            large: None,
        }
    }
}

impl SavedSlices {
    pub(super) fn problem(&self) -> Option<String> {
        let is_rotation = |plane: &SavedPlane| match plane {
            SavedPlane::Oblique(rotation) => Quat::from_array(*rotation).is_normalized(),
            _ => true,
        };
        let is_near = |x: f32| x.abs() <= MAX_COORDINATE;
        if !Vec3::from_array(self.point).is_finite() || !self.point.into_iter().all(is_near) {
            return Some("the point of the slices is not a place of finite numbers".into());
        }
        if !(0.0..=MAX_COORDINATE).contains(&self.thickness) {
            return Some(format!("thickness of the slices is {}, expected 0 or more", self.thickness));
        }
        if self.window.is_some_and(|[lo, hi]| !(lo < hi && (hi - lo).is_finite())) {
            return Some("the window of the slices is not two ascending numbers".into());
        }
        if !self.planes.iter().all(is_rotation) {
            return Some("the rotation of an oblique slice is not a unit quaternion".into());
        }
        let large = self.large.filter(|pane| !(1..=3).contains(pane))?;
        Some(format!("the large pane of the slices is {large}, expected 1 to 3"))
    }
}
