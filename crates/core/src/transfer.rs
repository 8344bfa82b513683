//! One-dimensional transfer functions: from control points to the table that every kernel classifies with.
//!
//! Classification is pre-integrated (Max 1995; Engel 2001 in its one-table form). The table holds the running integrals
//! K(x) = ∫σc dx and T(x) = ∫σ dx over the scalar. A step of length h whose ends read x0 and x1 has
//! τ = h·(T(x1) − T(x0))/(x1 − x0) and colour (K(x1) − K(x0))/(T(x1) − T(x0)). So no thin shell between two samples is
//! missed, and any step length has the right opacity. Within a step, colour is averaged with the weight σ, and
//! attenuation acts on that average.

use serde::{Deserialize, Serialize};

use crate::picture::{linear_from_srgb, srgb_from_linear};

/// One control point. Between points, colour and opacity vary linearly.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ControlPoint {
    /// Position in the domain, 0 to 1.
    pub x: f32,
    /// Colour, sRGB, each 0 to 1.
    pub color: [f32; 3],
    /// Opacity of matter one unit length thick (see [`UnitLength`]), 0 to 1.
    pub opacity: f32,
}

/// The physical values of the positions 0 and 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Domain {
    /// Least and greatest value of the volume.
    Full,
    /// Two given values.
    Values(f32, f32),
    /// Two percentiles of the volume's histogram, 0 to 100.
    Percentiles(f32, f32),
    /// From −m to m, where m is the greater magnitude of this percentile, 50 to 100, and of the one as far below 50.
    AboutZero(f32),
}

/// The thickness of matter that a control point's opacity refers to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum UnitLength {
    /// The geometric mean of the volume's spacings.
    Voxel,
    /// A length in world units.
    World(f32),
    /// A fraction of the radius of the volume's bounding sphere.
    Radius(f32),
}

/// A transfer function as a user writes it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TransferFunction {
    /// Name of the preset or file.
    pub name: String,
    /// What the positions mean.
    pub domain: Domain,
    /// What the opacities mean.
    pub unit_length: UnitLength,
    /// At least one point, positions ascending (equal positions make a jump).
    pub points: Vec<ControlPoint>,
}

/// Why control points do not make a transfer function.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum TransferError {
    /// There are no points, or more than [`MAX_POINTS`].
    #[error("{0} control points, expected 1 to {MAX_POINTS}")]
    Count(usize),
    /// A position is out of order.
    #[error("control point {index} is at {x}, before the point at {previous}; expected ascending positions")]
    Order {
        /// Number of the point, from 0.
        index: usize,
        /// Its position.
        x: f32,
        /// The position before it.
        previous: f32,
    },
    /// A number is outside of its range.
    #[error("control point {index}: {what} is {value}, expected 0 to 1")]
    Range {
        /// Number of the point, from 0.
        index: usize,
        /// Name of the number.
        what: &'static str,
        /// Its value.
        value: f32,
    },
    /// The domain is empty, reversed or not finite.
    #[error("domain runs from {0} to {1}, expected ascending finite numbers and percentiles from 0 to 100")]
    Domain(f32, f32),
    /// The unit length is not a positive number.
    #[error("unit length is {0}, expected a positive number")]
    UnitLength(f32),
}

impl TransferFunction {
    /// Checks what the type cannot express.
    pub fn validate(&self) -> Result<(), TransferError> {
        if self.points.is_empty() || self.points.len() > MAX_POINTS {
            return Err(TransferError::Count(self.points.len()));
        }
        let mut previous = 0.0;
        for (index, p) in self.points.iter().enumerate() {
            let [r, g, b] = p.color;
            for (what, value) in
                [("position", p.x), ("red", r), ("green", g), ("blue", b), ("opacity", p.opacity)]
            {
                if !(0.0..=1.0).contains(&value) {
                    return Err(TransferError::Range { index, what, value });
                }
            }
            if p.x < previous {
                return Err(TransferError::Order { index, x: p.x, previous });
            }
            previous = p.x;
        }
        match self.domain {
            Domain::Values(a, b) | Domain::Percentiles(a, b)
                if !(a < b && a.is_finite() && b.is_finite()) =>
            {
                return Err(TransferError::Domain(a, b));
            }
            Domain::AboutZero(percent) if !(50.0..=100.0).contains(&percent) => {
                return Err(TransferError::Domain(-percent, percent));
            }
            _ => {}
        }
        match self.unit_length {
            UnitLength::World(l) | UnitLength::Radius(l) if !(l > 0.0 && l.is_finite()) => {
                Err(TransferError::UnitLength(l))
            }
            _ => Ok(()),
        }
    }

