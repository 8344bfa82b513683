// Conversion for the screen. Twin of crates/core/src/picture.rs.

// sRGB encoding of a linear value (IEC 61966-2-1), clamped to [0, 1].
fn srgb_from_linear(x: f32) -> f32 {
    if (x <= 0.0031308) {
        return 12.92 * max(x, 0.0);
    }
    return min(1.055 * pow(x, 1.0 / 2.4) - 0.055, 1.0);
}
