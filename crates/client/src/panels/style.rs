//! What lies over the picture: numbers, banner, help, and the page before the first frame.

use egui::{Align2, Color32, Frame, Margin, RichText, Stroke, Ui, vec2};
use isinglass_core::wire::VolumeDescription;
use isinglass_net::State;

use crate::bindings::Bindings;
use crate::overlay::{OverlayModel, sentence};
use crate::viewing::Standing;

/// What is taken of the window around a pane that is to keep clear of it, points.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Taken {
    /// On the left.
    pub(crate) left: f32,
    /// On the right.
    pub(crate) right: f32,
    /// Above or below, at the edge of the window where the pane lies.
    pub(crate) edge: f32,
}

impl Taken {
    /// How wide a pane may be between the two sides.
    pub(crate) fn width(&self, ctx: &egui::Context) -> f32 {
        ctx.content_rect().width() - self.left - self.right
    }

    /// From the middle of the window to that between the sides.
    pub(crate) fn shift(&self) -> f32 {
        0.5 * (self.left - self.right)
    }
}

/// A pane that text can be read on over any picture.
pub(crate) fn pane(ctx: &egui::Context) -> Frame {
    let (fill, line) = if is_dark(ctx) {
        (Color32::from_rgba_unmultiplied(14, 16, 20, 225), Color32::from_white_alpha(28))
    } else {
        (Color32::from_rgba_unmultiplied(246, 247, 249, 240), Color32::from_black_alpha(60))
    };
    Frame::new()
        .fill(fill)
        .stroke(Stroke::new(1.0, line))
        .corner_radius(6.0)
        .inner_margin(Margin::symmetric(10, 8))
}

fn is_dark(ctx: &egui::Context) -> bool {
    ctx.theme() == egui::Theme::Dark
}

/// Text to be read, and text beside it.
pub(crate) fn bright(ctx: &egui::Context) -> Color32 {
    if is_dark(ctx) { Color32::from_gray(232) } else { Color32::from_gray(20) }
}

pub(crate) fn quiet(ctx: &egui::Context) -> Color32 {
    if is_dark(ctx) { Color32::from_gray(178) } else { Color32::from_gray(70) }
}

/// How much of the window's left the numbers take, with a gap beside them, where `right` points are taken on the right.
pub(crate) fn overlay_taken(ctx: &egui::Context, right: f32) -> f32 {
    let width = if has_room_for_numbers(ctx, right) { OVERLAY_WIDTH } else { BADGE_WIDTH };
    width + OVERLAY_GAPS
}

/// Whether there is room for more than the badge.
pub(crate) fn has_room_for_numbers(ctx: &egui::Context, right: f32) -> bool {
    OVERLAY_WIDTH + OVERLAY_GAPS + right <= ctx.content_rect().width()
}

/// The numbers, at the top left; in a narrow window the badge alone. `title` is the volume's name, `right` what is taken on the
/// right.
pub(crate) fn overlay(ctx: &egui::Context, title: &str, model: &OverlayModel, right: f32) {
    let has_numbers = has_room_for_numbers(ctx, right);
    egui::Area::new(egui::Id::unique("overlay"))
        .anchor(Align2::LEFT_TOP, vec2(10.0, 10.0))
        .interactable(true)
        .show(ctx, |ui| {
            pane(ctx).show(ui, |ui| {
                // A fixed width: changing digits must not make the pane tremble.
                ui.set_width(if has_numbers { OVERLAY_WIDTH } else { BADGE_WIDTH });
                ui.spacing_mut().item_spacing = vec2(6.0, 2.0);
                ui.spacing_mut().interact_size.y = 0.0;
                if has_numbers && !title.is_empty() {
                    ui.add(egui::Label::new(RichText::new(title).color(bright(ctx)).size(12.0)).truncate());
                }
                badge(ui, model.standing);
                if !has_numbers {
                    return;
                }
                ui.add_space(3.0);
                for (name, value) in model.rows() {
                    row(ui, name, &value);
                }
            });
        });
}

