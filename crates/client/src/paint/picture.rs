//! The picture inside egui's render pass. Each frame is uploaded when it comes, and the picture is cast when anything
//! changes.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError, Weak};

use isinglass_core::camera::Camera;
use isinglass_core::clip::Clip;
use isinglass_core::kernels::raycast::CastOptions;
use isinglass_core::space::Aabb;
use isinglass_gpu::{Channels, Eye, GpuError, NUM_SLOTS, ViewPass};
use isinglass_net::ReceivedFrame;

use crate::paint::frame_slots::FrameSlots;
use crate::paint::gpu_timer::{GpuTime, GpuTimer};
use crate::paint::picture_cache::{DrawPath, PictureCache};
use crate::paint::stereo::{Stereo, StereoMode};
use crate::view::quality_control::Quality;

pub(crate) struct PicturePaint {
    pub(crate) rect: egui::Rect,
    pub(crate) frame: Arc<ReceivedFrame>,
    /// Older frames for what `frame` does not see.
    pub(crate) kept: Vec<Arc<ReceivedFrame>>,
    pub(crate) camera: Camera,
    pub(crate) bounds: Aabb,
    pub(crate) clip: Clip,
    pub(crate) stereo: Stereo,
    /// How finely to cast for one eye.
    pub(crate) quality: Quality,
    /// Linear colour behind the volume.
    pub(crate) background: [f32; 3],
}

/// What painting reports to the application.
#[derive(Debug, Default)]
pub(crate) struct PictureStatus {
    pub(crate) time: Arc<GpuTime>,
    pub(crate) has_timer: bool,
    /// Whether nothing can be drawn yet: the pipeline for the frame is still being made.
    is_blank: AtomicBool,
    problem: Mutex<Option<String>>,
    /// What else the device complained of since the last frame, such as a lack of memory.
    complaint: Arc<Mutex<Option<String>>>,
    warm_up: Mutex<Option<WarmUpDraws>>,
}

/// Draws that a thread has prepared for the window's queue. Only the window submits to the queue: its surface cannot
/// be configured while another thread does.
#[derive(Debug)]
struct WarmUpDraws {
    queue: wgpu::Queue,
    ready: Receiver<(wgpu::CommandBuffer, SyncSender<wgpu::SubmissionIndex>)>,
}

impl PictureStatus {
    /// Why the newest frame could not be uploaded; an older one is shown then.
    pub(crate) fn problem(&self) -> Option<String> {
        let lock = |m: &Mutex<Option<String>>| m.lock().unwrap_or_else(PoisonError::into_inner).clone();
        lock(&self.problem).or_else(|| lock(&self.complaint))
    }

    /// Whether the last refresh drew nothing, as its pipeline is still being made.
    pub(crate) fn is_blank(&self) -> bool {
        self.is_blank.load(Ordering::Relaxed)
    }

    #[cfg(test)]
    pub(crate) fn set_blank(&self, is_blank: bool) {
        self.is_blank.store(is_blank, Ordering::Relaxed);
    }

    /// Submits the prepared draws before the first picture. Never waits.
    pub(crate) fn submit_warm_up(&self) {
        let warm_up = self.warm_up.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(WarmUpDraws { queue, ready }) = &*warm_up else { return };
        for (commands, reply) in ready.try_iter() {
            // The thread may have ended.
            let _ = reply.try_send(queue.submit([commands]));
        }
    }
}

/// What stays on the GPU from refresh to refresh.
struct PictureResources {
    pass: ViewPass,
    slots: FrameSlots<ReceivedFrame, NUM_SLOTS>,
    cache: PictureCache<PictureKey>,
    path: DrawPath,
    timer: Option<GpuTimer>,
    status: Arc<PictureStatus>,
}

