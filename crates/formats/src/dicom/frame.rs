//! The frames of a file, the location of their pixels, and their position in the body.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::sync::Arc;

use glam::DVec3;

use super::element::{DataSet, Elements};
use super::keys::Keys;
use super::mosaic::Mosaic;
use super::pixels::Coding;
use super::segmentation::Segmentation;
use super::shape::Shape;
use super::tags;
use crate::error::quoted;

#[derive(Clone, Debug)]
pub(super) struct Frame {
    pub(super) file: usize,
    /// Offsets and lengths of the parts of its pixel data.
    pub(super) parts: Vec<(u64, u64)>,
    /// Number of the slice in a mosaic; 0 in other pictures.
    pub(super) tile: usize,
    /// Centre of the first pixel, LPS millimetres.
    pub(super) position: Option<DVec3>,
    /// Millimetres along the stack, from a start that is not known.
    pub(super) location: Option<f64>,
    /// The order at equal positions: point in time, acquisition, number.
    pub(super) order: [f64; 3],
    /// The keys by which it may differ from others at the same position.
    pub(super) keys: Arc<Keys>,
    pub(super) scale: Scale,
    /// The least and the greatest number of pixels outside of the picture, as far as they are known.
    pub(super) padding: Option<(f64, f64)>,
    /// The values that it shows black and white, if it says so.
    pub(super) window: Option<(f64, f64)>,
}

/// How stored numbers become values.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Scale {
    /// Slope and intercept.
    Linear(f64, f64),
    /// The first number of a table (Modality LUT), and the values of the numbers from there on.
    Table(f64, Arc<[u16]>),
}

impl Scale {
    /// The value of a number. A number outside of a table has the nearest value in it.
    pub(super) fn value(&self, number: f64) -> f64 {
        match self {
            Self::Linear(slope, intercept) => number * slope + intercept,
            Self::Table(first, values) => {
                let at = (number - first).clamp(0.0, (values.len() - 1) as f64);
                values[at as usize].into()
            }
        }
    }

    /// The table of a file, if it has one.
    fn table(fields: &Elements, is_signed: bool) -> Option<Self> {
        let [count, first, bits] = *fields.shorts(tags::LUT_DESCRIPTOR).first_chunk()?;
        let count = if count == 0 { 1 << 16 } else { usize::from(count) };
        let first = if is_signed { f64::from(first as i16) } else { f64::from(first) };
        let (words, bytes) = (fields.shorts(tags::LUT_DATA), fields.bytes(tags::LUT_DATA));
        // Tables of 8 bits come in bytes or in words.
        let values: Vec<u16> = if bits <= 8 && bytes.len() < 2 * count {
            bytes.iter().map(|b| u16::from(*b)).take(count).collect()
        } else {
            words.into_iter().take(count).collect()
        };
        (!values.is_empty()).then(|| Self::Table(first, values.into()))
    }
}

/// The plane of a slice in the body.
#[derive(Clone, Debug, Default)]
pub(super) struct Plane {
    /// Directions of rows and columns.
    pub(super) orientation: Option<[f64; 6]>,
    /// Distances of rows and of columns, in millimetres.
    pub(super) pixel_spacing: Option<[f64; 2]>,
    /// Name of its stack in an enhanced file.
    pub(super) stack: Option<String>,
}

impl Plane {
    /// Whether both belong to one stack, except for rounding.
    pub(super) fn is_near(&self, other: &Self) -> bool {
        self.is_parallel(other) && self.stack == other.stack
    }

    /// Whether both have the same directions and distances of pixels.
    pub(super) fn is_parallel(&self, other: &Self) -> bool {
        is_near(&self.orientation, &other.orientation, 1e-3)
            && is_near(&self.pixel_spacing, &other.pixel_spacing, 1e-5)
    }

    /// Directions of rows, columns and the normal, if they are independent.
    pub(super) fn directions(&self) -> Option<(DVec3, DVec3, DVec3)> {
        let [a, b, c, d, e, f] = self.orientation?;
        let (row, column) = (DVec3::new(a, b, c), DVec3::new(d, e, f));
        let normal = row.cross(column);
        let is_good = normal.is_finite() && normal.length() > 0.1 && normal.length() < 10.0;
        is_good.then(|| (row.normalize(), column.normalize(), normal.normalize()))
    }
}

fn is_near<const N: usize>(a: &Option<[f64; N]>, b: &Option<[f64; N]>, most: f64) -> bool {
    match (a, b) {
        (Some(a), Some(b)) => a.iter().zip(b).all(|(a, b)| (a - b).abs() <= most),
        (None, None) => true,
        _ => false,
    }
}

