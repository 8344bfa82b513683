//! A frame whose rows are made bit by bit, so that other work can go between them, and within a number of segments.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::budget::{self, Budget};
use super::{Listing, SegmentList, clamp_k, close};
use crate::camera::Intrinsics;
use crate::cancel::Wanted;
use crate::kernels::march::{Marcher, Scene, Texels, with_texels};
use crate::layer::{FrameHeader, LayeredFrame};

/// A frame in the making. How often it is interrupted does not change it.
#[derive(Clone, Debug)]
pub struct UnfinishedFrame {
    /// `k` is K.
    asked: FrameHeader,
    threshold: Option<f32>,
    rows: Vec<LayeredFrame>,
    num_segments: usize,
}

/// How far a frame is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Making {
    /// Rows are missing.
    Unfinished,
    /// All rows are there.
    Whole,
    /// The rows so far have more segments than they may.
    TooLarge,
}

impl UnfinishedFrame {
    /// A frame of a scene, without any rows yet.
    pub fn new(scene: &Scene, header: FrameHeader) -> Self {
        let asked = FrameHeader { k: clamp_k(header.k), mode: scene.settings.mode, ..header };
        Self { asked, threshold: None, rows: Vec::new(), num_segments: 0 }
    }

    /// Makes rows while `goes_on`, at least one. `scene` is always the same one, and the first call takes its
    /// threshold from `budget`.
    pub fn advance(
        &mut self,
        scene: &Scene,
        budget: &Budget,
        max_segments: usize,
        goes_on: Wanted<'_>,
    ) -> Making {
        with_texels!(scene, texels => {
            self.advance_with(scene, &Marcher::new(scene, texels), budget, max_segments, goes_on)
        })
    }

    fn advance_with<T: Texels>(
        &mut self,
        scene: &Scene,
        marcher: &Marcher<'_, T>,
        budget: &Budget,
        max_segments: usize,
        goes_on: Wanted<'_>,
    ) -> Making {
        let asked = self.asked;
        let threshold = *self.threshold.get_or_insert_with(|| {
            let known = budget.threshold(&asked, scene.volume.bounds().radius());
            known.unwrap_or_else(|| budget::count(scene, marcher, &asked))
        });
        let header = self.header();
        let longest = usize::from(header.k);
        let room = max_segments.saturating_sub(self.num_segments);
        let first = self.rows.len() as u32;
        let list = |of: &Listing<'_, T>, list: &mut SegmentList| of.list(longest, threshold, list);
        self.rows.extend(rows_of_lists(scene, marcher, header, first, (room, goes_on), list));
        let new = &self.rows[first as usize..];
        self.num_segments += new.iter().map(LayeredFrame::num_segments).sum::<usize>();
        match self.rows.len() as u32 == header.camera.intrinsics.height {
            _ if self.num_segments > max_segments => Making::TooLarge,
            true => Making::Whole,
            false => Making::Unfinished,
        }
    }

    /// The header of the frame: its `k` is the longest possible list.
    fn header(&self) -> FrameHeader {
        FrameHeader { k: budget::longest_list(self.asked.k.into()) as u8, ..self.asked }
    }

    /// The number of segments that the frame will have if all rows are like the present ones; 0 before the first.
    pub fn expected_segments(&self) -> usize {
        let height = self.asked.camera.intrinsics.height as usize;
        (self.num_segments as f64 * height as f64 / self.rows.len().max(1) as f64) as usize
    }

    /// The whole frame, and what it tells `budget` about the next one. Rows that are missing are empty.
    pub fn finish(self, budget: &mut Budget) -> LayeredFrame {
        let frame = join_rows(self.header(), self.rows);
        budget.note(&self.asked, self.threshold.unwrap_or(f32::NAN), &frame);
        frame
    }
}

