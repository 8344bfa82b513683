//! A viewer's slices: made from the voxels on threads that may block, and sent one after another.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use isinglass_core::ids::SliceId;
use isinglass_core::volume::Slice;
use isinglass_core::wire::SliceRequest;
use isinglass_core::wire::slice::encode_slice;
use isinglass_net::server::{Control, FrameSender};
use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::{Semaphore, watch};
use tokio::task::{AbortHandle, JoinSet};
use tracing::Instrument;

use crate::ServeError;
use crate::selection::Present;

/// What makes the slices of all viewers: few threads, so that frames keep most of the machine.
pub(crate) struct SliceMakers {
    threads: ThreadPool,
    /// One for each slice that may be made at a time.
    turns: Arc<Semaphore>,
}

impl SliceMakers {
    pub(crate) fn new() -> Result<Self, ServeError> {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = ThreadPoolBuilder::new().num_threads(cores.div_ceil(4));
        let threads = threads.thread_name(|i| format!("slice {i}")).build()?;
        Ok(Self { threads, turns: Arc::new(Semaphore::new(MAX_MAKING)) })
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
        match self.make().await {
            Ok(Some(bytes)) => self.send(&bytes).await,
            Ok(None) => {}
            Err(e) => tracing::error!("no slice: {e}"),
        }
        self.request.id
    }

    /// The bytes of the stream; none if nobody wants the slice any more.
    async fn make(&self) -> Result<Option<Vec<u8>>, String> {
        let turn = self.makers.turns.clone().acquire_owned().await.map_err(|e| e.to_string())?;
        let given_up = GiveUp(Arc::default());
        let is_given_up = given_up.0.clone();
        let (request, present, makers) = (self.request, self.present.clone(), self.makers.clone());
        let work = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            let wanted = || !is_given_up.load(Ordering::Relaxed);
            let slice = makers.threads.install(|| Slice::of(present.lights.volume(), &request.spec, &wanted));
            slice.map(|slice| encode_slice(request.id, &slice)).transpose()
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

/// Tells the thread that makes a slice that nobody waits for it any more.
struct GiveUp(Arc<AtomicBool>);

impl Drop for GiveUp {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Most urgent slices of a viewer on their way at a time, so that a long link is used well; and as many ahead.
const MAX_RUNNING: usize = 4;
/// Most slices that all viewers together may make at a time.
const MAX_MAKING: usize = 2;
