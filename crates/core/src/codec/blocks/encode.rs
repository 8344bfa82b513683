//! Encodes: it chooses layers for the lists of a tile, and codes them.

use std::ops::Range;

use rayon::prelude::*;

use super::super::chunk::EncodedFrame;
use super::super::error::{CodecError, at_most};
use super::super::header::num_bands;
use super::super::limits::{MAX_CHUNK_SEGMENTS, MAX_FRAME_LISTS};
use super::bands;
use super::coding::{BlockSource, Offered, Origin, Plan, PlaneCode, TileCoder, TileScratch};
use super::corrections::{self, TilePicture, composite_roots};
use super::entropy::{BitRecorder, Tables, Tally, encoded};
use super::head::{Head, Room, write_streams};
use super::layer_search::{BlockLists, LayerSearch};
use super::model::{BLOCK, BLOCK_LISTS, MAX_LAYERS, PlaneFit, TILE, TilePlace, tiles_along};
use super::motion::ReferenceMotion;
use super::reference::{CodedTile, Notes, Reference};
use super::scales::{FINE, ycc_from_roots};
use super::steps::{self, LayerCost, Settings, StepSizes};
use super::tile::CellsOf;
use super::transform::BlockPlane;
use crate::cancel::{ALWAYS, Wanted};
use crate::layer::{FrameHeader, LayeredFrame};

/// Encodes a valid frame ([`LayeredFrame::validate`]), tiles in parallel. The frame is predicted from the reference,
/// if given. The receiver must have that reference. Also returns the reference that a receiver will have.
///
/// Lists may get more or fewer segments. The header allows `MAX_LAYERS`.
///
/// # Errors
/// On frames and bands above the limits of the codec.
pub fn encode(
    frame: &LayeredFrame,
    settings: &Settings,
    reference: Option<&Reference>,
) -> Result<(EncodedFrame, Reference), CodecError> {
    encode_while(frame, settings, reference, ALWAYS)
}

/// The same, but it stops with [`CodecError::Abandoned`] when the frame is no longer wanted.
pub(in crate::codec) fn encode_while(
    frame: &LayeredFrame,
    settings: &Settings,
    reference: Option<&Reference>,
    wanted: Wanted<'_>,
) -> Result<(EncodedFrame, Reference), CodecError> {
    let plan = BlocksPlan::new(frame.header, settings, reference, &bands::work_of_rows(frame))?;
    let (mut payloads, mut tiles, mut notes, mut tally) = (vec![], vec![], vec![], Tally::default());
    for band in 0..plan.num_bands() {
        let band = plan.encode(frame, band, wanted)?;
        payloads.push(band.payload);
        tiles.extend(band.tiles);
        notes.extend(band.notes);
        tally = tally.and(&band.tally);
    }
    Ok((plan.encoded(payloads)?, plan.reference(tiles, &tally, notes)))
}

/// What all bands of a frame share.
#[derive(Clone, Copy)]
pub(in crate::codec) struct BlocksPlan<'a> {
    header: FrameHeader,
    head: Head,
    num_bands: u8,
    cost: LayerCost,
    /// About the decisions that a segment takes.
    bits_per_segment: f32,
    reference: Option<(&'a Reference, ReferenceMotion)>,
}

/// An encoded band.
pub(in crate::codec) struct EncodedBand {
    pub(in crate::codec) payload: Vec<u8>,
    /// Its tiles, as a decoder has them.
    pub(in crate::codec) tiles: Vec<CodedTile>,
    /// How well the planes of each tile fit, for the next frame.
    pub(in crate::codec) notes: Vec<Notes>,
    /// What its bits were.
    pub(in crate::codec) tally: Tally,
}

/// A tile before its bits become bytes.
#[derive(Default)]
struct EncodedTile {
    coded: CodedTile,
    notes: Notes,
    recorder: BitRecorder,
}

