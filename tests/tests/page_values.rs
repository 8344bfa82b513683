//! Are slices, probes and profiles of a volume that is read by pages those of the volume? With all pages of the finest
//! level they are it to the bit. Coarser ones stay within the values around each point.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::HashSet;
use std::sync::Arc;

use glam::Vec3;
use isinglass_core::cancel::ALWAYS;
use isinglass_core::volume::{
    Finest, FoundVoxel, Page, PageId, PageSet, PageValues, Pyramid, PyramidLevel, SlabMode, Slice,
    SlicePlane, SliceSpec, ValuesAt, Volume, VolumeInfo, VoxelKind, Voxels, page_of,
};
use isinglass_tests::levels::{Levels, other_channel, volume_of};

/// Slices in all directions, thin and thick, inside and at the edges.
fn slices(whole: &Volume) -> Vec<SliceSpec> {
    let axis = |axis: u8, index, thickness, mode| SliceSpec {
        plane: SlicePlane::Axis { axis, index },
        thickness,
        mode,
    };
    let step = whole.spacing().min_element();
    let oblique = |thickness, mode| SliceSpec {
        plane: SlicePlane::Oblique {
            origin: (whole.bounds().min * 1.1).to_array(),
            column: [step * 1.3, step * 0.6, 0.1 * step],
            row: [-0.2 * step, 0.7 * step, step],
            size: [130, 90],
        },
        thickness,
        mode,
    };
    let mut specs = vec![oblique(0.0, SlabMode::Mean), oblique(9.0 * step, SlabMode::Mean)];
    specs.extend([oblique(4.0 * step, SlabMode::Min), oblique(5.0 * step, SlabMode::Max)]);
    for (a, index) in [(0, 63), (0, 64), (1, 65), (1, 0), (2, 20), (2, 9999)] {
        specs.push(axis(a, index, 0.0, SlabMode::Mean));
    }
    specs.extend([axis(0, 66, 11.0, SlabMode::Mean), axis(2, 30, 7.0, SlabMode::Max)]);
    specs
}

/// What stands for a page of the finest level in a set.
fn finder(set: &PageSet) -> impl Fn([u32; 3]) -> Arc<Page> + Sync {
    |at| set.pages()[set.slot(at)].clone()
}

/// Points everywhere in a volume, and on the borders of its voxels and pages.
fn points(whole: &Volume) -> Vec<Vec3> {
    let bounds = whole.bounds();
    let inside = (0..1500u32).map(|i| {
        let share = Vec3::new((i % 37) as f32 / 36.0, (i % 41) as f32 / 40.0, (i % 43) as f32 / 42.0);
        bounds.min + (bounds.max - bounds.min) * share
    });
    let dims = whole.dims();
    let at_borders = (0..600u32).map(|i| {
        let voxel = [i * 7 % (dims[0] + 1), i * 5 % (dims[1] + 1), i * 3 % (dims[2] + 1)];
        Vec3::from_array(voxel.map(|v| v as f32)) * whole.spacing() + bounds.min
    });
    inside.chain(at_borders).collect()
}

