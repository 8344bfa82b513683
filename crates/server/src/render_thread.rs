//! The thread that owns the renderer of a device. It works in pieces, and takes the next one from whoever has used least time.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::cancel::Wanted;
use isinglass_core::codec::MAX_FRAME_SEGMENTS;
use isinglass_core::kernels::march::{LitPage, Scene};
use isinglass_core::look::Look;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::session::frames::within;
use isinglass_core::volume::{Detail, Lighting, Occlusion, PageView};
use isinglass_gpu::GpuError;
use isinglass_net::{AfterWork, Work};
use isinglass_render::{Piece, Renderer};
use tokio::sync::{mpsc, oneshot};

use crate::company::Company;
use crate::counters::Counters;
use crate::dispatch::Site;
use crate::frame_memory::{bytes_of, bytes_of_making, max_segments};
use crate::generator::{Begun, FrameJob, GenerateError, Generated, Job, Rows, RowsJob};
use crate::lights::Lights;
use crate::paging::{FramePages, Pager};
use crate::selection::SceneNumber;
use crate::turns::Turns;

pub(crate) struct RenderThread {
    pub(crate) renderer: Renderer,
    pub(crate) look: Look,
    pub(crate) scene: SceneNumber,
    pub(crate) lights: Lights,
    /// Whether frames have no light until that of the look is there.
    pub(crate) awaits_light: bool,
    /// Reads the pages, if the volume is read by pages.
    pub(crate) pager: Option<Pager>,
    pub(crate) after_work: AfterWork,
    pub(crate) company: Company,
    pub(crate) counters: Counters,
    /// Its device among others.
    pub(crate) site: Site,
}

/// What a piece of work leaves.
enum Left {
    Nothing,
    /// The rest of it.
    Some(Waiting),
    /// The device is lost, and others do its work.
    Device,
}

/// Work that waits for a turn.
enum Waiting {
    Frame(Box<FrameJob>),
    Rows(Box<RowsJob>),
}

impl Waiting {
    fn viewer(&self) -> ViewerId {
        match self {
            Self::Frame(job) => job.order.viewer,
            Self::Rows(job) => job.viewer,
        }
    }

    /// Whether somebody waits for it. A closed reply means that the viewer has left.
    fn is_wanted(&self) -> bool {
        match self {
            Self::Frame(job) => !job.reply.is_closed() && job.order.wish.holds(),
            Self::Rows(job) => !job.reply.is_closed(),
        }
    }

    /// Answers why it is not done, as far as anybody listens.
    fn refuse(self, why: GenerateError) {
        match self {
            Self::Frame(job) => drop(job.reply.send(Err(why))),
            Self::Rows(job) => drop(job.reply.send(Err(why))),
        }
    }
}

impl RenderThread {
    /// Works until nobody can order anything, or other devices do its work. Returns who waits for the end, if anybody.
    pub(crate) fn work(mut self, jobs: &mut mpsc::Receiver<Job>) -> Option<oneshot::Sender<()>> {
        let (mut turns, mut waiting) = (Turns::default(), Vec::<Waiting>::new());
        loop {
            let first = if waiting.is_empty() { jobs.blocking_recv() } else { jobs.try_recv().ok() };
            if first.is_none() && waiting.is_empty() {
                return None;
            }
            for job in first.into_iter().chain(std::iter::from_fn(|| jobs.try_recv().ok())) {
                if let Some(stopped) = self.take(job, &mut turns, &mut waiting) {
                    waiting.into_iter().for_each(|work| work.refuse(GenerateError::OtherVolume));
                    return Some(stopped);
                }
            }
            let given_up = waiting.extract_if(.., |work| !work.is_wanted());
            given_up.for_each(|work| work.refuse(GenerateError::GivenUp));
            let Some(place) = turns.choose(waiting.iter().map(Waiting::viewer)) else { continue };
            let work = waiting.remove(place);
            let viewer = work.viewer();
            let has_others = waiting.iter().any(|other| other.viewer() != viewer);
            let started = Instant::now();
            self.company.note(viewer, started);
            // Who comes meanwhile may have a better claim.
            let goes_on = || started.elapsed() < TURN || (!has_others && jobs.is_empty());
            let left = self.turn(work, &goes_on);
            let micros = started.elapsed().as_micros() as u64;
            turns.charge(viewer, micros);
            self.counters.note_rendering(micros);
            self.site.note_rendering(micros);
            match left {
                Left::Nothing => {}
                Left::Some(work) => waiting.insert(place, work),
                Left::Device => {
                    waiting.into_iter().for_each(|work| work.refuse(GenerateError::Moved));
                    return None;
                }
            }
        }
    }

