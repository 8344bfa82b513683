//! Groups slices into series, and finds their geometry.

use std::collections::HashMap;

use glam::DVec3;

use super::divide::{self, Divided};
use super::frame::{FileStack, Frame, Plane, Shape};
use super::gaps::slice_distance;
use crate::axes::{Geometry, ras_from_lps};
use crate::error::quoted;
use crate::warning::WarningKind;

/// Slices of one series, shape, plane and kind.
pub(super) struct Series {
    pub(super) shape: Shape,
    uid: String,
    name: String,
    modality: Option<String>,
    value_unit: Option<String>,
    plane: Plane,
    slice_spacing: Option<f64>,
    /// Descriptions that distinguish it from others of the same series.
    details: Vec<String>,
    /// Sorted by position along the normal, then by their order. Without positions, by their order.
    frames: Vec<Frame>,
}

pub(super) struct Stacked {
    /// Sorted by time, then along the normal.
    pub(super) frames: Vec<Frame>,
    pub(super) num_slices: usize,
    pub(super) num_times: usize,
    pub(super) geometry: Geometry,
    pub(super) modality: Option<String>,
    pub(super) value_unit: Option<String>,
    pub(super) spacing_guess: Option<String>,
    pub(super) warnings: Vec<(WarningKind, String)>,
}

/// Groups slices into series, in the order of the files.
pub(super) fn group(files: Vec<FileStack>) -> Vec<Series> {
    let mut all: Vec<Series> = Vec::new();
    for file in files {
        // The latest series is the most likely.
        let fits = |s: &&mut Series| {
            s.uid == file.series_uid && s.shape == file.shape && s.plane.is_near(&file.plane)
        };
        match all.iter_mut().rev().take(MAX_COMPARED).find(fits) {
            Some(series) => series.frames.extend(file.frames),
            None => all.push(Series {
                shape: file.shape,
                uid: file.series_uid,
                name: file.name,
                modality: file.modality,
                value_unit: file.value_unit,
                plane: file.plane,
                slice_spacing: file.slice_spacing,
                details: Vec::new(),
                frames: file.frames,
            }),
        }
    }
    let mut counts: HashMap<String, usize> = HashMap::new();
    all.iter().for_each(|s| *counts.entry(s.uid.clone()).or_default() += 1);
    for series in &mut all {
        if counts[&series.uid] > 1 {
            series.details.extend(series.plane_in_words());
        }
    }
    all.into_iter().flat_map(Series::by_kind).collect()
}

/// Directions of rows, columns and the normal, if they are independent.
fn directions(plane: &Plane) -> Option<(DVec3, DVec3, DVec3)> {
    let [a, b, c, d, e, f] = plane.orientation?;
    let (row, column) = (DVec3::new(a, b, c), DVec3::new(d, e, f));
    let normal = row.cross(column);
    let is_good = normal.is_finite() && normal.length() > 0.1 && normal.length() < 10.0;
    is_good.then(|| (row.normalize(), column.normalize(), normal.normalize()))
}

impl Series {
    pub(super) fn num_voxels(&self) -> u64 {
        self.shape.num_pixels() * self.frames.len() as u64
    }

    pub(super) fn name(&self) -> String {
        let modality = self.modality.as_ref().map_or(String::new(), |m| format!(" {m}"));
        let Shape { columns, rows, .. } = self.shape;
        let details: String = self.details.iter().map(|d| format!(", {d}")).collect();
        format!("{}{details}:{modality}, {} slices of {columns}×{rows}", self.name, self.frames.len())
    }

    /// The direction of the slices, and the name of their stack.
    fn plane_in_words(&self) -> Vec<String> {
        let direction = directions(&self.plane).map(|(.., normal)| {
            let along = (0..3).find(|&i| normal[i].abs() > MIN_COSINE);
            along.map_or("oblique", |i| ["sagittal", "coronal", "axial"][i]).to_owned()
        });
        let stack = self.plane.stack.as_ref().map(|s| format!("stack {}", quoted(s)));
        direction.into_iter().chain(stack).collect()
    }

