//! A viewer's slices: made from the voxels on threads that may block, and sent one after another.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use isinglass_core::ids::SliceId;
use isinglass_core::volume::Slice;
use isinglass_core::wire::SliceRequest;
use isinglass_core::wire::slice::{SliceError, encode_slice};
use isinglass_net::server::{Control, FrameSender};
use tokio::sync::Semaphore;
use tokio::task::{AbortHandle, JoinSet};
use tracing::Instrument;

use crate::selection::Present;

/// The slices of one viewer that are being made or sent. When this is dropped, all are given up.
pub(crate) struct Slices {
    frames: FrameSender,
    control: Control,
    running: JoinSet<SliceId>,
    aborts: Vec<(SliceId, AbortHandle)>,
    /// One for each slice that all viewers together may make at a time.
    makers: Arc<Semaphore>,
    /// The one that writes its stream.
    writer: Arc<Semaphore>,
}

impl Slices {
    pub(crate) fn new(makers: Arc<Semaphore>, frames: FrameSender, control: Control) -> Self {
        let writer = Arc::new(Semaphore::new(1));
        Self { frames, control, running: JoinSet::new(), aborts: Vec::new(), makers, writer }
    }

    /// Gives up what is no longer wanted, and begins what is.
    pub(crate) fn advance(&mut self, present: &Arc<Present>) {
        let mut talk = self.control.talk();
        let slices = &mut talk.quietly().slices;
        self.aborts.retain(|(id, running)| {
            let is_wanted = slices.is_wanted(*id);
            if !is_wanted {
                running.abort();
            }
            is_wanted
        });
        while self.aborts.len() < MAX_RUNNING
            && let Some(request) = slices.poll_next()
        {
            let (frames, present) = (self.frames.clone(), present.clone());
            let (makers, writer) = (self.makers.clone(), self.writer.clone());
            let work = async move {
                send(request, &frames, present, &makers, &writer).await;
                request.id
            };
            let span = tracing::debug_span!("slice", id = request.id.0);
            self.aborts.push((request.id, self.running.spawn(work.instrument(span))));
        }
    }

    /// Returns when the viewer has a slice, so that another may begin; never if none is on its way.
    pub(crate) async fn next(&mut self) {
        match self.running.join_next().await {
            Some(Ok(id)) => self.aborts.retain(|(other, _)| *other != id),
            Some(Err(e)) if e.is_cancelled() => {}
            Some(Err(e)) => {
                tracing::error!("no slice: {e}");
                self.aborts.retain(|(_, running)| !running.is_finished());
            }
            None => std::future::pending().await,
        }
    }
}

/// Makes and sends a slice. If the viewer leaves meanwhile, nobody waits for it.
async fn send(
    request: SliceRequest,
    frames: &FrameSender,
    present: Arc<Present>,
    makers: &Arc<Semaphore>,
    writer: &Semaphore,
) {
    let Ok(turn) = makers.clone().acquire_owned().await else { return };
    let given_up = GiveUp(Arc::default());
    let is_given_up = given_up.0.clone();
    let work = tokio::task::spawn_blocking(move || -> Result<Option<Vec<u8>>, SliceError> {
        let _turn = turn;
        let wanted = || !is_given_up.load(Ordering::Relaxed);
        let slice = Slice::of(present.lights.volume(), &request.spec, &wanted);
        slice.map(|slice| encode_slice(request.id, &slice)).transpose()
    });
    let bytes = match work.await {
        Ok(Ok(Some(bytes))) => bytes,
        Ok(Ok(None)) => return,
        Ok(Err(e)) => return tracing::error!("no slice: {e}"),
        Err(e) => return tracing::error!("no slice: {e}"),
    };
    let Ok(turn) = writer.acquire().await else { return };
    let Ok(sent) = frames.send_slice(&bytes, request.is_ahead).await else { return };
    drop(turn);
    sent.delivered().await;
}

/// Tells the thread that makes a slice that nobody waits for it any more.
struct GiveUp(Arc<AtomicBool>);

impl Drop for GiveUp {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Most slices of a viewer on their way at a time, so that a long link is used well.
const MAX_RUNNING: usize = 4;
/// Most slices that all viewers together may make at a time.
pub(crate) const MAX_MAKERS: usize = 2;
