//! Draws a frame: the ray cast inside egui's render pass, and lines and handles over the picture.

pub(crate) mod clip_editor;
pub(crate) mod frame_slots;
pub(crate) mod gpu_timer;
pub(crate) mod measure;
pub(crate) mod novel_view;
pub(crate) mod picture;
pub(crate) mod picture_cache;
pub(crate) mod slice_planes;
pub(crate) mod stereo;
pub(crate) mod view_aids;
pub(crate) mod view_cube;
