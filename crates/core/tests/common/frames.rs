//! Layered frames, and how far two pictures are apart.

use isinglass_core::camera::Camera;
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::Scene;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;

/// The frame of a camera, which must keep every promise of frames.
pub(crate) fn frame_of(scene: &Scene, camera: Camera, k: u8) -> LayeredFrame {
    let header = FrameHeader::alone(camera, k);
    let frame = generate(scene, header);
    frame.validate().expect("a frame keeps its promises");
    frame
}

/// Greatest difference of any channel in 8-bit sRGB.
pub(crate) fn max_difference(a: &Picture, b: &Picture) -> u8 {
    a.to_srgb8([0.0; 3])
        .iter()
        .zip(&b.to_srgb8([0.0; 3]))
        .map(|(x, y)| x.abs_diff(*y))
        .max()
        .expect("a picture has pixels")
}
