//! The list of files from which volumes open, and texts if the owner reads them. It works by keyboard and mouse, and
//! never waits for a disk.

mod folder;
mod selection;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use egui::{Align, EventFilter, FontId, Key, Layout, Modifiers, Rect, RichText, ScrollArea, Sense, Ui, vec2};
use isinglass_formats::{Content, LoadRequest, Outline, Selection};

use self::folder::{Entry, Folder};
use self::selection::SelectionForm;
use super::background::{Background, path_from_text};
use super::style::{self, bright, named, quiet};
use super::text::format_bytes;
use crate::view::Waker;
use crate::view::local_servers::{LocalServers, survey};

pub(crate) struct Browser {
    wake: Waker,
    takes_volumes: bool,
    takes_texts: bool,
    folder: Folder,
    path_text: String,
    selected: Option<usize>,
    /// The name to select once the folder is listed.
    wanted_name: Option<String>,
    /// Whether a folder of that name is shown instead of selected.
    enters_wanted: bool,
    /// A name that was wanted and is not in the list.
    missing_name: Option<String>,
    scrolls: bool,
    wants_focus: bool,
    /// The letters of a name that were typed lately, and the time of the last, seconds.
    typed: (String, f64),
    looked_at: Option<LookedAt>,
    /// Whether the folder itself is selected as a volume.
    takes_folder: bool,
    /// A volume that was chosen elsewhere. The list may not have it.
    given: Option<PathBuf>,
}

pub(crate) enum Chosen {
    /// A volume, or a part of it.
    Volume(LoadRequest),
    /// A file that may be a state, or hold transfer functions.
    Text(PathBuf),
}

/// What opens volumes, and the size of the volume shown, bytes.
pub(crate) type Volumes<'a> = (&'a Arc<dyn LocalServers>, u64);

/// A volume whose header is shown.
struct LookedAt {
    source: PathBuf,
    form: SelectionForm,
    /// The selection of `found`.
    asked: Selection,
    waiting: Background<Outline>,
    found: Option<Result<Outline, String>>,
}

impl Browser {
    pub(crate) fn new(folder: PathBuf, wake: &Waker) -> Self {
        Self {
            wake: wake.clone(),
            takes_volumes: false,
            takes_texts: false,
            path_text: folder.display().to_string(),
            folder: Folder::open(folder, wake),
            selected: None,
            wanted_name: None,
            enters_wanted: false,
            missing_name: None,
            scrolls: false,
            wants_focus: false,
            typed: (String::new(), 0.0),
            looked_at: None,
            takes_folder: false,
            given: None,
        }
    }

    /// The same, for texts too.
    pub(crate) fn with_texts(folder: PathBuf, wake: &Waker) -> Self {
        Self { takes_texts: true, ..Self::new(folder, wake) }
    }

    /// Gives the list the keyboard, and lists the folder anew: files may have come since.
    pub(crate) fn focus(&mut self) {
        let selected = self.entry().map(|entry| entry.name.clone());
        self.go_to(self.folder.path.clone(), selected);
        self.wants_focus = true;
    }

    pub(crate) fn folder(&self) -> &Path {
        &self.folder.path
    }

    pub(crate) fn go_to(&mut self, folder: PathBuf, select: Option<String>) {
        self.path_text = folder.display().to_string();
        self.folder = Folder::open(folder, &self.wake);
        (self.selected, self.wanted_name, self.scrolls) = (None, select, true);
        (self.looked_at, self.takes_folder, self.missing_name) = (None, false, None);
        (self.enters_wanted, self.given) = (false, None);
    }

    /// Selects a volume that was chosen elsewhere. `is_folder` if the files in it are the volume together.
    pub(crate) fn select_volume(&mut self, volume: PathBuf, is_folder: bool) {
        let (parent, name) = (volume.parent().map(Path::to_owned), volume.file_name());
        match (parent, name.map(|name| name.to_string_lossy().into_owned())) {
            (Some(parent), name) if !is_folder => {
                self.go_to(parent, name);
                self.given = Some(volume);
            }
            _ => {
                self.go_to(volume, None);
                self.takes_folder = true;
            }
        }
        self.wants_focus = true;
    }

