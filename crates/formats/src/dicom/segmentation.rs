//! Segmentations (SEG): each frame shows one segment at one position. Together they are a volume of labels, which are
//! the numbers of the segments, and 0 where there is none.

use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::PathBuf;

use glam::DVec3;
use isinglass_core::volume::VolumeLabel;

use super::element::{DataSet, Elements};
use super::frame::{Frame, FrameFields, Scale, modality_of, series_name};
use super::keys::Keys;
use super::pixels;
use super::shape::Shape;
use super::tags;
use crate::axes::{Geometry, World, ras_from_lps};
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::FormatError;
use crate::plan::{Axis, Plan, VolumeFile};
use crate::source::open_file;
use crate::warning::WarningKind;

/// The contents of one file, without its pixels.
pub(super) struct Segmentation {
    pub(super) file: usize,
    name: String,
    modality: Option<String>,
    columns: u16,
    rows: u16,
    kind: Kind,
    frames: Vec<SegmentFrame>,
    labels: Vec<VolumeLabel>,
    num_slices: u64,
    geometry: Geometry,
    spacing_guess: Option<String>,
}

/// The meaning of the numbers of a frame.
#[derive(Clone, Copy, Debug)]
enum Kind {
    /// One bit a pixel.
    Binary,
    /// The part of a pixel that the segment fills, of this greatest number.
    Fractional(f64, Shape),
    /// The number of the segment.
    Labels(Shape),
}

struct SegmentFrame {
    segment: u16,
    /// The slice, from the lowest along the normal.
    slice: u64,
    /// Offset of its first bit, for frames of bits.
    bit: u64,
    /// Offsets and lengths of the parts of its pixel data, for other frames.
    parts: Vec<(u64, u64)>,
}

