//! From keys and mouse to actions and a camera. This folder uses no other.

pub(crate) mod bindings;
pub mod camera_controls;
pub(crate) mod camera_moves;
pub(crate) mod camera_path;
pub(crate) mod orientation;
pub(crate) mod pointer;
