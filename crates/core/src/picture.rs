//! A picture: premultiplied linear RGBA in floats, and its way to 8-bit sRGB.

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

    /// The picture over an opaque linear background, encoded as 8-bit sRGB, three bytes a pixel.
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
