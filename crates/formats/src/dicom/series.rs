//! Which slices belong together, and how they lie.

use glam::DVec3;

use super::frame::{Frame, Shape, Slices};
use crate::axes::{Geometry, ras_from_lps};
use crate::warning::WarningKind;

/// Slices of one series, shape and direction.
#[derive(Debug)]
pub(super) struct Series {
    pub(super) shape: Shape,
    uid: String,
    name: String,
    modality: Option<String>,
    value_unit: Option<String>,
    orientation: Option<[f64; 6]>,
    pixel_spacing: Option<[f64; 2]>,
    slice_spacing: Option<f64>,
    frames: Vec<Frame>,
}

/// A series in order.
pub(super) struct Stacked {
    /// Along the normal first, then in time.
    pub(super) frames: Vec<Frame>,
    pub(super) num_slices: usize,
    pub(super) num_times: usize,
    pub(super) geometry: Geometry,
    pub(super) modality: Option<String>,
    pub(super) value_unit: Option<String>,
    pub(super) spacing_guess: Option<String>,
    pub(super) warnings: Vec<(WarningKind, String)>,
}

/// Puts together what belongs together, in the order of the files.
pub(super) fn group(files: Vec<Slices>) -> Vec<Series> {
    let mut all: Vec<Series> = Vec::new();
    for file in files {
        // The newest is the likeliest.
        let fits = |s: &&mut Series| {
            s.uid == file.series_uid
                && s.shape == file.shape
                && is_near(&s.orientation, &file.orientation, 1e-3)
                && is_near(&s.pixel_spacing, &file.pixel_spacing, 1e-5)
        };
        match all.iter_mut().rev().take(MAX_COMPARED).find(fits) {
            Some(series) => series.frames.extend(file.frames),
            None => all.push(Series {
                shape: file.shape,
                uid: file.series_uid,
                name: file.name,
                modality: file.modality,
                value_unit: file.value_unit,
                orientation: file.orientation,
                pixel_spacing: file.pixel_spacing,
                slice_spacing: file.slice_spacing,
                frames: file.frames,
            }),
        }
    }
    all
}

fn is_near<const N: usize>(a: &Option<[f64; N]>, b: &Option<[f64; N]>, most: f64) -> bool {
    match (a, b) {
        (Some(a), Some(b)) => a.iter().zip(b).all(|(a, b)| (a - b).abs() <= most),
        (None, None) => true,
        _ => false,
    }
}

impl Series {
    pub(super) fn num_voxels(&self) -> u64 {
        self.shape.num_pixels() * self.frames.len() as u64
    }

    /// In words, for a list.
    pub(super) fn name(&self) -> String {
        let modality = self.modality.as_ref().map_or(String::new(), |m| format!(" {m}"));
        let Shape { columns, rows, .. } = self.shape;
        format!("{}:{modality}, {} slices of {columns}×{rows}", self.name, self.frames.len())
    }

    /// Sorts the slices and finds how they lie.
    pub(super) fn stack(self) -> Stacked {
        let mut warnings = Vec::new();
        let mut spacing_guess = None;
        let [row_distance, column_distance] = self.pixel_spacing.unwrap_or_else(|| {
            spacing_guess = Some("the file has no pixel spacing; it was taken as 1".to_owned());
            [1.0; 2]
        });
        let directions = self.orientation.and_then(|o| {
            let (row, column) = (DVec3::new(o[0], o[1], o[2]), DVec3::new(o[3], o[4], o[5]));
            let normal = row.cross(column);
            // Directions that are no two independent ones say nothing.
            let is_good = normal.is_finite() && normal.length() > 0.1 && normal.length() < 10.0;
            is_good.then(|| (row.normalize(), column.normalize(), normal.normalize()))
        });
        let is_placed = directions.is_some() && self.frames.iter().all(|f| f.position.is_some());
        let mut frames = self.frames;
        let Some((row, column, normal)) = directions.filter(|_| is_placed) else {
            frames.sort_by(|a, b| compare(&a.order, &b.order));
            let num_slices = frames.len();
            let distance = self.slice_spacing.unwrap_or(column_distance);
            let text = "positions are missing; slices are in the order of their numbers, and where the body lies is not known";
            warnings.push((WarningKind::Guess, text.to_owned()));
            if self.slice_spacing.is_none() && num_slices > 1 && spacing_guess.is_none() {
                spacing_guess = Some(
                    "the distance of the slices is not in the file; it was taken as that of the pixels"
                        .into(),
                );
            }
            let unit = spacing_guess.is_none().then(|| "mm".to_owned());
            let geometry = Geometry::along_axes([column_distance, row_distance, distance], unit);
            return Stacked {
                frames,
                num_slices,
                num_times: 1,
                geometry,
                modality: self.modality,
                value_unit: self.value_unit,
                spacing_guess,
                warnings,
            };
        };
        let along = |f: &Frame| f.position.unwrap_or_default().dot(normal);
        frames.sort_by(|a, b| along(a).total_cmp(&along(b)).then_with(|| compare(&a.order, &b.order)));
        let (frames, num_slices, num_times) = in_times(frames, along, &mut warnings);
        let first = frames[0].position.unwrap_or_default();
        let last = frames[num_slices - 1].position.unwrap_or_default();
        let places: Vec<f64> = frames[..num_slices].iter().map(along).collect();
        let step = if num_slices > 1 {
            let distance = slice_distance(&places, self.slice_spacing, &mut warnings);
            let mean = (last - first) / (num_slices - 1) as f64;
            let tilt = (mean.normalize_or(normal).dot(normal)).clamp(-1.0, 1.0).acos().to_degrees();
            if tilt > MAX_TILT_DEG {
                let text = format!(
                    "the slices are shifted against each other by a tilt of {tilt:.1}°, which is not shown"
                );
                warnings.push((WarningKind::Geometry, text));
            }
            normal * distance
        } else {
            if self.slice_spacing.is_none() {
                spacing_guess.get_or_insert("the thickness of the slice is not in the file; it was taken as the distance of the pixels".into());
            }
            normal * self.slice_spacing.unwrap_or(column_distance)
        };
        let geometry = Geometry {
            steps: [row * column_distance, column * row_distance, step].map(ras_from_lps),
            origin: Some(ras_from_lps(first)),
            is_body: true,
            unit: self.pixel_spacing.map(|_| "mm".to_owned()),
        };
        let Self { modality, value_unit, .. } = self;
        Stacked { frames, num_slices, num_times, geometry, modality, value_unit, spacing_guess, warnings }
    }
}

