//! Opens the window and closes it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use isinglass_formats::{SavedState, VolumeSource};
use isinglass_gpu::with_large_buffers;
use isinglass_net::{Clock, Link};

use crate::app::{ViewerApp, theme_preference};
use crate::bindings::Bindings;
use crate::camera_controls::InitialOrbit;
use crate::camera_path::CameraPath;
use crate::display::display_available;
use crate::display_loss::{DisplayLost, told_apart};
use crate::foresight::Foresight;
use crate::frame_source::FrameSource;
use crate::gpu_timer::timer_features;
use crate::novel_view::{LAYERS, NovelView, NovelViews};
use crate::picture::{self, PictureStatus};
use crate::start::{First, Nothing, Services, StartWindow};
use crate::stereo::Stereo;
use crate::viewing::{FrameSize, Refresh};

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

/// Is called after every refresh and says what to do next.
pub type Script = Box<dyn FnMut(&Probe) -> ScriptStep>;

/// What a script sees.
#[derive(Clone)]
pub struct Probe {
    /// Time since the window opened.
    pub now: Duration,
    /// What is drawn; none before the volume is known.
    pub refresh: Option<Refresh>,
}

/// What a script wants.
pub enum ScriptStep {
    /// Nothing.
    Continue,
    /// A picture of the window as it is drawn at this refresh.
    Capture(Box<dyn FnOnce(Shot) + Send>),
    /// The end.
    Close,
}

/// A picture of the window, 8-bit sRGB, three bytes a pixel, row by row from the top.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The pixels.
    pub rgb: Vec<u8>,
}

/// Wakes the window from any thread: something to show has arrived.
pub type Waker = Arc<dyn Fn() + Send + Sync>;

/// Why there is no window.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// No graphics adapter can draw to the window.
    #[error(
        "no graphics adapter can draw to a window: {0}; install a Vulkan driver \
         (Debian and Ubuntu: mesa-vulkan-drivers, Fedora: mesa-vulkan-drivers, NVIDIA: the vendor's driver)"
    )]
    Adapter(String),
    /// The window system does not give a window.
    #[error(
        "cannot open a window: {0}; on Linux a running X server or XWayland (DISPLAY) and its client libraries \
         (libx11-6, libxcursor1, libxi6, libxkbcommon-x11-0) are needed"
    )]
    Window(String),
    /// The window was open, and the screen it was on is gone.
    #[error(
        "the display was lost while the window was open: the X server ended, or the connection to it broke"
    )]
    DisplayLost,
    /// The window was open, and the device that draws it is gone.
    #[error(
        "the graphics device was lost while the window was open: {0}; a driver that was reset or updated does that, start again"
    )]
    Lost(String),
    /// The kernel could not be built for this device.
    #[error("cannot prepare the graphics device: {0}")]
    Device(String),
    /// Nothing can bring the frames.
    #[error("{0}")]
    Source(String),
}

/// Opens a window on the frames of `make_source` and returns when it is closed. `clock` is that of the source's stamps.
/// Must be called on the main thread.
///
/// # Errors
/// If there is no window, no adapter or no source; before anything was shown. Or if the display goes away later.
pub fn run_window<S: FrameSource + 'static>(
    options: WindowOptions,
    clock: Clock,
    make_source: impl FnOnce(Waker) -> Result<S, String>,
) -> Result<(), ViewerError> {
    open_window(options, |options, opened| {
        let source = make_source(opened.wake).map_err(ViewerError::Source)?;
        Ok(Box::new(ViewerApp::new(options, opened.views, source, clock, opened.status)))
    })
}

/// Opens a window that begins with `first`, and in which other servers and volumes can be chosen. Returns when it is closed.
/// `clock` is that of the sources' stamps. Must be called on the main thread.
///
/// # Errors
/// As for [`run_window`].
pub fn run_window_with_start(
    options: WindowOptions,
    clock: Clock,
    services: Services,
    first: impl FnOnce(Waker) -> Result<First, String>,
) -> Result<(), ViewerError> {
    open_window(options, |options, opened| {
        let Opened { ctx, wake, views, status } = opened;
        let first = first(wake.clone()).map_err(ViewerError::Source)?;
        let app = ViewerApp::new(options, views, Box::<Nothing>::default() as _, clock.clone(), status);
        Ok(Box::new(StartWindow::new(app, services, first, &ctx, clock, wake)))
    })
}

/// What a window shows, without the window and without the ray cast: for whoever shows it elsewhere, as tests do.
pub struct WindowContents<S>(ViewerApp<S>);

impl<S: FrameSource> WindowContents<S> {
    /// On the frames of `source`, whose stamps are of `clock`.
    pub fn new(options: WindowOptions, source: S, clock: Clock) -> Self {
        let views = NovelViews::new(Vec::new(), LAYERS, Arc::new(|| {}));
        Self(ViewerApp::new(options, views, source, clock, Arc::default()))
    }

    /// A refresh in all of `ui`.
    pub fn show(&mut self, ui: &mut egui::Ui) {
        self.0.show(ui);
    }
}

/// A window that was opened.
struct Opened {
    ctx: egui::Context,
    wake: Waker,
    views: NovelViews,
    status: Arc<PictureStatus>,
}

