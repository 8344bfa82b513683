//! Slices beside the picture: three panes that share a point, and a strip with the slab and the window.

mod pane;
mod texture;

use egui::{Rect, Ui, Vec2, vec2};
use glam::Vec3;
use isinglass_core::volume::{SlabMode, SliceGrid, SliceSpec};
use lucide_icons::Icon;

use super::controls::{self, field};
use super::style::{icon, named};
use super::text::format_in;
use super::value_scale::ValueScale;
use crate::input::bindings::{Action, Bindings};
use crate::view::planes::{PlaneChoice, Slab, Stack};

pub(crate) use pane::{COLORS, PaneScene, PaneView, Pointed, pen, show_pointed};

/// The panes and what they share.
#[derive(Default)]
pub(crate) struct SlicePanes {
    is_on: bool,
    /// The point that all panes show, world space.
    pub(crate) point: Vec3,
    pub(crate) slab: Slab,
    /// Whether the slices themselves are drawn into the picture, or their outlines only.
    pub(crate) is_in_picture: bool,
    /// The values shown black and white; none: chosen by the histogram.
    pub(crate) window: Option<(f32, f32)>,
    panes: [pane::Pane; 3],
    /// The planes that the panes showed last.
    stacks: Option<[Stack; 3]>,
    /// The pane that takes most of the room.
    large: Option<usize>,
    /// The pane that keys page without the keyboard's focus.
    active: usize,
}

/// The rooms of the picture and the panes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rooms {
    pub(crate) picture: Rect,
    pub(crate) panes: [Rect; 3],
}

impl SlicePanes {
    pub(crate) fn is_on(&self) -> bool {
        self.is_on
    }

    pub(crate) fn set_on(&mut self, is_on: bool) {
        self.is_on = is_on;
        self.stacks = None;
        self.panes.iter_mut().for_each(pane::Pane::hide);
    }

    /// Ends drags whose release may never be reported.
    pub(crate) fn end_drag(&mut self) {
        self.panes.iter_mut().for_each(pane::Pane::end_drag);
    }

    /// Another source is shown: only the panes stay.
    pub(crate) fn forget(&mut self) {
        *self = Self { is_on: self.is_on, large: self.large, ..Self::default() };
    }

    pub(crate) fn choices(&self) -> [PlaneChoice; 3] {
        std::array::from_fn(|i| self.panes[i].choice(i))
    }

    pub(crate) fn choose(&mut self, pane: usize, choice: PlaneChoice) {
        self.panes[pane].choose(choice);
    }

    pub(crate) fn large(&self) -> Option<usize> {
        self.large
    }

    pub(crate) fn set_large(&mut self, large: Option<usize>) {
        self.large = large.filter(|pane| *pane < 3);
    }

    /// The values shown black and white.
    pub(crate) fn window_of(&self, scale: &ValueScale) -> (f32, f32) {
        self.window.unwrap_or_else(|| {
            let (lo, hi) = (scale.percentile(0.5), scale.percentile(99.5));
            if hi > lo { (lo, hi) } else { scale.range }
        })
    }

    /// Divides a room: four equal parts, or a large pane beside the picture and the other two.
    pub(crate) fn rooms(&self, room: Rect) -> Rooms {
        let part = |x0: f32, y0: f32, x1: f32, y1: f32| {
            let at = |x: f32, y: f32| room.min + vec2(x, y) * room.size();
            let gap = |x: f32| if x > 0.0 { GAP } else { 0.0 };
            Rect::from_min_max((at(x0, y0) + vec2(gap(x0), gap(y0))).round(), at(x1, y1).round())
        };
        match self.large {
            None => Rooms {
                picture: part(0.0, 0.0, 0.5, 0.5),
                panes: [part(0.5, 0.0, 1.0, 0.5), part(0.0, 0.5, 0.5, 1.0), part(0.5, 0.5, 1.0, 1.0)],
            },
            Some(large) => {
                let mut panes =
                    [part(LARGE, 1.0 / 3.0, 1.0, 2.0 / 3.0), part(LARGE, 2.0 / 3.0, 1.0, 1.0)].into_iter();
                let whole = part(0.0, 0.0, LARGE, 1.0);
                let panes = std::array::from_fn(|i| match i == large {
                    true => whole,
                    false => panes.next().unwrap_or(whole),
                });
                Rooms { picture: part(LARGE, 0.0, 1.0, 1.0 / 3.0), panes }
            }
        }
    }

