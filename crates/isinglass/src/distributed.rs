//! One volume in the memory of all processes that `mpirun` started: `--distributed`.
//!
//! Every process runs the same command with the same arguments. Process 0 writes the results. An error of one is told to
//! all, and process 0 prints it in one line.

use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use anyhow::{Result, anyhow};
use clap::Args;
use isinglass_bench::progress::note;
use isinglass_cluster::{
    Cluster, ClusterError, Exchange, FinestNumbers, FrameOfAll, Orders, PartReader, Report, agree, are_alike,
    in_whole, orders, same_everywhere,
};
use isinglass_core::camera::Camera;
use isinglass_core::cancel::Wanted;
use isinglass_core::codec::blocks::Reference;
use isinglass_core::codec::{CodecError, Coding, EncodedFrame, MAX_CHUNKS};
use isinglass_core::kernels::lens::{View, mean_picture};
use isinglass_core::kernels::march::Scene;
use isinglass_core::layer::{Fineness, FrameHeader, LayeredFrame};
use isinglass_core::look::Look;
use isinglass_core::picture::Picture;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::volume::{
    AskedPoints, FoundPoints, GHOSTS, Histogram, Lighting, PageSet, PageView, Paging, PartProgress, PlanKey,
    Slice, SliceSpec, Split, Volume, VoxelBox,
};
use isinglass_formats::{
    LEAST_FOR_PAGES, OpenOptions, OpenedScene, Outline, Region, Selection, finest_numbers, open, open_paged,
    outline, scene_of,
};
use isinglass_render::{Backend, FrameElsewhere, PartRenderer, Renderer, RowsElsewhere, Workers};
use isinglass_server::{FramePages, Pager};
use serde_json::{Value, json};

use crate::args::{BackendArgs, ListArgs, LookArgs, VolumeArgs};
use crate::memory::MemoryArgs;
use crate::paged::{Pages, check};
use crate::report::{AlreadyTold, in_one_line};
use crate::state_args::Seen;

/// Whether several processes hold the volume.
#[derive(Args, Clone, Copy, Debug)]
pub(crate) struct DistributedArgs {
    /// Hold the volume in the memory of all processes that mpirun started, each a part of it. It takes a program built
    /// with --features distributed
    #[arg(long)]
    distributed: bool,
}

impl DistributedArgs {
    /// Joins the other processes; `None` if there is no other.
    pub(crate) fn join(self) -> Result<Option<Together>> {
        if !self.distributed {
            return Ok(None);
        }
        let exchange = isinglass_cluster::join().map_err(|e| anyhow!("--distributed: {e}"))?;
        Ok((exchange.size() > 1).then_some(Together { exchange }))
    }
}

/// This process among others.
pub(crate) struct Together {
    exchange: Box<dyn Exchange>,
}

impl Drop for Together {
    fn drop(&mut self) {
        // The others would wait for ever.
        if std::thread::panicking() {
            self.exchange.abort();
        }
    }
}

impl Together {
    /// Whether this process writes the results.
    pub(crate) fn is_root(&self) -> bool {
        self.exchange.rank() == 0
    }

    /// Ends the work of all: with the error of the first that has one, which process 0 prints.
    pub(crate) fn conclude(&self, result: Result<()>) -> Result<()> {
        let agreed = match result.map_err(anyhow::Error::downcast::<ClusterError>) {
            Err(Ok(known @ ClusterError::Rank { .. })) => Err(known),
            Err(Ok(lost)) => self.give_up(&lost),
            Err(Err(own)) => agree(&*self.exchange, Err(in_one_line(&own))),
            Ok(()) => agree(&*self.exchange, Ok(())),
        };
        let Err(error) = agreed else { return Ok(()) };
        if !matches!(error, ClusterError::Rank { .. }) {
            self.give_up(&error);
        }
        if self.is_root() {
            note(&format!("isinglass: {error}"));
        }
        // mpirun ends the others as soon as one has failed.
        match self.exchange.all_gather(&[]) {
            Ok(_) => Err(AlreadyTold.into()),
            Err(lost) => self.give_up(&lost.into()),
        }
    }

