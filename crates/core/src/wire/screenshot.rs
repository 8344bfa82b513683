//! A picture that the server renders in full: the request, and the stream that brings it.
//!
//! | offset | type | meaning |
//! |---|---|---|
//! | 0 | 4 bytes | `IGLS` |
//! | 4 | u32 | id of the request, little-endian |
//! | 8 | | a PNG file of the size that was asked for, to the end of the stream |

use serde::{Deserialize, Serialize};

use super::control::ControlError;
use super::pose::PoseRequest;
use crate::ids::ScreenshotId;
use crate::look::Look;

/// Requests a picture, with its own look or the one that was requested last. A later request replaces one that is not answered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScreenshotRequest {
    /// Number of the request.
    pub id: ScreenshotId,
    /// The view: the bytes of a pose datagram, of which only pose, size and field of view matter.
    pub view: Vec<u8>,
    /// Background behind the volume, sRGB; `None` for a transparent picture.
    pub background: Option<[u8; 3]>,
    /// The look, if it is not the viewer's own. Its lighting does not count: the picture has no shadows, no ambient
    /// occlusion and no highlights.
    pub look: Option<Box<Look>>,
}

impl ScreenshotRequest {
    /// The requested view.
    ///
    /// # Errors
    /// If the bytes are no view, or a larger one than can be rendered.
    pub fn view(&self) -> Result<PoseRequest, ControlError> {
        let view = PoseRequest::decode(&self.view).map_err(|_| ControlError::Value("view of a picture"))?;
        if view.intrinsics.num_pixels() > MAX_SCREENSHOT_PIXELS {
            return Err(ControlError::Value("size of a picture"));
        }
        Ok(view)
    }
}

/// The first bytes of the stream.
pub fn screenshot_header(id: ScreenshotId) -> [u8; SCREENSHOT_HEADER_BYTES] {
    let mut header = [0; SCREENSHOT_HEADER_BYTES];
    header[..4].copy_from_slice(&SCREENSHOT_MAGIC);
    header[4..].copy_from_slice(&id.0.to_le_bytes());
    header
}

/// The request that a stream answers; `None` if the header is not that of a screenshot.
pub fn screenshot_id(header: &[u8]) -> Option<ScreenshotId> {
    let header: &[u8; SCREENSHOT_HEADER_BYTES] = header.first_chunk()?;
    let id = u32::from_le_bytes([header[4], header[5], header[6], header[7]]);
    (header[..4] == SCREENSHOT_MAGIC).then_some(ScreenshotId(id))
}

/// First bytes of a screenshot's stream.
pub const SCREENSHOT_MAGIC: [u8; 4] = *b"IGLS";
/// Bytes before the PNG file.
pub const SCREENSHOT_HEADER_BYTES: usize = 8;
/// Pixels of the largest picture: 7680×4320 and a little more.
pub const MAX_SCREENSHOT_PIXELS: usize = 1 << 25;
/// Bytes of the longest stream: four per pixel, and the overhead of PNG.
pub const MAX_SCREENSHOT_BYTES: usize = 4 * MAX_SCREENSHOT_PIXELS + (1 << 20);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::Vec3;

    fn request(width: u32, height: u32) -> ScreenshotRequest {
        let pose = Pose::orbit(Vec3::ZERO, 0.3, 0.1, 3.0);
        let intrinsics = Intrinsics::perspective(width, height, 0.5);
        let view = PoseRequest::of_view(pose, intrinsics);
        ScreenshotRequest {
            id: ScreenshotId(7),
            view: view.encode().to_vec(),
            background: Some([1, 2, 3]),
            look: None,
        }
    }

    #[test]
    fn a_view_is_read_back_and_one_that_is_too_large_is_refused() {
        assert_eq!(request(640, 480).view().unwrap().intrinsics.width, 640);
        assert!(request(7680, 4320).view().is_ok());
        assert!(request(8192, 8192).view().is_err());
        let good = request(640, 480);
        assert!(ScreenshotRequest { view: good.view[1..].to_vec(), ..good }.view().is_err());
    }

    #[test]
    fn a_stream_says_what_it_answers() {
        assert_eq!(
            screenshot_id(&screenshot_header(ScreenshotId(0x0102_0304))),
            Some(ScreenshotId(0x0102_0304))
        );
        assert_eq!(screenshot_id(b"IGLC\x01\x02\x03\x04"), None);
        assert_eq!(screenshot_id(b"IGLS\x01"), None);
    }
}
