//! From a link or a file to a source of frames, step by step and without waiting. A volume is read and served in this
//! process, and then connected to like a link.

use std::sync::Arc;

use isinglass_core::volume::Volume;
use isinglass_formats::{
    LoadRequest, Loading, Outline, ReadState, RecentPlace, VolumeSource, is_address, state_from_link,
};
use isinglass_net::{Client, ClientOptions, Clock, Link, State, Tunnel};

use super::page::Act;
use crate::app::Origin;
use crate::panels::background::Background;
use crate::panels::text::sentence;
use crate::view::local_servers::{LocalServer, LocalServers, survey};
use crate::view::remote_servers::{RemoteServer, RemoteServers};
use crate::view::{BoxedSource, Waker};

/// Something that is being opened. Dropping it cancels.
pub(crate) struct Opening {
    pub(crate) name: String,
    /// What the person did for it.
    pub(crate) act: Act,
    place: RecentPlace,
    origin: Origin,
    clock: Clock,
    wake: Waker,
    step: OpeningStep,
    outline: Option<Outline>,
    server: Option<Box<dyn Send>>,
}

enum OpeningStep {
    Asking(Background<RemoteServer>),
    Surveying(Local, Background<Outline>),
    Reading(Local, Loading),
    Starting(Background<LocalServer>),
    Connecting(Box<Client>),
    /// The outcome was taken.
    Over,
}

struct Local {
    servers: Arc<dyn LocalServers>,
    request: LoadRequest,
}

pub(crate) struct Opened {
    pub(crate) source: BoxedSource,
    pub(crate) origin: Origin,
    /// The server in this process, and the size of its volume, bytes.
    pub(crate) server: Option<(Box<dyn Send>, u64)>,
    pub(crate) place: RecentPlace,
    pub(crate) shows: String,
}

impl Opening {
    pub(crate) fn connect(act: Act, link: &Link, clock: &Clock, wake: &Waker) -> Result<Self, String> {
        let place = RecentPlace::Server { host: link.host.clone(), port: link.port };
        let state = link.state.as_deref().map(state_from_link).transpose().map_err(|e| sentence(&e))?;
        let client = client(link, None, clock, wake)?;
        let name = link.place();
        let origin =
            Origin { server_name: name.clone(), link: Some(link.clone()), volume_source: None, state };
        Ok(Self {
            name,
            act,
            place,
            origin,
            clock: clock.clone(),
            wake: wake.clone(),
            step: OpeningStep::Connecting(client),
            outline: None,
            server: None,
        })
    }

    /// Starts a server on another machine for the volume that `place` names, and connects to it.
    pub(crate) fn remote(
        act: Act,
        place: String,
        servers: Arc<dyn RemoteServers>,
        clock: &Clock,
        wake: &Waker,
    ) -> Self {
        let named = place.clone();
        Self {
            name: place.clone(),
            act,
            place: RecentPlace::Remote { place },
            origin: Origin::default(),
            clock: clock.clone(),
            wake: wake.clone(),
            step: OpeningStep::Asking(Background::run(wake, move || servers.start(&named))),
            outline: None,
            server: None,
        }
    }

    /// Opens a volume beside one that takes `held` bytes.
    pub(crate) fn local(
        act: Act,
        mut request: LoadRequest,
        held: u64,
        servers: Arc<dyn LocalServers>,
        clock: &Clock,
        wake: &Waker,
    ) -> Self {
        request.foreign_files |= servers.allows_foreign_files();
        let name = std::path::Path::new(&request.source)
            .file_name()
            .map_or_else(|| request.source.clone(), |n| n.to_string_lossy().into_owned());
        // The recent list may be read from another working folder.
        let source = match request.source.starts_with("builtin:") || is_address(&request.source) {
            true => request.source.clone(),
            false => std::path::absolute(&request.source)
                .map_or_else(|_| request.source.clone(), |path| path.to_string_lossy().into_owned()),
        };
        let volume = VolumeSource { source, ..request.clone().into() };
        let place = RecentPlace::Volume(volume.clone());
        let origin =
            Origin { server_name: "this computer".into(), volume_source: Some(volume), ..Origin::default() };
        let (of_thread, servers_of_thread) = (request.clone(), servers.clone());
        let surveying = Background::run(wake, move || survey(&of_thread, held, &*servers_of_thread));
        Self {
            name,
            act,
            place,
            origin,
            clock: clock.clone(),
            wake: wake.clone(),
            step: OpeningStep::Surveying(Local { servers, request }, surveying),
            outline: None,
            server: None,
        }
    }

    /// The same, shown as a state says.
    pub(crate) fn seen_as(mut self, read: ReadState) -> Self {
        self.origin.state = Some(read);
        self
    }

