//! Grey pictures of slices: values become grey by level and window, here and at once.

use std::sync::Arc;

use egui::{Color32, ColorImage, TextureHandle, TextureOptions};
use isinglass_core::volume::{Slice, SliceCodes, SliceGrid};

/// The texture of a slice under a window. It is made anew when either changes.
#[derive(Default)]
pub(super) struct SliceTexture {
    texture: Option<TextureHandle>,
    of: Option<(Arc<Slice>, Window)>,
    /// The greatest code of the slice.
    greatest: usize,
}

/// The values shown black and white, and how many columns and rows a pixel stands for.
type Window = ((f32, f32), usize);

impl SliceTexture {
    /// The texture, and where its pixels lie. Of each `stride` columns and rows, one is taken.
    pub(super) fn of(
        &mut self,
        ctx: &egui::Context,
        name: &str,
        (slice, grid): (&Arc<Slice>, &SliceGrid),
        (window, stride): Window,
    ) -> Option<(egui::TextureId, SliceGrid)> {
        let before = self.of.as_ref().map(|(of, window)| (Arc::ptr_eq(of, slice), *window));
        if before != Some((true, (window, stride))) {
            if before.is_none_or(|(is_same, _)| !is_same) {
                self.greatest = greatest_code(slice);
            }
            let image = grey(slice, window, stride, self.greatest);
            match &mut self.texture {
                Some(texture) => texture.set(image, TextureOptions::LINEAR),
                None => self.texture = Some(ctx.load_texture(name, image, TextureOptions::LINEAR)),
            }
            self.of = Some((slice.clone(), (window, stride)));
        }
        self.placed(grid)
    }

    /// The newest texture of a slice with this grid, and where its pixels lie.
    pub(super) fn placed(&self, grid: &SliceGrid) -> Option<(egui::TextureId, SliceGrid)> {
        let stride = self.of.as_ref()?.1.1;
        let size = grid.size.map(|side| side.div_ceil(stride as u32));
        let [column, row] = [grid.column, grid.row].map(|step| step * stride as f32);
        Some((self.texture.as_ref()?.id(), SliceGrid { column, row, size, ..*grid }))
    }
}

fn greatest_code(slice: &Slice) -> usize {
    match &slice.codes {
        SliceCodes::U8(_) => 255,
        SliceCodes::U16(codes) => usize::from(codes.iter().copied().max().unwrap_or(0)),
    }
}

/// A slice in grey: black at the low end of the window and below, white at the high end and above.
fn grey(slice: &Slice, (lo, hi): (f32, f32), stride: usize, greatest: usize) -> ColorImage {
    let of_code = |code: usize| {
        let t = (slice.value_from_code(code as f32) - lo) / (hi - lo);
        Color32::from_gray((t.clamp(0.0, 1.0) * 255.0).round() as u8)
    };
    let table: Vec<Color32> = (0..=greatest).map(of_code).collect();
    let [width, height] = slice.size.map(|side| side as usize);
    let at = |row: usize| (0..width).step_by(stride).map(move |column| row * width + column);
    let places = (0..height).step_by(stride).flat_map(at);
    let pixels = match &slice.codes {
        SliceCodes::U8(codes) => places.map(|at| table[usize::from(codes[at])]).collect(),
        SliceCodes::U16(codes) => places.map(|at| table[usize::from(codes[at])]).collect(),
    };
    ColorImage::new([width, height].map(|side| side.div_ceil(stride)), pixels)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    #[test]
    fn values_are_grey_between_the_ends_of_the_window() {
        let codes = SliceCodes::U16(vec![0, 100, 150, 200, 65535]);
        let slice = Slice { size: [5, 1], lo: -1000.0, step: 10.0, codes };
        let greys = |window| grey(&slice, window, 1, 65535).pixels.iter().map(|p| p.r()).collect::<Vec<_>>();
        assert_eq!(greys((0.0, 1000.0)), [0, 0, 128, 255, 255]);
        assert_eq!(greys((-1000.0, 3000.0)), [0, 64, 96, 128, 255]);
        let bytes = Slice { codes: SliceCodes::U8(vec![0, 100, 150, 200, 255]), ..slice };
        assert_eq!(grey(&bytes, (0.0, 1000.0), 1, greatest_code(&bytes)).pixels[2].r(), 128);
    }

    #[test]
    fn a_slice_with_more_voxels_than_the_pane_has_pixels_is_thinned() {
        let codes = SliceCodes::U16((0..35).map(|i| i * 1000).collect());
        let slice = Arc::new(Slice { size: [7, 5], lo: 0.0, step: 1.0, codes });
        let grid = SliceGrid { origin: Vec3::Y, column: Vec3::X, row: Vec3::Z * 2.0, size: slice.size };
        let mut texture = SliceTexture::default();
        let ctx = egui::Context::default();
        let mut placed = |stride| texture.of(&ctx, "a", (&slice, &grid), ((0.0, 34000.0), stride)).unwrap().1;
        assert_eq!(placed(1), grid);
        let thin = placed(3);
        assert_eq!(thin.size, [3, 2]);
        let image = grey(&slice, (0.0, 34000.0), 3, greatest_code(&slice));
        assert_eq!(image.size, [3, 2]);
        for (row, column) in [(0, 0), (1, 2)] {
            assert_eq!(
                thin.point(column as f32, row as f32),
                grid.point(3.0 * column as f32, 3.0 * row as f32)
            );
            let code = (3 * row * 7 + 3 * column) as f32 * 1000.0;
            assert_eq!(image.pixels[row * 3 + column].r(), (code / 34000.0 * 255.0).round() as u8);
        }
    }
}
