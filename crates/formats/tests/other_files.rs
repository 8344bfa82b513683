//! Files of other programs. The message names them and tells how to convert them.

use std::fs;
use std::io::Write;

use isinglass_formats::{OpenOptions, outline};
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
        ("a.mgz", packed.clone(), "a FreeSurfer MGH volume", "`mri_convert FILE FILE.nii.gz`"),
        ("a.mgh", vec![0, 0, 0, 1, 0, 0, 1, 0], "a FreeSurfer MGH volume", "`mri_convert"),
        ("a.gz", packed, "gzip data that is no NIfTI file", "an NRRD file, NIfTI"),
        ("a.hdr", analyze, "an Analyze header", "`nib-convert FILE.hdr FILE.nii`"),
        ("pair.img", vec![7; 400], "voxels of a pair of files", "the .hdr file beside it"),
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
