//! Codes the depth planes of a block in steps, predicted from those of the blocks to the left and above.

use std::ops::Range;

use super::super::entropy::Coder;
use super::super::model::{BLOCK, DepthPlane, MAX_LAYERS};
use super::super::steps::StepSizes;
use super::super::syntax::{DEPTH_CONTEXTS, count_class};
use super::super::tile::Planes;
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
                    let behind =
                        last_back.map_or(f32::NEG_INFINITY, |b| (b.z as f32 - 0.5) * self.steps.depth);
                    self.plane(wanted_front, behind, 0, PlaneCode::default(), &neighbors)
                }
            };
            let behind = front.z as f32 * self.steps.depth;
            let back = self.plane(wanted_back, behind, 1, front, &neighbors);
            self.tile.planes.push((self.steps.plane(front), self.steps.plane(back)));
            last_back = Some(back);
        }
    }

    /// Codes a front (`side` 0) or back (1). The prediction is each neighbour's first plane that is `behind` a depth.
    fn plane(
        &mut self,
        wanted: PlaneCode,
        behind: f32,
        side: usize,
        otherwise: PlaneCode,
        neighbors: &[Range<usize>; 2],
    ) -> PlaneCode {
        let front = (side == 1).then(|| self.steps.plane(otherwise));
        let next = [(0, (1.0, 0.0)), (1, (0.0, 1.0))].map(|(neighbor, step)| {
            let planes = self.tile.planes[neighbors[neighbor].clone()].iter().map(|(f, b)| {
                let (f, b) = (continued(f, step), continued(b, step));
                match &front {
                    None => f,
                    // Half-way between the neighbour's back and one that makes the layer as thick as the neighbour's.
                    Some(own) => DepthPlane {
                        z: b.z + 0.5 * (own.z - f.z),
                        dx: b.dx + 0.5 * (own.dx - f.dx),
                        dy: b.dy + 0.5 * (own.dy - f.dy),
                    },
                }
            });
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

/// A plane continued by `step` blocks rightwards and downwards.
pub(super) fn continued(p: &DepthPlane, step: (f32, f32)) -> DepthPlane {
    bounded(p.z + BLOCK as f32 * (step.0 * p.dx + step.1 * p.dy), p.dx, p.dy)
}

/// A plane with bounded numbers, so that all later results are finite.
pub(super) fn bounded(z: f32, dx: f32, dy: f32) -> DepthPlane {
    let slope = |s: f32| s.clamp(-MAX_SLOPE, MAX_SLOPE);
    DepthPlane { z: z.clamp(-MAX_DEPTH, MAX_DEPTH), dx: slope(dx), dy: slope(dy) }
}

impl StepSizes {
    /// The plane of a code.
    fn plane(&self, code: PlaneCode) -> DepthPlane {
        let slope = self.depth * 0.25;
        bounded(code.z as f32 * self.depth, code.dx as f32 * slope, code.dy as f32 * slope)
    }

    /// The code of the nearest plane.
    pub(in crate::codec::blocks) fn code(&self, plane: &DepthPlane) -> PlaneCode {
        // `floor` would be a function call on machines without an instruction for it.
        let nearest = |v: f32, step: f32| {
            let (code, whole) = (v / step + 0.5, (v / step + 0.5) as i32);
            whole - i32::from(whole as f32 > code)
        };
        let slope = self.depth * 0.25;
        PlaneCode {
            z: nearest(plane.z, self.depth),
            dx: nearest(plane.dx, slope),
            dy: nearest(plane.dy, slope),
        }
    }

    /// The codes of planes. A front that nearly touches the back before it is that back, and every back is behind its
    /// front.
    pub(in crate::codec::blocks) fn codes(&self, planes: &[Planes], out: &mut Vec<(PlaneCode, PlaneCode)>) {
        out.clear();
        for (front, back) in planes {
            let (mut front, mut back) = (self.code(front), self.code(back));
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
    pub(in crate::codec::blocks) fn planes(&self, codes: &[(PlaneCode, PlaneCode)], out: &mut Vec<Planes>) {
        out.clear();
        out.extend(codes.iter().map(|(front, back)| (self.plane(*front), self.plane(*back))));
    }
}

const MAX_DEPTH: f32 = 1e7;
const MAX_SLOPE: f32 = 1e6;