impl<'a> BlocksPlan<'a> {
    /// Cuts a frame into bands, given the work of each row of tiles.
    pub(in crate::codec) fn new(
        frame: FrameHeader,
        settings: &Settings,
        reference: Option<&'a Reference>,
        work: &[usize],
    ) -> Result<Self, CodecError> {
        let camera = frame.camera;
        let num_lists = camera.intrinsics.num_pixels();
        at_most("lists", num_lists, MAX_FRAME_LISTS)?;
        let header = FrameHeader { k: MAX_LAYERS as u8, ..frame };
        let (cost, steps) = steps::from_settings(settings, reference.is_some(), &camera);
        let rows = tiles_along(camera.intrinsics.height).clamp(1, u8::MAX.into()) as u8;
        let least = num_lists.div_ceil(MOST_LISTS_OF_BAND) as u8;
        let num_bands =
            settings.max_bands.max(least).min(rows).clamp(1, num_bands(camera.intrinsics.height).max(1));
        let borders = bands::borders(work, camera.intrinsics.width, num_bands);
        let head = Head { steps, reference: reference.map(Reference::frame), borders };
        let reference = reference.map(|r| (r, ReferenceMotion::new(&camera, &r.header.camera)));
        let bits_per_segment = bits_per_segment(settings.quality, reference.is_some());
        Ok(Self { header, head, num_bands, cost, bits_per_segment, reference })
    }

    pub(in crate::codec) fn num_bands(&self) -> usize {
        self.num_bands.into()
    }

    /// The rows of lists of a band.
    pub(in crate::codec) fn rows(&self, band: usize) -> Range<usize> {
        let height = self.header.camera.intrinsics.height;
        let rows = self.head.borders.rows(band, tiles_along(height));
        let list = |row: usize| (row * TILE * BLOCK).min(height as usize);
        list(rows.start)..list(rows.end)
    }

    /// The chunks, given the payloads of all bands.
    pub(in crate::codec) fn encoded(&self, payloads: Vec<Vec<u8>>) -> Result<EncodedFrame, CodecError> {
        EncodedFrame::from_payloads(self.header, false, &self.head.to_bytes(), payloads)
    }

    /// The reference that a receiver will have, given all tiles.
    pub(in crate::codec) fn reference(
        &self,
        tiles: Vec<CodedTile>,
        tally: &Tally,
        notes: Vec<Notes>,
    ) -> Reference {
        let before = self.reference.map(|(reference, _)| reference);
        let reference = Reference::of_tiles(self.header, self.head.steps, tiles, tally, before);
        reference.with_notes(self.cost.lambda, notes)
    }

    /// Encodes a band of a valid frame, of which only the rows of the band are read.
    pub(in crate::codec) fn encode(
        &self,
        frame: &LayeredFrame,
        band: usize,
        wanted: Wanted<'_>,
    ) -> Result<EncodedBand, CodecError> {
        let places = self.head.tiles(&self.header, band);
        let parts: Vec<_> = places.iter().map(|place| self.parts(frame, place)).collect();
        // The bytes of each part of each tile.
        let mut streams: Vec<Vec<Vec<u8>>> =
            parts.iter().map(|parts| vec![Vec::new(); parts.len()]).collect();
        let indexed = |(tile, parts): (usize, Vec<_>)| {
            parts.into_iter().enumerate().filter_map(move |(n, part)| Some(((tile, n), part?)))
        };
        let mut by_work: Vec<_> = parts.into_iter().enumerate().flat_map(indexed).collect();
        by_work.sort_by_key(|(_, (_, num_segments))| std::cmp::Reverse(*num_segments));
        let room = Room::new(MAX_CHUNK_SEGMENTS);
        // Each thread takes one at a time, so no thread has a long one left at the end.
        let by_work = by_work.into_iter().par_bridge();
        let made = by_work.map_init(Default::default, |scratch, (index, (place, num_segments))| {
            let made = self.encode_tile(frame, place, num_segments, wanted, scratch)?;
            room.take(&made.coded.tile, made.coded.picture.num_blocks())?;
            Ok((index, made))
        });
        let mut made = made.collect::<Result<Vec<_>, CodecError>>()?;
        made.sort_unstable_by_key(|(index, _)| *index);
        let mut tally = Tally::default();
        made.iter().flat_map(|(_, tile)| &tile.recorder.bits).for_each(|bit| tally.add(*bit));
        let (changed, mut payload);
        let tables = match self.reference {
            Some((reference, _)) => {
                payload = Vec::new();
                &reference.tables
            }
            None => {
                (changed, payload) = Tables::changed(&tally);
                &changed
            }
        };
        let bytes: Vec<_> = made.par_iter().map(|(_, tile)| encoded(&tile.recorder.bits, tables)).collect();
        for (((tile, part), _), bytes) in made.iter().zip(bytes) {
            streams[*tile][*part] = bytes;
        }
        write_streams(&streams, &mut payload);
        let (tiles, notes) = made.into_iter().map(|(_, tile)| (tile.coded, tile.notes)).unzip();
        Ok(EncodedBand { payload, tiles, notes, tally })
    }