/// Prepares the device of the window. If the device is lost later, `lost` gets the reason and the window closes.
///
/// # Errors
/// If the kernel cannot be built on it.
pub(crate) fn install(
    state: &egui_wgpu::RenderState,
    ctx: &egui::Context,
    lost: Arc<Mutex<Option<String>>>,
) -> Result<Arc<PictureStatus>, String> {
    let (device, queue) = (&state.device, &state.queue);
    let closing = ctx.clone();
    device.set_device_lost_callback(move |reason, message| {
        *lost.lock().unwrap_or_else(PoisonError::into_inner) = Some(format!("{reason:?} {message}"));
        // The device calls this while it holds locks.
        let ctx = closing.clone();
        std::thread::spawn(move || {
            ctx.send_viewport_cmd_to(egui::ViewportId::ROOT, egui::ViewportCommand::Close);
            ctx.request_repaint();
        });
    });
    let complaint: Arc<Mutex<Option<String>>> = Arc::default();
    let (heard, waking) = (complaint.clone(), ctx.clone());
    device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
        let text = error.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
        tracing::error!("uncaptured GPU error: {text}");
        *heard.lock().unwrap_or_else(PoisonError::into_inner) = Some(text);
        let ctx = waking.clone();
        std::thread::spawn(move || ctx.request_repaint());
    }));
    let pass = ViewPass::new(device, state.target_format).map_err(|e| e.to_string())?;
    let draws = warm_up(&pass, state, ctx).map_err(|e| e.to_string())?;
    let time = Arc::new(GpuTime::default());
    let timer = GpuTimer::new(device, queue, time.clone());
    let status = Arc::new(PictureStatus {
        time,
        has_timer: timer.is_some(),
        is_blank: AtomicBool::new(true),
        problem: Mutex::default(),
        complaint,
        warm_up: Mutex::new(Some(draws)),
    });
    let resources = PictureResources {
        pass,
        slots: FrameSlots::default(),
        cache: PictureCache::default(),
        path: DrawPath::Direct,
        timer,
        status: status.clone(),
    };
    state.renderer.write().callback_resources.insert(resources);
    Ok(status)
}

/// Draws once with each pipeline while the first page waits for a frame. A thread prepares the draws and waits for
/// them; the window submits them.
fn warm_up(
    pass: &ViewPass,
    state: &egui_wgpu::RenderState,
    ctx: &egui::Context,
) -> Result<WarmUpDraws, GpuError> {
    let (adapter, device, queue) = (state.adapter.clone(), state.device.clone(), state.queue.clone());
    let warm_up = pass.warm_up(&device, &queue)?;
    let [ctx, repaint] = [ctx.clone(), ctx.clone()];
    let (sender, ready) = sync_channel(1);
    let submit = move |commands| {
        let (reply, submission) = sync_channel(1);
        sender.send((commands, reply)).ok()?;
        ctx.request_repaint();
        // The window may be closed meanwhile.
        submission.recv().ok()
    };
    // The device needs its queue even if the window closes meanwhile.
    let kept = queue.clone();
    let run = move || {
        if let Err(e) = warm_up.run(Some(&adapter), &device, submit) {
            tracing::warn!("first draws: {e}");
        }
        // The picture may wait for the last of the pipelines.
        drop(warm_up);
        repaint.request_repaint();
        drop(kept);
    };
    // Without a thread the first pictures come later.
    let _ = std::thread::Builder::new().name("warm-up".into()).spawn(run);
    Ok(WarmUpDraws { queue, ready })
}

impl PictureResources {
    /// Shows the frames of a refresh. If the newest is refused, the frame before stays; an older frame that is
    /// refused is left out.
    fn show(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        paint: &PicturePaint,
    ) -> Result<(), String> {
        let frames: Vec<&Arc<ReceivedFrame>> = std::iter::once(&paint.frame).chain(&paint.kept).collect();
        let (pass, complaint) = (&mut self.pass, &self.status.complaint);
        let mut places = self
            .slots
            .refresh(&frames, |slot, frame| {
                *complaint.lock().unwrap_or_else(PoisonError::into_inner) = None;
                pass.upload(device, queue, slot, &frame.frame, &paint.bounds)
            })
            .into_iter();
        let newest = places.next().transpose()?;
        let slots: Vec<usize> = newest.into_iter().chain(places.flatten()).collect();
        pass.show(device, &slots).map_err(|e| e.to_string())
    }
}

impl PicturePaint {
    pub(crate) fn shape(self) -> egui::PaintCallback {
        egui_wgpu::Callback::new_paint_callback(self.rect, self)
    }

    fn key(&self, is_as_asked: bool) -> PictureKey {
        PictureKey {
            frames: std::iter::once(&self.frame).chain(&self.kept).map(Arc::downgrade).collect(),
            camera: self.camera,
            bounds: self.bounds,
            clip: self.clip,
            stereo: self.stereo,
            quality: self.quality,
            background: self.background,
            is_as_asked,
        }
    }

    /// Whether the picture has as many pixels as the window has for it, so that a copy is exact.
    fn fits(&self, screen: &egui_wgpu::ScreenDescriptor) -> bool {
        let viewport = egui::PaintCallbackInfo {
            viewport: self.rect,
            clip_rect: self.rect,
            pixels_per_point: screen.pixels_per_point,
            screen_size_px: screen.size_in_pixels,
        }
        .viewport_in_pixels();
        let size = [viewport.width_px, viewport.height_px];
        let Camera { intrinsics, .. } = self.camera;
        size.map(u32::try_from) == [Ok(intrinsics.width), Ok(intrinsics.height)]
    }
}

