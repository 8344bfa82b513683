//! Scalar volumes: the voxel grid, min/max bricks, lighting and shade, slices, closed-form fields
//! and built-in volumes.

mod bricks;
mod classification;
mod extinction;
pub mod fields;
mod gaps;
mod grid;
mod histogram;
mod illumination;
mod labels;
mod level_assembly;
mod lighting;
mod lit;
mod opacities;
mod page_plan;
mod page_slice;
mod page_values;
mod pages;
mod part_values;
pub mod procedural;
mod pyramid;
mod residency;
mod shade;
mod slice;
mod slice_sums;
mod split;
mod world;

pub use bricks::{BRICK, Bricks, Occupancy, PEAK_MAX};
pub use extinction::{Detail, Matter, Sheet, are_lesser_bodies, area_above, has_lesser_bodies};
pub use gaps::VoxelGaps;
pub use grid::{ChannelInfo, MAX_CHANNELS, Placement, Volume, VolumeError, VolumeInfo, VolumeLabel, Voxels};
pub use histogram::{Histogram, parting_value};
pub use illumination::{Illumination, Occlusion};
pub use labels::label_color;
pub use level_assembly::LevelAssembly;
pub use lighting::{
    Lighting, LightingError, OCCLUSION_RADIUS_MAX, OCCLUSION_RADIUS_MIN, SHININESS_MAX, SOFTNESS_MAX_DEGREES,
};
pub use lit::{GRADIENT_MAX, LIT_MAX, Lit, Shading};
pub use opacities::{opacity_table, opacity_volume};
pub use page_plan::PagePlan;
pub use page_values::{FoundVoxel, PageCursor, PageFinder, PageReader, PageValues, ValuesAt};
pub use pages::{Page, PageSet, PageView, PlanKey, page_of};
pub use part_values::{AskedPoint, AskedPoints, FoundPoint, FoundPoints, PartValues};
pub use pyramid::{
    Finest, PAGE_CELLS, PAGE_POINTS, PAGE_VOXELS, PageError, PageId, PageRanges, PageSource, PageVoxels,
    Paging, Pyramid, PyramidLevel, VoxelKind,
};
pub use residency::{PageProgress, PartProgress, Residency};
pub use slice::{MAX_SLICE_SIDE, SlabMode, Slice, SliceCodes, SliceGrid, SlicePlane, SliceSpec};
pub use slice_sums::SliceSums;
pub use split::{GHOSTS, PointLine, Split, SplitError};
pub use world::{VoxelBox, Whole, sample_places};
