//! Do pages come and go as the memory allows? Whatever order they arrive in, and whatever fails, what is shown at rest is
//! the same, nothing becomes coarser while it is refined, and the memory is kept to.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::HashSet;
use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::space::Aabb;
use isinglass_core::volume::{
    PAGE_VOXELS, Page, PageId, PagePlan, PageSet, PageView, PageVoxels, Pyramid, PyramidLevel, Residency,
    VolumeInfo, VoxelKind, Voxels,
};

const DIMS: [u32; 3] = [513, 300, 129];

fn pyramid() -> Arc<Pyramid> {
    let level = |factor: u32| PyramidLevel {
        dims: DIMS.map(|d| d.div_ceil(factor)),
        factor: [factor; 3],
        first: [(factor as f32 - 1.0) * 0.5; 3],
    };
    let levels = [1, 2, 4, 8].map(level).into();
    let (spacing, kind, value_maps) = (Vec3::ONE, VoxelKind::U8, vec![(1.0, 0.0)]);
    Arc::new(Pyramid { levels, spacing, kind, value_maps, info: VolumeInfo::default() })
}

fn page(pyramid: &Pyramid, id: PageId) -> Arc<Page> {
    let voxels = PageVoxels { voxels: Voxels::U8(vec![id.level; PAGE_VOXELS]), gaps: None };
    Arc::new(Page::new(pyramid, id, vec![voxels]).unwrap())
}

fn base(pyramid: &Pyramid) -> Vec<Arc<Page>> {
    let [nx, ny, nz] = pyramid.pages(3);
    (0..nx * ny * nz)
        .map(|i| page(pyramid, PageId { level: 3, at: [i % nx, i / nx % ny, i / nx / ny] }))
        .collect()
}

fn bounds() -> Aabb {
    let half = Vec3::from_array(DIMS.map(|d| d as f32 * 0.5));
    Aabb { min: -half, max: half }
}

fn view(distance: f32, side: u32, rests: bool, clip: Clip) -> PageView {
    let bounds = bounds();
    let pose = Pose::orbit(Vec3::new(30.0, 10.0, 0.0), 0.4, 0.3, distance * bounds.radius());
    let camera = Camera::new(pose, Intrinsics::perspective(side, side, 0.7), &bounds);
    PageView { camera, region: clip.region(&bounds), rests }
}

/// The level of each part of the volume.
fn levels(set: &PageSet) -> Vec<u8> {
    set.table().iter().map(|slot| set.pages()[*slot as usize].id.level).collect()
}

/// A sequence of numbers that looks random.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % n
    }
}

/// Reads all that a plan wants, several pages at a time, which arrive or fail in any order.
fn settle(residency: &mut Residency, plan: PagePlan, dice: &mut Dice, failures: usize, max_pages: usize) {
    residency.set_plan(1, plan.clone());
    let pyramid = residency.pyramid().clone();
    let mut reading = Vec::new();
    let mut history = vec![levels(&residency.set(1))];
    loop {
        while reading.len() < 5 {
            let Some(id) = residency.take_next() else { break };
            reading.push(id);
        }
        if reading.is_empty() {
            break;
        }
        let id = reading.swap_remove(dice.roll(reading.len()));
        if failures > 0 && dice.roll(failures) == 0 {
            residency.fail(id, false);
        } else {
            residency.insert(page(&pyramid, id));
        }
        assert!(residency.num_pages() <= max_pages, "{} pages", residency.num_pages());
        history.push(levels(&residency.set(1)));
    }
    // What the view shows in the end never became coarser on the way.
    let set = residency.set(1);
    let seen = set.table().iter().map(|slot| plan.leaves().contains(&set.pages()[*slot as usize].id));
    for (place, _) in seen.enumerate().filter(|(_, is_seen)| *is_seen) {
        assert!(history.windows(2).all(|w| w[1][place] <= w[0][place]), "coarser than before");
    }
}

fn settled(view: &PageView, max_pages: usize, seed: u64) -> (Vec<u8>, isinglass_core::volume::PageProgress) {
    let pyramid = pyramid();
    let mut residency = Residency::new(pyramid.clone(), base(&pyramid), max_pages);
    let mut dice = Dice(seed);
    // What was looked at before does not matter.
    let before = self::view(0.3 + 0.2 * seed as f32, 60, seed.is_multiple_of(2), Clip::default());
    let plan = PagePlan::of(&pyramid, &before, residency.share(1), |_| true);
    residency.set_plan(1, plan);
    for _ in 0..seed * 10 {
        if let Some(id) = residency.take_next() {
            residency.insert(page(&pyramid, id));
        }
    }
    let plan = PagePlan::of(&pyramid, view, residency.share(1), |_| true);
    settle(&mut residency, plan, &mut dice, 0, max_pages);
    (levels(&residency.set(1)), residency.progress(1).progress)
}

