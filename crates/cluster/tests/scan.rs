//! Threads that hold the parts of a volume show what one process shows.

#![expect(clippy::unwrap_used, reason = "what a test cannot do without")]

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use glam::Vec3;
use isinglass_cluster::{Cluster, ClusterError, Exchange, FinestNumbers, InProcess, agree, in_whole};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::Mode;
use isinglass_core::picture::Picture;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Finest, GHOSTS, Histogram, Lighting, Split, Volume, VoxelBox};
use isinglass_formats::{OpenOptions, default_transfer, open};

fn scan() -> Option<Volume> {
    let folder = std::env::var_os("ISINGLASS_DATA").map_or_else(
        || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data")),
        PathBuf::from,
    );
    let path = folder.join("bonsai.nrrd");
    if !path.is_file() {
        eprintln!("skipped: there is no {}", path.display());
        return None;
    }
    Some(open(&path.to_string_lossy(), &OpenOptions::default()).unwrap())
}

fn camera(volume: &Volume, degrees: f32, side: u32) -> Camera {
    let bounds = volume.bounds();
    let pose = Pose::orbit(Vec3::ZERO, 0.5 + degrees.to_radians(), 0.35, 2.6 * bounds.radius());
    Camera::new(pose, Intrinsics::perspective(side, side, 0.8), &bounds)
}

/// How a part of a level lies in the same part of the finest level, as a reader says it.
fn finest_of_part(finest: &Finest, level: &Volume, held: &VoxelBox) -> Finest {
    let mut part = Finest { stored_range: None, histogram: None, ..finest.clone() };
    for axis in 0..3 {
        let step = level.spacing()[axis] / finest.spacing[axis];
        let start = (step * held.first[axis] as f32).round();
        let end = if held.end[axis] == level.dims()[axis] {
            finest.dims[axis] as f32
        } else {
            (step * held.end[axis] as f32).round()
        };
        part.dims[axis] = (end - start) as u32;
        part.first[axis] = finest.first[axis] + step * held.first[axis] as f32 - start;
    }
    part
}

/// The numbers of a finest level that are known.
fn numbers_of(finest: &Finest) -> Option<Vec<FinestNumbers>> {
    let (stored_range, histogram) = (finest.stored_range?, (**finest.histogram.as_ref()?).clone());
    Some(vec![FinestNumbers { stored_range, histogram }])
}

/// What each of several threads finds that hold a part of `volume` with so many voxels around it.
fn together<R: Send>(
    volume: &Volume,
    split: &Split,
    ghosts: u32,
    look: (&TransferFunction, MarchSettings),
    work: impl Fn(&Cluster<'_>, &Scene) -> R + Sync,
) -> Vec<R> {
    let work = &work;
    let part = |exchange: InProcess| {
        let rank = exchange.rank();
        let (own, held) = (split.boxes()[rank], split.held(rank, ghosts));
        // A part as a reader gives it, which knows nothing of the whole.
        let cut = volume.part(&held).unwrap();
        let (map, info) = (cut.value_map(), cut.info.clone());
        let alone = Volume::new(cut.dims(), cut.spacing(), cut.voxels().clone(), map, info).unwrap();
        let alone = match volume.finest() {
            Some(finest) => alone.with_finest(finest_of_part(finest, volume, &held)),
            None => alone,
        };
        let known = volume.finest().filter(|_| rank == 0).and_then(|finest| numbers_of(finest));
        let part = in_whole(&exchange, alone, &own, &held, volume.dims(), known).unwrap();
        let cluster = Cluster::new(&exchange, split.clone());
        let scene = cluster.ready(Scene::new(Arc::new(part), look.0, look.1)).unwrap();
        work(&cluster, &scene)
    };
    std::thread::scope(|scope| {
        let all = InProcess::all(split.boxes().len()).into_iter();
        let threads: Vec<_> = all.map(|exchange| scope.spawn(move || part(exchange))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    })
}

fn frame_of(
    volume: &Volume,
    split: &Split,
    ghosts: u32,
    look: (&TransferFunction, MarchSettings),
    header: FrameHeader,
) -> LayeredFrame {
    let all = together(volume, split, ghosts, look, |cluster, scene| {
        // Words arrive in another order each time.
        std::thread::sleep(Duration::from_millis((cluster.rank() as u64 * 7) % 5));
        cluster.generate(scene, header).unwrap().0
    });
    let mut made: Vec<_> = all.into_iter().flatten().collect();
    assert_eq!(made.len(), 1, "process 0 has the frame");
    made.remove(0)
}

fn psnr(a: &Picture, b: &Picture) -> f64 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    let sum: f64 = a.iter().zip(&b).map(|(x, y)| f64::from(x.abs_diff(*y)).powi(2)).sum();
    10.0 * (255.0f64.powi(2) / (sum / a.len() as f64).max(1e-3)).log10()
}

fn greatest_difference(a: &Picture, b: &Picture) -> u8 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(x, y)| x.abs_diff(*y)).max().unwrap()
}

