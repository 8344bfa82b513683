//! The window around the viewer: the start page, and whatever opens from it, from the recent list, or by dropping
//! files. The present picture stays until the next one is ready, and no refresh waits.

mod cards;
mod drop_frame;
mod hint_file;
mod opening;
mod page;
mod pictures;
mod recent_list;
mod services;
mod stranger;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use egui::{Align2, RichText};
use isinglass_core::ids::FrameId;
use isinglass_core::session::ClientSession;
use isinglass_formats::{Content, LoadRequest, ReadState, RecentEntry, RecentPlace, content_of, read_state};
use isinglass_net::{Clock, Link, LinkStats, ReceivedFrame, State, Talking};

use self::drop_frame::DropFrame;
use self::hint_file::HintFile;
use self::opening::{Opened, Opening, later};
use self::page::{Act, PageScene, PageWish, StartPage, opening_rows};
use self::pictures::{Keepsake, Pictures};
use self::recent_list::RecentList;
pub use self::services::{First, Services};
use self::stranger::{Stranger, link_of};
use crate::app::{AppWish, Origin, ViewerApp};
use crate::input::bindings::Action;
use crate::panels::background::Background;
use crate::panels::known_files::KnownFile;
use crate::panels::style::{self, name_window, named, pane_at};
use crate::panels::system_dialog::{Picked, SystemDialog, Wanted};
use crate::view::frame_source::FrameSource;
use crate::view::{BoxedSource, Waker};

enum Dropped {
    Volume {
        path: PathBuf,
        /// Whether the files in it are the volume together.
        is_folder: bool,
    },
    State(Box<ReadState>),
    /// A state or colours, for the picture that is shown.
    ForPicture(PathBuf),
}

