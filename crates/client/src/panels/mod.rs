//! The panels over the picture. A panel shows what it is given and returns what the person asks for.
//!
//! Panels do not know each other; `app` places them. What they share is in `background`, `color_well`, `controls`,
//! `file_field`, `known_files`, `part_pickers`, `style`, `text` and `value_scale`.

pub(crate) mod background;
pub(crate) mod banner;
pub(crate) mod browser;
pub(crate) mod channels;
pub(crate) mod clip;
pub(crate) mod color_well;
pub(crate) mod controls;
pub(crate) mod file_field;
pub(crate) mod first_page;
pub(crate) mod gallery;
pub(crate) mod help;
pub(crate) mod hints;
pub(crate) mod known_files;
pub(crate) mod light;
pub(crate) mod measure;
pub(crate) mod part_pickers;
pub(crate) mod parts_bar;
pub(crate) mod probe;
pub(crate) mod screenshots;
pub(crate) mod slices;
pub(crate) mod state_files;
pub(crate) mod status;
pub(crate) mod style;
pub(crate) mod system_dialog;
pub(crate) mod text;
pub(crate) mod toolbar;
pub(crate) mod transfer;
pub(crate) mod value_scale;
pub(crate) mod viewers;
