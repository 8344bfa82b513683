//! Files of other programs, packed files, and folders. Messages say what was found and what to do.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::io::Write;
use std::path::Path;

use isinglass_core::volume::Volume;
use isinglass_formats::{OpenOptions, open, outline, source_exists};
use tempfile::TempDir;

#[test]
fn each_is_named_with_the_way_to_a_volume() {
    let folder = TempDir::new().unwrap();
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(&[0, 0, 0, 1, 0, 0, 1, 0]).unwrap();
    let packed = packed.finish().unwrap();
    let mut analyze = vec![0x5c, 1, 0, 0];
    analyze.resize(348, 0);
    fs::write(folder.path().join("pair.hdr"), &analyze).unwrap();
    for (name, bytes, found, expected) in [
        ("a.gz", packed, "gzip data of an unknown format", "an NRRD file, NIfTI"),
        (
            "a.nii",
            b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n".to_vec(),
            "a Git LFS pointer",
            "`git lfs pull`",
        ),
        ("a.hdr", analyze, "an Analyze header", "`nib-convert FILE.hdr FILE.nii`"),
        // The header beside it is opened.
        ("pair.img", vec![7; 400], "an Analyze header", "`nib-convert"),
        ("alone.img", vec![7; 400], "voxels without their .hdr file", "the .hdr file"),
        ("a.czi", b"ZISRAWFILE\0\0\0\0\0\0".to_vec(), "a Zeiss CZI file", "`bfconvert FILE FILE.ome.tif`"),
        ("a.lif", vec![0x70, 0, 0, 0, 9, 9, 0, 0, 0x2a, 1], "a Leica LIF file", "`bfconvert"),
        ("a.nd2", vec![0xda, 0xce, 0xbe, 0x0a, 0x10], "a Nikon ND2 file", "`bfconvert"),
        (
            "a.companion.ome",
            b"<?xml version=\"1.0\"?><OME></OME>".to_vec(),
            "description of an OME-TIFF",
            "TIFF files",
        ),
    ] {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        let message = outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap_err().to_string();
        let is_one_line = message.lines().count() == 1;
        assert!(is_one_line && message.contains(found) && message.contains(expected), "{message}");
    }
}

