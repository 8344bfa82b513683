//! The viewer: ray-casts the newest layered frame from the camera under the user's hand at every refresh, and never
//! waits for the network.
//!
//! [`run`] opens the window on a server's link, [`run_window`] on any [`FrameSource`]. [`run_window_with_start`] also
//! opens it without a source, with a page to choose one. [`HeadlessViewer`] is the same without a window. This crate
//! renders no volume and knows nothing of the wire: frames come from `isinglass-net`, the ray caster from
//! `isinglass-gpu`.
//!
//! A folder uses only those above it; `tests/tests/module_order.rs` checks that.
//!
//! | folder | responsibility |
//! |---|---|
//! | `input` | Turns keys and mouse into actions and a camera. |
//! | `view` | Knows where frames come from, what is requested, and which frame is shown. |
//! | `paint` | Casts rays inside egui's pass, and draws lines and handles over the picture. |
//! | `panels` | Show what they are given. They do not know each other. |
//! | `app` | One viewer in a window: at each refresh input, view, paint, panels. |
//! | `start` | The page that chooses what the viewer shows, and the way there. |
//! | `window` | Opens the window of the system, and closes it. |

mod app;
mod input;
mod paint;
mod panels;
mod start;
mod view;
mod window;

pub use app::options::{DEFAULT_FOV_Y_DEGREES, WindowOptions};
pub use app::script::{Probe, Script, ScriptStep, Shot};
pub use input::bindings::{Action, BindingError, Bindings, Gesture, Opposite, REVERSE_WHEEL, Side, Step};
pub use input::camera_controls::{self, InitialOrbit};
pub use input::camera_path::{CameraPath, CameraPathError};
pub use paint::novel_view::{LAYERS, NovelView};
pub use paint::picture::BACKGROUND;
pub use paint::stereo::{DEFAULT_EYE_ANGLE_DEGREES, Stereo, StereoMode};
pub use panels::status::{OverlayModel, Row, ViewTime};
pub use panels::text::{format_bytes, format_duration, format_rate};
pub use start::{First, Services};
pub use view::foresight::Foresight;
pub use view::frame_source::FrameSource;
pub use view::headless::{DisplayRecord, HeadlessViewer};
pub use view::local_servers::{LocalServer, LocalServers};
pub use view::quality_control::{Quality, QualityControl};
pub use view::remote_servers::{RemoteServer, RemoteServers};
pub use view::viewing::{FrameSize, Refresh, Standing, Viewing};
pub use view::{BoxedSource, Waker};
pub use window::display::display_available;
pub use window::run::{ViewerOptions, run};
pub use window::{ViewerError, WindowContents, run_window, run_window_with_start};
