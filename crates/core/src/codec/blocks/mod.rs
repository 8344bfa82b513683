//! The rate mode: lists coded in blocks that share their cuts as depth planes, so that opacity and colour of a layer
//! are small planes a transform can code.

pub mod model;
pub mod relayer;
