//! Presets and modes by picture: the server renders the volume with each, in small.
//!
//! One picture is requested at a time, while the panel is open and no other picture is in progress.

use std::time::Duration;

use egui::{ColorImage, Context, RichText, Sense, TextureHandle, TextureOptions, Ui, vec2};
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::ScreenshotId;
use isinglass_core::look::Look;
use isinglass_core::mode::Mode;
use isinglass_core::volume::Lighting;
use isinglass_core::wire::VolumeDescription;
use isinglass_formats::png;
use lucide_icons::Icon;

use super::style::{ICON_SIZE, accent, bright, quiet};
use super::text::{mode_name, preset_title};
use super::value_scale::ValueScale;
use crate::view::frame_source::FrameSource;

/// What a picture stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum GalleryEntry {
    Preset(&'static str),
    Mode(Mode),
}

struct Thumbnail {
    texture: TextureHandle,
    /// Whether nothing is seen in it.
    is_empty: bool,
}

#[derive(Default)]
pub(crate) struct Gallery {
    /// The volume of the pictures, and the look that they vary.
    shown: Option<(VolumeDescription, Look)>,
    /// Since when the volume is shown.
    since: Duration,
    /// A picture, or none where the server made none.
    pictures: Vec<(GalleryEntry, Option<Thumbnail>)>,
    requested: Option<(ScreenshotId, GalleryEntry)>,
}

impl Gallery {
    /// Requests the next picture that is missing, and takes the one that has come. `pose` and `fov_y` (radians) are
    /// the camera's. Never waits.
    pub(crate) fn poll(
        &mut self,
        ctx: &Context,
        now: Duration,
        source: &impl FrameSource,
        scale: &ValueScale,
        (pose, fov_y): (Pose, f32),
    ) {
        let Some((volume, look)) = &self.shown else { return };
        let mut talk = source.talk();
        if let Some((id, entry)) = self.requested {
            let shot = talk.quietly().screenshot.take_outcome().filter(|shot| shot.id == id);
            if shot.is_none() && talk.screenshot.wants(id) {
                return;
            }
            // Without an outcome another request has taken its place.
            self.requested = None;
            if let Some(shot) = shot {
                let picture = shot.png.as_ref().ok().and_then(|bytes| png::decode(bytes, MOST_PIXELS).ok());
                let thumbnail = picture.map(|rgb| {
                    let size = [rgb.width as usize, rgb.height as usize];
                    let image = ColorImage::from_rgb(size, &rgb.bytes);
                    let texture = ctx.load_texture(entry.name(), image, TextureOptions::LINEAR);
                    Thumbnail { texture, is_empty: rgb.bytes.iter().all(|c| *c < LEAST_SEEN) }
                });
                self.pictures.push((entry, thumbnail));
                ctx.request_repaint();
            }
        }
        let missing = entries(volume).into_iter().find(|entry| self.picture(*entry).is_none());
        if let Some(entry) = missing {
            // The next volume of a series may follow at once.
            if now < self.since + STAY {
                ctx.request_repaint_after(self.since + STAY - now);
                return;
            }
            // Nearer than the window, because so little is seen in a small picture.
            let square = Intrinsics::perspective(SIDE_PIXELS, SIDE_PIXELS, 0.7 * fov_y);
            let id = talk.screenshot.request(pose, square, [0; 3], Some(entry.look(look, scale)));
            self.requested = Some((id, entry));
        }
    }

