//! The pose datagram: a fixed layout of [`POSE_BYTES`] bytes, little-endian, one pose each.
//!
//! | offset | type | meaning |
//! |---|---|---|
//! | 0 | u8 | kind, 1 |
//! | 1 | u8 | 0 for no turn shown, or 1 + its whole degrees, see [`PoseRequest::shown_turn_deg`] |
//! | 2 | u16 | width in pixels |
//! | 4 | u16 | height in pixels |
//! | 6 | u16 | what decoding takes the client, ns a list; 0: not known |
//! | 8 | u32 | pose id, not 0 |
//! | 12 | u32 | newest frame that is complete at the client, 0 for none |
//! | 16 | u64 | the client's clock when the pose was set, µs; the server only echoes it |
//! | 24 | 3 × f32 | eye, world units |
//! | 36 | 4 × f32 | world_from_view, quaternion x y z w |
//! | 52 | f32 | vertical field of view, radians; negative: minus the height of an orthographic picture, world units |

use glam::{Quat, Vec3};

use crate::camera::{Intrinsics, MAX_SIDE, Pose, Projection};
use crate::ids::{FrameId, PoseId};

/// A client's request for a frame: the newest one wins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseRequest {
    /// Number of the pose, ascending, not 0.
    pub id: PoseId,
    /// The client's clock when the pose was set, µs. The server only echoes it.
    pub stamp_micros: u64,
    /// The camera of the frame.
    pub pose: Pose,
    /// Size and projection of the frame.
    pub intrinsics: Intrinsics,
    /// The newest frame that is complete at the client; with prediction, the newest decoded one.
    pub newest_complete: Option<FrameId>,
    /// How far the client's moving camera is turned from that of the shown frame, about the volume's centre. Whole
    /// degrees up to [`MAX_SHOWN_TURN_DEG`]. `None` at rest, and without a frame or with an exact one.
    pub shown_turn_deg: Option<u8>,
    /// The client's recent decoding time, ns per list; 0 if unknown.
    pub decode_nanos_per_list: u16,
}

/// Why a datagram is not a pose.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
pub enum PoseError {
    /// The datagram has a wrong length.
    #[error("a pose datagram has {0} bytes, expected {POSE_BYTES}")]
    Length(usize),
    /// The first byte is wrong.
    #[error("datagram of kind {0}, expected {KIND}")]
    Kind(u8),
    /// The id is not valid.
    #[error("a pose datagram with a wrong {0}")]
    Field(&'static str),
    /// A number is not finite or out of range.
    #[error("a pose datagram with an unusable {0}")]
    Value(&'static str),
}

impl PoseRequest {
    /// A view alone, without a report of the client.
    pub fn of_view(pose: Pose, intrinsics: Intrinsics) -> Self {
        Self {
            id: PoseId(1),
            stamp_micros: 0,
            pose,
            intrinsics,
            newest_complete: None,
            shown_turn_deg: None,
            decode_nanos_per_list: 0,
        }
    }

    /// The bytes of the datagram.
    pub fn encode(&self) -> [u8; POSE_BYTES] {
        let mut out = [0; POSE_BYTES];
        let mut put = |at: usize, bytes: &[u8]| out[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, &[KIND, self.shown_turn_deg.map_or(0, |t| t.min(MAX_SHOWN_TURN_DEG) + 1)]);
        put(2, &(self.intrinsics.width.min(MAX_SIDE) as u16).to_le_bytes());
        put(4, &(self.intrinsics.height.min(MAX_SIDE) as u16).to_le_bytes());
        put(6, &self.decode_nanos_per_list.to_le_bytes());
        put(8, &self.id.0.to_le_bytes());
        put(12, &self.newest_complete.unwrap_or(FrameId(0)).0.to_le_bytes());
        put(16, &self.stamp_micros.to_le_bytes());
        let numbers = self.pose.eye.to_array().into_iter().chain(self.pose.world_from_view.to_array());
        for (i, x) in numbers.chain([self.intrinsics.projection.to_number()]).enumerate() {
            put(24 + 4 * i, &x.to_le_bytes());
        }
        out
    }

    /// Reads a datagram.
    ///
    /// # Errors
    /// If the server could not render it: wrong length or kind, numbers that are not finite, a rotation that is not
    /// of unit length, or an empty or too large picture.
    pub fn decode(bytes: &[u8]) -> Result<Self, PoseError> {
        let bytes: &[u8; POSE_BYTES] = bytes.try_into().map_err(|_| PoseError::Length(bytes.len()))?;
        let u16_at = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]);
        let u32_at = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        let f32_at = |at: usize| f32::from_bits(u32_at(at));
        if bytes[0] != KIND {
            return Err(PoseError::Kind(bytes[0]));
        }
        let request = Self {
            id: PoseId(u32_at(8)),
            stamp_micros: u64::from(u32_at(16)) | u64::from(u32_at(20)) << 32,
            pose: Pose {
                eye: Vec3::from_array(std::array::from_fn(|i| f32_at(24 + 4 * i))),
                world_from_view: Quat::from_array(std::array::from_fn(|i| f32_at(36 + 4 * i))),
            },
            intrinsics: Intrinsics {
                width: u16_at(2).into(),
                height: u16_at(4).into(),
                projection: Projection::from_number(f32_at(52)),
            },
            newest_complete: Some(FrameId(u32_at(12))).filter(|f| f.0 != 0),
            shown_turn_deg: bytes[1].checked_sub(1),
            decode_nanos_per_list: u16_at(6),
        };
        request.validate()?;
        Ok(request)
    }