    /// What of a tile has a stream of its own, with the number of its segments: nothing, all of it, or its quarters if
    /// these have some. So no stream takes much longer to decode than others.
    fn parts(&self, frame: &LayeredFrame, place: &TilePlace) -> Vec<Option<(TilePlace, usize)>> {
        let with_segments = |place: TilePlace| {
            let num_segments = segments(frame, &place);
            (num_segments > 0).then_some((place, num_segments))
        };
        match with_segments(*place) {
            None => Vec::new(),
            Some((_, num)) if num as f32 * self.bits_per_segment > MOST_BITS => {
                (0..4).map(|quarter| place.quarter(quarter).and_then(with_segments)).collect()
            }
            all => vec![all],
        }
    }

    /// Encodes a tile or a part of one.
    fn encode_tile(
        &self,
        frame: &LayeredFrame,
        place: TilePlace,
        num_segments: usize,
        wanted: Wanted<'_>,
        (planner, coder): &mut (PlannerScratch, TileScratch),
    ) -> Result<EncodedTile, CodecError> {
        let Self { cost, reference, head: Head { steps, .. }, .. } = *self;
        if !wanted() {
            return Err(CodecError::Abandoned);
        }
        let mut planner = BlockPlanner::new(frame, place, cost, steps, reference, planner);
        let coder = TileCoder::new(BitRecorder::default(), steps, place, reference, num_segments, coder);
        let (mut recorder, tile, origins) = coder.run(&mut planner)?;
        let BlockPlanner { goals, goal_of, notes, .. } = planner;
        let mut picture = TilePicture::default();
        if tile.num_cells() > 0 {
            let source = |block: usize, planes: &mut [BlockPlane; 3]| {
                // A block of the reference already contains its corrections.
                let is_corrected = origins[block] == Origin::Copied || !tile.has_matter(block);
                match goals.get(goal_of[block] as usize) {
                    Some(goal) if !is_corrected => miss(goal, tile.cells_of(block), planes),
                    _ => 0,
                }
            };
            let corrections;
            (recorder, corrections) = corrections::code(recorder, &steps, place, source)?;
            picture = TilePicture::new(&tile, &corrections);
        }
        Ok(EncodedTile { coded: CodedTile { tile, picture }, notes, recorder })
    }
}

/// About the decisions that a segment takes at a quality: a guess from the longest tiles of bonsai.
fn bits_per_segment(quality: u8, is_predicted: bool) -> f32 {
    let alone = 0.5 + 0.02 * f32::from(quality);
    if is_predicted { 0.6 * alone } else { alone }
}

/// Number of segments in a tile.
fn segments(frame: &LayeredFrame, place: &TilePlace) -> usize {
    let [width, height] = place.size;
    let [left, top] = place.first.map(|block| block * BLOCK);
    let right = (left + place.across * BLOCK).min(width);
    let rows = top..(top + place.num_rows * BLOCK).min(height);
    rows.map(|row| (frame.offsets[row * width + right] - frame.offsets[row * width + left]) as usize).sum()
}

/// What the lists of a block lack, as roots in units of 1/[`FINE`], to composite to `goal`. Returns the mask of lists
/// with matter.
fn miss(goal: &[BlockPlane; 3], cells: CellsOf<'_>, planes: &mut [BlockPlane; 3]) -> u64 {
    let mut found = [[0; BLOCK_LISTS]; 3];
    composite_roots(cells, &mut found);
    for i in 0..BLOCK_LISTS {
        let ycc = ycc_from_roots(std::array::from_fn(|c| goal[c][i] * FINE - found[c][i] as f32));
        for (plane, value) in planes.iter_mut().zip(ycc) {
            plane[i] = value;
        }
    }
    cells.mask()
}

/// A block's own planes, which are coded.
#[derive(Default)]
struct PlaneCandidate {
    codes: Vec<(PlaneCode, PlaneCode)>,
    /// The planes that a decoder makes of the codes.
    planes: Vec<(PlaneFit, PlaneFit)>,
    error: f32,
    /// Cost of the layers, in the unit of the error.
    worth: f32,
}

