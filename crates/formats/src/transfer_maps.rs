//! Colour maps, and their combination with the opacities of a transfer function.

use isinglass_core::transfer::{ControlPoint, MAX_POINTS, TransferFunction};

/// A colour map: sRGB over positions from 0 to 1.
#[derive(Clone, Copy, Debug)]
pub struct ColorMap {
    name: &'static str,
    kind: MapKind,
}

#[derive(Clone, Copy, Debug)]
enum MapKind {
    Gradient(colorous::Gradient),
    /// Positions and colours, linear between them.
    Points(&'static [(f32, [f32; 3])]),
    /// Moreland's interpolation between two colours, over white.
    Diverging([f32; 3], [f32; 3]),
}

impl ColorMap {
    /// All maps, in the order of lists.
    pub fn all() -> impl Iterator<Item = Self> {
        MAPS.iter().map(|&(name, kind)| Self { name, kind })
    }

    /// The map of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::all().find(|map| map.name == name)
    }

    /// Its name.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// The colour at a position. Positions outside of 0 to 1 have the colour of the end.
    pub fn at(&self, t: f32) -> [f32; 3] {
        let t = t.clamp(0.0, 1.0);
        match self.kind {
            MapKind::Gradient(gradient) => {
                let c = gradient.eval_continuous(f64::from(t));
                [c.r, c.g, c.b].map(|c| f32::from(c) / 255.0)
            }
            MapKind::Points(points) => color_between(points, ColorSpace::Rgb, t),
            MapKind::Diverging(low, high) => diverging(low, high, t),
        }
    }

    /// Returns `transfer` with the colours of this map over its whole domain. Its opacities stay.
    pub fn onto(&self, transfer: &TransferFunction) -> TransferFunction {
        recolored(transfer, &|x| self.at(x))
    }
}

/// The space in which colours between two points are interpolated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ColorSpace {
    /// sRGB.
    Rgb,
    /// Hue, saturation and value. The hue takes the shorter way.
    Hsv,
    /// CIELAB under D65.
    Lab,
    /// Moreland's Msh, through white between distant hues.
    Diverging,
    /// The colour of the point before.
    Step,
}

/// The colour at `x` between points with ascending positions. There must be a point.
pub(crate) fn color_between(points: &[(f32, [f32; 3])], space: ColorSpace, x: f32) -> [f32; 3] {
    let after = points.partition_point(|p| p.0 <= x);
    let Some(&(x1, b)) = points.get(after) else { return points[points.len() - 1].1 };
    let Some(&(x0, a)) = after.checked_sub(1).and_then(|i| points.get(i)) else { return b };
    let t = (x - x0) / (x1 - x0);
    let mix = |a: [f32; 3], b: [f32; 3]| -> [f32; 3] { std::array::from_fn(|i| a[i] + (b[i] - a[i]) * t) };
    match space {
        ColorSpace::Rgb => mix(a, b),
        ColorSpace::Step => a,
        ColorSpace::Lab => rgb_from_lab(mix(lab_from_rgb(a), lab_from_rgb(b))),
        ColorSpace::Diverging => diverging(a, b, t),
        ColorSpace::Hsv => {
            let (mut a, mut b) = (hsv_from_rgb(a), hsv_from_rgb(b));
            match b[0] - a[0] {
                d if d > 0.5 => a[0] += 1.0,
                d if d < -0.5 => b[0] += 1.0,
                _ => {}
            }
            rgb_from_hsv(mix(a, b))
        }
    }
}

