//! Is a volume that is read by pages shown at once, refined while it is read, and exact in the end? Over a real
//! connection, from a source that is slow, fails and lies by script.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_client::{Foresight, FrameSize, Standing, Viewing};
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::cancel::ALWAYS;
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{
    Finest, Histogram, Lighting, PAGE_VOXELS, Page, PageError, PageId, PageProgress, PageSet, PageSource,
    PageVoxels, Paging, Pyramid, PyramidLevel, SlabMode, Slice, SlicePlane, SliceSpec, ValuesAt, Volume,
    VolumeInfo, VoxelKind, Voxels, page_of,
};
use isinglass_core::wire::{Choices, Part, ProfileRequest};
use isinglass_formats::default_transfer;
use isinglass_net::{Client, ClientOptions};
use isinglass_render::Backend;
use isinglass_server::{Library, Loaded, Loader, RunningServer, ServeOptions, Survey, Timing, start};
use tokio::runtime::Runtime;

const SIDE: u32 = 200;

/// What a source does when a page is read for the n-th time.
type Script = fn(PageId, u32) -> Option<Result<PageVoxels, PageError>>;

/// The levels of a volume in memory.
struct Scripted {
    pyramid: Pyramid,
    levels: Vec<Volume>,
    script: Script,
    num_reads: Mutex<HashMap<PageId, u32>>,
}

impl PageSource for Scripted {
    fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }

    fn read(&self, _: usize, page: PageId) -> Result<PageVoxels, PageError> {
        std::thread::sleep(Duration::from_millis(10));
        let num_reads = {
            let mut all = self.num_reads.lock().unwrap();
            let num = all.entry(page).or_default();
            *num += 1;
            *num
        };
        let of_script = (self.script)(page, num_reads);
        let level = &self.levels[usize::from(page.level)];
        of_script.unwrap_or_else(|| Ok(page_of(level, self.pyramid.first_point(page))))
    }
}

/// Every `step`-th voxel.
fn thinned(whole: &Volume, step: u32) -> Volume {
    let n = SIDE.div_ceil(step);
    let at = |i: u32| [i % n, i / n % n, i / n / n].map(|i| (i * step) as i32);
    let stored = |i: u32| {
        let [x, y, z] = at(i);
        whole.stored_at(x, y, z) as u8
    };
    let voxels = Voxels::U8((0..n * n * n).map(stored).collect());
    let spacing = whole.spacing() * step as f32;
    let level = Volume::new([n; 3], spacing, voxels, whole.value_map(), VolumeInfo::default()).unwrap();
    level.with_finest(Finest {
        dims: whole.dims(),
        spacing: whole.spacing(),
        first: Vec3::ZERO,
        stored_range: Some(whole.stored_range()),
        histogram: Some(Arc::new(Histogram::of(whole))),
    })
}

struct Shown {
    standing: Standing,
    frame: LayeredFrame,
    progress: PageProgress,
    /// Whether pages were missing in an earlier picture.
    was_refining: bool,
}

/// The coarsest level of a volume, with all its pages.
fn paged(whole: &Volume, script: Script, max_bytes: u64) -> Volume {
    let factors = [1, 2, 4];
    let levels: Vec<Volume> = factors.iter().map(|step| thinned(whole, *step)).collect();
    let level_of =
        |(step, v): (&u32, &Volume)| PyramidLevel { dims: v.dims(), factor: [*step; 3], first: [0.0; 3] };
    let pyramid = Pyramid {
        levels: factors.iter().zip(&levels).map(level_of).collect(),
        spacing: whole.spacing(),
        kind: VoxelKind::U8,
        value_maps: vec![whole.value_map()],
        info: VolumeInfo::default(),
    };
    let base = levels.last().unwrap().clone();
    let source = Arc::new(Scripted { pyramid, levels, script, num_reads: Mutex::default() });
    base.with_paging(Paging { source, ranges: None, max_bytes, own: None })
}

/// A server, and a viewer without a window.
struct Stage {
    runtime: Runtime,
    server: RunningServer,
    viewing: Viewing<Client>,
    bounds: Aabb,
    azimuth: f32,
    begun: Instant,
}

