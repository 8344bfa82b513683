//! The start page: a link to paste, the recent list, and the files of this machine.

use std::path::PathBuf;

use egui::{Key, Modifiers, RichText, ScrollArea, Sense, Stroke, Ui, vec2};
use isinglass_formats::{Content, LoadRequest, RecentEntry, RecentPlace, VolumeSource};
use isinglass_net::{Link, place_of};

use super::opening::Opening;
use super::recent_list::{RecentList, ago};
use super::services::Services;
use crate::panels::browser::{Browser, Chosen};
use crate::panels::style::{self, bright, emblem, named, quiet, warning};
use crate::panels::text::{format_bytes, sentence};
use crate::view::Waker;

pub(crate) enum PageWish {
    Connect(Box<Link>),
    Open(LoadRequest),
    OpenState(PathBuf),
    Cancel,
    Back,
    Close,
    Forget(usize),
}

pub(crate) struct PageScene<'a> {
    pub(crate) services: &'a Services,
    pub(crate) recent: &'a RecentList,
    pub(crate) opening: Option<&'a Opening>,
    pub(crate) problem: Option<&'a str>,
    /// Whether a picture is shown behind the page.
    pub(crate) has_session: bool,
    /// Size of the volume that is shown in this process, bytes.
    pub(crate) held: u64,
}

pub(crate) struct StartPage {
    link_text: String,
    link_problem: Option<String>,
    /// A hint about a server in the recent list.
    hint: Option<String>,
    wants_link_focus: bool,
    pub(crate) browser: Browser,
}

impl StartPage {
    pub(crate) fn new(folder: PathBuf, wake: &Waker) -> Self {
        Self {
            link_text: String::new(),
            link_problem: None,
            hint: None,
            wants_link_focus: true,
            browser: Browser::new(folder, wake),
        }
    }

    pub(crate) fn focus(&mut self) {
        self.wants_link_focus = true;
    }

    pub(crate) fn show(&mut self, ui: &mut Ui, scene: &PageScene<'_>) -> Option<PageWish> {
        let rect = ui.max_rect();
        ui.painter().rect_filled(rect, 0.0, ui.visuals().panel_fill);
        let mut wish = None;
        if let Some(opening) = scene.opening {
            // The page beneath is inactive, but the window stays awake.
            return loading_page(ui, opening, scene.has_session);
        }
        if scene.has_session && ui.input_mut(|i| i.consume_key(Modifiers::NONE, Key::Escape)) {
            return Some(PageWish::Back);
        }
        let is_wide = rect.width() >= 820.0;
        let margin = if is_wide { 28.0 } else { 14.0 };
        let width = (rect.width() - 2.0 * margin).min(1120.0);
        let inner = egui::Rect::from_center_size(rect.center(), vec2(width, rect.height() - 2.0 * margin));
        let mut page = ui.new_child(egui::UiBuilder::new().max_rect(inner));
        let ui = &mut page;
        self.header(ui, scene, &mut wish);
        ui.add_space(10.0);
        let height = ui.available_height();
        if is_wide {
            let left_width = (width * 0.42).clamp(330.0, 430.0);
            ui.horizontal_top(|ui| {
                ui.allocate_ui(vec2(left_width, height), |ui| {
                    ui.set_width(left_width);
                    ui.vertical(|ui| self.left(ui, scene, &mut wish));
                });
                ui.add_space(22.0);
                let right = vec2(ui.available_width(), height);
                ui.allocate_ui(right, |ui| {
                    ui.set_width(right.x);
                    ui.vertical(|ui| self.right(ui, scene, height, &mut wish));
                });
            });
        } else {
            ScrollArea::vertical().show(ui, |ui| {
                self.left(ui, scene, &mut wish);
                ui.add_space(14.0);
                self.right(ui, scene, 420.0, &mut wish);
            });
        }
        wish
    }

