//! The first look of a volume: a preset, with the domain and the opacity that fit its values.

use isinglass_core::transfer::{Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Histogram, Volume};

use crate::channel_looks::{ChannelColors, in_color, of_channel, of_labels, of_pixels};
use crate::presets::{DARK, SIGNED, preset, preset_within};
use crate::surroundings::{MatterSide, Sides, Surroundings};

/// [`default_preset`](crate::default_preset) as a transfer function, with the window of the file if it has one. What
/// surrounds the matter would hide it, so opacity begins where its values end, whether the matter is brighter or darker.
pub fn default_transfer(source: &str, volume: &Volume, histogram: &Histogram) -> TransferFunction {
    match of_channel(0, volume) {
        Some(ChannelColors::Labels) => of_labels(),
        Some(ChannelColors::Plain(color)) => in_color(of_quantities(source, volume, histogram), color),
        Some(ChannelColors::OfPixels(color)) => of_pixels(volume, color),
        None => of_quantities(source, volume, histogram),
    }
}

/// The same for quantities in one channel.
pub(crate) fn of_quantities(source: &str, volume: &Volume, histogram: &Histogram) -> TransferFunction {
    let sides = Sides::of(volume);
    let surroundings = Surroundings::of(volume, histogram, &sides);
    let name = preset_within(source, volume, histogram, surroundings.as_ref());
    let mut transfer = preset(name).expect("the default is one of the presets");
    match surroundings {
        Some(surroundings) if name == DARK => begin_below(&mut transfer, &surroundings),
        Some(surroundings) if name == SIGNED => begin_around(&mut transfer, &surroundings),
        surroundings => begin_above(&mut transfer, volume, histogram, (&sides, surroundings)),
    }
    // The matter of a thin volume is as opaque as that of sixteen voxels.
    let thinnest = (volume.bounds().max - volume.bounds().min).min_element() / THINNEST;
    if transfer.unit_length_in(volume) > thinnest && thinnest > 0.0 {
        transfer.unit_length = UnitLength::World(thinnest);
    }
    transfer
}

/// Fits a function that is clear at its end to matter below its surroundings.
fn begin_below(transfer: &mut TransferFunction, surroundings: &Surroundings) {
    let (lo, clear) = (surroundings.reach.0, surroundings.values.0);
    let hi = lo + (clear - lo) / transfer.points.last().map_or(1.0, |point| point.x);
    if hi > lo && hi.is_finite() {
        transfer.domain = Domain::Values(lo, hi);
    }
}

/// Fits a function that is clear in its middle to matter on both sides of its surroundings.
fn begin_around(transfer: &mut TransferFunction, surroundings: &Surroundings) {
    let &Surroundings { values, reach, .. } = surroundings;
    let middle = surroundings.middle();
    let most = (middle - reach.0).max(reach.1 - middle);
    let wanted = ((middle - values.0).max(values.1 - middle) / most).min(MOST_CLEAR);
    let from_middle = |x: f32| 2.0 * (x - 0.5).abs();
    let clear_points = transfer.points.iter().filter(|point| point.opacity == 0.0);
    let clear = clear_points.map(|point| from_middle(point.x)).fold(0.0, f32::max);
    let (lo, hi) = (middle - most, middle + most);
    if wanted <= clear && surroundings.are_about_zero() || !(lo < hi && hi - lo < f32::INFINITY) {
        return;
    }
    transfer.domain = Domain::Values(lo, hi);
    if wanted <= clear {
        return;
    }
    for point in &mut transfer.points {
        let at = from_middle(point.x);
        let moved = match at <= clear {
            true => at / clear * wanted,
            false => wanted + (at - clear) / (1.0 - clear) * (1.0 - wanted),
        };
        point.x = (0.5 + 0.5 * moved * if point.x < 0.5 { -1.0 } else { 1.0 }).clamp(0.0, 1.0);
    }
}

/// Fits a function that begins clear to matter above its surroundings, or to what is above most of the outermost voxels.
fn begin_above(
    transfer: &mut TransferFunction,
    volume: &Volume,
    histogram: &Histogram,
    (sides, surroundings): (&Sides, Option<Surroundings>),
) {
    let (from, to) = match transfer.domain {
        Domain::Full => (0.0, 100.0),
        Domain::Percentiles(from, to) => (from, to),
        Domain::Values(..) | Domain::AboutZero(_) => return,
    };
    let (mut lo, mut hi) = (histogram.percentile(from), histogram.percentile(to));
    // A window that shows nearly nothing or all as white is no good beginning.
    let share = |value: f32| histogram.share_above(value);
    if let Some((black, white)) = volume.info.window
        && share(black) > FEWEST_SHOWN
        && share(white) < MOST_WHITE
    {
        (lo, hi) = (black, white);
        transfer.domain = Domain::Values(lo, hi);
    }
    let clear = transfer.points[0].x;
    let begins_at = |value: f32, hi: f32| {
        let begin = (value - clear * hi) / (1.0 - clear);
        (begin > lo && begin < hi).then_some(Domain::Values(begin, hi))
    };
    let above = surroundings.filter(|surroundings| surroundings.matter == MatterSide::Above);
    // Sparse matter lies above nearly all of the values.
    let veil = above.and_then(|around| begins_at(around.values.1, hi.max(around.reach.1)));
    let block = || {
        let highest = sides.percentile(0.98);
        let is_block = sides.are_block(transfer, (lo, hi)) && share(highest) > FEWEST_SHOWN;
        begins_at(highest, hi).filter(|_| is_block)
    };
    if let Some(domain) = veil.or_else(block) {
        transfer.domain = domain;
    }
}

