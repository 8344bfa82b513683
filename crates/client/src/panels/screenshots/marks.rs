//! Scale bar and colour legend in a picture. The texts are drawn from the window's fonts, and all is put into the
//! server's picture on a thread.

use std::sync::Arc;

use egui::{Color32, Context, FontId};
use isinglass_core::look::Look;
use isinglass_formats::png;

use super::Subject;
use crate::paint::legend::color_at;
use crate::paint::view_aids::round_length;
use crate::panels::text::format_in;

/// What the colours of a picture stand for.
#[derive(Clone, Debug)]
pub(crate) struct LegendSubject {
    pub(crate) look: Arc<Look>,
    /// The values at the ends of the transfer function.
    pub(crate) range: (f32, f32),
    /// Unit of the values, if known.
    pub(crate) unit: Option<String>,
}

/// What is drawn into pictures of one size.
#[derive(Clone, Debug)]
pub(super) struct PictureMarks {
    /// Length of the scale bar, pixels, and its text.
    scale: Option<(f32, Stamp)>,
    legend: Option<ColorLegend>,
    /// Pixels of what is a point on a screen.
    unit: f32,
    is_dark: bool,
}

#[derive(Clone, Debug)]
struct ColorLegend {
    /// sRGB from the greatest value down.
    colors: Vec<[u8; 3]>,
    high: Stamp,
    low: Stamp,
}

/// A text as opacities, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
struct Stamp {
    width: usize,
    height: usize,
    opacities: Vec<u8>,
}

impl PictureMarks {
    /// The marks of pictures of `subject`; none if nothing is wanted.
    pub(super) fn of(ctx: &Context, subject: &Subject, has_scale: bool, has_legend: bool) -> Option<Self> {
        let intrinsics = &subject.intrinsics;
        let unit = (intrinsics.width.min(intrinsics.height) as f32 / SIDE_IN_POINTS).max(1.0);
        let text = |text: &str| Stamp::of(ctx, text, TEXT_POINTS * unit);
        let depth = (subject.center - subject.pose.eye).dot(subject.pose.forward());
        let world_per_pixel = 2.0 * intrinsics.half_size_at(depth).1 / intrinsics.height as f32;
        let most = world_per_pixel * SCALE_POINTS * unit;
        let scale = round_length(most, subject.unit.as_deref()).filter(|_| has_scale);
        let legend = subject.legend.as_ref().filter(|_| has_legend);
        let marks = Self {
            scale: scale.map(|(length, words)| (length / world_per_pixel, text(&words))),
            legend: legend.map(|legend| {
                let (lo, hi) = legend.range;
                let unit = legend.unit.as_deref().map_or(String::new(), |unit| format!(" {unit}"));
                let color = |i: usize| {
                    let x = 1.0 - i as f32 / (NUM_COLORS - 1) as f32;
                    color_at(legend.look.chosen_transfer(), legend.look.mode, x)
                };
                ColorLegend {
                    colors: (0..NUM_COLORS).map(color).collect(),
                    high: text(&format!("{}{unit}", format_in(hi, hi - lo))),
                    low: text(&format!("{}{unit}", format_in(lo, hi - lo))),
                }
            }),
            unit,
            is_dark: subject.background.iter().map(|c| u32::from(*c)).sum::<u32>() < 384,
        };
        (marks.scale.is_some() || marks.legend.is_some()).then_some(marks)
    }

    /// The PNG file `png` with the marks in it.
    ///
    /// # Errors
    /// The file is damaged.
    pub(super) fn draw(&self, png: &[u8], most_pixels: u64) -> Result<Vec<u8>, String> {
        let (size, mut pixels) = png::decode_rgba(png, most_pixels).map_err(|e| e.to_string())?;
        self.draw_on(size, &mut pixels);
        let is_opaque = pixels.chunks_exact(4).all(|p| p[3] == 255);
        let bytes = match is_opaque {
            true => pixels.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect(),
            false => pixels,
        };
        png::encode(size[0], size[1], &bytes).map_err(|e| e.to_string())
    }