impl Segmentation {
    /// `parts` locate the frames that are in fragments. The error says what is wrong.
    pub(super) fn of(
        set: &DataSet,
        file: usize,
        num_frames: usize,
        parts: Option<Vec<Vec<(u64, u64)>>>,
    ) -> Result<Self, String> {
        let fields = &set.fields;
        let number = |tag, name: &str| fields.short(tag).ok_or_else(|| format!("{name} is missing"));
        let (rows, columns) = (number(tags::ROWS, "Rows")?, number(tags::COLUMNS, "Columns")?);
        let bits = number(tags::BITS_ALLOCATED, "BitsAllocated")?;
        let pixels = set.pixels.ok_or("there are no pixels")?;
        let shape = || Shape::of(set, None);
        let kind = match fields.text(tags::SEGMENTATION_TYPE).as_deref() {
            Some("BINARY") if bits == 1 && parts.is_none() => Kind::Binary,
            Some("FRACTIONAL") => {
                let most = fields.short(tags::MOST_FRACTION).filter(|m| *m > 0).unwrap_or(255);
                Kind::Fractional(most.into(), shape()?)
            }
            Some("LABELMAP") => Kind::Labels(shape()?),
            other => {
                let found = crate::error::quoted(other.unwrap_or_default());
                let place = if parts.is_some() { "in fragments" } else { "plain" };
                return Err(format!(
                    "the segmentation is {found} of {bits} bits, {place}; expected BINARY of 1 bit, plain, FRACTIONAL or LABELMAP"
                ));
            }
        };
        let in_frame = u64::from(rows) * u64::from(columns);
        if !(1..=MAX_PIXELS).contains(&in_frame) {
            return Err(format!("{columns}×{rows} pixels, expected 1 to {MAX_PIXELS}"));
        }
        let frame_bits = in_frame * u64::from(bits);
        if let Some(length) = pixels.length
            && u64::from(length) * 8 < frame_bits.saturating_mul(num_frames as u64)
        {
            let needed = (frame_bits * num_frames as u64).div_ceil(8);
            return Err(format!("{num_frames} frames need {needed} bytes, found {length}"));
        }
        let shared = FrameFields::of(fields);
        let own: Vec<FrameFields> = set.frames.iter().take(num_frames).map(FrameFields::of).collect();
        let plane = own.first().map(|o| &o.plane);
        let orientation = plane.and_then(|p| p.orientation).or(shared.plane.orientation);
        let pixel_spacing = plane.and_then(|p| p.pixel_spacing).or(shared.plane.pixel_spacing);
        let told = own.first().and_then(|o| o.slice_spacing).or(shared.slice_spacing);
        let directions = super::frame::Plane { orientation, ..Default::default() }.directions();
        let positions: Option<Vec<DVec3>> = own.iter().map(|o| o.position).collect();
        let placed = directions.zip(positions.filter(|p| p.len() == num_frames && num_frames > 0));
        let segments: Vec<u16> = (0..num_frames)
            .map(|i| {
                let of_frame = set.frames.get(i).and_then(|f| f.short(tags::REFERENCED_SEGMENT));
                of_frame.or_else(|| fields.short(tags::REFERENCED_SEGMENT)).unwrap_or(0)
            })
            .collect();
        if !matches!(kind, Kind::Labels(_)) && segments.contains(&0) {
            return Err("its frames do not say which segment they show".into());
        }
        let [row_distance, column_distance] = pixel_spacing.unwrap_or([1.0; 2]);
        let (slices, geometry) = match &placed {
            Some(((row, column, normal), positions)) => {
                let places: Vec<f64> = positions.iter().map(|p| p.dot(*normal)).collect();
                let lowest = places.iter().copied().fold(f64::INFINITY, f64::min);
                let step = slice_step(&places, told).unwrap_or(column_distance);
                let slices: Vec<u64> = places.iter().map(|p| ((p - lowest) / step).round() as u64).collect();
                let first = (0..num_frames).find(|&i| slices[i] == 0).unwrap_or(0);
                let steps = [*row * column_distance, *column * row_distance, *normal * step];
                let geometry = Geometry {
                    steps: steps.map(ras_from_lps),
                    origin: Some(ras_from_lps(positions[first])),
                    world: World::Body,
                    unit: pixel_spacing.map(|_| "mm".to_owned()),
                };
                (slices, geometry)
            }
            None => {
                let mut counts: HashMap<u16, u64> = HashMap::new();
                let next = |segment: &u16| {
                    let count = counts.entry(*segment).or_default();
                    *count += 1;
                    *count - 1
                };
                let slices = segments.iter().map(next).collect();
                let spacing = [column_distance, row_distance, told.unwrap_or(column_distance)];
                (slices, Geometry::along_axes(spacing, pixel_spacing.map(|_| "mm".to_owned())))
            }
        };
        let num_slices = slices.iter().max().map_or(0, |s| s.saturating_add(1));
        if num_slices > MAX_SLICES {
            return Err(format!("its frames lie {num_slices} slices apart, expected at most {MAX_SLICES}"));
        }
        let frames = (0..num_frames).map(|i| SegmentFrame {
            segment: segments[i],
            slice: slices[i],
            bit: pixels.offset * 8 + frame_bits * i as u64,
            parts: parts.as_ref().map_or_else(
                || vec![(pixels.offset + frame_bits / 8 * i as u64, frame_bits / 8)],
                |parts| parts[i].clone(),
            ),
        });
        let mut frames: Vec<SegmentFrame> = frames.collect();
        frames.sort_by_key(|f| (f.slice, f.segment));
        Ok(Self {
            file,
            name: series_name(fields),
            modality: modality_of(fields),
            columns,
            rows,
            kind,
            frames,
            labels: set.segments.iter().filter_map(label).collect(),
            num_slices,
            geometry,
            spacing_guess: pixel_spacing
                .is_none()
                .then(|| "the file has no pixel spacing; it was taken as 1".to_owned()),
        })
    }

    /// A description for the list of series.
    pub(super) fn name(&self) -> String {
        let Self { name, labels, num_slices, columns, rows, .. } = self;
        format!("{name}: SEG, {} segments, {num_slices} slices of {columns}×{rows}", labels.len())
    }

