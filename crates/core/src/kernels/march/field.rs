//! What a march reads along a part of a ray: the texels of a whole volume, or of one page.

use glam::Vec3;

use super::grid::{Grid, GridShape, Texels, TexelsOf};
use super::mixed::AnyGrid;
use super::pages::{PageCell, PageLook};
use super::{Lattice, Scene};
use crate::kernels::march::glossy::VoxelRay;
use crate::volume::{BRICK, Bricks, Lit, Occupancy, PAGE_CELLS, Page, PageSet, Volume};

/// The texels of one grid.
pub(super) struct MarchField<'a, T> {
    pub(super) voxels: Grid<T>,
    pub(super) lit: Option<(Grid<&'a [u8]>, &'a Lit)>,
    /// Voxels with nothing in them.
    pub(super) gaps: Option<Grid<&'a [u8]>>,
    /// All visible channels, if the march mixes them.
    pub(super) channels: Vec<AnyGrid<'a>>,
    pub(super) occupancy: &'a Occupancy,
    /// Where the first brick begins, voxel space.
    pub(super) first_brick: Vec3,
    pub(super) max_brick: Vec3,
    /// See [`Volume::steepness`].
    pub(super) steepness: Vec3,
    /// From the voxel space of the scene to that of the texels: a factor and an offset.
    place: (Vec3, Vec3),
    /// The level of a page.
    level: u8,
    /// Whether anything of it may be seen.
    is_visible: bool,
}

/// A part of a ray that is marched in one field, in lattice points.
#[derive(Clone, Copy, Debug)]
pub(super) struct Run {
    /// Steps begin before this point,
    pub(super) end: u32,
    /// and end before or at this one.
    pub(super) limit: u32,
    /// Lattice points of a step.
    pub(super) pace: u32,
}

impl<'a, T: TexelsOf<'a>> MarchField<'a, T> {
    /// A whole volume, or a process's part of one in the voxel space of the whole. `texels` are those of the first marched
    /// channel.
    pub(super) fn whole(scene: &'a Scene, texels: T) -> Self {
        let volume = &*scene.volume;
        let shape = GridShape::held(volume.dims(), volume.first());
        let first_brick = Vec3::from_array(Bricks::first(volume).map(|brick| (brick * BRICK) as f32));
        let lit = scene.illumination.lit().map(|lit| &**lit);
        Self {
            place: (Vec3::ONE, Vec3::ZERO),
            level: 0,
            is_visible: true,
            ..Self::new(scene, texels, shape, (volume, lit), &scene.occupancy, first_brick)
        }
    }

    /// A page, or a level that is held whole.
    pub(super) fn page(scene: &'a Scene, set: &'a PageSet, page: &'a Page, look: &'a PageLook) -> Self {
        let volume = scene.first_of_page(page);
        let level = set.pyramid().level(page.id);
        let first = set.pyramid().first_point(page.id);
        let shape = GridShape::part(volume.dims(), first, level.dims);
        let start = Vec3::from_array(first.map(|i| i as f32));
        let field = Self::new(
            scene,
            T::of(volume.voxels()),
            shape,
            (volume, look.lit().map(|lit| &**lit)),
            &look.occupancy,
            start,
        );
        Self {
            place: level.place(),
            level: page.id.level,
            is_visible: look.is_visible,
            channels: scene
                .channels_of_page(page)
                .map(|volume| AnyGrid::of(volume.voxels(), shape))
                .collect(),
            ..field
        }
    }

    fn new(
        scene: &'a Scene,
        texels: T,
        shape: GridShape,
        (volume, lit): (&'a Volume, Option<&'a Lit>),
        occupancy: &'a Occupancy,
        first_brick: Vec3,
    ) -> Self {
        let channels = if scene.is_mixed() { scene.marched_volumes().collect() } else { Vec::new() };
        Self {
            voxels: Grid::new(texels, shape),
            lit: lit.map(|lit| (Grid::new(&lit.shares[..], shape), lit)),
            gaps: volume.gaps().map(|gaps| Grid::new(&gaps.bytes[..], shape)),
            channels: channels.into_iter().map(|volume| AnyGrid::of(volume.voxels(), shape)).collect(),
            occupancy,
            first_brick,
            max_brick: Vec3::from_array(occupancy.dims.map(|n| n as f32 - 1.0)),
            steepness: volume.steepness(),
            place: (Vec3::ONE, Vec3::ZERO),
            level: 0,
            is_visible: true,
        }
    }
}