    /// The slices to request: what is seen first, the one under the pointer before the others, and then the next ones
    /// in the direction of paging.
    pub(crate) fn wanted(&self, stacks: &[Stack; 3]) -> Vec<(SliceSpec, bool)> {
        let mut order = [0, 1, 2];
        order.sort_by_key(|pane| *pane != self.active);
        let at = |pane: usize| stacks[pane].index_of(self.point);
        let spec = |pane: usize, by: i32| stacks[pane].spec(at(pane) + by, self.slab);
        let seen = order.iter().filter_map(|&pane| Some((spec(pane, 0)?, false)));
        let ahead = |pane: usize, steps: i32| {
            let towards = self.panes[pane].direction();
            (1..=steps).map(move |n| n * towards).chain([-towards])
        };
        let next = order.iter().flat_map(|&pane| {
            let steps = if pane == self.active { AHEAD_ACTIVE } else { AHEAD };
            ahead(pane, steps).filter_map(move |by| Some((spec(pane, by)?, true)))
        });
        seen.chain(next).collect()
    }

    /// Moves a pane's slice by a number of slices.
    pub(crate) fn page(&mut self, pane: usize, stack: &Stack, by: i32) {
        if by != 0 {
            self.point = stack.moved(self.point, stack.index_of(self.point) + by);
            self.panes[pane].note_direction(by);
            self.active = pane;
        }
    }

