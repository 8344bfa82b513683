//! Whether the voxels of a volume are labels: told by the file or the person, or judged by the voxels.

use std::collections::HashMap;
use std::path::Path;

use isinglass_core::volume::{Volume, Voxels};
use rayon::prelude::*;

use crate::dtype::Dtype;
use crate::error::{FormatError, shown};
use crate::plan::Plan;
use crate::reading::Meaning;
use crate::selection::Region;
use crate::warning::{Warning, WarningKind};

/// Marks the one channel that was read as labels, if it has them. Returns a word about a guess.
///
/// # Errors
/// `wish` is labels, but there are other numbers than whole ones from zero.
pub(crate) fn mark_labels(
    volume: &mut Volume,
    plan: &Plan,
    wish: Option<Meaning>,
    path: &Path,
) -> Result<Option<Warning>, FormatError> {
    let mut word = None;
    let are_labels = match wish {
        Some(Meaning::Values) => false,
        Some(Meaning::Labels) if !are_whole(volume) => {
            let (lo, hi) = volume.value_range();
            let problem =
                format!("values from {lo} to {hi}, expected labels, which are whole numbers from 0");
            return Err(FormatError::Data { path: shown(path), problem });
        }
        Some(Meaning::Labels) => true,
        None if plan.are_labels => {
            let are_whole = are_whole(volume);
            if !are_whole {
                let text = "the file calls its values labels, but not all are whole numbers from 0";
                word = Some(Warning::new(WarningKind::Data, text));
            }
            are_whole
        }
        None => {
            let are_labels = look_like_labels(volume, plan.dtype.integer_range().is_none());
            if are_labels {
                word = Some(Warning::new(WarningKind::Guess, TAKEN_FOR_LABELS));
            }
            are_labels
        }
    };
    volume.info.are_labels = are_labels;
    if !are_labels {
        volume.info.labels.clear();
    }
    Ok(word)
}

/// Whether the voxels of all channels are labels, as the person or the file says; `None` if their look decides.
pub(crate) fn told_labels(plan: &Plan, wish: Option<Meaning>, num_channels: u64) -> Option<bool> {
    match wish {
        Some(meaning) => return Some(meaning == Meaning::Labels),
        None if plan.are_labels || !plan.labels.is_empty() => return Some(true),
        None => {}
    }
    (plan.dtype.integer_range().is_none() || num_channels > 1 || plan.num_joint > 1).then_some(false)
}

/// The middle of a volume, by whose look labels are told from values in bounded memory.
pub(crate) fn judged_part(dims: [u64; 3], dtype: Dtype, max_bytes: u64) -> Region {
    let bytes_each = dtype.num_bytes_in_memory() as u64 + 1;
    let most = (max_bytes / 4 / bytes_each).min(MOST_JUDGED);
    let side = ((most as f64).cbrt() as u64).max(1);
    Region {
        min: dims.map(|n| (n.saturating_sub(side) / 2) as u32),
        max: dims.map(|n| Some((n.saturating_sub(side) / 2 + n.min(side)) as u32)),
    }
}

/// Whether all values are whole numbers from zero that single precision holds.
fn are_whole(volume: &Volume) -> bool {
    let is_whole = |x: f32| x.fract() == 0.0 && (0.0..=MOST).contains(&x);
    let (slope, intercept) = volume.value_map();
    let (least, greatest) = volume.value_range();
    if !is_whole(least) || !is_whole(greatest) {
        return false;
    }
    match volume.voxels() {
        Voxels::F32(v) => v.par_iter().all(|&x| is_whole(volume.value_from_stored(x))),
        Voxels::U8(_) | Voxels::U16(_) => slope.fract() == 0.0 && intercept.fract() == 0.0,
    }
}

/// Whether a volume looks like labels. Its numbers are whole and few, zero is among them, and nearly all voxels lie among
/// their like. A coarse scan differs: where its numbers change, they change by one step. `are_floats` tells of the type
/// in the file, whose white is one.
fn look_like_labels(volume: &Volume, are_floats: bool) -> bool {
    let num_voxels = volume.voxels().len();
    let is_plain = volume.value_map().0 == 1.0 && volume.value_range().0 == 0.0;
    if num_voxels < LEAST_VOXELS || !is_plain || !are_whole(volume) {
        return false;
    }
    let Some(few) = Neighbours::of(volume, FEW_PLANES) else { return false };
    if !few.lie_in_blocks(are_floats) {
        return false;
    }
    Neighbours::of(volume, MANY_PLANES)
        .is_some_and(|all| all.lie_in_blocks(are_floats) && all.changes_by_leaps())
}

