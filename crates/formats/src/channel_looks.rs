//! The first look of volumes with several channels, of labels and of pixels in their own colours.

use isinglass_core::channels::{Blend, ChannelLook, Channels, Visibility};
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Histogram, Volume, Voxels};

use crate::first_look::of_quantities;

/// How the values of a channel become colours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum ChannelColors {
    /// Each label has a colour of its own.
    Labels,
    /// All in one colour, sRGB, more opaque where the value is greater.
    Plain([u8; 3]),
    /// One component of pixels with colours.
    OfPixels([u8; 3]),
}

/// The colours of channel `number`, from 0, of a volume. `None` for quantities that have no channels beside them.
pub(crate) fn of_channel(number: usize, whole: &Volume) -> Option<ChannelColors> {
    let channel = whole.channels().nth(number)?;
    if channel.info.are_labels {
        return Some(ChannelColors::Labels);
    }
    let components: Vec<_> = whole.channels().map(|c| c.info.channel.color).collect();
    let is_quantity = |c: &&Volume| !c.info.are_labels;
    if PRIMARIES.iter().map(|p| Some(*p)).eq(components.iter().take(3).copied())
        && whole.channels().take(3).map(|c| &*c.info.channel.name).eq(["red", "green", "blue"])
    {
        return PRIMARIES.get(number).map(|color| ChannelColors::OfPixels(*color));
    }
    let own = channel.info.channel.color;
    let has_company = whole.channels().filter(is_quantity).count() > 1;
    own.or(has_company.then(|| PALETTE[number % PALETTE.len()])).map(ChannelColors::Plain)
}

/// The looks of a volume's channels, beside the transfer function of the first.
pub fn default_channels(volume: &Volume) -> Channels {
    let visibility =
        |channel: &Volume| Visibility { is_hidden: channel.info.channel.is_hidden, ..Visibility::default() };
    let look = |(number, channel): (usize, &Volume)| {
        let quantities = || of_quantities("", channel, &Histogram::of(channel));
        let transfer = match of_channel(number, volume) {
            Some(ChannelColors::Labels) => of_labels(),
            Some(ChannelColors::Plain(color)) => in_color(quantities(), color),
            Some(ChannelColors::OfPixels(color)) => of_pixels(channel, color),
            None => quantities(),
        };
        ChannelLook { transfer, visibility: visibility(channel) }
    };
    let has_labels = volume.others().iter().any(|other| other.info.are_labels);
    let mut channels = Channels {
        blend: if has_labels { Blend::Over } else { Blend::Additive },
        first: visibility(volume),
        others: volume.channels().enumerate().skip(1).map(look).collect(),
        chosen: 0,
    };
    // A file in which everything is hidden still shows something.
    if channels.first.is_hidden && channels.others.iter().all(|other| other.visibility.is_hidden) {
        channels.first.is_hidden = false;
    }
    channels
}

/// Labels, translucent.
pub(crate) fn of_labels() -> TransferFunction {
    let point = ControlPoint { x: 0.0, color: [1.0; 3], opacity: 0.35 };
    TransferFunction {
        name: "labels".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![point],
    }
}

/// The same function in one colour.
pub(crate) fn in_color(mut transfer: TransferFunction, color: [u8; 3]) -> TransferFunction {
    let color = color.map(|c| f32::from(c) / 255.0);
    transfer.points.iter_mut().for_each(|point| point.color = color);
    transfer
}

/// One component of pixels: with light that adds up, each pixel has its own hue, and is as opaque as it is bright.
pub(crate) fn of_pixels(volume: &Volume, color: [u8; 3]) -> TransferFunction {
    let white = match volume.voxels() {
        Voxels::U8(_) => 255.0,
        _ => volume.value_range().1.max(f32::MIN_POSITIVE),
    };
    let point = |x, opacity| ControlPoint { x, color: [1.0; 3], opacity };
    let transfer = TransferFunction {
        name: "pixels".into(),
        domain: Domain::Values(0.0, white),
        unit_length: UnitLength::Radius(0.02),
        points: vec![point(0.04, 0.0), point(1.0, 0.5)],
    };
    in_color(transfer, color)
}

/// Colours of channels that the file gives none.
const PALETTE: [[u8; 3]; 8] = [
    [0, 255, 0],
    [255, 0, 255],
    [0, 200, 255],
    [255, 220, 0],
    [255, 70, 70],
    [80, 120, 255],
    [255, 150, 0],
    [230, 230, 230],
];
const PRIMARIES: [[u8; 3]; 3] = [[255, 0, 0], [0, 255, 0], [0, 0, 255]];

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::Vec3;
    use isinglass_core::volume::{ChannelInfo, VolumeInfo};

    use super::*;

    fn channel(name: &str, color: Option<[u8; 3]>, is_hidden: bool) -> Volume {
        let voxels = Voxels::U8((0..64).map(|i| i * 4).collect());
        let channel = ChannelInfo { name: name.into(), color, is_hidden };
        let info = VolumeInfo { channel, ..VolumeInfo::default() };
        Volume::new([4; 3], Vec3::ONE, voxels, (1.0, 0.0), info).unwrap()
    }

    fn with(first: Volume, others: Vec<Volume>) -> Volume {
        first.with_others(others.into_iter().map(Arc::new).collect()).unwrap()
    }

    #[test]
    fn channels_have_the_colours_of_the_file_or_different_ones() {
        let nuclei = channel("nuclei", Some([10, 20, 30]), false);
        let whole = with(nuclei, vec![channel("a", None, true), channel("b", None, false)]);
        let colors: Vec<_> = (0..3).map(|i| of_channel(i, &whole)).collect();
        let plain = |color| Some(ChannelColors::Plain(color));
        assert_eq!(colors, [plain([10, 20, 30]), plain(PALETTE[1]), plain(PALETTE[2])]);
        let looks = default_channels(&whole);
        assert_eq!(looks.blend, Blend::Additive);
        assert!(looks.others[0].visibility.is_hidden && !looks.others[1].visibility.is_hidden);
        assert_eq!(looks.others[1].transfer.points[0].color, PALETTE[2].map(|c| f32::from(c) / 255.0));
        // The controls: one channel has its usual preset, and something is always seen.
        assert_eq!(of_channel(0, &channel("", None, false)), None);
        let hidden = with(channel("", None, true), vec![channel("", None, true)]);
        assert!(!default_channels(&hidden).first.is_hidden);
    }

    #[test]
    fn pixels_keep_their_colours_and_labels_lie_over() {
        let [red, green, blue] = PRIMARIES.map(Some);
        let component = |name, color| channel(name, color, false);
        let pixels = with(component("red", red), vec![component("green", green), component("blue", blue)]);
        assert_eq!(of_channel(1, &pixels), Some(ChannelColors::OfPixels(PRIMARIES[1])));
        // The control: three channels in the same colours that are no pixel's.
        let channels = with(component("a", red), vec![component("b", green), component("c", blue)]);
        assert_eq!(of_channel(1, &channels), Some(ChannelColors::Plain(PRIMARIES[1])));
        let mut labels = channel("", None, false);
        labels.info.are_labels = true;
        let looks = default_channels(&with(channel("", None, false), vec![labels]));
        assert_eq!((looks.blend, &*looks.others[0].transfer.name), (Blend::Over, "labels"));
    }
}
