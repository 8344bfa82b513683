//! The slices beside the picture: their rooms, their requests, and their planes in the picture.

use egui::{Panel, Ui};
use glam::{Quat, Vec3};
use isinglass_core::ids::ProbeId;
use isinglass_core::wire::{Probed, ProbedVoxel, VolumeDescription};
use isinglass_formats::{SavedPlane, SavedSlices};

use super::ViewerApp;
use crate::input::bindings::{Action, Side};
use crate::paint::slice_planes::{self, TexturedSlice};
use crate::panels::probe;
use crate::panels::slices::{self, PaneScene, Pointed, STRIP_HEIGHT};
use crate::panels::style::bar;
use crate::view::frame_source::FrameSource;
use crate::view::planes::{PlaneChoice, Slab, Stack, orientation_of_planes};
use crate::view::viewing::Refresh;

impl<S: FrameSource> ViewerApp<S> {
    /// Shows the panes in what is left of `ui`, and leaves the room for the picture in `self.room`.
    pub(super) fn show_slices(&mut self, ui: &mut Ui) {
        let Some(description) = self.viewing.source().description().filter(|_| self.slices.is_on()) else {
            return;
        };
        let ctx = ui.ctx().clone();
        let volume = &description.volume;
        let orientation = orientation_of_planes(volume.orientation.as_deref(), self.up_axis);
        let Some(scale) = self.scale_of_slices() else { return };
        let longest = volume.bounds().radius() * 2.0;
        let strip = Panel::bottom("strip of slices").frame(bar(&ctx)).exact_size(STRIP_HEIGHT);
        let (unit, bindings) = (volume.unit.as_deref(), &self.options.bindings);
        if strip.show(ui, |ui| self.slices.show_strip(ui, &scale, unit, longest, bindings)).inner {
            self.chosen_actions.push(Action::Slices);
        }
        let rooms = self.slices.rooms(ui.available_rect_before_wrap());
        self.room = rooms.picture;
        let stacks = self.stacks(volume);
        let world_from_view =
            self.controls.as_ref().map_or(Quat::IDENTITY, |(_, controls)| controls.pose().world_from_view);
        for (number, rect) in rooms.panes.into_iter().enumerate() {
            let stack = &stacks[number];
            let spec = stack.spec(stack.index_of(self.slices.point), self.slices.slab);
            let slice = spec.and_then(|spec| self.viewing.source().talk().slices.get(&spec));
            let scene = PaneScene {
                rect,
                orientation: &orientation,
                scale: &scale,
                slice,
                world_from_view,
                has_keys: self.slices.active() == number,
                has_dialog: self.has_dialog(),
                reverses_wheel: self.options.bindings.reverses_wheel,
                is_measuring: self.is_measuring(),
                drags_measure: self.measures.is_busy(),
            };
            if let Some(pointed) = self.slices.show_pane(ui, number, &stacks, &scene) {
                let Pointed { point, value } = pointed;
                let voxel = probe::voxel_at(point, volume);
                let voxel = Some(ProbedVoxel { index: voxel, value, level: 0 });
                let found = Probed { id: ProbeId(0), point: point.to_array(), voxel };
                let [value, place, _] = probe::lines(point, Some(&found), volume);
                slices::show_pointed(ui, rect, &[value, place]);
            }
        }
        // Planes that have changed just now are requested in the next refresh, which follows at once.
        let specs = self.slices.wanted(&stacks);
        self.slices.note_stacks(stacks);
        let mut talk = self.viewing.source().talk();
        if talk.slices.is_news(&specs) {
            talk.slices.want(&specs);
        } else {
            // The order in which slices were used changes, and nothing is sent.
            talk.quietly().slices.want(&specs);
        }
    }

    pub(super) fn stacks(&self, volume: &VolumeDescription) -> [Stack; 3] {
        let orientation = orientation_of_planes(volume.orientation.as_deref(), self.up_axis);
        self.slices.choices().map(|choice| Stack::new(choice, &orientation, volume))
    }

    /// Nothing is requested while no slice is shown.
    pub(super) fn set_slices_on(&mut self, is_on: bool) {
        self.slices.set_on(is_on);
        if !is_on {
            self.viewing.source().talk().slices.want(&[]);
        }
    }

    /// Draws the planes of the panes into the picture.
    pub(super) fn paint_planes(&self, ui: &Ui, rect: egui::Rect, refresh: &Refresh) {
        let Some(stacks) = self.slices.stacks() else { return };
        let pen = self.aids.pen(ui.painter());
        let pictures =
            self.slices.pictures().filter(|_| self.slices.is_in_picture).map(|(number, texture, grid)| {
                let stack = &stacks[number];
                TexturedSlice { corners: stack.outline(grid.origin), normal: stack.towards, grid, texture }
            });
        slice_planes::paint_textured(&pen, rect, &refresh.camera, pictures.collect());
        for (stack, color) in stacks.iter().zip(slices::COLORS) {
            let point = stack.moved(self.slices.point, stack.index_of(self.slices.point));
            let corners = stack.outline(point);
            slice_planes::paint_outline(&pen, rect, &refresh.camera, &refresh.bounds, &corners, color);
        }
    }

    pub(super) fn saved_slices(&self) -> SavedSlices {
        let planes = self.slices.choices().map(|choice| match choice {
            PlaneChoice::Standard(Side::Top) => SavedPlane::Top,
            PlaneChoice::Standard(Side::Front) => SavedPlane::Front,
            PlaneChoice::Standard(Side::Right) => SavedPlane::Right,
            PlaneChoice::Oblique(rotation) => SavedPlane::Oblique(rotation.to_array()),
        });
        SavedSlices {
            shown: self.slices.is_on(),
            point: self.slices.point.to_array(),
            thickness: self.slices.slab.thickness,
            mode: self.slices.slab.mode,
            window: self.slices.window.map(|(lo, hi)| [lo, hi]),
            planes,
            in_picture: self.slices.is_in_picture,
            large: self.slices.large().map(|pane| pane as u8 + 1),
        }
    }

    pub(super) fn restore_slices(&mut self, saved: &SavedSlices) {
        self.set_slices_on(saved.shown);
        self.slices.is_in_picture = saved.in_picture;
        let bounds = self.viewing.source().description().map(|description| description.volume.bounds());
        let point = Vec3::from_array(saved.point);
        self.slices.point = bounds.map_or(point, |bounds| point.clamp(bounds.min, bounds.max));
        self.slices.slab = Slab { thickness: saved.thickness, mode: saved.mode };
        self.slices.window = saved.window.map(|[lo, hi]| (lo, hi));
        for (pane, plane) in saved.planes.into_iter().enumerate() {
            let choice = match plane {
                SavedPlane::Top => PlaneChoice::Standard(Side::Top),
                SavedPlane::Front => PlaneChoice::Standard(Side::Front),
                SavedPlane::Right => PlaneChoice::Standard(Side::Right),
                SavedPlane::Oblique(rotation) => PlaneChoice::Oblique(Quat::from_array(rotation)),
            };
            self.slices.choose(pane, choice);
        }
        self.slices.set_large(saved.large.and_then(|pane| usize::from(pane).checked_sub(1)));
    }
}