    /// Drops what shows another volume or look. A preset replaces the transfer function, so its picture outlives a
    /// change of that. Surfaces are in the picture of their mode alone.
    pub(crate) fn follow(&mut self, now: Duration, volume: &VolumeDescription, look: &Look) {
        let Some((_, shown)) = self.shown.as_mut().filter(|(of, _)| of == volume) else {
            *self = Self { shown: Some((volume.clone(), look.clone())), since: now, ..Self::default() };
            return;
        };
        // A box around the whole volume cuts nothing away.
        let bounds = volume.bounds();
        let is_cut_alike = shown.clip.region(&bounds) == look.clip.region(&bounds);
        let is_lit_alike = shown.shaded == look.shaded && is_cut_alike;
        let has_channels = shown.channels == look.channels;
        let has_transfer = shown.transfer == look.transfer && has_channels;
        let has_isos = shown.isos == look.isos;
        if is_lit_alike && has_transfer && has_isos {
            return;
        }
        let stays = |entry: GalleryEntry| match entry {
            GalleryEntry::Preset(_) => is_lit_alike && has_channels,
            GalleryEntry::Mode(Mode::Iso) => is_lit_alike && has_transfer && has_isos,
            GalleryEntry::Mode(_) => is_lit_alike && has_transfer,
        };
        self.pictures.retain(|(entry, _)| stays(*entry));
        self.requested = self.requested.filter(|(_, entry)| stays(*entry));
        shown.clone_from(look);
    }

    /// Has pictures made anew that the server could not make.
    pub(crate) fn retry(&mut self) {
        self.pictures.retain(|(_, picture)| picture.is_some());
    }

    fn picture(&self, entry: GalleryEntry) -> Option<&Option<Thumbnail>> {
        self.pictures.iter().find(|(of, _)| *of == entry).map(|(_, picture)| picture)
    }

    #[cfg(test)]
    pub(crate) fn has(&self, entry: GalleryEntry) -> bool {
        matches!(self.picture(entry), Some(Some(_)))
    }

    /// Shows the pictures with their names. An edited preset is not the preset. Returns the one that the person chose.
    pub(crate) fn show(
        &self,
        ui: &mut Ui,
        look: &Look,
        is_edited: bool,
        volume: &VolumeDescription,
    ) -> Option<GalleryEntry> {
        let mut chosen = None;
        let (presets, modes): (Vec<_>, Vec<_>) =
            entries(volume).into_iter().partition(|entry| matches!(entry, GalleryEntry::Preset(_)));
        for (row, per_row, title) in [(presets, 4.0, None), (modes, 5.0, Some("Mode"))] {
            if let Some(title) = title {
                ui.add_space(4.0);
                ui.label(RichText::new(title).color(quiet(ui.ctx())));
            }
            ui.horizontal_wrapped(|ui| {
                ui.spacing_mut().item_spacing = vec2(GAP, 6.0);
                for entry in row {
                    if self.cell(ui, entry, per_row, entry.is_in(look, is_edited)) {
                        chosen = Some(entry);
                    }
                }
            });
        }
        chosen
    }

