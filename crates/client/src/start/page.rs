//! The start page: three choices, and what was opened lately.

use std::path::PathBuf;

use egui::{Key, Modifiers, RichText, ScrollArea, Sense, Ui, vec2};
use isinglass_core::volume::procedural::Builtin;
use isinglass_formats::{LoadRequest, RecentPlace};
use isinglass_net::Link;
use lucide_icons::Icon;

use super::cards::{CardWish, choice, drop_zone, recent_card, sample_card};
use super::opening::Opening;
use super::pictures::Pictures;
use super::recent_list::RecentList;
use super::services::Services;
use crate::app::open_dialog::file_window;
use crate::panels::browser::{Browser, Chosen};
use crate::panels::style::{self, bright, emblem, named, quiet, title};
use crate::panels::text::{format_bytes, sentence};
use crate::view::Waker;

pub(crate) enum PageWish {
    Connect(Box<Link>),
    /// Start a server for a volume on another machine.
    ConnectRemote(Act, String),
    Open(LoadRequest),
    OpenState(PathBuf),
    /// Open a file that the person has yet to choose.
    ChooseFile,
    ChooseFolder,
    OpenSample(Builtin),
    OpenRecent(LoadRequest),
    Cancel,
    Back,
    Close,
    Forget(usize),
}

/// What the person did. What goes wrong with it is said where it was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Act {
    Open,
    Connect,
    Sample,
    Recent,
    Drop,
}

pub(crate) struct PageScene<'a> {
    pub(crate) services: &'a Services,
    pub(crate) recent: &'a RecentList,
    pub(crate) pictures: &'a Pictures,
    pub(crate) opening: Option<&'a Opening>,
    pub(crate) problem: Option<(Act, &'a str)>,
    /// Whether a picture is shown behind the page.
    pub(crate) has_session: bool,
    /// Whether files are chosen by the system's dialog, which opens either files or folders.
    pub(crate) has_system_dialog: bool,
    /// Size of the volume that is shown in this process, bytes.
    pub(crate) held: u64,
}

pub(crate) struct StartPage {
    link_text: String,
    link_problem: Option<String>,
    /// A hint about a server in the recent list.
    hint: Option<String>,
    wants_link_focus: bool,
    is_browsing: bool,
    pub(crate) browser: Browser,
}

impl StartPage {
    pub(crate) fn new(folder: PathBuf, wake: &Waker) -> Self {
        Self {
            link_text: String::new(),
            link_problem: None,
            hint: None,
            wants_link_focus: true,
            is_browsing: false,
            browser: Browser::new(folder, wake),
        }
    }

    pub(crate) fn focus(&mut self) {
        self.wants_link_focus = true;
    }

    /// Opens the list of files.
    pub(crate) fn browse(&mut self) {
        self.is_browsing = true;
        self.browser.focus();
    }

    /// Opens it at a volume.
    pub(crate) fn browse_at(&mut self, volume: PathBuf, is_folder: bool) {
        self.is_browsing = true;
        self.browser.select_volume(volume, is_folder);
    }

    pub(crate) fn show(&mut self, ui: &mut Ui, scene: &PageScene<'_>) -> Option<PageWish> {
        let rect = ui.max_rect();
        ui.painter().rect_filled(rect, 0.0, ui.visuals().panel_fill);
        let mut wish = None;
        if let Some(opening) = scene.opening {
            // The page beneath is inactive, but the window stays awake.
            self.is_browsing = false;
            return loading_page(ui, opening, scene.has_session);
        }
        let ctx = ui.ctx().clone();
        let volumes = (&scene.services.servers, scene.held);
        match file_window(&ctx, &mut self.is_browsing, &mut self.browser, Some(volumes)) {
            Some(Chosen::Volume(request)) => return Some(PageWish::Open(request)),
            // Of texts, the page accepts states.
            Some(Chosen::Text(path)) => return Some(PageWish::OpenState(path)),
            None => {}
        }
        if scene.has_session && ui.input_mut(|i| i.consume_key(Modifiers::NONE, Key::Escape)) {
            return Some(PageWish::Back);
        }
        let margin = if rect.width() >= 820.0 { 32.0 } else { 16.0 };
        let width = (rect.width() - 2.0 * margin).min(1120.0);
        let inner = egui::Rect::from_center_size(rect.center(), vec2(width, rect.height() - 32.0));
        let ui = &mut ui.new_child(egui::UiBuilder::new().max_rect(inner));
        header(ui, scene, &mut wish);
        ui.add_space(16.0);
        ScrollArea::vertical().auto_shrink(false).show(ui, |ui| {
            self.choices(ui, scene, &mut wish);
            ui.add_space(24.0);
            self.recent(ui, scene, &mut wish);
        });
        wish
    }