    /// Takes a job. Returns who waits for the end of this thread, if the job says so.
    fn take(
        &mut self,
        job: Job,
        turns: &mut Turns,
        waiting: &mut Vec<Waiting>,
    ) -> Option<oneshot::Sender<()>> {
        let work = match job {
            Job::Frame(job) => Waiting::Frame(job),
            Job::Rows(job) => Waiting::Rows(job),
            Job::Light { scene, lit, pages, reply } => {
                if scene == self.scene
                    && let Err(e) = self.attempt(|state| state.light(&lit, &pages))
                {
                    tracing::error!("pages keep their light: {e}");
                }
                let _ = reply.send(());
                return None;
            }
            Job::ForgetPages { scene, reply } => {
                if scene == self.scene
                    && let Err(e) = self.attempt(|state| state.show(None))
                {
                    tracing::error!("the pages stay: {e}");
                }
                let _ = reply.send(());
                return None;
            }
            Job::Replace { state, reply } => {
                *self = *state;
                let _ = reply.send(());
                return None;
            }
            Job::Stop { reply } => return Some(reply),
        };
        if !waiting.iter().any(|other| other.viewer() == work.viewer()) {
            turns.enter(work.viewer());
        }
        waiting.push(work);
        None
    }

    /// Does a piece of work while `goes_on`.
    fn turn(&mut self, work: Waiting, goes_on: Wanted<'_>) -> Left {
        let is_lost = match work {
            Waiting::Frame(mut job) => {
                let made = match self.attempt(|state| state.advance(&mut job, goes_on)) {
                    Ok(None) => return Left::Some(Waiting::Frame(job)),
                    Ok(Some(generated)) => Ok(generated),
                    Err(e) => Err(e),
                };
                // Who hears of it orders again, and must find another device.
                let is_lost = made.as_ref().is_err_and(|e| self.is_over(e));
                let _ = job.reply.send(made);
                is_lost
            }
            Waiting::Rows(job) => {
                let made = self.attempt(|state| state.rows(&job));
                let is_lost = made.as_ref().is_err_and(|e| self.is_over(e));
                let _ = job.reply.send(made);
                is_lost
            }
        };
        if is_lost { Left::Device } else { Left::Nothing }
    }

    /// A panic in one frame must not end the service for everyone.
    fn attempt<T>(
        &mut self,
        work: impl FnOnce(&mut Self) -> Result<T, GenerateError>,
    ) -> Result<T, GenerateError> {
        let attempt = catch_unwind(AssertUnwindSafe(|| work(self)));
        attempt.unwrap_or(Err(GenerateError::Panicked))
    }

    /// Whether other devices do the work from now on, after an error. If the last renderer is lost, the CPU replaces it.
    fn is_over(&mut self, error: &GenerateError) -> bool {
        if !error.is_lost() {
            return false;
        }
        if self.site.lose() {
            tracing::error!("other devices render from now on: {error}");
            return true;
        }
        tracing::error!("the CPU goes on: {error}");
        self.renderer.fall_back();
        false
    }

