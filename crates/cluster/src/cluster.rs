//! Processes that make frames and pictures together.

use std::time::{Duration, Instant};

use isinglass_core::kernels::layering::parts::{
    AskedFrame, frame_from_words, pieces, steps, threshold, unite, words_from_rows,
};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::Scene;
use isinglass_core::kernels::{part_pictures, rows_of};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;
use isinglass_core::volume::{Split, VoxelBox};

use crate::exchange::{ClusterError, Exchange};

/// The processes that hold the parts of a volume, as one of them sees it.
pub struct Cluster<'a> {
    exchange: &'a dyn Exchange,
    split: Split,
}

/// Where the time of a frame went in this process.
#[derive(Clone, Copy, Debug, Default)]
pub struct Report {
    /// Finding the threshold.
    pub counting: Duration,
    /// Marching the own part.
    pub march: Duration,
    /// Sending pieces, and waiting for those of others.
    pub exchange: Duration,
    /// Making lists of pieces.
    pub merge: Duration,
    /// Gathering the lists in process 0.
    pub gather: Duration,
    /// Bytes of pieces that this process has sent to others.
    pub bytes_sent: u64,
}

impl<'a> Cluster<'a> {
    /// The processes of an exchange, one for each box of `split`.
    pub fn new(exchange: &'a dyn Exchange, split: Split) -> Self {
        Self { exchange, split }
    }

    /// The number of this process.
    pub fn rank(&self) -> usize {
        self.exchange.rank()
    }

    /// The box of this process.
    pub fn own(&self) -> &VoxelBox {
        &self.split.boxes()[self.rank()]
    }

    /// The scene of the own part, with what depends on the others.
    ///
    /// # Errors
    /// If the processes cannot talk.
    pub fn ready(&self, scene: Scene) -> Result<Scene, ClusterError> {
        let areas = scene.areas_of_bodies(self.own());
        let [above, all] = areas.unwrap_or_default().map(f64::to_bits);
        let words = self.exchange.all_gather(&[above as u32, (above >> 32) as u32])?;
        let number = |words: &Vec<u32>| match words[..] {
            [low, high] => f64::from_bits(u64::from(low) | u64::from(high) << 32),
            _ => 0.0,
        };
        let above = words.iter().map(number).sum();
        Ok(if areas.is_some() { scene.with_areas_of_bodies([above, f64::from_bits(all)]) } else { scene })
    }

    /// A layered frame with `header.k` segments per list on average, in process 0.
    ///
    /// # Errors
    /// If the processes cannot talk, or one sends something else than expected.
    pub fn generate(
        &self,
        scene: &Scene,
        header: FrameHeader,
    ) -> Result<(Option<LayeredFrame>, Report), ClusterError> {
        let (exchange, split, rank) = (self.exchange, &self.split, self.rank());
        let mut report = Report::default();
        let mut watch = Stopwatch::start();
        let mut frame = AskedFrame::new(scene, header, 0.0);
        let found = exchange.gather(steps(scene, split, rank, &frame))?;
        let found = found.map(|lists| threshold(scene, split, &frame, &lists)).transpose()?;
        let told = exchange.broadcast(vec![found.unwrap_or(0.0).to_bits()])?;
        frame.threshold = told.first().map_or(0.0, |bits| f32::from_bits(*bits));
        report.counting = watch.lap();
        let (size, height) = (exchange.size(), header.camera.intrinsics.height);
        let to = |owner| pieces(scene, split, rank, &frame, &rows_of(owner, size, height));
        let words: Vec<Vec<u32>> = (0..size).map(to).collect();
        let others = words.iter().enumerate().filter(|(owner, _)| *owner != rank);
        report.bytes_sent = others.map(|(_, words)| words.len() as u64 * 4).sum();
        report.march = watch.lap();
        let lists = exchange.all_to_all(words)?;
        report.exchange = watch.lap();
        let rows = unite(scene, split, &frame, &rows_of(rank, size, height), &lists)?;
        report.merge = watch.lap();
        let all = exchange.gather(words_from_rows(&rows))?;
        let made = all.map(|words| frame_from_words(&frame, &words)).transpose()?;
        report.gather = watch.lap();
        Ok((made, report))
    }

    /// The picture of a view by full volume rendering, premultiplied linear, in process 0.
    ///
    /// # Errors
    /// If the processes cannot talk, or one sends something else than expected.
    pub fn picture(&self, scene: &Scene, view: &View) -> Result<Option<Picture>, ClusterError> {
        let words = part_pictures::seen(scene, &self.split, self.rank(), view);
        let lists = self.exchange.gather(words)?;
        Ok(lists
            .map(|lists| part_pictures::picture_of_parts(scene, &self.split, view, &lists))
            .transpose()?)
    }
}

/// Time from one part of the work to the next.
struct Stopwatch(Instant);

impl Stopwatch {
    fn start() -> Self {
        Self(Instant::now())
    }

    fn lap(&mut self) -> Duration {
        let now = Instant::now();
        now - std::mem::replace(&mut self.0, now)
    }
}