/// The frames of a file in one stack, and their common properties.
#[derive(Clone, Debug)]
pub(super) struct FileStack {
    pub(super) shape: Shape,
    pub(super) series_uid: String,
    pub(super) name: String,
    pub(super) modality: Option<String>,
    pub(super) value_unit: Option<String>,
    pub(super) plane: Plane,
    /// Distance of slices that the file states, in millimetres.
    pub(super) slice_spacing: Option<f64>,
    pub(super) frames: Vec<Frame>,
}

/// What one file holds.
pub(super) enum Contents {
    Stacks(Vec<FileStack>),
    Segmentation(Box<Segmentation>),
    /// A list of other files (DICOMDIR).
    List,
}

/// Reads the header of the file with this number. Stacks are in the order of their first frames. An error of kind
/// `InvalidData` says what is wrong.
pub(super) fn read_file(file: File, number: usize) -> io::Result<Contents> {
    let invalid = |problem: String| io::Error::new(io::ErrorKind::InvalidData, problem);
    let mut reader = BufReader::new(file);
    let set = DataSet::read(&mut reader)?;
    let class =
        set.fields.text(tags::CLASS).or_else(|| set.fields.text(tags::FILE_CLASS)).unwrap_or_default();
    if class == LIST_CLASS {
        return Ok(Contents::List);
    }
    let num_frames = set.fields.decimal(tags::NUMBER_OF_FRAMES).unwrap_or(1.0);
    if !(1.0..=MAX_FRAMES).contains(&num_frames) {
        return Err(invalid(format!("it has {num_frames} frames, expected 1 to {MAX_FRAMES}")));
    }
    let num_frames = num_frames as usize;
    let Some(pixels) = set.pixels else {
        let modality = set.fields.text(tags::MODALITY).unwrap_or_default();
        let kind = match modality.as_str() {
            "" => String::new(),
            other => format!(" of modality {}", quoted(other)),
        };
        return Err(invalid(format!("the file{kind} has no pixels, expected a picture or a segmentation")));
    };
    if SEGMENTATION_CLASSES.contains(&class.as_str()) {
        let parts = match pixels.length {
            Some(_) => None,
            None => Some(fragments(&mut reader, num_frames)?),
        };
        return Segmentation::of(&set, number, num_frames, parts)
            .map(|found| Contents::Segmentation(Box::new(found)))
            .map_err(invalid);
    }
    let mosaic = Mosaic::of(&set).filter(|_| num_frames == 1);
    let shape = Shape::of(&set, mosaic.as_ref()).map_err(invalid)?;
    let parts = match pixels.length {
        Some(length) => plain_parts(pixels.offset, length.into(), num_frames, &shape).map_err(invalid)?,
        None => fragments(&mut reader, num_frames)?,
    };
    stacks_of(&set, number, shape, parts, mosaic.as_ref()).map(Contents::Stacks).map_err(invalid)
}