    /// The volume of the labels. `path` is the file.
    pub(super) fn into_file(mut self, path: PathBuf) -> SegmentationFile {
        let most = self.frames.iter().map(|f| f.segment).max().unwrap_or(0);
        let dtype = match self.kind {
            Kind::Labels(shape) => shape.dtype(),
            _ if most > u16::from(u8::MAX) => Dtype::Uint16,
            _ => Dtype::Uint8,
        };
        let dims = [self.columns.into(), self.rows.into(), self.num_slices];
        let kind = match self.kind {
            Kind::Binary => "bits",
            Kind::Fractional(..) => "fractions",
            Kind::Labels(_) => "labels",
        };
        let geometry = self.geometry.clone();
        let format = format!("DICOM segmentation, {kind}");
        let mut plan = Plan::new(format, dtype, Endian::Little, Axis::in_space(dims), geometry);
        plan.modality = self.modality.take();
        plan.spacing_guess = self.spacing_guess.take();
        plan.are_labels = true;
        plan.labels = std::mem::take(&mut self.labels);
        if let Kind::Fractional(..) = self.kind {
            let text = "a voxel has the label of the segment that fills most of it, if that is at least half";
            plan.warn(WarningKind::Values, text);
        }
        SegmentationFile { plan, path, parts: self }
    }
}

/// The distance of slices at these places: the told one if all are whole multiples of it apart, or else the least.
fn slice_step(places: &[f64], told: Option<f64>) -> Option<f64> {
    let mut sorted = places.to_vec();
    sorted.sort_by(f64::total_cmp);
    let gaps = || sorted.windows(2).map(|w| w[1] - w[0]).filter(|g| *g > SAME_PLACE_MM);
    let is_whole = |step: &f64| gaps().all(|g| ((g / step).round() - g / step).abs() < 0.1 && g / step > 0.5);
    told.filter(is_whole).or_else(|| gaps().min_by(f64::total_cmp)).or(told)
}

/// The number, name and colour of a segment; `None` for the background.
fn label(fields: &Elements) -> Option<VolumeLabel> {
    let value = fields.short(tags::SEGMENT_NUMBER).filter(|n| *n > 0)?;
    let name = fields.text(tags::SEGMENT_LABEL).unwrap_or_else(|| format!("segment {value}"));
    let color = fields.shorts(tags::SEGMENT_COLOR).first_chunk().map(|lab| srgb_from_lab(*lab));
    Some(VolumeLabel { value: value.into(), name: crate::error::one_line(&name), color })
}

/// The colour of CIELab numbers of 16 bits (PS3.3, C.10.7.1.1), whose white is D50.
fn srgb_from_lab(stored: [u16; 3]) -> [u8; 3] {
    let [l, a, b] = stored.map(|n| f64::from(n) / 65_535.0);
    let (l, a, b) = (100.0 * l, 255.0 * a - 128.0, 255.0 * b - 128.0);
    let y = (l + 16.0) / 116.0;
    let linear =
        |t: f64| if t > 6.0 / 29.0 { t.powi(3) } else { 3.0 * (6.0f64 / 29.0).powi(2) * (t - 4.0 / 29.0) };
    let xyz = DVec3::new(0.9642 * linear(y + a / 500.0), linear(y), 0.8249 * linear(y - b / 200.0));
    // Rows of the matrix from D50 to sRGB.
    let rows = [
        DVec3::new(3.133_856, -1.616_867, -0.490_615),
        DVec3::new(-0.978_768, 1.916_142, 0.033_454),
        DVec3::new(0.071_945, -0.228_991, 1.405_243),
    ];
    rows.map(|row| {
        let x = row.dot(xyz).clamp(0.0, 1.0);
        let x = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 };
        (255.0 * x).round() as u8
    })
}

/// A segmentation with its plan.
pub(super) struct SegmentationFile {
    plan: Plan,
    path: PathBuf,
    parts: Segmentation,
}

impl super::DicomVolume for SegmentationFile {
    fn plan_mut(&mut self) -> &mut Plan {
        &mut self.plan
    }

    fn into_volume_file(self: Box<Self>) -> Box<dyn VolumeFile> {
        self
    }
}