    /// Linear colour and opacity at position `x`; beyond the points the end points continue.
    pub fn at(&self, x: f32) -> ([f32; 3], f32) {
        let linear = |p: &ControlPoint| p.color.map(linear_from_srgb);
        let after = self.points.partition_point(|p| p.x <= x);
        let Some(b) = self.points.get(after) else {
            let last = &self.points[self.points.len() - 1];
            return (linear(last), last.opacity);
        };
        let Some(a) = after.checked_sub(1).map(|i| &self.points[i]) else {
            return (linear(b), b.opacity);
        };
        let t = (x - a.x) / (b.x - a.x);
        let mix: [f32; 3] = std::array::from_fn(|i| a.color[i] + (b.color[i] - a.color[i]) * t);
        (mix.map(linear_from_srgb), a.opacity + (b.opacity - a.opacity) * t)
    }

    /// Linear colour that a projection shows for position `x`, premultiplied. It is the colour there, with its sRGB
    /// dimmed by the opacity relative to the function's greatest. So a ramp of opacity is an even ramp on the screen.
    pub fn shown(&self, x: f32) -> [f32; 3] {
        let greatest = self.points.iter().map(|p| p.opacity).fold(0.0, f32::max);
        if greatest <= 0.0 {
            return [0.0; 3];
        }
        let (color, opacity) = self.at(x);
        color.map(|c| linear_from_srgb(srgb_from_linear(c) * (opacity / greatest)))
    }

    /// The table for stored numbers s at position x = s·`x_map.0` + `x_map.1`, `unit_length` in world units.
    pub fn tabulate(&self, unit_length: f32, x_map: (f32, f32)) -> TransferTable {
        let medium = |x: f32| -> [f64; 4] {
            let (c, opacity) = self.at(x);
            let sigma = -f64::from(1.0 - opacity.min(MAX_OPACITY)).ln() / f64::from(unit_length);
            // This is more than any use needs, and products with it stay finite.
            let sigma = sigma.min(MAX_EXTINCTION);
            [sigma * f64::from(c[0]), sigma * f64::from(c[1]), sigma * f64::from(c[2]), sigma]
        };
        integrated(medium, x_map)
    }
}

/// The table of a medium, over positions.
pub(crate) fn integrated(medium: impl Fn(f32) -> [f64; 4], x_map: (f32, f32)) -> TransferTable {
    let to_f32 = |v: [f64; 4]| v.map(|x| x as f32);
    let mut density = Vec::with_capacity(TABLE_BINS + 1);
    let mut integral = Vec::with_capacity(TABLE_BINS + 1);
    let mut sum = [0f64; 4];
    integral.push([0.0; 4]);
    density.push(to_f32(medium(0.0)));
    for bin in 0..TABLE_BINS {
        for sub in 0..SUBDIVISIONS {
            let x = (bin as f32 + (sub as f32 + 0.5) / SUBDIVISIONS as f32) / TABLE_BINS as f32;
            let m = medium(x);
            for ch in 0..4 {
                sum[ch] += m[ch] / (TABLE_BINS * SUBDIVISIONS) as f64;
            }
        }
        integral.push(to_f32(sum));
        density.push(to_f32(medium((bin + 1) as f32 / TABLE_BINS as f32)));
    }
    TransferTable { integral, density, x_scale: x_map.0, x_offset: x_map.1, are_labels: false }
}

/// The table of labels: node n holds the matter of label n, with no label between two nodes. `color` gives the linear
/// colour of a label, or `None` if it is not shown. All have the same `opacity` per `unit_length`, world units. A
/// stored number s means the label s·`value_map.0` + `value_map.1`.
pub fn label_table(
    color: impl Fn(u16) -> Option<[f32; 3]>,
    opacity: f32,
    unit_length: f32,
    value_map: (f32, f32),
) -> TransferTable {
    let sigma = -f64::from(1.0 - opacity.clamp(0.0, MAX_OPACITY)).ln() / f64::from(unit_length);
    let sigma = sigma.min(MAX_EXTINCTION) as f32;
    let mut density = vec![[0.0; 4]; TABLE_BINS + 1];
    for (label, node) in (0..LABEL_NODES as u16).zip(&mut density).skip(1) {
        if let Some(c) = color(label) {
            *node = [c[0] * sigma, c[1] * sigma, c[2] * sigma, sigma];
        }
    }
    let unit = 1.0 / TABLE_BINS as f32;
    let (x_scale, x_offset) = (value_map.0 * unit, value_map.1 * unit);
    TransferTable { integral: vec![[0.0; 4]; TABLE_BINS + 1], density, x_scale, x_offset, are_labels: true }
}

/// A transfer function prepared for one volume: [`TABLE_BINS`] + 1 nodes over x in [0, 1]. A stored number has the
/// position x = stored·`x_scale` + `x_offset`, clamped.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TransferTable {
    /// Running integrals over x: (K red, K green, K blue, T); extinctions per world unit.
    pub integral: Vec<[f32; 4]>,
    /// The integrands at the nodes: (σc red, green, blue, σ).
    pub density: Vec<[f32; 4]>,
    /// Maps stored numbers to x, with `x_scale` and `x_offset`.
    pub x_scale: f32,
    /// Maps stored numbers to x, with `x_scale` and `x_offset`.
    pub x_offset: f32,
    /// Whether the nodes are labels ([`label_table`]), which are never interpolated.
    pub are_labels: bool,
}

