//! Is a volume that is read by pages the same volume? Full pages of the finest level are it to the bit, coarser ones are
//! near, and levels of a pyramid have one look.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::channels::{Blend, ChannelLook, Channels};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::image_error::compare;
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene, SeenPages, render};
use isinglass_core::layer::FrameHeader;
use isinglass_core::mode::Mode;
use isinglass_core::picture::Picture;
use isinglass_core::transfer::Domain;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{
    Detail, LevelAssembly, Lighting, PageId, PageSet, Paging, Volume, VoxelKind, Voxels,
};
use isinglass_formats::preset;
use isinglass_tests::levels::{
    Levels, cameras, coarser, other_channel, pinned, settings, transfer, volume_of,
};

fn psnr(a: &Picture, b: &Picture) -> f64 {
    let bytes = |p: &Picture| p.to_srgb8([0.0; 3]);
    let (width, height) = (a.width as usize, a.height as usize);
    compare(&bytes(a), &bytes(b), width, height, [0; 3]).unwrap().psnr_db
}

/// Asserts that two pictures have the same bits.
fn same(a: &Picture, b: &Picture, what: &str) {
    let num = a.pixels.iter().zip(&b.pixels).filter(|(a, b)| a != b).count();
    assert_eq!(num, 0, "{what}: {num} of {} pixels differ, {:.1} dB", a.pixels.len(), psnr(a, b));
}

/// Compares pictures and frames of a volume with its pages of the finest level, to the bit.
fn agree(whole: &Volume, levels: &Levels, looks: &Channels, settings: MarchSettings) {
    let scene = |v: Volume| Scene::with_channels(Arc::new(v), &transfer(), looks.clone(), settings);
    let flat = &scene(whole.clone());
    let finest = levels.set(|id| id.level == 0);
    let base = scene(levels.base());
    let paged = base.with_pages(finest, None);
    for camera in cameras(flat) {
        same(
            &render(&paged, &camera),
            &render(flat, &camera),
            &format!("{:?} {:?}", settings.mode, camera.pose),
        );
        let header = FrameHeader::alone(camera, 4);
        assert!(generate(&paged, header) == generate(flat, header));
    }
    if levels.volumes.len() == 1 {
        return;
    }
    // Negative control: with some pages of a coarser level the picture is another one.
    let without = levels.set(|id| id.level == 0 && id.at[0] < 2);
    let camera = cameras(flat)[0];
    assert!(render(&base.with_pages(without, None), &camera).pixels != render(flat, &camera).pixels);
}

const DIMS: [u32; 3] = [141, 70, 66];

#[test]
fn all_pages_of_the_finest_level_are_the_volume() {
    let spacing = Vec3::new(1.0, 1.3, 0.8);
    let factors = [[1, 1, 1], [2, 2, 1], [4, 4, 2]];
    let light = Lighting { specular: 0.5, shininess: 20.0, ..Lighting::default() };
    for kind in [VoxelKind::U8, VoxelKind::U16, VoxelKind::F32] {
        let whole = volume_of(DIMS, spacing, kind);
        let levels = Levels::of(&whole, &factors);
        agree(&whole, &levels, &Channels::default(), settings(Mode::Composite, light));
    }
    let whole = volume_of(DIMS, spacing, VoxelKind::U8);
    let levels = Levels::of(&whole, &factors);
    for mode in [Mode::Mip, Mode::MinIp, Mode::Iso] {
        agree(&whole, &levels, &Channels::default(), settings(mode, Lighting::default()));
    }
    let plane = Plane::new(Vec3::new(0.3, 1.0, 0.2), -3.0);
    let clip = Clip { plane, ..Clip::default() };
    let clipped = MarchSettings { clip, ..settings(Mode::Composite, light) };
    agree(&whole, &levels, &Channels::default(), clipped);
    let unshaded = MarchSettings { shading: None, ..settings(Mode::Composite, Lighting::default()) };
    agree(&whole, &levels, &Channels::default(), unshaded);
}

#[test]
fn pages_of_several_channels_are_the_volume() {
    let whole = volume_of(DIMS, Vec3::ONE, VoxelKind::U8);
    let others = vec![other_channel(&whole, 3), other_channel(&whole, 5)];
    let whole = whole.with_others(others).unwrap();
    let levels = Levels::of(&whole, &[[1, 1, 1], [2, 2, 2]]);
    let look = ChannelLook { transfer: transfer(), visibility: Default::default() };
    for blend in [Blend::Additive, Blend::Over] {
        let looks = Channels { blend, others: vec![look.clone(), look.clone()], ..Channels::default() };
        agree(&whole, &levels, &looks, settings(Mode::Composite, Lighting::default()));
        let looks = Channels { chosen: 2, ..looks };
        agree(&whole, &levels, &looks, settings(Mode::Mip, Lighting::default()));
    }
}