impl VolumeFile for SegmentationFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let Self { path, parts, .. } = self;
        let in_slice = usize::from(parts.columns) * usize::from(parts.rows);
        let mut file = open_file(path)?;
        let mut num_shared = 0u64;
        let mut frames = parts.frames.iter().peekable();
        for slice in 0..parts.num_slices {
            if collector.is_done() {
                break;
            }
            let is_wanted = collector.gap() < in_slice as u64;
            let mut labels =
                Labels { numbers: vec![0; in_slice], fractions: vec![0.0; in_slice], num_shared: 0 };
            while let Some(frame) = frames.next_if(|f| f.slice == slice) {
                if is_wanted {
                    labels.add(&mut file, frame, parts.kind).map_err(|e| collector.data_error(path, e))?;
                }
            }
            num_shared += labels.num_shared;
            if !is_wanted {
                collector.pass(in_slice as u64);
            } else if collector.bytes_per_number() == 1 {
                collector.push(&labels.numbers.iter().map(|n| *n as u8).collect::<Vec<_>>())?;
            } else {
                collector.push(&labels.numbers.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<_>>())?;
            }
        }
        if num_shared > 0 {
            let text = format!(
                "{num_shared} voxels are in several segments; the one with the highest number is shown"
            );
            collector.warn(WarningKind::Data, text);
        }
        Ok(())
    }
}

/// The labels of one slice.
struct Labels {
    numbers: Vec<u16>,
    /// How much of each pixel its segment fills.
    fractions: Vec<f64>,
    /// Pixels that several segments have.
    num_shared: u64,
}

impl Labels {
    /// Adds the segment of a frame. Segments come in the order of their numbers. The error says what is wrong.
    fn add(&mut self, file: &mut File, frame: &SegmentFrame, kind: Kind) -> Result<(), String> {
        match kind {
            Kind::Binary => {
                let count = self.numbers.len() as u64;
                let (start, end) = (frame.bit / 8, (frame.bit + count).div_ceil(8));
                let mut bytes = vec![0; (end - start) as usize];
                file.seek(SeekFrom::Start(start)).map_err(|e| e.to_string())?;
                file.read_exact(&mut bytes).map_err(|e| e.to_string())?;
                for (i, number) in self.numbers.iter_mut().enumerate() {
                    let bit = (frame.bit % 8) as usize + i;
                    if bytes[bit / 8] >> (bit % 8) & 1 == 1 {
                        self.num_shared += u64::from(*number != 0);
                        *number = frame.segment;
                    }
                }
            }
            Kind::Fractional(most, shape) => {
                let numbers = decoded(file, frame, &shape)?;
                for (i, stored) in numbers.into_iter().enumerate().take(self.numbers.len()) {
                    let fraction = f64::from(stored) / most;
                    if fraction >= 0.5 && fraction > self.fractions[i] {
                        (self.numbers[i], self.fractions[i]) = (frame.segment, fraction);
                    }
                }
            }
            Kind::Labels(shape) => self.numbers = decoded(file, frame, &shape)?,
        }
        Ok(())
    }
}

/// The numbers of a frame.
fn decoded(file: &mut File, frame: &SegmentFrame, shape: &Shape) -> Result<Vec<u16>, String> {
    let frame = Frame {
        file: 0,
        parts: frame.parts.clone(),
        tile: 0,
        position: None,
        location: None,
        order: [0.0; 3],
        keys: Keys::default().into(),
        scale: Scale::Linear(1.0, 0.0),
        padding: None,
        window: None,
    };
    let bytes = pixels::decode(file, &frame, shape)?;
    match shape.bits_allocated {
        8 => Ok(bytes.into_iter().map(u16::from).collect()),
        16 => Ok(bytes.as_chunks().0.iter().map(|b| u16::from_le_bytes(*b)).collect()),
        bits => Err(format!("segments of {bits} bits, expected 8 or 16")),
    }
}

/// Most pixels of a frame, and slices of a volume.
const MAX_PIXELS: u64 = 1 << 26;
const MAX_SLICES: u64 = 1 << 16;
/// Slices nearer than this have the same position.
const SAME_PLACE_MM: f64 = 1e-3;
