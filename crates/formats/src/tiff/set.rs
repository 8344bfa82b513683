//! OME-TIFF: an image in one or several files. The description is in one of them or in another file.

use std::collections::HashSet;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::ome::{self, Files, Ome};
use super::page::{self, Group, Scan};
use super::stack::{Stack, plan};
use super::{PageLocation, TiffFile, several_series};
use crate::error::{FormatError, io_error, malformed, not_there, quoted, shown};
use crate::foreign::HomeFolder;
use crate::source::{OpenOptions, file_name, open_file};
use crate::warning::WarningKind;

/// The files of an image, before they are read.
pub(super) struct OmeSet {
    ome: Ome,
    index: usize,
    files: Files,
    /// The file that was opened, and the others in `files`.
    paths: Vec<PathBuf>,
    /// Number of files in the folder that belong to no image.
    num_left: usize,
}

impl OmeSet {
    /// Finds the files of the image in `text`, the description of the first of `files`. Returns `None` if each file
    /// is a slice of its own.
    pub(super) fn open(
        text: &str,
        files: &[PathBuf],
        path: &Path,
        options: &OpenOptions,
    ) -> Result<Option<Self>, FormatError> {
        let bad = malformed(path, OME_TIFF);
        let own = &files[0];
        let folder = own.parent().unwrap_or(Path::new("")).to_owned();
        let home = HomeFolder::of_header(own, options);
        let mut ome = Ome::read(text).map_err(bad)?;
        if let Some(name) = ome.metadata_file.take() {
            ome = elsewhere(&home, &folder, &name, own)?;
        }
        let index = options.selection.series.unwrap_or(0) as usize;
        if index >= ome.num_images() {
            return Err(not_there(path, "series", index as u64, ome.num_images()));
        }
        let is_there = |name: &str| folder.join(name).is_file();
        let own_name = file_name(own);
        let named = ome.files(index, &own_name, &is_there).map_err(bad)?;
        let mut num_left = 0;
        if files.len() > 1 {
            // The files of a folder need not belong together.
            let mut members = HashSet::from([own_name.clone()]);
            for i in 0..ome.num_images() {
                members.extend(ome.files(i, &own_name, &is_there).map_err(bad)?.others);
            }
            num_left = files.iter().filter(|f| !members.contains(&file_name(f))).count();
            if num_left == files.len() - 1 {
                if ome.num_images() == 1 && ome.places(0, &named).take(2).count() < 2 && ome.is_slice(0) {
                    return Ok(None);
                }
                return Err(FormatError::Unsupported {
                    path: shown(path),
                    found: "a folder of several OME-TIFF images",
                    expected: "one of its files, or the files of one image",
                });
            }
        }
        let others = named.others.iter().map(|name| home.file(name)).collect::<Result<Vec<_>, _>>()?;
        let paths = std::iter::once(own.clone()).chain(others).collect();
        Ok(Some(Self { ome, index, files: named, paths, num_left }))
    }