    fn go_up(&mut self) {
        if let Some(parent) = self.folder.path.parent().map(Path::to_owned) {
            let name = self.folder.path.file_name().map(|n| n.to_string_lossy().into_owned());
            self.go_to(parent, name);
        }
    }

    /// Shows path, list and details; returns what to open. Without `volumes`, volumes do not open.
    pub(crate) fn show(&mut self, ui: &mut Ui, volumes: Option<Volumes<'_>>, height: f32) -> Option<Chosen> {
        self.takes_volumes = volumes.is_some();
        self.folder.poll();
        let is_told = |e: &Entry| !e.is_folder || e.content.is_some();
        let is_unclear = |name: &str| {
            self.enters_wanted && self.folder.entries.iter().any(|e| e.name == name && !is_told(e))
        };
        if let Some(name) = self.wanted_name.take_if(|name| !self.folder.is_listing && !is_unclear(name)) {
            let found = self.folder.entries.iter().position(|e| e.name == name);
            self.select(found);
            let is_folder = self.entry().is_some_and(|entry| entry.is_folder);
            if std::mem::take(&mut self.enters_wanted) && is_folder {
                self.enter();
            }
            // A folder that cannot be listed has its own line.
            self.missing_name = (found.is_none() && self.folder.problem.is_none()).then_some(name);
        }
        self.path_row(ui);
        let details = match self.entry() {
            _ if self.looked_at.is_some() => DETAILS_HEIGHT.min(height * 0.5),
            Some(entry) if self.opens(entry).is_some() && !entry.is_folder => ui.spacing().interact_size.y,
            None if self.missing_name.is_some() => ui.spacing().interact_size.y,
            Some(_) | None => 0.0,
        };
        let list = (height - ui.spacing().interact_size.y - 16.0 - details).max(90.0);
        let opens = self.list(ui, list);
        match volumes {
            Some(volumes) => self.look(volumes),
            None => self.looked_at = None,
        }
        match &self.looked_at {
            Some(_) => volumes.and_then(|volumes| self.volume(ui, volumes, opens)).map(Chosen::Volume),
            None => self.file(ui, opens).map(Chosen::Text),
        }
    }

    fn path_row(&mut self, ui: &mut Ui) {
        ui.horizontal(|ui| {
            let up = ui.add_enabled(self.folder.path.parent().is_some(), egui::Button::new("up"));
            if up.on_hover_text("the folder above (Backspace in the list)").clicked() {
                self.go_up();
                self.wants_focus = true;
            }
            let slices = self.folder.may_be_volume();
            let width = ui.available_width() - if slices.is_some() { 128.0 } else { 0.0 };
            let field = egui::TextEdit::singleline(&mut self.path_text).desired_width(width);
            let field = ui.add(field.hint_text("a file or folder"));
            named(&field, egui::Role::TextInput, "path");
            if field.lost_focus() && ui.input(|i| i.key_pressed(Key::Enter)) {
                if let Some(path) = path_from_text(&self.path_text) {
                    // A thread lists the folder, and reports a missing name.
                    self.go_to_text(path);
                }
                self.wants_focus = true;
            }
            if let Some(slices) = slices {
                let all = egui::Button::new("whole folder").selected(self.takes_folder);
                let hint = format!("the {slices} files of this folder as one volume");
                if ui.add(all).on_hover_text(hint).clicked() {
                    self.select(None);
                    (self.takes_folder, self.given) = (true, None);
                }
            }
        });
    }