#[test]
fn what_is_shown_at_rest_depends_on_the_pose_and_the_memory_only() {
    for (distance, max_pages) in [(2.0, 400), (2.0, 120), (0.4, 120), (0.4, 90)] {
        let view = view(distance, 200, true, Clip::default());
        let (first, progress) = settled(&view, max_pages, 0);
        assert!(!progress.is_loading(), "{progress:?}");
        for seed in 1..5 {
            assert_eq!(settled(&view, max_pages, seed), (first.clone(), progress), "{distance} {max_pages}");
        }
        // Negative control: another pose or less memory shows something else.
        let other = self::view(0.8 * distance, 200, true, Clip::default());
        assert!(max_pages == 400 || settled(&other, max_pages, 0).0 != first);
    }
}

#[test]
fn with_memory_enough_all_that_is_seen_is_of_the_finest_level() {
    let (_, whole) = settled(&view(2.5, 200, true, Clip::default()), 1000, 3);
    assert!(whole.is_exact() && whole.num_wanted == 8 * 5 * 2, "{whole:?}");
    let (levels, near) = settled(&view(0.3, 100, true, Clip::default()), 1000, 2);
    assert!(near.is_exact() && near.num_wanted < 60 && levels.contains(&0), "{near:?}");
    let (_, less) = settled(&view(2.5, 200, true, Clip::default()), 60, 1);
    assert!(!less.is_exact() && !less.is_loading() && less.coarse_share > 0.1, "{less:?}");
    let (levels, none) = settled(&view(2.5, 200, true, Clip::default()), 0, 1);
    assert!(levels.iter().all(|level| *level == 3) && none.coarse_share == 1.0, "{none:?}");
}

#[test]
fn a_moving_camera_wants_a_voxel_for_a_pixel() {
    let pyramid = pyramid();
    let of = |side, rests| {
        let plan = PagePlan::of(&pyramid, &view(2.5, side, rests, Clip::default()), 1000, |_| true);
        let levels: HashSet<u8> = plan.leaves().iter().map(|id| id.level).collect();
        (levels, plan.leaves().len())
    };
    // Pixels of a small picture are several voxels wide, those of a large one are less than one.
    let (coarse, num_coarse) = of(60, false);
    let (fine, num_fine) = of(2000, false);
    assert!(coarse.iter().all(|level| *level >= 1) && num_coarse < 40, "{coarse:?} {num_coarse}");
    assert!(fine == HashSet::from([0]) && num_fine == 80, "{fine:?} {num_fine}");
    assert_eq!(of(60, true), (HashSet::from([0]), 80));
}

#[test]
fn what_cannot_be_seen_is_not_wanted() {
    let pyramid = pyramid();
    let num = |view: &PageView, is_visible: &dyn Fn(PageId) -> bool| {
        PagePlan::of(&pyramid, view, 1000, is_visible).leaves().len()
    };
    let all = view(2.5, 200, true, Clip::default());
    let plane = Plane::new(Vec3::X, 0.0);
    let half = view(2.5, 200, true, Clip { plane, ..Clip::default() });
    assert_eq!(num(&all, &|_| true), 80);
    let right = num(&half, &|_| true);
    assert!((40..=50).contains(&right), "{right}");
    assert_eq!(num(&all, &|id| id.level > 0 || id.at[1] == 0), 16);
}

#[test]
fn pages_that_fail_leave_coarser_ones() {
    let pyramid = pyramid();
    let mut residency = Residency::new(pyramid.clone(), base(&pyramid), 1000);
    let view = view(2.5, 200, true, Clip::default());
    // Each third reading fails, so nearly all pages come after some tries.
    let plan = PagePlan::of(&pyramid, &view, residency.share(1), |_| true);
    settle(&mut residency, plan, &mut Dice(5), 3, 1000);
    let progress = residency.progress(1).progress;
    assert!(!progress.is_loading() && progress.num_resident > 70, "{progress:?}");
    // A page that makes no sense is given up at once.
    let mut residency = Residency::new(pyramid.clone(), base(&pyramid), 1000);
    residency.set_plan(1, PagePlan::of(&pyramid, &view, residency.share(1), |_| true));
    let bad = PageId { level: 0, at: [3, 2, 1] };
    while let Some(id) = residency.take_next() {
        if id == bad {
            assert!(residency.fail(id, true));
        } else {
            residency.insert(page(&pyramid, id));
        }
    }
    let progress = residency.progress(1).progress;
    assert!((progress.num_damaged, progress.num_resident) == (1, 79) && !progress.is_exact(), "{progress:?}");
    let set = residency.set(1);
    assert_eq!(set.pages()[set.slot([3, 2, 1])].id.level, 1);
    assert_eq!(levels(&set).iter().filter(|level| **level == 0).count(), 79);
}

