//! The coding in blocks. 8×8 lists share their depth planes, so opacity and colour of a layer are small planes that a
//! transform can code.
//!
//! The server finds a block's layers (`layer_search`, `encode`). Their depth planes are coded in steps, or taken from
//! a neighbour, or moved from the reference (`coding`, `motion`, `reference`, `fetch`). Opacity and colour of a layer
//! are 8×8 planes (`scales`). They are predicted and transformed (`residual`), and coded in bits (`syntax`, `entropy`).
//! The probabilities of bits are known from the frames before (`tables`). The last plane of a block corrects the
//! picture at the frame's own pose (`corrections`). Borders between blocks are smoothed (`smooth`). The encoder works
//! with what a decoder will have (closed loop).
//!
//! A tile is 8×8 blocks. It has a stream of its own, or one for each quarter. So tiles are coded in parallel, in both
//! directions.
//!
//! One rule makes every machine decode alike, also a GPU. A decoder computes with integers of 32 bits. Its tables, and
//! the numbers of a camera, are made of sums, products, quotients and square roots in double precision, in the order
//! written. It calls no function of a mathematics library.
//!
//! A file or folder uses only those above it:
//!
//! | file or folder | responsibility |
//! |---|---|
//! | `model` | blocks, layers and depth planes |
//! | `transform` | the 8×8 cosine transform |
//! | `scales` | codes of opacity and colour |
//! | `smooth` | borders between blocks |
//! | `prior` | probabilities of a frame alone |
//! | `entropy`, `tables` | bits and their probabilities |
//! | `syntax` | contexts, masks and coefficients |
//! | `steps` | settings to steps |
//! | `motion` | where matter lies in the picture of a reference |
//! | `tile` | the decoded blocks of a tile |
//! | `residual` | a plane as prediction and coefficients |
//! | `corrections` | corrections of the picture |
//! | `reference` | frames that others are predicted from |
//! | `fetch` | what a reference has between two planes |
//! | `to_frame` | decoded blocks as lists |
//! | `head` | the head of a payload, and its streams |
//! | `coding` | the blocks of a tile, in both directions |
//! | `bands` | bands of about the same work |
//! | `layer_search` | lists to layers |
//! | `encode` | encoding |
//! | `decode` | decoding |
//! | `device` | frames in words, for a GPU |
//! | `raster` | pictures coded as planes are, for comparisons |
//! | `rate` | bytes to quality |

mod bands;
mod coding;
mod corrections;
mod decode;
pub mod device;
mod encode;
mod entropy;
mod fetch;
mod head;
mod layer_search;
mod model;
mod motion;
mod prior;
pub mod raster;
mod rate;
mod reference;
mod residual;
mod scales;
mod smooth;
mod steps;
mod syntax;
mod tables;
#[cfg(test)]
pub(super) mod tests;
mod tile;
mod to_frame;
mod transform;

pub(super) use bands::work_of_rows;
pub(super) use decode::{decode, decode_band};
pub(super) use encode::{BlocksPlan, EncodedBand, encode_while};
pub(super) use entropy::Tally;
pub(super) use reference::{CodedTile, Notes};

pub use encode::encode;
pub use head::reference_named;
pub use rate::{MAX_ENCODES, RateControl, encode_within};
pub use reference::{MAX_REFERENCE_BYTES, MAX_REFERENCES, Reference, References};
pub use steps::{MAX_QUALITY, MAX_TURN_DEG, Settings};

/// Makes the tables.
pub(super) fn prepare() {
    scales::scales();
    entropy::Tables::prior();
}
