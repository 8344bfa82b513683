//! Groups slices into series, and finds their geometry.

use std::collections::HashMap;

use glam::DVec3;

use super::divide::{self, Divided};
use super::frame::{FileStack, Frame, Plane};
use super::gaps::Gaps;
use super::resample::Resampling;
use super::shape::{Colors, Shape};
use crate::axes::{Geometry, World, ras_from_lps};
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

/// What orders the slices of a series.
#[derive(Clone, Copy)]
enum Along {
    /// Their positions, along this normal.
    Normal(DVec3),
    /// Their locations, along a direction that is not known.
    Locations,
}

impl Along {
    fn place(self, frame: &Frame) -> f64 {
        match self {
            Self::Normal(normal) => frame.position.unwrap_or_default().dot(normal),
            Self::Locations => frame.location.unwrap_or_default(),
        }
    }
}

pub(super) struct Stacked {
    /// Sorted by time, then along the normal.
    pub(super) frames: Vec<Frame>,
    pub(super) num_slices: usize,
    pub(super) num_times: usize,
    /// How evenly spaced slices come from these, if they are not such slices themselves.
    pub(super) resampling: Option<Resampling>,
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
    let mut all = joined(all);
    let mut counts: HashMap<String, usize> = HashMap::new();
    all.iter().for_each(|s| *counts.entry(s.uid.clone()).or_default() += 1);
    for series in &mut all {
        if counts[&series.uid] > 1 {
            series.details.extend(series.plane_in_words());
        }
    }
    all.into_iter().flat_map(Series::by_kind).collect()
}

/// Joins the stacks that together are evenly spaced slices of one volume.
fn joined(mut all: Vec<Series>) -> Vec<Series> {
    let mut result: Vec<Series> = Vec::new();
    while !all.is_empty() {
        let first = all.remove(0);
        let fits =
            |s: &Series| s.uid == first.uid && s.shape == first.shape && s.plane.is_parallel(&first.plane);
        if result.len() > MAX_COMPARED || first.plane.stack.is_none() || !all.iter().any(fits) {
            result.push(first);
            continue;
        }
        let (parts, rest): (Vec<_>, Vec<_>) = all.into_iter().partition(fits);
        all = rest;
        let mut parts: Vec<Series> = std::iter::once(first).chain(parts).collect();
        if are_one_stack(&parts) {
            let others: Vec<Frame> = parts.drain(1..).flat_map(|p| p.frames).collect();
            parts[0].frames.extend(others);
            parts[0].plane.stack = None;
        }
        result.extend(parts);
    }
    result
}

