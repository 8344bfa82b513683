//! Opens the window and closes it.

pub(crate) mod display;
mod display_loss;
pub(crate) mod run;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use isinglass_gpu::with_large_buffers;
use isinglass_net::Clock;

use self::display::display_available;
use self::display_loss::{DisplayLost, told_apart};
use crate::app::options::WindowOptions;
use crate::app::{ViewerApp, theme_preference};
use crate::paint::gpu_timer::timer_features;
use crate::paint::novel_view::{LAYERS, NovelViews};
use crate::paint::picture::{self, PictureStatus};
use crate::panels::screenshots;
use crate::start::{First, Nothing, Services, StartWindow};
use crate::view::frame_source::FrameSource;
use crate::view::{Waker, waker_of};

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
    /// The display of the open window is gone.
    #[error(
        "the display was lost while the window was open: the X server ended, or the connection to it broke"
    )]
    DisplayLost,
    /// The device of the open window is gone.
    #[error(
        "the graphics device was lost while the window was open: {0}; a driver that was reset or updated does that, start again"
    )]
    Lost(String),
    /// The kernel could not be built for this device.
    #[error("cannot prepare the graphics device: {0}")]
    Device(String),
    /// There is no source of frames.
    #[error("{0}")]
    Source(String),
}

/// Opens a window on the frames of `make_source` and returns when it closes. `clock` is the clock of the source's
/// stamps. Must be called on the main thread.
///
/// # Errors
/// If there is no window, adapter or source, before anything is shown. Or if the display is lost later.
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

/// Opens a window that begins with `first`, and in which the person can choose other servers and volumes. Returns
/// when it closes. `clock` is the clock of the sources' stamps. Must be called on the main thread.
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
        let WindowParts { ctx, wake, views, status } = opened;
        let first = first(wake.clone()).map_err(ViewerError::Source)?;
        let app = ViewerApp::new(options, views, Box::<Nothing>::default() as _, clock.clone(), status);
        Ok(Box::new(StartWindow::new(app, services, first, &ctx, clock, wake)))
    })
}

/// The content of a window, without the window and without the ray cast, for tests.
pub struct WindowContents<S>(ViewerApp<S>);

impl<S: FrameSource> WindowContents<S> {
    /// On the frames of `source`, whose stamps are of `clock`.
    pub fn new(options: WindowOptions, source: S, clock: Clock) -> Self {
        let views = NovelViews::new(Vec::new(), LAYERS, Arc::new(|| {}));
        Self(ViewerApp::new(options, views, source, clock, Arc::default()))
    }

    /// Refreshes in all of `ui`.
    pub fn show(&mut self, ui: &mut egui::Ui) {
        self.0.show(ui);
    }
}

struct WindowParts {
    ctx: egui::Context,
    wake: Waker,
    views: NovelViews,
    status: Arc<PictureStatus>,
}

fn open_window(
    options: WindowOptions,
    make_app: impl FnOnce(WindowOptions, WindowParts) -> Result<Box<dyn eframe::App>, ViewerError>,
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
        // The picture equals the server's to 1/255; noise would spoil a comparison.
        dithering: false,
        event_loop_builder: Some(Box::new(choose_window_system)),
        ..Default::default()
    };
    // Without a thread they stay for the next time.
    let _ = std::thread::Builder::new().name("leftovers".into()).spawn(screenshots::remove_leftovers);
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
        let wake = waker_of(&ctx);
        let views =
            NovelViews::new(std::mem::take(&mut options.novel_views), options.novel_view, wake.clone());
        Ok(make_app(options, WindowParts { ctx, wake, views, status })?)
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

/// Refresh rate of the display that shows the window, if known, 1/s.
fn display_hz(window: &winit::window::Window) -> Option<f32> {
    let monitor = window.current_monitor().or_else(|| window.primary_monitor())?;
    let hz = monitor.refresh_rate_millihertz()? as f32 / 1e3;
    (hz >= 1.0).then_some(hz)
}

/// X11 if there is a choice. On Wayland the window goes through XWayland: winit's Wayland windows accept no dropped
/// files, and have no title under some compositors.
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
            // winit puts its own source position before the cause.
            let text = one_line(&other);
            let cause = text.rsplit(": ").next().unwrap_or(&text).trim_end_matches('.');
            ViewerError::Window(cause.to_owned())
        }
    }
}

fn one_line(e: &dyn std::fmt::Display) -> String {
    e.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

/// eframe's defaults with the least latency, buffers for large frames, and timestamps if the adapter has them.
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