fn stage(volume: Volume, look: &Look, library: Option<Library>) -> Stage {
    let mut threads = tokio::runtime::Builder::new_multi_thread();
    let runtime = threads.worker_threads(2).enable_all().build().unwrap();
    let bounds = volume.bounds();
    let options = ServeOptions {
        volume: Arc::new(volume),
        look: look.clone(),
        devices: Backend::Cpu.into(),
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
        plan: CodingPlan::default(),
        max_viewers: 1,
        frame_memory: 1 << 30,
        library,
        timing: Timing::default(),
    };
    let server = runtime.block_on(async { start(options) }).unwrap();
    let link = runtime.block_on(server.mint_link(None)).unwrap();
    let client = Client::connect(&link, ClientOptions::default()).unwrap();
    client.wait_connected(Duration::from_secs(60)).unwrap();
    let viewing = Viewing::new(client, FrameSize::default(), Foresight::default());
    Stage { runtime, server, viewing, bounds, azimuth: 0.4, begun: Instant::now() }
}

impl Stage {
    fn client(&self) -> &Client {
        self.viewing.source()
    }

    /// Shows the volume until the picture rests.
    fn rest(&mut self) -> Shown {
        let picture = Intrinsics::perspective(64, 48, 0.6);
        let distance = self.bounds.radius() * picture.fit_distance();
        let pose = Pose::orbit(self.bounds.center(), self.azimuth, 0.3, distance);
        let (mut was_refining, started) = (false, Instant::now());
        loop {
            std::thread::sleep(Duration::from_millis(8));
            assert!(started.elapsed() < Duration::from_secs(300), "no rest");
            let refresh = self.viewing.refresh(self.begun.elapsed(), pose, picture, &self.bounds);
            let progress = self.client().talk().pages.progress().unwrap_or_default();
            was_refining |= refresh.frame.is_some() && progress.is_loading();
            let rests = matches!(refresh.standing, Standing::Exact | Standing::Settled);
            let is_here =
                |frame: &LayeredFrame| frame.header.camera.pose.eye.distance(pose.eye) < 1e-3 * distance;
            // What the server tells of the pages comes on another stream than the frame.
            let is_told = progress.is_exact() == (refresh.standing == Standing::Exact);
            let is_final = rests && is_told && !progress.is_loading();
            let frame = refresh.frame.filter(|frame| is_final && frame.is_exact && is_here(&frame.frame));
            if let Some(frame) = frame {
                let (standing, frame) = (refresh.standing, frame.frame.clone());
                return Shown { standing, frame, progress, was_refining };
            }
        }
    }

    fn close(self) {
        self.runtime.block_on(self.server.close());
    }
}

/// Shows a volume by pages until the picture rests.
fn show(whole: &Volume, look: &Look, script: Script, max_bytes: u64) -> Shown {
    let mut stage = stage(paged(whole, script, max_bytes), look, None);
    let shown = stage.rest();
    stage.close();
    shown
}

/// What `found` is, as soon as it is there.
fn wait_for<T>(what: &str, mut found: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        if let Some(found) = found() {
            return found;
        }
        assert!(started.elapsed() < Duration::from_secs(300), "no {what}");
        std::thread::sleep(Duration::from_millis(4));
    }
}

fn subject() -> (Volume, Look) {
    let volume = Builtin::Shells.volume(SIDE);
    let look = Look::new(default_transfer("builtin:shells", &volume, &Histogram::of(&volume)));
    (volume, look)
}

/// The greatest difference of the frame from the picture of the volume in memory, at the frame's own camera, of 255.
fn difference(whole: Volume, look: &Look, shown: &Shown) -> u8 {
    difference_from(&Scene::of_look(Arc::new(whole), look), shown)
}

