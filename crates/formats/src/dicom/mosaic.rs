//! Mosaics: pictures in which scanners by Siemens and United Imaging put all slices of a volume side by side.

use glam::DVec3;

use super::element::DataSet;
use super::tags;

/// The slices in one picture, by rows from the top left.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Mosaic {
    pub(super) per_side: u16,
    pub(super) num_slices: usize,
    /// The direction from one slice to the next, if the scanner says it.
    normal: Option<DVec3>,
    /// The position of each slice, if the scanner says it.
    positions: Option<Vec<DVec3>>,
}

impl Mosaic {
    /// The mosaic of a file; `None` if it is none, or does not say how many slices it has.
    pub(super) fn of(set: &DataSet) -> Option<Self> {
        let fields = &set.fields;
        let kind = fields.text(tags::IMAGE_TYPE)?;
        let is_kind = |word: &str| kind.split('\\').any(|w| w.trim() == word);
        let header = fields.bytes(tags::SIEMENS_HEADER);
        let told = if is_kind("MOSAIC") {
            let own = || header_numbers(header, "NumberOfImagesInMosaic")?.first().copied();
            fields.short(tags::SIEMENS_NUM_TILES).map(f64::from).or_else(own)
        } else {
            None
        };
        let num_slices = told.or_else(|| fields.decimal(tags::UIH_NUM_TILES))? as usize;
        let per_side = (1..=MAX_SIDE).find(|n| n * n >= num_slices).filter(|_| num_slices > 1)? as u16;
        let [rows, columns] = [tags::ROWS, tags::COLUMNS].map(|tag| fields.short(tag).unwrap_or(0));
        if !rows.is_multiple_of(per_side) || !columns.is_multiple_of(per_side) {
            return None;
        }
        let normal = header_numbers(header, "SliceNormalVector")
            .and_then(|v| v.first_chunk().copied())
            .and_then(|v: [f64; 3]| DVec3::from_array(v).try_normalize());
        let positions = set.tiles.iter().take(num_slices);
        let positions: Option<Vec<DVec3>> =
            positions.map(|t| t.decimal_array(tags::IMAGE_POSITION).map(DVec3::from_array)).collect();
        let positions = positions.filter(|p| p.len() == num_slices);
        Some(Self { per_side, num_slices, normal, positions })
    }

    /// The position of slice `i`. `corner` is that of the whole picture. `across` and `down` lead from one of its
    /// edges to the other. `step` leads along the normal to the next slice.
    pub(super) fn position(&self, i: usize, corner: DVec3, across: DVec3, down: DVec3, step: DVec3) -> DVec3 {
        if let Some(positions) = &self.positions {
            return positions[i];
        }
        // The picture lies around the centre of its first slice.
        let inset = (1.0 - 1.0 / f64::from(self.per_side)) / 2.0;
        let is_reversed = self.normal.is_some_and(|n| n.dot(step) < 0.0);
        corner + (across + down) * inset + step * if is_reversed { -(i as f64) } else { i as f64 }
    }
}

/// The numbers of a field in the header that Siemens scanners add, of its second version (SV10).
fn header_numbers(header: &[u8], name: &str) -> Option<Vec<f64>> {
    let word = |at: usize| Some(u32::from_le_bytes(*header.get(at..)?.first_chunk()?) as usize);
    if !header.starts_with(b"SV10") {
        return None;
    }
    let text = |bytes: &[u8]| {
        let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
        String::from_utf8_lossy(&bytes[..end]).trim().to_owned()
    };
    let mut at = 16;
    for _ in 0..word(8)?.min(MAX_FIELDS) {
        let field = text(header.get(at..at + 64)?);
        let num_items = word(at + 76)?.min(MAX_FIELDS);
        at += 84;
        let mut numbers = Vec::new();
        for _ in 0..num_items {
            let length = word(at + 4)?;
            at += 16;
            let end = at.checked_add(length)?;
            numbers.extend(text(header.get(at..end)?).parse::<f64>().ok().filter(|x| x.is_finite()));
            at = end.next_multiple_of(4);
        }
        if field == name {
            return Some(numbers);
        }
    }
    None
}

/// Most slices along a side of a mosaic.
const MAX_SIDE: usize = 64;
/// Most fields of a header, and items of a field.
const MAX_FIELDS: usize = 4096;
