//! Do parts of a volume that are marched on GPUs show what one process shows? On any adapter, lavapipe too.
//!
//! A GPU has other roundings than a processor, so pieces are compared by the pictures that are made of them.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::PathBuf;
use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::channels::{Blend, ChannelLook, Channels};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::layering::parts::{
    AskedFrame, OnProcessors, PartMarcher, frame_from_words, frame_of_rows, threshold, unite, words_from_rows,
};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::kernels::part_pictures::picture_of_parts;
use isinglass_core::kernels::part_rays::MarchedPart;
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::kernels::rows_of;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{GHOSTS, Histogram, Lighting, Split, Volume, VoxelKind, Voxels};
use isinglass_formats::{OpenOptions, default_transfer, open};
use isinglass_render::{Backend, PartRenderer};
use isinglass_tests::levels::{Levels, other_channel, volume_of};
use isinglass_tests::twins::{Difference, gpu, transfer};

/// A look at a volume.
struct Look {
    name: &'static str,
    volume: Volume,
    transfer: TransferFunction,
    channels: Channels,
    settings: MarchSettings,
    distance: f32,
    is_orthographic: bool,
}

impl Look {
    fn new(name: &'static str, volume: Volume, settings: MarchSettings) -> Self {
        let (transfer, channels) = (transfer(true), Channels::default());
        Self { name, volume, transfer, channels, settings, distance: 2.6, is_orthographic: false }
    }

    fn scene_of(&self, volume: Volume) -> Scene {
        Scene::with_channels(Arc::new(volume), &self.transfer, self.channels.clone(), self.settings)
    }

    /// The camera, turned by some degrees around the volume.
    fn camera(&self, degrees: f32, (width, height): (u32, u32)) -> Camera {
        let bounds = self.volume.bounds();
        let radius = bounds.radius();
        let pose = Pose::orbit(Vec3::ZERO, 0.5 + degrees.to_radians(), 0.35, self.distance * radius);
        let camera = Camera::new(pose, Intrinsics::perspective(width, height, 0.8), &bounds);
        if self.is_orthographic { camera.to_orthographic(self.distance * radius, &bounds) } else { camera }
    }
}

/// The processes that hold the parts, each with its own way to march.
struct Parts {
    split: Split,
    scenes: Vec<Scene>,
    marchers: Vec<Box<dyn PartMarcher>>,
}

impl Parts {
    fn of(look: &Look, split: Split, marcher: impl Fn(usize) -> Box<dyn PartMarcher>) -> Self {
        let num = split.boxes().len();
        let scene = |rank| look.scene_of(look.volume.part(&split.held(rank, GHOSTS)).unwrap());
        let scenes: Vec<Scene> = (0..num).map(scene).collect();
        let areas = scenes.iter().zip(split.boxes()).filter_map(|(scene, own)| scene.areas_of_bodies(own));
        let scenes = match areas.reduce(|a, b| [a[0] + b[0], a[1]]) {
            Some(areas) => scenes.into_iter().map(|scene| scene.with_areas_of_bodies(areas)).collect(),
            None => scenes,
        };
        Self { split, scenes, marchers: (0..num).map(marcher).collect() }
    }

