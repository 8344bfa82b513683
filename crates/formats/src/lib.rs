//! Volume files, transfer functions and presets, to and from the types of `isinglass-core`.
//!
//! [`open`] reads every format of docs/FORMATS.md, raw voxels whose shape is told, and the built-in volumes; [`outline`] reads
//! the header alone and tells what [`open`] would need; [`Loading`] opens on a thread of its own. [`load_transfer`] reads a
//! preset or a TOML file of control points; [`SavedState`] is what is seen and how, as a file or in a link; [`VolumeFacts`] is what `info` prints. What a
//! file says is never trusted: every length is checked against the file and a memory limit before anything is
//! allocated, and every error is one line that names the file, what was expected and what was found. This crate
//! draws nothing and knows no network.

mod axes;
mod content;
mod decode;
mod dicom;
mod dtype;
mod error;
mod facts;
pub mod iglf;
mod loading;
mod metaimage;
mod mrc;
mod nifti;
mod npy;
mod nrrd;
mod outline;
mod output;
mod parts;
mod picker;
mod plan;
pub mod png;
mod presets;
mod raw;
mod recent;
mod select;
mod settings;
mod sniff;
mod source;
mod state;
mod stream;
mod taker;
mod tiff;
mod transfer;
mod transfer_import;
mod transfer_json;
mod transfer_maps;
mod units;
mod volume_source;
mod vti;
mod warning;
mod words;
mod xml;
mod zarr;
mod zip;

pub use content::{Content, content_of};
pub use dtype::{Dtype, Endian};
pub use error::{FormatError, HeaderError};
pub use facts::{PERCENTILES, VolumeFacts};
pub use loading::{LoadRequest, Loading};
pub use outline::{Level, Outline};
pub use output::{check_writable, write_whole};
pub use presets::{default_preset, default_transfer, preset, preset_names};
pub use raw::RawShape;
pub use recent::{Recent, RecentEntry, RecentPlace};
pub use select::{Region, Selection};
pub use settings::{Setting, SettingValue, read_settings, settings_from_toml};
pub use source::{OpenOptions, open, outline};
pub use state::{
    MAX_LINK_BYTES, MAX_STATE_BYTES, ReadState, SavedCamera, SavedState, SavedView, SavedVolume, Srgb,
    StereoPicture, Theme, is_state, read_state, state_from_bytes, state_from_link, state_to_link,
};
pub use transfer::{MAX_TRANSFER_BYTES, load_transfer, transfer_from_toml, transfer_to_toml};
pub use transfer_import::{ImportedTransfer, import_transfers};
pub use transfer_maps::ColorMap;
pub use volume_source::VolumeSource;
pub use warning::{Warning, WarningKind};
