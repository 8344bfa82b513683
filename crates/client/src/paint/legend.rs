//! A key to the colours of the picture: a bar at the right edge, with values beside it.

use egui::{Align2, Mesh, Rect, Stroke, StrokeKind, pos2, vec2};
use isinglass_core::mode::Mode;
use isinglass_core::picture::srgb_from_linear;
use isinglass_core::transfer::TransferFunction;

use super::view_aids::Pen;

/// What the legend tells.
pub(crate) struct Legend<'a> {
    pub(crate) transfer: &'a TransferFunction,
    /// Values at both ends.
    pub(crate) domain: (f32, f32),
    pub(crate) unit: Option<&'a str>,
    pub(crate) mode: Mode,
    /// Writes a value of the domain.
    pub(crate) format: &'a dyn Fn(f32) -> String,
}

impl Legend<'_> {
    /// Where the bar is in a picture; none if there is no room.
    pub(crate) fn rect(picture: Rect) -> Option<Rect> {
        let height = (picture.height() * 0.4).min(LONGEST);
        let corner = picture.right_bottom() - vec2(RIGHT, BOTTOM);
        (height >= SHORTEST && picture.width() >= LEAST_WIDTH)
            .then(|| Rect::from_min_max(corner - vec2(WIDTH, height), corner))
    }

    pub(crate) fn paint(&self, pen: &Pen<'_>, bar: Rect) {
        let rows = bar.height().max(1.0) as usize;
        let mut colors = Mesh::default();
        for row in 0..rows {
            let top = bar.bottom() - bar.height() * (row + 1) as f32 / rows as f32;
            let bottom = top + bar.height() / rows as f32;
            let part = Rect::from_x_y_ranges(bar.x_range(), top..=bottom);
            let [r, g, b] = color_at(self.transfer, self.mode, (row as f32 + 0.5) / rows as f32);
            colors.add_colored_rect(part, egui::Color32::from_rgb(r, g, b));
        }
        pen.painter.add(colors);
        pen.painter.rect_stroke(bar, 0.0, Stroke::new(1.0, pen.ink), StrokeKind::Outside);
        let (lo, hi) = self.domain;
        for tick in 0..=NUM_PARTS {
            let part = tick as f32 / NUM_PARTS as f32;
            let at = pos2(bar.left(), bar.bottom() - bar.height() * part);
            pen.line([at - vec2(5.0, 0.0), at], 1.0, pen.ink);
            let text = (self.format)(lo + (hi - lo) * part);
            pen.text(at - vec2(8.0, 0.0), Align2::RIGHT_CENTER, &text, 12.0, pen.ink);
        }
        if let Some(unit) = self.unit {
            pen.text(bar.right_top() - vec2(0.0, 8.0), Align2::RIGHT_BOTTOM, unit, 12.0, pen.ink);
        }
    }

    /// The same in words, for screen readers.
    pub(crate) fn in_words(&self) -> String {
        let [lo, hi] = [self.domain.0, self.domain.1].map(self.format);
        let unit = self.unit.map_or_else(String::new, |unit| format!(" {unit}"));
        format!("legend: colours of the values from {lo} to {hi}{unit}")
    }
}

/// The colour of a position as the mode shows it, sRGB.
pub(crate) fn color_at(transfer: &TransferFunction, mode: Mode, x: f32) -> [u8; 3] {
    let linear = match mode.is_projection() {
        true => transfer.shown(x),
        false => transfer.at(x).0,
    };
    linear.map(|c| (srgb_from_linear(c) * 255.0).round() as u8)
}

const WIDTH: f32 = 14.0;
const LONGEST: f32 = 220.0;
const SHORTEST: f32 = 60.0;
/// Narrowest picture with a legend.
const LEAST_WIDTH: f32 = 240.0;
/// Distances of the bar from the edges of the picture, above the lines at the bottom.
const RIGHT: f32 = 20.0;
const BOTTOM: f32 = 56.0;
/// Parts between the values.
const NUM_PARTS: usize = 4;

#[cfg(test)]
mod tests {
    use isinglass_core::transfer::{ControlPoint, Domain, UnitLength};

    use super::*;

    #[test]
    fn its_colours_are_those_of_the_mode_and_it_keeps_to_the_picture() {
        let p = |x, opacity| ControlPoint { x, color: [1.0, x, 0.0], opacity };
        let transfer = TransferFunction {
            name: "test".into(),
            domain: Domain::Full,
            unit_length: UnitLength::Voxel,
            points: vec![p(0.0, 0.0), p(1.0, 0.5)],
        };
        let format = |value: f32| format!("{value:.0}");
        let of = |mode| Legend {
            transfer: &transfer,
            domain: (-100.0, 300.0),
            unit: Some("HU"),
            mode,
            format: &format,
        };
        let red = |mode, x| color_at(&transfer, mode, x)[0];
        assert_eq!([red(Mode::Composite, 0.5), red(Mode::Mip, 1.0)], [255; 2]);
        assert!(red(Mode::Mip, 0.5).abs_diff(128) <= 1, "a projection is dim where matter is thin");
        assert_eq!(of(Mode::Mip).in_words(), "legend: colours of the values from -100 to 300 HU");
        for size in [[900.0, 600.0], [240.0, 150.0]] {
            let picture = Rect::from_min_size(pos2(30.0, 40.0), size.into());
            assert!(picture.contains_rect(Legend::rect(picture).unwrap()), "{size:?}");
        }
        assert_eq!(Legend::rect(Rect::from_min_size(pos2(0.0, 0.0), vec2(900.0, 100.0))), None);
    }
}