/// Whether these parallel stacks lie one behind the other, with one even distance between all of their slices.
fn are_one_stack(parts: &[Series]) -> bool {
    let Some((.., normal)) = parts[0].plane.directions() else { return false };
    // The place of each slice, its stack, and what lies beside the normal.
    let mut slices = Vec::new();
    for (i, part) in parts.iter().enumerate() {
        for frame in &part.frames {
            let Some(position) = frame.position else { return false };
            let place = position.dot(normal);
            slices.push((place, i, position - normal * place));
        }
    }
    slices.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let is_same = |a: f64, b: f64| (a - b).abs() <= SAME_PLACE_MM;
    let is_shared = slices.windows(2).any(|w| is_same(w[0].0, w[1].0) && w[0].1 != w[1].1);
    let is_aside = slices.iter().any(|s| (s.2 - slices[0].2).length() > MAX_ASIDE_MM);
    slices.dedup_by(|a, b| is_same(a.0, b.0));
    let places: Vec<f64> = slices.iter().map(|s| s.0).collect();
    !is_shared && !is_aside && places.len() > 1 && Gaps::of(&places).are_even()
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
        let direction = self.plane.directions().map(|(.., normal)| {
            let along = (0..3).find(|&i| normal[i].abs() > MIN_COSINE);
            along.map_or("oblique", |i| ["sagittal", "coronal", "axial"][i]).to_owned()
        });
        let stack = self.plane.stack.as_ref().map(|s| format!("stack {}", quoted(s)));
        direction.into_iter().chain(stack).collect()
    }

    /// What orders the slices, if all of them have it.
    fn along(&self) -> Option<Along> {
        let normal = self.plane.directions().map(|d| d.2);
        if let Some(normal) = normal.filter(|_| self.frames.iter().all(|f| f.position.is_some())) {
            return Some(Along::Normal(normal));
        }
        let first = self.frames.first()?.location?;
        let is_located = self.frames.iter().all(|f| f.location.is_some());
        let is_told = is_located && self.frames.iter().any(|f| f.location != Some(first));
        is_told.then_some(Along::Locations)
    }

    /// Sorts the slices. Returns the number of each position, if positions or locations are known.
    fn sort(&mut self) -> Option<Vec<usize>> {
        let Some(order) = self.along() else {
            self.frames.sort_by(|a, b| compare(&a.order, &b.order));
            return None;
        };
        let along = |f: &Frame| order.place(f);
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

    /// Sorts the slices and finds their geometry. `is_stored` keeps slices that are not even as they are.
    pub(super) fn stack(mut self, is_stored: bool) -> Stacked {
        let mut warnings = Vec::new();
        let mut spacing_guess = None;
        let [row_distance, column_distance] = self.plane.pixel_spacing.unwrap_or_else(|| {
            spacing_guess = Some("the file has no pixel spacing; it was taken as 1".to_owned());
            [1.0; 2]
        });
        let order = self.along();
        let places = self.sort();
        let frames = std::mem::take(&mut self.frames);
        if self.shape.tiles == 1 && frames.iter().any(|f| f.keys.is_mosaic()) {
            let text =
                "the pictures are mosaics of slices (MOSAIC) without their number, and are shown as they are";
            warnings.push((WarningKind::Data, text.to_owned()));
        }
        let Divided { frames, num_slices, num_times, warnings: said } = match &places {
            Some(places) => divide::into_times(&frames, places),
            None => Divided { num_slices: frames.len(), num_times: 1, frames, warnings: Vec::new() },
        };
        warnings.extend(said);
        let stack = &frames[..num_slices];
        let places: Vec<f64> = order.map_or_else(Vec::new, |o| stack.iter().map(|f| o.place(f)).collect());
        let gaps = (places.len() > 1).then(|| Gaps::of(&places));
        let directions = match order {
            Some(Along::Normal(_)) => self.plane.directions(),
            Some(Along::Locations) => {
                let text = "positions are missing; slices are in the order of their locations, and where the body lies is not known";
                warnings.push((WarningKind::Guess, text.to_owned()));
                None
            }
            None => {
                let text = "positions are missing; slices are in the order of their numbers, and where the body lies is not known";
                warnings.push((WarningKind::Guess, text.to_owned()));
                None
            }
        };
        // How far each slice is shifted against the first one, in columns and rows.
        let offset = |frame: &Frame| match (directions, frame.position.zip(stack[0].position)) {
            (Some((row, column, _)), Some((position, first))) => {
                let aside = position - first;
                [aside.dot(row) / column_distance, aside.dot(column) / row_distance]
            }
            _ => [0.0; 2],
        };
        let tilt_deg = tilt_deg(stack, directions.map(|d| d.2));
        let is_tilted = tilt_deg > MAX_TILT_DEG;
        let is_even = !gaps.as_ref().is_some_and(Gaps::need_resampling) && !is_tilted;
        let resampling =
            gaps.as_ref().filter(|_| !is_even && !is_stored && self.shape.colors == Colors::Gray);
        let resampling = resampling.and_then(|gaps| {
            let offsets: Vec<[f64; 2]> =
                stack.iter().map(|f| if is_tilted { offset(f) } else { [0.0; 2] }).collect();
            Resampling::of(&places, gaps, &offsets, [self.shape.columns, self.shape.rows].map(usize::from))
        });
        if let Some(gaps) = &gaps {
            gaps.warn(self.slice_spacing, resampling.as_ref().map(|r| r.distance), &mut warnings);
        }
        if is_tilted {
            let shown = if resampling.is_some() {
                "they were resampled to right angles"
            } else {
                "which is not shown"
            };
            let text =
                format!("the slices are shifted against each other by a tilt of {tilt_deg:.1}°; {shown}");
            warnings.push((WarningKind::Geometry, text.replace("; which", ", which")));
        }
        if resampling.is_some() {
            let text = "the slices were resampled to even distances; --stored-slices shows them as they are";
            warnings.push((WarningKind::Geometry, text.to_owned()));
        }
        let distance = resampling.as_ref().map(|r| r.distance).or(gaps.map(|g| g.distance));
        let distance = distance.or(self.slice_spacing).unwrap_or_else(|| {
            let what =
                if num_slices > 1 { "the distance of the slices" } else { "the thickness of the slice" };
            let text = format!("{what} is not in the file; it was taken as the distance of the pixels");
            spacing_guess.get_or_insert(text);
            column_distance
        });
        let unit = self.plane.pixel_spacing.map(|_| "mm".to_owned());
        let geometry = match directions {
            Some((row, column, normal)) => {
                let [x, y] = resampling.as_ref().map_or([0.0; 2], |r| r.corner);
                let corner = row * column_distance * x + column * row_distance * y;
                Geometry {
                    steps: [row * column_distance, column * row_distance, normal * distance]
                        .map(ras_from_lps),
                    origin: stack[0].position.map(|first| ras_from_lps(first + corner)),
                    world: World::Body,
                    unit,
                }
            }
            None => Geometry::along_axes([column_distance, row_distance, distance], unit),
        };
        let Self { modality, value_unit, .. } = self;
        Stacked {
            frames,
            num_slices,
            num_times,
            resampling,
            geometry,
            modality,
            value_unit,
            spacing_guess,
            warnings,
        }
    }
}

/// The angle between the normal and the line from the first slice to the last.
fn tilt_deg(stack: &[Frame], normal: Option<DVec3>) -> f64 {
    let ends = stack.first().and_then(|f| f.position).zip(stack.last().and_then(|f| f.position));
    let Some(((first, last), normal)) = ends.zip(normal) else { return 0.0 };
    (last - first).normalize_or(normal).dot(normal).clamp(-1.0, 1.0).acos().to_degrees()
}

fn compare(a: &[f64; 3], b: &[f64; 3]) -> std::cmp::Ordering {
    a.iter().zip(b).map(|(a, b)| a.total_cmp(b)).find(|o| o.is_ne()).unwrap_or(std::cmp::Ordering::Equal)
}

/// Stacks of one volume lie no farther aside of each other.
const MAX_ASIDE_MM: f64 = 0.1;
/// Slices have the same position if they are nearer than this, or than this fraction of their distance.
const SAME_PLACE_MM: f64 = 1e-3;
const SAME_PLACE: f64 = 0.01;
/// Least cosine of a normal that is named after an axis: 15°.
const MIN_COSINE: f64 = 0.966;
/// Largest tilt without a warning, as for other formats.
const MAX_TILT_DEG: f64 = 1.0;
/// Most series that a slice is compared with.
const MAX_COMPARED: usize = 1024;
