//! ImageJ's description of a hyperstack, in lines of `name=value`.

use super::page::Group;
use super::stack::{PlaneAxis, Stack};
use crate::error::quoted;
use crate::plan::ChannelLook;
use crate::units::{length_unit, time_step, time_unit, value_unit};

/// Whether a description is ImageJ's.
pub(super) fn is_imagej(text: &str) -> bool {
    text.starts_with("ImageJ=")
}

/// The stack of a description of the pages in `group`.
pub(super) fn stack(text: &str, group: &Group, metadata: Option<&ImageJMetadata>) -> Stack {
    let resolution = group.resolution;
    let get =
        |name: &str| text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix('=')).map(str::trim);
    let number = |name: &str| get(name).and_then(|v| v.parse::<f64>().ok()).filter(|v| v.is_finite());
    let (axes, guess) = axes(&get, group.shape.samples.into());
    let own = get("unit").and_then(length_unit);
    // Distances along y and z may have their own units.
    let in_own = |name: &str| match (get(name).and_then(length_unit), own) {
        (Some((meters, _)), Some((own, _))) => meters / own,
        _ => 1.0,
    };
    let unit = own.map(|(_, name)| name).or(get("unit").filter(|u| !is_pixel(u)).map(|_| ""));
    let in_plane = |i: usize| unit.and(resolution[i]).map(|pixels| 1.0 / pixels);
    // A negative spacing marks a stack that was taken downwards.
    let depth = number("spacing").map(f64::abs).filter(|d| *d > 0.0);
    let spacing = match (unit, depth) {
        (None, Some(depth)) => [Some(1.0), Some(1.0), Some(depth)],
        _ => [in_plane(0), in_plane(1).map(|y| y * in_own("yunit")), depth.map(|z| z * in_own("zunit"))],
    };
    let value_map = value_map(get("cf"), number("c1"), number("c0"));
    Stack {
        axes,
        spacing,
        unit: unit.filter(|u| !u.is_empty()).map(str::to_owned),
        channel_names: Vec::new(),
        channel_looks: metadata.map_or(Vec::new(), |m| m.looks(value_map)),
        has_channels: true,
        planes: None,
        series: Vec::new(),
        value_map,
        value_unit: get("vunit").filter(|_| get("cf") == Some("0")).and_then(value_unit),
        time_step: interval(number("finterval"), get("tunit"), number("fps")),
        guess,
        name: "ImageJ TIFF",
        in_files: "",
    }
}

/// The axes of the planes, the fastest first, and a word about what was assumed. A pixel has `samples` numbers.
///
/// ImageJ itself has channels, slices, frames (`czt`). Others name their order, such as `zct` or `xyzct`.
fn axes<'a>(get: &impl Fn(&str) -> Option<&'a str>, samples: u64) -> (Vec<(PlaneAxis, u64)>, Option<String>) {
    let count = |name: &str| get(name).and_then(|v| v.parse::<u64>().ok()).filter(|n| *n > 0);
    let images = count("images").unwrap_or(1);
    let mut sizes = [("channels", 'c'), ("slices", 'z'), ("frames", 't')].map(|(name, c)| (count(name), c));
    let product = |sizes: &[(Option<u64>, char); 3]| {
        sizes.iter().fold(1u64, |n, (size, _)| n.saturating_mul(size.unwrap_or(1)))
    };
    // Some writers count the colours of a pixel as channels.
    if samples > 1 && sizes[0].0 == Some(samples) && product(&sizes) != images {
        sizes[0].0 = Some(1);
    }
    // What the description has no number for takes the rest, slices first.
    let all = product(&sizes);
    if images > all && images.is_multiple_of(all) {
        let is_alone = all == 1;
        let free = [1, 2, 0].into_iter().find(|&i| sizes[i].0.is_none() || (is_alone && i == 1));
        if let Some(i) = free {
            sizes[i].0 = Some(images / all);
        }
    }
    let told = get("order").map(str::to_lowercase);
    let order = told.as_deref().map(|order| order.strip_prefix("xy").unwrap_or(order));
    let is_known = |order: &str| order.len() == 3 && "czt".chars().all(|c| order.contains(c));
    let guess = order.filter(|order| !is_known(order) && !["", "default"].contains(order)).map(|order| {
        format!(
            "the order {} is not known; planes were taken as channels, then slices, then times",
            quoted(order)
        )
    });
    let axes = order.filter(|order| is_known(order)).unwrap_or("czt").chars().map(|c| {
        let size = sizes.iter().find(|(_, name)| *name == c).and_then(|(size, _)| *size).unwrap_or(1);
        let axis = match c {
            'c' => PlaneAxis::Channel,
            'z' => PlaneAxis::Z,
            _ => PlaneAxis::Time,
        };
        (axis, size)
    });
    (axes.collect(), guess)
}