impl PlaneCandidate {
    /// Codes the present planes and measures their error.
    fn weigh(&mut self, search: &mut LayerSearch, lists: &BlockLists, steps: &StepSizes, per_layer: f32) {
        steps.codes(&self.planes, &mut self.codes);
        steps.planes(&self.codes, &mut self.planes);
        self.error = search.error(lists, &self.planes, f32::INFINITY);
        self.worth = per_layer * self.codes.len() as f32;
    }

    fn cost(&self) -> f32 {
        self.error + WORTH_SHARE * self.worth
    }
}

/// Memory of a thread that plans blocks. What it holds means nothing to the next block.
#[derive(Default)]
struct PlannerScratch {
    search: LayerSearch,
    lists: BlockLists,
    own: PlaneCandidate,
    searched: PlaneCandidate,
    planes: Vec<(PlaneFit, PlaneFit)>,
    best: Vec<(PlaneFit, PlaneFit)>,
}

/// Finds layers for blocks.
struct BlockPlanner<'a> {
    frame: &'a LayeredFrame,
    place: TilePlace,
    cost: LayerCost,
    steps: StepSizes,
    reference: Option<(&'a Reference, ReferenceMotion)>,
    scratch: &'a mut PlannerScratch,
    notes: Notes,
    /// The roots of red, green and blue that the lists of blocks should composite to, and their index for each block;
    /// [`NO_GOAL`] for an empty block.
    goals: Vec<[BlockPlane; 3]>,
    goal_of: Vec<u32>,
}

impl<'a> BlockPlanner<'a> {
    fn new(
        frame: &'a LayeredFrame,
        place: TilePlace,
        cost: LayerCost,
        steps: StepSizes,
        reference: Option<(&'a Reference, ReferenceMotion)>,
        scratch: &'a mut PlannerScratch,
    ) -> Self {
        Self {
            frame,
            place,
            cost,
            steps,
            reference,
            scratch,
            notes: Vec::with_capacity(place.across * place.num_rows),
            goals: Vec::with_capacity(place.across * place.num_rows),
            goal_of: Vec::with_capacity(place.across * place.num_rows),
        }
    }

    /// Whether the block of a reference with the same camera is as good as a newly coded one. Its steps must not be
    /// coarser. Nor may its layers have cost more: then it was made for a smaller turn, which the picture at this
    /// pose does not show.
    fn is_same(&mut self, x: usize, y: usize) -> bool {
        let Some((reference, motion)) = self.reference else { return false };
        let is_fine =
            reference.steps.is_some_and(|s| s.color <= self.steps.color && s.depth <= self.steps.depth)
                && reference.lambda.is_some_and(|lambda| lambda <= self.cost.lambda * LIKE_LAMBDA);
        let [x, y] = self.place.in_frame(x, y).map(|at| at as i32);
        let Some((tile, block)) = reference.block(x, y) else { return false };
        if !(motion.is_still && is_fine && tile.has_matter(block)) {
            return false;
        }
        let Some(goal) = self.goals.last() else { return false };
        let mut planes = [[0.0; BLOCK_LISTS]; 3];
        miss(goal, tile.cells_of(block), &mut planes);
        let mean = planes[0].iter().map(|d| d.abs()).sum::<f32>() / BLOCK_LISTS as f32;
        mean <= SAME * f32::from(self.steps.picture)
    }
}

impl BlockSource for BlockPlanner<'_> {
    fn plan(&mut self, x: usize, y: usize, offered: &Offered<'_>, plan: &mut Plan) {
        let note = self.planned(x, y, offered, plan);
        self.notes.push(note);
    }
}

