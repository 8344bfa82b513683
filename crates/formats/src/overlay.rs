//! A volume of labels over another volume, from a file of its own.

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use isinglass_core::volume::{Finest, Placement, Volume, Voxels};
use rayon::prelude::*;

use crate::error::{FormatError, shown};
use crate::reading::{Meaning, Reading};
use crate::selection::Selection;
use crate::source::{OpenOptions, open, outline};

/// Reads the labels in the file `source` and shows them over `volume`, nearest to its voxels.
///
/// # Errors
/// They cannot be read, are no labels, or neither their grid nor their place fits.
pub(crate) fn with_labels(
    volume: Volume,
    source: &str,
    options: &OpenOptions,
) -> Result<Volume, FormatError> {
    let reading = Reading { voxels: Some(Meaning::Labels), ..Reading::default() };
    let max_bytes = options.max_bytes.saturating_sub(volume.bytes_in_memory());
    let own = OpenOptions { max_bytes, ..of_labels(options, &reading) };
    let labels = open(source, &own)?;
    let path = Path::new(source);
    let bad = |problem: String| FormatError::Data { path: shown(path), problem };
    let Selection { flip, region, .. } = options.selection;
    let labels = on_grid(labels, &volume, flip.0, region.is_some()).map_err(bad)?;
    let mut others = volume.others().to_vec();
    others.push(Arc::new(labels));
    volume.with_others(others).map_err(|cause| FormatError::Volume { path: shown(path), cause })
}

/// Bytes that the labels in the file `source` take in memory, on a grid of `num_voxels`, and while they are read.
///
/// # Errors
/// Their header cannot be read.
pub(crate) fn bytes_of_labels(
    source: &str,
    num_voxels: u64,
    options: &OpenOptions,
) -> Result<[u64; 2], FormatError> {
    let reading = Reading { voxels: Some(Meaning::Labels), ..Reading::default() };
    let found = outline(source, &of_labels(options, &reading))?;
    let count = found.dims.iter().map(|&n| u64::from(n)).product::<u64>().max(1);
    // The outline counts a byte more for each voxel, for brightness.
    let bytes_of_voxel = (found.bytes_in_memory / count).saturating_sub(1);
    let when_read = num_voxels.saturating_mul(bytes_of_voxel);
    Ok([when_read, when_read.saturating_add(found.bytes_needed())])
}

fn of_labels<'a>(options: &OpenOptions<'a>, reading: &'a Reading) -> OpenOptions<'a> {
    let selection = Selection { channel: Some(0), ..Selection::default() };
    OpenOptions { raw: None, selection, spacing: None, reading, ..*options }
}

/// The labels at the voxels of `volume`, zero outside of their own grid. `flip` are the axes along which the volume is
/// mirrored.
fn on_grid(labels: Volume, volume: &Volume, flip: [bool; 3], is_part: bool) -> Result<Volume, String> {
    if is_part && flip.contains(&true) {
        return Err("labels over a mirrored part of a volume, expected the whole volume or no --flip".into());
    }
    let (mut first, mut columns) = match is_same_grid(&labels, volume) {
        true => (DVec3::ZERO, DVec3::AXES),
        false => index_map(&labels, volume)?,
    };
    for k in (0..3).filter(|&k| flip[k]) {
        first += columns[k] * f64::from(volume.dims()[k] - 1);
        columns[k] = -columns[k];
    }
    let voxels = if (first, columns) == (DVec3::ZERO, DVec3::AXES) {
        labels.voxels().clone()
    } else {
        resampled(&labels, volume.dims(), first, columns)
    };
    let none = zero(&labels);
    let is_empty = match &voxels {
        Voxels::U8(v) => v.par_iter().all(|n| f32::from(*n) == none),
        Voxels::U16(v) => v.par_iter().all(|n| f32::from(*n) == none),
        Voxels::F32(v) => v.par_iter().all(|n| *n == none),
    };
    if is_empty {
        return Err("no label lies within the volume, expected some".into());
    }
    let (map, info) = (labels.value_map(), labels.info);
    let labels =
        Volume::new(volume.dims(), volume.spacing(), voxels, map, info).map_err(|e| e.to_string())?;
    Ok(match volume.finest() {
        Some(finest) => {
            labels.with_finest(Finest { stored_range: None, histogram: None, ..(**finest).clone() })
        }
        None => labels,
    })
}

