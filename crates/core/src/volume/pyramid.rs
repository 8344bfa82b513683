//! Volumes of several levels, and the pages that a large volume is read by.
//!
//! Level 0 is the finest. Voxel i of a level lies at index `first + factor·i` of the finest level, along each axis: the
//! mean of two voxels has `factor` 2 and `first` ½. Indices count voxel centres, so voxel space is half a voxel ahead
//! ([`crate::space`]).

use std::sync::Arc;

use glam::Vec3;

use super::grid::{Volume, VolumeInfo, Voxels};
use super::histogram::Histogram;
use super::world::VoxelBox;

/// What a level of a pyramid takes from the finest one, so that every level has one look: box, unit length, domain of
/// values and steepness.
#[derive(Clone, Debug, PartialEq)]
pub struct Finest {
    /// Voxels along x, y, z of the finest level.
    pub dims: [u32; 3],
    /// Distances between its voxel centres, world units.
    pub spacing: Vec3,
    /// Its index at which the first voxel of the coarser level lies.
    pub first: Vec3,
    /// Its least and greatest stored number, if known.
    pub stored_range: Option<(f32, f32)>,
    /// Its histogram, if known.
    pub histogram: Option<Arc<Histogram>>,
}

/// A volume that is read by pages.
#[derive(Clone, Debug)]
pub struct Pyramid {
    /// The levels, finest first. The last one is small enough to be held whole.
    pub levels: Vec<PyramidLevel>,
    /// Distances between voxel centres of the finest level, world units.
    pub spacing: Vec3,
    /// Type of the stored numbers.
    pub kind: VoxelKind,
    /// Scale and offset from stored numbers to physical values, by channel.
    pub value_maps: Vec<(f32, f32)>,
    /// Name, type and remarks.
    pub info: VolumeInfo,
}

/// A level of a pyramid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PyramidLevel {
    /// Voxels along x, y, z.
    pub dims: [u32; 3],
    /// Voxels of the finest level from one voxel to the next; powers of two.
    pub factor: [u32; 3],
    /// Index of the finest level at which the first voxel lies.
    pub first: [f32; 3],
}

/// The types of [`Voxels`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VoxelKind {
    /// Eight bits unsigned.
    U8,
    /// Sixteen bits unsigned.
    U16,
    /// Single-precision floats.
    F32,
}

/// A page: a cube of [`PAGE_CELLS`]³ cells of a level.
///
/// Page `at` covers the indices `[64·factor·at, 64·factor·(at + 1))` of the finest level. So pages of all levels share
/// their borders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PageId {
    /// The level, 0 for the finest.
    pub level: u8,
    /// Its place along x, y, z.
    pub at: [u32; 3],
}

/// The voxels of a page: [`PAGE_POINTS`]³ of them, x fastest. Beyond the level's last voxel that one repeats.
#[derive(Clone, Debug, PartialEq)]
pub struct PageVoxels {
    /// The stored numbers. Gaps are filled as in the whole level, from beyond the page, too: [`Volume::with_gaps`].
    pub voxels: Voxels,
    /// A byte a voxel that is not 0 where there is nothing; `None` if there is something everywhere.
    pub gaps: Option<Vec<u8>>,
}

/// Why a page cannot be read.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PageError {
    /// The file may answer later: a timeout, a lost connection.
    #[error("{0}")]
    Unreachable(String),
    /// What is stored makes no sense, and will make none later.
    #[error("{0}")]
    Damaged(String),
}

/// Reads the pages of a volume, on several threads at once.
pub trait PageSource: Send + Sync {
    /// The levels.
    fn pyramid(&self) -> &Pyramid;

    /// Reads a page of a channel.
    ///
    /// # Errors
    /// In one line, if it cannot be read. A part that the file leaves out has its fill value and is no error.
    fn read(&self, channel: usize, page: PageId) -> Result<PageVoxels, PageError>;
}

/// How a volume that does not fit into memory is read by pages. Clones share the reader.
#[derive(Clone)]
pub struct Paging {
    /// Reads the pages.
    pub source: Arc<dyn PageSource>,
    /// Known values of the pages, so that those of which nothing is seen are not read.
    pub ranges: Option<Arc<dyn PageRanges>>,
    /// Most memory of the pages, bytes.
    pub max_bytes: u64,
    /// The voxels of the finest level whose pages are read; all others stay coarse. `None` for all.
    pub own: Option<VoxelBox>,
}

