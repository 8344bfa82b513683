//! How large a viewer's next frame may be: what it takes of memory, and of time while others wait.

use std::time::{Duration, Instant};

use isinglass_core::kernels::layering::budget::longest_list;
use isinglass_core::look::Look;
use isinglass_core::wire::PoseRequest;

use crate::generator::Generated;

/// What the frames of one viewer were like.
#[derive(Debug, Default)]
pub(crate) struct FrameSizes {
    last: Option<Like>,
    /// The newest pose, and when it came.
    moved: Option<(PoseRequest, Instant)>,
}

#[derive(Debug)]
struct Like {
    /// The look without its clip and light.
    k: u8,
    mode: isinglass_core::mode::Mode,
    segments_per_list: f64,
    micros_per_list: f64,
}

impl FrameSizes {
    /// A newer pose has come.
    pub(crate) fn note_pose(&mut self, newest: &PoseRequest, now: Instant) {
        if self.moved.as_ref().is_none_or(|(before, _)| before.pose != newest.pose) {
            self.moved = Some((*newest, now));
        }
    }

    /// Notes a frame that was made for `look`.
    pub(crate) fn note_frame(&mut self, look: &Look, generated: &Generated) {
        let frame = &generated.frame;
        let num_lists = frame.num_lists().max(1) as f64;
        self.last = Some(Like {
            k: look.k,
            mode: look.mode,
            segments_per_list: frame.num_segments() as f64 / num_lists,
            micros_per_list: generated.generate_micros as f64 / num_lists,
        });
    }

    /// Segments that a frame of so many lists should have room for.
    pub(crate) fn expected_segments(&self, look: &Look, num_lists: usize) -> usize {
        let most = longest_list(look.k.into()) as f64;
        // After a jump, more lists hold something.
        let usual = |last: &Like| last.segments_per_list * 1.25 + 0.5;
        let like = self.last.as_ref().filter(|last| (last.k, last.mode) == (look.k, look.mode));
        (like.map_or(most, usual).min(most) * num_lists as f64) as usize
    }

    /// Most lists of a frame while others wait and the camera moves; `None` if it rests or nothing is known.
    pub(crate) fn lists_beside_others(&self, now: Instant) -> Option<usize> {
        let is_moving = self.moved.as_ref().is_some_and(|(_, at)| now.saturating_duration_since(*at) < REST);
        let last = self.last.as_ref().filter(|last| is_moving && last.micros_per_list > 0.0)?;
        Some(((SHARED_FRAME.as_micros() as f64 / last.micros_per_list) as usize).max(LEAST_LISTS))
    }
}

/// A camera rests when it has not moved for this time.
const REST: Duration = Duration::from_millis(100);
/// Rendering time of a moving camera's frame while others wait.
const SHARED_FRAME: Duration = Duration::from_millis(100);
/// No frame is made smaller than this to save time.
const LEAST_LISTS: usize = 96 * 96;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::camera::{Camera, Intrinsics, Pose};
    use isinglass_core::layer::{FrameHeader, LayeredFrame};
    use isinglass_core::space::Aabb;
    use isinglass_formats::load_transfer;
    use isinglass_render::MadeFrame;

    use super::*;
    use crate::frame_memory::FrameMemory;

    fn request(azimuth: f32) -> PoseRequest {
        let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.0, 3.0);
        PoseRequest::of_view(pose, Intrinsics::perspective(400, 300, 0.5))
    }

    /// A frame of 120 000 lists with `num` segments that took `micros`.
    fn generated(num: usize, generate_micros: u64) -> Generated {
        let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        let request = request(0.0);
        let camera = Camera::new(request.pose, request.intrinsics, &bounds);
        let mut frame = LayeredFrame::empty(FrameHeader::alone(camera, 8));
        frame.depth = vec![0; num];
        Generated {
            pages: None,
            frame: MadeFrame::Here(frame),
            _held: FrameMemory::new(0).nothing(),
            generate_micros,
            is_draft: false,
            occlusion: None,
        }
    }

    #[test]
    fn a_frame_has_room_for_what_the_last_one_had_and_a_new_look_for_the_most() {
        let look = Look::new(load_transfer("ct").unwrap());
        let mut sizes = FrameSizes::default();
        let most = longest_list(look.k.into()) * 1000;
        assert_eq!(sizes.expected_segments(&look, 1000), most);
        sizes.note_frame(&look, &generated(240_000, 1));
        assert_eq!(sizes.expected_segments(&look, 1000), 3000);
        assert_eq!(sizes.expected_segments(&Look { k: 32, ..look.clone() }, 1000), 32_000);
        sizes.note_frame(&look, &generated(120_000 * 20, 1));
        assert_eq!(sizes.expected_segments(&look, 1000), most);
    }

    #[test]
    fn frames_of_a_moving_camera_take_a_bounded_time_beside_others() {
        let look = Look::new(load_transfer("ct").unwrap());
        let (mut sizes, start) = (FrameSizes::default(), Instant::now());
        sizes.note_pose(&request(0.0), start);
        assert_eq!(sizes.lists_beside_others(start), None, "nothing is known");
        // A frame of 1.2 s: a twelfth of the lists.
        sizes.note_frame(&look, &generated(1000, 1_200_000));
        assert_eq!(sizes.lists_beside_others(start), Some(10_000));
        sizes.note_frame(&look, &generated(1000, 100_000_000));
        assert_eq!(sizes.lists_beside_others(start), Some(LEAST_LISTS));
        // The same pose again is no movement.
        sizes.note_pose(&request(0.0), start + REST);
        assert_eq!(sizes.lists_beside_others(start + REST), None);
        sizes.note_pose(&request(0.1), start + REST);
        assert!(sizes.lists_beside_others(start + REST).is_some());
    }
}
