//! What a person marks in a volume: views with a name, measurements, and the axis that points up.

use glam::{Quat, Vec3};
use isinglass_core::camera::Pose;
use isinglass_core::space::MAX_COORDINATE;
use isinglass_core::text::is_control;
use serde::{Deserialize, Serialize};

use crate::error::quoted;

/// The axis of world space that points up in standard views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum UpAxis {
    /// The top of the body if the file knows it, and y otherwise.
    #[default]
    #[serde(rename = "own")]
    Own,
    /// The first axis.
    #[serde(rename = "x")]
    X,
    /// Against the first axis.
    #[serde(rename = "-x")]
    MinusX,
    /// The second axis.
    #[serde(rename = "y")]
    Y,
    /// Against the second axis.
    #[serde(rename = "-y")]
    MinusY,
    /// The third axis.
    #[serde(rename = "z")]
    Z,
    /// Against the third axis.
    #[serde(rename = "-z")]
    MinusZ,
}

impl UpAxis {
    /// Every choice.
    pub const ALL: [Self; 7] =
        [Self::Own, Self::X, Self::MinusX, Self::Y, Self::MinusY, Self::Z, Self::MinusZ];

    /// A unit vector of world space; none if the file chooses it.
    pub fn direction(self) -> Option<Vec3> {
        Some(match self {
            Self::Own => return None,
            Self::X => Vec3::X,
            Self::MinusX => Vec3::NEG_X,
            Self::Y => Vec3::Y,
            Self::MinusY => Vec3::NEG_Y,
            Self::Z => Vec3::Z,
            Self::MinusZ => Vec3::NEG_Z,
        })
    }
}

/// A view that has a name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NamedView {
    /// The name that the person chose.
    pub name: String,
    /// The point that the camera turns about, world space.
    pub center: [f32; 3],
    /// Rotation from view to world space: x, y, z, w of a quaternion.
    pub rotation: [f32; 4],
    /// The vector from the centre to the eye, view space.
    pub eye_from_center: [f32; 3],
    /// Whether rays are parallel.
    #[serde(default)]
    pub orthographic: bool,
}

impl NamedView {
    /// The camera's centre, world space; its rotation from view to world space; its eye from the centre, view space.
    pub fn viewpoint(&self) -> (Vec3, Quat, Vec3) {
        let [center, eye] = [self.center, self.eye_from_center].map(Vec3::from_array);
        (center, Quat::from_array(self.rotation), eye)
    }

    pub(super) fn problem(&self) -> Option<String> {
        let (center, rotation, eye) = self.viewpoint();
        let is_name = is_view_name(&self.name);
        if !is_name {
            return Some(format!(
                "found the view {}, expected a name of 1 to {MAX_VIEW_NAME} characters in one line",
                quoted(&self.name)
            ));
        }
        let is_place = Pose::around(center, rotation, eye).is_valid();
        (!is_place).then(|| format!("the camera of the view {} is invalid", quoted(&self.name)))
    }
}

/// Whether a text can name a view.
pub fn is_view_name(text: &str) -> bool {
    !text.trim().is_empty() && text.chars().count() <= MAX_VIEW_NAME && !text.chars().any(is_control)
}

/// What is measured between points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MeasureKind {
    /// The distance of two points.
    Distance,
    /// The angle at the second of three points.
    Angle,
    /// The length of a path through points.
    Path,
    /// The values along the line between two points.
    Profile,
}

/// A measurement in a volume.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedMeasure {
    /// What is measured.
    pub kind: MeasureKind,
    /// Its points, world space.
    pub points: Vec<[f32; 3]>,
}

impl SavedMeasure {
    pub(super) fn problem(&self) -> Option<String> {
        let number = self.points.len();
        let is_number = match self.kind {
            MeasureKind::Distance | MeasureKind::Profile => number == 2,
            MeasureKind::Angle => number == 3,
            MeasureKind::Path => (2..=MAX_MEASURE_POINTS).contains(&number),
        };
        if !is_number {
            return Some(format!("a measurement ({:?}) has {number} points", self.kind));
        }
        let is_place = self.points.iter().flatten().all(|x| x.abs() <= MAX_COORDINATE);
        (!is_place).then(|| format!("a measurement has a coordinate beyond ±{MAX_COORDINATE:e}"))
    }
}