/// Returns `transfer` with other colours and the same opacities. Points that only serve colours are removed. New
/// points keep every colour within [`COLOR_TOLERANCE`].
pub(crate) fn recolored(transfer: &TransferFunction, color_at: &dyn Fn(f32) -> [f32; 3]) -> TransferFunction {
    let mut ends = transfer.points.clone();
    // Beyond the last point its opacity holds, but its colour does not.
    if let Some(first) = ends.first().filter(|p| p.x > 0.0 && p.opacity > 0.0) {
        ends.insert(0, ControlPoint { x: 0.0, ..*first });
    }
    if let Some(last) = ends.last().filter(|p| p.x < 1.0 && p.opacity > 0.0) {
        ends.push(ControlPoint { x: 1.0, ..*last });
    }
    let skeleton = without_straight_points(&ends);
    let mut tolerance = COLOR_TOLERANCE;
    loop {
        let mut points = Vec::with_capacity(2 * skeleton.len());
        for (i, p) in skeleton.iter().enumerate() {
            points.push(ControlPoint { color: color_at(p.x), ..*p });
            // Colours between clear points are invisible.
            let is_seen = |next: &&ControlPoint| next.x > p.x && p.opacity.max(next.opacity) > 0.0;
            if let Some(next) = skeleton.get(i + 1).filter(is_seen) {
                fill(&mut points, p, next, color_at, tolerance, MAX_SPLITS);
            }
        }
        if points.len() <= MAX_POINTS || tolerance > 1.0 {
            points.truncate(MAX_POINTS);
            return TransferFunction { points, ..transfer.clone() };
        }
        tolerance *= 2.0;
    }
}

/// Removes the points at which the opacity is straight.
fn without_straight_points(points: &[ControlPoint]) -> Vec<ControlPoint> {
    let mut kept: Vec<ControlPoint> = Vec::with_capacity(points.len());
    for (i, p) in points.iter().enumerate() {
        let is_straight = match (kept.last(), points.get(i + 1)) {
            // Comparing with the last kept point keeps errors from adding up.
            (Some(a), Some(b)) if a.x < p.x && p.x < b.x => {
                let t = (p.x - a.x) / (b.x - a.x);
                (a.opacity + (b.opacity - a.opacity) * t - p.opacity).abs() < OPACITY_TOLERANCE
            }
            _ => false,
        };
        if !is_straight {
            kept.push(*p);
        }
    }
    kept
}

/// Adds points between two others until colours between points are nearly straight.
fn fill(
    points: &mut Vec<ControlPoint>,
    a: &ControlPoint,
    b: &ControlPoint,
    color_at: &dyn Fn(f32) -> [f32; 3],
    tolerance: f32,
    splits: u32,
) {
    let (start, end) = (color_at(a.x), color_at(b.x));
    let mut worst = (tolerance, None);
    for i in 1..SAMPLES {
        let t = i as f32 / SAMPLES as f32;
        let x = a.x + (b.x - a.x) * t;
        let color = color_at(x);
        let off = |c: usize| (start[c] + (end[c] - start[c]) * t - color[c]).abs();
        let off = off(0).max(off(1)).max(off(2));
        if off > worst.0 {
            worst = (off, Some((t, x, color)));
        }
    }
    let (Some((t, x, color)), Some(splits)) = (worst.1, splits.checked_sub(1)) else { return };
    let middle = ControlPoint { x, color, opacity: a.opacity + (b.opacity - a.opacity) * t };
    fill(points, a, &middle, color_at, tolerance, splits);
    points.push(middle);
    fill(points, &middle, b, color_at, tolerance, splits);
}

/// The colour between `low` and `high` in polar CIELAB. White is in the middle of distant hues (Moreland 2009,
/// Diverging Color Maps for Scientific Visualization).
fn diverging(low: [f32; 3], high: [f32; 3], t: f32) -> [f32; 3] {
    let (mut a, mut b, mut t) = (msh_from_rgb(low), msh_from_rgb(high), t);
    let apart = (a[2] - b[2]).abs();
    let apart = apart.min(std::f32::consts::TAU - apart);
    if a[1] > GREY_SATURATION && b[1] > GREY_SATURATION && apart > std::f32::consts::FRAC_PI_3 {
        let middle = a[0].max(b[0]).max(88.0);
        (a, b, t) =
            if t < 0.5 { (a, [middle, 0.0, 0.0], 2.0 * t) } else { ([middle, 0.0, 0.0], b, 2.0 * t - 1.0) };
    }
    if a[1] < GREY_SATURATION && b[1] > GREY_SATURATION {
        a[2] = adjusted_hue(b, a[0]);
    } else if b[1] < GREY_SATURATION && a[1] > GREY_SATURATION {
        b[2] = adjusted_hue(a, b[0]);
    }
    rgb_from_msh(std::array::from_fn(|i| a[i] + (b[i] - a[i]) * t))
}

