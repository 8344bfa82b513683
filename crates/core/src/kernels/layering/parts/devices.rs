//! Who marches a process's own part: its processors, or a device that gathers along rays.
//!
//! A device does what [`super::forms`] does for each ray. Here is what is around that: which rays, and whose words.

use std::ops::Range;

use rayon::prelude::*;

use super::super::budget;
use super::forms::{CrossingForm, Form, GreatestForm, MatterForm, MeanForm, RawStep};
use super::{AskedFrame, FINER, LONGEST, pieces, steps};
use crate::kernels::lens::View;
use crate::kernels::part_pictures::{self, seen};
use crate::kernels::part_rays::{MarchedPart, PartRay, PartRays, RayItems};
use crate::mode::Mode;

/// Marches a process's own part of a volume. What it sends is the same whoever does it, but for rounding.
pub trait PartMarcher {
    /// For each owner of rows its words: see [`pieces`].
    fn pieces(&self, part: &MarchedPart<'_>, frame: &AskedFrame, rows: &[&[u32]]) -> Vec<Vec<u32>> {
        let of_owner = |rows: &&[u32]| pieces(part.scene, part.split, part.rank, frame, rows);
        rows.par_iter().map(of_owner).collect()
    }

    /// See [`steps`].
    fn steps(&self, part: &MarchedPart<'_>, frame: &AskedFrame) -> Vec<u32> {
        steps(part.scene, part.split, part.rank, frame)
    }

    /// See [`seen`].
    fn seen(&self, part: &MarchedPart<'_>, view: &View, rows: Range<u32>) -> Vec<u32> {
        seen(part.scene, part.split, part.rank, view, rows)
    }

    /// Where it marches, such as `cpu`.
    fn description(&self) -> String {
        "cpu".into()
    }
}

/// The processors of this process.
#[derive(Clone, Copy, Debug, Default)]
pub struct OnProcessors;

impl PartMarcher for OnProcessors {}

/// What a device gathers along rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Gathered {
    /// Pieces of matter or of a projection, of at most this error; crossings of surfaces.
    Pieces(f32),
    /// All steps or crossings.
    Steps,
    /// Of each ray one item: premultiplied colour and transmittance, or what a projection collects.
    Seen,
}

impl Gathered {
    /// Words of an item.
    pub fn words_per_item(self, mode: Mode) -> usize {
        match (self, mode) {
            (Self::Pieces(_), Mode::Composite) => MatterForm::WORDS,
            (Self::Pieces(_), Mode::Iso) => CrossingForm::WORDS,
            (Self::Pieces(_), Mode::Mip | Mode::MinIp) => GreatestForm::WORDS,
            (Self::Pieces(_), Mode::Average) => MeanForm::WORDS,
            (Self::Steps, _) => RawStep::WORDS,
            (Self::Seen, _) => part_pictures::WORDS,
        }
    }

    /// Items that most rays have room for.
    pub fn usual_items(self) -> usize {
        match self {
            Self::Pieces(_) => LONGEST,
            Self::Steps => USUAL_STEPS,
            Self::Seen => 1,
        }
    }
}

/// The words of [`pieces`] for each owner, by a device that gathers along the rays of a view.
///
/// # Errors
/// That of the device.
pub fn pieces_by<E>(
    part: &MarchedPart<'_>,
    frame: &AskedFrame,
    rows: &[&[u32]],
    gather: impl FnOnce(&View, &[PartRay], Gathered) -> Result<RayItems, E>,
) -> Result<Vec<Vec<u32>>, E> {
    let view = View::from(&frame.header.camera);
    let columns: Vec<u32> = (0..frame.width()).collect();
    let found = PartRays::of(part, &view, &columns, &rows.concat());
    let items = gather(&view, found.rays(), Gathered::Pieces(frame.threshold * FINER))?;
    let mut first = 0;
    let words = rows.iter().map(|rows| {
        let words = found.words_of_rows(first, rows.len(), &items);
        first += rows.len();
        words
    });
    Ok(words.collect())
}

/// The words of [`steps`], by a device.
///
/// # Errors
/// That of the device.
pub fn steps_by<E>(
    part: &MarchedPart<'_>,
    frame: &AskedFrame,
    gather: impl FnOnce(&View, &[PartRay], Gathered) -> Result<RayItems, E>,
) -> Result<Vec<u32>, E> {
    let (columns, rows) = budget::counted_pixels(&frame.header.camera);
    let view = View::from(&frame.header.camera);
    let found = PartRays::of(part, &view, &columns, &rows);
    Ok(found.words(&gather(&view, found.rays(), Gathered::Steps)?))
}

/// The words of [`seen`], by a device.
///
/// # Errors
/// That of the device.
pub fn seen_by<E>(
    part: &MarchedPart<'_>,
    view: &View,
    rows: Range<u32>,
    gather: impl FnOnce(&View, &[PartRay], Gathered) -> Result<RayItems, E>,
) -> Result<Vec<u32>, E> {
    let columns: Vec<u32> = (0..view.basis.width as u32).collect();
    let found = PartRays::of(part, view, &columns, &rows.collect::<Vec<_>>());
    Ok(found.words(&gather(view, found.rays(), Gathered::Seen)?))
}

/// Steps in a part that few rays exceed.
const USUAL_STEPS: usize = 128;