/// The least share of voxels that a look must show, and the greatest share that may be at its upper end.
const FEWEST_SHOWN: f32 = 0.002;
const MOST_WHITE: f32 = 0.5;
/// Voxels whose matter hides what is behind it.
const THINNEST: f32 = 16.0;
/// The greatest part of the domain that is clear about its middle.
const MOST_CLEAR: f32 = 0.95;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::volume::{VolumeInfo, Voxels};

    use super::*;
    use crate::surroundings::OPAQUE;

    #[test]
    fn what_a_thing_stands_in_is_clear() {
        // The height of `around` above the first point of the curve; `None` if the preset is unchanged.
        let shown = |around: u8, voxels: Vec<u8>| {
            let volume =
                Volume::new([20; 3], Vec3::ONE, Voxels::U8(voxels), (1.0, 0.0), VolumeInfo::default());
            let volume = volume.unwrap();
            let transfer = default_transfer("file", &volume, &Histogram::of(&volume));
            let Domain::Values(from, to) = transfer.domain else { return None };
            Some((f32::from(around) - from) / (to - from) - transfer.points[0].x)
        };
        let thing_in = |around: u8| {
            let mut voxels: Vec<u8> = (0..8000).map(|i| around - (i % 3) as u8).collect();
            voxels[3000..3100].fill(250);
            voxels[4210..4215].fill(0);
            voxels
        };
        assert!(shown(100, thing_in(100)).unwrap().abs() < 1e-3);
        assert_eq!(shown(3, thing_in(3)), None, "air is clear as it is");
        let halves = (0..8000).map(|i| if i % 20 < 10 { 100 } else { 220 }).collect();
        assert_eq!(shown(100, halves), None, "sides of several values are the thing itself");
    }

    #[test]
    fn a_look_begins_with_the_window_of_the_file() {
        let domain = |window| {
            let info = VolumeInfo { window, ..VolumeInfo::default() };
            let voxels = (0..4096).map(|i| i as f32).collect();
            let volume = Volume::new([16; 3], Vec3::ONE, Voxels::F32(voxels), (1.0, 0.0), info).unwrap();
            default_transfer("file", &volume, &Histogram::of(&volume)).domain
        };
        assert_eq!(domain(Some((1000.0, 3000.0))), Domain::Values(1000.0, 3000.0));
        let usual = domain(None);
        for useless in [(5000.0, 6000.0), (-9.0, -8.0), (0.0, 100.0)] {
            assert_eq!(domain(Some(useless)), usual, "{useless:?}");
        }
    }

    #[test]
    fn no_look_opens_on_a_block() {
        // Rising values on all sides and brighter matter within.
        let opened = |least: u16| {
            let voxels = (0..32_768usize).map(|i| {
                let at = [i % 32, i / 32 % 32, i / 1024];
                let is_within = at.iter().all(|x| (10..22).contains(x));
                let side = least + (at[0] + at[1] + at[2]) as u16 * 10;
                if is_within { 4000 + (i % 7) as u16 } else { side }
            });
            let voxels = Voxels::U16(voxels.collect());
            let volume = Volume::new([32; 3], Vec3::ONE, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
            let histogram = Histogram::of(&volume);
            let transfer = default_transfer("file", &volume, &histogram);
            let domain = transfer.at_values(&volume, &histogram).domain;
            let Domain::Values(lo, hi) = domain else { panic!("{domain:?}") };
            let opacity = |value: f32| transfer.at((value - lo) / (hi - lo)).1;
            (Sides::of(&volume).opaque_share(&transfer, (lo, hi)), opacity(4003.0))
        };
        let (sides, matter) = opened(2500);
        assert!(sides < 0.1 && matter > OPAQUE, "{sides} of the sides hide matter of {matter}");
        // The control is clear on its sides without any help.
        let (sides, matter) = opened(0);
        assert!(sides < 0.1 && matter > OPAQUE, "{sides} of the sides hide matter of {matter}");
    }
}
