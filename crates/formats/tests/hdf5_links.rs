//! HDF5 files with links of every kind, user blocks, old and new layouts, and bit shuffles. h5py wrote most
//! (`fixtures/make_hdf5_dialects.py`); the layouts of old versions are written here.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/cube.rs"]
mod cube;
#[path = "support/old_hdf5.rs"]
mod old_hdf5;
mod support;

use std::fs;

use cube::{check, error, open_as, outline_as, values};
use isinglass_formats::{OpenOptions, Selection, open, outline, source_exists};
use old_hdf5::{OldLayout, old_file};
use support::unpack;
use tempfile::TempDir;

#[test]
fn links_to_paths_are_followed() {
    let folder = unpack("hdf5_links");
    for word in ["old", "new"] {
        let path = folder.path().join(format!("soft-{word}.h5"));
        // The array is there once, under its own path.
        let found = outline_as(&path, Selection::default());
        assert_eq!((&found.format[..], found.series.len()), ("HDF5, /entry/instrument/detector/data", 0));
        check(&open_as(&path, Selection::default()), word);
        for inside in ["entry/data/data", "entry/near", "alias/instrument/detector/data", "chain", "alias"] {
            check(&open_as(&path.join(inside), Selection::default()), inside);
            assert!(source_exists(path.join(inside).to_str().unwrap()));
        }
        // A group that has only a link.
        check(&open_as(&path.join("entry/data"), Selection::default()), "group");
        // The control: links that lead nowhere.
        for (inside, words) in
            [("round", "form a circle"), ("nowhere", "nothing is at"), ("entry/none", "nothing is at")]
        {
            let e = error(&path.join(inside));
            assert!(e.contains(words), "{e}");
        }
        let many = folder.path().join(format!("many-{word}.h5"));
        check(&open_as(&many.join("g/link 7"), Selection::default()), "many");
        assert!(error(&many.join("g/link 8")).contains("nothing is at"));
    }
}

#[test]
fn an_array_with_several_paths_is_one() {
    let folder = unpack("hdf5_links");
    for word in ["old", "new"] {
        let path = folder.path().join(format!("cycle-{word}.h5"));
        let found = outline_as(&path, Selection::default());
        assert!(found.series.is_empty(), "{:?}", found.series);
        assert!(
            ["HDF5, /g/v", "HDF5, /also/v", "HDF5, /also/same", "HDF5, /g/same"].contains(&&*found.format)
        );
        check(&open_as(&path, Selection::default()), word);
        // All paths of it work.
        for inside in ["g/v", "g/up/g/up/also/same", "also"] {
            check(&open_as(&path.join(inside), Selection::default()), inside);
        }
    }
}

#[test]
fn links_to_other_files_of_the_folder_are_followed() {
    let folder = unpack("hdf5_links");
    let inner = folder.path().join("inner");
    fs::create_dir(&inner).unwrap();
    for (from, to) in [("data_000001", "outside"), ("data_000001", "inner/data_000001")] {
        let file = |name: &str| folder.path().join(format!("{name}.h5"));
        fs::copy(file(from), file(to)).unwrap();
    }
    for word in ["old", "new"] {
        let path = inner.join(format!("master-{word}.h5"));
        fs::copy(folder.path().join(format!("master-{word}.h5")), &path).unwrap();
        let found = outline_as(&path, Selection::default());
        let warnings: Vec<&str> = found.warnings.iter().map(|w| &w.text[..]).collect();
        let warnings = warnings.join("\n");
        assert!(warnings.contains("the voxels are in the file \"data_000001.h5\""), "{warnings}");
        assert!(warnings.contains("data_000002.h5\", which is missing"), "{warnings}");
        assert!(warnings.contains("\"../outside.h5\", which is outside its folder"), "{warnings}");
        let volume = open_as(&path, Selection::default());
        check(&volume, word);
        check(&open_as(&path.join("entry/data/data_000001"), Selection::default()), word);
        check(&open_as(&path.join("entry/data"), Selection::default()), word);
        // Only whoever allows foreign files gets those of another folder.
        let name = path.join("entry/data/other");
        let e = error(&name);
        assert!(e.contains("outside its folder; --foreign-files"), "{e}");
        let options = OpenOptions { foreign_files: true, ..Default::default() };
        let e = open(name.to_str().unwrap(), &options).map(|v| v.dims()).unwrap_err().to_string();
        assert!(e.contains("nothing is at \"/a\""), "{e}");
    }
    for (name, words) in
        [("self", "is in the file"), ("missing", "\"/a\" leads to the file \"none.h5\", which is missing")]
    {
        let e = error(&folder.path().join(format!("{name}.h5")));
        assert!(e.contains(words), "{e}");
    }
}

