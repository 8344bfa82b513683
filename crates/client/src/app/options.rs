//! What whoever opens a window can set.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use isinglass_formats::{Remembered, SavedState, VolumeSource};
use isinglass_net::Link;

use super::script::Script;
use crate::input::bindings::Bindings;
use crate::input::camera_controls::InitialOrbit;
use crate::input::camera_path::CameraPath;
use crate::paint::novel_view::{LAYERS, NovelView};
use crate::paint::stereo::Stereo;
use crate::view::foresight::Foresight;
use crate::view::viewing::FrameSize;

/// The settings of a window.
pub struct WindowOptions {
    /// The name of the server for the person at the viewer.
    pub server_name: String,
    /// Width and height of the picture, points.
    pub size: [u32; 2],
    /// The first view.
    pub initial_orbit: InitialOrbit,
    /// Vertical field of view, radians.
    pub fov_y: f32,
    /// Whether rays are parallel at first.
    pub is_orthographic: bool,
    /// Size of the requested frames.
    pub frame_size: FrameSize,
    /// Whether the picture is for two eyes at first.
    pub stereo: Stereo,
    /// What is requested beyond the present picture.
    pub foresight: Foresight,
    /// Refreshes a second to hold while the camera moves, by a coarser picture if needed; none: the display's rate.
    pub refresh_hz: Option<f32>,
    /// Whether bars, panels, axes and scale bar are shown at first, or the picture alone.
    pub shows_bars: bool,
    /// Whether the panel of the look is open at first.
    pub shows_panel: bool,
    /// Turns the camera by itself, degrees a second; 0: it stays.
    pub auto_orbit_degrees_per_second: f32,
    /// Other methods than the ray cast to choose from.
    pub novel_views: Vec<Box<dyn NovelView>>,
    /// The name of the method at first, or [`LAYERS`].
    pub novel_view: &'static str,
    /// Shown instead of the first view.
    pub state: Option<SavedState>,
    /// Whether `size` is that of the state's picture, in pixels.
    pub state_sets_size: bool,
    /// What the server opened, if known; a saved state names it.
    pub volume_source: Option<VolumeSource>,
    /// The server's link, from which links to the view are made.
    pub link: Option<Link>,
    /// What keys and mouse do.
    pub bindings: Bindings,
    /// Records the path of the camera.
    pub recorder: Option<Arc<Mutex<CameraPath>>>,
    /// What the person chose before.
    pub choices: Remembered,
    /// The file for choices; none if nothing is remembered.
    pub choices_file: Option<PathBuf>,
    /// Whether somebody chose the light of the first volume already.
    pub has_light: bool,
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
            shows_bars: true,
            shows_panel: false,
            auto_orbit_degrees_per_second: 0.0,
            novel_views: Vec::new(),
            novel_view: LAYERS,
            state: None,
            state_sets_size: false,
            volume_source: None,
            link: None,
            bindings: Bindings::default(),
            recorder: None,
            choices: Remembered::default(),
            choices_file: None,
            has_light: false,
            script: None,
        }
    }
}

/// The longest time a server may need for a frame while the camera moves: that of a long round trip. With half of it,
/// frames of a server without a GPU are so coarse that they look worse than older ones.
const MOVING_BUDGET: Duration = Duration::from_millis(300);
/// Refreshes a second if the display does not tell its rate.
pub(crate) const USUAL_HZ: f32 = 60.0;
/// Default vertical field of view, degrees.
pub const DEFAULT_FOV_Y_DEGREES: f32 = 40.0;