#[test]
fn a_scan_in_parts_is_the_scan_and_lacks_voxels_without_neighbours() {
    let Some(volume) = scan() else { return };
    let transfer = default_transfer("bonsai.nrrd", &volume, &Histogram::of(&volume));
    let bounds = volume.bounds();
    for mode in [Mode::Composite, Mode::Iso, Mode::Mip, Mode::Average] {
        let settings = MarchSettings { mode, ..MarchSettings::of(true, Lighting::default()) };
        let look = (&transfer, settings);
        let scene = Scene::new(Arc::new(volume.clone()), &transfer, settings);
        let camera_at = |degrees| camera(&volume, degrees, 128);
        let header = FrameHeader::alone(camera_at(0.0), 8);
        let truth = [0.0, 10.0, 30.0].map(|degrees| render(&scene, &camera_at(degrees)));
        let single = generate(&scene, header);
        let seen = |frame: &LayeredFrame, i: usize| raycast(frame, &bounds, &camera_at([0.0, 10.0, 30.0][i]));
        for (split, is_first) in
            [(Split::evenly(volume.dims(), 3), true), (Split::grid(volume.dims(), [2, 2, 2]), false)]
        {
            let split = split.unwrap();
            let frame = frame_of(&volume, &split, GHOSTS, look, header);
            let off = greatest_difference(&seen(&frame, 0), &truth[0]);
            assert!(off <= 1, "{mode:?}: {off}/255 off");
            for (i, margin) in [(1, 0.1), (2, 0.3)] {
                let [found, of_single] = [&frame, &single].map(|frame| psnr(&seen(frame, i), &truth[i]));
                println!("{mode:?} {} parts: {found:.2} dB, one process {of_single:.2}", split.boxes().len());
                assert!(found > of_single - margin, "{mode:?}: {found} dB, one process {of_single}");
            }
            if is_first {
                let again = frame_of(&volume, &split, GHOSTS, look, header);
                assert_eq!(again, frame, "{mode:?}: the order of arrival changes no bit");
            }
            let view = View::from(&camera_at(10.0));
            let pictures = together(&volume, &split, GHOSTS, look, |cluster, scene| {
                cluster.picture(scene, &view, 0..128).unwrap()
            });
            let picture = pictures.into_iter().flatten().next().unwrap();
            let off = greatest_difference(&picture, &truth[1]);
            assert!(off <= 1, "{mode:?}: a picture is {off}/255 off");
        }
    }
    // The controls: too few voxels around the parts are seen.
    let settings = MarchSettings::of(true, Lighting::default());
    let scene = Scene::new(Arc::new(volume.clone()), &transfer, settings);
    let camera = camera(&volume, 0.0, 256);
    let truth = render(&scene, &camera);
    let split = Split::grid(volume.dims(), [2, 2, 1]).unwrap();
    let off = [0, 1, 2, GHOSTS].map(|ghosts| {
        let header = FrameHeader::alone(camera, 8);
        let frame = frame_of(&volume, &split, ghosts, (&transfer, settings), header);
        greatest_difference(&raycast(&frame, &bounds, &camera), &truth)
    });
    println!("with 0 to 3 voxels around: {off:?}/255");
    assert!(off[0] > 4 && off[1] > 1 && off[3] <= 1, "{off:?}");
}

