//! What lies over the picture: numbers, banner, help, the look, and the page before the first frame.

use egui::{Align2, Color32, Frame, Margin, RichText, Stroke, Ui, vec2};
use isinglass_core::kernels::layering::Layering;
use isinglass_core::layer::MAX_K;
use isinglass_core::look::Look;
use isinglass_core::wire::VolumeDescription;
use isinglass_net::State;

use crate::overlay::{BINDINGS, OverlayModel, sentence};
use crate::stereo::{MAX_EYE_ANGLE_DEGREES, Stereo, StereoMode};
use crate::viewing::{FrameSize, Standing};

/// A dark pane that text can be read on over any picture.
fn pane() -> Frame {
    Frame::new()
        .fill(Color32::from_black_alpha(170))
        .stroke(Stroke::new(1.0, Color32::from_white_alpha(22)))
        .corner_radius(6.0)
        .inner_margin(Margin::symmetric(10, 8))
}

/// The numbers, at the top left. `title` is the volume's name.
pub(crate) fn overlay(ctx: &egui::Context, title: &str, model: &OverlayModel) {
    egui::Area::new(egui::Id::unique("overlay"))
        .anchor(Align2::LEFT_TOP, vec2(10.0, 10.0))
        .interactable(true)
        .show(ctx, |ui| {
            pane().show(ui, |ui| {
                // A fixed width: changing digits must not make the pane tremble.
                ui.set_width(OVERLAY_WIDTH);
                ui.spacing_mut().item_spacing = vec2(6.0, 2.0);
                ui.spacing_mut().interact_size.y = 0.0;
                if !title.is_empty() {
                    ui.add(egui::Label::new(RichText::new(title).color(BRIGHT).size(12.0)).truncate());
                }
                badge(ui, model.standing);
                ui.add_space(3.0);
                for (name, value) in model.rows() {
                    row(ui, name, &value);
                }
            });
        });
}

fn badge(ui: &mut Ui, standing: Standing) {
    let color = match standing {
        Standing::Exact | Standing::Settled => Color32::from_rgb(110, 205, 130),
        Standing::Moving => Color32::from_rgb(120, 175, 240),
        Standing::Refining => Color32::from_rgb(235, 190, 95),
        Standing::Waiting => Color32::from_gray(150),
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
        ui.label(RichText::new(name).color(QUIET).size(11.5));
        ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
            ui.label(RichText::new(value).color(BRIGHT).size(11.5));
        });
    });
}

/// One line at the bottom, clear of the other panes, while something is wrong with the connection.
pub(crate) fn banner(ctx: &egui::Context, text: &str) {
    let area = egui::Area::new(egui::Id::unique("banner")).anchor(Align2::CENTER_BOTTOM, vec2(0.0, -12.0));
    area.interactable(false).show(ctx, |ui| {
        pane().fill(Color32::from_rgba_unmultiplied(62, 48, 20, 235)).show(ui, |ui| {
            ui.set_max_width((ctx.content_rect().width() - 60.0).max(200.0));
            ui.label(RichText::new(text).color(Color32::from_rgb(245, 220, 165)).size(13.0));
        });
    });
}

/// The keys and buttons, in the middle.
pub(crate) fn help(ctx: &egui::Context, open: &mut bool) {
    egui::Window::new(RichText::new("Keys and mouse").size(14.0))
        .open(open)
        .anchor(Align2::CENTER_CENTER, vec2(0.0, 0.0))
        .resizable(false)
        .collapsible(false)
        .show(ctx, |ui| {
            egui::Grid::new("bindings").num_columns(2).spacing([28.0, 5.0]).show(ui, |ui| {
                for (keys, action) in BINDINGS {
                    ui.label(RichText::new(keys).color(BRIGHT));
                    ui.label(action);
                    ui.end_row();
                }
            });
        });
}

/// What the look panel asked for.
#[derive(Default)]
pub(crate) struct LookChoice {
    /// Another look.
    pub(crate) look: Option<Look>,
    /// Another size of the frames.
    pub(crate) scale: Option<f32>,
    /// Another method, by its number.
    pub(crate) method: Option<usize>,
    /// Another picture for two eyes.
    pub(crate) stereo: Option<Stereo>,
}

