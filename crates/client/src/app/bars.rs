//! The bars and the docked panel around the picture, and the room that they leave.

use std::time::Duration;

use egui::{Margin, Panel, Rect, RichText, Ui};
use isinglass_core::wire::VolumeDescription;
use isinglass_net::State;

use super::ViewerApp;
use crate::paint::view_aids;
use crate::panels::status;
use crate::panels::style::{self, bar, quiet};
use crate::panels::text::{format_duration, format_in};
use crate::panels::toolbar::{TOOLBAR_HEIGHT, Toolbar, ToolbarWish};
use crate::panels::viewers;
use crate::view::frame_source::FrameSource;

impl<S: FrameSource> ViewerApp<S> {
    /// Shows everything around the picture. What is left of `ui` is for the picture.
    pub(super) fn show_bars(&mut self, ui: &mut Ui, now: Duration) {
        let ctx = ui.ctx().clone();
        if self.shows_bars {
            let toolbar = Panel::top("toolbar").frame(bar(&ctx)).exact_size(TOOLBAR_HEIGHT);
            let wish = toolbar.show(ui, |ui| self.toolbar().show(ui)).inner;
            self.choose(now, wish);
            let line = Panel::bottom("status line").frame(bar(&ctx)).exact_size(STATUS_HEIGHT);
            if let Some(leader) = line.show(ui, |ui| self.status_line(ui)).inner {
                self.viewing.source().talk().viewers.follow(leader);
                self.joins_leader = leader.is_some();
            }
            self.show_look_panel(ui, now);
            self.show_measure_bar(ui);
        }
        self.room = ui.available_rect_before_wrap();
        self.show_slices(ui);
    }

    /// What the toolbar and the menu of the picture show.
    pub(super) fn toolbar(&self) -> Toolbar<'_> {
        Toolbar {
            bindings: &self.options.bindings,
            mode: self.viewing.look().map(|look| look.mode),
            is_orthographic: self.is_orthographic,
            has_clip_handles: self.clip_editor.is_shown,
            has_probe: self.probe.is_on(),
            is_measuring: self.is_measuring(),
            is_recording: self.recording.is_some(),
            has_path: self.screenshots.has_path(),
            shows_axes: self.aids.shows_axes,
            shows_box: self.aids.shows_box,
            shows_slices: self.slices.is_on(),
            is_look_open: self.is_look_open,
            opens_volumes: self.opens_volumes,
            axes: self.orientation(),
            up: self.up_axis,
            flip: self.viewing.source().talk().selection.choices().map(|choices| choices.shown.flip),
            named_views: self.named_views.iter().map(|view| &view.name[..]).collect(),
        }
    }

    pub(super) fn choose(&mut self, now: Duration, wish: Option<ToolbarWish>) {
        match wish {
            Some(ToolbarWish::Act(action)) => self.chosen_actions.push(action),
            Some(ToolbarWish::Show(mode)) => self.chosen_mode = Some(mode),
            Some(ToolbarWish::MovieOfPath) => self.screenshots.open_for_path(),
            Some(ToolbarWish::TurnUp(axis)) => self.turn_up(now, axis),
            Some(ToolbarWish::Mirror(flip)) => self.mirror(now, flip),
            Some(ToolbarWish::View(wish)) => self.do_named_view(now, wish),
            None => {}
        }
    }

    /// One line: the volume, the people there, and the server with its round trip. A server in this window answers at
    /// once. Returns whom to follow.
    fn status_line(&self, ui: &mut Ui) -> Option<Option<u32>> {
        let small = |text: String| RichText::new(text).size(12.0).color(quiet(ui.ctx()));
        let (source, name) = (self.viewing.source(), &self.options.server_name);
        let (state, stats) = (source.state(), source.stats());
        let is_silent = source.is_silent();
        let server = match (&state, stats.rtt_micros) {
            (State::Connected, micros) if micros > 0 && !is_silent && !self.is_server_here() => {
                format!("{name}  {}", format_duration(Duration::from_micros(micros)))
            }
            _ => name.clone(),
        };
        let size = source.description().map(|of| size_of(&of.volume)).unwrap_or_default();
        let (server, size) = (small(server), small(format!("{} {size}", self.title)));
        ui.horizontal_centered(|ui| {
            ui.add(egui::Label::new(size).truncate());
            ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                status::connection_dot(ui, &state, is_silent);
                ui.add(egui::Label::new(server).truncate());
                let talk = source.talk();
                let (list, following) = (talk.viewers.list().to_vec(), talk.viewers.following().cloned());
                drop(talk);
                viewers::show(ui, &list, following.as_ref())
            })
            .inner
        })
        .inner
    }

    /// Whether the server is a part of this window.
    fn is_server_here(&self) -> bool {
        self.opens_volumes && self.options.volume_source.is_some()
    }

    /// The room for panes at the top: beside the badge, or below it if there is too little.
    pub(super) fn room_at_top(&self) -> Rect {
        let room = self.room;
        let taken = if self.shows_bars {
            status::size_taken(room.width(), self.shows_numbers)
        } else {
            egui::Vec2::ZERO
        };
        match room.width() - taken.x >= LEAST_ROOM_AT_TOP {
            true => room.with_min_x(room.left() + taken.x),
            false => room.with_min_y(room.top() + taken.y),
        }
    }

    /// The room for panes at the bottom: above the bar of parts, beside axes and scale bar. These are below it if
    /// there is too little.
    pub(crate) fn room_at_bottom(&self) -> Rect {
        let corner = if self.aids.shows_axes { view_aids::CORNER } else { egui::Vec2::ZERO };
        let room = self.room.with_max_y(self.room.bottom() - self.parts_bar.height());
        match room.width() - corner.x >= LEAST_ROOM {
            true => room.with_min_x(room.left() + corner.x),
            false => {
                let lift = self.parts_bar.height_over(corner.x) + corner.y;
                room.with_max_y((self.room.bottom() - lift).min(room.bottom()))
            }
        }
    }

    /// The frame of the docked panel.
    pub(super) fn panel_frame(ctx: &egui::Context) -> egui::Frame {
        egui::Frame::new().fill(style::surface(ctx)).inner_margin(Margin::symmetric(12, 8))
    }
}

/// The size of a volume with its unit, and its values.
fn size_of(volume: &VolumeDescription) -> String {
    let (lo, hi) = volume.value_range;
    let values =
        |unit: &str| format!("values {} to {}{unit}", format_in(lo, hi - lo), format_in(hi, hi - lo));
    let values = volume.value_unit.as_ref().map_or_else(|| values(""), |unit| values(&format!(" {unit}")));
    let Some(unit) = &volume.unit else { return format!("voxels  {values}") };
    let size = volume.bounds().max - volume.bounds().min;
    let [x, y, z] = size.to_array().map(|side| format_in(side, size.max_element()));
    format!("voxels  {x}×{y}×{z} {unit}  {values}")
}

/// Height of the status line, points.
const STATUS_HEIGHT: f32 = 26.0;
/// Least width of a pane at the top, points.
const LEAST_ROOM_AT_TOP: f32 = 260.0;
/// Least width of a pane at the bottom, points.
const LEAST_ROOM: f32 = 280.0;