/// The lists of rows from `first` on, see [`take_rows`].
pub(super) fn rows_of_lists<T: Texels>(
    scene: &Scene,
    marcher: &Marcher<'_, T>,
    header: FrameHeader,
    first: u32,
    limits: (usize, Wanted<'_>),
    fill: impl Fn(&Listing<'_, T>, &mut SegmentList) + Sync,
) -> Vec<LayeredFrame> {
    let camera = header.camera;
    let basis = camera.basis();
    take_rows(header, first, limits, |y, row| {
        let mut list = SegmentList::default();
        for x in 0..camera.intrinsics.width {
            if let Some(of) = Listing::new(scene, marcher, &basis, camera.near, (x, y)) {
                list.len = 0;
                fill(&of, &mut list);
                close::list(&camera, header.mode.compositing(), &mut list, of.s_per_depth, |list| {
                    row.extend(list);
                });
            }
            row.offsets.push(row.depth.len() as u32);
        }
    })
}

/// Rows from `first` on, made in parallel by `fill` while `goes_on` and while they have at most `most` segments; at
/// least one. They follow each other without a gap.
fn take_rows(
    header: FrameHeader,
    first: u32,
    (most, goes_on): (usize, Wanted<'_>),
    fill: impl Fn(u32, &mut LayeredFrame) + Sync,
) -> Vec<LayeredFrame> {
    let height = header.camera.intrinsics.height;
    let (next, num_segments, has_begun) =
        (AtomicU32::new(first), AtomicUsize::new(0), AtomicBool::new(false));
    let made = Mutex::new(Vec::new());
    let lock = || made.lock().unwrap_or_else(PoisonError::into_inner);
    let work = || {
        let mut row = LayeredFrame { header, offsets: vec![], depth: vec![], c_rg: vec![], c_b_tau: vec![] };
        while !has_begun.swap(true, Ordering::Relaxed)
            || (num_segments.load(Ordering::Relaxed) <= most && goes_on())
        {
            // Whoever takes a row finishes it.
            let y = next.fetch_add(1, Ordering::Relaxed);
            if y >= height {
                break;
            }
            let LayeredFrame { offsets, depth, c_rg, c_b_tau, .. } = &mut row;
            [offsets, depth, c_rg, c_b_tau].into_iter().for_each(Vec::clear);
            fill(y, &mut row);
            num_segments.fetch_add(row.num_segments(), Ordering::Relaxed);
            // A copy takes no more memory than it needs.
            lock().push((y, row.clone()));
        }
    };
    rayon::scope(|scope| (0..rayon::current_num_threads()).for_each(|_| scope.spawn(|_| work())));
    let mut made = made.into_inner().unwrap_or_else(PoisonError::into_inner);
    made.sort_unstable_by_key(|(y, _)| *y);
    made.into_iter().map(|(_, row)| row).collect()
}

/// Collects the rows that `fill` makes in parallel: it pushes the segments and the end of each list of row `y`.
/// Returns `None` as soon as the frame is no longer wanted.
pub fn gather_rows(
    header: FrameHeader,
    wanted: Wanted<'_>,
    fill: impl Fn(u32, &mut LayeredFrame) + Sync,
) -> Option<LayeredFrame> {
    whole(header, || take_rows(header, 0, (usize::MAX, wanted), fill), wanted)
}

/// The frame of the rows that `make` returns, unless rows are missing or nobody wants it.
pub(super) fn whole(
    header: FrameHeader,
    make: impl FnOnce() -> Vec<LayeredFrame>,
    wanted: Wanted<'_>,
) -> Option<LayeredFrame> {
    let rows = if wanted() { make() } else { return None };
    let is_whole = rows.len() as u32 == header.camera.intrinsics.height;
    is_whole.then(|| join_rows(header, rows))
}

/// The frame with these rows from the top.
pub(super) fn join_rows(header: FrameHeader, rows: Vec<LayeredFrame>) -> LayeredFrame {
    let Intrinsics { width, .. } = header.camera.intrinsics;
    let total = rows.iter().map(LayeredFrame::num_segments).sum();
    let mut frame = LayeredFrame {
        depth: vec![0; total],
        c_rg: vec![0; total],
        c_b_tau: vec![0; total],
        ..LayeredFrame::empty(header)
    };
    // Fresh memory arrives page by page, which takes longer than copying, so this runs in parallel too.
    let (mut depth, mut c_rg, mut c_b_tau) =
        (&mut frame.depth[..], &mut frame.c_rg[..], &mut frame.c_b_tau[..]);
    let mut first = 0;
    let mut places = Vec::with_capacity(rows.len());
    for (row, offsets) in rows.into_iter().zip(frame.offsets[1..].chunks_mut(width as usize)) {
        let num = row.num_segments();
        let planes = [&mut depth, &mut c_rg, &mut c_b_tau].map(|plane| {
            let (own, rest) = std::mem::take(plane).split_at_mut(num);
            *plane = rest;
            own
        });
        places.push((row, first, offsets, planes));
        first += num as u32;
    }
    places.into_par_iter().for_each(|(row, first, offsets, [depth, c_rg, c_b_tau])| {
        for (offset, in_row) in offsets.iter_mut().zip(&row.offsets) {
            *offset = first + in_row;
        }
        depth.copy_from_slice(&row.depth);
        c_rg.copy_from_slice(&row.c_rg);
        c_b_tau.copy_from_slice(&row.c_b_tau);
    });
    frame
}