    /// The stage in words, and the share of the voxels that are read while they are.
    pub(crate) fn progress(&self) -> (String, Option<f32>) {
        let text = match &self.step {
            OpeningStep::Asking(_) => "starting a server there by ssh…",
            OpeningStep::Surveying(..) => "reading the header…",
            OpeningStep::Reading(_, loading) => return ("reading".into(), Some(loading.progress())),
            OpeningStep::Starting(_) => "preparing the picture…",
            // The server in this process answers at once.
            OpeningStep::Connecting(_) | OpeningStep::Over if self.server.is_some() => {
                "preparing the picture…"
            }
            OpeningStep::Connecting(_) | OpeningStep::Over => {
                return (format!("connecting to {}…", self.name), None);
            }
        };
        (text.into(), None)
    }

    /// What is known of the volume after its header is read.
    pub(crate) fn outline(&self) -> Option<&Outline> {
        self.outline.as_ref()
    }

    /// Continues as far as possible; returns the outcome, once.
    pub(crate) fn poll(&mut self) -> Option<Result<Opened, String>> {
        loop {
            let next = match std::mem::replace(&mut self.step, OpeningStep::Over) {
                OpeningStep::Asking(mut running) => match running.take() {
                    None => return self.stay(OpeningStep::Asking(running)),
                    Some(Err(problem)) => return Some(Err(sentence(&problem))),
                    Some(Ok(RemoteServer { link, tunnel })) => {
                        self.origin.server_name = link.place();
                        self.origin.link = Some(link.clone());
                        match client(&link, Some(tunnel), &self.clock, &self.wake) {
                            Ok(client) => OpeningStep::Connecting(client),
                            Err(problem) => return Some(Err(problem)),
                        }
                    }
                },
                OpeningStep::Surveying(local, mut running) => match running.take() {
                    None => return self.stay(OpeningStep::Surveying(local, running)),
                    Some(Err(problem)) => return Some(Err(problem)),
                    Some(Ok(outline)) => self.read(local, outline),
                },
                OpeningStep::Reading(local, loading) => match loading.poll() {
                    None => return self.stay(OpeningStep::Reading(local, loading)),
                    Some(Err(e)) => return Some(Err(e.to_string())),
                    Some(Ok(volume)) => self.start(local, volume),
                },
                OpeningStep::Starting(mut running) => match running.take() {
                    None => return self.stay(OpeningStep::Starting(running)),
                    Some(Err(problem)) => return Some(Err(problem)),
                    Some(Ok(LocalServer { link, server })) => {
                        self.server = Some(server);
                        self.origin.link = Some(link.clone());
                        match client(&link, None, &self.clock, &self.wake) {
                            Ok(client) => OpeningStep::Connecting(client),
                            Err(problem) => return Some(Err(problem)),
                        }
                    }
                },
                OpeningStep::Connecting(client) => match client.state() {
                    State::Connected => return Some(Ok(self.opened(client))),
                    State::Connecting { problem: None, .. } => {
                        return self.stay(OpeningStep::Connecting(client));
                    }
                    State::Connecting { problem: Some(problem), .. }
                    | State::Reconnecting { problem, .. }
                    | State::Refused(problem) => {
                        later(client);
                        return Some(Err(sentence(&problem)));
                    }
                },
                OpeningStep::Over => return None,
            };
            self.step = next;
        }
    }

    fn stay(&mut self, step: OpeningStep) -> Option<Result<Opened, String>> {
        self.step = step;
        None
    }

    fn read(&mut self, local: Local, outline: Outline) -> OpeningStep {
        self.name.clone_from(&outline.name);
        let wake = self.wake.clone();
        let loading = Loading::start(local.request.clone(), local.servers.index_folder(), move || wake());
        self.outline = Some(outline);
        OpeningStep::Reading(local, loading)
    }

    fn start(&mut self, local: Local, volume: Volume) -> OpeningStep {
        let Local { servers, request } = local;
        let outline = self.outline.clone();
        OpeningStep::Starting(Background::run(&self.wake, move || {
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
        // A server that is starting ends by itself, as nobody takes it. A running server or a volume takes time to
        // drop.
        let step = std::mem::replace(&mut self.step, OpeningStep::Over);
        let server = self.server.take();
        if server.is_some() || !matches!(step, OpeningStep::Over) {
            later((step, server));
        }
    }
}

fn client(link: &Link, tunnel: Option<Tunnel>, clock: &Clock, wake: &Waker) -> Result<Box<Client>, String> {
    let (clock, wake) = (clock.clone(), wake.clone());
    let options = ClientOptions { clock, wake, tunnel, ..ClientOptions::default() };
    Client::connect(link, options).map(Box::new).map_err(|e| sentence(&e))
}

/// Drops what takes time on a thread of its own.
pub(super) fn later<T: Send + 'static>(ended: T) {
    let _ = std::thread::Builder::new().name("goodbye".into()).spawn(move || drop(ended));
}
