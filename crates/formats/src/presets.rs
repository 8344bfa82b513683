//! The built-in transfer functions, and the choice of one for a volume.

use isinglass_core::space::are_of_body;
use isinglass_core::transfer::{Domain, TransferFunction};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Histogram, Volume};

use crate::channel_looks::{ChannelColors, in_color, of_channel, of_labels, of_pixels};
use crate::transfer::transfer_from_toml;
use crate::units::may_be_hounsfield;

/// The preset with this name.
pub fn preset(name: &str) -> Option<TransferFunction> {
    let (_, text) = PRESETS.iter().find(|(n, _)| *n == name)?;
    Some(transfer_from_toml(text, name).expect("every preset is parsed by a test"))
}

/// The names of all presets.
pub fn preset_names() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().map(|(name, _)| *name)
}

/// The presets that suit a volume with this name and range of values. Presets of Hounsfield units suit scans in these
/// alone, those of signed maps suit values on both sides of zero, and those of test volumes suit nothing else.
pub fn fitting_presets(name: &str, (lo, hi): (f32, f32)) -> impl Iterator<Item = &'static str> {
    let is_in_hounsfield_units = may_be_hounsfield(lo, hi);
    let kind = name.strip_prefix("builtin:").unwrap_or(name);
    let kind = kind.split_once('@').map_or(kind, |(kind, _)| kind);
    let builtin = Builtin::from_name(kind).map(Builtin::name);
    preset_names().filter(move |preset| match (builtin, Builtin::from_name(preset)) {
        (_, Some(_)) => builtin == Some(preset),
        (Some(_), None) => *preset == "smooth",
        (None, None) if *preset == SIGNED => lo < 0.0 && hi > 0.0 && !is_in_hounsfield_units,
        (None, None) => OF_HOUNSFIELD_UNITS.contains(preset) == is_in_hounsfield_units,
    })
}

const SIGNED: &str = "signed";
const OF_HOUNSFIELD_UNITS: [&str; 4] = ["ct-body", "ct-bone", "ct-lung", "ct-vessels"];

/// The initial preset for a volume that is opened from `source`. Built-in volumes have their own, and CT and MR use
/// the one of their modality. Other volumes are judged by their voxels, never by their names. `histogram` must be
/// that of the volume.
pub fn default_preset(source: &str, volume: &Volume, histogram: &Histogram) -> &'static str {
    let builtin =
        source.strip_prefix("builtin:").map(|name| name.split_once('@').map_or(name, |(kind, _)| kind));
    match builtin.and_then(Builtin::from_name) {
        Some(Builtin::Cloud) => "cloud",
        Some(Builtin::Cubus) => "cubus",
        Some(Builtin::Shells) => "shells",
        None => {
            of_values(volume, histogram).unwrap_or_else(|| match Statistics::of(volume, histogram).preset() {
                // A volume with an orientation shows a body, not a plant or a stone.
                "ct" if are_of_body(volume.info.orientation.as_deref()) => "ct-windowed",
                name => name,
            })
        }
    }
}

/// [`default_preset`] as a transfer function, with the window of the file if it has one. A scanned thing often stands in
/// resin or gel, which would hide it: then the domain begins so high that the outermost voxels are clear.
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
    let name = default_preset(source, volume, histogram);
    let mut transfer = preset(name).expect("the default is one of the presets");
    let (from, to) = match transfer.domain {
        Domain::Full => (0.0, 100.0),
        Domain::Percentiles(from, to) => (from, to),
        Domain::Values(..) | Domain::AboutZero(_) => return transfer,
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
    let clear_below = transfer.points[0].x;
    let begins_at = |surroundings: f32| {
        let begin = (surroundings - clear_below * hi) / (1.0 - clear_below);
        (begin > lo && begin < hi).then_some(begin)
    };
    let sides = Sides::of(volume);
    let uniform = sides.uniform(0.2 * (hi - lo));
    // A background that is already clear stays as it is.
    let veil = uniform.filter(|value| value - lo > (clear_below + 0.1) * (hi - lo)).and_then(begins_at);
    let block = || {
        let is_block = sides.opaque_share(&transfer, (lo, hi)) > MOST_OPAQUE;
        let highest = sides.percentile(0.98);
        begins_at(highest).filter(|_| is_block && share(highest) > FEWEST_SHOWN)
    };
    if let Some(begin) = veil.or_else(block) {
        transfer.domain = Domain::Values(begin, hi);
    }
    transfer
}