    fn give_up(&self, error: &ClusterError) -> ! {
        note(&format!("isinglass: rank {}: {error}", self.exchange.rank()));
        self.exchange.abort();
    }

    /// Opens the own part of a volume with its look; its light needs the others.
    fn open(
        &self,
        seen: &Seen,
        (volume, memory): (&VolumeArgs, &MemoryArgs),
        look: &LookArgs,
        lighting: Lighting,
        lists: &ListArgs,
    ) -> Result<(Opened, Look)> {
        let volume = seen.volume(volume)?;
        let (source, settings) = (volume.source()?, look.march_settings(lighting)?);
        let (part, split) = self.read(&volume, memory)?;
        let opened = scene_of(Arc::new(part), source, look.tf.as_deref(), settings);
        let opened = agree(&*self.exchange, opened.map_err(|e| e.to_string()))?;
        let (OpenedScene { scene, transfer, .. }, look) = seen.under_look(opened, look, lighting, lists)?;
        if self.is_root() {
            seen.note_oddities(scene.whole(), &look);
        }
        Ok((Opened { scene, split: Some(split), transfer: transfer.name }, look))
    }

    /// Serves a volume: process 0 by `serve`, on a thread of its own, with the frames that all processes make. This
    /// thread is the one that talks with them.
    pub(crate) fn serve(
        &self,
        seen: &Seen,
        volume: (&VolumeArgs, &MemoryArgs),
        look: &LookArgs,
        (lighting, lists, backend): (Lighting, &ListArgs, &BackendArgs),
        serve: impl FnOnce(Arc<Volume>, Look, Backend, Option<Pager>) -> Result<()> + Send,
    ) -> Result<()> {
        let (Opened { scene, split, .. }, look) = self.open(seen, volume, look, lighting, lists)?;
        let split = split.ok_or_else(|| anyhow!("the volume has no parts"))?;
        let pager = agree(&*self.exchange, Pager::of(scene.whole()).map_err(|e| e.to_string()))?;
        let reader = pager.clone().map(OwnPages);
        let reader = reader.as_ref().map(|reader| reader as &dyn PartReader);
        let cluster = self.cluster(split, backend)?.reading(reader);
        let devices = self.devices(&cluster)?;
        if !self.is_root() {
            return Ok(cluster.help(&scene)?);
        }
        let (orders, queue) = orders();
        let workers =
            SeveralProcesses { orders: orders.clone(), devices: description(&devices), num: devices.len() };
        let volume = scene.whole().clone();
        let own = volume.clone();
        drop(scene);
        std::thread::scope(|scope| {
            let serving = scope.spawn(move || {
                let _end = EndOnDrop(orders);
                serve(volume, look, Backend::Workers(Arc::new(workers)), pager)
            });
            // After a panic, the scope would wait for a server that can no longer show anything.
            match catch_unwind(AssertUnwindSafe(|| cluster.work_on(queue, &own))) {
                Ok(Ok(())) => {}
                Ok(Err(lost)) => self.give_up(&lost),
                Err(_) => self.exchange.abort(),
            }
            serving.join().unwrap_or_else(|_| Err(anyhow!("the server has failed")))
        })
    }