#[test]
fn where_nothing_is_seen_no_means_of_matter_beside_are() {
    let whole = Builtin::Shells.volume(200);
    let levels = Arc::new(Levels::of(&whole, &[[1; 3], [2; 3], [8; 3]]));
    let known = levels.paging();
    let unknown = Paging { ranges: None, ..known.clone() };
    let transfer = preset("shells").unwrap();
    for mode in [Mode::Composite, Mode::Iso, Mode::Mip] {
        let scene = |v: Volume| Scene::new(Arc::new(v), &transfer, settings(mode, Lighting::default()));
        let [flat, base, ignorant] = [
            whole.clone(),
            levels.base().with_paging(known.clone()),
            levels.base().with_paging(unknown.clone()),
        ]
        .map(scene);
        let seen = SeenPages::of(&levels.pyramid, &base, &*levels);
        let set = levels.set(|id| id.level == 0 && seen.sees(id));
        let num_coarse = set.rough().iter().filter(|is_rough| **is_rough).count();
        assert!(num_coarse > 4, "{num_coarse} pages are not there");
        let [paged, without] = [base, ignorant].map(|base| base.with_pages(set.clone(), None));
        let mut differs = false;
        for camera in cameras(&flat) {
            let truth = render(&flat, &camera);
            same(&render(&paged, &camera), &truth, &format!("{mode:?} {:?}", camera.pose));
            differs |= render(&without, &camera).pixels != truth.pixels;
        }
        // The control: a coarser page in their place shows something thin. Surfaces and the greatest value need more.
        assert!(differs || mode != Mode::Composite, "{mode:?}");
    }
}

#[test]
fn a_pyramid_of_one_level_has_the_same_shade() {
    let whole = volume_of(DIMS, Vec3::ONE, VoxelKind::U8);
    let levels = Levels::of(&whole, &[[1, 1, 1]]);
    let light = Lighting { ambient_occlusion: 0.8, shadows: 0.6, ..Lighting::default() };
    // The brightness of averages rests on the coarsest level, so only here it is the same.
    agree(&whole, &levels, &Channels::default(), settings(Mode::Average, light));
    let settings = settings(Mode::Composite, light);
    let flat = Scene::new(Arc::new(whole), &transfer(), settings);
    let paged =
        Scene::new(Arc::new(levels.base()), &transfer(), settings).with_pages(levels.set(|_| true), None);
    for camera in cameras(&flat) {
        same(&render(&paged, &camera), &render(&flat, &camera), "shade");
    }
    // Negative control: with other shade the picture is another one.
    let dark = MarchSettings { lighting: Lighting { ambient_occlusion: 0.5, ..light }, ..settings };
    let camera = cameras(&flat)[0];
    let other = paged.with_look(&transfer(), dark);
    assert!(other.is_final());
    assert!(render(&other, &camera).pixels != render(&flat, &camera).pixels);
}

#[test]
fn mixed_levels_are_near_and_have_no_seam() {
    let whole = volume_of(DIMS, Vec3::ONE, VoxelKind::U8);
    let levels = Levels::of(&whole, &[[1, 1, 1], [2, 2, 2], [4, 4, 4]]);
    let settings = settings(Mode::Composite, Lighting::default());
    let flat = Scene::new(Arc::new(whole), &transfer(), settings);
    let base = Scene::new(Arc::new(levels.base()), &transfer(), settings);
    let sets = [
        levels.set(|id| id.level == 1),
        levels.set(|id| id.level == 1 || id.at[0] == 1),
        levels.set(|id| id.level == 1 || id.at[1] == 0),
    ];
    let camera = cameras(&flat)[0];
    let exact = render(&flat, &camera);
    let coarse = psnr(&render(&base.with_pages(levels.set(|_| false), None), &camera), &exact);
    let near: Vec<f64> =
        sets.into_iter().map(|set| psnr(&render(&base.with_pages(set, None), &camera), &exact)).collect();
    // A set that is finer in a part is no farther than one that is coarser everywhere.
    assert!(near[0] > coarse + 2.0 && near[1] > near[0] && near[2] > near[0], "{coarse} {near:?}");
}

