//! What whoever opens a window sets.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use isinglass_formats::{SavedState, VolumeSource};
use isinglass_net::Link;

use super::script::Script;
use crate::input::bindings::Bindings;
use crate::input::camera_controls::InitialOrbit;
use crate::input::camera_path::CameraPath;
use crate::paint::novel_view::{LAYERS, NovelView};
use crate::paint::stereo::Stereo;
use crate::view::foresight::Foresight;
use crate::view::viewing::FrameSize;

/// What a window needs to know beside where its frames come from.
pub struct WindowOptions {
    /// Who renders, as the person at the viewer knows it.
    pub server_name: String,
    /// Width and height of the picture, points.
    pub size: [u32; 2],
    /// The first view.
    pub initial_orbit: InitialOrbit,
    /// Vertical field of view, radians.
    pub fov_y: f32,
    /// Whether rays are parallel at first.
    pub is_orthographic: bool,
    /// Size of the frames that are asked for.
    pub frame_size: FrameSize,
    /// Whether the picture is for two eyes at first.
    pub stereo: Stereo,
    /// What is asked for beyond the picture of the moment.
    pub foresight: Foresight,
    /// While the camera moves, the picture is cast as finely as so many refreshes a second allow; none: as many as the display
    /// makes.
    pub refresh_hz: Option<f32>,
    /// Whether numbers, axes and scale bar are shown at first.
    pub shows_overlay: bool,
    /// Turns the camera by itself, for pictures of a moving view; 0: not.
    pub auto_orbit_degrees_per_second: f32,
    /// Other methods than the ray cast to choose from.
    pub novel_views: Vec<Box<dyn NovelView>>,
    /// The name of the one that is shown at first, or [`LAYERS`].
    pub novel_view: &'static str,
    /// What is shown at first in place of the first view.
    pub state: Option<SavedState>,
    /// Whether `size` is that of the state's picture, in pixels.
    pub state_sets_size: bool,
    /// What the server was given to open, where that is known, for states that are saved.
    pub volume_source: Option<VolumeSource>,
    /// The server's link, for links to what is seen.
    pub link: Option<Link>,
    /// What keys and mouse do.
    pub bindings: Bindings,
    /// Is given the way of the camera.
    pub recorder: Option<Arc<Mutex<CameraPath>>>,
    /// Watches every refresh, for tests and pictures of the window.
    pub script: Option<Script>,
}

impl Default for WindowOptions {
    fn default() -> Self {
        Self {
            server_name: String::new(),
            size: [1100, 760],
            initial_orbit: InitialOrbit::default(),
            fov_y: DEFAULT_FOV_Y_DEGREES.to_radians(),
            is_orthographic: false,
            frame_size: FrameSize { moving_budget: Some(MOVING_BUDGET), ..FrameSize::default() },
            stereo: Stereo::default(),
            foresight: Foresight::default(),
            refresh_hz: None,
            shows_overlay: true,
            auto_orbit_degrees_per_second: 0.0,
            novel_views: Vec::new(),
            novel_view: LAYERS,
            state: None,
            state_sets_size: false,
            volume_source: None,
            link: None,
            bindings: Bindings::default(),
            recorder: None,
            script: None,
        }
    }
}

/// Longest time the server should need for a frame while the camera moves: that of a long round trip. With half of it,
/// a server without a GPU sends frames so coarse that the eye minds them more than their age.
const MOVING_BUDGET: Duration = Duration::from_millis(300);
/// Refreshes a second of a display that does not tell.
pub(crate) const USUAL_HZ: f32 = 60.0;
/// Vertical field of view if none is named, degrees.
pub const DEFAULT_FOV_Y_DEGREES: f32 = 40.0;