    /// Reads the own part of a volume. If all processes together have no room for it, parts are read by pages.
    fn read(&self, volume: &VolumeArgs, memory: &MemoryArgs) -> Result<(Volume, Split), ClusterError> {
        let exchange = &*self.exchange;
        let (rank, size) = (exchange.rank(), exchange.size());
        let result = |result: Result<_>| agree(exchange, result.map_err(|e| in_one_line(&e)));
        let reading = volume.part.reading();
        let options = OpenOptions { max_bytes: memory.bytes(), by_pages: true, ..volume.options(&reading) };
        // All processes together have room for the whole. Their machines may have different memories.
        let max_bytes = exchange.sum(&[options.max_bytes]).map_err(ClusterError::from)?[0];
        let source = result(volume.source().map(str::to_owned))?;
        let before = outline(&source, &OpenOptions { max_bytes, ..options }).map_err(|e| e.to_string());
        let before = agree(exchange, before)?;
        let Outline { dims, spacing, shown, .. } = &before;
        same_everywhere(exchange, "header of the file", &format!("{dims:?} voxels, {spacing:?} apart"))?;
        if before.pages.is_some() {
            let selection = Selection { level: None, ..options.selection };
            return self.read_by_pages(&source, &OpenOptions { selection, ..options }, *dims);
        }
        let options = OpenOptions { by_pages: false, ..options };
        let split = agree(exchange, Split::evenly(*dims, size).map_err(|e| e.to_string()))?;
        let held = split.held(rank, GHOSTS);
        let &Selection { time, level, series, .. } = shown;
        let chosen = options.selection;
        let region = Some(region_of(chosen.region, &held));
        let whole = Selection { time, level, series, ..chosen };
        let selection = Selection { region, ..whole };
        let part = open(&source, &OpenOptions { selection, ..options }).map_err(|e| e.to_string());
        let part = part.and_then(|part| cut(part, &held, *dims));
        let part = agree(exchange, part)?;
        let known = if rank == 0 && part.finest().is_some() {
            finest_numbers(&source, &OpenOptions { selection: whole, ..options }).unwrap_or_default()
        } else {
            None
        };
        let numbers = |(stored_range, histogram): (_, Arc<Histogram>)| FinestNumbers {
            stored_range,
            histogram: Arc::unwrap_or_clone(histogram),
        };
        let known = known.map(|known| known.into_iter().map(numbers).collect());
        let part = in_whole(exchange, part, &split.boxes()[rank], &held, *dims, known)?;
        Ok((part, split))
    }