    /// Makes a piece of a frame; the whole frame with the last one.
    fn advance(
        &mut self,
        job: &mut FrameJob,
        goes_on: Wanted<'_>,
    ) -> Result<Option<Generated>, GenerateError> {
        let started = Instant::now();
        let FrameJob { order, begun, spent_micros, .. } = job;
        if order.scene != self.scene {
            return Err(GenerateError::OtherVolume);
        }
        let mut pages = begun.as_ref().and_then(|begun| begun.pages.clone());
        if begun.as_ref().is_none_or(|begun| begun.frame.needs_its_scene()) {
            self.prepare(order.scene, &order.look, order.near.as_ref(), None)?;
            if let (None, Some(pager)) = (&begun, &self.pager) {
                let scene = self.renderer.scene();
                let view =
                    PageView { camera: order.header.camera, region: scene.region(), rests: order.rests };
                pages = Some(pager.pages(order.viewer, &view, scene));
                if !self.site.is_here(order.viewer) {
                    // It has left meanwhile, and must not keep a share of the memory.
                    pager.forget(order.viewer.0);
                }
            }
            if let Err(e) = self.show(pages.as_ref()) {
                // The frame begins anew, with a plan of fewer pages.
                *begun = None;
                return if self.may_plan_fewer(&e) { Ok(None) } else { Err(e) };
            }
        }
        let begun = match begun {
            Some(begun) => begun,
            None => {
                let is_draft = !self.is_final();
                let occlusion = self.renderer.scene().illumination.occlusion().filter(|_| !is_draft);
                begun.insert(Begun { frame: self.renderer.begin(order.header)?, is_draft, occlusion, pages })
            }
        };
        let num_lists = order.header.camera.intrinsics.num_pixels();
        let max_segments = max_segments(order.held.bytes(), num_lists);
        let wanted = || order.wish.holds();
        let piece = self.renderer.advance(&mut begun.frame, max_segments, goes_on, &wanted)?;
        *spent_micros += started.elapsed().as_micros() as u64;
        match piece {
            Piece::Unfinished => Ok(None),
            Piece::GivenUp => Err(GenerateError::GivenUp),
            // The frame before was smaller or sparser, and there is room.
            Piece::TooLarge(expected)
                if expected / 4 * 5 <= MAX_FRAME_SEGMENTS
                    && order.held.grow(bytes_of_making(expected / 4 * 5, num_lists)) =>
            {
                Ok(None)
            }
            Piece::TooLarge(expected) => {
                let camera = &order.header.camera;
                let share = max_segments as f64 / expected.max(1) as f64;
                let num_lists = camera.intrinsics.num_pixels() as f64 * (share * LESS).min(LESS);
                let intrinsics = within(camera.intrinsics, num_lists as usize);
                tracing::debug!(?intrinsics, "a smaller frame, within its memory");
                order.header.camera =
                    Camera::new(camera.pose, intrinsics, &self.renderer.scene().volume.bounds());
                job.begun = None;
                Ok(None)
            }
            Piece::Whole(mut frame) => {
                let ended = Instant::now();
                self.after_work.note(Work::Generate, Duration::from_micros(*spent_micros));
                *spent_micros += ended.elapsed().as_micros() as u64;
                let mut held = order.held.take();
                held.set(bytes_of(frame.num_segments(), frame.num_lists()));
                let (generate_micros, is_draft) = (*spent_micros, begun.is_draft);
                let occlusion = begun.occlusion.take();
                let pages = begun.pages.take().map(|pages| match &self.pager {
                    Some(pager) => pager.with_others(order.viewer, pages),
                    None => pages,
                });
                frame.header_mut().fineness = pages.as_ref().map(FramePages::fineness).unwrap_or_default();
                Ok(Some(Generated { frame, _held: held, generate_micros, is_draft, occlusion, pages }))
            }
        }
    }

    /// Renders as many rows of a picture as take about as long as a turn.
    fn rows(&mut self, job: &RowsJob) -> Result<Rows, GenerateError> {
        let started = Instant::now();
        self.prepare(job.scene, &job.look, None, job.lit.as_ref())?;
        self.show(job.pages.as_ref()).inspect_err(|e| {
            self.may_plan_fewer(e);
        })?;
        let Intrinsics { width, height, .. } = job.camera.intrinsics;
        let most = match self.renderer {
            Renderer::Gpu(_) => GPU_PIXELS,
            Renderer::Cpu(_) | Renderer::Workers(_) => CPU_PIXELS,
        };
        let num_pixels = job.num_pixels.unwrap_or(most / 8).min(most);
        let end = job.first.saturating_add((num_pixels / width.max(1)).max(1)).min(height);
        let picture = self.renderer.render_rows(&job.camera, job.first..end)?;
        Ok(Rows { picture, micros: started.elapsed().as_micros() as u64 })
    }

