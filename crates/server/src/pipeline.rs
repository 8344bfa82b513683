//! One viewer's frames in progress: one is generated, one coded and one sent. At most one waits for the coder, and
//! one for the network. Nothing here waits for the viewer or decides the content of a frame.

use std::future::pending;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::codec::blocks::Reference;
use isinglass_core::codec::{CodecError, Coding, EncodedFrame};
use isinglass_core::ids::FrameId;
use isinglass_core::layer::FrameHeader;
use isinglass_core::session::frames::{Asked, Sending};
use isinglass_core::session::ledger::Stage;
use isinglass_core::session::schedule::{Schedule, Station};
use isinglass_core::wire::ServerStats;
use isinglass_net::server::{Control, FrameSender};
use isinglass_net::{AfterWork, Journal, SessionClosed, Work};
use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tracing::Instrument;

use crate::ServeError;
use crate::generator::{GenerateError, Generated, Wish};
use crate::serving::Common;

/// The threads that encode all viewers' frames.
pub(crate) type Coders = Arc<ThreadPool>;

/// They are separate because on shared ones, encoding one frame and decoding another would wait for each other.
pub(crate) fn coders() -> Result<Coders, ServeError> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = ThreadPoolBuilder::new().num_threads(cores.min(MAX_CODERS));
    Ok(Arc::new(threads.thread_name(|i| format!("code {i}")).build()?))
}

/// More threads do not encode a frame faster.
const MAX_CODERS: usize = 8;

/// A frame on its way to the coder and the network.
#[derive(Clone)]
pub(crate) struct Ticket {
    pub(crate) sending: Sending,
    pub(crate) reference: Option<Arc<Reference>>,
    pub(crate) wish: Wish,
}

pub(crate) struct Coded {
    pub(crate) ticket: Ticket,
    pub(crate) generated: Generated,
    encoded: EncodedFrame,
    /// The reference for later frames.
    pub(crate) reference: Option<Arc<Reference>>,
    pub(crate) encode_micros: u64,
}

impl Coded {
    pub(crate) fn num_bytes(&self) -> usize {
        self.encoded.num_bytes()
    }
}

/// A frame that the network has taken.
pub(crate) struct Sent {
    pub(crate) ticket: Ticket,
    pub(crate) generated: Generated,
}

/// A station has finished. Its frame moves on only if it is handed on.
pub(crate) enum Event {
    /// The inner `None` means that the rendering thread has ended.
    Generated(Option<Asked>, Option<Result<Generated, GenerateError>>),
    /// `None` means that the thread has failed.
    Coded(Option<Result<Coded, CodecError>>),
    Sent(Result<Sent, SessionClosed>),
}

/// Holds the frames in progress. `advance` hands them on; `next` waits for a station.
pub(crate) struct Pipeline {
    frames: FrameSender,
    control: Control,
    journal: Journal,
    after_work: AfterWork,
    coders: Coders,
    schedule: Schedule,
    generating: Option<At<Outcome, (Asked, Wish)>>,
    made: Option<(Asked, Generated)>,
    coding: Option<At<Result<Coded, CodecError>, Ticket>>,
    coded: Option<Coded>,
    sending: Option<At<Result<Sent, SessionClosed>, Ticket>>,
}

/// `None` if the rendering thread has ended.
type Outcome = Option<Result<Generated, GenerateError>>;

/// A task and its subject. Dropping it ends the task, except work on threads, which its wish ends.
struct At<T, F> {
    task: JoinHandle<T>,
    of: F,
    frame: FrameId,
}

impl<T, F> Drop for At<T, F> {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Drop for Pipeline {
    fn drop(&mut self) {
        // Nobody waits for work on threads.
        let asked = self.generating.as_ref().map(|at| &at.of.1);
        let coding = self.coding.as_ref().map(|at| &at.of.wish);
        asked.into_iter().chain(coding).for_each(Wish::give_up);
    }
}

impl Pipeline {
    pub(crate) fn new(frames: FrameSender, control: Control, journal: Journal, common: &Common) -> Self {
        Self {
            frames,
            control,
            journal,
            after_work: common.after_work.clone(),
            coders: common.coders.clone(),
            schedule: Schedule::default(),
            generating: None,
            made: None,
            coding: None,
            coded: None,
            sending: None,
        }
    }

    /// Whether no frame is in progress.
    pub(crate) fn is_idle(&self) -> bool {
        self.generating.is_none()
            && self.made.is_none()
            && self.coding.is_none()
            && self.coded.is_none()
            && self.sending.is_none()
    }

