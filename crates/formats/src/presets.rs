//! The built-in transfer functions, and the choice of one for a volume.

use isinglass_core::space::are_of_body;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Histogram, Volume};

use crate::surroundings::{MatterSide, Sides, Surroundings};
use crate::transfer::transfer_from_toml;
use crate::units::{length_unit, may_be_hounsfield};

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

pub(crate) const SIGNED: &str = "signed";
pub(crate) const DARK: &str = "dark";
const OF_HOUNSFIELD_UNITS: [&str; 4] = ["ct-body", "ct-bone", "ct-lung", "ct-vessels"];

/// The initial preset for a volume that is opened from `source`. Built-in volumes have their own, and CT and MR use
/// the one of their modality. Other volumes are judged by their voxels, never by their names. `histogram` must be
/// that of the volume.
pub fn default_preset(source: &str, volume: &Volume, histogram: &Histogram) -> &'static str {
    let surroundings = Surroundings::of(volume, histogram, &Sides::of(volume));
    preset_within(source, volume, histogram, surroundings.as_ref())
}

/// The same for a volume with these surroundings, if they are known.
pub(crate) fn preset_within(
    source: &str,
    volume: &Volume,
    histogram: &Histogram,
    surroundings: Option<&Surroundings>,
) -> &'static str {
    let builtin =
        source.strip_prefix("builtin:").map(|name| name.split_once('@').map_or(name, |(kind, _)| kind));
    match builtin.and_then(Builtin::from_name) {
        Some(Builtin::Cloud) => return "cloud",
        Some(Builtin::Cubus) => return "cubus",
        Some(Builtin::Shells) => return "shells",
        None => {}
    }
    let of_values = of_values(volume, histogram, surroundings);
    of_values.unwrap_or_else(|| {
        let name = Statistics::of(volume, histogram).preset();
        match name {
            // A body is no plant and no stone, and its scanner no microscope.
            "ct" if is_body(volume) => "ct-windowed",
            "fluorescence" | "industrial" | "smooth" if is_body(volume) => "mri",
            name => name,
        }
    })
}

/// Whether the axes are those of a patient, and the voxels as long as in scans of such. Emission is no anatomy.
fn is_body(volume: &Volume) -> bool {
    let info = &volume.info;
    let meters = info.unit.as_deref().and_then(length_unit).map_or(1e-3, |(meters, _)| meters);
    are_of_body(info.orientation.as_deref())
        && f64::from(volume.voxel_side()) * meters > SHORTEST_IN_BODIES
        && !matches!(info.modality.as_deref(), Some("PT" | "NM"))
}

/// The preset of the modality, or of values that only one kind of volume has. CT must be in Hounsfield units, with air
/// at about −1000.
fn of_values(
    volume: &Volume,
    histogram: &Histogram,
    surroundings: Option<&Surroundings>,
) -> Option<&'static str> {
    let (lo, hi) = volume.value_range();
    let share = |from: f32, to: f32| histogram.share_above(from) - histogram.share_above(to);
    // Without surroundings: both signs, and zero either in the middle or the value of all that is empty.
    let (less, more) = (lo.abs().min(hi.abs()), lo.abs().max(hi.abs()));
    let near = 0.02 * more;
    let has_signs = lo < 0.0 && hi > 0.0 && less > 0.1 * more;
    let is_signed = || has_signs && (less > 0.7 * more || share(-near, near) > 0.3);
    let is_in_hounsfield_units = may_be_hounsfield(lo, hi);
    // Air, and tissue from fat to blood.
    let has_tissue = || share(-1080.0, -850.0) > 0.01 && share(-150.0, 150.0) > 0.01;
    let modality = volume.info.modality.as_deref();
    match modality {
        Some("CT") if is_in_hounsfield_units => return Some("ct-body"),
        None if is_in_hounsfield_units && has_tissue() => return Some("ct-body"),
        _ => {}
    }
    match surroundings.map(|surroundings| surroundings.matter) {
        Some(MatterSide::Both) => Some(SIGNED),
        Some(MatterSide::Below) => Some(DARK),
        None if is_signed() => Some(SIGNED),
        _ => (modality == Some("MR")).then_some("mri"),
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

/// The differences to the mean of the neighbours along axes of three voxels or more, for a regular sample of the voxels
/// above the lowest tenth.
fn roughness(volume: &Volume, lo: f32, range: f32) -> Vec<f32> {
    let dims = volume.dims().map(|d| d as i32);
    let stride = dims.map(|d| ((d - 2) / SAMPLES_PER_SIDE).max(1));
    let at = |[x, y, z]: [i32; 3]| (volume.value_from_stored(volume.stored_at(x, y, z)) - lo) / range;
    let axes: Vec<usize> = (0..3).filter(|axis| dims[*axis] > 2).collect();
    let along = |axis: usize| match axes.contains(&axis) {
        true => (1..dims[axis] - 1).step_by(stride[axis] as usize),
        false => (0..1).step_by(1),
    };
    let mut differences = Vec::new();
    for [x, y, z] in along(2).flat_map(|z| along(1).flat_map(move |y| along(0).map(move |x| [x, y, z]))) {
        let center = at([x, y, z]);
        if center > 0.1 && !axes.is_empty() {
            let neighbor = |axis: usize, by: i32| {
                let mut beside = [x, y, z];
                beside[axis] += by;
                at(beside)
            };
            let sum: f32 = axes.iter().map(|&axis| neighbor(axis, -1) + neighbor(axis, 1)).sum();
            differences.push((center - sum / (2 * axes.len()) as f32).abs());
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
    "dark",
    "cloud",
    "cubus",
    "shells"
];

/// Sampled voxels along each axis. The quarter of a million in all gives two digits.
const SAMPLES_PER_SIDE: i32 = 64;
/// Shortest voxels in scans of bodies, metres. Those of microscopes are shorter.
const SHORTEST_IN_BODIES: f64 = 0.95e-4;

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
            // A signed map is clear in its middle, and what is dark in bright surroundings at its end.
            let clear_at = match name {
                SIGNED => 0.5,
                DARK => points.last().unwrap().x,
                _ => 0.0,
            };
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
    fn degenerate_volumes_get_some_preset() {
        for (dims, voxels) in [
            ([1, 1, 1], Voxels::U8(vec![7])),
            ([2, 1, 2], Voxels::F32(vec![-1e30, 1e37, 0.0, 1.0])),
            ([3, 3, 3], Voxels::U16(vec![9; 27])),
        ] {
            let volume = Volume::new(dims, Vec3::ONE, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
            let histogram = Histogram::of(&volume);
            assert!(preset(default_preset("file", &volume, &histogram)).is_some());
            assert_eq!(crate::default_transfer("file", &volume, &histogram).validate(), Ok(()));
        }
    }
}
