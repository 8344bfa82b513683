//! Every level of a pyramid looks as the finest one does: its place, its unit of length, its domain.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/zarr.rs"]
mod zarr;

use std::path::Path;
use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::image_error::compare;
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::look::Look;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Finest, Histogram, Volume};
use isinglass_formats::{Flip, OpenOptions, Selection, open};
use tempfile::TempDir;
use zarr::{ArrayText, Packing, write_image};

/// How a writer makes a coarser level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rule {
    /// The mean of the voxels of a box. What does not fill a box is cut.
    Means,
    /// The first voxel of each box.
    Firsts,
}

const FACTORS: [u64; 3] = [2, 2, 1];
const PACKINGS: [Packing; 3] = [Packing::Zstd, Packing::Blosc, Packing::Raw];

/// Writes a pyramid of floats, whose finest level has `dims` along x, y, z. `signs` are those of the steps.
fn write(folder: &Path, dims: [u64; 3], rule: Rule, signs: [f64; 3], value: impl Fn([u64; 3]) -> f32) {
    let levels: Vec<(Vec<f64>, Vec<f64>)> = (0..3)
        .map(|level| {
            let factors = FACTORS.map(|f| f.pow(level) as f64);
            let scale = [2, 1, 0].map(|k| signs[k] * factors[k] * (k + 1) as f64);
            let shift = [2, 1, 0].map(|k| match rule {
                Rule::Means => signs[k] * (factors[k] - 1.0) / 2.0 * (k + 1) as f64 + 7.0,
                Rule::Firsts => 7.0,
            });
            (scale.to_vec(), shift.to_vec())
        })
        .collect();
    write_image(folder, &["z", "y", "x"], &levels, "");
    for level in 0..3u32 {
        let factors = FACTORS.map(|f| f.pow(level));
        let count = |k: usize| match rule {
            Rule::Means => dims[k] / factors[k],
            Rule::Firsts => dims[k].div_ceil(factors[k]),
        };
        let shape = [count(2), count(1), count(0)];
        let array =
            ArrayText { shape: &shape, chunk: &[16; 3], dtype: "<f4", packing: PACKINGS[level as usize] };
        let number = |at: &[u64]| -> f32 {
            let first = [2, 1, 0].map(|i| at[i] * factors[2 - i]);
            match rule {
                Rule::Firsts => value(first),
                Rule::Means => {
                    let [x, y, z] = factors;
                    let all = (0..x * y * z)
                        .map(|i| [first[0] + i % x, first[1] + i / x % y, first[2] + i / x / y]);
                    all.map(&value).sum::<f32>() / (x * y * z) as f32
                }
            }
        };
        array.write(&folder.join(level.to_string()), |at| number(at).to_le_bytes().to_vec());
    }
}

fn opened(folder: &Path, level: u32, more: Selection) -> Volume {
    let selection = Selection { level: Some(level), ..more };
    let options = OpenOptions { selection, ..OpenOptions::default() };
    open(folder.to_str().unwrap(), &options).unwrap_or_else(|e| panic!("{e}"))
}

/// The same voxels as a volume of their own.
fn unpinned(volume: &Volume) -> Volume {
    let voxels = volume.voxels().clone();
    Volume::new(volume.dims(), volume.spacing(), voxels, volume.value_map(), volume.info.clone()).unwrap()
}

/// The greatest difference between the values of a level and a ramp over the world, which `of` has.
fn farthest(level: &Volume, of: &Volume, slope: Vec3) -> f32 {
    let middle = |volume: &Volume, at: Vec3| volume.world_from_voxel(at + 0.5).dot(slope);
    // The ramp's value at the world's origin, from the first voxel of the finest level.
    let zero = of.value_from_stored(of.voxels().get(0)) - middle(of, Vec3::ZERO);
    let [nx, ny, nz] = level.dims();
    (0..nx * ny * nz).fold(0.0, |most, i| {
        let at = Vec3::new((i % nx) as f32, (i / nx % ny) as f32, (i / nx / ny) as f32);
        let value = level.value_from_stored(level.voxels().get(i as usize));
        (value - zero - middle(level, at)).abs().max(most)
    })
}

