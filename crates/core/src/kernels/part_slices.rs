//! Slices of a volume whose parts are in several processes: each cuts its own part, and one process adds the parts up. The
//! result is the slice of the whole, to the bit.

use super::part_rows::{self, PartsError};
use crate::cancel::ALWAYS;
use crate::volume::{Slice, SliceSpec, SliceSums, Volume, VoxelBox};

/// What the voxels of a process's own box add to a slice, as words. `volume` has them and those around them.
pub fn cut(volume: &Volume, own: &VoxelBox, spec: &SliceSpec) -> Vec<u32> {
    let sums = SliceSums::of(volume, own, spec, ALWAYS);
    let sums = sums.unwrap_or_else(|| SliceSums::nothing(volume, spec));
    let [width, height] = sums.size();
    let rows: Vec<u32> = (0..height).collect();
    part_rows::write(&rows, width, |x, y, words| match sums.at(x, y) {
        (_, 0) => 0,
        (value, num) => {
            let bits = value.to_bits();
            words.extend([bits as u32, (bits >> 32) as u32, num]);
            1
        }
    })
}

/// The slice of the whole, from what each process cut.
///
/// # Errors
/// If one did not send its part of this slice.
pub fn slice_of_parts(
    volume: &Volume,
    num_parts: usize,
    spec: &SliceSpec,
    lists: &[Vec<u32>],
) -> Result<Slice, PartsError> {
    let mut sums = SliceSums::nothing(volume, spec);
    let [width, height] = sums.size();
    for (rank, part) in
        part_rows::read_all(lists, num_parts, height as usize, width, WORDS)?.into_iter().enumerate()
    {
        for (row, y) in part.into_iter().zip(0..) {
            let mut columns = row.columns();
            let mut num_used = 0;
            for x in 0..width {
                if let [low, high, num, ..] = *columns(x) {
                    let value = f64::from_bits(u64::from(low) | u64::from(high) << 32);
                    sums.add((x, y), (value, num), spec.mode);
                    num_used += 1;
                }
            }
            let found = row.num_items();
            if found != num_used {
                return Err(PartsError::Stray { rank, row: y, found, expected: num_used });
            }
        }
    }
    Ok(sums.slice(volume, spec))
}