    /// Reads the coarsest level. The pages of the own part follow it.
    fn read_by_pages(
        &self,
        source: &str,
        options: &OpenOptions<'_>,
        dims: [u32; 3],
    ) -> Result<(Volume, Split), ClusterError> {
        let exchange = &*self.exchange;
        let found = options.max_bytes;
        let too_little = || {
            let [found, least] = [found, LEAST_FOR_PAGES].map(|bytes| bytes >> 20);
            format!(
                "found {found} MiB for a process that reads pages, expected at least {least} MiB (--max-memory)"
            )
        };
        agree(exchange, if found < LEAST_FOR_PAGES { Err(too_little()) } else { Ok(()) })?;
        let split = Split::between_pages(dims, exchange.size()).map_err(|e| e.to_string());
        let split = agree(exchange, split)?;
        let read = |options: &OpenOptions<'_>| {
            let file = open_paged(source, options).map_err(|e| e.to_string());
            agree(exchange, file.map(|file| file.into_volume(options.max_bytes)))
        };
        let mut volume = read(options)?;
        let numbers = |channel: &Volume| {
            let known = channel.finest().and_then(|finest| finest.histogram.clone());
            format!("{:?} {known:?}", channel.stored_range())
        };
        let mut numbers: Vec<String> = volume.channels().map(numbers).collect();
        // An index may have levels, too.
        numbers.extend(volume.paging().map(|paging| format!("{:?}", paging.source.pyramid().levels)));
        if !are_alike(exchange, &numbers.join("; "))? {
            // Only some have an index of the file.
            volume = read(&OpenOptions { index_folder: None, ..*options })?;
        }
        let own = Some(split.boxes()[exchange.rank()]);
        let paging = volume.paging().map(|paging| Paging { own, ..paging.clone() });
        Ok((paging.into_iter().fold(volume, Volume::with_paging), split))
    }

    /// All processes with their parts. Each marches its own where the backend says, and those of one machine take its
    /// GPUs in turn.
    fn cluster(&self, split: Split, backend: &BackendArgs) -> Result<Cluster<'_>, ClusterError> {
        let marcher = PartRenderer::open(backend.backend, local_rank(self.exchange.rank()));
        let marcher = agree(&*self.exchange, marcher.map_err(|e| e.to_string()))?;
        Ok(Cluster::new(&*self.exchange, split).with_marcher(marcher))
    }

    /// Where each process marches its part.
    fn devices(&self, cluster: &Cluster<'_>) -> Result<Vec<String>, ClusterError> {
        let words: Vec<u32> = cluster.description().chars().map(u32::from).collect();
        let text = |words: &Vec<u32>| words.iter().filter_map(|&word| char::from_u32(word)).collect();
        Ok(self.exchange.all_gather(&words)?.iter().map(text).collect())
    }

    /// The reports of all processes, in process 0.
    fn reports(&self, cluster: &Cluster<'_>, own: &Report) -> Result<Vec<Value>> {
        let devices = self.devices(cluster)?;
        let ms = |time: std::time::Duration| (time.as_secs_f64() * 1e3) as f32;
        let times = [own.counting, own.march, own.exchange, own.merge, own.gather].map(ms).map(f32::to_bits);
        let mut words = times.to_vec();
        words.extend([own.bytes_sent as u32, (own.bytes_sent >> 32) as u32]);
        let all = self.exchange.gather(words).map_err(ClusterError::from)?.unwrap_or_default();
        Ok(all
            .iter()
            .zip(devices)
            .filter_map(|(words, device)| Some((<[u32; 7]>::try_from(words.as_slice()).ok()?, device)))
            .map(|(words, device)| {
                let ms = |i: usize| f32::from_bits(words[i]);
                let bytes = u64::from(words[5]) | u64::from(words[6]) << 32;
                json!({
                    "backend": device, "counting_ms": ms(0), "march_ms": ms(1), "exchange_ms": ms(2), "merge_ms": ms(3),
                    "gather_ms": ms(4), "bytes_sent": bytes,
                })
            })
            .collect())
    }
}

/// The pages of the own part.
struct OwnPages(Pager);

impl PartReader for OwnPages {
    fn pages(&self, key: PlanKey, view: &PageView, scene: &Scene) -> (Arc<PageSet>, PartProgress) {
        let FramePages { set, part, .. } = self.0.pages(ViewerId(key), view, scene);
        (set, part)
    }

    fn progress(&self, key: PlanKey) -> PartProgress {
        self.0.own_progress(key)
    }

    fn viewers(&self) -> Vec<PlanKey> {
        self.0.viewers()
    }

    fn keep(&self, viewers: &[PlanKey]) {
        self.0.forget_others(viewers);
    }

    fn note_others(&self, key: PlanKey, others: PartProgress, in_frame: bool) {
        self.0.note_others(key, others, in_frame);
    }
}

/// The processes as a server sees them.
struct SeveralProcesses {
    orders: Orders,
    devices: String,
    num: usize,
}

impl Workers for SeveralProcesses {
    fn generate(&self, scene: &Scene, header: FrameHeader, wanted: Wanted<'_>) -> Option<FrameElsewhere> {
        let made = self.orders.generate(scene, header, wanted)?;
        let (header, num_segments) = (*made.header(), made.num_segments());
        Some(FrameElsewhere { header, num_segments, rows: Arc::new(RowsOfAll { made, num: self.num }) })
    }

    fn slice(&self, spec: &SliceSpec) -> Option<Slice> {
        self.orders.slice(*spec)
    }

    fn values(&self, asked: AskedPoints) -> Option<FoundPoints> {
        self.orders.values(asked)
    }

    fn render_rows(&self, scene: &Scene, view: &View, rows: Range<u32>) -> Option<Picture> {
        self.orders.render_rows(scene, view, rows)
    }

