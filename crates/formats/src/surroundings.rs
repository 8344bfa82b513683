//! What surrounds the matter of a volume, and on which side of its values the matter lies.
//!
//! The surroundings are the values around the densest half of the outermost voxels: the shortest interval with half of
//! them (the *shorth*, Andrews et al. 1972), and what joins it at a sixteenth of its density or more. All other voxels
//! are matter, which is brighter, darker, or both.

use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::{Histogram, Volume, Voxels};

/// A sample of the outermost voxels.
pub(crate) struct Sides {
    /// Ascending; at least one.
    values: Vec<f32>,
    /// Those with nothing in them.
    num_gaps: usize,
    /// Whether most voxels are outermost ones.
    are_most: bool,
}

impl Sides {
    pub(crate) fn of(volume: &Volume) -> Self {
        let dims = volume.dims().map(|d| d as i32);
        let stride = dims.map(|d| (d / SAMPLES_PER_SIDE).max(1) as usize);
        let (mut values, mut num_gaps) = (Vec::new(), 0);
        for axis in 0..3 {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            for side in [0, dims[axis] - 1] {
                for a in (0..dims[u]).step_by(stride[u]) {
                    for b in (0..dims[v]).step_by(stride[v]) {
                        let mut at = [0; 3];
                        (at[axis], at[u], at[v]) = (side, a, b);
                        let [x, y, z] = at.map(|i| i as usize);
                        let index = (z * dims[1] as usize + y) * dims[0] as usize + x;
                        if volume.gaps().is_some_and(|gaps| gaps.bytes[index] != 0) {
                            num_gaps += 1;
                            continue;
                        }
                        values.push(volume.value_from_stored(volume.stored_at(at[0], at[1], at[2])));
                    }
                }
            }
        }
        if values.is_empty() {
            values.push(volume.value_range().0);
        }
        values.sort_unstable_by(f32::total_cmp);
        let num = |less: i32| dims.map(|d| f64::from((d - less).max(0))).iter().product::<f64>();
        let are_most = num(2) < 0.5 * num(0);
        Self { values, num_gaps, are_most }
    }

    /// The value that this share of them does not exceed.
    pub(crate) fn percentile(&self, share: f32) -> f32 {
        self.values[((self.values.len() - 1) as f32 * share) as usize]
    }

    /// Whether they look like a block that hides what is within: a few voxels of most of them let hardly any light
    /// through.
    pub(crate) fn are_block(&self, transfer: &TransferFunction, domain: (f32, f32)) -> bool {
        !self.are_most && self.opaque_share(transfer, domain) > MOST_OPAQUE
    }

    /// The share of them that hides what is behind.
    pub(crate) fn opaque_share(&self, transfer: &TransferFunction, (lo, hi): (f32, f32)) -> f32 {
        let is_opaque = |value: &&f32| transfer.at((**value - lo) / (hi - lo)).1 > OPAQUE;
        let num = self.values.len() + self.num_gaps;
        self.values.iter().filter(is_opaque).count() as f32 / num as f32
    }

    /// The values around the densest half. `range` is the length of the range of nearly all voxels.
    fn densest(&self, range: f32) -> (f32, f32) {
        let v = &self.values;
        let half = v.len() / 2;
        let length = |i: usize| v[i + half] - v[i];
        let shortest = (0..v.len() - half).min_by(|a, b| length(*a).total_cmp(&length(*b))).unwrap_or(0);
        let (mut first, mut last) = (shortest, shortest + half);
        // Whole numbers are never nearer to each other than this.
        let step = v.windows(2).map(|p| p[1] - p[0]).filter(|d| *d > 0.0).fold(f32::INFINITY, f32::min);
        let step = if step.is_finite() { step } else { 0.0 };
        // A part of the voxels joins if it has a sixteenth of the density.
        let part = (v.len() / PARTS).max(1);
        let longest = (0.5 * (length(shortest) + step)).max(range * NEAR);
        while last + 1 < v.len() {
            let next = (last + part).min(v.len() - 1);
            if v[next] - v[last] > longest {
                break;
            }
            last = next;
        }
        while first > 0 {
            let next = first.saturating_sub(part);
            if v[first] - v[next] > longest {
                break;
            }
            first = next;
        }
        (v[first], v[last])
    }
}

/// The side of the surroundings on which matter has its values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MatterSide {
    Above,
    Below,
    Both,
}

/// The values of what surrounds the matter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Surroundings {
    /// The least and the greatest.
    pub(crate) values: (f32, f32),
    pub(crate) matter: MatterSide,
    /// The values that matter reaches below and above, but for the farthest fiftieth of its voxels.
    pub(crate) reach: (f32, f32),
}