    /// Sets the viewer's decoding time per list, ns; 0 if unknown.
    pub(crate) fn handle_decoding(&mut self, nanos_per_list: u16) {
        self.schedule.handle_decoding(nanos_per_list);
    }

    /// Time until a frame of `num_lists` lists should begin; `None` means after the next station finishes.
    pub(crate) fn begins_in(&self, num_lists: usize) -> Option<Duration> {
        let now = self.now_micros();
        let at = self.schedule.begin_at(now, num_lists)?;
        Some(Duration::from_micros(at.saturating_sub(now)))
    }

    /// Begins a frame that `making` makes.
    pub(crate) fn generate(
        &mut self,
        asked: Asked,
        wish: Wish,
        making: impl Future<Output = Option<Result<Generated, GenerateError>>> + Send + 'static,
    ) {
        let frame = asked.header.frame;
        self.journal.open(frame, asked.header.pose);
        self.journal.stamp(frame, Stage::Begun);
        self.schedule.handle_begun(self.now_micros(), Station::Generate, lists(&asked.header));
        self.generating = Some(At { task: tokio::spawn(making), of: (asked, wish), frame });
    }

    /// The frame that is being generated, and whether it is wanted.
    pub(crate) fn generating(&self) -> Option<&(Asked, Wish)> {
        self.generating.as_ref().map(|at| &at.of)
    }

    /// Gives up the frame that is being generated.
    pub(crate) fn give_up_generating(&self) {
        if let Some((_, wish)) = self.generating() {
            wish.give_up();
        }
    }

    /// Gives up the frame at the coder and the one that waits for it, where `is_overtaken` holds.
    pub(crate) fn give_up_coding(&mut self, is_overtaken: impl Fn(&Asked) -> bool) {
        if let Some(at) = self.coding.as_ref().filter(|at| is_overtaken(&at.of.sending.asked)) {
            at.of.wish.give_up();
        }
        if let Some((asked, _)) = self.made.take_if(|(asked, _)| is_overtaken(asked)) {
            self.drop_made(asked.header.frame);
        }
    }

    /// A frame is generated and waits for the coder.
    pub(crate) fn put_made(&mut self, asked: Asked, generated: Generated) {
        self.journal.stamp(asked.header.frame, Stage::Generated);
        self.made = Some((asked, generated));
    }

    /// Takes the next frame for the coder. The previous one must be on its way, so that at most one waits.
    pub(crate) fn take_made(&mut self) -> Option<(Asked, Generated)> {
        self.made.take_if(|_| self.coding.is_none() && self.coded.is_none())
    }

    /// Encodes a frame on a thread for blocking work.
    pub(crate) fn code(&mut self, generated: Generated, ticket: Ticket) {
        let header = *generated.frame.header();
        if ticket.sending.is_finer {
            self.journal.open(header.frame, header.pose);
        }
        self.journal.stamp(header.frame, Stage::CodingBegun);
        self.schedule.handle_begun(self.now_micros(), Station::Code, lists(&header));
        let (of, after_work, coders) = (ticket.clone(), self.after_work.clone(), self.coders.clone());
        let task = tokio::task::spawn_blocking(move || {
            let started = Instant::now();
            let wanted = || ticket.wish.holds();
            let Sending { coding, is_thinned, .. } = ticket.sending;
            let work =
                || generated.frame.encode_while(coding, is_thinned, ticket.reference.as_ref(), &wanted);
            let (encoded, reference) = after_work.run(Work::Encode, || coders.install(work))?;
            let encode_micros = started.elapsed().as_micros() as u64;
            Ok(Coded { ticket, generated, encoded, reference, encode_micros })
        });
        self.coding = Some(At { task, of, frame: header.frame });
    }

    /// A frame is coded and waits for the network.
    pub(crate) fn put_coded(&mut self, coded: Coded) {
        let header = *coded.generated.frame.header();
        self.journal.stamp(header.frame, Stage::Coded);
        self.journal.add_bytes(header.frame, coded.num_bytes() as u64);
        self.coded = Some(coded);
    }

