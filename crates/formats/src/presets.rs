//! The built-in transfer functions, and the choice of one for a volume.

use isinglass_core::transfer::{Domain, TransferFunction};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Histogram, Volume};

use crate::transfer::transfer_from_toml;

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
/// alone, and those of test volumes suit nothing else.
pub fn fitting_presets(name: &str, (lo, hi): (f32, f32)) -> impl Iterator<Item = &'static str> {
    let is_in_hounsfield_units = lo <= -500.0 && hi >= 300.0;
    let kind = name.strip_prefix("builtin:").unwrap_or(name);
    let kind = kind.split_once('@').map_or(kind, |(kind, _)| kind);
    let builtin = Builtin::from_name(kind).map(Builtin::name);
    preset_names().filter(move |preset| match (builtin, Builtin::from_name(preset)) {
        (_, Some(_)) => builtin == Some(preset),
        (Some(_), None) => *preset == "smooth",
        (None, None) => OF_HOUNSFIELD_UNITS.contains(preset) == is_in_hounsfield_units,
    })
}

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
        None => of_modality(volume).unwrap_or_else(|| match Statistics::of(volume, histogram).preset() {
            // A volume with an orientation shows a body, not a plant or a stone.
            "ct" if volume.info.orientation.is_some() => "ct-windowed",
            name => name,
        }),
    }
}

/// [`default_preset`] as a transfer function. A scanned thing often stands in resin or gel, which would hide it. If
/// the sides of the volume have nearly one visible value, the domain begins so high that this value is clear.
pub fn default_transfer(source: &str, volume: &Volume, histogram: &Histogram) -> TransferFunction {
    let name = default_preset(source, volume, histogram);
    let mut transfer = preset(name).expect("the default is one of the presets");
    if let Domain::Percentiles(from, to) = transfer.domain {
        let (lo, hi) = (histogram.percentile(from), histogram.percentile(to));
        let Some(surroundings) = surroundings(volume, 0.2 * (hi - lo)) else { return transfer };
        let clear_below = transfer.points[0].x;
        let begin = (surroundings - clear_below * hi) / (1.0 - clear_below);
        // A background that is already clear stays as it is.
        if surroundings - lo > (clear_below + 0.1) * (hi - lo) && begin > lo && begin < hi {
            transfer.domain = Domain::Values(begin, hi);
        }
    }
    transfer
}

/// The 98th percentile of the values on the sides of a volume, if 96 % of them lie within `span`.
fn surroundings(volume: &Volume, span: f32) -> Option<f32> {
    let dims = volume.dims().map(|d| d as i32);
    let stride = dims.map(|d| (d / SAMPLES_PER_SIDE).max(1) as usize);
    let mut values = Vec::new();
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for side in [0, dims[axis] - 1] {
            for a in (0..dims[u]).step_by(stride[u]) {
                for b in (0..dims[v]).step_by(stride[v]) {
                    let mut at = [0; 3];
                    (at[axis], at[u], at[v]) = (side, a, b);
                    values.push(volume.value_from_stored(volume.stored_at(at[0], at[1], at[2])));
                }
            }
        }
    }
    values.sort_unstable_by(f32::total_cmp);
    let at = |share: f32| values[((values.len() - 1) as f32 * share) as usize];
    (at(0.98) - at(0.02) < span).then(|| at(0.98))
}

/// The preset of the modality. CT must be in Hounsfield units, with air at about −1000.
fn of_modality(volume: &Volume) -> Option<&'static str> {
    let (lo, hi) = volume.value_range();
    match volume.info.modality.as_deref()? {
        "CT" if lo <= -500.0 && hi >= 300.0 => Some("ct-body"),
        "MR" => Some("mri"),
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
            air: 1.0 - foreground / volume.voxels().len() as f32,
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
    "cloud",
    "cubus",
    "shells"
];

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
    fn jump(points: &[ControlPoint]) -> Option<&'static str> {
        if points[0].opacity != 0.0 {
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
            assert_eq!(jump(&points), None, "{name}");
            // Negative controls.
            let with = |change: &dyn Fn(&mut Vec<ControlPoint>)| {
                let mut points = points.clone();
                change(&mut points);
                jump(&points)
            };
            assert_eq!(with(&|points| points[0].opacity = 0.01), Some("does not begin clear"));
            assert_eq!(with(&|points| points[1].x = points[0].x), Some("has two opacities in one place"));
            let edge = |points: &mut Vec<ControlPoint>| {
                points.push(ControlPoint { x: 1.001, opacity: 1.0, ..points[0] });
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
        assert_eq!(pick(Some("MR"), hounsfield.clone()), "mri");
        let others = [pick(None, hounsfield.clone()), pick(Some("US"), hounsfield)];
        assert!(others.iter().all(|name| *name == others[0] && *name != "ct-body"), "{others:?}");
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
