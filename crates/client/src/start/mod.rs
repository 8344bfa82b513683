//! The window around the viewer: the start page, and whatever opens from it, from the recent list, or by dropping
//! files. The present picture stays until the next one is ready, and no refresh waits.

mod opening;
mod page;
mod recent_list;
mod services;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use egui::{Align2, RichText};
use isinglass_core::ids::FrameId;
use isinglass_core::session::ClientSession;
use isinglass_formats::{Content, LoadRequest, ReadState, RecentEntry, RecentPlace, content_of, read_state};
use isinglass_net::{Clock, Link, LinkStats, ReceivedFrame, State, Talking};

use self::opening::{Opened, Opening, later};
use self::page::{PageScene, PageWish, StartPage, is_volume, opening_rows};
use self::recent_list::RecentList;
pub use self::services::{First, Services};
use crate::app::{AppWish, Origin, ViewerApp};
use crate::panels::background::Background;
use crate::panels::style::{self, name_window, named, pane_at};
use crate::view::frame_source::FrameSource;
use crate::view::{BoxedSource, Waker};

enum Dropped {
    Volume(PathBuf),
    State(Box<ReadState>),
    Others(Vec<egui::DroppedFileHandle>),
}

pub(crate) struct StartWindow {
    app: ViewerApp<BoxedSource>,
    services: Services,
    recent: RecentList,
    page: StartPage,
    is_page_shown: bool,
    has_session: bool,
    /// The server in this process whose volume is shown, and the size of that volume, bytes.
    server: Option<(Box<dyn Send>, u64)>,
    opening: Option<Opening>,
    problem: Option<String>,
    dropped: Background<Dropped>,
    chosen: Background<Box<ReadState>>,
    /// Whether the list shows the folder of the recent list, or one that the person chose.
    has_folder: bool,
    clock: Clock,
    wake: Waker,
}

impl StartWindow {
    /// Around `app`, which shows nothing yet.
    pub(crate) fn new(
        app: ViewerApp<BoxedSource>,
        services: Services,
        first: First,
        ctx: &egui::Context,
        clock: Clock,
        wake: Waker,
    ) -> Self {
        let recent = RecentList::new(services.recent_file.clone(), ctx);
        let here = std::env::current_dir().ok().filter(|here| here.parent().is_some());
        let folder = here.or_else(std::env::home_dir).unwrap_or_else(|| PathBuf::from("/"));
        let page = StartPage::new(folder, &wake);
        let mut app = app;
        app.leave_volumes_to_others();
        let mut window = Self {
            app,
            services,
            recent,
            page,
            is_page_shown: true,
            has_session: false,
            server: None,
            opening: None,
            problem: None,
            dropped: Background::default(),
            chosen: Background::default(),
            has_folder: false,
            clock,
            wake,
        };
        match first {
            First::StartPage => {}
            First::Connected { source, link } => {
                let shows = source.description().map(|d| d.volume.name.clone()).unwrap_or_default();
                let place = RecentPlace::Server { host: link.host.clone(), port: link.port };
                let origin = Origin { server_name: link.place(), link: Some(link), ..Origin::default() };
                window.show_opened(Opened { source, origin, server: None, place, shows }, ctx);
            }
            First::Volume(request) => window.open(request),
        }
        window
    }

    pub(crate) fn show(&mut self, ui: &mut egui::Ui) {
        let ctx = ui.ctx().clone();
        if self.recent.poll(&ctx) && !self.has_folder {
            self.has_folder = true;
            if let Some(folder) = self.recent.folder() {
                self.page.browser.go_to(folder.to_owned(), None);
            }
        }
        self.take_dropped(&ctx);
        self.take_chosen();
        self.go_on(&ctx);
        let held = self.held();
        let wish = if self.is_page_shown {
            self.app.warm_up();
            name_window(&ctx, "isinglass");
            // Of the viewer's keys only this one works here.
            if self.app.take_quit(&ctx) {
                ctx.send_viewport_cmd(egui::ViewportCommand::Close);
            }
            let scene = PageScene {
                services: &self.services,
                recent: &self.recent,
                opening: self.opening.as_ref(),
                problem: self.problem.as_deref(),
                has_session: self.has_session,
                held,
            };
            self.page.show(ui, &scene)
        } else {
            self.app.show(ui);
            if let Some(wish) = self.app.take_wish() {
                match wish {
                    AppWish::StartPage => self.show_page(),
                    AppWish::Volume(request) => self.open(request),
                    AppWish::State(read) => self.open_state(Ok(read)),
                    AppWish::Server(server) => self.connect(&server.0, server.1),
                }
                ctx.request_repaint();
            }
            self.show_around(&ctx)
        };
        if let Some(wish) = wish {
            self.has_folder = true;
            self.problem = None;
            self.fulfil(wish, &ctx);
            ctx.request_repaint();
        }
    }

