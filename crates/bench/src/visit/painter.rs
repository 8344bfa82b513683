//! Casts the pictures of a window, as finely as the display's rate allows.

use std::sync::Arc;
use std::time::{Duration, Instant};

use isinglass_client::{DisplayRecord, Quality, QualityControl, Standing};
use isinglass_core::camera::Camera;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::picture::Picture;
use isinglass_net::ReceivedFrame;
use isinglass_render::Backend;

use crate::error::BenchError;

pub(super) struct Painter {
    backend: Backend,
    quality: QualityControl,
    /// The last refresh, if the camera moved: when it was, how it was cast, and whether with kept frames.
    moved: Option<(Duration, Quality)>,
    cast: Option<Cast>,
}

/// The picture on the screen, and what it is of.
struct Cast {
    frame: Arc<ReceivedFrame>,
    camera: Camera,
    quality: Quality,
    picture: Arc<Picture>,
}

/// How a picture was made.
#[derive(Clone, Copy, Debug)]
pub(super) struct Painted {
    pub(super) time: Duration,
    /// Side of the cast picture as a share of the shown one.
    pub(super) scale: f32,
    /// Number of older frames in it.
    pub(super) num_kept: usize,
}

impl Default for Painted {
    fn default() -> Self {
        Self { time: Duration::ZERO, scale: 1.0, num_kept: 0 }
    }
}

impl Painter {
    pub(super) fn new(backend: Backend, refresh_hz: f32) -> Self {
        Self { backend, quality: QualityControl::new(refresh_hz), moved: None, cast: None }
    }

    /// The picture on the screen, and the size at which it is shown.
    pub(super) fn picture(&self) -> Option<(Arc<Picture>, [u32; 2])> {
        let Cast { camera, picture, .. } = self.cast.as_ref()?;
        Some((picture.clone(), [camera.intrinsics.width, camera.intrinsics.height]))
    }

    /// Casts what a refresh shows. The picture of a camera and a frame at rest is there already.
    pub(super) fn paint(&mut self, record: &DisplayRecord) -> Result<Painted, BenchError> {
        let Some(frame) = &record.frame else { return Ok(Painted::default()) };
        let is_moving = record.standing == Standing::Moving;
        if let Some((last, drawn)) = self.moved.filter(|_| is_moving) {
            self.quality.handle_cast(record.at, drawn, record.at.saturating_sub(last));
        }
        let quality = self.quality.quality(is_moving);
        let kept = if quality.keeps { &record.kept[..] } else { &[] };
        let drawn = Quality { keeps: quality.keeps && !kept.is_empty(), ..quality };
        self.moved = is_moving.then_some((record.at, drawn));
        let scale = drawn.scale;
        let is_there = |cast: &&Cast| {
            Arc::ptr_eq(&cast.frame, frame) && cast.camera == record.camera && cast.quality == drawn
        };
        if self.cast.as_ref().filter(is_there).is_some() {
            return Ok(Painted { time: Duration::ZERO, scale, num_kept: kept.len() });
        }
        let begun = Instant::now();
        let intrinsics = quality.size_of(record.camera.intrinsics);
        let camera = Camera { intrinsics, ..record.camera };
        let frames: Vec<&LayeredFrame> =
            std::iter::once(frame).chain(kept).map(|received| &received.frame).collect();
        let picture = match frames[..] {
            [one] => self.backend.raycast(one, &record.bounds, &camera)?,
            _ => self.backend.combine(&frames, &record.bounds, &camera)?,
        };
        let time = begun.elapsed();
        let (frame, picture) = (frame.clone(), Arc::new(picture));
        self.cast = Some(Cast { frame, camera: record.camera, quality: drawn, picture });
        Ok(Painted { time, scale, num_kept: kept.len() })
    }
}