impl BlockPlanner<'_> {
    /// Plans a block. Returns its note; see [`Notes`].
    fn planned(&mut self, x: usize, y: usize, offered: &Offered<'_>, plan: &mut Plan) -> f32 {
        plan.origin = Origin::Fresh;
        let at = self.place.in_frame(x, y).map(|at| at as u32);
        if BlockLists::is_nothing(self.frame, at[0], at[1]) {
            plan.layers.clear();
            self.goal_of.push(NO_GOAL);
            return 0.0;
        }
        self.scratch.lists.read(self.frame, at[0], at[1]);
        self.goal_of.push(self.goals.len() as u32);
        self.goals.push(*self.scratch.lists.roots());
        if self.is_same(x, y) {
            plan.origin = Origin::Copied;
            plan.layers.clear();
            return self.reference.map_or(0.0, |(reference, _)| reference.note(at.map(|v| v as i32)));
        }
        let per_layer = self.cost.error_per_layer();
        let Self { scratch, steps, .. } = self;
        let PlannerScratch { search, lists, own, searched, planes, best } = &mut **scratch;
        let mut kept = f32::INFINITY;
        // Error of a block's own planes here, in units of the cost of a layer.
        let mut note = 0.0;
        let (mut is_fitted, mut is_found) = (false, false);
        if offered(Origin::Kept, best) {
            let noted = self.reference.and_then(|(reference, motion)| {
                Some(reference.note(reference.moved_to(&motion, at.map(|v| v as usize))?))
            });
            note = noted.unwrap_or(0.0);
            let for_layers = per_layer * best.len() as f32;
            let accepted = (note + AT_ONCE_SHARE) * for_layers;
            kept = search.error(lists, best, HOPELESS * (note + KEEP_SHARE) * for_layers);
            if kept <= accepted {
                plan.origin = Origin::Kept;
                search.assign(lists, best, &mut plan.layers);
                return note.min(kept / for_layers);
            }
            own.planes.clone_from(best);
            search.fit(lists, &mut own.planes);
            own.weigh(search, lists, steps, per_layer);
            is_fitted = true;
            is_found = own.error <= (note + FIT_SHARE / self.cost.lambda.sqrt()) * own.worth;
        }
        if !is_found {
            search.find(lists, &self.cost, &mut searched.planes);
            searched.weigh(search, lists, steps, per_layer);
            if !is_fitted || searched.cost() < own.cost() {
                std::mem::swap(own, searched);
            }
            // The old note may be about planes that are gone.
            note = f32::INFINITY;
        }
        if kept < own.error + KEEP_SHARE * own.worth {
            plan.origin = Origin::Kept;
            search.assign(lists, best, &mut plan.layers);
            return note.min(own.error.min(kept) / (per_layer * best.len() as f32));
        }
        note = note.min(own.error / own.worth);
        let mut least = SLACK * own.error + MERGE_SHARE * own.worth;
        for origin in [Origin::Left, Origin::Above] {
            if !offered(origin, planes) {
                continue;
            }
            let for_layers = MERGE_SHARE * per_layer * planes.len() as f32;
            let error = search.error(lists, planes, least - for_layers) + for_layers;
            if error < least {
                least = error;
                plan.origin = origin;
                std::mem::swap(best, planes);
            }
        }
        if plan.origin == Origin::Fresh {
            plan.codes.clone_from(&own.codes);
            search.assign(lists, &own.planes, &mut plan.layers);
        } else {
            search.assign(lists, best, &mut plan.layers);
        }
        note
    }
}

/// A band has at most so many lists, so that its chunk may hold all of their segments.
const MOST_LISTS_OF_BAND: usize = MAX_CHUNK_SEGMENTS / 8;
const NO_GOAL: u32 = u32::MAX;
/// A tile of more decisions is divided. A GPU may take .1 µs for each; this is not measured.
const MOST_BITS: f32 = 24_000.0;
/// A copied block may be off by this part of the step of corrections on average.
const SAME: f32 = 0.75;
/// Allowed ratio of the former cost of a layer to the present one.
const LIKE_LAMBDA: f32 = 1.01;
/// A neighbour's planes are taken if their error is at most this multiple of the error of the block's own, plus this
/// part of the layers' cost.
const SLACK: f32 = 1.15;
const MERGE_SHARE: f32 = 0.3;
/// The reference's planes are taken if their error is at most that of the block's own plus this. With more, errors
/// add up from frame to frame.
const KEEP_SHARE: f32 = 0.1;
/// They are taken without a fit or a search if their error is at most the noted one plus this.
const AT_ONCE_SHARE: f32 = 0.05;
/// They are not taken at all if their error is this multiple of the noted one plus [`KEEP_SHARE`].
const HOPELESS: f32 = 4.0;
/// Fitted planes of the reference need no search if their error is at most the noted one plus this over the root of
/// λ. The less a layer costs, the less a search gains.
const FIT_SHARE: f32 = 0.16;
/// Otherwise fitted and found planes are compared by error plus this part of their layers' cost. The whole cost would
/// favour fewer layers, which look worse at a turn.
const WORTH_SHARE: f32 = 0.3;