    /// Checks whether the request can be sent and rendered.
    ///
    /// # Errors
    /// Names the first invalid number.
    pub fn validate(&self) -> Result<(), PoseError> {
        let i = &self.intrinsics;
        let side = 1..=MAX_SIDE;
        if self.id.0 == 0 {
            Err(PoseError::Field("id"))
        } else if !self.pose.is_valid() {
            Err(PoseError::Value("pose"))
        } else if !side.contains(&i.width) || !side.contains(&i.height) {
            Err(PoseError::Value("size"))
        } else if !i.projection.is_valid() {
            Err(PoseError::Value("projection"))
        } else if self.shown_turn_deg > Some(MAX_SHOWN_TURN_DEG) {
            Err(PoseError::Value("turn"))
        } else {
            Ok(())
        }
    }
}

/// Length of a pose datagram: far below the 1200 bytes that every QUIC path carries.
pub const POSE_BYTES: usize = 56;
/// Greatest angle between two directions.
pub const MAX_SHOWN_TURN_DEG: u8 = 180;
/// First byte of a pose datagram.
const KIND: u8 = 1;

#[cfg(test)]
mod tests {
    use super::*;

    fn request() -> PoseRequest {
        PoseRequest {
            id: PoseId(77),
            stamp_micros: 0x0123_4567_89ab_cdef,
            pose: Pose::orbit(Vec3::new(1.0, -2.0, 3.0), 0.3, -0.7, 5.0),
            intrinsics: Intrinsics::perspective(640, 480, 0.6),
            newest_complete: Some(FrameId(12)),
            shown_turn_deg: Some(7),
            decode_nanos_per_list: 27,
        }
    }

    #[test]
    fn decoding_inverts_encoding() {
        for (newest_complete, shown_turn_deg) in
            [(None, None), (Some(FrameId(1)), Some(0)), (Some(FrameId(u32::MAX)), Some(180))]
        {
            for intrinsics in [request().intrinsics, Intrinsics::orthographic(640, 480, 0.25)] {
                let r = PoseRequest { newest_complete, shown_turn_deg, intrinsics, ..request() };
                assert_eq!(PoseRequest::decode(&r.encode()), Ok(r));
            }
        }
    }

    #[test]
    fn unusable_numbers_are_refused() {
        let nan = f32::NAN;
        let with = |f: &dyn Fn(&mut PoseRequest)| {
            let mut r = request();
            f(&mut r);
            PoseRequest::decode(&r.encode())
        };
        assert_eq!(with(&|r| r.pose.eye.x = nan), Err(PoseError::Value("pose")));
        assert_eq!(with(&|r| r.pose.eye.x = 1e30), Err(PoseError::Value("pose")));
        assert_eq!(
            with(&|r| r.pose.world_from_view = Quat::from_array([0.0; 4])),
            Err(PoseError::Value("pose"))
        );
        assert_eq!(with(&|r| r.intrinsics.width = 0), Err(PoseError::Value("size")));
        for projection in [
            Projection::Perspective { fov_y: nan },
            Projection::Perspective { fov_y: 0.0 },
            Projection::Orthographic { height: f32::INFINITY },
            Projection::Orthographic { height: 1e-20 },
        ] {
            let wrong = with(&|r| r.intrinsics.projection = projection);
            assert_eq!(wrong, Err(PoseError::Value("projection")));
        }
        assert_eq!(with(&|r| r.id = PoseId(0)), Err(PoseError::Field("id")));
        let mut too_far = request().encode();
        too_far[1] = 182;
        assert_eq!(PoseRequest::decode(&too_far), Err(PoseError::Value("turn")));
        let mut too_wide = request().encode();
        too_wide[3] = 0xff;
        assert_eq!(PoseRequest::decode(&too_wide), Err(PoseError::Value("size")));
    }

    #[test]
    fn any_cut_or_flipped_datagram_is_an_error_or_a_valid_pose() {
        let good = request().encode();
        for len in 0..good.len() {
            assert_eq!(PoseRequest::decode(&good[..len]), Err(PoseError::Length(len)));
        }
        for i in 0..good.len() * 8 {
            let mut bytes = good;
            bytes[i / 8] ^= 1 << (i % 8);
            if let Ok(r) = PoseRequest::decode(&bytes) {
                assert_eq!(r.validate(), Ok(()));
                assert_eq!(r.encode(), bytes, "a flipped bit that is not seen");
            }
        }
    }
}
