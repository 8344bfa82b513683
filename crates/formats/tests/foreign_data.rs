//! Are data files outside a header's folder refused, whatever names them or leads to them, and opened where the
//! options allow it?

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::{Path, PathBuf};

use isinglass_core::volume::{Volume, Voxels};
use isinglass_formats::{FormatError, OpenOptions, open, outline};
use tempfile::TempDir;

const SECRET: [u8; 24] = [99; 24];
const OWN: [u8; 24] = [7; 24];

/// A folder `data` with voxels of its own, and a file beside that folder that nobody meant to show.
struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        let folder = TempDir::new().unwrap();
        fs::create_dir_all(folder.path().join("data/sub")).unwrap();
        fs::write(folder.path().join("secret.raw"), SECRET).unwrap();
        fs::write(folder.path().join("data/own.raw"), OWN).unwrap();
        fs::write(folder.path().join("data/sub/own.raw"), OWN).unwrap();
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        fs::write(&path, bytes).unwrap();
        path
    }
}

fn opened(path: &Path, foreign_files: bool) -> Result<Volume, FormatError> {
    open(path.to_str().unwrap(), &OpenOptions { foreign_files, ..OpenOptions::default() })
}

/// The one value of all voxels.
fn value(volume: &Volume) -> f32 {
    let Voxels::U8(voxels) = volume.voxels() else { panic!("other voxels") };
    assert!(voxels.iter().all(|v| *v == voxels[0]));
    voxels[0].into()
}

/// It is refused, also before any voxel is read, and only the option makes it open.
fn assert_foreign(path: &Path, name: &str) {
    let source = path.to_str().unwrap();
    let mut messages = vec![opened(path, false).unwrap_err().to_string()];
    messages.extend(outline(source, &OpenOptions::default()).err().map(|e| e.to_string()));
    for message in messages {
        assert!(message.contains(source) && message.contains(name), "{message}");
        assert!(message.contains("--foreign-files") && !message.contains(char::is_control), "{message}");
    }
    assert_eq!(value(&opened(path, true).unwrap()), 99.0, "{name}");
}

fn nrrd(data: &str) -> String {
    format!("NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 3 2\nencoding: raw\ndata file: {data}\n")
}

fn metaimage(data: &str) -> String {
    format!(
        "ObjectType = Image\nNDims = 3\nDimSize = 4 3 2\nElementType = MET_UCHAR\nElementDataFile = {data}\n"
    )
}

#[test]
fn a_header_reads_no_file_outside_its_folder() {
    let bench = Bench::new();
    let secret = bench.path("secret.raw").display().to_string();
    bench.write("s1.raw", [99; 12]);
    bench.write("s2.raw", [99; 12]);
    let names = [&secret, "../secret.raw", "./sub/../../secret.raw", "sub/../../secret.raw"];
    for (header, write) in [("scan.nhdr", nrrd as fn(&str) -> String), ("scan.mhd", metaimage)] {
        let path = bench.path("data").join(header);
        for name in names {
            fs::write(&path, write(name)).unwrap();
            assert_foreign(&path, name);
            fs::write(&path, write(&format!("LIST\n{name}"))).unwrap();
            assert_foreign(&path, name);
        }
        fs::write(&path, write("../s%d.raw 1 2 1")).unwrap();
        assert_foreign(&path, "../s1.raw");
        // Whether a file outside is there makes no difference.
        fs::write(&path, write("../absent.raw")).unwrap();
        let message = opened(&path, false).unwrap_err().to_string();
        assert!(message.contains("--foreign-files"), "{message}");
        // The control: files in the folder and below it, however they are called.
        let own = bench.path("data/own.raw").display().to_string();
        for name in ["own.raw", "./own.raw", "sub/own.raw", "sub/../own.raw", &own] {
            fs::write(&path, write(name)).unwrap();
            assert_eq!(value(&opened(&path, false).unwrap()), 7.0, "{name}");
        }
    }
}

#[test]
fn a_data_file_of_another_name_is_noted() {
    let bench = Bench::new();
    bench.write("data/scan.raw", OWN);
    for (header, write) in [("scan.nhdr", nrrd as fn(&str) -> String), ("scan.mhd", metaimage)] {
        let path = bench.path("data").join(header);
        for (name, is_noted) in [("scan.raw", false), ("own.raw", true), ("sub/own.raw", true)] {
            fs::write(&path, write(name)).unwrap();
            let volume = opened(&path, false).unwrap();
            let note = format!("the voxels are in the file \"{name}\"");
            assert_eq!(volume.info.warnings.contains(&note), is_noted, "{:?}", volume.info.warnings);
        }
    }
}