fn badge(ui: &mut Ui, standing: Standing) {
    let is_dark = ui.visuals().dark_mode;
    let color = match standing {
        Standing::Exact | Standing::Settled if is_dark => Color32::from_rgb(110, 205, 130),
        Standing::Exact | Standing::Settled => Color32::from_rgb(20, 120, 45),
        Standing::Moving if is_dark => Color32::from_rgb(120, 175, 240),
        Standing::Moving => Color32::from_rgb(20, 85, 175),
        Standing::Refining | Standing::Offline if is_dark => Color32::from_rgb(235, 190, 95),
        Standing::Refining | Standing::Offline => Color32::from_rgb(150, 90, 0),
        Standing::Waiting => quiet(ui.ctx()),
    };
    let line = ui.horizontal(|ui| {
        let (dot, _) = ui.allocate_exact_size(vec2(9.0, 14.0), egui::Sense::hover());
        ui.painter().circle_filled(dot.center(), 4.0, color);
        ui.label(RichText::new(standing.word()).color(color).strong().size(13.0));
    });
    line.response.on_hover_text(standing.explanation());
}

fn row(ui: &mut Ui, name: &str, value: &str) {
    ui.horizontal(|ui| {
        ui.label(RichText::new(name).color(quiet(ui.ctx())).size(11.5));
        ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
            ui.label(RichText::new(value).color(bright(ui.ctx())).size(11.5));
        });
    });
}

/// Gives a widget its name for screen readers and tests.
pub(crate) fn named(response: &egui::Response, role: egui::Role, name: &str) {
    response.widget_info(|| egui::WidgetInfo::labeled(role, true, name));
}

/// One line at the bottom while something is wrong with the connection, or something was said.
pub(crate) fn banner(ctx: &egui::Context, text: &str, taken: Taken) {
    let area = egui::Area::new(egui::Id::unique("banner"));
    let area = area.anchor(Align2::CENTER_BOTTOM, vec2(taken.shift(), -12.0 - taken.edge));
    area.interactable(false).show(ctx, |ui| {
        pane(ctx).fill(Color32::from_rgba_unmultiplied(62, 48, 20, 235)).show(ui, |ui| {
            ui.set_max_width((taken.width(ctx) - 40.0).max(100.0));
            ui.label(RichText::new(text).color(Color32::from_rgb(245, 220, 165)).size(13.0));
        });
    });
}

/// One line at the top, while the picture is made with an older look than was asked for.
pub(crate) fn older_look(ctx: &egui::Context, is_of_volume: bool, state: &State, taken: Taken) {
    let area = egui::Area::new(egui::Id::unique("older look"));
    let area = area.anchor(Align2::CENTER_TOP, vec2(taken.shift(), 12.0 + taken.edge));
    area.interactable(false).show(ctx, |ui| {
        pane(ctx).show(ui, |ui| {
            ui.set_max_width((taken.width(ctx) - 40.0).max(60.0));
            let what = if is_of_volume { "shown with the look before" } else { "the volume before" };
            let coming = match state {
                State::Connected => "the new one is on its way",
                State::Connecting { .. } | State::Reconnecting { .. } => {
                    "the new one waits until connected again"
                }
                State::Refused(_) => "there is no connection for the new one",
            };
            ui.label(RichText::new(format!("{what}; {coming}")).size(12.0));
        });
    });
}

