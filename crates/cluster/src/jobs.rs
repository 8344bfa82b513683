//! What process 0 tells all processes, as words, and what it asks them to make.

use std::ops::Range;

use glam::{Quat, Vec3};
use isinglass_core::camera::{Basis, Camera, Intrinsics, Pose, Projection};
use isinglass_core::kernels::lens::View;
use isinglass_core::look::Look;
use isinglass_core::volume::PlanKey;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::asides::AsideJob;
use crate::exchange::ClusterError;
use crate::pages::PagesOrder;
use crate::words::{push_bytes, take_bytes};

/// Something that all processes make together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum Job {
    /// A layered frame, at a threshold if one is known. All keep their rows of it under its number.
    Frame { scene: SceneOrder, camera: JobCamera, k: u8, threshold: Option<f32>, number: u64 },
    /// Whether a frame goes on, between two slices of its rows.
    GoOn(bool),
    /// Something that is done beside frames, also between two slices of one.
    Aside(AsideJob),
    /// Rows of a picture.
    Rows { scene: SceneOrder, view: JobView, rows: Range<u32> },
    /// How far the pages of some viewers are.
    Progress { viewers: Vec<PlanKey> },
    /// Nothing more.
    End,
}

/// Which of the kept scenes is shown, and what takes its place before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct SceneOrder {
    pub(crate) place: usize,
    /// The look of a scene that is not there yet, and whether its shade is a draft.
    pub(crate) new: Option<(Look, bool)>,
    /// The pages that it is shown by.
    pub(crate) pages: Option<PagesOrder>,
}

/// A camera, to the bit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct JobCamera {
    eye: [f32; 3],
    rotation: [f32; 4],
    size: [u32; 2],
    /// As one number.
    projection: f32,
    depths: [f32; 2],
}

impl From<&Camera> for JobCamera {
    fn from(camera: &Camera) -> Self {
        let Camera { pose, intrinsics, near, far } = *camera;
        Self {
            eye: pose.eye.to_array(),
            rotation: pose.world_from_view.to_array(),
            size: [intrinsics.width, intrinsics.height],
            projection: intrinsics.projection.to_number(),
            depths: [near, far],
        }
    }
}

impl JobCamera {
    pub(crate) fn camera(&self) -> Camera {
        let &Self { eye, rotation, size: [width, height], projection, depths: [near, far] } = self;
        let projection = Projection::from_number(projection);
        let pose = Pose { eye: Vec3::from_array(eye), world_from_view: Quat::from_array(rotation) };
        Camera { pose, intrinsics: Intrinsics { width, height, projection }, near, far }
    }
}

/// A view, to the bit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct JobView {
    /// Eye, forward, right and up.
    vectors: [[f32; 3]; 4],
    size: [f32; 2],
    perspective: f32,
    depths: [f32; 2],
}

impl From<&View> for JobView {
    fn from(view: &View) -> Self {
        let Basis { eye, forward, right, up, width, height, perspective } = view.basis;
        let vectors = [eye, forward, right, up].map(|v| v.to_array());
        Self { vectors, size: [width, height], perspective, depths: [view.near, view.far] }
    }
}

impl JobView {
    pub(crate) fn view(&self) -> View {
        let [eye, forward, right, up] = self.vectors.map(Vec3::from_array);
        let (perspective, [width, height], [near, far]) = (self.perspective, self.size, self.depths);
        View { basis: Basis { eye, forward, right, up, width, height, perspective }, near, far }
    }
}

/// Something as words: the number of bytes, and then those, four a word.
pub(crate) fn words_from<T: Serialize>(something: &T) -> Result<Vec<u32>, ClusterError> {
    let bytes = bincode::serde::encode_to_vec(something, bincode::config::standard());
    let bytes = bytes.map_err(|e| ClusterError::Job(e.to_string()))?;
    let mut words = Vec::with_capacity(1 + bytes.len().div_ceil(4));
    push_bytes(&mut words, &bytes);
    Ok(words)
}

/// Reads the words of [`words_from`].
pub(crate) fn from_words<T: DeserializeOwned>(words: &[u32]) -> Result<T, ClusterError> {
    let wrong = |why: &str| ClusterError::Job(why.to_owned());
    let mut rest = words;
    let bytes = take_bytes(&mut rest).ok_or_else(|| wrong("too few words"))?;
    let config = bincode::config::standard().with_limit::<MOST_BYTES>();
    let (found, used) =
        bincode::serde::decode_from_slice(&bytes, config).map_err(|e| wrong(&e.to_string()))?;
    if used == bytes.len() && rest.is_empty() { Ok(found) } else { Err(wrong("too many words")) }
}

/// A look has some kilobytes, and the histograms of all channels some megabytes.
const MOST_BYTES: usize = 16 << 20;

#[cfg(test)]
mod tests {
    use super::*;
    use isinglass_core::space::Aabb;
    use isinglass_core::transfer::TransferFunction;

    fn look() -> Look {
        let transfer = TransferFunction {
            name: "even".into(),
            domain: isinglass_core::transfer::Domain::Full,
            unit_length: isinglass_core::transfer::UnitLength::Voxel,
            points: Vec::new(),
        };
        Look::new(transfer)
    }

    #[test]
    fn a_job_arrives_as_it_was_and_cut_words_are_errors() {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let pose = Pose::orbit(Vec3::ZERO, 0.3, 0.2, 4.0);
        for projection in [Projection::Orthographic { height: 1.5 }, Projection::Perspective { fov_y: 0.7 }] {
            let camera = Camera::new(pose, Intrinsics { width: 33, height: 20, projection }, &bounds);
            assert_eq!(JobCamera::from(&camera).camera(), camera);
            let view = View::from(&camera);
            assert_eq!(JobView::from(&view).view(), view);
            let scene = SceneOrder { place: 1, new: Some((look(), true)), pages: None };
            let camera = JobCamera::from(&camera);
            let job = Job::Frame { scene, camera, k: 8, threshold: Some(0.25), number: 7 };
            let words = words_from(&job).unwrap();
            assert_eq!(from_words::<Job>(&words).unwrap(), job);
            // The controls.
            for num in 0..words.len() {
                assert!(from_words::<Job>(&words[..num]).is_err(), "{num} words");
            }
            let mut longer = words.clone();
            longer[0] += 1;
            longer.push(0);
            assert!(from_words::<Job>(&longer).is_err());
        }
        assert_eq!(from_words::<Job>(&words_from(&Job::End).unwrap()).unwrap(), Job::End);
    }
}
