//! Is a volume that is read by pages shown at once, refined while it is read, and exact in the end? Over a real
//! connection, from a source that is slow, fails and lies by script.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glam::Vec3;
use isinglass_client::{Foresight, FrameSize, Standing, Viewing};
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{
    Finest, Histogram, PAGE_VOXELS, PageError, PageId, PageProgress, PageSource, PageVoxels, Paging, Pyramid,
    PyramidLevel, Volume, VolumeInfo, VoxelKind, Voxels, page_of,
};
use isinglass_formats::default_transfer;
use isinglass_net::{Client, ClientOptions};
use isinglass_render::Backend;
use isinglass_server::{ServeOptions, Timing, start};

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

/// Shows a volume by pages until the picture rests.
fn show(whole: &Volume, look: &Look, script: Script, max_bytes: u64) -> Shown {
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
    let volume = base.with_paging(Paging { source, ranges: None, max_bytes });

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
        library: None,
        timing: Timing::default(),
    };
    let server = runtime.block_on(async { start(options) }).unwrap();
    let link = runtime.block_on(server.mint_link(None)).unwrap();
    let client = Client::connect(&link, ClientOptions::default()).unwrap();
    client.wait_connected(Duration::from_secs(60)).unwrap();
    let mut viewing = Viewing::new(client, FrameSize::default(), Foresight::default());
    let picture = Intrinsics::perspective(64, 48, 0.6);
    let pose = Pose::orbit(bounds.center(), 0.4, 0.3, bounds.radius() * picture.fit_distance());
    let begun = Instant::now();
    let mut was_refining = false;
    loop {
        std::thread::sleep(Duration::from_millis(8));
        assert!(begun.elapsed() < Duration::from_secs(300), "no rest");
        let refresh = viewing.refresh(begun.elapsed(), pose, picture, &bounds);
        let progress = viewing.source().talk().pages.progress().unwrap_or_default();
        was_refining |= refresh.frame.is_some() && progress.is_loading();
        let rests = matches!(refresh.standing, Standing::Exact | Standing::Settled);
        if let Some(frame) = refresh.frame.filter(|frame| rests && frame.is_exact) {
            let (standing, frame) = (refresh.standing, frame.frame.clone());
            runtime.block_on(server.close());
            return Shown { standing, frame, progress, was_refining };
        }
    }
}

fn subject() -> (Volume, Look) {
    let volume = Builtin::Shells.volume(SIDE);
    let look = Look::new(default_transfer("builtin:shells", &volume, &Histogram::of(&volume)));
    (volume, look)
}

/// The greatest difference of the frame from the picture of the volume in memory, at the frame's own camera, of 255.
fn difference(whole: Volume, look: &Look, shown: &Shown) -> u8 {
    let camera = shown.frame.header.camera;
    let bounds = whole.bounds();
    let pictures =
        [render(&Scene::of_look(Arc::new(whole), look), &camera), raycast(&shown.frame, &bounds, &camera)];
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
    // Room for some of the pages.
    let shown = show(&whole, &look, |_, _| None, 90 * 2 * 69 * 69 * 69);
    assert_eq!(shown.standing, Standing::Settled);
    let progress = shown.progress;
    assert!(progress.coarse_share > 0.0 && progress.coarse_share < 1.0, "{progress:?}");
    assert!(!progress.is_loading() && progress.num_damaged == 0 && progress.num_resident > 8, "{progress:?}");
}