/// Whether each label lies on a voxel. Without a position in both files, the number of voxels decides.
fn is_same_grid(labels: &Volume, volume: &Volume) -> bool {
    let has_same_steps = || {
        let difference = (labels.spacing() - volume.spacing()).abs().max_element();
        difference <= 1e-3 * volume.spacing().min_element()
    };
    labels.dims() == volume.dims()
        && match (labels.info.placement, volume.info.placement) {
            (Some(a), Some(b)) => has_same_steps() && is_near(&a, &b, volume),
            _ => true,
        }
}

/// The index of the label at the first voxel, and its change by one voxel along x, y and z, from both positions.
fn index_map(labels: &Volume, volume: &Volume) -> Result<(DVec3, [DVec3; 3]), String> {
    let (Some(from), Some(to)) = (labels.info.placement, volume.info.placement) else {
        let ([a, b, c], [x, y, z]) = (labels.dims(), volume.dims());
        return Err(format!(
            "labels of {a}×{b}×{c} voxels, expected {x}×{y}×{z} as in the volume, or a position in both files"
        ));
    };
    if labels.info.orientation != volume.info.orientation {
        return Err("the labels and the volume are in different spaces, expected the same".into());
    }
    let scale = unit_ratio(labels.info.unit.as_deref(), volume.info.unit.as_deref());
    let steps = volume.spacing().as_dvec3() * scale;
    let middle = |volume: &Volume| volume.voxel_origin().as_dvec3() - 0.5;
    let (own_steps, own_axes) = (labels.spacing().as_dvec3(), from.axes.map(DVec3::from));
    let index_from_place = |place: DVec3| DVec3::from(own_axes.map(|axis| axis.dot(place))) / own_steps;
    let columns: [DVec3; 3] = std::array::from_fn(|k| index_from_place(DVec3::from(to.axes[k]) * steps[k]));
    let start = DVec3::from(to.center) * scale - DVec3::from(from.center);
    let half = middle(volume).to_array();
    let to_first = half.into_iter().zip(columns).map(|(n, column)| column * n).sum::<DVec3>();
    Ok((index_from_place(start) + middle(labels) - to_first, columns))
}

/// The stored number of no label.
fn zero(labels: &Volume) -> f32 {
    let (slope, intercept) = labels.value_map();
    -intercept / slope
}

/// The length of the volume's unit in that of the labels. Without a name they are taken as the same.
fn unit_ratio(labels: Option<&str>, volume: Option<&str>) -> f64 {
    let meters = |unit: Option<&str>| unit.and_then(crate::units::length_unit).map(|(meters, _)| meters);
    meters(volume).zip(meters(labels)).map_or(1.0, |(volume, labels)| volume / labels)
}

/// Whether two placements differ by less than a tenth of a voxel over the whole volume.
fn is_near(a: &Placement, b: &Placement, volume: &Volume) -> bool {
    let bounds = volume.bounds();
    let tolerance = f64::from(volume.spacing().min_element()) * 0.1;
    [bounds.min, bounds.max].into_iter().all(|corner| {
        let (a, b) = (a.file_from_world(corner), b.file_from_world(corner));
        a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance)
    })
}

/// The labels at `first` + x, y and z of `columns`, rounded to an index.
fn resampled(labels: &Volume, dims: [u32; 3], first: DVec3, columns: [DVec3; 3]) -> Voxels {
    let sides = labels.dims().map(f64::from);
    let [nx, ny, nz] = dims.map(|n| n as usize);
    let index = |x: usize, y: usize, z: usize| -> Option<usize> {
        let at = first + columns[0] * x as f64 + columns[1] * y as f64 + columns[2] * z as f64;
        let at = (at + 0.5).floor().to_array();
        let is_in = at.iter().zip(sides).all(|(at, n)| *at >= 0.0 && *at < n);
        is_in.then(|| ((at[2] * sides[1] + at[1]) * sides[0] + at[0]) as usize)
    };
    macro_rules! pick {
        ($kind:path, $source:expr, $none:expr) => {{
            let mut voxels = vec![$none; nx * ny * nz];
            voxels.par_chunks_mut(nx * ny).enumerate().for_each(|(z, plane)| {
                for (i, voxel) in plane.iter_mut().enumerate() {
                    if let Some(at) = index(i % nx, i / nx, z) {
                        *voxel = $source[at];
                    }
                }
            });
            $kind(voxels)
        }};
    }
    match labels.voxels() {
        Voxels::U8(v) => pick!(Voxels::U8, v, zero(labels) as u8),
        Voxels::U16(v) => pick!(Voxels::U16, v, zero(labels) as u16),
        Voxels::F32(v) => pick!(Voxels::F32, v, zero(labels)),
    }
}