/// The stacks of a file. `parts` locate the pixels of each picture.
fn stacks_of(
    set: &DataSet,
    number: usize,
    shape: Shape,
    parts: Vec<Vec<(u64, u64)>>,
    mosaic: Option<&Mosaic>,
) -> Result<Vec<FileStack>, String> {
    let fields = &set.fields;
    let num_frames = mosaic.map_or(parts.len(), |m| m.num_slices);
    let shared = FrameFields::of(fields);
    let mut own: Vec<FrameFields> = set.frames.iter().take(num_frames).map(FrameFields::of).collect();
    if own.len() > 1 && stacks_are_single(&own) {
        own.iter_mut().for_each(|o| o.plane.stack = None);
    }
    let get = |i: usize, f: fn(&FrameFields) -> Option<f64>| own.get(i).and_then(f).or_else(|| f(&shared));
    let base = [tags::TEMPORAL_POSITION, tags::ACQUISITION_NUMBER, tags::INSTANCE_NUMBER]
        .map(|tag| fields.decimal(tag).unwrap_or(0.0));
    let positions = match mosaic {
        Some(mosaic) => mosaic_positions(mosaic, &shared, &shape),
        None => frame_positions(fields, &shared, num_frames),
    };
    let table = Scale::table(fields, shape.is_signed);
    let file_keys = Arc::new(Keys::of(fields));
    let time_slots = fields.shorts(tags::TIME_SLOT_VECTOR);
    let modality = modality_of(fields);
    let unit = own.first().and_then(|o| o.unit.as_deref()).or(shared.unit.as_deref());
    let value_unit = unit_of(unit, &modality);
    let padding = padding_of(fields, &shape);
    let mut stacks: Vec<FileStack> = Vec::new();
    for i in 0..num_frames {
        let own_position = own.get(i).and_then(|o| o.position);
        let keys = match set.frames.get(i) {
            Some(fields) => Arc::new(Keys::of(fields).or(&file_keys)),
            None if time_slots.len() == num_frames => Arc::new(file_keys.at_time(time_slots[i].into())),
            None => Arc::clone(&file_keys),
        };
        let frame = Frame {
            file: number,
            parts: parts[if mosaic.is_some() { 0 } else { i }].clone(),
            tile: if mosaic.is_some() { i } else { 0 },
            position: own_position.or_else(|| positions.as_ref().map(|p| p[i])),
            location: fields.decimal(tags::SLICE_LOCATION).filter(|_| num_frames == 1),
            order: [base[0], base[1], base[2] + i as f64 / num_frames as f64],
            keys,
            scale: table.clone().unwrap_or_else(|| {
                let slope = get(i, |o| o.slope).filter(|s| *s != 0.0).unwrap_or(1.0);
                Scale::Linear(slope, get(i, |o| o.intercept).unwrap_or(0.0))
            }),
            padding,
            window: own.get(i).and_then(|o| o.window).or(shared.window),
        };
        let plane = own.get(i).map(|o| &o.plane);
        let plane = Plane {
            orientation: plane.and_then(|p| p.orientation).or(shared.plane.orientation),
            pixel_spacing: plane.and_then(|p| p.pixel_spacing).or(shared.plane.pixel_spacing),
            stack: plane.and_then(|p| p.stack.clone()).or_else(|| shared.plane.stack.clone()),
        };
        if let Some(stack) = stacks.iter_mut().rev().find(|s| s.plane.is_near(&plane)) {
            stack.frames.push(frame);
            continue;
        }
        if stacks.len() == MAX_STACKS {
            return Err(format!("its frames lie in more than {MAX_STACKS} directions or stacks"));
        }
        stacks.push(FileStack {
            shape,
            series_uid: fields.text(tags::SERIES_UID).unwrap_or_default(),
            name: series_name(fields),
            modality: modality.clone(),
            value_unit: value_unit.clone(),
            plane,
            slice_spacing: get(i, |o| o.slice_spacing).map(f64::abs),
            frames: vec![frame],
        });
    }
    Ok(stacks)
}

/// The number and description of a file's series.
pub(super) fn series_name(fields: &Elements) -> String {
    let number = fields.decimal(tags::SERIES_NUMBER).map_or("?".into(), |n| n.to_string());
    format!("{number} {}", quoted(&fields.text(tags::SERIES_DESCRIPTION).unwrap_or_default()))
}

/// The imaging modality of a file.
pub(super) fn modality_of(fields: &Elements) -> Option<String> {
    let is_word = |m: &String| m.len() <= 16 && m.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_');
    fields.text(tags::MODALITY).filter(is_word)
}

/// The least and the greatest number that stand for no value (PS3.3, C.7.5.1.1.2 and C.7.6.3.1.1). They are stored
/// numbers, before any rescaling. Without a limit, there is one.
fn padding_of(fields: &Elements, shape: &Shape) -> Option<(f64, f64)> {
    let number = |[short, float, double]: [tags::Tag; 3]| match (shape.is_float, shape.bits_allocated) {
        (true, 64) => fields.double(double),
        (true, _) => fields.float(float).map(f64::from),
        (false, _) if shape.is_signed => fields.short(short).map(|bits| f64::from(bits as i16)),
        (false, _) => fields.short(short).map(f64::from),
    };
    let padding = number([tags::PIXEL_PADDING, tags::FLOAT_PADDING, tags::DOUBLE_PADDING])?;
    let limit = number([tags::PADDING_LIMIT, tags::FLOAT_PADDING_LIMIT, tags::DOUBLE_PADDING_LIMIT]);
    let limit = limit.unwrap_or(padding);
    Some((padding.min(limit), padding.max(limit)))
}

