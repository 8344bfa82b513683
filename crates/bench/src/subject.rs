//! The subject of tables: scenes, look and camera, and their description in a report.

use std::sync::Arc;

use isinglass_core::camera::Intrinsics;
use isinglass_core::clip::Clip;
use isinglass_core::kernels::march::MarchSettings;
use isinglass_core::mode::{Isos, Mode};
use isinglass_core::volume::{Lighting, Volume};
use isinglass_formats::{Selection, open};
use serde::Serialize;

use crate::error::BenchError;
use crate::progress::note;
use crate::scenes::SceneSource;
use isinglass_core::orbit::Orbit;
use isinglass_formats::{OpenedScene, scene_of};

/// What is measured, and from where.
#[derive(Clone, Debug)]
pub struct Subject {
    /// The scenes, see [`crate::scenes::select`].
    pub scenes: Vec<SceneSource>,
    /// Preset or file for all scenes; `None` chooses the one that suits each.
    pub transfer: Option<String>,
    /// List lengths, each 1 to [`isinglass_core::layer::MAX_K`].
    pub ks: Vec<u8>,
    /// Turns of azimuth, degrees. 0 is the generating camera itself.
    pub angles_degrees: Vec<f32>,
    /// The generating camera.
    pub orbit: Orbit,
    /// Size and field of view of pictures, and by default of frames.
    pub intrinsics: Intrinsics,
    /// Whether gradients shade.
    pub shaded: bool,
    /// What a pixel shows of its ray.
    pub mode: Mode,
    /// The surfaces of [`Mode::Iso`].
    pub isos: Isos,
    /// The visible part of the volumes.
    pub clip: Clip,
}

impl Subject {
    /// Opens one of the scenes.
    pub fn open(&self, source: &SceneSource) -> Result<OpenedScene, BenchError> {
        self.open_scene(source, self.open_volume(source)?)
    }

    /// Reads or makes the voxels of one of the scenes.
    pub fn open_volume(&self, source: &SceneSource) -> Result<Arc<Volume>, BenchError> {
        Ok(Arc::new(open(&source.volume.source, &source.volume.options())?))
    }

    /// Prepares them for rendering.
    pub fn open_scene(&self, source: &SceneSource, volume: Arc<Volume>) -> Result<OpenedScene, BenchError> {
        let (clip, mode, isos) = (self.clip, self.mode, self.isos);
        let settings =
            MarchSettings { clip, mode, isos, ..MarchSettings::of(self.shaded, Lighting::default()) };
        Ok(scene_of(volume, &source.volume.source, self.transfer.as_deref(), settings)?)
    }

    /// The generating camera's place around a volume, upright as for `render` and the viewer.
    pub fn orbit(&self, volume: &Volume) -> Orbit {
        self.orbit.upright(volume.info.orientation.as_deref())
    }

    /// The conditions of all rows.
    pub fn conditions(&self, threads: usize, failed: Vec<String>) -> SubjectConditions {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let Orbit { azimuth_degrees, elevation_degrees, distance_in_radii, .. } = self.orbit;
        SubjectConditions {
            version: env!("CARGO_PKG_VERSION"),
            size: [width, height],
            fov_deg: self.intrinsics.fov_y().to_degrees(),
            orbit_deg: [azimuth_degrees, elevation_degrees],
            distance_radii: distance_in_radii.unwrap_or_else(|| self.intrinsics.fit_distance()),
            angles_deg: self.angles_degrees.clone(),
            transfer: self.transfer.clone(),
            shading: self.shaded,
            mode: self.mode.name(),
            isos: self.isos,
            clip: self.clip,
            part: self.scenes.first().map(|scene| scene.volume.selection).unwrap_or_default(),
            threads,
            failed,
        }
    }
}

/// Measures scene by scene, and returns the failures. A scene that fails loses only its own rows, not hours of work
/// on others.
pub fn each_scene<E: std::fmt::Display>(
    scenes: &[SceneSource],
    mut measure: impl FnMut(&SceneSource) -> Result<(), E>,
) -> Failures<E> {
    let mut failures = Failures(Vec::new());
    for source in scenes {
        if let Err(error) = measure(source) {
            let line = match error.to_string() {
                // An error about a file names it already.
                told if told.starts_with(&format!("{}:", source.name)) => told,
                told => format!("{}: {told}", source.name),
            };
            note(&line);
            failures.0.push((line, error));
        }
    }
    failures
}

