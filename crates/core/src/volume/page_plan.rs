//! Which pages of a large volume a view wants.
//!
//! A viewer's *plan* refines the volume page by page, where a voxel is largest on the screen first, until its share of
//! the memory is full. A plan depends on the pose, the look and the memory only. While the camera moves, it ends where a
//! voxel is a pixel.

use std::collections::{BinaryHeap, HashMap, HashSet};

use glam::Vec3;

use super::pages::PageView;
use super::pyramid::{PAGE_CELLS, PageId, Pyramid};
use crate::clip::Region;
use crate::space::Aabb;

/// The pages for a view.
#[derive(Clone, Debug, Default)]
pub struct PagePlan {
    /// The pages in the order in which they are read. Each follows a coarser one that it replaces.
    pub(super) steps: Vec<PageId>,
    /// Those that nothing finer replaces.
    pub(super) leaves: HashSet<PageId>,
    /// For each step that finer pages replace, these.
    pub(super) parts: HashMap<PageId, Vec<PageId>>,
    /// Pages of the coarsest level that nothing finer replaces.
    pub(super) coarsest: Vec<PageId>,
    /// The level that is held whole in place of pages.
    pub(super) level: Option<u8>,
    /// Share of the view that the finest level does not fill for lack of memory, 0 to 1.
    pub(super) coarse_share: f32,
    /// About the part of the picture that all of the view fills, in no unit.
    pub(super) size: f32,
    /// Whether the camera rests.
    pub(super) rests: bool,
}

/// A page in the making of a plan, by the size of its voxels on the screen.
struct Candidate {
    pixels: f32,
    id: PageId,
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Candidate {}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        let by_level = self.id.level.cmp(&other.id.level);
        self.pixels.total_cmp(&other.pixels).then(by_level).then_with(|| other.id.cmp(&self.id))
    }
}

impl PagePlan {
    /// The plan for a view with memory for so many pages beside those of the coarsest level. `is_visible` says whether
    /// anything of a page may be seen; it errs on the side of yes.
    pub fn of(
        pyramid: &Pyramid,
        view: &PageView,
        max_pages: usize,
        is_visible: impl Fn(PageId) -> bool,
    ) -> Self {
        let screen = Screen::of(pyramid, view);
        let last = pyramid.levels.len().saturating_sub(1) as u8;
        let mut plan = Self { rests: view.rests, ..Self::default() };
        let mut heap = BinaryHeap::new();
        let offer = |heap: &mut BinaryHeap<Candidate>, id: PageId| {
            let pixels = screen.pixels(id);
            heap.push(Candidate { pixels, id });
        };
        for id in places([0; 3], pyramid.pages(usize::from(last))).map(|at| PageId { level: last, at }) {
            if screen.sees(id) && is_visible(id) {
                offer(&mut heap, id);
            }
        }
        // Finer leaves are in the plan.
        let stays = |coarsest: &mut Vec<PageId>, id: PageId| {
            if id.level == last && last > 0 {
                coarsest.push(id);
            }
        };
        let enough = if view.rests { 0.0 } else { PIXELS_IN_MOTION };
        let (mut num_pages, mut coarse, mut all) = (0, 0.0, 0.0);
        // The coarsest level of which a page has no room for its parts. Pages of finer levels get none, either: nowhere is a
        // picture much coarser than beside.
        let mut least_level = 0;
        while let Some(Candidate { pixels, id }) = heap.pop() {
            let finer_level = id.level.checked_sub(1).filter(|_| pixels > enough);
            let Some(level) = finer_level else {
                all += screen.share(id);
                if id.level > 0 {
                    stays(&mut plan.coarsest, id);
                }
                continue;
            };
            let finer = parts(pyramid, id, level).filter(|id| screen.sees(*id) && is_visible(*id));
            let finer: Vec<PageId> = finer.collect();
            // The page that they replace is free once they are there.
            let freed = usize::from(id.level != last);
            if id.level < least_level || num_pages + finer.len() > max_pages + freed {
                least_level = least_level.max(id.level);
                coarse += screen.share(id);
                all += screen.share(id);
                stays(&mut plan.coarsest, id);
                continue;
            }
            num_pages = num_pages + finer.len() - freed;
            plan.leaves.remove(&id);
            for finer in &finer {
                plan.steps.push(*finer);
                plan.leaves.insert(*finer);
                offer(&mut heap, *finer);
            }
            plan.parts.insert(id, finer);
        }
        plan.coarse_share = if all > 0.0 { coarse / all } else { 0.0 };
        plan.size = all;
        plan
    }

    /// The same view by a level that is held whole, if pages would show a part of it coarser than that.
    pub fn or_level(self, pyramid: &Pyramid, level: u8) -> Self {
        let last = pyramid.levels.len().saturating_sub(1) as u8;
        let of_leaves = self.leaves.iter().map(|id| id.level).max().unwrap_or(0);
        let coarsest = if self.coarsest.is_empty() { of_leaves } else { last };
        if coarsest <= level {
            return self;
        }
        Self {
            steps: pyramid.page_ids(level).collect(),
            coarsest: pyramid.page_ids(last).collect(),
            level: Some(level),
            coarse_share: if level > 0 { 1.0 } else { 0.0 },
            size: self.size,
            rests: self.rests,
            ..Self::default()
        }
    }

    /// The pages that the view wants in the end.
    pub fn leaves(&self) -> &HashSet<PageId> {
        &self.leaves
    }
}

/// The camera over the finest level's indices.
struct Screen<'a> {
    pyramid: &'a Pyramid,
    view: &'a PageView,
    /// Inward normals and offsets of the sides of the picture.
    sides: Vec<(Vec3, f32)>,
    /// Pixels of a world unit at distance 1, or at any distance.
    pixels_per_unit: f32,
}