/// The positions of frames that have none of their own. The file has the position of the first, and distances.
fn frame_positions(fields: &Elements, shared: &FrameFields, num_frames: usize) -> Option<Vec<DVec3>> {
    let first = shared.position?;
    if num_frames == 1 {
        return Some(vec![first]);
    }
    let (.., normal) = shared.plane.directions()?;
    if let Some(offsets) = fields.decimals(tags::GRID_FRAME_OFFSETS).filter(|o| o.len() == num_frames) {
        return Some(offsets.iter().map(|o| first + normal * (o - offsets[0])).collect());
    }
    // Frames of a camera that turns around the body lie elsewhere.
    if !fields.shorts(tags::ROTATION_VECTOR).is_empty() {
        return None;
    }
    // In nuclear medicine, a negative distance says that the slices run against the normal.
    let distance = fields.decimal(tags::SPACING_BETWEEN_SLICES).filter(|d| *d != 0.0)?;
    let numbers = fields.shorts(tags::SLICE_VECTOR);
    let number = |i: usize| numbers.get(i).map_or(i as f64, |n| f64::from(*n) - 1.0);
    Some((0..num_frames).map(|i| first + normal * distance * number(i)).collect())
}

/// The positions of the slices of a mosaic.
fn mosaic_positions(mosaic: &Mosaic, shared: &FrameFields, shape: &Shape) -> Option<Vec<DVec3>> {
    let (corner, [row_distance, column_distance]) = (shared.position?, shared.plane.pixel_spacing?);
    let (row, column, normal) = shared.plane.directions()?;
    let [columns, rows] = shape.picture();
    let across = row * column_distance * columns as f64;
    let down = column * row_distance * rows as f64;
    let step = normal * shared.slice_spacing?.abs();
    Some((0..mosaic.num_slices).map(|i| mosaic.position(i, corner, across, down, step)).collect())
}

/// Whether every frame has its own stack, which has no meaning.
fn stacks_are_single(frames: &[FrameFields]) -> bool {
    let mut names: Vec<&str> = frames.iter().filter_map(|o| o.plane.stack.as_deref()).collect();
    names.sort_unstable();
    names.windows(2).all(|w| w[0] != w[1])
}

/// The position and scale of a frame or file, as far as it states them.
pub(super) struct FrameFields {
    pub(super) position: Option<DVec3>,
    pub(super) plane: Plane,
    pub(super) slice_spacing: Option<f64>,
    slope: Option<f64>,
    intercept: Option<f64>,
    window: Option<(f64, f64)>,
    /// Unit of the values, in DICOM's terms.
    unit: Option<String>,
}

impl FrameFields {
    pub(super) fn of(fields: &Elements) -> Self {
        let above_zero = |x: &f64| *x > 0.0;
        let spacing = |tag| fields.decimal_array::<2>(tag).filter(|s| s.iter().all(above_zero));
        let slice = |tag| fields.decimal(tag).map(f64::abs).filter(above_zero);
        Self {
            position: fields.decimal_array(tags::IMAGE_POSITION).map(DVec3::from_array),
            plane: Plane {
                orientation: fields.decimal_array(tags::IMAGE_ORIENTATION),
                pixel_spacing: spacing(tags::PIXEL_SPACING).or_else(|| spacing(tags::IMAGER_PIXEL_SPACING)),
                stack: fields.text(tags::STACK_ID),
            },
            slice_spacing: slice(tags::SPACING_BETWEEN_SLICES).or_else(|| slice(tags::SLICE_THICKNESS)),
            // Doses have their own field for the slope, and are then in gray.
            slope: fields.decimal(tags::RESCALE_SLOPE).or_else(|| fields.decimal(tags::DOSE_GRID_SCALING)),
            intercept: fields.decimal(tags::RESCALE_INTERCEPT),
            // Of several windows, the first is that of the whole picture.
            window: fields
                .decimal(tags::WINDOW_CENTER)
                .zip(fields.decimal(tags::WINDOW_WIDTH))
                .map(|(center, width)| (center - width / 2.0, center + width / 2.0)),
            unit: [tags::DOSE_UNITS, tags::UNITS, tags::RESCALE_TYPE, tags::LUT_TYPE]
                .into_iter()
                .find_map(|t| fields.text(t)),
        }
    }
}

/// The unit of values for a DICOM `term` (PS3.3, C.7.6.16.2.9, C.8.9.1 and C.8.8.3). The default of computed
/// tomography is Hounsfield units.
fn unit_of(term: Option<&str>, modality: &Option<String>) -> Option<String> {
    let unit = match term {
        None if modality.as_deref() == Some("CT") => "HU",
        Some("HU" | "HU_MOD") => "HU",
        Some("GY") => "Gy",
        Some("BQML") => "Bq/mL",
        Some("GML") => "g/mL",
        Some("MGML") => "mg/mL",
        Some("CNTS") => "counts",
        Some("CPS") => "counts/s",
        Some("PCNT") => "%",
        _ => return None,
    };
    Some(unit.to_owned())
}