fn open_window(
    options: WindowOptions,
    make_app: impl FnOnce(WindowOptions, Opened) -> Result<Box<dyn eframe::App>, ViewerError>,
) -> Result<(), ViewerError> {
    let [width, height] = options.size;
    let native = eframe::NativeOptions {
        viewport: egui::ViewportBuilder::default()
            .with_title("isinglass")
            .with_app_id("isinglass")
            .with_inner_size([width as f32, height as f32])
            .with_min_inner_size([320.0, 240.0])
            .with_icon(egui::IconData::default()),
        wgpu_options: wgpu_options(),
        // The picture is the server's to 1/255; noise would be seen in a comparison.
        dithering: false,
        event_loop_builder: Some(Box::new(choose_window_system)),
        ..Default::default()
    };
    let mut options = options;
    let was_open = Arc::new(AtomicBool::new(false));
    let opened = was_open.clone();
    let lost: Arc<Mutex<Option<String>>> = Arc::default();
    let heard = lost.clone();
    let create: eframe::AppCreator<'_> = Box::new(move |cc| {
        opened.store(true, Ordering::Relaxed);
        options.refresh_hz = options.refresh_hz.or_else(|| display_hz(cc.winit_window()?));
        // The rest of a state waits for a volume.
        let theme = options.state.as_ref().and_then(|state| state.view.theme);
        cc.egui_ctx.set_theme(theme.map_or(egui::ThemePreference::Dark, theme_preference));
        let state = cc.wgpu_render_state.as_ref().ok_or("the window has no wgpu device")?;
        let ctx = cc.egui_ctx.clone();
        let status = picture::install(state, &ctx, heard).map_err(ViewerError::Device)?;
        let wake: Waker = {
            let ctx = ctx.clone();
            Arc::new(move || ctx.request_repaint())
        };
        let views =
            NovelViews::new(std::mem::take(&mut options.novel_views), options.novel_view, wake.clone());
        Ok(make_app(options, Opened { ctx, wake, views, status })?)
    });
    let run = || eframe::run_native("isinglass", native, create);
    let result = told_apart(display_available, run);
    if let Some(reason) = lost.lock().unwrap_or_else(PoisonError::into_inner).take() {
        return Err(ViewerError::Lost(one_line(&reason)));
    }
    match result {
        Ok(Ok(())) => Ok(()),
        Ok(Err(_)) | Err(DisplayLost) if was_open.load(Ordering::Relaxed) && !display_available() => {
            Err(ViewerError::DisplayLost)
        }
        Ok(Err(e)) => Err(viewer_error(e)),
        Err(DisplayLost) => Err(ViewerError::Window("the display is gone".into())),
    }
}

/// Refreshes a second of the display that a window opens on, if it tells.
fn display_hz(window: &winit::window::Window) -> Option<f32> {
    let monitor = window.current_monitor().or_else(|| window.primary_monitor())?;
    let hz = monitor.refresh_rate_millihertz()? as f32 / 1e3;
    (hz >= 1.0).then_some(hz)
}

/// X11 wherever there is a choice: on Wayland, which goes through XWayland then, files cannot be dropped on a window of winit's,
/// and under some compositors it has no title.
fn choose_window_system(builder: &mut eframe::EventLoopBuilder<eframe::UserEvent>) {
    #[cfg(all(unix, not(target_os = "macos")))]
    winit::platform::x11::EventLoopBuilderExtX11::with_x11(builder);
    #[cfg(not(all(unix, not(target_os = "macos"))))]
    let _ = builder;
}

fn viewer_error(error: eframe::Error) -> ViewerError {
    match error {
        eframe::Error::AppCreation(e) => match e.downcast::<ViewerError>() {
            Ok(e) => *e,
            Err(e) => ViewerError::Device(one_line(&e)),
        },
        eframe::Error::Wgpu(e) => ViewerError::Adapter(one_line(&e)),
        other => {
            // winit puts the place in its own source in front of the cause.
            let text = one_line(&other);
            let cause = text.rsplit(": ").next().unwrap_or(&text).trim_end_matches('.');
            ViewerError::Window(cause.to_owned())
        }
    }
}

fn one_line(e: &dyn std::fmt::Display) -> String {
    e.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

/// eframe's defaults, least latency, buffers for large frames, and timestamps where the adapter has them.
fn wgpu_options() -> egui_wgpu::WgpuConfiguration {
    let mut setup = egui_wgpu::WgpuSetupCreateNew::without_display_handle();
    let device_descriptor = setup.device_descriptor.clone();
    setup.device_descriptor = Arc::new(move |adapter| {
        let descriptor = device_descriptor(adapter);
        let features = descriptor.required_features | timer_features(adapter);
        let limits = with_large_buffers(descriptor.required_limits.clone(), &adapter.limits());
        wgpu::DeviceDescriptor { required_features: features, required_limits: limits, ..descriptor }
    });
    egui_wgpu::WgpuConfiguration { wgpu_setup: setup.into(), ..Default::default() }
        .with_surface_config(egui_wgpu::SurfaceConfig::LOW_LATENCY)
}

/// Longest time the server should need for a frame while the camera moves: that of a long round trip. With half of it,
/// a server without a GPU sends frames so coarse that the eye minds them more than their age.
const MOVING_BUDGET: Duration = Duration::from_millis(300);
/// Refreshes a second of a display that does not tell.
pub(crate) const USUAL_HZ: f32 = 60.0;
/// Vertical field of view if none is named, degrees.
pub const DEFAULT_FOV_Y_DEGREES: f32 = 40.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_one_line_and_name_the_cause() {
        let source = Box::new(ViewerError::Source("no route to host".into()));
        let e = viewer_error(eframe::Error::AppCreation(source));
        assert_eq!(e.to_string(), "no route to host");
        let e = viewer_error(eframe::Error::AppCreation("two\n lines".into()));
        assert_eq!(e.to_string(), "cannot prepare the graphics device: two lines");
        let e = viewer_error(eframe::Error::Wgpu(egui_wgpu::WgpuError::NoSurfaceFormatsAvailable));
        assert!(e.to_string().contains("mesa-vulkan-drivers") && !e.to_string().contains('\n'), "{e}");
    }
}
