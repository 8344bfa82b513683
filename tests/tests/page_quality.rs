//! Is a picture by pages ever worse than that of a level which the same memory holds whole? And is a part of it ever much
//! coarser than the part beside? A search over volumes, memories and views.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::image_error::compare;
use isinglass_core::kernels::march::{Scene, SeenPages, render};
use isinglass_core::mode::Mode;
use isinglass_core::picture::Picture;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{
    Lighting, Page, PageId, PagePlan, PageSet, PageView, Residency, Volume, VoxelKind, Voxels,
};
use isinglass_formats::preset;
use isinglass_tests::levels::{Levels, settings, transfer, volume_of};
use rayon::prelude::*;

/// A volume of bytes by a function of -1 to 1 along each axis.
fn bytes(dims: [u32; 3], spacing: Vec3, value: impl Fn(Vec3) -> f32 + Sync) -> Volume {
    let [nx, ny, nz] = dims;
    let at = |i: u32| {
        let index = Vec3::new((i % nx) as f32, (i / nx % ny) as f32, (i / nx / ny) as f32);
        let size = Vec3::from_array(dims.map(|n| n as f32 - 1.0));
        value(index / size * 2.0 - 1.0).clamp(0.0, 255.0) as u8
    };
    let voxels = Voxels::U8((0..nx * ny * nz).into_par_iter().map(at).collect());
    Volume::new(dims, spacing, voxels, (1.0, 0.0), Default::default()).unwrap()
}

/// A sheet without an end, thinner than a voxel of the coarser levels.
fn gyroid(p: Vec3) -> f32 {
    let q = p * 20.0;
    let g = q.x.sin() * q.y.cos() + q.y.sin() * q.z.cos() + q.z.sin() * q.x.cos();
    if p.length_squared() < 0.9 && g.abs() < 0.35 { 180.0 * (1.0 - g.abs() / 0.35) } else { 0.0 }
}

/// Numbers that look random, 0 to 1.
fn noise(p: Vec3, scale: f32) -> f32 {
    let q = (p * scale).floor();
    (q.dot(Vec3::new(12.9898, 78.233, 37.719)).sin() * 43_758.547).rem_euclid(1.0)
}

/// Fibres along x, of several widths.
fn fibres(p: Vec3) -> f32 {
    let (a, b) =
        ((p.y * 23.0 + (p.x * 5.0).sin()).fract().abs(), (p.z * 17.0 + (p.x * 3.0).cos()).fract().abs());
    let width = 0.1 + 0.1 * noise(Vec3::new(0.0, (p.y * 23.0).floor(), (p.z * 17.0).floor()), 1.0);
    if (a - 0.5).hypot(b - 0.5) < width { 220.0 } else { 0.0 }
}

struct Sample {
    name: &'static str,
    whole: Volume,
    transfer: TransferFunction,
    factors: Vec<[u32; 3]>,
}

fn samples() -> Vec<Sample> {
    let cubes = vec![[1; 3], [2; 3], [4; 3], [8; 3], [16; 3]];
    let flat = vec![[1; 3], [2, 2, 1], [4, 4, 1], [8, 8, 2], [16, 16, 4]];
    let by = |name, whole, transfer| Sample { name, whole, transfer, factors: cubes.clone() };
    let builtin = |name, builtin: Builtin| by(name, builtin.volume(140), preset(name).unwrap());
    let balls = |p: Vec3| 150.0 - 900.0 * (p - (p * 6.0).round() / 6.0).length() + 60.0 * p.x;
    let grain = |p: Vec3| 200.0 * noise(p, 90.0) * (1.0 - p.length());
    let bone = |p: Vec3| if (p.length() - 0.7).abs() < 0.03 { 230.0 } else { 60.0 * (1.0 - p.length()) };
    let sparse = |p: Vec3| if noise(p, 9.0) > 0.97 { 240.0 * noise(p, 40.0) } else { 0.0 };
    vec![
        by("gyroid", bytes([240; 3], Vec3::ONE, gyroid), transfer()),
        builtin("shells", Builtin::Shells),
        builtin("cloud", Builtin::Cloud),
        builtin("cubus", Builtin::Cubus),
        by("waves", volume_of([150, 90, 130], Vec3::new(1.0, 1.2, 0.9), VoxelKind::U16), transfer()),
        by("fibres", bytes([160, 140, 90], Vec3::ONE, fibres), transfer()),
        by("balls", bytes([100, 120, 200], Vec3::ONE, balls), transfer()),
        by("grain", bytes([131; 3], Vec3::ONE, grain), transfer()),
        by("bone", bytes([140, 150, 110], Vec3::new(0.8, 0.8, 1.1), bone), transfer()),
        by("sparse", bytes([150, 140, 130], Vec3::ONE, sparse), transfer()),
        Sample {
            name: "flat",
            whole: bytes([200, 190, 60], Vec3::new(1.0, 1.0, 4.0), gyroid),
            transfer: transfer(),
            factors: flat,
        },
    ]
}

fn views(scene: &Scene) -> Vec<Camera> {
    let bounds = scene.volume.bounds();
    let radius = bounds.radius();
    let orbit = |turn: f32, distance: f32| Pose::orbit(bounds.center(), turn, 0.4, distance * radius);
    vec![
        Camera::new(orbit(0.7, 2.4), Intrinsics::perspective(96, 80, 0.7), &bounds),
        Camera::new(orbit(2.9, 0.9), Intrinsics::perspective(96, 80, 0.8), &bounds),
        Camera::new(orbit(4.0, 2.0), Intrinsics::orthographic(96, 80, 2.0 * radius), &bounds),
    ]
}

