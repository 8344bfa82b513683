//! Scalar volumes: the grid of voxels, min/max bricks over it, closed-form fields and the built-in volumes.

mod bricks;
mod grid;
mod histogram;
pub mod fields;
pub mod procedural;

pub use bricks::{BRICK, Bricks, Occupancy};
pub use grid::{Volume, VolumeError, VolumeInfo, Voxels};
pub use histogram::Histogram;