/// Seconds between the frames: their interval in its unit, or what the rate of playing says.
fn interval(interval: Option<f64>, unit: Option<&str>, frames_per_second: Option<f64>) -> Option<f64> {
    let told = interval.and_then(|interval| time_step(interval * time_unit(unit.unwrap_or("sec"))?));
    told.or_else(|| time_step(1.0 / frames_per_second?))
}

/// What ImageJ writes into tags of its own: a table of colours and a range of values for each channel.
#[derive(Debug, Default, PartialEq)]
pub(super) struct ImageJMetadata {
    colors: Vec<Option<[u8; 3]>>,
    ranges: Vec<(f64, f64)>,
}

impl ImageJMetadata {
    /// Parses `bytes`, which are blocks of these `lengths`. The first block lists the kinds of the others.
    pub(super) fn of(bytes: &[u8], lengths: &[u32]) -> Option<Self> {
        let (list, lengths) = lengths.split_first()?;
        let (list, mut rest) = bytes.split_at_checked(*list as usize)?;
        let (magic, kinds) = list.split_at_checked(4)?;
        let is_little = match magic {
            b"IJIJ" => false,
            b"JIJI" => true,
            _ => return None,
        };
        let mut found = Self::default();
        let mut lengths = lengths.iter();
        for kind in kinds.as_chunks::<8>().0 {
            let (mut name, count) =
                ([kind[0], kind[1], kind[2], kind[3]], [kind[4], kind[5], kind[6], kind[7]]);
            let count = if is_little { u32::from_le_bytes(count) } else { u32::from_be_bytes(count) };
            if is_little {
                name.reverse();
            }
            for length in lengths.by_ref().take(count as usize) {
                let block;
                (block, rest) = rest.split_at_checked(*length as usize)?;
                match &name {
                    b"luts" => found.colors.push(color(block)),
                    b"rang" => {
                        let number = |b: [u8; 8]| {
                            if is_little { f64::from_le_bytes(b) } else { f64::from_be_bytes(b) }
                        };
                        let numbers: Vec<f64> = block.as_chunks().0.iter().map(|b| number(*b)).collect();
                        found.ranges = numbers.as_chunks::<2>().0.iter().map(|[a, b]| (*a, *b)).collect();
                    }
                    _ => {}
                }
            }
        }
        Some(found)
    }

    /// How each channel is shown. Ranges are of numbers, and `slope` and `intercept` turn them into values.
    fn looks(&self, (slope, intercept): (f64, f64)) -> Vec<ChannelLook> {
        let value = |number: f64| slope * number + intercept;
        let look = |i: usize| ChannelLook {
            window: self.ranges.get(i).map(|&(a, b)| (value(a), value(b))),
            color: self.colors.get(i).copied().flatten(),
            is_hidden: false,
        };
        (0..self.colors.len().max(self.ranges.len())).map(look).collect()
    }
}

/// The colour of a table of 256 reds, greens and blues that goes evenly from black to it.
pub(super) fn color(table: &[u8]) -> Option<[u8; 3]> {
    let table: &[u8; 768] = table.try_into().ok()?;
    let at = |i: usize| [table[i], table[256 + i], table[512 + i]];
    let (black, middle, last) = (at(0), at(128), at(255));
    let is_even = (0..3).all(|c| black[c] < 8 && middle[c].abs_diff(last[c] / 2) < 8);
    (is_even && last != [0; 3]).then_some(last)
}

/// Whether lengths are in pixels.
fn is_pixel(unit: &str) -> bool {
    matches!(unit.to_lowercase().as_str(), "" | "pixel" | "pixels")
}

