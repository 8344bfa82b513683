//! One pane: a slice with the shared point, the ends of its axes, and what pointer and keys do in it.

use std::sync::Arc;

use egui::{
    Align2, Color32, Event, Key, Mesh, PointerButton, Pos2, Rect, Role, Sense, Stroke, Ui, pos2, vec2,
};
use glam::Vec3;
use isinglass_core::volume::{Slice, SliceGrid};
use lucide_icons::Icon;

use super::on_screen;
use super::texture::SliceTexture;
use crate::input::bindings::Side;
use crate::input::orientation::Orientation;
use crate::input::pointer::notches_of;
use crate::paint::measure::Canvas;
use crate::paint::view_aids::{Pen, ViewAids};
use crate::panels::style::{icon, named};
use crate::panels::value_scale::ValueScale;
use crate::view::planes::{PlaneChoice, Slab, Stack};

/// One pane.
#[derive(Default)]
pub(crate) struct Pane {
    choice: Option<PlaneChoice>,
    /// The direction in which it was paged last; 0 before.
    direction: i32,
    /// The last slice that was there, with its grid.
    shown: Option<(Arc<Slice>, SliceGrid, Stack)>,
    texture: SliceTexture,
    /// Parts of a notch of the wheel.
    wheel: f32,
    /// How it lay on the screen when it was shown last.
    view: Option<PaneView>,
    /// The button that drags level and window, and where the pointer was last.
    window_from: Option<(PointerButton, Pos2)>,
}

/// What a pane is shown with.
pub(crate) struct PaneScene<'a> {
    pub(crate) rect: Rect,
    pub(crate) orientation: &'a Orientation,
    pub(crate) scale: &'a ValueScale,
    /// The slice at the point, once it is there.
    pub(crate) slice: Option<Arc<Slice>>,
    /// The present view, for an oblique plane.
    pub(crate) world_from_view: glam::Quat,
    /// Whether keys that no pane has page this one.
    pub(crate) has_keys: bool,
    /// Whether a dialog lies over the panes, and has the keys.
    pub(crate) has_dialog: bool,
    pub(crate) reverses_wheel: bool,
    /// Whether clicks set points of measurements.
    pub(crate) is_measuring: bool,
    /// Whether drags move a point of a measurement.
    pub(crate) drags_measure: bool,
}

/// What a person does in a pane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PaneInput {
    /// Whether it is under the pointer, or has the keyboard.
    pub(super) is_active: bool,
    pub(super) point: Option<Vec3>,
    pub(super) pages: i32,
    /// A drag of level and window, points.
    pub(super) window: Option<[f32; 2]>,
    pub(super) is_double: bool,
    pub(super) choice: Option<PlaneChoice>,
}

/// What lies under the pointer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pointed {
    pub(crate) point: Vec3,
    pub(crate) value: f32,
}

/// Where a stack lies on the screen. The middle of the volume is in the middle of the pane.
#[derive(Clone, Copy, Debug)]
struct Place {
    middle: Pos2,
    /// Points a world unit.
    scale: f32,
}

impl Place {
    fn new(rect: Rect, stack: &Stack) -> Self {
        let half = stack.half_size();
        let room = rect.shrink(MARGIN).size().max(vec2(1.0, 1.0));
        let scale = (room.x / (2.0 * half.x)).min(room.y / (2.0 * half.y));
        Self { middle: rect.center(), scale }
    }

    fn screen(&self, stack: &Stack, point: Vec3) -> Pos2 {
        self.middle + on_screen(stack, self.scale, point)
    }

    /// The point of the plane through `point` that is seen at a place of the screen.
    fn world(&self, stack: &Stack, point: Vec3, at: Pos2) -> Vec3 {
        let from = (at - self.middle) / self.scale;
        stack.right * from.x + stack.down * from.y + stack.towards * point.dot(stack.towards)
    }
}