/// Transfer function, shading, layering, frame size, stereo and, if there are several, the method of making pictures, at
/// the top right; folded at first.
pub(crate) fn look_panel(
    ctx: &egui::Context,
    look: &Look,
    frame_size: &FrameSize,
    (methods, method): (&[&str], usize),
    stereo: Stereo,
) -> LookChoice {
    let mut choice = LookChoice::default();
    let mut changed = look.clone();
    let open_id = egui::Id::unique("look is open");
    let is_open = ctx.data(|d| d.get_temp(open_id).unwrap_or(false));
    // Two areas: one would keep the width of the unfolded panel.
    let area_id = egui::Id::unique(if is_open { "look" } else { "look, folded" });
    let area = egui::Area::new(area_id).anchor(Align2::RIGHT_TOP, vec2(-10.0, 10.0));
    let in_pane = |ui: &mut Ui| {
        let title = egui::Button::new(RichText::new("Look").color(BRIGHT).size(12.0)).frame(false);
        let hint = if is_open { "click to fold" } else { "transfer function, shading, layers, stereo" };
        if ui.add(title).on_hover_text(hint).clicked() {
            ctx.data_mut(|d| d.insert_temp(open_id, !is_open));
        }
        if is_open {
            egui::Grid::new("look").num_columns(2).spacing([14.0, 6.0]).show(ui, |ui| {
                ui.label("transfer function");
                egui::ComboBox::from_id_salt("transfer").selected_text(&look.transfer.name).show_ui(
                    ui,
                    |ui| {
                        for name in isinglass_formats::preset_names() {
                            let is_selected = look.transfer.name == name;
                            if ui.selectable_label(is_selected, name).clicked()
                                && let Some(transfer) = isinglass_formats::preset(name)
                            {
                                changed.transfer = transfer;
                            }
                        }
                    },
                );
                ui.end_row();
                ui.label("shading");
                ui.checkbox(&mut changed.shaded, "");
                ui.end_row();
                ui.label("layering");
                egui::ComboBox::from_id_salt("layering").selected_text(look.layering.name()).show_ui(
                    ui,
                    |ui| {
                        for layering in Layering::ALL {
                            ui.selectable_value(&mut changed.layering, layering, layering.name());
                        }
                    },
                );
                ui.end_row();
                ui.label("segments a ray").on_hover_text("K: more is truer after a turn, and more to send");
                ui.add(egui::Slider::new(&mut changed.k, 1..=MAX_K as u8));
                ui.end_row();
                if methods.len() > 1 {
                    ui.label("picture by").on_hover_text("how the server's frames become pictures here");
                    egui::ComboBox::from_id_salt("method").selected_text(methods[method]).show_ui(ui, |ui| {
                        for (number, name) in methods.iter().enumerate() {
                            if ui.selectable_label(number == method, *name).clicked() {
                                choice.method = Some(number);
                            }
                        }
                    });
                    ui.end_row();
                }
                ui.label("frame size").on_hover_text("of the server's frames, in units of the window's");
                let mut percent = (frame_size.scale * 100.0).round();
                if ui.add(egui::Slider::new(&mut percent, 25.0..=100.0).step_by(5.0).suffix(" %")).changed() {
                    choice.scale = Some(percent / 100.0);
                }
                ui.end_row();
                // Only the ray cast has two eyes.
                if method == 0 {
                    choice.stereo = stereo_rows(ui, stereo);
                }
            });
        }
    };
    area.show(ctx, |ui| pane().show(ui, in_pane));
    choice.look = (changed != *look).then_some(changed);
    choice
}

/// Mode and eye distance; what was chosen, if anything.
fn stereo_rows(ui: &mut Ui, stereo: Stereo) -> Option<Stereo> {
    let mut changed = stereo;
    ui.label("stereo").on_hover_text("two eyes, side by side or for red-cyan glasses");
    egui::ComboBox::from_id_salt("stereo").selected_text(stereo.mode.name()).show_ui(ui, |ui| {
        for mode in StereoMode::ALL {
            ui.selectable_value(&mut changed.mode, mode, mode.name());
        }
    });
    ui.end_row();
    ui.label("eye distance").on_hover_text("as an angle, seen from the volume's centre");
    let slider = egui::Slider::new(&mut changed.eye_angle_degrees, 0.0..=MAX_EYE_ANGLE_DEGREES);
    ui.add_enabled(!stereo.is_mono(), slider.step_by(0.1).fixed_decimals(1).suffix("°"));
    ui.end_row();
    (changed != stereo).then_some(changed)
}

/// The page before the first picture.
pub(crate) fn first_page(ui: &mut Ui, server: &str, state: &State, seconds: f64) {
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
    text(96.0, "h shows the keys", 12.0, Color32::from_gray(120));
}

/// Name and size of a volume in one line.
pub(crate) fn title_of(volume: &VolumeDescription) -> String {
    let [x, y, z] = volume.dims;
    format!("{}  {x}×{y}×{z}", volume.name)
}

/// Behind the page before the first picture.
const PAGE: Color32 = Color32::from_rgb(23, 27, 33);
const BRIGHT: Color32 = Color32::from_gray(232);
const QUIET: Color32 = Color32::from_gray(160);
const OVERLAY_WIDTH: f32 = 172.0;
