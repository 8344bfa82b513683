//! The frames of a file, the location of their pixels, and their position in the body.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::sync::Arc;

use glam::DVec3;

use super::element::{DataSet, Elements};
use super::keys::Keys;
use super::pixels::Coding;
use super::tags;
use crate::error::quoted;

/// The common properties of all frames of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shape {
    pub(super) columns: u16,
    pub(super) rows: u16,
    pub(super) samples: u16,
    /// Whether each sample has its own plane.
    pub(super) is_planar: bool,
    pub(super) bits_allocated: u16,
    pub(super) bits_stored: u16,
    pub(super) high_bit: u16,
    pub(super) is_signed: bool,
    /// Whether the least value is white (MONOCHROME1).
    pub(super) is_inverted: bool,
    pub(super) coding: Coding,
}

impl Shape {
    fn of(set: &DataSet) -> Result<Self, String> {
        let number = |tag, name: &str| set.fields.short(tag).ok_or_else(|| format!("{name} is missing"));
        let (rows, columns) = (number(tags::ROWS, "Rows")?, number(tags::COLUMNS, "Columns")?);
        let bits_allocated = number(tags::BITS_ALLOCATED, "BitsAllocated")?;
        let bits_stored = set.fields.short(tags::BITS_STORED).unwrap_or(bits_allocated);
        let high_bit = set.fields.short(tags::HIGH_BIT).unwrap_or(bits_stored.wrapping_sub(1));
        let samples = set.fields.short(tags::SAMPLES_PER_PIXEL).unwrap_or(1);
        let photometric = set.fields.text(tags::PHOTOMETRIC).unwrap_or_default();
        let coding = Coding::of(&set.syntax)?;
        // The decoder supports the extended process only for 8 bits.
        if set.syntax == JPEG_EXTENDED && bits_stored > 8 {
            return Err(format!(
                "pixels are coded as JPEG Extended of {bits_stored} bits (transfer syntax {}), expected at most 8 bits in it",
                quoted(&set.syntax)
            ));
        }
        let is_known = match samples {
            1 => !photometric.starts_with("PALETTE"),
            3 => photometric == "RGB" && coding != Coding::Jpeg,
            _ => false,
        };
        if !is_known {
            let found = quoted(&photometric);
            return Err(format!(
                "pixels are {found} of {samples} samples, expected MONOCHROME1, MONOCHROME2 or RGB"
            ));
        }
        let is_good = matches!(bits_allocated, 8 | 16 | 32)
            && (1..=bits_allocated).contains(&bits_stored)
            && (bits_stored - 1..bits_allocated).contains(&high_bit)
            && rows > 0
            && columns > 0;
        if !is_good {
            return Err(format!(
                "{columns}×{rows} pixels of {bits_stored} bits in {bits_allocated}, the highest {high_bit}; expected at least one pixel and bits in 8, 16 or 32"
            ));
        }
        Ok(Self {
            columns,
            rows,
            samples,
            is_planar: samples > 1
                && (coding == Coding::Rle || set.fields.short(tags::PLANAR_CONFIGURATION) == Some(1)),
            bits_allocated,
            bits_stored,
            high_bit,
            is_signed: set.fields.short(tags::PIXEL_REPRESENTATION) == Some(1),
            is_inverted: photometric == "MONOCHROME1",
            coding,
        })
    }

    pub(super) fn num_pixels(&self) -> u64 {
        u64::from(self.columns) * u64::from(self.rows)
    }

    /// Bytes of a frame, unpacked.
    pub(super) fn num_bytes(&self) -> u64 {
        self.num_pixels() * u64::from(self.samples) * u64::from(self.bits_allocated / 8)
    }
}

