//! Arguments for the size, field of view and projection of a picture.

use clap::Args;
use isinglass_client::DEFAULT_FOV_Y_DEGREES;
use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::space::Aabb;

use super::{parse_fov, parse_size};

/// Size and field of view of a picture.
#[derive(Args, Clone, Debug)]
pub(crate) struct ViewArgs {
    /// Columns and rows of the picture
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "512x512")]
    pub(crate) size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = DEFAULT_FOV_Y_DEGREES)]
    pub(crate) fov: f32,
    /// Parallel rays: size does not depend on distance. The picture shows as much of the volume's middle as with
    /// --fov
    #[arg(long)]
    pub(crate) orthographic: bool,
}

impl ViewArgs {
    /// The intrinsics of a perspective picture.
    pub(crate) fn intrinsics(&self) -> Intrinsics {
        let [width, height] = self.size;
        Intrinsics::perspective(width, height, self.fov.to_radians())
    }
}

/// The camera of parallel rays that shows as much of the middle of `bounds` as `camera`.
pub(crate) fn orthographic(camera: &Camera, bounds: &Aabb) -> Camera {
    if camera.intrinsics.projection.is_orthographic() {
        return *camera;
    }
    let depth = (bounds.center() - camera.pose.eye).dot(camera.pose.forward());
    // An eye in the exact middle would see nothing of it.
    camera.to_orthographic(depth.max(1e-3 * bounds.radius()), bounds)
}
