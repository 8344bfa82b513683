//! Pictures in premultiplied linear RGBA, and their conversion to 8-bit sRGB.

/// Premultiplied linear RGBA, row by row from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Pixels: red, green, blue, opacity.
    pub pixels: Vec<[f32; 4]>,
}

impl Picture {
    /// A transparent picture.
    pub fn new(width: u32, height: u32) -> Self {
        Self { width, height, pixels: vec![[0.0; 4]; width as usize * height as usize] }
    }

    /// The same without `margin` pixels on every side; empty if the picture is not larger than that.
    pub fn cropped(&self, margin: u32) -> Self {
        let less = |side: u32| side.saturating_sub(2 * margin);
        let mut inner = Self::new(less(self.width), less(self.height));
        let rows = self.pixels.chunks(self.width.max(1) as usize).skip(margin as usize);
        for (to, from) in inner.pixels.chunks_mut(inner.width.max(1) as usize).zip(rows) {
            to.copy_from_slice(&from[margin as usize..][..to.len()]);
        }
        inner
    }

    /// The picture with its transparency, encoded as 8-bit sRGB with straight opacity, four bytes per pixel.
    pub fn to_srgba8(&self) -> Vec<u8> {
        let byte = |x: f32| (x * 255.0 + 0.5) as u8;
        let mut out = Vec::with_capacity(self.pixels.len() * 4);
        for p in &self.pixels {
            let opacity = p[3].clamp(0.0, 1.0);
            let color = |ch: usize| if opacity > 0.0 { byte(srgb_from_linear(p[ch] / opacity)) } else { 0 };
            out.extend([color(0), color(1), color(2), byte(opacity)]);
        }
        out
    }

    /// The picture over an opaque linear background, encoded as 8-bit sRGB, three bytes per pixel.
    pub fn to_srgb8(&self, background: [f32; 3]) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.pixels.len() * 3);
        for p in &self.pixels {
            for ch in 0..3 {
                let linear = p[ch] + (1.0 - p[3]) * background[ch];
                out.push((srgb_from_linear(linear) * 255.0 + 0.5) as u8);
            }
        }
        out
    }
}

/// sRGB encoding of a linear value (IEC 61966-2-1), clamped to [0, 1].
pub fn srgb_from_linear(x: f32) -> f32 {
    if x <= 0.003_130_8 { 12.92 * x.max(0.0) } else { (1.055 * x.powf(1.0 / 2.4) - 0.055).min(1.0) }
}

/// Inverse of [`srgb_from_linear`] on [0, 1].
pub fn linear_from_srgb(x: f32) -> f32 {
    if x <= 0.040_45 { x.max(0.0) / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transparent_picture_looks_over_black_as_it_did() {
        let mut p = Picture::new(3, 1);
        p.pixels = vec![[0.0; 4], [0.1, 0.2, 0.05, 0.5], [0.3, 0.6, 0.9, 1.0]];
        let (rgba, rgb) = (p.to_srgba8(), p.to_srgb8([0.0; 3]));
        assert_eq!(rgba[..4], [0; 4]);
        assert_eq!((&rgba[8..11], rgba[11]), (&rgb[6..9], 255), "what is opaque is the same");
        for ch in 0..3 {
            let straight = linear_from_srgb(f32::from(rgba[4 + ch]) / 255.0) * f32::from(rgba[7]) / 255.0;
            assert!((straight - p.pixels[1][ch]).abs() < 0.01);
        }
        assert_ne!(rgba[4], rgb[3], "control: straight colours are brighter");
    }

    #[test]
    fn cropping_keeps_the_middle() {
        let mut p = Picture::new(5, 4);
        (0..20).for_each(|i| p.pixels[i][0] = i as f32);
        let reds = |p: &Picture| p.pixels.iter().map(|p| p[0]).collect::<Vec<_>>();
        assert_eq!(p.cropped(0), p);
        assert_eq!(reds(&p.cropped(1)), [6.0, 7.0, 8.0, 11.0, 12.0, 13.0]);
        assert!(p.cropped(2).pixels.is_empty());
    }
}