/// Scenes that failed, with their errors.
#[derive(Debug)]
pub struct Failures<E>(Vec<(String, E)>);

impl<E> Default for Failures<E> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<E> Failures<E> {
    /// Appends the failures of another run.
    pub fn append(&mut self, mut others: Self) {
        self.0.append(&mut others.0);
    }

    /// One line each for the report; the first error if there is nothing to report.
    pub fn lines(mut self, is_nothing_measured: bool) -> Result<Vec<String>, E> {
        if is_nothing_measured && !self.0.is_empty() {
            return Err(self.0.swap_remove(0).1);
        }
        Ok(self.0.into_iter().map(|(line, _)| line).collect())
    }
}

/// The conditions of all rows in a report.
#[derive(Clone, Debug, Serialize)]
pub struct SubjectConditions {
    /// Version of this program.
    pub version: &'static str,
    /// Columns and rows of the pictures.
    pub size: [u32; 2],
    /// Vertical field of view, degrees.
    pub fov_deg: f32,
    /// Azimuth and elevation of the generating camera, degrees.
    pub orbit_deg: [f32; 2],
    /// Its distance in radii of the bounding sphere.
    pub distance_radii: f32,
    /// Turns, degrees.
    pub angles_deg: Vec<f32>,
    /// Preset or file of all scenes; `None` for the one that suits each.
    pub transfer: Option<String>,
    /// What a pixel shows of its ray.
    pub mode: &'static str,
    /// The surfaces of mode `iso`.
    pub isos: Isos,
    /// The visible part of the volumes.
    pub clip: Clip,
    /// The part of each file.
    pub part: Selection,
    /// Whether gradients shade.
    pub shading: bool,
    /// Threads of the CPU.
    pub threads: usize,
    /// Scenes with missing rows, and the cause.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub failed: Vec<String>,
}

#[cfg(test)]
mod tests {
    use isinglass_core::volume::procedural::Builtin;

    use super::*;

    #[test]
    fn a_scene_that_fails_costs_its_own_rows() {
        let scenes = ["a", "b", "c"].map(|name| SceneSource::new(name, name));
        let mut seen = Vec::new();
        let mut run = |bad: &[&str]| {
            each_scene(&scenes, |source| {
                seen.push(source.name.clone());
                match bad.contains(&&*source.name) {
                    true => Err(BenchError::NoScene(format!("{} is no volume", source.name))),
                    false => Ok(()),
                }
            })
        };
        assert_eq!(run(&["b"]).lines(false).unwrap(), ["b: no scene to measure: b is no volume"]);
        assert!(run(&[]).lines(true).unwrap().is_empty());
        let told = each_scene(&scenes[..1], |_| Err(BenchError::NoScene("a.nrrd".into()))).lines(false);
        assert_eq!(told.unwrap(), ["a: no scene to measure: a.nrrd"]);
        let error = run(&["a", "b", "c"]).lines(true).unwrap_err();
        assert_eq!(error.to_string(), "no scene to measure: a is no volume");
        assert_eq!(seen.concat(), "abcabcabc");
    }

    #[test]
    fn the_orbit_is_upright_as_it_is_for_render() {
        let intrinsics = Intrinsics::perspective(8, 8, 0.7);
        let subject = Subject {
            scenes: vec![],
            transfer: None,
            ks: vec![],
            angles_degrees: vec![],
            orbit: Orbit::default(),
            intrinsics,
            shaded: true,
            mode: Mode::default(),
            isos: Isos::default(),
            clip: Clip::default(),
        };
        let mut volume = Builtin::Cubus.volume(8);
        assert_eq!(subject.orbit(&volume), subject.orbit);
        volume.info.orientation = Some("RAS".into());
        let bounds = volume.bounds();
        let pose = |orbit: Orbit| orbit.pose(&intrinsics, &bounds);
        let upright = pose(subject.orbit(&volume));
        assert_eq!(upright, pose(Orbit::default().upright(Some("RAS"))));
        assert_ne!(upright, pose(Orbit::default()));
    }
}