/// The keys and buttons, in the middle: side by side where one column is too high and there is room.
pub(crate) fn help(ctx: &egui::Context, bindings: &Bindings, open: &mut bool) {
    egui::Window::new(RichText::new("Keys and mouse").size(14.0))
        .id(egui::Id::unique("help"))
        .open(open)
        .anchor(Align2::CENTER_CENTER, vec2(0.0, 0.0))
        .auto_sized()
        .collapsible(false)
        .show(ctx, |ui| {
            let screen = ctx.content_rect().size();
            let height = (screen.y - 100.0).max(100.0);
            let lines = bindings.lines();
            let row_height = ui.text_style_height(&egui::TextStyle::Body) + HELP_GAPS.y;
            let is_high = lines.len() as f32 * row_height > height;
            let num_columns = if is_high && screen.x >= LEAST_WIDTH_OF_TWO { 2 } else { 1 };
            let room = (screen.x - 60.0).max(120.0) / num_columns as f32 - 2.0 * HELP_GAPS.x;
            let columns = lines.chunks(lines.len().div_ceil(num_columns));
            let columns: Vec<_> = columns.map(|lines| KeyColumn::of(ui, lines, room)).collect();
            if columns.iter().all(|column| column.height() <= height) {
                key_columns(ui, &columns, -HELP_GAPS.x);
            } else {
                let scroll = egui::ScrollArea::vertical().max_height(height).min_scrolled_height(height);
                // The bar lies over what is at the right.
                scroll.show(ui, |ui| key_columns(ui, &columns, 0.0));
            }
        });
}

/// Keys and what they do. Sizes are known before anything is drawn: a table that finds its own is cut off at first.
struct KeyColumn<'a> {
    lines: &'a [(String, &'static str)],
    /// Of the keys and of what they do, with a gap beside each.
    widths: [f32; 2],
    /// Of each line, with a gap below it.
    heights: Vec<f32>,
}

impl<'a> KeyColumn<'a> {
    /// Lines whose texts take up to `room` points across, and are broken where they need more.
    fn of(ui: &Ui, lines: &'a [(String, &'static str)], room: f32) -> Self {
        let font = egui::TextStyle::Body.resolve(ui.style());
        let size = |text: &str, width: f32| {
            ui.painter().layout(text.to_owned(), font.clone(), Color32::WHITE, width).size().ceil()
        };
        let widest = |texts: &mut dyn Iterator<Item = &str>| {
            texts.map(|text| size(text, f32::INFINITY).x + 1.0).fold(0.0, f32::max)
        };
        let keys = widest(&mut lines.iter().map(|(keys, _)| &keys[..])).min(0.5 * room);
        let text = widest(&mut lines.iter().map(|(_, text)| *text)).min(room - keys);
        let height = |(of_keys, of_text): &(String, &str)| size(of_keys, keys).y.max(size(of_text, text).y);
        let heights = lines.iter().map(|line| height(line) + HELP_GAPS.y).collect();
        Self { lines, widths: [keys + HELP_GAPS.x, text + HELP_GAPS.x], heights }
    }

    fn height(&self) -> f32 {
        self.heights.iter().sum()
    }
}

