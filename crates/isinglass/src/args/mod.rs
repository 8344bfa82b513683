//! Arguments that several commands share.

mod backend;
mod coding;
mod link;
mod look;
mod motion;
mod parse;
mod view;
mod volume;

pub(crate) use backend::{BackendArgs, GpusArgs};
pub(crate) use coding::{CodecArgs, CodecChoice, PlanArgs};
pub(crate) use link::LinkArgs;
pub(crate) use look::{ListArgs, LookArgs, Switch};
pub(crate) use motion::{ForesightArgs, PathArgs};
pub(crate) use parse::{
    not_an_input, parse_background, parse_duration, parse_fov, parse_k, parse_mbit, parse_output,
    parse_picture, parse_rate, parse_size, usage_error,
};
pub(crate) use view::{ViewArgs, orthographic};
pub(crate) use volume::{PartArgs, RawArgs, VolumeArgs, any_text, open_to_serve, open_volume, with_percent};
