//! Pictures by other methods than the ray cast. A thread draws them, and the newest request wins. So a slow method
//! never holds up a refresh: its picture comes late.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::Thread;

use arc_swap::ArcSwapOption;
use isinglass_core::camera::Camera;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_net::ReceivedFrame;

use crate::view::Waker;

/// A way of making a picture from a layered frame.
pub trait NovelView: Send {
    /// The name for people; not [`LAYERS`].
    fn name(&self) -> &'static str;

    /// The picture of a frame from a camera, at the camera's size. `bounds` is the box of the volume. This may take
    /// long. An implementation may keep what it knows of a frame: the next picture often shows the same one.
    ///
    /// # Errors
    /// One line for a person.
    fn draw(&mut self, frame: &Arc<ReceivedFrame>, bounds: &Aabb, camera: &Camera)
    -> Result<Picture, String>;
}

/// The name of the ray cast.
pub const LAYERS: &str = "layers";

pub(crate) struct NovelViews {
    /// [`LAYERS`] and the others.
    pub(crate) names: Vec<&'static str>,
    /// Index in `names`.
    pub(crate) selected: usize,
    worker: Option<Worker>,
    texture: Option<egui::TextureHandle>,
}

impl NovelViews {
    /// Starts with the method `name`, or with the ray cast if there is no such method.
    pub(crate) fn new(views: Vec<Box<dyn NovelView>>, name: &str, wake: Waker) -> Self {
        let names: Vec<&'static str> =
            std::iter::once(LAYERS).chain(views.iter().map(|v| v.name())).collect();
        let selected = names.iter().position(|n| *n == name).unwrap_or(0);
        let worker = (!views.is_empty()).then(|| Worker::start(views, wake));
        Self { names, selected, worker, texture: None }
    }

    /// Requests a picture of this frame and returns the newest one. None for the ray cast, and before the first
    /// picture.
    pub(crate) fn show(
        &mut self,
        ctx: &egui::Context,
        frame: &Arc<ReceivedFrame>,
        bounds: &Aabb,
        camera: &Camera,
        background: [f32; 3],
    ) -> Option<Shown> {
        // The other methods composite with *over*.
        let selected = self.selected.checked_sub(1).filter(|_| !frame.frame.header.mode.is_projection());
        let Some((worker, view)) = self.worker.as_mut().zip(selected) else {
            self.texture = None;
            return None;
        };
        worker.wish(Wish { view, frame: frame.clone(), bounds: *bounds, camera: *camera });
        match worker.take() {
            Some(Ok(picture)) => {
                let size = [picture.width as usize, picture.height as usize];
                let image = egui::ColorImage::from_rgb(size, &picture.to_srgb8(background));
                match &mut self.texture {
                    Some(texture) => texture.set(image, egui::TextureOptions::LINEAR),
                    None => {
                        let name = "novel view";
                        self.texture = Some(ctx.load_texture(name, image, egui::TextureOptions::LINEAR));
                    }
                }
            }
            Some(Err(problem)) => {
                // The former picture shows another frame or camera.
                self.texture = None;
                return Some(Shown::Problem(problem));
            }
            None => {}
        }
        self.texture.as_ref().map(|texture| Shown::Picture(texture.id()))
    }
}

pub(crate) enum Shown {
    Picture(egui::TextureId),
    /// Why there is no picture.
    Problem(String),
}

#[derive(Clone)]
struct Wish {
    view: usize,
    frame: Arc<ReceivedFrame>,
    bounds: Aabb,
    camera: Camera,
}

impl Wish {
    fn is_same(&self, other: &Self) -> bool {
        self.view == other.view
            && Arc::ptr_eq(&self.frame, &other.frame)
            && self.camera == other.camera
            && self.bounds == other.bounds
    }
}

struct Worker {
    shared: Arc<Shared>,
    thread: Thread,
    last: Option<Wish>,
}

/// The newest values, without a lock.
#[derive(Default)]
struct Shared {
    wish: ArcSwapOption<Wish>,
    drawn: ArcSwapOption<Result<Picture, String>>,
    is_closed: AtomicBool,
}