#[test]
fn parts_know_the_numbers_of_the_whole() {
    let cube = Builtin::Cloud.volume(40);
    let floats = (0..64_000).map(|i| if i == 40 { 1e8 } else { (i % 1000) as f32 }).collect();
    let wide = Volume::new(
        [40; 3],
        Vec3::ONE,
        isinglass_core::volume::Voxels::F32(floats),
        (-0.5, 1.0),
        Default::default(),
    );
    // The mean of two and of two and a half voxels: parts round their begin and end.
    let (dims, spacing) = ([79, 40, 99], cube.spacing() / Vec3::new(2.0, 1.0, 2.5));
    let finest =
        Finest { dims, spacing, first: Vec3::new(0.5, 0.0, 0.75), stored_range: None, histogram: None };
    let level = cube.clone().with_finest(finest.clone());
    // Another histogram than that of the level itself, and a wider range.
    let other = Builtin::Shells.volume(40);
    let histogram = Arc::new(Histogram::of(&other));
    assert_ne!(*histogram, Histogram::of(&cube), "the control: the level's own");
    let known = Finest { stored_range: Some((0.0, 255.0)), histogram: Some(histogram), ..finest };
    let pinned = cube.clone().with_finest(known);
    for volume in [cube, wide.unwrap(), level, pinned] {
        let whole = Histogram::of(&volume);
        let transfer = default_transfer("cloud", &volume, &whole);
        let look = (&transfer, MarchSettings { mode: Mode::Average, ..MarchSettings::default() });
        let table = Scene::new(Arc::new(volume.clone()), &transfer, look.1).table;
        let split = Split::grid([40; 3], [3, 1, 2]).unwrap();
        let found = together(&volume, &split, GHOSTS, look, |_, scene| {
            (
                scene.volume.value_range(),
                (*scene.histogram).clone(),
                (scene.volume.bounds(), scene.voxel_space(), scene.volume.steepness()),
                scene.table.clone(),
            )
        });
        for (range, histogram, bounds, of_part) in found {
            let place = (volume.bounds(), (volume.spacing(), volume.voxel_origin()), volume.steepness());
            assert_eq!((range, bounds), (volume.value_range(), place));
            assert_eq!((histogram.lo, histogram.hi, &histogram.counts), (whole.lo, whole.hi, &whole.counts));
            assert_eq!(of_part, table, "the exposure of averages is that of the whole");
        }
    }
}

#[test]
fn the_error_of_one_is_told_to_all_and_another_file_is_found() {
    let all = InProcess::all(3);
    let told: Vec<_> = std::thread::scope(|scope| {
        let work = |exchange: InProcess| {
            let own = if exchange.rank() == 1 { Err("no such file".to_owned()) } else { Ok(7) };
            let first = agree(&exchange, own).unwrap_err().to_string();
            let second = agree(&exchange, Ok(exchange.rank())).unwrap();
            (first, second)
        };
        let threads: Vec<_> = all.into_iter().map(|exchange| scope.spawn(move || work(exchange))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    let expected: Vec<_> = (0..3).map(|rank| ("rank 1: no such file".to_owned(), rank)).collect();
    assert_eq!(told, expected);
    // Parts of different sizes.
    let volume = Builtin::Cloud.volume(32);
    let split = Split::evenly([32; 3], 2).unwrap();
    let errors: Vec<ClusterError> = std::thread::scope(|scope| {
        let work = |exchange: InProcess| {
            let rank = exchange.rank();
            let (own, held) = (split.boxes()[rank], split.held(rank, GHOSTS));
            let part = volume.part(&if rank == 0 { held } else { own }).unwrap();
            in_whole(&exchange, part, &own, &held, [32; 3], None).unwrap_err()
        };
        let threads: Vec<_> =
            InProcess::all(2).into_iter().map(|exchange| scope.spawn(move || work(exchange))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    assert!(errors.iter().all(|e| e.to_string().starts_with("rank 1: found [")), "{errors:?}");
    // Somebody who is gone is no reason to wait.
    let mut all = InProcess::all(2);
    drop(all.pop());
    assert!(all[0].all_gather(&[1]).is_err());
}
