//! The contents of a file, known before any voxel is read.

use std::fmt;

use isinglass_core::volume::VolumeLabel;

use crate::selection::Selection;
use crate::warning::Warning;

/// What a file or folder contains, and the part that the options select.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Outline {
    /// File name or name of the built-in volume.
    #[serde(skip)]
    pub name: String,
    /// The selected part. Time, level and series are always set. Without a channel, several are shown together.
    #[serde(skip)]
    pub shown: Selection,
    /// Format, such as `NIfTI-1, gzip`.
    pub format: String,
    /// Type of a voxel in the file.
    #[serde(skip)]
    pub dtype: String,
    /// Voxels along x, y, z of the selected part.
    #[serde(skip)]
    pub dims: [u32; 3],
    /// Distances between voxel centres along x, y, z.
    #[serde(skip)]
    pub spacing: [f32; 3],
    /// Unit of the spacing, if known.
    pub unit: Option<String>,
    /// The directions of the volume's axes, such as `RAS`, if known.
    #[serde(skip)]
    pub orientation: Option<String>,
    /// The directions of the file's axes, such as `LPS`, or `+x+y+z` without a body.
    pub file_axes: String,
    /// Voxels along x, y, z of the whole volume.
    pub whole_dims: [u64; 3],
    /// Names or numbers of the channels; empty for one channel without a name.
    pub channels: Vec<String>,
    /// Number of channels. The list of names has an upper limit.
    pub num_channels: u64,
    /// Whether the channels can be shown together, up to [`isinglass_core::volume::MAX_CHANNELS`] of them.
    pub joins_channels: bool,
    /// Points in time.
    pub num_times: u64,
    /// Time from one point in time to the next, seconds, if the file tells it and has several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_step: Option<f64>,
    /// Levels of a pyramid, finest first; empty if there is one.
    pub levels: Vec<Level>,
    /// The selected level.
    pub level: u32,
    /// Descriptions of the series of a folder; empty if there is only one.
    pub series: Vec<String>,
    /// The imaging modality (`CT`, `MR`, …), if known.
    pub modality: Option<String>,
    /// Unit of the values, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value_unit: Option<String>,
    /// Whether the file says that the values are labels.
    pub are_labels: bool,
    /// What the values mean, if they are labels.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub labels: Vec<VolumeLabel>,
    /// Centre of the volume in the world of the file, which is RAS+ for a body; `None` if unknown.
    pub center: Option<[f64; 3]>,
    /// Directions of x, y and z in that world, if known.
    pub directions: Option<[[f64; 3]; 3]>,
    /// Bytes that the volume takes in memory and on the GPU. If voxels turn out to have no value, each takes one more.
    #[serde(skip)]
    pub bytes_in_memory: u64,
    /// Bytes that the voxels take during reading.
    pub bytes_while_reading: u64,
    /// The pages that the volume can be read by, if [`crate::page_count`] was asked and it can.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pages: Option<PageCount>,
    /// Warnings about the header and the selection.
    #[serde(skip)]
    pub warnings: Vec<Warning>,
}

/// The pages of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct PageCount {
    /// Levels of the file that have pages.
    pub levels: u32,
    /// Pages of the finest level.
    pub finest: u64,
    /// Bytes of memory that it takes to read the coarsest level, before any page is read.
    #[serde(skip)]
    pub bytes_to_open: u64,
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
    /// Bytes of memory that are needed to open the volume: the larger of the needs during and after reading.
    pub fn bytes_needed(&self) -> u64 {
        self.bytes_in_memory.max(self.bytes_while_reading)
    }

    /// Bytes that are needed beside another volume, until that makes room: all of them, or those of the coarsest level of
    /// one that is read by pages.
    pub fn bytes_beside(&self) -> u64 {
        self.pages.map_or_else(|| self.bytes_needed(), |pages| pages.bytes_to_open)
    }
}

impl fmt::Display for Outline {
    /// Prints a few lines beside dimensions, type and memory. Each ends with a line feed.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "  format       {}", self.format)?;
        let sides = |dims: &[u64; 3]| format!("{} × {} × {}", dims[0], dims[1], dims[2]);
        if self.whole_dims != self.dims.map(u64::from) {
            writeln!(f, "  part of      {}", sides(&self.whole_dims))?;
        }
        if !self.channels.is_empty() {
            let names = &self.channels[..self.channels.len().min(MAX_NAMED)];
            let more = if self.num_channels as usize > names.len() { ", …" } else { "" };
            let together = if self.shown.channel.is_none() { " (shown together)" } else { "" };
            writeln!(f, "  channels     {}: {}{more}{together}", self.num_channels, names.join(", "))?;
        }
        if self.num_times > 1 {
            let step = self.time_step.map_or(String::new(), |seconds| format!(", one every {seconds} s"));
            writeln!(f, "  times        {}{step}", self.num_times)?;
        }
        for (i, level) in self.levels.iter().enumerate() {
            let [x, y, z] = level.spacing;
            let mark = if i as u32 == self.level { " (shown)" } else { "" };
            writeln!(f, "  level {i:<6} {}, spacing {x} × {y} × {z}{mark}", sides(&level.dims))?;
        }
        if let Some(PageCount { levels, finest, .. }) = self.pages {
            let levels = if levels == 1 { "1 level".to_owned() } else { format!("{levels} levels") };
            writeln!(f, "  by pages     {finest} of 64 × 64 × 64 in the finest of {levels}")?;
        }
        for (i, series) in self.series.iter().enumerate() {
            writeln!(f, "  series {i:<5} {series}")?;
        }
        if self.are_labels && self.labels.is_empty() {
            writeln!(f, "  labels       the values are labels without names")?;
        }
        for VolumeLabel { value, name, color } in self.labels.iter().take(MAX_LABELS) {
            let color = color.map_or(String::new(), |[r, g, b]| format!(" #{r:02x}{g:02x}{b:02x}"));
            writeln!(f, "  label {value:<6} {name}{color}")?;
        }
        if self.labels.len() > MAX_LABELS {
            writeln!(f, "  labels       {} more", self.labels.len() - MAX_LABELS)?;
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

/// Most channels in a line.
const MAX_NAMED: usize = 16;
/// Most labels that are listed.
const MAX_LABELS: usize = 64;