impl Worker {
    fn start(mut views: Vec<Box<dyn NovelView>>, wake: Waker) -> Self {
        let shared = Arc::new(Shared::default());
        let of_thread = shared.clone();
        let thread = std::thread::spawn(move || {
            while let Some(wish) = of_thread.next_wish() {
                let Wish { view, frame, bounds, camera } = &*wish;
                let Some(view) = views.get_mut(*view) else { continue };
                let drawn = view.draw(frame, bounds, camera);
                of_thread.drawn.store(Some(Arc::new(drawn)));
                wake();
            }
        });
        Self { shared, thread: thread.thread().clone(), last: None }
    }

    /// Requests a picture unless it is the last one requested.
    fn wish(&mut self, wish: Wish) {
        if self.last.as_ref().is_none_or(|last| !last.is_same(&wish)) {
            self.shared.wish.store(Some(Arc::new(wish.clone())));
            self.thread.unpark();
            self.last = Some(wish);
        }
    }

    fn take(&self) -> Option<Result<Picture, String>> {
        Arc::into_inner(self.shared.drawn.swap(None)?)
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.shared.is_closed.store(true, Ordering::Release);
        self.thread.unpark();
    }
}

impl Shared {
    /// Waits for a request; none when the window closes.
    fn next_wish(&self) -> Option<Arc<Wish>> {
        loop {
            if self.is_closed.load(Ordering::Acquire) {
                return None;
            }
            if let Some(wish) = self.wish.swap(None) {
                return Some(wish);
            }
            std::thread::park();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

    use glam::Vec3;
    use isinglass_core::camera::{Intrinsics, Pose};

    use isinglass_core::layer::{FrameHeader, LayeredFrame};

    use super::*;
    use crate::view::viewing::tests::BOUNDS;

    /// Says that it has begun, waits to be let on, and draws a picture as wide as the camera's.
    struct Gated {
        begun: SyncSender<u32>,
        gate: Receiver<()>,
    }

    impl NovelView for Gated {
        fn name(&self) -> &'static str {
            "gated"
        }

        fn draw(&mut self, _: &Arc<ReceivedFrame>, _: &Aabb, camera: &Camera) -> Result<Picture, String> {
            let width = camera.intrinsics.width;
            self.begun.send(width).unwrap();
            self.gate.recv().unwrap();
            if width == 4 { Err("four".into()) } else { Ok(Picture::new(width, 1)) }
        }
    }

    fn wish(width: u32) -> Wish {
        let intrinsics = Intrinsics::perspective(width, 1, 0.7);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.0, 0.0, 5.0), intrinsics, &BOUNDS);
        let header = FrameHeader::alone(camera, 4);
        let frame = LayeredFrame::empty(header);
        let frame = ReceivedFrame { frame, is_exact: true, times: Default::default() };
        Wish { view: 0, frame: Arc::new(frame), bounds: BOUNDS, camera }
    }

    #[test]
    fn the_newest_wish_wins_and_nobody_waits_for_a_slow_method() {
        let (begun, has_begun) = sync_channel(16);
        let (open, gate) = sync_channel(16);
        let (wake, woken) = sync_channel(16);
        let wake: Waker = Arc::new(move || wake.send(()).unwrap());
        let mut worker = Worker::start(vec![Box::new(Gated { begun, gate })], wake);
        worker.wish(wish(1));
        assert_eq!(has_begun.recv(), Ok(1));
        // While it draws, wishes come and go and none of them blocks.
        let third = wish(3);
        worker.wish(wish(2));
        worker.wish(third.clone());
        worker.wish(third);
        assert!(worker.take().is_none());
        open.send(()).unwrap();
        woken.recv().unwrap();
        assert_eq!(worker.take().unwrap().unwrap().width, 1);
        assert_eq!(has_begun.recv(), Ok(3), "the second wish is forgotten");
        open.send(()).unwrap();
        woken.recv().unwrap();
        assert_eq!(worker.take().unwrap().unwrap().width, 3);
        assert!(worker.take().is_none());
        worker.wish(wish(4));
        open.send(()).unwrap();
        woken.recv().unwrap();
        assert_eq!(worker.take().unwrap(), Err("four".into()));
        // The thread ends with the window: its end of the channel is gone.
        assert_eq!(has_begun.recv(), Ok(4));
        drop(worker);
        assert!(has_begun.recv().is_err());
    }

    #[test]
    fn layers_are_always_there() {
        let views = NovelViews::new(vec![], "unknown", Arc::new(|| {}));
        assert_eq!((views.names, views.selected), (vec![LAYERS], 0));
    }
}
