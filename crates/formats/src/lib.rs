//! Volume files, transfer functions and presets, to and from the types of `isinglass-core`.
//!
//! - [`open`] reads every format of docs/FORMATS.md, raw voxels, the built-in volumes and OME-Zarr at an address. [`outline`] reads only the
//!   header and returns what [`open`] would need. [`Loading`] opens a volume on its own thread.
//! - [`load_transfer`] reads a preset or a file with a transfer function.
//! - [`SavedState`] is a saved view of a volume, as a file or in a link.
//! - [`Conversion`] makes a pyramid in OME-Zarr of whatever opens.
//! - [`VolumeFacts`] is what `isinglass info` prints.
//! - [`write_whole`] writes a file as a whole or not at all.
//!
//! Nothing in a file is trusted. Every length is checked against the file and a memory limit before anything is
//! allocated. Every error is one line that names the file, what was expected and what was found. This crate draws
//! nothing. Only `web` knows a network: it gets the files of an OME-Zarr image.

mod alike;
mod allocator;
mod axes;
mod builtin;
mod cf;
mod channel_looks;
mod channels;
mod chunk_cache;
mod chunk_grid;
mod collector;
mod content;
mod convert;
mod decode;
mod dicom;
mod dtype;
mod error;
mod facts;
mod facts_of_file;
mod file_list;
mod first_look;
mod foreign;
mod gap_rule;
mod hdf5;
mod header_bytes;
mod hyperslab;
pub mod iglf;
mod labels;
mod levels;
mod loading;
mod metaimage;
mod mgh;
pub mod movie;
mod mrc;
mod netcdf;
mod nifti;
mod npy;
mod nrrd;
mod outline;
mod output;
mod overlay;
mod packed;
mod padding;
mod paged;
mod plan;
mod planes;
pub mod png;
mod png_stack;
mod presets;
mod pyramid;
mod raw;
mod read_volume;
mod reading;
mod recent;
mod remembered;
mod scene;
mod scratch;
mod selection;
mod settings;
mod sniff;
mod source;
mod state;
mod stream;
mod surroundings;
mod tiff;
mod transfer;
mod transfer_import;
mod transfer_json;
mod transfer_maps;
mod units;
mod unpack;
mod volume_source;
mod vti;
mod vtk;
mod warning;
mod web;
mod web_reach;
mod xml;
mod zarr;
mod zip;

pub use allocator::{return_large_blocks, share_arena};
pub use channel_looks::default_channels;
pub use content::{Content, content_of};
pub use convert::{Conversion, Converted};
pub use dtype::{Dtype, Endian};
pub use error::{FormatError, HeaderError};
pub use facts::{PERCENTILES, ValuesOf, VolumeFacts};
pub use facts_of_file::facts_at_once;
pub use first_look::default_transfer;
pub use loading::{LoadRequest, Loading};
pub use outline::{Level, Outline, PageCount};
pub use output::{
    check_writable, make_private_folder, remove_leftovers, write_new, write_new_private, write_private,
    write_whole,
};
pub use paged::{BuiltIndex, PageIndex, PageIndexBuilder, PagedFile, open_paged, page_count};
pub use presets::{default_preset, fitting_presets, preset, preset_names};
pub use raw::RawShape;
pub use reading::{Meaning, Reading};
pub use recent::{Recent, RecentEntry, RecentPlace};
pub use remembered::Remembered;
pub use scene::{OpenedScene, open_scene, scene_of};
pub use scratch::{before_scratch, remove_scratch};
pub use selection::{Flip, Region, Selection};
pub use settings::{Setting, SettingValue, read_settings, settings_from_toml};
pub use source::{
    ChannelNumbers, LEAST_FOR_PAGES, OpenOptions, finest_numbers, open, open_file, outline, read_text,
    source_exists,
};
pub use state::{
    MAX_LINK_BYTES, MAX_MEASURE_POINTS, MAX_MEASURES, MAX_STATE_BYTES, MAX_VIEWS, MeasureKind, NamedView,
    ReadState, SavedCamera, SavedMeasure, SavedPlane, SavedSlices, SavedState, SavedView, SavedVolume, Srgb,
    StereoPicture, Theme, UpAxis, is_state, is_view_name, read_state, state_from_bytes, state_from_link,
    state_to_link,
};
pub use transfer::{MAX_TRANSFER_BYTES, load_transfer, transfer_from_toml, transfer_to_toml};
pub use transfer_import::{ImportedTransfer, import_transfers};
pub use transfer_maps::ColorMap;
pub use volume_source::VolumeSource;
pub use warning::{Warning, WarningKind};
pub use web::is_address;
