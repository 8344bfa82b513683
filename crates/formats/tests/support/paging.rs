//! Pages beside the same parts of the whole volume.

use std::path::Path;

use isinglass_core::volume::{PAGE_POINTS, PageId, PageSource, PageVoxels, Volume};
use isinglass_formats::{OpenOptions, PagedFile, Selection, open, open_paged};

pub(crate) fn text(path: &Path) -> &str {
    path.to_str().expect("the path is UTF-8")
}

/// The places of all pages of a level.
pub(crate) fn places(source: &dyn PageSource, level: usize) -> impl Iterator<Item = [u32; 3]> {
    let [nx, ny, nz] = source.pyramid().pages(level);
    (0..nx * ny * nz).map(move |i| [i % nx, i / nx % ny, i / nx / ny])
}

/// Whether a page has the voxels of `volume` from `first` on, of which the last ones repeat.
pub(crate) fn is_part(page: &PageVoxels, volume: &Volume, first: [u32; 3]) -> bool {
    let dims = volume.dims();
    (0..PAGE_POINTS.pow(3)).all(|i| {
        let at = [i % PAGE_POINTS, i / PAGE_POINTS % PAGE_POINTS, i / PAGE_POINTS.pow(2)];
        let [x, y, z] = [0, 1, 2].map(|k| (first[k] + at[k]).min(dims[k] - 1) as usize);
        let index = (z * dims[1] as usize + y) * dims[0] as usize + x;
        let is_gap = volume.gaps().is_some_and(|gaps| gaps.bytes[index] != 0);
        let found = page.gaps.as_ref().is_some_and(|gaps| gaps[i as usize] != 0);
        page.voxels.get(i as usize).to_bits() == volume.voxels().get(index).to_bits() && is_gap == found
    })
}

/// Checks all pages of the levels that can be opened whole, and the base.
pub(crate) fn check_pages(path: &Path, options: &OpenOptions) -> PagedFile {
    let paged = open_paged(text(path), options).unwrap_or_else(|e| panic!("{e}"));
    let source = &*paged.source;
    let levels = source.pyramid().levels.clone();
    let has_levels = !isinglass_formats::outline(text(path), options).expect("opens").levels.is_empty();
    for (l, level) in levels.iter().enumerate() {
        let whole = if l + 1 == levels.len() {
            paged.base.clone()
        } else {
            let selection = Selection { level: has_levels.then_some(l as u32), ..options.selection };
            open(text(path), &OpenOptions { selection, ..*options }).expect("opens")
        };
        assert_eq!(whole.dims(), level.dims, "{} level {l}", path.display());
        assert_eq!(whole.channels().count(), paged.base.channels().count());
        for (c, channel) in whole.channels().enumerate() {
            assert_eq!(channel.value_map(), source.pyramid().value_maps[c]);
            for at in places(source, l) {
                let page = source.read(c, PageId { level: l as u8, at }).unwrap_or_else(|e| panic!("{e}"));
                let first = level.first_point(at);
                assert!(is_part(&page, channel, first), "{} {l} {c} {at:?}", path.display());
            }
        }
    }
    assert_eq!(paged.base.finest().expect("a base").dims, levels[0].dims);
    paged
}
