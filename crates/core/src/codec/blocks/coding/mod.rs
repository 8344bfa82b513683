//! Codes the layers of a tile in bits. One text serves both directions. It also computes what a decoder will have, so
//! that the encoder works with it.

mod depth;
mod layer;

use super::super::error::CodecError;
use super::entropy::Coder;
use super::fetch::Fetched;
use super::model::{BlockLayer, DepthPlane, PlaneFit, TilePlace, middle_of};
use super::motion::ReferenceMotion;
use super::reference::Reference;
use super::steps::StepSizes;
use super::syntax::Contexts;
use super::tile::{FrameTile, OpenBlock, Planes};
use layer::{BlockContext, CodedLayer};

pub(super) use depth::PlaneCode;

/// The origin of a block's planes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Origin {
    /// The planes are coded.
    #[default]
    Fresh,
    /// The planes of the left block, continued.
    Left,
    /// The planes of the upper block, continued.
    Above,
    /// The planes of the reference, moved.
    Kept,
    /// The whole block is copied from the reference, which has the same camera.
    Copied,
}

/// An encoder's plan for a block.
#[derive(Clone, Debug, Default)]
pub(super) struct Plan {
    pub(super) origin: Origin,
    /// The planes, if they are fresh.
    pub(super) codes: Vec<(PlaneCode, PlaneCode)>,
    /// The matter between the planes that the decoder will have. Empty for an empty block.
    pub(super) layers: Vec<BlockLayer>,
}

/// Writes the planes of an origin and returns whether there are any.
pub(super) type Offered<'a> = dyn Fn(Origin, &mut Vec<(PlaneFit, PlaneFit)>) -> bool + 'a;