/// Everything that determines a picture. Frames are equal if they are the same one.
#[derive(Debug)]
struct PictureKey {
    frames: Vec<Weak<ReceivedFrame>>,
    camera: Camera,
    bounds: Aabb,
    clip: Clip,
    stereo: Stereo,
    quality: Quality,
    background: [f32; 3],
    /// Whether there is a pipeline for exactly this cast.
    is_as_asked: bool,
}

impl PartialEq for PictureKey {
    fn eq(&self, other: &Self) -> bool {
        let values =
            |s: &Self| (s.camera, s.bounds, s.clip, s.stereo, s.quality, s.background, s.is_as_asked);
        self.frames.len() == other.frames.len()
            && self.frames.iter().zip(&other.frames).all(|(a, b)| Weak::ptr_eq(a, b))
            && values(self) == values(other)
    }
}

impl egui_wgpu::CallbackTrait for PicturePaint {
    fn prepare(
        &self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        screen: &egui_wgpu::ScreenDescriptor,
        encoder: &mut wgpu::CommandEncoder,
        resources: &mut egui_wgpu::CallbackResources,
    ) -> Vec<wgpu::CommandBuffer> {
        let Some(r) = resources.get_mut::<PictureResources>() else { return Vec::new() };
        let problem = r.show(device, queue, self).err();
        *r.status.problem.lock().unwrap_or_else(PoisonError::into_inner) = problem;
        r.pass.set_options(queue, &CastOptions { clip: self.clip, ..Default::default() });
        // Pipelines for single channels are made where they are used.
        let is_drawn = self.stereo.mode == StereoMode::RedCyan || r.pass.can_cast();
        r.status.is_blank.store(!is_drawn, Ordering::Relaxed);
        let may_stand = self.stereo.is_mono() && self.fits(screen);
        r.path = r.cache.next(self.key(r.pass.casts_as_asked()), self.is_enlarged(), may_stand);
        match r.path {
            DrawPath::FromTexture => {}
            DrawPath::IntoTexture => {
                let size = self.quality.size_of(self.camera.intrinsics);
                let camera = Camera { intrinsics: size, ..self.camera };
                let timestamps = r.timer.as_ref().and_then(GpuTimer::of_pass);
                r.pass.prepare_apart(device, queue, encoder, &camera, self.background, timestamps);
            }
            DrawPath::Direct if self.stereo.is_mono() => {
                r.pass.prepare(queue, &self.camera, self.background);
            }
            DrawPath::Direct => {
                r.pass.prepare_eyes(queue, &self.stereo.eyes(&self.camera, &self.bounds), self.background);
            }
        }
        if let Some(timer) = &r.timer {
            timer.step(device, encoder);
        }
        Vec::new()
    }

    fn paint(
        &self,
        info: egui::PaintCallbackInfo,
        pass: &mut wgpu::RenderPass<'static>,
        resources: &egui_wgpu::CallbackResources,
    ) {
        let Some(r) = resources.get::<PictureResources>() else { return };
        match &r.timer {
            _ if r.path != DrawPath::Direct => r.pass.paint_apart(pass),
            Some(timer) => timer.around(pass, |pass| self.paint_eyes(&r.pass, pass, &info)),
            None => self.paint_eyes(&r.pass, pass, &info),
        }
    }
}

impl PicturePaint {
    fn is_enlarged(&self) -> bool {
        self.stereo.is_mono() && self.quality.scale < 1.0
    }

    fn paint_eyes(&self, view: &ViewPass, pass: &mut wgpu::RenderPass<'_>, info: &egui::PaintCallbackInfo) {
        match self.stereo.mode {
            StereoMode::Off => view.paint(pass),
            StereoMode::SideBySide => {
                let whole = info.viewport_in_pixels();
                let (left, top) = (whole.left_px as f32, whole.top_px as f32);
                let (width, height) = (whole.width_px as f32, whole.height_px as f32);
                // Each eye's picture has this many columns.
                let half = (width * 0.5).ceil();
                for (eye, left) in [(Eye::Left, left), (Eye::Right, left + width - half)] {
                    pass.set_viewport(left, top, half, height, 0.0, 1.0);
                    view.paint_eye(pass, eye, Channels::All);
                }
            }
            StereoMode::RedCyan => {
                view.paint_eye(pass, Eye::Left, Channels::Red);
                view.paint_eye(pass, Eye::Right, Channels::Cyan);
            }
        }
    }
}

/// Default linear colour behind the volume: black, as in every picture that the program writes.
pub const BACKGROUND: [f32; 3] = [0.0; 3];