#[test]
fn a_level_of_a_pyramid_looks_as_the_finest() {
    let whole = volume_of([97, 80, 65], Vec3::new(1.0, 1.0, 2.0), VoxelKind::U8);
    let settings = settings(Mode::Composite, Lighting::default());
    let flat = Scene::new(Arc::new(whole.clone()), &transfer(), settings);
    let camera = cameras(&flat)[0];
    let exact = render(&flat, &camera);
    for factor in [[2, 2, 1], [2, 2, 2], [4, 4, 2]] {
        let level = coarser(&whole, factor);
        let own = psnr(&render(&Scene::new(Arc::new(level.clone()), &transfer(), settings), &camera), &exact);
        let level = pinned(level, &whole, factor);
        let near = psnr(&render(&Scene::new(Arc::new(level), &transfer(), settings), &camera), &exact);
        assert!(near > own + 3.0, "{factor:?}: {near} against {own}");
    }
}

#[test]
fn a_ramp_of_the_world_is_the_same_at_every_level() {
    let (dims, spacing) = ([21, 18, 13], Vec3::new(0.5, 0.7, 1.1));
    let slope = Vec3::new(3.0, -2.0, 4.0);
    let [nx, ny, nz] = dims;
    let at = |i: u32| slope.dot(Vec3::new((i % nx) as f32, (i / nx % ny) as f32, (i / nx / ny) as f32));
    let voxels = Voxels::F32((0..nx * ny * nz).map(at).collect());
    let whole = Volume::new(dims, spacing, voxels, (1.0, 0.0), Default::default()).unwrap();
    for factor in [[2, 2, 1], [4, 2, 2]] {
        let level = coarser(&whole, factor);
        let right = pinned(level.clone(), &whole, factor);
        let (mut worst, mut worst_of_own) = (0f32, 0f32);
        for point in [Vec3::new(-1.0, 0.3, 0.4), Vec3::new(2.0, -1.0, -2.0), Vec3::new(0.1, 2.0, 1.0)] {
            let exact = whole.value_between(point).unwrap();
            worst = worst.max((right.value_between(point).unwrap() - exact).abs());
            worst_of_own = worst_of_own.max((level.value_between(point).unwrap() - exact).abs());
        }
        // Without its place in the finest level, a level of odd sides is half a fine voxel aside.
        assert!(worst < 1e-4 && worst_of_own > 0.5, "{factor:?}: {worst} {worst_of_own}");
    }
}

/// Holes that cross the borders of pages, single ones everywhere, and pages with nothing.
fn with_holes(volume: Volume, seed: u32) -> Volume {
    let [nx, ny, nz] = volume.dims();
    let is_gap = |i: u32| {
        let [x, y, z] = [i % nx, i / nx % ny, i / nx / ny];
        let near = (x as f32 - 64.0).hypot(y as f32 - 40.0).hypot(z as f32 - 30.0) < 9.0;
        // Some pages have nothing in one channel, and others in the other.
        let is_empty = if seed == 0 { x > 61 && x < 132 } else { x < 70 };
        near || is_empty || (x * 7 + y * 5 + z + seed).is_multiple_of(31)
    };
    volume.with_gaps((0..nx * ny * nz).map(|i| u8::from(is_gap(i))).collect())
}

#[test]
fn pages_with_gaps_are_the_volume() {
    let spacing = Vec3::new(1.0, 1.3, 0.8);
    for kind in [VoxelKind::U8, VoxelKind::F32] {
        let whole = volume_of([205, 70, 66], spacing, kind);
        let holed = with_holes(whole.clone(), 0);
        let levels = Levels::of(&holed, &[[1, 1, 1], [2, 2, 1]]);
        let light = Lighting { specular: 0.5, shininess: 20.0, ..Lighting::default() };
        for mode in [Mode::Composite, Mode::Mip] {
            agree(&holed, &levels, &Channels::default(), settings(mode, light));
        }
        // The control: without its gaps it is another picture.
        let scene = |v: Volume| {
            let settings = settings(Mode::Composite, light);
            Scene::with_channels(Arc::new(v), &transfer(), Channels::default(), settings)
        };
        let camera = cameras(&scene(whole.clone()))[0];
        assert!(render(&scene(whole), &camera).pixels != render(&scene(holed), &camera).pixels);
    }
}