fn opened(path: &Path) -> Volume {
    open(path.to_str().unwrap(), &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn refused(source: &str) -> String {
    let e = outline(source, &OpenOptions::default()).unwrap_err().to_string();
    assert_eq!(e.lines().count(), 1, "{e}");
    e
}

fn values(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// An NRRD file of 2×1×1 voxels.
const NRRD: &[u8] = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 1 1\nencoding: raw\n\n\x05\x06";

/// A MetaImage file of 2×1×1 voxels.
const MHA: &[u8] =
    b"NDims = 3\nDimSize = 2 1 1\nElementType = MET_UCHAR\nElementSpacing = 1 2 3\nElementDataFile = LOCAL\n\x05\x06";

/// A FreeSurfer volume of 2×1×1 voxels, with or without a place.
fn mgh(is_placed: bool) -> Vec<u8> {
    let mut bytes: Vec<u8> = [1, 2, 1, 1, 1, 4, 0].iter().flat_map(|n: &i32| n.to_be_bytes()).collect();
    bytes.extend(i16::from(is_placed).to_be_bytes());
    // The spacing, the directions left, down and front, and the middle.
    let numbers = [1.5f32, 2.0, 3.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0, 10.0, 20.0, 30.0];
    bytes.extend(numbers.iter().flat_map(|x| x.to_be_bytes()));
    bytes.resize(284, 0);
    bytes.extend([5i16, -6].iter().flat_map(|n| n.to_be_bytes()));
    // Notes follow.
    bytes.extend(b"mri_convert");
    bytes
}

#[test]
fn any_format_may_be_in_gzip() {
    let folder = TempDir::new().unwrap();
    let file = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        path
    };
    for (name, bytes) in [("a.nrrd.gz", NRRD), ("a.mha.gz", MHA), ("b.gz", MHA)] {
        let volume = opened(&file(name, &gzip(bytes)));
        assert_eq!((values(&volume), volume.info.name.as_str()), (vec![5.0, 6.0], name));
    }
    // The parts of a file in gzip follow each other, as `cat` joins them.
    let (a, b) = NRRD.split_at(20);
    assert_eq!(values(&opened(&file("two.nrrd.gz", &[gzip(a), gzip(b)].concat()))), [5.0, 6.0]);
    // Errors name the file, and no temporary folder.
    let cut = gzip(&NRRD[..NRRD.len() - 1]);
    let cut = file("cut.nrrd.gz", &cut);
    let e = open(cut.to_str().unwrap(), &OpenOptions::default()).unwrap_err().to_string();
    let expected = "cut.nrrd.gz/cut.nrrd: 2×1×1 uint8 needs 2 bytes, found 1";
    assert!(e.ends_with(expected) && e.starts_with(folder.path().to_str().unwrap()), "{e}");
    // A file may not unpack to more than the memory that is allowed.
    let large = file("large.nrrd.gz", &gzip(&[NRRD, &vec![0; 1 << 20]].concat()));
    let options = OpenOptions { max_bytes: 1 << 19, ..OpenOptions::default() };
    let e = open(large.to_str().unwrap(), &options).unwrap_err().to_string();
    assert!(e.contains("524289 bytes of memory, expected at most 524288"), "{e}");
}

#[test]
fn volumes_of_freesurfer_have_their_place() {
    let folder = TempDir::new().unwrap();
    for (name, bytes) in [("a.mgh", mgh(true)), ("a.mgz", gzip(&mgh(true))), ("b.mgh.gz", gzip(&mgh(true)))] {
        fs::write(folder.path().join(name), bytes).unwrap();
        let volume = opened(&folder.path().join(name));
        // x runs to the left, so the voxels are reversed.
        assert_eq!(
            (values(&volume), volume.spacing().to_array()),
            (vec![-6.0, 5.0], [1.5, 3.0, 2.0]),
            "{name}"
        );
        // The header has the voxel after the middle. For a side of one voxel, that is half a voxel away.
        let center = volume.info.placement.unwrap().center;
        assert_eq!(center, [10.0 + 0.75, 20.0 - 1.5, 30.0 + 1.0], "{name}");
        assert!(!volume.info.warnings.iter().any(|w| w.contains("more data")), "{:?}", volume.info.warnings);
    }
    fs::write(folder.path().join("c.mgh"), mgh(false)).unwrap();
    let volume = opened(&folder.path().join("c.mgh"));
    assert_eq!(volume.spacing().to_array(), [1.0; 3]);
    assert!(volume.info.warnings[0].contains("the header has no place"), "{:?}", volume.info.warnings);
    let mut bytes = mgh(true);
    bytes[23] = 2;
    fs::write(folder.path().join("d.mgh"), bytes).unwrap();
    assert!(
        refused(folder.path().join("d.mgh").to_str().unwrap())
            .contains("its type is 2, expected 0, 1, 3, 4 or 10")
    );
}

#[test]
fn legacy_vtk_images_are_read() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.vtk");
    let head = |kind: &str, data: &str| {
        format!(
            "# vtk DataFile Version 3.0\nmade\n{kind}\nDATASET STRUCTURED_POINTS\nDIMENSIONS 2 1 1\nORIGIN 10 0 0\nSPACING 1 2 3\n{data}"
        )
    };
    let of = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        opened(&path)
    };
    let text = head("ASCII", "POINT_DATA 2\nSCALARS density short 1\nLOOKUP_TABLE default\n5 -6\n");
    let volume = of(text.as_bytes());
    assert_eq!((values(&volume), volume.spacing().to_array()), (vec![5.0, -6.0], [1.0, 2.0, 3.0]));
    assert_eq!(volume.info.placement.unwrap().center, [10.5, 0.0, 0.0]);
    let binary = head("BINARY", "POINT_DATA 2\nSCALARS density short\nLOOKUP_TABLE default\n");
    let more = b"\0\x05\xff\xfa\nSCALARS other short\n";
    assert_eq!(values(&of(&[binary.as_bytes(), more].concat())), [5.0, -6.0]);
    let field = head("BINARY", "POINT_DATA 2\nFIELD FieldData 1\ndensity 1 2 float\n");
    let floats: Vec<u8> = [0.5f32, 2.0].iter().flat_map(|x| x.to_be_bytes()).collect();
    assert_eq!(values(&of(&[field.as_bytes(), &floats].concat())), [0.5, 2.0]);
    // Values of cells lie between the points.
    let cells = head("ASCII", "CELL_DATA 1\nSCALARS density float\n7.5\n");
    let volume = of(cells.as_bytes());
    assert_eq!((volume.dims(), values(&volume)), ([1, 1, 1], vec![7.5]));
    for (bytes, expected) in [
        (
            text.replace("STRUCTURED_POINTS", "POLYDATA"),
            r#"the dataset is "POLYDATA", expected STRUCTURED_POINTS"#,
        ),
        (text.replace("ASCII", "ascii"), r#"line 3 is "ascii", expected ASCII or BINARY"#),
        (text.replace("short", "bit"), r#"array "density" has the type "bit", expected a number"#),
        (text.replace("DIMENSIONS 2 1 1", ""), "DIMENSIONS is missing"),
        (head("ASCII", ""), "no array begins"),
    ] {
        fs::write(&path, bytes).unwrap();
        let e = refused(path.to_str().unwrap());
        assert!(e.contains(expected), "{e}");
    }
}

/// A ZIP archive of these entries, which are stored as they are.
fn zip(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut archive = rawzip::ZipArchiveWriter::new(Vec::new());
    for (name, bytes) in entries {
        let (mut entry, config) = archive.new_file(name).start().unwrap();
        let mut writer = config.wrap(&mut entry);
        writer.write_all(bytes).unwrap();
        let (_, descriptor) = writer.finish().unwrap();
        entry.finish(descriptor).unwrap();
    }
    archive.finish().unwrap()
}

#[test]
fn archives_hold_files_or_folders() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.zip");
    let of = |entries: &[(&str, &[u8])]| {
        fs::write(&path, zip(entries)).unwrap();
        path.to_str().unwrap().to_owned()
    };
    assert_eq!(values(&opened(Path::new(&of(&[("deep/a.nrrd", NRRD)])))), [5.0, 6.0]);
    let png = |value: u8| isinglass_formats::png::encode(2, 1, &[value; 6]).unwrap();
    let (one, two) = (png(7), png(9));
    let slices =
        of(&[("s/2.png", &two), ("s/1.png", &one), ("__MACOSX/s/._1.png", b"?"), ("s/.DS_Store", b"?")]);
    let volume = opened(Path::new(&slices));
    assert_eq!((values(&volume), volume.info.name.as_str()), (vec![7.0, 7.0, 9.0, 9.0], "a.zip"));
    for (entries, expected) in [
        (
            &[("__MACOSX/a.nrrd", NRRD)][..],
            "a.zip: found a ZIP archive without files, expected one with a volume",
        ),
        (&[("b.zip", &zip(&[("a.nrrd", NRRD)]))], "a.zip: found a ZIP archive in a ZIP archive, expected"),
        (&[("a.txt", b"hello")], "a.zip/a.txt: found no header that is known, expected"),
        (&[("a/b.txt", b"hello"), ("a/c.txt", b"hello")], "a.zip/a: found a folder without slices, expected"),
    ] {
        let e = refused(&of(entries));
        assert!(e.contains(expected), "{e}");
    }
}

#[test]
fn an_image_of_ome_zarr_may_be_in_an_archive() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.ozx");
    let image =
        br#"{"zarr_format": 3, "node_type": "group", "attributes": {"ome": {"version": "0.5", "multiscales":
        [{"axes": [{"name": "z"}, {"name": "y"}, {"name": "x"}], "datasets": [{"path": "0",
        "coordinateTransformations": [{"type": "scale", "scale": [3, 2, 1]}]}]}]}}}"#;
    let array = br#"{"zarr_format": 3, "node_type": "array", "shape": [1, 2, 2], "data_type": "uint8", "fill_value": 0,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [1, 2, 2]}},
        "chunk_key_encoding": {"name": "default"}, "codecs": [{"name": "bytes"}]}"#;
    let all: &[(&str, &[u8])] = &[("zarr.json", image), ("0/zarr.json", array), ("0/c/0/0/0", &[1, 2, 3, 4])];
    fs::write(&path, zip(all)).unwrap();
    let volume = opened(&path);
    assert_eq!((values(&volume), volume.spacing().to_array()), (vec![1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0]));
    assert_eq!(volume.info.name, "a.ozx");
    // A file of the image that is cut is told with the name of the archive.
    fs::write(&path, zip(&[all[0], all[1], ("0/c/0/0/0", &[1, 2, 3])])).unwrap();
    let e = open(path.to_str().unwrap(), &OpenOptions::default()).unwrap_err().to_string();
    assert!(e.contains("a.ozx/0/c/0/0/0") && e.contains("it has 3 bytes, expected 4"), "{e}");
}