#[test]
fn a_ramp_has_the_same_values_in_the_world_at_every_level() {
    let dims = [37, 22, 9];
    let ramp = |[x, y, z]: [u64; 3]| x as f32 + 10.0 * y as f32 + 100.0 * z as f32;
    for rule in [Rule::Means, Rule::Firsts] {
        for (signs, flip) in [
            ([1.0; 3], [false; 3]),
            ([1.0; 3], [true, false, true]),
            ([-1.0, 1.0, -1.0], [false; 3]),
            ([1.0, -1.0, 1.0], [true, true, false]),
        ] {
            let folder = TempDir::new().unwrap();
            write(folder.path(), dims, rule, signs, ramp);
            let region = [None, Some("8:32,4:,2:7".parse().unwrap())];
            for region in region {
                let more = Selection { flip: Flip(flip), ..Selection::default() };
                let finest = opened(folder.path(), 0, Selection { region, ..more });
                let sign = |k: usize| if (signs[k] < 0.0) != flip[k] { -1.0 } else { 1.0 };
                let slope = Vec3::new(sign(0), 10.0 * sign(1) / 2.0, 100.0 * sign(2) / 3.0);
                assert!(farthest(&finest, &finest, slope) < 1e-2, "{rule:?} {signs:?} {flip:?}");
                for level in 1..3 {
                    // A mirrored axis counts regions from its other end, where sizes do not divide.
                    let of_level = region.filter(|_| signs == [1.0; 3] && flip == [false; 3]);
                    let is_part = of_level.is_some() && level == 1;
                    if region.is_some() && !is_part {
                        continue;
                    }
                    let part = is_part.then(|| "4:16,2:,2:7".parse().unwrap());
                    let coarse = opened(folder.path(), level, Selection { region: part, ..more });
                    let error = farthest(&coarse, &finest, slope);
                    assert!(error < 1e-2, "{rule:?} {signs:?} {flip:?} {region:?} {level}: {error}");
                    assert_eq!(coarse.bounds(), finest.bounds());
                    assert_eq!(coarse.stored_range(), finest.stored_range());
                    assert_eq!(Histogram::of(&coarse), Histogram::of(&finest));
                    assert_eq!(coarse.voxel_side(), finest.voxel_side());
                    let steps = coarse.spacing() / finest.spacing();
                    let expected = Vec3::from(FACTORS.map(|f| f.pow(level) as f32));
                    assert_eq!(steps, expected);
                    // Each voxel has its place in the file.
                    let place = |volume: &Volume| {
                        let place = volume.info.placement.unwrap();
                        place.file_from_world(Vec3::new(3.0, -2.0, 1.0))
                    };
                    let apart = place(&coarse).into_iter().zip(place(&finest)).map(|(a, b)| (a - b).abs());
                    assert!(apart.fold(0.0, f64::max) < 1e-4, "{:?} {:?}", place(&coarse), place(&finest));
                    // The control: a level by itself lies elsewhere.
                    let error = farthest(&unpinned(&coarse), &finest, slope);
                    assert!(is_part || error > 0.3, "{rule:?} {signs:?} {flip:?} {level}: {error}");
                }
            }
        }
    }
}

/// Three balls, as bytes would have them.
fn balls([x, y, z]: [u64; 3]) -> f32 {
    let at = Vec3::new(x as f32, y as f32, 2.0 * z as f32);
    let ball = |center: Vec3, radius: f32| (1.5 - (at - center).length() / radius).clamp(0.0, 1.0);
    let all = [(Vec3::new(20.0, 20.0, 20.0), 12.0), (Vec3::new(45.0, 40.0, 40.0), 9.0)];
    let sum: f32 = all.iter().map(|(center, radius)| ball(*center, *radius)).sum();
    // A few bright voxels, which no mean keeps.
    let spark = if (x, y, z) == (50, 11, 20) { 60.0 } else { 0.0 };
    (100.0 * sum + spark * 3.0).min(255.0)
}

