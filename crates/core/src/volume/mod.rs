//! Scalar volumes: the grid of voxels, min/max bricks over it, its brightness under a light, closed-form fields and the built-in volumes.

mod bricks;
pub mod fields;
mod grid;
mod histogram;
mod lit;
pub mod procedural;

pub use bricks::{BRICK, Bricks, Occupancy};
pub use grid::{Placement, Volume, VolumeError, VolumeInfo, Voxels};
pub use histogram::Histogram;
pub use lit::{LIT_MAX, Lit, Shading};