    /// Shows a written folder, or the folder of a written file with that selected.
    fn go_to_text(&mut self, path: PathBuf) {
        let path = if path.is_relative() { self.folder.path.join(path) } else { path };
        let is_folder_text = self.path_text.trim_end().ends_with(['/', '\\']);
        match (path.parent(), path.file_name()) {
            (Some(parent), Some(name)) if !is_folder_text => {
                self.go_to(parent.to_owned(), Some(name.to_string_lossy().into_owned()));
                self.enters_wanted = true;
            }
            _ => self.go_to(path, None),
        }
    }

    fn select(&mut self, entry: Option<usize>) {
        let is_given =
            |number: usize| self.folder.entries.get(number).map(|e| &e.path) == self.given.as_ref();
        if !entry.is_none_or(is_given) {
            self.given = None;
        }
        if self.selected != entry && self.given.is_none() {
            self.looked_at = None;
        }
        (self.selected, self.scrolls, self.missing_name) = (entry, true, None);
        self.takes_folder &= entry.is_none();
    }

    /// Shows the list; returns whether to open the selected entry.
    fn list(&mut self, ui: &mut Ui, height: f32) -> bool {
        let width = ui.available_width();
        let (outer, _) = ui.allocate_exact_size(vec2(width, height), Sense::hover());
        let frame = ui.visuals().widgets.noninteractive.bg_stroke;
        ui.painter().rect_filled(outer, 4.0, ui.visuals().extreme_bg_color);
        let id = ui.make_persistent_id("files");
        let list = ui.interact(outer, id, Sense::click());
        named(&list, egui::Role::List, "files");
        if std::mem::take(&mut self.wants_focus) || list.clicked() {
            list.request_focus();
        }
        let filter =
            EventFilter { tab: false, horizontal_arrows: true, vertical_arrows: true, escape: false };
        ui.memory_mut(|m| m.set_focus_lock_filter(id, filter));
        let stroke = if list.has_focus() { ui.visuals().selection.stroke } else { frame };
        ui.painter().rect_stroke(outer, 4.0, stroke, egui::StrokeKind::Inside);
        let mut opens = list.has_focus() && self.keys(ui, height);
        let mut ui = ui.new_child(
            egui::UiBuilder::new().max_rect(outer.shrink(3.0)).layout(Layout::top_down(Align::Min)),
        );
        ui.set_clip_rect(outer.shrink(2.0).intersect(ui.clip_rect()));
        if let Some(problem) = &self.folder.problem {
            style::problem(&mut ui, problem);
            return false;
        }
        if self.folder.entries.is_empty() {
            let text = if self.folder.is_listing { "looking…" } else { "nothing in this folder" };
            let color = quiet(ui.ctx());
            ui.label(RichText::new(text).color(color));
            return false;
        }
        ui.spacing_mut().item_spacing.y = 0.0;
        let mut area = ScrollArea::vertical().auto_shrink(false);
        if let Some(row) = self.selected.filter(|_| self.scrolls) {
            // Keeps the selected row and a row around it in sight.
            let (top, bottom) = ((row as f32 - 1.0) * ROW, (row as f32 + 2.0) * ROW);
            let offset = ui.data(|d| d.get_temp::<f32>(id)).unwrap_or(0.0);
            let view = height - 6.0;
            area = area.vertical_scroll_offset(offset.min(top).max(bottom - view).max(0.0));
        }
        self.scrolls = false;
        let mut clicked = None;
        let output = area.show_rows(&mut ui, ROW, self.folder.entries.len(), |ui, rows| {
            for i in rows {
                let (rect, response) =
                    ui.allocate_exact_size(vec2(ui.available_width(), ROW), Sense::click());
                let entry = &self.folder.entries[i];
                named(&response, egui::Role::ListItem, &entry.name);
                let opens = entry.is_folder || self.opens(entry) != Some(false);
                row(ui, rect, entry, opens, self.selected == Some(i), response.hovered());
                if response.clicked() || response.double_clicked() {
                    clicked = Some((i, response.double_clicked()));
                }
            }
        });
        ui.data_mut(|d| d.insert_temp(id, output.state.clamped_offset().y));
        if let Some((i, is_double)) = clicked {
            ui.memory_mut(|m| m.request_focus(id));
            let scrolls = self.scrolls;
            self.select(Some(i));
            self.scrolls = scrolls;
            opens |= is_double && self.enter();
        }
        opens
    }

