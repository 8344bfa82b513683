//! Pages whose numbers are places in a table of colours. A table that goes smoothly from colour to colour is a look of
//! intensities, as ImageJ writes it. One that jumps from number to number has the colours of labels.

use ::tiff::tags::Tag;
use isinglass_core::volume::VolumeLabel;

use super::imagej;
use super::page::PageDecoder;
use crate::plan::{ChannelLook, Plan};
use crate::warning::WarningKind;

/// The colours of the numbers from 0 on.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Palette(Vec<[u8; 3]>);

impl Palette {
    /// The table of the current page, if it has one.
    pub(super) fn here(decoder: &mut PageDecoder) -> Option<Self> {
        decoder.find_tag(Tag::PhotometricInterpretation).ok()??.into_u16().ok().filter(|p| *p == 3)?;
        Self::of(&decoder.get_tag_u16_vec(Tag::ColorMap).ok()?)
    }

    /// All reds, then greens, then blues, of 16 bits. Some writers leave them at 8.
    fn of(table: &[u16]) -> Option<Self> {
        let count = table.len() / 3;
        let shift = if table.iter().all(|x| *x < 256) { 0 } else { 8 };
        let color = |i: usize| [0, 1, 2].map(|k| (table[k * count + i] >> shift) as u8);
        (count > 1).then(|| Self((0..count).map(color).collect()))
    }

    /// The colours without those at the end that all are one, to fill the table.
    fn used(&self) -> &[[u8; 3]] {
        let last = self.0.last();
        let num_last = self.0.iter().rev().take_while(|color| Some(*color) == last).count();
        let num_filled = if num_last > 1 { num_last } else { 0 };
        &self.0[..(self.0.len() - num_filled).max(2)]
    }

    /// Whether most neighbours in the table have colours that are far from each other.
    fn has_leaps(&self) -> bool {
        let used = self.used();
        let is_leap = |pair: &&[[u8; 3]]| (0..3).any(|k| pair[0][k].abs_diff(pair[1][k]) >= LEAST_LEAP);
        let num_leaps = used.windows(2).filter(is_leap).count();
        num_leaps * 2 > used.len() - 1
    }

    /// Gives a plan of one channel the colours.
    pub(super) fn apply(&self, plan: &mut Plan) {
        if self.has_leaps() && plan.channels() == 1 {
            let label = |(value, color): (usize, &[u8; 3])| VolumeLabel {
                value: value as u32,
                name: format!("colour {value}"),
                color: Some(*color),
            };
            plan.labels = self.used().iter().enumerate().skip(1).take(MOST_LABELS).map(label).collect();
            plan.are_labels = true;
            let text = "the table of colours jumps from number to number, so they are labels; --voxels values shows them as values";
            plan.warn(WarningKind::Guess, text);
            return;
        }
        let is_gray = self.0.iter().all(|[r, g, b]| r == g && g == b);
        let table: Vec<u8> = (0..3).flat_map(|k| self.0.iter().map(move |color| color[k])).collect();
        let look = imagej::color(&table).filter(|_| !is_gray);
        if look.is_some() && plan.channel_looks.is_empty() {
            plan.channel_looks = vec![ChannelLook { color: look, ..ChannelLook::default() }];
        }
        if look.is_none() && !is_gray {
            plan.warn(
                WarningKind::Choice,
                "the table of colours is left out; the numbers are shown as values",
            );
        }
    }
}

/// Least distance of two colours that are far from each other, of 255.
const LEAST_LEAP: u8 = 32;
/// Most labels with colours of their own.
const MOST_LABELS: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    /// A table of these colours, to which the last one is added.
    fn palette(color: impl Fn(usize) -> [u8; 3]) -> Palette {
        let table: Vec<u16> =
            (0..3).flat_map(|k| (0..256).map(|i| u16::from(color(i)[k]) * 257).collect::<Vec<_>>()).collect();
        Palette::of(&table).unwrap()
    }

    #[test]
    fn leaps_of_colours_are_labels_and_ramps_are_looks() {
        let few = [[0, 0, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255]];
        let labels = [
            palette(|i| few.get(i).copied().unwrap_or_default()),
            palette(|i| if i == 1 { [255; 3] } else { [0; 3] }),
            // Colours that look random, as for hundreds of cells.
            palette(|i| {
                if i == 0 {
                    [0; 3]
                } else {
                    [(i * 97 % 256) as u8, (i * 57 % 256) as u8, (i * 151 % 256) as u8]
                }
            }),
        ];
        labels.iter().for_each(|palette| assert!(palette.has_leaps(), "{palette:?}"));
        assert_eq!(labels[0].used(), few);
        let looks = [
            palette(|i| [i as u8; 3]),
            palette(|i| [255 - i as u8; 3]),
            palette(|i| [0, i as u8, 0]),
            // Red, then yellow, then white, and a look in bands.
            palette(|i| [0, 85, 170].map(|from| ((i.saturating_sub(from)) * 3).min(255) as u8)),
            palette(|i| few[i / 64]),
        ];
        looks.iter().for_each(|palette| assert!(!palette.has_leaps(), "{palette:?}"));
        assert_eq!(Palette::of(&[1, 2, 3]), None);
        assert_eq!(
            Palette::of(&[0, 200, 0, 100, 0, 50]),
            Some(Palette(vec![[0; 3], [200, 100, 50]])),
            "8 bits"
        );
    }
}