fn compare(a: &[f64; 3], b: &[f64; 3]) -> std::cmp::Ordering {
    a.iter().zip(b).map(|(a, b)| a.total_cmp(b)).find(|o| o.is_ne()).unwrap_or(std::cmp::Ordering::Equal)
}

/// Slices of one place are points in time, if there are as many at each. `frames` are sorted by place, then by time.
fn in_times(
    frames: Vec<Frame>,
    along: impl Fn(&Frame) -> f64,
    warnings: &mut Vec<(WarningKind, String)>,
) -> (Vec<Frame>, usize, usize) {
    let mut places: Vec<Vec<Frame>> = Vec::new();
    for frame in frames {
        match places.last_mut() {
            Some(place) if along(&frame) - along(&place[0]) < SAME_PLACE_MM => place.push(frame),
            _ => places.push(vec![frame]),
        }
    }
    let num_times = places.iter().map(Vec::len).min().unwrap_or(1);
    let num_extra = places.iter().map(|p| p.len() - num_times).sum::<usize>();
    if num_extra > 0 {
        let text = format!("{num_extra} slices lie where others do and were left out");
        warnings.push((WarningKind::Data, text));
    }
    let num_slices = places.len();
    let ordered = (0..num_times).flat_map(|t| places.iter().map(move |p| p[t].clone())).collect();
    (ordered, num_slices, num_times)
}

/// The distance at which slices at these places are shown; what is not even is told.
fn slice_distance(places: &[f64], told: Option<f64>, warnings: &mut Vec<(WarningKind, String)>) -> f64 {
    let gaps: Vec<f64> = places.windows(2).map(|w| w[1] - w[0]).collect();
    let mut sorted = gaps.clone();
    sorted.sort_by(f64::total_cmp);
    let (least, median, greatest) = (sorted[0], sorted[sorted.len() / 2], sorted[sorted.len() - 1]);
    let mean = gaps.iter().sum::<f64>() / gaps.len() as f64;
    let mut warn = |text: String| warnings.push((WarningKind::Geometry, text));
    let missing: Vec<(usize, f64)> = gaps
        .iter()
        .enumerate()
        .map(|(i, gap)| (i, (gap / median).round() - 1.0))
        .filter(|(i, n)| *n >= 1.0 && (gaps[*i] / median - n - 1.0).abs() < 0.2)
        .collect();
    let distance = if missing.is_empty() { mean } else { median };
    if let Some((i, _)) = missing.first() {
        let count = missing.iter().map(|m| m.1).sum::<f64>();
        let more = if missing.len() > 1 {
            format!(" and in {} other places", missing.len() - 1)
        } else {
            String::new()
        };
        warn(format!("{count} slices are missing, after slice {}{more}; the gap is not shown", i + 1));
    } else if greatest - least > UNEVEN * median {
        warn(format!(
            "slices are {least:.3} to {greatest:.3} mm apart; they are shown {distance:.3} mm apart"
        ));
    }
    if let Some(told) = told.filter(|t| (t - distance).abs() > 0.05 * distance && missing.is_empty()) {
        warn(format!(
            "the file says that slices are {told} mm apart, their positions {distance:.3} mm, which is shown"
        ));
    }
    distance
}

/// Slices nearer than this lie in the same place.
const SAME_PLACE_MM: f64 = 1e-3;
/// Distances that differ by less than this share are rounding.
const UNEVEN: f64 = 0.005;
/// As for other formats.
const MAX_TILT_DEG: f64 = 1.0;
/// Series that a slice is compared with; more than any folder holds.
const MAX_COMPARED: usize = 1024;