/// A sample of the outermost voxels.
struct Sides {
    /// Ascending; at least one.
    values: Vec<f32>,
    /// Those with nothing in them.
    num_gaps: usize,
}

impl Sides {
    fn of(volume: &Volume) -> Self {
        let dims = volume.dims().map(|d| d as i32);
        let stride = dims.map(|d| (d / SAMPLES_PER_SIDE).max(1) as usize);
        let (mut values, mut num_gaps) = (Vec::new(), 0);
        for axis in 0..3 {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            for side in [0, dims[axis] - 1] {
                for a in (0..dims[u]).step_by(stride[u]) {
                    for b in (0..dims[v]).step_by(stride[v]) {
                        let mut at = [0; 3];
                        (at[axis], at[u], at[v]) = (side, a, b);
                        let [x, y, z] = at.map(|i| i as usize);
                        let index = (z * dims[1] as usize + y) * dims[0] as usize + x;
                        if volume.gaps().is_some_and(|gaps| gaps.bytes[index] != 0) {
                            num_gaps += 1;
                            continue;
                        }
                        values.push(volume.value_from_stored(volume.stored_at(at[0], at[1], at[2])));
                    }
                }
            }
        }
        if values.is_empty() {
            values.push(volume.value_range().0);
        }
        values.sort_unstable_by(f32::total_cmp);
        Self { values, num_gaps }
    }

    /// The value that this share of them does not exceed.
    fn percentile(&self, share: f32) -> f32 {
        self.values[((self.values.len() - 1) as f32 * share) as usize]
    }

    /// The 98th percentile, if 96 % lie within `span`.
    fn uniform(&self, span: f32) -> Option<f32> {
        let most = self.percentile(0.98);
        (most - self.percentile(0.02) < span).then_some(most)
    }

    /// The share of them that hides what is behind: a few voxels let hardly any light through.
    fn opaque_share(&self, transfer: &TransferFunction, (lo, hi): (f32, f32)) -> f32 {
        let is_opaque = |value: &&f32| transfer.at((**value - lo) / (hi - lo)).1 > OPAQUE;
        let num = self.values.len() + self.num_gaps;
        self.values.iter().filter(is_opaque).count() as f32 / num as f32
    }
}

/// The preset of the modality, or of values that only one kind of volume has. CT must be in Hounsfield units, with air
/// at about −1000.
fn of_values(volume: &Volume, histogram: &Histogram) -> Option<&'static str> {
    let (lo, hi) = volume.value_range();
    let share = |from: f32, to: f32| histogram.share_above(from) - histogram.share_above(to);
    // Both signs, and zero either in the middle or the value of all that is empty.
    let (less, more) = (lo.abs().min(hi.abs()), lo.abs().max(hi.abs()));
    let near = 0.02 * more;
    let has_signs = lo < 0.0 && hi > 0.0 && less > 0.1 * more;
    let is_signed = has_signs && (less > 0.7 * more || share(-near, near) > 0.3);
    let is_in_hounsfield_units = may_be_hounsfield(lo, hi);
    // Air, and tissue from fat to blood.
    let has_tissue = || share(-1080.0, -850.0) > 0.01 && share(-150.0, 150.0) > 0.01;
    match volume.info.modality.as_deref() {
        Some("CT") if is_in_hounsfield_units => Some("ct-body"),
        None if is_in_hounsfield_units && has_tissue() => Some("ct-body"),
        _ if is_signed => Some(SIGNED),
        Some("MR") => Some("mri"),
        _ => None,
    }
}