/// The hue of an unsaturated end of magnitude `m` that makes the way to `from` even.
fn adjusted_hue([from_m, s, h]: [f32; 3], m: f32) -> f32 {
    if from_m >= m {
        return h;
    }
    let spin = s * (m * m - from_m * from_m).sqrt() / (from_m * s.sin());
    if h > -std::f32::consts::FRAC_PI_3 { h + spin } else { h - spin }
}

fn msh_from_rgb(rgb: [f32; 3]) -> [f32; 3] {
    let [l, a, b] = lab_from_rgb(rgb);
    let m = (l * l + a * a + b * b).sqrt();
    let s = if m > 1e-3 { (l / m).clamp(-1.0, 1.0).acos() } else { 0.0 };
    [m, s, if s > 1e-3 { b.atan2(a) } else { 0.0 }]
}

fn rgb_from_msh([m, s, h]: [f32; 3]) -> [f32; 3] {
    rgb_from_lab([m * s.cos(), m * s.sin() * h.cos(), m * s.sin() * h.sin()])
}

/// Converts through XYZ (IEC 61966-2-1 and CIE 15).
fn lab_from_rgb(rgb: [f32; 3]) -> [f32; 3] {
    let [r, g, b] = rgb.map(isinglass_core::picture::linear_from_srgb);
    let f = |v: f32| if v > 0.008_856 { v.cbrt() } else { 7.787 * v + 16.0 / 116.0 };
    let x = f((0.4124 * r + 0.3576 * g + 0.1805 * b) / WHITE[0]);
    let y = f((0.2126 * r + 0.7152 * g + 0.0722 * b) / WHITE[1]);
    let z = f((0.0193 * r + 0.1192 * g + 0.9505 * b) / WHITE[2]);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

fn rgb_from_lab([l, a, b]: [f32; 3]) -> [f32; 3] {
    let y = (l + 16.0) / 116.0;
    let f = |v: f32| if v.powi(3) > 0.008_856 { v.powi(3) } else { (v - 16.0 / 116.0) / 7.787 };
    let (x, y, z) = (f(a / 500.0 + y) * WHITE[0], f(y) * WHITE[1], f(y - b / 200.0) * WHITE[2]);
    let linear = [
        3.2406 * x - 1.5372 * y - 0.4986 * z,
        -0.9689 * x + 1.8758 * y + 0.0415 * z,
        0.0557 * x - 0.2040 * y + 1.0570 * z,
    ];
    linear.map(|c| isinglass_core::picture::srgb_from_linear(c.clamp(0.0, 1.0)).clamp(0.0, 1.0))
}

fn hsv_from_rgb([r, g, b]: [f32; 3]) -> [f32; 3] {
    let (most, least) = (r.max(g).max(b), r.min(g).min(b));
    let range = most - least;
    let sixth = match range {
        0.0 => 0.0,
        d if most == r => (g - b) / d,
        d if most == g => 2.0 + (b - r) / d,
        d => 4.0 + (r - g) / d,
    };
    [(sixth / 6.0).rem_euclid(1.0), if most > 0.0 { range / most } else { 0.0 }, most]
}

fn rgb_from_hsv([h, s, v]: [f32; 3]) -> [f32; 3] {
    // How far each channel is below the value, over the hue in sixths.
    let channel = |shift: f32| {
        let k = (shift + h * 6.0).rem_euclid(6.0);
        (v - v * s * k.min(4.0 - k).clamp(0.0, 1.0)).clamp(0.0, 1.0)
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}

/// White point of D65.
const WHITE: [f32; 3] = [0.9505, 1.0, 1.089];
/// Saturation below which a colour has no hue (Moreland 2009).
const GREY_SATURATION: f32 = 0.05;

/// Colour tolerance: two steps of eight bits, the error of maps that are tables of bytes.
const COLOR_TOLERANCE: f32 = 2.5 / 255.0;
/// A point that changes the opacity by less only serves its colour.
const OPACITY_TOLERANCE: f32 = 1e-5;
/// Positions between two points at which colours are compared.
const SAMPLES: u32 = 32;
/// Most halvings between two points. 2⁶ parts make a curve straight, and a jump a ramp of a thousandth.
const MAX_SPLITS: u32 = 6;

const BLACK: [f32; 3] = [0.0; 3];
const WHITE_RGB: [f32; 3] = [1.0; 3];

const MAPS: &[(&str, MapKind)] = &[
    ("viridis", MapKind::Gradient(colorous::VIRIDIS)),
    ("inferno", MapKind::Gradient(colorous::INFERNO)),
    ("magma", MapKind::Gradient(colorous::MAGMA)),
    ("plasma", MapKind::Gradient(colorous::PLASMA)),
    ("cividis", MapKind::Gradient(colorous::CIVIDIS)),
    ("turbo", MapKind::Gradient(colorous::TURBO)),
    ("cubehelix", MapKind::Gradient(colorous::CUBEHELIX)),
    ("cool to warm", MapKind::Diverging([0.2314, 0.2980, 0.7529], [0.7059, 0.0157, 0.1490])),
    ("spectral", MapKind::Gradient(colorous::SPECTRAL)),
    (
        "black body",
        MapKind::Points(&[(0.0, BLACK), (0.4, [0.9, 0.0, 0.0]), (0.8, [0.9, 0.9, 0.0]), (1.0, WHITE_RGB)]),
    ),
    ("greys", MapKind::Points(&[(0.0, BLACK), (1.0, WHITE_RGB)])),
    ("X-ray", MapKind::Points(&[(0.0, WHITE_RGB), (1.0, BLACK)])),
    (
        "bone",
        MapKind::Points(&[(0.0, [0.35, 0.16, 0.09]), (0.5, [0.85, 0.68, 0.50]), (1.0, [1.0, 0.98, 0.93])]),
    ),
    ("green", MapKind::Points(&[(0.0, BLACK), (1.0, [0.1, 1.0, 0.2])])),
    ("magenta", MapKind::Points(&[(0.0, BLACK), (1.0, [1.0, 0.15, 1.0])])),
    ("cyan", MapKind::Points(&[(0.0, BLACK), (1.0, [0.1, 0.95, 1.0])])),
    ("rainbow", MapKind::Gradient(colorous::SINEBOW)),
];

#[cfg(test)]
mod tests {
    use isinglass_core::transfer::{Domain, UnitLength};

    use super::*;
    use crate::presets::{preset, preset_names};

    fn assert_near(a: [f32; 3], b: [f32; 3], tolerance: f32, what: &str) {
        let off = (0..3).map(|i| (a[i] - b[i]).abs()).fold(0.0, f32::max);
        assert!(off <= tolerance, "{what}: {a:?} is not {b:?}");
    }

    /// The colour at a position, linear between points as in the kernels.
    fn color_of(transfer: &TransferFunction, x: f32) -> [f32; 3] {
        let points: Vec<_> = transfer.points.iter().map(|p| (p.x, p.color)).collect();
        color_between(&points, ColorSpace::Rgb, x)
    }

    #[test]
    fn a_map_changes_colours_and_no_opacity() {
        for name in preset_names() {
            let transfer = preset(name).unwrap();
            // Control: the preset does not have the colours of the map.
            let (last, green) =
                (transfer.points.last().unwrap().color, ColorMap::named("green").unwrap().at(1.0));
            assert!((0..3).any(|i| (last[i] - green[i]).abs() > 0.1), "{name} is green already");
            for map in ColorMap::all() {
                let mapped = map.onto(&transfer);
                assert_eq!(mapped.validate(), Ok(()), "{} onto {name}", map.name());
                assert_eq!((mapped.domain, mapped.unit_length), (transfer.domain, transfer.unit_length));
                for i in 0..=1000 {
                    let x = i as f32 / 1000.0;
                    let (opacity, before) = (mapped.at(x).1, transfer.at(x).1);
                    // The tolerance covers rounding and removed points.
                    assert!(
                        (opacity - before).abs() < 3e-5,
                        "{} onto {name} at {x}: {opacity} {before}",
                        map.name()
                    );
                    if before > 0.0 {
                        // `recolored` keeps its tolerance at its samples, and half as much again between them.
                        assert_near(color_of(&mapped, x), map.at(x), 1.5 * COLOR_TOLERANCE, map.name());
                    }
                }
            }
        }
    }

    #[test]
    fn maps_one_after_the_other_leave_no_points_behind() {
        let transfer = preset("ct").unwrap();
        let viridis = ColorMap::named("viridis").unwrap();
        let once = viridis.onto(&transfer);
        let mut many = once.clone();
        for map in ColorMap::all() {
            many = map.onto(&many);
        }
        let again = viridis.onto(&many);
        assert!(again.points.len() <= once.points.len() + 1, "{} {}", again.points.len(), once.points.len());
        let mut clear = transfer.clone();
        clear.points.iter_mut().for_each(|p| p.opacity = 0.0);
        assert_eq!(viridis.onto(&clear).points.len(), 2, "what is clear needs no colours");
        let greys = ColorMap::named("greys").unwrap().onto(&transfer);
        assert!(greys.points.len() <= transfer.points.len() + 1, "a straight map adds no points");
    }

    #[test]
    fn ends_and_middles_of_maps_are_known() {
        // The figures of the example in Moreland's paper.
        let map = ColorMap::named("cool to warm").unwrap();
        for (t, rgb) in
            [(0.0, [59, 76, 192]), (0.5, [221, 221, 221]), (1.0, [180, 4, 38]), (0.25, [141, 176, 254])]
        {
            assert_near(map.at(t), rgb.map(|c| c as f32 / 255.0), 1.6 / 255.0, "cool to warm");
        }
        assert_near(ColorMap::named("viridis").unwrap().at(0.0), [0.267, 0.005, 0.329], 0.003, "viridis");
        assert_near(ColorMap::named("X-ray").unwrap().at(0.0), [1.0; 3], 0.0, "X-ray");
        assert_near(ColorMap::named("greys").unwrap().at(0.25), [0.25; 3], 1e-6, "greys");
        let mut names: Vec<_> = ColorMap::all().map(|m| m.name()).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), MAPS.len(), "no name twice");
    }

    #[test]
    fn spaces_of_colours_there_and_back() {
        for rgb in [[0.2, 0.7, 0.4], [1.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.0, 0.1, 1.0], [0.0; 3], [1.0; 3]] {
            // Four figures of the matrices.
            assert_near(rgb_from_lab(lab_from_rgb(rgb)), rgb, 2e-3, "lab");
            assert_near(rgb_from_msh(msh_from_rgb(rgb)), rgb, 2e-3, "msh");
            assert_near(rgb_from_hsv(hsv_from_rgb(rgb)), rgb, 1e-5, "hsv");
        }
        let points = [(0.0, [1.0, 0.0, 0.1]), (1.0, [1.0, 0.2, 0.0])];
        let red = color_between(&points, ColorSpace::Hsv, 0.5);
        assert!(red[0] > 0.99 && red[1] < 0.2 && red[2] < 0.2, "the shorter way around: {red:?}");
        assert_eq!(color_between(&points, ColorSpace::Step, 0.9), points[0].1);
    }

    #[test]
    fn many_points_and_jumps_stay_within_the_limit() {
        let p =
            |i: usize| ControlPoint { x: (i / 2) as f32 / 127.0, color: [0.0; 3], opacity: (i % 2) as f32 };
        let transfer = TransferFunction {
            name: "comb".into(),
            domain: Domain::Full,
            unit_length: UnitLength::Voxel,
            points: (0..256).map(p).collect(),
        };
        let mapped = ColorMap::named("turbo").unwrap().onto(&transfer);
        assert_eq!((mapped.points.len(), mapped.validate()), (256, Ok(())));
    }
}
