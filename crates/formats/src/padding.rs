//! Pixels outside of what a scanner measures: a value that the file names, or one that CT scanners write there.

use isinglass_core::volume::{Volume, Voxels};
use rayon::prelude::*;

use crate::units::may_be_hounsfield;

/// The volume with nothing in voxels of the padding value: `told`, or what is known of CT. Returns the stored number of
/// such voxels, too.
pub(crate) fn without_padding(mut volume: Volume, told: Option<f64>) -> (Volume, Option<f32>) {
    let (lo, hi) = volume.value_range();
    let (scale, offset) = volume.value_map();
    let stored_of = |value: f64| ((value - f64::from(offset)) / f64::from(scale)) as f32;
    let padding = match told {
        Some(value) => Some(stored_of(value)),
        None if may_be_hounsfield(lo, hi) && volume.gaps().is_none() => {
            let stored = stored_of(f64::from(lo));
            (OF_CT.contains(&lo) && is_apart(&volume, stored, f64::from(scale))).then_some(stored)
        }
        None => None,
    };
    let Some(padding) = padding else { return (volume, None) };
    let is_integer = !matches!(volume.voxels(), Voxels::F32(_));
    let padding = if is_integer { padding.round() } else { padding };
    let gaps: Vec<u8> = match volume.voxels() {
        Voxels::U8(v) => v.par_iter().map(|x| u8::from(f32::from(*x) == padding)).collect(),
        Voxels::U16(v) => v.par_iter().map(|x| u8::from(f32::from(*x) == padding)).collect(),
        Voxels::F32(v) => v.par_iter().map(|x| u8::from(*x == padding)).collect(),
    };
    let before = volume.gaps().map(|gaps| gaps.bytes.clone());
    let gaps = match before {
        Some(before) => gaps.into_iter().zip(before).map(|(a, b)| a | b).collect(),
        None => gaps,
    };
    let had = volume.gaps().map_or(0, |gaps| gaps.num_gaps);
    volume = volume.with_gaps(gaps);
    let num = volume.gaps().map_or(0, |gaps| gaps.num_gaps) - had;
    if num > 0 {
        let value = padding * scale + offset;
        let text = format!("{num} voxels are {value}, outside of the scanned part; nothing is shown there");
        volume.info.warnings.push(text);
    }
    (volume, Some(padding))
}

/// Whether a good share of the voxels has the number, and hardly any one of the numbers next to it.
fn is_apart(volume: &Volume, number: f32, scale: f64) -> bool {
    let near = (f64::from(NEAR) / scale.abs()) as f32;
    let count = |x: f32| {
        let is_equal = x == number;
        (u64::from(is_equal), u64::from(!is_equal && (x - number).abs() <= near))
    };
    let both = |a: (u64, u64), b: (u64, u64)| (a.0 + b.0, a.1 + b.1);
    let (equal, beside) = match volume.voxels() {
        Voxels::U8(v) => v.par_iter().map(|x| count(f32::from(*x))).reduce(|| (0, 0), both),
        Voxels::U16(v) => v.par_iter().map(|x| count(f32::from(*x))).reduce(|| (0, 0), both),
        Voxels::F32(v) => v.par_iter().map(|x| count(*x)).reduce(|| (0, 0), both),
    };
    are_padding(equal, beside, volume.voxels().len() as u64)
}

/// Whether `equal` of so many voxels are padding, if `beside` others have a value within [`NEAR`] of it.
pub(crate) fn are_padding(equal: u64, beside: u64, num_voxels: u64) -> bool {
    equal * FEWEST > num_voxels && beside * MOST_BESIDE < equal
}

/// What scanners write outside of their circle, in Hounsfield units.
pub(crate) const OF_CT: [f32; 5] = [-3024.0, -3000.0, -2048.0, -2000.0, -1024.0];
/// At least one voxel in so many is padding.
const FEWEST: u64 = 100;
/// At most one voxel for so many has a value near the padding's.
const MOST_BESIDE: u64 = 20;
/// Values near the padding's, in its unit.
pub(crate) const NEAR: f32 = 3.0;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    fn ct(outside: f32, inside: impl Fn(u32) -> f32) -> Volume {
        let voxels = (0..1000u32).map(|i| if i < 300 { outside } else { inside(i) } + 4000.0);
        let voxels = Voxels::U16(voxels.map(|x| x as u16).collect());
        Volume::new([10; 3], Vec3::ONE, voxels, (1.0, -4000.0), Default::default()).unwrap()
    }

    #[test]
    fn what_is_outside_of_the_circle_is_nothing() {
        let tissue = |i: u32| -1000.0 + (i % 100) as f32 * 20.0;
        for outside in OF_CT {
            let (found, padding) = without_padding(ct(outside, tissue), None);
            assert_eq!(padding, Some(outside + 4000.0));
            assert_eq!(found.gaps().map(|g| g.num_gaps), Some(300), "{outside}");
            assert_eq!(found.value_range().0, -1000.0);
            assert!(found.info.warnings[0].contains(&outside.to_string()));
        }
        // The controls: another least value, air that happens to be the least, and a value that the file names.
        assert!(without_padding(ct(-1010.0, tissue), None).0.gaps().is_none());
        let air = |i: u32| -1024.0 + (i % 7) as f32;
        assert!(without_padding(ct(-1024.0, air), None).0.gaps().is_none());
        let (told, _) = without_padding(ct(-1010.0, tissue), Some(-1010.0));
        assert_eq!(told.gaps().map(|g| g.num_gaps), Some(300));
    }
}