    fn part(&self, rank: usize) -> MarchedPart<'_> {
        MarchedPart { scene: &self.scenes[rank], split: &self.split, rank }
    }

    /// What each process says by its own way.
    fn each<R>(&self, say: impl Fn(&dyn PartMarcher, &MarchedPart<'_>) -> R) -> Vec<R> {
        self.marchers.iter().enumerate().map(|(rank, by)| say(&**by, &self.part(rank))).collect()
    }

    fn asked(&self, header: FrameHeader) -> AskedFrame {
        let mut frame = AskedFrame::new(&self.scenes[0], header, 0.0);
        let steps = self.each(|marcher, part| marcher.steps(part, &frame));
        frame.threshold = threshold(&self.scenes[0], &self.split, &frame, &steps).unwrap();
        frame
    }

    /// What each process sends to each owner of rows.
    fn pieces(&self, frame: &AskedFrame) -> Vec<Vec<Vec<u32>>> {
        let (num, height) = (self.scenes.len(), frame.asked().camera.intrinsics.height);
        let rows: Vec<_> = (0..num).map(|owner| rows_of(owner, num, height)).collect();
        let rows: Vec<&[u32]> = rows.iter().map(Vec::as_slice).collect();
        self.each(|marcher, part| marcher.pieces(part, frame, &rows))
    }

    fn frame_of(&self, frame: &AskedFrame, pieces: &[Vec<Vec<u32>>]) -> LayeredFrame {
        let (num, height) = (self.scenes.len(), frame.asked().camera.intrinsics.height);
        let rows: Vec<_> = (0..num).map(|owner| rows_of(owner, num, height)).collect();
        let words = rows.iter().enumerate().map(|(owner, rows)| {
            let lists: Vec<_> = pieces.iter().map(|of_rank| of_rank[owner].clone()).collect();
            let made = unite(&self.scenes[owner], &self.split, frame, rows, &lists).unwrap();
            words_from_rows(&frame_of_rows(frame, rows, made), rows)
        });
        let words: Vec<_> = words.collect();
        let header = frame_of_rows(frame, &[], Vec::new()).header;
        let made = frame_from_words(header, &rows, &words).unwrap();
        made.validate().unwrap();
        made
    }

    fn frame(&self, header: FrameHeader) -> LayeredFrame {
        let frame = self.asked(header);
        self.frame_of(&frame, &self.pieces(&frame))
    }

    fn picture(&self, camera: &Camera) -> Picture {
        let (view, rows) = (View::from(camera), 0..camera.intrinsics.height);
        let words = self.each(|marcher, part| marcher.seen(part, &view, rows.clone()));
        picture_of_parts(&self.scenes[0], &self.split, &view, rows, &words).unwrap()
    }
}

fn on_gpu(_: usize) -> Box<dyn PartMarcher> {
    Box::new(PartRenderer::on(&Backend::Gpu(gpu().unwrap().clone())))
}

fn on_processors(_: usize) -> Box<dyn PartMarcher> {
    Box::new(OnProcessors)
}

fn looks() -> Vec<Look> {
    let shaded = MarchSettings::of(true, Lighting::default());
    let glossy = MarchSettings::of(true, Lighting { specular: 0.8, ..Lighting::default() });
    let flat = MarchSettings::of(false, Lighting::default());
    let inner = Aabb { min: Vec3::new(-0.6, -0.5, -0.7), max: Vec3::new(0.45, 0.62, 0.3) };
    let clip = Clip { bounds: Some(inner), plane: Plane::new(Vec3::new(0.4, 1.0, -0.7), 0.1) };
    let of = |mode| MarchSettings { mode, ..shaded };
    let iso = |value, opacity| Isos::new(&[Iso { value, opacity }]).unwrap();
    let two = Isos::new(&[Iso { value: 60.0, opacity: 0.4 }, Iso { value: 140.0, opacity: 1.0 }]).unwrap();
    let cloud = || Builtin::Cloud.volume(48);
    let long = |kind| volume_of([48, 41, 57], Vec3::new(0.02, 0.031, 0.017), kind);
    let first = volume_of([48; 3], Vec3::splat(0.04), VoxelKind::U8);
    let others = vec![other_channel(&first, 3), other_channel(&first, 5)];
    let channel = ChannelLook { transfer: transfer(true), visibility: Default::default() };
    let channels =
        Channels { blend: Blend::Over, others: vec![channel.clone(), channel], ..Channels::default() };
    vec![
        Look::new("shaded", cloud(), shaded),
        Look::new("glossy", Builtin::Cubus.volume(48), glossy),
        Look::new("16 bits", long(VoxelKind::U16), flat),
        Look::new("floats", long(VoxelKind::F32), shaded),
        Look { channels, ..Look::new("channels", first.with_others(others).unwrap(), shaded) },
        Look { is_orthographic: true, ..Look::new("orthographic", Builtin::Shells.volume(48), shaded) },
        Look { distance: 0.3, ..Look::new("from inside", cloud(), shaded) },
        Look::new("clipped", Builtin::Cubus.volume(48), MarchSettings { clip, ..shaded }),
        Look::new("greatest", cloud(), of(Mode::Mip)),
        Look::new("least", Builtin::Cubus.volume(48), MarchSettings { clip, ..of(Mode::MinIp) }),
        Look::new("mean", cloud(), of(Mode::Average)),
        Look::new("surface", cloud(), MarchSettings { isos: iso(90.0, 1.0), ..of(Mode::Iso) }),
        Look::new("surfaces", Builtin::Shells.volume(48), MarchSettings { isos: two, ..of(Mode::Iso) }),
    ]
}

