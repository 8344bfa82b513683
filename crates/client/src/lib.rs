//! The viewer: ray-casts the newest layered frame from the camera under the user's hand at every refresh, and never
//! waits for the network.
//!
//! [`run`] opens the window on a server's link, [`run_window`] on any [`FrameSource`], [`run_window_with_start`] also without one
//! and with a page to choose one; [`HeadlessViewer`] is the same
//! without a window. [`camera_controls`] is pure. This crate renders no volume and knows nothing of the wire: frames
//! come from `isinglass-net`, the ray caster from `isinglass-gpu`.

mod app;
mod background;
mod bindings;
pub mod camera_controls;
mod camera_path;
mod clip_editor;
mod clip_panel;
mod display;
mod display_loss;
mod foresight;
mod frame_source;
mod gpu_timer;
mod headless;
mod kept;
mod light_panel;
mod look_panel;
mod meters;
mod mode_panel;
mod novel_view;
mod number;
mod open_dialog;
mod orientation;
mod overlay;
mod panels;
mod parts_bar;
mod pick;
mod picture;
mod pointer;
mod probe;
mod quality_control;
mod run;
mod shots;
mod slots;
mod start;
mod state_files;
mod state_part;
mod stereo;
mod stills;
mod transfer_editor;
mod view_aids;
mod viewing;
mod window;
#[cfg(test)]
mod window_walk;

pub use bindings::{Action, BindingError, Bindings, Gesture, Opposite, REVERSE_WHEEL, Side, Step};
pub use camera_controls::InitialOrbit;
pub use camera_path::{CameraPath, CameraPathError};
pub use display::display_available;
pub use foresight::Foresight;
pub use frame_source::FrameSource;
pub use headless::{DisplayRecord, HeadlessViewer};
pub use novel_view::{LAYERS, NovelView};
pub use overlay::{OverlayModel, Row, ViewTime, format_bytes, format_duration, format_rate};
pub use picture::BACKGROUND;
pub use quality_control::{Quality, QualityControl};
pub use run::{ViewerOptions, run};
pub use start::{First, LocalServer, LocalServers, Services};
pub use stereo::{DEFAULT_EYE_ANGLE_DEGREES, Stereo, StereoMode};
pub use viewing::{FrameSize, Refresh, Standing, Viewing};
pub use window::{
    DEFAULT_FOV_Y_DEGREES, Probe, Script, ScriptStep, Shot, ViewerError, Waker, WindowContents,
    WindowOptions, run_window, run_window_with_start,
};

/// Whoever brings the frames of a window that may turn to others.
pub type BoxedSource = Box<dyn FrameSource + Send>;
