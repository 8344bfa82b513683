//! How the numbers of a file are read.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Choices that change how the numbers of a file become voxels.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Reading {
    /// Whether the slices of a DICOM series stay as they are stored, even if they are uneven, missing or tilted.
    pub stored_slices: bool,
    /// What the voxels mean; `None` leaves it to the file and the look of its voxels.
    pub voxels: Option<Meaning>,
    /// Take one voxel in so many along each axis. `None` thins only sides of more than 2048 voxels.
    pub thin: Option<u32>,
    /// A file with a volume of labels that is shown over this one.
    pub labels: Option<String>,
}

impl Reading {
    /// All left to the file.
    pub const USUAL: &'static Self = &Self { stored_slices: false, voxels: None, thin: None, labels: None };
}

/// What the numbers of voxels mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Meaning {
    /// Quantities, between which there are others.
    Values,
    /// Names for kinds of matter.
    Labels,
}

impl fmt::Display for Meaning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Values => "values",
            Self::Labels => "labels",
        })
    }
}

impl FromStr for Meaning {
    type Err = String;

    /// Accepts `values` and `labels`.
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "values" => Ok(Self::Values),
            "labels" => Ok(Self::Labels),
            _ => Err("expected values or labels".into()),
        }
    }
}
