//! Choosing layers for the lists of a band, and coding them.

use super::super::{CodecError, MAX_CHUNK_SEGMENTS};
use super::band::{Band, Planes};
use super::chunk::Head;
use super::coding::{BandCoder, Origin, Place, Plan, Source};
use super::entropy::Encoder;
use super::model::{BLOCK, BLOCK_LISTS, BlockLayer};
use super::motion::Motion;
use super::picture::{self, composite_roots};
use super::reference::Reference;
use super::relayer::{BlockLists, Relayer, Rule};
use super::scales::ycc_from_roots;
use super::steps::Steps;
use super::transform::Plane;
use crate::layer::{LayeredFrame, Over};

/// An encoded band.
pub(super) struct EncodedBand {
    pub(super) base: Vec<u8>,
    /// If they are apart.
    pub(super) corrections: Option<Vec<u8>>,
    /// What a decoder makes of both.
    pub(super) decoded: Band,
}

/// Encodes a band of a valid frame.
pub(super) fn band(
    frame: &LayeredFrame,
    place: Place,
    rule: Rule,
    head: &Head,
    reference: Option<(&Reference, Motion)>,
) -> Result<EncodedBand, CodecError> {
    let steps = head.steps;
    let mut layering = Layering::new(frame, place, rule, steps, reference);
    let coder = BandCoder::new(Encoder::new(), steps, place, reference);
    let (coder, mut decoded, origins) = coder.run(&mut layering, MAX_CHUNK_SEGMENTS)?;
    if !head.has_corrections(&decoded) {
        return Ok(EncodedBand { base: coder.finish(), corrections: None, decoded });
    }
    let source = |block: usize, planes: &mut [Plane; 3]| {
        // A block of the reference has its corrections in it.
        let is_corrected = origins[block] == Origin::Copied || !decoded.has_matter(block);
        let at = [block % place.across, block / place.across + place.first_row];
        if is_corrected { 0 } else { miss(frame, at, &decoded, block, planes) }
    };
    let (base, coder) = if head.is_split { (Some(coder.finish()), Encoder::new()) } else { (None, coder) };
    let (coder, corrections) = picture::code(coder, &steps, place, source)?;
    let last = coder.finish();
    corrections.apply(&mut decoded);
    let (base, corrections) = match base {
        Some(base) => (base, Some(last)),
        None => (last, None),
    };
    Ok(EncodedBand { base, corrections, decoded })
}

/// By how much the lists of a block, at column and row `at` of the frame's blocks, composite to too little, as roots;
/// and which are in the frame and have matter in the band.
fn miss(frame: &LayeredFrame, at: [usize; 2], band: &Band, block: usize, planes: &mut [Plane; 3]) -> u64 {
    let intrinsics = frame.header.camera.intrinsics;
    let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
    let mut mask = 0;
    for i in 0..BLOCK_LISTS {
        let (x, y) = (at[0] * BLOCK + i % BLOCK, at[1] * BLOCK + i / BLOCK);
        let cells = &band.cells[band.list(block, i)];
        planes.iter_mut().for_each(|plane| plane[i] = 0.0);
        if x >= width || y >= height {
            continue;
        }
        mask |= u64::from(!cells.is_empty()) << i;
        let mut over = Over::default();
        for segment in frame.list(y * width + x) {
            let segment = frame.segment(segment);
            over.add(segment.c, segment.tau);
        }
        let found = composite_roots(cells);
        let wanted = over.c.to_array().map(|c| c.max(0.0).sqrt());
        let ycc = ycc_from_roots(std::array::from_fn(|c| wanted[c] - found[c]));
        for (plane, value) in planes.iter_mut().zip(ycc) {
            plane[i] = value;
        }
    }
    mask
}

/// Finds layers for blocks.
struct Layering<'a> {
    frame: &'a LayeredFrame,
    place: Place,
    rule: Rule,
    steps: Steps,
    reference: Option<(&'a Reference, Motion)>,
    relayer: Relayer,
    lists: BlockLists,
    planes: Vec<Planes>,
    layers: Vec<BlockLayer>,
}

