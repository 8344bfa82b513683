//! The layers of a band in bits: written once, for both directions. What is decoded is computed here too, so that the
//! encoder works with it.

use std::ops::Range;

use super::super::CodecError;
use super::band::{Band, Lists, Planes};
use super::entropy::Coder;
use super::model::{BLOCK, BLOCK_LISTS, BlockLayer, DepthPlane, MAX_LAYERS};
use super::motion::{Motion, Shift};
use super::reference::{Fetched, Reference};
use super::scales::{fixed_from_f32, scales, ycc_from_color};
use super::steps::Steps;
use super::syntax::{Contexts, DEPTH_CONTEXTS, Levels, NO_CLASS, count_class};
use super::transform::{Plane, ZIGZAG, fill_in, forward, inverse};

/// Where the planes of a block come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Origin {
    /// They are coded.
    #[default]
    Fresh,
    /// Those of the block on the left, continued.
    Left,
    /// Those of the block above, continued.
    Above,
    /// Those of the reference, moved.
    Kept,
    /// All of the block is that of the reference, whose camera is the same.
    Copied,
}

/// A depth plane in steps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct PlaneCode {
    pub(super) z: i32,
    pub(super) dx: i32,
    pub(super) dy: i32,
}

/// What an encoder says of a block.
#[derive(Clone, Debug, Default)]
pub(super) struct Plan {
    pub(super) origin: Origin,
    /// The planes, if they are fresh.
    pub(super) codes: Vec<(PlaneCode, PlaneCode)>,
    /// The matter between the planes that the decoder will have; none if the block is empty.
    pub(super) layers: Vec<BlockLayer>,
}

/// Gives what is to be coded.
pub(super) trait Source {
    /// Plans the block at (`x`, `y`) of the band. `offered` writes the planes of an origin, if it has any.
    fn plan(
        &mut self,
        x: usize,
        y: usize,
        offered: &dyn Fn(Origin, &mut Vec<Planes>) -> bool,
        plan: &mut Plan,
    );
}

/// The source of a decoder.
pub(super) struct Nothing;

impl Source for Nothing {
    fn plan(&mut self, _: usize, _: usize, _: &dyn Fn(Origin, &mut Vec<Planes>) -> bool, _: &mut Plan) {}
}

/// Where a band lies in its frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    /// Blocks to a row.
    pub(super) across: usize,
    /// The first row of blocks, and how many there are.
    pub(super) first_row: usize,
    pub(super) num_rows: usize,
    /// Columns and rows of lists of the frame.
    pub(super) size: [usize; 2],
}

impl Place {
    /// The lists of a block that are inside of the frame.
    fn inside(&self, x: usize, y: usize) -> u64 {
        let [columns, rows] = [(x, 0), (y + self.first_row, 1)]
            .map(|(at, axis)| self.size[axis].saturating_sub(at * BLOCK).min(BLOCK));
        let row = (1u64 << columns) - 1;
        (0..rows).fold(0, |mask, y| mask | row << (y * BLOCK))
    }
}

/// Codes one band.
pub(super) struct BandCoder<'a, C> {
    pub(super) coder: C,
    contexts: Box<Contexts>,
    steps: Steps,
    place: Place,
    reference: Option<(&'a Reference, Motion)>,
    band: Band,
    /// Beside the planes of the band.
    layers: Vec<Coded>,
    /// How each block came to its planes.
    origins: Vec<Origin>,
    lists: Lists,
    fetched: Fetched,
    offered: Vec<Planes>,
}

/// The block that a layer is in.
struct Around {
    x: usize,
    y: usize,
    origin: Origin,
    first_layer: usize,
    /// Layers of the block on the left and of the one above.
    neighbors: [Range<usize>; 2],
}

/// What later blocks and layers want to know of a layer.
#[derive(Clone, Copy, Debug)]
struct Coded {
    means: [f32; 4],
    classes: [u8; 4],
}