    /// Side by side, or below each other where there is no room.
    fn choices(&mut self, ui: &mut Ui, scene: &PageScene<'_>, wish: &mut Option<PageWish>) {
        let width = ui.available_width();
        let is_wide = width >= LEAST_WIDTH_OF_ROW;
        let (height, side) = match is_wide {
            true => (CHOICE_HEIGHT, (width - 2.0 * GAP) / 3.0),
            false => (0.0, width),
        };
        let layout = match is_wide {
            true => egui::Layout::left_to_right(egui::Align::Min),
            false => egui::Layout::top_down(egui::Align::Min),
        };
        ui.with_layout(layout, |ui| {
            ui.spacing_mut().item_spacing = vec2(GAP, GAP);
            for number in 0..3 {
                ui.allocate_ui(vec2(side, height), |ui| {
                    ui.set_width(side);
                    ui.spacing_mut().item_spacing = vec2(8.0, 4.0);
                    match number {
                        0 => open_choice(ui, scene, height, wish),
                        1 => self.connect_choice(ui, scene, height, wish),
                        _ => sample_choice(ui, scene, height, wish),
                    }
                });
            }
        });
    }

    fn connect_choice(
        &mut self,
        ui: &mut Ui,
        scene: &PageScene<'_>,
        height: f32,
        wish: &mut Option<PageWish>,
    ) {
        choice(ui, (Icon::Cable, "Connect to a server"), height, |ui| {
            let has_link = !self.link_text.trim().is_empty();
            ui.horizontal(|ui| {
                let width = (ui.available_width() - 84.0).max(60.0);
                let field = egui::TextEdit::singleline(&mut self.link_text).desired_width(width);
                let field = ui.add(field.hint_text("a link, or host:/path"));
                named(&field, egui::Role::TextInput, "link");
                if std::mem::take(&mut self.wants_link_focus) {
                    field.request_focus();
                }
                if field.changed() {
                    self.link_problem = None;
                }
                let enters = field.lost_focus() && ui.input(|i| i.key_pressed(Key::Enter));
                let is_clicked = ui.add_enabled(has_link, egui::Button::new("Connect")).clicked();
                if (enters && has_link) || is_clicked {
                    let text = self.link_text.trim();
                    match link_in(text) {
                        _ if names_remote(scene.services, text) => {
                            *wish = Some(PageWish::ConnectRemote(Act::Connect, text.to_owned()));
                        }
                        Ok(link) => *wish = Some(PageWish::Connect(Box::new(link))),
                        Err(problem) => {
                            self.link_problem = Some(problem);
                            self.wants_link_focus = true;
                        }
                    }
                }
            });
            let problem = self.link_problem.as_deref().or(problem_of(scene, Act::Connect));
            match (problem, &self.hint) {
                (Some(problem), _) => style::problem(ui, problem),
                (None, Some(hint)) => small(ui, hint),
                (None, None) => {
                    small(
                        ui,
                        "A link that 'isinglass serve' printed, or host:/path for a file that ssh reaches.",
                    );
                }
            }
        });
    }

    fn recent(&mut self, ui: &mut Ui, scene: &PageScene<'_>, wish: &mut Option<PageWish>) {
        ui.label(title("Recent"));
        ui.add_space(8.0);
        for problem in [scene.recent.problem(), problem_of(scene, Act::Recent)].into_iter().flatten() {
            style::problem(ui, problem);
        }
        let entries = scene.recent.entries();
        if entries.is_empty() {
            small(ui, "What you open is here the next time, with its last picture.");
        }
        let now = (scene.services.calendar)();
        let width = ui.available_width();
        let per_row = ((width + GAP) / (LEAST_WIDTH_OF_CARD + GAP)).floor().max(1.0);
        let card_width = ((width + GAP) / per_row - GAP).floor();
        for (row, of_row) in entries.chunks(per_row as usize).enumerate() {
            ui.horizontal_top(|ui| {
                ui.spacing_mut().item_spacing.x = GAP;
                for (column, entry) in of_row.iter().enumerate() {
                    let picture = scene.pictures.of(&entry.place);
                    match recent_card(ui, entry, picture, now, card_width) {
                        Some(CardWish::Open) => self.choose(ui, &entry.place, scene, wish),
                        Some(CardWish::Forget) => {
                            *wish = Some(PageWish::Forget(row * per_row as usize + column));
                        }
                        None => {}
                    }
                }
            });
            ui.add_space(GAP - 4.0);
        }
    }

