//! The decoding thread: it takes the newest decodable frame, decodes its chunks in parallel and publishes it.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, OnceLock, PoisonError};
use std::time::Duration;

use isinglass_core::codec;
use isinglass_core::codec::blocks::References;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::session::chunks::DecodeJob;
use rayon::{ThreadPool, ThreadPoolBuilder};

use super::{ReceivedFrame, Shared};
use crate::work::Work;

/// Decodes until the client stops.
pub(super) fn run(shared: &Shared) {
    let mut references = References::default();
    let mut given = Given::default();
    let mut connection = 0;
    // This runs while the connection is made.
    codec::prepare();
    while let Some(job) = next_job(shared) {
        let _span = tracing::debug_span!("frame", frame = job.frame.0).entered();
        if job.connection != connection {
            connection = job.connection;
            references.clear();
            given = Given::default();
        }
        // Even a panic costs only one frame.
        let begun_micros = shared.clock.now_micros();
        let spare = given.take();
        let attempt = shared.after_work.run(Work::Decode, || {
            let decode = || codec::decode_with(&job.chunks, &references, spare);
            catch_unwind(AssertUnwindSafe(|| match decoders() {
                Some(threads) => threads.install(decode),
                None => decode(),
            }))
        });
        let decoded = match attempt {
            Ok(decoded) => decoded.map_err(|e| e.to_string()),
            Err(_) => Err("the decoder has failed".into()),
        };
        let (frame, reference) = match decoded {
            Ok(decoded) => decoded,
            Err(problem) => {
                shared.note_broken_chunk(format!("frame {} cannot be decoded: {problem}", job.frame));
                shared.chunks().handle_broken(job.connection, job.frame);
                continue;
            }
        };
        let is_exact = reference.is_none();
        if let Some(reference) = reference {
            references.insert(reference);
        }
        let now = shared.clock.now_micros();
        let num_lists = frame.header.camera.intrinsics.num_pixels();
        let times = {
            let mut chunks = shared.chunks();
            chunks.handle_decode_time(now.saturating_sub(begun_micros), num_lists);
            chunks.handle_decoded(now, job.connection, job.frame)
        };
        let Some(times) = times else { continue };
        let received = Arc::new(ReceivedFrame { frame, is_exact, times });
        given.note(&received);
        shared.frame.store(Some(received));
        tracing::trace!("decoded");
        (shared.wake)();
    }
}

/// The threads that decode, for all clients of the process; `None` if the system gives none. On shared ones, a frame
/// would wait for long work of a server in the same process, such as the shade of a new look.
fn decoders() -> Option<&'static ThreadPool> {
    static THREADS: OnceLock<Option<ThreadPool>> = OnceLock::new();
    let make = || {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = ThreadPoolBuilder::new().num_threads(cores.min(MAX_DECODERS));
        threads.thread_name(|i| format!("decode {i}")).build().ok()
    };
    THREADS.get_or_init(make).as_ref()
}

/// Waits for the next job; `None` when the client stops.
fn next_job(shared: &Shared) -> Option<DecodeJob> {
    let mut chunks = shared.chunks();
    loop {
        if shared.is_stopping() {
            return None;
        }
        if let Some(job) = chunks.poll_decode(shared.clock.now_micros()) {
            return Some(job);
        }
        let waited = shared.decode_wanted.wait_timeout(chunks, Duration::from_secs(1));
        chunks = waited.unwrap_or_else(PoisonError::into_inner).0;
    }
}

/// Recently published frames. When nobody uses one any more, its memory is recycled.
#[derive(Default)]
struct Given(VecDeque<Arc<ReceivedFrame>>);

impl Given {
    fn note(&mut self, frame: &Arc<ReceivedFrame>) {
        self.0.push_back(frame.clone());
        if self.0.len() > MAX_GIVEN {
            self.0.pop_front();
        }
    }

    /// Takes a frame that nobody uses.
    fn take(&mut self) -> Option<LayeredFrame> {
        let at = self.0.iter().position(|frame| Arc::strong_count(frame) == 1)?;
        Some(Arc::into_inner(self.0.remove(at)?)?.frame)
    }
}

/// More threads do not decode a frame faster.
const MAX_DECODERS: usize = 8;
/// The viewer shows the newest, may still use the previous one, and may keep one more.
const MAX_GIVEN: usize = 3;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::camera::{Camera, Intrinsics, Pose};
    use isinglass_core::ids::FrameId;
    use isinglass_core::layer::FrameHeader;
    use isinglass_core::session::ledger::Life;
    use isinglass_core::space::Aabb;

    use super::*;

    #[test]
    fn memory_is_taken_of_frames_that_nobody_has() {
        let received = |id| {
            let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
            let pose = Pose::orbit(Vec3::ZERO, 0.3, 0.2, 5.0);
            let camera = Camera::new(pose, Intrinsics::perspective(4, 3, 0.7), &bounds);
            let frame =
                LayeredFrame::empty(FrameHeader { frame: FrameId(id), ..FrameHeader::alone(camera, 4) });
            Arc::new(ReceivedFrame { frame, is_exact: false, times: Life::default() })
        };
        let mut given = Given::default();
        assert!(given.take().is_none());
        let [first, second] = [1, 2].map(received);
        given.note(&first);
        given.note(&second);
        assert!(given.take().is_none(), "both are looked at");
        drop(second);
        assert_eq!(given.take().map(|frame| frame.header.frame), Some(FrameId(2)));
        assert!(given.take().is_none(), "the first is still looked at, the second is taken");
        // Frames that stay with others are not waited for.
        let kept: Vec<_> = (3..9).map(received).collect();
        kept.iter().for_each(|frame| given.note(frame));
        assert_eq!((given.0.len(), Arc::strong_count(&first)), (MAX_GIVEN, 1));
        drop(kept);
        assert_eq!(given.take().map(|frame| frame.header.frame), Some(FrameId(6)));
    }
}