impl<'a, C: Coder> BandCoder<'a, C> {
    pub(super) fn new(
        coder: C,
        steps: Steps,
        place: Place,
        reference: Option<(&'a Reference, Motion)>,
    ) -> Self {
        Self {
            coder,
            contexts: Contexts::new(),
            steps,
            place,
            reference,
            band: Band::new(place.across),
            layers: Vec::new(),
            origins: Vec::new(),
            lists: Lists::default(),
            fetched: Fetched::new(),
            offered: Vec::new(),
        }
    }

    /// Codes all blocks; `limit` is the greatest number of cells.
    pub(super) fn run(
        mut self,
        source: &mut impl Source,
        limit: usize,
    ) -> Result<(C, Band, Vec<Origin>), CodecError> {
        let mut plan = Plan::default();
        for y in 0..self.place.num_rows {
            for x in 0..self.place.across {
                self.block(x, y, source, &mut plan);
                super::super::at_most("segments in a chunk", self.band.cells.len(), limit)?;
                super::super::at_most("layers in a chunk", self.band.planes.len(), limit / 8)?;
                if self.coder.is_overrun() {
                    return Err(CodecError::Payload { plane: "blocks", problem: "ends too early".into() });
                }
            }
        }
        Ok((self.coder, self.band, self.origins))
    }

    /// Number of the block to the left of or above one, if there is one.
    fn left(&self, x: usize) -> Option<usize> {
        (x > 0).then(|| self.band.blocks.len() - 1)
    }

    fn above(&self, y: usize) -> Option<usize> {
        (y > 0).then(|| self.band.blocks.len() - self.place.across)
    }

    /// The planes that an origin has for the block at (`x`, `y`); whether there are any.
    fn offer(&self, origin: Origin, x: usize, y: usize, out: &mut Vec<Planes>) -> bool {
        out.clear();
        let continued = |block: Option<usize>, dx: f32, dy: f32, out: &mut Vec<Planes>| {
            let Some(block) = block else { return };
            let move_by = |p: &DepthPlane| bounded(p.z + BLOCK as f32 * (dx * p.dx + dy * p.dy), p.dx, p.dy);
            out.extend(
                self.band.planes[self.band.layers(block)].iter().map(|(f, b)| (move_by(f), move_by(b))),
            );
        };
        match origin {
            Origin::Fresh | Origin::Copied => {}
            Origin::Left => continued(self.left(x), 1.0, 0.0, out),
            Origin::Above => continued(self.above(y), 0.0, 1.0, out),
            Origin::Kept => self.kept(x, y, out),
        }
        !out.is_empty()
    }

    /// The planes of the block of the reference that the middle of this one has moved to.
    fn kept(&self, x: usize, y: usize, out: &mut Vec<Planes>) {
        let Some((reference, motion)) = &self.reference else { return };
        let y = y + self.place.first_row;
        let middle = [x, y].map(|v| (v * BLOCK) as f32 + HALF);
        // About how deep is the block? As the reference was here, or beside.
        let first = [(0, 0), (0, -1), (-1, 0), (1, 0), (0, 1)].into_iter().find_map(|(dx, dy)| {
            let (band, block) = reference.block(x as i32 + dx, y as i32 + dy)?;
            band.planes[band.layers(block)].first()
        });
        let Some((front, _)) = first else { return };
        let Some(shift) = motion.at(middle[0], middle[1], front.z) else { return };
        let to = [middle[0] + shift.x, middle[1] + shift.y].map(|v| (v / BLOCK as f32).floor());
        let Some((band, block)) = reference.block(to[0] as i32, to[1] as i32) else { return };
        let theirs = to.map(|v| v * BLOCK as f32 + HALF);
        let moved = |p: &DepthPlane| {
            let shift = motion.at(middle[0], middle[1], p.z).unwrap_or(Shift { x: 0.0, y: 0.0, z: 0.0 });
            let dx = middle[0] + shift.x - theirs[0];
            let dy = middle[1] + shift.y - theirs[1];
            bounded(p.z + p.dx * dx + p.dy * dy - shift.z, p.dx, p.dy)
        };
        out.extend(band.planes[band.layers(block)].iter().map(|(f, b)| (moved(f), moved(b))));
    }

    fn block(&mut self, x: usize, y: usize, source: &mut impl Source, plan: &mut Plan) {
        if C::ENCODES {
            source.plan(x, y, &|origin, out| self.offer(origin, x, y, out), plan);
        }
        if self.copied(x, y, plan) {
            return;
        }
        let (left, above) = (self.left(x), self.above(y));
        let layers_of = |block: Option<usize>| block.map_or(0, |b| self.band.layers(b).len());
        let (num_left, num_above) = (layers_of(left), layers_of(above));
        let state = |block: Option<usize>, count: usize| block.map_or(0, |_| 1 + usize::from(count > 0));
        let around = state(left, num_left) * 3 + state(above, num_above);
        let before =
            self.reference.as_ref().and_then(|(r, _)| r.block(x as i32, (y + self.place.first_row) as i32));
        let before = before.map_or(0, |(band, block)| 1 + usize::from(!band.layers(block).is_empty()));

        let first_plane = self.band.planes.len();
        self.lists.clear();
        let has_planes = !plan.layers.is_empty();
        let mut origin = Origin::Fresh;
        if self.coder.bit(&mut self.contexts.has_planes[around][before], has_planes) {
            let mut planes = std::mem::take(&mut self.offered);
            origin = self.origin(x, y, plan.origin, &mut planes);
            if origin == Origin::Fresh {
                let neighbors = [left, above].map(|b| b.map_or(0..0, |b| self.band.layers(b)));
                self.fresh(&plan.codes, neighbors);
            } else {
                self.band.planes.extend_from_slice(&planes);
            }
            self.offered = planes;
            let neighbors = [left, above].map(|b| b.map_or(0..0, |b| self.band.layers(b)));
            let around = Around { x, y, origin, first_layer: first_plane, neighbors };
            let mut mask_before = None;
            for layer in first_plane..self.band.planes.len() {
                let wanted = plan.layers.get(layer - first_plane);
                let coded = self.layer(layer, &around, wanted, &mut mask_before);
                self.layers.push(coded);
            }
        }
        self.band.push(first_plane, &self.lists);
        self.origins.push(origin);
    }

    /// Copies the block if that is said.
    fn copied(&mut self, x: usize, y: usize, plan: &Plan) -> bool {
        let Some((reference, motion)) = self.reference else { return false };
        let block = reference.block(x as i32, (y + self.place.first_row) as i32);
        let Some((band, block)) = block.filter(|(band, block)| motion.is_still && band.has_matter(*block))
        else {
            return false;
        };
        let context = self.around(x, y, |o| o == Origin::Copied);
        if !self.coder.bit(&mut self.contexts.is_copied[context], plan.origin == Origin::Copied) {
            return false;
        }
        self.band.copy(band, block);
        self.layers.resize(self.band.planes.len(), Coded { means: [0.0; 4], classes: [0; 4] });
        self.origins.push(Origin::Copied);
        true
    }

    /// Context of the origins of the blocks on the left and above.
    fn around(&self, x: usize, y: usize, is: impl Fn(Origin) -> bool) -> usize {
        let state = |block: Option<usize>| block.map_or(0, |b| 1 + usize::from(is(self.origins[b])));
        state(self.left(x)) * 3 + state(self.above(y))
    }

    /// Where the planes come from, and these unless they are fresh.
    fn origin(&mut self, x: usize, y: usize, wanted: Origin, planes: &mut Vec<Planes>) -> Origin {
        let (left, above) = (self.left(x), self.above(y));
        let is_kept = self.around(x, y, |o| o == Origin::Kept);
        let is_merged = self.around(x, y, |o| matches!(o, Origin::Left | Origin::Above));
        if self.offer(Origin::Kept, x, y, planes)
            && self.coder.bit(&mut self.contexts.is_kept[is_kept], wanted == Origin::Kept)
        {
            return Origin::Kept;
        }
        let has = |block: Option<usize>| block.is_some_and(|b| !self.band.layers(b).is_empty());
        let (has_left, has_above) = (has(left), has(above));
        let is_wanted = matches!(wanted, Origin::Left | Origin::Above);
        if !(has_left || has_above) || !self.coder.bit(&mut self.contexts.is_merged[is_merged], is_wanted) {
            return Origin::Fresh;
        }
        let is_above = if has_left && has_above {
            let context = match left.map(|b| self.origins[b]) {
                Some(Origin::Above) => 2,
                Some(Origin::Left) => 1,
                _ => 0,
            };
            self.coder.bit(&mut self.contexts.is_above[context], wanted == Origin::Above)
        } else {
            has_above
        };
        let origin = if is_above { Origin::Above } else { Origin::Left };
        self.offer(origin, x, y, planes);
        origin
    }

    /// Codes the planes of a block.
    fn fresh(&mut self, codes: &[(PlaneCode, PlaneCode)], neighbors: [Range<usize>; 2]) {
        let classes = neighbors.clone().map(|n| count_class(n.len()));
        let models = &mut self.contexts.num_layers[classes[0]][classes[1]];
        let count = self.coder.tree(models, 5, codes.len() as u32).min(MAX_LAYERS as u32);
        let mut last_back: Option<PlaneCode> = None;
        for i in 0..count as usize {
            let (wanted_front, wanted_back) = codes.get(i).copied().unwrap_or_default();
            let touches = last_back.is_some_and(|back| {
                let has_touched = usize::from(i > 1);
                self.coder.bit(&mut self.contexts.touches[has_touched], wanted_front == back)
            });
            let front = match last_back {
                Some(back) if touches => back,
                _ => {
                    let behind =
                        last_back.map_or(f32::NEG_INFINITY, |b| (b.z as f32 - 0.5) * self.steps.depth);
                    self.plane(wanted_front, behind, 0, PlaneCode::default(), &neighbors)
                }
            };
            let behind = front.z as f32 * self.steps.depth;
            let back = self.plane(wanted_back, behind, 1, front, &neighbors);
            self.band.planes.push((self.steps.plane(front), self.steps.plane(back)));
            last_back = Some(back);
        }
    }

    /// Codes a front (`side` 0) or back (1), predicted from the first of the neighbours' that is `behind` a depth.
    fn plane(
        &mut self,
        wanted: PlaneCode,
        behind: f32,
        side: usize,
        otherwise: PlaneCode,
        neighbors: &[Range<usize>; 2],
    ) -> PlaneCode {
        let next = neighbors.clone().map(|layers| {
            let planes = self.band.planes[layers].iter().map(|(f, b)| if side == 0 { *f } else { *b });
            planes.filter(|p| p.z > behind).min_by(|a, b| a.z.total_cmp(&b.z))
        });
        let (expected, context) = match next {
            [Some(a), Some(b)] => {
                let apart = ((a.z - b.z).abs() / self.steps.depth) as u32;
                let nearer = if a.z < b.z { a } else { b };
                let mean =
                    DepthPlane { z: 0.5 * (a.z + b.z), dx: 0.5 * (a.dx + b.dx), dy: 0.5 * (a.dy + b.dy) };
                let context = (apart.saturating_add(1).ilog2() as usize + usize::from(apart > 0))
                    .min(DEPTH_CONTEXTS - 3);
                (self.steps.code(&if apart < 4 { mean } else { nearer }), context)
            }
            [Some(a), None] | [None, Some(a)] => (self.steps.code(&a), DEPTH_CONTEXTS - 2),
            [None, None] => (otherwise, DEPTH_CONTEXTS - 1),
        };
        let coder = &mut self.coder;
        let models = &mut self.contexts.depth[side][context];
        let z = expected.z.saturating_add(coder.signed(models, wanted.z.saturating_sub(expected.z)));
        let models = &mut self.contexts.slope[side][(context / 3).min(3)];
        let mut slope = |wanted: i32, expected: i32| {
            expected.saturating_add(coder.signed(models, wanted.saturating_sub(expected)))
        };
        let (dx, dy) = (slope(wanted.dx, expected.dx), slope(wanted.dy, expected.dy));
        PlaneCode { z, dx, dy }
    }

    /// Codes what is between the planes number `layer`.
    fn layer(
        &mut self,
        layer: usize,
        around: &Around,
        wanted: Option<&BlockLayer>,
        mask_before: &mut Option<u64>,
    ) -> Coded {
        let &Around { x, y, origin, first_layer, ref neighbors } = around;
        let planes = self.band.planes[layer];
        let in_front = layer.checked_sub(1).filter(|&l| l >= first_layer).map(|l| self.layers[l]);
        let expected = self.fetch((x, y), &planes);
        let wanted_mask = wanted.map_or(0, |w| w.mask);
        let likely = match expected.map(u64::count_ones) {
            None => 0,
            Some(0) => 1,
            Some(1..=8) => 2,
            Some(9..=63) => 3,
            Some(_) => 4,
        };
        let kind = match origin {
            Origin::Fresh => 0,
            Origin::Left | Origin::Above => 1,
            Origin::Kept | Origin::Copied => 2,
        };
        let nothing = Coded { means: in_front.map_or([0.0; 4], |l| l.means), classes: [0; 4] };
        if !self.coder.bit(&mut self.contexts.has_matter[kind][likely], wanted_mask != 0) {
            return nothing;
        }
        let inside = self.place.inside(x, y);
        let said = if wanted_mask == inside { u64::MAX } else { wanted_mask };
        let mask = self.contexts.mask(&mut self.coder, *mask_before, expected, said) & inside;
        if mask == 0 {
            return nothing;
        }
        *mask_before = Some(mask);

        let matches = neighbors.clone().map(|n| self.overlapping(n, &planes));
        let means: [f32; 4] = std::array::from_fn(|c| match matches {
            [Some(a), Some(b)] => 0.5 * (a.means[c] + b.means[c]),
            [Some(a), None] | [None, Some(a)] => a.means[c],
            [None, None] => in_front.map_or(0.0, |l| l.means[c]),
        });
        let classes: [[u8; 2]; 4] = std::array::from_fn(|c| {
            let beside = match matches {
                [Some(a), Some(b)] => (a.classes[c] + b.classes[c]) / 2,
                [Some(a), None] | [None, Some(a)] => a.classes[c],
                [None, None] => NO_CLASS,
            };
            [in_front.map_or(NO_CLASS, |l| l.classes[c]), beside]
        });
        let known = expected.map_or(0, |e| (e & mask).count_ones());
        let sources = wanted.filter(|_| C::ENCODES).map(|w| planes_of(w, mask));
        let mut is_inter = 2 * known > mask.count_ones();
        if is_inter {
            let is_better = sources.as_ref().is_some_and(|s| self.is_inter_better(s, &means, mask));
            let full = usize::from(expected == Some(u64::MAX));
            is_inter = self.coder.bit(&mut self.contexts.is_inter[full], is_better);
        }

        let scales = scales();
        let lists = || (0..BLOCK_LISTS).filter(|&i| mask >> i & 1 == 1);
        let num_lists = mask.count_ones() as f32;
        let kappa = lists().map(|i| self.lists.kappa[i]).sum::<f32>() / num_lists;
        let mut coded = Coded { means, classes: [0; 4] };
        let mut step = self.steps.opacity / kappa.max(KAPPA_FLOOR).sqrt();
        let mut values = [[0.0; BLOCK_LISTS]; 4];
        let mut codes = [0; BLOCK_LISTS];
        for c in 0..4 {
            let expected = if is_inter { self.fetched.planes[c] } else { [means[c]; BLOCK_LISTS] };
            if is_inter {
                coded.means[c] = expected.iter().sum::<f32>() * (1.0 / BLOCK_LISTS as f32);
            }
            if c == 1 {
                // How much of a colour is seen is known from what is decoded.
                let seen =
                    |i: usize| self.lists.kappa[i].max(KAPPA_FLOOR) * scales.alpha[usize::from(codes[i])];
                let seen = lists().map(seen).sum::<f32>() / num_lists;
                step = self.steps.color / seen.max(SEEN_FLOOR).sqrt();
            } else if c == 2 {
                step *= self.steps.chroma;
            }
            let component = [0, 1, 2, 2][c] + if is_inter { 4 } else { 0 };
            let source = sources.as_ref().map(|s| &s[c]);
            let (class, mean) = residual(
                &mut self.coder,
                &mut self.contexts,
                component,
                classes[c],
                step,
                mask,
                source,
                &expected,
                &mut values[c],
            );
            coded.classes[c] = class;
            coded.means[c] += mean;
            if c == 0 {
                for i in lists() {
                    codes[i] = scales.code(values[0][i]);
                }
            }
        }
        for i in lists() {
            let ycc = [
                values[1][i].clamp(0.0, MAX_BRIGHTNESS),
                values[2][i].clamp(-1.0, 1.0),
                values[3][i].clamp(-1.0, 1.0),
            ];
            let alpha = scales.alpha[usize::from(codes[i])];
            self.lists.push(i, &planes, codes[i], ycc.map(fixed_from_f32), alpha);
        }
        coded
    }

    /// Fetches what the reference has between two planes; the lists that have any.
    fn fetch(&mut self, (x, y): (usize, usize), planes: &Planes) -> Option<u64> {
        let (reference, motion) = self.reference.as_ref()?;
        let y = y + self.place.first_row;
        let [mx, my] = [x, y].map(|v| (v * BLOCK) as f32 + HALF);
        let shift = motion.at(mx, my, 0.5 * (planes.0.z + planes.1.z))?;
        self.fetched.fetch(reference, (x, y), planes, shift, self.steps.depth);
        Some(self.fetched.mask)
    }

    /// The layer that has most depth in common with a pair of planes.
    fn overlapping(&self, layers: Range<usize>, planes: &Planes) -> Option<Coded> {
        let common = |l: usize| {
            let (front, back) = self.band.planes[l];
            back.z.min(planes.1.z) - front.z.max(planes.0.z)
        };
        let best =
            layers.map(|l| (common(l), l)).filter(|(c, _)| *c > 0.0).max_by(|a, b| a.0.total_cmp(&b.0));
        best.map(|(_, l)| self.layers[l])
    }

    /// Whether the moved reference is nearer to the source than a constant is.
    fn is_inter_better(&self, sources: &[Plane; 4], means: &[f32; 4], mask: u64) -> bool {
        let lists = || (0..BLOCK_LISTS).filter(|&i| mask >> i & 1 == 1);
        let (mut intra, mut inter) = (0.0, 0.0);
        for c in 0..2 {
            let mean = lists().map(|i| sources[c][i]).sum::<f32>() / mask.count_ones() as f32;
            intra += 8.0 * (mean - means[c]).abs();
            for i in lists() {
                intra += (sources[c][i] - mean).abs();
                inter += (sources[c][i] - self.fetched.planes[c][i]).abs();
            }
        }
        inter < intra
    }
}

/// Codes what a plane differs by from what is expected of it, and writes its values. Returns the class, and by how
/// much the mean differs.
#[expect(clippy::too_many_arguments, reason = "two directions in one function")]
pub(super) fn residual<C: Coder>(
    coder: &mut C,
    contexts: &mut Contexts,
    component: usize,
    near: [u8; 2],
    step: f32,
    mask: u64,
    source: Option<&Plane>,
    expected: &Plane,
    values: &mut Plane,
) -> (u8, f32) {
    let mut levels = Levels::ZERO;
    if let (true, Some(source)) = (C::ENCODES, source) {
        let mut difference: Plane = std::array::from_fn(|i| source[i] - expected[i]);
        fill_in(&mut difference, mask);
        let rounding =
            if component < FIRST_INTER || component == CORRECTION { ROUNDING } else { INTER_ROUNDING };
        quantize(&forward(&difference), step, rounding, &mut levels);
    }
    let class = contexts.coefficients(coder, component, near, &mut levels);
    *values = *expected;
    if levels.length == 0 {
        return (class, 0.0);
    }
    let mut coefficients = [0.0; BLOCK_LISTS];
    for (k, &level) in levels.values[..levels.length].iter().enumerate() {
        if level != 0 {
            let size = level.unsigned_abs() as f32 - if k > 0 { TOWARDS_ZERO } else { 0.0 };
            coefficients[usize::from(ZIGZAG[k])] = if level < 0 { -size * step } else { size * step };
        }
    }
    let mean = coefficients[0] * (1.0 / BLOCK as f32);
    if levels.length == 1 {
        values.iter_mut().for_each(|v| *v += mean);
    } else {
        for (value, difference) in values.iter_mut().zip(inverse(&coefficients)) {
            *value += difference;
        }
    }
    (class, mean)
}

/// Levels of coefficients.
fn quantize(coefficients: &Plane, step: f32, rounding: [f32; 2], levels: &mut Levels) {
    levels.length = 0;
    for (k, &place) in ZIGZAG.iter().enumerate() {
        let coefficient = coefficients[usize::from(place)];
        let size = (coefficient.abs() / step + rounding[usize::from(k > 0)]) as i32;
        levels.values[k] = if coefficient < 0.0 { -size } else { size };
        if size > 0 {
            levels.length = k + 1;
        }
    }
}

/// u, Y, Co, Cg of a layer's lists.
fn planes_of(layer: &BlockLayer, mask: u64) -> [Plane; 4] {
    let mut planes = [[0.0; BLOCK_LISTS]; 4];
    for i in (0..BLOCK_LISTS).filter(|&i| mask >> i & 1 == 1) {
        planes[0][i] = scales().u_from_tau(layer.tau[i]);
        let [y, co, cg] = ycc_from_color(layer.c[i], -(-layer.tau[i]).exp_m1());
        (planes[1][i], planes[2][i], planes[3][i]) = (y, co, cg);
    }
    planes
}

/// A plane with numbers that stay finite whatever is done to them.
fn bounded(z: f32, dx: f32, dy: f32) -> DepthPlane {
    let slope = |s: f32| s.clamp(-MAX_SLOPE, MAX_SLOPE);
    DepthPlane { z: z.clamp(-MAX_DEPTH, MAX_DEPTH), dx: slope(dx), dy: slope(dy) }
}

impl Steps {
    /// The plane of a code.
    fn plane(&self, code: PlaneCode) -> DepthPlane {
        let slope = self.depth * 0.25;
        bounded(code.z as f32 * self.depth, code.dx as f32 * slope, code.dy as f32 * slope)
    }

