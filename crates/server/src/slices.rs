//! A viewer's slices: made from the voxels on threads that may block, and sent one after another.

use std::sync::Arc;

use isinglass_core::ids::SliceId;
use isinglass_core::volume::{PAGE_CELLS, Pyramid, Slice, SliceSpec, Volume};
use isinglass_core::wire::SliceRequest;
use isinglass_core::wire::slice::encode_slice;
use isinglass_net::server::{Control, FrameSender};
use isinglass_render::Workers;
use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::{Semaphore, watch};
use tokio::task::{AbortHandle, JoinSet};
use tracing::Instrument;

use crate::ServeError;
use crate::give_up::GiveUp;
use crate::selection::Present;

/// What makes the slices of all viewers: few threads, so that frames keep most of the machine.
pub(crate) struct SliceMakers {
    threads: ThreadPool,
    /// One for each slice that may be made at a time.
    turns: Arc<Semaphore>,
    /// Reads pages for slices, one slice at a time.
    readers: ThreadPool,
    reading: Arc<Semaphore>,
    /// The processes that have the volume, if they are several.
    workers: Option<Arc<dyn Workers>>,
}

impl SliceMakers {
    pub(crate) fn new(workers: Option<Arc<dyn Workers>>) -> Result<Self, ServeError> {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = ThreadPoolBuilder::new().num_threads(cores.div_ceil(4));
        let threads = threads.thread_name(|i| format!("slice {i}")).build()?;
        let readers = ThreadPoolBuilder::new().num_threads(cores.clamp(1, MAX_READERS));
        let readers = readers.thread_name(|i| format!("slice page {i}")).build()?;
        let (turns, reading) = (Arc::new(Semaphore::new(MAX_MAKING)), Arc::new(Semaphore::new(1)));
        Ok(Self { threads, turns, readers, reading, workers })
    }
}

/// The slices of one viewer that are being made or sent. When this is dropped, all are given up.
pub(crate) struct Slices {
    frames: FrameSender,
    control: Control,
    jobs: JoinSet<SliceId>,
    running: Vec<Running>,
    makers: Arc<SliceMakers>,
    writers: Arc<Writers>,
}

/// Those that write their stream: one that is urgent, and one that is ahead.
struct Writers {
    urgent: Semaphore,
    ahead: Semaphore,
}

struct Running {
    id: SliceId,
    /// Whether nobody looks at it yet.
    is_ahead: watch::Sender<bool>,
    abort: AbortHandle,
}

impl Slices {
    pub(crate) fn new(makers: Arc<SliceMakers>, frames: FrameSender, control: Control) -> Self {
        let writers = Arc::new(Writers { urgent: Semaphore::new(1), ahead: Semaphore::new(1) });
        Self { frames, control, jobs: JoinSet::new(), running: Vec::new(), makers, writers }
    }

    /// Gives up what is no longer wanted, and begins what is.
    pub(crate) fn advance(&mut self, present: &Arc<Present>) {
        let mut talk = self.control.talk();
        let slices = &mut talk.quietly().slices;
        self.running.retain(|job| match slices.wanted(job.id) {
            Some(wanted) => {
                job.is_ahead.send_replace(wanted.is_ahead);
                true
            }
            None => {
                job.abort.abort();
                false
            }
        });
        // Slices ahead leave room to urgent ones.
        let has_room = |running: &[Running], request: &SliceRequest| {
            let is_alike = |job: &&Running| *job.is_ahead.borrow() == request.is_ahead;
            running.iter().filter(is_alike).count() < MAX_RUNNING
        };
        while let Some(request) = slices.poll_next(|request| has_room(&self.running, request)) {
            let is_ahead = watch::Sender::new(request.is_ahead);
            let job = SliceJob {
                request,
                is_ahead: is_ahead.subscribe(),
                frames: self.frames.clone(),
                present: present.clone(),
                makers: self.makers.clone(),
                writers: self.writers.clone(),
            };
            let span = tracing::debug_span!("slice", id = request.id.0);
            let abort = self.jobs.spawn(job.run().instrument(span));
            self.running.push(Running { id: request.id, is_ahead, abort });
        }
    }

    /// Returns when the viewer has a slice, so that another may begin; never if none is on its way.
    pub(crate) async fn next(&mut self) {
        match self.jobs.join_next().await {
            Some(Ok(id)) => self.running.retain(|job| job.id != id),
            Some(Err(e)) if e.is_cancelled() => {}
            Some(Err(e)) => {
                tracing::error!("no slice: {e}");
                self.running.retain(|job| !job.abort.is_finished());
            }
            None => std::future::pending().await,
        }
    }
}

/// A slice that is made and sent.
struct SliceJob {
    request: SliceRequest,
    is_ahead: watch::Receiver<bool>,
    frames: FrameSender,
    present: Arc<Present>,
    makers: Arc<SliceMakers>,
    writers: Arc<Writers>,
}

impl SliceJob {
    async fn run(mut self) -> SliceId {
        let passes = match &self.present.pager {
            Some(pager) => passes(pager.pyramid(), &self.request.spec, self.present.lights.volume()),
            None => vec![None],
        };
        let last = passes.len() - 1;
        for (i, level) in passes.into_iter().enumerate() {
            match self.make(level, i == last).await {
                Ok(Some(Made { bytes, is_draft })) => {
                    self.send(&bytes).await;
                    if !is_draft {
                        break;
                    }
                }
                Ok(None) => break,
                Err(e) => {
                    tracing::error!("no slice: {e}");
                    break;
                }
            }
        }
        self.request.id
    }

