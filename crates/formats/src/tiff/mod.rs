//! TIFF and BigTIFF. Slices are the pages of one file, or the files of a folder. Descriptions by ImageJ and OME have
//! channels, times and the size of a voxel. So have the names of files.

mod check;
mod chunks;
mod folder;
mod imagej;
mod name_fields;
mod names;
mod ome;
mod packing;
mod page;
mod palette;
mod set;
mod shaped;
mod stack;

use std::path::{Path, PathBuf};

use self::chunks::{PageFinder, PlanePlace, TiffPlanes};
use self::packing::MAX_LZW_RATIO;
use self::page::{Group, PageShape, Scan};
use self::shaped::Shaped;
use self::stack::{Stack, plan};
use crate::collector::Collector;
use crate::error::{FormatError, io_error, malformed, not_there, shown};
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{BoxLevel, Plan, VolumeFile};
use crate::planes::{plane_level, whole_plane};
use crate::source::{OpenOptions, file_name, open_file};
use crate::stream::{Packing, Unpacked};
use crate::warning::WarningKind;

/// Files whose pages were scanned.
pub(crate) struct TiffFile {
    plan: Plan,
    files: Vec<PathBuf>,
    /// The page of each plane, in the order of the plan's axes. A plane without a page is empty.
    planes: Vec<Option<PageLocation>>,
    shape: PageShape,
    /// Offset of planes that follow each other without pages.
    contiguous: Option<u64>,
    /// Most bytes of memory.
    max_bytes: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct PageLocation {
    pub(super) file: u32,
    pub(super) page: u32,
}

impl TiffFile {
    /// Opens a file, or the files of a folder, which contain one or more slices each. `path` is the file or the
    /// folder.
    pub(crate) fn open(files: Vec<PathBuf>, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let first = match files.len() {
            1 => Some(Scan::of(&files[0], options)?),
            _ => Scan::of(&files[0], options).ok(),
        };
        if let Some(text) = first.as_ref().and_then(|first| first.description.clone())
            && ome::is_ome(&text)
            && let Some(image) = set::OmeSet::open(&text, &files, path, options)?
        {
            return match first {
                Some(first) => image.into_file(first, path, options),
                None => Err(malformed(path, "TIFF")("no page".into())),
            };
        }
        match first {
            Some(first) if files.len() == 1 => Self::open_one(first, files, path, options),
            _ => folder::open(files, path, options),
        }
    }

    /// Opens a file by its scan.
    fn open_one(
        mut first: Scan,
        files: Vec<PathBuf>,
        path: &Path,
        options: &OpenOptions,
    ) -> Result<Self, FormatError> {
        let bad = malformed(path, "TIFF");
        let num_series = first.groups.len();
        let index = options.selection.series.unwrap_or(0) as usize;
        if index >= num_series {
            return Err(not_there(path, "series", index as u64, num_series));
        }
        let series: Vec<String> = first.groups.iter().map(Group::name).collect();
        let group = first.groups.swap_remove(index);
        let (mut stack, is_described) = first.stack(&group, index == 0).map_err(bad)?;
        let num_planes = stack.num_planes().map_err(bad)?;
        let is_truncated = group.shaped.as_ref().is_some_and(|s| s.is_truncated);
        let is_contiguous =
            (stack.name == "ImageJ TIFF" || is_truncated) && group.pages.len() == 1 && num_planes > 1;
        if is_contiguous && group.block.is_none() {
            return Err(bad(format!(
                "its description has {num_planes} planes, but there is one page, packed or in parts that lie apart; \
                 expected a page for each, or plain numbers one after the other"
            )));
        }
        let mut warnings = Vec::new();
        if !is_contiguous && num_planes != group.pages.len() as u64 {
            let text = stack.read_as_slices(num_planes, group.pages.len());
            if is_described {
                warnings.push((WarningKind::Data, text));
            }
            stack.guess = None;
        }
        if num_series > 1 {
            if options.selection.series.is_none() {
                warnings.push((WarningKind::Choice, several_series(&series)));
            }
            stack.series = series;
        }
        if first.num_other > 0 {
            let text = format!("{} pages of another size or type were left out", first.num_other);
            warnings.push((WarningKind::Data, text));
        }
        let mut plan = plan(&group, &mut stack, first.endian).map_err(bad)?;
        for (kind, text) in warnings {
            plan.warn(kind, text);
        }
        let location = |&page| Some(PageLocation { file: 0, page });
        let planes = if is_contiguous { Vec::new() } else { group.pages.iter().map(location).collect() };
        let contiguous = group.block.filter(|_| is_contiguous);
        let (shape, max_bytes) = (group.shape, options.max_bytes);
        Ok(Self { plan, files, planes, shape, contiguous, max_bytes })
    }

    /// Refuses pages that are too large for their file.
    fn check_size(&self) -> Result<(), FormatError> {
        let (plane_bytes, path) = (self.shape.num_bytes(), &self.files[0]);
        let found = std::fs::metadata(path).map_err(io_error(path))?.len();
        if plane_bytes <= MAX_PLANE_BYTES && plane_bytes <= found.saturating_mul(MAX_RATIO) {
            return Ok(());
        }
        let shape = self.shape.name();
        Err(FormatError::Short {
            path: shown(path),
            shape,
            expected: plane_bytes,
            found,
            unit: "bytes a page",
        })
    }