impl<T: Texels> MarchField<'_, T> {
    /// A ray of the scene's voxel space in that of the texels.
    #[inline(always)]
    pub(super) fn ray(&self, ray: &VoxelRay) -> VoxelRay {
        let (scale, offset) = self.place;
        VoxelRay { origin: ray.origin * scale + offset, dir: ray.dir * scale, ..*ray }
    }
}

/// The fields of a scene.
pub(super) struct Fields<'a, T> {
    /// The whole volume; of a scene with pages, its coarsest level.
    whole: MarchField<'a, T>,
    /// The pages, in the order of their set.
    pages: Vec<MarchField<'a, T>>,
    set: Option<(&'a PageSet, &'a [PageCell])>,
    /// Greatest index of the finest level along x, y, z.
    last: Vec3,
}

impl<'a, T: TexelsOf<'a>> Fields<'a, T> {
    pub(super) fn of(scene: &'a Scene, texels: T) -> Self {
        let whole = MarchField::whole(scene, texels);
        let Some(pages) = &scene.pages else {
            return Self { whole, pages: Vec::new(), set: None, last: Vec3::ZERO };
        };
        let set = &*pages.set;
        let each = set.pages().iter().zip(&pages.looks);
        let fields = each.map(|(page, look)| MarchField::page(scene, set, page, look)).collect();
        let last = Vec3::from_array(set.pyramid().dims().map(|n| n as f32 - 1.0));
        Self { whole, pages: fields, set: Some((set, &pages.table)), last }
    }
}

impl<'a, T: Texels> Fields<'a, T> {
    /// The field at lattice point `i` of a ray, and how far it reaches. `None` if the rest of the ray meets nothing.
    /// Skips what cannot be seen, and tells the new point by `i`.
    #[inline(always)]
    pub(super) fn run(
        &self,
        ray: &VoxelRay,
        lattice: Lattice,
        i: &mut u32,
        stride: u32,
    ) -> Option<(&MarchField<'a, T>, Run)> {
        let n = lattice.n;
        let Some((set, table)) = self.set else {
            return (*i < n).then_some((&self.whole, Run { end: n, limit: n, pace: 1 }));
        };
        while *i < n {
            // A step belongs to the page of its middle, so both ends are at most half a step outside.
            let half = 0.5 * stride as f32;
            let at = self.cell(set, ray, lattice, *i as f32 + half);
            let PageCell { slot, block } = table[set.cell(at)];
            let field = self.pages.get(slot as usize);
            // Finer pages may stand for other parts of the same page.
            let faces = set.pyramid().faces(set.pyramid().page_over(at, block));
            let leaves = Vec3::select(ray.dir.cmpgt(Vec3::ZERO), faces.1, faces.0);
            let exit = ((leaves - ray.origin) * ray.dir.recip()).min_element();
            let end = ((exit - lattice.s0) / lattice.h - half).ceil();
            let end = if end < n as f32 { (end as u32).max(*i + 1) } else { n };
            let in_level = ray.dir * field.map_or(Vec3::ONE, |field| field.place.0);
            let pace = ((ray.dir.length() / in_level.length()) * (1.0 + 1e-4)) as u32;
            let pace = pace.max(1);
            let Some(field) = field.filter(|field| field.is_visible) else {
                let step = stride.saturating_mul(pace);
                *i = i.saturating_add((end - *i).div_ceil(step).saturating_mul(step)).min(n);
                continue;
            };
            let level_at = |place: f32| {
                let cell = set.cell(self.cell(set, ray, lattice, place));
                self.pages.get(table[cell].slot as usize).map_or(0, |field| field.level)
            };
            let is_same = end >= n || level_at(end as f32 + half) == field.level;
            return Some((field, Run { end, limit: if is_same { n } else { end }, pace }));
        }
        None
    }

    /// The page of the finest level at a place of the lattice, in steps.
    #[inline(always)]
    fn cell(&self, set: &PageSet, ray: &VoxelRay, lattice: Lattice, place: f32) -> [u32; 3] {
        let p = ray.origin + ray.dir * (lattice.s0 + place * lattice.h);
        let index = (p - 0.5).max(Vec3::ZERO).min(self.last);
        let grid = set.grid();
        let place = index.to_array().map(|x| x as u32 / PAGE_CELLS);
        std::array::from_fn(|i| place[i].min(grid[i] - 1))
    }
}