    fn draw_on(&self, size: [u32; 2], pixels: &mut [u8]) {
        let [width, height] = size.map(|side| side as usize);
        let mut canvas = Raster { width, height, pixels };
        let ink = if self.is_dark { [225; 3] } else { [25; 3] };
        let halo = if self.is_dark { [8; 3] } else { [248; 3] };
        let points = |points: f32| (points * self.unit).round() as isize;
        let (right, bottom) = (width as isize, height as isize);
        if let Some((length, text)) = &self.scale {
            let (left, y) = (points(24.0), bottom - points(28.0));
            let (length, thick) = (length.round() as isize, points(2.0));
            let bars = [
                [left, y, length, thick],
                [left, y - points(3.0), thick, points(8.0)],
                [left + length - thick, y - points(3.0), thick, points(8.0)],
            ];
            for [x, y, w, h] in bars {
                canvas.fill([x - 1, y - 1, w + 2, h + 2], halo);
            }
            for bar in bars {
                canvas.fill(bar, ink);
            }
            canvas.stamp(text, [left, y - points(6.0) - text.height as isize], ink, halo);
        }
        if let Some(ColorLegend { colors, high, low }) = &self.legend {
            let (wide, tall) = (points(14.0), points(180.0).min(bottom / 2));
            let (x, y) = (right - points(24.0) - wide, bottom - points(28.0) - tall);
            canvas.fill([x - 1, y - 1, wide + 2, tall + 2], ink);
            for row in 0..tall {
                let color =
                    colors[(row as usize * colors.len() / tall.max(1) as usize).min(colors.len() - 1)];
                canvas.fill([x, y + row, wide, 1], color);
            }
            let left_of = |text: &Stamp| x - points(6.0) - text.width as isize;
            canvas.stamp(high, [left_of(high), y - points(2.0)], ink, halo);
            canvas.stamp(low, [left_of(low), y + tall + points(2.0) - low.height as isize], ink, halo);
        }
    }
}

impl Stamp {
    /// A line of text whose letters are so many pixels high.
    fn of(ctx: &Context, text: &str, pixels: f32) -> Self {
        let scale = ctx.pixels_per_point();
        let font = FontId::proportional(pixels / scale);
        ctx.fonts_mut(|fonts| {
            let galley = fonts.layout_no_wrap(text.to_owned(), font, Color32::WHITE);
            let letters = fonts.image();
            let [width, height] =
                [galley.size().x, galley.size().y].map(|side| (side * scale).ceil() as usize + 2);
            let mut stamp = Self { width, height, opacities: vec![0; width * height] };
            for row in &galley.rows {
                for glyph in row.row.glyphs.iter().filter(|glyph| !glyph.uv_rect.is_nothing()) {
                    let uv = glyph.uv_rect;
                    let at = (row.pos + glyph.pos.to_vec2() + uv.offset) * scale;
                    let (left, top) = (at.x.round() as isize, at.y.round() as isize);
                    for y in uv.min[1]..uv.max[1] {
                        for x in uv.min[0]..uv.max[0] {
                            let (to_x, to_y) =
                                (left + (x - uv.min[0]) as isize, top + (y - uv.min[1]) as isize);
                            let is_inside =
                                (0..width as isize).contains(&to_x) && (0..height as isize).contains(&to_y);
                            let letter =
                                letters.pixels.get(usize::from(y) * letters.size[0] + usize::from(x));
                            if let Some(letter) = letter.filter(|_| is_inside) {
                                let to = &mut stamp.opacities[to_y as usize * width + to_x as usize];
                                *to = (*to).max(letter.a());
                            }
                        }
                    }
                }
            }
            stamp
        })
    }
}

/// A picture with straight opacity.
struct Raster<'a> {
    width: usize,
    height: usize,
    pixels: &'a mut [u8],
}

impl Raster<'_> {
    /// Fills a rectangle: left, top, width, height.
    fn fill(&mut self, [left, top, width, height]: [isize; 4], color: [u8; 3]) {
        for y in top..top + height {
            for x in left..left + width {
                self.blend(x, y, color, 255);
            }
        }
    }

    fn stamp(&mut self, stamp: &Stamp, [left, top]: [isize; 2], ink: [u8; 3], halo: [u8; 3]) {
        for (dx, dy, color) in [(-1, 0, halo), (1, 0, halo), (0, -1, halo), (0, 1, halo), (0, 0, ink)] {
            for (i, opacity) in stamp.opacities.iter().enumerate().filter(|(_, opacity)| **opacity > 0) {
                let (x, y) = ((i % stamp.width) as isize, (i / stamp.width) as isize);
                self.blend(left + x + dx, top + y + dy, color, *opacity);
            }
        }
    }

    fn blend(&mut self, x: isize, y: isize, color: [u8; 3], opacity: u8) {
        if !(0..self.width as isize).contains(&x) || !(0..self.height as isize).contains(&y) {
            return;
        }
        let at = 4 * (y as usize * self.width + x as usize);
        let pixel = &mut self.pixels[at..at + 4];
        let over = f32::from(opacity) / 255.0;
        let under = f32::from(pixel[3]) / 255.0 * (1.0 - over);
        let whole = over + under;
        if whole > 0.0 {
            for ch in 0..3 {
                let mixed = (f32::from(color[ch]) * over + f32::from(pixel[ch]) * under) / whole;
                pixel[ch] = (mixed + 0.5) as u8;
            }
            pixel[3] = (whole * 255.0 + 0.5) as u8;
        }
    }
}