/// The parts of frames that follow each other.
fn plain_parts(
    offset: u64,
    length: u64,
    num_frames: usize,
    shape: &Shape,
) -> Result<Vec<Vec<(u64, u64)>>, String> {
    if !matches!(shape.coding, Coding::Plain { .. }) {
        return Err(format!("{} pixels are not in fragments", shape.coding.name()));
    }
    let each = shape.num_bytes();
    let needed = each.saturating_mul(num_frames as u64);
    if length < needed {
        return Err(format!("{num_frames} frames need {needed} bytes, found {length}"));
    }
    Ok((0..num_frames as u64).map(|i| vec![(offset + i * each, each)]).collect())
}

/// The fragments of each frame. `reader` is at the first item, the table of offsets.
fn fragments(reader: &mut BufReader<File>, num_frames: usize) -> io::Result<Vec<Vec<(u64, u64)>>> {
    let invalid = |problem: String| io::Error::new(io::ErrorKind::InvalidData, problem);
    let length = reader.get_ref().metadata()?.len();
    let mut list: Vec<(u64, u64)> = Vec::new();
    let mut table = Vec::new();
    let mut is_table = true;
    loop {
        let mut head = [0; 8];
        reader.read_exact(&mut head)?;
        let at = reader.stream_position()?;
        let size = u64::from(u32::from_le_bytes([head[4], head[5], head[6], head[7]]));
        match head[..4] {
            [0xfe, 0xff, 0x00, 0xe0] if at + size <= length => {}
            [0xfe, 0xff, 0xdd, 0xe0] => break,
            _ => return Err(invalid("a fragment of pixel data is not where it should be".into())),
        }
        if is_table {
            if size / 4 > MAX_FRAMES as u64 {
                return Err(invalid("the table of offsets is too long".into()));
            }
            let mut bytes = Vec::new();
            reader.by_ref().take(size).read_to_end(&mut bytes)?;
            table.extend(bytes.as_chunks::<4>().0.iter().map(|b| u64::from(u32::from_le_bytes(*b))));
            is_table = false;
        } else {
            if list.len() == MAX_FRAGMENTS {
                return Err(invalid(format!("more than {MAX_FRAGMENTS} fragments")));
            }
            list.push((at, size));
        }
        reader.seek(SeekFrom::Start(at + size))?;
    }
    let start = list.first().map_or(0, |f| f.0 - 8);
    if num_frames == 1 {
        return Ok(vec![list]);
    }
    if list.len() == num_frames {
        return Ok(list.into_iter().map(|f| vec![f]).collect());
    }
    if table.len() == num_frames && table.is_sorted() {
        let mut frames = vec![Vec::new(); num_frames];
        for fragment in list {
            // This is the frame that begins at or before the fragment.
            let i = table.partition_point(|&o| o <= fragment.0 - 8 - start);
            if let Some(frame) = i.checked_sub(1).and_then(|i| frames.get_mut(i)) {
                frame.push(fragment);
            }
        }
        return Ok(frames);
    }
    Err(invalid(format!("{} fragments for {num_frames} frames and no table of offsets", list.len())))
}

/// Lists of files (PS3.3, annex F).
const LIST_CLASS: &str = "1.2.840.10008.1.3.10";
/// Segmentations, and those whose numbers are labels.
const SEGMENTATION_CLASSES: [&str; 2] = ["1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7"];
/// Most frames of a file.
const MAX_FRAMES: f64 = 65_536.0;
const MAX_FRAGMENTS: usize = 1 << 18;
/// Most directions and stacks of a file.
const MAX_STACKS: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_have_the_unit_that_their_file_says() {
        let unit = |term: Option<&str>, modality: &str| unit_of(term, &Some(modality.to_owned()));
        assert_eq!(unit(None, "CT").as_deref(), Some("HU"));
        assert_eq!(unit(Some("HU"), "MR").as_deref(), Some("HU"));
        assert_eq!(unit(Some("BQML"), "PT").as_deref(), Some("Bq/mL"));
        for (term, modality) in [(None, "MR"), (Some("US"), "CT"), (Some("RELATIVE"), "RTDOSE")] {
            assert_eq!(unit(term, modality), None, "{term:?} of {modality}");
        }
    }
}
