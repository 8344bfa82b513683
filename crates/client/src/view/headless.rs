//! The viewer without a window: the same requests and frames, driven by the caller's clock and camera path. It
//! records every picture that a window would have shown. To get the pictures, cast the recorded frames from the
//! recorded cameras.

use std::sync::Arc;
use std::time::Duration;

use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::space::Aabb;
use isinglass_net::{LinkStats, ReceivedFrame, State};

use crate::view::foresight::Foresight;
use crate::view::frame_source::FrameSource;
use crate::view::viewing::{FrameSize, Standing, Viewing};

/// A picture that a window would have shown.
#[derive(Clone, Debug)]
pub struct DisplayRecord {
    /// The time, on the clock of the source's stamps.
    pub at: Duration,
    /// The camera of the picture, from the pose of the same refresh.
    pub camera: Camera,
    /// The box of the volume.
    pub bounds: Aabb,
    /// The frame that was cast; `None` before the first.
    pub frame: Option<Arc<ReceivedFrame>>,
    /// Older frames that fill what `frame` lacks.
    pub kept: Vec<Arc<ReceivedFrame>>,
    /// How the picture relates to the server's.
    pub standing: Standing,
    /// Time since the camera was last at the frame's pose.
    pub frame_age: Option<Duration>,
    /// Angle between the frame's pose and the camera.
    pub turned_degrees: Option<f32>,
    /// The connection's state.
    pub state: State,
    /// Statistics of the connection.
    pub stats: LinkStats,
}

/// A viewer without a window.
pub struct HeadlessViewer<S> {
    viewing: Viewing<S>,
    picture: Intrinsics,
    is_orthographic: bool,
    records: Vec<DisplayRecord>,
}

impl<S: FrameSource> HeadlessViewer<S> {
    /// Pictures of the size `picture`, with frames of that size and a margin.
    pub fn new(source: S, picture: Intrinsics, foresight: Foresight) -> Self {
        let frame_size = FrameSize { max_width: u32::MAX, max_height: u32::MAX, ..FrameSize::default() };
        let viewing = Viewing::new(source, frame_size, foresight);
        Self { viewing, picture, is_orthographic: false, records: Vec::new() }
    }

    /// Sets whether rays are parallel from now on. The picture shows as much of the volume's middle as with
    /// perspective.
    pub fn set_orthographic(&mut self, is_orthographic: bool) {
        self.is_orthographic = is_orthographic;
    }

    /// Requests frames of this size from now on.
    pub fn set_frame_size(&mut self, frame_size: FrameSize) {
        self.viewing.frame_size = frame_size;
    }

    /// The source of frames.
    pub fn source(&self) -> &S {
        self.viewing.source()
    }

    /// The box of the volume, once known.
    pub fn bounds(&self) -> Option<Aabb> {
        self.source().description().map(|d| d.volume.bounds())
    }

    /// Refreshes the display at `now`, the time on the clock of the source's stamps, with the camera at `pose`.
    /// Records what is shown. Before the volume is known, nothing is recorded.
    pub fn tick(&mut self, now: Duration, pose: Pose) -> Option<&DisplayRecord> {
        let bounds = self.bounds()?;
        let mut camera = Camera::new(pose, self.picture, &bounds);
        if self.is_orthographic {
            let depth = (bounds.center() - pose.eye).dot(pose.forward());
            camera = camera.to_orthographic(depth.max(1e-3 * bounds.radius()), &bounds);
        }
        let refresh = self.viewing.refresh(now, camera.pose, camera.intrinsics, &bounds);
        let source = self.viewing.source();
        self.records.push(DisplayRecord {
            at: now,
            camera: refresh.camera,
            bounds: refresh.bounds,
            frame: refresh.frame,
            kept: if refresh.standing == Standing::Exact { Vec::new() } else { refresh.kept },
            standing: refresh.standing,
            frame_age: refresh.frame_age,
            turned_degrees: refresh.turned_degrees,
            state: source.state(),
            stats: source.stats(),
        });
        self.records.last()
    }

    /// The records since the last call. A frame lives as long as a record names it, so long paths at a large size
    /// need this.
    pub fn take_records(&mut self) -> Vec<DisplayRecord> {
        std::mem::take(&mut self.records)
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::view::viewing::tests::{BOUNDS, FakeSource};

    #[test]
    fn every_tick_is_recorded_with_the_camera_of_its_own_pose() {
        let picture = Intrinsics::perspective(8, 8, 0.7);
        let pose = |i: u64| Pose::orbit(Vec3::ZERO, i as f32 * 0.01, 0.0, 5.0);
        let mut viewer = HeadlessViewer::new(FakeSource::default(), picture, Foresight::default());
        assert!(viewer.tick(Duration::ZERO, pose(0)).is_none(), "no volume yet");
        let mut viewer = HeadlessViewer::new(
            FakeSource { max_side: Some(64), ..Default::default() },
            picture,
            Foresight::default(),
        );
        for i in 0..5 {
            let at = Duration::from_millis(16 * i);
            assert_eq!(viewer.tick(at, pose(i)).unwrap().camera, Camera::new(pose(i), picture, &BOUNDS));
        }
        let records = viewer.take_records();
        assert_eq!(records.len(), 5);
        assert!(records.iter().all(|r| r.frame.is_none() && r.standing == Standing::Waiting));
    }
}
