//! The difference of two pictures: SSIM, DSSIM, PSNR and the greatest difference.
//!
//! SSIM follows Wang 2004 to the letter: luma, an 11×11 Gaussian window with σ = 1.5 that sums to one, K1 = 0.01, K2
//! = 0.03, data range 255, weighted (biased) moments. Beyond its edges the picture is mirrored (`d c b a | a b c d |
//! d c b a`), so the mean covers every pixel. Luma is Wang's `rgb2gray`: 0.299 R + 0.587 G + 0.114 B of the 8-bit
//! sRGB numbers, not rounded.
//!
//! A black background flatters a mean over all pixels, so DSSIM is also given over the object's bounding rectangle.

use rayon::prelude::*;
use serde::Serialize;

/// The error measures of a pair of pictures; symmetric in the two.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ImageError {
    /// (1 − SSIM)/2: 0 for equal pictures, at most 1.
    pub dssim: f64,
    /// Mean structural similarity over all pixels, −1 to 1.
    pub ssim: f64,
    /// Peak signal-to-noise ratio over red, green and blue, decibels; at most [`PSNR_CAP_DB`].
    pub psnr_db: f64,
    /// Greatest difference of any channel of any pixel, 0 to 255.
    pub max_abs_255: u8,
    /// DSSIM over the bounding rectangle of all pixels that are not background in either picture; 0 if there are
    /// none.
    pub dssim_object: f64,
}

