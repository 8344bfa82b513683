//! The Rust twins of the kernels in `shaders/`: same names, same order, a function for one invocation and a parallel
//! loop. They are the oracle of the GPU's tests and the `cpu` backend.

pub mod combine;
pub mod empty_space;
pub mod layering;
pub mod lens;
pub mod march;
pub mod part_pictures;
pub mod part_rays;
mod part_rows;
pub mod part_slices;
pub use part_rows::{PartsError, ROWS_IN_BLOCK, rows_of};
pub mod raycast;