#[cfg(unix)]
mod links {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn a_link_leads_no_header_outside() {
        let bench = Bench::new();
        symlink(bench.path("secret.raw"), bench.path("data/link.raw")).unwrap();
        symlink(bench.folder.path(), bench.path("data/up")).unwrap();
        symlink("own.raw", bench.path("data/inner.raw")).unwrap();
        let path = bench.path("data/scan.nhdr");
        for name in ["link.raw", "up/secret.raw"] {
            fs::write(&path, nrrd(name)).unwrap();
            assert_foreign(&path, name);
        }
        for name in ["inner.raw", "up/data/own.raw"] {
            fs::write(&path, nrrd(name)).unwrap();
            assert_eq!(value(&opened(&path, false).unwrap()), 7.0, "{name}");
        }
        // A link that a person names is what that person wants.
        symlink(&path, bench.path("scan.nhdr")).unwrap();
        fs::write(bench.path("own.raw"), OWN).unwrap();
        fs::write(&path, nrrd("own.raw")).unwrap();
        assert_eq!(value(&opened(&bench.path("scan.nhdr"), false).unwrap()), 7.0);
    }

    #[test]
    fn nor_a_pair_of_files() {
        let bench = Bench::new();
        let mut header = vec![0; 352];
        header[..4].copy_from_slice(&348i32.to_le_bytes());
        for (i, n) in [3i16, 4, 3, 2, 1, 1, 1, 1].iter().enumerate() {
            header[40 + 2 * i..][..2].copy_from_slice(&n.to_le_bytes());
        }
        header[70..72].copy_from_slice(&2i16.to_le_bytes());
        for i in 0..4 {
            header[76 + 4 * i..][..4].copy_from_slice(&1f32.to_le_bytes());
        }
        header[344..348].copy_from_slice(b"ni1\0");
        let path = bench.write("data/pair.hdr", header);
        bench.write("data/pair.img", OWN);
        assert_eq!(value(&opened(&path, false).unwrap()), 7.0);
        fs::remove_file(bench.path("data/pair.img")).unwrap();
        symlink(bench.path("secret.raw"), bench.path("data/pair.img")).unwrap();
        assert_foreign(&path, "pair.img");
    }

    #[test]
    fn nor_a_folder_of_chunks() {
        let bench = Bench::new();
        let array = bench.path("data");
        let metadata = r#"{"zarr_format": 2, "shape": [2, 3, 4], "chunks": [2, 3, 4], "dtype": "|u1",
            "compressor": null, "filters": null, "order": "C", "fill_value": 0}"#;
        bench.write("data/.zarray", metadata);
        let chunk = bench.write("data/0.0.0", OWN);
        assert_eq!(value(&opened(&array, false).unwrap()), 7.0);
        fs::remove_file(&chunk).unwrap();
        symlink(bench.path("secret.raw"), &chunk).unwrap();
        assert_foreign(&array, "0.0.0");
        // A level that is a link.
        bench.write(
            "data/.zattrs",
            r#"{"multiscales": [{"version": "0.4", "axes": ["z", "y", "x"],
            "datasets": [{"path": "level"}]}]}"#,
        );
        bench.write("data/.zgroup", r#"{"zarr_format": 2}"#);
        fs::remove_file(array.join(".zarray")).unwrap();
        fs::create_dir(bench.path("elsewhere")).unwrap();
        bench.write("elsewhere/.zarray", metadata);
        bench.write("elsewhere/0.0.0", SECRET);
        symlink(bench.path("elsewhere"), array.join("level")).unwrap();
        assert_foreign(&array, "level/.zarray");
        fs::remove_file(array.join("level")).unwrap();
        fs::rename(bench.path("elsewhere"), array.join("level")).unwrap();
        assert_eq!(value(&opened(&array, false).unwrap()), 99.0);
    }

    #[test]
    fn nor_a_folder_of_slices() {
        let bench = Bench::new();
        let slice = |name: &str, value: u8| {
            let file = fs::File::create(bench.path(name)).unwrap();
            let mut encoder = tiff::encoder::TiffEncoder::new(file).unwrap();
            encoder.write_image::<tiff::encoder::colortype::Gray8>(4, 3, &[value; 12]).unwrap();
        };
        fs::create_dir(bench.path("slices")).unwrap();
        slice("slices/1.tif", 99);
        slice("slices/2.tif", 99);
        slice("secret.tif", 99);
        assert_eq!(value(&opened(&bench.path("slices"), false).unwrap()), 99.0);
        symlink(bench.path("secret.tif"), bench.path("slices/3.tif")).unwrap();
        assert_foreign(&bench.path("slices"), "3.tif");
    }
}