/// Says what is wrong with the lists of a state.
pub(super) fn problem(views: Option<&[NamedView]>, measures: Option<&[SavedMeasure]>) -> Option<String> {
    let (views, measures) = (views.unwrap_or_default(), measures.unwrap_or_default());
    if views.len() > MAX_VIEWS {
        return Some(format!("found {} views, expected at most {MAX_VIEWS}", views.len()));
    }
    if measures.len() > MAX_MEASURES {
        return Some(format!("found {} measurements, expected at most {MAX_MEASURES}", measures.len()));
    }
    let of_views = views.iter().find_map(NamedView::problem);
    of_views.or_else(|| measures.iter().find_map(SavedMeasure::problem))
}

/// Named views in a state.
pub const MAX_VIEWS: usize = 64;
/// Measurements in a state.
pub const MAX_MEASURES: usize = 64;
/// Points of a path.
pub const MAX_MEASURE_POINTS: usize = 256;
/// Characters of a view's name.
const MAX_VIEW_NAME: usize = 60;
#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::state::{SavedState, state_from_bytes};

    fn view(name: &str) -> NamedView {
        let rotation = Quat::from_rotation_y(0.3).to_array();
        let eye_from_center = [0.1, 0.0, 1.0 / 3.0];
        NamedView {
            name: name.into(),
            center: [1.5, -2.0, 0.1],
            rotation,
            eye_from_center,
            orthographic: true,
        }
    }

    fn measure(kind: MeasureKind, number: usize) -> SavedMeasure {
        SavedMeasure { kind, points: (0..number).map(|i| [i as f32 / 3.0, 0.1, -7.0]).collect() }
    }

    fn read(state: &SavedState) -> Result<SavedState, String> {
        let read = state_from_bytes(state.to_toml().as_bytes(), Path::new("a.toml"));
        read.map(|read| read.state).map_err(|e| e.to_string())
    }

    #[test]
    fn marks_are_read_back_to_the_bit() {
        let measures = vec![
            measure(MeasureKind::Distance, 2),
            measure(MeasureKind::Angle, 3),
            measure(MeasureKind::Path, MAX_MEASURE_POINTS),
            measure(MeasureKind::Profile, 2),
        ];
        let state = SavedState {
            views: Some(vec![view("the \"left\" nerve"), view("µ")]),
            measures: Some(measures),
            ..SavedState::default()
        };
        assert_eq!(read(&state), Ok(state.clone()));
        for up in UpAxis::ALL {
            let mut state = SavedState::default();
            state.view.up = Some(up);
            assert_eq!(read(&state), Ok(state.clone()));
        }
        // Control: what is not there is not made up.
        assert_eq!(read(&SavedState::default()).unwrap().views, None);
    }

    #[test]
    fn marks_that_no_viewer_makes_are_refused_in_one_line() {
        let odd = |views: Vec<NamedView>, measures: Vec<SavedMeasure>| {
            let state = SavedState { views: Some(views), measures: Some(measures), ..SavedState::default() };
            let problem = read(&state).unwrap_err();
            assert!(!problem.contains('\n') && problem.len() < 400, "{problem}");
            problem
        };
        assert!(odd(vec![view("")], vec![]).contains("expected a name"));
        assert!(odd(vec![view(&"x".repeat(5000))], vec![]).contains("expected a name"));
        assert!(odd(vec![NamedView { rotation: [0.0; 4], ..view("a") }], vec![]).contains("is invalid"));
        assert!(odd(vec![view("a"); MAX_VIEWS + 1], vec![]).contains("65 views"));
        assert!(odd(vec![], vec![measure(MeasureKind::Distance, 3)]).contains("3 points"));
        assert!(odd(vec![], vec![measure(MeasureKind::Angle, 2)]).contains("2 points"));
        assert!(odd(vec![], vec![measure(MeasureKind::Path, 1)]).contains("1 points"));
        assert!(odd(vec![], vec![measure(MeasureKind::Path, 257)]).contains("257 points"));
        let far =
            SavedMeasure { points: vec![[f32::INFINITY, 0.0, 0.0]; 2], ..measure(MeasureKind::Profile, 2) };
        assert!(odd(vec![], vec![far]).contains("beyond"));
        assert!(odd(vec![], vec![measure(MeasureKind::Distance, 2); 65]).contains("65 measurements"));
    }
}