    fn fulfil(&mut self, wish: PageWish, ctx: &egui::Context) {
        match wish {
            PageWish::Connect(link) => self.connect(&link, None),
            PageWish::Open(request) => self.open(request),
            PageWish::OpenState(path) => self.chosen = Background::run(&self.wake, move || state_in(&path)),
            PageWish::Cancel => self.opening = None,
            PageWish::Back => self.is_page_shown = false,
            PageWish::Close => self.close(),
            PageWish::Forget(number) => self.recent.forget(number, ctx),
        }
    }

    /// Begins to connect, to show the volume as the link's own state says, or else `state`.
    fn connect(&mut self, link: &Link, state: Option<ReadState>) {
        self.problem = None;
        let state = state.filter(|_| link.state.is_none());
        match Opening::connect(link, &self.clock, &self.wake) {
            Ok(opening) => {
                self.opening = Some(state.into_iter().fold(opening, Opening::seen_as));
            }
            Err(problem) => self.problem = Some(problem),
        }
    }

    fn open(&mut self, request: LoadRequest) {
        let held = self.held();
        let servers = self.services.servers.clone();
        self.problem = None;
        self.opening = Some(Opening::local(request, held, servers, &self.clock, &self.wake));
    }

    /// Begins to open a state's volume, to show it as the state says.
    fn open_state(&mut self, read: Result<Box<ReadState>, String>) {
        self.problem = None;
        let opening = read.and_then(|read| {
            let volume = read.state.volume.clone().unwrap_or_default();
            let source = volume.volume_source().map_err(|e| format!("The state's region: {e}"))?;
            let opening = match (volume.link(), source) {
                (Some(link), _) => {
                    let link = link.parse().map_err(|e| format!("The link of the state's volume: {e}"))?;
                    Opening::connect(&link, &self.clock, &self.wake)?
                }
                (None, Some(source)) => {
                    let held = self.held();
                    let servers = self.services.servers.clone();
                    let request = source.request(servers.max_bytes());
                    Opening::local(request, held, servers, &self.clock, &self.wake)
                }
                (None, None) => {
                    let place = match &volume.server {
                        Some(server) => format!("was shown by the server {server}: connect to that"),
                        None => "may lie anywhere: open it".into(),
                    };
                    let name = &volume.name;
                    return Err(format!(
                        "The state's volume, {name:?}, {place}, then drop the state on the picture."
                    ));
                }
            };
            Ok(opening.seen_as(*read))
        });
        match opening {
            Ok(opening) => self.opening = Some(opening),
            Err(problem) => self.problem = Some(problem),
        }
    }

    fn take_chosen(&mut self) {
        if let Some(read) = self.chosen.take() {
            self.open_state(read);
        }
    }

    fn go_on(&mut self, ctx: &egui::Context) {
        let Some(opening) = &mut self.opening else { return };
        if let Some(ended) = opening.poll() {
            self.opening = None;
            match ended {
                Ok(opened) => self.show_opened(opened, ctx),
                Err(problem) => {
                    tracing::warn!("{problem}");
                    self.problem = Some(problem);
                }
            }
        } else {
            // Progress is polled.
            ctx.request_repaint_after(PROGRESS_PERIOD);
        }
    }

    /// Size of the volume that a server of this window holds, bytes.
    fn held(&self) -> u64 {
        let Some((_, bytes)) = self.server else { return 0 };
        self.app.source().talk().selection.choices().map_or(bytes, |parts| parts.bytes_in_memory)
    }

    fn show_opened(&mut self, opened: Opened, ctx: &egui::Context) {
        let Opened { source, origin, server, place, shows } = opened;
        let is_volume = matches!(place, RecentPlace::Volume(_));
        let folder = (is_volume && self.has_folder).then(|| self.page.browser.folder().to_owned());
        self.recent.note(RecentEntry { place, shows, used_at: (self.services.calendar)() }, folder, ctx);
        later((self.app.turn_to(source, origin), std::mem::replace(&mut self.server, server)));
        let held = self.held();
        self.app.offer_volumes(self.services.servers.clone(), held, self.page.browser.folder());
        (self.has_session, self.is_page_shown, self.problem) = (true, false, None);
    }