impl std::fmt::Debug for Paging {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Paging").field("max_bytes", &self.max_bytes).finish_non_exhaustive()
    }
}

/// Knows the values of a volume's pages.
pub trait PageRanges: Send + Sync {
    /// Least and greatest stored number of a channel in a page of the finest level; `None` if unknown.
    fn range(&self, channel: usize, at: [u32; 3]) -> Option<(f32, f32)>;
}

impl Pyramid {
    /// A volume in memory as the only level.
    pub fn of(volume: &Volume) -> Self {
        let level = PyramidLevel { dims: volume.dims(), factor: [1; 3], first: [0.0; 3] };
        Self {
            levels: vec![level],
            spacing: volume.spacing(),
            kind: volume.voxels().kind(),
            value_maps: volume.channels().map(Volume::value_map).collect(),
            info: volume.info.clone(),
        }
    }

    /// Voxels along x, y, z of the finest level.
    pub fn dims(&self) -> [u32; 3] {
        self.levels.first().map_or([1; 3], |level| level.dims)
    }

    /// Pages along x, y, z of a level.
    pub fn pages(&self, level: usize) -> [u32; 3] {
        let (dims, factor) = (self.dims(), self.levels[level].factor);
        std::array::from_fn(|i| dims[i].saturating_sub(1).div_ceil(PAGE_CELLS * factor[i]).max(1))
    }

    /// All pages of a level, x fastest.
    pub fn page_ids(&self, level: u8) -> impl Iterator<Item = PageId> + use<> {
        let [nx, ny, nz] = self.pages(usize::from(level));
        let places = (0..nz).flat_map(move |z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])));
        places.map(move |at| PageId { level, at })
    }

    /// The page of a level that covers a page of the finest one. Both must exist.
    pub fn page_over(&self, at: [u32; 3], level: u8) -> PageId {
        let (factor, pages) = (self.levels[usize::from(level)].factor, self.pages(usize::from(level)));
        PageId { level, at: std::array::from_fn(|i| (at[i] / factor[i]).min(pages[i] - 1)) }
    }

    /// The level of a page, which must exist.
    pub fn level(&self, page: PageId) -> &PyramidLevel {
        &self.levels[usize::from(page.level)]
    }

    /// The index, along x, y, z of its level, of the first voxel of a page.
    pub fn first_point(&self, page: PageId) -> [u32; 3] {
        self.level(page).first_point(page.at)
    }

    /// The least and the greatest faces of a page in the voxel space of the finest level. Pages at the volume's faces go
    /// on beyond it, to infinity.
    pub fn faces(&self, page: PageId) -> (Vec3, Vec3) {
        let (dims, factor) = (self.dims(), self.level(page).factor);
        let face = |at: u32, i: usize| (at * factor[i] * PAGE_CELLS) as f32 + 0.5;
        let low = |i: usize| if page.at[i] == 0 { f32::NEG_INFINITY } else { face(page.at[i], i) };
        let high = |i: usize| match face(page.at[i] + 1, i) {
            high if high > dims[i] as f32 - 0.5 => f32::INFINITY,
            high => high,
        };
        (Vec3::from_array([0, 1, 2].map(low)), Vec3::from_array([0, 1, 2].map(high)))
    }

    /// Whether a page has cells of a box of the finest level.
    pub fn meets(&self, page: PageId, voxels: &VoxelBox) -> bool {
        let (factor, pages) = (self.level(page).factor, self.pages(usize::from(page.level)));
        (0..3).all(|i| {
            let first = page.at[i] * factor[i] * PAGE_CELLS;
            let is_last = page.at[i] + 1 >= pages[i];
            first < voxels.end[i] && (is_last || voxels.first[i] < first + factor[i] * PAGE_CELLS)
        })
    }

    /// Whether voxels are as many as those of a page, and of their type.
    pub fn is_page(&self, page: &PageVoxels) -> bool {
        page.voxels.kind() == self.kind && page.voxels.len() == PAGE_VOXELS
    }

    /// Bytes of the voxels of a page.
    pub fn page_bytes(&self) -> usize {
        PAGE_VOXELS * self.kind.bytes()
    }
}