/// A slice on the screen, for what is drawn over it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PaneView {
    pub(crate) rect: Rect,
    place: Place,
    stack: Stack,
    /// A point of the middle of the slice.
    middle: Vec3,
    /// Half of the thickness that is shown, world units.
    half: f32,
}

impl PaneView {
    fn new(rect: Rect, stack: &Stack, point: Vec3, slab: Slab) -> Self {
        let middle = stack.moved(point, stack.index_of(point));
        let half = 0.5 * slab.thickness.max(stack.step());
        Self { rect, place: Place::new(rect, stack), stack: *stack, middle, half }
    }

    /// The point of the volume that is seen at a place of the screen.
    pub(crate) fn pick(&self, at: Pos2) -> Option<Vec3> {
        self.stack.inside(self.place.world(&self.stack, self.middle, at))
    }

    /// Whether a place of the screen shows the slice, and no control.
    pub(crate) fn is_free(&self, at: Pos2) -> bool {
        self.rect.contains(at) && !menu_corner(self.rect).contains(at)
    }
}

impl Canvas for PaneView {
    fn ends(&self, a: Vec3, b: Vec3) -> Option<[Pos2; 2]> {
        Some([a, b].map(|point| self.place.screen(&self.stack, point)))
    }

    fn holds(&self, point: Vec3) -> bool {
        (point - self.middle).dot(self.stack.towards).abs() <= self.half * 1.001
    }
}

impl Pane {
    pub(super) fn view(&self) -> Option<PaneView> {
        self.view
    }

    pub(super) fn choice(&self, number: usize) -> PlaneChoice {
        self.choice.unwrap_or(PlaneChoice::FIRST[number])
    }

    pub(super) fn choose(&mut self, choice: PlaneChoice) {
        self.choice = Some(choice);
    }

    /// The picture of the slice that is shown, and where it lies.
    pub(super) fn picture(&self) -> Option<(egui::TextureId, SliceGrid)> {
        let (_, grid, _) = self.shown.as_ref()?;
        self.texture.placed(grid)
    }

    pub(super) fn direction(&self) -> i32 {
        if self.direction < 0 { -1 } else { 1 }
    }

    /// The pane is on the screen no more.
    pub(super) fn hide(&mut self) {
        (self.view, self.window_from) = (None, None);
    }

    pub(super) fn end_drag(&mut self) {
        self.window_from = None;
    }

    pub(super) fn note_direction(&mut self, by: i32) {
        self.direction = by.signum();
    }

    pub(super) fn show(
        &mut self,
        ui: &mut Ui,
        number: usize,
        stacks: &[Stack; 3],
        scene: &PaneScene<'_>,
        (point, slab, window): (Vec3, Slab, (f32, f32)),
    ) -> PaneInput {
        let (rect, stack) = (scene.rect, &stacks[number]);
        let ui = &mut ui.new_child(egui::UiBuilder::new().max_rect(rect));
        ui.set_clip_rect(rect);
        ui.painter().rect_filled(rect, 0.0, Color32::BLACK);
        let index = stack.index_of(point);
        if let (Some(slice), Some(spec)) = (&scene.slice, stack.spec(index, slab)) {
            let (dims, spacing) = stack.voxels();
            self.shown = Some((slice.clone(), spec.grid(dims, spacing), *stack));
        }
        self.shown.take_if(|(_, _, of)| &*of != stack);
        let view = PaneView::new(rect, stack, point, slab);
        let place = view.place;
        self.view = Some(view);
        if let Some((slice, grid, _)) = &self.shown {
            // More pixels than the screen has are not worth their time.
            let step =
                grid.column.length().max(grid.row.length()) * place.scale * ui.ctx().pixels_per_point();
            let stride = (1.0 / step).clamp(1.0, slice.size.into_iter().max().unwrap_or(1) as f32) as usize;
            let (name, of) = (format!("slice {number}"), (slice, grid));
            if let Some((texture, grid)) = self.texture.of(ui.ctx(), &name, of, (window, stride)) {
                ui.painter().add(mesh(texture, &place, stack, &grid));
            }
        }
        let (first, count) = (*stack.range().start(), stack.range().count());
        let name = self.choice(number).name(scene.orientation);
        let told = format!("slice {} of {count}", index - first + 1);
        let input = self.take_input(ui, number, &place, stack, point, scene, &format!("{name}, {told}"));
        let at = input.point.unwrap_or(point);
        draw_lines(ui, number, &place, stacks, at, rect);
        draw_letters(ui, stack, scene.orientation, rect);
        let is_late = scene.slice.is_none();
        let told = if is_late { format!("{told} …") } else { told };
        write(ui.painter(), rect.right_top() + vec2(-8.0, 8.0), Align2::RIGHT_TOP, &told);
        let choice = self.show_menu(ui, number, scene, name);
        PaneInput { choice, ..input }
    }