/// Statistics that distinguish kinds of volumes. Values are relative to the range from the least value to the 99.9th
/// percentile.
#[derive(Clone, Copy, Debug)]
struct Statistics {
    /// The greatest value in units of the range. It is large if there are a few very bright voxels.
    tail: f32,
    /// Fraction of voxels in the lowest tenth, which are air or empty.
    air: f32,
    /// Fraction of the voxels above the lowest tenth that exceed 0.4.
    dense: f32,
    /// Median and mean difference between a voxel above the lowest tenth and the mean of its six neighbours. It
    /// measures noise and fine structure.
    roughness_median: f32,
    roughness_mean: f32,
}

impl Statistics {
    fn of(volume: &Volume, histogram: &Histogram) -> Self {
        let (lo, hi) = (histogram.lo, histogram.hi);
        let range = (histogram.percentile(99.9) - lo).max(f32::MIN_POSITIVE);
        let last = (histogram.counts.len() - 1).max(1) as f32;
        let above = |share: f32| {
            let value = |i: usize| histogram.lo + (histogram.hi - histogram.lo) * (i as f32 / last);
            let is_above = |(i, _): &(usize, &u64)| value(*i) - lo > share * range;
            histogram.counts.iter().enumerate().filter(is_above).map(|(_, n)| *n).sum::<u64>() as f32
        };
        let (foreground, dense) = (above(0.1).max(1.0), above(0.4));
        let mut roughness = roughness(volume, lo, range);
        roughness.sort_unstable_by(f32::total_cmp);
        Self {
            tail: (hi - lo) / range,
            // The histogram may be that of a finer level.
            air: 1.0 - foreground / histogram.counts.iter().sum::<u64>().max(1) as f32,
            dense: dense / foreground,
            roughness_median: roughness.get(roughness.len() / 2).copied().unwrap_or(0.0),
            roughness_mean: roughness.iter().sum::<f32>() / roughness.len().max(1) as f32,
        }
    }

    /// The bounds lie between the figures of real volumes, which a test prints and checks. Angiography has 0.98 of
    /// air, others at most 0.91. A simulation has a median roughness of 0.002, scans at least 0.005. An MRI of a head
    /// has a mean roughness of 0.03, CT less than 0.015. A machine part has 0.77 of dense voxels, a plant 0.5. Bright
    /// specks in microscopy stretch the range 25 times, others 1.4 times.
    fn preset(&self) -> &'static str {
        match self {
            s if s.air > 0.95 => "angio",
            s if s.tail > 3.0 => "fluorescence",
            s if s.roughness_median < 0.0035 => "smooth",
            s if s.roughness_mean > 0.02 && s.air < 0.7 => "mri",
            s if s.dense > 0.65 && s.air > 0.5 => "industrial",
            _ => "ct",
        }
    }
}

/// The differences to the mean of the six neighbours, for a regular sample of the voxels above the lowest tenth.
fn roughness(volume: &Volume, lo: f32, range: f32) -> Vec<f32> {
    let dims = volume.dims().map(|d| d as i32);
    let stride = dims.map(|d| ((d - 2) / SAMPLES_PER_SIDE).max(1));
    let at = |x, y, z| (volume.value_from_stored(volume.stored_at(x, y, z)) - lo) / range;
    let along = |axis: usize| (1..dims[axis] - 1).step_by(stride[axis] as usize);
    let mut differences = Vec::new();
    for z in along(2) {
        for y in along(1) {
            for x in along(0) {
                let center = at(x, y, z);
                if center > 0.1 {
                    let sum = at(x - 1, y, z) + at(x + 1, y, z) + at(x, y - 1, z) + at(x, y + 1, z);
                    let sum = sum + at(x, y, z - 1) + at(x, y, z + 1);
                    differences.push((center - sum / 6.0).abs());
                }
            }
        }
    }
    differences
}

macro_rules! presets {
    ($($name:literal),*) => {
        /// Names and texts, in the order of lists.
        const PRESETS: &[(&str, &str)] =
            &[$(($name, include_str!(concat!("../../../configs/presets/", $name, ".toml")))),*];
    };
}