    /// The code of the nearest plane.
    pub(super) fn code(&self, plane: &DepthPlane) -> PlaneCode {
        let nearest = |v: f32, step: f32| (v / step + 0.5).floor() as i32;
        let slope = self.depth * 0.25;
        PlaneCode {
            z: nearest(plane.z, self.depth),
            dx: nearest(plane.dx, slope),
            dy: nearest(plane.dy, slope),
        }
    }

    /// The codes of layers' planes: what all but touches does, and every back is behind its front.
    pub(super) fn codes(&self, layers: &[BlockLayer], out: &mut Vec<(PlaneCode, PlaneCode)>) {
        out.clear();
        for layer in layers {
            let (mut front, mut back) = (self.code(&layer.front), self.code(&layer.back));
            if let Some((_, before)) = out.last()
                && front.z <= before.z + 1
            {
                front = *before;
            }
            back.z = back.z.max(front.z + 1);
            out.push((front, back));
        }
    }

    /// The planes that a decoder makes of codes.
    pub(super) fn planes(&self, codes: &[(PlaneCode, PlaneCode)], out: &mut Vec<Planes>) {
        out.clear();
        out.extend(codes.iter().map(|(front, back)| (self.plane(*front), self.plane(*back))));
    }
}

/// Least visibility in the steps: what is hidden here is seen from another pose.
const KAPPA_FLOOR: f32 = 0.2;
/// Least visible opacity in the steps of colour.
const SEEN_FLOOR: f32 = 0.02;
const MAX_BRIGHTNESS: f32 = 1.5;
/// What is added to constant and other coefficients before levels are cut off. Larger dead zones cost more of the picture than they
/// save.
const ROUNDING: [f32; 2] = [0.5, 0.45];
/// After a moved reference, which has errors of about half a step itself, they save more than they cost.
const INTER_ROUNDING: [f32; 2] = [0.4, 0.32];
/// Components from here on are predicted from a reference, but for the last.
const FIRST_INTER: usize = 4;
const CORRECTION: usize = 7;
/// How much nearer to zero than its level a coefficient is on average.
const TOWARDS_ZERO: f32 = 0.05;
/// Half of a block in lists.
const HALF: f32 = BLOCK as f32 / 2.0;
const MAX_DEPTH: f32 = 1e7;
const MAX_SLOPE: f32 = 1e6;
