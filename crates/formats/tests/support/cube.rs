//! Opens files with the small volume of `fixtures/make.py`.

use std::path::Path;

use isinglass_core::volume::Volume;
use isinglass_formats::{OpenOptions, Outline, Selection, open, outline};

pub(crate) fn open_as(path: &Path, selection: Selection) -> Volume {
    let options = OpenOptions { selection, ..Default::default() };
    open(path.to_str().unwrap(), &options).unwrap_or_else(|e| panic!("{e}"))
}

pub(crate) fn outline_as(path: &Path, selection: Selection) -> Outline {
    outline(path.to_str().unwrap(), &OpenOptions { selection, ..Default::default() }).unwrap()
}

pub(crate) fn error(path: &Path) -> String {
    let options = OpenOptions::default();
    let (a, b) = (open(path.to_str().unwrap(), &options), outline(path.to_str().unwrap(), &options));
    let message = a.map(|v| v.dims()).unwrap_err().to_string();
    assert!(message.lines().count() == 1 && message.len() < 800, "{message}");
    if let Err(e) = b {
        assert_eq!(e.to_string(), message);
    }
    message
}

/// The values, x fastest.
pub(crate) fn values(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

/// Checks that a volume is the one of `make.py`, but for a constant. Returns the value of the first voxel.
pub(crate) fn check(volume: &Volume, name: &str) -> f32 {
    assert_eq!(volume.dims(), [5, 4, 3], "{name}");
    let found = values(volume);
    for (i, x) in found.iter().enumerate() {
        let expected = (i % 5) + (i / 5 % 4) * 10 + i / 20 * 100;
        assert_eq!(x - found[0], expected as f32, "{name}: voxel {i}");
    }
    found[0]
}
