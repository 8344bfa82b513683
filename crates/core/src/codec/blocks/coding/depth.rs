//! Codes the depth planes of a block in steps, predicted from those of the blocks to the left and above.

use std::ops::Range;

use super::super::entropy::Coder;
use super::super::model::{DepthPlane, MAX_LAYERS, PlaneFit, SIXTEENTHS};
use super::super::steps::StepSizes;
use super::super::syntax::{DEPTH_CONTEXTS, count_class};
use super::TileCoder;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::codec::blocks) struct PlaneCode {
    pub(in crate::codec::blocks) z: i32,
    pub(in crate::codec::blocks) dx: i32,
    pub(in crate::codec::blocks) dy: i32,
}

impl<C: Coder> TileCoder<'_, C> {
    /// Codes the planes of a block.
    pub(super) fn fresh(&mut self, codes: &[(PlaneCode, PlaneCode)], neighbors: [Range<usize>; 2]) {
        let classes = neighbors.clone().map(|n| count_class(n.len()));
        let contexts = &self.contexts.num_layers[classes[0]][classes[1]];
        let count = self.coder.tree(contexts, 5, codes.len() as u32).min(MAX_LAYERS as u32);
        let mut last_back: Option<PlaneCode> = None;
        for i in 0..count as usize {
            let (wanted_front, wanted_back) = codes.get(i).copied().unwrap_or_default();
            let touches = last_back.is_some_and(|back| {
                let has_touched = usize::from(i > 1);
                self.coder.bit(self.contexts.touches[has_touched], wanted_front == back)
            });
            let front = match last_back {
                Some(back) if touches => back,
                _ => {
                    let behind = last_back.map_or(i32::MIN, |back| {
                        self.steps.plane(back).z - i32::from(self.steps.depth) * SIXTEENTHS / 2
                    });
                    self.plane(wanted_front, behind, 0, PlaneCode::default(), &neighbors)
                }
            };
            let behind = self.steps.plane(front).z;
            let back = self.plane(wanted_back, behind, 1, front, &neighbors);
            self.tile.planes.push((self.steps.plane(front), self.steps.plane(back)));
            last_back = Some(back);
        }
    }

    /// Codes a front (`side` 0) or back (1). The prediction is each neighbour's first plane that is `behind` a depth.
    fn plane(
        &mut self,
        wanted: PlaneCode,
        behind: i32,
        side: usize,
        otherwise: PlaneCode,
        neighbors: &[Range<usize>; 2],
    ) -> PlaneCode {
        let front = (side == 1).then(|| self.steps.plane(otherwise));
        let next = [(0, [1, 0]), (1, [0, 1])].map(|(neighbor, step)| {
            let planes = self.tile.planes[neighbors[neighbor].clone()].iter().map(|(f, b)| {
                let (f, b) = (f.continued(step), b.continued(step));
                match &front {
                    None => f,
                    // Half-way between the neighbour's back and one that makes the layer as thick as the neighbour's.
                    Some(own) => DepthPlane {
                        z: b.z + ((own.z - f.z) >> 1),
                        dx: b.dx + ((own.dx - f.dx) >> 1),
                        dy: b.dy + ((own.dy - f.dy) >> 1),
                    },
                }
            });
            planes.filter(|p| p.z > behind).min_by_key(|p| p.z)
        });
        let (expected, context) = match next {
            [Some(a), Some(b)] => {
                let apart = (a.z - b.z).unsigned_abs() / (u32::from(self.steps.depth) * SIXTEENTHS as u32);
                let nearer = if a.z < b.z { a } else { b };
                let mean = DepthPlane { z: (a.z + b.z) >> 1, dx: (a.dx + b.dx) >> 1, dy: (a.dy + b.dy) >> 1 };
                let context = (apart.saturating_add(1).ilog2() as usize + usize::from(apart > 0))
                    .min(DEPTH_CONTEXTS - 3);
                (self.steps.code(&if apart < 4 { mean } else { nearer }), context)
            }
            [Some(a), None] | [None, Some(a)] => (self.steps.code(&a), DEPTH_CONTEXTS - 2),
            [None, None] => (otherwise, DEPTH_CONTEXTS - 1),
        };
        let coder = &mut self.coder;
        let contexts = &self.contexts.depth[side][context];
        let z = expected.z.saturating_add(coder.signed(contexts, wanted.z.saturating_sub(expected.z)));
        let contexts = &self.contexts.slope[side][(context / 3).min(3)];
        let mut slope = |wanted: i32, expected: i32| {
            expected.saturating_add(coder.signed(contexts, wanted.saturating_sub(expected)))
        };
        let (dx, dy) = (slope(wanted.dx, expected.dx), slope(wanted.dy, expected.dy));
        PlaneCode { z, dx, dy }
    }
}

impl StepSizes {
    /// Steps of depth and of slope, sixteenths of a unit.
    fn of_planes(&self) -> [i32; 2] {
        let depth = i32::from(self.depth);
        [depth * SIXTEENTHS, depth * SIXTEENTHS / 4]
    }

    /// The plane of a code.
    fn plane(&self, code: PlaneCode) -> DepthPlane {
        let [depth, slope] = self.of_planes();
        // Beyond this, a product would be beyond the bounds of a plane.
        let times = |code: i32, step: i32| code.clamp(-MOST_NUMBER / step, MOST_NUMBER / step) * step;
        DepthPlane::bounded(times(code.z, depth), times(code.dx, slope), times(code.dy, slope))
    }

    /// The code of the nearest plane.
    fn code(&self, plane: &DepthPlane) -> PlaneCode {
        let nearest = |v: i32, step: i32| (v + step / 2).div_euclid(step);
        let [depth, slope] = self.of_planes();
        PlaneCode { z: nearest(plane.z, depth), dx: nearest(plane.dx, slope), dy: nearest(plane.dy, slope) }
    }

    /// The codes of planes. A front that nearly touches the back before it is that back, and every back is behind its
    /// front.
    pub(in crate::codec::blocks) fn codes(
        &self,
        planes: &[(PlaneFit, PlaneFit)],
        out: &mut Vec<(PlaneCode, PlaneCode)>,
    ) {
        let number = |v: f32| (v * SIXTEENTHS as f32).round() as i32;
        let code = |p: &PlaneFit| self.code(&DepthPlane::bounded(number(p.z), number(p.dx), number(p.dy)));
        out.clear();
        for (front, back) in planes {
            let (mut front, mut back) = (code(front), code(back));
            if let Some((_, before)) = out.last()
                && front.z <= before.z + 1
            {
                front = *before;
            }
            back.z = back.z.max(front.z + 1);
            out.push((front, back));
        }
    }

    /// The planes that a decoder makes of the codes.
    pub(in crate::codec::blocks) fn planes(
        &self,
        codes: &[(PlaneCode, PlaneCode)],
        out: &mut Vec<(PlaneFit, PlaneFit)>,
    ) {
        out.clear();
        out.extend(codes.iter().map(|(front, back)| (self.plane(*front).fit(), self.plane(*back).fit())));
    }
}

/// Greater than every number of a plane.
const MOST_NUMBER: i32 = 1 << 24;