    /// Sets a look: with all of its shade if that is known or given, else with a draft. The scene may have the look of
    /// any viewer, so its ambient occlusion is not taken.
    fn prepare(
        &mut self,
        scene: SceneNumber,
        look: &Look,
        near: Option<&Occlusion>,
        lit: Option<&Scene>,
    ) -> Result<(), GenerateError> {
        if scene != self.scene {
            return Err(GenerateError::OtherVolume);
        }
        let is_set = self.look.marches_like(look);
        if is_set && self.is_final() {
            // This marks the look as used, so that it is not evicted first.
            self.lights.known(look);
            return Ok(());
        }
        let plain = || self.lights.known_without_shade(look, || self.renderer.scene().without_pages());
        match lit.cloned().or_else(|| self.lights.known(look)).or_else(plain) {
            Some(lit) => {
                self.renderer.set_scene(lit)?;
                self.awaits_light = false;
            }
            None if is_set => return Ok(()),
            None => {
                let shown = self.renderer.scene().without_pages();
                let mut draft = shown.under(look, Detail::Draft, near);
                let is_lit = |scene: &Scene| scene.illumination.lit().is_some();
                // To light all pages takes a while, so that happens beside the frames.
                self.awaits_light = self.pager.is_some() && !is_lit(&shown) && is_lit(&draft);
                if self.awaits_light {
                    let lighting = Lighting { ambient_occlusion: 0.0, shadows: 0.0, ..look.lighting };
                    let dark = Look { shaded: false, lighting, ..look.clone() };
                    draft = shown.under(&dark, Detail::Draft, None);
                }
                self.renderer.set_scene(draft)?;
            }
        }
        self.look = look.clone();
        Ok(())
    }

    /// Shows these pages, or the volume that is in memory whole.
    fn show(&mut self, pages: Option<&FramePages>) -> Result<(), GenerateError> {
        let scene = self.renderer.scene();
        let shown = scene.pages.as_ref().map(|shown| Arc::as_ptr(&shown.set));
        if shown == pages.map(|pages| Arc::as_ptr(&pages.set)) {
            return Ok(());
        }
        let scene = match pages {
            Some(pages) if self.awaits_light => self.lights.with_dark_pages(scene, &pages.set),
            Some(pages) => self.lights.with_pages(scene, &pages.set),
            None => scene.without_pages(),
        };
        Ok(self.renderer.set_scene(scene)?)
    }

    /// Whether plans have fewer pages from now on, because the device turned out to have too little memory.
    fn may_plan_fewer(&self, error: &GenerateError) -> bool {
        match (error, &self.pager) {
            (GenerateError::Gpu(GpuError::Pages { most }), Some(pager)) => pager.limit(*most),
            _ => false,
        }
    }

    /// Shows pages that are lit: the renderer keeps no brightness that nobody shows any more.
    fn light(&mut self, lit: &Scene, pages: &[LitPage]) -> Result<(), GenerateError> {
        let shown = self.renderer.scene();
        // Pages under another look have other visible bricks.
        if shown.is_seen_like(lit) && !self.awaits_light {
            let scene = shown.with_lit_pages(pages);
            self.renderer.set_scene(scene)?;
        }
        Ok(())
    }

    fn is_final(&self) -> bool {
        !self.awaits_light && self.renderer.scene().is_final()
    }
}

/// Time of a turn while others wait.
const TURN: Duration = Duration::from_millis(10);
/// Most pixels of a picture in a piece.
const CPU_PIXELS: u32 = 1 << 16;
const GPU_PIXELS: u32 = 1 << 20;
/// How much smaller than expected a frame is made that was too large.
const LESS: f64 = 0.85;

#[cfg(test)]
mod tests;