    /// Handles keys; returns whether to open the selected entry.
    fn keys(&mut self, ui: &Ui, height: f32) -> bool {
        let last = self.folder.entries.len().saturating_sub(1);
        let page = ((height / ROW) as usize).saturating_sub(2).max(1);
        let at = self.selected;
        let press = |key| ui.input_mut(|i| i.consume_key(Modifiers::NONE, key));
        // A slow refresh may bring several presses.
        let steps = |key| ui.input_mut(|i| i.count_and_consume_key(Modifiers::NONE, key));
        let (down, up) = (steps(Key::ArrowDown), steps(Key::ArrowUp));
        let to = |n: usize| Some(n.min(last)).filter(|_| !self.folder.entries.is_empty());
        let moved = if down > 0 {
            to(at.map_or(down - 1, |n| n + down))
        } else if up > 0 {
            to(at.map_or(0, |n| n.saturating_sub(up)))
        } else if press(Key::PageDown) {
            to(at.map_or(0, |n| n + page))
        } else if press(Key::PageUp) {
            to(at.map_or(0, |n| n.saturating_sub(page)))
        } else if press(Key::Home) {
            to(0)
        } else if press(Key::End) {
            to(last)
        } else {
            None
        };
        if moved.is_some() {
            self.select(moved);
        }
        if press(Key::Backspace) || press(Key::ArrowLeft) {
            self.go_up();
            return false;
        }
        if press(Key::ArrowRight) && self.entry().is_some_and(|e| e.is_folder) {
            self.enter();
            return false;
        }
        self.type_on(ui);
        if let Some(path) = pasted_path(ui) {
            self.path_text = path.display().to_string();
            self.go_to_text(path);
            return false;
        }
        press(Key::Enter) && self.enter()
    }

    /// Typed letters select the first name that begins with them.
    fn type_on(&mut self, ui: &Ui) {
        let (text, now) = ui.input(|i| {
            let texts = i.events.iter().filter_map(|e| match e {
                egui::Event::Text(text) => Some(text.as_str()),
                _ => None,
            });
            (texts.collect::<String>(), i.time)
        });
        if text.is_empty() {
            return;
        }
        if now > self.typed.1 + TYPING_SECONDS {
            self.typed.0.clear();
        }
        self.typed.0 += &text.to_lowercase();
        self.typed.1 = now;
        let typed = &self.typed.0;
        let found = self.folder.entries.iter().position(|e| e.name.to_lowercase().starts_with(typed));
        if found.is_some() {
            self.select(found);
        }
    }

    /// Whether a file opens here, by its first bytes; unknown until they are read.
    fn opens(&self, entry: &Entry) -> Option<bool> {
        Some(match entry.content? {
            Content::Volume(_) => self.takes_volumes,
            Content::State => true,
            Content::Text => self.takes_texts,
            Content::Folder | Content::Other(_) => false,
        })
    }

    fn entry(&self) -> Option<&Entry> {
        self.folder.entries.get(self.selected?)
    }

    /// Enters the selected folder, or returns that the file is to be opened.
    fn enter(&mut self) -> bool {
        let Some(entry) = self.entry() else { return self.looked_at.is_some() };
        if entry.is_folder && self.opens(entry) != Some(true) {
            let path = entry.path.clone();
            self.go_to(path, None);
            return false;
        }
        true
    }