#[test]
fn folders_of_pictures_leave_out_what_is_unlike() {
    let folder = TempDir::new().unwrap();
    let put = |name: &str, bytes: &[u8]| fs::write(folder.path().join(name), bytes).unwrap();
    let picture = |side: u32, value: u8| {
        isinglass_formats::png::encode(side, 1, &vec![value; 3 * side as usize]).unwrap()
    };
    for (i, value) in [(1, 10), (2, 20), (10, 30)] {
        put(&format!("s{i}.png"), &picture(2, value));
    }
    put("a_preview.png", &picture(5, 99));
    put("s3.png", b"");
    let volume = opened(folder.path());
    assert_eq!((volume.dims(), values(&volume)), ([2, 1, 3], vec![10.0, 10.0, 20.0, 20.0, 30.0, 30.0]));
    let said = "2 files are not like the others and were left out, the first: a_preview.png";
    assert!(volume.info.warnings.iter().any(|w| w == said), "{:?}", volume.info.warnings);
    // A lone picture is one slice.
    let lone = opened(&folder.path().join("s1.png"));
    assert_eq!(lone.dims(), [2, 1, 1]);
    assert!(lone.info.warnings.iter().any(|w| w.contains("its folder is a stack")));

    let pages = TempDir::new().unwrap();
    let page = |name: &str, side: u32| {
        let file = fs::File::create(pages.path().join(name)).unwrap();
        let mut encoder = tiff::encoder::TiffEncoder::new(file).unwrap();
        encoder.write_image::<tiff::encoder::colortype::Gray8>(side, 1, &vec![7; side as usize]).unwrap();
    };
    page("0_preview.tif", 9);
    ["1.tif", "2.tif", "3.tif"].into_iter().for_each(|name| page(name, 2));
    fs::write(pages.path().join("4.tif"), b"").unwrap();
    let volume = opened(pages.path());
    assert_eq!(volume.dims(), [2, 1, 3]);
    let said = "2 files are not like the others and were left out, the first: 0_preview.tif";
    assert!(volume.info.warnings.iter().any(|w| w == said), "{:?}", volume.info.warnings);
}