    fn planes_at(&self, places: Vec<PlanePlace>) -> TiffPlanes {
        TiffPlanes::new(&self.files, places, self.shape, self.plan.endian)
    }
}

impl Scan {
    /// What the pages of a group mean by the descriptions of their file, and whether these tell it. ImageJ describes
    /// the first group.
    fn stack(&self, group: &Group, is_first: bool) -> Result<(Stack, bool), String> {
        let is_array = |s: &&Shaped| s.num_planes(&group.shape).is_some_and(|n| n > 1);
        if let Some(shaped) = group.shaped.as_ref().filter(is_array) {
            return Ok((shaped.stack(group)?.unwrap_or_else(|| Stack::plain(group)), true));
        }
        let text = self.description.as_deref().filter(|text| is_first && imagej::is_imagej(text));
        Ok(match text {
            Some(text) => (imagej::stack(text, group, self.imagej.as_ref()), true),
            None => (Stack::plain(group), false),
        })
    }
}

/// The warning for a file with several series.
fn several_series(series: &[String]) -> String {
    let names = series.iter().take(MAX_NAMED).cloned().collect::<Vec<_>>().join("; ");
    format!("the file has {} series ({names}), of which 0 is shown", series.len())
}

impl VolumeFile for TiffFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        if let Some(offset) = self.contiguous {
            let (path, num_bytes) = (&self.files[0], collector.num_bytes());
            let data = Unpacked::open(open_file(path)?, path, offset, Some(num_bytes), Packing::Plain)?;
            return data.take(collector, path, 0, num_bytes);
        }
        self.check_size()?;
        let in_plane = self.shape.num_bytes() / collector.bytes_per_number();
        let mut finder = PageFinder::new(&self.files, self.shape);
        let mut planes = self.planes_at(Vec::new());
        for &location in &self.planes {
            if collector.is_done() {
                break;
            }
            if collector.gap() >= in_plane {
                collector.pass(in_plane);
                continue;
            }
            planes.set_only(finder.place(location)?);
            collector.push(&whole_plane(&planes, &self.plan, 0)?)?;
        }
        Ok(())
    }

    fn data_files(&self) -> Vec<PathBuf> {
        self.files.clone()
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        if let Some(offset) = self.contiguous {
            return flat_level(&self.plan, vec![FlatFile { path: self.files[0].clone(), offset }], path);
        }
        self.check_size()?;
        let mut finder = PageFinder::new(&self.files, self.shape);
        let places: Vec<PlanePlace> =
            self.planes.iter().map(|location| finder.place(*location)).collect::<Result<_, _>>()?;
        // Numbers that lie there as they are, are read without the rest of their strip.
        let offset = |place: &PlanePlace| match place {
            PlanePlace::At(chunks)
                if self.shape.dtype.num_bytes() == 1 || chunks.endian == self.plan.endian =>
            {
                chunks.plain_block(&self.shape)
            }
            _ => None,
        };
        let files = self.planes.iter().zip(&places).map(|(location, place)| {
            let path = self.files[location.as_ref()?.file as usize].clone();
            Some(FlatFile { path, offset: offset(place)? })
        });
        match files.collect::<Option<Vec<_>>>() {
            Some(files) => flat_level(&self.plan, files, path),
            None => plane_level(&self.plan, self.planes_at(places), self.max_bytes, path),
        }
    }
}

/// Sorts the files of a folder by the numbers in their names.
pub(crate) fn sort_by_number(files: &mut [PathBuf]) {
    files.sort_by_cached_key(|path| {
        let name = file_name(path);
        // Runs of digits are compared as numbers, first by length.
        let mut key = Vec::new();
        let mut rest = name.as_str();
        while let Some(first) = rest.chars().next() {
            let is_digit = first.is_ascii_digit();
            let end = rest.find(|c: char| c.is_ascii_digit() != is_digit).unwrap_or(rest.len());
            let word = &rest[..end];
            let number = word.trim_start_matches('0');
            key.push(if is_digit {
                (number.len(), number.to_owned())
            } else {
                (usize::MAX, word.to_owned())
            });
            rest = &rest[end..];
        }
        (key, name)
    });
}

/// Most series in a warning.
const MAX_NAMED: usize = 8;
/// Largest page in bytes.
const MAX_PLANE_BYTES: u64 = 1 << 30;
/// Greatest ratio of a file to one of its pages that is believed: that of LZW, times what zstd does better.
const MAX_RATIO: u64 = 16 * MAX_LZW_RATIO as u64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_sorted_by_their_numbers() {
        let mut files: Vec<PathBuf> =
            ["b2.tif", "a10.tif", "a9.tif", "a010.tif", "a1_2.tif", "a1_10.tif"].map(PathBuf::from).into();
        sort_by_number(&mut files);
        let names: Vec<String> = files.iter().map(|p| file_name(p)).collect();
        assert_eq!(names, ["a1_2.tif", "a1_10.tif", "a9.tif", "a010.tif", "a10.tif", "b2.tif"]);
    }
}