#[test]
fn viewers_share_the_memory() {
    let pyramid = pyramid();
    let mut residency = Residency::new(pyramid.clone(), base(&pyramid), 300);
    let near = view(0.4, 200, true, Clip::default());
    let far = view(2.5, 200, true, Clip::default());
    for (key, view) in [(1, &near), (2, &far), (1, &near)] {
        residency.set_plan(key, PagePlan::of(&pyramid, view, residency.share(key), |_| true));
    }
    let mut order = Vec::new();
    while let Some(id) = residency.take_next() {
        order.push(id);
        residency.insert(page(&pyramid, id));
    }
    assert!(residency.num_pages() <= 300);
    assert!(!residency.progress(1).progress.is_loading() && !residency.progress(2).progress.is_loading());
    // Alone, the second gets all.
    residency.forget(1);
    residency.set_plan(2, PagePlan::of(&pyramid, &far, residency.share(2), |_| true));
    while let Some(id) = residency.take_next() {
        residency.insert(page(&pyramid, id));
    }
    assert!(residency.progress(2).progress.is_exact());
}

/// Pages of the finest level that touch: a pair for each face, edge and corner that two of them share.
fn neighbours(grid: [u32; 3]) -> Vec<([u32; 3], [u32; 3])> {
    let places =
        |n: [u32; 3]| (0..n[0] * n[1] * n[2]).map(move |i| [i % n[0], i / n[0] % n[1], i / n[0] / n[1]]);
    let beside = |at: [u32; 3]| {
        let other = move |step: [u32; 3]| {
            let moved: [u32; 3] = std::array::from_fn(|i| (at[i] + step[i]).wrapping_sub(1));
            (moved != at && (0..3).all(|i| moved[i] < grid[i])).then_some((at, moved))
        };
        places([3; 3]).filter_map(other)
    };
    places(grid).flat_map(beside).collect()
}

/// For parallel rays, all pages have the same size on the screen.
#[test]
fn no_part_is_much_coarser_than_the_part_beside() {
    let pyramid = pyramid();
    let mut camera = view(2.0, 200, true, Clip::default()).camera;
    camera = Camera::new(camera.pose, Intrinsics::orthographic(200, 200, 2000.0), &bounds());
    let view = PageView { camera, region: Clip::default().region(&bounds()), rests: true };
    let mut dice = Dice(7);
    let mut num_mixed = 0;
    for max_pages in 0..90 {
        // Some pages have nothing in them, so that some are refined by few pages.
        let empty: HashSet<[u32; 3]> =
            (0..dice.roll(60)).map(|_| [8, 5, 2].map(|n| dice.roll(n) as u32)).collect();
        let is_seen = |id: PageId| {
            let factor = pyramid.level(id).factor;
            let mut cells = neighbours(pyramid.pages(0)).into_iter().map(|(at, _)| at);
            cells.any(|at| !empty.contains(&at) && (0..3).all(|i| at[i] / factor[i] == id.at[i]))
        };
        let plan = PagePlan::of(&pyramid, &view, max_pages, is_seen);
        let mut residency = Residency::new(pyramid.clone(), base(&pyramid), 1000);
        residency.set_plan(1, plan);
        while let Some(id) = residency.take_next() {
            residency.insert(page(&pyramid, id));
        }
        let set = residency.set(1);
        let level = |at: [u32; 3]| set.pages()[set.slot(at)].id.level;
        let seen =
            neighbours(set.grid()).into_iter().filter(|(a, b)| !empty.contains(a) && !empty.contains(b));
        let steps: HashSet<u8> = seen.map(|(a, b)| level(a).abs_diff(level(b))).collect();
        assert!(steps.iter().all(|step| *step <= 1), "{max_pages}: {steps:?}");
        num_mixed += usize::from(steps.len() == 2);
    }
    assert!(num_mixed > 40, "levels are mixed: {num_mixed}");
    // The control: one page of the finest level among those of the coarsest.
    let mut pages = base(&pyramid);
    pages.push(page(&pyramid, PageId { level: 0, at: [2, 2, 1] }));
    let set = PageSet::new(pyramid.clone(), pages, |_| true);
    let level = |at: [u32; 3]| set.pages()[set.slot(at)].id.level;
    assert!(neighbours(set.grid()).into_iter().any(|(a, b)| level(a).abs_diff(level(b)) == 3));
}