#[test]
fn folders_and_places_are_told_apart() {
    let folder = TempDir::new().unwrap();
    let put = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, bytes).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let mut nifti = vec![0; 352];
    nifti[..4].copy_from_slice(&348i32.to_le_bytes());
    nifti[344..348].copy_from_slice(b"n+1\0");
    put("many/a.nii.gz", &gzip(&nifti));
    put("many/b.nii.gz", &gzip(&nifti));
    let e = refused(folder.path().join("many").to_str().unwrap());
    assert!(e.ends_with("found a folder of volumes, expected one of them, or a folder of slices"), "{e}");
    put("pointers/a.dcm", b"version https://git-lfs.github.com/spec/v1\n");
    let e = refused(folder.path().join("pointers").to_str().unwrap());
    assert!(e.contains("a folder of Git LFS pointers"), "{e}");
    put("empty/a.txt", b"hello");
    assert!(refused(folder.path().join("empty").to_str().unwrap()).contains("a folder without slices"));
    for address in ["ftp://example.org/a.zarr", "gs://bucket/a.zarr"] {
        let e = refused(address);
        assert!(e.starts_with(&format!("{address}: found an address, expected a path")), "{e}");
    }
    assert!(refused("nowhere/a.nrrd").contains("No such file"));
    // A missing file of voxels is told with the name of its header.
    let header = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 1 1\nencoding: raw\ndata file: gone.raw\n";
    let e = refused(&put("a.nhdr", header));
    assert!(
        e.ends_with(r#"a.nhdr: its data file "gone.raw" is missing; expected it beside the header"#),
        "{e}"
    );
    put("gone.raw", b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n");
    let e = refused(folder.path().join("a.nhdr").to_str().unwrap());
    assert!(e.contains("gone.raw: found a Git LFS pointer in place of the file"), "{e}");
    fs::remove_file(folder.path().join("gone.raw")).unwrap();
    let mhd = String::from_utf8_lossy(&MHA[..MHA.len() - 2]).replace("LOCAL", "gone.raw");
    assert!(refused(&put("a.mhd", mhd.as_bytes())).contains(r#"a.mhd: its data file "gone.raw" is missing"#));
    // A scale of zero is told in words, and another can be given.
    let zero = put("zero.mha", &String::from_utf8_lossy(MHA).replace("= 1 2 3", "= 0 2 3").into_bytes());
    let e = refused(&zero);
    let expected = "the distances of voxels along its axes are 0, 2 and 3, expected finite numbers above zero; --spacing replaces them";
    assert!(e.contains(expected) || e.contains("ElementSpacing"), "{e}");
    let spacing = Some(glam::Vec3::new(4.0, 2.0, 3.0));
    let given = open(&zero, &OpenOptions { spacing, ..OpenOptions::default() });
    assert!(given.is_ok_and(|v| v.spacing().to_array() == [4.0, 2.0, 3.0]) || !e.contains(expected));
}

#[cfg(target_os = "linux")]
#[test]
fn names_that_are_no_utf8_are_found() {
    use std::os::unix::ffi::OsStrExt;
    let folder = TempDir::new().unwrap();
    let name = std::ffi::OsStr::from_bytes(b"M\xfcller.nrrd");
    fs::create_dir(folder.path().join(std::ffi::OsStr::from_bytes(b"\xe4"))).unwrap();
    fs::write(folder.path().join(std::ffi::OsStr::from_bytes(b"\xe4")).join(name), NRRD).unwrap();
    let source = format!("{}/\u{fffd}/M\u{fffd}ller.nrrd", folder.path().display());
    let volume = open(&source, &OpenOptions::default()).unwrap();
    assert_eq!(values(&volume), [5.0, 6.0]);
    assert!(source_exists(&source) && !source_exists(&source.replace("ller", "llen")));
    assert!(refused(&source.replace("ller", "llen")).contains("No such file"));
}