#[cfg(test)]
mod tests {
    use super::super::layer_search::tests::{COST, frame, slab};
    use super::*;
    use crate::layer::Segment;

    /// What is planned for a block with these lists, where the frame before had layers between these depths.
    fn planned(list: impl Fn(usize) -> Vec<Segment>, before: &[[f32; 2]]) -> (Plan, f32) {
        let frame = frame(list);
        let steps = StepSizes { depth: 1, opacity: 1375, color: 3277, picture: 1, chroma: 32 };
        let place = TilePlace { first: [0; 2], across: 1, num_rows: 1, size: [8, 8] };
        let mut scratch = PlannerScratch::default();
        let mut planner = BlockPlanner::new(&frame, place, COST, steps, None, &mut scratch);
        let offered = |origin: Origin, out: &mut Vec<(PlaneFit, PlaneFit)>| {
            out.clear();
            if origin == Origin::Kept {
                out.extend(before.iter().map(|ends| {
                    let [front, back] = ends.map(|z| PlaneFit { z, dx: 90.0, dy: -60.0 });
                    (front, back)
                }));
            }
            !out.is_empty()
        };
        let mut plan = Plan::default();
        let note = planner.planned(0, 0, &offered, &mut plan);
        (plan, note)
    }

    /// A search would find one layer in a homogeneous slab.
    #[test]
    fn planes_that_can_be_fitted_need_no_search_and_those_that_cannot_are_not_kept() {
        let one = |i| vec![slab(i, 20300.0, 3000.0, 0.8, 1.5)];
        let (alone, _) = planned(one, &[]);
        assert_eq!((alone.origin, alone.codes.len()), (Origin::Fresh, 1));
        let halves = |z: f32| [[z, z + 1500.0], [z + 1500.0, z + 3000.0]];
        let (there, note) = planned(one, &halves(20300.0));
        assert_eq!((there.origin, there.layers.len()), (Origin::Kept, 2));
        assert!(note < 0.05, "{note}");
        let (moved, note) = planned(one, &halves(20000.0));
        assert_eq!((moved.origin, moved.codes.len(), moved.layers.len()), (Origin::Fresh, 2, 2));
        assert!(note < 0.05, "{note}");
        // Of a slab that has come out between the two a part would be in each layer.
        let three = |i| {
            let at = [(20000.0, 0.8), (22000.0, 0.1), (24000.0, 0.3)];
            at.map(|(z, gray)| slab(i, z, 700.0, gray, 0.9)).to_vec()
        };
        let (searched, _) = planned(three, &[[20000.0, 20700.0], [24000.0, 24700.0]]);
        assert_eq!((searched.origin, searched.codes.len()), (Origin::Fresh, 3));
    }

    /// A row of a layer takes the memory of eight lists, even if one of them has matter: few segments must not take much.
    #[test]
    fn rows_of_layers_are_bounded_as_well_as_segments() {
        let coded = |has_matter: fn(usize) -> bool, limit: usize| {
            let list = |i| if has_matter(i) { vec![slab(i, 20300.0, 3000.0, 0.8, 1.5)] } else { vec![] };
            let frame = frame(list);
            let steps = StepSizes { depth: 1, opacity: 1375, color: 3277, picture: 1, chroma: 32 };
            let place = TilePlace { first: [0; 2], across: 1, num_rows: 1, size: [8, 8] };
            let mut scratch = PlannerScratch::default();
            let mut planner = BlockPlanner::new(&frame, place, COST, steps, None, &mut scratch);
            let mut coder = TileScratch::default();
            let coder = TileCoder::new(BitRecorder::default(), steps, place, None, 0, &mut coder);
            let (_, tile, _) = coder.run(&mut planner).unwrap();
            match Room::new(limit).take(&tile, 0) {
                Ok(()) => Ok((tile.num_cells(), tile.num_rows())),
                Err(CodecError::TooLarge { what, .. }) => Err(what),
                Err(other) => panic!("{other}"),
            }
        };
        let one_of_eight = |i: usize| i % 8 == 3;
        assert_eq!(coded(one_of_eight, 32), Ok((8, 8)));
        assert_eq!(coded(one_of_eight, 28), Err("rows of segments in a chunk"));
        assert_eq!(coded(|_| true, 64), Ok((64, 8)));
        assert_eq!(coded(|_| true, 60), Err("segments in a chunk"));
    }
}