    fn choose(&mut self, ui: &Ui, place: &RecentPlace, scene: &PageScene<'_>, wish: &mut Option<PageWish>) {
        match place {
            RecentPlace::Volume(volume) => {
                let max_bytes = scene.services.servers.max_bytes();
                *wish = Some(PageWish::OpenRecent(volume.clone().request(max_bytes)));
            }
            RecentPlace::Remote { place } if names_remote(scene.services, place) => {
                *wish = Some(PageWish::ConnectRemote(Act::Recent, place.clone()));
            }
            RecentPlace::Remote { .. } => {}
            RecentPlace::Server { host, port } => {
                // A link works once and is not stored: there is nothing to connect with.
                self.hint = Some(format!(
                    "Links let in once and are not stored: paste the new one that 'isinglass serve' printed on {host} (port {port})."
                ));
                self.link_problem = None;
                self.link_text.clear();
                self.wants_link_focus = true;
                ui.ctx().request_repaint();
            }
        }
    }
}

fn header(ui: &mut Ui, scene: &PageScene<'_>, wish: &mut Option<PageWish>) {
    ui.horizontal(|ui| {
        let (emblem_rect, _) = ui.allocate_exact_size(vec2(44.0, 36.0), Sense::hover());
        emblem(ui.painter(), emblem_rect.center(), 0.5, ui.visuals().dark_mode);
        ui.label(RichText::new("isinglass").size(26.0).color(bright(ui.ctx())));
        if scene.has_session {
            ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                if ui.button("Back to the picture").on_hover_text("Esc").clicked() {
                    *wish = Some(PageWish::Back);
                }
                if ui.button("Close it").on_hover_text("Closes the volume and frees its memory").clicked() {
                    *wish = Some(PageWish::Close);
                }
            });
        }
    });
}

fn open_choice(ui: &mut Ui, scene: &PageScene<'_>, height: f32, wish: &mut Option<PageWish>) {
    choice(ui, (Icon::FolderOpen, "Open a file"), height, |ui| {
        ui.horizontal_wrapped(|ui| {
            if ui.button("Choose a file…").on_hover_text("Ctrl+O").clicked() {
                *wish = Some(PageWish::ChooseFile);
            }
            if scene.has_system_dialog && ui.button("Choose a folder…").clicked() {
                *wish = Some(PageWish::ChooseFolder);
            }
        });
        match problem_of(scene, Act::Open) {
            Some(problem) => style::problem(ui, problem),
            None if ui.available_width() < LEAST_WIDTH_OF_ZONE => {
                small(ui, "A volume, a folder of slices or a saved view. Or drop it on this window.");
            }
            None => {
                small(ui, "A volume, a folder of slices or a saved view.");
                drop_zone(ui, "or drop it on this window");
            }
        }
    });
}

fn sample_choice(ui: &mut Ui, scene: &PageScene<'_>, height: f32, wish: &mut Option<PageWish>) {
    choice(ui, (Icon::Shapes, "Try a sample"), height, |ui| {
        ui.horizontal(|ui| {
            let width = ((ui.available_width() - 16.0) / 3.0).min(MOST_WIDTH_OF_SAMPLE).floor();
            for (sample, name, png) in SAMPLES {
                if sample_card(ui, name, png, width) {
                    *wish = Some(PageWish::OpenSample(sample));
                }
            }
        });
        if let Some(problem) = problem_of(scene, Act::Sample) {
            style::problem(ui, problem);
        }
    });
}

fn problem_of<'a>(scene: &PageScene<'a>, act: Act) -> Option<&'a str> {
    scene.problem.filter(|(of, _)| *of == act).map(|(_, problem)| problem)
}

fn small(ui: &mut Ui, text: &str) {
    let text = RichText::new(text).size(12.0).color(quiet(ui.ctx()));
    ui.add(egui::Label::new(text).wrap());
}

