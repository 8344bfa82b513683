//! Processes that make frames and pictures together.

use std::ops::Range;
use std::time::{Duration, Instant};

use isinglass_core::kernels::layering::parts::{
    AskedFrame, OnProcessors, PartMarcher, frame_from_words, frame_of_rows, threshold, unite, words_from_rows,
};
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::Scene;
use isinglass_core::kernels::part_rays::MarchedPart;
use isinglass_core::kernels::{ROWS_IN_BLOCK, part_pictures, rows_of};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;
use isinglass_core::volume::{Split, VoxelBox};

use crate::exchange::{ClusterError, Exchange};
use crate::pages::PartReader;

/// The processes that hold the parts of a volume, as one of them sees it.
pub struct Cluster<'a> {
    exchange: &'a dyn Exchange,
    split: Split,
    /// Reads the pages of the own part, if the volume is read by pages.
    pub(crate) reader: Option<&'a dyn PartReader>,
    marcher: Box<dyn PartMarcher + 'a>,
}

/// The rows of a frame that this process has made.
#[derive(Clone, Debug)]
pub(crate) struct OwnRows {
    /// The frame, whose other rows are empty.
    pub(crate) rows: LayeredFrame,
    /// Segments of the whole frame, and lists that have any.
    pub(crate) num_segments: u64,
    pub(crate) num_filled: u64,
}