    #[expect(clippy::too_many_arguments, reason = "everything that an event may mean")]
    fn take_input(
        &mut self,
        ui: &Ui,
        number: usize,
        place: &Place,
        stack: &Stack,
        point: Vec3,
        scene: &PaneScene<'_>,
        name: &str,
    ) -> PaneInput {
        let mut input = PaneInput::default();
        let id = egui::Id::unique("slice pane").with(number);
        let response = ui.interact(scene.rect, id, Sense::click_and_drag());
        named(&response, Role::Image, name);
        let is_over = response.contains_pointer();
        let is_down =
            |button| response.is_pointer_button_down_on() && ui.input(|i| i.pointer.button_down(button));
        let at = response.interact_pointer_pos();
        let moves_point = match scene.is_measuring {
            true => response.dragged_by(PointerButton::Primary) && !scene.drags_measure,
            false => is_down(PointerButton::Primary) || response.clicked(),
        };
        let events = ui.input(|i| i.events.clone());
        input.window = self.window_drag(&events, |at| is_over && scene.rect.contains(at));
        if self.window_from.is_some() || input.window.is_some() {
            // The point stays.
        } else if let Some(at) = at.filter(|_| moves_point) {
            let found = stack.nearest(place.world(stack, point, at));
            input.point = (found != point).then_some(found);
        }
        if is_down(PointerButton::Primary) || is_down(PointerButton::Secondary) {
            response.request_focus();
        }
        input.is_double = response.double_clicked() && !scene.is_measuring;
        if is_over {
            for event in &events {
                if let Event::MouseWheel { unit, delta, modifiers, .. } = event
                    && !modifiers.command
                {
                    let notches = notches_of(*unit, delta.y);
                    self.wheel += if scene.reverses_wheel { -notches } else { notches };
                }
            }
            input.pages += self.wheel.trunc() as i32;
            self.wheel = self.wheel.fract();
        }
        // With a modifier, a key means something else.
        let pressed = |key: Key| {
            let is_press = |event: &&Event| {
                matches!(event, Event::Key { key: of, pressed: true, modifiers, .. }
                if *of == key && modifiers.is_none())
            };
            if scene.has_dialog { 0 } else { events.iter().filter(is_press).count() as i32 }
        };
        if response.has_focus() {
            let filter =
                egui::EventFilter { horizontal_arrows: true, vertical_arrows: true, ..Default::default() };
            ui.memory_mut(|m| m.set_focus_lock_filter(id, filter));
            let stroke = Stroke::new(2.0, ui.visuals().selection.stroke.color);
            ui.painter().rect_stroke(scene.rect, 0.0, stroke, egui::StrokeKind::Inside);
            input.pages += pressed(Key::ArrowUp) + pressed(Key::ArrowRight);
            input.pages -= pressed(Key::ArrowDown) + pressed(Key::ArrowLeft);
        }
        let no_pane_has_focus = ui
            .memory(|m| m.focused())
            .is_none_or(|focused| (0..3).all(|pane| focused != egui::Id::unique("slice pane").with(pane)));
        let has_keys = response.has_focus() || (no_pane_has_focus && scene.has_keys);
        if has_keys && !ui.ctx().text_edit_focused() {
            input.pages += pressed(Key::PageUp) - pressed(Key::PageDown);
        }
        input.is_active = is_over || response.gained_focus();
        input
    }