#[derive(Clone, Debug)]
pub(super) struct Frame {
    pub(super) file: usize,
    /// Offsets and lengths of the parts of its pixel data.
    pub(super) parts: Vec<(u64, u64)>,
    /// Centre of the first pixel, LPS millimetres.
    pub(super) position: Option<DVec3>,
    /// The order at equal positions: point in time, acquisition, number.
    pub(super) order: [f64; 3],
    /// The keys by which it may differ from others at the same position.
    pub(super) keys: Arc<Keys>,
    pub(super) slope: f64,
    pub(super) intercept: f64,
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
        is_near(&self.orientation, &other.orientation, 1e-3)
            && is_near(&self.pixel_spacing, &other.pixel_spacing, 1e-5)
            && self.stack == other.stack
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

impl FileStack {
    /// Reads the header of the file with this number. Returns its stacks in the order of their first frames. An error
    /// of kind `InvalidData` says what is wrong.
    pub(super) fn read(file: File, number: usize) -> io::Result<Vec<Self>> {
        let invalid = |problem: String| io::Error::new(io::ErrorKind::InvalidData, problem);
        let mut reader = BufReader::new(file);
        let set = DataSet::read(&mut reader)?;
        let (offset, length) = set.pixels.ok_or_else(|| invalid("there are no pixel data".into()))?;
        let shape = Shape::of(&set).map_err(invalid)?;
        let fields = &set.fields;
        let num_frames = fields.decimal(tags::NUMBER_OF_FRAMES).unwrap_or(1.0);
        if !(1.0..=MAX_FRAMES).contains(&num_frames) {
            return Err(invalid(format!("it has {num_frames} frames, expected 1 to {MAX_FRAMES}")));
        }
        let num_frames = num_frames as usize;
        let parts = match length {
            Some(length) => plain_parts(offset, length.into(), num_frames, &shape).map_err(invalid)?,
            None => fragments(&mut reader, num_frames)?,
        };
        let shared = FrameFields::of(fields);
        let mut own: Vec<FrameFields> = set.frames.iter().take(num_frames).map(FrameFields::of).collect();
        if own.len() > 1 && stacks_are_single(&own) {
            own.iter_mut().for_each(|o| o.plane.stack = None);
        }
        let get =
            |i: usize, f: fn(&FrameFields) -> Option<f64>| own.get(i).and_then(f).or_else(|| f(&shared));
        let base = [tags::TEMPORAL_POSITION, tags::ACQUISITION_NUMBER, tags::INSTANCE_NUMBER]
            .map(|tag| fields.decimal(tag).unwrap_or(0.0));
        let offsets = fields.decimals(tags::GRID_FRAME_OFFSETS).filter(|o| o.len() == num_frames);
        let positions = shared.position.zip(shared.normal()).zip(offsets);
        let file_keys = Arc::new(Keys::of(fields));
        let number_of_series = fields.decimal(tags::SERIES_NUMBER).map_or("?".into(), |n| n.to_string());
        let description = fields.text(tags::SERIES_DESCRIPTION).unwrap_or_default();
        let modality = fields
            .text(tags::MODALITY)
            .filter(|m| m.len() <= 16 && m.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_'));
        let unit = own.first().and_then(|o| o.unit.as_deref()).or(shared.unit.as_deref());
        let value_unit = unit_of(unit, &modality);
        let mut stacks: Vec<Self> = Vec::new();
        for (i, parts) in parts.into_iter().enumerate() {
            let own_position = own.get(i).and_then(|o| o.position);
            // A plain file with many frames has the position of the first. Some files list the distances of the
            // others.
            let along = positions.as_ref().map(|((first, normal), o)| *first + *normal * (o[i] - o[0]));
            let frame = Frame {
                file: number,
                parts,
                position: own_position.or(along).or(shared.position.filter(|_| num_frames == 1)),
                order: [base[0], base[1], base[2] + i as f64 / num_frames as f64],
                keys: set.frames.get(i).map_or_else(
                    || Arc::clone(&file_keys),
                    |fields| Arc::new(Keys::of(fields).or(&file_keys)),
                ),
                slope: get(i, |o| o.slope).filter(|s| *s != 0.0).unwrap_or(1.0),
                intercept: get(i, |o| o.intercept).unwrap_or(0.0),
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
                return Err(invalid(format!(
                    "its frames lie in more than {MAX_STACKS} directions or stacks"
                )));
            }
            stacks.push(Self {
                shape,
                series_uid: fields.text(tags::SERIES_UID).unwrap_or_default(),
                name: format!("{number_of_series} {}", quoted(&description)),
                modality: modality.clone(),
                value_unit: value_unit.clone(),
                plane,
                slice_spacing: get(i, |o| o.slice_spacing),
                frames: vec![frame],
            });
        }
        Ok(stacks)
    }
}

/// Whether every frame has its own stack, which has no meaning.
fn stacks_are_single(frames: &[FrameFields]) -> bool {
    let mut names: Vec<&str> = frames.iter().filter_map(|o| o.plane.stack.as_deref()).collect();
    names.sort_unstable();
    names.windows(2).all(|w| w[0] != w[1])
}

/// The position and scale of a frame or file, as far as it states them.
struct FrameFields {
    position: Option<DVec3>,
    plane: Plane,
    slice_spacing: Option<f64>,
    slope: Option<f64>,
    intercept: Option<f64>,
    /// Unit of the values, in DICOM's terms.
    unit: Option<String>,
}

impl FrameFields {
    fn of(fields: &Elements) -> Self {
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
            unit: [tags::DOSE_UNITS, tags::UNITS, tags::RESCALE_TYPE]
                .into_iter()
                .find_map(|t| fields.text(t)),
        }
    }
}

impl FrameFields {
    /// The unit vector perpendicular to rows and columns.
    fn normal(&self) -> Option<DVec3> {
        let [a, b, c, d, e, f] = self.plane.orientation?;
        DVec3::new(a, b, c).cross(DVec3::new(d, e, f)).try_normalize()
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

/// Transfer syntax of lossy JPEG with 8 or 12 bits.
const JPEG_EXTENDED: &str = "1.2.840.10008.1.2.4.51";
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