presets![
    "ct",
    "industrial",
    "mri",
    "mri-skin",
    "angio",
    "smooth",
    "fluorescence",
    "ct-body",
    "ct-bone",
    "ct-vessels",
    "ct-lung",
    "ct-windowed",
    "signed",
    "cloud",
    "cubus",
    "shells"
];

/// The opacity per unit length of matter that hides what is behind it after a few voxels.
const OPAQUE: f32 = 0.1;
/// The share of opaque voxels on the sides from which on a volume looks like a block.
const MOST_OPAQUE: f32 = 0.5;
/// The least share of voxels that a look must show, and the greatest share that may be at its upper end.
const FEWEST_SHOWN: f32 = 0.002;
const MOST_WHITE: f32 = 0.5;
/// Sampled voxels along each axis. The quarter of a million in all gives two digits.
const SAMPLES_PER_SIDE: i32 = 64;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::transfer::ControlPoint;
    use isinglass_core::volume::{VolumeInfo, Voxels};

    use super::*;

    #[test]
    fn every_preset_file_is_embedded_and_valid() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs");
        let mut found = Vec::new();
        for entry in std::fs::read_dir(format!("{folder}/presets")).unwrap() {
            let path = entry.unwrap().path();
            let text = std::fs::read_to_string(&path).unwrap();
            let stem = path.file_stem().unwrap().to_str().unwrap().to_owned();
            let parsed = transfer_from_toml(&text, "elsewhere").unwrap();
            assert_eq!(parsed.name, stem);
            assert_eq!(preset(&stem), Some(parsed), "{stem} is embedded");
            found.push(stem);
        }
        found.sort_unstable();
        let mut names: Vec<_> = preset_names().collect();
        names.sort_unstable();
        assert_eq!(names, found);
        // A new kind of file in the folder needs a test here.
        let others = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name());
        let mut others: Vec<_> = others.collect();
        others.sort_unstable();
        assert_eq!(others, ["presets", "server.toml", "viewer.toml"]);
    }

    /// What is wrong with a curve: a jump in opacity would appear as a hard edge. Opacity begins at zero, has one value
    /// everywhere, and grows or falls by no more than half within an eighth of the domain.
    fn jump(points: &[ControlPoint], clear_at: f32) -> Option<&'static str> {
        if points.iter().find(|p| p.x >= clear_at).is_none_or(|p| p.opacity != 0.0) {
            return Some("does not begin clear");
        }
        let is_steep =
            |p: &[ControlPoint]| (p[1].opacity - p[0].opacity).abs() > STEEPEST * (p[1].x - p[0].x);
        if points.windows(2).any(|p| p[0].x >= p[1].x) {
            return Some("has two opacities in one place");
        }
        points.windows(2).any(is_steep).then_some("jumps")
    }

    /// Opacity by the width of the domain.
    const STEEPEST: f32 = 4.0;

    #[test]
    fn opacities_ramp_without_jumps() {
        for name in preset_names() {
            let points = preset(name).unwrap().points;
            // A signed map is clear in its middle.
            let clear_at = if name == SIGNED { 0.5 } else { 0.0 };
            let jump = |points: &[ControlPoint]| jump(points, clear_at);
            assert_eq!(jump(&points), None, "{name}");
            let first = points.iter().position(|p| p.x >= clear_at).unwrap();
            // Negative controls.
            let with = |change: &dyn Fn(&mut Vec<ControlPoint>)| {
                let mut points = points.clone();
                change(&mut points);
                jump(&points)
            };
            assert_eq!(with(&|points| points[first].opacity = 0.01), Some("does not begin clear"));
            assert_eq!(with(&|points| points[1].x = points[0].x), Some("has two opacities in one place"));
            let edge = |points: &mut Vec<ControlPoint>| {
                points.push(ControlPoint { x: 1.001, opacity: 0.0, ..points[0] });
                points.push(ControlPoint { x: 1.002, opacity: 1.0, ..points[0] });
            };
            assert_eq!(with(&edge), Some("jumps"), "{name}");
        }
    }

    #[test]
    fn built_in_volumes_have_their_own() {
        let volume = Builtin::Cubus.volume(16);
        let histogram = Histogram::of(&volume);
        for name in ["cloud", "cubus", "shells"] {
            assert_eq!(default_preset(&format!("builtin:{name}"), &volume, &histogram), name);
            assert_eq!(default_preset(&format!("builtin:{name}@64"), &volume, &histogram), name);
        }
        // The name counts only after "builtin:". The same voxels from a file are judged like any others.
        assert_ne!(default_preset("cubus", &volume, &histogram), "cubus");
    }

    #[test]
    fn a_modality_has_its_preset_where_the_values_are_what_it_says() {
        let pick = |modality: Option<&str>, voxels: Vec<f32>| {
            let info = VolumeInfo { modality: modality.map(Into::into), ..VolumeInfo::default() };
            let volume = Volume::new([2, 2, 2], Vec3::ONE, Voxels::F32(voxels), (1.0, 0.0), info).unwrap();
            default_preset("file", &volume, &Histogram::of(&volume))
        };
        let hounsfield = vec![-1000.0, -900.0, -100.0, 0.0, 40.0, 60.0, 400.0, 1200.0];
        assert_eq!(pick(Some("CT"), hounsfield.clone()), "ct-body");
        assert_eq!(pick(None, hounsfield.clone()), "ct-body", "its values say so");
        assert_ne!(pick(Some("US"), hounsfield.clone()), "ct-body");
        let above_zero: Vec<f32> = hounsfield.iter().map(|x| x + 1000.0).collect();
        assert_eq!(pick(Some("MR"), above_zero.clone()), "mri");
        assert_ne!(pick(None, above_zero), "ct-body");
        // A map of statistics, a phase, and noise below an image.
        let map = vec![0.0, 0.0, 0.0, 0.0, 0.0, -2.0, 4.0, 3.0];
        assert_eq!([pick(None, map.clone()), pick(Some("MR"), map)], [SIGNED; 2]);
        assert_eq!(pick(Some("MR"), (0..8).map(|i| i as f32 * 0.89 - 3.1).collect()), SIGNED);
        assert_eq!(pick(Some("MR"), (0..8).map(|i| i as f32 * 100.0 - 20.0).collect()), "mri");
        let bytes = (0..8).map(|i| i as f32 * 30.0).collect();
        assert_ne!(pick(Some("CT"), bytes), "ct-body", "a CT of bytes is in no Hounsfield units");
    }

    #[test]
    fn a_body_has_other_colours_than_a_plant() {
        let pick = |orientation: Option<&str>| {
            let info = VolumeInfo { orientation: orientation.map(Into::into), ..VolumeInfo::default() };
            let voxels = (0..27).map(|i| [0, 90, 200][i % 3]).collect();
            let volume = Volume::new([3; 3], Vec3::ONE, Voxels::U8(voxels), (1.0, 0.0), info).unwrap();
            default_preset("file", &volume, &Histogram::of(&volume))
        };
        assert_eq!((pick(None), pick(Some("RAS"))), ("ct", "ct-windowed"));
        assert_eq!(pick(Some(isinglass_core::space::IMAGE_AXES)), "ct");
    }

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

    #[test]
    fn degenerate_volumes_get_some_preset() {
        for (dims, voxels) in [
            ([1, 1, 1], Voxels::U8(vec![7])),
            ([2, 1, 2], Voxels::F32(vec![-1e30, 1e37, 0.0, 1.0])),
            ([3, 3, 3], Voxels::U16(vec![9; 27])),
        ] {
            let volume = Volume::new(dims, Vec3::ONE, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
            let histogram = Histogram::of(&volume);
            assert!(preset(default_preset("file", &volume, &histogram)).is_some());
            assert_eq!(default_transfer("file", &volume, &histogram).validate(), Ok(()));
        }
    }
}
