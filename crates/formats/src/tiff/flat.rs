//! Pages whose numbers lie in their files as they are, to be read by offset.

use std::path::{Path, PathBuf};

use ::tiff::TiffError;
use ::tiff::tags::ByteOrder;

use super::PageLocation;
use super::page::{PageDecoder, PageShape, decoder, is_white, page_shape, plain_block, tiff_error};
use crate::dtype::Endian;
use crate::error::{FormatError, shown};
use crate::paged::flat::FlatFile;

/// Where the numbers of each plane begin, and their byte order.
///
/// # Errors
/// A page is missing, packed, in parts that lie apart, or its least number is white.
pub(super) fn flat_planes(
    files: &[PathBuf],
    planes: &[Option<PageLocation>],
    shape: PageShape,
    path: &Path,
) -> Result<(Vec<FlatFile>, Endian), FormatError> {
    let not_paged = |found: &str| FormatError::NotPaged { path: shown(path), found: found.to_owned() };
    let (mut found, mut endian) = (Vec::new(), None);
    let mut reader: Option<(u32, PageDecoder)> = None;
    for place in planes {
        let place = place.ok_or_else(|| not_paged("a TIFF without some of its pages"))?;
        let file = &files[place.file as usize];
        if reader.as_ref().is_none_or(|(open, _)| *open != place.file) {
            reader = Some((place.file, decoder(file)?));
        }
        let Some((_, decoder)) = &mut reader else { continue };
        let error = |e: TiffError| tiff_error(file, place.page, e);
        decoder.seek_to_image(place.page as usize).map_err(error)?;
        let order = match decoder.byte_order() {
            ByteOrder::LittleEndian => Endian::Little,
            ByteOrder::BigEndian => Endian::Big,
        };
        let is_odd = *endian.get_or_insert(order) != order
            || page_shape(decoder).map_err(|e| e.at(file, place.page))? != shape
            || is_white(decoder);
        let offset = plain_block(decoder).filter(|_| !is_odd);
        let offset = offset.ok_or_else(|| not_paged("a TIFF of pages that are packed or in parts"))?;
        found.push(FlatFile { path: file.clone(), offset });
    }
    Ok((found, endian.unwrap_or_default()))
}
