//! Are times of a volume beyond memory shown by pages, within the memory of one of them? Over a real connection.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::{Fineness, LayeredFrame};
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{
    Finest, Histogram, PAGE_VOXELS, PageError, PageId, PageSource, PageVoxels, Paging, Pyramid, PyramidLevel,
    Volume, VolumeInfo, VoxelKind, Voxels, page_of,
};
use isinglass_core::wire::{Choices, Part};
use isinglass_formats::load_transfer;
use isinglass_net::{Client, ClientOptions};
use isinglass_render::Backend;
use isinglass_server::{Library, Loaded, Loader, RunningServer, ServeOptions, Survey, Timing, start};
use tokio::runtime::Runtime;

const SIDE: u32 = 200;
const SIZE: Intrinsics = Intrinsics::perspective(64, 48, 0.6);
/// Memory for all pages, and for some of them.
const MUCH: u64 = 1 << 30;
const LITTLE: u64 = 80 * 2 * PAGE_VOXELS as u64;

/// Who measures memory is alone.
static TURN: Mutex<()> = Mutex::new(());

/// The levels of a volume in memory.
struct Levels {
    pyramid: Pyramid,
    volumes: Vec<Volume>,
}

impl PageSource for Levels {
    fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }

    fn read(&self, _: usize, page: PageId) -> Result<PageVoxels, PageError> {
        std::thread::sleep(Duration::from_millis(2));
        Ok(page_of(&self.volumes[usize::from(page.level)], self.pyramid.first_point(page)))
    }
}

