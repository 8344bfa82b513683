//! Where a volume is, and what it takes to read it the same way again.

use glam::Vec3;

use crate::loading::LoadRequest;
use crate::raw::RawShape;
use crate::select::Selection;
use crate::source::OpenOptions;

/// See the module.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeSource {
    /// As for [`crate::open`].
    pub source: String,
    /// The shape of a raw file.
    pub raw: Option<RawShape>,
    /// Which part of it.
    pub selection: Selection,
    /// Distances between voxels, in place of those of the file.
    pub spacing: Option<Vec3>,
}

impl VolumeSource {
    /// All of `source`, as its file says.
    pub fn new(source: impl Into<String>) -> Self {
        Self { source: source.into(), raw: None, selection: Selection::default(), spacing: None }
    }

    /// How to open it.
    pub fn options(&self) -> OpenOptions<'static> {
        let &Self { raw, selection, spacing, .. } = self;
        OpenOptions { raw, selection, spacing, ..OpenOptions::default() }
    }

    /// Whether all of its numbers are.
    pub(crate) fn is_finite(&self) -> bool {
        self.spacing.is_none_or(Vec3::is_finite) && self.raw.is_none_or(|raw| raw.spacing.is_finite())
    }

    /// To read it within a limit of memory.
    pub fn request(self, max_bytes: u64) -> LoadRequest {
        let Self { source, raw, selection, spacing } = self;
        LoadRequest { source, raw, selection, spacing, max_bytes }
    }
}

impl From<LoadRequest> for VolumeSource {
    fn from(request: LoadRequest) -> Self {
        let LoadRequest { source, raw, selection, spacing, max_bytes: _ } = request;
        Self { source, raw, selection, spacing }
    }
}
