//! Layered frames of a volume whose parts are in several processes.
//!
//! 1. Each process marches the steps of its own part ([`Split::runs`]) and gathers them into at most [`LONGEST`] pieces
//!    a ray ([`pieces`]). Their errors are a fraction of the frame's threshold, so little is lost.
//! 2. Pieces go to the owner of their row, once ([`rows_of`](crate::kernels::rows_of)).
//! 3. The owner takes the pieces of a ray from front to back, in place of steps. It makes the list by the rule of any
//!    other frame ([`unite`]).
//!
//! Crossings of surfaces are sent bare: the owner gives them thickness, for which it needs the next crossing. The
//! threshold comes from the steps of the counted rays ([`steps`]), which are sent whole.

mod devices;
mod forms;
mod rows;

use rayon::prelude::*;

pub use self::devices::{Gathered, OnProcessors, PartMarcher, pieces_by, seen_by, steps_by};
use self::forms::{CrossingForm, Form, GreatestForm, MatterForm, MeanForm, RawStep};
use super::budget::{self, longest_list};
use super::projection::ProjectionLister;
use super::visibility_merge::Counter;
use super::{Listing, SegmentList, clamp_k, close};
use crate::camera::Basis;
use crate::kernels::march::{Lattice, Marcher, Scene, Sink, Step, Texels, with_texels};
use crate::kernels::part_rays::own_steps;
use crate::kernels::part_rows::{self, MAX_ITEMS, PartsError, RowItems};
use crate::layer::{FrameHeader, LayeredFrame};
use crate::mode::Mode;
use crate::volume::Split;

pub use rows::{frame_from_words, frame_of_rows, words_from_rows};

/// A frame that several processes make. All of them ask for the same.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AskedFrame {
    /// `k` is K, and the mode that of the scene.
    header: FrameHeader,
    /// Greatest error of a segment, see [`budget`].
    pub threshold: f32,
}

impl AskedFrame {
    /// A frame with `header.k` segments per list on average, at a threshold.
    pub fn new(scene: &Scene, header: FrameHeader, threshold: f32) -> Self {
        let header = FrameHeader { k: clamp_k(header.k), mode: scene.settings.mode, ..header };
        Self { header, threshold }
    }

    /// What the frame is asked to be.
    pub fn asked(&self) -> &FrameHeader {
        &self.header
    }

    /// The header of the frame: its `k` is the longest possible list.
    fn of_frame(&self) -> FrameHeader {
        FrameHeader { k: longest_list(self.header.k.into()) as u8, ..self.header }
    }

    fn width(&self) -> u32 {
        self.header.camera.intrinsics.width
    }
}

/// The pieces of a process's own part along the rays of `rows`, as words for their owner.
pub fn pieces(scene: &Scene, split: &Split, rank: usize, frame: &AskedFrame, rows: &[u32]) -> Vec<u32> {
    with_texels!(scene, texels => {
        let of = OwnPart { scene, marcher: &Marcher::new(scene, texels), split, rank };
        match scene.settings.mode {
            Mode::Composite => of.write::<MatterForm>(frame, rows),
            Mode::Iso => of.write::<CrossingForm>(frame, rows),
            Mode::Mip | Mode::MinIp => of.write::<GreatestForm>(frame, rows),
            Mode::Average => of.write::<MeanForm>(frame, rows),
        }
    })
}

/// All steps of a process's own part along the counted rays of a frame.
pub fn steps(scene: &Scene, split: &Split, rank: usize, frame: &AskedFrame) -> Vec<u32> {
    with_texels!(scene, texels => {
        let of = OwnPart { scene, marcher: &Marcher::new(scene, texels), split, rank };
        let (columns, rows) = budget::counted_pixels(&frame.header.camera);
        let basis = frame.header.camera.basis();
        part_rows::write(&rows, columns.len() as u32, |column, y, words| {
            let pixel = (columns[column as usize], y);
            of.fill(frame, &basis, pixel, RawStep::WORDS, words, |of, _, words| RawStep::gather(of, words))
        })
    })
}

/// A process's own part of a scene.
struct OwnPart<'a, T> {
    scene: &'a Scene,
    marcher: &'a Marcher<'a, T>,
    split: &'a Split,
    rank: usize,
}