    /// Shows the strip of the slab and the window. Returns whether to close the panes.
    pub(crate) fn show_strip(
        &mut self,
        ui: &mut Ui,
        scale: &ValueScale,
        unit: Option<&str>,
        longest: f32,
        bindings: &Bindings,
    ) -> bool {
        let suffix = unit.map_or(String::new(), |unit| format!(" {unit}"));
        let width = ui.available_width();
        let mut is_closed = false;
        ui.horizontal_centered(|ui| {
            let label = ui.label("slab").on_hover_text("thickness of what a slice shows; 0 is one voxel");
            let thickness = &mut self.slab.thickness;
            let of_slab = field(ui, thickness, move |v| format_in(v, longest));
            let of_slab = of_slab.range(0.0..=longest).speed(longest / 500.0).suffix(&suffix);
            ui.add(of_slab).labelled_by(label.id);
            let is_thick = self.slab.thickness > 0.0;
            for (name, hint, mode) in MODES {
                let button = egui::Button::selectable(self.slab.mode == mode && is_thick, name);
                if ui.add_enabled(is_thick, button).on_hover_text(hint).clicked() {
                    self.slab.mode = mode;
                }
            }
            controls::checkbox(ui, &mut self.is_in_picture, "show in 3D")
                .on_hover_text("draw the slices over the picture of the volume, too");
            if width >= WIDTH_WITH_WINDOW {
                ui.separator();
                let (lo, hi) = self.window_of(scale);
                let span = scale.span();
                let (mut level, mut wide) = ((lo + hi) * 0.5, hi - lo);
                let label = ui.label("level");
                let of_level = field(ui, &mut level, move |v| format_in(v, span)).speed(span / 500.0);
                let is_moved = ui.add(of_level).labelled_by(label.id).changed();
                let label = ui.label("window");
                let of_width = field(ui, &mut wide, move |v| format_in(v, span)).speed(span / 500.0);
                let is_wider = ui.add(of_width.range(0.0..=f32::MAX)).labelled_by(label.id).changed();
                if is_moved || is_wider {
                    self.set_window(level, wide, scale);
                }
                if ui.button("auto").on_hover_text("window by the histogram").clicked() {
                    self.window = None;
                }
            }
            ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                let close = ui.add(egui::Button::new(icon(Icon::X)).frame_when_inactive(false));
                named(&close, egui::Role::Button, "close the slices");
                let hint = bindings.with_key("close the slices", Action::Slices);
                is_closed = close.on_hover_text(hint).clicked();
            });
        });
        is_closed
    }

    /// Sets level and window. The window is never empty.
    fn set_window(&mut self, level: f32, width: f32, scale: &ValueScale) {
        let least = (scale.range.1 - scale.range.0) * 1e-5;
        let half = (width.max(least) * 0.5).min(f32::MAX * 0.1);
        let (lo, hi) = (level - half, level + half);
        if lo.is_finite() && hi.is_finite() && hi > lo {
            self.window = Some((lo, hi));
        }
    }

    /// Shows a pane, and does what pointer and keys do in it. Returns the point under the pointer.
    pub(crate) fn show_pane(
        &mut self,
        ui: &mut Ui,
        number: usize,
        stacks: &[Stack; 3],
        scene: &PaneScene<'_>,
    ) -> Option<Pointed> {
        let window = self.window_of(scene.scale);
        let pane = &mut self.panes[number];
        let input = pane.show(ui, number, stacks, scene, (self.point, self.slab, window));
        if input.is_active {
            self.active = number;
        }
        if let Some(point) = input.point {
            self.point = point;
        }
        self.page(number, &stacks[number], input.pages);
        if let Some([wider, darker]) = input.window {
            let (lo, hi) = window;
            let width = (hi - lo) * (wider * WINDOW_PER_POINT).exp();
            self.set_window((lo + hi) * 0.5 + darker * WINDOW_PER_POINT * (hi - lo), width, scene.scale);
        }
        if input.is_double {
            self.large = if self.large == Some(number) { None } else { Some(number) };
        }
        if let Some(choice) = input.choice {
            self.panes[number].choose(choice);
        }
        if (pane::PaneInput { is_active: false, ..input }) != pane::PaneInput::default() {
            // What lies beside this pane is drawn already.
            ui.ctx().request_repaint();
        }
        pane::pointed(&self.panes[number], stacks, number, scene.rect, ui)
    }

    /// The pictures of the panes' slices, with the numbers of their panes and where they lie.
    pub(crate) fn pictures(&self) -> impl Iterator<Item = (usize, egui::TextureId, SliceGrid)> {
        self.panes
            .iter()
            .enumerate()
            .filter_map(|(i, pane)| pane.picture().map(|(texture, grid)| (i, texture, grid)))
    }

    pub(crate) fn note_stacks(&mut self, stacks: [Stack; 3]) {
        self.stacks = Some(stacks);
    }

    /// The planes that the panes show; none while they are closed.
    pub(crate) fn stacks(&self) -> Option<&[Stack; 3]> {
        self.stacks.as_ref()
    }

    /// The panes as they lie on the screen.
    pub(crate) fn views(&self) -> impl Iterator<Item = PaneView> {
        self.panes.iter().filter_map(pane::Pane::view)
    }

    /// The pane that keys page while no pane has the keyboard.
    pub(crate) fn active(&self) -> usize {
        self.active
    }
}

/// Names of what a slab shows.
const MODES: [(&str, &str, SlabMode); 3] = [
    ("mean", "the mean value across the slab", SlabMode::Mean),
    ("MIP", "the greatest value across the slab", SlabMode::Max),
    ("MinIP", "the least value across the slab", SlabMode::Min),
];
/// Height of the strip, points.
pub(crate) const STRIP_HEIGHT: f32 = 34.0;
/// Distance between panes, points.
const GAP: f32 = 2.0;
/// Share of the width of a large pane.
const LARGE: f32 = 0.66;
/// Slices fetched ahead, in the pane that is paged and in the others.
const AHEAD_ACTIVE: i32 = 6;
const AHEAD: i32 = 2;
/// Change of level and window, relative to the window, of a drag by a point.
const WINDOW_PER_POINT: f32 = 0.005;
/// The strip has level and window from this width on, points.
const WIDTH_WITH_WINDOW: f32 = 560.0;

/// Scales a vector of the panes' plane to the screen.
fn on_screen(stack: &Stack, scale: f32, v: Vec3) -> Vec2 {
    vec2(v.dot(stack.right), v.dot(stack.down)) * scale
}