    /// A picture with its name. Returns whether it was clicked.
    fn cell(&self, ui: &mut Ui, entry: GalleryEntry, per_row: f32, is_chosen: bool) -> bool {
        let side = ((ui.max_rect().width() + GAP) / per_row - GAP).clamp(48.0, 96.0).floor();
        let (rect, response) = ui.allocate_exact_size(vec2(side, side + 16.0), Sense::click());
        let name = entry.name();
        response.widget_info(|| egui::WidgetInfo::selected(egui::Role::RadioButton, true, is_chosen, &name));
        if !ui.is_rect_visible(rect) {
            return response.clicked();
        }
        let square = egui::Rect::from_min_size(rect.min, vec2(side, side));
        let visuals = ui.visuals();
        let painter = ui.painter();
        let field = visuals.extreme_bg_color;
        let faint = quiet(ui.ctx()).gamma_multiply(0.6);
        let told = |text: &str, size: f32| {
            painter.rect_filled(square, ROUNDING, field);
            let font = egui::FontId::proportional(size);
            painter.text(square.center(), egui::Align2::CENTER_CENTER, text, font, faint);
        };
        match self.picture(entry) {
            Some(Some(picture)) if picture.is_empty => told("empty", 11.0),
            Some(Some(picture)) => {
                let whole = egui::Rect::from_min_max(egui::Pos2::ZERO, egui::pos2(1.0, 1.0));
                let shape = egui::epaint::RectShape::filled(square, ROUNDING, egui::Color32::WHITE);
                painter.add(shape.with_texture(picture.texture.id(), whole));
            }
            Some(None) => told(&Icon::ImageOff.unicode().to_string(), ICON_SIZE),
            // It is on the way.
            None => told(&Icon::Image.unicode().to_string(), ICON_SIZE),
        }
        let (width, color) = match (is_chosen, response.hovered() || response.has_focus()) {
            (true, _) => (2.0, accent(ui.ctx())),
            (false, true) => (1.0, visuals.widgets.hovered.fg_stroke.color),
            (false, false) => (1.0, visuals.widgets.noninteractive.bg_stroke.color),
        };
        // Around the picture: it is seen beside the panel's colour, whatever the picture's is.
        painter.rect_stroke(square, ROUNDING, egui::Stroke::new(width, color), egui::StrokeKind::Outside);
        let color = if is_chosen { bright(ui.ctx()) } else { quiet(ui.ctx()) };
        let font = egui::FontId::proportional(11.0);
        let below = rect.with_min_y(square.bottom() + 2.0);
        let painter = painter.with_clip_rect(below.intersect(ui.clip_rect()));
        painter.text(below.left_top(), egui::Align2::LEFT_TOP, entry.short_name(), font, color);
        response.on_hover_text(name).clicked()
    }
}

impl GalleryEntry {
    /// The look that the picture shows: lit as in a new window, which the server makes fastest.
    fn look(self, look: &Look, scale: &ValueScale) -> Look {
        let mut shown = Look { lighting: Lighting::default(), ..look.clone() };
        self.set(&mut shown, scale);
        shown
    }

    /// Changes a look to the entry's preset or mode.
    pub(crate) fn set(self, look: &mut Look, scale: &ValueScale) {
        match self {
            Self::Preset(name) => {
                look.mode = Mode::Composite;
                if let Some(preset) = isinglass_formats::preset(name) {
                    *look.transfer_of_mut(look.channels.chosen) = preset;
                }
            }
            Self::Mode(mode) => scale.set_mode(look, mode),
        }
    }

    fn is_in(self, look: &Look, is_edited: bool) -> bool {
        match self {
            Self::Preset(name) => look.chosen_transfer().name == name && !is_edited,
            Self::Mode(mode) => look.mode == mode,
        }
    }

    fn name(self) -> String {
        match self {
            Self::Preset(name) => format!("preset {name}"),
            Self::Mode(mode) => format!("mode {}", mode_name(mode)),
        }
    }

    fn short_name(self) -> &'static str {
        match self {
            Self::Preset(name) => preset_title(name),
            Self::Mode(Mode::Composite) => "Composite",
            Self::Mode(Mode::Mip) => "MIP",
            Self::Mode(Mode::MinIp) => "MinIP",
            Self::Mode(Mode::Average) => "Average",
            Self::Mode(Mode::Iso) => "Surfaces",
        }
    }
}

/// The presets that suit the volume, then the modes.
fn entries(volume: &VolumeDescription) -> Vec<GalleryEntry> {
    let presets =
        isinglass_formats::fitting_presets(&volume.name, volume.value_range).map(GalleryEntry::Preset);
    presets.chain(Mode::ALL.into_iter().map(GalleryEntry::Mode)).collect()
}

/// A volume is shown for this long before it has pictures.
const STAY: Duration = Duration::from_secs(1);
/// Between pictures, points.
const GAP: f32 = 8.0;
const ROUNDING: f32 = 3.0;
/// A picture with nothing but darker pixels shows nothing.
const LEAST_SEEN: u8 = 12;
/// Size of a picture, pixels.
const SIDE_PIXELS: u32 = 128;
const MOST_PIXELS: u64 = (SIDE_PIXELS * SIDE_PIXELS) as u64;
