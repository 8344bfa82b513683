//! Grey pictures of slices: values become grey by level and window, here and at once.

use std::sync::Arc;

use egui::{Color32, ColorImage, TextureHandle, TextureOptions};
use isinglass_core::volume::{Slice, SliceCodes};

/// The texture of a slice under a window. It is made anew when either changes.
#[derive(Default)]
pub(super) struct SliceTexture {
    texture: Option<TextureHandle>,
    of: Option<(Arc<Slice>, (f32, f32))>,
}

impl SliceTexture {
    pub(super) fn of(
        &mut self,
        ctx: &egui::Context,
        name: &str,
        slice: &Arc<Slice>,
        window: (f32, f32),
    ) -> Option<egui::TextureId> {
        let is_same = self.of.as_ref().is_some_and(|(of, w)| Arc::ptr_eq(of, slice) && *w == window);
        if !is_same {
            let image = grey(slice, window);
            match &mut self.texture {
                Some(texture) => texture.set(image, TextureOptions::LINEAR),
                None => self.texture = Some(ctx.load_texture(name, image, TextureOptions::LINEAR)),
            }
            self.of = Some((slice.clone(), window));
        }
        self.id()
    }

    /// The newest texture.
    pub(super) fn id(&self) -> Option<egui::TextureId> {
        self.texture.as_ref().map(TextureHandle::id)
    }
}

/// A slice in grey: black at the low end of the window and below, white at the high end and above.
pub(super) fn grey(slice: &Slice, (lo, hi): (f32, f32)) -> ColorImage {
    let size = slice.size.map(|side| side as usize);
    let of_code = |code: usize| {
        let t = (slice.value_from_code(code as f32) - lo) / (hi - lo);
        Color32::from_gray((t.clamp(0.0, 1.0) * 255.0).round() as u8)
    };
    let pixels = match &slice.codes {
        SliceCodes::U8(codes) => {
            let table: Vec<Color32> = (0..256).map(of_code).collect();
            codes.iter().map(|code| table[usize::from(*code)]).collect()
        }
        SliceCodes::U16(codes) => {
            let greatest = usize::from(codes.iter().copied().max().unwrap_or(0));
            let table: Vec<Color32> = (0..=greatest).map(of_code).collect();
            codes.iter().map(|code| table[usize::from(*code)]).collect()
        }
    };
    ColorImage::new(size, pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_grey_between_the_ends_of_the_window() {
        let codes = SliceCodes::U16(vec![0, 100, 150, 200, 65535]);
        let slice = Slice { size: [5, 1], lo: -1000.0, step: 10.0, codes };
        let greys = |window| grey(&slice, window).pixels.iter().map(|p| p.r()).collect::<Vec<_>>();
        assert_eq!(greys((0.0, 1000.0)), [0, 0, 128, 255, 255]);
        assert_eq!(greys((-1000.0, 3000.0)), [0, 64, 96, 128, 255]);
        let bytes = Slice { codes: SliceCodes::U8(vec![0, 100, 150, 200, 255]), ..slice };
        assert_eq!(grey(&bytes, (0.0, 1000.0)).pixels[2].r(), 128);
    }
}