    /// How far the pointer is dragged with the right button, or with shift; points. This reads the events, so a drag
    /// counts that begins and ends between two slow refreshes.
    fn window_drag(&mut self, events: &[Event], begins_at: impl Fn(Pos2) -> bool) -> Option<[f32; 2]> {
        let mut moved = egui::Vec2::ZERO;
        for event in events {
            let from = self.window_from;
            match event {
                Event::PointerMoved(to) => {
                    if let Some((button, from)) = from {
                        moved += *to - from;
                        self.window_from = Some((button, *to));
                    }
                }
                Event::PointerButton { pos, button, pressed: true, modifiers } if from.is_none() => {
                    let is_own = *button == PointerButton::Secondary
                        || (*button == PointerButton::Primary && modifiers.shift);
                    self.window_from = (is_own && begins_at(*pos)).then_some((*button, *pos));
                }
                Event::PointerButton { button, pressed: false, .. } => {
                    self.window_from.take_if(|(held, _)| held == button);
                }
                Event::WindowFocused(false) => self.window_from = None,
                _ => {}
            }
        }
        (moved != egui::Vec2::ZERO).then_some([moved.x, moved.y])
    }

    /// The name of the plane, and the others behind it.
    fn show_menu(
        &self,
        ui: &mut Ui,
        number: usize,
        scene: &PaneScene<'_>,
        name: &str,
    ) -> Option<PlaneChoice> {
        let mut choice = None;
        let corner = egui::UiBuilder::new().max_rect(menu_corner(scene.rect));
        let ui = &mut ui.new_child(corner.id_salt(("plane", number)));
        let text = egui::RichText::new(name).color(COLORS[number]).strong();
        let planes = [PlaneChoice::Standard(Side::Top), PlaneChoice::Standard(Side::Front)];
        let planes = planes.into_iter().chain([PlaneChoice::Standard(Side::Right)]);
        let button = ui.menu_button((text, icon(Icon::ChevronDown).size(12.0)), |ui| {
            for plane in planes {
                let is_chosen = self.choice(number) == plane;
                if ui.selectable_label(is_chosen, plane.name(scene.orientation)).clicked() {
                    choice = Some(plane);
                    ui.close();
                }
            }
            let is_oblique = matches!(self.choice(number), PlaneChoice::Oblique(_));
            let hint = "across the present view of the volume, through the point of the cross";
            if ui.selectable_label(is_oblique, "oblique: across the view").on_hover_text(hint).clicked() {
                choice = Some(PlaneChoice::Oblique(scene.world_from_view));
                ui.close();
            }
        });
        named(&button.response, Role::Button, &format!("plane: {name}"));
        choice
    }
}

/// The point and the value under the pointer.
pub(super) fn pointed(
    pane: &Pane,
    stacks: &[Stack; 3],
    number: usize,
    rect: Rect,
    ui: &Ui,
) -> Option<Pointed> {
    let id = egui::Id::unique("slice pane").with(number);
    let is_over = ui.ctx().read_response(id).is_some_and(|response| response.contains_pointer());
    let at = ui.ctx().pointer_latest_pos().filter(|at| is_over && rect.contains(*at))?;
    let (slice, grid, _) = pane.shown.as_ref()?;
    let stack = &stacks[number];
    let point = Place::new(rect, stack).world(stack, grid.origin, at);
    let [column, row] = grid.place(point);
    let inside =
        |x: f32, size: u32| (-0.5..size as f32 - 0.5).contains(&x).then(|| x.round().max(0.0) as u32);
    let (column, row) = (inside(column, slice.size[0])?, inside(row, slice.size[1])?);
    stack.inside(point).map(|point| Pointed { point, value: slice.value(column, row) })
}