/// How often neighbours are alike, in some planes of a volume.
#[derive(Default)]
struct Neighbours {
    /// For each value, its neighbours, and how many of them are alike.
    values: HashMap<u32, [u64; 2]>,
    /// How often two different values meet, the lesser first.
    pairs: HashMap<(u32, u32), u64>,
}

impl Neighbours {
    /// Looks at `num_planes` planes; `None` if there are too many values.
    fn of(volume: &Volume, num_planes: usize) -> Option<Self> {
        let depth = volume.dims()[2] as usize;
        let count = num_planes.min(depth);
        let planes =
            (0..count).into_par_iter().map(|i| Self::in_plane(volume, (2 * i + 1) * depth / (2 * count)));
        planes.try_reduce(Self::default, |a, b| {
            let mut sum = a;
            for (value, [all, alike]) in b.values {
                let entry = sum.values.entry(value).or_default();
                *entry = [entry[0] + all, entry[1] + alike];
            }
            for (pair, count) in b.pairs {
                *sum.pairs.entry(pair).or_default() += count;
            }
            sum.is_short().then_some(sum)
        })
    }

    fn is_short(&self) -> bool {
        self.values.len() <= MOST_LABELS && self.pairs.len() <= MOST_PAIRS
    }

    fn in_plane(volume: &Volume, z: usize) -> Option<Self> {
        let [nx, ny, nz] = volume.dims().map(|n| n as usize);
        let at = |x: usize, y: usize, z: usize| {
            volume.value_from_stored(volume.voxels().get((z * ny + y) * nx + x)) as u32
        };
        let mut found = Self::default();
        for y in 0..ny {
            // Runs of one value are counted at once.
            let (mut run, mut length, mut alike) = (at(0, y, z), 0, 0);
            for x in 0..nx {
                let here = at(x, y, z);
                if here != run {
                    found.add(run, length, alike);
                    (run, length, alike) = (here, 0, 0);
                }
                let others = [(x + 1, y, z), (x, y + 1, z), (x, y, z + 1)];
                for (x, y, z) in others.into_iter().filter(|&(x, y, z)| x < nx && y < ny && z < nz) {
                    let other = at(x, y, z);
                    length += 1;
                    if other == here {
                        alike += 1;
                    } else {
                        found.add(other, 1, 0);
                        *found.pairs.entry((here.min(other), here.max(other))).or_default() += 1;
                    }
                }
            }
            found.add(run, length, alike);
            if !found.is_short() {
                return None;
            }
        }
        Some(found)
    }

    fn add(&mut self, value: u32, all: u64, alike: u64) {
        let entry = self.values.entry(value).or_default();
        *entry = [entry[0] + all, entry[1] + alike];
    }

    /// Whether most values lie among their like, and nearly all voxels that are not zero.
    fn lie_in_blocks(&self, are_floats: bool) -> bool {
        let others = || self.values.iter().filter(|(value, _)| **value != 0).map(|(_, counts)| counts);
        let num = others().count();
        let share = |[all, alike]: [u64; 2]| alike as f64 / all.max(1) as f64;
        let sum = others().fold([0, 0], |sum: [u64; 2], c| [sum[0] + c[0], sum[1] + c[1]]);
        let num_blocks = others().filter(|c| share(**c) >= LEAST_ALIKE).count();
        // One value beside zero is a label, or the white of a mask.
        let whites = &WHITES[usize::from(!are_floats)..];
        let is_mask = num == 1 && whites.iter().any(|white| self.values.contains_key(white));
        num > 0 && !is_mask && share(sum) >= LEAST_ALIKE_IN_ALL && num_blocks * 4 >= num * 3
    }

    /// Whether different values that meet are often not next to each other in the list of values.
    fn changes_by_leaps(&self) -> bool {
        if self.values.len() <= FEW_VALUES {
            return true;
        }
        let mut list: Vec<u32> = self.values.keys().copied().collect();
        list.sort_unstable();
        let rank = |value: u32| list.binary_search(&value).unwrap_or(0);
        let all: u64 = self.pairs.values().sum();
        let leaps = self.pairs.iter().filter(|((a, b), _)| rank(*b) - rank(*a) > 1);
        leaps.map(|(_, count)| count).sum::<u64>() * 4 >= all
    }
}