impl<T: Texels> OwnPart<'_, T> {
    fn write<F: Form>(&self, frame: &AskedFrame, rows: &[u32]) -> Vec<u32> {
        let basis = frame.header.camera.basis();
        let threshold = frame.threshold * FINER;
        part_rows::write(rows, frame.width(), |x, y, words| {
            self.fill(frame, &basis, (x, y), F::WORDS, words, |of, whole, words| {
                F::gather(of, whole, threshold, words);
            })
        })
    }

    /// Adds what a ray meets in the part, and returns the number of items.
    fn fill(
        &self,
        frame: &AskedFrame,
        basis: &Basis,
        pixel: (u32, u32),
        words_per_item: usize,
        words: &mut Vec<u32>,
        gather: impl FnOnce(&Listing<'_, T>, &Lattice, &mut Vec<u32>),
    ) -> usize {
        let near = frame.header.camera.near;
        let Some(mut of) = Listing::new(self.scene, self.marcher, basis, near, pixel) else { return 0 };
        let whole = of.lattice;
        let own = own_steps(self.marcher, (self.split, self.rank), &of.ray, whole);
        let Some(own) = own else { return 0 };
        of.lattice = own;
        let before = words.len();
        gather(&of, &whole, words);
        words.truncate(before + MAX_ITEMS * words_per_item);
        (words.len() - before) / words_per_item
    }
}

/// The pieces of a ray from front to back, and what is left over.
struct Along<'a> {
    columns: Vec<Box<dyn FnMut(u32) -> &'a [u32] + 'a>>,
    num_used: Vec<usize>,
}

