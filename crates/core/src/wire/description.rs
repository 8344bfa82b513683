//! The viewer's description of a volume and its channels.

use serde::{Deserialize, Serialize};

use super::control::{ControlError, check_text};
use crate::look::MAX_NAME_BYTES;
use crate::space::Aabb;
use crate::text;
use crate::volume::{Histogram, MAX_CHANNELS, Placement, Volume, VolumeLabel};

/// The viewer's description of the volume.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VolumeDescription {
    /// File name or name of the built-in volume.
    pub name: String,
    /// Voxels along x, y, z.
    pub dims: [u32; 3],
    /// Size of a voxel, world units.
    pub spacing: [f32; 3],
    /// Unit of the spacing, if known.
    pub unit: Option<String>,
    /// Directions of the axes, such as `RAS`, if known.
    pub orientation: Option<String>,
    /// Position of the volume in the world of its file, if known.
    pub placement: Option<Placement>,
    /// Unit of the values, if known.
    pub value_unit: Option<String>,
    /// Least and greatest value.
    pub value_range: (f32, f32),
    /// The range that the histogram's bins cover: the value range, or less if a few voxels lie far away. The first
    /// and the last bin count those.
    pub histogram_range: (f32, f32),
    /// Number of voxels in each of at most [`MAX_BINS`] equal bins.
    pub histogram: Vec<u64>,
    /// All channels, the first included, if there are several or the values are labels; else none.
    pub channels: Vec<ChannelDescription>,
}

/// The viewer's description of a channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChannelDescription {
    /// A name in one line.
    pub name: String,
    /// The least and greatest value.
    pub value_range: (f32, f32),
    /// As in [`VolumeDescription`].
    pub histogram_range: (f32, f32),
    /// As in [`VolumeDescription`], in at most [`MAX_CHANNEL_BINS`] bins.
    pub histogram: Vec<u64>,
    /// Whether the values are labels.
    pub are_labels: bool,
    /// What they mean: at most [`MAX_LABELS`] of them.
    pub labels: Vec<VolumeLabel>,
}

impl VolumeDescription {
    /// Describes a volume. `histogram` must be the volume's own.
    pub fn of(volume: &Volume, histogram: &Histogram) -> Self {
        let cut = |s: &str| text::printable(s, MAX_NAME_BYTES / 4);
        Self {
            name: cut(&volume.info.name),
            dims: volume.finest_dims(),
            spacing: volume.finest_spacing().to_array(),
            unit: volume.info.unit.as_deref().map(cut),
            orientation: volume.info.orientation.as_deref().map(cut),
            placement: volume.info.placement,
            value_unit: volume.info.value_unit.as_deref().map(cut),
            value_range: volume.value_range(),
            histogram_range: (histogram.lo, histogram.hi),
            histogram: in_bins(histogram, MAX_BINS),
            channels: Vec::new(),
        }
    }