/// Provides the plans of blocks.
pub(super) trait BlockSource {
    /// Plans the block at (`x`, `y`) of the tile. `offered` writes the planes of an origin and returns whether there
    /// are any.
    fn plan(&mut self, x: usize, y: usize, offered: &Offered<'_>, plan: &mut Plan);
}

/// The source of a decoder.
pub(super) struct NoSource;

impl BlockSource for NoSource {
    fn plan(&mut self, _: usize, _: usize, _: &Offered<'_>, _: &mut Plan) {}
}

/// Codes a tile.
pub(super) struct TileCoder<'a, C> {
    pub(super) coder: C,
    contexts: &'static Contexts,
    steps: StepSizes,
    place: TilePlace,
    reference: Option<(&'a Reference, ReferenceMotion)>,
    tile: FrameTile,
    /// One for each pair of planes of the tile.
    layers: Vec<CodedLayer>,
    /// The origin of each block's planes.
    origins: Vec<Origin>,
    scratch: &'a mut TileScratch,
}

/// Memory of a thread that codes blocks. What it holds means nothing to the next block.
pub(super) struct TileScratch {
    lists: OpenBlock,
    fetched: Fetched,
    offered: Vec<Planes>,
}

impl Default for TileScratch {
    fn default() -> Self {
        Self { lists: OpenBlock::default(), fetched: Fetched::new(), offered: Vec::new() }
    }
}

impl<'a, C: Coder> TileCoder<'a, C> {
    pub(super) fn new(
        coder: C,
        steps: StepSizes,
        place: TilePlace,
        reference: Option<(&'a Reference, ReferenceMotion)>,
        num_cells: usize,
        scratch: &'a mut TileScratch,
    ) -> Self {
        Self {
            coder,
            contexts: Contexts::all(),
            steps,
            place,
            reference,
            tile: FrameTile::new(place, num_cells),
            layers: Vec::new(),
            origins: Vec::new(),
            scratch,
        }
    }

    /// Codes all blocks.
    pub(super) fn run(
        mut self,
        source: &mut impl BlockSource,
    ) -> Result<(C, FrameTile, Vec<Origin>), CodecError> {
        let mut plan = Plan::default();
        for y in 0..self.place.num_rows {
            for x in 0..self.place.across {
                self.block(x, y, source, &mut plan);
                if self.coder.is_overrun() {
                    return Err(CodecError::Payload { plane: "blocks", problem: "ends too early".into() });
                }
            }
        }
        Ok((self.coder, self.tile, self.origins))
    }

    /// Index of the block to the left, if there is one.
    fn left(&self, x: usize) -> Option<usize> {
        (x > 0).then(|| self.tile.blocks.len() - 1)
    }

    fn above(&self, y: usize) -> Option<usize> {
        (y > 0).then(|| self.tile.blocks.len() - self.place.across)
    }

    /// Writes the planes that an origin has for the block at (`x`, `y`). Returns whether there are any.
    fn offer(&self, origin: Origin, x: usize, y: usize, out: &mut Vec<Planes>) -> bool {
        out.clear();
        let mut offer = |block: Option<usize>, step| {
            let Some(block) = block else { return };
            let planes = self.tile.planes[self.tile.layers(block)].iter();
            out.extend(planes.map(|(f, b)| (f.continued(step), b.continued(step))));
        };
        match origin {
            Origin::Fresh | Origin::Copied => {}
            Origin::Left => offer(self.left(x), [1, 0]),
            Origin::Above => offer(self.above(y), [0, 1]),
            Origin::Kept => self.kept(x, y, out),
        }
        !out.is_empty()
    }

    /// Adds the planes of the reference's block that the middle of this block moves to.
    fn kept(&self, x: usize, y: usize, out: &mut Vec<Planes>) {
        let Some((reference, motion)) = &self.reference else { return };
        let [x, y] = self.place.in_frame(x, y);
        let Some(to) = reference.moved_to(motion, [x, y]) else { return };
        let Some((tile, block)) = reference.block(to[0], to[1]) else { return };
        let middle = middle_of([x, y].map(|v| v as i32));
        let theirs = middle_of(to);
        let moved = |p: &DepthPlane| {
            let shift = motion.at(middle, p.z).unwrap_or_default();
            let dx = 64 * (middle[0] - theirs[0]) + shift.x;
            let dy = 64 * (middle[1] - theirs[1]) + shift.y;
            let across = p.dx.wrapping_mul(dx).wrapping_add(p.dy.wrapping_mul(dy)) >> 6;
            DepthPlane::bounded(p.z.wrapping_add(across).wrapping_sub(shift.z), p.dx, p.dy)
        };
        out.extend(tile.planes[tile.layers(block)].iter().map(|(f, b)| (moved(f), moved(b))));
    }

    fn block(&mut self, x: usize, y: usize, source: &mut impl BlockSource, plan: &mut Plan) {
        if C::ENCODES {
            let planes = std::cell::RefCell::new(std::mem::take(&mut self.scratch.offered));
            let offered = |origin: Origin, out: &mut Vec<(PlaneFit, PlaneFit)>| {
                let planes = &mut *planes.borrow_mut();
                let has_any = self.offer(origin, x, y, planes);
                out.clear();
                out.extend(planes.iter().map(|(front, back)| (front.fit(), back.fit())));
                has_any
            };
            source.plan(x, y, &offered, plan);
            self.scratch.offered = planes.into_inner();
        }
        if self.copied(x, y, plan) {
            return;
        }
        let (left, above) = (self.left(x), self.above(y));
        let layers_of = |block: Option<usize>| block.map_or(0, |b| self.tile.layers(b).len());
        let (num_left, num_above) = (layers_of(left), layers_of(above));
        let state = |block: Option<usize>, count: usize| block.map_or(0, |_| 1 + usize::from(count > 0));
        let around = state(left, num_left) * 3 + state(above, num_above);
        let [column, row] = self.place.in_frame(x, y).map(|at| at as i32);
        let before = self.reference.as_ref().and_then(|(r, _)| r.block(column, row));
        let before = before.map_or(0, |(tile, block)| 1 + usize::from(!tile.layers(block).is_empty()));

        let first_plane = self.tile.planes.len();
        self.scratch.lists.clear();
        let has_planes = !plan.layers.is_empty();
        let mut origin = Origin::Fresh;
        if self.coder.bit(self.contexts.has_planes[around][before], has_planes) {
            let mut planes = std::mem::take(&mut self.scratch.offered);
            origin = self.origin(x, y, plan.origin, &mut planes);
            if origin == Origin::Fresh {
                let neighbors = [left, above].map(|b| b.map_or(0..0, |b| self.tile.layers(b)));
                self.fresh(&plan.codes, neighbors);
            } else {
                self.tile.planes.extend_from_slice(&planes);
            }
            self.scratch.offered = planes;
            let neighbors = [left, above].map(|b| b.map_or(0..0, |b| self.tile.layers(b)));
            let around = BlockContext { x, y, origin, first_layer: first_plane, neighbors };
            let mut mask_before = None;
            for layer in first_plane..self.tile.planes.len() {
                let wanted = plan.layers.get(layer - first_plane);
                let coded = self.layer(layer, &around, wanted, &mut mask_before);
                self.layers.push(coded);
            }
        }
        self.tile.push(first_plane, &mut self.scratch.lists);
        self.origins.push(origin);
    }

    /// Codes whether the block is a copy, and copies it.
    fn copied(&mut self, x: usize, y: usize, plan: &Plan) -> bool {
        let Some((reference, motion)) = self.reference else { return false };
        let [column, row] = self.place.in_frame(x, y).map(|at| at as i32);
        let Some((tile, block)) =
            reference.block(column, row).filter(|(tile, block)| motion.is_still && tile.has_matter(*block))
        else {
            return false;
        };
        let context = self.around(x, y, |o| o == Origin::Copied);
        if !self.coder.bit(self.contexts.is_copied[context], plan.origin == Origin::Copied) {
            return false;
        }
        self.tile.copy(tile, block);
        self.layers.resize(self.tile.planes.len(), CodedLayer::without_matter([0; 4]));
        self.origins.push(Origin::Copied);
        true
    }

    /// Context of the origins of the left and upper blocks.
    fn around(&self, x: usize, y: usize, is: impl Fn(Origin) -> bool) -> usize {
        let state = |block: Option<usize>| block.map_or(0, |b| 1 + usize::from(is(self.origins[b])));
        state(self.left(x)) * 3 + state(self.above(y))
    }

    /// Codes the origin of the planes, and writes these unless they are fresh.
    fn origin(&mut self, x: usize, y: usize, wanted: Origin, planes: &mut Vec<Planes>) -> Origin {
        let (left, above) = (self.left(x), self.above(y));
        let is_kept = self.around(x, y, |o| o == Origin::Kept);
        let is_merged = self.around(x, y, |o| matches!(o, Origin::Left | Origin::Above));
        if self.offer(Origin::Kept, x, y, planes)
            && self.coder.bit(self.contexts.is_kept[is_kept], wanted == Origin::Kept)
        {
            return Origin::Kept;
        }
        let has = |block: Option<usize>| block.is_some_and(|b| !self.tile.layers(b).is_empty());
        let (has_left, has_above) = (has(left), has(above));
        let is_wanted = matches!(wanted, Origin::Left | Origin::Above);
        if !(has_left || has_above) || !self.coder.bit(self.contexts.is_merged[is_merged], is_wanted) {
            return Origin::Fresh;
        }
        let is_above = if has_left && has_above {
            let context = match left.map(|b| self.origins[b]) {
                Some(Origin::Above) => 2,
                Some(Origin::Left) => 1,
                _ => 0,
            };
            self.coder.bit(self.contexts.is_above[context], wanted == Origin::Above)
        } else {
            has_above
        };
        let origin = if is_above { Origin::Above } else { Origin::Left };
        self.offer(origin, x, y, planes);
        origin
    }
}