fn picture(volume: &Volume, domain: Domain, unit_length: UnitLength) -> Vec<u8> {
    let p = |x, opacity| ControlPoint { x, color: [0.9, 0.5 + x / 2.0, 1.0 - x], opacity };
    let points = vec![p(0.0, 0.0), p(0.2, 0.02), p(1.0, 0.2)];
    let look = Look {
        shaded: true,
        ..Look::new(TransferFunction { name: "a".into(), domain, unit_length, points })
    };
    let scene = Scene::of_look(Arc::new(volume.clone()), &look);
    let bounds = scene.volume.bounds();
    let pose = Pose::orbit(Vec3::ZERO, 0.5, 0.4, 3.0 * bounds.radius());
    let camera = Camera::new(pose, Intrinsics::orthographic(96, 96, 2.2 * bounds.radius()), &bounds);
    render(&scene, &camera).to_srgb8([0.0; 3])
}

#[test]
fn a_coarse_level_renders_as_near_to_the_finest_as_with_domain_and_unit_by_hand() {
    let folder = TempDir::new().unwrap();
    write(folder.path(), [65, 63, 31], Rule::Means, [1.0; 3], balls);
    let psnr = |a: &[u8], b: &[u8]| compare(a, b, 96, 96, [0; 3]).unwrap().psnr_db;
    let [finest, coarse] = [0, 1].map(|level| opened(folder.path(), level, Selection::default()));
    let (full, voxel) = (Domain::Full, UnitLength::Voxel);
    let expected = picture(&finest, full, voxel);
    let (lo, hi) = finest.value_range();
    let by_hand = picture(&coarse, Domain::Values(lo, hi), UnitLength::World(finest.voxel_side()));
    let found = picture(&coarse, full, voxel);
    let (found, by_hand) = (psnr(&found, &expected), psnr(&by_hand, &expected));
    assert!(found > 30.0 && found >= by_hand - 0.01, "{found} dB, by hand {by_hand} dB");
    // The control: the level's own domain and unit.
    let own = psnr(&picture(&unpinned(&coarse), full, voxel), &expected);
    assert!(own < found - 4.0, "{own} dB, pinned {found} dB");
}

#[test]
fn a_level_that_lies_elsewhere_is_a_volume_of_its_own() {
    let folder = TempDir::new().unwrap();
    write(folder.path(), [16; 3], Rule::Means, [1.0; 3], |[x, ..]| x as f32);
    assert!(opened(folder.path(), 1, Selection::default()).finest().is_some());
    let level = |scale: f64, shift: f64| (vec![scale; 3], vec![shift; 3]);
    for odd in [level(2.0, 100.0), level(9.0, 0.0), level(1e-9, 0.0), level(1e200, 0.0)] {
        write_image(folder.path(), &["z", "y", "x"], &[level(1.0, 0.0), odd.clone()], "");
        let selection = Selection { level: Some(1), ..Selection::default() };
        let options = OpenOptions { selection, ..OpenOptions::default() };
        match open(folder.path().to_str().unwrap(), &options) {
            Ok(volume) => {
                assert_eq!(volume.finest(), None::<&Arc<Finest>>, "{odd:?}");
                let text = "level 1 lies elsewhere than level 0";
                assert!(volume.info.warnings.iter().any(|w| w.starts_with(text)), "{odd:?}");
            }
            Err(e) => assert!(e.to_string().contains("expected finite numbers"), "{e}"),
        }
    }
}

#[test]
fn what_cannot_be_read_of_the_finest_level_leaves_a_word() {
    let folder = TempDir::new().unwrap();
    write(folder.path(), [16; 3], Rule::Means, [1.0; 3], |[x, ..]| x as f32);
    let is_told = |volume: &Volume| volume.info.warnings.iter().any(|w| w.contains("`isinglass index`"));
    let whole = opened(folder.path(), 1, Selection::default());
    assert!(!is_told(&whole) && whole.stored_range() == (0.0, 15.0));
    std::fs::write(folder.path().join("0/0/0/0"), b"no chunk").unwrap();
    let found = opened(folder.path(), 1, Selection::default());
    assert!(is_told(&found) && found.stored_range() == (0.5, 14.5));
    assert_eq!(found.bounds(), whole.bounds());
}