    fn header(&mut self, ui: &mut Ui, scene: &PageScene<'_>, wish: &mut Option<PageWish>) {
        ui.horizontal(|ui| {
            let (emblem_rect, _) = ui.allocate_exact_size(vec2(44.0, 36.0), Sense::hover());
            emblem(ui.painter(), emblem_rect.center(), 0.5, ui.visuals().dark_mode);
            ui.label(RichText::new("isinglass").size(26.0).color(bright(ui.ctx())));
            if scene.has_session {
                ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                    if ui.button("Back to the picture").on_hover_text("Esc").clicked() {
                        *wish = Some(PageWish::Back);
                    }
                    if ui
                        .button("Close it")
                        .on_hover_text("ends what is shown, and frees its memory")
                        .clicked()
                    {
                        *wish = Some(PageWish::Close);
                    }
                });
            }
        });
        if let Some(problem) = scene.problem {
            style::problem(ui, problem);
        }
    }

    fn left(&mut self, ui: &mut Ui, scene: &PageScene<'_>, wish: &mut Option<PageWish>) {
        title(ui, "Connect to a server");
        let has_link = !self.link_text.trim().is_empty();
        ui.horizontal(|ui| {
            let width = ui.available_width() - 84.0;
            let field = egui::TextEdit::singleline(&mut self.link_text).desired_width(width);
            let field = ui.add(field.hint_text("isinglass://host:port/#token=…&cert=…"));
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
                match link_in(&self.link_text) {
                    Ok(link) => *wish = Some(PageWish::Connect(Box::new(link))),
                    Err(problem) => {
                        self.link_problem = Some(problem);
                        self.wants_link_focus = true;
                    }
                }
            }
        });
        let color = quiet(ui.ctx());
        let note = match (&self.link_problem, &self.hint) {
            (Some(problem), _) => RichText::new(problem).color(warning(ui)),
            (None, Some(hint)) => RichText::new(hint),
            (None, None) => {
                RichText::new("Paste the link that 'isinglass serve' printed; it lets in one viewer.")
                    .color(color)
            }
        };
        ui.add(egui::Label::new(note.size(12.0)).wrap());
        ui.add_space(16.0);
        title(ui, "Recent");
        if let Some(problem) = scene.recent.problem() {
            ui.add(egui::Label::new(RichText::new(problem).size(11.5).color(warning(ui))).wrap());
        }
        let entries = scene.recent.entries();
        if entries.is_empty() {
            ui.label(
                RichText::new("Servers and volumes that were opened are listed here.")
                    .size(12.0)
                    .color(color),
            );
        }
        let now = (scene.services.calendar)();
        for (i, entry) in entries.iter().enumerate() {
            match recent_row(ui, entry, now) {
                Some(RowWish::Open) => self.choose(ui, entry, scene, wish),
                Some(RowWish::Forget) => *wish = Some(PageWish::Forget(i)),
                None => {}
            }
        }
    }

    fn choose(&mut self, ui: &Ui, entry: &RecentEntry, scene: &PageScene<'_>, wish: &mut Option<PageWish>) {
        match &entry.place {
            RecentPlace::Volume(volume) => {
                let max_bytes = scene.services.servers.max_bytes();
                *wish = Some(PageWish::Open(volume.clone().request(max_bytes)));
            }
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

    fn right(&mut self, ui: &mut Ui, scene: &PageScene<'_>, height: f32, wish: &mut Option<PageWish>) {
        title(ui, "Open a volume of this computer");
        let height = height - 34.0;
        let volumes = (&scene.services.servers, scene.held);
        match self.browser.show(ui, Some(volumes), height) {
            Some(Chosen::Volume(request)) => *wish = Some(PageWish::Open(request)),
            // Of texts, the page accepts states.
            Some(Chosen::Text(path)) => *wish = Some(PageWish::OpenState(path)),
            None => {}
        }
    }
}

enum RowWish {
    Open,
    Forget,
}

fn recent_row(ui: &mut Ui, entry: &RecentEntry, now: u64) -> Option<RowWish> {
    let (name, place) = match &entry.place {
        RecentPlace::Server { host, port } => {
            (place_of(host, *port), format!("server, showed {}", entry.shows))
        }
        RecentPlace::Volume(VolumeSource { source, raw, selection, spacing }) => {
            let part = [
                ("channel", selection.channel),
                ("time", selection.time),
                ("level", selection.level),
                ("series", selection.series),
            ];
            let part = part.into_iter().filter_map(|(what, n)| n.map(|n| format!(", {what} {n}")));
            let region = selection.region.map(|r| format!(", region {r}"));
            let raw = raw.map(|raw| {
                let [x, y, z] = raw.dims;
                format!(", raw {x}×{y}×{z} {}", raw.dtype.name())
            });
            let spacing = spacing.map(|s| format!(", voxels of {}×{}×{}", s.x, s.y, s.z));
            let part: String = part.chain(region).chain(raw).chain(spacing).collect();
            (entry.shows.clone(), format!("{source}{part}"))
        }
    };
    let mut wish = None;
    let width = ui.available_width();
    let (rect, response) = ui.allocate_exact_size(vec2(width, 38.0), Sense::click());
    let response = response.on_hover_text(&place);
    named(&response, egui::Role::Button, &name);
    let visuals = ui.visuals();
    if response.hovered() || response.has_focus() {
        ui.painter().rect_filled(rect, 4.0, visuals.widgets.hovered.weak_bg_fill);
    }
    let (text, side) = (bright(ui.ctx()), quiet(ui.ctx()));
    let when = ago(now, entry.used_at);
    let small = egui::FontId::proportional(11.5);
    let when = ui.painter().layout_no_wrap(when, small.clone(), side);
    let when_left = rect.right() - 28.0 - when.size().x;
    let texts = ui.painter().with_clip_rect(rect.with_max_x(when_left - 8.0).intersect(ui.clip_rect()));
    texts.text(
        rect.left_top() + vec2(8.0, 4.0),
        egui::Align2::LEFT_TOP,
        name.clone(),
        egui::FontId::proportional(13.5),
        text,
    );
    texts.text(rect.left_bottom() + vec2(8.0, -4.0), egui::Align2::LEFT_BOTTOM, place, small, side);
    let when_top = rect.center().y - when.size().y * 0.5;
    ui.painter().galley(egui::pos2(when_left, when_top), when, side);
    let cross =
        egui::Rect::from_center_size(egui::pos2(rect.right() - 13.0, rect.center().y), vec2(18.0, 18.0));
    let forget = ui.interact(cross, response.id.with("forget"), Sense::click()).on_hover_text("forget this");
    named(&forget, egui::Role::Button, &format!("forget {name}"));
    let stroke = Stroke::new(1.2, if forget.hovered() { text } else { side.gamma_multiply(0.7) });
    let arm = cross.shrink(5.5);
    ui.painter().line_segment([arm.left_top(), arm.right_bottom()], stroke);
    ui.painter().line_segment([arm.right_top(), arm.left_bottom()], stroke);
    if forget.clicked() {
        wish = Some(RowWish::Forget);
    } else if response.clicked() {
        wish = Some(RowWish::Open);
    }
    wish
}

/// The page while something is being opened: name, progress, and a way out.
fn loading_page(ui: &mut Ui, opening: &Opening, has_session: bool) -> Option<PageWish> {
    let center = ui.max_rect().center();
    let card = egui::Rect::from_center_size(center, vec2(ui.max_rect().width().min(460.0) - 20.0, 210.0));
    let mut ui = ui.new_child(egui::UiBuilder::new().max_rect(card));
    let (emblem_rect, _) = ui.allocate_exact_size(vec2(44.0, 36.0), Sense::hover());
    emblem(ui.painter(), emblem_rect.center(), 0.5, ui.visuals().dark_mode);
    ui.add_space(6.0);
    ui.add(egui::Label::new(RichText::new(&opening.name).size(18.0)).truncate());
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
    ui.label(RichText::new(text).size(12.5));
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

fn title(ui: &mut Ui, text: &str) {
    ui.label(RichText::new(text).size(15.0).strong());
    ui.add_space(2.0);
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

/// Whether a file opens as a volume.
pub(crate) fn is_volume(content: Content) -> bool {
    matches!(content, Content::Volume(_) | Content::Folder)
}

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