    fn description(&self) -> String {
        self.devices.clone()
    }
}

/// A frame whose rows lie in `num` processes.
struct RowsOfAll {
    made: FrameOfAll,
    num: usize,
}

impl RowsElsewhere for RowsOfAll {
    fn encode(
        &self,
        header: &FrameHeader,
        mut coding: Coding,
        is_thinned: bool,
        reference: Option<&Arc<Reference>>,
    ) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError> {
        if let Coding::Blocks(settings) = &mut coding {
            // Each process codes at least one band.
            settings.max_bands = settings.max_bands.max(self.num.min(MAX_CHUNKS) as u8);
        }
        self.made.encode(header, coding, is_thinned, reference)
    }

    fn gather(&self) -> Option<LayeredFrame> {
        self.made.gather()
    }
}

/// Where the kernels of several processes run, such as `gpu of 3 and cpu of 1 processes`.
fn description(devices: &[String]) -> String {
    let num = devices.len();
    match devices.iter().filter(|device| device.starts_with("gpu")).count() {
        0 => format!("cpu of {num} processes"),
        gpus if gpus == num => format!("gpu of {num} processes"),
        gpus => format!("gpu of {gpus} and cpu of {} processes", num - gpus),
    }
}

/// The number of a process among those of its machine, as its starter tells it; or else the one among all.
fn local_rank(rank: usize) -> usize {
    let told = LOCAL_RANKS.iter().find_map(|name| std::env::var(name).ok()?.parse().ok());
    told.unwrap_or(rank)
}

/// Where Open MPI, Slurm, MPICH with Hydra, MVAPICH and Cray's PALS tell it.
const LOCAL_RANKS: [&str; 5] = [
    "OMPI_COMM_WORLD_LOCAL_RANK",
    "SLURM_LOCALID",
    "MPI_LOCALRANKID",
    "MV2_COMM_WORLD_LOCAL_RANK",
    "PALS_LOCAL_RANKID",
];

/// Ends the work of all processes when the server has ended, even by a panic.
struct EndOnDrop(Orders);

impl Drop for EndOnDrop {
    fn drop(&mut self) {
        self.0.end();
    }
}

/// A volume with a look, or the own part of one.
pub(crate) struct Opened {
    pub(crate) scene: Scene,
    split: Option<Split>,
    /// Name of the transfer function.
    pub(crate) transfer: String,
}

/// Opens a volume with its look, or the own part of it.
pub(crate) fn open_for(
    together: Option<&Together>,
    seen: &Seen,
    (volume, memory): (&VolumeArgs, &MemoryArgs),
    look: &LookArgs,
    lighting: Lighting,
    lists: &ListArgs,
) -> Result<(Opened, Look)> {
    if let Some(together) = together {
        return together.open(seen, (volume, memory), look, lighting, lists);
    }
    let (OpenedScene { scene, transfer, .. }, look) = seen.open(volume, look, lighting, lists, memory)?;
    Ok((Opened { scene, split: None, transfer: transfer.name }, look))
}

/// The own part of a volume, ready to be drawn with the others.
pub(crate) struct Part<'a> {
    scene: Scene,
    cluster: Cluster<'a>,
    pages: Pages,
    /// Where kernels run.
    devices: String,
}

/// Makes frames and pictures, alone or with the other processes.
pub(crate) enum Drawer<'a> {
    Alone(Box<Renderer>, Backend, Pages),
    Together(&'a Together, Box<Part<'a>>),
}