    /// Reads the header of the selected volume, and again for other parts of it.
    fn look(&mut self, (servers, held): Volumes<'_>) {
        let source = match self.entry() {
            Some(entry) if matches!(entry.content, Some(Content::Volume(_))) => Some(entry.path.clone()),
            None if self.takes_folder => Some(self.folder.path.clone()),
            Some(entry) if self.given.as_ref() != Some(&entry.path) => None,
            Some(_) | None => self.given.clone(),
        };
        let Some(source) = source else {
            self.looked_at = None;
            return;
        };
        if self.looked_at.as_ref().is_none_or(|l| l.source != source) {
            let form = SelectionForm::default();
            let asked = Selection::default();
            self.looked_at =
                Some(LookedAt { source, form, asked, waiting: Background::default(), found: None });
        }
        let Some(looked) = &mut self.looked_at else { return };
        if let Some(found) = looked.waiting.take() {
            if let Ok(outline) = &found {
                looked.form.learn(outline);
            }
            looked.found = Some(found);
        }
        let wanted = looked.form.selection();
        if !looked.waiting.is_busy() && (looked.found.is_none() || looked.asked != wanted) {
            looked.asked = wanted;
            let request = request(&looked.source, wanted, &**servers);
            let servers = servers.clone();
            looked.waiting = Background::run(&self.wake, move || survey(&request, held, &*servers));
        }
    }

    /// Details of a selected file that is no volume of this list; returns the file to open.
    fn file(&self, ui: &mut Ui, opens: bool) -> Option<PathBuf> {
        let color = quiet(ui.ctx());
        if let Some(name) = &self.missing_name {
            let text = format!("{name}: not in this folder, or not shown in it");
            ui.add(egui::Label::new(RichText::new(text).color(color)).truncate());
        }
        let entry = self.entry().filter(|entry| !entry.is_folder)?;
        let can_open = self.opens(entry)?;
        if !can_open {
            let text = format!("{} is not supported: {}", entry.name, entry.kind());
            ui.add(egui::Label::new(RichText::new(text).color(color)).wrap());
            return None;
        }
        let is_clicked = ui.horizontal(|ui| {
            let is_clicked = ui.button("Open").clicked();
            let text = match entry.is_state() {
                true => "a saved state, with the volume that it names",
                false => "as colours and opacities",
            };
            ui.add(egui::Label::new(RichText::new(text).color(color)).truncate());
            is_clicked
        });
        (opens || is_clicked.inner).then(|| entry.path.clone())
    }

    /// Details of the selected volume, and a choice of its parts.
    fn volume(&mut self, ui: &mut Ui, (servers, _): Volumes<'_>, opens: bool) -> Option<LoadRequest> {
        let looked = self.looked_at.as_mut()?;
        ui.add_space(4.0);
        let mut is_asked = opens;
        let is_folder = looked.source == self.folder.path;
        match &looked.found {
            None => drop(ui.label("reading the header…")),
            Some(Err(problem)) => {
                style::problem(ui, problem);
                looked.form.show(ui);
            }
            Some(Ok(outline)) => {
                ui.label(RichText::new(title(outline, is_folder)).strong());
                let color = quiet(ui.ctx());
                ui.add(egui::Label::new(RichText::new(facts(outline)).color(color)).truncate());
                looked.form.show(ui);
                ui.horizontal(|ui| {
                    let can_open = !looked.waiting.is_busy();
                    let text = if is_folder { "Open this folder" } else { "Open" };
                    is_asked |= ui.add_enabled(can_open, egui::Button::new(text)).clicked();
                    let needs = format!("needs {} of memory", format_bytes(outline.bytes_needed()));
                    ui.label(RichText::new(needs).color(color));
                    if let Some(warning) = outline.warnings.first() {
                        let more = outline.warnings.len() - 1;
                        let more = if more > 0 { format!(" (and {more} more)") } else { String::new() };
                        let text = RichText::new(format!("{}{more}", warning.text)).size(11.5).color(color);
                        let all: Vec<&str> = outline.warnings.iter().map(|w| w.text.as_str()).collect();
                        ui.add(egui::Label::new(text).truncate()).on_hover_text(all.join("\n"));
                    }
                });
            }
        }
        let is_good = matches!(looked.found, Some(Ok(_))) && !looked.waiting.is_busy();
        // Enter before the header is read counts.
        is_asked |= is_good && looked.form.opens_when_read;
        looked.form.opens_when_read = is_asked && !is_good && looked.waiting.is_busy();
        (is_asked && is_good).then(|| request(&looked.source, looked.asked, &**servers))
    }
}