impl Surroundings {
    /// Those of a volume with this histogram; `None` if nothing tells them from the matter.
    pub(crate) fn of(volume: &Volume, histogram: &Histogram, sides: &Sides) -> Option<Self> {
        let is_tiny = sides.are_most && volume.voxels().len() < LEAST_VOXELS;
        if is_tiny || sides.num_gaps > sides.values.len() {
            return None;
        }
        let range = histogram.percentile(99.9) - histogram.percentile(0.1);
        let values = sides.densest(range.max(0.0));
        let beyond = [false, true].map(|is_above| Beyond::of(volume, histogram, values, is_above));
        let [below, above] = beyond.map(|beyond| beyond.moment);
        let (less, more) = (below.min(above), below.max(above));
        let width = f64::from(values.1 - values.0);
        if more <= LEAST_MATTER * width || more <= 0.0 {
            return None;
        }
        let reach = (beyond[0].reach, beyond[1].reach);
        let mut found = Self { values, matter: MatterSide::Both, reach };
        // Where zero is nothing at all, a sign means something.
        let is_thin = width < 0.01 * f64::from(reach.1 - reach.0);
        let has_both =
            less > BOTH_SIDES * more || is_thin && found.are_about_zero() && less > BOTH_SIDES_OF_ZERO * more;
        if !has_both {
            found.matter = if above > below { MatterSide::Above } else { MatterSide::Below };
        }
        // Air surrounds a patient, and is dark.
        let is_patient = matches!(volume.info.modality.as_deref(), Some("CT" | "MR" | "PT" | "NM"));
        let is_known = found.matter == MatterSide::Above || has_both && found.are_about_zero();
        (is_known || !is_patient).then_some(found)
    }

    /// Whether zero is among them.
    pub(crate) fn are_about_zero(&self) -> bool {
        let near = 0.01 * (self.reach.1 - self.reach.0);
        self.values.0 <= near && self.values.1 >= -near
    }

    /// The value in their middle.
    pub(crate) fn middle(&self) -> f32 {
        if self.are_about_zero() { 0.0 } else { 0.5 * (self.values.0 + self.values.1) }
    }
}

/// The voxels on one side of the surroundings.
#[derive(Clone, Copy)]
struct Beyond {
    /// Their mean distance from the surroundings times their share of all voxels.
    moment: f64,
    /// The value that all but the farthest fiftieth of them reach.
    reach: f32,
}

impl Beyond {
    fn of(volume: &Volume, histogram: &Histogram, values: (f32, f32), is_above: bool) -> Self {
        let counts = &histogram.counts;
        let (lo, hi) = (f64::from(histogram.lo), f64::from(histogram.hi));
        let width = (hi - lo) / (counts.len() - 1).max(1) as f64;
        // Bins of floats round by more than one.
        let rounding = if matches!(volume.voxels(), Voxels::F32(_)) { 1.5 * width } else { 0.5 * width };
        let edge = f64::from(if is_above { values.1 } else { values.0 });
        let distance = |i: usize| (lo + width * i as f64 - edge) * if is_above { 1.0 } else { -1.0 };
        let is_beyond = |i: &usize| distance(*i) > rounding;
        let (mut num, mut sum) = (0u64, 0.0);
        for i in (0..counts.len()).filter(is_beyond) {
            num += counts[i];
            sum += counts[i] as f64 * distance(i);
        }
        let (mut farther, mut reach) = (0, edge);
        let mut from_the_end = (0..counts.len()).map(|i| if is_above { counts.len() - 1 - i } else { i });
        if let Some(i) = from_the_end.find(|i| {
            farther += counts[*i];
            farther * 50 > num
        }) && is_beyond(&i)
        {
            reach = lo + width * i as f64;
        }
        let all = counts.iter().sum::<u64>().max(1) as f64;
        Self { moment: sum / all, reach: reach as f32 }
    }
}

/// The opacity per unit length of matter that hides what is behind it after a few voxels.
pub(crate) const OPAQUE: f32 = 0.1;
/// The share of opaque voxels on the sides from which on a volume looks like a block.
const MOST_OPAQUE: f32 = 0.5;
/// Sampled voxels along each axis.
const SAMPLES_PER_SIDE: i32 = 64;
/// A 64th of the outermost voxels joins at a time: half of them in 32 times half the length of the shorth.
const PARTS: usize = 64;
/// Values so near, by the range, are of one kind however few others there are.
const NEAR: f32 = 1.0 / 128.0;
/// The surroundings of fewer voxels are mostly matter.
const LEAST_VOXELS: usize = 4096;
/// The least moment of matter in widths of the surroundings. The tails of noise have a tenth.
const LEAST_MATTER: f64 = 1e-3;
/// From this share of the greater moment on, the lesser one matters too. Noise and shading have a fiftieth, dark
/// proteins with bright rims an eighth, and maps of differences three quarters.
const BOTH_SIDES: f64 = 0.25;
/// The same about an exact zero. Ringing of an interpolation has less than a hundredth.
const BOTH_SIDES_OF_ZERO: f64 = 0.03;