impl PyramidLevel {
    /// The index of the first voxel of the page at a place.
    pub fn first_point(&self, at: [u32; 3]) -> [u32; 3] {
        std::array::from_fn(|i| {
            let index = f64::from(at[i]) * f64::from(PAGE_CELLS) - self.shift(i);
            ((index.floor() - 2.0).max(0.0) as u32).min(self.dims[i].saturating_sub(2))
        })
    }

    /// From the voxel space of the finest level to that of this one: a factor and an offset.
    pub fn place(&self) -> (Vec3, Vec3) {
        let scale = Vec3::from_array(self.factor.map(|f| 1.0 / f as f32));
        (scale, 0.5 - (0.5 + Vec3::from_array(self.first)) * scale)
    }

    /// The finest level's index of the first voxel, in voxels of this level.
    fn shift(&self, axis: usize) -> f64 {
        f64::from(self.first[axis]) / f64::from(self.factor[axis])
    }
}

impl VoxelKind {
    /// Bytes of a voxel.
    pub fn bytes(self) -> usize {
        match self {
            Self::U8 => 1,
            Self::U16 => 2,
            Self::F32 => 4,
        }
    }
}

/// Cells along the side of a page.
pub const PAGE_CELLS: u32 = 64;
/// Voxels along the side of a page. Its cells have one more than that many, and steps begin before it, which takes
/// another. The voxels of a coarser level lie between those of a finer one, which takes a third. Gradients take one
/// before and one behind.
pub const PAGE_POINTS: u32 = PAGE_CELLS + 5;
/// Voxels of a page.
pub const PAGE_VOXELS: usize = (PAGE_POINTS * PAGE_POINTS * PAGE_POINTS) as usize;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_holds_every_voxel_that_its_cells_need() {
        for (dims, factor, first) in [
            ([130u32, 64, 65], [1u32, 1, 1], [0f32, 0.0, 0.0]),
            ([65, 33, 33], [2, 2, 2], [0.5, 0.5, 0.0]),
            ([33, 130, 9], [4, 1, 8], [1.5, 0.0, 3.5]),
        ] {
            let level = PyramidLevel { dims, factor, first };
            for axis in 0..3 {
                let cells = PAGE_CELLS * factor[axis];
                for at in 0..3 {
                    let origin = level.first_point([at; 3])[axis];
                    for index in at * cells..(at + 1) * cells {
                        let here = (index as f32 - first[axis]) / factor[axis] as f32;
                        let corner = (here.max(0.0) as u32).min(dims[axis].saturating_sub(2));
                        let last = index >= dims[axis] * factor[axis];
                        // With the neighbours of both voxels.
                        let is_held = corner.saturating_sub(1) >= origin && corner + 2 < origin + PAGE_POINTS;
                        assert!(last || is_held, "{dims:?} {axis} {index}: {corner} from {origin}");
                    }
                }
            }
        }
        // A level of means takes all of them: its cells begin a quarter of a voxel behind a voxel.
        let level = PyramidLevel { dims: [200; 3], factor: [2; 3], first: [0.5; 3] };
        let corners = [128.0f32, 255.99].map(|index| ((index - 0.5) / 2.0) as u32);
        assert_eq!(corners[0] - 2, level.first_point([1; 3])[0]);
        assert_eq!(corners[1] + 2, level.first_point([1; 3])[0] + PAGE_POINTS - 1);
    }

    #[test]
    fn pages_cover_the_volume() {
        let level = |factor: u32, dims| PyramidLevel { dims, factor: [factor; 3], first: [0.0; 3] };
        let pyramid = Pyramid {
            levels: vec![level(1, [129, 130, 1]), level(2, [65, 65, 1])],
            spacing: Vec3::ONE,
            kind: VoxelKind::U16,
            value_maps: vec![(1.0, 0.0)],
            info: VolumeInfo::default(),
        };
        // 128 cells are two pages, 129 are three, and one voxel has a page of its own.
        assert_eq!(pyramid.pages(0), [2, 3, 1]);
        assert_eq!(pyramid.pages(1), [1, 2, 1]);
        assert_eq!(pyramid.page_bytes(), 69 * 69 * 69 * 2);
    }
}