/// An absolute path in the clipboard that is pasted into the list.
fn pasted_path(ui: &Ui) -> Option<PathBuf> {
    ui.input(|i| {
        let texts =
            i.events.iter().filter_map(|e| if let egui::Event::Paste(text) = e { Some(text) } else { None });
        texts.filter_map(|text| path_from_text(text)).next_back().filter(|path| path.has_root())
    })
}

fn request(source: &Path, selection: Selection, servers: &dyn LocalServers) -> LoadRequest {
    LoadRequest {
        selection,
        max_bytes: servers.max_bytes(),
        ..LoadRequest::new(source.to_string_lossy().into_owned())
    }
}

fn title(outline: &Outline, is_folder: bool) -> String {
    let whole = if is_folder { " (the whole folder)" } else { "" };
    format!("{}{whole}", outline.name)
}

fn facts(outline: &Outline) -> String {
    let [x, y, z] = outline.dims;
    let spacing =
        outline.spacing.map(|s| format!("{s:.3}").trim_end_matches('0').trim_end_matches('.').to_owned());
    let unit = outline.unit.as_deref().map_or(String::new(), |u| format!(" {u}"));
    format!("{}, {x}×{y}×{z} {}, voxels of {}{unit}", outline.format, outline.dtype, spacing.join("×"))
}

fn row(ui: &Ui, rect: Rect, entry: &Entry, opens: bool, is_selected: bool, is_hovered: bool) {
    let visuals = ui.visuals();
    if is_selected {
        ui.painter().rect_filled(rect, 3.0, visuals.selection.bg_fill);
    } else if is_hovered {
        ui.painter().rect_filled(rect, 3.0, visuals.widgets.hovered.weak_bg_fill);
    }
    let strong = if is_selected { visuals.selection.stroke.color } else { bright(ui.ctx()) };
    let color = if opens { strong } else { visuals.weak_text_color().gamma_multiply(0.8) };
    let side = if is_selected { strong } else { quiet(ui.ctx()) };
    let font = FontId::proportional(13.0);
    let small = FontId::proportional(11.5);
    let painter = ui.painter().with_clip_rect(rect.intersect(ui.clip_rect()));
    let middle = rect.center().y;
    let size = if entry.is_folder { String::new() } else { format_bytes(entry.bytes) };
    let right = rect.right() - 10.0;
    painter.text(egui::pos2(right, middle), egui::Align2::RIGHT_CENTER, size, small.clone(), side);
    let kind_right = right - SIZE_WIDTH;
    let kind = painter.layout_no_wrap(entry.kind().to_owned(), small, side);
    let kind_left = kind_right - kind.size().x;
    painter.galley(egui::pos2(kind_left, middle - kind.size().y * 0.5), kind, side);
    let mark = if entry.is_folder { "/" } else { "" };
    let name_rect = rect.with_max_x(kind_left - 8.0);
    ui.painter().with_clip_rect(name_rect.intersect(ui.clip_rect())).text(
        egui::pos2(rect.left() + 6.0, middle),
        egui::Align2::LEFT_CENTER,
        format!("{}{mark}", entry.name),
        font,
        color,
    );
}

const ROW: f32 = 21.0;
const SIZE_WIDTH: f32 = 62.0;
const DETAILS_HEIGHT: f32 = 150.0;
/// Letters after a longer pause begin another name, seconds.
const TYPING_SECONDS: f64 = 1.0;