    /// Opens the image. `first` is the scan of the file that was opened.
    pub(super) fn into_file(
        self,
        mut first: Scan,
        path: &Path,
        options: &OpenOptions,
    ) -> Result<TiffFile, FormatError> {
        let (bad, endian) = (malformed(path, OME_TIFF), first.endian);
        let Self { ome, index, files, paths, num_left } = self;
        let mut missing: Vec<&PathBuf> = paths[1..].iter().filter(|p| !p.is_file()).collect();
        // All pages should have the shape of the first that exists.
        let is_there = |p: &PageLocation| paths.get(p.file as usize).is_some_and(|p| !missing.contains(&p));
        let is_told = ome.places(index, &files).next().is_some();
        let place = ome.places(index, &files).find(is_there);
        if is_told && place.is_none() {
            let name = missing.first().map_or(String::new(), |p| quoted(&file_name(p)));
            return Err(bad(format!("its planes are in {name}, which is missing")));
        }
        let known = |g: &Group| place.is_none_or(|p| p.file == 0 && g.pages.contains(&p.page));
        let group = match (first.groups.iter().position(known), place) {
            (None, Some(place)) => Group::of(&paths[place.file as usize], place.page)?,
            (at, _) => first.groups.swap_remove(at.unwrap_or(0)),
        };
        let mut stack = ome::stack(&ome, index, &files, group.shape.samples.into()).map_err(bad)?;
        let num_planes = stack.num_planes().map_err(bad)?;
        let mut warnings = Vec::new();
        let planes = stack.planes.take().unwrap_or_else(|| {
            let found = group.pages.len();
            if num_planes != found as u64 {
                warnings.push(stack.read_as_slices(num_planes, found));
            }
            group.pages.iter().map(|&page| Some(PageLocation { file: 0, page })).collect()
        });
        let mut plan = plan(&group, &mut stack, endian).map_err(bad)?;
        if ome.num_images() > 1 && options.selection.series.is_none() {
            plan.warn(WarningKind::Choice, several_series(&plan.series));
        }
        let num_unknown = planes.iter().filter(|p| p.is_none()).count();
        if num_unknown > 0 {
            warnings.push(format!("{num_unknown} planes are not in the file and are shown empty"));
        }
        if !missing.is_empty() {
            let count = missing.len();
            missing.truncate(MAX_NAMED);
            let names: Vec<String> = missing.iter().map(|p| quoted(&file_name(p))).collect();
            let more = if count > names.len() { ", …" } else { "" };
            let names = names.join(", ");
            warnings.push(format!("{count} of {} files are missing: {names}{more}", paths.len()));
        }
        if num_left > 0 {
            warnings
                .push(format!("{num_left} TIFF files of the folder are not of this image and were left out"));
        }
        for text in warnings {
            plan.warn(WarningKind::Data, text);
        }
        let (shape, max_bytes) = (group.shape, options.max_bytes);
        Ok(TiffFile { plan, files: paths, planes, shape, contiguous: None, max_bytes })
    }
}

/// Reads the description in the file `name`, to which `own` beside it refers. It is a TIFF file or a document.
fn elsewhere(home: &HomeFolder, folder: &Path, name: &str, own: &Path) -> Result<Ome, FormatError> {
    let bad = malformed(own, OME_TIFF);
    if name.is_empty() || name.contains(['/', '\\', '\0']) {
        return Err(bad(format!(
            "its description is in file {}, expected a name without folders",
            quoted(name)
        )));
    }
    let path = folder.join(name);
    if !path.is_file() {
        return Err(bad(format!("its description is in {}, which is missing", quoted(name))));
    }
    home.check(&path)?;
    let mut bytes = Vec::new();
    open_file(&path)?.take(MAX_DOCUMENT_BYTES + 1).read_to_end(&mut bytes).map_err(io_error(&path))?;
    let text = if bytes.starts_with(b"II") || bytes.starts_with(b"MM") {
        page::description(&mut page::decoder(&path)?).unwrap_or_default()
    } else if bytes.len() as u64 > MAX_DOCUMENT_BYTES {
        return Err(bad(format!("{} has more than {MAX_DOCUMENT_BYTES} bytes", quoted(name))));
    } else {
        String::from_utf8_lossy(&bytes).into_owned()
    };
    let ome = Ome::read(&text).map_err(malformed(&path, OME_TIFF))?;
    if ome.num_images() == 0 {
        return Err(bad(format!(
            "its description is in {}, expected OME-XML with an image there",
            quoted(name)
        )));
    }
    Ok(ome)
}

/// A stack of slices in separate files. `text` describes the first.
pub(super) fn slices(text: &str, group: &Group) -> Result<Stack, String> {
    let plain = Stack::plain(group);
    let ome = Ome::read(text)?;
    let files = ome.files(0, "", &|_| false)?;
    let told = ome::stack(&ome, 0, &files, group.shape.samples.into())?;
    Ok(Stack {
        spacing: told.spacing,
        unit: told.unit,
        channel_names: told.channel_names,
        channel_looks: told.channel_looks,
        ..plain
    })
}

/// Longest document in bytes.
const MAX_DOCUMENT_BYTES: u64 = 64 << 20;
/// Most files or images in a warning.
const MAX_NAMED: usize = 8;

const OME_TIFF: &str = "OME-TIFF";