const SIZE: (u32, u32) = (44, 36);

/// The greatest difference of two pictures, in 1/255.
fn off(a: &Picture, b: &Picture) -> u8 {
    Difference::of(a, b).max
}

fn psnr(a: &Picture, b: &Picture) -> f64 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    let sum: f64 = a.iter().zip(&b).map(|(x, y)| f64::from(x.abs_diff(*y)).powi(2)).sum();
    10.0 * (255.0f64.powi(2) / (sum / a.len() as f64).max(1e-3)).log10()
}

/// Each process has the finest pages of its own part, and the coarsest level.
#[test]
fn parts_that_are_read_by_pages_show_the_picture_of_the_whole() {
    let whole = volume_of([141, 70, 66], Vec3::splat(0.02), VoxelKind::U8);
    let levels = Levels::of(&whole, &[[1; 3], [4; 3]]);
    let split = Split::between_pages(whole.dims(), 2).unwrap();
    for mode in [Mode::Composite, Mode::Iso, Mode::Mip, Mode::Average] {
        let look = Look::new(
            "pages",
            whole.clone(),
            MarchSettings { mode, ..MarchSettings::of(true, Lighting::default()) },
        );
        let base = look.scene_of(levels.base());
        let with_pages_of = |owner: usize| {
            let own = &split.boxes()[owner];
            base.with_pages(levels.set(|id| id.level == 0 && levels.pyramid.meets(id, own)), None)
        };
        let all = base.with_pages(levels.set(|id| id.level == 0), None);
        let camera = look.camera(0.0, SIZE);
        let (bounds, truth) = (look.volume.bounds(), render(&all, &camera));
        let shown = |owners: [usize; 2], marcher: fn(usize) -> Box<dyn PartMarcher>| {
            let (split, scenes) = (split.clone(), owners.map(with_pages_of).to_vec());
            let parts = Parts { split, scenes, marchers: (0..2).map(marcher).collect() };
            let seen = raycast(&parts.frame(FrameHeader::alone(camera, 8)), &bounds, &camera);
            [off(&seen, &truth), off(&parts.picture(&camera), &truth)]
        };
        let found = shown([0, 1], on_processors);
        assert!(found.iter().all(|off| *off <= 1), "{mode:?}: {found:?}/255");
        if gpu().is_some() {
            let found = shown([0, 1], on_gpu);
            assert!(found.iter().all(|off| *off <= 1), "{mode:?} on GPUs: {found:?}/255");
        }
        // The control: each has the pages of the other.
        assert!(shown([1, 0], on_processors)[1] > 4, "{mode:?}");
    }
}