/// Compares slices and points of all pages with the volume, to the bit.
fn agree(whole: &Volume, levels: &Levels) {
    let (base, pyramid) = (levels.base(), &*levels.pyramid);
    let (all, none) =
        (levels.set(|_| true), levels.set(|id| usize::from(id.level) + 1 == levels.volumes.len()));
    let (all, none) = (finder(&all), finder(&none));
    let read = |id: PageId| {
        let level = &levels.volumes[usize::from(id.level)];
        Some(page_of(level, pyramid.first_point(id)))
    };
    let (known, coarse) = (PageValues::known(&base, pyramid, &all), PageValues::known(&base, pyramid, &none));
    let full = PageValues::known(&base, pyramid, &none).reading(0, &read);
    let mut num_different = 0;
    for spec in slices(whole) {
        let flat = Slice::of(whole, &spec, ALWAYS).unwrap();
        assert_eq!(Slice::of_pages(&known, &spec, ALWAYS), Some((flat.clone(), 0)), "{spec:?}");
        assert_eq!(Slice::of_pages(&full, &spec, ALWAYS), Some((flat.clone(), 0)), "{spec:?}: read");
        let (rough, level) = Slice::of_pages(&coarse, &spec, ALWAYS).unwrap();
        // A slice beside the volume has no values of any level.
        assert!(rough == flat || usize::from(level) + 1 == levels.volumes.len(), "{spec:?}: {level}");
        assert_eq!(rough.size, flat.size);
        num_different += usize::from(rough != flat);
    }
    assert!(num_different > 6, "the control: a coarser level is another slice, {num_different}");
    for values in [&known, &full] {
        let (mut paged, mut flat) = (values.cursor(), whole);
        for point in points(whole) {
            assert_eq!(paged.voxel(point), flat.voxel(point), "{point}");
            assert_eq!(paged.between(point), flat.between(point), "{point}");
        }
        assert_eq!(paged.coarsest(), 0);
    }
    let (mut rough, mut flat) = (coarse.cursor(), whole);
    let differ = points(whole).into_iter().filter(|p| rough.voxel(*p) != flat.voxel(*p)).count();
    assert!(differ > 100, "the control: {differ}");
}

const FACTORS: [[u32; 3]; 3] = [[1; 3], [2, 2, 1], [4, 4, 2]];

/// Holes that cross the borders of pages, and a larger one with nothing beside most of it.
fn with_holes(volume: Volume, seed: u32) -> Volume {
    let [nx, ny, nz] = volume.dims();
    let is_gap = |i: u32| {
        let [x, y, z] = [i % nx, i / nx % ny, i / nx / ny].map(|v| v as f32);
        let far = |a: f32, b: f32, c: f32, r: f32| (x - a).hypot(y - b).hypot(z - c) > r;
        let edge = if seed == 0 { 64.0 } else { 30.0 };
        !far(edge, 40.0, 30.0, 9.0)
            || x > 118.0
            || (x as u32 * 7 + y as u32 * 5 + z as u32 + seed).is_multiple_of(31)
    };
    volume.with_gaps((0..nx * ny * nz).map(|i| u8::from(is_gap(i))).collect())
}

#[test]
fn values_of_every_type_spacing_and_size_are_those_of_the_volume() {
    for (dims, spacing, kind) in [
        ([150, 90, 70], Vec3::new(1.0, 1.25, 0.8), VoxelKind::U8),
        ([131, 67, 129], Vec3::new(0.3, 0.7, 4.1), VoxelKind::U16),
        ([141, 71, 65], Vec3::new(2.0, 0.013, 0.4), VoxelKind::F32),
    ] {
        let whole = volume_of(dims, spacing, kind);
        agree(&whole, &Levels::of(&whole, &FACTORS));
    }
}

#[test]
fn values_of_several_channels_are_those_of_the_first() {
    let whole = volume_of([150, 90, 70], Vec3::ONE, VoxelKind::U8);
    let other = other_channel(&whole, 3);
    let whole = whole.with_others(vec![other.clone()]).unwrap();
    agree(&whole, &Levels::of(&whole, &FACTORS));
    // The control: the other channel has other values.
    let spec = slices(&whole)[4];
    assert_ne!(Slice::of(&whole, &spec, ALWAYS), Slice::of(&other, &spec, ALWAYS));
}

#[test]
fn values_in_and_beside_gaps_are_those_of_the_volume() {
    for kind in [VoxelKind::U8, VoxelKind::U16, VoxelKind::F32] {
        let whole = volume_of([150, 90, 70], Vec3::new(1.0, 1.25, 0.8), kind);
        let holed = with_holes(whole.clone(), 0);
        assert!(holed.voxels() != whole.voxels(), "the control: gaps are filled");
        agree(&holed, &Levels::of(&holed, &FACTORS));
    }
}