/// Every `step`-th voxel.
fn thinned(whole: &Volume, step: u32) -> Volume {
    let n = SIDE.div_ceil(step);
    let stored = |i: u32| {
        let [x, y, z] = [i % n, i / n % n, i / n / n].map(|i| (i * step) as i32);
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

/// The coarsest level of a volume, with its pages.
fn paged(whole: &Volume, max_bytes: u64) -> Volume {
    let factors = [1, 2, 4];
    let volumes: Vec<Volume> = factors.iter().map(|step| thinned(whole, *step)).collect();
    let level_of =
        |(step, v): (&u32, &Volume)| PyramidLevel { dims: v.dims(), factor: [*step; 3], first: [0.0; 3] };
    let pyramid = Pyramid {
        levels: factors.iter().zip(&volumes).map(level_of).collect(),
        spacing: whole.spacing(),
        kind: VoxelKind::U8,
        value_maps: vec![whole.value_map()],
        info: VolumeInfo::default(),
    };
    let base = volumes[2].clone();
    let source = Arc::new(Levels { pyramid, volumes });
    base.with_paging(Paging { source, ranges: None, max_bytes, own: None })
}

/// The volume at a time: other values in other places.
fn at_time(time: u8) -> Volume {
    let first = Builtin::Shells.volume(SIDE);
    let Voxels::U8(voxels) = first.voxels() else { panic!("bytes") };
    let (before, after) = voxels.split_at(voxels.len() / 5 * usize::from(time));
    let moved = after.iter().chain(before).map(|x| x / 2 + 20 * time).collect();
    let info = VolumeInfo::default();
    Volume::new([SIDE; 3], first.spacing(), Voxels::U8(moved), first.value_map(), info).unwrap()
}

/// A file whose times are all read by pages.
struct Film {
    times: Vec<Volume>,
    transfer: TransferFunction,
}

fn choices(time: u32) -> Choices {
    let shown =
        Part { channel: Some(0), time: Some(time), level: Some(0), series: Some(0), ..Part::default() };
    let (num_times, num_channels, num_series) = (3, 1, 1);
    Choices { shown, whole_dims: [SIDE.into(); 3], num_channels, num_times, num_series, ..Choices::default() }
}

impl Loader for Film {
    fn survey(&self, part: &Part, _: u64) -> Result<Survey, String> {
        Ok(Survey { parts: choices(part.time.unwrap()), bytes_needed: 4 << 20 })
    }

    fn load(&self, part: &Part, _: u64, _: &dyn Fn(f32), _: &AtomicBool) -> Result<Loaded, String> {
        let volume = self.times[part.time.unwrap() as usize].clone();
        Ok(Loaded { volume, transfer: self.transfer.clone(), channels: Default::default() })
    }
}

fn film(max_bytes: u64) -> Arc<Film> {
    let times = (0..3).map(|time| paged(&at_time(time), max_bytes)).collect();
    Arc::new(Film { times, transfer: load_transfer("shells").unwrap() })
}

/// A server, and a viewer.
struct Stage {
    runtime: Runtime,
    server: RunningServer,
    client: Client,
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

impl Stage {
    fn of(volume: &Volume, look: &Look, library: Option<Library>) -> Self {
        let mut threads = tokio::runtime::Builder::new_multi_thread();
        let runtime = threads.worker_threads(2).enable_all().build().unwrap();
        let options = ServeOptions {
            volume: Arc::new(volume.clone()),
            look: look.clone(),
            devices: Backend::Cpu.into(),
            listen: ([127, 0, 0, 1], 0).into(),
            plan: CodingPlan::EXACT,
            max_viewers: 1,
            frame_memory: 1 << 30,
            library,
            timing: Timing::default(),
        };
        let server = runtime.block_on(async { start(options) }).unwrap();
        let link = runtime.block_on(server.mint_link(None)).unwrap();
        let client = Client::connect(&link, ClientOptions::default()).unwrap();
        client.wait_connected(Duration::from_secs(60)).unwrap();
        Self { runtime, server, client }
    }

    /// Shows the first time of a film.
    fn of_film(film: &Arc<Film>) -> Self {
        let library = Library { parts: choices(0), loader: film.clone(), volume_memory: MUCH };
        Self::of(&film.times[0], &Look::new(film.transfer.clone()), Some(library))
    }

    /// Requests a time, and waits until a frame shows it.
    fn turn_to(&self, time: u32) {
        self.client.talk().selection.open(Some(choices(time).shown));
        wait_for("frame of another time", || {
            let frame = self.client.latest_frame()?;
            let talk = self.client.talk();
            (talk.selection.choices()?.shown.time == Some(time) && frame.is_of(&talk)).then_some(())
        });
    }

    /// The frame of a resting camera, when all of its pages are there.
    fn rest(&self, azimuth: f32) -> LayeredFrame {
        let distance = self.client.talk().link.description().unwrap().volume.bounds().radius() * 4.0;
        let pose = self.client.set_pose(Pose::orbit(Vec3::ZERO, azimuth, 0.3, distance), SIZE);
        wait_for("rest", || {
            let received = self.client.latest_frame()?;
            let header = received.frame.header;
            let is_final = header.fineness != Fineness::Draft && header.pose == pose;
            if !is_final || !received.is_of(&self.client.talk()) {
                return None;
            }
            // Light comes after the pages.
            std::thread::sleep(Duration::from_millis(600));
            let is_last = self.client.latest_frame()?.frame.header.frame == header.frame;
            is_last.then(|| received.frame.clone())
        })
    }

    fn look(&self) -> Look {
        (*self.client.talk().look.in_force().unwrap().1).clone()
    }

    fn num_pages(&self) -> u32 {
        self.client.talk().pages.progress().unwrap().num_resident
    }

    fn close(self) {
        drop(self.client);
        self.runtime.block_on(self.server.close());
    }
}

/// The greatest difference of a frame from the picture of a volume in memory, at the frame's own camera, of 255.
fn difference(whole: Volume, look: &Look, frame: &LayeredFrame) -> u8 {
    let scene = Scene::of_look(Arc::new(whole), look);
    let camera = frame.header.camera;
    let pictures = [render(&scene, &camera), raycast(frame, &scene.volume.bounds(), &camera)];
    let [a, b] = pictures.map(|picture| picture.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn each_time_is_seen_as_when_it_alone_is_opened_by_pages() {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    for max_bytes in [MUCH, LITTLE] {
        let film = film(max_bytes);
        let stage = Stage::of_film(&film);
        stage.rest(0.1);
        // Times are played, and stay where the playing ends.
        for (i, playing) in [&[1u32, 2, 0, 1, 2][..], &[0, 1], &[0]].into_iter().enumerate() {
            playing.iter().for_each(|time| stage.turn_to(*time));
            let (azimuth, time) = (0.4 + 0.5 * i as f32, playing[playing.len() - 1]);
            let (shown, look) = (stage.rest(azimuth), stage.look());
            let alone = |time: u32| {
                let alone = Stage::of(&film.times[time as usize], &look, None);
                let shown = alone.rest(azimuth);
                alone.close();
                shown
            };
            let (found, other) = (alone(time), alone((time + 1) % 3));
            let (a, b) = (found.header, shown.header);
            assert_eq!((a.camera, a.fineness), (b.camera, b.fineness), "time {time}");
            let same = |frame: &LayeredFrame| LayeredFrame { header: b, ..frame.clone() } == shown;
            assert!(same(&found), "time {time}: another frame");
            assert!(!same(&other), "control: another time is another frame");
            let worst = difference(at_time(time as u8), &look, &shown);
            assert!(b.fineness == Fineness::Whole || max_bytes == LITTLE);
            assert!(worst <= 1 || b.fineness != Fineness::Whole, "time {time}: {worst}");
        }
        stage.close();
    }
}

/// Resident memory of this process, bytes.
#[cfg(target_os = "linux")]
fn memory() -> u64 {
    let text = std::fs::read_to_string("/proc/self/statm").unwrap();
    text.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() * 4096
}

/// What `work` returns, and the most memory meanwhile, bytes.
#[cfg(target_os = "linux")]
fn with_peak<T>(work: impl FnOnce() -> T) -> (T, u64) {
    use std::sync::atomic::Ordering;
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let watch = scope.spawn(|| {
            let mut peak = 0;
            while !is_over.load(Ordering::Relaxed) {
                peak = peak.max(memory());
                std::thread::sleep(Duration::from_millis(1));
            }
            peak
        });
        let made = work();
        is_over.store(true, Ordering::Relaxed);
        (made, watch.join().unwrap())
    })
}

#[cfg(target_os = "linux")]
#[test]
fn playing_takes_no_more_memory_than_one_time() {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let film = film(MUCH);
    let stage = Stage::of_film(&film);
    stage.rest(0.1);
    let (num_pages, before) = (stage.num_pages(), memory());
    let of_pages = u64::from(num_pages) * 2 * PAGE_VOXELS as u64;
    assert!(of_pages > 20 << 20, "{num_pages} pages are enough to be seen");
    let play = || {
        for (i, time) in [1, 2, 0, 1, 2, 0, 1].into_iter().enumerate() {
            stage.turn_to(time);
            // All pages of this time are there when the next one comes.
            stage.rest(0.2 + 0.1 * i as f32);
        }
        stage.turn_to(2);
        stage.turn_to(0);
        stage.rest(0.1);
    };
    let ((), peak) = with_peak(play);
    let more = peak.saturating_sub(before);
    println!("{of_pages} bytes of pages, {more} bytes more while they change");
    assert!(more < of_pages / 3, "{more} bytes more while {of_pages} bytes of pages change");
    // The control: a time that is opened beside it takes that much.
    let beside = Stage::of(&film.times[1], &stage.look(), None);
    let (_, peak) = with_peak(|| beside.rest(0.1));
    assert!(peak.saturating_sub(before) > of_pages / 2, "{peak} bytes with two, {before} with one");
    beside.close();
    stage.close();
}