/// A picture whose shorter side has this many pixels has marks as large as in a window.
const SIDE_IN_POINTS: f32 = 700.0;
const TEXT_POINTS: f32 = 14.0;
/// The longest scale bar, points.
const SCALE_POINTS: f32 = 180.0;
const NUM_COLORS: usize = 256;

#[cfg(test)]
pub(super) mod tests {
    use glam::Vec3;
    use isinglass_core::camera::{Intrinsics, Pose};
    use isinglass_core::mode::Mode;
    use isinglass_core::space::Aabb;

    use super::*;

    pub(in crate::panels::screenshots) fn subject(width: u32, height: u32) -> Subject {
        let transfer = isinglass_formats::preset("shells").unwrap();
        Subject {
            name: "a".into(),
            pose: Pose::orbit(Vec3::ZERO, 0.2, 0.1, 10.0),
            intrinsics: Intrinsics::perspective(width, height, 0.7),
            background: [0; 3],
            bounds: Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE },
            center: Vec3::ZERO,
            up: Vec3::Y,
            unit: Some("mm".into()),
            legend: Some(LegendSubject {
                look: Arc::new(Look::new(transfer)),
                range: (-100.0, 250.0),
                unit: Some("HU".into()),
            }),
        }
    }

    fn context() -> Context {
        let ctx = Context::default();
        // No window takes the letters' texture.
        ctx.run_ui(egui::RawInput::default(), |_| {}).textures_delta.clear();
        ctx
    }

    #[test]
    fn the_bar_is_as_long_as_it_says_at_any_size() {
        let ctx = context();
        for (width, height) in [(640, 480), (3840, 2160), (64, 48)] {
            let subject = subject(width, height);
            let marks = PictureMarks::of(&ctx, &subject, true, false).unwrap();
            let (pixels, text) = marks.scale.as_ref().unwrap();
            // The centre is ten units away; the picture is 2 · 10 · tan 0.35 high there.
            let world = pixels * 20.0 * 0.35f32.tan() / height as f32;
            let is_round = [1.0, 2.0, 5.0].iter().any(|step| {
                let power = (world / step).log10();
                (power - power.round()).abs() < 1e-4
            });
            assert!(is_round && text.opacities.iter().any(|o| *o > 128), "{world}");
        }
        assert!(PictureMarks::of(&ctx, &subject(64, 48), false, false).is_none());
    }

    #[test]
    fn the_legend_of_a_projection_is_that_of_the_window() {
        let mut subject = subject(700, 500);
        let ctx = context();
        let colors =
            |subject: &Subject| PictureMarks::of(&ctx, subject, false, true).unwrap().legend.unwrap().colors;
        let composite = colors(&subject);
        let legend = subject.legend.as_mut().unwrap();
        legend.look = Arc::new(Look { mode: Mode::Mip, ..(*legend.look).clone() });
        let transfer = legend.look.transfer.clone();
        let projected = colors(&subject);
        assert_ne!(projected, composite, "the control");
        for (i, color) in projected.iter().enumerate() {
            let x = 1.0 - i as f32 / (NUM_COLORS - 1) as f32;
            assert_eq!(*color, color_at(&transfer, Mode::Mip, x), "{x}");
        }
    }

    #[test]
    fn marks_lie_in_their_corners_and_leave_the_rest() {
        let (ctx, subject) = (context(), subject(700, 500));
        let marks = PictureMarks::of(&ctx, &subject, true, true).unwrap();
        for before in [0u8, 255] {
            let mut pixels = vec![before; 700 * 500 * 4];
            marks.draw_on([700, 500], &mut pixels);
            let changed = |x: std::ops::Range<usize>, y: std::ops::Range<usize>| {
                let rows = y.flat_map(|y| x.clone().map(move |x| (x, y)));
                rows.filter(|(x, y)| pixels[4 * (y * 700 + x)..][..4] != [before; 4]).count()
            };
            assert!(changed(0..350, 250..500) > 100, "the scale bar");
            assert!(changed(350..700, 250..500) > 100, "the legend");
            assert_eq!(changed(0..700, 0..200), 0);
        }
        // A transparent picture stays so beside them.
        let png = png::encode(700, 500, &vec![0; 700 * 500 * 4]).unwrap();
        let drawn = marks.draw(&png, 1 << 20).unwrap();
        let (_, pixels) = png::decode_rgba(&drawn, 1 << 20).unwrap();
        assert!(pixels[3] == 0 && pixels.chunks(4).any(|p| p[3] == 255));
        assert!(marks.draw(&png[..100], 1 << 20).is_err(), "a damaged file");
    }
}