/// Why two pictures cannot be compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ImageErrorError {
    /// A picture without pixels has no mean.
    #[error("picture is {width}x{height}, expected at least 1x1")]
    Empty {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// The bytes are not those of a picture of the stated size.
    #[error("picture {which} has {found} bytes, expected {expected} for {width}x{height} RGB")]
    Size {
        /// Which picture, 1 or 2.
        which: u8,
        /// Bytes given.
        found: usize,
        /// Bytes needed.
        expected: usize,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
}

/// Compares two 8-bit RGB pictures (row by row, three bytes per pixel). `background` is the colour that does not
/// count as object.
pub fn compare(
    a: &[u8],
    b: &[u8],
    width: usize,
    height: usize,
    background: [u8; 3],
) -> Result<ImageError, ImageErrorError> {
    if width == 0 || height == 0 {
        return Err(ImageErrorError::Empty { width, height });
    }
    let expected = width.saturating_mul(height).saturating_mul(3);
    for (which, bytes) in [(1, a), (2, b)] {
        if bytes.len() != expected {
            return Err(ImageErrorError::Size { which, found: bytes.len(), expected, width, height });
        }
    }
    let rect = object_rect(a, b, width, background);
    let (all, object) = ssim_sums(&luma(a), &luma(b), width, height, rect);
    let ssim = all / (width * height) as f64;
    let dssim_object = match rect.num_pixels() {
        0 => 0.0,
        n => (1.0 - object / n as f64) / 2.0,
    };

    let mut sum_of_squares = 0u64;
    let mut max_abs_255 = 0;
    for (&x, &y) in a.iter().zip(b) {
        let d = x.abs_diff(y);
        sum_of_squares += u64::from(d) * u64::from(d);
        max_abs_255 = max_abs_255.max(d);
    }
    let mse = sum_of_squares as f64 / expected as f64;
    // Equal pictures give an infinite ratio, which the cap makes finite.
    let psnr_db = (10.0 * (RANGE * RANGE / mse).log10()).min(PSNR_CAP_DB);
    Ok(ImageError { dssim: (1.0 - ssim) / 2.0, ssim, psnr_db, max_abs_255, dssim_object })
}

/// Greatest PSNR: equal pictures get it, so that reports stay finite.
pub const PSNR_CAP_DB: f64 = 100.0;

/// A rectangle of pixels; `x1` and `y1` are exclusive.
#[derive(Clone, Copy)]
struct Rect {
    x0: usize,
    x1: usize,
    y0: usize,
    y1: usize,
}

impl Rect {
    fn num_pixels(&self) -> usize {
        self.x1.saturating_sub(self.x0) * self.y1.saturating_sub(self.y0)
    }
}

fn object_rect(a: &[u8], b: &[u8], width: usize, background: [u8; 3]) -> Rect {
    let mut rect = Rect { x0: usize::MAX, x1: 0, y0: usize::MAX, y1: 0 };
    for (i, (p, q)) in a.chunks_exact(3).zip(b.chunks_exact(3)).enumerate() {
        if p != background || q != background {
            let (x, y) = (i % width, i / width);
            rect.x0 = rect.x0.min(x);
            rect.x1 = rect.x1.max(x + 1);
            rect.y0 = rect.y0.min(y);
            rect.y1 = rect.y1.max(y + 1);
        }
    }
    rect
}

fn luma(rgb: &[u8]) -> Vec<f64> {
    rgb.chunks_exact(3)
        .map(|p| 0.299 * f64::from(p[0]) + 0.587 * f64::from(p[1]) + 0.114 * f64::from(p[2]))
        .collect()
}

/// The sums of SSIM over all pixels and over `rect`. Rows are independent; their sums are added in order, so the
/// result does not depend on the number of threads.
fn ssim_sums(a: &[f64], b: &[f64], width: usize, height: usize, rect: Rect) -> (f64, f64) {
    let window = gaussian_window();
    let rows: Vec<(f64, f64)> = (0..height)
        .into_par_iter()
        .map_init(
            || RowMoments::new(width),
            |scratch, y| {
                scratch.filter_vertically(a, b, y, height, &window);
                let mut all = 0.0;
                let mut object = 0.0;
                let row_in_rect = (rect.y0..rect.y1).contains(&y);
                for x in 0..width {
                    let s = scratch.ssim(x, &window);
                    all += s;
                    if row_in_rect && (rect.x0..rect.x1).contains(&x) {
                        object += s;
                    }
                }
                (all, object)
            },
        )
        .collect();
    rows.iter().fold((0.0, 0.0), |(s, t), (all, object)| (s + all, t + object))
}

/// The five vertically filtered moments of one row (a, b, a², b², ab), with mirrored margins of [`REACH`].
struct RowMoments {
    width: usize,
    moments: [Vec<f64>; 5],
}

impl RowMoments {
    fn new(width: usize) -> Self {
        Self { width, moments: std::array::from_fn(|_| vec![0.0; width + 2 * REACH]) }
    }

    fn filter_vertically(&mut self, a: &[f64], b: &[f64], y: usize, height: usize, window: &[f64; WINDOW]) {
        let width = self.width;
        for m in &mut self.moments {
            m[REACH..REACH + width].fill(0.0);
        }
        let [ma, mb, maa, mbb, mab] = self.moments.each_mut().map(|m| &mut m[REACH..REACH + width]);
        for (tap, &w) in window.iter().enumerate() {
            let row = mirrored(y as isize + tap as isize - REACH as isize, height) * width;
            let (a, b) = (&a[row..row + width], &b[row..row + width]);
            for x in 0..width {
                // Multiplying the pixels first makes the result independent of the pictures' order.
                ma[x] += w * a[x];
                mb[x] += w * b[x];
                maa[x] += w * (a[x] * a[x]);
                mbb[x] += w * (b[x] * b[x]);
                mab[x] += w * (a[x] * b[x]);
            }
        }
        for m in &mut self.moments {
            for i in 0..REACH {
                m[i] = m[REACH + mirrored(i as isize - REACH as isize, width)];
                m[REACH + width + i] = m[REACH + mirrored((width + i) as isize, width)];
            }
        }
    }

    fn ssim(&self, x: usize, window: &[f64; WINDOW]) -> f64 {
        let [a, b, aa, bb, ab] = self
            .moments
            .each_ref()
            .map(|m| m[x..x + WINDOW].iter().zip(window).map(|(value, w)| value * w).sum::<f64>());
        let (variance_a, variance_b, covariance) = (aa - a * a, bb - b * b, ab - a * b);
        (2.0 * a * b + C1) * (2.0 * covariance + C2) / ((a * a + b * b + C1) * (variance_a + variance_b + C2))
    }
}

/// Mirrors an index at the edges of `0..n`, repeatedly for pictures smaller than the window.
fn mirrored(i: isize, n: usize) -> usize {
    let i = i.rem_euclid(2 * n as isize) as usize;
    if i < n { i } else { 2 * n - 1 - i }
}

/// The one-dimensional factor of the window; sums to one.
fn gaussian_window() -> [f64; WINDOW] {
    let raw: [f64; WINDOW] = std::array::from_fn(|i| {
        let d = i as f64 - REACH as f64;
        (-d * d / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|w| w / sum)
}

const WINDOW: usize = 11;
const REACH: usize = WINDOW / 2;
const SIGMA: f64 = 1.5;
const RANGE: f64 = 255.0;
const C1: f64 = (0.01 * RANGE) * (0.01 * RANGE);
const C2: f64 = (0.03 * RANGE) * (0.03 * RANGE);

#[cfg(test)]
mod tests {
    use super::*;

    const BLACK: [u8; 3] = [0; 3];

    /// A seeded picture of gradients and noise.
    fn picture(width: usize, height: usize, seed: u32) -> Vec<u8> {
        let mut state = seed;
        (0..width * height * 3)
            .map(|i| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                ((i / 3 % width) * 120 / width + (state >> 26) as usize) as u8 + 40
            })
            .collect()
    }

    fn constant(value: u8, width: usize, height: usize) -> Vec<u8> {
        vec![value; width * height * 3]
    }

    #[test]
    fn equal_pictures_have_no_error_and_any_change_shows() {
        let a = picture(40, 30, 1);
        let same = compare(&a, &a, 40, 30, BLACK).unwrap();
        let expect =
            ImageError { dssim: 0.0, ssim: 1.0, psnr_db: PSNR_CAP_DB, max_abs_255: 0, dssim_object: 0.0 };
        // Exact: numerator and denominator are the same products when both pictures are the same.
        assert_eq!(same, expect);
        let mut b = a.clone();
        b[17] += 1;
        let changed = compare(&a, &b, 40, 30, BLACK).unwrap();
        assert!(changed.dssim > 0.0 && changed.psnr_db < PSNR_CAP_DB && changed.max_abs_255 == 1);
    }

    #[test]
    fn constant_pictures_differ_by_luminance_alone() {
        for (p, q) in [(0u8, 255u8), (100, 110), (7, 200)] {
            let e = compare(&constant(p, 20, 13), &constant(q, 20, 13), 20, 13, BLACK).unwrap();
            let (x, y) = (f64::from(p), f64::from(q));
            let ssim = (2.0 * x * y + C1) / (x * x + y * y + C1);
            // Moments near 255² cancel in doubles to about 1e-11; C2 is 58.5.
            assert!((e.ssim - ssim).abs() < 1e-9, "{} {ssim}", e.ssim);
            assert!((e.dssim - (1.0 - ssim) / 2.0).abs() < 1e-9);
            let psnr = 20.0 * (255.0 / (x - y).abs()).log10();
            assert!((e.psnr_db - psnr).abs() < 1e-9);
            assert_eq!(e.max_abs_255, q - p);
        }
    }

    #[test]
    fn separable_filter_equals_wangs_sum_over_the_window() {
        let (width, height) = (17, 9);
        let (a, b) = (picture(width, height, 3), picture(width, height, 4));
        let (la, lb) = (luma(&a), luma(&b));
        let w = gaussian_window();
        let mut sum = 0.0;
        for y in 0..height as isize {
            for x in 0..width as isize {
                let mut tap = vec![];
                for j in 0..WINDOW as isize {
                    for i in 0..WINDOW as isize {
                        let at = mirrored(y + j - 5, height) * width + mirrored(x + i - 5, width);
                        tap.push((w[i as usize] * w[j as usize], la[at], lb[at]));
                    }
                }
                let mean = |f: &dyn Fn(f64, f64) -> f64| tap.iter().map(|t| t.0 * f(t.1, t.2)).sum::<f64>();
                let (ma, mb) = (mean(&|p, _| p), mean(&|_, q| q));
                let va = mean(&|p, _| (p - ma) * (p - ma));
                let vb = mean(&|_, q| (q - mb) * (q - mb));
                let vab = mean(&|p, q| (p - ma) * (q - mb));
                sum += (2.0 * ma * mb + C1) * (2.0 * vab + C2) / ((ma * ma + mb * mb + C1) * (va + vb + C2));
            }
        }
        let e = compare(&a, &b, width, height, BLACK).unwrap();
        // Rounding of doubles only; independent noise must also be seen as such.
        assert!((e.ssim - sum / (width * height) as f64).abs() < 1e-10);
        assert!(e.ssim < 0.9, "{}", e.ssim);
        assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-15);
    }

    #[test]
    fn symmetric_also_for_pictures_smaller_than_the_window() {
        for (width, height) in [(1, 1), (1, 7), (3, 2), (64, 5)] {
            let (a, b) = (picture(width, height, 5), picture(width, height, 6));
            let e = compare(&a, &b, width, height, BLACK).unwrap();
            assert_eq!(e, compare(&b, &a, width, height, BLACK).unwrap());
            assert!(e.ssim.is_finite() && e.dssim_object == e.dssim);
        }
    }

    #[test]
    fn object_is_the_rectangle_of_what_is_not_background() {
        let (width, height) = (64, 64);
        let background = [10, 20, 30];
        let mut a: Vec<u8> = background.repeat(width * height);
        let mut b = a.clone();
        assert_eq!(compare(&a, &b, width, height, background).unwrap().dssim_object, 0.0);
        for y in 20..30 {
            for x in 40..52 {
                a[(y * width + x) * 3] = 200;
                b[(y * width + x) * 3] = 100 + (x % 3) as u8;
            }
        }
        let e = compare(&a, &b, width, height, background).unwrap();
        let rect = object_rect(&a, &b, width, background);
        assert_eq!((rect.x0, rect.x1, rect.y0, rect.y1), (40, 52, 20, 30));
        assert!(e.dssim_object > 4.0 * e.dssim, "{e:?}");
        // With a background that occurs nowhere the rectangle is the whole picture.
        let whole = compare(&a, &b, width, height, [1, 1, 1]).unwrap();
        assert!((whole.dssim_object - whole.dssim).abs() < 1e-12);
    }

    #[test]
    fn wrong_sizes_are_named() {
        let a = constant(1, 4, 4);
        assert_eq!(
            compare(&a, &a[1..], 4, 4, BLACK),
            Err(ImageErrorError::Size { which: 2, found: 47, expected: 48, width: 4, height: 4 })
        );
        assert_eq!(compare(&[], &[], 0, 4, BLACK), Err(ImageErrorError::Empty { width: 0, height: 4 }));
        assert!(compare(&a, &a, usize::MAX, 2, BLACK).is_err());
    }
}
