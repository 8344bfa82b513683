//! Do pages look the same on the GPU as on the CPU, and as the volume whole? On any adapter, lavapipe too; the tolerance
//! is that of `isinglass_tests::twins`.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::channels::{Blend, ChannelLook, Channels};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::kernels::march::{MarchSettings, NOTHING, Scene, SeenPages, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::mode::Mode;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Lighting, Page, PageSet, PageView, PageVoxels, Volume, VoxelKind, Voxels};
use isinglass_formats::{Dtype, Endian, OpenOptions, RawShape, open, preset};
use isinglass_gpu::{Gpu, GpuRenderer};
use isinglass_server::Pager;
use isinglass_tests::levels::{Levels, cameras, other_channel, settings, transfer, volume_of, voxels};
use isinglass_tests::twins::{Difference, gpu, header};

const DIMS: [u32; 3] = [141, 70, 66];

fn scene(volume: Volume, looks: &Channels, settings: MarchSettings) -> Scene {
    Scene::with_channels(Arc::new(volume), &transfer(), looks.clone(), settings)
}

/// Compares pictures and frames of each set of pages with those of the CPU, on one renderer.
fn agree(gpu: &Gpu, base: &Scene, sets: &[Arc<PageSet>], what: &str) {
    let mut renderer = GpuRenderer::new(gpu, base.clone()).unwrap();
    for (number, set) in sets.iter().enumerate() {
        let paged = base.with_pages(set.clone(), None);
        renderer.set_scene(paged.clone()).unwrap();
        for camera in cameras(base) {
            let twin = render(&paged, &camera);
            let what = format!("{what}, set {number}, {:?}", camera.pose);
            Difference::of(&renderer.render(&camera).unwrap(), &twin).assert_tolerable(&what);
        }
        let camera = cameras(base)[0];
        let frame = renderer.generate(header(camera, 16)).unwrap();
        let cast = raycast(&frame, &base.volume.bounds(), &camera);
        let found = Difference::of(&cast, &renderer.render(&camera).unwrap());
        found.assert_alike_but_for_choices(&format!("{what}, set {number}, a frame"));
    }
    // The volume in memory is shown again as before.
    renderer.set_scene(base.clone()).unwrap();
    let camera = cameras(base)[0];
    Difference::of(&renderer.render(&camera).unwrap(), &render(base, &camera)).assert_tolerable("the base");
    // Negative control: another set looks otherwise.
    let [first, last] = [sets.first(), sets.last()].map(|set| base.with_pages(set.unwrap().clone(), None));
    renderer.set_scene(last).unwrap();
    Difference::of(&renderer.render(&camera).unwrap(), &render(&first, &camera))
        .assert_noticed("another set");
}

/// All of the finest level, the coarsest level alone, levels side by side.
fn sets(levels: &Levels) -> Vec<Arc<PageSet>> {
    vec![
        levels.set(|id| id.level == 0),
        levels.set(|id| id.level == 1 || id.at[0] == 1),
        levels.set(|id| id.level == 1 && id.at[0] == 0),
        levels.set(|_| false),
    ]
}

#[test]
fn pages_look_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let spacing = Vec3::new(1.0, 1.3, 0.8);
    let factors = [[1, 1, 1], [2, 2, 1], [4, 4, 2]];
    let light = Lighting { specular: 0.5, shininess: 20.0, ..Lighting::default() };
    for kind in [VoxelKind::U8, VoxelKind::U16, VoxelKind::F32] {
        let levels = Levels::of(&volume_of(DIMS, spacing, kind), &factors);
        let base = scene(levels.base(), &Channels::default(), settings(Mode::Composite, light));
        agree(gpu, &base, &sets(&levels), &format!("{kind:?}"));
    }
    let levels = Levels::of(&volume_of(DIMS, spacing, VoxelKind::U8), &factors);
    for mode in [Mode::Mip, Mode::MinIp, Mode::Iso, Mode::Average] {
        let base = scene(levels.base(), &Channels::default(), settings(mode, Lighting::default()));
        agree(gpu, &base, &sets(&levels), &format!("{mode:?}"));
    }
    let plane = Plane::new(Vec3::new(0.3, 1.0, 0.2), -3.0);
    let clip = Clip { plane, ..Clip::default() };
    let clipped = MarchSettings { clip, ..settings(Mode::Composite, light) };
    agree(gpu, &scene(levels.base(), &Channels::default(), clipped), &sets(&levels), "clipped");
    let unshaded = MarchSettings { shading: None, ..settings(Mode::Composite, Lighting::default()) };
    agree(gpu, &scene(levels.base(), &Channels::default(), unshaded), &sets(&levels), "unshaded");
}

#[test]
fn where_nothing_is_seen_both_show_nothing() {
    let Some(gpu) = gpu() else { return };
    let levels = Arc::new(Levels::of(&Builtin::Shells.volume(150), &[[1; 3], [2; 3], [8; 3]]));
    let shells = preset("shells").unwrap();
    for mode in [Mode::Composite, Mode::Iso] {
        let base = levels.base().with_paging(levels.paging());
        let base = Scene::new(Arc::new(base), &shells, settings(mode, Lighting::default()));
        let seen = SeenPages::of(&levels.pyramid, &base, &*levels);
        let finest = levels.set(|id| id.level == 0 && seen.sees(id));
        assert!(
            base.with_pages(finest.clone(), None)
                .pages
                .unwrap()
                .table
                .iter()
                .any(|cell| cell.slot == NOTHING)
        );
        let half = levels.set(|id| id.level == 0 && seen.sees(id) && id.at[0] == 0);
        agree(gpu, &base, &[finest, half, levels.set(|_| false)], &format!("shells, {mode:?}"));
    }
}