/// Slope and intercept of a linear calibration. Other functions are ignored. Signed integers are stored as unsigned
/// ones with a calibration.
fn value_map(function: Option<&str>, slope: Option<f64>, intercept: Option<f64>) -> (f64, f64) {
    match (function, slope, intercept) {
        (Some("0"), Some(slope), Some(intercept)) if slope != 0.0 => (slope, intercept),
        _ => (1.0, 0.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dtype::Dtype;
    use crate::tiff::page::PageShape;

    fn group(samples: u16) -> Group {
        Group {
            shape: PageShape {
                width: 3,
                height: 2,
                samples,
                is_planar: false,
                dtype: Dtype::Uint8,
                is_white: false,
            },
            pages: vec![0],
            shaped: None,
            resolution: [Some(4.0), Some(2.0)],
            unit_mm: None,
            block: None,
            palette: None,
        }
    }

    #[test]
    fn planes_have_the_order_that_the_description_names() {
        use PlaneAxis::{Channel, Time, Z};
        let told = |lines: &str, samples: u16| {
            let stack = stack(&format!("ImageJ=1.53c\n{lines}\n"), &group(samples), None);
            (stack.axes, stack.guess.is_some())
        };
        let all = "images=24\nchannels=2\nslices=4\nframes=3";
        let of = |order: &str| -> Vec<(PlaneAxis, u64)> {
            let axis = |c| match c {
                'c' => (Channel, 2),
                'z' => (Z, 4),
                _ => (Time, 3),
            };
            order.chars().map(axis).collect()
        };
        for order in ["czt", "ctz", "zct", "ztc", "tcz", "tzc"] {
            for line in [
                format!("order={order}"),
                format!("order=xy{order}"),
                format!("order=XY{}", order.to_uppercase()),
            ] {
                assert_eq!(told(&format!("{all}\n{line}"), 1), (of(order), false), "{line}");
            }
        }
        for (line, is_guess) in
            [("", false), ("order=default", false), ("order=zz", true), ("order=xyczz", true)]
        {
            assert_eq!(told(&format!("{all}\n{line}"), 1), (of("czt"), is_guess), "{line}");
        }
        let sizes =
            |lines: &str, samples: u16| told(lines, samples).0.iter().map(|a| a.1).collect::<Vec<_>>();
        assert_eq!(sizes("images=12\nslices=12", 1), [1, 12, 1]);
        assert_eq!(sizes("images=12", 1), [1, 12, 1]);
        assert_eq!(sizes("images=12\nchannels=2\nhyperstack=true", 1), [2, 6, 1]);
        assert_eq!(sizes("images=12\nslices=6", 1), [1, 6, 2]);
        assert_eq!(sizes("images=12\nslices=3\nframes=2", 1), [2, 3, 2]);
        assert_eq!(
            sizes("images=4\nchannels=3\nslices=4", 3),
            [1, 4, 1],
            "channels are the colours of a pixel"
        );
        assert_eq!(sizes("images=12\nchannels=3\nslices=4", 1), [3, 4, 1]);
        // The control: what does not divide stays as it is told.
        assert_eq!(sizes("images=13\nchannels=2\nslices=3", 1), [2, 3, 1]);
    }

    #[test]
    fn steps_have_their_unit_along_each_axis() {
        let told = |lines: &str| {
            let text = format!("ImageJ=1.54f\nimages=4\nslices=4\n{lines}\n");
            let Stack { spacing, unit, .. } = stack(&text, &group(1), None);
            (spacing.map(|s| s.unwrap_or(0.0)), unit)
        };
        for (name, expected) in [
            ("micron", "µm"),
            ("um", "µm"),
            ("µm", "µm"),
            ("\\u00B5m", "µm"),
            ("\u{fffd}m", "µm"),
            ("nm", "nm"),
            ("mm", "mm"),
            ("cm", "cm"),
            ("inch", "in"),
            ("Å", "Å"),
        ] {
            let expected = ([0.25, 0.5, 3.0], Some(expected.to_owned()));
            assert_eq!(told(&format!("unit={name}\nspacing=3.0")), expected, "{name}");
            assert_eq!(told(&format!("unit={name}\nspacing=-3.0")), expected, "{name}");
        }
        let (spacing, _) = told("unit=micron\nyunit=nm\nzunit=mm\nspacing=0.002");
        let near = spacing.iter().zip([0.25, 0.0005, 2.0]).all(|(a, b)| (a / b - 1.0_f64).abs() < 1e-12);
        assert!(near, "{spacing:?}");
        // The thickness of a slice is in pixels and has no unit.
        assert_eq!(told("spacing=3.0"), ([1.0, 1.0, 3.0], None));
        assert_eq!(told("unit=pixel\nspacing=3.0"), ([1.0, 1.0, 3.0], None));
        assert_eq!(told("unit=pixel"), ([0.0; 3], None));
        assert_eq!(told("unit=furlong\nspacing=3.0"), ([0.25, 0.5, 3.0], None));
    }
}