#[test]
fn every_split_on_gpus_shows_the_picture_of_the_whole() {
    if gpu().is_none() {
        return;
    }
    for look in looks() {
        let (scene, camera) = (look.scene_of(look.volume.clone()), look.camera(0.0, SIZE));
        let (bounds, truth) = (look.volume.bounds(), render(&scene, &camera));
        for layers in [[1, 1, 1], [2, 1, 1], [1, 3, 2], [3, 3, 3]] {
            let what = format!("{} {layers:?}", look.name);
            let split = || Split::grid(look.volume.dims(), layers).unwrap();
            let parts = Parts::of(&look, split(), on_gpu);
            let asked = parts.asked(FrameHeader::alone(camera, 8));
            let pieces = parts.pieces(&asked);
            let frame = parts.frame_of(&asked, &pieces);
            let seen = raycast(&frame, &bounds, &camera);
            assert!(off(&seen, &truth) <= 1, "{what}: {}/255 off at its own pose", off(&seen, &truth));
            assert!(off(&parts.picture(&camera), &truth) <= 1, "{what}: a picture");
            // The order in which a device ends its rays is not seen.
            assert_eq!(parts.pieces(&asked), pieces, "{what}: again");
            // Processors send about as much, and the frame of theirs looks the same.
            let of_cpu = Parts::of(&look, split(), on_processors);
            let asked_of_cpu = of_cpu.asked(FrameHeader::alone(camera, 8));
            let ratio = asked.threshold / asked_of_cpu.threshold;
            assert!((0.98..1.02).contains(&ratio), "{what}: {ratio} times the threshold");
            let num = |pieces: &[Vec<Vec<u32>>]| pieces.iter().flatten().map(Vec::len).sum::<usize>() as f64;
            let sent = of_cpu.pieces(&asked);
            let ratio = num(&pieces) / num(&sent);
            assert!((0.98..1.02).contains(&ratio), "{what}: {ratio} times the words");
            let frame_of_cpu = of_cpu.frame_of(&asked, &sent);
            let beside = look.camera(10.0, SIZE);
            let [a, b] = [&frame, &frame_of_cpu].map(|frame| raycast(frame, &bounds, &beside));
            let found = Difference::of(&a, &b);
            // Where two joints cost the same, another one is made.
            assert!(found.mean < 0.3 && found.share_beyond_2 < 0.03, "{what}: beside, {found:?}");
        }
    }
}

#[test]
fn gpus_and_processors_work_together_and_a_part_that_is_not_sent_is_missed() {
    if gpu().is_none() {
        return;
    }
    let look = &looks()[0];
    let (scene, camera) = (look.scene_of(look.volume.clone()), look.camera(0.0, SIZE));
    let (bounds, truth) = (look.volume.bounds(), render(&scene, &camera));
    let split = Split::evenly([48; 3], 5).unwrap();
    let by_turns = |rank| if rank % 2 == 0 { on_gpu(rank) } else { on_processors(rank) };
    let parts = Parts::of(look, split, by_turns);
    let asked = parts.asked(FrameHeader::alone(camera, 8));
    let pieces = parts.pieces(&asked);
    let seen = |pieces: &[Vec<Vec<u32>>]| raycast(&parts.frame_of(&asked, pieces), &bounds, &camera);
    assert!(off(&seen(&pieces), &truth) <= 1);
    // The control: one sends words about no pixel, which is one word a row.
    let mut fewer = pieces;
    let num = fewer[2].len();
    fewer[2] = (0..num).map(|owner| vec![0; rows_of(owner, num, SIZE.1).len()]).collect();
    assert!(off(&seen(&fewer), &truth) > 20);
}