fn dssim(a: &Picture, b: &Picture) -> f64 {
    let bytes = |p: &Picture| p.to_srgb8([0.0; 3]);
    let (width, height) = (a.width as usize, a.height as usize);
    compare(&bytes(a), &bytes(b), width, height, [0; 3]).unwrap().dssim
}

/// The pages of a resting view, once all of them are read. `memory` is in bytes, and whether a level may be held whole in
/// it.
fn settled(
    levels: &Levels,
    view: &PageView,
    (max_bytes, may_be_level): (u64, bool),
    is_visible: impl Fn(PageId) -> bool,
) -> Arc<PageSet> {
    let base: Vec<Arc<Page>> = levels.pyramid.base_pages(&levels.base()).unwrap();
    let page_bytes = base[0].num_bytes();
    let max_pages = ((max_bytes / page_bytes) as usize).saturating_sub(base.len());
    let mut residency = Residency::new(levels.pyramid.clone(), base, max_pages);
    let mut plan = PagePlan::of(&levels.pyramid, view, residency.share(1), is_visible);
    if let Some(level) = residency.level_that_fits(1).filter(|_| may_be_level) {
        plan = plan.or_level(&levels.pyramid, level);
    }
    residency.set_plan(1, plan);
    while let Some(id) = residency.take_next() {
        if let Some(level) = residency.insert(levels.page(id)) {
            residency.insert_level(Arc::new(level.finish(&levels.pyramid).unwrap()));
        }
        assert!(residency.num_pages() <= max_pages);
    }
    assert!(!residency.progress(1).progress.is_loading());
    Arc::new(residency.set(1))
}

/// A volume, its levels and what they show.
struct Search {
    name: &'static str,
    levels: Arc<Levels>,
    /// Each level by itself, finest first.
    all: Vec<Scene>,
    /// The coarsest level, which pages take the place of.
    base: Scene,
    seen: SeenPages,
}

impl Search {
    fn new(Sample { name, whole, transfer, factors }: Sample) -> Self {
        let levels = Arc::new(Levels::of(&whole, &factors));
        let settings = settings(Mode::Composite, Lighting::default());
        let scene = |volume: Volume| Scene::new(Arc::new(volume), &transfer, settings);
        let all: Vec<Scene> = levels.volumes.iter().cloned().map(scene).collect();
        let base = scene(levels.base().with_paging(levels.paging()));
        let seen = SeenPages::of(&levels.pyramid, &base, &*levels);
        Self { name, levels, all, base, seen }
    }

    /// Compares the pages of a view with the finest level that fits whole, for several memories.
    fn look(&self, number: usize, camera: Camera, found: &mut Findings) {
        let Self { name, levels, all, base, seen } = self;
        let view = PageView { camera, region: base.region(), rests: true };
        let truth = render(&all[0], &camera);
        let error = |scene: &Scene| dssim(&render(scene, &camera), &truth);
        let wholes: Vec<f64> = all.iter().map(error).collect();
        let base_pages = levels.pyramid.base_pages(&levels.base()).unwrap();
        // The coarsest level is always there, and a page is beside it while it is read. Memory is counted in pages.
        let beside = (base_pages.len() as u64 + 2) * base_pages[0].num_bytes();
        for share in [20, 35, 50, 80, 120, 180] {
            let max_bytes = levels.volumes[0].bytes_in_memory() * share / 100;
            let fits = |level: &Volume| level.bytes_in_memory() + beside <= max_bytes;
            let Some(level) = levels.volumes.iter().position(fits) else { continue };
            for is_known in [true, false] {
                let is_visible = |id| !is_known || seen.sees(id);
                let of = |may_be_level| settled(levels, &view, (max_bytes, may_be_level), is_visible);
                let set = of(true);
                let slots = set.table().iter().map(|slot| set.pages()[*slot as usize].id.level);
                found.num_mixed += usize::from(slots.clone().max() != slots.min());
                let bound = wholes[level] * MOST_MORE + 1e-4;
                let of_pages = error(&base.with_pages(set, None));
                if of_pages > bound {
                    let what = format!("{name}, view {number}, {share} %, values known: {is_known}");
                    found
                        .worse
                        .push(format!("{what}: {of_pages:.4}, level {level} has {:.4}", wholes[level]));
                }
                if is_known && number == 0 {
                    found.num_worse_alone += usize::from(error(&base.with_pages(of(false), None)) > bound);
                }
            }
        }
    }
}

#[derive(Default)]
struct Findings {
    worse: Vec<String>,
    /// Sets of pages of several levels.
    num_mixed: usize,
    /// How often pages are worse that may not be a level in their place.
    num_worse_alone: usize,
}

#[test]
fn pages_are_never_worse_than_a_level_that_fits_whole() {
    let mut found = Findings::default();
    for search in samples().into_iter().map(Search::new) {
        for (number, camera) in views(&search.all[0]).into_iter().enumerate() {
            search.look(number, camera, &mut found);
        }
    }
    let Findings { worse, num_mixed, num_worse_alone } = found;
    assert!(worse.is_empty(), "{}", worse.join("\n"));
    assert!(num_mixed > 5, "{num_mixed} sets have several levels");
    // The control: pages alone take more memory than a level.
    assert!(num_worse_alone > 10, "{num_worse_alone}");
}

/// A picture of pages of several levels may have this many times the error of one of the coarser of them: where levels
/// meet, colours step a little.
const MOST_MORE: f64 = 1.02;