/// Single precision holds all whole numbers up to this one.
const MOST: f32 = 16_777_216.0;
/// Smaller volumes are no scans, and their voxels tell nothing.
const LEAST_VOXELS: usize = 4096;
/// Most labels that are taken for such without a word of the file. Atlases of the brain have a few hundred.
const MOST_LABELS: usize = 512;
/// Most pairs of labels that touch.
const MOST_PAIRS: usize = 1 << 14;
/// Planes that are looked at, first to refuse quickly.
const FEW_PLANES: usize = 4;
const MANY_PLANES: usize = 48;
/// Share of like neighbours from which a value lies in blocks. A ball of two voxels' radius has half.
const LEAST_ALIKE: f64 = 0.5;
/// The same for all values but zero.
const LEAST_ALIKE_IN_ALL: f64 = 0.6;
/// What masks have for white: one among floats, and the greatest number of a type.
const WHITES: [u32; 5] = [1, 127, 255, 32_767, 65_535];
/// So few values may all touch each other in their order.
const FEW_VALUES: usize = 5;

/// Most voxels that are looked at to tell labels from values.
const MOST_JUDGED: u64 = 512 * 512 * 512;
/// What is said of a guess.
pub(crate) const TAKEN_FOR_LABELS: &str =
    "few whole numbers in blocks were taken for labels; --voxels values shows them as values";

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::volume::VolumeInfo;

    use super::*;

    fn are_labels(volume: &Volume) -> bool {
        look_like_labels(volume, false)
    }

    const SIDE: usize = 40;

    fn volume(value: impl Fn([f32; 3]) -> f32) -> Volume {
        let at = |i: usize| [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE].map(|n| n as f32 - 20.0);
        let voxels: Vec<u16> = (0..SIDE.pow(3)).map(|i| value(at(i)) as u16).collect();
        let dims = [SIDE as u32; 3];
        Volume::new(dims, Vec3::ONE, Voxels::U16(voxels), (1.0, 0.0), VolumeInfo::default()).unwrap()
    }

    /// A number that looks random, 0 to 1.
    fn noise([x, y, z]: [f32; 3]) -> f32 {
        ((x * 12.9898 + y * 78.233 + z * 37.719).sin() * 43_758.547).abs().fract()
    }

    fn radius([x, y, z]: [f32; 3]) -> f32 {
        (x * x + y * y + z * z).sqrt()
    }

    #[test]
    fn blocks_of_few_numbers_are_labels() {
        // Eight parts of a ball, two nested balls, a mask, and thin shells.
        let parts = |at: [f32; 3]| {
            let corner: f32 =
                at.iter().zip([1.0, 2.0, 4.0]).map(|(x, bit)| if *x < 0.0 { bit } else { 0.0 }).sum();
            if radius(at) < 15.0 { 10.0 + 100.0 * corner } else { 0.0 }
        };
        assert!(are_labels(&volume(parts)));
        assert!(are_labels(&volume(|at| [2.0, 1.0, 0.0][(radius(at) / 8.0).min(2.0) as usize])));
        assert!(are_labels(&volume(|at| f32::from(radius(at) < 9.0))));
        assert!(are_labels(&volume(|at| 10.0 * f32::from(radius(at) < 9.0))));
        assert!(are_labels(&volume(|at| if (8.0..11.0).contains(&radius(at)) { 7.0 } else { parts(at) })));
    }

    #[test]
    fn scans_are_no_labels() {
        // A mask with a soft edge, noise of three levels, a coarse smooth scan, and a microscope's black and white.
        assert!(!are_labels(&volume(|at| (255.0 - 40.0 * (radius(at) - 9.0)).clamp(0.0, 255.0))));
        assert!(!are_labels(&volume(|at| (noise(at) * 3.0).floor())));
        assert!(!are_labels(&volume(|at| (20.0 - radius(at)).max(0.0).floor())));
        assert!(!are_labels(&volume(|at| ((20.0 - radius(at)) / 2.5).max(0.0).floor())));
        assert!(!are_labels(&volume(|at| if radius(at) < 9.0 { 255.0 } else { 0.0 })));
        assert!(!are_labels(&volume(|at| 100.0 * noise(at) + 1000.0 * f32::from(radius(at) < 9.0))));
    }
}