#[test]
fn all_pages_of_the_finest_level_are_the_volume_in_memory() {
    let Some(gpu) = gpu() else { return };
    let whole = volume_of(DIMS, Vec3::ONE, VoxelKind::U8);
    let levels = Levels::of(&whole, &[[1, 1, 1], [2, 2, 2]]);
    let settings = settings(Mode::Composite, Lighting::default());
    let looks = Channels::default();
    let (flat, base) = (scene(whole, &looks, settings), scene(levels.base(), &looks, settings));
    let finest = base.with_pages(levels.set(|id| id.level == 0), None);
    let coarse = base.with_pages(levels.set(|_| false), None);
    let mut renderers = [flat, finest, coarse].map(|scene| GpuRenderer::new(gpu, scene).unwrap());
    for camera in cameras(&base) {
        let [flat, finest, coarse] = renderers.each_mut().map(|renderer| renderer.render(&camera).unwrap());
        Difference::of(&finest, &flat).assert_tolerable("pages of the finest level");
        // Negative control.
        Difference::of(&coarse, &flat).assert_noticed("the coarsest level");
    }
}

#[test]
fn pages_of_several_channels_look_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let whole = volume_of(DIMS, Vec3::ONE, VoxelKind::U8);
    let others = vec![other_channel(&whole, 3), other_channel(&whole, 5)];
    let levels = Levels::of(&whole.with_others(others).unwrap(), &[[1, 1, 1], [2, 2, 2]]);
    let look = ChannelLook { transfer: transfer(), visibility: Default::default() };
    let looks = Channels { blend: Blend::Over, others: vec![look.clone(), look], ..Channels::default() };
    let base = scene(levels.base(), &looks, settings(Mode::Composite, Lighting::default()));
    agree(gpu, &base, &sets(&levels), "three channels");
    let looks = Channels { chosen: 2, ..looks };
    let base = scene(levels.base(), &looks, settings(Mode::Mip, Lighting::default()));
    agree(gpu, &base, &sets(&levels), "the third channel");
}

/// A file longer than the textures of the least devices.
#[test]
fn a_long_volume_is_shown_by_pages() {
    let Some(gpu) = gpu() else { return };
    let dims = [3000, 40, 40];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.raw");
    let Voxels::U8(mut bytes) = voxels(dims, VoxelKind::U8) else { panic!("expected bytes") };
    // A coarser level does not have what changes from voxel to voxel.
    bytes.iter_mut().step_by(2).for_each(|byte| *byte = byte.saturating_add(60));
    std::fs::write(&path, bytes).unwrap();
    let raw = RawShape { dims, dtype: Dtype::Uint8, spacing: Vec3::ONE, endian: Endian::Little, offset: 0 };
    let options =
        OpenOptions { raw: Some(raw), by_pages: true, max_bytes: 1 << 30, ..OpenOptions::default() };
    let base = scene(
        open(path.to_str().unwrap(), &options).unwrap(),
        &Channels::default(),
        settings(Mode::Composite, Lighting::default()),
    );
    let pager = Pager::of(base.whole()).unwrap().expect("the volume is read by pages");
    let camera = cameras(&base)[1];
    let view = PageView { camera, region: base.region(), rests: true };
    let pages = pager.settled(ViewerId(0), &view, &base, &|| true);
    assert!(pages.part.progress.is_exact(), "{:?}", pages.part.progress);
    let pyramid = pages.set.pyramid().clone();
    let coarsest = pyramid.base_pages(base.whole()).unwrap();
    let coarse = Arc::new(PageSet::new(pyramid, coarsest, |_| true));
    assert!(pages.set.pages().iter().any(|page| page.id.level == 0));
    agree(gpu, &base, &[pages.set, coarse], "a long volume");
}

#[test]
fn a_level_that_is_held_whole_looks_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let levels = Levels::of(&volume_of(DIMS, Vec3::ONE, VoxelKind::U8), &[[1; 3], [2; 3], [4; 3]]);
    let base = scene(levels.base(), &Channels::default(), settings(Mode::Composite, Lighting::default()));
    let level = |number: u8| {
        let volume = &levels.volumes[usize::from(number)];
        let channel = PageVoxels { voxels: volume.voxels().clone(), gaps: None };
        let page = Page::whole_level(&levels.pyramid, number, vec![channel]).unwrap();
        base.with_pages(Arc::new(PageSet::of_level(levels.pyramid.clone(), Arc::new(page))), None)
    };
    let pages = base.with_pages(levels.set(|id| id.level == 1), None);
    let mut renderer = GpuRenderer::new(gpu, base.clone()).unwrap();
    // Pages and levels take turns, as a camera comes and goes.
    for (paged, what) in [(level(1), "level 1"), (pages, "pages"), (level(0), "level 0"), (level(1), "again")]
    {
        renderer.set_scene(paged.clone()).unwrap();
        let twin = paged.of_level().unwrap_or(paged);
        for camera in cameras(&base) {
            let found = renderer.render(&camera).unwrap();
            Difference::of(&found, &render(&twin, &camera)).assert_tolerable(what);
        }
    }
    // Negative control: the level before is another picture.
    let camera = cameras(&base)[0];
    let finest = render(&level(0).of_level().unwrap(), &camera);
    Difference::of(&renderer.render(&camera).unwrap(), &finest).assert_noticed("level 0");
}