impl<'a> Drawer<'a> {
    /// Of what was opened. Kernels run where `backend` says.
    pub(crate) fn new(opened: Opened, together: Option<&'a Together>, backend: &BackendArgs) -> Result<Self> {
        Ok(match (together, opened.split) {
            (Some(together), Some(split)) => {
                let cluster = together.cluster(split, backend)?;
                let devices = description(&together.devices(&cluster)?);
                let scene = cluster.ready(opened.scene)?;
                let pages = Pages::of(&scene)?;
                Self::Together(together, Box::new(Part { scene, cluster, pages, devices }))
            }
            _ => {
                let pages = Pages::of(&opened.scene)?;
                let (renderer, backend) = backend.renderer(opened.scene)?;
                Self::Alone(Box::new(renderer), backend, pages)
            }
        })
    }

    /// Where kernels run.
    pub(crate) fn description(&self) -> String {
        match self {
            Self::Alone(_, backend, _) => backend.description(),
            Self::Together(_, part) => part.devices.clone(),
        }
    }

    /// Another volume in the place of the one that is drawn alone, which ends first: both may not fit into memory.
    pub(crate) fn with_volume(self, open: impl FnOnce() -> Result<Scene>) -> Result<Self> {
        let Self::Alone(renderer, backend, pages) = self else { return Ok(self) };
        drop((renderer, pages));
        let scene = open()?;
        let pages = Pages::of(&scene)?;
        Ok(Self::Alone(Box::new(backend.renderer(scene)?), backend, pages))
    }

    /// Reads what a camera sees of a volume that is read by pages. Returns how fine that is.
    pub(crate) fn show(&mut self, camera: &Camera) -> Result<Fineness> {
        match self {
            Self::Alone(renderer, _, pages) => pages.show(renderer, camera),
            Self::Together(together, part) => {
                let own = part.pages.settled(&part.scene.without_pages(), camera);
                let Some(own) = own else { return Ok(Fineness::Whole) };
                part.scene = part.scene.with_pages(own.set, None);
                let progress = part.cluster.progress_of_all(own.part)?;
                check(&progress, together.is_root())
            }
        }
    }

    /// A layered frame, and how each process made its part; nothing but in process 0.
    pub(crate) fn generate(&mut self, header: FrameHeader) -> Result<Option<(LayeredFrame, Vec<Value>)>> {
        match self {
            Self::Alone(renderer, ..) => Ok(Some((renderer.generate(header)?, Vec::new()))),
            Self::Together(together, part) => {
                let (frame, report) = part.cluster.generate(&part.scene, header)?;
                let reports = together.reports(&part.cluster, &report)?;
                Ok(frame.map(|frame| (frame, reports)))
            }
        }
    }

    /// The mean picture of views; empty but in process 0.
    pub(crate) fn render_mean(&mut self, views: &[View]) -> Result<Picture> {
        match self {
            Self::Alone(renderer, ..) => Ok(renderer.render_mean(views)?),
            Self::Together(_, part) => {
                let nothing = |view: &View| Picture::new(view.basis.width as u32, view.basis.height as u32);
                let pictures = views.iter().map(|view| {
                    let made = part.cluster.picture(&part.scene, view, 0..view.basis.height as u32);
                    made.map(|made| made.unwrap_or_else(|| nothing(view)))
                });
                mean_picture(pictures)?.ok_or_else(|| anyhow!("there is no view"))
            }
        }
    }
}

/// The voxels to read of a chosen region, or of all.
fn region_of(chosen: Option<Region>, held: &VoxelBox) -> Region {
    let min = chosen.map_or([0; 3], |region| region.min);
    Region {
        min: [0, 1, 2].map(|axis| min[axis] + held.first[axis]),
        max: [0, 1, 2].map(|axis| Some(min[axis] + held.end[axis])),
    }
}

/// The part of what was read; volumes that are not in a file are made whole.
fn cut(read: Volume, held: &VoxelBox, dims: [u32; 3]) -> Result<Volume, String> {
    if read.dims() == held.dims() {
        return Ok(read);
    }
    if read.dims() == dims {
        return read.part(held).map_err(|e| e.to_string());
    }
    Err(format!("read {:?} voxels, expected {:?} of {dims:?}", read.dims(), held.dims()))
}