    /// Sorts the slices. Returns the number of each position, if positions are known.
    fn sort(&mut self) -> Option<Vec<usize>> {
        let normal = directions(&self.plane).map(|d| d.2);
        let is_placed = self.frames.iter().all(|f| f.position.is_some());
        let Some(normal) = normal.filter(|_| is_placed) else {
            self.frames.sort_by(|a, b| compare(&a.order, &b.order));
            return None;
        };
        let along = |f: &Frame| f.position.unwrap_or_default().dot(normal);
        self.frames.sort_by(|a, b| along(a).total_cmp(&along(b)));
        let tolerance = SAME_PLACE_MM.max(SAME_PLACE * self.slice_spacing.unwrap_or(0.0));
        let (mut places, mut first, mut place) = (Vec::new(), self.frames.first().map_or(0.0, along), 0);
        for frame in &self.frames {
            if along(frame) - first > tolerance {
                (first, place) = (along(frame), place + 1);
            }
            places.push(place);
        }
        let mut rest = &mut self.frames[..];
        for part in places.chunk_by(|a, b| a == b) {
            let (frames, after) = rest.split_at_mut(part.len());
            frames.sort_by(|a, b| compare(&a.order, &b.order));
            rest = after;
        }
        Some(places)
    }

    /// Splits the series by kind of picture at the same positions.
    fn by_kind(mut self) -> Vec<Self> {
        let places = self.sort();
        let frames = std::mem::take(&mut self.frames);
        let parts = match &places {
            Some(places) => divide::by_kind(frames, places),
            None => vec![(None, frames)],
        };
        let is_last = parts.len() == 1;
        let made = parts.into_iter().flat_map(|(words, frames)| {
            let details = self.details.iter().cloned().chain(words).collect();
            let part = Self {
                shape: self.shape,
                uid: self.uid.clone(),
                name: self.name.clone(),
                modality: self.modality.clone(),
                value_unit: self.value_unit.clone(),
                plane: self.plane.clone(),
                slice_spacing: self.slice_spacing,
                details,
                frames,
            };
            // Each kind may have several echoes.
            if is_last { vec![part] } else { part.by_kind() }
        });
        made.collect()
    }

    /// Sorts the slices and finds their geometry.
    pub(super) fn stack(mut self) -> Stacked {
        let mut warnings = Vec::new();
        let mut spacing_guess = None;
        let [row_distance, column_distance] = self.plane.pixel_spacing.unwrap_or_else(|| {
            spacing_guess = Some("the file has no pixel spacing; it was taken as 1".to_owned());
            [1.0; 2]
        });
        let places = self.sort();
        let frames = std::mem::take(&mut self.frames);
        if frames.iter().any(|f| f.keys.is_mosaic()) {
            let text =
                "the pictures are mosaics of slices (MOSAIC), which are shown as they are, not as a volume";
            warnings.push((WarningKind::Data, text.to_owned()));
        }
        let Some(((row, column, normal), places)) = directions(&self.plane).zip(places) else {
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
        let Divided { frames, num_slices, num_times, warnings: said } = divide::into_times(&frames, &places);
        warnings.extend(said);
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
            unit: self.plane.pixel_spacing.map(|_| "mm".to_owned()),
        };
        let Self { modality, value_unit, .. } = self;
        Stacked { frames, num_slices, num_times, geometry, modality, value_unit, spacing_guess, warnings }
    }
}

fn compare(a: &[f64; 3], b: &[f64; 3]) -> std::cmp::Ordering {
    a.iter().zip(b).map(|(a, b)| a.total_cmp(b)).find(|o| o.is_ne()).unwrap_or(std::cmp::Ordering::Equal)
}

/// Slices have the same position if they are nearer than this, or than this fraction of their distance.
const SAME_PLACE_MM: f64 = 1e-3;
const SAME_PLACE: f64 = 0.01;
/// Least cosine of a normal that is named after an axis: 15°.
const MIN_COSINE: f64 = 0.966;
/// Largest tilt without a warning, as for other formats.
const MAX_TILT_DEG: f64 = 1.0;
/// Most series that a slice is compared with.
const MAX_COMPARED: usize = 1024;