#[test]
fn user_blocks_of_any_size_are_passed_over() {
    let folder = unpack("hdf5_links");
    for size in [512, 1024, 2048, 8192] {
        let path = folder.path().join(format!("block-{size}.h5"));
        check(&open_as(&path, Selection::default()), &size.to_string());
        check(&open_as(&path.join("b"), Selection::default()), &size.to_string());
    }
    // The control: a block of another size.
    let bytes = fs::read(folder.path().join("block-1024.h5")).unwrap();
    let path = folder.path().join("moved");
    fs::write(&path, &bytes[24..]).unwrap();
    assert!(error(&path).contains("no header that is known"));
}

#[test]
fn chunks_in_every_index_and_bit_shuffle() {
    let folder = unpack("hdf5_links");
    let mut num = 0;
    for entry in fs::read_dir(folder.path()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        if name.starts_with("chunks-") || name.starts_with("bits-") {
            num += 1;
            let volume = open_as(&path, Selection::default());
            assert_eq!(check(&volume, &name), 0.0);
            assert!(!volume.info.warnings.join("\n").contains("not found"), "{:?}", volume.info.warnings);
        }
    }
    assert_eq!(num, 7 + 12);
    let holes = values(&open_as(&folder.path().join("holes.h5"), Selection::default()));
    let expected: Vec<f32> = (0..160).map(|i| if (40..80).contains(&i) { 3.0 } else { -7.0 }).collect();
    assert_eq!(holes, expected);
    let deep = values(&open_as(&folder.path().join("deep.h5"), Selection::default()));
    assert!(deep.iter().enumerate().all(|(i, x)| *x == i as f32));
}

#[test]
fn layouts_of_old_versions() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("old.h5");
    for version in [1, 2] {
        for layout in [OldLayout::Compact, OldLayout::Contiguous, OldLayout::Chunked] {
            fs::write(&path, old_file(version, layout)).unwrap();
            let volume = open_as(&path, Selection::default());
            assert_eq!(check(&volume, &format!("{version} {layout:?}")), 0.0);
            assert_eq!(outline_as(&path, Selection::default()).format, "HDF5, /a");
        }
    }
    // The control: a version that no library writes.
    fs::write(&path, old_file(9, OldLayout::Contiguous)).unwrap();
    assert!(error(&path).contains("layout 9, expected 1 to 5"));
}

/// Every byte of the headers in turn becomes something else. Whatever is read then, nothing panics.
#[test]
fn damaged_links_and_layouts_are_errors() {
    let folder = unpack("hdf5_links");
    let path = folder.path().join("damaged.h5");
    for name in ["soft-old", "soft-new", "master-new", "chunks-newfixed", "chunks-tree2packed"] {
        let bytes = fs::read(folder.path().join(format!("{name}.h5"))).unwrap();
        for at in (0..bytes.len().min(6000)).step_by(7) {
            let mut damaged = bytes.clone();
            damaged[at] ^= [0xff, 1, 0x80][at % 3];
            fs::write(&path, &damaged).unwrap();
            let text = path.to_str().unwrap();
            if let Err(e) = outline(text, &OpenOptions::default()) {
                assert_eq!(e.to_string().lines().count(), 1, "{name} {at}: {e}");
            }
            let _ = open(text, &OpenOptions { max_bytes: 1 << 20, ..Default::default() });
        }
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let _ = outline(path.to_str().unwrap(), &OpenOptions::default());
    }
}
