//! From a wish to a source of frames, step by step and without waiting: a link is connected to; a volume is looked at, read,
//! served in this process, and then connected to.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};

use isinglass_core::volume::Volume;
use isinglass_formats::{
    FormatError, LoadRequest, Loading, Outline, ReadState, RecentPlace, VolumeSource, outline,
    state_from_link,
};
use isinglass_net::{Client, ClientOptions, Clock, Link, State};

use super::services::{LocalServer, LocalServers};
use crate::BoxedSource;
use crate::app::Origin;
use crate::overlay::sentence;
use crate::window::Waker;

/// Something that is being opened. Dropping it cancels.
pub(crate) struct Opening {
    /// What a person calls it.
    pub(crate) name: String,
    place: RecentPlace,
    origin: Origin,
    clock: Clock,
    wake: Waker,
    step: Step,
    outline: Option<Outline>,
    server: Option<Box<dyn Send>>,
}

enum Step {
    /// The header is read.
    Surveying(Local, Receiver<Result<Outline, String>>),
    /// The voxels are read.
    Reading(Local, Loading),
    /// The server is started.
    Starting(Receiver<Result<LocalServer, String>>),
    Connecting(Box<Client>),
    /// It was told how it ended.
    Over,
}

struct Local {
    servers: Arc<dyn LocalServers>,
    request: LoadRequest,
}

/// How far an opening is.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Stage {
    /// The header is read.
    Looking,
    /// The voxels are read.
    Reading(f32),
    /// Bricks, histogram, upload to the GPU.
    Preparing,
    /// A server is called.
    Connecting,
}

/// What was opened.
pub(crate) struct Opened {
    pub(crate) source: BoxedSource,
    pub(crate) origin: Origin,
    /// The server in this process, and the bytes of its volume.
    pub(crate) server: Option<(Box<dyn Send>, u64)>,
    pub(crate) place: RecentPlace,
    /// The name of the volume.
    pub(crate) shows: String,
}

impl Opening {
    /// Calls a server.
    pub(crate) fn connect(link: &Link, clock: &Clock, wake: &Waker) -> Result<Self, String> {
        let place = RecentPlace::Server { host: link.host.clone(), port: link.port };
        let state = link.state.as_deref().map(state_from_link).transpose().map_err(|e| sentence(&e))?;
        let client = client(link, clock, wake)?;
        let name = link.place();
        let origin =
            Origin { server_name: name.clone(), link: Some(link.clone()), volume_source: None, state };
        Ok(Self {
            name,
            place,
            origin,
            clock: clock.clone(),
            wake: wake.clone(),
            step: Step::Connecting(client),
            outline: None,
            server: None,
        })
    }

    /// Opens a volume beside one that takes `held` bytes.
    pub(crate) fn local(
        request: LoadRequest,
        held: u64,
        servers: Arc<dyn LocalServers>,
        clock: &Clock,
        wake: &Waker,
    ) -> Self {
        let name = std::path::Path::new(&request.source)
            .file_name()
            .map_or_else(|| request.source.clone(), |n| n.to_string_lossy().into_owned());
        // The list is read where another folder may be the present one.
        let source = match request.source.starts_with("builtin:") {
            true => request.source.clone(),
            false => std::path::absolute(&request.source)
                .map_or_else(|_| request.source.clone(), |path| path.to_string_lossy().into_owned()),
        };
        let volume = VolumeSource { source, ..request.clone().into() };
        let place = RecentPlace::Volume(volume.clone());
        let origin =
            Origin { server_name: "this computer".into(), volume_source: Some(volume), ..Origin::default() };
        let (of_thread, servers_of_thread) = (request.clone(), servers.clone());
        let look = move || survey(&of_thread, held, &*servers_of_thread);
        let receiver = on_a_thread(wake, look);
        Self {
            name,
            place,
            origin,
            clock: clock.clone(),
            wake: wake.clone(),
            step: Step::Surveying(Local { servers, request }, receiver),
            outline: None,
            server: None,
        }
    }

    /// The same, to be seen as a state says.
    pub(crate) fn seen_as(mut self, read: ReadState) -> Self {
        self.origin.state = Some(read);
        self
    }

    /// How far it is.
    pub(crate) fn stage(&self) -> Stage {
        match &self.step {
            Step::Surveying(..) => Stage::Looking,
            Step::Reading(_, loading) => Stage::Reading(loading.progress()),
            Step::Starting(_) => Stage::Preparing,
            // The server in this process answers at once.
            Step::Connecting(_) | Step::Over if self.server.is_some() => Stage::Preparing,
            Step::Connecting(_) | Step::Over => Stage::Connecting,
        }
    }

    /// What is known of the volume, once its header was read.
    pub(crate) fn outline(&self) -> Option<&Outline> {
        self.outline.as_ref()
    }

