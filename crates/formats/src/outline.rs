//! What a file holds and what of it would be shown: known before any voxel is read.

use std::fmt;

use crate::select::Selection;
use crate::warning::Warning;

/// What there is in a file or folder, and the part of it that the options take.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Outline {
    /// File name or name of the built-in volume.
    #[serde(skip)]
    pub name: String,
    /// What would be shown: channel, time, level and series are named.
    #[serde(skip)]
    pub shown: Selection,
    /// Format, such as `NIfTI-1, gzip`.
    pub format: String,
    /// Type of a voxel in the file.
    #[serde(skip)]
    pub dtype: String,
    /// Voxels along x, y, z of what would be shown.
    #[serde(skip)]
    pub dims: [u32; 3],
    /// Distances between voxel centres along x, y, z.
    #[serde(skip)]
    pub spacing: [f32; 3],
    /// Unit of the spacing, if known.
    pub unit: Option<String>,
    /// Where the axes of the volume point, such as `RAS`, if known.
    #[serde(skip)]
    pub orientation: Option<String>,
    /// Where the axes of the file point, such as `LPS`, or `+x+y+z` where no body is known.
    pub file_axes: String,
    /// Voxels along x, y, z of the whole, of which a region may be taken.
    pub whole_dims: [u64; 3],
    /// Names of the channels, or their numbers; empty for one without a name.
    pub channels: Vec<String>,
    /// How many channels there are: names are listed up to a limit.
    pub num_channels: u64,
    /// Points in time.
    pub num_times: u64,
    /// Levels of a pyramid, finest first; empty if there is one.
    pub levels: Vec<Level>,
    /// The level that would be shown.
    pub level: u32,
    /// Series of a folder in words; empty if there is one.
    pub series: Vec<String>,
    /// How the volume was taken (`CT`, `MR`, …), if known.
    pub modality: Option<String>,
    /// Unit of the values, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value_unit: Option<String>,
    /// Centre of the volume in the world of the file, RAS+ for a body, if known.
    pub center: Option<[f64; 3]>,
    /// Directions of x, y and z in that world, if known.
    pub directions: Option<[[f64; 3]; 3]>,
    /// Bytes the volume will take in memory, on the GPU as well.
    #[serde(skip)]
    pub bytes_in_memory: u64,
    /// Bytes the voxels take while they are read.
    pub bytes_while_reading: u64,
    /// What is odd about the header, or was chosen.
    #[serde(skip)]
    pub warnings: Vec<Warning>,
}

/// One level of a pyramid.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Level {
    /// Voxels along x, y, z.
    pub dims: [u64; 3],
    /// Distances between voxel centres along x, y, z.
    pub spacing: [f64; 3],
}

impl Outline {
    /// Bytes of memory that there must be to open it: while it is read or after, whichever is more.
    pub fn bytes_needed(&self) -> u64 {
        self.bytes_in_memory.max(self.bytes_while_reading)
    }
}

impl fmt::Display for Outline {
    /// What a person wants to know beside dimensions, type and memory; a few lines, each ending in a line feed.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "  format       {}", self.format)?;
        let sides = |dims: &[u64; 3]| format!("{} × {} × {}", dims[0], dims[1], dims[2]);
        if self.whole_dims != self.dims.map(u64::from) {
            writeln!(f, "  region of    {}", sides(&self.whole_dims))?;
        }
        if !self.channels.is_empty() {
            let names = &self.channels[..self.channels.len().min(MAX_NAMED)];
            let more = if self.num_channels as usize > names.len() { ", …" } else { "" };
            writeln!(f, "  channels     {}: {}{more}", self.num_channels, names.join(", "))?;
        }
        if self.num_times > 1 {
            writeln!(f, "  times        {}", self.num_times)?;
        }
        for (i, level) in self.levels.iter().enumerate() {
            let [x, y, z] = level.spacing;
            let mark = if i as u32 == self.level { " (shown)" } else { "" };
            writeln!(f, "  level {i:<6} {}, spacing {x} × {y} × {z}{mark}", sides(&level.dims))?;
        }
        for (i, series) in self.series.iter().enumerate() {
            writeln!(f, "  series {i:<5} {series}")?;
        }
        if let Some(modality) = &self.modality {
            writeln!(f, "  modality     {modality}")?;
        }
        writeln!(f, "  file's axes  {}", self.file_axes)?;
        if let (Some([x, y, z]), Some(axes)) = (self.center, self.directions) {
            let unit = self.unit.as_ref().map_or(String::new(), |u| format!(" {u}"));
            writeln!(f, "  centre       {x:.4} {y:.4} {z:.4}{unit}")?;
            let axes = axes.map(|[x, y, z]| format!("({x:.4} {y:.4} {z:.4})"));
            writeln!(f, "  directions   {}", axes.join(" "))?;
        }
        Ok(())
    }
}

/// Channels that a line names.
const MAX_NAMED: usize = 16;