/// Looks take turns on one device, and rays have more items than it usually has room for.
#[test]
fn looks_take_turns_and_long_rays_get_room() {
    if gpu().is_none() {
        return;
    }
    // Noise: a surface is crossed in every other voxel.
    let noise = |i: u32| (i.wrapping_mul(2_654_435_761) >> 24) as u8;
    let voxels = Voxels::U8((0..160 * 24 * 24).map(noise).collect());
    let volume = Volume::new([160, 24, 24], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap();
    let isos = Isos::new(&[Iso { value: 128.0, opacity: 0.02 }]).unwrap();
    let flat = MarchSettings::of(false, Lighting::default());
    let soft = Look::new("soft", volume.clone(), flat);
    let surface = Look::new("surface", volume, MarchSettings { mode: Mode::Iso, isos, ..flat });
    let along = |look: &Look| {
        let bounds = look.volume.bounds();
        let pose = Pose::look_at(Vec3::X * 6.0 * bounds.radius(), Vec3::ZERO, Vec3::Y);
        Camera::new(pose, Intrinsics::perspective(20, 20, 0.04), &bounds)
    };
    let split = Split::grid([160, 24, 24], [1, 1, 1]).unwrap();
    let [ours, theirs] = [on_gpu as fn(usize) -> _, on_processors];
    let mut parts = Parts::of(&soft, split.clone(), ours);
    for look in [&soft, &surface, &soft] {
        let camera = along(look);
        let of_cpu = Parts::of(look, split.clone(), theirs);
        // Only the scene is another one.
        parts.scenes = of_cpu.scenes.clone();
        let asked = AskedFrame::new(&parts.scenes[0], FrameHeader::alone(camera, 8), 1.0);
        let steps = [&parts, &of_cpu].map(|parts| {
            let all = parts.each(|marcher, part| marcher.steps(part, &asked));
            all.into_iter().flatten().count()
        });
        assert!(steps[0].abs_diff(steps[1]) <= steps[1] / 50, "{}: {steps:?} words", look.name);
        // 25 counted rays, of which a step has seven words: more than the usual 128 steps each.
        assert!(look.name == "surface" || steps[0] > 25 * 7 * 140, "{steps:?}");
        let pieces = parts.pieces(&asked);
        let [a, b] = [parts.frame_of(&asked, &pieces), of_cpu.frame_of(&asked, &of_cpu.pieces(&asked))]
            .map(|frame| raycast(&frame, &look.volume.bounds(), &camera));
        assert!(off(&a, &b) <= 1, "{}: {}/255", look.name, off(&a, &b));
        if look.name == "surface" {
            // 400 rays, each with more crossings of four words than the usual 32.
            assert!(pieces[0][0].len() > 400 * 40 * 4, "{} words", pieces[0][0].len());
        }
    }
}

#[test]
fn a_scan_on_gpus_is_the_scan() {
    if gpu().is_none() {
        return;
    }
    let folder = std::env::var_os("ISINGLASS_DATA")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data")), PathBuf::from);
    let path = folder.join("bonsai.nrrd");
    if !path.is_file() {
        eprintln!("skipped: there is no {}", path.display());
        return;
    }
    let volume = open(&path.to_string_lossy(), &OpenOptions::default()).unwrap();
    let transfer = default_transfer("bonsai.nrrd", &volume, &Histogram::of(&volume));
    for mode in [Mode::Composite, Mode::Iso] {
        let settings = MarchSettings { mode, ..MarchSettings::of(true, Lighting::default()) };
        let look = Look { transfer: transfer.clone(), ..Look::new("bonsai", volume.clone(), settings) };
        let scene = look.scene_of(volume.clone());
        let camera_at = |degrees| look.camera(degrees, (128, 128));
        let header = FrameHeader::alone(camera_at(0.0), 8);
        let single = generate(&scene, header);
        let frame = Parts::of(&look, Split::grid(volume.dims(), [2, 2, 1]).unwrap(), on_gpu).frame(header);
        let truth = [0.0, 10.0].map(|degrees| render(&scene, &camera_at(degrees)));
        let seen =
            |frame: &LayeredFrame, i: usize| raycast(frame, &volume.bounds(), &camera_at([0.0, 10.0][i]));
        let found = off(&seen(&frame, 0), &truth[0]);
        assert!(found <= 1, "{mode:?}: {found}/255 off at its own pose");
        let [found, of_single] = [&frame, &single].map(|frame| psnr(&seen(frame, 1), &truth[1]));
        println!("{mode:?}: {found:.2} dB at 10 degrees, one process {of_single:.2}");
        assert!(found > of_single - 0.1, "{mode:?}: {found} dB, one process {of_single}");
    }
}