#[test]
fn coarse_values_are_between_those_around_them() {
    let whole = volume_of([150, 90, 70], Vec3::new(1.0, 1.25, 0.8), VoxelKind::F32);
    let levels = Levels::of(&whole, &FACTORS);
    let (base, pyramid) = (levels.base(), &*levels.pyramid);
    let (mut num_elsewhere, mut num) = (0, 0);
    for coarsest in [1, 2u8] {
        let factor = FACTORS[usize::from(coarsest)];
        // Every other page is finer by a level.
        let set = levels.set(|id| id.level == coarsest || (id.level + 1 == coarsest && id.at[0] % 2 == 1));
        let find = finder(&set);
        let values = PageValues::known(&base, pyramid, &find);
        let mut num_outside = 0;
        for (axis, index) in [(0, 20), (1, 20), (2, 33)] {
            let spec =
                SliceSpec { plane: SlicePlane::Axis { axis, index }, thickness: 0.0, mode: SlabMode::Mean };
            let (slice, level) = Slice::of_pages(&values, &spec, ALWAYS).unwrap();
            assert_eq!(level, coarsest);
            let [a, b] = [[1, 2], [0, 2], [0, 1]][usize::from(axis)];
            for (x, y) in (0..slice.size[0]).flat_map(|x| (0..slice.size[1]).map(move |y| (x, y))) {
                let mut at = [0; 3];
                (at[usize::from(axis)], at[a], at[b]) = (index, x, y);
                let is_within = |at: [u32; 3]| {
                    let range = |i: usize| at[i].saturating_sub(2 * factor[i])..=at[i] + 2 * factor[i];
                    let all = range(2).flat_map(|z| range(1).map(move |y| (y, z)));
                    let all = all.flat_map(|(y, z)| range(0).map(move |x| [x, y, z].map(|v| v as i32)));
                    let all = all.map(|[x, y, z]| whole.stored_at(x, y, z));
                    let (lo, hi) = all.fold((f32::MAX, f32::MIN), |(lo, hi), v| (lo.min(v), hi.max(v)));
                    (lo - 0.01..=hi + 0.01).contains(&slice.value(x, y))
                };
                if (x + y) % 5 == 0 {
                    num += 1;
                    num_outside += usize::from(!is_within(at));
                    num_elsewhere += usize::from(!is_within([at[0], (at[1] + 45) % 90, at[2]]));
                }
            }
        }
        assert_eq!(num_outside, 0, "of {num}");
    }
    assert!(num_elsewhere * 20 > num, "the control: elsewhere are other values, {num_elsewhere} of {num}");
}

/// Labels in blocks, of which neighbours have numbers far apart.
fn labels(dims: [u32; 3], are_labels: bool) -> (Volume, Levels) {
    let number =
        |[x, y, z]: [u32; 3]| [3u8, 200, 90, 17][((x / 9 + 2 * (y / 7) + 3 * (z / 11)) % 4) as usize];
    let whole_level = PyramidLevel { dims, factor: [1; 3], first: [0.0; 3] };
    let level = |factor: [u32; 3]| {
        let dims: [u32; 3] = std::array::from_fn(|k| dims[k].div_ceil(factor[k]));
        PyramidLevel { dims, factor, first: [0.0; 3] }
    };
    let shapes = [whole_level, level([2; 3]), level([4; 3])];
    let volume = |PyramidLevel { dims, factor, .. }: PyramidLevel| {
        let [nx, ny, nz] = dims;
        let at = |i: u32| [i % nx * factor[0], i / nx % ny * factor[1], i / nx / ny * factor[2]];
        let voxels = Voxels::U8((0..nx * ny * nz).map(|i| number(at(i))).collect());
        let info = VolumeInfo { are_labels, ..VolumeInfo::default() };
        Volume::new(dims, Vec3::from_array(factor.map(|f| f as f32)), voxels, (1.0, 0.0), info).unwrap()
    };
    let whole = volume(shapes[0]);
    let finest = |first: Vec3| Finest {
        dims,
        spacing: Vec3::ONE,
        first,
        stored_range: Some(whole.stored_range()),
        histogram: None,
    };
    let volumes = shapes.iter().map(|shape| volume(*shape).with_finest(finest(Vec3::ZERO))).collect();
    let info = whole.info.clone();
    let pyramid = Pyramid {
        levels: shapes.to_vec(),
        spacing: Vec3::ONE,
        kind: VoxelKind::U8,
        value_maps: vec![(1.0, 0.0)],
        info,
    };
    (whole, Levels { pyramid: Arc::new(pyramid), volumes })
}