impl TransferTable {
    /// The table with every integral and integrand `factor` times as large.
    pub fn scaled(mut self, factor: f32) -> Self {
        for node in self.integral.iter_mut().chain(&mut self.density) {
            *node = node.map(|x| x * factor);
        }
        self
    }

    /// The node of a stored label. Labels of [`LABEL_NODES`] and more share the nodes from 1 on.
    pub fn label_node(&self, stored: f32) -> usize {
        let label = ((stored * self.x_scale + self.x_offset) * TABLE_BINS as f32 + 0.5).max(0.0) as u32;
        if label == 0 { 0 } else { ((label - 1) % (LABEL_NODES as u32 - 1) + 1) as usize }
    }

    /// The extinction of a stored number, 1/world unit.
    pub fn extinction_of(&self, stored: f32) -> f32 {
        if self.are_labels {
            return self.density[self.label_node(stored)][3];
        }
        // `clamp` would pass NaN on, which numbers of the greatest domains may become.
        let x = stored * self.x_scale + self.x_offset;
        let u = if x > 0.0 { x.min(1.0) } else { 0.0 } * TABLE_BINS as f32;
        let i = (u as usize).min(TABLE_BINS - 1);
        let (a, b) = (self.density[i][3], self.density[i + 1][3]);
        a + (b - a) * (u - i as f32)
    }

    /// Whether a sample between the stored numbers `lo` and `hi` can have any extinction; it errs on the side of yes.
    pub fn is_visible(&self, lo: f32, hi: f32) -> bool {
        let (a, b) = self.positions(lo, hi);
        if self.are_labels && b >= 1.0 {
            return self.has_any(0.0, 1.0);
        }
        self.has_any(a.clamp(0.0, 1.0), b.clamp(0.0, 1.0))
    }

    /// The positions of two stored numbers, ascending and not clamped.
    pub fn positions(&self, lo: f32, hi: f32) -> (f32, f32) {
        let x = |stored: f32| stored * self.x_scale + self.x_offset;
        (x(lo).min(x(hi)), x(lo).max(x(hi)))
    }

    /// Whether there is anything between two positions in [0, 1]; it errs on the side of yes.
    pub fn has_any(&self, a: f32, b: f32) -> bool {
        let (a, b) = (a * TABLE_BINS as f32, b * TABLE_BINS as f32);
        let (a, b) = ((a - 1e-3).max(0.0) as usize, ((b + 1e-3).ceil() as usize).min(TABLE_BINS));
        self.integral[b][3] > self.integral[a][3] || self.density[a..=b].iter().any(|m| m[3] > 0.0)
    }
}

/// Bins of a table.
pub const TABLE_BINS: usize = 1024;
/// Labels with a node of their own, from 0 on.
pub const LABEL_NODES: usize = 1024;
/// Largest number of control points.
pub const MAX_POINTS: usize = 256;
/// An opacity of one has no finite extinction, so it counts as this.
pub const MAX_OPACITY: f32 = 0.9999;
/// Greatest extinction, per unit of length. Opaque matter in voxels of an ångström, in metres, has 1e11. Over the
/// longest possible ray (1e16) the optical depth stays finite.
const MAX_EXTINCTION: f64 = 1e20;
/// Midpoint evaluations per bin when integrating.
const SUBDIVISIONS: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> TransferFunction {
        let p = |x, opacity| ControlPoint { x, color: [1.0, 0.5, 0.0], opacity };
        TransferFunction {
            name: "ramp".into(),
            domain: Domain::Full,
            unit_length: UnitLength::World(1.0),
            points: vec![p(0.0, 0.0), p(0.5, 0.0), p(1.0, 0.9)],
        }
    }

    #[test]
    fn bad_points_are_named() {
        let mut tf = ramp();
        tf.points[1].x = 0.9;
        tf.points[2].x = 0.8;
        assert!(matches!(tf.validate(), Err(TransferError::Order { index: 2, .. })));
        tf.points[2].x = f32::NAN;
        assert!(matches!(tf.validate(), Err(TransferError::Range { index: 2, what: "position", .. })));
        tf.points.clear();
        assert_eq!(tf.validate(), Err(TransferError::Count(0)));
        let reversed = TransferFunction { domain: Domain::Values(3.0, 1.0), ..ramp() };
        assert_eq!(reversed.validate(), Err(TransferError::Domain(3.0, 1.0)));
        assert_eq!(ramp().validate(), Ok(()));
    }

    #[test]
    fn integral_of_the_table_is_the_integral_of_the_points() {
        let table = ramp().tabulate(1.0, (1.0, 0.0));
        // ∫ −ln(1 − 0.9u) du / 2 over u in [0, 1], by the antiderivative of −ln.
        let exact = 0.5 * (0.9 + 0.1 * (0.1f64).ln()) / 0.9;
        assert!((f64::from(table.integral[TABLE_BINS][3]) - exact).abs() < 1e-5);
        assert!(!table.is_visible(0.0, 0.49));
        assert!(table.is_visible(0.0, 0.51));
        assert!(table.is_visible(0.7, 0.7));
    }
}