#[test]
fn each_channel_has_its_own_window_and_its_own_gaps() {
    let whole = volume_of([205, 70, 66], Vec3::ONE, VoxelKind::U8);
    let other = with_holes(Arc::unwrap_or_clone(other_channel(&whole, 3)), 1);
    let whole = with_holes(whole, 0).with_others(vec![Arc::new(other)]).unwrap();
    let levels = Levels::of(&whole, &[[1, 1, 1], [2, 2, 2]]);
    let mut narrow = transfer();
    narrow.domain = Domain::Values(20.0, 140.0);
    let look = ChannelLook { transfer: narrow, visibility: Default::default() };
    for (blend, mode, chosen) in [
        (Blend::Additive, Mode::Composite, 0),
        (Blend::Over, Mode::Composite, 0),
        (Blend::Over, Mode::Mip, 1),
    ] {
        let looks = Channels { blend, chosen, others: vec![look.clone()], ..Channels::default() };
        agree(&whole, &levels, &looks, settings(mode, Lighting::default()));
    }
}

#[test]
fn light_in_pieces_is_the_light_at_once() {
    let whole = volume_of([130, 90, 70], Vec3::ONE, VoxelKind::U8);
    let levels = Levels::of(&whole, &[[1; 3], [2; 3]]);
    let set = levels.set(|id| id.level == 0 && id.at != [1, 1, 0]);
    let base = Arc::new(levels.base());
    let dim = Lighting { ambient_occlusion: 0.9, shadows: 0.7, ..Lighting::default() };
    let lit_by = |lighting| Scene::new(base.clone(), &transfer(), settings(Mode::Composite, lighting));
    let before = lit_by(Lighting::default()).with_pages(set.clone(), None);
    let after = lit_by(dim);
    let at_once = after.with_pages(set.clone(), None);
    // What is shown while the light of the pages is worked out.
    let draft = MarchSettings { detail: Detail::Draft, ..after.settings };
    let mut shown = Scene::new(base.clone(), &transfer(), draft).with_pages(set.clone(), Some(&before));
    let camera = cameras(&after)[0];
    assert!(!shown.is_final());
    let (mut num_pieces, num_pages) = (0, set.pages().len());
    loop {
        let dark = shown.pages_to_light(&after, 5);
        if dark.is_empty() {
            break;
        }
        assert!(dark.len() <= 5 && num_pieces < num_pages, "each piece is a step");
        shown = shown.with_lit_pages(&after.light_pages(dark));
        num_pieces += 1;
    }
    assert_eq!(num_pieces, num_pages.div_ceil(5));
    let in_pieces = after.with_pages(set.clone(), Some(&shown));
    assert!(in_pieces.is_final() && at_once.is_final());
    same(&render(&in_pieces, &camera), &render(&at_once, &camera), "in pieces");
    // The control: the light before is another one.
    assert!(psnr(&render(&before, &camera), &render(&at_once, &camera)) < 45.0);
}

#[test]
fn a_level_from_its_pages_is_the_level() {
    for kind in [VoxelKind::U8, VoxelKind::U16, VoxelKind::F32] {
        let levels = Levels::of(&volume_of(DIMS, Vec3::ONE, kind), &[[1; 3], [2, 2, 1], [4, 4, 2]]);
        for (level, volume) in levels.volumes.iter().enumerate() {
            let mut assembly = LevelAssembly::new(&levels.pyramid, level as u8, 1);
            let mut ids: Vec<PageId> = assembly.missing().iter().copied().collect();
            ids.sort_unstable_by_key(|id| id.at.map(|at| at * 7 % 3));
            for id in &ids {
                // The control: one page less is another volume.
                assert!(!assembly.missing().is_empty());
                assembly.add(&levels.pyramid, &levels.page(*id));
            }
            assert!(assembly.missing().is_empty());
            let page = assembly.finish(&levels.pyramid).unwrap();
            assert_eq!((page.volume.dims(), page.volume.voxels()), (volume.dims(), volume.voxels()));
            // It looks as the level by itself: steps may begin elsewhere.
            let scene = |v: &Volume| {
                let settings = settings(Mode::Composite, Lighting::default());
                Scene::new(Arc::new(v.clone()), &transfer(), settings)
            };
            let set = Arc::new(PageSet::of_level(levels.pyramid.clone(), Arc::new(page)));
            let paged = scene(&levels.base()).with_pages(set, None);
            for camera in cameras(&paged) {
                let (found, truth) = (render(&paged, &camera), render(&scene(volume), &camera));
                assert!(psnr(&found, &truth) > 45.0, "{level}: {}", psnr(&found, &truth));
                same(&render(&paged.of_level().unwrap(), &camera), &truth, "without pages");
            }
        }
    }
}
