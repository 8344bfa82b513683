//! The location of a volume, and what is needed to read it again.

use glam::Vec3;

use crate::loading::LoadRequest;
use crate::raw::RawShape;
use crate::reading::Reading;
use crate::selection::Selection;
use crate::source::OpenOptions;

/// The location of a volume, and how to read it.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeSource {
    /// The source, as for [`crate::open`].
    pub source: String,
    /// The shape of a raw file.
    pub raw: Option<RawShape>,
    /// The part of the file to read.
    pub selection: Selection,
    /// Distances between voxels, instead of those in the file.
    pub spacing: Option<Vec3>,
    /// Whether a header may name files outside its own folder. No state or list keeps this.
    pub foreign_files: bool,
    /// How the numbers become voxels.
    pub reading: Reading,
}

impl VolumeSource {
    /// All of `source`, without changes.
    pub fn new(source: impl Into<String>) -> Self {
        let (source, selection) = (source.into(), Selection::default());
        Self {
            source,
            raw: None,
            selection,
            spacing: None,
            foreign_files: false,
            reading: Reading::default(),
        }
    }

    /// The options to open it with the default limits.
    pub fn options(&self) -> OpenOptions<'_> {
        let &Self { raw, selection, spacing, foreign_files, ref reading, .. } = self;
        OpenOptions { raw, selection, spacing, foreign_files, reading, ..OpenOptions::default() }
    }

    /// Whether all of its numbers are finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.spacing.is_none_or(Vec3::is_finite) && self.raw.is_none_or(|raw| raw.spacing.is_finite())
    }

    /// A request to load it within a limit of memory.
    pub fn request(self, max_bytes: u64) -> LoadRequest {
        let Self { source, raw, selection, spacing, foreign_files, reading } = self;
        LoadRequest { source, raw, selection, spacing, max_bytes, foreign_files, reading }
    }
}

impl From<LoadRequest> for VolumeSource {
    fn from(request: LoadRequest) -> Self {
        let LoadRequest { source, raw, selection, spacing, reading, .. } = request;
        Self { raw, selection, spacing, reading, ..Self::new(source) }
    }
}