pub(crate) struct StartWindow {
    app: ViewerApp<BoxedSource>,
    services: Services,
    recent: RecentList,
    pictures: Pictures,
    hints: HintFile,
    /// What is shown, for its picture in the recent list.
    place: Option<RecentPlace>,
    page: StartPage,
    is_page_shown: bool,
    has_session: bool,
    /// The server in this process whose volume is shown, and the size of that volume, bytes.
    server: Option<(Box<dyn Send>, u64)>,
    opening: Option<Opening>,
    /// A state that would call another machine, and waits for the person's answer.
    stranger: Option<Stranger>,
    /// What went wrong, and with what the person did.
    problem: Option<(Act, String)>,
    drop_frame: DropFrame,
    system_dialog: SystemDialog,
    dropped: Background<Dropped>,
    /// How the files came that are looked at.
    dropped_by: Act,
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
        let pictures = Pictures::new(services.recent_file.as_deref());
        let hints = HintFile::new(services.recent_file.as_deref(), ctx);
        let system_dialog = SystemDialog::new(services.has_system_dialog);
        let here = std::env::current_dir().ok().filter(|here| here.parent().is_some());
        let folder = here.or_else(std::env::home_dir).unwrap_or_else(|| PathBuf::from("/"));
        let page = StartPage::new(folder, &wake);
        let mut app = app;
        app.leave_volumes_to_others();
        let mut window = Self {
            app,
            services,
            recent,
            pictures,
            hints,
            place: None,
            page,
            is_page_shown: true,
            has_session: false,
            server: None,
            opening: None,
            stranger: None,
            problem: None,
            drop_frame: DropFrame::default(),
            system_dialog,
            dropped: Background::default(),
            dropped_by: Act::Drop,
            chosen: Background::default(),
            has_folder: false,
            clock,
            wake,
        };
        match first {
            First::StartPage => {}
            First::Connected { source, link, remote } => {
                let shows = source.description().map(|d| d.volume.name.clone()).unwrap_or_default();
                let place = match remote {
                    Some(place) => RecentPlace::Remote { place },
                    None => RecentPlace::Server { host: link.host.clone(), port: link.port },
                };
                let origin = Origin { server_name: link.place(), link: Some(link), ..Origin::default() };
                window.show_opened(Opened { source, origin, server: None, place, shows }, ctx);
            }
            First::Volume(request) => window.open(Act::Open, request),
        }
        window
    }

    pub(crate) fn show(&mut self, ui: &mut egui::Ui) {
        let ctx = ui.ctx().clone();
        style::install(&ctx);
        if self.recent.poll(&ctx) {
            self.take_recent();
        }
        if let Some(hints) = self.hints.take(&ctx) {
            self.app.hints = hints;
        }
        self.hints.follow(&ctx, &self.app.hints);
        self.take_dropped(&ctx);
        self.take_picked(&ctx);
        self.take_chosen();
        self.go_on(&ctx);
        self.forget_pictures();
        self.pictures.go_on(&ctx);
        let held = self.held();
        self.ask(&ctx);
        let wish = if self.is_page_shown {
            self.app.warm_up();
            name_window(&ctx, "isinglass");
            // Of the viewer's keys only these work here.
            let wished = self.app.take_page_actions(&ctx);
            if wished.contains(&Action::Quit) {
                ctx.send_viewport_cmd(egui::ViewportCommand::Close);
            }
            if wished.contains(&Action::OpenFile) && self.opening.is_none() {
                self.choose(Wanted::File, &ctx);
            }
            self.pictures.poll(&ctx, self.recent.entries());
            let scene = PageScene {
                services: &self.services,
                recent: &self.recent,
                pictures: &self.pictures,
                opening: self.opening.as_ref(),
                problem: self.problem.as_ref().map(|(act, problem)| (*act, problem.as_str())),
                has_session: self.has_session,
                has_system_dialog: self.system_dialog.is_wanted(),
                held,
            };
            self.page.show(ui, &scene)
        } else {
            self.app.show(ui);
            if let Some(wish) = self.app.take_wish() {
                match wish {
                    AppWish::StartPage => self.show_page(),
                    AppWish::ChooseFile => self.choose(Wanted::File, &ctx),
                    AppWish::Volume(request) => self.open(Act::Open, request),
                    AppWish::State(read) => self.open_state(Act::Open, Ok(read)),
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
        let dropped = self.problem.as_ref().filter(|(act, _)| *act == Act::Drop);
        if self.drop_frame.show(&ctx, &self.wake, dropped.map(|(_, problem)| problem.as_str())) {
            self.problem = self.problem.take().filter(|(act, _)| *act != Act::Drop);
        }
    }

    /// The list is read, or cannot be.
    fn take_recent(&mut self) {
        if self.recent.problem().is_none() {
            self.pictures.sweep(self.recent.entries());
        }
        if !std::mem::replace(&mut self.has_folder, true)
            && let Some(folder) = self.recent.folder()
        {
            self.page.browser.go_to(folder.to_owned(), None);
        }
    }

    fn fulfil(&mut self, wish: PageWish, ctx: &egui::Context) {
        match wish {
            PageWish::Connect(link) => self.connect(&link, None),
            PageWish::ConnectRemote(act, place) => {
                if let Some(servers) = self.services.remote.clone() {
                    self.opening = Some(Opening::remote(act, place, servers, &self.clock, &self.wake));
                }
            }
            PageWish::ChooseFile => self.choose(Wanted::File, ctx),
            PageWish::ChooseFolder => self.choose(Wanted::Folder, ctx),
            PageWish::Open(request) => self.open(Act::Open, request),
            PageWish::OpenRecent(request) => self.open(Act::Recent, request),
            PageWish::OpenSample(sample) => {
                let max_bytes = self.services.servers.max_bytes();
                let source = format!("builtin:{}", sample.name());
                self.open(Act::Sample, LoadRequest { max_bytes, ..LoadRequest::new(source) });
            }
            PageWish::OpenState(path) => {
                self.chosen = Background::run(&self.wake, move || state_in(&path));
            }
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
        match Opening::connect(Act::Connect, link, &self.clock, &self.wake) {
            Ok(opening) => {
                self.opening = Some(state.into_iter().fold(opening, Opening::seen_as));
            }
            Err(problem) => self.problem = Some((Act::Connect, problem)),
        }
    }

    fn open(&mut self, act: Act, request: LoadRequest) {
        let held = self.held();
        let servers = self.services.servers.clone();
        self.problem = None;
        self.opening = Some(Opening::local(act, request, held, servers, &self.clock, &self.wake));
    }

    /// Asks for it by the system's dialog, or by our own where there is none.
    fn choose(&mut self, wanted: Wanted, ctx: &egui::Context) {
        if !self.system_dialog.open(wanted, &self.wake, self.page.browser.folder()) {
            self.browse(ctx);
        }
    }

    fn browse(&mut self, ctx: &egui::Context) {
        match self.is_page_shown {
            true => self.page.browse(),
            false => self.app.open_file_dialog(ctx),
        }
        ctx.request_repaint();
    }

    fn take_picked(&mut self, ctx: &egui::Context) {
        match self.system_dialog.take() {
            Some(Picked::Path(path)) => {
                if let Some(folder) = path.parent() {
                    self.has_folder = true;
                    self.page.browser.go_to(folder.to_owned(), None);
                }
                self.look_at(Act::Open, vec![path]);
            }
            Some(Picked::NoDialog) => self.browse(ctx),
            Some(Picked::Nothing) | None => {}
        }
    }

    /// Begins to open a state's volume, to show it as the state says. If that calls another machine, the person is asked
    /// first.
    fn open_state(&mut self, act: Act, read: Result<Box<ReadState>, String>) {
        (self.problem, self.stranger) = (None, None);
        match read.and_then(|read| Ok((Stranger::of(act, &read)?, read))) {
            Ok((Some(stranger), _)) => self.stranger = Some(stranger),
            Ok((None, read)) => self.open_state_at_once(act, read),
            Err(problem) => self.problem = Some((act, problem)),
        }
    }

    /// Asks whether the state that waits may call another machine.
    fn ask(&mut self, ctx: &egui::Context) {
        let Some(answer) = self.stranger.as_ref().and_then(|stranger| stranger.show(ctx)) else { return };
        if let Some(stranger) = self.stranger.take().filter(|_| answer) {
            self.open_state_at_once(stranger.act, stranger.read);
        }
        ctx.request_repaint();
    }

    fn open_state_at_once(&mut self, act: Act, read: Box<ReadState>) {
        let opening = Ok(read).and_then(|read: Box<ReadState>| {
            let volume = read.state.volume.clone().unwrap_or_default();
            let source = volume.volume_source().map_err(|e| format!("The state's region: {e}"))?;
            let opening = match (link_of(&volume)?, source) {
                (Some(link), _) => Opening::connect(act, &link, &self.clock, &self.wake)?,
                (None, Some(source)) => {
                    let held = self.held();
                    let servers = self.services.servers.clone();
                    let request = source.request(servers.max_bytes());
                    Opening::local(act, request, held, servers, &self.clock, &self.wake)
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
            Err(problem) => self.problem = Some((act, problem)),
        }
    }

    fn take_chosen(&mut self) {
        if let Some(read) = self.chosen.take() {
            self.open_state(Act::Open, read);
        }
    }

    fn go_on(&mut self, ctx: &egui::Context) {
        let Some(opening) = &mut self.opening else { return };
        let act = opening.act;
        if let Some(ended) = opening.poll() {
            self.opening = None;
            match ended {
                Ok(opened) => self.show_opened(opened, ctx),
                Err(problem) => {
                    tracing::warn!("{problem}");
                    self.problem = Some((act, problem));
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
        self.keep_picture();
        self.place = Some(place.clone());
        let is_volume = matches!(place, RecentPlace::Volume(_));
        let folder = (is_volume && self.has_folder).then(|| self.page.browser.folder().to_owned());
        self.recent.note(RecentEntry { place, shows, used_at: (self.services.calendar)() }, folder, ctx);
        later((self.app.turn_to(source, origin), std::mem::replace(&mut self.server, server)));
        let held = self.held();
        self.app.offer_volumes(self.services.servers.clone(), held, self.page.browser.folder());
        (self.has_session, self.is_page_shown, self.problem) = (true, false, None);
    }

    fn close(&mut self) {
        self.keep_picture();
        self.place = None;
        later((self.app.turn_to(Box::<Nothing>::default(), Origin::default()), self.server.take()));
        (self.has_session, self.is_page_shown) = (false, true);
    }

    fn show_page(&mut self) {
        self.is_page_shown = true;
        self.keep_picture();
        self.page.focus();
    }

    fn keepsake(&self) -> Option<Keepsake> {
        let frame = self.app.source().latest_frame()?;
        Some(Keepsake { frame, background: self.app.background(), place: self.place.clone()? })
    }

    /// Keeps a picture of what is shown, for its card.
    fn keep_picture(&mut self) {
        if let Some(keepsake) = self.keepsake() {
            self.pictures.keep(keepsake, self.recent.entries());
        }
    }

    /// Deletes the pictures of what the list has dropped.
    fn forget_pictures(&mut self) {
        for place in self.recent.take_dropped() {
            self.pictures.forget(&place, self.recent.entries());
        }
    }

    /// Keeps what is not on the disk yet. The window has closed, so it may wait.
    fn finish(&mut self) {
        self.app.finish_choices();
        self.hints.finish(&self.app.hints);
        self.recent.finish();
        self.forget_pictures();
        self.keep_picture();
        self.pictures.finish();
    }

    fn take_dropped(&mut self, ctx: &egui::Context) {
        let files = ctx.input_mut(|i| std::mem::take(&mut i.raw.dropped_files));
        if !files.is_empty() {
            self.look_at(Act::Drop, files.iter().map(|file| file.path().to_owned()).collect());
        }
        let act = self.dropped_by;
        match self.dropped.take() {
            // What was chosen by the system's dialog has its size and parts told before it is read, as in our list.
            Some(Ok(Dropped::Volume { path, is_folder })) if act == Act::Open => {
                match self.is_page_shown {
                    true => self.page.browse_at(path, is_folder),
                    false => self.app.open_file_dialog_at(ctx, path, is_folder),
                }
                ctx.request_repaint();
            }
            Some(Ok(Dropped::Volume { path, .. })) => {
                let source = path.to_string_lossy().into_owned();
                let max_bytes = self.services.servers.max_bytes();
                self.open(act, LoadRequest { max_bytes, ..LoadRequest::new(source) });
            }
            Some(Ok(Dropped::State(read))) => self.open_state(act, Ok(read)),
            Some(Ok(Dropped::ForPicture(path))) => self.app.open_any(path, ctx),
            Some(Err(problem)) => self.problem = Some((act, problem)),
            None => {}
        }
    }

    /// Files are distinguished by their content. Volumes open here. States open here with their volumes while the page
    /// is shown. The viewer gets states and colours otherwise.
    fn look_at(&mut self, act: Act, paths: Vec<PathBuf>) {
        (self.dropped_by, self.problem) = (act, None);
        let is_page_shown = self.is_page_shown;
        self.dropped = Background::run(&self.wake, move || {
            let mut known: Vec<_> = paths.into_iter().map(|path| (KnownFile::at(&path), path)).collect();
            // Volumes before states, before colours, before what does not open.
            known.sort_by_key(|(kind, _)| match kind {
                KnownFile::Volume => 0,
                KnownFile::State => 1,
                KnownFile::Transfer => 2,
                KnownFile::Unknown(_) => 3,
            });
            let (kind, path) = known.into_iter().next().ok_or("no file")?;
            match kind {
                KnownFile::Volume => {
                    let is_folder = matches!(content_of(&path), Ok(Content::Folder));
                    Ok(Dropped::Volume { path, is_folder })
                }
                KnownFile::State if is_page_shown => state_in(&path).map(Dropped::State),
                KnownFile::Transfer if is_page_shown => {
                    let name = path.display();
                    Err(format!("{name}: colours and opacities are for a volume. Open one first."))
                }
                KnownFile::State | KnownFile::Transfer => Ok(Dropped::ForPicture(path)),
                KnownFile::Unknown(problem) => Err(problem),
            }
        });
    }

    /// Shows the progress of an opening.
    fn show_around(&mut self, ctx: &egui::Context) -> Option<PageWish> {
        let problem = self.problem.as_ref().filter(|(act, _)| *act != Act::Drop).map(|(_, problem)| problem);
        if self.opening.is_none() && problem.is_none() {
            return None;
        }
        let (mut wish, mut is_read) = (None, false);
        let room = self.app.room_at_bottom();
        pane_at(ctx, "opening", room, (Align2::CENTER_BOTTOM, [0.0, -12.0]), |ui| {
            ui.set_max_width((room.width() - 40.0).clamp(180.0, 420.0));
            if let Some(opening) = &self.opening {
                ui.add(egui::Label::new(RichText::new(&opening.name).strong()).truncate());
                wish = opening_rows(ui, opening, false);
            } else if let Some(problem) = problem {
                style::problem(ui, problem);
                let ok = ui.small_button("OK");
                named(&ok, egui::Role::Button, "OK");
                is_read = ok.clicked();
            }
        });
        if is_read {
            self.problem = None;
        }
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

    fn on_exit(&mut self) {
        self.finish();
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