impl<'a> Along<'a> {
    fn row(rows: &[Vec<RowItems<'a>>], row: usize) -> Self {
        let columns =
            rows.iter().map(|of| -> Box<dyn FnMut(u32) -> &'a [u32] + 'a> { Box::new(of[row].columns()) });
        Self { columns: columns.collect(), num_used: vec![0; rows.len()] }
    }

    /// Hands on the words of each part that a ray meets, from front to back, given all of a column.
    fn take<T: Texels>(
        &mut self,
        of: &Listing<'_, T>,
        split: &Split,
        column: &[&'a [u32]],
        mut each: impl FnMut(&'a [u32]),
    ) {
        let line = of.marcher.point_line(&of.ray, of.lattice);
        split.runs(&line, 0..of.lattice.n, &mut |rank, _| {
            self.num_used[rank] += column[rank].len();
            each(column[rank]);
        });
    }

    fn column(&mut self, x: u32, column: &mut Vec<&'a [u32]>) {
        column.clear();
        column.extend(self.columns.iter_mut().map(|columns| columns(x)));
    }

    /// Whether all that was sent about a row was taken.
    fn check(&self, rows: &[Vec<RowItems<'a>>], row: usize, y: u32, words: usize) -> Result<(), PartsError> {
        for (rank, used) in self.num_used.iter().enumerate() {
            let (found, expected) = (rows[rank][row].num_items(), used / words);
            if found != expected {
                return Err(PartsError::Stray { rank, row: y, found, expected });
            }
        }
        Ok(())
    }
}

/// The lists of `rows`, of which `lists` are the words of each process; one frame a row, whose offsets are the ends of
/// its lists.
///
/// # Errors
/// If one did not send what a process sends about these rows.
pub fn unite(
    scene: &Scene,
    split: &Split,
    frame: &AskedFrame,
    rows: &[u32],
    lists: &[Vec<u32>],
) -> Result<Vec<LayeredFrame>, PartsError> {
    with_texels!(scene, texels => {
        let of = Owner { scene, marcher: &Marcher::new(scene, texels), split };
        match scene.settings.mode {
            Mode::Composite => of.unite::<MatterForm>(frame, rows, lists),
            Mode::Iso => of.unite::<CrossingForm>(frame, rows, lists),
            Mode::Mip | Mode::MinIp => of.unite::<GreatestForm>(frame, rows, lists),
            Mode::Average => of.unite::<MeanForm>(frame, rows, lists),
        }
    })
}

struct Owner<'a, T> {
    scene: &'a Scene,
    marcher: &'a Marcher<'a, T>,
    split: &'a Split,
}

impl<T: Texels> Owner<'_, T> {
    fn unite<F: Form>(
        &self,
        frame: &AskedFrame,
        rows: &[u32],
        lists: &[Vec<u32>],
    ) -> Result<Vec<LayeredFrame>, PartsError> {
        let found =
            part_rows::read_all(lists, self.split.boxes().len(), rows.len(), frame.width(), F::WORDS)?;
        let (camera, header) = (frame.header.camera, frame.of_frame());
        let basis = camera.basis();
        let unite_row = |(row, &y): (usize, &u32)| {
            let mut made =
                LayeredFrame { header, offsets: vec![], depth: vec![], c_rg: vec![], c_b_tau: vec![] };
            let (mut list, mut column) = (SegmentList::default(), Vec::new());
            let mut along = Along::row(&found, row);
            for x in 0..frame.width() {
                along.column(x, &mut column);
                let is_any = column.iter().any(|words| !words.is_empty());
                let of = Listing::new(self.scene, self.marcher, &basis, camera.near, (x, y));
                if let Some(of) = of.filter(|_| is_any) {
                    list.len = 0;
                    let each = |each: &mut dyn FnMut(&[u32])| along.take(&of, self.split, &column, each);
                    F::list(&of, header.k.into(), frame.threshold, each, &mut list);
                    close::list(&camera, header.mode.compositing(), &mut list, of.s_per_depth, |list| {
                        made.extend(list);
                    });
                }
                made.offsets.push(made.depth.len() as u32);
            }
            along.check(&found, row, y, F::WORDS).map(|()| made)
        };
        rows.par_iter().enumerate().map(unite_row).collect()
    }
}

/// The threshold of a frame, from the steps that each process found ([`steps`]).
///
/// # Errors
/// If one did not send the steps of the counted rays.
pub fn threshold(
    scene: &Scene,
    split: &Split,
    frame: &AskedFrame,
    lists: &[Vec<u32>],
) -> Result<f32, PartsError> {
    with_texels!(scene, texels => {
        let of = Owner { scene, marcher: &Marcher::new(scene, texels), split };
        of.threshold(frame, lists)
    })
}

impl<T: Texels> Owner<'_, T> {
    fn threshold(&self, frame: &AskedFrame, lists: &[Vec<u32>]) -> Result<f32, PartsError> {
        let asked = &frame.header;
        let (columns, rows) = budget::counted_pixels(&asked.camera);
        let (width, words) = (columns.len() as u32, RawStep::WORDS);
        let found = part_rows::read_all(lists, self.split.boxes().len(), rows.len(), width, words)?;
        let basis = asked.camera.basis();
        let steps_of_row = |(row, &y): (usize, &u32)| {
            let (mut along, mut column) = (Along::row(&found, row), Vec::new());
            let mut rays = Vec::with_capacity(columns.len());
            for (at, &x) in columns.iter().enumerate() {
                along.column(at as u32, &mut column);
                let mut steps = Vec::new();
                if let Some(of) = Listing::new(self.scene, self.marcher, &basis, asked.camera.near, (x, y)) {
                    along.take(&of, self.split, &column, |words| steps.extend(RawStep::steps(words)));
                }
                rays.push(steps);
            }
            along.check(&found, row, y, words).map(|()| rays)
        };
        let rays = rows.par_iter().enumerate().map(steps_of_row).collect::<Result<Vec<_>, _>>()?;
        let longest = longest_list(asked.k.into());
        Ok(budget::count_by(asked, |(x, y), thresholds| {
            let of = Listing::new(self.scene, self.marcher, &basis, asked.camera.near, (x, y))?;
            let (row, column) = (rows.binary_search(&y).ok()?, columns.binary_search(&x).ok()?);
            let steps = &rays[row][column];
            let mut unused = SegmentList::default();
            Some(match self.scene.settings.mode {
                Mode::Composite => {
                    let mut counter = Counter::new(thresholds, longest, &of.lattice);
                    hand_on(steps, &mut counter);
                    counter.finish()
                }
                Mode::Iso => {
                    let mut counter = Counter::new(thresholds, longest, &of.lattice);
                    let mut thicken = self.marcher.thicken(of.lattice, &mut counter);
                    hand_on(steps, &mut thicken);
                    thicken.finish();
                    counter.finish()
                }
                Mode::Mip | Mode::MinIp | Mode::Average => {
                    let mut counter = ProjectionLister::new(&of, *thresholds, longest, &mut unused);
                    hand_on(steps, &mut counter);
                    counter.count()
                }
            })
        }))
    }
}

fn hand_on(steps: &[Step], sink: &mut impl Sink) {
    for step in steps {
        sink.step(*step);
    }
}

/// Most pieces of a ray in one part.
pub const LONGEST: usize = 32;
/// Greatest error of a piece, as a share of the frame's threshold. With a half, novel views of a scan are up to .15 dB
/// worse than those of one process, and two thirds as much is sent.
const FINER: f32 = 0.1;