    /// Describes a volume with all of its channels, whose histograms these are.
    pub fn of_channels<'a>(volume: &Volume, histograms: impl Iterator<Item = &'a Histogram>) -> Self {
        let mut histograms = histograms.peekable();
        let empty = Histogram::default();
        let mut description = Self::of(volume, histograms.peek().copied().unwrap_or(&empty));
        if !volume.others().is_empty() || volume.info.are_labels {
            let channels = volume.channels().zip(histograms).enumerate();
            description.channels = channels.map(|(i, (c, h))| ChannelDescription::of(i, c, h)).collect();
        }
        description
    }

    /// The volume's box in world space: centred at the origin.
    pub fn bounds(&self) -> Aabb {
        let half =
            glam::Vec3::from_array(std::array::from_fn(|i| self.dims[i] as f32 * self.spacing[i] * 0.5));
        Aabb { min: -half, max: half }
    }

    pub(super) fn validate(&self) -> Result<(), ControlError> {
        check_text("volume name", &self.name, MAX_NAME_BYTES)?;
        for s in [&self.unit, &self.orientation, &self.value_unit].into_iter().flatten() {
            check_text("unit or orientation", s, MAX_NAME_BYTES)?;
        }
        let numbers = self.placement.iter().flat_map(|p| p.axes.iter().flatten().chain(&p.center));
        if numbers.into_iter().any(|x| !x.is_finite()) {
            return Err(ControlError::Value("placement"));
        }
        let positive = |x: &f32| *x > 0.0 && x.is_finite();
        if self.dims.contains(&0) || !self.spacing.iter().all(positive) || !self.bounds().radius().is_finite()
        {
            return Err(ControlError::Value("volume size"));
        }
        let (lo, hi) = self.value_range;
        let is_range = |(lo, hi): (f32, f32)| lo <= hi && lo.is_finite() && hi.is_finite();
        if !is_range(self.value_range) {
            return Err(ControlError::Value("value range"));
        }
        let (first, last) = self.histogram_range;
        if !is_range(self.histogram_range) || first < lo || last > hi {
            return Err(ControlError::Value("histogram range"));
        }
        if self.histogram.len() > MAX_BINS {
            return Err(ControlError::Value("histogram"));
        }
        if self.channels.len() > MAX_CHANNELS {
            return Err(ControlError::Value("number of channels"));
        }
        self.channels.iter().try_for_each(ChannelDescription::validate)
    }
}

impl ChannelDescription {
    /// Describes channel `number`, from 0. `histogram` must be its own.
    fn of(number: usize, volume: &Volume, histogram: &Histogram) -> Self {
        let names = [&volume.info.channel.name, &volume.info.name];
        let name =
            names.map(|name| text::printable(name, MAX_LABEL_CHARS)).into_iter().find(|n| !n.is_empty());
        let label = |label: &VolumeLabel| VolumeLabel {
            name: text::printable(&label.name, MAX_LABEL_CHARS),
            ..label.clone()
        };
        Self {
            name: name.unwrap_or_else(|| format!("channel {number}")),
            value_range: volume.value_range(),
            histogram_range: (histogram.lo, histogram.hi),
            histogram: in_bins(histogram, MAX_CHANNEL_BINS),
            are_labels: volume.info.are_labels,
            labels: volume.info.labels.iter().take(MAX_LABELS).map(label).collect(),
        }
    }

    fn validate(&self) -> Result<(), ControlError> {
        check_text("channel name", &self.name, MAX_NAME_BYTES)?;
        let ((lo, hi), (first, last)) = (self.value_range, self.histogram_range);
        let is_range = |lo: f32, hi: f32| lo <= hi && lo.is_finite() && hi.is_finite();
        if !is_range(lo, hi) || !is_range(first, last) || first < lo || last > hi {
            return Err(ControlError::Value("range of a channel"));
        }
        if self.histogram.len() > MAX_CHANNEL_BINS || self.labels.len() > MAX_LABELS {
            return Err(ControlError::Value("histogram or list of labels"));
        }
        self.labels.iter().try_for_each(|label| check_text("label", &label.name, MAX_NAME_BYTES))
    }
}

/// The counts of a histogram in at most `most` bins.
fn in_bins(histogram: &Histogram, most: usize) -> Vec<u64> {
    let bins = histogram.counts.len().clamp(1, most);
    let mut counts = vec![0u64; bins];
    for (i, n) in histogram.counts.iter().enumerate() {
        counts[i * bins / histogram.counts.len()] += n;
    }
    counts
}

/// Most bins in a description's histogram. A window of a hundredth of the range gets forty. A bin takes at most nine
/// bytes, so they leave room in a message.
pub const MAX_BINS: usize = 4096;
/// Most bins in the histogram of a channel beside others.
pub const MAX_CHANNEL_BINS: usize = 512;
/// Most labels that are described.
pub const MAX_LABELS: usize = 256;
/// Longest name of a label or a channel.
const MAX_LABEL_CHARS: usize = 40;