    /// Hands a waiting frame to the network, if the previous one is through.
    pub(crate) fn send(&mut self) {
        let Some(coded) = self.coded.take_if(|_| self.sending.is_none()) else { return };
        let Coded { ticket, generated, encoded, encode_micros, .. } = coded;
        let header = *generated.frame.header();
        self.schedule.handle_begun(self.now_micros(), Station::Send, lists(&header));
        if !ticket.sending.is_finer {
            self.control.talk().link.report(ServerStats {
                frame: header.frame,
                pose: header.pose,
                pose_stamp_micros: ticket.sending.asked.request.stamp_micros,
                generate_micros: generated.generate_micros,
                encode_micros,
                bytes: encoded.num_bytes() as u64,
                segments: generated.frame.num_segments() as u64,
            });
        }
        let (frames, of) = (self.frames.clone(), ticket.clone());
        let sending = async move {
            let (frame, pose) = (header.frame, header.pose);
            match ticket.sending.is_finer {
                true => frames.send_finer(frame, pose, encoded.chunks).await?,
                false => frames.send(frame, pose, encoded.chunks).await?,
            }
            Ok(Sent { ticket, generated })
        };
        let span = tracing::debug_span!("frame", id = header.frame.0);
        self.sending = Some(At { task: tokio::spawn(sending.instrument(span)), of, frame: header.frame });
    }

    /// Waits for a station. Cancellation loses nothing.
    pub(crate) async fn next(&mut self) -> Event {
        tokio::select! {
            biased;
            sent = ended(&mut self.sending) => {
                let is_usual = self.sending.take().is_some_and(|at| at.of.sending.is_usual());
                self.schedule.handle_done(self.now_micros(), Station::Send, is_usual);
                Event::Sent(sent.unwrap_or(Err(SessionClosed)))
            }
            coded = ended(&mut self.coding) => self.note_coded(coded),
            generated = ended(&mut self.generating) => self.note_generated(generated),
        }
    }

    fn note_coded(&mut self, coded: Option<Result<Coded, CodecError>>) -> Event {
        let (Some(at), Some(coded)) = (self.coding.take(), coded) else { return Event::Coded(None) };
        // A frame that was given up at the last moment is not sent either: no other was predicted from it.
        let coded =
            coded.and_then(|c| if c.ticket.wish.holds() { Ok(c) } else { Err(CodecError::Abandoned) });
        if coded.is_ok() {
            self.schedule.handle_done(self.now_micros(), Station::Code, at.of.sending.is_usual());
        } else {
            self.schedule.handle_given_up(Station::Code);
            self.journal.give_up(at.frame);
        }
        Event::Coded(Some(coded))
    }

    fn note_generated(&mut self, generated: Option<Option<Result<Generated, GenerateError>>>) -> Event {
        let generated = generated.flatten();
        if generated.as_ref().is_some_and(Result::is_ok) {
            self.schedule.handle_done(self.now_micros(), Station::Generate, true);
        } else {
            self.schedule.handle_given_up(Station::Generate);
        }
        let at = self.generating.take();
        if let Some(at) = at.as_ref().filter(|_| !matches!(generated, Some(Ok(_)))) {
            self.journal.give_up(at.frame);
        }
        Event::Generated(at.map(|at| at.of.0), generated)
    }

    /// A generated frame goes no further.
    pub(crate) fn drop_made(&mut self, frame: FrameId) {
        self.schedule.handle_dropped(Station::Code);
        self.journal.give_up(frame);
    }

    /// Gives up frames behind the generator for which `is_outdated` holds. A coded frame in blocks is still sent,
    /// because others may refer to it.
    pub(crate) fn give_up(&mut self, is_outdated: impl Fn(&Sending) -> bool) {
        let is_outdated = |ticket: &Ticket| is_outdated(&ticket.sending);
        if let Some(at) = self.coding.as_ref().filter(|at| is_outdated(&at.of)) {
            at.of.wish.give_up();
        }
        let is_exact = |t: &Ticket| matches!(t.sending.coding, Coding::Exact);
        if let Some(coded) = self.coded.take_if(|c| is_exact(&c.ticket) && is_outdated(&c.ticket)) {
            self.schedule.handle_dropped(Station::Send);
            self.journal.give_up(coded.generated.frame.header().frame);
        }
        if let Some(at) = self.sending.take_if(|at| is_exact(&at.of) && is_outdated(&at.of)) {
            self.schedule.handle_given_up(Station::Send);
            self.journal.give_up(at.frame);
        }
    }

    fn now_micros(&self) -> u64 {
        self.journal.clock().now_micros()
    }
}

/// Waits for a task, for ever without one. `None` if it has failed.
async fn ended<T, F>(at: &mut Option<At<T, F>>) -> Option<T> {
    match at {
        Some(at) => (&mut at.task).await.ok(),
        None => pending().await,
    }
}

fn lists(header: &FrameHeader) -> usize {
    header.camera.intrinsics.num_pixels()
}