/// Words of a point: its sum, and the number of its values.
const WORDS: usize = 3;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::procedural::Builtin;
    use crate::volume::{
        AskedPoints, Finest, FoundPoints, GHOSTS, PartValues, SlabMode, SlicePlane, Split, ValuesAt, Voxels,
    };
    use glam::Vec3;

    /// A volume of noise with this kind of voxels.
    fn volume(kind: u8) -> Volume {
        let dims = [40, 33, 26];
        let noise = (0..40 * 33 * 26u32).map(|i| i.wrapping_mul(2_654_435_761) >> 8);
        let voxels = match kind {
            0 => Voxels::U8(noise.map(|n| n as u8).collect()),
            1 => Voxels::U16(noise.map(|n| n as u16).collect()),
            _ => Voxels::F32(noise.map(|n| n as f32 * 1.7e-3 - 999.0).collect()),
        };
        let info = Builtin::Cloud.volume(8).info.clone();
        Volume::new(dims, Vec3::new(0.9, 1.3, 0.7), voxels, (2.5, -40.0), info).unwrap()
    }

    /// The same numbers as the second level of a pyramid.
    fn level(kind: u8) -> Volume {
        let volume = volume(kind);
        let finest = Finest {
            dims: [80, 66, 51],
            spacing: volume.spacing() * 0.5,
            first: Vec3::splat(0.5),
            stored_range: None,
            histogram: None,
        };
        volume.with_finest(finest)
    }

    fn specs(volume: &Volume) -> Vec<SliceSpec> {
        let step = volume.finest_spacing().min_element();
        let oblique = SlicePlane::Oblique {
            origin: (volume.bounds().min * 1.1).into(),
            column: [0.8 * step, 0.5 * step, 0.1 * step],
            row: [-0.1 * step, 0.4 * step, 0.9 * step],
            size: [45, 37],
        };
        let planes =
            [(0, 17), (1, 8), (2, 16), (2, 25)].map(|(axis, index)| SlicePlane::Axis { axis, index });
        let modes = [SlabMode::Mean, SlabMode::Max, SlabMode::Min];
        let of_plane = |plane| {
            modes
                .into_iter()
                .flat_map(move |mode| [0.0, 9.3 * step].map(|thickness| SliceSpec { plane, thickness, mode }))
        };
        planes.into_iter().chain([oblique]).flat_map(of_plane).collect()
    }

    #[test]
    fn slices_and_values_of_all_parts_are_those_of_the_whole_to_the_bit() {
        let volumes = [volume(0), volume(1), volume(2), level(0), level(2)];
        for (volume, layers) in volumes.iter().flat_map(|v| [[2, 1, 1], [3, 2, 2]].map(|layers| (v, layers)))
        {
            let split = Split::grid(volume.dims(), layers).unwrap();
            let held = |rank| volume.part(&split.held(rank, GHOSTS)).unwrap();
            let parts: Vec<Volume> = (0..split.boxes().len()).map(held).collect();
            for spec in specs(volume) {
                let whole = Slice::of(volume, &spec, ALWAYS).unwrap();
                let cut_of = |(part, own)| cut(part, own, &spec);
                let lists: Vec<_> = parts.iter().zip(split.boxes()).map(cut_of).collect();
                let made = slice_of_parts(&parts[0], parts.len(), &spec, &lists).unwrap();
                assert_eq!(made, whole, "{spec:?}");
                // The controls: a part alone, and ghosts that count twice.
                if spec.mode == SlabMode::Mean && spec.thickness > 0.0 {
                    let mut fewer = lists.clone();
                    let last = fewer.len() - 1;
                    fewer[last] = cut(&parts[last], &VoxelBox { first: [0; 3], end: [0; 3] }, &spec);
                    let is_in_last = lists[last] != fewer[last];
                    let made = slice_of_parts(&parts[0], parts.len(), &spec, &fewer).unwrap();
                    assert_eq!(made != whole, is_in_last);
                }
            }
            let bounds = volume.bounds();
            let points =
                (0..90).map(|i| bounds.min * 1.02 + (bounds.max - bounds.min) * 1.04 * (i as f32 / 89.0));
            let points: Vec<Vec3> = points.collect();
            let ask = |values: &mut dyn ValuesAt| -> Vec<_> {
                points.iter().map(|p| (values.voxel(*p), values.between(*p))).collect()
            };
            let mut asked = AskedPoints::default();
            assert!(ask(&mut asked).iter().all(|(voxel, between)| voxel.is_none() && between.is_none()));
            let answers = parts.iter().zip(split.boxes()).map(|(volume, own)| {
                let found = asked.found_in(&mut PartValues { volume, own: *own });
                assert!(found.iter().any(Option::is_none), "no part has all");
                found
            });
            let answers: Vec<_> = answers.collect();
            let truth = ask(&mut &*volume);
            assert!(truth.iter().filter(|(voxel, _)| voxel.is_some()).count() > 60);
            assert_eq!(ask(&mut FoundPoints::of_parts(180, answers)), truth);
        }
    }

    #[test]
    fn words_that_are_no_part_of_a_slice_are_errors() {
        let volume = volume(0);
        let plane = SlicePlane::Axis { axis: 2, index: 3 };
        let spec = SliceSpec { plane, thickness: 0.0, mode: SlabMode::Mean };
        let words = cut(&volume, &volume.held(), &spec);
        let read = |lists: &[Vec<u32>], num| slice_of_parts(&volume, num, &spec, lists).map(|_| ());
        assert_eq!(read(std::slice::from_ref(&words), 1), Ok(()));
        let processes = Err(PartsError::Processes { found: 1, expected: 2 });
        assert_eq!(read(std::slice::from_ref(&words), 2), processes);
        for i in 0..words.len().min(400) {
            assert!(read(&[words[..i].to_vec()], 1).is_err(), "{i} words");
            let mut wrong = words.clone();
            wrong[i] ^= 0xffff_ffff;
            // It may mean something else, but nothing breaks.
            let _ = read(&[wrong], 1);
        }
    }
}