    /// Goes on as far as it can; the end, once.
    pub(crate) fn poll(&mut self) -> Option<Result<Opened, String>> {
        loop {
            let next = match std::mem::replace(&mut self.step, Step::Over) {
                Step::Surveying(local, receiver) => match taken(&receiver) {
                    None => return self.stay(Step::Surveying(local, receiver)),
                    Some(Err(problem)) => return Some(Err(problem)),
                    Some(Ok(outline)) => self.read(local, outline),
                },
                Step::Reading(local, loading) => match loading.poll() {
                    None => return self.stay(Step::Reading(local, loading)),
                    Some(Err(e)) => return Some(Err(e.to_string())),
                    Some(Ok(volume)) => self.start(local, volume),
                },
                Step::Starting(receiver) => match taken(&receiver) {
                    None => return self.stay(Step::Starting(receiver)),
                    Some(Err(problem)) => return Some(Err(problem)),
                    Some(Ok(LocalServer { link, server })) => {
                        self.server = Some(server);
                        self.origin.link = Some(link.clone());
                        match client(&link, &self.clock, &self.wake) {
                            Ok(client) => Step::Connecting(client),
                            Err(problem) => return Some(Err(problem)),
                        }
                    }
                },
                Step::Connecting(client) => match client.state() {
                    State::Connected => return Some(Ok(self.opened(client))),
                    State::Connecting { problem: None, .. } => return self.stay(Step::Connecting(client)),
                    State::Connecting { problem: Some(problem), .. }
                    | State::Reconnecting { problem, .. }
                    | State::Refused(problem) => {
                        later(client);
                        return Some(Err(sentence(&problem)));
                    }
                },
                Step::Over => return None,
            };
            self.step = next;
        }
    }

    fn stay(&mut self, step: Step) -> Option<Result<Opened, String>> {
        self.step = step;
        None
    }

    fn read(&mut self, local: Local, outline: Outline) -> Step {
        self.name.clone_from(&outline.name);
        let wake = self.wake.clone();
        let loading = Loading::start(local.request.clone(), move || wake());
        self.outline = Some(outline);
        Step::Reading(local, loading)
    }

    fn start(&mut self, local: Local, volume: Volume) -> Step {
        let Local { servers, request } = local;
        let outline = self.outline.clone();
        Step::Starting(on_a_thread(&self.wake, move || {
            let outline = outline.ok_or("the header was not read")?;
            servers.start(volume, &outline, &request)
        }))
    }

    fn opened(&mut self, client: Box<Client>) -> Opened {
        let shows = client.talk().link.description().map(|d| d.volume.name.clone()).unwrap_or_default();
        let bytes = self.outline.as_ref().map_or(0, |o| o.bytes_in_memory);
        Opened {
            source: client,
            origin: std::mem::take(&mut self.origin),
            server: self.server.take().map(|server| (server, bytes)),
            place: self.place.clone(),
            shows,
        }
    }
}

impl Drop for Opening {
    fn drop(&mut self) {
        // A server that is being started hands itself to nobody, and ends; one that is there already, or a volume that was read
        // and not taken, would take its time here.
        let step = std::mem::replace(&mut self.step, Step::Over);
        let server = self.server.take();
        if server.is_some() || !matches!(step, Step::Over) {
            later((step, server));
        }
    }
}

/// The header of what is asked for, if there is room for it.
pub(super) fn survey(
    request: &LoadRequest,
    held: u64,
    servers: &dyn LocalServers,
) -> Result<Outline, String> {
    let LoadRequest { source, raw, selection, spacing, max_bytes } = request.clone();
    let options = isinglass_formats::OpenOptions {
        raw,
        selection,
        spacing,
        max_bytes,
        ..isinglass_formats::OpenOptions::default()
    };
    let found = match outline(&source, &options) {
        // Let the check say it, with all that it needs.
        Err(FormatError::TooLarge { .. }) => {
            outline(&source, &isinglass_formats::OpenOptions { max_bytes: u64::MAX, ..options })
        }
        found => found,
    };
    let found = found.map_err(|e| e.to_string())?;
    servers.check(&found, held)?;
    Ok(found)
}

fn client(link: &Link, clock: &Clock, wake: &Waker) -> Result<Box<Client>, String> {
    let options = ClientOptions { clock: clock.clone(), wake: wake.clone(), ..ClientOptions::default() };
    Client::connect(link, options).map(Box::new).map_err(|e| sentence(&e))
}

/// Drops what takes time to end on a thread of its own.
pub(super) fn later<T: Send + 'static>(ended: T) {
    // Without a thread it is dropped here.
    let _ = std::thread::Builder::new().name("goodbye".into()).spawn(move || drop(ended));
}

/// What `work` gives, on a thread of its own, which then wakes the window.
pub(super) fn on_a_thread<T: Send + 'static>(
    wake: &Waker,
    work: impl FnOnce() -> Result<T, String> + Send + 'static,
) -> Receiver<Result<T, String>> {
    let (sender, receiver) = sync_channel(1);
    let wake = wake.clone();
    let run = move || {
        // A defect of ours must not leave anyone waiting.
        let outcome = catch_unwind(AssertUnwindSafe(work));
        // Nobody listens any more if it was cancelled.
        let _ = sender.send(outcome.unwrap_or_else(|_| Err(DEFECT.into())));
        wake();
    };
    // Without a thread the sender is gone, and the outcome a failure.
    let _ = std::thread::Builder::new().name("opening".into()).spawn(run);
    receiver
}

fn taken<T>(receiver: &Receiver<Result<T, String>>) -> Option<Result<T, String>> {
    match receiver.try_recv() {
        Ok(outcome) => Some(outcome),
        Err(TryRecvError::Empty) => None,
        Err(TryRecvError::Disconnected) => Some(Err(DEFECT.into())),
    }
}

const DEFECT: &str = "Opening ended early, by a defect of the program.";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_that_panics_wakes_and_has_failed() {
        let (wake, woken) = sync_channel(1);
        let wake: Waker = Arc::new(move || wake.send(()).unwrap());
        let receiver = on_a_thread::<()>(&wake, || panic!("for the test"));
        woken.recv().unwrap();
        assert_eq!(taken(&receiver), Some(Err(DEFECT.into())));
        let receiver = on_a_thread(&wake, || Ok(7));
        woken.recv().unwrap();
        assert_eq!(taken(&receiver), Some(Ok(7)));
    }
}