/// Where the time of a frame went in this process.
#[derive(Clone, Copy, Debug, Default)]
pub struct Report {
    /// Greatest error of a segment.
    pub threshold: f32,
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
        Self { exchange, split, marcher: Box::new(OnProcessors), reader: None }
    }

    /// The same for a volume that is read by pages.
    #[must_use]
    pub fn reading(self, reader: Option<&'a dyn PartReader>) -> Self {
        Self { reader, ..self }
    }

    /// The same with another way to march the own part.
    #[must_use]
    pub fn with_marcher(self, marcher: impl PartMarcher + 'a) -> Self {
        Self { marcher: Box::new(marcher), ..self }
    }

    /// Where the own part is marched.
    pub fn description(&self) -> String {
        self.marcher.description()
    }

    fn part<'s>(&'s self, scene: &'s Scene) -> MarchedPart<'s> {
        MarchedPart { scene, split: &self.split, rank: self.rank() }
    }

    pub(crate) fn exchange(&self) -> &dyn Exchange {
        self.exchange
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
        if scene.whole().paging().is_some() {
            // Everybody has all of the coarsest level, on which this rests.
            return Ok(scene);
        }
        let areas = scene.areas_of_bodies(self.own());
        let [above, all] = areas.unwrap_or_default().map(f64::to_bits);
        let words = self.exchange.all_gather(&[above as u32, (above >> 32) as u32])?;
        let number = |words: &Vec<u32>| match words[..] {
            [low, high] => f64::from_bits(u64::from(low) | u64::from(high) << 32),
            _ => 0.0,
        };
        let above = words.iter().map(number).sum();
        let scene =
            if areas.is_some() { scene.with_areas_of_bodies([above, f64::from_bits(all)]) } else { scene };
        // All scenes have one look, so all of them wait for light or none does.
        let Some(cells) = scene.own_cells_of_light(self.own()) else { return Ok(scene) };
        let cells = self.exchange.all_gather(&cells)?;
        Ok(scene.lit_by_cells(self.split.boxes(), &cells)?)
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
        let (rows, mut report) = self.rows_while(scene, header, None, &mut || Ok(true))?;
        let mut watch = Stopwatch::start();
        let made = rows.map(|rows| self.gather(&rows)).transpose()?.flatten();
        report.gather = watch.lap();
        Ok((made, report))
    }

    /// The whole of a frame, in process 0.
    pub(crate) fn gather(&self, own: &OwnRows) -> Result<Option<LayeredFrame>, ClusterError> {
        let (size, height) = (self.exchange.size(), own.rows.header.camera.intrinsics.height);
        let rows: Vec<Vec<u32>> = (0..size).map(|owner| rows_of(owner, size, height)).collect();
        let all = self.exchange.gather(words_from_rows(&own.rows, &rows[self.rank()]))?;
        Ok(all.map(|words| frame_from_words(own.rows.header, &rows, &words)).transpose()?)
    }

    /// The rows of a frame that this process makes, at a threshold if one is known. After each slice of rows, all ask
    /// whether it goes on, and all get the same answer.
    pub(crate) fn rows_while(
        &self,
        scene: &Scene,
        header: FrameHeader,
        known_threshold: Option<f32>,
        goes_on: &mut dyn FnMut() -> Result<bool, ClusterError>,
    ) -> Result<(Option<OwnRows>, Report), ClusterError> {
        let (exchange, split, rank) = (self.exchange, &self.split, self.rank());
        let (size, height) = (exchange.size(), header.camera.intrinsics.height);
        let mut report = Report::default();
        let mut watch = Stopwatch::start();
        let mut frame = AskedFrame::new(scene, header, 0.0);
        frame.threshold = match known_threshold {
            Some(threshold) => threshold,
            None => self.counted_threshold(scene, &frame)?,
        };
        (report.threshold, report.counting) = (frame.threshold, watch.lap());
        let rows: Vec<Vec<u32>> = (0..size).map(|owner| rows_of(owner, size, height)).collect();
        let mut words = vec![Vec::new(); size];
        for slice in slices(height, size) {
            let of_slice: Vec<&[u32]> = rows.iter().map(|rows| rows_within(rows, &slice)).collect();
            let found = self.marcher.pieces(&self.part(scene), &frame, &of_slice);
            words.iter_mut().zip(found).for_each(|(words, mut found)| words.append(&mut found));
            if !goes_on()? {
                return Ok((None, report));
            }
        }
        let others = words.iter().enumerate().filter(|(owner, _)| *owner != rank);
        report.bytes_sent = others.map(|(_, words)| words.len() as u64 * 4).sum();
        report.march = watch.lap();
        let lists = exchange.all_to_all(words)?;
        report.exchange = watch.lap();
        let made = unite(scene, split, &frame, &rows[rank], &lists)?;
        let rows = frame_of_rows(&frame, &rows[rank], made);
        let spent = exchange.sum(&[rows.num_segments() as u64, rows.num_filled() as u64])?;
        report.merge = watch.lap();
        Ok((Some(OwnRows { rows, num_segments: spent[0], num_filled: spent[1] }), report))
    }

    /// The threshold of a frame, by the steps of its counted rays.
    fn counted_threshold(&self, scene: &Scene, frame: &AskedFrame) -> Result<f32, ClusterError> {
        let found = self.exchange.gather(self.marcher.steps(&self.part(scene), frame))?;
        let found = found.map(|lists| threshold(scene, &self.split, frame, &lists)).transpose()?;
        let told = self.exchange.broadcast(vec![found.unwrap_or(0.0).to_bits()])?;
        Ok(told.first().map_or(0.0, |bits| f32::from_bits(*bits)))
    }

    /// Some rows of the picture of a view by full volume rendering, premultiplied linear, in process 0.
    ///
    /// # Errors
    /// If the processes cannot talk, or one sends something else than expected.
    pub fn picture(
        &self,
        scene: &Scene,
        view: &View,
        rows: Range<u32>,
    ) -> Result<Option<Picture>, ClusterError> {
        let words = self.marcher.seen(&self.part(scene), view, rows.clone());
        let lists = self.exchange.gather(words)?;
        let unite = |lists: Vec<_>| part_pictures::picture_of_parts(scene, &self.split, view, rows, &lists);
        Ok(lists.map(unite).transpose()?)
    }
}

/// Those of ascending rows that lie in a slice.
fn rows_within<'r>(rows: &'r [u32], slice: &Range<u32>) -> &'r [u32] {
    let [from, to] = [slice.start, slice.end].map(|row| rows.partition_point(|r| *r < row));
    &rows[from..to]
}

/// The rows of a picture in slices, of which each process owns some.
fn slices(height: u32, size: usize) -> impl Iterator<Item = Range<u32>> {
    let turn = u32::try_from(size).unwrap_or(u32::MAX).saturating_mul(ROWS_IN_BLOCK).max(1);
    let rows = LEAST_ROWS.next_multiple_of(turn);
    (0..height.div_ceil(rows)).map(move |i| i * rows..((i + 1) * rows).min(height))
}

/// Fewest rows of a slice.
const LEAST_ROWS: u32 = 32;

/// Time from one part of the work to the next.
pub(crate) struct Stopwatch(Instant);

impl Stopwatch {
    pub(crate) fn start() -> Self {
        Self(Instant::now())
    }

    pub(crate) fn lap(&mut self) -> Duration {
        let now = Instant::now();
        now - std::mem::replace(&mut self.0, now)
    }
}