    fn close(&mut self) {
        later((self.app.turn_to(Box::<Nothing>::default(), Origin::default()), self.server.take()));
        (self.has_session, self.is_page_shown) = (false, true);
    }

    fn show_page(&mut self) {
        self.is_page_shown = true;
        self.page.focus();
    }

    /// Dropped files are distinguished by their content. Volumes open here. States open here with their volumes while
    /// the page is shown. The viewer gets everything else: it knows presets and states.
    fn take_dropped(&mut self, ctx: &egui::Context) {
        let files = ctx.input_mut(|i| std::mem::take(&mut i.raw.dropped_files));
        if !files.is_empty() {
            let takes_states = self.is_page_shown;
            self.dropped = Background::run(&self.wake, move || {
                let content = |path: &Path| content_of(path).ok();
                let paths: Vec<_> = files.iter().map(|file| file.path().to_owned()).collect();
                if let Some(volume) = paths.iter().find(|path| content(path).is_some_and(is_volume)) {
                    return Ok(Dropped::Volume(volume.clone()));
                }
                let is_state = |path: &&PathBuf| takes_states && content(path) == Some(Content::State);
                match paths.iter().find(is_state) {
                    Some(path) => state_in(path).map(Dropped::State),
                    None => Ok(Dropped::Others(files)),
                }
            });
        }
        match self.dropped.take() {
            Some(Ok(Dropped::Volume(volume))) => {
                let source = volume.to_string_lossy().into_owned();
                let max_bytes = self.services.servers.max_bytes();
                self.open(LoadRequest { max_bytes, ..LoadRequest::new(source) });
            }
            Some(Ok(Dropped::State(read))) => self.open_state(Ok(read)),
            Some(Ok(Dropped::Others(files))) if self.is_page_shown => {
                let name = files.first().map(|f| f.path().display().to_string()).unwrap_or_default();
                self.problem = Some(format!("{name}: found no volume or state that opens here."));
            }
            Some(Ok(Dropped::Others(files))) => ctx.input_mut(|i| i.raw.dropped_files = files),
            Some(Err(problem)) => self.problem = Some(problem),
            None => {}
        }
    }

    /// Shows the progress of an opening.
    fn show_around(&mut self, ctx: &egui::Context) -> Option<PageWish> {
        if self.opening.is_none() && self.problem.is_none() {
            return None;
        }
        let mut wish = None;
        let room = self.app.room_at_bottom();
        pane_at(ctx, "opening", room, (Align2::CENTER_BOTTOM, [0.0, -12.0]), |ui| {
            ui.set_max_width((room.width() - 40.0).clamp(180.0, 420.0));
            if let Some(opening) = &self.opening {
                ui.add(egui::Label::new(RichText::new(&opening.name).strong()).truncate());
                wish = opening_rows(ui, opening, false);
            } else if let Some(problem) = &self.problem {
                style::problem(ui, problem);
                let ok = ui.small_button("OK");
                named(&ok, egui::Role::Button, "OK");
                if ok.clicked() {
                    self.problem = None;
                }
            }
        });
        wish
    }
}

/// Reads the state in a file. May wait for a disk.
fn state_in(path: &Path) -> Result<Box<ReadState>, String> {
    read_state(path).map(Box::new).map_err(|e| e.to_string())
}

impl eframe::App for StartWindow {
    fn ui(&mut self, ui: &mut egui::Ui, _frame: &mut eframe::Frame) {
        self.show(ui);
    }
}

/// The source before anything is opened.
#[derive(Default)]
pub(crate) struct Nothing(Mutex<ClientSession>);

impl FrameSource for Nothing {
    fn talk(&self) -> Talking<'_, ClientSession> {
        Talking::alone(&self.0)
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        None
    }

    fn note_shown(&mut self, _frame: FrameId) {}

    fn state(&self) -> State {
        State::Connecting { attempt: 1, problem: None }
    }

    fn stats(&self) -> LinkStats {
        LinkStats::default()
    }
}

/// Period of refreshes while something is being opened.
const PROGRESS_PERIOD: std::time::Duration = std::time::Duration::from_millis(60);