impl<'a> Screen<'a> {
    fn of(pyramid: &'a Pyramid, view: &'a PageView) -> Self {
        let camera = &view.camera;
        let size = camera.intrinsics;
        let (width, height) = (size.width as f32, size.height as f32);
        let corners = [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]];
        let rays = corners.map(|[x, y]| camera.ray(x, y).0);
        let (middle, _) = camera.ray(0.5 * width, 0.5 * height);
        let inside = middle.origin + middle.dir * camera.far.max(1.0);
        let mut sides = Vec::new();
        for i in 0..4 {
            let (a, b) = (rays[i], rays[(i + 1) % 4]);
            let far = b.origin + b.dir * camera.far;
            let normal = a.dir.cross(far - a.origin).normalize_or_zero();
            let offset = normal.dot(a.origin);
            let turn = if normal.dot(inside) < offset { -1.0 } else { 1.0 };
            sides.push((normal * turn, offset * turn));
        }
        let forward = middle.dir;
        sides.push((forward, forward.dot(middle.origin) - size_of(pyramid) * BEHIND));
        let apart = {
            let (a, b) =
                (camera.ray(0.5 * width, 0.5 * height).0, camera.ray(0.5 * width + 1.0, 0.5 * height).0);
            if size.projection.is_orthographic() {
                a.origin.distance(b.origin)
            } else {
                a.dir.distance(b.dir)
            }
        };
        Self { pyramid, view, sides, pixels_per_unit: 1.0 / apart.max(f32::MIN_POSITIVE) }
    }

    /// The box of a page, world space.
    fn bounds(&self, id: PageId) -> Aabb {
        let factor = self.pyramid.level(id).factor;
        let dims = self.pyramid.dims();
        let edge = |i: usize, at: u32| {
            let index = (u64::from(at) * u64::from(factor[i] * PAGE_CELLS)) as f32;
            (index.min(dims[i] as f32 - 1.0) + 0.5 - 0.5 * dims[i] as f32) * self.pyramid.spacing[i]
        };
        // Half a voxel more: the outermost pages go on to the faces, and steps begin before their page.
        let more = self.pyramid.spacing;
        Aabb {
            min: Vec3::from_array(std::array::from_fn(|i| edge(i, id.at[i]))) - more,
            max: Vec3::from_array(std::array::from_fn(|i| edge(i, id.at[i] + 1))) + more,
        }
    }

    /// Whether anything of a page's box may be in the picture.
    fn sees(&self, id: PageId) -> bool {
        let bounds = self.bounds(id);
        let Region { bounds: region, normal, offset } = &self.view.region;
        let meets = bounds.min.cmple(region.max).all() && region.min.cmple(bounds.max).all();
        let half = (bounds.max - bounds.min) * 0.5;
        let center = bounds.center();
        let is_inside = |normal: Vec3, offset: f32| normal.dot(center) + normal.abs().dot(half) >= offset;
        meets
            && is_inside(*normal, *offset)
            && self.sides.iter().all(|(normal, offset)| is_inside(*normal, *offset))
    }

    fn distance(&self, bounds: &Aabb) -> f32 {
        let eye = self.view.camera.pose.eye;
        eye.clamp(bounds.min, bounds.max).distance(eye)
    }

    /// Pixels of a voxel of a page on the screen, at its nearest point.
    fn pixels(&self, id: PageId) -> f32 {
        let factor = Vec3::from_array(self.pyramid.level(id).factor.map(|f| f as f32));
        let voxel = (self.pyramid.spacing * factor).max_element();
        if self.view.camera.intrinsics.projection.is_orthographic() {
            return voxel * self.pixels_per_unit;
        }
        let near = self.pyramid.spacing.min_element();
        voxel * self.pixels_per_unit / self.distance(&self.bounds(id)).max(near)
    }

    /// About the part of the picture that a page fills, in no unit.
    fn share(&self, id: PageId) -> f32 {
        let bounds = self.bounds(id);
        let side = (bounds.max - bounds.min).length();
        if self.view.camera.intrinsics.projection.is_orthographic() {
            return side * side;
        }
        let relative = side / self.distance(&bounds).max(side);
        relative * relative
    }
}

fn size_of(pyramid: &Pyramid) -> f32 {
    let dims = pyramid.dims().map(|d| d as f32);
    (Vec3::from_array(dims) * pyramid.spacing).length()
}

/// The pages of a finer level within a page.
fn parts(pyramid: &Pyramid, id: PageId, level: u8) -> impl Iterator<Item = PageId> {
    let (coarse, fine) = (pyramid.level(id).factor, pyramid.levels[usize::from(level)].factor);
    let most = pyramid.pages(usize::from(level));
    let first = std::array::from_fn(|i| id.at[i] * (coarse[i] / fine[i]));
    let end = std::array::from_fn(|i| ((id.at[i] + 1) * (coarse[i] / fine[i])).min(most[i]));
    places(first, end).map(move |at| PageId { level, at })
}

/// All places of a box of the grid.
fn places(first: [u32; 3], end: [u32; 3]) -> impl Iterator<Item = [u32; 3]> {
    let [xs, ys, zs] = [0, 1, 2].map(|i| first[i]..end[i]);
    zs.flat_map(move |z| {
        let xs = xs.clone();
        ys.clone().flat_map(move |y| xs.clone().map(move |x| [x, y, z]))
    })
}

/// While the camera moves, voxels need not be smaller on the screen.
const PIXELS_IN_MOTION: f32 = 1.0;
/// How far behind the eye a page may lie, in sizes of the volume: boxes are tested by their nearest corners.
const BEHIND: f32 = 1e-3;
