//! Older frames that fill what the newest lacks.

use std::collections::VecDeque;
use std::sync::Arc;

use isinglass_core::camera::Camera;
use isinglass_core::kernels::combine;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::space::Aabb;
use isinglass_net::ReceivedFrame;

use crate::input::camera_controls::angle_between_degrees;
use crate::view::foresight::eye_of;

/// A few frames of one volume and look, from cameras as different as possible; the newest last.
#[derive(Debug, Default)]
pub(crate) struct KeptFrames {
    frames: VecDeque<Arc<ReceivedFrame>>,
    bounds: Option<Aabb>,
}

impl KeptFrames {
    /// Keeps a displayed frame. A frame of another volume, look or connection drops all earlier ones.
    pub(crate) fn note(&mut self, shown: &Arc<ReceivedFrame>, bounds: &Aabb) {
        if self.bounds.replace(*bounds) != Some(*bounds) {
            self.frames.clear();
        }
        self.frames.retain(|f| is_alike(f, shown));
        if self.frames.iter().any(|f| Arc::ptr_eq(f, shown)) {
            return;
        }
        self.frames.push_back(shown.clone());
        if self.frames.len() > MAX_KEPT {
            self.frames.remove(self.most_repeated(bounds));
        }
        let total = |frames: &VecDeque<Arc<ReceivedFrame>>| -> usize {
            frames.iter().map(|f| num_bytes(&f.frame)).sum()
        };
        while self.frames.len() > 1 && total(&self.frames) > MAX_KEPT_BYTES {
            self.frames.pop_front();
        }
    }

    /// The frames to combine with the newest for a picture; empty if it sees all of it.
    pub(crate) fn choose(
        &self,
        newest: &Arc<ReceivedFrame>,
        display: &Camera,
        bounds: &Aabb,
    ) -> Vec<Arc<ReceivedFrame>> {
        let older: Vec<_> =
            self.frames.iter().filter(|f| !Arc::ptr_eq(f, newest) && is_alike(f, newest)).collect();
        let cameras: Vec<Camera> = older.iter().map(|f| f.frame.header.camera).collect();
        let chosen = combine::choose(display, &newest.frame.header.camera, &cameras, bounds);
        chosen.into_iter().map(|n| older[n].clone()).collect()
    }

    /// The frame with the smallest distance to a newer one.
    fn most_repeated(&self, bounds: &Aabb) -> usize {
        let poses: Vec<_> = self.frames.iter().map(|f| eye_of(&f.frame.header.camera, bounds)).collect();
        let distance = |i: usize, j: usize| {
            let turned = angle_between_degrees(&poses[i], &poses[j], bounds.center()).to_radians();
            let looking = poses[i].forward().angle_between(poses[j].forward());
            turned + looking + (poses[i].eye - poses[j].eye).length() / bounds.radius()
        };
        let nearest = |i: usize| (i + 1..poses.len()).map(|j| distance(i, j)).fold(f32::INFINITY, f32::min);
        (0..poses.len()).min_by(|&i, &j| nearest(i).total_cmp(&nearest(j))).unwrap_or(0)
    }
}

/// Whether two frames show the same matter in the same way.
fn is_alike(a: &ReceivedFrame, b: &ReceivedFrame) -> bool {
    a.frame.header.look == b.frame.header.look && a.times.connection == b.times.connection
}

fn num_bytes(frame: &LayeredFrame) -> usize {
    12 * frame.num_segments() + 4 * frame.offsets.len()
}

/// Kept frames, the newest included: twice as many as a picture combines.
const MAX_KEPT: usize = 7;
/// Most bytes of all kept frames together: three of 1920×1080 with six segments per list.
const MAX_KEPT_BYTES: usize = 512 << 20;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::camera::{Intrinsics, Pose};
    use isinglass_core::ids::{FrameId, LookVersion, PoseId};
    use isinglass_core::layer::FrameHeader;
    use isinglass_core::session::ledger::Life;

    use super::*;

    const BOUNDS: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };

    fn camera(azimuth_degrees: f32, distance: f32) -> Camera {
        let intrinsics = Intrinsics::perspective(40, 30, 0.7);
        let pose = Pose::orbit(Vec3::ZERO, azimuth_degrees.to_radians(), 0.2, distance);
        Camera::new(pose, intrinsics, &BOUNDS)
    }

    fn frame(number: u32, camera: Camera, look: u32) -> Arc<ReceivedFrame> {
        let header = FrameHeader {
            frame: FrameId(number),
            pose: PoseId(number),
            look: LookVersion(look),
            camera,
            k: 4,
            mode: Default::default(),
            fineness: Default::default(),
        };
        let mut times = Life::new(header.frame, header.pose);
        times.connection = 1;
        Arc::new(ReceivedFrame { frame: LayeredFrame::empty(header), is_exact: true, times })
    }

    #[test]
    fn frames_are_spread_and_bounded_and_of_one_look() {
        let mut kept = KeptFrames::default();
        for i in 0..100u32 {
            // Five places far apart, and between them many frames that hardly differ.
            let shown = frame(i, camera((i / 20) as f32 * 40.0 + (i % 20) as f32 * 0.1, 2.0), 1);
            kept.note(&shown, &BOUNDS);
            kept.note(&shown, &BOUNDS);
            assert!(kept.frames.len() <= MAX_KEPT);
            assert!(kept.frames.iter().any(|f| Arc::ptr_eq(f, &shown)), "the newest is among them");
        }
        for place in 0..5 {
            assert!(kept.frames.iter().any(|f| f.frame.header.frame.0 / 20 == place), "{place}");
        }
        kept.note(&frame(101, camera(0.0, 2.0), 2), &BOUNDS);
        assert_eq!(kept.frames.len(), 1, "another look shows other matter");
        let other = Aabb { max: Vec3::splat(2.0), ..BOUNDS };
        kept.note(&frame(102, camera(1.0, 2.0), 2), &other);
        assert_eq!(kept.frames.len(), 1, "and so does another volume");
    }

    #[test]
    fn kept_frames_come_in_where_the_newest_does_not_see_the_picture() {
        let mut kept = KeptFrames::default();
        let (left, newest) = (frame(1, camera(-30.0, 1.5), 1), frame(2, camera(0.0, 1.5), 1));
        kept.note(&left, &BOUNDS);
        kept.note(&newest, &BOUNDS);
        assert!(kept.choose(&newest, &camera(0.0, 1.5), &BOUNDS).is_empty());
        let chosen = kept.choose(&newest, &camera(-20.0, 1.5), &BOUNDS);
        assert!(chosen.len() == 1 && Arc::ptr_eq(&chosen[0], &left));
        // From far away the newest frame has seen all that there is.
        let far = frame(3, camera(10.0, 9.0), 1);
        kept.note(&far, &BOUNDS);
        assert!(kept.choose(&far, &camera(40.0, 9.0), &BOUNDS).is_empty());
    }
}