    /// The slice; none if nobody wants it any more. Of a volume that is read by pages, those are read at `level` that are
    /// coarser in memory. Unless it is the `last` pass, a slice of coarser ones is a draft.
    async fn make(&self, level: Option<u8>, is_last: bool) -> Result<Option<Made>, String> {
        let turns = if level.is_some() { &self.makers.reading } else { &self.makers.turns };
        let turn = turns.clone().acquire_owned().await.map_err(|e| e.to_string())?;
        let given_up = GiveUp::default();
        let wanted = given_up.wanted();
        let (request, present, makers) = (self.request, self.present.clone(), self.makers.clone());
        let work = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            let threads = if level.is_some() { &makers.readers } else { &makers.threads };
            let volume = present.lights.volume();
            let slice = threads.install(|| match (&makers.workers, &present.pager) {
                // They make all of it once they have begun.
                (Some(workers), None) => {
                    workers.slice(&request.spec).filter(|_| wanted()).map(|slice| (slice, 0))
                }
                (_, Some(pager)) => pager.with_values(volume, level, &wanted, |values| {
                    Slice::of_pages(values, &request.spec, &wanted)
                }),
                (None, None) => Slice::of(volume, &request.spec, &wanted).map(|slice| (slice, 0)),
            });
            let made = slice.map(|(slice, coarsest)| {
                let is_draft = coarsest > 0 && !is_last;
                encode_slice(request.id, &slice, is_draft).map(|bytes| Made { bytes, is_draft })
            });
            made.transpose()
        });
        work.await.map_err(|e| e.to_string())?.map_err(|e| e.to_string())
    }

    /// Waits for the writer before it, unless somebody now looks at the slice. If the viewer leaves, nobody waits.
    async fn send(&mut self, bytes: &[u8]) {
        let mut is_ahead = self.is_ahead.clone();
        let becomes_urgent = async { is_ahead.wait_for(|is_ahead| !is_ahead).await.is_ok() };
        let turn = tokio::select! {
            biased;
            _ = becomes_urgent => self.writers.urgent.acquire().await,
            turn = self.writers.ahead.acquire() => turn,
        };
        let Ok(turn) = turn else { return };
        let Ok(sent) = self.frames.send_slice(bytes, &self.is_ahead).await else { return };
        drop(turn);
        sent.delivered().await;
    }
}

/// The bytes of a slice's stream, and whether a finer one follows.
struct Made {
    bytes: Vec<u8>,
    is_draft: bool,
}

/// What a slice of a volume that is read by pages is made of, one after the other: what is in memory, and then pages of
/// finer and finer levels. A slab that is thick in pages ends with a coarser level.
fn passes(pyramid: &Pyramid, spec: &SliceSpec, base: &Volume) -> Vec<Option<u8>> {
    let thickness = spec.thickness / base.finest_spacing().min_element();
    let num_pages = |level: u8| {
        let mut sides = pyramid.pages(usize::from(level)).map(f64::from);
        sides.sort_by(f64::total_cmp);
        let factor = pyramid.levels[usize::from(level)].factor.into_iter().min().unwrap_or(1);
        let across = f64::from(thickness) / f64::from(PAGE_CELLS * factor);
        sides[1] * sides[2] * (1.0 + across).min(sides[0])
    };
    let finer = (0..pyramid.levels.len().saturating_sub(1) as u8).rev();
    let worth = finer.filter(|&level| {
        let is_last = level == 0 || num_pages(level - 1) > MOST_PAGES;
        num_pages(level) <= MOST_PAGES && (is_last || num_pages(level) > FEW_PAGES)
    });
    std::iter::once(None).chain(worth.map(Some)).collect()
}

/// Most urgent slices of a viewer on their way at a time, so that a long link is used well; and as many ahead.
const MAX_RUNNING: usize = 4;
/// Most slices that all viewers together may make at a time.
const MAX_MAKING: usize = 2;
/// Most threads that read pages for slices.
const MAX_READERS: usize = 4;
/// Most pages that are read for a slice: seconds on a fast disk.
const MOST_PAGES: f64 = 8192.0;
/// A slice of so few pages is not worth a pass of its own.
const FEW_PAGES: f64 = 64.0;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::volume::{PyramidLevel, SlabMode, SlicePlane, VolumeInfo, VoxelKind, Voxels};

    use super::*;

    #[test]
    fn slices_are_read_from_coarse_to_fine_and_thick_slabs_end_earlier() {
        let side = |level: u32| 2714u32.div_ceil(1 << level);
        let level = |n: u32| PyramidLevel { dims: [side(n); 3], factor: [1 << n; 3], first: [0.0; 3] };
        let pyramid = Pyramid {
            levels: (0..5).map(level).collect(),
            spacing: Vec3::ONE,
            kind: VoxelKind::U8,
            value_maps: vec![(1.0, 0.0)],
            info: VolumeInfo::default(),
        };
        let base = Volume::new([2; 3], Vec3::ONE, Voxels::U8(vec![0; 8]), (1.0, 0.0), VolumeInfo::default());
        let base = base.unwrap();
        let spec = |thickness| SliceSpec {
            plane: SlicePlane::Axis { axis: 0, index: 7 },
            thickness,
            mode: SlabMode::Mean,
        };
        let of = |thickness| passes(&pyramid, &spec(thickness), &base);
        assert_eq!(of(0.0), [None, Some(2), Some(1), Some(0)]);
        assert_eq!(of(3000.0), [None, Some(3), Some(2)]);
        let small = Pyramid { levels: pyramid.levels[3..].to_vec(), ..pyramid };
        assert_eq!(passes(&small, &spec(0.0), &base), [None, Some(0)], "control: one pass is enough");
    }
}