impl<'a> Layering<'a> {
    fn new(
        frame: &'a LayeredFrame,
        place: Place,
        rule: Rule,
        steps: Steps,
        reference: Option<(&'a Reference, Motion)>,
    ) -> Self {
        Self {
            frame,
            place,
            rule,
            steps,
            reference,
            relayer: Relayer::default(),
            lists: BlockLists::default(),
            planes: Vec::new(),
            layers: Vec::new(),
        }
    }

    /// Whether the reference, from the same camera and no coarser, shows the block as well as it could be coded.
    fn is_same(&self, x: usize, y: usize) -> bool {
        let Some((reference, motion)) = self.reference else { return false };
        let is_fine =
            reference.steps.is_some_and(|s| s.color <= self.steps.color && s.depth <= self.steps.depth);
        let at = [x, y + self.place.first_row];
        let Some((band, block)) = reference.block(at[0] as i32, at[1] as i32) else { return false };
        if !(motion.is_still && is_fine && band.has_matter(block)) {
            return false;
        }
        let mut planes = [[0.0; BLOCK_LISTS]; 3];
        miss(self.frame, at, band, block, &mut planes);
        let mean = planes[0].iter().map(|d| d.abs()).sum::<f32>() / BLOCK_LISTS as f32;
        mean <= SAME * self.steps.picture
    }

    /// The error with the planes of an origin, if it has any; the layers are then in `self.layers`.
    fn try_origin(
        &mut self,
        origin: Origin,
        offered: &dyn Fn(Origin, &mut Vec<Planes>) -> bool,
    ) -> Option<f32> {
        if !offered(origin, &mut self.planes) {
            return None;
        }
        Some(self.relayer.given(&self.lists, &self.planes, &mut self.layers))
    }
}

impl Source for Layering<'_> {
    fn plan(
        &mut self,
        x: usize,
        y: usize,
        offered: &dyn Fn(Origin, &mut Vec<Planes>) -> bool,
        plan: &mut Plan,
    ) {
        plan.layers.clear();
        plan.origin = Origin::Fresh;
        if self.is_same(x, y) {
            plan.origin = Origin::Copied;
            return;
        }
        self.lists.read(self.frame, x as u32, (y + self.place.first_row) as u32);
        if self.lists.is_empty() {
            return;
        }
        let per_layer = self.rule.error_per_layer();
        let kept = self.try_origin(Origin::Kept, offered);
        if let Some(error) = kept
            && error <= KEEP_AT_ONCE * per_layer * self.layers.len() as f32
        {
            plan.origin = Origin::Kept;
            std::mem::swap(&mut plan.layers, &mut self.layers);
            return;
        }
        self.relayer.fresh(&self.lists, &self.rule, &mut plan.layers);
        self.steps.codes(&plan.layers, &mut plan.codes);
        self.steps.planes(&plan.codes, &mut self.planes);
        let fresh = self.relayer.given(&self.lists, &self.planes, &mut plan.layers);
        plan.origin = Origin::Fresh;
        let num_fresh = plan.layers.len() as f32;
        let acceptable = |share: f32| SLACK * fresh + share * per_layer * num_fresh;
        if kept.is_some_and(|error| error < acceptable(KEEP_SHARE)) {
            self.try_origin(Origin::Kept, offered);
            plan.origin = Origin::Kept;
            std::mem::swap(&mut plan.layers, &mut self.layers);
            return;
        }
        let mut least = acceptable(MERGE_SHARE);
        for origin in [Origin::Left, Origin::Above] {
            let Some(error) = self.try_origin(origin, offered) else { continue };
            let error = error + MERGE_SHARE * per_layer * self.layers.len() as f32;
            if error < least {
                least = error;
                plan.origin = origin;
                std::mem::swap(&mut plan.layers, &mut self.layers);
            }
        }
    }
}

/// Part of the step of corrections that a block may be off on average and still be the same.
const SAME: f32 = 0.75;
/// Planes of another block are taken if their error is at most so many times that of fresh ones.
const SLACK: f32 = 1.15;
/// And, for each layer, so much of what a layer is worth more.
const KEEP_SHARE: f32 = 0.5;
const MERGE_SHARE: f32 = 0.3;
/// Kept planes with less error than this share for each layer are taken without looking for fresh ones.
const KEEP_AT_ONCE: f32 = 0.5;