/// Where the name of the plane is.
fn menu_corner(pane: Rect) -> Rect {
    Rect::from_min_size(pane.min + vec2(6.0, 4.0), vec2(110.0, 22.0))
}

/// Draws over slices, which lie on black.
pub(crate) fn pen(painter: &egui::Painter) -> Pen<'_> {
    ViewAids::default().pen(painter)
}

/// What the volume leaves of the plane, covered by the texture of the slice.
fn mesh(texture: egui::TextureId, place: &Place, stack: &Stack, grid: &SliceGrid) -> Mesh {
    let mut mesh = Mesh::with_texture(texture);
    let corners = stack.outline(grid.origin);
    for corner in &corners {
        let [column, row] = grid.place(*corner);
        let uv = pos2((column + 0.5) / grid.size[0] as f32, (row + 0.5) / grid.size[1] as f32);
        let pos = place.screen(stack, *corner);
        mesh.vertices.push(egui::epaint::Vertex { pos, uv, color: Color32::WHITE });
    }
    for i in 2..corners.len() as u32 {
        mesh.add_triangle(0, i - 1, i);
    }
    mesh
}

/// The lines in which the planes of the other panes meet this one.
fn draw_lines(ui: &Ui, number: usize, place: &Place, stacks: &[Stack; 3], point: Vec3, rect: Rect) {
    let stack = &stacks[number];
    let at = place.screen(stack, point);
    for other in (0..3).filter(|other| *other != number) {
        let along = stacks[other].towards.cross(stack.towards);
        let flat = on_screen(stack, 1.0, along);
        if flat.length() < 1e-3 {
            continue;
        }
        let way = flat.normalized();
        let reach = rect.width() + rect.height();
        let stroke = Stroke::new(1.0, COLORS[other].gamma_multiply(0.85));
        for side in [-1.0, 1.0] {
            ui.painter().line_segment([at + way * (side * CROSS_GAP), at + way * (side * reach)], stroke);
        }
    }
}

/// The sides of the body, or the ends of axes, at the edges.
fn draw_letters(ui: &Ui, stack: &Stack, orientation: &Orientation, rect: Rect) {
    let edge = rect.shrink(8.0);
    for (direction, at, align) in [
        (stack.right, edge.right_center(), Align2::RIGHT_CENTER),
        (-stack.right, edge.left_center(), Align2::LEFT_CENTER),
        (-stack.down, edge.center_top(), Align2::CENTER_TOP),
        (stack.down, edge.center_bottom(), Align2::CENTER_BOTTOM),
    ] {
        if let Some(letter) = orientation.letter_towards(direction) {
            // The lines of the other planes pass below the letters.
            let pen = pen(ui.painter());
            pen.label(at, align, &letter.to_string(), 12.0, pen.ink);
        }
    }
}

/// Writes words that stand out from any grey.
fn write(painter: &egui::Painter, at: Pos2, align: Align2, text: &str) {
    let pen = pen(painter);
    pen.text(at, align, text, 12.0, pen.ink);
}

/// Shows lines about what lies under the pointer.
pub(crate) fn show_pointed(ui: &Ui, rect: Rect, lines: &[String]) {
    for (i, line) in lines.iter().rev().enumerate() {
        let at = rect.left_bottom() + vec2(8.0, -8.0 - 15.0 * i as f32);
        write(&ui.painter().with_clip_rect(rect), at, Align2::LEFT_BOTTOM, line);
    }
}

/// Colours of the panes' planes.
pub(crate) const COLORS: [Color32; 3] =
    [Color32::from_rgb(235, 110, 95), Color32::from_rgb(120, 205, 105), Color32::from_rgb(240, 205, 90)];
/// Room around a slice, points.
const MARGIN: f32 = 20.0;
/// The lines leave so much free about the point, points.
const CROSS_GAP: f32 = 7.0;