/// Columns side by side, with so much more at their right.
fn key_columns(ui: &mut Ui, columns: &[KeyColumn<'_>], more: f32) {
    let width = columns.iter().flat_map(|column| column.widths).sum::<f32>() + more;
    let height = columns.iter().map(KeyColumn::height).fold(0.0, f32::max);
    let (rect, _) = ui.allocate_exact_size(vec2(width, height), egui::Sense::hover());
    let (bright, quiet) = (bright(ui.ctx()), quiet(ui.ctx()));
    let mut left = rect.left();
    for KeyColumn { lines, widths: [keys_width, text_width], heights } in columns {
        let mut top = rect.top();
        for ((keys, text), height) in lines.iter().zip(heights) {
            for (x, width, text) in [
                (left, keys_width, RichText::new(keys).color(bright).strong()),
                (left + keys_width, text_width, RichText::new(*text).color(quiet)),
            ] {
                let size = vec2(width - HELP_GAPS.x, *height);
                let cell = egui::Rect::from_min_size(egui::pos2(x, top), size);
                let cell = egui::UiBuilder::new().max_rect(cell);
                ui.scope_builder(cell, |ui| ui.add(egui::Label::new(text).wrap()));
            }
            top += height;
        }
        left += keys_width + text_width;
    }
}

/// The page before the first picture.
pub(crate) fn first_page(ui: &mut Ui, server: &str, state: &State, seconds: f64, help: &str) {
    let rect = ui.max_rect();
    let painter = ui.painter();
    painter.rect_filled(rect, 0.0, PAGE);
    let center = rect.center();
    // The emblem: sheets of mica, one behind the other.
    for i in 0..4u8 {
        let shift = f32::from(i) * 9.0 - 13.5;
        let sheet = egui::Rect::from_center_size(center + vec2(shift, -86.0 - shift * 0.6), vec2(54.0, 40.0));
        painter.rect_filled(sheet, 4.0, Color32::from_rgba_unmultiplied(150, 190, 225, 38));
        painter.rect_stroke(
            sheet,
            4.0,
            Stroke::new(1.0, Color32::from_rgba_unmultiplied(190, 215, 240, 80)),
            egui::StrokeKind::Inside,
        );
    }
    let text = |y: f32, s: &str, size: f32, color: Color32| {
        let wrapped =
            painter.layout(s.to_owned(), egui::FontId::proportional(size), color, rect.width() - 80.0);
        painter.galley(center + vec2(-wrapped.size().x * 0.5, y), wrapped, color);
    };
    text(-36.0, "isinglass", 30.0, Color32::from_gray(225));
    let dots = &"..."[..1 + (seconds * 2.0) as usize % 3];
    let (line, problem) = match state {
        State::Connecting { problem, .. } => (format!("connecting to {server} {dots}"), problem.as_ref()),
        State::Connected => (format!("connected to {server}, waiting for the first frame {dots}"), None),
        State::Reconnecting { problem, .. } => {
            (format!("connecting to {server} again {dots}"), Some(problem))
        }
        State::Refused(problem) => (format!("not connected to {server}"), Some(problem)),
    };
    text(10.0, &line, 15.0, Color32::from_gray(190));
    if let Some(problem) = problem {
        text(38.0, &sentence(problem), 13.0, Color32::from_rgb(235, 195, 120));
    }
    if !help.is_empty() {
        text(96.0, &format!("{help} shows the keys"), 12.0, Color32::from_gray(150));
    }
}

/// The picture, to which the keyboard goes by Tab: a name for it, and a frame as long as it is there.
pub(crate) fn picture(ui: &Ui, rect: egui::Rect, name: &str) {
    let response = ui.interact(rect, picture_id(), egui::Sense::focusable_noninteractive());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, name));
    if response.has_focus() {
        // Arrows are the camera's, and do not go on to another control.
        let filter =
            egui::EventFilter { horizontal_arrows: true, vertical_arrows: true, ..Default::default() };
        ui.memory_mut(|m| m.set_focus_lock_filter(response.id, filter));
        let stroke = Stroke::new(2.0, ui.visuals().selection.stroke.color);
        ui.painter().rect_stroke(rect, 0.0, stroke, egui::StrokeKind::Inside);
    }
}

/// Gives the window its name for screen readers.
pub(crate) fn name_window(ctx: &egui::Context, name: &str) {
    ctx.accesskit_node_builder(egui::accesskit_root_id(), |node| node.set_label(name));
}

/// Something painted that is there to be looked at: a name for those who do not.
pub(crate) fn image(ui: &Ui, rect: egui::Rect, id: &str, name: &str) {
    let response = ui.interact(rect, egui::Id::unique(id), egui::Sense::hover());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, name));
}

/// Of the picture, as a control.
pub(crate) fn picture_id() -> egui::Id {
    egui::Id::unique("picture")
}

/// Name and size of a volume in one line.
pub(crate) fn title_of(volume: &VolumeDescription) -> String {
    let [x, y, z] = volume.dims;
    format!("{}  {x}×{y}×{z}", volume.name)
}

/// Behind the page before the first picture.
const PAGE: Color32 = Color32::from_rgb(23, 27, 33);
const OVERLAY_WIDTH: f32 = 190.0;
/// For the badge's longest word.
const BADGE_WIDTH: f32 = 66.0;
/// Around the numbers and in their pane.
const OVERLAY_GAPS: f32 = 42.0;
const HELP_GAPS: egui::Vec2 = vec2(24.0, 4.0);
/// Of a window, for two columns of keys.
const LEAST_WIDTH_OF_TWO: f32 = 1240.0;