#[test]
fn slices_and_profiles_of_labels_show_no_label_that_is_not_there() {
    let numbers = |are_labels: bool| {
        let (whole, levels) = labels([141, 90, 70], are_labels);
        agree(&whole, &levels);
        let mut found = HashSet::new();
        let set = levels.set(|id| id.level == 1 && id.at[0] == 0);
        let (base, find) = (levels.base(), finder(&set));
        let values = PageValues::known(&base, &levels.pyramid, &find);
        for spec in
            slices(&whole).into_iter().filter(|spec| spec.mode != SlabMode::Mean || spec.thickness == 0.0)
        {
            let (slice, _) = Slice::of_pages(&values, &spec, ALWAYS).unwrap();
            let flat = Slice::of(&whole, &spec, ALWAYS).unwrap();
            for slice in [&slice, &flat] {
                let [width, height] = slice.size;
                let all = (0..width).flat_map(|x| (0..height).map(move |y| (x, y)));
                found.extend(all.map(|(x, y)| slice.value(x, y).round() as u32));
            }
        }
        let (mut cursor, mut flat) = (values.cursor(), &whole);
        for point in points(&whole) {
            found
                .extend([cursor.between(point), flat.between(point)].into_iter().flatten().map(|v| v as u32));
        }
        found
    };
    assert_eq!(numbers(true), HashSet::from([3, 17, 90, 200]));
    assert!(numbers(false).len() > 50, "the control: values are mixed");
}

#[test]
fn what_is_not_known_or_cannot_be_read_is_of_the_coarser_level_and_says_so() {
    let whole = volume_of([150, 90, 70], Vec3::new(1.0, 1.25, 0.8), VoxelKind::F32);
    let levels = Levels::of(&whole, &FACTORS);
    let (base, pyramid) = (levels.base(), &*levels.pyramid);
    let some = levels.set(|id| id.level == 0 && id.at[0] == 0);
    let find = finder(&some);
    let (known, mut flat) = (PageValues::known(&base, pyramid, &find), &whole);
    let (mut cursor, mut num_coarse) = (known.cursor(), 0);
    for point in points(&whole) {
        let Some(voxel) = flat.voxel(point) else { continue };
        let found: FoundVoxel = cursor.voxel(point).unwrap();
        assert_eq!(found.index, voxel.index);
        assert!(found.level == 2 || found == voxel, "the finest that is known, or it says so");
        num_coarse += usize::from(found.level == 2);
    }
    assert!(num_coarse > 700 && num_coarse < 1500, "{num_coarse}");
    assert_eq!(cursor.coarsest(), 2);
    let outside = whole.bounds().max + 1.0;
    assert_eq!((cursor.voxel(outside), cursor.between(outside)), (None, None));
    let read = |id: PageId| {
        let level = &levels.volumes[usize::from(id.level)];
        (id.at != [1, 0, 0]).then(|| page_of(level, pyramid.first_point(id)))
    };
    let none = levels.set(|_| false);
    let find = finder(&none);
    let torn = PageValues::known(&base, pyramid, &find).reading(0, &read);
    for (spec, expected) in [(slices(&whole)[5], 2), (slices(&whole)[8], 2)] {
        let (slice, level) = Slice::of_pages(&torn, &spec, ALWAYS).unwrap();
        assert_eq!(
            (level, slice == Slice::of(&whole, &spec, ALWAYS).unwrap()),
            (expected, false),
            "{spec:?}"
        );
        assert_eq!(Slice::of_pages(&torn, &spec, &|| false), None, "nobody waits");
    }
    // The control: a slice that does not meet the page is exact.
    let plane = SlicePlane::Axis { axis: 0, index: 3 };
    let spec = SliceSpec { plane, thickness: 0.0, mode: SlabMode::Mean };
    assert_eq!(Slice::of_pages(&torn, &spec, ALWAYS), Some((Slice::of(&whole, &spec, ALWAYS).unwrap(), 0)));
}
