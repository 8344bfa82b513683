//! The segments that 3D Slicer lists in the keys of a `.seg.nrrd`.

use std::collections::BTreeMap;

use isinglass_core::volume::VolumeLabel;

use crate::error::one_line;

/// What is said about each segment, by its number.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Segments(BTreeMap<u32, Segment>);

#[derive(Debug, Default, PartialEq)]
struct Segment {
    name: Option<String>,
    value: Option<u32>,
    color: Option<[u8; 3]>,
    /// The channel that has it. Segments that overlap are in different ones.
    layer: Option<u32>,
}

impl Segments {
    /// Takes a key such as `Segment0_Name` with its value; others say nothing.
    pub(super) fn take(&mut self, key: &str, value: &str) {
        let Some((number, field)) = key.trim().strip_prefix("Segment").and_then(|rest| rest.split_once('_'))
        else {
            return;
        };
        let Some(number) = number.parse().ok().filter(|n| *n < MAX_SEGMENTS) else { return };
        let value = value.trim();
        let known = ["Name", "LabelValue", "Layer", "Color"];
        if !known.contains(&field) {
            return;
        }
        let segment = self.0.entry(number).or_default();
        match field {
            "Name" => segment.name = Some(one_line(value)),
            "LabelValue" => segment.value = value.parse().ok(),
            "Layer" => segment.layer = value.parse().ok(),
            _ => {
                let parts: Option<Vec<f64>> =
                    value.split_ascii_whitespace().map(|w| w.parse().ok()).collect();
                let byte = |x: f64| (x.clamp(0.0, 1.0) * 255.0).round() as u8;
                segment.color = match parts.as_deref() {
                    Some(&[red, green, blue]) => Some([red, green, blue].map(byte)),
                    _ => None,
                };
            }
        }
    }

    /// Whether there is any.
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The labels in a channel. Older files have a channel of 0 and 1 for each segment.
    pub(super) fn labels(&self, channel: u32) -> Vec<VolumeLabel> {
        let is_old = self.0.values().all(|segment| segment.value.is_none());
        let layer = |number: u32, segment: &Segment| segment.layer.unwrap_or(if is_old { number } else { 0 });
        let in_channel = self.0.iter().filter(|(number, segment)| layer(**number, segment) == channel);
        let mut labels: Vec<VolumeLabel> = in_channel
            .map(|(number, segment)| VolumeLabel {
                value: segment.value.unwrap_or(1),
                name: segment.name.clone().unwrap_or_else(|| format!("segment {number}")),
                color: segment.color,
            })
            .collect();
        labels.sort_by_key(|label| label.value);
        labels
    }
}

/// Most segments.
const MAX_SEGMENTS: u32 = 1 << 16;