fn difference_from(scene: &Scene, shown: &Shown) -> u8 {
    let camera = shown.frame.header.camera;
    let pictures = [render(scene, &camera), raycast(&shown.frame, &scene.volume.bounds(), &camera)];
    let [a, b] = pictures.map(|picture| picture.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn it_is_refined_while_it_is_read_and_exact_in_the_end() {
    let (whole, look) = subject();
    // Each fifth page fails at first.
    let script: Script = |page, num_reads| {
        let fails = page.at.iter().sum::<u32>() % 5 == 2 && num_reads == 1;
        fails.then(|| Err(PageError::Unreachable("not now".into())))
    };
    let shown = show(&whole, &look, script, 1 << 30);
    assert!(shown.standing == Standing::Exact && shown.was_refining, "{:?}", shown.progress);
    assert!(shown.progress.is_exact() && shown.progress.num_wanted > 30, "{:?}", shown.progress);
    assert!(difference(whole, &look, &shown) <= 1, "the picture is that of the volume in memory");
}

#[test]
fn damaged_and_lying_pages_stay_coarse_and_it_is_never_called_exact() {
    let (whole, look) = subject();
    let script: Script = |page, _| match (page.level, page.at) {
        (0, [1, 1, 1]) => Some(Err(PageError::Damaged("a bad checksum".into()))),
        (0, [2, 1, 2]) => Some(Ok(PageVoxels { voxels: Voxels::U8(vec![7; 99]), gaps: None })),
        (0, [2, 2, 2]) => Some(Ok(PageVoxels { voxels: Voxels::F32(vec![1.0; PAGE_VOXELS]), gaps: None })),
        (0, [1, 2, 1]) => panic!("a defect of the reader"),
        _ => None,
    };
    let shown = show(&whole, &look, script, 1 << 30);
    assert_eq!(shown.standing, Standing::Settled);
    let progress = shown.progress;
    assert!(!progress.is_loading() && progress.num_damaged == 4 && !progress.is_exact(), "{progress:?}");
    assert!(difference(whole, &look, &shown) > 1);
}

#[test]
fn with_little_memory_it_is_the_finest_that_fits() {
    let (whole, look) = subject();
    // Room for some of the pages, and less than all voxels take.
    let shown = show(&whole, &look, |_, _| None, 26 * 2 * 69 * 69 * 69);
    assert_eq!(shown.standing, Standing::Settled);
    let progress = shown.progress;
    assert!(progress.coarse_share > 0.0 && progress.coarse_share < 1.0, "{progress:?}");
    assert!(!progress.is_loading() && progress.num_damaged == 0 && progress.num_resident > 8, "{progress:?}");
}

#[test]
fn slices_and_points_are_of_the_finest_level_whatever_is_shown() {
    let (whole, look) = subject();
    // Room for few pages, and one that is damaged.
    let script: Script = |page, _| {
        let is_damaged = (page.level, page.at) == (0, [2, 2, 2]);
        is_damaged.then(|| Err(PageError::Damaged("a bad checksum".into())))
    };
    let stage = stage(paged(&whole, script, 26 * 2 * 69 * 69 * 69), &look, None);
    let client = stage.client();
    let across = |index| SliceSpec {
        plane: SlicePlane::Axis { axis: 2, index },
        thickness: 0.0,
        mode: SlabMode::Mean,
    };
    let mut was_draft = false;
    let mut slice = |index| {
        client.talk().slices.want(&[(across(index), false)]);
        wait_for("slice", || {
            let there = client.talk().slices.get(&across(index));
            // It is wanted until the finest one is there.
            let is_final = !client.talk().slices.is_news(&[]);
            was_draft |= there.is_some() && !is_final;
            there.filter(|_| is_final)
        })
    };
    let flat = |index| Slice::of(&whole, &across(index), ALWAYS).unwrap();
    assert_eq!(*slice(70), flat(70));
    // The control: a damaged page stays coarse, and the slice ends all the same.
    assert_ne!(*slice(150), flat(150));
    assert!(was_draft, "what is in memory comes first");
    let point = |share: f32| stage.bounds.min + (stage.bounds.max - stage.bounds.min) * share;
    let probed = |share: f32, level: u8| {
        let id = client.talk().probe.ask(point(share).to_array());
        wait_for("value", || {
            let answer = client.talk().probe.answer().filter(|a| a.id == id).and_then(|a| a.voxel)?;
            (answer.level <= level).then_some(answer)
        })
    };
    let exact = (&whole).voxel(point(0.3)).unwrap();
    let found = probed(0.3, 0);
    assert_eq!((found.index, found.value, found.level), (exact.index, exact.value, 0));
    // In the damaged page the answer says that it is of a coarser level.
    assert!(probed(0.8, 2).level > 0);
    let ends = [point(0.1), point(0.6)].map(|p| p.to_array());
    let id = client.talk().profile.ask(ends, 200);
    let question = ProfileRequest { id, ends, num_points: 200 };
    let exact = question.answer(&mut &whole);
    wait_for("profile", || client.talk().profile.answer().filter(|answer| **answer == exact).map(|_| ()));
    stage.close();
}

/// A file of two times, both read by pages.
struct Film {
    times: [Volume; 2],
    transfer: TransferFunction,
    /// Memory that was held while a time was opened.
    held: Mutex<Vec<u64>>,
}

fn choices(time: u32) -> Choices {
    let shown =
        Part { channel: Some(0), time: Some(time), level: Some(0), series: Some(0), ..Part::default() };
    Choices {
        shown,
        whole_dims: [SIDE.into(); 3],
        num_channels: 1,
        num_times: 3,
        num_series: 1,
        ..Choices::default()
    }
}

impl Loader for Film {
    fn survey(&self, part: &Part, held: u64) -> Result<Survey, String> {
        self.held.lock().unwrap().push(held);
        let time = part.time.filter(|time| *time < 2).ok_or("there is no such time")?;
        Ok(Survey { parts: choices(time), bytes_needed: 0 })
    }

    fn load(&self, part: &Part, _: u64, _: &dyn Fn(f32), _: &AtomicBool) -> Result<Loaded, String> {
        let volume = paged(&self.times[part.time.unwrap() as usize], |_, _| None, MEMORY);
        Ok(Loaded { volume, transfer: self.transfer.clone(), channels: Default::default() })
    }
}

const MEMORY: u64 = 1 << 30;

#[test]
fn another_time_is_read_by_pages_when_the_pages_before_have_made_room() {
    let (first, look) = subject();
    let turned = match first.voxels() {
        Voxels::U8(v) => Voxels::U8(v.iter().rev().map(|x| x / 2 + 40).collect()),
        _ => panic!("bytes"),
    };
    let second =
        Volume::new([SIDE; 3], first.spacing(), turned, first.value_map(), VolumeInfo::default()).unwrap();
    let times = [first.clone(), second.clone()];
    let film = Arc::new(Film { times, transfer: look.transfer.clone(), held: Mutex::default() });
    let library = Library { parts: choices(0), loader: film.clone(), volume_memory: MEMORY };
    let mut stage = stage(paged(&first, |_, _| None, MEMORY), &look, Some(library));
    assert_eq!(stage.rest().standing, Standing::Exact);
    // A time that is not there changes nothing: the pages come back.
    stage.client().talk().selection.open(Some(choices(2).shown));
    wait_for("refusal", || (!film.held.lock().unwrap().is_empty()).then_some(()));
    stage.azimuth = 0.9;
    let shown = stage.rest();
    assert_eq!(shown.standing, Standing::Exact, "{:?}", shown.progress);
    assert!(difference(first, &look, &shown) <= 1, "the first time again");
    stage.client().talk().selection.open(Some(choices(1).shown));
    let time = |stage: &Stage| stage.client().talk().selection.choices().and_then(|c| c.shown.time);
    wait_for("another time", || time(&stage).filter(|time| *time == 1));
    stage.azimuth = 1.4;
    let shown = stage.rest();
    assert_eq!(shown.standing, Standing::Exact);
    let (_, of_second) = stage.client().talk().look.in_force().unwrap();
    assert!(difference(second, &of_second, &shown) <= 1, "the second time");
    assert!(film.held.lock().unwrap().iter().all(|held| *held < MEMORY / 8), "the pages are free");
    stage.close();
}

/// The volume with all pages of its finest level, lit at once.
fn with_all_pages(volume: Volume, look: &Look) -> Scene {
    let source = volume.paging().unwrap().source.clone();
    let pyramid = Arc::new(source.pyramid().clone());
    let mut pages = pyramid.base_pages(&volume).unwrap();
    let [nx, ny, nz] = pyramid.pages(0);
    for i in 0..nx * ny * nz {
        let id = PageId { level: 0, at: [i % nx, i / nx % ny, i / nx / ny] };
        let page = Page::new(&pyramid, id, vec![source.read(0, id).unwrap()]).unwrap();
        pages.push(Arc::new(page));
    }
    let set = Arc::new(PageSet::new(pyramid, pages, |_| true));
    Scene::of_look(Arc::new(volume), look).with_pages(set, None)
}

#[test]
fn another_light_reaches_every_page() {
    let (whole, look) = subject();
    let mut stage = stage(paged(&whole, |_, _| None, 1 << 30), &look, None);
    assert_eq!(stage.rest().standing, Standing::Exact);
    let lighting = Lighting { ambient_occlusion: 0.9, shadows: 0.6, ..Lighting::default() };
    for (azimuth, lighting) in [(0.8, lighting), (1.1, Lighting { shadows: 0.1, ..lighting })] {
        let dim = Look { lighting, ..look.clone() };
        stage.viewing.set_look(stage.begun.elapsed(), dim.clone());
        stage.azimuth = azimuth;
        let shown = stage.rest();
        assert_eq!(shown.standing, Standing::Exact);
        let [right, before] =
            [&dim, &look].map(|look| with_all_pages(paged(&whole, |_, _| None, 1 << 30), look));
        assert!(difference_from(&right, &shown) <= 1, "the light of the look");
        assert!(difference_from(&before, &shown) > 1, "control: another light is another picture");
    }
    stage.close();
}