/// The page while something is being opened: name, progress, and a way out.
fn loading_page(ui: &mut Ui, opening: &Opening, has_session: bool) -> Option<PageWish> {
    let center = ui.max_rect().center();
    let card = egui::Rect::from_center_size(center, vec2(ui.max_rect().width().min(460.0) - 20.0, 210.0));
    let mut ui = ui.new_child(egui::UiBuilder::new().max_rect(card));
    let (emblem_rect, _) = ui.allocate_exact_size(vec2(44.0, 36.0), Sense::hover());
    emblem(ui.painter(), emblem_rect.center(), 0.5, ui.visuals().dark_mode);
    ui.add_space(6.0);
    ui.add(egui::Label::new(title(&opening.name)).truncate());
    let wish = opening_rows(&mut ui, opening, true);
    if has_session && ui.button("Back to the picture meanwhile").clicked() {
        return Some(PageWish::Back);
    }
    wish
}

/// The progress of an opening, and a button that cancels it. Escape cancels, too, if it has no other meaning.
pub(crate) fn opening_rows(ui: &mut Ui, opening: &Opening, takes_escape: bool) -> Option<PageWish> {
    let color = quiet(ui.ctx());
    if let Some(outline) = opening.outline() {
        let [x, y, z] = outline.dims;
        let needs = format_bytes(outline.bytes_needed());
        let text = format!("{}, {x}×{y}×{z} {}, {needs} of memory", outline.format, outline.dtype);
        ui.add(egui::Label::new(RichText::new(text).size(12.0).color(color)).truncate());
    }
    let (text, share) = opening.progress();
    ui.label(RichText::new(text).size(12.0));
    if let Some(fraction) = share {
        let percent = RichText::new(format!("{:.0} %", fraction * 100.0)).size(11.0);
        let bar = ui.add(egui::ProgressBar::new(fraction).desired_height(14.0).text(percent));
        named(&bar, egui::Role::ProgressIndicator, "read");
    }
    ui.add_space(4.0);
    let button = ui.button("Cancel");
    let button = if takes_escape { button.on_hover_text("Esc") } else { button };
    let is_cancelled =
        button.clicked() || (takes_escape && ui.input_mut(|i| i.consume_key(Modifiers::NONE, Key::Escape)));
    is_cancelled.then_some(PageWish::Cancel)
}

/// Whether a text names a volume on another machine.
fn names_remote(services: &Services, text: &str) -> bool {
    services.remote.as_ref().is_some_and(|remote| remote.is_place(text))
}

/// The link in a pasted text, which may be a whole command line.
fn link_in(text: &str) -> Result<Link, String> {
    let text = text.trim();
    let begin = text.find("isinglass://").unwrap_or(0);
    let is_end = |c: char| c.is_whitespace() || "'\"`<>".contains(c);
    let link = &text[begin..];
    let link = link.split(is_end).find(|part| !part.is_empty()).unwrap_or(link);
    link.parse::<Link>().map_err(|e| sentence(&e))
}

/// Volumes that need no file, with their names and pictures.
const SAMPLES: [(Builtin, &str, &[u8]); 3] = [
    (Builtin::Shells, "Shells", include_bytes!("samples/shells.png")),
    (Builtin::Cloud, "Cloud", include_bytes!("samples/cloud.png")),
    (Builtin::Cubus, "Cubes", include_bytes!("samples/cubus.png")),
];
/// Cards this wide have a field for dropping, points.
const LEAST_WIDTH_OF_ZONE: f32 = 260.0;
/// Points.
const MOST_WIDTH_OF_SAMPLE: f32 = 128.0;
/// Between cards, points.
const GAP: f32 = 16.0;
/// Height of the choices in a row, points.
const CHOICE_HEIGHT: f32 = 148.0;
/// The choices are in a row where it is at least this wide, points.
const LEAST_WIDTH_OF_ROW: f32 = 640.0;
/// Points.
const LEAST_WIDTH_OF_CARD: f32 = 160.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_found_in_a_line_of_a_shell() {
        let token = "00112233445566778899aabbccddeeff";
        let link = format!("isinglass://h:4433/#token={token}&cert=sha256:{}", "ab".repeat(32));
        for text in
            [link.clone(), format!("  isinglass view '{link}'\n"), format!("\"{link}\""), format!("<{link}>")]
        {
            let found = link_in(&text).unwrap_or_else(|e| panic!("{text}: {e}"));
            assert_eq!((found.host.as_str(), found.port), ("h", 4433));
        }
        assert!(link_in("hello").unwrap_err().starts_with("Not an isinglass link"));
        assert!(link_in("isinglass://h:4433/").unwrap_err().contains("token="));
        assert!(link_in("").is_err());
    }
}
